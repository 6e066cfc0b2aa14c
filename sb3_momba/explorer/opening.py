"""From a run's folder or a model's file to a decision kit: what there is to decide about, or why there is nothing."""

import contextlib
import logging
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_momba import MOMBA
from sb3_momba.envs.preferences import preference_grid
from sb3_momba.explorer.kit import DecisionKit
from sb3_momba.explorer.prediction import Calibration, calibrate, draw_calibration
from sb3_momba.explorer.reading import Run, read_run
from sb3_momba.explorer.rendering import RenderingProcess, check_filmable
from sb3_momba.explorer.rollouts import roll_out
from sb3_momba.explorer.stage import RenderingError
from sb3_momba.methods import method_settings
from sb3_momba.pareto.evaluation import ParetoFront, check_model_fits, probe_environment
from sb3_momba.pareto.protocol import N_EPISODES
from sb3_momba.records import Record

NICE = 10
N_SURVEYED = 41  # preferences that are rolled out before the page opens

logger = logging.getLogger(__name__)


@contextlib.contextmanager
def open_kit(
    path: Path, env: str | None = None, seeds: Sequence[Path] = (), folder: Path | None = None, films: bool = True
) -> Iterator[DecisionKit]:
    """A kit about a model, whose process ends with it.

    :param path: folder of a run; or a model's file, with `env`
    :param env: id
    :param seeds: folders of runs of the same method with other seeds
    :param folder: where kept policies go; by default `kept` beside the model
    :param films: whether they are wanted
    :raises ValueError: for what there is nothing to decide about, saying why
    """
    if env is None and path.is_file():
        raise ValueError(f"{path} is a file: say also what environment it acts in, --env ID, or give the folder of its run.")
    run = model_alone(path, env) if env is not None else read_run(path)
    if env is None and (run.model is None or run.preferences is None):
        raise ValueError(f"{path} has no policy to choose a preference for. {run.no_films}")
    if run.record.error is not None or run.policy.path.name != "model.zip":
        run.front = None  # It is that of the training's last policy, which is not the one to choose from.
    model = MOMBA.load(run.policy.path, device="cpu")
    n_objectives = check_model_fits(model, probe_environment(run.policy.env, run.policy.env_kwargs))
    if n_objectives < 2:
        raise ValueError(f"{path} has one objective: there is no trade-off to choose.")
    if run.front is not None and len(np.unique(run.front.preferences, axis=0)) < 2:
        weights = ", ".join(f"{weight:.4g}" for weight in run.front.preferences[0])
        raise ValueError(
            f"The front of {path} has one point, of the preference ({weights}): there is nothing to "
            "choose between. Give a run that was evaluated under several preferences, or its model.zip with --env."
        )
    others = [other_seed(one, run, model.gamma) for one in seeds]
    no_film, process = start_process(run) if films else ("none are wanted", RenderingProcess(needs_gl=False))
    with process:
        process.call(be_nice)
        grid = preference_grid(n_objectives, N_SURVEYED).astype(np.float32).astype(np.float64)
        logger.info("Rolling out %d preferences ...", len(grid))
        seed = 0 if run.front is None else int(run.front.settings.get("seed", 0))
        survey = process.call(roll_out, run.policy, grid, N_EPISODES, seed)
        if run.front is None:
            run.front, run.values = survey.front, survey.front.values
        yield DecisionKit(run, model, process, no_film, survey, others, folder or run.policy.path.parent / "kept")


def be_nice() -> None:
    """Leave the processor to whoever answers the page, while this process rolls out."""
    if hasattr(os, "nice"):
        os.nice(NICE)


def model_alone(path: Path, env: str) -> Run:
    """A model's file as a run that was not recorded: its front is not known yet."""
    if not path.is_file():
        raise ValueError(f"{path} is no file: with --env, give a model's, such as model.zip.")
    none: Any = {"config": {}, "parameters": {}, "start": {}, "floors": [], "evaluations": []}
    n = probe_environment(env).n_objectives
    record = Record(path, path.stem, env, {}, 0, **none, reference_point=np.zeros(n), preferences=np.eye(n),
                    general_policy=True, final_values=None, error=None)  # fmt: skip
    return Run(path.stem, record, np.zeros((n, n)), None, path)


def other_seed(folder: Path, run: Run, gamma: float) -> ParetoFront:
    """The front of a run that differs from another one by its seed alone; from a model without a record, as far as can be seen.

    :param gamma: of the model
    :raises ValueError: for a run of another task or method or of the same seed, or without a front, saying what differs
    """
    other = read_run(folder)
    if folder.resolve() == run.policy.path.parent:
        raise ValueError(f"--seeds {folder} is the run itself: give runs with other seeds.")
    if other.record.task != run.record.task:
        raise ValueError(f"--seeds {folder} is a run of {other.record.task}, not of {run.record.task}.")
    if other.front is None:
        raise ValueError(f"--seeds {folder} has no discounted returns of a finished run: leave it out.")
    if run.record.config:
        if other.record.seed == run.record.seed:
            raise ValueError(f"--seeds {folder} has the seed {run.record.seed} too: give runs with other seeds.")
        ours, theirs = ({"label": one.record.label, **method_settings(one.record)} for one in (run, other))
    else:
        ours, theirs = {"gamma": gamma}, {"gamma": other.front.settings.get("gamma", gamma)}
    differing = [name for name in sorted({*ours, *theirs}) if ours.get(name) != theirs.get(name)]
    if differing:
        texts = ", ".join(f"{name} is {theirs.get(name)!r} instead of {ours.get(name)!r}" for name in differing)
        raise ValueError(f"--seeds {folder} differs by more than its seed: {texts}.")
    return other.front


def start_process(run: Run) -> tuple[str, RenderingProcess]:
    """A process that films where that can be; else the reason, and one that only rolls out."""
    try:
        return "", RenderingProcess(needs_gl=check_filmable(run.policy))
    except (RenderingError, ImportError, gym.error.Error) as error:
        logger.warning("No films: %s", error)
        return str(error), RenderingProcess(needs_gl=False)


def write_calibration(path: Path, env: str | None, n_preferences: int, output: Path) -> Calibration:
    """Compare each predictor with rollouts under random preferences: print how often it is right, and draw how it errs."""
    if n_preferences < 1:
        raise ValueError(f"--preferences {n_preferences}: give at least 1.")
    with open_kit(path, env, films=False) as kit:
        logger.info("Rolling out %d random preferences ...", n_preferences)
        calibration = calibrate(kit.predictors, kit.roll_out, n_preferences)
        for name, share in calibration.shares.items():
            error = np.abs(calibration.predicted[name] - calibration.measured).mean(axis=0)
            errors = ", ".join(f"{one} {value:.4g}" for one, value in zip(kit.objectives, error, strict=True))
            logger.info("%s: within 5 %% on %.0f %% of %d preferences; mean error %s", name, 100 * share, n_preferences, errors)
        draw_calibration(calibration, kit.objectives, f"{kit.run.record.task}, {kit.run.name}", output)
    return calibration
