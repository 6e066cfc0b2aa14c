"""Gymnasium ids whose environments carry PreferenceWrapper, `momba/<id>` beside the raw ones, and environments made anew.

`gymnasium.make("momba/mo-hopper-2obj-v5")` has the observation [s, w] and the reward w.r, a number: what makes environments
from ids alone, and wraps them into Monitor, can use it as any other. No environment's module is imported here.
"""

import copy
from collections.abc import Callable
from functools import partial

import gymnasium as gym
import mo_gymnasium  # noqa: F401  registers its environments' ids
from gymnasium.envs.registration import WrapperSpec
from stable_baselines3.common.vec_env import VecEnv

PREFIX = "momba/"
WRAPPER = WrapperSpec("PreferenceWrapper", "sb3_momba.envs.wrappers:PreferenceWrapper", {"preference_sampler": None})

TASKS = {
    "MO-Ant-v4": ("MOAnt", 500),
    "MO-HalfCheetah-v4": ("MOHalfCheetah", 500),
    "MO-Hopper-v4": ("MOHopper", 500),
    "MO-Hopper-3obj-v4": ("MOHopper3", 500),
    "MO-Humanoid-v4": ("MOHumanoid", 1000),
    "MO-Swimmer-v4": ("MOSwimmer", 500),
    "MO-Walker2d-v4": ("MOWalker2d", 500),
}
"""The seven tasks of Table 4.1: the class in `sb3_momba.envs.pgmorl`, and steps after which an episode is truncated."""

# MO-Gymnasium's tasks with one-dimensional observations and continuous actions.
CONTINUOUS = (
    *("mo-ant-v4", "mo-ant-v5", "mo-ant-2d-v4", "mo-ant-2obj-v5", "mo-halfcheetah-v4", "mo-halfcheetah-v5"),
    *("mo-hopper-v4", "mo-hopper-v5", "mo-hopper-2d-v4", "mo-hopper-2obj-v5", "mo-humanoid-v4", "mo-humanoid-v5"),
    *("mo-lunar-lander-continuous-v3", "mo-mountaincarcontinuous-v0", "mo-swimmer-v4", "mo-swimmer-v5"),
    *("mo-walker2d-v4", "mo-walker2d-v5", "water-reservoir-v0"),
)
_raw_ids: dict[str, str] = {}
NEEDED_ARGUMENTS = {"water-reservoir-v0": {"normalized_action": True}}  # Its actions have no bounds otherwise.


def preference_id(env_id: str) -> str:
    """The id of the same task inside PreferenceWrapper, registered if it was not yet.

    :param env_id: of any registered environment; one that has the wrapper already stays as it is, and so does an id that
        nobody knows
    """
    if env_id not in gym.registry:
        return env_id
    spec = gym.registry[env_id]
    if any(wrapper.name == WRAPPER.name for wrapper in spec.additional_wrappers):
        return env_id
    wrapped_id = PREFIX + env_id.replace("/", ".")  # An id has one namespace.
    _raw_ids[wrapped_id] = env_id
    if wrapped_id not in gym.registry:
        gym.register(
            wrapped_id,
            entry_point=spec.entry_point,
            reward_threshold=spec.reward_threshold,
            nondeterministic=spec.nondeterministic,
            max_episode_steps=spec.max_episode_steps,
            order_enforce=spec.order_enforce,
            disable_env_checker=True,  # It does not know vector rewards.
            additional_wrappers=(*spec.additional_wrappers, WRAPPER),
            kwargs={**spec.kwargs, **NEEDED_ARGUMENTS.get(env_id, {})},
        )
    return wrapped_id


def raw_id(env_id: str) -> str:
    """The task's own id: "momba/mo-hopper-2obj-v5" -> "mo-hopper-2obj-v5"; any other id as it is."""
    return _raw_ids.get(env_id, env_id.removeprefix(PREFIX))


def copies_of(venv: VecEnv) -> Callable[[], gym.Env]:
    """A function that makes environments such as the first one of a VecEnv, with all its wrappers but Monitor, and without
    a window.

    :raises ValueError: if Gymnasium did not make that one, or a wrapper cannot be made anew
    """
    spec = venv.get_attr("spec", indices=[0])[0]
    if spec is None:
        raise ValueError("The environment has no spec to make another one from: gymnasium.make did not make it.")
    spec = copy.copy(spec)
    spec.additional_wrappers = tuple(wrapper for wrapper in spec.additional_wrappers if wrapper.name != "Monitor")
    spec.kwargs = {name: value for name, value in spec.kwargs.items() if name != "render_mode"}
    for wrapper in spec.additional_wrappers:
        if wrapper.kwargs is None:
            raise ValueError(
                f"{spec.id} has a wrapper that cannot be made anew: {wrapper.name} does not inherit from "
                "gymnasium.utils.RecordConstructorArgs."
            )
    return partial(gym.make, spec, disable_env_checker=True)


for _task, (_class, _steps) in TASKS.items():
    if _task not in gym.registry:
        gym.register(
            _task,
            entry_point=f"sb3_momba.envs.pgmorl:{_class}",
            max_episode_steps=_steps,
            disable_env_checker=True,  # It does not know vector rewards.
        )
for _task in (*CONTINUOUS, *TASKS):
    preference_id(_task)
