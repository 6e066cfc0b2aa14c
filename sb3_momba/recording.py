"""Writing run records, line by line as the run goes on; `records.py` says what is in them, and reads them."""

import errno
import json
import math
import os
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from traceback import format_exception
from types import TracebackType
from typing import Any

import numpy as np

from sb3_momba.files import qualified_name
from sb3_momba.records import FORMAT, VERSION, whole_lines
from sb3_momba.system import git_revision, library_versions, machine


class RecordWriter:
    """Appends to a new record, each line on disk before the call returns.

    `with writer.start(...):` writes the first line, and the failure if what is inside fails. What is interrupted (Ctrl-C,
    SystemExit) has no end, like what is killed.

    :param path: of the record, which must not exist
    """

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)
        self.is_ended = False

    def start(self, **content: Any) -> "RecordWriter":
        """:param content: of the first line, beside versions, machine, revision and time"""
        line = _line("start", format=FORMAT, version=VERSION, **content, **_provenance())
        self.path.parent.mkdir(parents=True, exist_ok=True)
        # Held until the end: whoever deletes the record does not find lines of this run in the next one.
        self.file = open(self.path, "ab", buffering=0, opener=_only_new)  # noqa: SIM115
        try:
            self._write(line)
        except BaseException:
            self.file.close()
            self.path.unlink()
            raise
        return self

    def resume(self, steps: int, **content: Any) -> "RecordWriter":
        """Go on with the record of a run that was cut off, from a checkpoint at `steps`.

        :param content: of the line that says so, beside versions, machine, revision and time
        """
        whole = sum(len(line) for line, _ in whole_lines(self.path) if line.endswith(b"\n"))
        os.truncate(self.path, whole)  # A line that was cut off is none.
        self.file = open(self.path, "ab", buffering=0)  # noqa: SIM115
        try:
            self._write(_line("resumed", steps=steps, **content, **_provenance()))
        except BaseException:
            self.file.close()
            raise
        return self

    def append(self, event: str, **content: Any) -> None:
        """:raises ValueError: for numbers that are not finite, before anything is written"""
        self._write(_line(event, **content))

    def _write(self, line: bytes) -> None:
        """The whole line or, if the disk is full, nothing of it."""
        size = os.fstat(self.file.fileno()).st_size
        try:
            if self.file.write(line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), os.fspath(self.path))
            os.fsync(self.file.fileno())
        except BaseException:
            os.ftruncate(self.file.fileno(), size)
            raise

    def finish(self, steps: int, front: dict[str, Any], **content: Any) -> None:
        """
        :param front: the attributes of a ParetoFront, or of a set of solutions
        :param content: of the last line besides
        """
        self.append("end", status="finished", steps=steps, **content, front=front)
        self.is_ended = True

    def fail(self, error: str, traceback: str = "") -> None:
        """:param error: one line; `traceback`: where it came from"""
        self.is_ended = True
        self.append("end", status="failed", error=error, traceback=traceback)

    def __enter__(self) -> "RecordWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        with self.file:
            if isinstance(error, Exception) and not self.is_ended:
                message = f"{type(error).__name__}: {error}".removesuffix(": ")
                self.fail(message, "".join(format_exception(error)))


def _provenance() -> dict[str, Any]:
    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return {"versions": library_versions(), "machine": machine(), "git_revision": git_revision(), "started": now}


def _only_new(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_EXCL, 0o666)


def _line(event: str, **content: Any) -> bytes:
    return (json.dumps({"event": event, **content}, allow_nan=False, default=_as_list) + "\n").encode()


def _as_list(x: Any) -> Any:
    if isinstance(x, np.ndarray | np.generic):
        return x.tolist()
    raise TypeError(f"A record cannot hold a {type(x).__name__}: {x!r}.")


def plain(x: Any) -> Any:
    """A setting as strict JSON can hold it: classes and functions by their names, those without one of their own by their line
    too, objects as their attributes, numbers that are not finite as text."""
    if isinstance(x, dict):
        return {str(key): plain(value) for key, value in x.items()}
    if isinstance(x, list | tuple):
        return [plain(value) for value in x]
    if isinstance(x, np.ndarray | np.generic):
        return plain(x.tolist())
    if isinstance(x, float) and not math.isfinite(x):
        return str(x)
    if x is None or isinstance(x, bool | int | float | str):
        return x
    if isinstance(x, partial):
        return {"class": qualified_name(partial), **plain({"func": x.func, "args": x.args, "keywords": x.keywords})}
    if hasattr(x, "__qualname__"):
        line = f":{x.__code__.co_firstlineno}" if "<" in x.__qualname__ and hasattr(x, "__code__") else ""
        return qualified_name(x) + line
    return {"class": qualified_name(type(x)), **plain(getattr(x, "__dict__", {}))}
