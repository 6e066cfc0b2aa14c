"""The exact fronts of tests/known_fronts.py are exact, and a short training comes near one."""

from functools import lru_cache

import numpy as np
import pytest

from sb3_momba import MOMBA, evaluate_front, preference_regret
from sb3_momba.envs.preferences import preference_grid
from sb3_momba.pareto.floors import ZeroActionPolicy
from tests.known_fronts import (
    GAMMA,
    N_PREFERENCES,
    TASKS,
    LinearQuadraticRegulator,
    QuadraticBandit,
    floors,
    score,
    score_policy,
    train_and_score,
)


def grid_of(task_name: str) -> np.ndarray:
    n_objectives = TASKS[task_name].n_objectives
    return preference_grid(n_objectives, N_PREFERENCES[n_objectives])


def exact_front_of(task_name: str) -> np.ndarray:
    return TASKS[task_name].make().exact_front(grid_of(task_name))


# ---------------------------------------------------------------------------------------------------------- the bandit


@pytest.mark.parametrize("n_objectives", [2, 3])
def test_no_action_of_a_fine_grid_beats_the_bandits_best_one(n_objectives):
    bandit = QuadraticBandit(n_objectives)
    step = 0.02
    actions = np.stack(np.meshgrid(*[np.arange(-1, 1 + step / 2, step)] * 2), axis=-1).reshape(-1, 2)
    preferences = grid_of(f"bandit, {n_objectives} objectives")
    utilities = preferences @ bandit.rewards(actions).T
    best = (preferences * bandit.exact_front(preferences)).sum(axis=1)
    assert (utilities.max(axis=1) <= best + 1e-12).all()
    # u falls by the squared distance from the best action, and some action of the grid is half a diagonal near.
    assert (utilities.max(axis=1) >= best - step**2 / 2).all()
    np.testing.assert_allclose(actions[utilities.argmax(axis=1)], preferences @ bandit.centres, atol=step / 2 + 1e-9)


@pytest.mark.parametrize("n_objectives", [2, 3])
def test_the_bandits_step_gives_the_rewards_of_the_formula(n_objectives):
    bandit = QuadraticBandit(n_objectives)
    bandit.reset()
    action = np.array([0.5, -0.25], dtype=np.float32)
    _, reward, terminated, truncated, _ = bandit.step(action)
    assert (terminated, truncated) == (True, False)
    for i, r in enumerate(reward):
        angle = 2 * np.pi * i / n_objectives + 0.3
        assert r == pytest.approx(1 - (0.5 - 0.6 * np.cos(angle)) ** 2 - (-0.25 - 0.6 * np.sin(angle)) ** 2)


def test_the_bandits_front_by_hand():
    # Two centres 1.2 apart: with weight w on the first, the best action is 1.2 (1 - w) from it and 1.2 w from the other.
    w = np.array([0, 0.25, 0.5, 1])
    front = QuadraticBandit(2).exact_front(np.stack([w, 1 - w], axis=1))
    np.testing.assert_allclose(front, np.stack([1 - 1.44 * (1 - w) ** 2, 1 - 1.44 * w**2], axis=1), atol=1e-12)


# ------------------------------------------------------------------------------------------------------------- the LQR

LQR_PREFERENCES = preference_grid(2, 6)


def returns_of_gain(gain: np.ndarray) -> tuple[np.ndarray, float]:
    """Discounted returns of u = -K x over the horizon, mean of the starts, (2,), and the largest |u|."""
    lqr = LinearQuadraticRegulator()
    x = lqr.starts.T.copy()  # (2, starts)
    returns, largest = np.zeros(2), 0.0
    for t in range(lqr.horizon):
        u = -gain @ x
        state_costs, action_costs = np.sum(x * (lqr.q_matrices @ x), axis=1), np.sum(u * (lqr.r_matrices @ u), axis=1)
        returns -= GAMMA**t * (state_costs + action_costs).mean(axis=1)
        largest = max(largest, float(np.abs(u).max()))
        x = lqr.a_matrix @ x + lqr.b_matrix @ u
    return returns, largest


def infinite_cost(gain: np.ndarray, w: np.ndarray) -> np.ndarray:
    """P with x.P x the discounted cost of u = -K x for ever: P = Q + K'R K + gamma (A - B K)' P (A - B K), a linear system."""
    lqr = LinearQuadraticRegulator()
    q, r = np.tensordot(w, lqr.q_matrices, 1), np.tensordot(w, lqr.r_matrices, 1)
    closed = lqr.a_matrix - lqr.b_matrix @ gain
    stage = q + gain.T @ r @ gain
    return np.linalg.solve(np.eye(4) - GAMMA * np.kron(closed.T, closed.T), stage.reshape(-1)).reshape(2, 2)


@pytest.mark.parametrize("w", LQR_PREFERENCES, ids=str)
def test_no_other_action_now_beats_the_riccati_gain(w):
    """Bellman's equation, with a cost-to-go that does not come from the Riccati equation: no policy of any kind is better."""
    lqr = LinearQuadraticRegulator()
    gain = lqr.gain(w)
    p = infinite_cost(gain, w)
    q, r = np.tensordot(w, lqr.q_matrices, 1), np.tensordot(w, lqr.r_matrices, 1)[0, 0]
    actions = np.linspace(-3, 3, 601)
    for x in [*lqr.starts, np.array([0.3, -0.7])]:
        following = (lqr.a_matrix @ x)[:, None] + lqr.b_matrix * actions
        costs = x @ q @ x + r * actions**2 + GAMMA * np.sum(following * (p @ following), axis=0)
        assert costs.min() >= x @ p @ x - 1e-12
        assert abs(actions[costs.argmin()] + (gain @ x)[0]) <= 0.005 + 1e-9  # half a step of the grid


