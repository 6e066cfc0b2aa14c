"""What comes out of a training: metrics, rollouts, the callback that evaluates, pictures and floors."""

import csv
import io
import random
import time
from functools import partial, reduce
from itertools import product

import gymnasium as gym
import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgba
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Figure as LoggedFigure
from stable_baselines3.common.logger import KVWriter, Logger, configure
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_momba import (
    MOMBA,
    ParetoEvalCallback,
    ParetoFront,
    PreferenceWrapper,
    evaluate_front,
    expected_utility,
    hypervolume,
    inverted_generational_distance,
    make_mo_vec_env,
    plot_front,
    preference_regret,
)
from sb3_momba.envs.making import wrap_env
from sb3_momba.envs.preferences import PerStepSampler, UniformSampler, preference_grid
from sb3_momba.files import FileFormatError, write_tree
from sb3_momba.pareto.floors import RandomPolicy, ZeroActionPolicy
from sb3_momba.pareto.metrics import non_dominated
from sb3_momba.pareto.plotting import COLOURS, style_of
from tests.stubs import StubEnv, assert_same_tree, tiny_model

pytestmark = [
    pytest.mark.filterwarnings("ignore:The environment is already wrapped with a `Monitor`"),
    pytest.mark.filterwarnings("ignore:.*precision lowered by casting to float32"),
]

# ------------------------------------------------------------------------------------------------------- hypervolume

NOTHING = np.zeros((0, 2))


def point_sets(largest: int = 6, widths: tuple[int, ...] = (1, 2, 3, 4), min_size: int = 1, max_size: int = 7):
    """Integer points, so that volumes and utilities are exact and ties and duplicates frequent: (n, n_objectives)."""

    def points(width: int) -> st.SearchStrategy[list[list[int]]]:
        return st.lists(
            st.lists(st.integers(-2, largest), min_size=width, max_size=width), min_size=min_size, max_size=max_size
        )

    return st.sampled_from(widths).flatmap(points).map(lambda rows: np.array(rows, dtype=np.float64))


def volume_by_cells(points: np.ndarray, reference: np.ndarray) -> float:
    """Exact and slow: the points' coordinates cut space into cells; a cell counts if some point reaches its upper corner."""
    edges = [np.unique([r, *p[p > r]]) for p, r in zip(points.T, reference, strict=True)]
    corners = np.stack(np.meshgrid(*[e[1:] for e in edges], indexing="ij"), axis=-1)
    covered = np.any([(corners <= point).all(axis=-1) for point in points], axis=0)
    return float((reduce(np.multiply.outer, [np.diff(e) for e in edges]) * covered).sum())


@given(point_sets(), st.integers(-3, 3))
def test_the_hypervolume_is_the_volume_of_the_dominated_cells(points, reference):
    reference = reference + np.arange(points.shape[1]) % 2  # not the same in every objective
    assert hypervolume(points, reference) == volume_by_cells(points, reference)


@pytest.mark.parametrize("width", [2, 3, 5])
def test_the_hypervolume_of_random_points(width):
    points = np.random.default_rng(width).random((9, width))
    reference = np.full(width, 0.1)
    assert hypervolume(points, reference) == pytest.approx(volume_by_cells(points, reference), rel=1e-12)
    assert hypervolume(points, reference) > 0


@pytest.mark.parametrize(
    ("values", "reference", "volume"),
    [
        ([[2, 3]], [0, 0], 6),
        ([[3, 1], [2, 2], [1, 3]], [0, 0], 6),  # a staircase: columns of height 3, 2 and 1
        ([[3, 1], [2, 2], [1, 3]], [-1, -1], 13),  # columns of width 2, 1, 1 and height 4, 3, 2
        ([[3, 1], [2, 2], [1, 3]], [1, 1], 1),  # only (2, 2) is above (1, 1) in both objectives
        ([[1, 2, 3], [3, 2, 1]], [0, 0, 0], 10),  # 6 + 6, less the common 1 x 2 x 1
        ([[2, 1, 1], [1, 2, 1], [1, 1, 2]], [0, 0, 0], 4),  # 2 + 2 + 2 - 1 - 1 - 1 + 1
        ([[1, 1, 1, 2], [2, 1, 1, 1]], [0, 0, 0, 0], 3),
        ([[4], [7], [5]], [2], 5),
        ([[1], [2]], [2], 0),
    ],
)
def test_hypervolumes_by_hand(values, reference, volume):
    result = hypervolume(values, reference)
    assert type(result) is float
    assert result == volume


@pytest.mark.parametrize("outside", [[-1, 9], [9, 0], [0, 0], [-5, -5], [0, 9]])
def test_values_that_are_not_above_the_reference_point_in_every_objective_count_nothing(outside):
    assert hypervolume([outside], [0, 0]) == 0
    assert hypervolume([[2, 3], outside], [0, 0]) == 6


def test_no_value_spans_no_volume():
    assert hypervolume(NOTHING, [0, 0]) == 0


@given(point_sets(min_size=2), st.randoms(use_true_random=False))
def test_neither_the_order_of_values_nor_that_of_objectives_changes_the_hypervolume(points, rng):
    rows, columns = list(range(len(points))), list(range(points.shape[1]))
    rng.shuffle(rows)
    rng.shuffle(columns)
    reference = np.arange(points.shape[1]) - 2.0
    expected = hypervolume(points, reference)
    assert hypervolume(points[rows], reference) == expected
    assert hypervolume(points[:, columns], reference[columns]) == expected


@given(point_sets(), st.data())
def test_a_dominated_point_adds_nothing_and_any_other_never_takes_away(points, data):
    reference = np.zeros(points.shape[1])
    before = hypervolume(points, reference)
    below = points[data.draw(st.integers(0, len(points) - 1))] - data.draw(
        st.lists(st.integers(0, 3), min_size=points.shape[1], max_size=points.shape[1])
    )
    assert hypervolume([*points, below], reference) == before
    assert hypervolume([*points, points[0]], reference) == before
    assert hypervolume([*points, below + 2], reference) >= before


@given(point_sets())
def test_the_hypervolume_moves_with_the_reference_point_and_scales_with_the_units(points):
    reference, units = np.zeros(points.shape[1]), 2.0 ** np.arange(points.shape[1])
    volume = hypervolume(points, reference)
    assert hypervolume(points + 5, reference + 5) == volume
    assert hypervolume(points * units, reference) == volume * units.prod()


@pytest.mark.parametrize("units", [np.ones(10), 10.0 ** np.arange(-4, 6)], ids=["units alike", "units apart"])
def test_the_hypervolume_of_many_objectives_is_approximated_as_the_exact_one_never_ends(units):
    """What products of five staircases dominate is the product of what each does, 6; as many values as preferences."""
    staircase = [[3, 1], [2, 2], [1, 3]]
    values = np.array([np.concatenate(steps) for steps in product(staircase, repeat=5)])
    assert len(values) >= len(preference_grid(10))
    reference = np.arange(10.0)
    began = time.process_time()
    volume = hypervolume((values + reference) * units, reference * units)
    assert time.process_time() - began < 10
    assert volume == pytest.approx(6**5 * units.prod(), rel=0.01)
    assert hypervolume((values + reference) * units, reference * units) == volume


@pytest.mark.parametrize("width", [6, 7, 10, 12])
def test_the_hypervolume_of_boxes_along_the_axes(width):
    """A cube of 1, and a box of height 1 on each side; exact up to six objectives."""
    volume = hypervolume(np.ones((width, width)) + np.eye(width), np.zeros(width))
    assert volume == pytest.approx(1 + width, rel=1e-12 if width <= 6 else 0.01)


# ------------------------------------------------------------------------------------- utility, regret, distance, fronts

CORNERS = np.array([[1, 0], [0.5, 0.5], [0, 1]])


def test_expected_utility_by_hand():
    # The best of w.V: 4 for [1, 0], max(2, 1) for the middle, 2 for [0, 1].
    assert expected_utility([[4, 0], [0, 2]], CORNERS) == pytest.approx(8 / 3)
    # As many values or preferences as one likes: values are a set.
    assert expected_utility([[4, 0], [0, 2], [0, 2], [-9, -9]], [[1, 0]]) == 4


def test_expected_utility_of_negative_returns():
    assert expected_utility([[-4, 0], [0, -2]], CORNERS) == pytest.approx(-1 / 3)  # max(-4, 0), max(-2, -1), max(0, -2)


def test_preference_regret_by_hand():
    values = [[4, 0], [1, 1], [3, 2]]
    # [1, 0] and [0, 1] get their best, 4 and 2; the middle gets 1 where the third value would give it 2.5.
    assert preference_regret(values, CORNERS) == pytest.approx(1.5 / 3)
    assert type(preference_regret(values, CORNERS)) is float


def test_there_is_no_regret_where_each_preference_gets_its_best():
    values = np.array([[4, 0], [3, 3], [0, 4]])
    assert preference_regret(values, CORNERS) == 0
    assert preference_regret(values[::-1], CORNERS) == pytest.approx(8 / 3)  # both ends get 0 instead of 4


