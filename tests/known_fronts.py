"""Two tasks whose Pareto front is known exactly, and how near a trained model comes to it.

`python -m tests.known_fronts` trains every combination of architecture, critic loss and value representation and prints
the table of docs/results.md; `--help` says how to train fewer.
"""

import argparse
import itertools
import logging
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import LinearSchedule

from sb3_momba import MOMBA, evaluate_front, hypervolume, inverted_generational_distance
from sb3_momba.envs.preferences import preference_grid
from sb3_momba.pareto.floors import RandomPolicy

GAMMA = 0.9
N_PREFERENCES = {2: 30, 3: 36}
# Fewer atoms than by default: unit-norm weights let a 64-wide critic tell only so many atoms apart within 10,000 updates.
SMALL_SIMBA = {"actor_hidden_dim": 64, "critic_hidden_dim": 64, "actor_blocks": 1, "critic_blocks": 1, "n_atoms": 41}
SMALL_MLP = {"net_arch": [64, 64], "n_atoms": 41}
# Fast at first, so that the scalers grow; slow at last, so that the policy comes to rest.
LEARNING_RATE = LinearSchedule(4e-3, 2e-4, 1.0)


class QuadraticBandit(gym.Env[np.ndarray, np.ndarray]):
    """One step, r_i = 1 - |a - c_i|^2 with a in [-1, 1]^2: the best action for w is sum_i w_i c_i."""

    deterministic = True

    def __init__(self, n_objectives: int = 2):
        angles = 2 * np.pi * np.arange(n_objectives) / n_objectives + 0.3
        self.centres = 0.6 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        self.observation_space = spaces.Box(0, 1, (1,), np.float32)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.reward_space = spaces.Box(-np.inf, np.inf, (n_objectives,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        return np.ones(1, np.float32), {}

    def step(self, action: np.ndarray):
        return np.ones(1, np.float32), self.rewards(action[None])[0], True, False, {}

    def rewards(self, actions: np.ndarray) -> np.ndarray:
        """(n, 2) -> (n, n_objectives)."""
        return 1 - np.square(actions[:, None] - self.centres).sum(axis=-1)

    def exact_front(self, preferences: np.ndarray) -> np.ndarray:
        return self.rewards(preferences @ self.centres)


class LinearQuadraticRegulator(gym.Env[np.ndarray, np.ndarray]):
    """x' = A x + B u from four fixed starts, r_i = -(x.Q_i x + u.R_i u): reach 0 against spare the motors.

    The optimal policy for w is u = -K_w x, by the discounted Riccati equation of sum_i w_i Q_i and sum_i w_i R_i.
    """

    deterministic = False  # The seed chooses the start.
    horizon = 40
    bound = 2.2
    # Damped enough that the largest cost of a policy that knows nothing is a hundred times the best one's, not a thousand.
    a_matrix = np.array([[0.9, 0.2], [-0.2, 0.85]])
    b_matrix = np.array([[0.1], [0.5]])
    q_matrices = np.array([np.diag([1.0, 0.2]), np.diag([0.02, 0.02])])
    r_matrices = np.array([[[0.02]], [[1.0]]])
    starts = np.array([[1.0, 0.0], [-1.0, 0.0], [0.5, 0.8], [-0.5, -0.8]])

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-5, 5, (2,), np.float32)
        self.action_space = spaces.Box(-self.bound, self.bound, (1,), np.float32)
        self.reward_space = spaces.Box(-np.inf, 0, (2,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        start = seed if seed is not None else int(self.np_random.integers(len(self.starts)))
        self.x, self.t = self.starts[start % len(self.starts)].copy(), 0
        return self.x.astype(np.float32), {}

    def step(self, action: np.ndarray):
        u = np.clip(np.asarray(action, dtype=np.float64), -self.bound, self.bound)
        reward = -(np.einsum("i,oij,j->o", self.x, self.q_matrices, self.x) + np.einsum("i,oij,j->o", u, self.r_matrices, u))
        self.x = self.a_matrix @ self.x + self.b_matrix @ u
        self.t += 1
        return self.x.astype(np.float32), reward, False, self.t == self.horizon, {}

    def gain(self, preference: np.ndarray) -> np.ndarray:
        """K_w, by iterating the Riccati equation to its fixed point."""
        q, r = np.tensordot(preference, self.q_matrices, 1), np.tensordot(preference, self.r_matrices, 1)
        a, b, p = self.a_matrix, self.b_matrix, q
        for _ in range(500):
            k = np.linalg.solve(r + GAMMA * b.T @ p @ b, GAMMA * b.T @ p @ a)
            p = q + GAMMA * a.T @ p @ (a - b @ k)
        return k

    def exact_front(self, preferences: np.ndarray) -> np.ndarray:
        """Discounted returns over the horizon, mean of the starts, (P, 2)."""
        values = np.zeros((len(preferences), 2))
        for value, w in zip(values, preferences, strict=True):
            k = self.gain(w)
            for start in range(len(self.starts)):
                self.reset(seed=start)
                for t in range(self.horizon):
                    value += GAMMA**t * self.step(-k @ self.x)[1] / len(self.starts)
        return values


@dataclass(frozen=True)
class Task:
    make: Any
    n_objectives: int
    n_episodes: int
    steps: int
    share: float  # of the exact hypervolume that a trained model must reach
    settings: dict[str, Any] = field(default_factory=dict)  # of every model alike


TASKS = {
    "bandit, 2 objectives": Task(QuadraticBandit, 2, 1, 5_000, 0.98),
    "bandit, 3 objectives": Task(lambda: QuadraticBandit(3), 3, 1, 10_000, 0.98),
    "LQR": Task(LinearQuadraticRegulator, 2, 4, 10_000, 0.95, {"her": True}),
}


def score(values: np.ndarray, exact: np.ndarray) -> tuple[float, float]:
    """Share of the exact front's hypervolume (reference point: its nadir less 5 % of its range), and IGD on [0, 1] axes."""
    nadir, span = exact.min(axis=0), np.ptp(exact, axis=0)
    reference = nadir - 0.05 * span
    share = hypervolume(values, reference) / hypervolume(exact, reference)
    return share, inverted_generational_distance((values - nadir) / span, (exact - nadir) / span)


def train_and_score(task_name: str, steps: int | None, seed: int, policy: str, critic_loss: str, vector_values: bool):
    """(share of the exact hypervolume, IGD) of one model."""
    th.set_num_threads(1)
    task = TASKS[task_name]
    model = MOMBA(
        policy,
        task.make(),
        learning_rate=LEARNING_RATE,
        learning_starts=500,
        batch_size=256,
        gamma=GAMMA,
        critic_loss=critic_loss,
        vector_values=vector_values,
        ent_coef="auto_0.01",
        policy_kwargs=SMALL_MLP if policy == "MlpPolicy" else SMALL_SIMBA,
        seed=seed,
        **task.settings,
    )
    model.learn(steps or task.steps)
    return score_policy(model, task)


def score_policy(model: Any, task: Task) -> tuple[float, float]:
    """Discounted values of a policy against the exact front, at the same preferences."""
    grid = preference_grid(task.n_objectives, N_PREFERENCES[task.n_objectives])
    return score(discounted_values(model, task, grid), task.make().exact_front(grid))


def discounted_values(model: Any, task: Task, preferences: np.ndarray) -> np.ndarray:
    front = evaluate_front(model, task.make, preferences=preferences, n_episodes=task.n_episodes, gamma=GAMMA)
    return front.discounted_returns.mean(axis=1)


def floors(task: Task) -> dict[str, tuple[float, float]]:
    """Scores of random actions, and of the constant action with the largest hypervolume."""
    space = task.make().action_space
    grid = preference_grid(task.n_objectives, N_PREFERENCES[task.n_objectives])
    exact = task.make().exact_front(grid)
    actions = itertools.product(*(np.linspace(low, high, 21) for low, high in zip(space.low, space.high, strict=True)))
    constants = (score(discounted_values(_Constant(np.array(a)), task, grid[:1]), exact) for a in actions)
    return {
        "random": score_policy(RandomPolicy(space), task),
        "best constant action": max(constants, key=lambda c: (c[0], -c[1])),
    }


@dataclass
class _Constant:
    action: np.ndarray

    def predict(self, observation: np.ndarray, *, deterministic: bool = True):
        return np.tile(self.action.astype(np.float32), (len(observation), 1)), None


def main() -> None:
    logging.disable(logging.WARNING)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--policies", nargs="+", default=["SimbaPolicy", "MlpPolicy"], choices=MOMBA.policy_aliases)
    parser.add_argument("--critic-losses", nargs="+", default=["ce", "mse"])
    parser.add_argument("--vector-values", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--steps", type=int, help="by default the task's")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    print("| task | model | hypervolume, share of exact: mean (lowest) | IGD: mean (largest) |\n|---|---|---|---|", flush=True)
    with ProcessPoolExecutor(given.processes) as pool:
        for name in given.tasks:
            for floor, (share, igd) in floors(TASKS[name]).items():
                print(f"| {name} | {floor} | {share:.3f} | {igd:.3f} |", flush=True)
            cells = list(itertools.product(given.policies, given.critic_losses, map(bool, given.vector_values)))
            futures = {
                cell: [pool.submit(train_and_score, name, given.steps, seed, *cell) for seed in range(given.seeds)]
                for cell in cells
            }
            for (policy, loss, vector), runs in futures.items():
                share, igd = np.array([run.result() for run in runs]).T
                label = f"{policy}, {loss}, {'vector' if vector else 'scalarised'}"
                print(
                    f"| {name} | {label} | {share.mean():.3f} ({share.min():.3f}) | {igd.mean():.3f} ({igd.max():.3f}) |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
