"""DPMORL's parts alone: utilities, the return in the state, rewards that add up to a utility, dominance of distributions."""

import itertools
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

import sb3_momba.baselines.utilities as utilities_module
from sb3_momba.baselines.dominance import dominates, non_dominated_distributions
from sb3_momba.baselines.returns import AccumulatedReturn, UtilityReward, WithoutReward, symlog
from sb3_momba.baselines.utilities import (
    LinearUtility,
    MonotoneUtility,
    Probes,
    UtilityOfReturns,
    distance,
    generate_utilities,
    linear_utilities,
    move_away,
)
from tests.stubs import StubEnv, observation_of

LOW, HIGH = np.array([-10.0, -200.0]), np.array([10.0, 0.0])


@pytest.fixture(scope="module", params=[2, 3], ids=["two objectives", "three objectives"])
def utilities(request) -> tuple[int, list[nn.Module]]:
    """The linear ones of so many objectives, and two learned ones."""
    n = request.param
    return n, generate_utilities(n + 3, n, th.Generator().manual_seed(0))


# ------------------------------------------------------------------------------------------------------------ utilities


def test_utilities_rise_with_every_objective(utilities) -> None:
    n, found = utilities
    for utility in found:
        x = th.rand((200, n), generator=th.Generator().manual_seed(1), dtype=th.float64).requires_grad_()
        utility(x).sum().backward()
        assert (x.grad > 0).all()


def test_utilities_prefer_what_is_better_in_any_objective(utilities) -> None:
    n, found = utilities
    generator = th.Generator().manual_seed(2)
    worse = 3 * th.rand((500, n), generator=generator, dtype=th.float64) - 1  # beyond the cube too
    better = worse + th.rand((500, n), generator=generator, dtype=th.float64) * (th.rand((500, n), generator=generator) < 0.5)
    for utility in found:
        assert (utility(better) >= utility(worse)).all()


def test_utilities_are_0_and_1_at_the_corners(utilities) -> None:
    n, found = utilities
    corners = th.tensor([[0.0] * n, [1.0] * n], dtype=th.float64)
    for utility in found:
        th.testing.assert_close(utility(corners), th.tensor([0.0, 1.0], dtype=th.float64))


def test_the_first_utilities_are_weighted_means() -> None:
    x = th.tensor([[0.5, 1.0]], dtype=th.float64)
    assert [float(utility(x)) for utility in linear_utilities(2)] == pytest.approx([0.75, 0.6, 0.9])  # 1:1, 4:1, 1:4
    assert [utility.weights.tolist() for utility in linear_utilities(3)][2] == pytest.approx([1 / 6, 4 / 6, 1 / 6])
    assert len(generate_utilities(2, 3, th.Generator())) == 2


def test_a_learned_utility_is_no_weighted_mean(utilities) -> None:
    n, found = utilities
    x = Probes(n, th.Generator().manual_seed(1)).points.numpy()
    planes = np.column_stack([x, np.ones(len(x))])
    for number, utility in enumerate(found):
        values = utility(th.tensor(x)).numpy()
        nearest = planes @ np.linalg.lstsq(planes, values, rcond=None)[0]
        assert bool(np.abs(values - nearest).max() > 0.1) is (number > n)


def test_the_distance_by_hand() -> None:
    """Values that differ by 0.2 everywhere and angles by 0.4: 0.1 x 0.04 + 0.5 x 0.16."""
    one = th.stack([th.zeros(5), th.zeros(5)])
    other = th.stack([th.full((5,), 0.2), th.full((5,), -0.4)])
    assert float(distance(one, other)) == pytest.approx(0.084)
    assert distance(one, th.stack([other, one])).tolist() == pytest.approx([0.084, 0.0])