def test_expected_utility_hides_what_regret_tells():
    # Both policies can reach 1,000 in one objective; the second one gives it to whoever asks for the other.
    obeys, confuses = np.array([[1000, 0], [0, 1000]]), np.array([[0, 1000], [1000, 0]])
    preferences = np.array([[0.9, 0.1], [0.1, 0.9]])
    assert expected_utility(obeys, preferences) == expected_utility(confuses, preferences) == pytest.approx(900)
    assert hypervolume(obeys + 1, [0, 0]) == hypervolume(confuses + 1, [0, 0])
    assert preference_regret(obeys, preferences) == 0
    assert preference_regret(confuses, preferences) == pytest.approx(800)


@given(st.integers(1, 4), st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_expected_utility_less_regret_is_the_utility_of_the_own_preference(n_objectives, n, seed):
    rng = np.random.default_rng(seed)
    preferences, values = rng.dirichlet(np.ones(n_objectives), n), rng.normal(size=(n, n_objectives))
    own = np.mean([sum(w_i * v_i for w_i, v_i in zip(w, v, strict=True)) for w, v in zip(preferences, values, strict=True)])
    regret = preference_regret(values, preferences)
    assert regret >= 0
    assert expected_utility(values, preferences) - regret == pytest.approx(own, abs=1e-12)


@pytest.mark.parametrize(
    ("values", "front", "distance"),
    [
        ([[0, 0], [3, 4]], [[0, 0], [3, 0], [0, 4]], 2),  # 0, then min(3, 4), then min(4, 3)
        ([[0, 0]], [[3, 4]], 5),
        ([[3, 4]], [[0, 0]], 5),  # a value beyond the reference front is as far as one behind it
        ([[0, 0], [3, 4], [9, 9]], [[3, 4]], 0),  # what is no reference point's nearest does not count
        ([[1, 1, 1]], [[1, 1, 3], [1, 1, 1]], 1),
        ([[1], [3]], [[0], [4], [2]], 1),
    ],
)
def test_inverted_generational_distance_by_hand(values, front, distance):
    assert inverted_generational_distance(values, front) == pytest.approx(distance)


@given(point_sets(widths=(3,)), point_sets(widths=(3,)))
def test_inverted_generational_distance_is_the_mean_distance_to_the_nearest(values, front):
    nearest = [min(np.sqrt(((value - point) ** 2).sum()) for value in values) for point in front]
    assert inverted_generational_distance(values, front) == pytest.approx(np.mean(nearest))


@pytest.mark.parametrize(
    ("values", "mask"),
    [
        ([[3, 1], [2, 2], [1, 3]], [1, 1, 1]),
        ([[3, 1], [2, 1], [1, 3]], [1, 0, 1]),  # a tie in the second objective
        ([[1, 3], [1, 3], [3, 1], [1, 3]], [1, 0, 1, 0]),  # of equal ones the first
        ([[0, 0], [1, 1], [1, 1]], [0, 1, 0]),
        ([[1, 2, 3], [1, 2, 4], [2, 1, 3]], [0, 1, 1]),
        ([[-1, -1]], [1]),
        ([[1], [3], [3], [2]], [0, 1, 0, 0]),
    ],
)
def test_non_dominated_by_hand(values, mask):
    result = non_dominated(values)
    assert result.dtype == bool
    assert result.tolist() == [bool(m) for m in mask]


@given(point_sets(largest=2, widths=(1, 2, 3, 4, 5), max_size=12))
def test_non_dominated_against_the_definition(points):
    def survives(i: int) -> bool:
        return not any(
            (other >= points[i]).all() and ((other > points[i]).any() or j < i) for j, other in enumerate(points) if j != i
        )

    assert non_dominated(points).tolist() == [survives(i) for i in range(len(points))]


@given(point_sets(widths=(2, 3)))
def test_the_non_dominated_values_have_the_whole_hypervolume(points):
    reference = np.full(points.shape[1], -3)
    assert hypervolume(points[non_dominated(points)], reference) == hypervolume(points, reference)


def test_metrics_leave_their_arguments_alone():
    values, preferences, reference = np.array([[1.0, 2.0], [2.0, 1.0]]), CORNERS[[0, 2]].copy(), np.array([0.5, 0.5])
    given_arrays = values.copy(), preferences.copy(), reference.copy()
    hypervolume(values, reference)
    expected_utility(values, preferences)
    preference_regret(values, preferences)
    inverted_generational_distance(values, values)
    non_dominated(values)
    assert_same_tree([values, preferences, reference], list(given_arrays))


TWO = np.ones((2, 2))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda bad: hypervolume(bad, [0, 0]), "values"),
        (lambda bad: expected_utility(bad, TWO), "values"),
        (lambda bad: expected_utility(TWO, bad), "preferences"),
        (lambda bad: preference_regret(bad, TWO), "values"),
        (lambda bad: preference_regret(TWO, bad), "preferences"),
        (lambda bad: inverted_generational_distance(bad, TWO), "values"),
        (lambda bad: inverted_generational_distance(TWO, bad), "reference_front"),
        (non_dominated, "values"),
    ],
)
@pytest.mark.parametrize(
    ("bad", "why"),
    [
        (np.ones(2), r"has shape \(2,\)"),
        (np.ones((1, 2, 2)), r"has shape \(1, 2, 2\)"),
        (np.ones((2, 0)), r"has shape \(2, 0\)"),
        (1.0, r"has shape \(\)"),
        (np.array([[1, 2], [np.nan, 1]]), "not finite"),
        (np.array([[np.inf, 2], [0, 1]]), "not finite"),
    ],
)
def test_arrays_that_are_no_points_are_errors_that_name_them(call, message, bad, why):
    with pytest.raises(ValueError, match=f"{message} has.*" + why.removeprefix("has ")):
        call(bad)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: hypervolume(TWO, 0), r"reference point 0 has shape \(\), not \(2,\)"),
        (lambda: hypervolume(TWO, [0, 0, 0]), r"reference point .* has shape \(3,\), not \(2,\)"),
        (lambda: hypervolume(TWO, [[0, 0]]), r"reference point .* has shape \(1, 2\), not \(2,\)"),
        (lambda: expected_utility(TWO, np.ones((2, 3))), "values have 2 objectives, preferences 3"),
        (lambda: preference_regret(np.ones((2, 3)), TWO), "values have 3 objectives, preferences 2"),
        (lambda: preference_regret(TWO, CORNERS), "2 values for 3 preferences"),
        (lambda: inverted_generational_distance(TWO, np.ones((1, 3))), "values have 2 objectives, the reference front 3"),
    ],
)
def test_arguments_that_do_not_fit_each_other_are_errors(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_reference_point_that_is_not_finite_is_an_error(wrong):
    # No value is above NaN: without the error the front would count nothing.
    with pytest.raises(ValueError, match="reference point"):
        hypervolume(TWO, [0, wrong])


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: expected_utility(NOTHING, TWO), "values"),
        (lambda: expected_utility(TWO, NOTHING), "preferences"),
        (lambda: preference_regret(NOTHING, NOTHING), "values"),
        # Not 0, the distance of a perfect front.
        (lambda: inverted_generational_distance(NOTHING, TWO), "values"),
        (lambda: inverted_generational_distance(TWO, NOTHING), "reference_front"),
    ],
    ids=["utility of no values", "utility for no preferences", "regret", "distance to no values", "distance from no front"],
)
def test_a_mean_over_nothing_is_an_error(call, name):
    with pytest.raises(ValueError, match=name):
        call()


@pytest.mark.parametrize("n_objectives", [1, 2, 3])
def test_of_no_values_none_is_on_the_front(n_objectives):
    assert non_dominated(np.zeros((0, n_objectives))).tolist() == []


# ---------------------------------------------------------------------------------------------------- evaluate_front


class SeededEnv(gym.Env):
    """An episode seeded with s has 1 + s % 3 steps; its step t = 1, 2, ... shows [s, t] and gives r = [s t, a t, t, ...].

    Episodes without a seed count as s = 1000: their rewards would show in every sum. Odd seeds terminate, even ones truncate.

    :param n_objectives: None: the reward is the number s t + a t
    :param fail_at: seed of an episode whose first step raises
    """

    opened: int = 0
    closed: int = 0

    def __init__(self, n_objectives: int | None = 2, fail_at: int | None = None):
        type(self).opened += 1
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        if n_objectives is not None:
            self.reward_space = spaces.Box(-np.inf, np.inf, (n_objectives,), np.float32)
        self.n_objectives = n_objectives
        self.fail_at = fail_at

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        assert options is None
        self.s, self.t = 1000 if seed is None else seed, 0
        return self.observe(), {}

    def step(self, action):
        if self.s == self.fail_at:
            raise RuntimeError("the simulator broke")
        self.t += 1
        reward = self.t * np.array([self.s, action[0], 1.0, 1.0, 1.0][: self.n_objectives])
        if self.n_objectives is None:
            reward = float(reward[0] + reward[1])
        ended = self.t == 1 + self.s % 3
        return self.observe(), reward, ended and self.s % 2 == 1, ended and self.s % 2 == 0, {}

    def observe(self):
        return np.array([self.s, self.t], dtype=np.float32)

    def close(self):
        type(self).closed += 1


