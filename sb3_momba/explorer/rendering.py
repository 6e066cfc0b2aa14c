"""Films of rollouts, made in a process of their own: OpenGL may fail in ways that take a process with it.

A filmed episode is one of `evaluate_front`, with the same numbers: cameras only look at the state.
"""

import importlib.util
import os
import tempfile
import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_momba import MOMBA
from sb3_momba.envs.making import make_env
from sb3_momba.envs.simulator import mujoco
from sb3_momba.explorer.stage import Camera, Image, RenderingError, Stage, backends, camera_on, follow
from sb3_momba.pareto.evaluation import check_model_fits, probe_environment, run_jobs

FPS = 20
LONGEST_FILM = 250  # frames
WIDTH, HEIGHT = 400, 304  # multiples of 16, as codecs like them
QUALITY = 26  # x264's constant rate factor
USUAL_STEPS = 1_000  # of an episode whose longest is not declared

Result = TypeVar("Result")


@dataclass(frozen=True)
class Policy:
    """A model in a file, and the environment that it acts in: what a process needs to roll it out.

    :param path: of the model
    :param env: id
    :param env_kwargs: of the id
    :param deterministic: the mean action instead of a sample
    """

    path: Path
    env: str
    env_kwargs: dict[str, Any]
    deterministic: bool = True


@dataclass(frozen=True)
class Film:
    """One episode under one preference.

    :param video: MP4 (H.264)
    :param returns: undiscounted, up to each frame, (frames, n_objectives); the first frame is the start
    :param total: of the whole episode, (n_objectives,)
    :param steps: of the episode
    :param seconds_per_step: of simulated time; None if the environment does not say
    """

    video: bytes
    returns: NDArray[np.float64]
    total: NDArray[np.float64]
    steps: int
    stride: int
    seconds_per_step: float | None

    @property
    def speed(self) -> float | None:
        """How many times faster than in simulated time it plays."""
        return None if self.seconds_per_step is None else self.stride * self.seconds_per_step * FPS


