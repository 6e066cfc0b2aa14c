"""The numbers of chapter 4: whose runs count on which task, in which unit, and what they come to. Nothing is drawn or written.

Tasks are those of Table 4.1 by the environment's id, in the thesis's order; what has no runs is None or left out, and whoever
shows it says so.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import factorial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sb3_momba.benchmark.chapter4.layout import MOMBA, NONE, PGMORL, Labels, Methods
from sb3_momba.benchmark.chapter4.thesis import read_thesis
from sb3_momba.benchmark.curves import Curve, curve_through
from sb3_momba.benchmark.results import Metric, Run, Task, compare, curve_on, is_fixed_preference, parameters_of
from sb3_momba.benchmark.statistics import Estimate, estimate, interquartile_mean
from sb3_momba.envs.registry import raw_id
from sb3_momba.methods import method_settings, setting_text
from sb3_momba.records import Record

Array = NDArray[np.float64]
Tasks = Mapping[str, Task]
Score = Metric | Literal["inverted_generational_distance"]

# The preference itself, where each run has one of its own.
OF_THE_PREFERENCE = ("preference", "preferences", "n_preferences", "hyperparameters.preference_sampler")


@dataclass(frozen=True)
class Unit:
    """What a score on a task is divided by; `published` if it is the thesis's number."""

    value: float
    published: bool = False


@dataclass(frozen=True)
class Aggregate:
    """A score of one configuration over tasks.

    :param estimate: None where no task has both runs and a unit
    :param tasks: those that are in it
    """

    estimate: Estimate | None
    finished: int
    runs: int
    tasks: tuple[str, ...]


def tasks_of(records: Iterable[Record]) -> dict[str, Task]:
    """The records on the thesis's tasks, in an order that does not depend on that of the files.

    :raises ValueError: for records that cannot stand in one table, naming two of them
    """
    known = read_thesis().tasks
    ours = in_order(record for record in records if raw_id(record.env) in known)
    check_one_setting(ours)
    tasks: dict[str, Task] = {}
    for task in compare(ours):
        env = task.name.partition(" (")[0]
        if env in tasks:
            raise ValueError(f"There are records of {tasks[env].name} and of {task.name}: give those of one of them at a time.")
        tasks[env] = task
    return {env: tasks[env] for env in known if env in tasks}


def in_order(records: Iterable[Record]) -> list[Record]:
    """By what they say, not by where they lie."""

    def content(record: Record) -> tuple[Any, ...]:
        values = [] if record.final_values is None else record.final_values.tolist()
        return record.task, record.label, record.seed, str(record.start.get("started")), values

    return sorted(records, key=content)


def check_one_setting(records: Iterable[Record]) -> None:
    """
    :raises ValueError: for two runs of one label on one task that differ in a setting
    """
    first: dict[tuple[str, str], Record] = {}
    for record in records:
        other = first.setdefault((record.task, record.label), record)
        one, two = settings_of(other), settings_of(record)
        differing = [name for name in sorted({*one, *two}) if repr(one.get(name)) != repr(two.get(name))]
        if differing:
            said = [f"{name} is {setting_text(one.get(name))} and {setting_text(two.get(name))}" for name in differing]
            raise ValueError(
                f"{record.label} on {record.task} has two settings, in {other.path} and {record.path}: {'; '.join(said)}. "
                "Report them apart: give the records of one of them at a time."
            )


def settings_of(record: Record) -> dict[str, object]:
    """In which the runs of one label on one task must be alike, flat."""
    settings = method_settings(record)
    if not is_fixed_preference(record):
        return settings
    return {
        name: value
        for name, value in settings.items()
        if not any(name == one or name.startswith(f"{one}.") for one in OF_THE_PREFERENCE)
    }


def label_of(task: Task | None, labels: Labels) -> str | None:
    """The first of the accepted labels that has runs on a task."""
    return next((label for label in labels if task is not None and label in task.methods), None)


def runs_of(task: Task | None, labels: Labels) -> list[Run]:
    """Of the first label that has some."""
    label = label_of(task, labels)
    return [] if task is None or label is None else task.methods[label]


def score_of(runs: Sequence[Run], score: Score) -> Estimate | None:
    """The IQM of some runs on one task; None where there are none, or one is unknown."""
    scores = np.array([getattr(run, score) for run in runs])
    return estimate(interquartile_mean, [scores]) if len(scores) and np.isfinite(scores).all() else None


def units(tasks: Tasks, labels: Labels, metric: Metric, title: str | None = None) -> dict[str, Unit]:
    """The IQM of one method on each task (section 4.1.2); tasks on which it has none, or none above 0, are left out.

    :param title: of the method whose published values stand in where there are no runs
    """
    found = {}
    for env, published in read_thesis().tasks.items():
        runs = runs_of(tasks.get(env), labels)
        if runs:
            value = float(interquartile_mean([[getattr(run, metric) for run in runs]]))
            if value > 0:
                found[env] = Unit(value)
        elif title is not None:
            found[env] = Unit(published.scores[metric][title].value, published=True)
    return found


def main_units(tasks: Tasks, metric: Metric) -> dict[str, Unit]:
    """Of the main comparison: PGMORL's, the thesis's where there are no runs of it."""
    return units(tasks, PGMORL, metric, "PGMORL")


