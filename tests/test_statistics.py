"""Interquartile mean, probability of improvement and bootstrap intervals: by hand, and as rliable computes them.

Of rliable's example there are its own score matrices, those of its unit tests, and seeded matrices of the shapes of its
published scores (10 runs of 26 games, 3 and 5 runs of 55 games). The published scores themselves carry no licence, so they
are not stored here.
"""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rliable import metrics as rliable_metrics
from rliable.library import StratifiedBootstrap, StratifiedIndependentBootstrap, get_interval_estimates

from sb3_momba.benchmark import statistics
from sb3_momba.benchmark.statistics import Estimate, estimate, interquartile_mean, probability_of_improvement


def heavy_tailed(seed: int, n_runs: int, n_tasks: int, level: float = 1.0) -> np.ndarray:
    """Scores as of a benchmark of games, (n_runs, n_tasks): tasks of different levels, runs of Student's t of 2 degrees of
    freedom, so that single ones are far off, and two decimals, so that some are equal."""
    rng = np.random.default_rng(seed)
    medians = level * np.exp(1.5 * rng.random(n_tasks) - 1.5)
    u = rng.random((n_runs, n_tasks))
    return np.round(medians * (1 + 0.2 * (2 * u - 1) / np.sqrt(2 * u * (1 - u))), 2)


COUNTING = np.arange(80).reshape(5, 16)  # of rliable's own tests of its intervals (library_test.py)
SCORES = {
    "counting": COUNTING,
    "counting down": np.flip(COUNTING, axis=0),
    "10 runs of 26 games": heavy_tailed(0, 10, 26),
    "10 better runs of 26 games": heavy_tailed(1, 10, 26, level=1.15),
    "5 runs of 55 games": heavy_tailed(2, 5, 55),
    "3 runs of 55 games": heavy_tailed(3, 3, 55),
    "1 run of 26 games": heavy_tailed(4, 1, 26),
}
PAIRS = [
    ("counting", "counting down"),
    ("10 better runs of 26 games", "10 runs of 26 games"),
    ("5 runs of 55 games", "3 runs of 55 games"),
    ("1 run of 26 games", "10 runs of 26 games"),
]
MATRICES = [(name,) for name in SCORES] + PAIRS


def tasks_of(name: str) -> list[np.ndarray]:
    """rliable has a run per row, this package an array per task."""
    return list(SCORES[name].T)


def statistics_of(names: tuple[str, ...]):
    """What is computed of one matrix and what of two: this package's function and rliable's."""
    if len(names) == 2:
        return probability_of_improvement, rliable_metrics.probability_of_improvement
    return interquartile_mean, lambda scores: np.array([rliable_metrics.aggregate_iqm(scores)])


def mean_score(scores) -> np.ndarray:
    return np.concatenate(scores, axis=-1).mean(axis=-1)


# -------------------------------------------------------------------------------------------------------------- by hand


@pytest.mark.parametrize(
    ("scores", "mean"),
    [
        ([[1, 2, 3, 4]], 2.5),
        ([[0, 1, 2, 99]], 1.5),  # what is far off does not count
        ([[-50, 1, 2, 3, 4, 5, 6, 70]], 3.5),
        ([[1, 2, 3, 4, 100]], 3),  # a quarter of 5 runs is 1.25, of which one is left out at either end
        ([[1, 2, 30]], 11),  # a quarter of 3 runs is less than one
        ([[7]], 7),
        ([[1], [2], [3], [10]], 2.5),  # the quarters are those of all runs, not of each task's
        ([[1, 4], [2], [0, 3, 9, 9, 9]], 4.5),  # tasks of 2, 1 and 5 runs: of 0 1 2 3 4 9 9 9 the middle, 2 3 4 9
        ([[1, 2, 1, 2], [2, 2, 1, 1]], 1.5),  # metrics_test.py of rliable
        ([[1, 2, 3], [1, 2, 3]], 2),  # likewise
    ],
)
def test_interquartile_means_by_hand(scores, mean):
    assert interquartile_mean(scores) == pytest.approx(mean, abs=1e-12)


