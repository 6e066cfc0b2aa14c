"""`python -m sb3_momba.benchmark report RECORDS`: a table, the curves and the fronts of whatever was recorded."""

import argparse
import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sb3_momba.benchmark.curves import curve_through, draw_curve
from sb3_momba.benchmark.results import Run, Task, compare, curve_on, cut_at, median_run, parameters_of
from sb3_momba.benchmark.statistics import estimate, interquartile_mean, probability_of_improvement
from sb3_momba.benchmark.tables import as_text, markdown, one_line
from sb3_momba.files import atomic_write
from sb3_momba.methods import differing, method_settings
from sb3_momba.pareto.plotting import add_legend, default_style, plot_front, save_figure, verbatim
from sb3_momba.records import UNENDED, Record, find_records, is_cut_off_at_its_start, read_record
from sb3_momba.train import whole_number

COLUMNS = {
    "hypervolume": "hypervolume",
    "expected utility": "expected_utility",
    "preference regret": "preference_regret",
    "IGD": "inverted_generational_distance",
    "curve over steps": "mean_over_steps",
    "curve over time": "mean_over_time",
}
CLOCKS = {"cpu_seconds": "of one processor", "seconds": "by the wall"}
EXTRA_STEPS = "Extra steps: of episodes that a method plays for itself, which are not among its steps.\n"
NORMALISED = ("hypervolume", "expected utility", "curve over steps", "curve over time")
EXPLANATION = """\
IQM of the runs with its 95 % interval from a stratified bootstrap, which is too narrow where there are few seeds: of normal
scores it covers the truth in 75 % of cases with 3 seeds, 90 % with 5, 93 % with 10. Runs: those that finished, of all. A run
that failed or did not end counts with the hypervolume 0 and with the worst expected utility and IGD among the floors and the
finished runs; regret is of the finished ones. IGD is measured on [0, 1] axes to the convex envelope of all final solutions in
this report (section 4.4), so it changes with the records; there is none where the envelope is one point. The two columns of
the curve are mean hypervolumes, areas under it divided by its length: over steps from the first evaluation that all methods
of the task have to the last; over time up to the seconds of training (without evaluations) that every finished run had, from
the better of the policies that learned nothing to the first evaluation in a straight line.
"""


def write_report(tasks: Sequence[Task], records: Sequence[Record], folder: Path, baseline: str | None = None) -> str:
    """Write report.md and its pictures into a folder; the report's text.

    :param baseline: the method whose IQM on each task is 1 in the aggregate over tasks
    :raises ValueError: for a baseline that no task has
    """
    aggregate = "" if baseline is None else aggregate_table(tasks, baseline)
    folder.mkdir(parents=True, exist_ok=True)
    parts = ["# Report\n", EXPLANATION]
    unended = sum(record.error == UNENDED for record in records)
    if unended:
        parts.append(f"**{unended} runs have no end: they were killed, or still run.**\n")
    names = file_names([task.name for task in tasks])
    for task, name in zip(tasks, names, strict=True):
        parts.append(f"## {task.name}\n")
        duration = f"{task.seconds:,.0f} s {CLOCKS[task.clock]}"
        parts.append(f"Reference point {task.reference_point.tolist()}; curves over time up to {duration}.\n")
        if compares_nothing(task):
            parts.append(
                "**Nothing lies above the reference point: hypervolumes are 0 and compare nothing; choose another.**\n"
            )
        parts.append(task_table(task))
        parts += [EXTRA_STEPS] * has_extra_steps(task)
        parts += [f"Recorded more than once: {repeated}.\n" for repeated in repeated_seeds(task)]
        parts += [f"Not recorded: {missing}.\n" for missing in missing_seeds(task)]
        if task.fixed_preference:
            finished = f"{sum(record.error is None for record in task.fixed_preference)}/{len(task.fixed_preference)}"
            parts.append(f"Not in the table: runs of a fixed preference each, {finished}, points of one front.\n")
        with default_style():
            if draw_curves(task, folder / f"curve-{name}.png"):
                parts.append(f"![Hypervolume over environment steps](curve-{name}.png)\n")
            if draw_fronts(task, folder / f"front-{name}.png"):
                parts.append(f"![Fronts of the seeds of median hypervolume](front-{name}.png)\n")
    parts += [aggregate, comparison_table(tasks), failures(tasks), provenance(records)]
    text = "\n".join(part for part in parts if part)
    with atomic_write(folder / "report.md") as file:
        file.write(text.encode())
    return text


