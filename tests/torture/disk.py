"""A disk that is full at any byte."""

import os
import resource
import shutil
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import SAC

from sb3_momba import MOMBA, MombaCheckpointCallback
from sb3_momba.checkpoints.folders import checkpoints_in
from tests.torture.checkpoints import before_a_checkpoint, faults_of, write_into
from tests.torture.measured import Counts, Measured
from tests.torture.processes import new_folder, result_of
from tests.torture.trainings import new_model, new_sac


def size_of_files_limited_to(limit: int) -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))


def error_of(write: Callable[[], Any], limit: int) -> str:
    """The kind of error that a write ends with where no file may be longer than `limit`; "" for none."""
    size_of_files_limited_to(limit)
    try:
        write()
    except OSError:
        return "OSError"
    except BaseException as error:
        return f"{type(error).__name__}: {error}"
    return ""


def error_of_checkpoint(callback: MombaCheckpointCallback, folder: Path, limit: int) -> tuple[str, str]:
    """Of a checkpoint's write, and of the same again when there is room."""
    write_into(callback, folder)
    return error_of(callback.save, limit), error_of(callback.save, resource.RLIM_INFINITY)


def limits_up_to(size: int, count: int) -> list[int]:
    return [int(limit) for limit in np.linspace(0, size - 1, count)]


def disk(counts: Counts) -> Measured:
    """Files that may not grow beyond a limit, as on a full disk, while a good one is overwritten."""
    n_limits = counts["limits"]
    old, new, sac, other_sac = new_model(), new_model(seed=1), new_sac(), new_sac()
    for model, steps in ((old, 30), (new, 40), (sac, 30), (other_sac, 40)):
        model.learn(steps)
    ours = [
        overwritten("MOMBA.save", old.save, new.save, MOMBA.load, n_limits),
        overwritten(
            "MOMBA.save_replay_buffer", old.save_replay_buffer, new.save_replay_buffer, old.load_replay_buffer, n_limits
        ),
        checkpoints_on_a_full_disk(n_limits),
    ]
    theirs = [
        overwritten("SB3's SAC.save", sac.save, other_sac.save, SAC.load, n_limits),
        overwritten(
            "SB3's SAC.save_replay_buffer",
            sac.save_replay_buffer,
            other_sac.save_replay_buffer,
            sac.load_replay_buffer,
            n_limits,
        ),
    ]
    header = ["file", "limits", "OSError", "the old one still loads", "what was written of the new one is gone"]
    return Measured([header, *(row for row, _ in ours + theirs)], [fault for _, faults in ours for fault in faults])


def overwritten(
    name: str,
    save_old: Callable[[Path], None],
    save_new: Callable[[Path], None],
    load: Callable[[Path], Any],
    n_limits: int,
) -> tuple[list[Any], list[str]]:
    """A row of the table, and what went wrong."""
    found, faults = [], []
    for limit in limits_up_to(size_of(save_new), n_limits):
        with new_folder() as folder:
            path = folder / "file.zip"
            save_old(path)
            before = path.read_bytes()
            error = result_of(error_of, partial(save_new, path), limit)
            stands = path.read_bytes() == before and result_of(loads, load, path)
            is_clean = os.listdir(folder) == [path.name]
        found.append((error == "OSError", stands, is_clean))
        if not all(found[-1]):
            faults.append(f"{name}, at most {limit} bytes: error {error!r}, old one loads: {stands}, nothing left: {is_clean}")
    return [name, len(found), *(sum(column) for column in zip(*found, strict=True))], faults


def size_of(save: Callable[[Path], None]) -> int:
    with new_folder() as folder:
        save(folder / "file.zip")
        return (folder / "file.zip").stat().st_size


def loads(load: Callable[[Path], Any], path: Path) -> bool:
    try:
        load(path)
    except Exception:
        return False
    return True


def checkpoints_on_a_full_disk(n_limits: int) -> tuple[list[Any], list[str]]:
    """The same for a checkpoint beside older ones; the next one must come about when there is room again."""
    found, broken = [], []
    with new_folder() as folder:
        callback, undisturbed = before_a_checkpoint(folder)
        largest = max(file.stat().st_size for file in checkpoints_in(folder / "checkpoints")[0].iterdir())
        steps_before, steps_after = sorted(undisturbed)[-2:]
        for limit in limits_up_to(largest, n_limits):
            with new_folder() as copy:
                shutil.copytree(folder, copy, dirs_exist_ok=True)
                before = files_in(copy)
                write_into(callback, copy)
                error = result_of(error_of, callback.save, limit)
                steps, faults = result_of(faults_of, copy / "checkpoints", undisturbed)
                # A segment that was written whole may stay: the next checkpoint removes it.
                is_clean = all("part" not in name for name in files_in(copy) - before)
                _, again = result_of(error_of_checkpoint, callback, copy, limit)
                later, later_faults = result_of(faults_of, copy / "checkpoints", undisturbed)
            found.append((error == "OSError", steps == steps_before and not faults, is_clean))
            if not all(found[-1]):
                broken.append(f"checkpoint, at most {limit} bytes: error {error!r}, {faults}, nothing left: {is_clean}")
            if again or later != steps_after or later_faults:
                broken.append(f"checkpoint, at most {limit} bytes, and then without limit: {again} {later_faults}")
    return ["checkpoint", len(found), *(sum(column) for column in zip(*found, strict=True))], broken


def files_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}
