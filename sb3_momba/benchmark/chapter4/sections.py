"""The parts of chapter 4 one by one: what each figure shows, the numbers beside it, and what is missing."""

from pathlib import Path

from sb3_momba.benchmark.chapter4 import figures, layout, tables
from sb3_momba.benchmark.chapter4.differences import MISSING, missing_note, names, steps_note
from sb3_momba.benchmark.chapter4.figures import CurvePanel, FrontPanel
from sb3_momba.benchmark.chapter4.layout import Labels, Methods
from sb3_momba.benchmark.chapter4.scores import (
    Array,
    Tasks,
    ablation_units,
    aggregate,
    aggregate_curve,
    critic_parameters,
    curve_of,
    fixed_values,
    main_units,
    normalisation_worth,
    runs_of,
    score_of,
    shapley_values,
)
from sb3_momba.benchmark.chapter4.tables import SHORT, aggregate_cells, aggregate_table, seeds_table, unit_note
from sb3_momba.benchmark.chapter4.thesis import read_thesis
from sb3_momba.benchmark.results import Metric, Task, median_run
from sb3_momba.benchmark.tables import markdown
from sb3_momba.pareto.metrics import hypervolume

FIRST_STEPS = 200_000  # figure 4.4
NORMALISED_HV = "normalised HV"


def notes(tasks: Tasks, methods: Methods) -> str:
    return "\n".join(note for note in (missing_note(tasks, methods), steps_note(tasks, methods)) if note)


def picture(name: str, title: str, is_drawn: bool) -> str:
    return f"![{title}](figure-{name}.png)\n" if is_drawn else "Not drawn: there are no runs for it.\n"


def file(folder: Path, name: str) -> Path:
    return folder / f"figure-{name}.png"


def table_4_2(tasks: Tasks, folder: Path) -> str:
    introduction = (
        "Parameters are the mean over the tasks, of a single policy with its critics. Steps behind a + are of episodes that a "
        "method plays for itself, and in no budget.\n"
    )
    return "\n".join([introduction, tables.table_4_2(tasks), notes(tasks, layout.MAIN)])


def figure_4_1(tasks: Tasks, folder: Path) -> str:
    panels, text = {}, []
    for metric, short in SHORT.items():
        unit = main_units(tasks, metric)
        found = {title: aggregate(tasks, labels, metric, unit) for title, labels in layout.MAIN.items()}
        panels[f"normalised {short}"] = found
        text += [aggregate_table("algorithm", found, f"normalised {short}"), unit_note(tasks, unit, "PGMORL", metric)]
    is_drawn = figures.draw_estimates(panels, file(folder, "4.1"))
    return "\n".join([picture("4.1", "Aggregate hypervolume and expected utility", is_drawn), *text, notes(tasks, layout.MAIN)])


def table_4_3(tasks: Tasks, folder: Path) -> str:
    caution = (
        "Whether the thesis trained on exactly these models of the tasks is not known. The best of a row is bold; its last "
        "number is that of the better of two policies that learned nothing, standing still and random actions.\n"
    )
    return "\n".join([caution, tables.table_4_3(tasks), notes(tasks, layout.MAIN)])


def fronts(tasks: Tasks, folder: Path, name: str, title: str, methods: Methods) -> str:
    """Figures 4.2 and 4.11."""
    panels = [
        FrontPanel(
            read_thesis().tasks[env].name,
            read_thesis().tasks[env].objectives,
            {method: median_front(task, labels) for method, labels in methods.items()},
        )
        for env, task in tasks.items()
    ]
    is_drawn = figures.draw_fronts(panels, file(folder, name))
    introduction = "The run of median hypervolume of each; of an even number the lower one of the two in the middle.\n"
    return "\n".join([picture(name, title, is_drawn), introduction, seeds_table(tasks, methods), notes(tasks, methods)])


def median_front(task: Task, labels: Labels) -> Array | None:
    run = median_run(runs_of(task, labels))
    return None if run is None else run.record.final_values


def figure_4_2(tasks: Tasks, folder: Path) -> str:
    return fronts(tasks, folder, "4.2", "Fronts of all methods", layout.MAIN)


