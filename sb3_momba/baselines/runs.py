"""Runs of baselines: an algorithm trains, is evaluated under the protocol while it does, and leaves a record in its folder."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sb3_momba.baselines.settings import ALGORITHMS, BaselineSettings
from sb3_momba.baselines.solutions import SolutionSet
from sb3_momba.envs.preferences import preference_grid
from sb3_momba.files import alone_in
from sb3_momba.pareto import protocol
from sb3_momba.pareto.callbacks import CLOCKS
from sb3_momba.pareto.evaluation import ParetoFront, probe_environment
from sb3_momba.pareto.metrics import hypervolume, summarise
from sb3_momba.recording import RecordWriter, plain
from sb3_momba.records import FILE_NAME
from sb3_momba.runs import append_floors, check_empty, description
from sb3_momba.settings import check_whole, nearest


class Baseline(Protocol):
    """An algorithm that is ready to train: `Baseline(settings, n_objectives)`, which raises a ValueError for what cannot be.

    :ivar general_policy: whether one policy answers all preferences
    :ivar hyperparameters: all of them, defaults included
    :ivar parameters: how many trainable ones each network of a policy has
    :ivar steps: of the training, so far
    :ivar extra_steps: that the algorithm had besides, in episodes of its own, so far
    """

    general_policy: bool
    hyperparameters: dict[str, Any]
    parameters: dict[str, int]

    @property
    def steps(self) -> int: ...

    @property
    def extra_steps(self) -> int: ...

    def train(self, between_steps: Callable[[], None]) -> None:
        """:param between_steps: called now and then while the policies are what these steps have made of them"""

    def evaluate(self, preferences: np.ndarray) -> ParetoFront | SolutionSet:
        """The policies of this moment, played on the raw environment."""

    def close(self) -> None: ...


@dataclass
class BaselineResult:
    """What a run left: metrics over time, those of policies that learned nothing, and its folder."""

    timesteps: list[int]
    metrics: list[dict[str, float]]
    floors: dict[str, dict[str, float]]
    folder: Path


class Curve:
    """Evaluates an algorithm while it trains, and appends what it finds to the run's record.

    :param reference_point: of the hypervolume, (n_objectives,)
    :param preferences: of the protocol, (P, n_objectives)
    """

    def __init__(
        self,
        baseline: Baseline,
        record: RecordWriter,
        eval_freq: int,
        preferences: np.ndarray,
        reference_point: Sequence[float],
    ):
        self.baseline = baseline
        self.record = record
        self.eval_freq = self.next_evaluation = eval_freq
        self.preferences = preferences
        self.reference_point = reference_point
        self.timesteps: list[int] = []
        self.metrics: list[dict[str, float]] = []
        self.evaluation_seconds = dict.fromkeys(CLOCKS, 0.0)
        self.started = {name: clock() for name, clock in CLOCKS.items()}

    def between_steps(self) -> None:
        """Evaluate, if `eval_freq` steps have passed."""
        if self.baseline.steps >= self.next_evaluation:
            self.evaluate()

    def finish(self) -> None:
        """The evaluation at the end, if it was not made, and the record's last line."""
        if self.timesteps[-1:] != [self.baseline.steps]:
            self.evaluate()
        self.record.finish(self.baseline.steps, vars(self.front), extra_steps=self.baseline.extra_steps)

    def evaluate(self) -> None:
        before = {name: clock() for name, clock in CLOCKS.items()}
        seconds = {name: round(before[name] - self.started[name] - self.evaluation_seconds[name], 3) for name in CLOCKS}
        steps = self.baseline.steps
        self.next_evaluation = (steps // self.eval_freq + 1) * self.eval_freq
        self.front = front = self.baseline.evaluate(self.preferences)
        measured = summarise(front.values, self.preferences, self.reference_point, self.baseline.general_policy)
        self.timesteps.append(steps)
        self.metrics.append(measured)
        for name, clock in CLOCKS.items():
            self.evaluation_seconds[name] += clock() - before[name]
        self.record.append(
            "evaluation",
            steps=steps,
            **seconds,
            evaluation_seconds=round(self.evaluation_seconds["seconds"], 3),
            extra_steps=self.baseline.extra_steps,
            **measured,
            values=front.values,
        )


@dataclass
class Prepared:
    """A run that nothing speaks against."""

    baseline: Baseline
    preferences: np.ndarray
    reference_point: Sequence[float]


@contextlib.contextmanager
def prepared(settings: BaselineSettings) -> Iterator[Prepared]:
    """The algorithm, ready to train. Nothing is written.

    :raises ValueError: for settings that cannot be
    :raises ImportError: if the extra of a baseline is not installed
    """
    if settings.algorithm not in ALGORITHMS:
        raise ValueError(f"There is no baseline {settings.algorithm!r}{nearest(settings.algorithm, ALGORITHMS)}")
    for name, least in {"steps": 1, "seed": 0, "eval_freq": 1, "n_preferences": 1, "n_episodes": 1}.items():
        check_whole(name, getattr(settings, name), least)
    n_objectives = probe_environment(settings.env).n_objectives
    if n_objectives < 2:
        raise ValueError(f"{settings.env} has one objective: a baseline needs at least two.")
    preferences = preference_grid(n_objectives, settings.n_preferences)
    reference_point = settings.reference_point or protocol.reference_point_of(settings.env, n_objectives)
    hypervolume(np.zeros((1, n_objectives)), reference_point)  # It refuses what is no such point.
    baseline = make_baseline(settings, n_objectives)
    try:
        yield Prepared(baseline, preferences, reference_point)
    finally:
        baseline.close()


def make_baseline(settings: BaselineSettings, n_objectives: int) -> Baseline:
    """The algorithm, ready to train.

    :raises ValueError: for settings that cannot be
    :raises ImportError: if its library is not installed, naming the extra
    """
    module = import_module(f"sb3_momba.baselines.{settings.algorithm}")  # Each needs libraries that the others do not.
    return module.Baseline(settings, n_objectives)


def run(settings: BaselineSettings, on_step: Callable[[int], None] | None = None) -> BaselineResult:
    """Train, evaluate and write the run's record.

    :param on_step: called now and then with the number of steps so far; it changes no result
    :raises ValueError: for settings that cannot be, before anything is written
    :raises ImportError: if the extra of a baseline is not installed
    """
    folder = Path(settings.output)
    check_empty(folder)
    with prepared(settings) as ready, alone_in(folder):
        check_empty(folder)  # Another run may have come first.
        baseline = ready.baseline
        with RecordWriter(folder / FILE_NAME).start(**_start(settings, ready)) as record:
            rules = (ready.preferences, ready.reference_point)
            floors = append_floors(record, settings.env, *rules, settings.n_episodes, baseline.general_policy)
            curve = Curve(baseline, record, settings.eval_freq, *rules)

            def between_steps() -> None:
                curve.between_steps()
                if on_step is not None:
                    on_step(baseline.steps)

            baseline.train(between_steps)
            curve.finish()
        return BaselineResult(curve.timesteps, curve.metrics, floors, folder)


def check(settings: BaselineSettings) -> None:
    """:raises ValueError: for settings that cannot be"""
    with prepared(settings):
        pass


def record_failure(settings: BaselineSettings, error: str, traceback: str = "") -> None:
    """A record in the run's folder of a run that died before it could begin one."""
    with prepared(settings) as ready:
        start = _start(settings, ready)
    path = Path(settings.output) / FILE_NAME
    path.unlink(missing_ok=True)  # It may have been cut off in its first line.
    with RecordWriter(path).start(**start) as record:
        record.fail(error, traceback)


def recorded_settings(settings: BaselineSettings) -> dict[str, Any]:
    """Every setting that a result depends on, defaults included, as JSON holds it."""
    with prepared(settings) as ready:
        return _config(settings, ready.baseline)


def _config(settings: BaselineSettings, baseline: Baseline) -> dict[str, Any]:
    config = {name: value for name, value in asdict(settings).items() if name != "output"}  # No result depends on it.
    return dict(plain({**config, "hyperparameters": baseline.hyperparameters}))


def _start(settings: BaselineSettings, ready: Prepared) -> dict[str, Any]:
    baseline, config = ready.baseline, _config(settings, ready.baseline)
    about = (ready.preferences, ready.reference_point, baseline.parameters, baseline.general_policy)
    return description(settings, config, *about)
