"""A grid of runs on Ray: on this machine, or on all those of a cluster.

What must survive lies in the runs' own folders: their records and checkpoints. So a run whose process, node or sweep is killed
goes on from its newest checkpoint, and its record is that of a run that nothing happened to. All nodes need the output folder
under one path, with file locks.
"""

import argparse
import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sb3_momba.benchmark import execution, grid
from sb3_momba.benchmark.ending import end
from sb3_momba.benchmark.grid import Cell


def run_sweep(
    cells: Sequence[Cell],
    output: Path,
    address: str | None = None,
    workers: int | None = None,
    threads: int = 1,
    gpus: float = 0.0,
    max_failures: int = 10,
    retry_failed: bool = False,
) -> dict[str, str]:
    """Run what has not ended yet: see `execution.run_cells`.

    :param address: of a Ray cluster, "host:port" or "auto" for the one that this machine is part of; None: this machine alone
    :param workers: runs side by side; by default as many as there are processors for
    :param threads: processors of each run
    :param gpus: share of a GPU of each run (untested)
    :param max_failures: how often a run may lose its process before this sweep gives it up
    :param retry_failed: run again what failed
    :raises ImportError: without Ray
    :raises ConnectionError: if no cluster answers
    """
    try:
        from sb3_momba.benchmark import trials
    except ImportError as error:
        raise ImportError(f'A sweep needs Ray: pip install "sb3-momba[benchmark]" ({error}).') from error
    for name, value, least in (
        ("workers", workers, 1),
        ("threads", threads, 1),
        ("gpus", gpus, 0),
        ("max_failures", max_failures, 0),
    ):
        if value is not None and value < least:
            raise ValueError(f"{name}={value}: it must be at least {least}.")
    processors = os.cpu_count() or 1
    if address is None and threads > processors:
        raise ValueError(f"threads={threads}: this machine has {processors} processors.")
    n = workers or processors // threads

    def on_ray(waiting: Sequence[Cell], settings: Mapping[str, Any]) -> dict[str, str]:
        with trials.cluster(address, n * threads, threads):
            at_most = n if address is None else workers
            return trials.run_trials(waiting, settings, output.resolve(), at_most, threads, gpus, max_failures, retry_failed)

    return execution.run_cells(cells, output.resolve(), on_ray, retry_failed)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    grid.add_arguments(parser)
    parser.add_argument("--address", help='of a Ray cluster, "host:port" or "auto"; by default this machine alone')
    parser.add_argument("--workers", type=int, help="runs side by side; by default as many as there are processors for")
    parser.add_argument("--threads", type=int, default=1, help="processors of each run")
    parser.add_argument("--gpus", type=float, default=0.0, help="share of a GPU of each run")
    parser.add_argument("--max-failures", type=int, default=10, help="how often a run may lose its process")


def main(given: argparse.Namespace, options: Sequence[str]) -> None:
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    failures = run_sweep(
        grid.cells_of(given, options),
        given.output,
        given.address,
        given.workers,
        given.threads,
        given.gpus,
        given.max_failures,
        given.retry_failed,
    )
    end(failures, given.output, given.report)
