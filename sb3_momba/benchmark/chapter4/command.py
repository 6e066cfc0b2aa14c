"""`python -m sb3_momba.benchmark chapter4 RECORDS`: chapter4.md and one picture for each figure."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_momba.benchmark.chapter4.differences import coverage_table, differences, not_shown
from sb3_momba.benchmark.chapter4.scores import Tasks, in_order, tasks_of
from sb3_momba.benchmark.chapter4.sections import SECTIONS
from sb3_momba.benchmark.chapter4.thesis import read_thesis
from sb3_momba.benchmark.report import add_records, failures, folder_of, provenance, records_of, repeated_seeds
from sb3_momba.files import atomic_write
from sb3_momba.records import Record

EXPLANATION = """\
Made from records alone; the thesis's values stand beside. Scores are the IQM of the runs with its 95 % interval from a
stratified bootstrap, which is too narrow where there are few seeds; of a single run they are the value alone. Runs: those that
finished, of all. A run that failed or did not end counts with the hypervolume 0 and with the worst expected utility and IGD
among the floors and the finished runs of its task. Aggregates are in units of one method's IQM on each task, over the tasks
named beside them, and can be compared where these are the same. Methods of several policies are scored on their own policies,
general ones on the preferences of the evaluation. What has no runs is missing.
"""


def write_chapter(records: Sequence[Record], folder: Path) -> str:
    """Write chapter4.md and its pictures into a folder; the text.

    :raises ValueError: for records of no task of the thesis, or that cannot stand in one table
    """
    tasks = tasks_of(records)
    if not tasks:
        found = ", ".join(sorted({record.task for record in records}))
        raise ValueError(
            f"No record is of a task of chapter 4, {', '.join(read_thesis().tasks)}; the records are of {found}. "
            "python -m sb3_momba.benchmark report compares records of any task."
        )
    folder.mkdir(parents=True, exist_ok=True)
    parts = ["# Chapter 4 from records\n", EXPLANATION, *of_the_records(tasks, records)]
    for title, section in SECTIONS.items():
        parts += [f"## {title}\n", section(tasks, folder)]
    for picture in folder.glob("figure-4.*.png"):
        if not any(f"({picture.name})" in part for part in parts):  # of other records
            picture.unlink()
    parts += [failures(list(tasks.values())), provenance(in_order(records))]
    text = "\n".join(part.rstrip("\n") + "\n" for part in parts if part)
    with atomic_write(folder / "chapter4.md") as file:
        file.write(text.encode())
    return text


def of_the_records(tasks: Tasks, records: Sequence[Record]) -> list[str]:
    """Which there are, and what they are beside the thesis's experiments."""
    differing = differences(tasks)
    parts = ["## The records\n", coverage_table(tasks), *not_shown(tasks, records)]
    parts += [f"Recorded more than once on {task.name}: {one}.\n" for task in tasks.values() for one in repeated_seeds(task)]
    if differing:
        parts += ["**Not run as in the thesis**, so that the values beside are not what these records should reach:\n"]
        parts += ["\n".join(differing) + "\n"]
    return parts


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_records(parser)


def main(given: argparse.Namespace) -> None:
    records = records_of(given)
    folder = folder_of(given)
    write_chapter(records, folder)
    print(f"Written to {folder / 'chapter4.md'}.")