def test_slopes_are_taken_along_the_displacements() -> None:
    probes = Probes(2, th.Generator().manual_seed(0))
    values, angles = probes(LinearUtility([0.3, 0.7]))
    assert ((probes.points >= 0.1) & (probes.points <= 0.9)).all()
    weights = th.tensor([0.3, 0.7], dtype=th.float64)
    th.testing.assert_close(values, probes.points @ weights)
    th.testing.assert_close(angles.tan(), (probes.displacements @ weights) / probes.displacements.norm(dim=1))


def smallest_distance(utilities: list[nn.Module], n: int) -> float:
    probes = Probes(n, th.Generator().manual_seed(5))
    seen = [probes(utility) for utility in utilities]
    return min(float(distance(one, other).detach()) for one, other in itertools.combinations(seen, 2))


def test_generated_utilities_differ_more_than_random_ones(utilities) -> None:
    n, found = utilities
    learned = found[n + 1 :]
    for seed in range(5):
        generator = th.Generator().manual_seed(seed)
        untrained = [MonotoneUtility(n, generator) for _ in learned]
        assert smallest_distance(found, n) > 1.5 * smallest_distance([*linear_utilities(n), *untrained], n)


def test_moving_away_moves_away() -> None:
    generator = th.Generator().manual_seed(3)
    probes = Probes(2, generator)
    others = th.stack([probes(utility) for utility in linear_utilities(2)])
    utility = MonotoneUtility(2, generator)
    before = float(distance(probes(utility), others).min().detach())
    move_away(utility, probes, others)
    assert float(distance(probes(utility), others).min().detach()) > 2 * before


def test_the_same_generator_gives_the_same_utilities(monkeypatch) -> None:
    monkeypatch.setattr(utilities_module, "EPOCHS", 5)
    x = Probes(2, th.Generator().manual_seed(0)).points
    one, same, other = (generate_utilities(4, 2, th.Generator().manual_seed(seed))[3](x) for seed in (7, 7, 8))
    assert th.equal(one, same)
    assert not th.equal(one, other)


def test_the_utility_of_returns_by_hand() -> None:
    """The widest range, 200, is the cube's width; the objective of the range 20 lies in its middle, from -100 to 100."""
    utility = UtilityOfReturns(LinearUtility([0.25, 0.75]), th.tensor(LOW), th.tensor(HIGH))
    z = th.tensor([[0.0, 0.0], [10.0, -100.0]], dtype=th.float64)
    # 2 x 200 x (0.25 x 0.5 + 0.75 x 1), and 2 x 200 x (0.25 x 0.55 + 0.75 x 0.5)
    assert utility(z).tolist() == pytest.approx([350.0, 205.0])


# ------------------------------------------------------------------------------------------------ state and reward


def augmented(**kwargs: Any) -> AccumulatedReturn:
    """Step t gives [t, -10 t]; z is shown as the symlog of (z - low) / 20 and / 200."""
    return AccumulatedReturn(StubEnv(**kwargs), LOW, HIGH)


def seen(z: tuple[float, float]) -> list[float]:
    return [np.log(1 + (z[0] + 10) / 20), np.log(1 + (z[1] + 200) / 200)]  # neither falls below its range


def test_the_state_shows_the_return_so_far() -> None:
    env = augmented(episode_length=3)
    observation, _ = env.reset()
    np.testing.assert_allclose(observation, [*observation_of(0, start_of_episode=True), *seen((0, 0))], rtol=1e-6)
    returns = [(1, -10), (3, -30), (6, -60)]
    for t, z in enumerate(returns, start=1):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        np.testing.assert_allclose(observation, [*observation_of(t), *seen(z)], rtol=1e-6)
        assert observation.dtype == np.float32
        assert env.observation_space.shape == observation.shape == (5,)
        assert reward.tolist() == [t, -10 * t]
        assert info["accumulated_return"].tolist() == list(z)
        assert (terminated, truncated) == (False, t == 3)
    observation, _ = env.reset()
    np.testing.assert_allclose(observation[-2:], seen((0, 0)), rtol=1e-6)


