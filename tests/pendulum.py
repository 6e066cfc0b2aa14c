"""Pendulum as a plain single-objective task: `python -m tests.pendulum` trains three seeds of 10,000 steps."""

import logging
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import torch as th

from sb3_momba import MOMBA, evaluate_front

THRESHOLD = -250  # mean return of 3 seeds x 20 episodes


def train(seed: int, steps: int = 10_000) -> float:
    """Mean return of 20 episodes after training."""
    th.set_num_threads(1)
    sizes = {"actor_hidden_dim": 64, "critic_hidden_dim": 64}
    model = MOMBA("SimbaPolicy", "Pendulum-v1", 1e-3, learning_starts=500, ent_coef="auto_0.01", policy_kwargs=sizes, seed=seed)
    model.learn(steps)
    return float(evaluate_front(model, "Pendulum-v1", n_episodes=20, seed=1_000).values.mean())


def main() -> None:
    logging.disable(logging.WARNING)
    with ProcessPoolExecutor(2) as pool:
        returns = list(pool.map(train, range(3)))
    print(f"Pendulum-v1, mean return of 20 episodes: {np.round(returns, 1)}, mean {np.mean(returns):.1f} (above {THRESHOLD})")


if __name__ == "__main__":
    main()