class RepeatableEnv(SeededEnv):
    """Every episode is the one of seed 5."""

    deterministic = True

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=5)


class FirstWeight:
    """The action is the preference's first weight; all observations are kept."""

    def __init__(self, gamma: float | None = None):
        self.seen: list[np.ndarray] = []
        self.deterministic: set[bool] = set()
        if gamma is not None:
            self.gamma = gamma

    def predict(self, observation, *, deterministic):
        self.seen.append(observation.copy())
        self.deterministic.add(deterministic)
        return observation[:, 2:3], None


# Sums over the steps of an episode with 1, 2 or 3 steps, of t and of t / 2^(t - 1).
SUM_T, SUM_DISCOUNTED_T = {1: 1, 2: 3, 3: 6}, {1: 1, 2: 2, 3: 2.75}
SEEDS, LENGTHS = [4, 5, 6], [2, 3, 1]
FIVE = np.array([[0, 1], [0.25, 0.75], [0.5, 0.5], [0.75, 0.25], [1, 0]])
RETURNS = np.array([[[s * SUM_T[n], w[0] * SUM_T[n]] for s, n in zip(SEEDS, LENGTHS, strict=True)] for w in FIVE])
DISCOUNTED = np.array(
    [[[s * SUM_DISCOUNTED_T[n], w[0] * SUM_DISCOUNTED_T[n]] for s, n in zip(SEEDS, LENGTHS, strict=True)] for w in FIVE]
)


@pytest.fixture
def seeded_id():
    """An id of SeededEnv."""
    gym.register("Seeded-v0", SeededEnv)
    yield "Seeded-v0"
    gym.registry.pop("Seeded-v0")


def fixed_preference() -> gym.Env:
    env = PreferenceWrapper(SeededEnv())
    env.set_preference([0.5, 0.5])
    return env


FORMS = {
    "id": lambda: "Seeded-v0",
    "class": lambda: SeededEnv,
    "callable": lambda: lambda: PreferenceWrapper(SeededEnv()),
    "instance": SeededEnv,
    "wrapped instance": lambda: wrap_env(SeededEnv()),
    "instance with a preference per step": lambda: PreferenceWrapper(SeededEnv(), PerStepSampler(UniformSampler(2))),
    "instance with a fixed preference": fixed_preference,
    "1 environment": lambda: make_mo_vec_env(SeededEnv),
    "4 environments": lambda: make_mo_vec_env(SeededEnv, 4),
    "as many environments as episodes": lambda: make_mo_vec_env(SeededEnv, 15),
    "more environments than episodes": lambda: make_mo_vec_env(SeededEnv, 17),
    "seeded environments": lambda: make_mo_vec_env(SeededEnv, 2, seed=77),
    "VecMonitor": lambda: VecMonitor(make_mo_vec_env(SeededEnv, 2)),
    "2 processes": lambda: make_mo_vec_env(SeededEnv, 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "fork"}),
}


@pytest.mark.parametrize("form", FORMS)
def test_returns_lengths_and_their_order_by_hand_for_every_form_of_environment(form, seeded_id):
    env = FORMS[form]()
    front = evaluate_front(FirstWeight(gamma=0.5), env, n_preferences=5, n_episodes=3, seed=4)
    np.testing.assert_array_equal(front.preferences, FIVE, strict=True)
    np.testing.assert_array_equal(front.returns, RETURNS, strict=True)
    np.testing.assert_array_equal(front.discounted_returns, DISCOUNTED, strict=True)
    np.testing.assert_array_equal(front.episode_lengths, [LENGTHS] * 5)
    assert front.episode_lengths.dtype == np.int64
    assert front.n_objectives == 2
    name = {"id": "Seeded-v0", "class": "SeededEnv", "callable": "SeededEnv"}.get(form)
    name = name or ("SeededEnv" if "instance" in form else "VecEnv")
    assert front.settings == {
        "env": name,
        "seed": 4,
        "gamma": 0.5,
        "deterministic_policy": True,
        "deterministic_env": False,
    }
    # What was given is still open, and its preferences are its own again.
    if isinstance(env, gym.Env):
        observation, _ = wrap_env(env).reset(seed=3)
        assert form != "instance with a fixed preference" or observation.tolist() == [3, 0, 0.5, 0.5]
    elif not isinstance(env, str) and not callable(env):
        assert env.reset().shape == (env.num_envs, 4)
        env.close()


def test_a_front_knows_its_values_and_metrics():
    front = evaluate_front(FirstWeight(), SeededEnv, n_preferences=5, n_episodes=3, seed=4)
    # First objective: (12 + 30 + 6) / 3. Second: w_0 (3 + 6 + 1) / 3.
    values = np.array([[16, 10 / 3 * w] for w in (0, 0.25, 0.5, 0.75, 1)])
    np.testing.assert_allclose(front.values, values)
    assert front.non_dominated().tolist() == [False] * 4 + [True]
    assert front.hypervolume() == pytest.approx(16 * 10 / 3)
    assert front.hypervolume([6, 1 / 3]) == pytest.approx(10 * 3)
    # The last value is the best for every w: 16 w_0 + 10/3 w_1, on average 8 + 5/3.
    assert front.expected_utility() == pytest.approx(8 + 5 / 3)
    # w_1 = 1, 0.75, ... would win 10/3 (1 - w_0) = 10/3 w_1 more: the mean of w_1^2 is 3/8.
    assert front.preference_regret() == pytest.approx(10 / 3 * 3 / 8)


def test_episode_e_starts_from_seed_plus_e_for_every_preference():
    policy = FirstWeight()
    evaluate_front(policy, make_mo_vec_env(SeededEnv, 1), n_preferences=2, n_episodes=3, seed=10)
    starts = [row for batch in policy.seen for row in batch.tolist() if row[1] == 0]
    assert starts == [[s, 0, w, 1 - w] for w in (0, 1) for s in (10, 11, 12)]


def test_the_policy_always_sees_one_batch_shape():
    policy = FirstWeight()
    front = evaluate_front(policy, make_mo_vec_env(SeededEnv, 4), n_preferences=2, n_episodes=3, seed=4)
    assert {batch.shape for batch in policy.seen} == {(4, 4)}
    assert {batch.dtype for batch in policy.seen} == {np.dtype(np.float32)}
    np.testing.assert_array_equal(front.returns, RETURNS[[0, 4]])


def test_ids_and_callables_run_at_most_128_copies_side_by_side_and_close_them():
    policy, opened, closed = FirstWeight(), SeededEnv.opened, SeededEnv.closed
    front = evaluate_front(policy, SeededEnv, n_preferences=50, n_episodes=3, seed=4)  # 150 episodes
    assert {len(batch) for batch in policy.seen} == {128}
    assert SeededEnv.closed - closed == SeededEnv.opened - opened
    np.testing.assert_array_equal(front.returns[:, :, 0], [[12, 30, 6]] * 50)
    weights = np.linspace(0, 1, 50, dtype=np.float32)
    np.testing.assert_allclose(front.returns[:, :, 1], np.outer(weights, [3, 6, 1]), rtol=1e-6)


@pytest.mark.parametrize("n_envs", [1, 4])
def test_fewer_copies_give_the_same(n_envs):
    policy, opened = FirstWeight(), SeededEnv.opened
    front = evaluate_front(policy, SeededEnv, n_preferences=3, n_episodes=3, seed=4, n_envs=n_envs)
    assert {len(batch) for batch in policy.seen} == {n_envs}
    assert SeededEnv.opened - opened == n_envs + 1  # and one that is looked at
    expected = evaluate_front(FirstWeight(), SeededEnv, n_preferences=3, n_episodes=3, seed=4)
    np.testing.assert_array_equal(front.returns, expected.returns)


def test_an_evaluation_without_copies_or_preferences_is_refused():
    with pytest.raises(ValueError, match="n_envs=0: at least one copy"):
        evaluate_front(FirstWeight(), SeededEnv, n_envs=0)
    with pytest.raises(ValueError, match="n_envs=0: at least one copy"):
        ParetoEvalCallback(SeededEnv, n_envs=0)
    for nothing in ([], np.zeros((0, 2))):
        with pytest.raises(ValueError, match="give at least one preference"):
            evaluate_front(FirstWeight(), SeededEnv, preferences=nothing)


def test_no_more_copies_run_than_episodes():
    policy = FirstWeight()
    evaluate_front(policy, SeededEnv, n_preferences=2, n_episodes=3)
    assert {len(batch) for batch in policy.seen} == {6}


@pytest.mark.parametrize("n_envs", [1, 3])
def test_environments_are_closed_after_an_error(n_envs):
    opened, closed = SeededEnv.opened, SeededEnv.closed
    with pytest.raises(RuntimeError, match="the simulator broke"):
        evaluate_front(FirstWeight(), partial(SeededEnv, fail_at=5), n_preferences=2, n_episodes=2, seed=4, n_envs=n_envs)
    assert SeededEnv.closed - closed == SeededEnv.opened - opened


