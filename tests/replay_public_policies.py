"""Replay recorded action sequences of published policies: `python -m tests.replay_public_policies FILE` prints a table.

FILE is an npz with, per task under its name of 2020, for `legacy` (physics 2020) and `modern` (current): `actions_*`
(sequences, steps, actions), `returns_*` (sequences, objectives), `cum_*` (sequences, checkpoints, objectives), the
cumulative returns after the numbers of steps in `checkpoints`, and `horizon_*` (sequences,), the last checkpoint that
rounding errors do not move.
"""

import argparse

import gymnasium as gym
import numpy as np

import sb3_momba  # noqa: F401  registers its environments' ids

IDS = {
    "MO-Hopper-v2": "MO-Hopper-v4",
    "MO-Hopper-v3": "MO-Hopper-3obj-v4",
    "MO-HalfCheetah-v2": "MO-HalfCheetah-v4",
    "MO-Swimmer-v2": "MO-Swimmer-v4",
    "MO-Walker2d-v2": "MO-Walker2d-v4",
    "MO-Ant-v2": "MO-Ant-v4",
}
PHYSICS = {"legacy": "2020", "modern": "current"}


def cumulative_returns(env: gym.Env, actions: np.ndarray) -> np.ndarray:
    """(steps, n_objectives); constant after the end of an episode."""
    env.reset(seed=0)
    rewards = np.zeros((len(actions), *env.get_wrapper_attr("reward_space").shape))
    for step, action in enumerate(actions):
        _, rewards[step], terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            break
    return rewards.cumsum(axis=0)


def relative_deviation(value: np.ndarray, reference: np.ndarray) -> float:
    """The largest |value - reference|, relative to |reference| but to no less than 1."""
    return float((np.abs(value - reference) / np.maximum(np.abs(reference), 1)).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", help="the recorded sequences, npz")
    with np.load(parser.parse_args().file) as file:
        recorded = dict(file)
    checkpoints = recorded["checkpoints"]
    print("| task | physics | sequences | largest deviation up to the horizon | deviation of the full return | horizons |")
    print("|---|---|---|---|---|---|")
    for name, task in IDS.items():
        for key, physics in PHYSICS.items():
            env = gym.make(task, physics=physics)
            up_to_horizon, full = [], []
            horizons = recorded[f"{name}/horizon_{key}"]
            for index, actions in enumerate(recorded[f"{name}/actions_{key}"]):
                returns = cumulative_returns(env, actions)
                reliable = checkpoints[checkpoints <= horizons[index]]
                expected = recorded[f"{name}/cum_{key}"][index, : len(reliable)]
                up_to_horizon.append(relative_deviation(returns[reliable - 1], expected))
                full.append(relative_deviation(returns[-1], recorded[f"{name}/returns_{key}"][index]))
            print(
                f"| {task} | {physics} | {len(full)} | {max(up_to_horizon):.1e} | {max(full):.1e} "
                f"| {', '.join(str(horizon) for horizon in horizons)} |"
            )


if __name__ == "__main__":
    main()