class Recorder(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps what the first episode that ends saw, did and earned, and what it looked like.

    :param picture: of the environment as it is now; None: nothing is drawn
    :param stride: steps between pictures
    """

    def __init__(self, env: gym.Env, picture: Callable[[gym.Env], Any] | None = None, stride: int = 1):
        super().__init__(env)
        self.picture, self.stride = picture, stride
        self.is_over = self.is_truncated = False

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """The environment's."""
        observation, info = self.env.reset(**kwargs)
        if not self.is_over:
            self.pictures: list[Any] = []
            self.observations: list[NDArray[np.float32]] = []
            self.actions: list[NDArray[np.float32]] = []
            self.rewards: list[NDArray[np.float32]] = []
            self._look(observation)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """The environment's."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if not self.is_over:
            self.actions.append(np.array(action, dtype=np.float32))
            self.rewards.append(np.array(reward, dtype=np.float32))  # as PreferenceWrapper gives them
            self._look(observation)
            self.is_over, self.is_truncated = terminated or truncated, truncated and not terminated
        return observation, reward, terminated, truncated, info

    def _look(self, observation: Any) -> None:
        if self.picture is not None and len(self.rewards) % self.stride == 0:
            self.pictures.append(self.picture(self.env))
        self.observations.append(np.array(observation, dtype=np.float32))


def is_mujoco(env: gym.Env) -> bool:
    """Whether its state can be drawn by a Stage."""
    return isinstance(getattr(env.unwrapped, "model", None), mujoco.MjModel)


def record_episode(
    policy: Policy,
    preference: NDArray[np.float64],
    number: int,
    seed: int,
    make: Callable[[], gym.Env],
    picture: Callable[[gym.Env], Any],
    stride: int,
) -> tuple[list[Any], NDArray[np.float64]]:
    """One episode's pictures, and its returns so far, (steps + 1, n_objectives).

    :param number: of the episode among all those of the evaluation that it shall equal; see `evaluate_front`
    """
    model = load_model(policy.path)
    recorders: list[Recorder] = []

    def recorded() -> gym.Env:
        recorders.append(Recorder(make(), picture, stride))
        return recorders[0]

    jobs = [(number, preference, seed)]
    total, _, _ = run_jobs(model, recorded, None, jobs, 1.0, policy.deterministic)
    rewards = np.array(recorders[0].rewards, dtype=np.float64)
    returns = np.cumsum(rewards.reshape(len(rewards), -1), axis=0)
    assert np.array_equal(returns[-1], total[0])
    return recorders[0].pictures, np.concatenate([np.zeros((1, returns.shape[1])), returns])


def film(policy: Policy, preference: NDArray[np.float64], number: int, seed: int, backend: str) -> Film:
    """Roll a policy out once and film it; see `record_episode`."""
    env = _filmed_env(policy)
    seconds = seconds_per_step(env)
    stride = stride_of(env, seconds)
    if is_mujoco(env):
        env.reset(seed=seed)
        physics: Any = env.unwrapped
        camera, stage = camera_on(physics.model, physics.data), Stage(physics.model, WIDTH, HEIGHT, backend)

        def picture(one: gym.Env) -> Image:
            return stage.image(one.unwrapped.data, follow(camera, one.unwrapped.data))  # type: ignore[attr-defined]

        try:
            pictures, returns = record_episode(policy, preference, number, seed, lambda: _filmed_env(policy), picture, stride)
        finally:
            stage.close()
    else:
        pictures, returns = record_episode(policy, preference, number, seed, lambda: _filmed_env(policy), rendered, stride)
    env.close()
    steps = len(returns) - 1
    shown = np.arange(len(pictures)) * stride
    return Film(encode(pictures), returns[shown], returns[-1], steps, stride, seconds)


def rendered(env: gym.Env) -> Image:
    """What an environment draws by itself, (height, width, 3).

    :raises RenderingError: if that is no image
    """
    image = np.asarray(env.render())
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        name = type(env.unwrapped).__name__
        raise RenderingError(f"{name} draws no images: its render() gives none with render_mode='rgb_array'.")
    return image


def _filmed_env(policy: Policy) -> gym.Env:
    """The task's own environment, able to draw itself only where no Stage can draw it."""
    env = make_env(policy.env, policy.env_kwargs)
    if is_mujoco(env):
        return env
    env.close()
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame opens no window then
    env = make_env(policy.env, policy.env_kwargs, render_mode="rgb_array")
    if env.render_mode != "rgb_array":
        raise RenderingError(f"{policy.env} cannot be filmed: it has no render_mode 'rgb_array'.")
    return env


def seconds_per_step(env: gym.Env) -> float | None:
    """Of simulated time, as far as the environment says it."""
    if is_mujoco(env) and hasattr(env.unwrapped, "dt"):
        return float(env.unwrapped.dt)
    fps = env.metadata.get("render_fps")
    return 1 / fps if fps else None


def stride_of(env: gym.Env, seconds: float | None) -> int:
    """Steps between frames: in real time, or faster where the longest episode would give too many frames."""
    longest = (env.spec.max_episode_steps if env.spec is not None else None) or USUAL_STEPS
    real_time = 1 if seconds is None else round(1 / (FPS * seconds))
    return max(1, real_time, ceil(longest / LONGEST_FILM))


def encode(pictures: Sequence[Image]) -> bytes:
    """Images of one size as an MP4 that every browser plays.

    :raises ImportError: if imageio-ffmpeg is missing
    """
    import imageio_ffmpeg

    height, width = pictures[0].shape[:2]
    even = f"scale='min({width},2*{WIDTH})':-2,pad=ceil(iw/2)*2:ceil(ih/2)*2"
    options = ["-crf", str(QUALITY), "-preset", "fast", "-threads", "1", "-movflags", "+faststart", "-vf", even]
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/film.mp4"
        writer = imageio_ffmpeg.write_frames(
            path, (width, height), fps=FPS, codec="libx264", macro_block_size=1, quality=None, output_params=options
        )
        writer.send(None)
        for picture in pictures:
            writer.send(np.ascontiguousarray(picture))
        writer.close()
        return Path(path).read_bytes()


def load_model(path: Path) -> MOMBA:
    """A model on the processor, read again only when its file has changed."""
    return _load_version(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _load_version(path: Path, _written: int) -> MOMBA:
    return MOMBA.load(path, device="cpu")


def quieten() -> None:
    """Without Gymnasium's warnings of what rounding does to the bounds of a space, one for each environment that is made."""
    warnings.filterwarnings("ignore", message=r".*precision lowered by casting")


def begin_process() -> None:
    """Let no one be left behind where the parent is killed, or ended by a signal that it does not handle."""
    quieten()

    def watch() -> None:
        parent = parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class RenderingProcess:
    """A process in which OpenGL works; `with` ends it, and so does the end of this one.

    :param needs_gl: whether it must
    :raises RenderingError: where it does not, with what each way to draw said
    """

    def __init__(self, needs_gl: bool = True):
        self.backend = ""
        self.pool = self._start()
        if needs_gl:
            self._choose_backend()

    def _start(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=begin_process)

    def _choose_backend(self) -> None:
        reasons = []
        for backend in backends():
            try:
                self.call(try_backend, backend)
                self.backend = backend
                return
            except RenderingError as error:
                reasons.append(str(error))
                self.pool.shutdown()
                self.pool = self._start()  # A library that failed stays loaded.
        self.pool.shutdown()
        raise RenderingError(
            f"OpenGL does not work without a window here ({'; '.join(reasons)}). Install libegl1 or libosmesa6, as in "
            "`apt-get install libegl1 libosmesa6`."
        )

    def call(self, function: Callable[..., Result], *arguments: Any) -> Result:
        """`function(*arguments)` in the process.

        :raises RenderingError: if it crashes, which the next call does not feel; an error that is raised comes out as it is
        """
        try:
            return self.pool.submit(function, *arguments).result()
        except BrokenProcessPool as error:
            self.pool.shutdown()
            self.pool = self._start()
            raise RenderingError("the process that draws crashed") from error

    def __enter__(self) -> "RenderingProcess":
        return self

    def __exit__(self, *error: object) -> None:
        self.pool.shutdown(cancel_futures=True)


def try_backend(backend: str) -> None:
    """Draw something.

    :raises RenderingError: if nothing comes of it
    """
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body><geom size='1'/></body></worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    stage = Stage(model, 16, 16, backend)
    image = stage.image(data, Camera(np.zeros(3), 4.0, 0.0))
    stage.close()
    if np.ptp(image) == 0:
        raise RenderingError(f"{backend} draws nothing")


def check_filmable(policy: Policy) -> bool:
    """Whether OpenGL is needed to film a policy.

    :raises ValueError: if the model does not fit the environment, or cannot be read
    :raises RenderingError: if the environment cannot be drawn, or nothing can write films
    """
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise RenderingError("the package imageio-ffmpeg is missing, which writes films: `pip install 'sb3-momba[explorer]'`.")
    check_model_fits(load_model(policy.path), probe_environment(policy.env, policy.env_kwargs))
    env = _filmed_env(policy)
    env.close()
    return is_mujoco(env)
