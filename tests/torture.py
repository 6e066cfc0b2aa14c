"""What files, checkpoints and resumption promise, put to the test: `python -m tests.torture [PART ...] [--counts short]`.

Every part prints one table, with Stable-Baselines3 beside it where it has the like, and each promise that did not hold. The
exit status is 1 if there is one. For Linux: processes are forked, killed and limited.

- kill: a training that is killed at random moments, and goes on from what is left, again and again
- operations: a kill before and after every file operation of one checkpoint
- resume: trainings that go on from a checkpoint against those that never stopped
- mutate: damaged and malicious files
- disk: a disk that is full at any byte
- million: what a checkpoint costs with a million transitions in the replay buffer (`--counts long` only)
"""

import argparse
import base64
import builtins
import contextlib
import ctypes
import hashlib
import io
import json
import logging
import os
import pickle
import random
import resource
import shutil
import signal
import statistics
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import torch as th
import yaml
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback

from sb3_momba import MOMBA, MombaCheckpointCallback, make_mo_vec_env
from sb3_momba.benchmark.tables import markdown
from sb3_momba.buffers import STORED_ARRAYS
from sb3_momba.checkpoints.folders import MANIFEST, canonical, checkpoints_in, described, newest
from sb3_momba.checkpoints.training_state import random_states, statistics_of
from sb3_momba.files import FileFormatError
from sb3_momba.pareto.evaluation import ParetoFront
from sb3_momba.records import RecordWriter, read_record
from sb3_momba.zoo.configuration import SHIPPED, read_configuration
from tests.stubs import TINY_SIMBA

COUNTS = {
    "long": {
        "kills": 500,
        "sb3_kills": 100,
        "every_write": 1,
        "points": 100,
        "resumed_steps": 260,
        "sb3_points": 8,
        "mutations": 10_000,
        "every_slot": 1,
        "limits": 40,
        "checkpoints": 5,
    },
    "short": {
        "kills": 8,
        "sb3_kills": 2,
        "every_write": 200,
        "points": 8,
        "resumed_steps": 40,
        "sb3_points": 1,
        "mutations": 300,
        "every_slot": 10,
        "limits": 6,
    },
}
TASK = "MO-Hopper-v4"
LEARNING_STARTS = 10  # steps of each environment
ROWS = 30  # of the replay buffer, which goes round several times
SAVE_FREQ = 10
CHAIN = 400  # steps of a training that is killed on its way, again and again
LONGEST_LIFE = 0.6  # seconds until a kill

Counts = dict[str, int]


@dataclass
class Measured:
    """A part's table, and the promises that did not hold."""

    rows: list[list[Any]]
    broken: list[str]


# ----------------------------------------------------------------------------------------------------------- processes


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


def kill_when(process: int, is_ready: Callable[[], bool], life: float) -> bool:
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


# ----------------------------------------------------------------------------------------------------------- trainings


def new_model(task: str = TASK, n_envs: int = 1, rows: int = ROWS, seed: int = 0) -> MOMBA:
    """Networks of a few hundred parameters and a small replay buffer, as many updates as steps."""
    return MOMBA(
        "SimbaPolicy",
        make_mo_vec_env(task, n_envs),
        learning_starts=LEARNING_STARTS * n_envs,
        batch_size=16,
        buffer_size=rows * n_envs,
        gradient_steps=-1,
        policy_kwargs=TINY_SIMBA,
        seed=seed,
        device="cpu",
    )


def new_sac(task: str = TASK, n_envs: int = 1, rows: int = ROWS) -> SAC:
    """The like for Stable-Baselines3, on the same environments, whose reward is scalarised."""
    return SAC(
        "MlpPolicy",
        make_mo_vec_env(task, n_envs),
        learning_starts=LEARNING_STARTS * n_envs,
        batch_size=16,
        buffer_size=rows * n_envs,
        gradient_steps=-1,
        policy_kwargs={"net_arch": [8, 8]},
        seed=0,
        device="cpu",
    )


def fingerprint(model: MOMBA) -> str:
    """A hash of all that a training goes on from: parameters, optimisers, replay buffer, statistics, random numbers."""
    buffer = model.replay_buffer
    everything = [
        model.get_parameters(),
        model.alpha,
        [getattr(buffer, name)[: buffer.size()] for name in STORED_ARRAYS],
        [buffer.pos, buffer.full, buffer.n_added, buffer.rng.bit_generator.state],
        [model.num_timesteps, model._n_updates, model._episode_num, model._last_obs],
        statistics_of(model),
        random_states(model),
        model.env.env_method("episode_so_far"),
    ]
    return hash_of(everything)


def hash_of(x: Any) -> str:
    digest = hashlib.sha256()
    add_to(digest, x)
    return digest.hexdigest()


def add_to(digest: Any, x: Any) -> None:
    """Feed a nest of dictionaries, sequences, arrays, tensors and numbers to a hash."""
    if isinstance(x, th.Tensor):
        x = x.detach().cpu().numpy()
    if isinstance(x, dict):
        for key in sorted(x, key=repr):
            digest.update(repr(key).encode())
            add_to(digest, x[key])
    elif isinstance(x, list | tuple | deque):
        digest.update(f"{len(x)} items".encode())
        for item in x:
            add_to(digest, item)
    elif isinstance(x, np.ndarray):
        digest.update(f"{x.dtype} {x.shape}".encode() + x.tobytes())
    else:
        digest.update(repr(x.item() if isinstance(x, np.generic) else x).encode())