def ablation_units(tasks: Tasks) -> dict[str, Unit]:
    """Of the ablations: Momba's hypervolume."""
    return units(tasks, MOMBA, "hypervolume")


def normalised(tasks: Tasks, labels: Labels, score: Score, unit: Mapping[str, Unit] | None) -> dict[str, Array]:
    """The scores of all runs, in units, by the tasks that have runs, a unit and no unknown score.

    :param unit: None: the scores as they are
    """
    found = {}
    for env, task in tasks.items():
        scores = np.array([getattr(run, score) for run in runs_of(task, labels)])
        if len(scores) and np.isfinite(scores).all() and (unit is None or env in unit):
            found[env] = scores if unit is None else scores / unit[env].value
    return found


def aggregate(tasks: Tasks, labels: Labels, score: Score, unit: Mapping[str, Unit] | None = None) -> Aggregate:
    """IQM and interval over the runs of all tasks (section 4.1.2)."""
    scores = normalised(tasks, labels, score, unit)
    runs = [run for env in scores for run in runs_of(tasks[env], labels)]
    found = estimate(interquartile_mean, list(scores.values())) if scores else None
    return Aggregate(found, sum(run.is_finished for run in runs), len(runs), tuple(scores))


def curve_of(runs: Sequence[Run], metric: Metric) -> Curve | None:
    """Of one method on one task; None where nothing was evaluated, or a run that failed counts with nothing known."""
    steps, curves = curve_on(runs, metric) if runs else (np.zeros(0), np.zeros((0, 0)))
    return curve_through(steps, [curves]) if len(steps) and np.isfinite(curves).all() else None


def aggregate_curve(tasks: Tasks, labels: Labels, metric: Metric, unit: Mapping[str, Unit], until: float) -> Curve | None:
    """Over all tasks, from the steps by which each was evaluated to the last that all have, `until` at most.

    Between its evaluations a run is interpolated linearly.
    """
    on_tasks = []
    for env, task in tasks.items():
        runs = runs_of(task, labels)
        steps, curves = curve_on(runs, metric) if runs and env in unit else (np.zeros(0), np.zeros((0, 0)))
        if len(steps) and np.isfinite(curves).all():
            on_tasks.append((steps, curves / unit[env].value))
    if not on_tasks:
        return None
    begin = max(steps[0] for steps, _ in on_tasks)
    end = min(until, *(steps[-1] for steps, _ in on_tasks))
    if end < begin:
        return None
    every = np.unique(np.concatenate([np.array([end]), *(steps for steps, _ in on_tasks)]))
    common = every[(begin <= every) & (every <= end)]
    return curve_through(common, [np.array([np.interp(common, steps, run) for run in runs]) for steps, runs in on_tasks])


def critic_parameters(tasks: Tasks, labels: Labels) -> float | None:
    """Of all critics of the ensemble, mean over the tasks; None where no record says so."""
    sizes = [parameters_of(runs_of(task, labels)).get("critic") for task in tasks.values()]
    known = [size for size in sizes if size is not None]
    return float(np.mean(known)) if known else None


def fixed_values(task: Task | None) -> Array | None:
    """The points that the finished runs of a fixed preference reached, (n_runs, n_objectives)."""
    records = [] if task is None else task.fixed_preference
    values = [record.final_values for record in records if record.final_values is not None]
    return np.concatenate(values) if values else None


def coalition(title: str) -> frozenset[str]:
    """The normalisations that are on in a cell of figure 4.9."""
    return frozenset() if title == NONE else frozenset(title.split(" + "))


def normalisation_worth(tasks: Tasks, methods: Methods) -> tuple[dict[frozenset[str], float], tuple[str, ...]]:
    """The IQM of the normalised hypervolume of each combination, over the tasks that have all of them; and these tasks."""
    unit = ablation_units(tasks)
    scores = {title: normalised(tasks, labels, "hypervolume", unit) for title, labels in methods.items()}
    common = tuple(env for env in tasks if all(env in one for one in scores.values()))
    if not common:
        return {}, ()
    return {coalition(name): float(interquartile_mean([one[env] for env in common])) for name, one in scores.items()}, common


def shapley_values(worth: Mapping[frozenset[str], float]) -> dict[str, float]:
    """Each player's mean contribution over all orders in which the players can join (Shapley, 1953).

    phi_i = sum over S without i of |S|! (n - |S| - 1)! / n! (v(S + i) - v(S)); they sum to v(all) - v(nobody).

    :param worth: v, of every set of players
    :raises ValueError: for a set without one, naming it
    """
    players = sorted(frozenset().union(*worth))
    n = len(players)
    every = [frozenset(some) for size in range(n + 1) for some in combinations(players, size)]
    unknown = [sorted(some) for some in every if some not in worth]
    if unknown:
        raise ValueError(f"The worth of {unknown[0]} is not known: Shapley values need that of every set of {players}.")
    return {
        player: sum(
            factorial(len(others)) * factorial(n - len(others) - 1) / factorial(n) * (worth[others | {player}] - worth[others])
            for others in every
            if player not in others
        )
        for player in players
    }
