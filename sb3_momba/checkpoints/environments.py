"""Environments brought back to where they were, in mid-episode too: the episode is played again from its beginning.

What an environment does is decided by the state of its random numbers at the reset and by the actions since. Both are noted
by PreferenceWrapper. Where the episode does not come out as it was (an environment with other sources of randomness), it
ends instead, as truncated, and that is said.
"""

import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_momba.envs.wrappers import PreferenceWrapper


def states_of(env: VecEnv) -> list[dict[str, Any]] | None:
    """Of each environment, what `bring_back` needs; None where they are not ours to ask."""
    if not all(env.env_is_wrapped(PreferenceWrapper)):
        return None
    return list(env.env_method("episode_so_far"))


def bring_back(env: VecEnv, states: list[dict[str, Any]] | None, observations: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Play each running episode again.

    :param states: as `states_of` gave them
    :param observations: [s, w] where the training stopped, (n_envs, observation_dim + preference_dim)
    :return: [s, w] to go on from, like observations, and the environments whose episodes could not be brought back
    """
    env._reset_seeds()
    env._reset_options()
    observations, lost = observations.copy(), []
    for index in range(env.num_envs):
        if states is not None:
            reached = _replay(env, index, states[index])
            if reached is not None and np.array_equal(reached, observations[index]):
                continue
        lost.append(index)
        observations[index] = env.env_method("reset", indices=[index])[0][0]
    if lost:
        warnings.warn(
            f"Environments {lost} could not be brought back to where they were: their episodes end here, as truncated, and "
            "what follows differs from an undisturbed run. "
            + (
                "They are not in a PreferenceWrapper."
                if states is None
                else "They have randomness outside np_random, or state that a reset does not set."
            ),
            stacklevel=3,
        )
    return observations, lost


def _replay(env: VecEnv, index: int, state: dict[str, Any]) -> np.ndarray | None:
    """[s, w] at the end of the episode so far; None where it ended earlier or was too long to be noted."""
    if state["actions"] is None:
        return None
    (seed_and_options,) = env.env_method("begin_replay", state, indices=[index])
    env.env_method("reset", **seed_and_options, indices=[index])
    for action in state["actions"]:
        ((_, _, terminated, truncated, _),) = env.env_method("step", action, indices=[index])
        if terminated or truncated:
            return None
    (reached,) = env.env_method("end_replay", state, indices=[index])
    return np.asarray(reached)
