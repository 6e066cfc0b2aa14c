"""What the records are beside the thesis's experiments: which runs there are, and in what they differ."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

from sb3_momba.baselines.schedules import script_of
from sb3_momba.benchmark.chapter4.layout import FIXED, MAIN, Labels, Methods, all_labels
from sb3_momba.benchmark.chapter4.scores import Tasks, runs_of, settings_of
from sb3_momba.benchmark.chapter4.thesis import read_thesis
from sb3_momba.benchmark.results import Run, Task
from sb3_momba.benchmark.tables import markdown
from sb3_momba.envs.registry import raw_id
from sb3_momba.methods import flat, setting_text
from sb3_momba.pareto import protocol
from sb3_momba.recording import plain
from sb3_momba.records import Record
from sb3_momba.zoo.configuration import N_TIMESTEPS, read_configuration, shipped_configurations, with_defaults

MISSING = "missing"
# Labels of methods that have no configuration of MOMBA, beside those of Table 4.2 (section 4.2.3).
STEPS_OF = {"gpi_ls_utd_1": "GPI-LS"}


def names(envs: Iterable[str]) -> str:
    return ", ".join(read_thesis().tasks[env].name for env in envs)


def coverage_table(tasks: Tasks) -> str:
    """Finished runs of all, by label and task."""
    labels = sorted({label for task in tasks.values() for label in task.methods} & all_labels())
    rows = [["label", *(task.name for task in read_thesis().tasks.values())]]
    for label in labels:
        runs = [tasks[env].methods.get(label, []) if env in tasks else [] for env in read_thesis().tasks]
        rows.append([label, *(f"{sum(run.is_finished for run in one)}/{len(one)}" if one else MISSING for one in runs)])
    fixed = [tasks[env].fixed_preference if env in tasks else [] for env in read_thesis().tasks]
    if any(fixed):
        cells = [f"{sum(r.error is None for r in one)}/{len(one)}" if one else MISSING for one in fixed]
        rows.append([FIXED, *cells])
    return markdown(rows)


def not_shown(tasks: Tasks, records: Sequence[Record]) -> list[str]:
    """Tasks without records, and what is among the records and in no table or figure."""
    others = sorted({record.task for record in records if raw_id(record.env) not in read_thesis().tasks})
    labels = sorted({label for task in tasks.values() for label in task.methods} - all_labels())
    lines = []
    lacking = [env for env in read_thesis().tasks if env not in tasks]
    if lacking:
        lines.append(f"No records at all, and missing everywhere: {names(lacking)}.\n")
    if others:
        lines.append(f"Not tasks of the thesis, and left out: {', '.join(others)}.\n")
    if labels:
        lines.append(
            f"Labels of no table or figure, whose runs only widen the front of Table 4.5: {', '.join(labels)}. "
            "`layout.py` says which labels are shown.\n"
        )
    return lines


def missing_note(tasks: Tasks, methods: Methods) -> str:
    """Names the cells without runs on tasks that have records; empty where there are none."""
    lacking: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for title, labels in methods.items():
        lacking[tuple(env for env, task in tasks.items() if not runs_of(task, labels))].append(title)
    lacking.pop((), None)
    said = [f"{', '.join(some)} ({'all tasks' if len(envs) == len(tasks) else names(envs)})" for envs, some in lacking.items()]
    return f"Missing: {'; '.join(said)}.\n" if said else ""


def steps_note(tasks: Tasks, methods: Methods) -> str:
    """Says of methods that stand side by side that they did not have the same steps; empty where they had."""
    steps = {title: sorted({run.record.planned_steps for run in all_runs(tasks, labels)}) for title, labels in methods.items()}
    steps = {title: some for title, some in steps.items() if some}
    if len({step for some in steps.values() for step in some}) < 2:
        return ""
    return f"Steps: {'; '.join(f'{title} {listed(some)}' for title, some in steps.items())}.\n"


def all_runs(tasks: Tasks, labels: Labels) -> list[Run]:
    return [run for task in tasks.values() for run in runs_of(task, labels)]


def listed(numbers: Iterable[float]) -> str:
    return " or ".join(f"{number:,.0f}" for number in numbers)


def differences(tasks: Tasks) -> list[str]:
    """In which settings the records differ from the thesis's, one line for the labels that differ alike.

    The thesis's settings of a label are those of the configuration of its name, its steps those of Table 4.2 where there is
    none, and the protocol that of section 4.1.2.
    """
    by_label: dict[str, list[Record]] = defaultdict(list)
    for task in tasks.values():
        for record in recorded_on(task):
            by_label[record.label].append(record)
    alike: dict[str, list[str]] = defaultdict(list)
    for label in sorted(by_label):
        found: dict[tuple[str, str], set[str]] = defaultdict(set)
        for record in by_label[label]:
            for name, (ours, published) in differing(record).items():
                found[name, published].add(ours)
        said = [f"{name} {' or '.join(sorted(ours))} instead of {thesis}" for (name, thesis), ours in sorted(found.items())]
        if said:
            alike["; ".join(said)].append(label)
    return [f"- {', '.join(labels)}: {said}." for said, labels in alike.items()]


def recorded_on(task: Task) -> list[Record]:
    return [run.record for runs in task.methods.values() for run in runs] + task.fixed_preference


def differing(record: Record) -> dict[str, tuple[str, str]]:
    """The settings of one record that differ: ours and the thesis's."""
    published = published_settings(record)
    ours: dict[str, Any] = settings_of(record) | flat({"env_kwargs": record.env_kwargs})
    found = {}
    for name in sorted(name for name in ours if name in published or name.startswith("env_kwargs.")):
        own, theirs = ours[name], published.get(name)
        if not matches(own, theirs):
            said = range_text(theirs) if isinstance(theirs, tuple) else number_text(theirs)
            found[name.removeprefix("hyperparameters.")] = number_text(own), said
    return found


def published_settings(record: Record) -> dict[str, Any]:
    """Of a record's label, flat; a tuple is a range. PGMORL's steps are those of its authors' script for the task."""
    settings: dict[str, Any] = {"n_preferences": protocol.N_PREFERENCES, "n_episodes": protocol.N_EPISODES}
    configuration = "momba" if record.label == FIXED else record.label
    if configuration in shipped_configurations() and "hyperparameters" in record.config:
        read = read_configuration(configuration, raw_id(record.env))
        settings |= {
            "steps": read.n_timesteps or N_TIMESTEPS,
            "policy": read.policy,
            "n_envs": read.n_envs,
            "hyperparameters": plain(with_defaults(read.policy, read.hyperparameters)),
        }
    found = flat(settings)
    method = STEPS_OF.get(record.label) or next((title for title, labels in MAIN.items() if record.label in labels), None)
    if "steps" not in found and method is not None:
        found["steps"] = float(script_of(record.env).steps) if method == "PGMORL" else read_thesis().methods[method].steps
    if method == "DPMORL":
        found["hyperparameters.augment_state"] = False  # The thesis's parameters are those of policies that see no returns.
    return found


def matches(ours: Any, published: Any) -> bool:
    if isinstance(published, tuple):
        return isinstance(ours, float) and published[0] <= ours <= published[1]
    return repr(ours) == repr(published)


def number_text(value: Any) -> str:
    if value is None:
        return "the default"
    return f"{value:,.0f}" if isinstance(value, float) and value >= 1_000 else setting_text(value)


def range_text(numbers: tuple[float, float]) -> str:
    low, high = numbers
    return f"{low:,.0f}" if low == high else f"{low:,.0f} to {high:,.0f}"