class Fingerprints(BaseCallback):
    """Of a training at every step at which a checkpoint could be."""

    def __init__(self, every: int):
        super().__init__()
        self.every = every
        self.found: dict[int, str] = {}

    def _on_rollout_start(self) -> None:
        if self.num_timesteps > 0 and self.num_timesteps % self.every == 0:
            self.found[self.num_timesteps] = fingerprint(self.model)

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._on_rollout_start()


def undisturbed_fingerprints(steps: int) -> dict[int, str]:
    """Of a training that is never interrupted and writes nothing, {steps: hash}."""
    fingerprints = Fingerprints(SAVE_FREQ)
    new_model().learn(steps, fingerprints)
    return fingerprints.found


def faults_of(folder: Path, undisturbed: dict[int, str]) -> tuple[int, list[str]]:
    """The steps of the newest checkpoint of a folder, and what is wrong with it: nothing, if it is whole and of one moment.

    :param undisturbed: fingerprints of the same training without any interruption, {steps: hash}
    """
    faults = []
    try:
        checkpoint = newest(folder)
        model = MOMBA.resume(folder, make_mo_vec_env(TASK, 1), device="cpu")
    except Exception as error:
        return 0, [f"does not load: {type(error).__name__}: {error}"]
    if checkpoint.folder != checkpoints_in(folder)[0]:
        faults.append("a newer one is damaged")
    steps, buffer = model.num_timesteps, model.replay_buffer
    if steps != checkpoint.steps:
        faults.append(f"the model is of step {steps}, its manifest of {checkpoint.steps}")
    if buffer.n_added != steps:
        faults.append(f"the model is of step {steps}, its replay buffer of {buffer.n_added}")
    if model._n_updates != max(steps - LEARNING_STARTS, 0):
        faults.append(f"{model._n_updates} updates after {steps} steps")
    if fingerprint(model) != undisturbed[steps]:
        faults.append(f"differs at step {steps} from a training that was never interrupted")
    return steps, faults


# ---------------------------------------------------------------------------------------------------------------- kill


def train(folder: Path) -> None:
    """Begin a training with checkpoints, or go on with one."""
    model = MOMBA.resume(folder, make_mo_vec_env(TASK, 1), device="cpu") if checkpoints_in(folder) else new_model()
    callback = MombaCheckpointCallback(SAVE_FREQ, folder, keep=2)
    model.learn(CHAIN - model.num_timesteps, callback, reset_num_timesteps=False)


def is_half_written(folder: Path) -> bool:
    """Whether a write was cut off: what has another name until it is whole, or what no checkpoint uses yet."""
    used = {name for checkpoint in checkpoints_in(folder) for name in newest(checkpoint).shared}
    shared = {file.name for file in (folder / "shared").iterdir()}
    return any(path.suffix in (".part", ".old") for path in folder.iterdir()) or shared != used


def kill(counts: Counts) -> Measured:
    """Trainings that are killed at random moments after their first checkpoint; each goes on from what is left."""
    rng = random.Random(0)
    undisturbed = result_of(undisturbed_fingerprints, CHAIN)
    killed = cut_off = good = trainings = 0
    broken: list[str] = []
    while killed < counts["kills"]:
        with new_folder() as folder:
            trainings += 1
            while killed < counts["kills"]:
                process = started(train, folder)
                has_one = partial(checkpoints_in, folder)
                if not kill_when(process, has_one, rng.uniform(0, LONGEST_LIFE)):
                    break
                killed += 1
                cut_off += is_half_written(folder)
                steps, faults = result_of(faults_of, folder, undisturbed)
                good += not faults
                broken += [f"kill {killed}, step {steps}: {fault}" for fault in faults]
                if faults:
                    break
    sb3 = Counter(sb3_after_a_kill(rng) for _ in range(counts["sb3_kills"]))
    sb3_kills = sum(sb3.values())
    rows = [
        ["", "kills", "in the midst of a write", "whole, of one moment, as never interrupted", "not"],
        [f"MOMBA, {trainings} trainings", killed, cut_off, good, killed - good],
        ["SB3's SAC and CheckpointCallback", sb3_kills, "", f"{sb3['']} load", failures(sb3)],
    ]
    return Measured(rows, broken)


def failures(found: Counter[str]) -> str:
    """How often what went wrong; "" stands for nothing."""
    wrong = {fault: n for fault, n in found.items() if fault}
    if not wrong:
        return "0"
    return f"{sum(wrong.values())}: " + ", ".join(f"{n} x {fault}" for fault, n in sorted(wrong.items()))


def train_sac(folder: Path) -> None:
    callback = CheckpointCallback(SAVE_FREQ, str(folder), save_replay_buffer=True)
    new_sac().learn(1_000_000, callback)


def sb3_after_a_kill(rng: random.Random) -> str:
    """What is wrong with the newest files of SB3's CheckpointCallback after a kill; "" if they load."""
    with new_folder() as folder:
        process = started(train_sac, folder)
        second = folder / f"rl_model_{2 * SAVE_FREQ}_steps.zip"
        kill_when(process, second.exists, rng.uniform(0, LONGEST_LIFE))
        return result_of(sb3_fault, folder)