@pytest.mark.parametrize(
    ("scores", "others", "probability"),
    [
        ([[2]], [[1]], 1),
        ([[1]], [[2]], 0),
        ([[1]], [[1]], 0.5),  # a tie is half an improvement
        ([[1, 2, 3]], [[2, 2, 2]], 0.5),  # 3 losses, 3 ties, 3 wins
        ([[3]], [[1, 2, 3, 4]], 0.625),  # 1 run against 4: 2 wins, a tie and a loss
        ([[1], [5, 6]], [[0], [7, 8, 9]], 0.5),  # 1 on the first task, 0 on the second, however many pairs they have
        ([[1, 2, 1, 2], [2, 2, 1, 1]], [[1, 2, 3], [1, 2, 3]], 1 / 3),  # metrics_test.py of rliable
    ],
)
def test_probabilities_of_improvement_by_hand(scores, others, probability):
    assert probability_of_improvement(scores, others) == pytest.approx(probability, abs=1e-12)
    assert probability_of_improvement(others, scores) == pytest.approx(1 - probability, abs=1e-12)


@pytest.mark.parametrize(
    ("confidence", "low", "high"),
    [
        (0.95, 1 / 8, 7 / 8),  # no success has probability 0.004, at most one 0.035: 0.025 lies between
        (0.5, 3 / 8, 5 / 8),  # at most 2 have 0.145, at most 3 0.363
        (0.999, 0, 1),
    ],
)
def test_the_interval_is_of_percentiles_of_the_bootstrap(confidence, low, high):
    """The mean of 8 runs, half of them 0 and half 1, is a binomial proportion when they are drawn anew."""
    scores = [[0, 1, 0, 1, 0, 1, 0, 1]]
    assert estimate(mean_score, scores, confidence=confidence) == Estimate(0.5, low, high)


# ------------------------------------------------------------------------------------------------- properties of statistics

RUNS = st.lists(st.integers(-3, 3), min_size=1, max_size=5)
TWO_METHODS = st.integers(1, 4).flatmap(lambda n: st.tuples(*[st.lists(RUNS, min_size=n, max_size=n)] * 2))


@given(TWO_METHODS)
def test_one_of_two_methods_improves_on_the_other(methods):
    x, y = methods
    p = probability_of_improvement(x, y)
    assert 0 <= p <= 1
    assert p + probability_of_improvement(y, x) == pytest.approx(1, abs=1e-12)
    assert probability_of_improvement(x, x) == pytest.approx(0.5, abs=1e-12)


@given(TWO_METHODS)
def test_the_probability_is_the_mean_over_tasks_of_the_share_of_pairs(methods):
    shares = []
    for x, y in zip(*methods, strict=True):
        wins = [1 if a > b else 0.5 if a == b else 0 for a, b in itertools.product(x, y)]
        shares.append(sum(wins) / len(wins))
    assert probability_of_improvement(*methods) == pytest.approx(sum(shares) / len(shares), abs=1e-12)


@given(st.lists(RUNS, min_size=1, max_size=5))
def test_the_interquartile_mean_is_of_the_middle_half_of_all_runs(scores):
    ordered = sorted(itertools.chain.from_iterable(scores))
    cut = len(ordered) // 4
    middle = ordered[cut : len(ordered) - cut]
    assert interquartile_mean(scores) == pytest.approx(sum(middle) / len(middle), abs=1e-12)


@pytest.mark.parametrize("names", [("5 runs of 55 games",), ("5 runs of 55 games", "3 runs of 55 games")])
def test_a_batch_is_computed_like_its_members_one_by_one(names):
    statistic, _ = statistics_of(names)
    orders = np.random.default_rng(0).normal(size=(2, 3))
    batches = [[task * orders[..., None] for task in tasks_of(name)] for name in names]
    values = statistic(*batches)
    assert values.shape == (2, 3)
    for i in np.ndindex(2, 3):
        assert values[i] == pytest.approx(statistic(*[[task[i] for task in batch] for batch in batches]), abs=1e-12)


# -------------------------------------------------------------------------------------------------- properties of intervals


def test_runs_are_drawn_within_their_task_as_many_as_there_are():
    scores, n = [[1, 2, 3], [10], [20, 21, 22, 23, 24]], 30_000
    drawn = []

    def statistic(sample):
        drawn.append(sample)
        return mean_score(sample)

    estimate(statistic, scores, repetitions=n)
    resampled = drawn[0]
    assert [task.shape for task in resampled] == [(n, 3), (n, 1), (n, 5)]
    for task, runs in zip(resampled, scores, strict=True):
        found, counts = np.unique(task, return_counts=True)
        assert found.tolist() == runs
        np.testing.assert_allclose(counts / task.size, 1 / len(runs), atol=0.01)
    assert drawn[1] == scores


