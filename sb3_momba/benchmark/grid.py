"""Every configuration on every environment with every seed, each run in a process of its own.

A cell whose run ended, well or badly, is not run again; one that was cut off is. So the same command goes on where it stopped.
"""

import argparse
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import gymnasium as gym

from sb3_momba.records import FILE_NAME, UNENDED, read_record
from sb3_momba.zoo.configuration import read_configuration

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Cell:
    """One run.

    :param conf: yaml file or name of a shipped configuration
    :param options: further ones of `python -m sb3_momba.train`
    """

    conf: str
    env: str
    seed: int
    options: tuple[str, ...] = field(default=())

    @property
    def name(self) -> str:
        return f"{Path(self.conf).stem}/{self.env}/{self.seed}"

    def command(self, folder: Path) -> list[str]:
        where = ["--conf", self.conf, "--env", self.env, "--seed", str(self.seed), "--output", str(folder)]
        return [sys.executable, "-m", "sb3_momba.train", *where, "--no-progress-bar", *self.options]


def make_cells(
    confs: Sequence[str], envs: Sequence[str], seeds: int, options: Sequence[str] = (), auto_ent_coef: float | None = None
) -> list[Cell]:
    """Seeds vary slowest, so that whatever is finished compares all methods.

    :param auto_ent_coef: where configurations that learn alpha start it, all alike
    :raises ValueError: for a configuration that does not exist
    :raises gymnasium.error.Error: for an environment that does not exist, naming the nearest
    """
    for env in envs:
        gym.spec(env)
    cells = []
    for seed in range(seeds):
        for env in envs:
            for conf in confs:
                learned = str(read_configuration(conf, env).hyperparameters.get("ent_coef", "auto")).startswith("auto")
                start = ("--ent-coef", f"auto_{auto_ent_coef}") if auto_ent_coef is not None and learned else ()
                cells.append(Cell(conf, env, seed, (*start, *options)))
    return cells


def run_grid(cells: Sequence[Cell], output: Path, processes: int = 2) -> int:
    """Run what has not ended yet; the number of runs that failed, now or before."""
    with ThreadPoolExecutor(processes) as pool:
        return sum(pool.map(lambda cell: _run_cell(cell, output), cells))


def _run_cell(cell: Cell, output: Path) -> bool:
    """Whether the run failed."""
    folder = output / cell.name
    record = folder / FILE_NAME
    error = read_record(record).error if record.exists() else UNENDED
    if error == UNENDED:
        logger.info("%s starts", cell.name)
        shutil.rmtree(folder, ignore_errors=True)
        folder.parent.mkdir(parents=True, exist_ok=True)
        with open(folder.with_name(f"{cell.seed}.log"), "wb") as log:
            # Runs side by side share the cores: one thread each.
            environment = {**os.environ, "OMP_NUM_THREADS": "1"}
            subprocess.run(cell.command(folder), stdout=log, stderr=subprocess.STDOUT, env=environment, check=False)
        error = read_record(record).error if record.exists() else f"it did not start, see {log.name}"
    logger.info("%s %s", cell.name, "finished" if error is None else f"failed: {error}")
    return error is not None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--conf", nargs="+", required=True, help="shipped configurations or yaml files")
    parser.add_argument("--env", nargs="+", required=True, help="environment ids")
    parser.add_argument("--seeds", type=int, required=True, help="how many: 0, 1, ...")
    parser.add_argument("--output", type=Path, required=True, help="folder of the run folders")
    parser.add_argument("--processes", type=int, default=2, help="runs side by side, one thread each")
    parser.add_argument(
        "--auto-ent-coef", type=float, help="where every configuration that learns alpha starts it; 0.01 below 200,000 steps"
    )
    parser.epilog = "Every other option is handed to python -m sb3_momba.train, such as --steps 3e4."


def main(given: argparse.Namespace, options: Sequence[str]) -> None:
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    failed = run_grid(
        make_cells(given.conf, given.env, given.seeds, options, given.auto_ent_coef), given.output, given.processes
    )
    if failed:
        sys.exit(f"error: {failed} runs failed; their logs lie beside their folders in {given.output}.")