def test_symlog_by_hand() -> None:
    x = np.array([0.0, np.e - 1, 1 - np.e, np.e**2 - 1])
    np.testing.assert_allclose(symlog(x), [0, 1, -1, 2], atol=1e-12)
    assert symlog(np.array([1e-6]))[0] == pytest.approx(1e-6, rel=1e-5)


def test_a_return_far_beyond_its_range_is_still_seen() -> None:
    """Forty times the range is less than four, and more than thirty times."""
    env = AccumulatedReturn(StubEnv(), np.zeros(2), np.ones(2))
    env.reset()
    env.z = np.array([40.0, -30.0])
    assert env._observe(np.zeros(1))[1:].tolist() == pytest.approx([np.log(41), -np.log(31)])


def test_the_state_without_the_return() -> None:
    env = AccumulatedReturn(StubEnv(), LOW, HIGH, augment=False)
    observation, _ = env.reset()
    assert env.observation_space.shape == observation.shape == (3,)
    _, _, _, _, info = env.step(env.action_space.sample())
    assert info["accumulated_return"].tolist() == [1, -10]


def test_an_environment_that_reuses_its_arrays_keeps_no_hold_of_the_return() -> None:
    env = augmented(reuse_arrays=True)
    env.reset()
    first = env.step(env.action_space.sample())[4]["accumulated_return"]
    env.step(env.action_space.sample())
    assert first.tolist() == [1, -10]


def rewarded(utility: Any, *lengths: int, ending: str = "truncated") -> UtilityReward:
    venv = DummyVecEnv(
        [lambda length=length: WithoutReward(augmented(episode_length=length, ending=ending)) for length in lengths]
    )
    return UtilityReward(venv, utility, 2)


def play(venv: UtilityReward, n_steps: int) -> list[tuple[Any, ...]]:
    return [venv.step(np.zeros((venv.num_envs, 2), dtype=np.float32)) for _ in range(n_steps)]


@pytest.mark.parametrize("ending", ["truncated", "terminated"])
def test_rewards_add_up_to_the_utility_of_the_return(ending: str) -> None:
    utility = UtilityOfReturns(MonotoneUtility(2, th.Generator().manual_seed(0)), th.tensor(LOW), th.tensor(HIGH))
    venv = rewarded(utility, 3, 5, ending=ending)
    venv.reset()
    steps = play(venv, 9)
    rewards = np.array([rewards for _, rewards, _, _ in steps])
    dones = np.array([dones for _, _, dones, _ in steps])
    assert dones[:, 0].nonzero()[0].tolist() == [2, 5, 8]
    assert dones[:, 1].nonzero()[0].tolist() == [4]

    def of(*z: float) -> float:
        return float(utility(th.tensor([z], dtype=th.float64)))

    # The stub counts on over its episodes: 1 + 2 + 3, 4 + 5 + 6, 7 + 8 + 9; and 1 + ... + 5.
    for index, rows, total in ((0, slice(0, 3), 6), (0, slice(3, 6), 15), (0, slice(6, 9), 24), (1, slice(0, 5), 15)):
        assert rewards[rows, index].sum() == pytest.approx(of(total, -10 * total) - of(0, 0), abs=1e-9)
    assert rewards[1, 0] == pytest.approx(of(3, -30) - of(1, -10), abs=1e-12)


def test_the_state_over_an_autoreset() -> None:
    venv = rewarded(lambda z: z.sum(dim=1), 2, 3)
    assert venv.reset()[:, -2:].tolist() == pytest.approx(np.array([seen((0, 0))] * 2))
    (first, rewards, _, _), (second, _, dones, infos) = play(venv, 2)
    np.testing.assert_allclose(first[:, -2:], [seen((1, -10))] * 2, rtol=1e-6)
    assert rewards.tolist() == [-9, -9]
    assert dones.tolist() == [True, False]
    np.testing.assert_allclose(second[:, -2:], [seen((0, 0)), seen((3, -30))], rtol=1e-6)
    np.testing.assert_allclose(infos[0]["terminal_observation"], [*observation_of(2), *seen((3, -30))], rtol=1e-6)
    _, rewards, _, _ = play(venv, 1)[0]
    assert rewards.tolist() == [-27, -27]  # 3 - 30 from 0 on, and from [3, -30] to [6, -60]


