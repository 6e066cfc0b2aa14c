"""From records to comparable results: who ran what, what each run scored, and what its curve was."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import trapezoid

from sb3_momba.pareto.metrics import (
    convex_coverage,
    expected_utility,
    hypervolume,
    inverted_generational_distance,
    preference_regret,
)
from sb3_momba.records import Record

Array = NDArray[np.float64]

# Settings in which runs of one method may differ.
NOT_THE_METHOD = ("env", "env_kwargs", "seed", "label", "objectives", "reference_point", "device", "subprocesses")


@dataclass(frozen=True)
class Run:
    """One run's scores.

    A run that failed or did not end counts with the hypervolume 0 and the expected utility of the worse floor (of the worst
    finished run where no floor is recorded); its regret and its distance are unknown.

    :param curve: hypervolume at each of `steps`
    """

    record: Record
    hypervolume: float
    expected_utility: float
    preference_regret: float
    inverted_generational_distance: float
    steps: Array
    seconds: Array
    curve: Array

    @property
    def is_finished(self) -> bool:
        return self.record.error is None


@dataclass(frozen=True)
class Task:
    """All that was run on one task.

    :param methods: runs by the method's name
    :param floors: name, hypervolume and expected utility of policies that learned nothing
    :param reference_front: the convex envelope of all solutions of all methods (section 4.4), (n, n_objectives)
    """

    name: str
    reference_point: Array
    reference_front: Array
    floors: dict[str, tuple[float, float]]
    methods: dict[str, list[Run]]


def compare(records: Iterable[Record], reference_point: ArrayLike | None = None) -> list[Task]:
    """Records by task and method; methods of one label that differ in a setting are told apart by it.

    :param reference_point: of the hypervolume, instead of the records' own
    :raises ValueError: for records of one task that cannot be compared
    """
    by_task: dict[str, list[Record]] = defaultdict(list)
    for record in records:
        by_task[record.task].append(record)
    return [_compare_task(name, by_task[name], reference_point) for name in sorted(by_task)]


def _compare_task(name: str, records: Sequence[Record], reference_point: ArrayLike | None) -> Task:
    points = sorted({tuple(record.reference_point.tolist()) for record in records})
    if reference_point is None and len(points) > 1:
        raise ValueError(f"The records of {name} have the reference points {points}: choose one, --reference-point.")
    reference = records[0].reference_point if reference_point is None else np.asarray(reference_point, dtype=np.float64)
    for record in records:
        if record.preferences.shape[1] != len(reference):
            raise ValueError(
                f"{name} has {record.preferences.shape[1]} objectives in {record.path}, the reference point "
                f"{reference.tolist()} has {len(reference)} numbers."
            )
    finals = [(record.final_values, record.preferences) for record in records if record.final_values is not None]
    front = np.zeros((0, len(reference)))
    if finals:
        values, preferences = (np.concatenate(parts) for parts in zip(*finals, strict=True))
        front = convex_coverage(values, np.unique(preferences, axis=0))
    floors = _floors(records, reference)
    utilities = [expected_utility(values, preferences) for values, preferences in finals]
    worst_utility = min([utility for _, utility in floors.values()] or utilities, default=0.0)
    methods: dict[str, list[Run]] = {}
    for method, its_records in name_methods(records).items():
        methods[method] = [_score(record, reference, front, worst_utility) for record in its_records]
    return Task(name, reference, front, floors, methods)


def _floors(records: Sequence[Record], reference_point: Array) -> dict[str, tuple[float, float]]:
    """Hypervolume and expected utility, of a record that has all of them: they do not depend on the method."""
    record = max(records, key=lambda record: len(record.floors))
    return {
        floor.policy: (hypervolume(floor.values, reference_point), expected_utility(floor.values, record.preferences))
        for floor in record.floors
    }


def _score(record: Record, reference_point: Array, front: Array, worst_utility: float) -> Run:
    steps = np.array([evaluation.steps for evaluation in record.evaluations], dtype=np.float64)
    seconds = np.array([evaluation.seconds for evaluation in record.evaluations])
    curve = np.array([hypervolume(evaluation.values, reference_point) for evaluation in record.evaluations])
    values = record.final_values
    if values is None:
        return Run(record, 0.0, worst_utility, np.nan, np.nan, steps, seconds, curve)
    nadir, span = front.min(axis=0), np.ptp(front, axis=0)
    span = np.where(span > 0, span, 1.0)
    return Run(
        record,
        hypervolume(values, reference_point),
        expected_utility(values, record.preferences),
        preference_regret(values, record.preferences),
        inverted_generational_distance((values - nadir) / span, (front - nadir) / span),
        steps,
        seconds,
        curve,
    )


def name_methods(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Records by their label; where those of one label differ in settings, the differing ones are appended to the name."""
    by_label: dict[str, list[Record]] = defaultdict(list)
    for record in records:
        by_label[record.label].append(record)
    methods: dict[str, list[Record]] = defaultdict(list)
    for label in sorted(by_label):
        settings = [_flat({k: v for k, v in r.config.items() if k not in NOT_THE_METHOD}) for r in by_label[label]]
        names = sorted({name for one in settings for name in one})
        differing = [name for name in names if len({repr(one.get(name)) for one in settings}) > 1]
        for record, one in zip(by_label[label], settings, strict=True):
            suffix = ", ".join(f"{name.split('.')[-1]}={_as_text(one.get(name))}" for name in differing)
            methods[f"{label} ({suffix})" if suffix else label].append(record)
    return dict(methods)


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """{"a": {"b": 1}} -> {"a.b": 1.0}: 1 and 1.0 are the same setting."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{name}."))
        else:
            flat[f"{prefix}{name}"] = float(value) if type(value) is int else value
    return flat


def _as_text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def curve_on(runs: Sequence[Run]) -> tuple[Array, Array]:
    """The hypervolume curves of one method's runs on common steps: (n,) and (n_runs, n).

    After its last evaluation a run that failed has the hypervolume 0.
    """
    steps = max((run.steps for run in runs), key=lambda s: (s[-1] if len(s) else 0, len(s)))
    curves = [
        np.interp(steps, run.steps, run.curve, right=None if run.is_finished else 0.0) if len(run.steps) else 0 * steps
        for run in runs
    ]
    return steps, np.array(curves)


def areas_under_curve(runs: Sequence[Run]) -> list[float]:
    """For each run its mean hypervolume from the method's first evaluation to its last."""
    steps, curves = curve_on(runs)
    if len(steps) < 2:
        return [run.hypervolume for run in runs]
    return [float(area) for area in trapezoid(curves, steps, axis=1) / (steps[-1] - steps[0])]