def file_names(tasks: Sequence[str]) -> list[str]:
    """Names that any file system takes, each one once."""
    names: list[str] = []
    for task in tasks:
        name = plain = re.sub(r"[^\w.-]+", "_", task).strip("_")[:100]
        number = 1
        while name in names:
            number += 1
            name = f"{plain}-{number}"
        names.append(name)
    return names


def repeated_seeds(task: Task) -> list[str]:
    counts = Counter(f"{name}, seed {run.record.seed}" for name, runs in task.methods.items() for run in runs)
    return [run for run, count in counts.items() if count > 1]


def missing_seeds(task: Task) -> list[str]:
    """Seeds that other methods have: their runs may have died before they could begin a record."""
    seeds = {run.record.seed for runs in task.methods.values() for run in runs}
    return [
        f"{name}, seed {seed}"
        for name, runs in task.methods.items()
        for seed in sorted(seeds - {run.record.seed for run in runs})
    ]


def has_extra_steps(task: Task) -> bool:
    return any(run.record.extra_steps for runs in task.methods.values() for run in runs)


def has_unequal_budgets(task: Task) -> bool:
    """By more than a hundredth: not every method can have any number of steps."""
    steps = [last_step(runs) for runs in task.methods.values()]
    return max(steps, default=0) > 1.01 * min(steps, default=0)


def compares_nothing(task: Task) -> bool:
    """Whether no run has a hypervolume, though some finished."""
    runs = [run for runs in task.methods.values() for run in runs]
    return any(run.is_finished for run in runs) and not any(run.hypervolume > 0 for run in runs)


def last_step(runs: Sequence[Run]) -> int:
    return max((int(run.steps[-1]) for run in runs if len(run.steps)), default=0)


def task_table(task: Task) -> str:
    """Extra steps have a column where any method has some."""
    with_extra = has_extra_steps(task)
    rows = [["method", "runs", "steps", *["extra steps"] * with_extra, "parameters", *COLUMNS]]
    for name, (volume, utility, distance) in task.floors.items():
        igd = f"{distance:,.4g}" if np.isfinite(distance) else ""
        rows.append([f"({name})", "", "", *[""] * with_extra, "", f"{volume:,.5g}", f"{utility:,.5g}", "", igd, "", ""])
    for name, runs in task.methods.items():
        finished = sum(run.is_finished for run in runs)
        parameters = sum(parameters_of(runs).values())
        scores = [[getattr(run, column) for run in runs] for column in COLUMNS.values()]
        known = [[score for score in column if np.isfinite(score)] for column in scores]
        estimates = [as_text(estimate(interquartile_mean, [column])) if column else "" for column in known]
        extra = [f"{max(run.record.extra_steps for run in runs):,}"] * with_extra
        rows.append([name, f"{finished}/{len(runs)}", f"{last_step(runs):,}", *extra, f"{parameters:,}", *estimates])
    return markdown(rows)


def comparison_table(tasks: Sequence[Task]) -> str:
    """P(row > column) in hypervolume, over the tasks that both were run on and on which it tells anything."""
    tasks = [task for task in tasks if not compares_nothing(task)]
    names = sorted({name for task in tasks for name in task.methods})
    if len(names) < 2:
        return ""
    rows = [["", *names]]
    for row in names:
        cells = []
        for column in names:
            shared = [task.methods for task in tasks if row in task.methods and column in task.methods]
            if row == column or not shared:
                cells.append("")
                continue
            x, y = ([[run.hypervolume for run in methods[name]] for methods in shared] for name in (row, column))
            cells.append(f"{as_text(estimate(probability_of_improvement, x, y))} ({len(shared)} tasks)")
        rows.append([row, *cells])
    introduction = "## Probability of improvement\n\nOf the row's method over the column's, in hypervolume."
    unequal = [task.name for task in tasks if has_unequal_budgets(task)]
    if unequal:
        introduction += f" Methods had unequal numbers of steps on {', '.join(unequal)}."
    introduction += told_of_settings(tasks)
    return introduction + "\n\n" + markdown(rows)


