"""A training that is killed at random moments, and goes on from what is left."""

import random
from collections import Counter
from functools import partial
from pathlib import Path

from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import CheckpointCallback

from sb3_momba import MombaCheckpointCallback
from sb3_momba.checkpoints.folders import checkpoints_in, newest
from tests.torture.checkpoints import faults_of, undisturbed_fingerprints
from tests.torture.measured import Counts, Measured, Rows
from tests.torture.processes import kill_when, new_folder, result_of, started
from tests.torture.trainings import SAVE_FREQ, new_model, new_sac, resumed

CHAIN = 400  # steps of a training that is killed on its way, again and again
LONGEST_LIFE = 0.6  # seconds until a kill


def train(folder: Path) -> None:
    """Begin a training with checkpoints, or go on with one."""
    model = resumed(folder) if checkpoints_in(folder) else new_model()
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
    rows: Rows = [
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
