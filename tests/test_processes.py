"""Processes that share an evaluation and are killed, hang or raise: an error that says so, and nobody is left."""

import os
import signal
import time

import psutil
import pytest

from sb3_momba import evaluate_front
from sb3_momba.envs.workers import WorkerError
from sb3_momba.pareto.processes import in_processes
from tests.stubs import StubEnv


def doubled(number, still_alive):
    still_alive()
    return 2 * number


def in_trouble(trouble, still_alive):
    if trouble == "raises":
        raise ZeroDivisionError("the physics exploded")
    if trouble == "is killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if trouble == "hangs":
        still_alive()
        time.sleep(1_000)
    if trouble == "is slow":
        for _ in range(20):
            time.sleep(0.1)
            still_alive()
    return trouble


def test_results_come_in_the_order_of_the_calls():
    assert in_processes(doubled, [(1,), (2,), (3,)]) == [2, 4, 6]


def test_slow_is_not_hanging():
    assert in_processes(in_trouble, [("is slow",), ("none",)], timeout=1) == ["is slow", "none"]


@pytest.mark.parametrize(
    ("trouble", "error", "message"),
    [
        ("raises", ZeroDivisionError, "the physics exploded"),
        ("is killed", WorkerError, "One of the 2 processes of an evaluation was killed, or crashed"),
        ("hangs", WorkerError, r"(?s)of an evaluation has not got on for 1 s:.*test_processes.py.*in in_trouble"),
    ],
)
def test_row_38_an_evaluation_in_trouble_says_so_and_nobody_is_left(trouble, error, message):
    in_processes(doubled, [(1,)])  # starts the server that forks them, which stays for the next ones
    before = set(psutil.Process().children(recursive=True))
    started = time.perf_counter()
    with pytest.raises(error, match=message):
        in_processes(in_trouble, [(trouble,), ("none",)], timeout=1)
    assert time.perf_counter() - started < 30
    assert set(psutil.Process().children(recursive=True)) <= before


class Dying(StubEnv):
    def step(self, action):
        os.kill(os.getpid(), signal.SIGKILL)


class Uniform:
    def predict(self, observation, *, deterministic):
        return [[0.0, 0.0]] * len(observation), None


def test_row_38_an_environment_that_crashes_its_process_ends_the_evaluation():
    with pytest.raises(WorkerError, match="was killed, or crashed"):
        evaluate_front(Uniform(), Dying, n_preferences=4, n_workers=2)
