"""`python -m sb3_momba.explorer strobe RUN`: poses along the path under several preferences (Figure 4.6)."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_momba.envs.making import make_env
from sb3_momba.envs.preferences import check_preference, preference_grid
from sb3_momba.envs.simulator import mujoco
from sb3_momba.explorer.reading import objectives_of, read_run
from sb3_momba.explorer.rendering import Policy, RenderingProcess, check_filmable, is_mujoco, record_episode, seconds_per_step
from sb3_momba.explorer.stage import Camera, Image, RenderingError, Stage, body_box, camera_on
from sb3_momba.pareto.plotting import save_figure, verbatim

SECONDS = 3.0  # of simulated time: 200 steps of the Humanoid, as in Figure 4.6
N_PREFERENCES = 4
WIDTH = 1_600  # pixels
SHORTEST = 3.0  # a picture is at least so many times wider than high
FAINTEST, FADED = 0.12, 0.35  # opacity of the first and of the last but one pose


@dataclass(frozen=True)
class Strobe:
    """One row of the picture.

    :param image: (height, width, 3)
    :param steps: of the last pose, which is opaque; fewer than asked for where the episode ended before
    :param distance: of the mass centre along x until then, in metres
    """

    image: Image
    steps: int
    distance: float


def draw_strobe(
    folder: Path,
    path: Path,
    preferences: ArrayLike | None = None,
    steps: int | None = None,
    n_poses: int = 8,
    width: int = WIDTH,
) -> list[Strobe]:
    """Write a picture with a row for each preference, all of one scale.

    :param folder: of a run
    :param path: of the picture; its suffix chooses the format
    :param preferences: (n, n_objectives); by default four, equally spaced
    :param steps: how long each path is; by default 3 s of simulated time
    :param n_poses: how many are drawn along it; the last one is opaque
    :param width: of each row, in pixels
    :return: the rows
    :raises ValueError: for a folder that is no run or has no model, a preference off the simplex, or numbers below 1
    :raises RenderingError: if nothing can be drawn here
    """
    for name, n in (("steps", 1 if steps is None else steps), ("poses", n_poses)):
        if n < 1:
            raise ValueError(f"--{name} {n}: give at least 1.")
    run = read_run(folder)
    if run.model is None or run.preferences is None:
        raise ValueError(f"{folder} cannot be drawn. {run.no_films}")
    n_objectives = run.preferences.shape[1]
    wanted = preference_grid(n_objectives, N_PREFERENCES)[::-1] if preferences is None else preferences
    grid = check_preference(np.atleast_2d(np.asarray(wanted)), n_objectives).astype(np.float64)
    check_filmable(run.policy)
    env = make_env(run.policy.env, run.policy.env_kwargs)
    seconds, drawable = seconds_per_step(env), is_mujoco(env)
    env.close()
    if not drawable:
        raise RenderingError(f"{run.record.task} has no bodies of MuJoCo: only those can be drawn as strobe pictures.")
    steps = max(1, round(SECONDS / (seconds or SECONDS / 200))) if steps is None else steps
    with RenderingProcess() as process:
        rows, box = process.call(strobes, run.policy, grid, steps, n_poses, width, process.backend)
    _write(rows, box, grid, objectives_of(run.record), run.record.task, seconds, path)
    return rows


def strobes(
    policy: Policy, preferences: NDArray[np.float64], steps: int, n_poses: int, width: int, backend: str
) -> tuple[list[Strobe], tuple[float, float]]:
    """A row for each preference, and from where to where along x, in metres, they all show.

    The poses lie equally many steps apart, the start among them.
    """
    model: Any = _model(policy)
    every, every_last = [], []
    for preference in preferences:
        states, _ = record_episode(policy, preference, 0, 0, lambda: make_env(policy.env, policy.env_kwargs), _state, 1)
        last = min(steps, len(states) - 1)
        shown = sorted({round(step) for step in np.linspace(0, last, n_poses)} | {last})
        every.append([_posed(model, states[step]) for step in shown])
        every_last.append(last)
    camera, height, left, right = _view(model, [pose for poses in every for pose in poses])
    length = max(right - left, SHORTEST * height)
    left, right = (left + right - length) / 2, (left + right + length) / 2
    _look_from_afar(model, camera, length, height)
    stage = Stage(model, width, max(16, round(width * height / length)), backend, fine=True)
    rows = []
    for poses, last in zip(every, every_last, strict=True):
        opacities = np.linspace(FAINTEST, FADED, max(len(poses) - 1, 1))
        image = stage.image(poses[-1], camera, list(zip(poses[:-1], opacities.tolist(), strict=False)))
        distance = float(poses[-1].subtree_com[0, 0] - poses[0].subtree_com[0, 0])
        rows.append(Strobe(image, last, distance))
    stage.close()
    return rows, (left, right)


def _state(env: gym.Env) -> Any:
    return env.unwrapped.data.qpos.copy()  # type: ignore[attr-defined]


def _posed(model: Any, qpos: NDArray[np.float64]) -> Any:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return data


def _model(policy: Policy) -> Any:
    env = make_env(policy.env, policy.env_kwargs)
    model = copy.copy(env.unwrapped.model)  # type: ignore[attr-defined]
    env.close()
    return model


def _look_from_afar(model: Any, camera: Camera, width: float, height: float) -> None:
    """Set the camera so far away, and the angle of its view so small, that metres are everywhere the same."""
    camera.distance = 20 * max(width, height)
    model.vis.global_.fovy = np.rad2deg(2 * np.arctan(height / 2 / camera.distance))
    model.vis.map.znear, model.vis.map.zfar = (factor * camera.distance / model.stat.extent for factor in (0.3, 3.0))


def _view(model: Any, poses: Sequence[Any]) -> tuple[Camera, float, float, float]:
    """A camera that sees all poses, the height of its view, and from where to where along x they reach, in metres."""
    boxes = np.array([body_box(model, pose) for pose in poses])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    elevation = camera_on(model, poses[0]).elevation
    angle = np.deg2rad(-elevation)
    _, y, z = high - low
    height = 1.1 * float(z * np.cos(angle) + y * np.sin(angle))
    margin = 0.04 * float(high[0] - low[0])
    return Camera((low + high) / 2, 2 * float((high - low).max()), elevation), height, low[0] - margin, high[0] + margin


def _write(
    rows: Sequence[Strobe],
    box: tuple[float, float],
    preferences: NDArray[np.float64],
    objectives: Sequence[str],
    task: str,
    seconds: float | None,
    path: Path,
) -> None:
    from matplotlib.figure import Figure  # It takes half a second to import.

    height, width = rows[0].image.shape[:2]
    row = 10 * height / width
    figure = Figure(figsize=(10.4, len(rows) * (row + 0.35) + 0.8), layout="constrained")
    figure.suptitle(verbatim(task), x=0.005, ha="left", fontsize=13, fontweight="bold")
    all_axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    for axes, strobe, preference in zip(all_axes, rows, preferences, strict=True):
        axes.imshow(strobe.image, extent=(*box, 0, (box[1] - box[0]) * height / width), interpolation="lanczos")
        asked = ", ".join(f"{weight:.2f} {name}" for weight, name in zip(preference, objectives, strict=True))
        time = f"{strobe.steps} steps" + ("" if seconds is None else f" ({strobe.steps * seconds:.3g} s)")
        axes.set_title(verbatim(asked), loc="left", fontsize=10)
        axes.set_title(f"{strobe.distance:+.2f} m in {time}", loc="right", fontsize=10, color="#52606d")
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0, labelsize=9, colors="#52606d")
    all_axes[-1].set_xlabel("x (m)", fontsize=9, color="#52606d")
    save_figure(figure, path)
