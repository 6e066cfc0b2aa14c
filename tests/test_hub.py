"""The hub: what would be uploaded is whole and says what is true, what is fetched loads, and nothing reaches the network."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from copy import deepcopy
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from huggingface_hub import HfApi, hf_hub_download

from sb3_momba import MOMBA, ParetoFront, evaluate_front, hub
from sb3_momba.files import FileFormatError
from sb3_momba.recording import RecordWriter
from sb3_momba.records import read_record
from sb3_momba.runs import RunSettings, recorded_settings, run
from sb3_momba.train import command_of, parse
from tests.stubs import TINY_MLP, TINY_SIMBA, StubEnv, tiny_model

ENV = "mo-hopper-2obj-v5"
REPO = "someone/momba-hopper"
WHOLE = ["README.md", "front.npz", "front.png", "model.zip"]
TINY = {"learning_starts": 50, "buffer_size": 200, "batch_size": 8, "ent_coef": "auto_0.01", "policy_kwargs": TINY_SIMBA}


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    """A real run of a few steps."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    small = {"steps": 60, "eval_freq": 60, "n_preferences": 3, "n_episodes": 2, "device": "cpu", "progress_bar": False}
    run(RunSettings(ENV, str(folder), seed=3, objectives=["speed", "height"], hyperparameters=deepcopy(TINY), **small))
    return folder


def model_and_front(n_objectives: int = 2, n_preferences: int = 3) -> tuple[MOMBA, ParetoFront]:
    reward = n_objectives if n_objectives > 1 else None
    model = tiny_model(StubEnv(reward))
    return model, evaluate_front(model, lambda: StubEnv(reward), n_preferences=n_preferences, n_episodes=2)


def card_in(folder: Path) -> tuple[dict[str, Any], str]:
    """Metadata and text, as any reader of the hub's format finds them."""
    _, head, text = (folder / "README.md").read_text().split("---\n", 2)
    return yaml.safe_load(head), text


class Hub:
    """In place of the hub's client: takes what that would take, and keeps what it was asked for and what lay in the folder."""

    calls: list[tuple[str, dict[str, Any]]]

    def __init__(self, **kwargs: Any):
        signature(HfApi).bind(**kwargs)
        Hub.calls = [("api", kwargs)]

    def create_repo(self, repo_id: str, **kwargs: Any) -> str:
        signature(HfApi.create_repo).bind(self, repo_id, **kwargs)
        Hub.calls.append(("create_repo", {"repo_id": repo_id, **kwargs}))
        return f"https://hub/{repo_id}"

    def upload_folder(self, *, folder_path: str, **kwargs: Any) -> None:
        signature(HfApi.upload_folder).bind(self, folder_path=folder_path, **kwargs)
        Hub.calls.append(("upload_folder", {**kwargs, "files": sorted(os.listdir(folder_path))}))


@pytest.fixture(autouse=True)
def offline(monkeypatch) -> type[Hub]:
    Hub.calls = []
    monkeypatch.setattr(hub, "HfApi", Hub)
    monkeypatch.setattr(hub, "hf_hub_download", lambda *_, **__: pytest.fail("nothing is downloaded"))
    return Hub


# -------------------------------------------------------------------------------------------------------- what is sent


def test_a_run_is_packaged_whole(run_folder, tmp_path):
    hub.package(run_folder, tmp_path / "packed", REPO)
    assert sorted(os.listdir(tmp_path / "packed")) == sorted([*WHOLE, "record.jsonl"])
    for name in ("model.zip", "record.jsonl"):
        assert (tmp_path / "packed" / name).read_bytes() == (run_folder / name).read_bytes()
    front = ParetoFront.load(tmp_path / "packed" / "front.npz")
    np.testing.assert_array_equal(front.values, read_record(run_folder / "record.jsonl").final_values)
    assert MOMBA.load(tmp_path / "packed" / "model.zip").num_timesteps == 60