def sb3_fault(folder: Path) -> str:
    steps = max(int(file.stem.split("_")[2]) for file in folder.glob("rl_model_*_steps.zip"))
    buffer = folder / f"rl_model_replay_buffer_{steps}_steps.pkl"
    try:
        model = SAC.load(folder / f"rl_model_{steps}_steps.zip", device="cpu")
    except Exception as error:
        return f"model does not load ({type(error).__name__})"
    if not buffer.exists():
        return "no replay buffer of the model's step"
    try:
        model.load_replay_buffer(buffer)
    except Exception as error:
        return f"replay buffer does not load ({type(error).__name__})"
    return ""


# ---------------------------------------------------------------------------------------------------------- operations

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


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def before_a_checkpoint(folder: Path) -> tuple[MombaCheckpointCallback, dict[int, str]]:
    """A training with two checkpoints in a folder, and ten steps after the second; the next one removes the first of them
    and files that only it has used.

    :return: a callback that writes into "checkpoints", from wherever the process is, and the fingerprints of both moments
    """
    os.chdir(folder)
    model, fingerprints = new_model(), Fingerprints(SAVE_FREQ)
    callback = MombaCheckpointCallback(SAVE_FREQ, "checkpoints", keep=2)
    model.learn(80, [fingerprints, callback])
    model.learn(SAVE_FREQ, fingerprints, reset_num_timesteps=False)
    return callback, fingerprints.found


def operations_of_one_write(callback: MombaCheckpointCallback) -> list[str]:
    operations = Operations()
    operations.watch()
    callback.save()
    return operations.names


def write_and_die(callback: MombaCheckpointCallback, folder: Path, number: int, after: bool) -> None:
    os.chdir(folder)
    Operations(number, after).watch()
    callback.save()


def operations(counts: Counts) -> Measured:
    """A kill before and after every file operation of one checkpoint; of a write, before it and in its midst."""
    with new_folder() as folder, new_folder() as rehearsal:
        callback, undisturbed = before_a_checkpoint(folder)
        shutil.copytree(folder, rehearsal, dirs_exist_ok=True)
        os.chdir(rehearsal)
        names = result_of(operations_of_one_write, callback)
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
        os.chdir("/")
    rows = [["operation", "in one checkpoint", "kills", "the old checkpoint is the newest", "the new one is", "none or mixed"]]
    for name, outcomes in found.items():
        each = [outcomes["old"], outcomes["new"], outcomes["broken"]]
        rows.append([name, names.count(name), sum(each), *each])
    rows.append(["all", len(names), *(sum(column) for column in list(zip(*rows[1:], strict=True))[2:])])
    return Measured(rows, broken)


# -------------------------------------------------------------------------------------------------------------- resume

TASKS = ("MO-Hopper-v4", "MO-HalfCheetah-v4", "MO-Ant-v4", "mo-mountaincarcontinuous-v0")
TRAININGS = [(task, n_envs) for n_envs in (1, 4) for task in TASKS]


class Kill(BaseCallback):
    """Kills the process at a step."""

    def __init__(self, at: int):
        super().__init__()
        self.at = at

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.at:
            die()
        return True


def never_stopped(task: str, n_envs: int, steps: int) -> str:
    return fingerprint(new_model(task, n_envs).learn(steps))


def killed_near_its_end(task: str, n_envs: int, steps: int, save_freq: int, folder: Path) -> None:
    callbacks = [MombaCheckpointCallback(save_freq, folder, keep=steps), Kill(steps)]
    new_model(task, n_envs).learn(steps, callbacks)


def gone_on(folder: Path, task: str, n_envs: int) -> str:
    model = MOMBA.resume(folder, make_mo_vec_env(task, n_envs), device="cpu")
    return fingerprint(model.learn(model.remaining_timesteps, reset_num_timesteps=False))


def resume(counts: Counts) -> Measured:
    """Trainings that go on from a checkpoint to their end, against those that never stopped."""
    rows = [["task", "environments", "points", "different hashes", "SB3's SAC, points", "different parameters"]]
    broken = []
    for i, (task, n_envs) in enumerate(TRAININGS):
        n_points = counts["points"] // len(TRAININGS) + (i < counts["points"] % len(TRAININGS))
        steps = counts["resumed_steps"] * n_envs
        save_freq = steps // (n_points + 1) // n_envs * n_envs
        expected = result_of(never_stopped, task, n_envs, steps)
        with new_folder() as folder:
            was_killed(started(killed_near_its_end, task, n_envs, steps, save_freq, folder))
            points = checkpoints_in(folder)[::-1][:n_points]
            different = [point.name for point in points if result_of(gone_on, point, task, n_envs) != expected]
        broken += [f"{task}, {n_envs} environments, resumed at {name}: another result" for name in different]
        if len(points) < n_points:
            broken.append(f"{task}, {n_envs} environments: {len(points)} checkpoints instead of {n_points}")
        sb3 = [result_of(sb3_differs, task, n_envs, steps)] if i < counts["sb3_points"] else []
        rows.append([task, n_envs, len(points), len(different), len(sb3) or "", sum(sb3) if sb3 else ""])
    totals = [sum(row[column] or 0 for row in rows[1:]) for column in range(2, 6)]
    rows.append(["all", "", *totals])
    return Measured(rows, broken)