def figure_4_3(tasks: Tasks, folder: Path) -> str:
    panels = [
        CurvePanel(
            read_thesis().tasks[env].name,
            short,
            {title: curve_of(runs_of(task, labels), metric) for title, labels in layout.CURVES.items()},
            levels(task, env, metric),
        )
        for env, task in tasks.items()
        for metric, short in SHORT.items()
    ]
    is_drawn = figures.draw_curves(panels, file(folder, "4.3"))
    said = "Horizontal lines are final values, the thesis's where it says so.\n"
    title = "Hypervolume and expected utility over steps"
    return "\n".join([picture("4.3", title, is_drawn), said, notes(tasks, layout.CURVES)])


def levels(task: Task, env: str, metric: Metric) -> dict[str, float]:
    """The final IQM of the multi-policy methods, the thesis's where there are no runs."""
    found = {}
    for title, labels in layout.LEVELS.items():
        ours = score_of(runs_of(task, labels), metric)
        published = read_thesis().tasks[env].scores[metric][title]
        found[title if ours else f"{title} (thesis)"] = (ours or published).value
    return found


def figure_4_4(tasks: Tasks, folder: Path) -> str:
    panels, text = [], []
    for metric, short in SHORT.items():
        unit = main_units(tasks, metric)
        curves = {
            title: aggregate_curve(tasks, labels, metric, unit, FIRST_STEPS)
            for title, labels in layout.SAMPLE_EFFICIENCY.items()
        }
        panels.append(CurvePanel("", f"normalised {short}", curves))
        text.append(unit_note(tasks, unit, "PGMORL", metric))
    is_drawn = figures.draw_curves(panels, file(folder, "4.4"))
    title = f"Normalised scores within the first {FIRST_STEPS:,} steps"
    said = "Each curve goes as far as all tasks of its method do.\n"
    return "\n".join([picture("4.4", title, is_drawn), said, *text, notes(tasks, layout.SAMPLE_EFFICIENCY)])


def figure_4_5(tasks: Tasks, folder: Path) -> str:
    panels = []
    rows = [["task", "preferences", "of the thesis", "runs", "HV of their front", "Momba's median run", "its HV"]]
    for env, published in read_thesis().tasks.items():
        task, of_thesis = tasks.get(env), layout.FIXED_PREFERENCES[len(published.objectives)]
        reference = fixed_values(task)
        run = median_run(runs_of(task, layout.MOMBA))
        ours = [MISSING] * 2 if run is None else [f"seed {run.record.seed}", f"{run.hypervolume:,.4g}"]
        if task is None or reference is None:
            rows.append([published.name, MISSING, str(of_thesis), MISSING, MISSING, *ours])
            continue
        finished = [record for record in task.fixed_preference if record.error is None]
        n_preferences = len({tuple(record.preferences[0]) for record in finished})
        runs = f"{len(finished)}/{len(task.fixed_preference)}"
        volume = f"{hypervolume(reference, task.reference_point):,.4g}"
        rows.append([published.name, str(n_preferences), str(of_thesis), runs, volume, *ours])
        front = None if run is None else run.record.final_values
        panels.append(FrontPanel(published.name, published.objectives, {"Momba": front, "Fixed preferences": reference}))
    is_drawn = figures.draw_fronts(panels, file(folder, "4.5"))
    said = "Runs trained and evaluated for one preference each, all that finished, beside one run of Momba.\n"
    return "\n".join([picture("4.5", "Momba beside runs of fixed preferences", is_drawn), said, markdown(rows)])


def figure_4_7(tasks: Tasks, folder: Path) -> str:
    unit = ablation_units(tasks)
    found = {
        group: {title: aggregate(tasks, labels, "hypervolume", unit) for title, labels in methods.items()}
        for group, methods in layout.VALUES.items()
    }
    rows = [["configuration", "values", "runs", "tasks", NORMALISED_HV]]
    rows += [[group, title, *aggregate_cells(one)] for group, members in found.items() for title, one in members.items()]
    is_drawn = figures.draw_groups(found, NORMALISED_HV, file(folder, "4.7"))
    return "\n".join(
        [
            picture("4.7", "Vector and scalarised values", is_drawn),
            markdown(rows),
            unit_note(tasks, unit, "Momba", "hypervolume"),
            notes(tasks, joined(layout.VALUES)),
        ]
    )


def joined(groups: dict[str, Methods]) -> Methods:
    return {f"{group} {title}": labels for group, methods in groups.items() for title, labels in methods.items()}