def test_tasks_and_methods_are_drawn_independently_of_each_other():
    runs, n = np.arange(5.0), 30_000
    drawn = []

    def statistic(*samples):
        drawn.append(samples)
        return probability_of_improvement(*samples)

    estimate(statistic, [runs, runs], [runs, runs], repetitions=n)
    columns = np.concatenate([task for sample in drawn[0] for task in sample], axis=1)  # 2 methods of 2 tasks of 5 runs
    correlation = np.corrcoef(columns.T)
    np.testing.assert_allclose(correlation, np.eye(20), atol=5 / np.sqrt(n))


@pytest.mark.parametrize("names", MATRICES)
def test_an_interval_contains_the_value_and_widens_with_the_confidence(names):
    statistic, _ = statistics_of(names)
    samples = [tasks_of(name) for name in names]
    wide, usual, narrow = (estimate(statistic, *samples, repetitions=1_000, confidence=c) for c in (0.99, 0.95, 0.5))
    assert wide.value == usual.value == statistic(*samples)
    assert wide.low <= usual.low <= narrow.low <= narrow.high <= usual.high <= wide.high
    assert usual.low <= usual.value <= usual.high
    assert all(type(number) is float for number in (usual.value, usual.low, usual.high))


@pytest.mark.parametrize("tasks", [[[3]], [[3], [5], [-2], [8]]])
def test_one_run_per_task_leaves_nothing_to_draw(tasks):
    mean = interquartile_mean(tasks)
    assert estimate(interquartile_mean, tasks) == Estimate(mean, mean, mean)
    others = [[4] for _ in tasks]
    p = probability_of_improvement(tasks, others)
    assert estimate(probability_of_improvement, tasks, others) == Estimate(p, p, p)


def test_equal_runs_have_an_interval_of_no_width_and_a_method_against_itself_has_one():
    assert estimate(interquartile_mean, [[2, 2, 2], [2, 2]]) == Estimate(2, 2, 2)
    runs = [np.arange(10)]
    against_itself = estimate(probability_of_improvement, runs, runs)
    assert against_itself.value == 0.5
    assert against_itself.low < 0.4
    assert against_itself.high > 0.6


def test_more_runs_narrow_the_interval():
    widths = []
    for n in (4, 16, 64):
        result = estimate(interquartile_mean, list(heavy_tailed(5, n, 10).T), repetitions=2_000)
        widths.append(result.high - result.low)
    assert widths[0] > 1.4 * widths[1] > 1.4**2 * widths[2] > 0


def test_the_seed_decides_the_interval():
    first, again, other = (
        estimate(interquartile_mean, tasks_of("10 runs of 26 games"), repetitions=500, seed=s) for s in (3, 3, 4)
    )
    assert first == again
    assert first.value == other.value
    assert (first.low, first.high) != (other.low, other.high)


def test_the_rows_of_a_matrix_are_tasks_and_the_scores_are_left_alone():
    matrix = SCORES["10 runs of 26 games"].T.copy()
    before = matrix.copy()
    result = estimate(interquartile_mean, matrix, repetitions=500)
    assert result == estimate(interquartile_mean, [row.tolist() for row in matrix], repetitions=500)
    np.testing.assert_array_equal(matrix, before)


@pytest.mark.parametrize(
    ("scores", "message"),
    [
        ([[]], r"have shape \(0,\)"),
        ([[1, 2], []], r"have shape \(0,\)"),
        ([np.ones((2, 3))], r"have shape \(2, 3\)"),
        ([1.0, 2.0], r"have shape \(\)"),
        ([[1, np.nan]], "not all finite"),
        ([[1, 2], [np.inf, 0]], "not all finite"),
    ],
)
def test_what_are_no_runs_of_a_task_is_an_error(scores, message):
    with pytest.raises(ValueError, match=message):
        estimate(interquartile_mean, scores)
    fine = [[1.0] for _ in scores]
    with pytest.raises(ValueError, match=message):
        estimate(probability_of_improvement, fine, scores)


def test_methods_of_different_numbers_of_tasks_cannot_be_compared():
    with pytest.raises(ValueError, match="Scores of 1 tasks cannot be compared with scores of 2"):
        probability_of_improvement([[1, 2]], [[1, 2], [3]])
    with pytest.raises(ValueError, match="Scores of 2 tasks cannot be compared with scores of 1"):
        estimate(probability_of_improvement, [[1, 2], [3]], [[1, 2]])


# --------------------------------------------------------------------------------------------------------------- rliable


@pytest.fixture
def restart_rliable(monkeypatch):
    """Start rliable's draws from a seed. It draws from numpy's global generator, whatever `random_state` it is given."""
    return lambda: monkeypatch.setattr(np.random, "choice", np.random.default_rng(0).choice)