def test_nothing_is_added_for_what_a_truncated_episode_would_have_come_to() -> None:
    venv = rewarded(lambda z: z.sum(dim=1), 2)
    venv.reset()
    assert [infos[0]["TimeLimit.truncated"] for _, _, _, infos in play(venv, 4)] == [False] * 4


def test_a_reset_in_mid_episode_starts_from_0() -> None:
    venv = rewarded(lambda z: z.sum(dim=1), 5)
    venv.reset()
    play(venv, 2)
    venv.reset()
    assert play(venv, 1)[0][1].tolist() == [-27]  # step 3 of the stub, from 0


def test_the_range_of_returns_is_noted() -> None:
    venv = rewarded(lambda z: z.sum(dim=1), 2, 3)
    venv.reset()
    play(venv, 3)
    assert (venv.low.tolist(), venv.high.tolist()) == ([0, -60], [6, 0])


# ------------------------------------------------------------------------------------------------------- dominance


def of(*samples: tuple[float, float]) -> np.ndarray:
    return np.array(samples, dtype=np.float64)


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        (of((1, 1)), of((0, 1)), True),
        (of((1, 1)), of((1, 1)), False),
        (of((1, 0)), of((0, 1)), False),
        (of((1, 1), (3, 3)), of((2, 2), (0, 0)), True),  # in another order
        (of((1, 1), (3, 3)), of((3, 3), (1, 1)), False),  # the same distribution
        (of((2, 2), (0, 0)), of((1, 1), (1, 1)), False),  # more risk, the same mean
        (of((0, 1), (1, 0)), of((0, 0), (1, 1)), False),  # each objective is distributed alike
        (of((1, 1), (0, 0)), of((0, 1), (1, 0)), False),
        (of((3, 1), (2, 2)), of((2, 1), (1, 2)), True),
        (of((2, 2), (3, 1)), of((2, 2), (1, 1)), True),  # (2, 2) must not take (1, 1)'s place
        (of((5, 0), (9, 9)), of((0, 1), (0, 1)), False),  # a better mean is not enough
    ],
    ids=range(11),
)
def test_dominance_by_hand(one: np.ndarray, other: np.ndarray, expected: bool) -> None:
    assert dominates(one, other) is expected
    if expected:
        assert not dominates(other, one)


def test_what_dominates_is_liked_better_by_every_utility() -> None:
    rng = np.random.default_rng(0)
    liked = [MonotoneUtility(2, th.Generator().manual_seed(seed)) for seed in range(5)]
    n_dominating = 0
    for _ in range(100):
        one, other = rng.random((2, 3, 2)) + np.array([[[0.3]], [[0.0]]])
        if dominates(one, other):
            n_dominating += 1
            assert all(utility(th.tensor(one)).mean() > utility(th.tensor(other)).mean() for utility in liked)
    assert n_dominating > 5


def test_the_distributions_that_stay() -> None:
    returns = np.stack([of((1, 1), (3, 3)), of((0, 0), (2, 2)), of((3, 3), (1, 1)), of((0, 5), (0, 4))])
    assert non_dominated_distributions(returns) == [0, 2, 3]


def test_single_samples_are_compared_as_points() -> None:
    assert non_dominated_distributions(np.array([[[1.0, 2.0]], [[2.0, 1.0]], [[1.0, 1.0]]])) == [0, 1]


def test_samples_of_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(1, 2\) and \(2, 2\)"):
        dominates(of((1, 1)), of((1, 1), (2, 2)))