def test_the_card_of_a_run_says_what_was_measured(run_folder, tmp_path):
    hub.package(run_folder, tmp_path / "packed", REPO)
    data, text = card_in(tmp_path / "packed")
    assert data["library_name"] == "stable-baselines3"
    assert {ENV, "stable-baselines3", "deep-reinforcement-learning", "multi-objective"} <= set(data["tags"])
    (index,) = data["model-index"]
    (found,) = index["results"]
    assert index["name"] == "momba-hopper"
    assert found["task"]["type"] == "reinforcement-learning"
    assert found["dataset"] == {"type": ENV, "name": ENV}
    measured = ParetoFront.load(run_folder / "front.npz").metrics([0, 0])
    assert {metric["type"]: metric["value"] for metric in found["metrics"]} == {
        name: pytest.approx(measured[name]) for name in ("hypervolume", "expected_utility", "preference_regret")
    }
    assert found["metrics"][0]["args"] == {"reference_point": [0.0, 0.0]}
    for name, value in measured.items():
        assert f"{value:,.6g}" in text, name
    for floor in read_record(run_folder / "record.jsonl").floors:
        assert f"| {floor.policy} |" in text
    assert "trained for 60 steps" in text
    assert "3 preferences, 2 episodes each" in text
    assert "torch " in text
    assert str(run_folder) not in text


def test_links_and_pictures_of_the_card_are_in_the_package(run_folder, tmp_path):
    hub.package(run_folder, tmp_path, REPO)
    targets = re.findall(r"\]\(([^)]+)\)", card_in(tmp_path)[1])
    assert {"front.png", "record.jsonl"} <= set(targets)
    for target in targets:
        assert target.startswith("https://") or (tmp_path / target).exists(), target


def test_the_usage_of_the_card_works(run_folder, tmp_path, monkeypatch):
    hub.package(run_folder, tmp_path, REPO)
    (usage,) = re.findall(r"```python\n(.*?)```", card_in(tmp_path)[1], re.DOTALL)
    fetched = []

    def fetch(repo_id: str, filename: str, **_: Any) -> str:
        fetched.append(repo_id)
        return str(tmp_path / filename)

    monkeypatch.setattr(hub, "hf_hub_download", fetch)
    names: dict[str, Any] = {}
    exec(usage, names)
    assert fetched == [REPO]
    assert names["env"].action_space.contains(names["action"])


def test_the_command_of_the_card_is_the_runs(run_folder, tmp_path):
    hub.package(run_folder, tmp_path, REPO)
    (command,) = re.findall(r"```bash\n(.*?)\n```", card_in(tmp_path)[1], re.DOTALL)
    words = shlex.split(command)
    assert words[:3] == ["python", "-m", "sb3_momba.train"]
    assert recorded_settings(parse(words[3:])) == read_record(run_folder / "record.jsonl").config


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"label": "mine", "n_envs": 3, "subprocesses": True, "device": "cpu", "n_preferences": 7},
        {
            "env_kwargs": {"physics": "current", "n": 3, "list": [1, 2]},
            "reference_point": [-1.5, 0.0],
            "objectives": ["a b", "c"],
        },
        {"policy": "MlpPolicy", "hyperparameters": {"ent_coef": 0.2, "policy_kwargs": TINY_MLP}},
        {"hyperparameters": {"her": True, "her_kwargs": {"keep_probability": 0.5}, "train_freq": [2, "episode"], "n_steps": 3}},
        {"hyperparameters": {"best_return_scale": None, "preference_sampler": [0.3, 0.7], "ent_coef": "auto_0.01"}},
        {"hyperparameters": {"preference_sampler": {"name": "cone", "angle": 22.5, "per_step": True}, "learning_rate": 1e-5}},
        {"hyperparameters": {"policy_kwargs": {"support": [-2.0, 7.5], "conditioning": "film+all"}}},
    ],
)
def test_a_command_gives_the_settings_that_it_was_made_from(changed):
    settings = RunSettings(ENV, "folder", steps=1234, seed=5, **deepcopy(changed))
    config = recorded_settings(settings)
    assert recorded_settings(parse(command_of(config)[3:])) == config


