"""What an environment must declare: its objectives, observations and actions."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from mo_gymnasium.wrappers.wrappers import LinearReward
from stable_baselines3.common.env_util import is_wrapped

HOW_TO_DECLARE = (
    "if it has several objectives, declare them in the environment's __init__: "
    "self.reward_space = gymnasium.spaces.Box(-inf, inf, shape=(n_objectives,)), as MO-Gymnasium does"
)


def declared_reward_space(env: gym.Env) -> spaces.Box | None:
    """The environment's `reward_space`, wherever in its stack of wrappers it stands, or None."""
    if is_wrapped(env, LinearReward):
        return None  # MO-Gymnasium's own scalarisation, behind which the reward space still shows
    space = env.get_wrapper_attr("reward_space") if env.has_wrapper_attr("reward_space") else None
    if space is not None and (not isinstance(space, spaces.Box) or len(space.shape) != 1 or space.shape[0] < 1):
        raise ValueError(f"reward_space={space!r} is not a one-dimensional Box with an entry per objective.")
    return space


def count_objectives(env: gym.Env) -> int:
    """n_objectives of the declared `reward_space`, or 1."""
    space = declared_reward_space(env)
    return 1 if space is None else int(space.shape[0])


class UnsupportedSpaceError(ValueError, AssertionError):
    """Observations or actions that the policy does not know; SB3 raises AssertionError where it does not know a space."""


def check_spaces(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    """
    :raises UnsupportedSpaceError: where observations are not a one-dimensional Box, or actions not a bounded Box
    """
    if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
        raise UnsupportedSpaceError(
            f"The observation space {observation_space} is not a one-dimensional Box: flatten it with "
            "gymnasium.wrappers.FlattenObservation, images after a feature extractor of your own."
        )
    if not isinstance(action_space, spaces.Box):
        raise UnsupportedSpaceError(f"The action space {action_space} is not supported: continuous actions, a Box, are needed.")
    if action_space.dtype is None or action_space.dtype.kind != "f":
        raise UnsupportedSpaceError(
            f"The action space {action_space} has the dtype {action_space.dtype}: actions are continuous, and would be cut to "
            "whole numbers. Declare a float32 Box, and round inside the environment or an ActionWrapper."
        )
    if len(action_space.shape) != 1 or action_space.shape[0] == 0:
        raise UnsupportedSpaceError(
            f"The action space {action_space} has shape {action_space.shape}: flatten it to (n,) with an ActionWrapper."
        )
    low, high = action_space.low, action_space.high
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise UnsupportedSpaceError(
            f"The action space {action_space} has no finite bounds: MOMBA's policy covers [low, high]. Ask the environment for "
            "bounded actions (water-reservoir-v0: normalized_action=True) or put an ActionWrapper with a bounded Box around it."
        )
    if (low >= high).any():
        raise UnsupportedSpaceError(
            f"The action space {action_space} has low >= high in dimension {int((low >= high).argmax())}: leave a constant "
            "action out of the space with an ActionWrapper."
        )