def aggregate_table(tasks: Sequence[Task], baseline: str) -> str:
    """Scores over all tasks, each in units of the baseline's IQM on it (section 4.1.2)."""
    with_baseline = [task.methods for task in tasks if baseline in task.methods]
    names = sorted({name for task in tasks for name in task.methods})
    if not with_baseline:
        raise ValueError(f"No task has the method {baseline!r}: there are {', '.join(names)}.")
    rows = [["method", "tasks", *(f"normalised {column}" for column in NORMALISED)]]
    for name in names:
        shared = [methods for methods in with_baseline if name in methods]
        cells = [normalised(shared, name, baseline, COLUMNS[column]) for column in NORMALISED]
        rows.append([name, str(len(shared)), *cells])
    introduction = f"In units of the IQM of {one_line(baseline)} on each task; the IQM is over all runs of all tasks."
    return f"## Aggregate\n\n{introduction}{told_of_settings(tasks)}\n\n{markdown(rows)}"


def told_of_settings(tasks: Sequence[Task]) -> str:
    """A sentence on methods whose settings are not the same on all tasks; empty where there are none."""
    of_methods: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for task in tasks:
        for name, runs in task.methods.items():
            of_methods[name].append(method_settings(runs[0].record))
    told = []
    for name, several in sorted(of_methods.items()):
        if settings := differing(several):
            told.append(f"{one_line(name)} ({', '.join(one.split('.')[-1] for one in settings)})")
    return f" Not on all tasks with the same settings: {'; '.join(told)}." if told else ""


def normalised(tasks: Sequence[dict[str, list[Run]]], name: str, baseline: str, column: str) -> str:
    """Empty where a score is unknown or the baseline's is not above 0."""
    scores = [np.array([getattr(run, column) for run in methods[name]]) for methods in tasks]
    units = [interquartile_mean([[getattr(run, column) for run in methods[baseline]]]) for methods in tasks]
    known = all(np.isfinite(score).all() and unit > 0 for score, unit in zip(scores, units, strict=True))
    if not tasks or not known:
        return ""
    return as_text(estimate(interquartile_mean, [score / unit for score, unit in zip(scores, units, strict=True)]))


def failures(tasks: Sequence[Task]) -> str:
    named = [(task, name, run.record) for task in tasks for name, runs in task.methods.items() for run in runs]
    named += [(task, fixed_name(record), record) for task in tasks for record in task.fixed_preference]
    lines = [
        f"- {task.name}, {name}, seed {record.seed}: {one_line(str(record.error))}"
        for task, name, record in named
        if record.error is not None
    ]
    return "## Runs that did not finish\n\n" + "\n".join(lines) + "\n" if lines else ""


def fixed_name(record: Record) -> str:
    weights = ", ".join(f"{w:.3g}" for w in record.preferences[0])
    return f"{record.label} ({weights})"


def provenance(records: Sequence[Record]) -> str:
    """What the numbers were made with."""
    lines = ["## Made with\n"]
    whole = [(record.whole, record) for record in records if record.whole is not None]
    spans = Counter((one.planned_steps, cut.planned_steps) for one, cut in whole)
    lines += [f"- Runs of {steps:,} steps, as they stood at {until:,}: {n}" for (steps, until), n in sorted(spans.items())]
    failed_later = sum(cut.error is None and one.error is not None for one, cut in whole)
    lines += [f"- Did not finish after that: {failed_later}"] * (failed_later > 0)
    for title, entry in (("Versions", "versions"), ("Machine", "machine"), ("Git revision", "git_revision")):
        parts = [part for record in records for part in (record.start, *record.resumed)]
        for made in dict.fromkeys(describe(part.get(entry)) for part in parts):
            lines.append(f"- {title}: {made}")
    return "\n".join(lines) + "\n"