def sb3_differs(task: str, n_envs: int, steps: int) -> bool:
    """Whether SB3's documented way to go on ends with other parameters than a training that never stopped."""
    expected = hash_of(new_sac(task, n_envs).learn(steps).get_parameters())
    half = steps // n_envs // 2
    with new_folder() as folder:
        callback = CheckpointCallback(half, str(folder), save_replay_buffer=True)
        new_sac(task, n_envs).learn(steps, callback)
        name = f"{half * n_envs}_steps"
        model = SAC.load(folder / f"rl_model_{name}.zip", make_mo_vec_env(task, n_envs), device="cpu")
        model.load_replay_buffer(folder / f"rl_model_replay_buffer_{name}.pkl")
    model.learn(steps - model.num_timesteps, reset_num_timesteps=False)
    return hash_of(model.get_parameters()) != expected


# -------------------------------------------------------------------------------------------------------------- mutate

EXPECTED_ERRORS = (FileFormatError, ValueError, FileNotFoundError, OSError)
MEMORY = 2**30  # bytes that a load may take
LONGEST_LOAD = 10.0  # seconds of processor time
OTHER_VALUES = (
    *(None, True, -1, 0, 3, 10**12, 10**30, 0.5, -1e308, "", "x", "nan", [], [1, "x"], {}, {"x": 1}),
    *({"~": "float", "value": "nan"}, {"~": "tuple", "items": [1, None]}, {"~": "array", "file": "x"}, {"~": "surprise"}),
)


class TooLongError(BaseException):
    """A load that does not come to an end; no handler of ordinary errors catches it."""


@dataclass
class Kind:
    """A kind of files.

    :param folder: an example; it is copied before it is damaged
    :param file: the path in it of the file to damage
    :param load: the public loader, called with the folder
    :param content: "zip", "json", "json lines" or "yaml"
    """

    name: str
    folder: Path
    file: str
    load: Callable[[Path], Any]
    content: str


def kinds_of_files(folder: Path) -> list[Kind]:
    """An example of each, and how it is loaded."""
    model = new_model().learn(30, MombaCheckpointCallback(SAVE_FREQ, folder / "checkpoints", keep=1))
    (checkpoint,) = checkpoints_in(folder / "checkpoints")
    for name in ("model", "buffer", "record", "front", "configuration"):
        (folder / name).mkdir()
    model.save(folder / "model" / "model.zip")
    model.save_replay_buffer(folder / "buffer" / "buffer.npz")
    write_record(folder / "record" / "record.jsonl")
    a_front().save(folder / "front" / "front.npz")
    (folder / "configuration" / "c.yml").write_text((SHIPPED / "capql.yml").read_text())
    env = make_mo_vec_env(TASK, 1)

    def single(name: str, file: str, load: Callable[[Path], Any], content: str) -> Kind:
        return Kind(f"{name}, {file}", folder / name, file, lambda copy: load(copy / file), content)

    def of_checkpoint(file: str, content: str) -> Kind:
        def load(copy: Path) -> Any:
            return MOMBA.resume(copy / checkpoint.name, env, device="cpu")

        where = checkpoint.name if (checkpoint / file).exists() else "shared"
        shown = file if where == checkpoint.name else "shared segment"
        return Kind(f"checkpoint, {shown}", folder / "checkpoints", f"{where}/{file}", load, content)

    return [
        single("model", "model.zip", partial(MOMBA.load, device="cpu"), "zip"),
        single("buffer", "buffer.npz", model.load_replay_buffer, "zip"),
        of_checkpoint(MANIFEST, "json"),
        of_checkpoint("model.zip", "zip"),
        of_checkpoint("state.zip", "zip"),
        of_checkpoint(newest(checkpoint).shared[0], "zip"),
        single("record", "record.jsonl", read_record, "json lines"),
        single("front", "front.npz", ParetoFront.load, "zip"),
        single("configuration", "c.yml", lambda path: read_configuration(str(path), TASK), "yaml"),
    ]


def a_front() -> ParetoFront:
    rng = np.random.default_rng(0)
    returns = rng.normal(size=(3, 2, 2))
    return ParetoFront(np.eye(3, 2) + 0.1, returns, returns / 2, np.full((3, 2), 9), {"env": TASK, "seed": 0})


def write_record(path: Path) -> None:
    """A short record with a line of every kind."""
    front, values = a_front(), [[1.0, 2.0], [2.0, 1.0], [1.5, 1.5]]
    start = {"label": "momba", "env": TASK, "env_kwargs": {"x": 1}, "seed": 0, "config": {"gamma": 0.99, "her": True}}
    start |= {"reference_point": [0.0, 0.0], "preferences": values, "general_policy": True, "parameters": {"actor": 10}}
    with RecordWriter(path).start(**start) as writer:
        writer.append("floor", policy="random", values=values)
        for steps in (100, 200):
            writer.append("evaluation", steps=steps, seconds=1.5, cpu_seconds=1.0, evaluation_seconds=0.5, values=values)
        writer.finish(200, vars(front))


