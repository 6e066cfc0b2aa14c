"""What a run of a baseline is set to, and whether that can be."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

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
    elif name in RANGES and not RANGES[name][0] <= value <= RANGES[name][1]:
        raise ValueError(f"{name}={value!r}: it must be from {RANGES[name][0]} to {RANGES[name][1]}.")
