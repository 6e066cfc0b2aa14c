"""Every configuration on every environment with every seed, each run in a process of its own.

A cell whose run ended, well or badly, is not run again; one that was cut off is. So the same command goes on where it stopped.
"""

import argparse
import contextlib
import fcntl
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from sb3_momba.envs.wrappers import make_env
from sb3_momba.momba import parse_ent_coef
from sb3_momba.records import FILE_NAME, UNENDED, is_cut_off_at_its_start, read_record
from sb3_momba.train import RunSettings, parse, recorded_settings
from sb3_momba.zoo.configuration import check_hyperparameters, read_configuration

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

    def arguments(self, folder: Path) -> list[str]:
        """Of `python -m sb3_momba.train`."""
        where = ["--conf", self.conf, "--env", self.env, "--seed", str(self.seed), "--output", str(folder)]
        return [*self.options, *where, "--no-progress-bar"]


def make_cells(
    confs: Sequence[str], envs: Sequence[str], seeds: int, options: Sequence[str] = (), auto_ent_coef: float | None = None
) -> list[Cell]:
    """Seeds vary slowest, so that whatever is finished compares all methods.

    :param seeds: how many
    :param auto_ent_coef: where configurations that learn alpha start it, all alike
    :raises ValueError: for a configuration that does not exist, or two of one name
    """
    if seeds < 1:
        raise ValueError(f"seeds={seeds}: at least one is needed.")
    cells: dict[str, Cell] = {}
    for seed in range(seeds):
        for env in dict.fromkeys(envs):
            for conf in dict.fromkeys(confs):
                learned, _ = parse_ent_coef(read_configuration(conf, env).hyperparameters.get("ent_coef", "auto"))
                start = ("--ent-coef", f"auto_{auto_ent_coef}") if auto_ent_coef is not None and learned else ()
                cell = Cell(conf, env, seed, (*start, *options))
                if cell.name in cells:
                    raise ValueError(f"{cells[cell.name].conf} and {conf} have one name, {cell.name}: rename one of them.")
                cells[cell.name] = cell
    return list(cells.values())


def run_grid(cells: Sequence[Cell], output: Path, processes: int = 2) -> int:
    """Run what has not ended yet; the number of runs that failed, now or before.

    :raises ValueError: for unknown hyperparameters, a folder that holds something else or where another grid runs, before
        anything runs
    :raises gymnasium.error.Error: for an environment that does not exist, naming the nearest
    """
    if processes < 1:
        raise ValueError(f"processes={processes}: at least one is needed.")
    settings = {cell.name: parse(cell.arguments(output / cell.name)) for cell in cells}
    for one in settings.values():
        check_hyperparameters(one.policy, one.hyperparameters)
    for env, env_kwargs in {one.env: one.env_kwargs for one in settings.values()}.items():
        make_env(env, env_kwargs).close()
    output.mkdir(parents=True, exist_ok=True)
    with alone_in(output):
        waiting = [cell for cell in cells if has_to_run(output / cell.name, settings[cell.name])]
        with ThreadPoolExecutor(processes) as pool:
            list(pool.map(lambda cell: _run_cell(cell, output / cell.name), waiting))
    return sum(outcome(output / cell.name) is not None for cell in cells)


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """:raises ValueError: if another process is in here with the same folder"""
    with open(folder / ".lock", "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(f"Another grid runs in {folder}: wait for it, or choose another --output.") from error
        yield


def has_to_run(folder: Path, settings: RunSettings) -> bool:
    """Whether a cell never ran or was cut off.

    :raises ValueError: if its folder holds anything but a run with these settings
    """
    record = folder / FILE_NAME
    if not record.exists() or is_cut_off_at_its_start(record):
        if folder.exists() and (not folder.is_dir() or any(file.name != FILE_NAME for file in folder.iterdir())):
            raise ValueError(f"{folder} holds something else than a run: choose another --output.")
        return True
    found, wanted = read_record(record), recorded_settings(settings)
    if found.config != wanted:
        differing = sorted(name for name in {*wanted, *found.config} if wanted.get(name) != found.config.get(name))
        raise ValueError(f"{folder} holds a run with other settings ({', '.join(differing)}): choose another --output.")
    return found.error == UNENDED


def _run_cell(cell: Cell, folder: Path) -> None:
    logger.info("%s starts", cell.name)
    if folder.exists():
        shutil.rmtree(folder)  # What was cut off; see `has_to_run`.
    folder.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "sb3_momba.train", *cell.arguments(folder)]
    with open(log_of(folder), "wb") as log:
        # Runs side by side share the cores: one thread each.
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=environment, check=False)
    error = outcome(folder)
    logger.info("%s %s", cell.name, "finished" if error is None else f"failed: {error}")


def outcome(folder: Path) -> str | None:
    """Why a run failed; None for one that finished."""
    record = folder / FILE_NAME
    if record.exists() and not is_cut_off_at_its_start(record):
        return read_record(record).error
    said = log_of(folder).read_text(errors="replace").strip() if log_of(folder).exists() else ""
    return f"it did not start: {said.splitlines()[-1] if said else 'no output'}"


def log_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.log")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--conf", nargs="+", required=True, help="shipped configurations or yaml files")
    parser.add_argument("--env", nargs="+", required=True, help="environment ids")
    parser.add_argument("--seeds", type=int, required=True, help="how many; they are 0, 1, ...")
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
