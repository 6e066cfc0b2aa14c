"""What the adapters of morl-baselines share: its import, its hyperparameters, steps that are counted."""

import contextlib
import os
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import gymnasium as gym
from stable_baselines3.common.utils import set_random_seed

from sb3_momba.zoo.configuration import defaults

# Of the constructors: what the adapters decide, and what only logs.
NOT_FOR_USERS = (
    *("env", "env_id", "origin", "seed", "device"),
    *("log", "project_name", "experiment_name", "wandb_entity", "group"),
)


def imported(module: str) -> Any:
    """A module of morl-baselines.

    :raises ImportError: if it is not installed, naming the extra
    """
    try:
        return import_module(f"morl_baselines.{module}")
    except ImportError as error:
        raise ImportError(
            f'This baseline needs morl-baselines ({error}): install it with pip install "sb3-momba[baselines]".'
        ) from error


def hyperparameters_of(cls: type, but: tuple[str, ...] = ()) -> dict[str, Any]:
    """The defaults of a constructor's arguments.

    :param but: further ones that are not for users
    """
    return defaults(cls, (*NOT_FOR_USERS, *but))


@contextlib.contextmanager
def quiet_and_seeded(seed: int) -> Iterator[None]:
    """The library prints every number, and draws from the global random streams of Python, NumPy and torch."""
    set_random_seed(seed)
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        yield


class CountedSteps(gym.Wrapper[Any, Any, Any, Any]):
    """Counts the steps of an environment over all episodes.

    :param before_step: called before each step
    """

    def __init__(self, env: gym.Env, before_step: Callable[[], None] = lambda: None):
        super().__init__(env)
        self.before_step = before_step
        self.n_steps = 0

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self.before_step()
        self.n_steps += 1
        return self.env.step(action)