@pytest.mark.parametrize("form", [RepeatableEnv, RepeatableEnv(), lambda: PreferenceWrapper(RepeatableEnv())])
def test_a_deterministic_environment_runs_one_episode_and_says_so(form):
    front = evaluate_front(FirstWeight(gamma=0.5), form, n_preferences=5, n_episodes=3)
    assert front.settings["deterministic_env"] is True
    np.testing.assert_array_equal(front.returns, RETURNS[:, [1]], strict=True)
    np.testing.assert_array_equal(front.discounted_returns, DISCOUNTED[:, [1]], strict=True)
    assert front.episode_lengths.tolist() == [[3]] * 5


@pytest.mark.parametrize(
    ("makers", "deterministic"), [([RepeatableEnv] * 2, True), ([RepeatableEnv, SeededEnv], False), ([SeededEnv] * 2, False)]
)
def test_a_vec_env_is_deterministic_if_every_environment_is(makers, deterministic):
    venv = DummyVecEnv([partial(lambda make: wrap_env(make()), make) for make in makers])
    front = evaluate_front(FirstWeight(), venv, n_preferences=2, n_episodes=3)
    assert front.settings["deterministic_env"] is deterministic
    assert front.returns.shape == (2, 1 if deterministic else 3, 2)


def test_a_stochastic_policy_runs_all_episodes_even_in_a_deterministic_environment():
    policy = FirstWeight()
    front = evaluate_front(policy, RepeatableEnv, n_preferences=2, n_episodes=3, deterministic=False)
    assert policy.deterministic == {False}
    assert front.returns.shape == (2, 3, 2)
    assert (front.settings["deterministic_policy"], front.settings["deterministic_env"]) == (False, True)


@pytest.mark.parametrize("preferences", [[0.25, 0.75], [[0.25, 0.75]], [[1, 0], [0.25, 0.75], [1, 0]]])
def test_given_preferences_are_evaluated_in_their_order(preferences):
    front = evaluate_front(FirstWeight(), SeededEnv, n_episodes=1, seed=5, preferences=preferences)
    np.testing.assert_array_equal(front.preferences, np.atleast_2d(preferences).astype(np.float64), strict=True)
    np.testing.assert_array_equal(front.returns[:, 0], [[30, 6 * w] for w, _ in np.atleast_2d(preferences)])


@pytest.mark.parametrize(("model_gamma", "gamma", "used"), [(None, None, 0.99), (0.5, None, 0.5), (0.5, 0.25, 0.25)])
def test_the_discount_is_the_given_one_or_the_models(model_gamma, gamma, used):
    front = evaluate_front(FirstWeight(model_gamma), SeededEnv, n_preferences=1, n_episodes=1, seed=5, gamma=gamma)
    assert front.settings["gamma"] == used
    assert front.discounted_returns[0, 0, 0] == pytest.approx(5 * (1 + 2 * used + 3 * used**2))


@pytest.mark.parametrize(("n_objectives", "n_preferences", "n"), [(3, 6, 6), (3, 100, 100), (4, 10, 10), (5, 5, 5)])
def test_more_objectives(n_objectives, n_preferences, n):
    front = evaluate_front(FirstWeight(), partial(SeededEnv, n_objectives), n_preferences, n_episodes=1, seed=5)
    grid = preference_grid(n_objectives, n_preferences)
    assert front.returns.shape == (n, 1, n_objectives)
    np.testing.assert_allclose(front.preferences, grid, atol=1e-7)
    np.testing.assert_allclose(front.values[:, 1], 6 * grid[:, 0], atol=1e-6)
    assert (front.values[:, 2:] == 6).all()


def test_env_kwargs_reach_ids_and_callables(seeded_id):
    for env in (seeded_id, SeededEnv):
        front = evaluate_front(FirstWeight(), env, 3, 1, seed=5, env_kwargs={"n_objectives": 3})
        assert front.n_objectives == 3


class Constant:
    def predict(self, observation, *, deterministic):
        assert observation.shape[1] == 2  # nothing of a preference
        return np.full((len(observation), 1), 0.5, dtype=np.float32), None


@pytest.mark.parametrize(
    "form",
    [
        partial(SeededEnv, None),
        partial(SeededEnv, 1),
        SeededEnv(None),
        DummyVecEnv([partial(SeededEnv, None)] * 2),
        make_mo_vec_env(partial(SeededEnv, None), 4),
    ],
    ids=["number", "vector of one", "instance", "plain VecEnv", "wrapped VecEnv"],
)
def test_one_objective(form):
    front = evaluate_front(Constant(), form, n_episodes=3, seed=4, gamma=0.5)
    assert front.preferences.tolist() == [[1.0]]
    if isinstance(form, partial) and form.args == (1,):
        assert front.returns.tolist() == [[[12], [30], [6]]]
    else:
        assert front.returns.tolist() == [[[13.5], [33], [6.5]]]
        assert front.discounted_returns.tolist() == [[[9], [15.125], [6.5]]]
        assert front.hypervolume() == front.expected_utility() == pytest.approx(53 / 3)
    assert front.episode_lengths.tolist() == [LENGTHS]
    assert front.preference_regret() == 0
    assert front.non_dominated().tolist() == [True]


def test_a_single_objective_momba():
    model = tiny_model(SeededEnv(None))
    model.learn(30)
    front = evaluate_front(model, partial(SeededEnv, None), n_episodes=3, seed=4)
    assert front.returns.shape == (1, 3, 1)
    assert front.settings["gamma"] == model.gamma
    # Between action -1 and action 1: s sum(t) -+ sum(t).
    assert (np.abs(front.returns[0, :, 0] - [12, 30, 6]) <= [3, 6, 1]).all()


def test_a_single_objective_model_against_sb3s_evaluate_policy():
    model = SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}, buffer_size=10, seed=0, device="cpu")
    front = evaluate_front(model, "Pendulum-v1", n_episodes=1, seed=7)
    # evaluate_policy's environment starts from the seed of the first reset.
    mean, _ = evaluate_policy(model, make_vec_env("Pendulum-v1", seed=7), n_eval_episodes=1)
    assert front.values[0, 0] == pytest.approx(mean, rel=1e-5)
    assert front.episode_lengths.tolist() == [[200]]


@pytest.mark.parametrize(
    "wrap", [VecNormalize, partial(VecNormalize, norm_reward=False), lambda venv: VecMonitor(VecNormalize(venv))]
)
def test_vec_normalize_is_refused(wrap):
    # Normalised rewards are no returns, and `reset(seed)` of one environment passes the normalisation by.
    venv = wrap(DummyVecEnv([partial(SeededEnv, None)] * 2))
    with pytest.raises(ValueError, match="VecNormalize"):
        evaluate_front(Constant(), venv, n_episodes=3, seed=4)


def one_at_a_time(model, env: gym.Env, preferences: np.ndarray, seeds: list[int], gamma: float) -> np.ndarray:
    """Slow reference: [returns, discounted returns], (2, P, E, n_objectives)."""
    wrapped = PreferenceWrapper(env)
    returns = np.zeros((2, len(preferences), len(seeds), preferences.shape[1]))
    for i, w in enumerate(preferences):
        for j, seed in enumerate(seeds):
            observation, _ = wrapped.reset(seed=seed, options={"preference": w})
            t, over = 0, False
            while not over:
                action, _ = model.predict(observation, deterministic=True)
                observation, _, terminated, truncated, info = wrapped.step(action)
                returns[:, i, j] += np.outer([1, gamma**t], info["vector_reward"].astype(np.float64))
                t, over = t + 1, terminated or truncated
    return returns


def trained_sac(env: gym.Env) -> SAC:
    venv = DummyVecEnv([lambda: wrap_env(env)])
    model = SAC("MlpPolicy", venv, learning_starts=10, batch_size=8, policy_kwargs={"net_arch": [8]}, seed=0, device="cpu")
    return model.learn(40)


@pytest.mark.parametrize("make_model", [trained_sac, lambda env: tiny_model(env).learn(40)], ids=["SAC", "MOMBA"])
def test_models_against_episodes_one_at_a_time(make_model):
    kwargs = {"max_episode_steps": 12}
    model = make_model(gym.make("mo-mountaincarcontinuous-v0", disable_env_checker=True, **kwargs))
    front = evaluate_front(model, "mo-mountaincarcontinuous-v0", 3, n_episodes=2, seed=3, gamma=0.9, env_kwargs=kwargs)
    env = gym.make("mo-mountaincarcontinuous-v0", disable_env_checker=True, **kwargs)
    expected = one_at_a_time(model, env, front.preferences, [3, 4], 0.9)
    np.testing.assert_allclose([front.returns, front.discounted_returns], expected, rtol=1e-4, atol=1e-5)
    assert len(np.unique(front.values[:, 1])) == 3  # the preference makes a difference


@pytest.mark.parametrize("deterministic", [True, False])
def test_evaluating_twice_gives_the_same_and_leaves_the_global_random_states_alone(deterministic):
    model = tiny_model(SeededEnv())
    before = th.get_rng_state(), np.random.get_state()[1].copy(), random.getstate()  # noqa: NPY002
    first = evaluate_front(model, SeededEnv, 3, 2, deterministic=deterministic)
    assert th.equal(th.get_rng_state(), before[0])
    np.testing.assert_array_equal(np.random.get_state()[1], before[1])  # noqa: NPY002
    assert random.getstate() == before[2]
    th.manual_seed(1234)
    second = evaluate_front(model, SeededEnv, 3, 2, deterministic=deterministic)
    assert_same_tree(vars(first), vars(second))


