"""Every configuration on every environment with every seed, each run in a process of its own.

A cell whose run ended, well or badly, is not run again; one that was cut off is. So the same command goes on where it stopped.
"""

import argparse
import logging
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from sb3_momba.benchmark import cells
from sb3_momba.benchmark.cells import Cell
from sb3_momba.files import alone_in
from sb3_momba.records import FILE_NAME, is_cut_off_at_its_start, read_record

logger = logging.getLogger(__name__)


def run_grid(grid: Sequence[Cell], output: Path, processes: int = 2, retry_failed: bool = False) -> dict[str, str]:
    """Run what has not ended yet; the names of the runs that failed, now or before, each with what is known of it.

    :param retry_failed: run again what failed
    :raises ValueError: for settings that cannot be, a folder that holds something else or where another grid runs, before
        anything runs
    :raises gymnasium.error.Error: for an environment that does not exist, naming the nearest
    """
    if processes < 1:
        raise ValueError(f"processes={processes}: at least one is needed.")
    settings = cells.checked(grid, output)
    with alone_in(output), ThreadPoolExecutor(processes) as pool:
        waiting = [cell for cell in grid if cells.has_to_run(cell, settings[cell.name], retry_failed)]
        list(pool.map(lambda cell: _run_cell(cell, settings[cell.name]), waiting))
    return cells.failed(grid, output)


def _run_cell(cell: Cell, settings: Any) -> None:
    logger.info("%s starts", cell.name)
    folder = Path(settings.output)
    goes_on = cells.goes_on(folder)
    arguments = ["--resume", str(folder), "--no-progress-bar"] if goes_on else cell.arguments(folder)
    command = [sys.executable, "-m", cell.program.module, *arguments]
    with open(cells.log_of(folder), "ab" if goes_on else "wb") as log:
        # Runs side by side share the cores: one thread each.
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=environment, check=False)
    record = folder / FILE_NAME
    if not record.exists() or is_cut_off_at_its_start(record):
        record.unlink(missing_ok=True)
        said = [line for line in cells.log_of(folder).read_text(errors="replace").splitlines() if line.strip()]
        cell.program.runs.record_failure(settings, f"it did not start: {said[-1] if said else 'no output'}")
    error = read_record(record).error
    logger.info("%s %s", cell.name, "finished" if error is None else f"failed: {error}")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    cells.add_arguments(parser)
    parser.add_argument("--processes", type=int, default=2, help="runs side by side, one thread each")


def main(given: argparse.Namespace, options: Sequence[str]) -> None:
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    failures = run_grid(cells.cells_of(given, options), given.output, given.processes, given.retry_failed)
    cells.end_with_failures(failures, given.output)
