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

from sb3_momba.benchmark.results import flat
from sb3_momba.checkpoints.folders import newest
from sb3_momba.files import LOCK, FileFormatError, alone_in
from sb3_momba.records import FILE_NAME, UNENDED, is_cut_off_at_its_start, read_record
from sb3_momba.runs import CHECKPOINTS, RunSettings, prepared, record_failure, recorded_settings
from sb3_momba.settings import parse_ent_coef
from sb3_momba.train import parse
from sb3_momba.zoo.configuration import read_configuration, with_later_settings

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
    for option in ("--seed", "--output"):
        if any(given.split("=")[0] == option for given in options):
            raise ValueError(f"{option} is the grid's own for each run: give --seeds and the grid's --output.")
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


def run_grid(cells: Sequence[Cell], output: Path, processes: int = 2, retry_failed: bool = False) -> list[str]:
    """Run what has not ended yet; the names of the runs that failed, now or before.

    :param retry_failed: run again what failed
    :raises ValueError: for settings that cannot be, a folder that holds something else or where another grid runs, before
        anything runs
    :raises gymnasium.error.Error: for an environment that does not exist, naming the nearest
    """
    if processes < 1:
        raise ValueError(f"processes={processes}: at least one is needed.")
    settings = {cell.name: parse(cell.arguments(output / cell.name)) for cell in cells}
    for one in {(cell.conf, cell.env): settings[cell.name] for cell in cells}.values():
        with prepared(one):
            pass
    output.mkdir(parents=True, exist_ok=True)
    with alone_in(output):
        waiting = [cell for cell in cells if has_to_run(output / cell.name, settings[cell.name], retry_failed)]
        with ThreadPoolExecutor(processes) as pool:
            list(pool.map(lambda cell: _run_cell(cell, settings[cell.name]), waiting))
    return [cell.name for cell in cells if read_record(output / cell.name / FILE_NAME).error is not None]


def has_to_run(folder: Path, settings: RunSettings, retry_failed: bool = False) -> bool:
    """Whether a cell never ran or was cut off.

    :raises ValueError: if its folder holds anything but a run with these settings
    """
    record = folder / FILE_NAME
    if not record.exists() or is_cut_off_at_its_start(record):
        if folder.exists() and (not folder.is_dir() or any(file.name not in (FILE_NAME, LOCK) for file in folder.iterdir())):
            raise ValueError(f"{folder} holds something else than a run: choose another --output.")
        return True
    found, wanted = read_record(record), recorded_settings(settings)
    config = with_later_settings(found.config)
    if config != wanted:
        theirs, ours = flat(config), flat(wanted)
        differing = sorted(name for name in {*theirs, *ours} if theirs.get(name) != ours.get(name))
        raise ValueError(f"{folder} holds a run with other settings ({', '.join(differing)}): choose another --output.")
    return found.error == UNENDED or (retry_failed and found.error is not None)


def _run_cell(cell: Cell, settings: RunSettings) -> None:
    logger.info("%s starts", cell.name)
    folder = Path(settings.output)
    goes_on = can_go_on(folder)
    if folder.exists() and not goes_on:
        shutil.rmtree(folder)  # What was cut off or failed; see `has_to_run`.
    folder.parent.mkdir(parents=True, exist_ok=True)
    arguments = ["--resume", str(folder), "--no-progress-bar"] if goes_on else cell.arguments(folder)
    command = [sys.executable, "-m", "sb3_momba.train", *arguments]
    with open(log_of(folder), "ab" if goes_on else "wb") as log:
        # Runs side by side share the cores: one thread each.
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=environment, check=False)
    record = folder / FILE_NAME
    if not record.exists() or is_cut_off_at_its_start(record):
        record.unlink(missing_ok=True)
        said = log_of(folder).read_text(errors="replace").split("\n")
        record_failure(settings, f"it did not start: {next((line for line in reversed(said) if line.strip()), 'no output')}")
    error = read_record(record).error
    logger.info("%s %s", cell.name, "finished" if error is None else f"failed: {error}")


def can_go_on(folder: Path) -> bool:
    """Whether a run was cut off, and left a checkpoint that is whole."""
    record = folder / FILE_NAME
    if not record.exists() or is_cut_off_at_its_start(record) or read_record(record).error != UNENDED:
        return False
    try:
        newest(folder / CHECKPOINTS)
    except (FileNotFoundError, FileFormatError):
        return False
    return True


def log_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.log")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--conf", nargs="+", required=True, help="shipped configurations or yaml files")
    parser.add_argument("--env", nargs="+", required=True, help="environment ids")
    parser.add_argument("--seeds", type=int, required=True, help="how many; they are 0, 1, ...")
    parser.add_argument("--output", type=Path, required=True, help="folder of the run folders")
    parser.add_argument("--processes", type=int, default=2, help="runs side by side, one thread each")
    parser.add_argument("--retry-failed", action="store_true", help="run again what failed")
    parser.add_argument(
        "--auto-ent-coef", type=float, help="where every configuration that learns alpha starts it; 0.01 below 200,000 steps"
    )
    parser.epilog = "Every other option is handed to python -m sb3_momba.train, such as --steps 3e4."


def main(given: argparse.Namespace, options: Sequence[str]) -> None:
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    cells = make_cells(given.conf, given.env, given.seeds, options, given.auto_ent_coef)
    failed = run_grid(cells, given.output, given.processes, given.retry_failed)
    if failed:
        names = ", ".join(failed)
        sys.exit(f"error: {len(failed)} runs failed ({names}); their logs lie beside their folders in {given.output}.")
