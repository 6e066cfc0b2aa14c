"""Reading hyperparameters from yaml in rl_zoo3's format. Values are literals: nothing is evaluated, and of what rl_zoo3
imports and calls by its name, only callbacks and wrappers are called."""

import inspect
import logging
import re
from collections.abc import Container, Iterator
from dataclasses import dataclass, field
from importlib import import_module, resources
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_momba.envs.registry import PREFIX, raw_id
from sb3_momba.momba import MOMBA
from sb3_momba.policy import MombaPolicy
from sb3_momba.recording import plain
from sb3_momba.settings import (
    OF_SAC,
    check_other_arguments,
    check_policy_kwargs,
    check_whole,
    nearest,
    parameters,
    policy_parameters,
)

SHIPPED = resources.files("sb3_momba.zoo") / "hyperparams"
RUN_KEYS = ("n_timesteps", "policy", "n_envs", "normalize", "env_kwargs", "callback")
# What only rl_zoo3 can do; `callback` is left to it too, but changes no model.
ZOO_KEYS = ("env_wrapper", "vec_env_wrapper", "frame_stack", "monitor_kwargs", "noise_type", "noise_std")
CALLED_BY_RL_ZOO3 = {"callback": BaseCallback, "env_wrapper": gym.Wrapper, "vec_env_wrapper": VecEnvWrapper}
EVALUATED_BY_RL_ZOO3 = ("policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs", "monitor_kwargs", "normalize")
LINEAR = "lin_"
WITH_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d{1,3}")
N_TIMESTEPS = 1_000_000  # where neither file nor command line says
POLICIES = MOMBA.policy_aliases
# What belongs to a run, not to a method: how the command line has it.
OF_A_RUN = {
    "policy": "give --architecture",
    "env": "give --env",
    "env_kwargs": "give --env-kwargs",
    "n_envs": "give --n-envs",
    "n_timesteps": "give --steps",
    "seed": "give --seed",
    "device": "give --device",
    "tensorboard_log": "a run's folder has its logs",
    "verbose": "a run's folder has its logs",
}
NOT_FOR_CONFIGURATIONS = {*OF_A_RUN, "self", "_init_setup_model", "others"}

logger = logging.getLogger(__name__)


@dataclass
class Configuration:
    """One entry of a yaml file."""

    policy: str
    hyperparameters: dict[str, Any]
    n_timesteps: int | None = None
    n_envs: int = 1
    env_kwargs: dict[str, Any] = field(default_factory=dict)


def shipped_configurations() -> list[str]:
    """Names of the files that come with the package."""
    return sorted(file.name.removesuffix(".yml") for file in SHIPPED.iterdir() if file.name.endswith(".yml"))


def find_file(name: str) -> Path:
    """The yaml file of a path, or of a shipped configuration's name.

    :raises ValueError: for neither, with the nearest shipped name
    """
    if name in shipped_configurations():
        return Path(str(SHIPPED / f"{name}.yml"))
    if not Path(name).is_file():
        known = nearest(name, shipped_configurations())
        raise ValueError(f"{name!r} is neither a yaml file nor a shipped configuration{known}")
    return Path(name)


def find_entry(name: str, env_id: str) -> tuple[str, dict[str, Any]]:
    """The key and the values of an environment's entry in a yaml file: its id as given, raw, with `momba/`, or `default`.

    :param name: path of a yaml file, or name of a shipped one, such as "capql"
    :raises ValueError: for a file that is no yaml, or has no entry
    """
    file = find_file(name)
    try:
        entries = yaml.safe_load(file.read_text())
    except (yaml.YAMLError, ValueError) as error:
        said = " ".join(str(error).split())
        raise ValueError(f"{name} is not valid yaml, or asks for Python objects: {said}") from error
    for key in (env_id, raw_id(env_id), PREFIX + raw_id(env_id), "default"):
        if isinstance(entries, dict) and isinstance(entries.get(key), dict):
            return key, entries[key]
    raise ValueError(f"{name} has no entry {env_id!r} and no 'default'.")


def read_configuration(name: str, env_id: str) -> Configuration:
    """The entry of an environment in a yaml file, or the file's `default`.

    :param name: path of a yaml file, or name of a shipped one, such as "capql"
    :raises ValueError: for a missing file or entry, and for unknown keys, with the nearest known name
    """
    _, found = find_entry(name, env_id)
    try:
        entry = check_entry(found)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    for key in ZOO_KEYS:
        if entry.get(key) is not None:
            raise ValueError(f"{name}: {key} needs rl_zoo3: train with python -m sb3_momba.zoo train, or leave it out.")
    if entry.get("callback"):
        logger.warning("%s: callback is left to python -m sb3_momba.zoo; here --eval-freq and its like say what is done.", name)
    hyperparameters = {key: value for key, value in entry.items() if key not in (*RUN_KEYS, *ZOO_KEYS)}
    return Configuration(
        entry["policy"], hyperparameters, entry.get("n_timesteps"), entry.get("n_envs", 1), entry.get("env_kwargs") or {}
    )


def check_entry(entry: dict[str, Any]) -> dict[str, Any]:
    """An entry of a yaml file with numbers for numbers and the default policy.

    :raises ValueError: for what cannot be, and for unknown keys, with the nearest known name
    """
    entry = {"policy": "SimbaPolicy", **literal(entry)}
    for key in EVALUATED_BY_RL_ZOO3:
        if isinstance(entry.get(key), str):
            raise ValueError(f"{key}={entry[key]!r} is Python code, and nothing is evaluated: write a mapping.")
    if entry.get("normalize"):
        raise ValueError("normalize must be false: the policy normalises observations and rewards itself.")
    for key in ("n_timesteps", "n_envs"):
        if key in entry:
            if isinstance(entry[key], float) and entry[key].is_integer():  # !!float 1e6
                entry[key] = int(entry[key])
            check_whole(key, entry[key], 1)
    own = {key: value for key, value in entry.items() if key not in (*RUN_KEYS, *ZOO_KEYS)}
    check_hyperparameters(entry["policy"], own)
    return entry