def flipped(content: bytes, rng: random.Random) -> bytes:
    """One to eight bits are flipped."""
    damaged = bytearray(content)
    for _ in range(rng.choice([1, 1, 2, 8])):
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def cut(content: bytes, rng: random.Random) -> bytes:
    """The end, or a piece from anywhere, is missing."""
    start, stop = span(content, rng)
    return content[:start] + (b"" if rng.random() < 0.5 else content[stop:])


def inserted(content: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(content) + 1)
    return content[:start] + rng.randbytes(rng.choice([1, 2, 8, 100])) + content[start:]


def doubled(content: bytes, rng: random.Random) -> bytes:
    start, stop = span(content, rng)
    return content[:stop] + content[start:stop] + content[stop:]


def swapped(content: bytes, rng: random.Random) -> bytes:
    """Two neighbouring pieces have changed places."""
    start, stop = span(content, rng)
    middle = rng.randint(start, stop)
    return content[:start] + content[middle:stop] + content[start:middle] + content[stop:]


def span(content: bytes, rng: random.Random) -> tuple[int, int]:
    start = rng.randrange(len(content))
    return start, min(start + rng.choice([1, 4, 64, 1000, len(content)]), len(content))


BYTES = (flipped, cut, inserted, doubled, swapped)


def members_of(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def archive_of(members: dict[str, bytes]) -> bytes:
    """With checksums that fit."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return file.getvalue()


def with_a_damaged_member(content: bytes, rng: random.Random) -> bytes:
    members = members_of(content)
    name = rng.choice(list(members))
    members[name] = rng.choice(BYTES)(members[name], rng)
    return archive_of(members)


def with_an_exchanged_member(content: bytes, rng: random.Random) -> bytes:
    """A member has the content of another one, or none, or is missing."""
    members = members_of(content)
    name = rng.choice(list(members))
    members[name] = rng.choice([b"", *members.values()])
    if rng.random() < 0.2:
        del members[name]
    return archive_of(members)


def with_a_changed_tree(content: bytes, rng: random.Random) -> bytes:
    members = members_of(content)
    members["tree.json"] = json.dumps(with_another_value(json.loads(members["tree.json"]), rng)).encode()
    return archive_of(members)


def with_a_changed_line(content: bytes, rng: random.Random) -> bytes:
    lines = content.splitlines()
    number = rng.randrange(len(lines))
    lines[number] = json.dumps(with_another_value(json.loads(lines[number]), rng)).encode()
    return b"\n".join(lines) + b"\n"


def with_a_changed_document(content: bytes, rng: random.Random) -> bytes:
    return json.dumps(with_another_value(json.loads(content), rng)).encode()


def with_a_changed_configuration(content: bytes, rng: random.Random) -> bytes:
    return yaml.safe_dump(with_another_value(yaml.safe_load(content), rng)).encode()


def with_another_value(x: Any, rng: random.Random) -> Any:
    """One place of a JSON document holds something else."""
    container, key = rng.choice(list(places(x)))
    container[key] = rng.choice(OTHER_VALUES)
    return x


def places(x: Any) -> Iterator[tuple[Any, Any]]:
    """Every container in a JSON document with each of its keys."""
    items = list(x.items()) if isinstance(x, dict) else list(enumerate(x)) if isinstance(x, list) else []
    for key, item in items:
        yield x, key
        yield from places(item)


OTHERS = {
    "zip": (with_a_damaged_member, with_an_exchanged_member, with_a_changed_tree, with_a_changed_tree),
    "json": (with_a_changed_document,) * 3,
    "json lines": (with_a_changed_line,) * 3,
    "yaml": (with_a_changed_configuration,) * 3,
}


def seal(folder: Path) -> None:
    """Let the manifest of the only checkpoint in a folder state the checksums that its files have."""
    for checkpoint in checkpoints_in(folder):
        with contextlib.suppress(Exception):
            manifest = json.loads((checkpoint / MANIFEST).read_text())
            for name in manifest["content"]["files"]:
                if (checkpoint / name).is_file():
                    manifest["content"]["files"][name] = described(checkpoint / name)
            manifest["sha256"] = hashlib.sha256(canonical(manifest["content"])).hexdigest()
            (checkpoint / MANIFEST).write_text(json.dumps(manifest))


def outcome_of(kind: Kind, content: bytes, sealed: bool, canary: Path) -> str:
    """What comes of loading a file with other content: "loaded", "refused", "executed" or an unexpected error's name."""
    with new_folder() as copy:
        shutil.copytree(kind.folder, copy, dirs_exist_ok=True)
        (copy / kind.file).write_bytes(content)
        if sealed:
            seal(copy)
        signal.setitimer(signal.ITIMER_PROF, LONGEST_LOAD)
        try:
            kind.load(copy)
            outcome = "loaded"
        except EXPECTED_ERRORS:
            outcome = "refused"
        except BaseException as error:
            outcome = f"{type(error).__name__}: {error} ({place_of(error)})"
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
    if canary.exists():
        canary.unlink()
        return "executed"
    return outcome


def place_of(error: BaseException) -> str:
    """The line of the package that an error has passed last."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "sb3_momba" in Path(frame.filename).parts]
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "outside the package"


Attack = tuple[str, bytes, bool]  # what was done, the file's content, and whether a manifest is made to fit


def mutations(kind: Kind, count: int) -> Iterator[Attack]:
    original = (kind.folder / kind.file).read_bytes()
    for number in range(count):
        rng = random.Random(f"{kind.name} {number}")
        change = rng.choice([*BYTES, *OTHERS[kind.content]])
        yield f"mutation {number}, {change.__name__}", change(original, rng), rng.random() < 0.7


class Malicious:
    """Its pickle makes a file wherever it is loaded."""

    def __init__(self, canary: Path):
        self.canary = canary

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return os.mkdir, (str(self.canary),)


def payloads_of(canary: Path) -> list[bytes]:
    """One object, pickled in the three ways that programs like this one unpickle."""
    malicious, array, torch_file = Malicious(canary), io.BytesIO(), io.BytesIO()
    np.save(array, np.array([malicious], dtype=object), allow_pickle=True)
    th.save(malicious, torch_file)
    return [pickle.dumps(malicious), array.getvalue(), torch_file.getvalue()]


def malicious_files(kind: Kind, canary: Path, every: int) -> Iterator[Attack]:
    """The pickles in place of the file and of each of its parts, and where other libraries would look for them."""
    original, payloads = (kind.folder / kind.file).read_bytes(), payloads_of(canary)
    slots = [(f"the file is pickle {i}", payload) for i, payload in enumerate(payloads)]
    if kind.content == "zip":
        members = members_of(original)
        extra = {"data": sb3_data(canary), "data.pkl": payloads[0], "extra.npy": payloads[1], "policy.pth": payloads[2]}
        slots.append(("extra members", archive_of({**members, **extra})))
        slots += [
            (f"{name} is pickle {i}", archive_of({**members, name: payload}))
            for name in members
            for i, payload in enumerate(payloads)
        ]
    elif kind.content == "yaml":
        for command in (f"!!python/object/apply:os.mkdir ['{canary}']", f"!!python/object/new:os.mkdir ['{canary}']"):
            lines = original.decode().splitlines()
            slots += [(f"{command} as the file", command.encode()), (f"{command} in a list", f"default: [{command}]".encode())]
            for number, line in enumerate(lines):
                if ": " in line:
                    changed = [*lines[:number], f"{line.split(': ')[0]}: {command}", *lines[number + 1 :]]
                    slots.append((f"line {number} is {command}", "\n".join(changed).encode()))
    else:
        lines = original.splitlines()
        slots += [(f"line {n} is a pickle", b"\n".join([*lines[:n], payloads[0], *lines[n + 1 :]])) for n in range(len(lines))]
    for what, content in slots[::every] if every < len(slots) else slots:
        yield what, content, True


def sb3_data(canary: Path) -> bytes:
    """The settings in a zip of SB3's, of which one is the pickle."""
    text = base64.b64encode(cloudpickle.dumps(Malicious(canary))).decode()
    return json.dumps({"policy_class": {":type:": "x", ":serialized:": text}}).encode()


def note_outcomes(kind: Kind, attacks: list[Attack], canary: Path, notes: Path) -> None:
    """Load one file after the other, each with a limit on its memory and time."""

    def give_up(*_: Any) -> None:
        raise TooLongError

    signal.signal(signal.SIGPROF, give_up)
    limit_memory(MEMORY)
    with open(notes, "a") as file:
        for _, content, sealed in attacks:
            file.write(json.dumps(outcome_of(kind, content, sealed, canary)) + "\n")
            file.flush()


def limit_memory(room: int) -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + room, resource.RLIM_INFINITY))