def test_another_seed_samples_other_actions():
    model = tiny_model(RepeatableEnv())
    returns = [evaluate_front(model, RepeatableEnv, 2, 3, seed=seed, deterministic=False).returns[:, :, 1] for seed in (0, 1)]
    assert len(np.unique(returns)) == 12


@pytest.mark.parametrize("deterministic", [True, False])
def test_training_with_and_without_evaluation_gives_bit_equal_parameters(deterministic, tmp_path):
    evaluate = ParetoEvalCallback(
        SeededEnv, 7, 3, 2, deterministic=deterministic, log_path=tmp_path, best_model_save_path=tmp_path
    )
    with_evaluation = tiny_model(SeededEnv()).learn(40, callback=evaluate)
    without = tiny_model(SeededEnv()).learn(40)
    assert with_evaluation._n_updates == without._n_updates == 20
    assert len(evaluate.timesteps) == 6
    assert_same_tree(dict(with_evaluation.policy.state_dict()), dict(without.policy.state_dict()))
    for name in ("observations", "preferences", "actions", "rewards"):
        assert_same_tree(getattr(with_evaluation.replay_buffer, name), getattr(without.replay_buffer, name))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_episodes": 0}, "n_episodes=0"),
        ({"n_preferences": 0}, "n_preferences=0"),
        ({"preferences": [0.5, 0.6]}, r"sums to 1\.1"),
        ({"preferences": [[1, 0], [1.5, -0.5]]}, "negative weight"),
        ({"preferences": [0.2, 0.3, 0.5]}, r"has shape \(1, 3\): give 2 weights"),
        ({"preferences": [np.nan, 1]}, "not finite"),
        ({"preferences": [[[0.5, 0.5]]]}, r"has shape \(1, 1, 2\)"),
        ({"preferences": np.zeros((0, 2))}, "preferences"),
        ({"env": SeededEnv(), "env_kwargs": {"n_objectives": 3}}, "env_kwargs go with an id or a callable"),
        ({"env": make_mo_vec_env(SeededEnv), "env_kwargs": {"n_objectives": 3}}, "env_kwargs"),
        ({"env": DummyVecEnv([SeededEnv])}, "without PreferenceWrapper.*make_mo_vec_env"),
        ({"env": partial(StubEnv, rewards={3: np.array([1, np.nan])})}, "reward of objective 1 is nan"),
    ],
)
def test_what_cannot_be_evaluated_is_an_error_that_says_why(kwargs, message):
    with pytest.raises(ValueError, match=message):
        evaluate_front(FirstWeight(), **{"env": SeededEnv, **kwargs})


def test_a_model_of_other_objectives_is_an_error():
    with pytest.raises(ValueError, match="The model has 3 objectives, the environment SeededEnv has 2"):
        evaluate_front(tiny_model(SeededEnv(3)), SeededEnv, 2, 1)


def test_a_model_of_other_observations_or_actions_is_refused_before_anything_runs():
    model = tiny_model(StubEnv())
    with pytest.raises(
        ValueError, match=r"The model's observation_space has shape \(5,\), that of mo-hopper-2obj-v5 has \(13,\)"
    ):
        ParetoEvalCallback("mo-hopper-2obj-v5", eval_freq=10).check(model)
    with pytest.raises(ValueError, match=r"The model's action_space has shape \(2,\), that of StubEnv has \(3,\)"):
        evaluate_front(model, lambda: StubEnv(action_dim=3), n_preferences=3)


# ------------------------------------------------------------------------------------------------- ParetoFront's file


def test_a_front_is_saved_whole(tmp_path):
    front = evaluate_front(FirstWeight(), SeededEnv, 3, 2, seed=4)
    front.save(tmp_path / "folder" / "front.npz")
    loaded = ParetoFront.load(tmp_path / "folder" / "front.npz")
    assert_same_tree(vars(loaded), vars(front))
    assert list((tmp_path / "folder").iterdir()) == [tmp_path / "folder" / "front.npz"]  # nothing left beside it
    with np.load(tmp_path / "folder" / "front.npz", allow_pickle=False) as file:  # NumPy alone reads the arrays too
        np.testing.assert_array_equal(file["returns"], front.returns)


def test_a_front_saved_without_a_suffix_is_loaded_without_one(tmp_path):
    front = evaluate_front(FirstWeight(), SeededEnv, 3, 2, seed=4)
    front.save(str(tmp_path / "front"))
    assert [path.name for path in tmp_path.iterdir()] == ["front.npz"]
    assert_same_tree(vars(ParetoFront.load(tmp_path / "front.npz")), vars(front))
    assert_same_tree(vars(ParetoFront.load(str(tmp_path / "front"))), vars(front))


def test_a_front_passes_through_a_file_object():
    front = evaluate_front(FirstWeight(), SeededEnv, 3, 2, seed=4)
    file = io.BytesIO()
    front.save(file)
    assert_same_tree(vars(ParetoFront.load(file)), vars(front))


def test_a_failed_save_leaves_the_old_front(tmp_path):
    path = tmp_path / "front.npz"
    front = evaluate_front(FirstWeight(), SeededEnv, 3, 2)
    front.save(path)
    before = path.read_bytes()
    front.settings["policy"] = FirstWeight()
    with pytest.raises(TypeError, match=r"settings\.policy is a FirstWeight"):
        front.save(path)
    assert path.read_bytes() == before


