"""Work that several processes share, where one that dies or hangs ends it all with an error."""

import faulthandler
import signal
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_all_start_methods, get_context
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import IO, Any

from stable_baselines3.common.vec_env import CloudpickleWrapper

from sb3_momba.envs.workers import TIMEOUT, WorkerError


def in_processes(function: Callable[..., Any], calls: Sequence[tuple[Any, ...]], timeout: float = TIMEOUT) -> list[Any]:
    """`function(*call, still_alive)` for each call, in a process of its own, and what it returns.

    :param function: calls `still_alive()`, without arguments, again and again while it gets on
    :param timeout: seconds between two of those
    :raises WorkerError: if a process dies or hangs, with the place where it did; an error that one raises comes out as it is
    """
    with tempfile.TemporaryDirectory() as folder:
        runs = [CloudpickleWrapper((function, call, f"{folder}/{index}", timeout)) for index, call in enumerate(calls)]
        try:
            with ProcessPoolExecutor(len(runs), mp_context=_context()) as pool:
                try:
                    return list(pool.map(_run, runs))
                except BaseException:
                    for process in (pool._processes or {}).values():  # The pool itself would wait for those that still run.
                        process.kill()
                    raise
        except BrokenProcessPool as error:
            places = [path.read_text() for path in Path(folder).iterdir()]
            hung = [place for place in places if place]
            what = f"has not got on for {timeout:g} s:\n{hung[0]}" if hung else "was killed, or crashed."
            raise WorkerError(f"One of the {len(runs)} processes of an evaluation {what}") from error


def _context() -> BaseContext:
    """Processes that start from a clean one, which has the package loaded already."""
    if "forkserver" not in get_all_start_methods():
        return get_context("spawn")
    context = get_context("forkserver")
    context.set_forkserver_preload(["sb3_momba"])
    return context


def _run(run: CloudpickleWrapper) -> Any:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the caller decides when this ends.
    function, call, path, timeout = run.var
    with open(path, "w") as file:
        watch = Watch(file, timeout)
        try:
            watch()
            return function(*call, watch)
        finally:
            faulthandler.cancel_dump_traceback_later()


class Watch:
    """Ends this process, wherever it hangs, unless it is called again within `timeout` seconds; `file` says where it was."""

    def __init__(self, file: IO[str], timeout: float):
        self.file, self.timeout = file, timeout

    def __call__(self) -> None:
        faulthandler.dump_traceback_later(self.timeout, exit=True, file=self.file)
