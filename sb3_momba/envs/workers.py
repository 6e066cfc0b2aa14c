"""Environments in processes of their own that say why they do not answer."""

import multiprocessing
import signal
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, NoReturn

import gymnasium as gym
from stable_baselines3.common.vec_env import CloudpickleWrapper, SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.subproc_vec_env import _worker

TIMEOUT = 300.0


class WorkerError(Exception):
    """A process raised an error, died or does not answer; the processes beside it have been ended."""


@dataclass(frozen=True)
class Failure:
    """What a worker sends instead of an answer."""

    traceback: str


class WatchedSubprocVecEnv(SubprocVecEnv):
    """SB3's SubprocVecEnv, which waits for ever for a process that hangs, and leaves the others alone where one has died.

    :param env_fns: that make the environments
    :param start_method: of multiprocessing; "forkserver" where there is one
    :param timeout: seconds that an environment has for an answer
    :raises WorkerError: from any call, naming the environment, with its own traceback
    """

    def __init__(self, env_fns: list[Callable[[], gym.Env]], start_method: str | None = None, timeout: float = TIMEOUT):
        self.waiting = False
        self.closed = False
        self.timeout = timeout
        if start_method is None:
            start_method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
        context: Any = multiprocessing.get_context(start_method)
        self.processes = []
        remotes = []
        for index, env_fn in enumerate(env_fns):
            ours, theirs = context.Pipe()
            process = context.Process(target=_watched_worker, args=(theirs, ours, CloudpickleWrapper(env_fn)), daemon=True)
            process.start()
            theirs.close()
            self.processes.append(process)
            remotes.append(Remote(ours, self, index))
        self.remotes = tuple(remotes)
        self.remotes[0].send(("get_spaces", None))
        VecEnv.__init__(self, len(env_fns), *self.remotes[0].recv())

    def close(self) -> None:
        if self.closed:
            return
        if self.waiting:
            for remote in self.remotes:
                remote.recv()
        for remote in self.remotes:
            remote.send(("close", None))
        deadline = time.monotonic() + self.timeout
        for process in self.processes:
            process.join(max(deadline - time.monotonic(), 0))
            process.kill()  # one that hangs
        self.closed = True

    def fail(self, index: int, what: str, its_traceback: str = "") -> NoReturn:
        """End all processes and say what happened to one."""
        code = self.processes[index].exitcode
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.join()
        for remote in self.remotes:
            remote.close()
        self.closed = True
        died = f" (exit code {code})" if code is not None else ""
        raise WorkerError(f"Environment {index} {what}{died}." + (f"\n{its_traceback}" if its_traceback else ""))


class Remote:
    """Our end of a worker's pipe."""

    def __init__(self, connection: Connection, venv: WatchedSubprocVecEnv, index: int):
        self.connection, self.venv, self.index = connection, venv, index

    def send(self, request: Any) -> None:
        try:
            self.connection.send(request)
        except (BrokenPipeError, ConnectionResetError):
            self.recv()  # It may have said why it ended.

    def recv(self) -> Any:
        try:
            if not self.connection.poll(self.venv.timeout):
                self.venv.fail(self.index, f"has not answered for {self.venv.timeout:g} s: its process hangs")
            answer = self.connection.recv()
        except (EOFError, ConnectionResetError):
            self.venv.processes[self.index].join(1)
            self.venv.fail(self.index, "is gone: its process was killed, or crashed")
        if isinstance(answer, Failure):
            self.venv.fail(self.index, "raised an error", answer.traceback)
        return answer

    def close(self) -> None:
        self.connection.close()


def _watched_worker(theirs: Connection, ours: Connection, env_fn: CloudpickleWrapper) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the training decides when it ends.
    try:
        _worker(theirs, ours, env_fn)
    except Exception:
        theirs.send(Failure(traceback.format_exc()))
