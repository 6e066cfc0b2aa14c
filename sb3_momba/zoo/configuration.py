"""Reading hyperparameters from yaml in rl_zoo3's format. Values are literals: nothing is evaluated."""

import inspect
from collections.abc import Container
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from sb3_momba.momba import MOMBA
from sb3_momba.policies import MombaPolicy
from sb3_momba.settings import check_policy_kwargs, check_whole, nearest, parameters, policy_parameters

SHIPPED = resources.files("sb3_momba.zoo") / "hyperparams"
RUN_KEYS = ("n_timesteps", "policy", "n_envs", "normalize")
POLICIES = MOMBA.policy_aliases
NOT_FOR_CONFIGURATIONS = {
    *("self", "policy", "env", "seed", "tensorboard_log", "verbose", "device", "_init_setup_model", "others"),
}


@dataclass
class Configuration:
    """One entry of a yaml file."""

    policy: str
    hyperparameters: dict[str, Any]
    n_timesteps: int | None = None
    n_envs: int = 1


def shipped_configurations() -> list[str]:
    """Names of the files that come with the package."""
    return sorted(file.name.removesuffix(".yml") for file in SHIPPED.iterdir() if file.name.endswith(".yml"))


def read_configuration(name: str, env_id: str) -> Configuration:
    """The entry of an environment in a yaml file, or the file's `default`.

    :param name: path of a yaml file, or name of a shipped one, such as "capql"
    :raises ValueError: for a missing file or entry, and for unknown keys, with the nearest known name
    """
    if name in shipped_configurations():
        text = (SHIPPED / f"{name}.yml").read_text()
    elif Path(name).is_file():
        text = Path(name).read_text()
    else:
        raise ValueError(
            f"{name!r} is neither a yaml file nor a shipped configuration{nearest(name, shipped_configurations())}"
        )
    try:
        entries = yaml.safe_load(text)
    except yaml.YAMLError as error:
        said = " ".join(str(error).split())
        raise ValueError(f"{name} is not valid yaml, or asks for Python objects: {said}") from error
    entry = entries.get(env_id, entries.get("default")) if isinstance(entries, dict) else None
    if not isinstance(entry, dict):
        raise ValueError(f"{name} has no entry {env_id!r} and no 'default'.")
    entry = literal(entry)
    if entry.pop("normalize", False):
        raise ValueError(f"{name}: normalize must be false: the policy normalises observations and rewards itself.")
    policy = entry.pop("policy", "SimbaPolicy")
    n_timesteps, n_envs = entry.pop("n_timesteps", None), entry.pop("n_envs", 1)
    for key, value in (("n_timesteps", n_timesteps), ("n_envs", n_envs)):
        if value is not None:  # yaml's 1e6 is a float
            check_whole(f"{name}: {key}", int(value) if isinstance(value, float) and value.is_integer() else value, 1)
    check_hyperparameters(policy, entry)
    return Configuration(policy, entry, None if n_timesteps is None else int(n_timesteps), n_envs)


def literal(value: Any) -> Any:
    """A yaml value in which numbers such as 1e-3, strings to yaml 1.1, are numbers."""
    if isinstance(value, dict):
        return {key: literal(item) for key, item in value.items()}
    if isinstance(value, list):
        return [literal(item) for item in value]
    if isinstance(value, str):
        try:
            number = float(value)
        except ValueError:
            return value
        return int(number) if number.is_integer() else number
    return value


def check_hyperparameters(policy: str, hyperparameters: dict[str, Any]) -> None:
    """:raises ValueError: for names that MOMBA or the policy do not take, with the nearest that they do"""
    if not isinstance(policy, str) or policy not in POLICIES:
        raise ValueError(f"The policy {policy!r} is not known{nearest(policy, POLICIES)}")
    known = [name for name in parameters(MOMBA) if name not in NOT_FOR_CONFIGURATIONS]
    for name in hyperparameters:
        if name not in known:
            raise ValueError(f"MOMBA has no hyperparameter {name!r}{nearest(name, [*known, *RUN_KEYS])}")
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


def defaults(cls: type, but: Container[str] = ()) -> dict[str, Any]:
    """The arguments of a constructor that have a default, with it."""
    arguments = inspect.signature(cls.__init__).parameters.values()  # type: ignore[misc]
    return {a.name: a.default for a in arguments if a.default is not inspect.Parameter.empty and a.name not in but}