def test_what_is_no_front_is_an_error_that_names_the_file(tmp_path):
    front = evaluate_front(FirstWeight(), SeededEnv, 3, 2)
    front.save(tmp_path / "cut.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "cut.npz").read_bytes()[:-40])
    tiny_model(SeededEnv()).save(tmp_path / "model.npz")
    write_tree(tmp_path / "list.npz", [1, 2])
    np.savez(tmp_path / "other.npz", returns=front.returns)
    for name in ("cut", "model", "list", "other"):
        with pytest.raises(FileFormatError, match=rf"{name}\.npz"):
            ParetoFront.load(tmp_path / f"{name}.npz")
    with pytest.raises(FileNotFoundError):
        ParetoFront.load(tmp_path / "none.npz")


WRONG_FRONTS = [
    {"returns": None},
    {"another": 1},
    {"returns": np.zeros((3, 2))},
    {"returns": "none"},
    {"preferences": np.zeros((4, 2))},
    {"episode_lengths": np.zeros(3, dtype=np.int64)},
]


@pytest.mark.parametrize("change", WRONG_FRONTS)
def test_a_front_whose_arrays_are_not_those_of_a_front_is_an_error_that_names_the_file(tmp_path, change):
    front = evaluate_front(FirstWeight(), SeededEnv, 3, 2)
    tree = {"format": "sb3_momba.front", "version": 1, **vars(front), **change}
    write_tree(tmp_path / "front.npz", {name: value for name, value in tree.items() if value is not None})
    with pytest.raises(FileFormatError, match=r"front\.npz"):
        ParetoFront.load(tmp_path / "front.npz")


# ------------------------------------------------------------------------------------------------- ParetoEvalCallback


class Memory(KVWriter):
    """A logger's output that keeps what it is given."""

    def __init__(self):
        self.rows = []

    def write(self, key_values, key_excluded, step=0):
        self.rows.append((step, dict(key_values), dict(key_excluded)))

    def close(self):
        pass


class Count(BaseCallback):
    """At how many environment steps it was called, and whether to go on each time.

    :param stop_at: the call that ends the training
    """

    def __init__(self, stop_at: int | None = None):
        super().__init__()
        self.called: list[int] = []
        self.stop_at = stop_at

    def _on_step(self) -> bool:
        self.called.append(self.num_timesteps)
        return len(self.called) != self.stop_at


def idle_model(n_envs: int = 1, **kwargs) -> MOMBA:
    """A model that acts but never trains."""
    return tiny_model(make_mo_vec_env(SeededEnv, n_envs, seed=0), learning_starts=10_000, **kwargs)


def evaluation(eval_freq: int = 10, **kwargs) -> ParetoEvalCallback:
    return ParetoEvalCallback(SeededEnv, eval_freq, **{"n_preferences": 3, "n_episodes": 2, **kwargs})


def front_of(volume: float) -> ParetoFront:
    """A front of that hypervolume: two preferences, both with the value [volume, 1]."""
    returns = np.array([[[volume, 1.0]], [[volume, 1.0]]])
    return ParetoFront(np.eye(2), returns, returns, np.ones((2, 1), dtype=np.int64), {"env": "scripted"})


@pytest.fixture
def script(monkeypatch):
    """script(3, 1): let the evaluations find fronts with these hypervolumes, the last one for ever."""

    def use(*volumes: float) -> None:
        left = list(volumes)
        monkeypatch.setattr(
            "sb3_momba.pareto.callbacks.evaluate_front",
            lambda *args, **kwargs: front_of(left.pop(0) if len(left) > 1 else left[0]),
        )

    return use


@pytest.mark.parametrize(
    ("n_envs", "eval_freq", "steps", "expected"),
    [
        (1, 10, 30, [10, 20, 30]),
        (1, 10, 25, [10, 20, 25]),
        (1, 100, 5, [5]),
        (1, 1, 3, [1, 2, 3]),
        (3, 10, 30, [12, 21, 30]),  # environment steps come in threes: the first at or after 10, 20, 30
        (3, 10, 31, [12, 21, 30, 33]),  # SB3 finishes the step that it began
        (4, 3, 12, [4, 8, 12]),
        (2, 3, 12, [4, 6, 10, 12]),
        (5, 2, 10, [5, 10]),  # two are due at once: one evaluation
    ],
)
def test_the_front_is_evaluated_every_eval_freq_environment_steps_and_once_at_the_end(
    n_envs, eval_freq, steps, expected, script
):
    script(1)
    callback = evaluation(eval_freq)
    model = idle_model(n_envs).learn(steps, callback=callback)
    assert callback.timesteps == expected
    assert model.num_timesteps == expected[-1]
    assert len(callback.metrics) == len(callback.values) == len(expected)


def test_the_evaluation_waits_for_the_end_of_a_rollout(script):
    script(1)
    callback = evaluation(10)
    idle_model(train_freq=7).learn(30, callback=callback)
    assert callback.timesteps == [14, 21, 35]  # rollouts end at 7, 14, 21, 28 and 35; due are 10, 20 and 30


class Keep(BaseCallback):
    """The policy's parameters each time that it is called."""

    def __init__(self):
        super().__init__()
        self.policies: list[dict[str, th.Tensor]] = []

    def _on_step(self) -> bool:
        self.policies.append({name: tensor.clone() for name, tensor in self.model.policy.state_dict().items()})
        return True


def test_what_is_evaluated_is_the_model_after_the_updates_of_its_steps():
    keep = Keep()
    callback = evaluation(10, callback_after_eval=keep)
    model = tiny_model(SeededEnv(), learning_starts=5).learn(25, callback=callback)
    assert callback.timesteps == [10, 20, 25]
    for steps, policy in zip(callback.timesteps, keep.policies, strict=True):
        alone = tiny_model(SeededEnv(), learning_starts=5).learn(steps)
        assert_same_tree(policy, dict(alone.policy.state_dict()))
    assert_same_tree(vars(callback.front), vars(evaluate_front(model, SeededEnv, 3, 2)))


@pytest.mark.parametrize("eval_freq", [0, -5])
def test_eval_freq_must_be_positive(eval_freq):
    with pytest.raises(ValueError, match=f"eval_freq={eval_freq}"):
        evaluation(eval_freq)


def test_the_end_is_evaluated_once_though_it_is_announced_twice(script):
    script(1)
    callback, count = evaluation(10), Count()
    callback.callback = count
    idle_model().learn(15, callback=CallbackList([callback]))
    callback.on_training_end()
    callback.on_training_end()
    assert callback.timesteps == count.called == [10, 15]


def test_the_evaluation_is_evaluate_fronts_with_the_given_settings():
    callback = evaluation(100, n_preferences=4, n_episodes=3, seed=8, deterministic=False, reference_point=[-1, -20])
    model = idle_model().learn(5, callback=callback)
    front = evaluate_front(model, SeededEnv, 4, 3, seed=8, deterministic=False)
    assert_same_tree(vars(callback.front), vars(front))
    assert callback.metrics[0]["hypervolume"] == front.hypervolume([-1, -20]) != front.hypervolume()
    np.testing.assert_array_equal(callback.values[0], front.values)


@pytest.mark.parametrize("form", ["Seeded-v0", SeededEnv(), make_mo_vec_env(SeededEnv, 2)])
def test_every_form_of_evaluation_environment_serves_more_than_once(form, seeded_id):
    callback = ParetoEvalCallback(form, 5, n_preferences=3, n_episodes=2)
    model = idle_model().learn(12, callback=callback)
    assert callback.timesteps == [5, 10, 12]
    # The batches differ in size, so that the last bits may.
    np.testing.assert_allclose(callback.front.returns, evaluate_front(model, SeededEnv, 3, 2).returns, rtol=1e-5)


@pytest.mark.parametrize(
    "share",
    [
        lambda model, env: model.get_env(),
        lambda model, env: VecMonitor(model.get_env()),
        lambda model, env: env,
        lambda model, env: PreferenceWrapper(env),
        lambda model, env: model.get_env().envs[0],
    ],
    ids=["VecEnv", "wrapped VecEnv", "instance", "instance in another wrapper", "wrapped instance"],
)
def test_the_training_environment_cannot_be_the_evaluations(share):
    # Its episode would end in the middle, and the next transition would join two episodes.
    env = SeededEnv()
    model = tiny_model(env)
    with pytest.raises(ValueError, match=r"eval_env is the training environment|use another one to evaluate"):
        model.learn(20, callback=ParetoEvalCallback(share(model, env), 10, n_preferences=2, n_episodes=1))


@pytest.mark.parametrize("verbose", [0, 1])
def test_each_evaluation_is_printed_if_asked_for(verbose, script, capsys):
    script(1, 2)
    idle_model().learn(20, callback=evaluation(10, verbose=verbose))
    lines = [line for line in capsys.readouterr().out.splitlines() if "hypervolume" in line]
    assert len(lines) == 2 * verbose
    if verbose:
        assert "10 steps" in lines[0]
        assert "hypervolume 2" in lines[1]


def test_the_metrics_and_the_picture_are_logged():
    memory, callback = Memory(), evaluation(10, objectives=["speed", "thrift"])
    model = idle_model()
    model.set_logger(Logger(None, [memory]))
    model.learn(25, callback=callback, log_interval=1_000)
    assert [step for step, _, _ in memory.rows] == [10, 20, 25]
    for (_, values, excluded), measured in zip(memory.rows, callback.metrics, strict=True):
        assert {name: values[f"pareto/{name}"] for name in measured} == measured
        picture = values["pareto/front"]
        assert isinstance(picture, LoggedFigure)
        assert picture.figure.axes[0].get_ylabel() == "thrift"
        assert set(excluded["pareto/front"]) == {"stdout", "log", "json", "csv"}
    assert "25 steps" in memory.rows[-1][1]["pareto/front"].figure.axes[0].get_title()
    assert callback.metrics[-1] == {
        "hypervolume": callback.front.hypervolume(),
        "expected_utility": callback.front.expected_utility(),
        "preference_regret": callback.front.preference_regret(),
        "n_non_dominated": callback.front.non_dominated().sum(),
    }
    assert callback.last_mean_reward == callback.metrics[-1]["hypervolume"]


def test_text_loggers_get_the_numbers_only(tmp_path):
    model = idle_model()
    model.set_logger(configure(str(tmp_path), ["csv", "json", "log"]))
    callback = evaluation(10)
    model.learn(20, callback=callback)
    with open(tmp_path / "progress.csv") as file:
        rows = list(csv.DictReader(file))
    logged = [float(row["pareto/hypervolume"]) for row in rows if row["pareto/hypervolume"]]
    assert logged == [m["hypervolume"] for m in callback.metrics]
    assert "pareto/front" not in rows[0]
    assert "hypervolume" in (tmp_path / "log.txt").read_text()


def test_tensorboard_gets_numbers_and_pictures(tmp_path):
    callback = evaluation(10)
    idle_model(tensorboard_log=str(tmp_path)).learn(20, callback=callback)
    (folder,) = tmp_path.iterdir()
    events = EventAccumulator(str(folder)).Reload()
    assert [event.step for event in events.Scalars("pareto/hypervolume")] == [10, 20]
    assert [event.value for event in events.Scalars("pareto/hypervolume")] == pytest.approx(
        [m["hypervolume"] for m in callback.metrics]
    )
    pictures = events.Images("pareto/front")
    assert [picture.step for picture in pictures] == [10, 20]
    assert pictures[0].encoded_image_string.startswith(PNG)
    assert plt.get_fignums() == []


@pytest.mark.parametrize("n_objectives", [None, 2, 3, 4])
def test_the_files_of_the_log_folder(n_objectives, tmp_path):
    make = partial(SeededEnv, n_objectives)
    callback = ParetoEvalCallback(make, 10, n_preferences=4, n_episodes=2, log_path=tmp_path / "logs")
    memory = Memory()
    model = tiny_model(make(), learning_starts=10_000)
    model.set_logger(Logger(None, [memory]))
    model.learn(15, callback=callback)

    with np.load(tmp_path / "logs" / "pareto_evaluations.npz", allow_pickle=False) as file:
        content = dict(file)
    front, width = callback.front, n_objectives or 1
    n = len(front.preferences)
    assert set(content) == {
        "timesteps",
        "preferences",
        "values",
        "hypervolume",
        "expected_utility",
        "preference_regret",
        "n_non_dominated",
    }
    assert content["timesteps"].tolist() == [10, 15]
    assert content["values"].shape == (2, n, width)
    np.testing.assert_array_equal(content["values"][-1], front.values)
    np.testing.assert_array_equal(content["preferences"], front.preferences)
    for name in callback.metrics[0]:
        assert content[name].tolist() == [m[name] for m in callback.metrics]
    assert_same_tree(vars(ParetoFront.load(tmp_path / "logs" / "front.npz")), vars(front))

    has_picture = n_objectives in (2, 3)
    assert (tmp_path / "logs" / "front.png").exists() == has_picture
    assert ("pareto/front" in memory.rows[-1][1]) == has_picture
    assert len(list((tmp_path / "logs").iterdir())) == 2 + has_picture  # nothing half-written, no evaluations.npz


def test_the_files_are_up_to_date_after_each_evaluation(tmp_path, script):
    script(1, 2, 3)
    seen = []

    class Look(BaseCallback):
        def _on_step(self) -> bool:
            with np.load(tmp_path / "pareto_evaluations.npz") as file:
                seen.append((file["timesteps"].tolist(), file["hypervolume"].tolist()))
            return True

    idle_model().learn(25, callback=evaluation(10, log_path=tmp_path, callback_after_eval=Look()))
    assert seen == [([10], [1]), ([10, 20], [1, 2]), ([10, 20, 25], [1, 2, 3])]


def test_the_best_model_is_the_one_with_the_largest_hypervolume(tmp_path, script):
    script(2, 5, 3, 5, 4)  # the second 5 is not better than the first
    new_best, after = Count(), Count()
    callback = evaluation(10, best_model_save_path=tmp_path / "best", callback_on_new_best=new_best, callback_after_eval=after)
    idle_model().learn(45, callback=callback)
    assert new_best.called == [10, 20]
    assert after.called == [10, 20, 30, 40, 45]
    assert MOMBA.load(tmp_path / "best" / "best_model.zip").num_timesteps == 20
    assert (callback.best_mean_reward, callback.last_mean_reward) == (5, 4)


def test_the_best_model_of_a_training_scores_its_hypervolume_again(tmp_path):
    callback = evaluation(10, best_model_save_path=tmp_path, reference_point=[-1, -20])
    tiny_model(SeededEnv(), learning_rate=0.01).learn(60, callback=callback)
    volumes = [m["hypervolume"] for m in callback.metrics]
    assert len(set(volumes)) > 1
    best = MOMBA.load(tmp_path / "best_model.zip")
    assert best.num_timesteps == callback.timesteps[int(np.argmax(volumes))]
    front = evaluate_front(best, SeededEnv, 3, 2)
    assert front.hypervolume([-1, -20]) == pytest.approx(callback.best_mean_reward, rel=1e-6)
    assert callback.best_mean_reward == max(volumes)


@pytest.mark.parametrize(
    ("stop_new_best", "stop_after", "expected"),
    [(None, 2, [10, 20]), (2, None, [10, 20, 30]), (1, 1, [10]), (None, None, [10, 20, 30, 40])],
)
def test_both_callbacks_are_asked_and_each_can_stop_the_training(stop_new_best, stop_after, expected, script):
    script(1, 1, 2, 2)  # new best ones at 10 and at 30
    new_best, after = Count(stop_new_best), Count(stop_after)
    callback = evaluation(10, callback_on_new_best=new_best, callback_after_eval=after)
    model = idle_model().learn(40, callback=callback)
    assert callback.timesteps == after.called == expected
    assert model.num_timesteps <= expected[-1] + 1
    assert new_best.called == [step for step in (10, 30) if step <= expected[-1]]


def test_sb3s_callback_stops_the_training_without_improvement(script):
    script(1, 2, 2)
    stop = StopTrainingOnNoModelImprovement(max_no_improvement_evals=2)
    callback = evaluation(10, callback_after_eval=stop)
    model = idle_model().learn(200, callback=callback)
    # The best is found at 20; 30 and 40 are forgiven, 50 is the third without improvement.
    assert callback.timesteps == [10, 20, 30, 40, 50]
    assert model.num_timesteps <= 51


def test_sb3s_callback_stops_the_training_at_a_threshold(script):
    script(1, 3, 8, 9)
    callback = evaluation(10, callback_on_new_best=StopTrainingOnRewardThreshold(7))
    idle_model().learn(200, callback=callback)
    assert callback.timesteps == [10, 20, 30]


def test_a_model_that_is_stopped_is_the_one_that_was_evaluated():
    callback = evaluation(10, callback_after_eval=Count(stop_at=2))
    model = tiny_model(SeededEnv(), learning_starts=5).learn(40, callback=callback)
    assert callback.timesteps == [10, 20]
    assert_same_tree(vars(callback.front), vars(evaluate_front(model, SeededEnv, 3, 2)))


def test_continuing_the_training_keeps_the_schedule(script, tmp_path):
    script(1)
    callback = evaluation(10, log_path=tmp_path)
    model = idle_model()
    model.learn(15, callback=callback)
    model.learn(20, callback=callback, reset_num_timesteps=False)
    assert callback.timesteps == [10, 15, 20, 30, 35]
    with np.load(tmp_path / "pareto_evaluations.npz") as file:
        assert file["timesteps"].tolist() == [10, 15, 20, 30, 35]
    another = evaluation(10)
    model.learn(20, callback=another, reset_num_timesteps=False)
    assert another.timesteps == [40, 50, 55]


@pytest.mark.parametrize(("eval_freq", "expected"), [(10, [10, 15]), (5, [5, 10, 15]), (100, [15])])
def test_training_again_from_zero_is_evaluated_like_the_first_time(eval_freq, expected, script):
    script(1)
    callback = evaluation(eval_freq)
    for _ in range(2):
        idle_model().learn(15, callback=callback)
    assert callback.timesteps == expected * 2


def test_sb3s_sac_can_be_evaluated_while_it_trains(tmp_path):
    model = SAC("MlpPolicy", make_mo_vec_env(SeededEnv), learning_starts=10, batch_size=8, policy_kwargs={"net_arch": [8]})
    callback = evaluation(10, best_model_save_path=tmp_path)
    model.learn(20, callback=callback)
    assert callback.timesteps == [10, 20]
    assert (tmp_path / "best_model.zip").exists()


# ------------------------------------------------------------------------------------------------------------ pictures

PNG = b"\x89PNG\r\n\x1a\n"
STAIRS = np.array([[1.0, 3.0], [3.0, 1.0], [2.0, 2.0], [1.0, 1.0]])  # the last one is dominated
SOLID = np.array([[1.0, 3.0, 2.0], [3.0, 1.0, 2.0], [0.5, 0.5, 0.5]])


def pixels_of(path, colour: str) -> int:
    """How many pixels of a picture have exactly this colour."""
    return int((np.abs(matplotlib.image.imread(path)[..., :3] - to_rgba(colour)[:3]).max(axis=-1) < 0.01).sum())


@pytest.mark.parametrize("values", [STAIRS, SOLID], ids=["2 objectives", "3 objectives"])
def test_a_front_is_drawn_and_written_as_png(values, tmp_path):
    open_figures = plt.get_fignums()
    figure = plot_front(values, tmp_path / "folder" / "front.png", ["a", "b", "c"][: values.shape[1]], "A title")
    assert plt.get_fignums() == open_figures
    assert (tmp_path / "folder" / "front.png").read_bytes().startswith(PNG)
    picture = matplotlib.image.imread(tmp_path / "folder" / "front.png")
    assert picture.shape[:2] == (675, 900)  # 4.5 x 6 inches of 150 dots
    assert len(np.unique(picture.reshape(-1, 4), axis=0)) > 50  # axes, text and edges, not one empty page
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_title()) == ("a", "b", "A title")
    if values.shape[1] == 3:
        assert axes.get_zlabel() == "c"
    else:
        assert pixels_of(tmp_path / "folder" / "front.png", COLOURS[0]) > 100
    assert axes.get_legend() is None


