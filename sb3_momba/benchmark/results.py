"""From records to comparable results: who ran what, what each run scored, and what its curve was."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import trapezoid

from sb3_momba.methods import name_methods
from sb3_momba.pareto.metrics import (
    convex_envelope,
    expected_utility,
    hypervolume,
    inverted_generational_distance,
    preference_regret,
)
from sb3_momba.records import Record, common_reference_point

Array = NDArray[np.float64]
Metric = Literal["hypervolume", "expected_utility"]

# The label of runs that were trained and evaluated for one preference alone: points of a front that they form together (4.2.4).
FIXED_PREFERENCE = "fixed_preference"


@dataclass(frozen=True)
class Run:
    """One run's scores.

    A run that failed or did not end counts with the hypervolume 0 and with the worst expected utility and distance among the
    floors and all finished runs. Its regret is unknown: standing still regrets nothing.

    :param seconds: of training, at each of `steps`; see `Task.clock`
    :param curve: hypervolume at each of them
    :param utility_curve: expected utility at each of them
    :param mean_over_steps: of the curve, see `areas_under_curve`
    :param mean_over_time: of the curve, see `areas_over_time`
    """

    record: Record
    hypervolume: float
    expected_utility: float
    preference_regret: float
    inverted_generational_distance: float
    steps: Array
    seconds: Array
    curve: Array
    utility_curve: Array
    mean_over_steps: float = np.nan
    mean_over_time: float = np.nan

    @property
    def is_finished(self) -> bool:
        return self.record.error is None


@dataclass(frozen=True)
class Task:
    """All that was run on one task.

    :param methods: runs by the method's name, without those of a fixed preference
    :param seconds: of training that every method had
    :param clock: "cpu_seconds" where all its records have those, else "seconds"
    :param floors: hypervolume, expected utility and distance of policies that learned nothing, by name
    :param reference_front: the convex envelope of the final solutions of all methods (section 4.4), (n, n_objectives)
    :param fixed_preference: records of runs for one preference each
    """

    name: str
    reference_point: Array
    reference_front: Array
    floors: dict[str, tuple[float, float, float]]
    methods: dict[str, list[Run]]
    seconds: float
    clock: Literal["seconds", "cpu_seconds"]
    fixed_preference: list[Record] = field(default_factory=list)


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
    reference = common_reference_point(name, records, reference_point)
    fixed = [record for record in records if is_fixed_preference(record)]
    found = [record.final_values for record in records if record.final_values is not None]
    front = convex_envelope(np.concatenate(found)) if found else np.zeros((0, len(reference)))
    records = [record for record in records if not is_fixed_preference(record)]
    if not records:
        return Task(name, reference, front, {}, {}, 0.0, "seconds", fixed)
    _check_protocol(name, records)
    final = [record.final_values for record in records if record.final_values is not None]
    preferences = records[0].preferences
    # The floors do not depend on the method; a run that was cut off may lack one.
    floors = {
        floor.policy: (
            hypervolume(floor.values, reference),
            expected_utility(floor.values, preferences),
            normalized_distance(floor.values, front),
        )
        for floor in max(records, key=lambda record: len(record.floors)).floors
    }
    earned = [*floors.values()]
    earned += [(0.0, expected_utility(values, preferences), normalized_distance(values, front)) for values in final]
    noted = all(evaluation.cpu_seconds is not None for record in records for evaluation in record.evaluations)
    clock: Literal["seconds", "cpu_seconds"] = "cpu_seconds" if noted else "seconds"
    methods = {
        method: [_score(record, reference, front, earned, clock) for record in its_records]
        for method, its_records in name_methods(records).items()
    }
    first, seconds, start = (
        common_first_step(methods),
        common_seconds(methods),
        max((volume for volume, _, _ in floors.values()), default=0.0),
    )
    methods = {
        method: [
            replace(run, mean_over_steps=over_steps, mean_over_time=over_time)
            for run, over_steps, over_time in zip(
                runs, areas_under_curve(runs, first), areas_over_time(runs, seconds, start), strict=True
            )
        ]
        for method, runs in methods.items()
    }
    return Task(name, reference, front, floors, methods, seconds, clock, fixed)


def cut_at(record: Record, steps: int) -> Record:
    """A run as it stood at `steps`, which is as if it had been asked for no more: its evaluation there is the final one.

    A run that was asked for no more is as it is. Its extra steps may include those of the episodes that it had begun there.

    :raises ValueError: for a longer one that was not evaluated there, or that would have gone otherwise with fewer steps
    """
    if record.planned_steps <= steps:
        return record
    cannot = f"{record.path} cannot be cut at {steps:,} steps, leave it out"
    rate = record.config.get("hyperparameters", {}).get("learning_rate", 0.0)
    if not record.general_policy or not isinstance(rate, int | float):
        what = "what it trains" if not record.general_policy else f"its learning rate, {rate},"
        raise ValueError(f"{cannot}: {what} depends on how many it was asked for, {record.planned_steps:,}.")
    before = [evaluation for evaluation in record.evaluations if evaluation.steps <= steps]
    cut = replace(record, config={**record.config, "steps": steps}, evaluations=before, whole=record)
    if before and before[-1].steps == steps:
        last = before[-1]
        return replace(cut, final_values=last.values, extra_steps=last.extra_steps, error=None, traceback="")
    if record.error is not None and before == record.evaluations:
        return cut  # It did not get so far.
    raise ValueError(f"{cannot}: it was evaluated at {', '.join(f'{one.steps:,}' for one in record.evaluations) or 'none'}.")


def is_fixed_preference(record: Record) -> bool:
    return record.label == FIXED_PREFERENCE and len(record.preferences) == 1


def _check_protocol(name: str, records: Sequence[Record]) -> None:
    """Hypervolume and expected utility grow with the number of preferences and episodes."""
    first = records[0]
    for record in records[1:]:
        same = np.array_equal(record.preferences, first.preferences)
        if not same or record.config.get("n_episodes") != first.config.get("n_episodes"):
            numbers = [one.config.get("n_episodes") if same else len(one.preferences) for one in (first, record)]
            what = "episodes" if same else "preferences"
            raise ValueError(
                f"{name} was evaluated with different {what} in {first.path} ({numbers[0]}) and {record.path} ({numbers[1]}): "
                "report them apart."
            )


def _score(
    record: Record, reference_point: Array, front: Array, earned: Sequence[tuple[float, float, float]], clock: str
) -> Run:
    """:param earned: hypervolume, expected utility and distance of floors and finished runs"""
    steps = np.array([evaluation.steps for evaluation in record.evaluations], dtype=np.float64)
    seconds = np.array([getattr(evaluation, clock) for evaluation in record.evaluations])
    curve = np.array([hypervolume(evaluation.values, reference_point) for evaluation in record.evaluations])
    utility_curve = np.array([expected_utility(evaluation.values, record.preferences) for evaluation in record.evaluations])
    values = record.final_values
    if values is None:
        utility = min((utility for _, utility, _ in earned), default=np.nan)
        distance = max((distance for _, _, distance in earned), default=np.nan)
        return Run(record, 0.0, utility, np.nan, distance, steps, seconds, curve, utility_curve)
    return Run(
        record,
        hypervolume(values, reference_point),
        expected_utility(values, record.preferences),
        preference_regret(values, record.preferences) if record.general_policy else np.nan,
        normalized_distance(values, front),
        steps,
        seconds,
        curve,
        utility_curve,
    )


def normalized_distance(values: Array, front: Array) -> float:
    """IGD (4.3) on axes on which the front's range is [0, 1]; unknown where the front is a point."""
    if len(front) < 2:
        return np.nan
    nadir, span = front.min(axis=0), np.ptp(front, axis=0)
    span = np.where(span > 0, span, 1)
    return inverted_generational_distance((values - nadir) / span, (front - nadir) / span)


