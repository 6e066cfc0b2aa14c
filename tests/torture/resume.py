"""Trainings that go on from a checkpoint against those that never stopped."""

from pathlib import Path

from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback

from sb3_momba import MombaCheckpointCallback, make_mo_vec_env
from sb3_momba.checkpoints.folders import checkpoints_in
from tests.torture.fingerprints import fingerprint, hash_of
from tests.torture.measured import Counts, Measured, Rows, totals
from tests.torture.processes import die, new_folder, result_of, started, was_killed
from tests.torture.trainings import new_model, new_sac, resumed

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
    model = resumed(folder, task, n_envs)
    return fingerprint(model.learn(model.remaining_timesteps, reset_num_timesteps=False))


def resume(counts: Counts) -> Measured:
    """Trainings that go on from a checkpoint to their end, against those that never stopped."""
    rows: Rows = [["task", "environments", "points", "different hashes", "SB3's SAC, points", "different parameters"]]
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
    rows.append(["all", "", *totals(rows)[1:]])
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