def outcomes_of(kind: Kind, attacks: list[Attack], canary: Path) -> list[str]:
    """In a process of their own; where that dies, the rest in another one."""
    outcomes: list[str] = []
    with new_folder() as folder:
        while len(outcomes) < len(attacks):
            notes = folder / f"{len(outcomes)}"
            process = started(note_outcomes, kind, attacks[len(outcomes) :], canary, notes)
            ended_well = not was_killed(process)
            outcomes += [json.loads(line) for line in notes.read_text().splitlines()]
            if len(outcomes) < len(attacks):
                outcomes.append("the process ended" if ended_well else "the process was killed")
    return outcomes


def mutate(counts: Counts) -> Measured:
    """Damaged and malicious files: what is loaded, what is refused, and what should never come of it."""
    rows = [
        ["file", "mutations", "loaded all the same", "refused", "other errors", "malicious", "refused or ignored", "executed"]
    ]
    broken: list[str] = []
    with new_folder() as folder:
        canary = folder / "canary"
        kinds = kinds_of_files(folder)
        for i, kind in enumerate(kinds):
            count = counts["mutations"] // len(kinds) + (i < counts["mutations"] % len(kinds))
            damaged = list(mutations(kind, count))
            malicious = list(malicious_files(kind, canary, counts["every_slot"]))
            outcomes = outcomes_of(kind, [*damaged, *malicious], canary)
            of_damaged = Counter(map(in_short, outcomes[: len(damaged)]))
            of_malicious = Counter(map(in_short, outcomes[len(damaged) :]))
            fine = of_malicious["refused"] + of_malicious["loaded"]
            executed = of_damaged["executed"] + of_malicious["executed"]
            found = [of_damaged[outcome] for outcome in ("loaded", "refused", "other")]
            rows.append([kind.name, len(damaged), *found, len(malicious), fine, executed])
            for (what, _, _), outcome in zip([*damaged, *malicious], outcomes, strict=True):
                if outcome not in ("loaded", "refused"):
                    broken.append(f"{kind.name}, {what}: {outcome}")
        rows.append(["all", *(sum(column) for column in list(zip(*rows[1:], strict=True))[1:])])
        executed = [result_of(sb3_executes, what, canary) for what in ("model", "buffer")]
        rows.append(["SB3's SAC: model, replay buffer", "", "", "", "", 2, executed.count(False), executed.count(True)])
    return Measured(rows, broken)


