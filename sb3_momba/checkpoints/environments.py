"""Environments brought back to where they were, in mid-episode too: the episode is played again from its beginning.

What an environment does is decided by the state of its random numbers at the reset and by the actions since. Both are noted
by PreferenceWrapper. Where the episode does not come out as it was (an environment with other sources of randomness), it
ends instead, as truncated, and that is said.
"""

import warnings
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.random import MT19937, PCG64, PCG64DXSM, SFC64, Philox
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_momba.envs.wrappers import LONGEST_REPLAY, PreferenceWrapper


def states_of(env: VecEnv) -> list[dict[str, Any]] | None:
    """Of each environment, what `bring_back` needs; None where they are not ours to ask."""
    if not all(env.env_is_wrapped(PreferenceWrapper)):
        return None
    return list(env.env_method("episode_so_far"))


def check(states: Any, n_objectives: int, action_space: spaces.Space[Any]) -> None:
    """What a file holds in the place of `states_of`.

    :raises TypeError: if it cannot be that, and other errors that content of a wrong type leads to
    """
    if states is None:
        return
    for state in states:
        for name in ("rng", "rng_now", "env_rng"):
            if name != "env_rng" or state[name] is not None:
                check_generator(state[name])
        if not (state["seed"] is None or type(state["seed"]) is int) or not isinstance(state["options"], dict | None):
            raise TypeError("an environment's reset has another seed or other options")
        shapes: dict[str, tuple[int, ...]] = {"preference": (n_objectives,), "vector_return": (n_objectives,)}
        if state["actions"] is not None and len(state["actions"]) > 0:
            shapes["actions"] = (len(state["actions"]), *(action_space.shape or ()))
        if "played" in state:
            shapes["played"] = (len(state["played"]), 2, n_objectives)
        for name, shape in shapes.items():
            if np.shape(state[name]) != shape or np.asarray(state[name]).dtype.kind not in "fiu":
                raise TypeError(f"an environment's {name} are no numbers of shape {shape}")


def check_generator(state: Any) -> None:
    """:raises TypeError: if it is no state of NumPy's random numbers"""
    kinds = {kind.__name__: kind for kind in (PCG64, PCG64DXSM, MT19937, Philox, SFC64)}
    try:
        kinds[state["bit_generator"]]().state = state
    except (ValueError, OverflowError) as error:
        raise TypeError(f"no state of random numbers: {error}") from error


def bring_back(
    env: VecEnv, states: list[dict[str, Any]] | None, observations: np.ndarray, replay: bool = True
) -> tuple[np.ndarray, list[int]]:
    """Play each running episode again.

    :param states: as `states_of` gave them
    :param observations: [s, w] where the training stopped, (n_envs, observation_dim + preference_dim)
    :param replay: False resets all environments instead
    :return: [s, w] to go on from, like observations, and the environments whose episodes end instead
    """
    env._reset_seeds()
    env._reset_options()
    if isinstance(env, VecEnvWrapper) or not replay:
        for index, state in enumerate(states or []):
            (given,) = env.env_method("begin_replay", state, indices=[index])
            env.unwrapped._seeds[index], env.unwrapped._options[index] = given["seed"], given["options"] or {}
        if replay:
            _warn(list(range(env.num_envs)), f"{type(env).__name__} around them has a state of its own.")
        return np.asarray(env.reset()), list(range(env.num_envs))
    observations, lost = observations.copy(), []
    for index in range(env.num_envs):
        if states is not None:
            reached = _replay(env, index, states[index])
            if reached is not None and all(map(np.array_equal, reached, (observations[index], states[index]["vector_return"]))):
                continue
        lost.append(index)
        observations[index] = env.env_method("reset", indices=[index])[0][0]
    if lost and states is None:
        _warn(lost, "They are not in a PreferenceWrapper.")
    elif lost:
        _warn(
            lost,
            "They have randomness outside np_random, state that a reset does not set, or an episode of more than "
            f"{LONGEST_REPLAY:,} steps.",
        )
    return observations, lost


def _warn(lost: list[int], why: str) -> None:
    warnings.warn(
        f"Environments {lost} could not be brought back to where they were: their episodes end here, as truncated, and what "
        f"follows differs from an undisturbed run. {why}",
        stacklevel=5,
    )


def _replay(env: VecEnv, index: int, state: dict[str, Any]) -> tuple[np.ndarray, np.ndarray] | None:
    """[s, w] at the end of the episode so far, and its vector return; None where it ended earlier or was not noted."""
    (seed_and_options,) = env.env_method("begin_replay", state, indices=[index])
    if state["actions"] is None:
        return None
    env.env_method("reset", **seed_and_options, indices=[index])
    for action in state["actions"]:
        ((_, _, terminated, truncated, _),) = env.env_method("step", action, indices=[index])
        if terminated or truncated:
            env.env_method("begin_replay", state, indices=[index])  # This episode was not played.
            return None
    (reached,) = env.env_method("end_replay", state, indices=[index])
    return reached[0], reached[1]