def figure_4_8(tasks: Tasks, folder: Path) -> str:
    unit = ablation_units(tasks)
    rows = [["configuration", "critic's hidden dimension", "critic parameters", "runs", "tasks", NORMALISED_HV]]
    lines = {}
    for group, methods in layout.SCALING.items():
        points = []
        for width, labels in methods.items():
            one, size = aggregate(tasks, labels, "hypervolume", unit), critic_parameters(tasks, labels)
            rows.append([group, width, MISSING if size is None else f"{size:,.0f}", *aggregate_cells(one)])
            if one.estimate is not None and size is not None:
                points.append((size, one.estimate))
        lines[group] = points
    is_drawn = figures.draw_scaling(lines, NORMALISED_HV, file(folder, "4.8"))
    return "\n".join(
        [
            picture("4.8", "Hypervolume over the critic's size", is_drawn),
            markdown(rows),
            unit_note(tasks, unit, "Momba", "hypervolume"),
            notes(tasks, joined(layout.SCALING)),
        ]
    )


def figure_4_9(tasks: Tasks, folder: Path) -> str:
    unit = ablation_units(tasks)
    found = {title: aggregate(tasks, labels, "hypervolume", unit) for title, labels in layout.NORMALISATION.items()}
    worth, common = normalisation_worth(tasks, layout.NORMALISATION)
    values = shapley_values(worth) if worth else {}
    is_drawn = figures.draw_normalisation(found, values, NORMALISED_HV, file(folder, "4.9"))
    parts = [picture("4.9", "Normalisation components and their Shapley values", is_drawn)]
    parts += [aggregate_table("normalisation", found, NORMALISED_HV)]
    if values:
        total = sum(values.values())
        rows = [["component", "Shapley value", "share"]]
        rows += [[name, f"{value:.4g}", f"{value / total:.0%}" if total > 0 else ""] for name, value in values.items()]
        parts += [f"Shapley values of the IQM of the normalised hypervolume, over {names(common)}.\n", markdown(rows)]
    else:
        parts.append("Shapley values: missing, no task has runs of all eight combinations.\n")
    return "\n".join([*parts, unit_note(tasks, unit, "Momba", "hypervolume"), notes(tasks, layout.NORMALISATION)])


def table_4_4(tasks: Tasks, folder: Path) -> str:
    note = unit_note(tasks, ablation_units(tasks), "Momba", "hypervolume")
    return "\n".join([tables.table_4_4(tasks), note, notes(tasks, layout.CONDITIONING)])


def figure_4_10(tasks: Tasks, folder: Path) -> str:
    panels = [
        CurvePanel(
            read_thesis().tasks[env].name,
            SHORT["hypervolume"],
            {title: curve_of(runs_of(task, labels), "hypervolume") for title, labels in layout.UTD.items()},
        )
        for env, task in tasks.items()
    ]
    is_drawn = figures.draw_curves(panels, file(folder, "4.10"))
    return "\n".join([picture("4.10", "Hypervolume over steps for each UTD ratio", is_drawn), notes(tasks, layout.UTD)])


def table_4_5(tasks: Tasks, folder: Path) -> str:
    said = (
        "IGD to the convex envelope of all final solutions on a task, of every run and method among the records, on axes on "
        "which that envelope goes from 0 to 1: it changes with the records.\n"
    )
    note = unit_note(tasks, ablation_units(tasks), "Momba", "hypervolume")
    return "\n".join([tables.table_4_5(tasks), said, note, notes(tasks, layout.IMPROVEMENTS)])


def figure_4_11(tasks: Tasks, folder: Path) -> str:
    return fronts(tasks, folder, "4.11", "Fronts with HER and PAR", layout.IMPROVEMENTS)


SECTIONS = {
    "Table 4.2: the algorithms": table_4_2,
    "Figure 4.1: aggregate performance": figure_4_1,
    "Table 4.3: results per environment": table_4_3,
    "Figure 4.2: fronts": figure_4_2,
    "Figure 4.3: training curves": figure_4_3,
    "Figure 4.4: sample efficiency": figure_4_4,
    "Figure 4.5: fixed preferences": figure_4_5,
    "Figure 4.7: value representation": figure_4_7,
    "Figure 4.8: critic scaling": figure_4_8,
    "Figure 4.9: normalisation": figure_4_9,
    "Table 4.4: conditioning": table_4_4,
    "Figure 4.10: updates per step": figure_4_10,
    "Table 4.5: HER and PAR": table_4_5,
    "Figure 4.11: fronts with HER and PAR": figure_4_11,
}