@pytest.mark.parametrize("n_objectives", [1, 2, 3, 4])
def test_a_model_is_packaged_with_its_front(n_objectives, tmp_path):
    model, front = model_and_front(n_objectives)
    model.num_timesteps = 1_234_567
    hub.package(model, tmp_path, REPO, front, env_kwargs={"n_objectives": n_objectives})
    data, text = card_in(tmp_path)
    pictures = ["front.png"] if n_objectives in (2, 3) else []
    assert sorted(os.listdir(tmp_path)) == sorted({*WHOLE} - {"front.png"} | {*pictures})
    assert ("multi-objective" in data["tags"]) == (n_objectives > 1)
    assert ("front.png" in text) == bool(pictures)
    assert "1,234,567 steps" in text
    assert f"env = StubEnv(n_objectives={n_objectives})" in text
    observation = np.ones(3, np.float32)
    preference = np.eye(n_objectives)[0]
    assert f"preference={preference.tolist()}" in text or n_objectives == 1
    (action, _), (expected, _) = (
        one.predict(observation, preference=preference, deterministic=True)
        for one in (MOMBA.load(tmp_path / "model.zip"), model)
    )
    np.testing.assert_array_equal(action, expected)


def test_with_one_objective_the_metric_is_the_hubs_own(tmp_path):
    model, front = model_and_front(1)
    returns = np.array([1.0, 4.0])
    hub.package(model, tmp_path, REPO, replace(front, returns=returns[None, :, None]))
    data, text = card_in(tmp_path)
    (metric,) = data["model-index"][0]["results"][0]["metrics"]
    assert metric == {"type": "mean_reward", "name": "mean_reward", "value": "2.50 +/- 1.50"}
    assert "| this model | 2.5 |" in text
    assert "hypervolume" not in text


def test_the_reference_point_can_be_chosen(tmp_path):
    model, front = model_and_front(2)
    hub.package(model, tmp_path, REPO, front, reference_point=[-5, -1e6])
    metrics = card_in(tmp_path)[0]["model-index"][0]["results"][0]["metrics"]
    assert metrics[0]["value"] == pytest.approx(front.hypervolume([-5, -1e6]))
    assert metrics[0]["args"] == {"reference_point": [-5.0, -1e6]}


def test_an_environment_with_arguments_is_named_with_them(tmp_path):
    model, front = model_and_front(2)
    named = replace(front, settings={**front.settings, "env": "MO-Hopper-v4"})
    hub.package(model, tmp_path, REPO, named, env_kwargs={"physics": "current"})
    data, text = card_in(tmp_path)
    assert data["model-index"][0]["results"][0]["dataset"]["args"] == {"physics": "current"}
    assert "env = mo_gymnasium.make('MO-Hopper-v4', physics='current')" in text
    assert "MO-Hopper-v4" in gym.registry


def test_pushing_makes_the_repository_and_uploads_the_package(run_folder, offline):
    assert hub.push_to_hub(run_folder, REPO, token="secret", private=True, commit_message="mine") == f"https://hub/{REPO}"
    (first, client), *calls = offline.calls
    assert first == "api"
    assert client["token"] == "secret"
    assert calls == [
        ("create_repo", {"repo_id": REPO, "private": True, "exist_ok": True}),
        (
            "upload_folder",
            {
                **{"repo_id": REPO, "commit_message": "mine", "files": sorted([*WHOLE, "record.jsonl"])},
                "delete_patterns": ["model.zip", "front.npz", "front.png", "record.jsonl"],
            },
        ),
    ]


# --------------------------------------------------------------------------------------------------- what is not sent


def test_failures_of_earlier_attempts_are_not_sent(run_folder, tmp_path):
    """Their tracebacks name folders of the computer."""
    source = shutil.copytree(run_folder, tmp_path / "run")
    record = source / "record.jsonl"
    *lines, end = record.read_bytes().splitlines(keepends=True)
    record.write_bytes(b"".join(lines))
    for _ in range(2):
        with pytest.raises(RuntimeError), RecordWriter(record).resume(60):
            raise RuntimeError(f"{source} is gone")
    with RecordWriter(record).resume(60):
        pass
    record.write_bytes(record.read_bytes() + end + b'{"event": "end", "traceback": "/home')
    assert str(source).encode() in record.read_bytes()
    hub.package(source, tmp_path / "packed", REPO)
    packed = tmp_path / "packed" / "record.jsonl"
    for place in (source, Path(hub.__file__).parent, Path(__file__).parent, "/home", "Traceback"):
        assert str(place).encode() not in packed.read_bytes(), place
    assert packed.read_bytes().startswith(b"".join(lines))
    ours, theirs = read_record(record), read_record(packed)
    assert (theirs.error, len(theirs.resumed)) == (None, 3)
    assert (theirs.resumed, theirs.start) == (ours.resumed, ours.start)
    assert [evaluation.steps for evaluation in theirs.evaluations] == [evaluation.steps for evaluation in ours.evaluations]
    np.testing.assert_array_equal(theirs.final_values, ours.final_values)


