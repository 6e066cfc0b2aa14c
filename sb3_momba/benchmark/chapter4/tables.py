"""The tables of chapter 4, and the numbers beside its figures, in Markdown: the records' and the thesis's."""

from collections.abc import Mapping, Sequence

import numpy as np

from sb3_momba.benchmark.chapter4.differences import MISSING, all_runs, names, range_text
from sb3_momba.benchmark.chapter4.layout import CONDITIONING, IMPROVEMENTS, MAIN, Labels, Methods
from sb3_momba.benchmark.chapter4.scores import (
    Aggregate,
    Tasks,
    Unit,
    ablation_units,
    aggregate,
    runs_of,
    score_of,
)
from sb3_momba.benchmark.chapter4.thesis import read_thesis, scaled
from sb3_momba.benchmark.results import Metric, Run, median_run, parameters_of
from sb3_momba.benchmark.statistics import Estimate
from sb3_momba.benchmark.tables import as_text, markdown

# How many policies PGMORL and DPMORL train at a time.
N_POLICIES = ("pop_size", "n_policies")
SHORT: dict[Metric, str] = {"hypervolume": "HV", "expected_utility": "EUM"}


def table_4_2(tasks: Tasks) -> str:
    """Summary of the algorithms; parameters are the mean over the tasks that have runs, of a single policy."""
    columns = ("policies", "trainable parameters", "training steps")
    rows = [["algorithm", "classification", *(f"{who}{name}" for name in columns for who in ("", "thesis: "))]]
    for title, labels in MAIN.items():
        published = read_thesis().methods[title]
        ours = summary(tasks, labels)
        theirs = [range_text(published.policies), range_text(published.parameters), range_text(published.steps)]
        rows.append([title, published.classification, *(cell for pair in zip(ours, theirs, strict=True) for cell in pair)])
    return markdown(rows)


def summary(tasks: Tasks, labels: Labels) -> list[str]:
    """Policies, parameters and steps of a method's runs; behind + the steps of episodes that it played for itself."""
    runs = all_runs(tasks, labels)
    if not runs:
        return [MISSING] * 3
    sizes = [parameters_of(runs_of(task, labels)) for task in tasks.values()]
    parameters = [sum(one.values()) for one in sizes if one]
    policies = [n for n in map(n_policies, runs) if n is not None]
    steps = [run.record.planned_steps for run in runs]
    extra = [run.record.extra_steps for run in runs]
    of_training = range_text((min(steps), max(steps)))
    return [
        range_text((min(policies), max(policies))) if policies else MISSING,
        f"{np.mean(parameters):,.0f}" if parameters else MISSING,
        f"{of_training} + {range_text((min(extra), max(extra)))}" if any(extra) else of_training,
    ]


def n_policies(run: Run) -> int | None:
    """One of a general policy, as many as a method of several trains; unknown of a record that does not say."""
    if run.record.general_policy:
        return 1
    hyperparameters = run.record.config.get("hyperparameters", {})
    return next((int(hyperparameters[name]) for name in N_POLICIES if name in hyperparameters), None)


def table_4_3(tasks: Tasks) -> str:
    """Results per task, in the units of the thesis's table, beside the better of the policies that learned nothing."""
    rows = [["environment", "metric", "of", *MAIN, "nothing learned"]]
    for env, published in read_thesis().tasks.items():
        floors = tasks[env].floors.values() if env in tasks else ()
        best_floors = dict(zip(SHORT, np.max([floor[:2] for floor in floors], axis=0), strict=True)) if floors else {}
        for metric, short in SHORT.items():
            unit = published.units[metric]
            ours = [score_of(runs_of(tasks.get(env), labels), metric) for labels in MAIN.values()]
            theirs = [published.scores[metric][title] for title in MAIN]
            unit_text = f"{short} / 10^{round(np.log10(unit))}"
            floor = f"{best_floors[metric] / unit:,.4g}" if best_floors else ""
            for of, scores, beside in (("records", ours, floor), ("thesis", theirs, "")):
                rows.append([published.name, unit_text, of, *with_best_in_bold(scores, 1 / unit), beside])
    return markdown(rows)


def with_best_in_bold(scores: Sequence[Estimate | None], factor: float) -> list[str]:
    """Nothing is best that stands alone."""
    known = [score.value for score in scores if score is not None]
    cells = []
    for score in scores:
        text = MISSING if score is None else as_text(scaled(score, factor))
        is_best = score is not None and len(known) > 1 and score.value == max(known)
        cells.append(f"**{text}**" if is_best else text)
    return cells


def table_4_4(tasks: Tasks) -> str:
    """Conditioning: hypervolume in units of Momba's."""
    unit, published = ablation_units(tasks), read_thesis().conditioning
    rows = [["conditioning style", "runs", "tasks", "normalised HV", "thesis"]]
    for title, labels in CONDITIONING.items():
        rows.append([title, *aggregate_cells(aggregate(tasks, labels, "hypervolume", unit)), as_text(published[title])])
    return markdown(rows)


def table_4_5(tasks: Tasks) -> str:
    """HER and PAR: hypervolume in units of Momba's, and IGD."""
    unit, published = ablation_units(tasks), read_thesis().improvements
    rows = [["configuration", "runs", "tasks", "normalised HV", "thesis", "runs", "tasks", "IGD", "thesis"]]
    for title, labels in IMPROVEMENTS.items():
        volume = aggregate(tasks, labels, "hypervolume", unit)
        distance = aggregate(tasks, labels, "inverted_generational_distance")
        theirs = published[title]
        cells = [*aggregate_cells(volume), as_text(theirs["hypervolume"])]
        rows.append([title, *cells, *aggregate_cells(distance), as_text(theirs["distance"])])
    return markdown(rows)


def aggregate_table(header: str, found: Mapping[str, Aggregate], score: str) -> str:
    """One score of several configurations."""
    rows = [[header, "runs", "tasks", score], *([title, *aggregate_cells(one)] for title, one in found.items())]
    return markdown(rows)


def aggregate_cells(found: Aggregate) -> list[str]:
    """Runs, tasks and the score."""
    if found.estimate is None:
        return [MISSING] * 3
    every = len(found.tasks) == len(read_thesis().tasks)
    return [f"{found.finished}/{found.runs}", "all" if every else names(found.tasks), as_text(found.estimate)]


def seeds_table(tasks: Tasks, methods: Methods) -> str:
    """The seed of median hypervolume of each method on each task, whose front a figure shows."""
    rows = [["task", *methods]]
    for env, published in read_thesis().tasks.items():
        chosen = [median_run(runs_of(tasks.get(env), labels)) for labels in methods.values()]
        rows.append([published.name, *(MISSING if run is None else f"seed {run.record.seed}" for run in chosen)])
    return markdown(rows)


def unit_note(tasks: Tasks, unit: Mapping[str, Unit], title: str, metric: Metric) -> str:
    """Whose numbers the scores are divided by, and on which tasks there is none."""
    ours = [env for env in tasks if env in unit and not unit[env].published]
    theirs = [env for env in tasks if env in unit and unit[env].published]
    lacking = [env for env in tasks if env not in unit]
    parts = [f"of the records on {names(ours)}"] if ours else []
    parts += [f"as the thesis has it on {names(theirs)}"] if theirs else []
    parts += [f"missing or not above 0 on {names(lacking)}, which the aggregates leave out"] if lacking else []
    return f"Unit of {SHORT[metric]}: the IQM of {title}, {'; '.join(parts)}.\n"