def test_dominated_solutions_are_faint_and_the_front_is_joined_in_order():
    (axes,) = plot_front(STAIRS).figure.axes
    dominated, front = axes.collections
    assert dominated.get_offsets().tolist() == [[1, 1]]
    assert sorted(front.get_offsets().tolist()) == [[1, 3], [2, 2], [3, 1]]
    assert dominated.get_alpha() < 0.5
    assert front.get_alpha() is None
    (line,) = axes.lines
    assert line.get_xydata().tolist() == [[1, 3], [2, 2], [3, 1]]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("Objective 1", "Objective 2")


def test_the_third_objective_is_drawn():
    (axes,) = plot_front(SOLID).axes
    dominated, front = axes.collections
    np.testing.assert_array_equal(np.stack(front._offsets3d, axis=1), SOLID[:2])
    np.testing.assert_array_equal(np.stack(dominated._offsets3d, axis=1), SOLID[2:])


@pytest.mark.parametrize("values", [STAIRS, SOLID], ids=["2 objectives", "3 objectives"])
def test_several_runs_have_their_colours_and_names(values, tmp_path):
    returns = values[:, None]
    front = ParetoFront(np.full_like(values, 1 / values.shape[1]), returns, returns, np.ones((len(values), 1), dtype=np.int64))
    runs = {"ours": front, "theirs": (values + 1).tolist(), "nobody's": values - 1}
    figure = plot_front(runs, tmp_path / "runs.png")
    (axes,) = figure.axes
    assert [text.get_text() for text in axes.get_legend().get_texts()] == list(runs)
    assert len(axes.collections) == 6
    for i in range(3):
        np.testing.assert_allclose(axes.collections[2 * i + 1].get_facecolor()[0][:3], to_rgba(COLOURS[i])[:3])
    if values is STAIRS:
        assert all(pixels_of(tmp_path / "runs.png", colour) > 50 for colour in COLOURS[:3])