def named_classes(entry: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Each name of a class that rl_zoo3 would import and call, after its key."""
    for key in CALLED_BY_RL_ZOO3:
        given = entry.get(key)
        for one in given if isinstance(given, list) else [given]:
            for name in one if isinstance(one, dict) else [one]:
                if isinstance(name, str):
                    yield key, name


def check_classes(entry: dict[str, Any]) -> None:
    """That what a checked entry names is what rl_zoo3 takes it for. It is imported, which only rl_zoo3 needs.

    :raises ValueError: for what is not there, or is no class of its kind
    """
    for key, name in named_classes(entry):
        module, _, last = name.rpartition(".")
        try:
            found = getattr(import_module(module or name), last, None)
        except (ImportError, TypeError, ValueError) as error:  # the latter two for what is no name
            raise ValueError(f"{key}: {name!r} cannot be imported: {error}") from error
        base = CALLED_BY_RL_ZOO3[key]
        if not (isinstance(found, type) and issubclass(found, base)):
            raise ValueError(f"{key}: {name!r} is no subclass of {base.__name__}: give the full name of one.")


def with_schedules(hyperparameters: dict[str, Any]) -> dict[str, Any]:
    """A learning rate "lin_3e-4" falls linearly from 3e-4 to 0, as in rl_zoo3; "lin_3e-4_1e-4" from 3e-4 to 1e-4.

    :raises ValueError: for any other string
    """
    rate = hyperparameters.get("learning_rate")
    if not isinstance(rate, str):
        return hyperparameters
    ends = [number_in(part) for part in rate.removeprefix(LINEAR).split("_")]
    start, end = ends if len(ends) == 2 else (*ends, 0.0)[:2]
    if not rate.startswith(LINEAR) or len(ends) > 2 or start is None or end is None or start < end:
        raise ValueError(
            f"learning_rate={rate!r}: give a number of at least 0, or {LINEAR}3e-4 to fall from it to 0, {LINEAR}3e-4_1e-4 to "
            "fall to 1e-4."
        )
    return {**hyperparameters, "learning_rate": LinearSchedule(start, end, 1.0)}


def number_in(text: str) -> float | None:
    """A finite number of at least 0, if a text is one."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if 0 <= number < float("inf") else None


def literal(value: Any) -> Any:
    """A yaml value in which numbers such as 1e-3, strings to yaml 1.1, are numbers."""
    if isinstance(value, dict):
        return {key: literal(item) for key, item in value.items()}
    if isinstance(value, list):
        return [literal(item) for item in value]
    if isinstance(value, str) and WITH_EXPONENT.fullmatch(value):
        number = float(value)
        return int(number) if number.is_integer() else number
    return value


def check_hyperparameters(policy: str, hyperparameters: dict[str, Any]) -> None:
    """:raises ValueError: for names that MOMBA or the policy do not take, with the nearest that they do"""
    if not isinstance(policy, str) or policy not in POLICIES:
        raise ValueError(f"The policy {policy!r} is not known{nearest(policy, POLICIES)}")
    known = [name for name in parameters(MOMBA) if name not in NOT_FOR_CONFIGURATIONS]
    for name, value in hyperparameters.items():
        if name in OF_A_RUN or name in RUN_KEYS:
            raise ValueError(f"{name}={value!r} is no hyperparameter: {OF_A_RUN.get(name, 'only a yaml file has it')}.")
        if name in ZOO_KEYS:
            raise ValueError(f"{name}={value!r} needs rl_zoo3: write it into a yaml file for python -m sb3_momba.zoo train.")
        if name in OF_SAC:
            check_other_arguments({name: value}, known)
        elif name not in known:
            raise ValueError(f"MOMBA has no hyperparameter {name!r}{nearest(name, [*known, *RUN_KEYS, *ZOO_KEYS])}")
    check_policy_kwargs(POLICIES[policy], hyperparameters.get("policy_kwargs") or {})


def with_defaults(policy: str, hyperparameters: dict[str, Any]) -> dict[str, Any]:
    """Every argument of MOMBA and, under `policy_kwargs`, of its policy, as a run uses them."""
    policy_defaults = {**defaults(MombaPolicy), **defaults(POLICIES[policy])}
    return {
        **defaults(MOMBA, NOT_FOR_CONFIGURATIONS),
        **hyperparameters,
        "policy_kwargs": {
            **{name: value for name, value in policy_defaults.items() if name in policy_parameters(POLICIES[policy])},
            **(hyperparameters.get("policy_kwargs") or {}),
        },
    }


def with_later_settings(config: dict[str, Any]) -> dict[str, Any]:
    """A run's recorded settings; arguments of MOMBA that came after it have their defaults, which change nothing."""
    if config.get("policy") not in POLICIES or "hyperparameters" not in config:
        return config
    return {**config, "hyperparameters": plain(with_defaults(config["policy"], config["hyperparameters"]))}


def defaults(cls: type, but: Container[str] = ()) -> dict[str, Any]:
    """The arguments of a constructor that have a default, with it."""
    arguments = inspect.signature(cls.__init__).parameters.values()  # type: ignore[misc]
    return {a.name: a.default for a in arguments if a.default is not inspect.Parameter.empty and a.name not in but}