def test_sources_that_are_not_whole_are_refused_before_anything_is_sent(run_folder, tmp_path, offline):
    model, front = model_and_front(2)
    by_hand = ParetoFront(front.preferences, front.returns, front.discounted_returns, front.episode_lengths)
    (tmp_path / "empty").mkdir()
    (tmp_path / "damaged").mkdir()
    for file in run_folder.iterdir():
        if file.is_file():
            (tmp_path / "damaged" / file.name).write_bytes(file.read_bytes())
    (tmp_path / "damaged" / "model.zip").write_bytes((run_folder / "model.zip").read_bytes()[:-100])
    start = {"label": "x", "env": ENV, "env_kwargs": {}, "seed": 0, "config": {}, "parameters": {}, "general_policy": True}
    with RecordWriter(tmp_path / "cut" / "record.jsonl").start(**start, reference_point=[0, 0], preferences=[[0.5, 0.5]]):
        pass
    for source, kwargs, match in [
        (model, {}, r"front=evaluate_front"),
        (model, {"front": by_hand}, r"front=evaluate_front"),
        (model, {"front": model_and_front(3)[1]}, "The model has 2 objectives, the front 3"),
        (model, {"front": front, "reference_point": [0, 0, 0]}, "reference point"),
        (model, {"front": front, "objectives": ["one"]}, "2 labels"),
        (tmp_path / "empty", {}, "holds no run"),
        (tmp_path / "missing", {}, "holds no run"),
        (run_folder / "model.zip", {}, "holds no run"),
        (tmp_path / "cut", {}, "not finished"),
        (run_folder, {"front": front}, "its own front"),
        (run_folder, {"env_kwargs": {}}, "its own front"),
    ]:
        with pytest.raises(ValueError, match=match):
            hub.push_to_hub(source, REPO, **kwargs)
    with pytest.raises(FileFormatError, match=r"model\.zip"):
        hub.push_to_hub(tmp_path / "damaged", REPO)
    assert offline.calls == []


def test_a_folder_that_holds_something_is_left_alone(run_folder, tmp_path):
    (tmp_path / "mine").write_text("x")
    for folder in (tmp_path, tmp_path / "mine"):
        with pytest.raises(ValueError, match="not an empty folder"):
            hub.package(run_folder, folder, REPO)
    assert os.listdir(tmp_path) == ["mine"]


# -------------------------------------------------------------------------------------------------------- what is loaded


def test_loading_asks_the_hub_for_the_file_of_a_revision(monkeypatch):
    asked: dict[str, Any] = {}

    def fetch(repo_id: str, filename: str, **kwargs: Any) -> str:
        signature(hf_hub_download).bind(repo_id, filename, **kwargs)
        asked.update(repo_id=repo_id, filename=filename, **kwargs)
        return "/cache/file"

    monkeypatch.setattr(hub, "hf_hub_download", fetch)
    assert hub.load_from_hub(REPO, "front.npz", revision="v1", token="secret") == "/cache/file"
    assert asked["repo_id"] == REPO
    assert asked["filename"] == "front.npz"
    assert asked["revision"] == "v1"
    assert asked["token"] == "secret"
    hub.load_from_hub(REPO)
    assert asked["filename"] == "model.zip"


def test_the_package_imports_without_its_extras_and_the_hub_says_which_it_needs():
    code = """
import sys
for name in ("onnx", "onnxruntime", "huggingface_hub"):
    sys.modules[name] = None
import sb3_momba, sb3_momba.export
try:
    import sb3_momba.hub
except ImportError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install huggingface_hub" in done.stdout
    assert "extra `hub`" in done.stdout
