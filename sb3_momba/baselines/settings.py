"""What a run of a baseline is set to, and whether that can be."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch as th
from stable_baselines3.common.utils import get_device

from sb3_momba.pareto import protocol
from sb3_momba.settings import RANGES, check_switch, check_whole, is_number

ALGORITHMS = ("pgmorl", "gpi_ls", "dpmorl")
# Rows of chapter 4: the algorithm, and what is not its default. UTD 1 is in figure 4.4; the parameters of DPMORL in Table 4.2
# are those of policies that do not see the return so far.
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: (name, {}) for name in ALGORITHMS},
    "gpi_ls_utd_1": ("gpi_ls", {"gradient_updates": 1}),
    "dpmorl_state": ("dpmorl", {"augment_state": False}),
}
STEPS = {"gpi_ls": 200_000, "dpmorl": 10_000_000}  # Table 4.2; PGMORL's depend on the task, see `schedules.py`
INTERVALS = {**RANGES, "gae_lambda": (0, 1), "alpha": (0, 1)}  # of numbers that are not whole, ends included
AT_LEAST_0 = ("policy_noise", "noise_clip", "ent_coef", "vf_coef")
ABOVE_0 = ("learning_rate", "clip_range", "clip_coef", "max_grad_norm", "target_kl", "min_priority")
LEAST = {"learning_starts": 0, "batch_size": 2}  # of whole numbers; 1 of others


@dataclass
class BaselineSettings:
    """One training run.

    :param algorithm: one of `ALGORITHMS`
    :param env: id of a task with a vector reward
    :param output: the run's folder; must not hold a run already
    :param steps: environment steps of the training, over all policies and environments
    :param label: the method's name in its record and in reports; the algorithm's by default
    :param hyperparameters: of the algorithm, where they are not its defaults
    :param eval_freq: environment steps between evaluations
    :param n_preferences: of the protocol
    :param n_episodes: of each evaluation of a policy, under each preference
    :param reference_point: of the hypervolume; None: the task's in `pareto/protocol.py`
    """

    algorithm: str
    env: str
    output: str
    steps: int
    seed: int = 0
    label: str = ""
    hyperparameters: dict[str, Any] = field(default_factory=dict)
    env_kwargs: dict[str, Any] = field(default_factory=dict, init=False)  # The libraries make environments from ids alone.
    eval_freq: int = 50_000
    n_preferences: int = protocol.N_PREFERENCES
    n_episodes: int = protocol.N_EPISODES
    reference_point: list[float] | None = None
    device: str = "auto"

    def __post_init__(self) -> None:
        self.label = self.label or self.algorithm


def completed(algorithm: str, given: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """All hyperparameters of an algorithm: those given, and the defaults of the others.

    :raises ValueError: for a name that it does not take, or a value of another kind than the default
    """
    for name, value in given.items():
        if name not in defaults:
            raise ValueError(f"{algorithm} has no hyperparameter {name!r}; it takes {', '.join(sorted(defaults))}.")
        _check_kind(name, value, defaults[name])
    return {**defaults, **given}


def _check_kind(name: str, value: Any, default: Any) -> None:
    if isinstance(default, bool):
        check_switch(name, value)
    elif isinstance(default, int):
        check_whole(name, value, LEAST.get(name, 1))
    elif isinstance(default, list):
        if not isinstance(value, list) or not value:
            raise ValueError(f"{name}={value!r}: give a list such as {default}.")
        for entry in value:
            check_whole(name, entry, 1)
    elif not (is_number(value) or (default is None and value is None)):
        raise ValueError(f"{name}={value!r}: give a finite number.")
    elif value is not None:
        _check_range(name, value)


def _check_range(name: str, value: float) -> None:
    if name in INTERVALS and not INTERVALS[name][0] <= value <= INTERVALS[name][1]:
        raise ValueError(f"{name}={value!r}: it must be from {INTERVALS[name][0]} to {INTERVALS[name][1]}.")
    if name in AT_LEAST_0 and value < 0:
        raise ValueError(f"{name}={value!r}: it must be at least 0.")
    if name in ABOVE_0 and value <= 0:
        raise ValueError(f"{name}={value!r}: it must be above 0.")


def device_of(name: str) -> th.device:
    """As Stable-Baselines3 has it: "auto" is the GPU if there is one, and what asks for one that is not there gets the CPU.

    :raises ValueError: for a name of no device
    """
    try:
        return get_device(name)
    except RuntimeError as error:
        raise ValueError(f"device={name!r} is no device of torch ({error}): give auto, cpu or cuda.") from error
