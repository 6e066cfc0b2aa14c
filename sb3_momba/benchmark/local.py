"""A grid of runs on this machine, each in a process of its own.

A cell whose run ended, well or badly, is not run again; one that was cut off is. So the same command goes on where it stopped.
"""

import argparse
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import IO, Any

from sb3_momba.benchmark import execution, grid
from sb3_momba.benchmark.ending import end
from sb3_momba.benchmark.grid import Cell
from sb3_momba.files import FileFormatError, FolderInUseError
from sb3_momba.train import INTERRUPTED, as_arguments, running_options

logger = logging.getLogger(__name__)


class Trainings:
    """The processes that train, which end with their grid."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.RLock()  # A second signal may come while the first is dealt with.
        self._are_over = False

    def run(self, command: Sequence[str], log: IO[bytes]) -> int:
        """Until it ends; its return code, negative for a signal."""
        with self._lock:
            if self._are_over:
                return -signal.SIGTERM
            # Runs side by side share the cores: one thread each.
            environment = {**os.environ, "OMP_NUM_THREADS": "1"}
            process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)
            self._running.add(process)
        ended = process.wait()
        with self._lock:
            self._running.remove(process)
        return ended

    def end(self, *of_the_signal: Any) -> None:
        """What SIGTERM does to the grid; Ctrl-C reaches all of its processes by itself."""
        with self._lock:
            self._are_over = True
            for process in list(self._running):
                process.terminate()
        raise KeyboardInterrupt


def run_grid(cells: Sequence[Cell], output: Path, processes: int = 2, retry_failed: bool = False) -> dict[str, str]:
    """Run what has not ended yet: see `execution.run_cells`.

    :param processes: runs side by side
    """
    if processes < 1:
        raise ValueError(f"processes={processes}: at least one is needed.")

    def side_by_side(waiting: Sequence[Cell], settings: Mapping[str, Any]) -> dict[str, str]:
        trainings = Trainings()
        with execution.on_sigterm(trainings.end), ThreadPoolExecutor(processes) as pool:
            try:
                said = list(pool.map(lambda cell: _run_cell(cell, settings[cell.name], retry_failed, trainings), waiting))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        return {cell.name: error for cell, error in zip(waiting, said, strict=True) if error is not None}

    return execution.run_cells(cells, output, side_by_side, retry_failed)


def _run_cell(cell: Cell, settings: Any, retry_failed: bool, trainings: Trainings) -> str | None:
    """What kept it from running, if anything did."""
    logger.info("%s starts", cell.name)
    folder = Path(settings.output)
    try:
        way = execution.way_to_run(folder, retry_failed)
    except (FolderInUseError, FileFormatError, OSError) as error:
        logger.info("%s is left alone: %s", cell.name, error)
        return str(error)
    if way is not None:
        resuming = ["--resume", str(folder), "--no-progress-bar", *as_arguments(running_options(cell.options))]
        arguments = resuming if way == "go on" else cell.arguments(folder)
        command = [sys.executable, "-m", cell.program.module, *arguments]
        with open(execution.log_of(folder), "ab" if way == "go on" else "wb") as log:
            ended = trainings.run(command, log)
        if execution.state_of(folder) == "not begun" and ended > 0 and ended not in INTERRUPTED:
            said = execution.log_of(folder).read_text(errors="replace").rstrip()
            last = said.splitlines()[-1] if said else "no output"
            cell.program.runs.record_failure(settings, f"it did not start: {last}", said)
    state = execution.state_of(folder)
    logger.info("%s %s", cell.name, state if state != "not begun" else "did not begin")
    return None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    grid.add_arguments(parser)
    parser.add_argument("--processes", type=int, default=2, help="runs side by side, one thread each")


def main(given: argparse.Namespace, options: Sequence[str]) -> None:
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    failures = run_grid(grid.cells_of(given, options), given.output, given.processes, given.retry_failed)
    end(failures, given.output, given.report)
