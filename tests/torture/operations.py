"""A kill before and after every file operation of one checkpoint."""

import builtins
import io
import os
import shutil
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from sb3_momba import MombaCheckpointCallback
from tests.torture.checkpoints import before_a_checkpoint, faults_of, write_into
from tests.torture.measured import Counts, Measured, Rows, totals
from tests.torture.processes import die, new_folder, result_of, started, was_killed

OPERATIONS = ("replace", "rename", "fsync", "mkdir", "unlink", "rmdir", "truncate", "ftruncate")


class Operations:
    """The file operations of this process, and its end before or after one of them.

    :param last: the number of the operation at which the process is killed
    :param after: whether that one is still made; of a write, the first half
    """

    def __init__(self, last: int | None = None, after: bool = False):
        self.last = last
        self.after = after
        self.names: list[str] = []

    def watch(self) -> None:
        """From now on."""
        for name in OPERATIONS:
            setattr(os, name, self._counted(name, getattr(os, name)))
        builtins.open = partial(self._open, builtins.open)

    def begin(self, name: str) -> bool:
        """Note an operation; whether it is the last."""
        self.names.append(name)
        is_last = len(self.names) == self.last
        if is_last and not self.after:
            die()
        return is_last

    def _counted(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*args: Any, **kwargs: Any) -> Any:
            is_last = self.begin(name)
            try:
                return function(*args, **kwargs)
            finally:
                if is_last:
                    die()

        return counted

    def _open(self, original: Callable[..., Any], file: Any, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
        if mode not in ("w", "wb"):
            return original(file, mode, *args, **kwargs)
        is_last = self.begin("open")
        opened = WatchedFile(file, self)
        if is_last:
            die()
        return opened if mode == "wb" else io.TextIOWrapper(opened, encoding="utf-8")


class WatchedFile(io.FileIO):
    """Every write is one of the operations, and reaches the file at once."""

    def __init__(self, path: Path, operations: Operations):
        super().__init__(path, "w")
        self.operations = operations

    def write(self, data: Any) -> int:
        data = bytes(data)
        if self.operations.begin("write"):
            super().write(data[: len(data) // 2])
            die()
        return super().write(data)


def operations_of_one_write(callback: MombaCheckpointCallback, folder: Path) -> list[str]:
    write_into(callback, folder)
    operations = Operations()
    operations.watch()
    callback.save()
    return operations.names


def write_and_die(callback: MombaCheckpointCallback, folder: Path, number: int, after: bool) -> None:
    write_into(callback, folder)
    Operations(number, after).watch()
    callback.save()


def operations(counts: Counts) -> Measured:
    """A kill before and after every file operation of one checkpoint; of a write, before it and in its midst."""
    with new_folder() as folder, new_folder() as rehearsal:
        callback, undisturbed = before_a_checkpoint(folder)
        shutil.copytree(folder, rehearsal, dirs_exist_ok=True)
        names = result_of(operations_of_one_write, callback, rehearsal)
        old, new = sorted(undisturbed)[-2:]
        found: dict[str, Counter[str]] = {name: Counter() for name in names}
        broken = []
        writes = 0
        for number, name in enumerate(names, start=1):
            writes += name == "write"
            if name == "write" and writes % counts["every_write"] != 0:
                continue
            for after in (False, True):
                with new_folder() as copy:
                    shutil.copytree(folder, copy, dirs_exist_ok=True)
                    if not was_killed(started(write_and_die, callback, copy, number, after)):
                        raise ChildProcessError(f"operation {number}, {name}, was not reached")
                    steps, faults = result_of(faults_of, copy / "checkpoints", undisturbed)
                outcome = "broken" if faults or steps not in (old, new) else "old" if steps == old else "new"
                found[name][outcome] += 1
                when = "after" if after else "before"
                broken += [f"killed {when} operation {number}, {name}: {fault}" for fault in faults]
    rows: Rows = [
        ["operation", "in one checkpoint", "kills", "the old checkpoint is the newest", "the new one is", "none or mixed"]
    ]
    for name, outcomes in found.items():
        each = [outcomes["old"], outcomes["new"], outcomes["broken"]]
        rows.append([name, names.count(name), sum(each), *each])
    rows.append(["all", *totals(rows)])
    return Measured(rows, broken)