@pytest.mark.parametrize("w", LQR_PREFERENCES, ids=str)
def test_the_riccati_gain_beats_other_linear_gains(w):
    gain = LinearQuadraticRegulator().gain(w)
    best = w @ returns_of_gain(gain)[0]
    rng = np.random.default_rng(0)
    turned = [gain + 0.1 * np.array([[np.cos(a), np.sin(a)]]) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)]
    wild = list(rng.normal(0, 1.5, (40, 1, 2)))
    scaled = [0.8 * gain, 1.25 * gain, 0 * gain]
    assert max(w @ returns_of_gain(other)[0] for other in turned + wild + scaled) < best


def test_the_actions_of_the_best_gains_stay_inside_the_bounds():
    space = LinearQuadraticRegulator().action_space
    largest = max(returns_of_gain(LinearQuadraticRegulator().gain(w))[1] for w in grid_of("LQR"))
    assert 0.5 < largest < space.high[0]  # so that clipping them changes nothing


def test_the_exact_front_of_the_lqr_is_that_of_its_gains():
    expected = [returns_of_gain(LinearQuadraticRegulator().gain(w))[0] for w in LQR_PREFERENCES]
    np.testing.assert_allclose(LinearQuadraticRegulator().exact_front(LQR_PREFERENCES), expected, rtol=1e-9)


def test_the_seed_chooses_the_start_of_the_lqr():
    lqr = LinearQuadraticRegulator()
    assert [lqr.reset(seed=seed)[0].tolist() for seed in range(5)] == [
        lqr.starts[i].astype(np.float32).tolist() for i in (0, 1, 2, 3, 0)
    ]


# ----------------------------------------------------------------------------------------------------------- the score


@pytest.mark.parametrize("task_name", TASKS)
def test_the_exact_front_scores_1_and_0(task_name):
    exact = exact_front_of(task_name)
    share, distance = score(exact, exact)
    assert share == 1
    assert distance == 0
    assert preference_regret(exact, grid_of(task_name)) <= 1e-4  # each preference's own value is its best


@pytest.mark.parametrize("task_name", TASKS)
def test_less_of_the_front_scores_lower(task_name):
    exact = exact_front_of(task_name)
    fewer, worse = score(exact[::3], exact), score(exact - 0.1 * np.ptp(exact, axis=0), exact)
    assert fewer[0] < 1
    assert worse[0] < 1
    assert fewer[1] > 0
    assert worse[1] > 0
    share, _ = score(exact.min(axis=0)[None], exact)
    assert 0 < share < 0.02  # the nadir alone covers the 5 % margin
    # In units of each axis' range, so that the units of a reward do not count.
    units = 10.0 ** np.arange(exact.shape[1])
    assert score(exact[1:] * units, exact * units) == pytest.approx(score(exact[1:], exact))


class ExactPolicy:
    """The best action for the preference in the observation."""

    def __init__(self, task_name: str):
        self.env = TASKS[task_name].make()
        self.gain = lru_cache(lambda w: LinearQuadraticRegulator().gain(np.array(w)))

    def predict(self, observation, *, deterministic=True):
        if isinstance(self.env, QuadraticBandit):
            return (observation[:, 1:] @ self.env.centres).astype(np.float32), None
        return np.array([-self.gain(tuple(row[2:].tolist())) @ row[:2] for row in observation], dtype=np.float32), None


@pytest.mark.parametrize("task_name", TASKS)
def test_the_best_policy_scores_1_and_0_through_evaluate_front(task_name):
    share, distance = score_policy(ExactPolicy(task_name), TASKS[task_name])
    assert share == pytest.approx(1, abs=1e-5)
    assert distance == pytest.approx(0, abs=1e-5)


# The shares that an untrained policy must stay below; a trained one must reach Task.share.
@pytest.mark.parametrize(
    ("task_name", "share", "distance"),
    [("bandit, 2 objectives", 0.88, 0.10), ("bandit, 3 objectives", 0.60, 0.2), ("LQR", 0.01, 0.5)],
)
def test_policies_that_learned_nothing_score_far_below(task_name, share, distance):
    untrained = floors(TASKS[task_name])
    assert set(untrained) == {"random", "best constant action"}
    for floor_share, floor_distance in untrained.values():
        assert floor_share <= share < TASKS[task_name].share
        assert floor_distance >= distance


def test_standing_still_is_no_solution():
    for task_name, task in TASKS.items():
        still = ZeroActionPolicy(task.make().action_space)
        front = evaluate_front(still, task.make, preferences=grid_of(task_name), n_episodes=task.n_episodes, gamma=GAMMA)
        assert len(np.unique(front.values, axis=0)) == 1
        assert score(front.discounted_returns.mean(axis=1), exact_front_of(task_name))[0] < task.share - 0.2


# Seeds 0 to 2 reach 0.94 to 1.00 and 0.05 to 0.01; random actions 0.82 and 0.12, the best constant one 0.69 and 0.39.
@pytest.mark.parametrize("vector_values", [False, True], ids=["scalarised", "vector"])
@pytest.mark.parametrize("critic_loss", ["ce", "mse"])
@pytest.mark.parametrize("policy", MOMBA.policy_aliases)
def test_a_short_training_comes_near_the_exact_front(policy, critic_loss, vector_values):
    share, distance = train_and_score("bandit, 2 objectives", 1_500, 1, policy, critic_loss, vector_values)
    assert share >= 0.92
    assert distance <= 0.08
