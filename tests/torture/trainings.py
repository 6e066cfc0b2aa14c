"""Trainings small enough to be made by the hundred."""

from pathlib import Path
from typing import Any

from stable_baselines3 import SAC

from sb3_momba import MOMBA, make_mo_vec_env
from tests.stubs import TINY_SIMBA

TASK = "MO-Hopper-v4"
LEARNING_STARTS = 10  # steps of each environment
ROWS = 30  # of the replay buffer, which goes round several times
SAVE_FREQ = 10


def new_model(task: str = TASK, n_envs: int = 1, seed: int = 0) -> MOMBA:
    """Networks of a few hundred parameters and a small replay buffer, as many updates as steps."""
    return MOMBA("SimbaPolicy", policy_kwargs=TINY_SIMBA, seed=seed, **small_and_short(task, n_envs))


def new_sac(task: str = TASK, n_envs: int = 1) -> SAC:
    """The like for Stable-Baselines3, on the same environments, whose reward is scalarised."""
    return SAC("MlpPolicy", policy_kwargs={"net_arch": [8, 8]}, seed=0, **small_and_short(task, n_envs))


def resumed(folder: Path, task: str = TASK, n_envs: int = 1) -> MOMBA:
    return MOMBA.resume(folder, make_mo_vec_env(task, n_envs), device="cpu")


def small_and_short(task: str, n_envs: int) -> dict[str, Any]:
    return {
        "env": make_mo_vec_env(task, n_envs),
        "learning_starts": LEARNING_STARTS * n_envs,
        "batch_size": 16,
        "buffer_size": ROWS * n_envs,
        "gradient_steps": -1,
        "device": "cpu",
    }
