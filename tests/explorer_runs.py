"""What the explorer's tests share: runs made in a moment, and what they need of the system."""

import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_momba.baselines.solutions import SolutionSet
from sb3_momba.envs.preferences import simplex_lattice
from sb3_momba.explorer.__main__ import main
from sb3_momba.explorer.kit import DecisionKit
from sb3_momba.explorer.live import LiveServer, listen
from sb3_momba.pareto.evaluation import ParetoFront
from sb3_momba.pareto.metrics import summarise
from sb3_momba.recording import RecordWriter
from sb3_momba.runs import RunSettings, run

TINY = {"net_arch": [8], "n_atoms": 11}
NUMBERS = {  # and how charts.number and common.js write them
    0.0: "0",
    0.12345: "0.1235",
    -12.345: "-12.35",
    100.25: "100.3",
    999.96: "1000",
    1234.5: "1,235",
    -2500.5: "-2,501",
    999_999.7: "1,000,000",
    1.2345e6: "1.234 M",  # 1.23449999...
    2e9: "2 G",
    1.5e300: "1.500e+300",
    3e-5: "3.0e-5",
    -2.5e-12: "-2.5e-12",
}
HOW = "run `make browser` as root, or `apt-get install chromium libegl1 libgl1-mesa-dri`"


def require(what: str, is_there: bool) -> pytest.MarkDecorator:
    """Skips tests where something is missing, but on CI, where it must be there, lets them fail."""
    missing = not is_there and os.environ.get("CI") != "true"
    return pytest.mark.skipif(missing, reason=f"{what} is missing: {HOW}.")


def chromium() -> str | None:
    """The system's browser."""
    return next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)


DRAWS = """
import mujoco
context = mujoco.GLContext(8, 8)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100)
"""


def has_gl() -> bool:
    """Whether MuJoCo draws without a window: asked in a process of its own."""
    environments = ({**os.environ, "MUJOCO_GL": backend} for backend in ("egl", "osmesa"))
    tried = (subprocess.run([sys.executable, "-c", DRAWS], env=env, capture_output=True) for env in environments)
    return any(ended.returncode == 0 for ended in tried)


needs_gl = require("OpenGL without a window", has_gl())
needs_browser = require("Chromium", chromium() is not None)


def simplex(n_objectives: int, n: int) -> np.ndarray:
    """The first n preferences of a lattice, at least its corners."""
    if n == 1 or n_objectives == 1:
        return np.full((1, n_objectives), 1 / n_objectives)
    return simplex_lattice(n_objectives, n - 1 if n_objectives == 2 else 2)


def write_run(
    folder: Path,
    values: np.ndarray,
    preferences: np.ndarray,
    *,
    label: str = "method",
    env: str = "MO-Hopper-v4",
    objectives: list[str] | None = None,
    reference_point: list[float] | None = None,
    steps: tuple[int, ...] = (100, 200),
    returns: np.ndarray | None = None,
    general_policy: bool = True,
    error: str | None = None,
) -> Path:
    """A run without a model: each evaluation but the last is half as good.

    :param returns: of each episode, (P, E, n_objectives), for front.npz
    :param error: of a run that failed
    """
    reference = [0.0] * values.shape[1] if reference_point is None else reference_point
    content: dict[str, Any] = {
        "label": label,
        "env": env,
        "env_kwargs": {},
        "seed": 0,
        "config": {"objectives": objectives, "n_episodes": 1},
        "reference_point": reference,
        "preferences": preferences,
        "general_policy": general_policy,
        "parameters": {"actor": 10},
    }
    record = RecordWriter(folder / "record.jsonl").start(**content)
    with record:
        still = np.zeros((len(preferences) if general_policy else 1, values.shape[1]))
        record.append("floor", policy="standing still", values=still)
        for at in steps:
            now = values if at == steps[-1] else values / 2
            metrics = summarise(now, preferences, reference) if general_policy else {}
            record.append("evaluation", steps=at, seconds=at / 10, evaluation_seconds=1.0, **metrics, values=now)
        if error is None:
            every = values[:, None] if returns is None else returns
            lengths = np.ones(every.shape[:2], dtype=np.int64)
            if general_policy:
                front = {"preferences": preferences, "returns": values[:, None], "settings": {}}
            else:
                front = vars(SolutionSet(every, every, lengths, {}))
            record.finish(steps[-1] if steps else 0, front)
            if general_policy and returns is not None:
                ParetoFront(preferences, every, every, lengths, {"seed": 0}).save(folder / "front.npz")
        else:
            record.is_ended = True
            record.append("end", status="failed", error=error)
    return folder


def train_tiny(folder: Path) -> Path:
    """A real run of a few hundred steps."""
    hyperparameters = {"learning_starts": 50, "batch_size": 16, "buffer_size": 1_000, "train_freq": 4, "policy_kwargs": TINY}
    settings = RunSettings(
        "MO-Hopper-v4",
        str(folder),
        steps=300,
        policy="MlpPolicy",
        hyperparameters={**hyperparameters, "ent_coef": 0.1},
        eval_freq=100,
        n_preferences=5,
        n_episodes=1,
        progress_bar=False,
    )
    run(settings)
    return folder


def fail(arguments: list[Any], words: str) -> None:
    """The explorer's command ends with an error of these words."""
    with pytest.raises(SystemExit, match=words):
        main([str(one) for one in arguments])


@contextmanager
def serving(kit: DecisionKit) -> Iterator[LiveServer]:
    """The live page's server, for as long as a test needs it, also one that fails."""
    with LiveServer(kit, listen("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