def test_more_runs_than_colours():
    (legend,) = plot_front({f"run {i}": STAIRS + i for i in range(9)}).legends
    assert len(legend.get_texts()) == 9


@pytest.mark.parametrize("values", [STAIRS, SOLID], ids=["2 objectives", "3 objectives"])
@pytest.mark.parametrize(
    "names",
    [[f"run {i} ({', '.join(['cost=$1'] * 12)})" for i in range(4)], [f"run {i}" for i in range(30)]],
    ids=["long", "many"],
)
@pytest.mark.filterwarnings("error::UserWarning")
def test_a_large_legend_covers_nothing_and_takes_nothing_from_the_axes(values, names, tmp_path):
    small, large = (
        plot_front({name: values + i for i, name in enumerate(several)}, tmp_path / "front.png") for several in (["a"], names)
    )
    areas = []
    for figure in (small, large):
        figure.draw_without_rendering()
        areas.append(figure.axes[0].bbox)
    legend = large.axes[0].get_legend() or large.legends[0]
    assert [text.get_text().replace("\n", " ") for text in legend.get_texts()] == [name.replace("$", r"\$") for name in names]
    area = legend.get_window_extent()
    assert 0 < area.x0 < area.x1 < large.bbox.x1
    assert 0 < area.y0 < area.y1 < areas[1].y0
    assert areas[1].width > 0.95 * areas[0].width
    assert areas[1].height > 0.95 * areas[0].height


@pytest.mark.parametrize(
    ("name", "start"), [("front.pdf", b"%PDF"), ("front.svg", b"<?xml"), ("front.PNG", PNG), ("front", PNG)]
)
def test_the_suffix_chooses_the_format(name, start, tmp_path):
    plot_front(STAIRS, str(tmp_path / name))
    assert [file.name for file in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_bytes().startswith(start)
    assert (tmp_path / name).stat().st_size > 5_000
    assert b"Software" not in (tmp_path / name).read_bytes()


def test_an_evaluated_front_is_drawn_as_its_mean_returns():
    front = evaluate_front(FirstWeight(), SeededEnv, 3, 3, seed=4)
    (axes,) = plot_front(front).axes
    dominated, best = axes.collections
    np.testing.assert_allclose(np.vstack([dominated.get_offsets(), best.get_offsets()]), front.values)


@pytest.mark.parametrize(
    ("fronts", "kwargs", "message"),
    [
        (np.ones((3, 1)), {}, "2 or of 3 objectives, not"),
        (np.ones((3, 4)), {}, "2 or of 3 objectives, not .*4"),
        ({"a": STAIRS, "b": SOLID}, {}, "'a': 2, 'b': 3"),
        ({}, {}, "2 or of 3 objectives"),
        (np.ones(2), {}, r"has shape \(2,\)"),
        ([[1.0, np.nan]], {}, "not finite"),
        (STAIRS, {"objectives": ["speed"]}, r"objectives=\['speed'\]: 2 labels"),
        (STAIRS, {"objectives": ["a", "b", "c"]}, "2 labels"),
        (STAIRS, {"path": "front.xyz"}, "xyz"),
    ],
)
def test_what_cannot_be_drawn_is_an_error_and_no_file(fronts, kwargs, message, tmp_path):
    path = tmp_path / kwargs.pop("path", "front.png")
    with pytest.raises(ValueError, match=message):
        plot_front(fronts, path, **kwargs)
    assert list(tmp_path.iterdir()) == []


# -------------------------------------------------------------------------------------------------------------- floors


@pytest.mark.parametrize(
    ("low", "high", "action"),
    [([-1, -1], [1, 1], [0, 0]), ([0.5, -3], [2, -1], [0.5, -1]), ([0, -4], [4, 0], [0, 0]), ([-2, 0.25], [-1, 1], [-1, 0.25])],
)
def test_the_zero_action_is_the_one_nearest_to_zero(low, high, action):
    space = spaces.Box(np.float32(low), np.float32(high))
    actions, state = ZeroActionPolicy(space).predict(np.ones((3, 7)), deterministic=True)
    np.testing.assert_array_equal(actions, np.float32([action] * 3), strict=True)
    assert state is None
    assert space.contains(actions[0])


def test_random_actions_are_uniform_between_the_bounds():
    space = spaces.Box(np.float32([-1, 10]), np.float32([1, 30]))
    actions, state = RandomPolicy(space).predict(np.ones((4000, 7)), deterministic=True)
    assert state is None
    assert (actions.shape, actions.dtype) == ((4000, 2), np.float32)
    assert all(space.contains(action) for action in actions)
    # Standard errors of the mean: 2 / sqrt(12 n) = 0.009 and 0.09; of a quarter's share: 0.007.
    np.testing.assert_allclose(actions.mean(axis=0), [0, 20], atol=0.5)
    np.testing.assert_allclose(actions[:, 0].mean(), 0, atol=0.05)
    shares = np.histogram2d(*actions.T, bins=2, range=[[-1, 1], [10, 30]])[0] / 4000
    np.testing.assert_allclose(shares, 0.25, atol=0.04)


def test_random_actions_come_from_their_seed():
    space, observations = spaces.Box(-1, 1, (2,)), np.ones((3, 4))
    ours, again, other = RandomPolicy(space, 5), RandomPolicy(space, 5), RandomPolicy(space, 6)
    first, second = ours.predict(observations)[0], ours.predict(observations)[0]
    np.testing.assert_array_equal(first, again.predict(observations)[0])
    assert not np.array_equal(first, second)
    assert not np.array_equal(first, other.predict(observations)[0])
    assert len(np.unique(first)) == 6


def test_floors_are_evaluated_like_models():
    space = SeededEnv().action_space
    still = evaluate_front(ZeroActionPolicy(space), SeededEnv, 3, 3, seed=4)
    assert still.returns.tolist() == [[[12, 0], [30, 0], [6, 0]]] * 3
    wild = evaluate_front(RandomPolicy(space), SeededEnv, 3, 3, seed=4)
    assert (wild.returns[:, :, 0] == [12, 30, 6]).all()
    assert (np.abs(wild.returns[:, :, 1]) <= [3, 6, 1]).all()
    assert len(np.unique(wild.returns[:, :, 1])) == 9


# ------------------------------------------------------------------------------------------------------------ workers


@pytest.mark.parametrize("n_workers", [2, 3])
def test_fronts_are_bit_equal_for_any_number_of_workers_and_preferences(n_workers):
    model = MOMBA("SimbaPolicy", "MO-Walker2d-v4", seed=1, buffer_size=10)
    alone = evaluate_front(model, "MO-Walker2d-v4", n_preferences=20)
    assert len(np.unique(alone.episode_lengths)) > 1
    shared = evaluate_front(model, "MO-Walker2d-v4", n_preferences=20, n_workers=n_workers)
    for name in ("preferences", "returns", "discounted_returns", "episode_lengths"):
        np.testing.assert_array_equal(getattr(shared, name), getattr(alone, name))
    few = evaluate_front(model, "MO-Walker2d-v4", preferences=alone.preferences[:2])
    np.testing.assert_array_equal(few.returns, alone.returns[:2])


def test_workers_take_environments_from_a_function_and_any_policy():
    alone = evaluate_front(FirstWeight(), SeededEnv, n_preferences=5, n_episodes=3)
    shared = evaluate_front(FirstWeight(), SeededEnv, n_preferences=5, n_episodes=3, n_workers=2)
    np.testing.assert_array_equal(shared.returns, alone.returns)


@pytest.mark.parametrize(("env", "n_workers"), [(make_mo_vec_env(SeededEnv, 1), 2), (SeededEnv(), 2), (SeededEnv, 0)])
def test_workers_that_cannot_be_are_refused(env, n_workers):
    with pytest.raises(ValueError, match=rf"n_workers={n_workers}: at least one; more of them need an id or a callable"):
        evaluate_front(FirstWeight(), env, n_workers=n_workers)


def test_an_error_in_a_worker_reaches_the_caller():
    with pytest.raises(RuntimeError, match="no answer"):
        evaluate_front(Speechless(), SeededEnv, n_preferences=4, n_workers=2)


class Speechless:
    def predict(self, observation, *, deterministic):
        raise RuntimeError("no answer")


def test_many_things_in_a_picture_are_told_apart():
    styles = [style_of(i) for i in range(28)]
    assert len(set(styles)) == len({(colour, marker) for colour, marker, _ in styles}) == 28
    assert [line for _, _, line in styles[:8]] == ["-"] * 7 + ["--"]