@pytest.mark.parametrize("names", MATRICES)
def test_values_and_intervals_from_rliables_own_draws(names, restart_rliable, monkeypatch):
    """Of the same draws, both packages make the same interval to the last digits."""
    statistic, rliables = statistics_of(names)
    matrices = [SCORES[name] for name in names]
    repetitions = 60 if len(names) == 2 else 1_000  # rliable takes some 10 ms for each draw of two methods

    restart_rliable()
    values, intervals = get_interval_estimates(
        {"": matrices if len(names) == 2 else matrices[0]}, rliables, reps=repetitions, confidence_interval_size=0.9
    )
    restart_rliable()
    bootstrap = (StratifiedIndependentBootstrap if len(names) == 2 else StratifiedBootstrap)(*matrices)
    draws = zip(*[data for data, _ in bootstrap.bootstrap(repetitions)], strict=True)
    drawn_tasks = iter([task for draw in draws for task in np.stack(draw).transpose(2, 0, 1)])
    monkeypatch.setattr(statistics, "_resample", lambda *_: next(drawn_tasks))

    result = estimate(statistic, *[tasks_of(name) for name in names], repetitions=repetitions, confidence=0.9)
    assert next(drawn_tasks, None) is None
    assert result.value == pytest.approx(np.squeeze(values[""]), abs=1e-9)
    assert [result.low, result.high] == pytest.approx(np.ravel(intervals[""]).tolist(), abs=1e-9)


def test_an_interval_from_each_ones_own_draws(restart_rliable):
    """Few draws of rliable's, so to five standard errors of a percentile rather than to a fixed tolerance."""
    n = 4_000
    restart_rliable()
    _, rliables = statistics_of(("10 runs of 26 games",))
    _, intervals = get_interval_estimates({"": SCORES["10 runs of 26 games"]}, rliables, reps=n)
    result = estimate(interquartile_mean, tasks_of("10 runs of 26 games"))
    deviation = (result.high - result.low) / (2 * 1.96)
    percentile_error = np.sqrt(0.025 * 0.975 * (1 / n + 1 / statistics.REPETITIONS)) / 0.0584 * deviation
    assert [result.low, result.high] == pytest.approx(np.ravel(intervals[""]).tolist(), abs=5 * percentile_error)


# What rliable 1.2.0 (with arch 7.2.0, numpy 2.4.6) answers, after np.random.seed(0), to
#   get_interval_estimates({"": scores}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=200_000)
#   get_interval_estimates({"": (scores, others)}, probability, reps=200_000)
# where `probability` is metrics.probability_of_improvement written with one comparison of arrays, because 200,000 of the
# original take more than half an hour; the values are those of the original.
RLIABLE = {
    ("counting",): Estimate(39.5, 32.525, 46.5),
    ("counting down",): Estimate(39.5, 32.525, 46.475),
    ("10 runs of 26 games",): Estimate(0.503, 0.47561538461538455, 0.531076923076923),
    ("10 better runs of 26 games",): Estimate(0.5289230769230769, 0.5039230769230769, 0.5553846153846154),
    ("5 runs of 55 games",): Estimate(0.47035971223021583, 0.4487050359712231, 0.49266187050359705),
    ("3 runs of 55 games",): Estimate(0.4874698795180723, 0.466867469879518, 0.5078313253012049),
    ("counting", "counting down"): Estimate(0.5, 0.41125, 0.59),
    ("10 better runs of 26 games", "10 runs of 26 games"): Estimate(0.5451923076923076, 0.5053846153846154, 0.5851923076923077),
    ("5 runs of 55 games", "3 runs of 55 games"): Estimate(0.4715151515151515, 0.4303030303030303, 0.5127272727272727),
}


@pytest.mark.parametrize("names", RLIABLE)
def test_intervals_against_many_draws_of_rliables(names):
    """To 1e-3 of the scores' scale, which is 80 for the counting matrices and 1 for all others.

    The probability of the counting matrices moves in steps of 1/800, so there one step is allowed.
    """
    statistic, _ = statistics_of(names)
    result = estimate(statistic, *[tasks_of(name) for name in names], repetitions=50_000)
    tolerance = 1e-3
    if names == ("counting", "counting down"):
        tolerance = 1.001 / 800
    elif names[0].startswith("counting"):
        tolerance = 0.08
    assert result.value == pytest.approx(RLIABLE[names].value, abs=1e-9)
    assert result.low == pytest.approx(RLIABLE[names].low, abs=tolerance)
    assert result.high == pytest.approx(RLIABLE[names].high, abs=tolerance)
