"""What the pages hold, and a world in which their code takes seconds."""

import functools
import inspect
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import pytest
from morl_baselines.multi_policy.capql.capql import CAPQL
from stable_baselines3 import SAC

import sb3_momba
from sb3_momba import MOMBA, MombaCheckpointCallback, ParetoEvalCallback, hub
from sb3_momba.runs import RunSettings, run
from tests.stubs import TINY_MLP, TINY_SIMBA

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)

CALLS = re.compile(r"^\| `(.+?)` \| `(.+?)` \|$", re.MULTILINE)
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page: Path, language: str) -> list[str]:
    return [text for name, text in BLOCK.findall(page.read_text()) if name == language]


def commands(page: Path) -> list[str]:
    """Those of its bash blocks."""
    lines = "".join(blocks(page, "bash")).replace("\\\n", " ").splitlines()
    return [line for line in lines if line.strip() and not line.startswith("#")]


def slug(heading: str) -> str:
    """The anchor that GitHub and MyST give to a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def anchors(page: Path) -> set[str]:
    return {slug(heading) for heading in re.findall(r"^#+ (.+)$", BLOCK.sub("", page.read_text()), re.MULTILINE)}


def links(page: Path) -> list[str]:
    """To elsewhere in the project."""
    found = re.findall(r"\]\(([^)]+)\)", BLOCK.sub("", page.read_text()))
    return [link for link in found if not link.startswith("http")]


def capped(function: Callable[..., Any], **caps: int) -> Callable[..., Any]:
    """A function whose arguments are at most these, whether given or by default."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        bound = inspect.signature(function).bind(*args, **kwargs)
        bound.apply_defaults()
        for name, cap in caps.items():
            bound.arguments[name] = min(bound.arguments[name], cap)
        return function(*bound.args, **bound.kwargs)

    return call


def with_small_networks(construct: Callable[..., None]) -> Callable[..., None]:
    @functools.wraps(construct)
    def call(self: MOMBA, policy: Any, *args: Any, policy_kwargs: dict[str, Any] | None = None, **kwargs: Any) -> None:
        small = TINY_MLP if policy == "MlpPolicy" else TINY_SIMBA
        construct(self, policy, *args, policy_kwargs={**small, **(policy_kwargs or {})}, **kwargs)

    return call


def make_everything_short(monkeypatch: Any) -> None:
    """Episodes of 12 steps, trainings of 24 with 8-wide networks, evaluations of 2 preferences. The pages' numbers are for
    users."""
    for spec in gym.registry.values():
        monkeypatch.setattr(spec, "max_episode_steps", 12)
    small = capped(MOMBA.__init__, learning_starts=6, batch_size=4, buffer_size=200)
    monkeypatch.setattr(MOMBA, "__init__", with_small_networks(small))
    monkeypatch.setattr(MOMBA, "learn", capped(MOMBA.learn, total_timesteps=24))
    monkeypatch.setattr(SAC, "learn", capped(SAC.learn, total_timesteps=24))
    monkeypatch.setattr(CAPQL, "train", capped(CAPQL.train, total_timesteps=24))
    evaluation = {"n_preferences": 2, "n_episodes": 1}
    monkeypatch.setattr(ParetoEvalCallback, "__init__", capped(ParetoEvalCallback.__init__, eval_freq=12, **evaluation))
    monkeypatch.setattr(MombaCheckpointCallback, "__init__", capped(MombaCheckpointCallback.__init__, save_freq=8))
    monkeypatch.setattr(sb3_momba, "evaluate_front", capped(sb3_momba.evaluate_front, **evaluation))


def finished_run(folder: str) -> None:
    small = {"learning_starts": 6, "batch_size": 4, "buffer_size": 200, "policy_kwargs": TINY_SIMBA}
    evaluation = {"eval_freq": 24, "n_preferences": 2, "n_episodes": 1, "progress_bar": False}
    run(RunSettings("mo-hopper-2obj-v5", folder, steps=24, hyperparameters=small, **evaluation))


def put_the_hub_into(folder: Path, monkeypatch: Any) -> None:
    """A hub that is a folder: what is pushed lies there, and is fetched from there."""

    def upload_folder(*, folder_path: str, repo_id: str, **_: Any) -> None:
        shutil.copytree(folder_path, folder / repo_id, dirs_exist_ok=True)

    api = SimpleNamespace(create_repo=lambda repo_id, **_: f"https://hub/{repo_id}", upload_folder=upload_folder)
    monkeypatch.setattr(hub, "HfApi", lambda **_: api)
    monkeypatch.setattr(hub, "hf_hub_download", lambda repo_id, filename, **_: str(folder / repo_id / filename))
