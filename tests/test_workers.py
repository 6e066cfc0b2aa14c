"""Environments in processes of their own that are killed, hang or raise: an error that says so, and nobody is left."""

import os
import signal
import time

import numpy as np
import psutil
import pytest
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_momba import make_mo_vec_env
from sb3_momba.envs.workers import WorkerError
from tests.stubs import StubEnv, tiny_model


class Troubled(StubEnv):
    """Does at step 7 what it is told to."""

    def __init__(self, trouble: str = "none"):
        super().__init__()
        if trouble == "raises at once":
            raise KeyError("no such model")
        self.trouble = trouble

    def step(self, action):
        if self.n_steps == 7:
            if self.trouble == "raises":
                raise ZeroDivisionError("the physics exploded")
            if self.trouble == "is killed":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.trouble == "hangs":
                time.sleep(1_000)
        return super().step(action)


def troubled(trouble: str, n_envs: int = 3, timeout: float = 60):
    return make_mo_vec_env(
        Troubled,
        n_envs,
        env_kwargs={"trouble": trouble},
        vec_env_cls=SubprocVecEnv,
        vec_env_kwargs={"timeout": timeout, "start_method": "fork"},
    )


@pytest.mark.parametrize(
    ("trouble", "message"),
    [
        ("raises", r"Environment 0 raised an error.*(?s:.*)ZeroDivisionError: the physics exploded"),
        ("is killed", r"Environment 0 is gone: its process was killed, or crashed \(exit code -9\)"),
        ("hangs", r"Environment 0 has not answered for 2 s: its process hangs"),
    ],
)
def test_row_38_a_worker_in_trouble_is_named_and_nobody_is_left(trouble, message):
    env = troubled(trouble, timeout=2)
    pids = [process.pid for process in env.processes]
    model = tiny_model(env)
    started = time.perf_counter()
    with pytest.raises(WorkerError, match=message):
        model.learn(100)
    assert time.perf_counter() - started < 30
    assert not any(psutil.pid_exists(pid) for pid in pids)


def test_row_38_an_environment_that_cannot_be_made_says_why():
    before = {child.pid for child in psutil.Process().children(recursive=True)}
    with pytest.raises(WorkerError, match=r"(?s)Environment 0 raised an error.*KeyError: 'no such model'"):
        troubled("raises at once")
    left = {child.pid for child in psutil.Process().children(recursive=True)} - before
    assert not left


def test_row_38_an_error_in_a_method_reaches_the_caller():
    env = troubled("none")
    with pytest.raises(WorkerError, match=r"(?s)Environment 1 raised an error.*sums to 7"):
        env.env_method("set_preference", [3.0, 4.0], indices=[1])


def test_watched_processes_step_as_others_do():
    env, plain = troubled("none"), make_mo_vec_env(Troubled, 3)
    for one in (env, plain):
        one.seed(0)
    np.testing.assert_array_equal(env.reset(), plain.reset())
    for _ in range(15):
        ours, theirs = env.step(np.zeros((3, 2))), plain.step(np.zeros((3, 2)))
        for our, their in zip(ours[:3], theirs[:3], strict=True):
            np.testing.assert_array_equal(our, their)
    assert env.get_attr("n_steps") == plain.get_attr("n_steps")
    env.close()
    assert not any(process.is_alive() for process in env.processes)
