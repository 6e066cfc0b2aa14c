"""Processes that are forked, and killed, and folders for them."""

import contextlib
import os
import pickle
import random
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any


def started(function: Callable[..., Any], *arguments: Any) -> int:
    """The id of a forked process that calls a function, and ends."""
    sys.stdout.flush()
    state = random.getstate()  # Python gives forked processes other random numbers.
    process = os.fork()
    if process == 0:
        random.setstate(state)
        status = 1
        try:
            function(*arguments)
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    return process


def result_of(function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function returns in a forked process: this one stays as it is, its random numbers and limits too."""
    reading, writing = os.pipe()

    def call() -> None:
        os.close(reading)
        with os.fdopen(writing, "wb") as file:
            pickle.dump(function(*arguments), file)

    process = started(call)
    os.close(writing)
    with os.fdopen(reading, "rb") as file:
        content = file.read()
    _, status = os.waitpid(process, 0)
    if status != 0:
        raise ChildProcessError(f"{function} has ended with status {status}.")
    return pickle.loads(content)


def was_killed(process: int) -> bool:
    """Wait for a process to end; whether it was killed."""
    _, status = os.waitpid(process, 0)
    return os.WIFSIGNALED(status)


def is_over(process: int) -> bool:
    """Whether a process has ended; nothing is taken from `was_killed`."""
    return os.waitid(os.P_PID, process, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def kill_when(process: int, is_ready: Callable[[], Any], life: float) -> bool:
    """Kill a process `life` seconds after something is there; False if it had ended before."""
    while not is_ready() and not is_over(process):
        time.sleep(0.002)
    time.sleep(life)
    os.kill(process, signal.SIGKILL)
    return was_killed(process)


@contextlib.contextmanager
def new_folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)
