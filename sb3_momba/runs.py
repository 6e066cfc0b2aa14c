"""Training runs: what a run is set to, how it is made, cut off and gone on with, and what it leaves in its folder.

A run's folder holds the record (settings, curve and final front; `sb3_momba/records.py` says its format), checkpoints, the
models, the evaluations, the front's picture, and logs as CSV and for TensorBoard.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.logger import CSVOutputFormat, Logger, TensorBoardOutputFormat, configure
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_momba.checkpoints.callback import MombaCheckpointCallback
from sb3_momba.checkpoints.folders import checkpoints_in
from sb3_momba.envs.making import make_env, make_mo_vec_env, n_objectives_of
from sb3_momba.envs.preferences import check_preference, preference_grid
from sb3_momba.files import LOCK, alone_in
from sb3_momba.momba import MOMBA
from sb3_momba.pareto import protocol
from sb3_momba.pareto.callbacks import ParetoEvalCallback, RecordCallback
from sb3_momba.pareto.evaluation import MAX_PARALLEL_EPISODES, ParetoFront, probe_environment
from sb3_momba.pareto.floors import evaluate_floors
from sb3_momba.pareto.metrics import summarise
from sb3_momba.recording import RecordWriter, plain
from sb3_momba.records import FILE_NAME as RECORD_NAME
from sb3_momba.records import read_record
from sb3_momba.settings import check_whole
from sb3_momba.zoo.configuration import check_hyperparameters, with_defaults, with_schedules

CHECKPOINTS = "checkpoints"
# No result depends on these, but for which actions the random floor draws under other eval_envs: they are no settings of the
# method, and `config` is without them. A resumption takes over RUNNING.
RUNNING = ("eval_workers", "eval_envs", "checkpoint_freq", "keep_checkpoints")
NOT_IN_CONFIG = ("output", "progress_bar", *RUNNING)


@dataclass
class RunSettings:
    """One training run.

    :param label: the method's name in its record and in reports
    :param hyperparameters: MOMBA's arguments
    :param env_kwargs: of the environment, such as {"physics": "current"}
    :param output: the run's folder; must not hold a run already
    :param eval_freq: environment steps between evaluations
    :param eval_workers: processes that share an evaluation
    :param eval_envs: copies of the environment in each of them, at most
    :param checkpoint_freq: environment steps between checkpoints
    :param keep_checkpoints: how many of them stay
    :param reference_point: of the hypervolume; None: the task's in `pareto/protocol.py`
    :param preference: to train and evaluate for alone, as the fixed-preference runs of section 4.2.4; None: for all
    """

    env: str
    output: str
    steps: int = 1_000_000
    seed: int = 0
    label: str = "momba"
    policy: str = "SimbaPolicy"
    hyperparameters: dict[str, Any] = field(default_factory=dict)
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    n_envs: int = 1
    subprocesses: bool = False
    eval_freq: int = 50_000
    n_preferences: int = protocol.N_PREFERENCES
    n_episodes: int = protocol.N_EPISODES
    reference_point: list[float] | None = None
    preference: list[float] | None = None
    objectives: list[str] | None = None
    eval_workers: int = 1
    eval_envs: int = MAX_PARALLEL_EPISODES
    checkpoint_freq: int = 10_000
    keep_checkpoints: int = 2
    device: str = "auto"
    progress_bar: bool = True


@dataclass
class RunResult:
    """What a run left: its front, its metrics over time, those of policies that learned nothing, and its folder."""

    front: ParetoFront
    timesteps: list[int]
    metrics: list[dict[str, float]]
    floors: dict[str, dict[str, float]]
    folder: Path


@dataclass
class Prepared:
    """A run that nothing speaks against."""

    model: MOMBA
    evaluation: ParetoEvalCallback
    record: RecordWriter
    preferences: np.ndarray
    reference_point: Sequence[float]


@contextlib.contextmanager
def prepared(settings: RunSettings, resumed: bool = False) -> Iterator[Prepared]:
    """The model, with its environments open, and its evaluation. Nothing is written.

    :param resumed: the model of the newest checkpoint instead of a new one
    :raises ValueError: for settings that cannot be
    """
    if not resumed:  # A record has names in place of classes; the checkpoint has the hyperparameters themselves.
        check_hyperparameters(settings.policy, settings.hyperparameters)
    for name in ("steps", *RUNNING):
        check_whole(name, getattr(settings, name), 1)
    hyperparameters = hyperparameters_of(settings)
    folder = Path(settings.output)
    make_one = partial(make_env, settings.env, settings.env_kwargs)
    env = make_mo_vec_env(make_one, settings.n_envs, vec_env_cls=SubprocVecEnv if settings.subprocesses else DummyVecEnv)
    try:
        reference_point = settings.reference_point or protocol.reference_point_of(settings.env, n_objectives_of(env))
        preferences = preferences_of(settings, n_objectives_of(env))
        record = RecordWriter(folder / RECORD_NAME)
        evaluation = ParetoEvalCallback(
            make_one,
            eval_freq=settings.eval_freq,
            n_episodes=settings.n_episodes,
            preferences=preferences,
            reference_point=reference_point,
            objectives=settings.objectives,
            n_workers=settings.eval_workers,
            n_envs=settings.eval_envs,
            log_path=folder,
            best_model_save_path=folder,
            callback_after_eval=RecordCallback(record),
        )
        if resumed:
            model = MOMBA.resume(folder / CHECKPOINTS, env, device=settings.device)
        else:
            model = MOMBA(settings.policy, env, seed=settings.seed, device=settings.device, **with_schedules(hyperparameters))
        evaluation.check(model)
        yield Prepared(model, evaluation, record, preferences, reference_point)
    finally:
        env.close()


def hyperparameters_of(settings: RunSettings) -> dict[str, Any]:
    """MOMBA's arguments, with the sampler of a run for one preference.

    :raises ValueError: for such a run with another sampler
    """
    if settings.preference is None:
        return settings.hyperparameters
    given = settings.hyperparameters.get("preference_sampler")
    if given not in (None, settings.preference):
        raise ValueError(f"preference={settings.preference} and preference_sampler={given!r}: leave one of them out.")
    return {**settings.hyperparameters, "preference_sampler": settings.preference}


def preferences_of(settings: RunSettings, n_objectives: int) -> np.ndarray:
    """What a run is evaluated for, (P, n_objectives)."""
    if settings.preference is None:
        return preference_grid(n_objectives, settings.n_preferences)
    return check_preference(np.array([settings.preference]), n_objectives).astype(np.float64)


def run(settings: RunSettings, on_step: Callable[[int], None] | None = None) -> RunResult:
    """Train, evaluate and write the run's folder.

    :param on_step: called after each step of the environments with the number of steps so far; it changes no result
    """
    folder = Path(settings.output)
    check_empty(folder)
    with prepared(settings) as ready, alone_in(folder):
        check_empty(folder)  # Another run may have come first.
        model, evaluation = ready.model, ready.evaluation
        assert evaluation.eval_env is not None
        sizes = {
            "actor": sum(p.numel() for p in model.actor.parameters()),
            "critic": sum(p.numel() for p in model.critic.parameters()),
        }
        config = recorded_settings(settings)
        start = description(settings, config, ready.preferences, ready.reference_point, sizes)
        with ready.record.start(**start, running=running_settings(settings)) as record:
            env, n_episodes, n_envs = evaluation.eval_env, settings.n_episodes, settings.eval_envs
            append_floors(record, env, ready.preferences, ready.reference_point, n_episodes, n_envs=n_envs)
            model.set_logger(configure(str(folder), ["csv", "tensorboard"]))
            return _train(settings, ready, record, settings.steps, on_step)


def check(settings: RunSettings) -> None:
    """:raises ValueError: for settings that cannot be"""
    with prepared(settings):
        pass


def check_empty(folder: Path) -> None:
    """:raises ValueError: for a folder that holds anything, or something that is none"""
    if folder.exists() and (not folder.is_dir() or any(file.name != LOCK for file in folder.iterdir())):
        way_on = f", or go on with its run: --resume {folder}" if has_checkpoint(folder) else ""
        raise ValueError(f"{folder} exists and is not an empty folder: choose another --output{way_on}.")


def has_checkpoint(folder: Path) -> bool:
    """Whether a run can be gone on with."""
    return bool(checkpoints_in(folder / CHECKPOINTS))


def resume(folder: Path, on_step: Callable[[int], None] | None = None, **running: Any) -> RunResult:
    """Go on with a run that was cut off, from its newest checkpoint.

    :param on_step: see `run`
    :param running: settings that no result depends on, such as eval_workers, in place of those that it had last
    :raises ValueError: if there is nothing to go on with
    """
    path = folder / RECORD_NAME
    if not path.is_file():
        raise ValueError(f"{folder} holds no run: give the folder that a run was started with as its --output.")
    with alone_in(folder):
        found = read_record(path)
        if found.error is None:
            raise ValueError(f"{folder} holds a run that has finished: there is nothing to go on with.")
        if not has_checkpoint(folder):
            raise ValueError(
                f"{folder} holds a run that was cut off before its first checkpoint: delete it, and start it again."
            )
        for line in (*reversed(found.resumed), found.start):  # Of older versions they do not say how the run was run.
            had = line.get("running", {})
            running = {**{name: had[name] for name in RUNNING if name in had}, **running}
        settings = RunSettings(**{**found.config, **running, "output": str(folder)})
        with (
            prepared(settings, resumed=True) as ready,
            ready.record.resume(ready.model.num_timesteps, running=running_settings(settings)) as record,
        ):
            name = f"progress_{ready.model.num_timesteps}.csv"  # The logs so far stay.
            outputs = [CSVOutputFormat(str(folder / name)), TensorBoardOutputFormat(str(folder))]
            ready.model.set_logger(Logger(str(folder), outputs))
            return _train(settings, ready, record, ready.model.remaining_timesteps, on_step)


def _train(
    settings: RunSettings, ready: Prepared, record: RecordWriter, steps: int, on_step: Callable[[int], None] | None
) -> RunResult:
    folder, model, evaluation = Path(settings.output), ready.model, ready.evaluation
    checkpoints = MombaCheckpointCallback(settings.checkpoint_freq, folder / CHECKPOINTS, settings.keep_checkpoints)
    try:
        callbacks: list[BaseCallback] = [evaluation, checkpoints]
        if on_step is not None:
            callbacks.append(ConvertCallback(lambda *_: on_step(model.num_timesteps) or True))
        model.learn(steps, callbacks, reset_num_timesteps=model.num_timesteps == 0, progress_bar=settings.progress_bar)
    finally:
        model.save(folder / "model.zip")
    assert evaluation.front is not None
    record.finish(model.num_timesteps, vars(evaluation.front))
    floors = {
        floor.policy: summarise(floor.values, ready.preferences, ready.reference_point)
        for floor in read_record(record.path).floors
    }
    return RunResult(evaluation.front, evaluation.timesteps, evaluation.metrics, floors, folder)


def record_failure(settings: RunSettings, error: str, traceback: str = "") -> None:
    """A record in the run's folder of a run that died before it could begin one."""
    n_objectives = probe_environment(settings.env, settings.env_kwargs).n_objectives
    reference_point = settings.reference_point or protocol.reference_point_of(settings.env, n_objectives)
    preferences = preferences_of(settings, n_objectives)
    path = Path(settings.output) / RECORD_NAME
    path.unlink(missing_ok=True)  # It may have been cut off in its first line.
    with RecordWriter(path).start(
        **description(settings, recorded_settings(settings), preferences, reference_point, {})
    ) as record:
        record.fail(error, traceback)


