"""What a checkpoint costs with a million transitions in the replay buffer."""

import ctypes
import os
import statistics
import time
from collections.abc import Callable
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import SAC

from sb3_momba import MOMBA, MombaCheckpointCallback, make_mo_vec_env
from tests.torture.measured import Counts, Measured, Rows
from tests.torture.processes import new_folder

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
    rows: Rows = [["", "writes", "seconds, median (largest)", "memory beside, MB", "written, MB"]]
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
