"""The runs of a grid, whatever runs them: which of them still have to, from where, and which have failed."""

import contextlib
import errno
import logging
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from sb3_momba.benchmark.grid import Cell, checked
from sb3_momba.checkpoints.folders import newest
from sb3_momba.files import LOCK, FolderInUseError, alone_in
from sb3_momba.methods import flat
from sb3_momba.records import FILE_NAME, UNENDED, is_cut_off_at_its_start, read_record
from sb3_momba.runs import CHECKPOINTS
from sb3_momba.zoo.configuration import with_later_settings

LEAST_BYTES_FREE = 200_000_000  # of a disk, for a run to begin or go on: two checkpoints and a model of Momba's size
SECONDS_FOR_A_LOCK = 120.0  # in which the process that has lost a cell notices it and ends

logger = logging.getLogger(__name__)

State = Literal["not begun", "cut off", "failed", "finished"]
Runner = Callable[[Sequence[Cell], Mapping[str, Any]], dict[str, str]]


def state_of(folder: Path) -> State:
    """What has come of a run, by its record."""
    record = folder / FILE_NAME
    if not record.exists() or is_cut_off_at_its_start(record):
        return "not begun"
    error = read_record(record).error
    return "finished" if error is None else "cut off" if error == UNENDED else "failed"


def has_to_run(cell: Cell, settings: Any, retry_failed: bool = False) -> bool:
    """Whether a cell never ran, was cut off, or failed and is to be tried again.

    :raises ValueError: if its folder holds anything but a run with these settings
    """
    folder = Path(settings.output)
    state = state_of(folder)
    if state == "not begun":
        if folder.exists() and (not folder.is_dir() or any(file.name not in (FILE_NAME, LOCK) for file in folder.iterdir())):
            raise ValueError(f"{folder} holds something else than a run: choose another --output.")
        return True
    config = read_record(folder / FILE_NAME).config
    theirs, ours = flat(with_later_settings(config)), flat(cell.program.runs.recorded_settings(settings))
    differing = sorted(name for name in {*theirs, *ours} if theirs.get(name) != ours.get(name))
    if differing:
        raise ValueError(f"{folder} holds a run with other settings ({', '.join(differing)}): choose another --output.")
    return state == "cut off" or (state == "failed" and retry_failed)


def way_to_run(folder: Path, retry_failed: bool = False) -> Literal["begin", "go on"] | None:
    """How the process that got a cell runs it: from a checkpoint, or from the start, for which its folder is emptied; None:
    it has ended meanwhile.

    :raises FolderInUseError: if a process that had lost the cell still writes into the folder after two minutes
    :raises FileFormatError: if there are checkpoints, and none can be read
    :raises OSError: if the disk is full
    """
    with alone_soon_in(folder):
        state = state_of(folder)
        if state == "finished" or (state == "failed" and not retry_failed):
            return None
        check_space(folder)
        if state != "not begun":
            with contextlib.suppress(FileNotFoundError):
                newest(folder / CHECKPOINTS)
                return "go on"
        for path in folder.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name != LOCK:
                path.unlink()
        return "begin"


def check_space(folder: Path) -> None:
    """:raises OSError: if the disk is full, before a run fails on it"""
    free = shutil.disk_usage(folder).free
    if free < LEAST_BYTES_FREE:
        raise OSError(errno.ENOSPC, f"The disk is full, {free:,} bytes are left", str(folder))


@contextlib.contextmanager
def alone_soon_in(folder: Path) -> Iterator[None]:
    """`alone_in`, once the process that is there has ended."""
    until = time.monotonic() + SECONDS_FOR_A_LOCK
    with contextlib.ExitStack() as stack:
        while True:
            try:
                stack.enter_context(alone_in(folder))
                break
            except FolderInUseError:
                if time.monotonic() > until:
                    raise
                time.sleep(0.5)
        yield


def run_cells(cells: Sequence[Cell], output: Path, runner: Runner, retry_failed: bool = False) -> dict[str, str]:
    """Run what has not ended yet; the names of the cells that did not finish, now or before, each with what is known of it.

    :param runner: of the cells that have to run, with what their programs have read, by name; gives what those that did not
        finish have said last
    :param retry_failed: run again what failed
    :raises ValueError: for settings that cannot be, a folder that holds something else or where another grid runs, before
        anything runs
    :raises gymnasium.error.Error: for an environment that does not exist, naming the nearest
    :raises OSError: if the disk is full
    """
    settings = checked(cells, output)
    with alone_in(output):
        waiting = [cell for cell in cells if has_to_run(cell, settings[cell.name], retry_failed)]
        logger.info("%d of %d runs have to run", len(waiting), len(cells))
        if waiting:
            check_space(output)
        said = runner(waiting, settings) if waiting else {}
        return {name: said.get(name, error) for name, error in failed(cells, output).items()}


@contextlib.contextmanager
def on_sigterm(handler: Callable[..., None]) -> Iterator[None]:
    """Inside, what SIGTERM does; only in the main thread, as others cannot hear signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def log_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.log")


def failed(cells: Sequence[Cell], output: Path) -> dict[str, str]:
    """The cells that did not finish, by name, each with its traceback or, where it left none, its error."""
    found = {}
    for cell in cells:
        state = state_of(output / cell.name)
        if state == "not begun":
            found[cell.name] = "no record: it never began"
        elif state != "finished":
            record = read_record(output / cell.name / FILE_NAME)
            found[cell.name] = (record.traceback or str(record.error)).rstrip()
    return found