def curve_on(runs: Sequence[Run], metric: Metric = "hypervolume") -> tuple[Array, Array]:
    """The curves of one method's runs on common steps, from where all have been evaluated: (n,) and (n_runs, n).

    After its last evaluation a run that failed has what it counts with, the hypervolume 0, up to the steps that it was meant
    to have.
    """
    steps = max((run.steps for run in runs), key=lambda s: (s[-1] if len(s) else 0, len(s)))
    planned = max((run.record.planned_steps for run in runs if not run.is_finished), default=0)
    if len(steps) and planned > steps[-1]:
        steps = np.append(steps, np.unique([steps[-1] + 1, planned]))
    steps = steps[steps >= max((run.steps[0] for run in runs if len(run.steps)), default=0.0)]
    curves = []
    for run in runs:
        curve = run.curve if metric == "hypervolume" else run.utility_curve
        failed = None if run.is_finished else getattr(run, metric)
        curves.append(np.interp(steps, run.steps, curve, right=failed) if len(run.steps) else 0 * steps + (failed or 0.0))
    return steps, np.array(curves)


def areas_under_curve(runs: Sequence[Run], first: float = 0.0) -> list[float]:
    """For each run its mean hypervolume from the method's first evaluation to its last; unknown if that is one.

    :param first: step to begin at, where the method's first evaluation comes before it
    """
    steps, curves = curve_on(runs)
    if len(steps) < 2 or first >= steps[-1]:
        return [np.nan] * len(runs)
    if first > steps[0]:
        later = np.append(first, steps[steps > first])
        steps, curves = later, np.array([np.interp(later, steps, curve) for curve in curves])
    return [float(area) for area in trapezoid(curves, steps, axis=1) / (steps[-1] - steps[0])]


def common_first_step(methods: dict[str, list[Run]]) -> float:
    """The latest of the methods' first evaluations: who evaluates late does not leave out its beginning."""
    return max((float(steps[0]) for steps, _ in map(curve_on, methods.values()) if len(steps) > 1), default=0.0)


def common_seconds(methods: dict[str, list[Run]]) -> float:
    """How long the shortest of the finished runs trained; 0 where there is none."""
    return min(
        (float(run.seconds[-1]) for runs in methods.values() for run in runs if run.is_finished and len(run.seconds)),
        default=0.0,
    )


def areas_over_time(runs: Sequence[Run], seconds: float, start: float) -> list[float]:
    """For each run its mean hypervolume over its first `seconds` of training; unknown where that is none.

    A run that failed has 0 after its last evaluation.

    :param start: the hypervolume before training: who evaluates late is not credited with what was learned until then
    """
    if seconds == 0:
        return [np.nan] * len(runs)
    areas = []
    for run in runs:
        known, curve = np.append(0.0, run.seconds), np.append(start, run.curve)
        end = seconds if run.is_finished else min(seconds, known[-1])
        times = np.append(known[known < end], end)
        areas.append(float(trapezoid(np.interp(times, known, curve), times) / seconds))
    return areas


def median_run(runs: Sequence[Run]) -> Run | None:
    """The finished run of median hypervolume; of an even number the lower one of the two in the middle."""
    finished = sorted((run for run in runs if run.is_finished), key=lambda run: run.hypervolume)
    return finished[(len(finished) - 1) // 2] if finished else None


def parameters_of(runs: Sequence[Run]) -> dict[str, int]:
    """Trainable parameters of each network of one method; a run that never began has recorded none."""
    return next((run.record.parameters for run in runs if run.record.parameters), {})