def describe(entry: object) -> str:
    if isinstance(entry, dict):
        return ", ".join(f"{key} {value}" for key, value in entry.items())
    return str(entry)


def draw_curves(task: Task, path: Path) -> bool:
    """The IQM of the hypervolume over steps with its interval; False where nothing was evaluated twice."""
    figure = Figure(figsize=(6, 4.5), layout="constrained")
    axes = figure.add_subplot()
    drawn = False
    for i, (name, runs) in enumerate(task.methods.items()):
        steps, curves = curve_on(runs)
        if len(steps) < 2:
            continue
        draw_curve(axes, curve_through(steps, [curves]), name, i)
        drawn = True
    if not drawn:
        return False
    for (name, (volume, *_)), style in zip(task.floors.items(), (":", "--"), strict=False):
        axes.axhline(volume, color="grey", linestyle=style, linewidth=1, label=name)
    axes.set(xlabel="environment steps", ylabel="hypervolume (IQM, 95 %)", title=verbatim(task.name), ylim=(0, None))
    axes.grid(alpha=0.3)
    add_legend(figure, axes)
    save_figure(figure, path)
    return True


def draw_fronts(task: Task, path: Path) -> bool:
    """Each method's front of the seed of median hypervolume; False where there is none of 2 or 3 objectives."""
    medians = {name: median_run(runs) for name, runs in task.methods.items()}
    fronts = {
        f"{name}, seed {run.record.seed}": run.record.final_values
        for name, run in medians.items()
        if run is not None and run.record.final_values is not None
    }
    if not fronts or len(task.reference_point) not in (2, 3):
        return False
    named = [run.record.config.get("objectives") for run in medians.values() if run is not None]
    objectives = next((names for names in named if names), None)
    plot_front(fronts, path, objectives, task.name)
    return True


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_records(parser)
    parser.add_argument("--baseline", help="the method in whose units scores are aggregated over tasks")
    parser.add_argument("--reference-point", type=float, nargs="+", help="of the hypervolume, instead of the records' own")


def add_records(parser: argparse.ArgumentParser) -> None:
    """The records that a command reads, and where it writes; see `records_of` and `folder_of`."""
    parser.add_argument("records", nargs="+", type=Path, help="record files, or folders that hold some")
    parser.add_argument("--output", type=Path, help="folder of the text and its pictures; by default the first of RECORDS")
    parser.add_argument("--steps", type=whole_number, help="compare at so many steps: longer runs as they stood there")


def records_of(given: argparse.Namespace) -> list[Record]:
    """What the command line asks for; says which records hold nothing yet.

    :raises ValueError: if none holds anything, or one cannot be cut where it is asked for
    """
    if given.steps is not None and given.steps < 1:
        raise ValueError(f"--steps {given.steps}: give at least one.")
    records = read_begun(given.records)
    return records if given.steps is None else [cut_at(record, given.steps) for record in records]


def folder_of(given: argparse.Namespace) -> Path:
    """Where the command line wants what is written."""
    first: Path = given.records[0]
    return given.output or (first if first.is_dir() else first.parent)


def read_begun(given: Sequence[Path]) -> list[Record]:
    """The records among files and in folders; says which ones hold nothing yet.

    :raises ValueError: if none does
    """
    paths = find_records(given)
    begun = [path for path in paths if not is_cut_off_at_its_start(path)]
    for path in paths:
        if path not in begun:
            print(f"{path} was cut off in its first line: that run is not in the report.")
    if not begun:
        raise ValueError("No run got beyond the first line of its record.")
    return [read_record(path) for path in begun]


def tell(
    records: Sequence[Record], folder: Path, reference_point: Sequence[float] | None = None, baseline: str | None = None
) -> None:
    """Print the report of these records, and write it with its pictures into a folder."""
    print(write_report(compare(records, reference_point), records, folder, baseline))
    print(f"Written to {folder / 'report.md'}.")


def main(given: argparse.Namespace) -> None:
    tell(records_of(given), folder_of(given), given.reference_point, given.baseline)