class Described(Protocol):
    """What the first line of a record says of any run's settings."""

    label: str
    env: str
    env_kwargs: dict[str, Any]
    seed: int


def description(
    settings: Described,
    config: dict[str, Any],
    preferences: np.ndarray,
    reference_point: Sequence[float],
    parameters: dict[str, int],
    general_policy: bool = True,
) -> dict[str, Any]:
    """The first line of a run's record.

    :param config: every setting of the run, as JSON holds it
    :param preferences: of the protocol, (P, n_objectives)
    :param parameters: how many trainable ones each network has
    :param general_policy: whether one policy answers the preferences
    """
    return {
        "label": settings.label,
        "env": settings.env,
        "env_kwargs": plain(settings.env_kwargs),
        "seed": settings.seed,
        "config": config,
        "reference_point": reference_point,
        "preferences": preferences,
        "general_policy": general_policy,
        "parameters": parameters,
    }


def append_floors(
    record: RecordWriter,
    env: str | gym.Env | VecEnv | Callable[[], gym.Env],
    preferences: np.ndarray,
    reference_point: Sequence[float],
    n_episodes: int,
    general_policy: bool = True,
    n_envs: int = MAX_PARALLEL_EPISODES,
) -> dict[str, dict[str, float]]:
    """Measure policies that learned nothing, and append them to a record; their metrics by the policy's name."""
    measured = {}
    for name, front in evaluate_floors(env, preferences, n_episodes, n_envs=n_envs).items():
        measured[name] = summarise(front.values, preferences, reference_point, general_policy)
        record.append("floor", policy=name, **measured[name], values=front.values)
    return measured


def recorded_settings(settings: RunSettings) -> dict[str, Any]:
    """Every setting that a result depends on, defaults included, as JSON holds it."""
    config = {name: value for name, value in asdict(settings).items() if name not in NOT_IN_CONFIG}
    config["hyperparameters"] = with_defaults(settings.policy, hyperparameters_of(settings))
    return dict(plain(config))


def running_settings(settings: RunSettings) -> dict[str, int]:
    """What a resumption takes over although no result depends on it."""
    return {name: getattr(settings, name) for name in RUNNING}
