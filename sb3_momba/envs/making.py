"""Environments from ids and callables, alone or vectorised, in PreferenceWrapper and Monitor."""

import contextlib
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import mo_gymnasium  # noqa: F401  registers its environments' ids
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_momba.envs.preferences import PreferenceSampler, SamplerSpec, preference_dim
from sb3_momba.envs.spaces import check_spaces
from sb3_momba.envs.workers import WatchedSubprocVecEnv
from sb3_momba.envs.wrappers import PreferenceWrapper

EnvLike = str | gym.Env | Callable[[], gym.Env]


def make_env(env: EnvLike, env_kwargs: dict[str, Any] | None = None, render_mode: str | None = None) -> gym.Env:
    """An environment from its id, from a callable, or itself. Ids are made without Gymnasium's checker, which does not
    know vector rewards.

    :param render_mode: for an id, where its environment takes one
    """
    if isinstance(env, str):
        try:
            if render_mode is not None:
                with contextlib.suppress(TypeError), warnings.catch_warnings():
                    warnings.filterwarnings("ignore", "(?s).*render_mode", UserWarning)  # It need not have this one.
                    return gym.make(env, disable_env_checker=True, render_mode=render_mode, **(env_kwargs or {}))
            return gym.make(env, disable_env_checker=True, **(env_kwargs or {}))
        except gym.error.UnregisteredEnv as error:
            if ":" in env:
                raise
            raise type(error)(
                f"{str(error).rstrip('.')}. If it is your own, name the module that registers it too: 'my_module:{env}'."
            ) from error
        except TypeError as error:
            if not env_kwargs:
                raise
            raise ValueError(f"{env} cannot be made with env_kwargs={env_kwargs}: {str(error).rstrip('.')}.") from error
    if isinstance(env, gym.Env):
        if env_kwargs:
            raise ValueError("env_kwargs go with an id or a callable; this environment exists already.")
        return env
    return env(**(env_kwargs or {}))


def wrap_env(env: gym.Env, preference_sampler: PreferenceSampler | SamplerSpec | None = None) -> Monitor:
    """`Monitor(PreferenceWrapper(env))`, unless both are there already."""
    has_monitor, has_preference = is_wrapped(env, Monitor), is_wrapped(env, PreferenceWrapper)
    if has_preference and preference_sampler is not None:
        env.get_wrapper_attr("set_preference_sampler")(preference_sampler)
    if not has_preference:
        env = PreferenceWrapper(env, preference_sampler)
    return env if has_monitor else Monitor(env)  # type: ignore[return-value]


def make_mo_vec_env(
    env: str | Callable[[], gym.Env],
    n_envs: int = 1,
    seed: int | None = None,
    preference_sampler: PreferenceSampler | SamplerSpec | None = None,
    env_kwargs: dict[str, Any] | None = None,
    vec_env_cls: type[DummyVecEnv] | type[SubprocVecEnv] = DummyVecEnv,
    vec_env_kwargs: dict[str, Any] | None = None,
) -> VecEnv:
    """Several copies of a vector-reward environment, each `Monitor(PreferenceWrapper(env))`.

    SB3's `make_vec_env(wrapper_class=...)` would put the wrapper outside Monitor, where vector rewards cannot pass.

    Observations are [s, w], float32 (n_envs, observation_dim + preference_dim); rewards w . r, (n_envs,), each r in its
    environment's info as `vector_reward`, (n_objectives,).

    :param env: id or callable that makes a new environment
    :param n_envs: copies, at least one
    :param seed: environment i starts with seed + i
    :param preference_sampler: for every copy; each has its own random stream
    :param env_kwargs: of the id or the callable
    :param vec_env_cls: with SubprocVecEnv, processes are watched over: see WatchedSubprocVecEnv
    :param vec_env_kwargs: of its constructor
    :raises ValueError: for an environment that exists already, n_envs below 1, or what PreferenceWrapper refuses
    :raises WorkerError: with SubprocVecEnv, where a process raises an error or dies
    """
    if isinstance(env, gym.Env):
        raise ValueError("make_mo_vec_env needs an id or a callable that makes new environments, not one environment.")

    if n_envs < 1:
        raise ValueError(f"n_envs={n_envs}: at least one environment is needed.")

    def maker(index: int) -> Callable[[], gym.Env]:
        def make() -> gym.Env:
            wrapped = wrap_env(make_env(env, env_kwargs), preference_sampler)
            wrapped.get_wrapper_attr("set_env_index")(index)
            return wrapped

        return make

    vec_env_cls = WatchedSubprocVecEnv if vec_env_cls is SubprocVecEnv else vec_env_cls
    venv = vec_env_cls([maker(i) for i in range(n_envs)], **(vec_env_kwargs or {}))
    if seed is not None:
        venv.seed(seed)
    return venv


def check_vec_env(venv: VecEnv) -> None:
    """A VecEnv that MOMBA can train on: every environment in a PreferenceWrapper, or every one scalar.

    :raises ValueError: naming what is missing or differs
    """
    check_spaces(venv.observation_space, venv.action_space)
    wrapped = venv.env_is_wrapped(PreferenceWrapper)
    if all(wrapped):
        for index in range(venv.num_envs):
            venv.env_method("set_env_index", index, indices=[index])
        n_objectives = venv.get_attr("n_objectives")
        if len(set(n_objectives)) > 1:
            raise ValueError(f"The environments of this VecEnv differ in their numbers of objectives: {n_objectives}.")
        inside = venv.get_attr("raw_shape")[0][0] + preference_dim(n_objectives[0])
        if venv.observation_space.shape != (inside,):
            raise ValueError(
                f"A wrapper outside PreferenceWrapper changes [observation, preference] from ({inside},) to "
                f"{venv.observation_space.shape}: put it inside, as in Monitor(PreferenceWrapper(YourWrapper(env)))."
            )
    elif any(wrapped) or venv.has_attr("reward_space"):
        raise ValueError(
            "This VecEnv has vector rewards without PreferenceWrapper: vector rewards do not pass through a VecEnv. Build it "
            "with sb3_momba.make_mo_vec_env, or give MOMBA the environment's id."
        )


def n_objectives_of(venv: VecEnv) -> int:
    """The number of objectives of a checked VecEnv; 1 where its environments are scalar."""
    return int(venv.get_attr("n_objectives", indices=[0])[0]) if all(venv.env_is_wrapped(PreferenceWrapper)) else 1
