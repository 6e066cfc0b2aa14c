"""Whether an environment of one's own is what a training needs."""

import inspect
import warnings
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.env_util import is_wrapped

from sb3_momba.envs.making import EnvLike, make_env
from sb3_momba.envs.spaces import declared_reward_space
from sb3_momba.envs.wrappers import PreferenceWrapper

LARGEST_RATIO = 1e3  # of the objectives' sizes
OURS = ("vector_reward", "preference")  # what PreferenceWrapper adds to a step's info


@dataclass
class Rollout:
    """What an environment gave under some actions.

    :param observations: those of resets among them, (n, observation_dim)
    :param rewards: (n_steps, n_objectives)
    """

    observations: np.ndarray
    rewards: np.ndarray
    n_episodes: int


def check_mo_env(
    env: EnvLike,
    n_steps: int = 1_000,
    seed: int = 0,
    env_kwargs: dict[str, Any] | None = None,
    reproducible: bool = True,
) -> None:
    """Run an environment with random actions and name what is wrong with it.

    Errors are what a training would stop at, or learn wrong things from: spaces, shapes, types, numbers that are not finite or
    outside of their space, randomness that a seed does not set. Warnings are what is allowed and seldom meant: episodes that
    never end, an objective that never changes, objectives of very different sizes.

    :param env: id, callable or environment, as its author wrote it: with its vector reward, without PreferenceWrapper
    :param n_steps: how long, over as many episodes as that takes
    :param seed: of the first reset and of the actions, uniform within their bounds
    :param env_kwargs: of an id or a callable; an environment that exists takes none
    :param reproducible: False for a machine, whose runs no seed repeats: it is run once, and not compared
    :raises ValueError: naming what is wrong, and the cure
    """
    made = make_env(env, env_kwargs)
    try:
        _check(made, n_steps, seed, reproducible)
    finally:
        if made is not env:
            made.close()


def _check(env: gym.Env, n_steps: int, seed: int, reproducible: bool) -> None:
    if is_wrapped(env, PreferenceWrapper):
        raise ValueError("This environment is in PreferenceWrapper already: check the one inside, which has the vector reward.")
    _check_interface(env.unwrapped, seed)
    wrapped = PreferenceWrapper(env)
    box = env.action_space
    assert isinstance(box, spaces.Box)
    actions = np.random.default_rng(seed).uniform(box.low, box.high, (n_steps, *box.shape)).astype(box.dtype)

    rollout = _run(wrapped, actions, seed)
    errors = _outside("observation_space", env.observation_space, rollout.observations)
    errors += _outside("reward_space", declared_reward_space(env), rollout.rewards)
    if reproducible and not _are_equal(rollout, _run(wrapped, actions, seed)):
        errors.append(
            "Two runs with the same seed and actions differ: draw random numbers from self.np_random alone, call "
            "super().reset(seed=seed) first, and let reset set every variable that step changes. Of a machine, which cannot "
            "be repeated, ask for reproducible=False."
        )
    elif getattr(env.unwrapped, "deterministic", False) and not _are_equal(rollout, _run(wrapped, actions, seed + 1)):
        errors.append("It declares deterministic = True, and another seed gives another run: leave the declaration out.")
    if errors:
        raise ValueError("\n- ".join([f"{type(env.unwrapped).__name__} is not ready for a training:", *errors]))
    for advice in _advice(env, rollout):
        warnings.warn(advice, stacklevel=3)


def _check_interface(env: gym.Env, seed: int) -> None:
    """What the environment has and returns, before any wrapper takes it apart."""
    for name in ("observation_space", "action_space"):
        if not isinstance(getattr(env, name, None), spaces.Space):
            raise ValueError(f"{type(env).__name__} has no {name}: set self.{name} = gymnasium.spaces.Box(...) in __init__.")
    arguments = inspect.signature(env.reset).parameters
    if not all(name in arguments for name in ("seed", "options")) and "kwargs" not in arguments:
        raise ValueError(
            f"reset takes {list(arguments)}: write def reset(self, *, seed=None, options=None), as Gymnasium has it."
        )
    start: Any = env.reset(seed=seed)
    if not (isinstance(start, tuple) and len(start) == 2):
        raise ValueError(f"reset returned {_in_short(start)}: return (observation, info).")
    step: Any = env.step(env.action_space.sample())
    if not (isinstance(step, tuple) and len(step) == 5):
        raise ValueError(f"step returned {_in_short(step)}: return (observation, reward, terminated, truncated, info).")
    for name, value in zip(("terminated", "truncated"), step[2:4], strict=True):
        if not isinstance(value, bool | np.bool_):
            raise ValueError(f"{name} is {value!r}: return True or False.")
    for info in (start[1], step[4]):
        if not isinstance(info, dict):
            raise ValueError(f"info is {_in_short(info)}: return a dictionary.")
        for name in OURS:
            if name in info:
                raise ValueError(f"info has an entry {name!r}, which PreferenceWrapper writes over: give it another name.")


def _run(env: PreferenceWrapper, actions: np.ndarray, seed: int) -> Rollout:
    """The wrapper itself raises errors for wrong shapes and types, and for numbers that are not finite."""
    observations, rewards, n_episodes = [env.reset(seed=seed)[0]], [], 0
    for action in actions:
        observation, _, terminated, truncated, info = env.step(action)
        observations.append(observation)
        rewards.append(info["vector_reward"])
        if terminated or truncated:
            n_episodes += 1
            observations.append(env.reset()[0])
    without_preference = np.array(observations)[:, : env.raw_shape[0]]
    return Rollout(without_preference, np.array(rewards), n_episodes)


def _outside(name: str, box: Any, values: np.ndarray) -> list[str]:
    """:param values: (n, entries of the box)"""
    if box is None:
        return []
    lowest, highest = values.min(axis=0), values.max(axis=0)
    wrong = [("low", i, box.low[i], lowest[i]) for i in np.flatnonzero(lowest < box.low)]
    wrong += [("high", i, box.high[i], highest[i]) for i in np.flatnonzero(highest > box.high)]
    return [
        f"{name}.{side}[{i}] is {bound:g}, and {seen:g} was seen: widen the space, or clip." for side, i, bound, seen in wrong
    ]


def _are_equal(one: Rollout, other: Rollout) -> bool:
    return np.array_equal(one.observations, other.observations) and np.array_equal(one.rewards, other.rewards)


def _advice(env: gym.Env, rollout: Rollout) -> list[str]:
    advice = []
    n_steps, has_limit = len(rollout.rewards), env.spec is not None and env.spec.max_episode_steps is not None
    if rollout.n_episodes == 0 and not has_limit:
        advice.append(
            f"No episode ended in {n_steps:,} steps, and there is no time limit: return truncated=True after some steps, or "
            "register the environment with max_episode_steps."
        )
    for objective in np.flatnonzero(np.ptp(rollout.rewards, axis=0) == 0):
        constant = rollout.rewards[0, objective]
        advice.append(f"Objective {objective} was {constant:g} at each of {n_steps:,} steps: random actions do not change it.")
    sizes = np.abs(rollout.rewards).mean(axis=0)
    large, small = sizes.argmax(), sizes.argmin()
    if 0 < sizes[small] < sizes[large] / LARGEST_RATIO:
        advice.append(
            f"Objective {large} is {sizes[large] / sizes[small]:,.0f} times as large as objective {small}: most preferences "
            "mean the larger one alone. Scale them to like sizes."
        )
    return advice


def _in_short(x: Any) -> str:
    return f"a tuple of {len(x)}" if isinstance(x, tuple) else f"a {type(x).__name__}"