def in_short(outcome: str) -> str:
    return outcome if outcome in ("loaded", "refused", "executed") else "other"


def sb3_executes(what: str, canary: Path) -> bool:
    """Whether SB3 runs the same pickle in a file of its own format."""
    model = new_sac()
    with new_folder() as folder, contextlib.suppress(Exception):
        if what == "buffer":
            (folder / "buffer.pkl").write_bytes(pickle.dumps(Malicious(canary)))
            model.load_replay_buffer(folder / "buffer.pkl")
        else:
            model.save(folder / "model.zip")
            members = members_of((folder / "model.zip").read_bytes())
            (folder / "model.zip").write_bytes(archive_of({**members, "data": sb3_data(canary)}))
            SAC.load(folder / "model.zip", device="cpu")
    executed = canary.exists()
    if executed:
        canary.rmdir()
    return executed


# ---------------------------------------------------------------------------------------------------------------- disk


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
    os.chdir(folder)
    return error_of(callback.save, limit), error_of(callback.save, resource.RLIM_INFINITY)


def limits_up_to(size: int, count: int) -> list[int]:
    return [int(limit) for limit in np.linspace(0, size - 1, count)]


def disk(counts: Counts) -> Measured:
    """Files that may not grow beyond a limit, as on a full disk, while a good one is overwritten."""
    rows = [["file", "limits", "OSError", "the old one still loads", "what was written of the new one is gone"]]
    broken: list[str] = []
    with new_folder() as folder:
        old, new = new_model().learn(30), new_model(seed=1).learn(40)
        ours = [("MOMBA.save", MOMBA.save, MOMBA.load), ("MOMBA.save_replay_buffer", MOMBA.save_replay_buffer, load_into(old))]
        for name, save, load in ours:
            row, faults = overwritten(name, partial(save, old), partial(save, new), load, folder, counts["limits"])
            rows.append(row)
            broken += faults
        row, faults = checkpoints_on_a_full_disk(counts["limits"])
        rows.append(row)
        broken += faults
        sac, other = new_sac().learn(30), new_sac().learn(40)
        theirs = [("SB3's SAC.save", SAC.save, SAC.load)]
        theirs.append(("SB3's SAC.save_replay_buffer", SAC.save_replay_buffer, load_into(sac)))
        for name, save, load in theirs:
            row, _ = overwritten(name, partial(save, sac), partial(save, other), load, folder, counts["limits"])
            rows.append(row)
    return Measured(rows, broken)


def load_into(model: Any) -> Callable[[Path], None]:
    return model.load_replay_buffer


def overwritten(
    name: str,
    save_old: Callable[[Path], None],
    save_new: Callable[[Path], None],
    load: Callable[[Path], Any],
    folder: Path,
    n_limits: int,
) -> tuple[list[Any], list[str]]:
    """A row of the table, and what went wrong."""
    found, faults = [], []
    save_new(folder / "measured.zip")
    for limit in limits_up_to((folder / "measured.zip").stat().st_size, n_limits):
        with new_folder() as copy:
            path = copy / "file.zip"
            save_old(path)
            before = path.read_bytes()
            error = result_of(error_of, partial(save_new, path), limit)
            stands = path.read_bytes() == before and result_of(loads, load, path)
            is_clean = os.listdir(copy) == [path.name]
        found.append((error == "OSError", stands, is_clean))
        if not all(found[-1]):
            faults.append(f"{name}, at most {limit} bytes: error {error!r}, old one loads: {stands}, nothing left: {is_clean}")
    return [name, len(found), *(sum(column) for column in zip(*found, strict=True))], faults


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
                os.chdir(copy)
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
        os.chdir("/")
    return ["checkpoint", len(found), *(sum(column) for column in zip(*found, strict=True))], broken


def files_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


# ------------------------------------------------------------------------------------------------------------- million

MILLION = 1_000_000
NEW_ROWS = 10_000
WIDE_TASK = "MO-HalfCheetah-v4"


def fill(buffer: Any, first: int, stop: int) -> None:
    """Put random numbers into rows of a replay buffer, counted since the training began."""
    rng = np.random.default_rng(first)
    for name, array in vars(buffer).items():
        if isinstance(array, np.ndarray) and len(array) == buffer.buffer_size and name not in ("dones", "timeouts"):
            rows = array[np.arange(first, stop) % buffer.buffer_size]
            array[np.arange(first, stop) % buffer.buffer_size] = rng.random(rows.shape)
    buffer.pos, buffer.full = stop % buffer.buffer_size, stop >= buffer.buffer_size


def memory_of(name: str) -> float:
    """MB: VmRSS now, or VmHWM at most since `forget_peak`."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) / 1024


def forget_peak() -> None:
    """Give what is free back to the system, so that all that is needed is seen, and begin anew."""
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")


def cost_of(write: Callable[[], Any]) -> tuple[float, float]:
    """Seconds, and MB beyond what was there before."""
    forget_peak()
    before, start = memory_of("VmRSS"), time.perf_counter()
    write()
    return time.perf_counter() - start, memory_of("VmHWM") - before


def size_of(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_size for path in folder.rglob("*") if path.is_file()}


def momba_costs(n_checkpoints: int) -> list[tuple[str, float, float, float]]:
    """Of the first checkpoint of a full replay buffer, and of later ones with NEW_ROWS new rows each."""
    model = MOMBA("SimbaPolicy", make_mo_vec_env(WIDE_TASK, 1), buffer_size=MILLION, seed=0, device="cpu")
    costs = []
    with new_folder() as folder:
        callback = MombaCheckpointCallback(MILLION, folder)
        model.learn(1, callback)
        for number in range(n_checkpoints + 1):
            end = MILLION + number * NEW_ROWS
            fill(model.replay_buffer, 1 if number == 0 else end - NEW_ROWS, end)
            model.replay_buffer.n_added = model.num_timesteps = end
            before = size_of(folder)
            seconds, megabytes = cost_of(callback.save)
            written = sum(size for file, size in size_of(folder).items() if file not in before)
            costs.append(("first" if number == 0 else "later", seconds, megabytes, written / 1e6))
    return costs


def sac_costs(n_checkpoints: int) -> list[tuple[str, float, float, float]]:
    """Of SB3's pickle of as many transitions."""
    model = SAC("MlpPolicy", make_mo_vec_env(WIDE_TASK, 1), buffer_size=MILLION, seed=0, device="cpu")
    fill(model.replay_buffer, 0, MILLION)
    costs = []
    for _ in range(n_checkpoints):
        for name, write in (("pickle", model.save_replay_buffer), ("synced", partial(save_and_sync, model))):
            with new_folder() as folder:
                seconds, megabytes = cost_of(partial(write, folder / "buffer.pkl"))
                costs.append((name, seconds, megabytes, sum(size_of(folder).values()) / 1e6))
    return costs


def save_and_sync(model: SAC, path: Path) -> None:
    """As a checkpoint that must outlive a power failure."""
    model.save_replay_buffer(path)
    with open(path, "rb") as file:
        os.fsync(file.fileno())


def million(counts: Counts) -> Measured:
    """What a checkpoint costs with a million transitions in the replay buffer, each training in a new process."""
    costs = []
    for measure in (momba_costs, sac_costs):
        with get_context("spawn").Pool(1) as pool:
            costs += pool.apply(measure, (counts["checkpoints"],))
    rows = [["", "writes", "seconds, median (largest)", "memory beside, MB", "written, MB"]]
    names = {
        "first": "MOMBA, first checkpoint: everything, 1,000,000 transitions new",
        "later": f"MOMBA, later checkpoint: everything, {NEW_ROWS:,} transitions new",
        "pickle": "SB3's save_replay_buffer: the transitions only, in the system's cache",
        "synced": "the same, forced to the disk as MOMBA's are",
    }
    for key, name in names.items():
        seconds, megabytes, written = zip(*(cost[1:] for cost in costs if cost[0] == key), strict=True)
        median = f"{statistics.median(seconds):.2f} ({max(seconds):.2f})"
        rows.append([name, len(seconds), median, f"{max(megabytes):.0f}", f"{statistics.median(written):.0f}"])
    return Measured(rows, [])


# ---------------------------------------------------------------------------------------------------------------- main

PARTS = {"kill": kill, "operations": operations, "resume": resume, "mutate": mutate, "disk": disk, "million": million}
MOST_SHOWN = 20


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"by default all: {', '.join(PARTS)}")
    parser.add_argument("--counts", choices=COUNTS, default="long")
    given = parser.parse_args()
    unknown = [part for part in given.parts if part not in PARTS]
    if unknown:
        parser.error(f"no part is called {unknown[0]!r}: {', '.join(PARTS)}")
    th.set_num_threads(1)  # a pool of threads does not survive a fork
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    parts = [name for name in given.parts or PARTS if name != "million" or given.counts == "long"]
    with new_folder() as folder:
        tempfile.tempdir = str(folder)  # for what SB3 leaves there, too
        new_model().learn(LEARNING_STARTS + 2)  # Now forked processes need not import anything.
        n_broken = sum(measure_and_print(name, COUNTS[given.counts]) for name in parts)
        tempfile.tempdir = None
    return 1 if n_broken else 0


def measure_and_print(name: str, counts: Counts) -> int:
    """How many promises did not hold."""
    start = time.perf_counter()
    measured = PARTS[name](counts)
    print(f"{name}: {PARTS[name].__doc__.splitlines()[0]} ({time.perf_counter() - start:.0f} s)\n")
    print(markdown([[str(cell) for cell in row] for row in measured.rows]))
    for fault in measured.broken[:MOST_SHOWN]:
        print(f"NOT HELD: {fault}")
    if len(measured.broken) > MOST_SHOWN:
        print(f"NOT HELD: and {len(measured.broken) - MOST_SHOWN} more")
    print(flush=True)
    return len(measured.broken)


if __name__ == "__main__":
    sys.exit(main())
