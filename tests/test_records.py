"""Run records: what a run writes, that nothing written is lost, and that a reader meets no other surprise than an error."""

import contextlib
import getpass
import inspect
import json
import math
import os
import platform
import re
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_momba import MOMBA, ParetoEvalCallback, ParetoFront, recording, system
from sb3_momba.checkpoints.folders import checkpoints_in
from sb3_momba.envs.making import make_mo_vec_env
from sb3_momba.envs.preferences import ConeSampler, preference_grid
from sb3_momba.files import FileFormatError
from sb3_momba.pareto import callbacks
from sb3_momba.pareto.callbacks import RecordCallback
from sb3_momba.pareto.evaluation import evaluate_front
from sb3_momba.pareto.floors import RandomPolicy, ZeroActionPolicy, evaluate_floors
from sb3_momba.pareto.metrics import summarise
from sb3_momba.pareto.protocol import REFERENCE_POINTS, reference_point_of
from sb3_momba.recording import RecordWriter, plain
from sb3_momba.records import UNENDED, Record, find_records, is_cut_off_at_its_start, read_record
from sb3_momba.runs import NOT_IN_CONFIG, RunSettings, recorded_settings, resume, run
from sb3_momba.train import command_of, main, parse
from sb3_momba.zoo.configuration import check_hyperparameters, with_defaults
from tests.stubs import TINY_MLP, TINY_SIMBA, StubEnv, tiny_model

ENV = "mo-hopper-2obj-v5"
TINY = {"learning_starts": 50, "buffer_size": 200, "batch_size": 8, "policy_kwargs": TINY_SIMBA}
METRICS = ("hypervolume", "expected_utility", "preference_regret", "n_non_dominated")
PREFERENCES = [[0.0, 1.0], [0.5, 0.5], [1.0, 0.0]]
VALUES = [[1.0, 2.0]] * 3


def settings_of(folder: Path, **changed: Any) -> RunSettings:
    small = {"steps": 120, "eval_freq": 60, "n_preferences": 3, "n_episodes": 2, "device": "cpu", "progress_bar": False}
    return RunSettings(ENV, str(folder), label="tiny", seed=3, **{"hyperparameters": deepcopy(TINY), **small, **changed})


def lines_of(path: Path) -> list[dict[str, Any]]:
    """What a stranger reads who has nothing but a strict JSON reader."""

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no strict JSON")

    content = path.read_bytes()
    assert content.endswith(b"\n")
    return [json.loads(line, parse_constant=refuse) for line in content.decode("utf-8").splitlines()]


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory) -> SimpleNamespace:
    """One real run: its settings, its result and the lines of its record."""
    settings = settings_of(tmp_path_factory.mktemp("runs") / "run")
    result = run(settings)
    path = result.folder / "record.jsonl"
    return SimpleNamespace(settings=settings, result=result, path=path, lines=lines_of(path))


def writer_of(path: Path, **changed: Any) -> RecordWriter:
    content = {
        "label": "momba",
        "env": "E",
        "env_kwargs": {},
        "seed": 0,
        "config": {"hyperparameters": {"gamma": 0.99}},
        "reference_point": [0.0, 0.0],
        "general_policy": True,
        "preferences": PREFERENCES,
        "parameters": {"actor": 10, "critic": 20},
    }
    return RecordWriter(path).start(**{**content, **changed})


def front_of(values: Any) -> dict[str, Any]:
    """The attributes of a front with one episode for each preference."""
    returns = np.asarray(values, dtype=np.float64)[:, None]
    lengths = np.full(returns.shape[:2], 10)
    return {
        "preferences": PREFERENCES,
        "returns": returns,
        "discounted_returns": 0.9 * returns,
        "episode_lengths": lengths,
        "settings": {"env": "E", "seed": 0},
    }


@pytest.fixture(autouse=True)
def no_revision(monkeypatch) -> None:
    """git is asked for the real run, which comes first, and in its own test."""
    monkeypatch.setattr(recording, "git_revision", lambda: None)


@pytest.fixture
def valid(tmp_path) -> Path:
    """A finished record of two floors and two evaluations."""
    path = tmp_path / "valid.jsonl"
    with writer_of(path) as writer:
        for name in ("standing still", "random actions"):
            writer.append("floor", policy=name, values=[[1.0, 1.0]] * 3, hypervolume=1.0)
        writer.append("evaluation", steps=10, seconds=1.5, evaluation_seconds=0.5, values=[[1.0, 2.0]] * 3, hypervolume=2.0)
        writer.append("evaluation", steps=20, seconds=3.0, evaluation_seconds=1.0, values=[[2.0, 2.0]] * 3, hypervolume=4.0)
        writer.finish(20, front_of([[1.0, 3.0], [2.0, 2.0], [3.0, 1.0]]))
    return path


@pytest.fixture
def valid_set(tmp_path) -> Path:
    """A finished record without a general policy: sets of 2, 1, 4 and 5 solutions, where there are 3 preferences."""
    path = tmp_path / "valid_set.jsonl"
    with writer_of(path, general_policy=False) as writer:
        writer.append("floor", policy="random actions", values=[[1.0, 1.0]] * 2)
        writer.append("evaluation", steps=10, seconds=1.5, values=[[1.0, 2.0]])
        writer.append("evaluation", steps=20, seconds=3.0, values=[[2.0, 2.0]] * 4)
        writer.finish(20, front_of([[1.0, 5.0], [2.0, 4.0], [3.0, 3.0], [4.0, 2.0], [5.0, 1.0]]))
    return path


# -------------------------------------------------------------------------------------------------- what a run writes


def test_a_record_holds_what_its_format_promises(tiny_run) -> None:
    assert [line["event"] for line in tiny_run.lines] == ["start", "floor", "floor", "evaluation", "evaluation", "end"]
    start, *floors_and_curve, end = tiny_run.lines
    named = (
        "format version label env env_kwargs seed config reference_point preferences general_policy parameters versions machine"
    )
    assert {*named.split(), "git_revision", "started"} <= set(start)
    assert (start["format"], start["version"]) == ("sb3_momba.record", 1)
    assert (start["label"], start["env"], start["env_kwargs"], start["seed"]) == ("tiny", ENV, {}, 3)
    assert start["reference_point"] == [0.0, 0.0]
    assert start["preferences"] == PREFERENCES
    assert start["general_policy"] is True
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", start["started"])
    for line in floors_and_curve:
        assert set(METRICS) <= set(line)
        assert np.shape(line["values"]) == (3, 2)
    assert [line["policy"] for line in floors_and_curve[:2]] == ["standing still", "random actions"]
    assert [line["steps"] for line in floors_and_curve[2:]] == [60, 120]
    assert (end["status"], end["steps"]) == ("finished", 120)
    front = end["front"]
    assert np.shape(front["preferences"]) == (3, 2)
    assert np.shape(front["returns"]) == np.shape(front["discounted_returns"]) == (3, 2, 2)
    assert np.shape(front["episode_lengths"]) == (3, 2)
    assert front["settings"]["env"] == ENV


def test_values_are_those_of_the_runs_other_files(tiny_run) -> None:
    _, still, random, first, last, end = tiny_run.lines
    front = ParetoFront.load(tiny_run.result.folder / "front.npz")
    for name in ("preferences", "returns", "discounted_returns", "episode_lengths"):
        np.testing.assert_array_equal(end["front"][name], getattr(front, name))
    np.testing.assert_array_equal(last["values"], front.values)
    for line, metrics in zip((first, last), tiny_run.result.metrics, strict=True):
        assert {name: line[name] for name in METRICS} == metrics
    for line in (still, random):
        assert {name: line[name] for name in METRICS} == tiny_run.result.floors[line["policy"]]


def test_the_metrics_follow_from_the_values(tiny_run) -> None:
    start, *rest, _ = tiny_run.lines
    for line in rest:
        expected = summarise(line["values"], start["preferences"], start["reference_point"])
        assert {name: line[name] for name in METRICS} == pytest.approx(expected)


def test_seconds_are_of_training_and_evaluations_apart(tmp_path, monkeypatch) -> None:
    """A clock that goes on by 1 in each step of the training and by 100 in each evaluation."""
    clock = [0.0]

    class Timed(StubEnv):
        def step(self, action: np.ndarray) -> Any:
            clock[0] += 1
            return super().step(action)

    def timed_evaluation(*args: Any, **kwargs: Any) -> ParetoFront:
        clock[0] += 100
        return evaluate_front(*args, **kwargs)

    clocks = {"seconds": lambda: clock[0], "cpu_seconds": lambda: clock[0] / 2}
    monkeypatch.setattr(callbacks, "CLOCKS", clocks)
    monkeypatch.setattr(callbacks, "evaluate_front", timed_evaluation)
    writer = writer_of(tmp_path / "record.jsonl")
    callback = ParetoEvalCallback(
        StubEnv, eval_freq=10, n_preferences=3, n_episodes=1, callback_after_eval=RecordCallback(writer)
    )
    tiny_model(Timed(), learning_starts=100).learn(30, callback=callback)
    evaluations = [line for line in lines_of(writer.path) if line["event"] == "evaluation"]
    times = [[line[name] for name in ("steps", "seconds", "cpu_seconds", "evaluation_seconds")] for line in evaluations]
    assert times == [[10, 10, 5, 100], [20, 20, 10, 200], [30, 30, 15, 300]]


def test_processor_time_is_not_noted_where_other_processes_work_for_the_training(tmp_path) -> None:
    writer = writer_of(tmp_path / "record.jsonl")
    callback = ParetoEvalCallback(
        StubEnv, eval_freq=10, n_preferences=3, n_episodes=1, callback_after_eval=RecordCallback(writer)
    )
    env = make_mo_vec_env(StubEnv, 2, vec_env_cls=SubprocVecEnv)
    tiny_model(env, learning_starts=100).learn(20, callback=callback)
    env.close()
    evaluations = [line for line in lines_of(writer.path) if line["event"] == "evaluation"]
    assert [("seconds" in line, "cpu_seconds" in line) for line in evaluations] == [(True, False)] * 2
    (record,) = find_records([writer.path])
    assert [evaluation.cpu_seconds for evaluation in read_record(record).evaluations] == [None, None]


def test_the_configuration_has_every_setting_with_its_default(tiny_run) -> None:
    config = tiny_run.lines[0]["config"]
    assert set(config) == {field.name for field in fields(RunSettings)} - set(NOT_IN_CONFIG)
    assert (config["steps"], config["eval_freq"], config["n_episodes"], config["policy"]) == (120, 60, 2, "SimbaPolicy")
    written = config["hyperparameters"]
    arguments = inspect.signature(MOMBA.__init__).parameters
    of_the_run = {"self", "policy", "env", "seed", "device", "tensorboard_log", "verbose", "_init_setup_model", "others"}
    assert set(written) == set(arguments) - of_the_run
    for name in set(written) - {"policy_kwargs", *TINY}:
        assert written[name] == arguments[name].default, name
    assert {name: written[name] for name in TINY if name != "policy_kwargs"} == {
        name: value for name, value in TINY.items() if name != "policy_kwargs"
    }
    policy = written["policy_kwargs"]
    assert TINY_SIMBA.items() <= policy.items()
    assert (policy["support"], policy["conditioning"], policy["normalize_weights"]) == ([-5.0, 5.0], "input", True)


@pytest.mark.parametrize("policy", ["SimbaPolicy", "MlpPolicy"])
def test_defaults_are_arguments_that_the_policy_takes(policy: str) -> None:
    """What a run uses can be asked for: MlpPolicy has no weight normalisation, so its record may not say that it is on."""
    complete = with_defaults(policy, {})
    check_hyperparameters(policy, complete)
    given = {"gamma": 0.5, "policy_kwargs": {"n_critics": 3}}
    changed = with_defaults(policy, given)
    assert (changed["gamma"], changed["policy_kwargs"]["n_critics"]) == (0.5, 3)
    assert given == {"gamma": 0.5, "policy_kwargs": {"n_critics": 3}}
    assert set(changed) == set(complete)
    assert set(changed["policy_kwargs"]) == set(complete["policy_kwargs"])


def test_a_run_goes_on_whose_record_has_names_in_place_of_classes(tmp_path) -> None:
    """Such as MlpPolicy's activation."""

    def cut(steps: int) -> None:
        if steps == 70:
            raise KeyboardInterrupt

    hyperparameters = {**TINY, "policy_kwargs": TINY_MLP}
    settings = settings_of(
        tmp_path / "run", policy="MlpPolicy", hyperparameters=hyperparameters, n_episodes=1, checkpoint_freq=60
    )
    with pytest.raises(KeyboardInterrupt):
        run(settings, cut)
    resume(tmp_path / "run", progress_bar=False)
    record = read_record(tmp_path / "run" / "record.jsonl")
    assert record.error is None
    assert [evaluation.steps for evaluation in record.evaluations] == [60, 120]


def test_a_resumption_keeps_how_the_run_was_run_unless_it_is_told_otherwise(tmp_path) -> None:
    """How often checkpoints are written and how many stay, and the processes of an evaluation: no setting of the method."""

    def cut(at: int, going: Callable[[Callable[[int], None]], Any]) -> None:
        def stop(steps: int) -> None:
            if steps == at:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            going(stop)

    def checkpoints() -> list[int]:
        return [int(path.name.partition("-")[2]) for path in checkpoints_in(folder / "checkpoints")]

    folder = tmp_path / "run"
    cut(45, partial(run, settings_of(folder, n_episodes=1, checkpoint_freq=10, keep_checkpoints=4, eval_workers=2)))
    assert checkpoints() == [40, 30, 20, 10]
    cut(75, partial(resume, folder, progress_bar=False))
    assert checkpoints() == [70, 60, 50, 40]
    cut(95, partial(resume, folder, progress_bar=False, keep_checkpoints=3, eval_workers=1))
    assert checkpoints() == [90, 80, 70]
    resume(folder, progress_bar=False)
    assert checkpoints() == [120, 110, 100]
    record = read_record(folder / "record.jsonl")
    first = {"checkpoint_freq": 10, "keep_checkpoints": 4, "eval_workers": 2, "eval_envs": 128}
    told = {"checkpoint_freq": 10, "keep_checkpoints": 3, "eval_workers": 1, "eval_envs": 128}
    assert [line["running"] for line in (record.start, *record.resumed)] == [first, first, told, told]
    assert not set(first) & set(record.config)


@pytest.mark.parametrize("running", [None, {"env": "no_such_module:X-v0", "unknown": 1}])
def test_a_run_of_which_nothing_says_how_it_was_run_goes_on_with_the_defaults(tmp_path, running) -> None:
    """Records of before say nothing; of a stranger's, nothing else than how it was run counts."""

    def cut(steps: int) -> None:
        if steps == 70:
            raise KeyboardInterrupt

    folder = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        run(settings_of(folder, n_episodes=1, checkpoint_freq=10, keep_checkpoints=4), cut)
    path = folder / "record.jsonl"
    start, *others = lines_of(path)
    start["running"] = None
    path.write_text("".join(json.dumps(line) + "\n" for line in (start, *others)))
    with pytest.raises(FileFormatError, match="running is no mapping"):
        resume(folder, progress_bar=False)
    start["running"] = running
    if running is None:
        del start["running"]
    path.write_text("".join(json.dumps(line) + "\n" for line in (start, *others)))
    resume(folder, progress_bar=False)
    assert [path.name.partition("-")[2] for path in checkpoints_in(folder / "checkpoints")] == ["000000120", "000000060"]


def test_parameters_are_the_trained_ones(tiny_run) -> None:
    model = MOMBA.load(tiny_run.result.folder / "model.zip", device="cpu")
    counts = {
        name: sum(p.numel() for p in getattr(model, name).parameters() if p.requires_grad) for name in ("actor", "critic")
    }
    assert tiny_run.lines[0]["parameters"] == counts
    assert sum(p.numel() for p in model.policy.parameters() if p.requires_grad) == sum(counts.values())


def test_nothing_in_a_record_names_the_computer(tiny_run) -> None:
    text = tiny_run.path.read_text()
    for place in (tiny_run.result.folder, Path.home(), Path.cwd(), Path(system.__file__).parent):
        assert str(place) not in text
    for name in {platform.node(), getpass.getuser()} - {""}:
        assert not re.search(rf"\b{re.escape(name)}\b", text), name

    def strings(x: Any) -> Iterator[str]:
        if isinstance(x, dict):
            for key, value in x.items():
                yield key
                yield from strings(value)
        elif isinstance(x, list):
            for value in x:
                yield from strings(value)
        elif isinstance(x, str):
            yield x

    assert not [s for s in strings(tiny_run.lines) if os.path.isabs(s) or s.startswith("~") or "/home/" in s]


def test_versions_machine_and_revision(tiny_run) -> None:
    start = tiny_run.lines[0]
    assert {"python", "sb3_momba", "stable_baselines3", "torch", "numpy", "gymnasium", "mujoco"} <= set(start["versions"])
    assert all(isinstance(version, str) for version in start["versions"].values())
    machine = start["machine"]
    assert machine["cores"] >= 1
    assert machine["memory_gb"] > 0
    assert machine["torch_threads"] == th.get_num_threads()
    assert start["git_revision"] is None or re.fullmatch(r"[0-9a-f]{40}(-dirty)?", start["git_revision"])


def test_the_revision_is_of_the_repository_that_tracks_the_package(tmp_path, monkeypatch) -> None:
    """An installed copy inside a stranger's repository is not of its revision; a tag does not take the commit's place."""
    module = tmp_path / "system.py"
    shutil.copy(system.__file__, module)
    monkeypatch.setattr(system, "__file__", str(module))
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    for role in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{role}_NAME", "A")
        monkeypatch.setenv(f"GIT_{role}_EMAIL", "a@example.org")

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(tmp_path), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    assert system.git_revision() is None
    git("init")
    assert system.git_revision() is None
    git("add", "system.py")
    git("commit", "--no-gpg-sign", "-m", "x")
    git("tag", "v1")
    revision = git("rev-parse", "HEAD")
    assert system.git_revision() == revision
    module.write_text(module.read_text() + "\n")
    assert system.git_revision() == f"{revision}-dirty"
    monkeypatch.setenv("PATH", "")
    assert system.git_revision() is None


@pytest.mark.parametrize(
    ("setting", "written"),
    [
        ({"a": (1, "step")}, {"a": [1, "step"]}),
        (th.optim.Adam, "torch.optim.adam.Adam"),
        (preference_grid, "sb3_momba.envs.preferences.preference_grid"),
        (np.float64(0.5), 0.5),
        (np.array([0.5, 1.5]), [0.5, 1.5]),
        (np.int64(64), 64),
        (np.float32(0.5), 0.5),
        (np.bool_(True), True),
        (np.array([64, 32]), [64, 32]),
    ],
)
def test_settings_as_json_holds_them(setting: Any, written: Any) -> None:
    assert json.loads(json.dumps(plain(setting), allow_nan=False)) == written


def test_settings_that_differ_are_written_differently() -> None:
    """A sampler is a setting: two of different angles are two methods."""
    narrow, wide = (plain(ConeSampler(2, angle)) for angle in (22.5, 45.0))
    assert narrow != wide


def test_functions_of_other_arguments_or_lines_are_written_differently() -> None:
    assert plain(partial(pow, 2, exp=3)) == {
        "class": "functools.partial",
        "func": "builtins.pow",
        "args": [2],
        "keywords": {"exp": 3},
    }
    one = plain(lambda rng: rng.dirichlet([1, 1]))
    other = plain(lambda rng: rng.dirichlet([1, 9]))
    assert re.fullmatch(r"tests\.test_records\..*<lambda>:\d+", one)
    assert one != other


def test_reference_points_of_the_tasks() -> None:
    assert set(REFERENCE_POINTS) <= set(gym.registry)
    assert tuple(reference_point_of("MO-Hopper-3obj-v4", 3)) == (0.0, 0.0, 0.0)
    assert tuple(reference_point_of("Unknown-v0", 4)) == (0.0,) * 4


# ------------------------------------------------------------------------------------------------------------- floors


def test_standing_still_is_a_rollout_of_zeros(tiny_run) -> None:
    """Episode e starts from seed e; the same under every preference."""
    env = gym.make(ENV, disable_env_checker=True)
    returns = []
    for seed in range(2):
        env.reset(seed=seed)
        total, ended = np.zeros(2), False
        while not ended:
            _, reward, terminated, truncated, _ = env.step(np.zeros(3, dtype=np.float32))
            total += reward
            ended = terminated or truncated
        returns.append(total)
    env.close()
    np.testing.assert_allclose(tiny_run.lines[1]["values"], np.tile(np.mean(returns, axis=0), (3, 1)), rtol=1e-12)


def test_floors_are_measured_as_learned_policies_are() -> None:
    grid = preference_grid(2, 4)
    state, torch_state = np.random.get_state()[1].tolist(), th.get_rng_state()  # noqa: NPY002
    fronts = evaluate_floors(short_stub, grid, n_episodes=3)
    assert np.random.get_state()[1].tolist() == state  # noqa: NPY002
    assert th.equal(th.get_rng_state(), torch_state)
    assert set(fronts) == {"standing still", "random actions"}
    for front in fronts.values():
        np.testing.assert_allclose(front.preferences, grid, rtol=1e-6)
        assert front.returns.shape == front.discounted_returns.shape == (4, 3, 2)
        assert front.episode_lengths.tolist() == [[5] * 3] * 4
        assert front.settings["seed"] == 0
    again = evaluate_floors(short_stub, grid, n_episodes=3)
    for name, front in fronts.items():
        np.testing.assert_array_equal(front.returns, again[name].returns)


def short_stub() -> StubEnv:
    return StubEnv(episode_length=5)


def test_the_actions_of_policies_that_learned_nothing() -> None:
    space = spaces.Box(np.array([0.5, -2.0, -3.0]), np.array([1.0, 2.0, -1.0]), dtype=np.float64)
    still, _ = ZeroActionPolicy(space).predict(np.zeros((4, 7)))
    np.testing.assert_array_equal(still, np.tile([0.5, 0.0, -1.0], (4, 1)))
    drawn = RandomPolicy(space, seed=1).predict(np.zeros((2_000, 7)))[0]
    assert (drawn >= space.low).all()
    assert (drawn <= space.high).all()
    np.testing.assert_allclose(drawn.mean(axis=0), [0.75, 0.0, -2.0], atol=0.1)
    np.testing.assert_array_equal(drawn, RandomPolicy(space, seed=1).predict(np.zeros((2_000, 7)))[0])


def test_a_record_does_not_change_the_training(tiny_run) -> None:
    """The same model trained by itself, without floors, evaluations and record, has the same front."""
    settings = tiny_run.settings
    env = make_mo_vec_env(ENV)
    model = MOMBA(settings.policy, env, seed=settings.seed, device="cpu", **deepcopy(TINY)).learn(settings.steps)
    env.close()
    front = evaluate_front(model, ENV, n_preferences=3, n_episodes=2)
    np.testing.assert_array_equal(front.returns, tiny_run.lines[-1]["front"]["returns"])


# -------------------------------------------------------------------------------------------------------- append-only


def test_a_record_is_not_written_over(valid) -> None:
    before = valid.read_bytes()
    with pytest.raises(FileExistsError, match=re.escape(str(valid))):
        writer_of(valid)
    assert valid.read_bytes() == before


def test_each_line_is_on_disk_before_the_call_returns(tmp_path, monkeypatch) -> None:
    path = tmp_path / "deep" / "down" / "record.jsonl"
    synchronised: list[int] = []
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: (synchronised.append(os.fstat(fd).st_size), fsync(fd))[1])
    writer = writer_of(path)
    content = path.read_bytes()
    assert synchronised == [len(content)]
    for i in range(3):
        writer.append("evaluation", steps=i, seconds=0.0, values=[[1.0, 2.0]] * 3)
        before, content = content, path.read_bytes()
        assert content.startswith(before)
        assert content[len(before) :].count(b"\n") == 1
        assert content.endswith(b"\n")
        assert synchronised[-1] == len(content)
    writer.finish(3, front_of([[1.0, 2.0]] * 3))
    assert path.read_bytes().startswith(content)
    assert lines_of(path)[-1]["status"] == "finished"


def test_the_file_is_held_until_the_end(tmp_path) -> None:
    """Who deletes the record of a run that still goes on finds none of its lines in the next one."""
    path = tmp_path / "record.jsonl"
    with writer_of(path) as writer:
        path.unlink()
        with writer_of(path, seed=1) as other:
            writer.append("evaluation", steps=1, seconds=0.0, values=VALUES)
            writer.finish(1, front_of(VALUES))
            assert [line["event"] for line in lines_of(path)] == ["start"]
            other.append("evaluation", steps=2, seconds=0.0, values=VALUES)
            assert not other.file.closed
    assert writer.file.closed
    assert other.file.closed
    record = read_record(path)
    assert (record.seed, record.error) == (1, UNENDED)
    assert [evaluation.steps for evaluation in record.evaluations] == [2]


@pytest.mark.parametrize("interruption", [KeyboardInterrupt(), SystemExit(3)], ids=repr)
def test_what_is_interrupted_has_no_end_like_what_is_killed(tmp_path, interruption: BaseException) -> None:
    path = tmp_path / "record.jsonl"
    with pytest.raises(type(interruption)) as raised, writer_of(path) as writer:  # noqa: PT012
        writer.append("evaluation", steps=1, seconds=0.0, values=VALUES)
        raise interruption
    assert raised.value is interruption
    assert writer.file.closed
    assert [line["event"] for line in lines_of(path)] == ["start", "evaluation"]
    record = read_record(path)
    assert record.error == UNENDED
    assert record.final_values is None
    assert len(record.evaluations) == 1


def test_leaving_without_an_end_writes_none(tmp_path) -> None:
    with writer_of(tmp_path / "record.jsonl") as writer:
        pass
    assert read_record(writer.path).error == UNENDED


@pytest.mark.parametrize("error", [RuntimeError("boom"), MemoryError("too large"), ValueError("two\nlines")])
def test_an_error_inside_leaves_its_end(tmp_path, error: BaseException) -> None:
    path = tmp_path / "record.jsonl"
    with pytest.raises(type(error)) as raised, writer_of(path) as writer:  # noqa: PT012
        writer.append("evaluation", steps=1, seconds=0.0, values=[[1.0, 2.0]] * 3)
        raise error
    assert raised.value is error
    assert writer.file.closed
    *_, end = lines_of(path)
    assert (end["event"], end["status"]) == ("end", "failed")
    assert type(error).__name__ in end["error"]
    assert str(error) in end["error"]
    record = read_record(path)
    assert record.error == end["error"]
    assert record.final_values is None
    assert len(record.evaluations) == 1


def test_a_line_that_a_full_disk_cut_off_does_not_swallow_the_end(tmp_path) -> None:
    path = tmp_path / "record.jsonl"
    with pytest.raises(OSError, match="No space left"), writer_of(path) as writer:  # noqa: PT012
        writer.append("evaluation", steps=1, seconds=0.0, values=[[1.0, 2.0]] * 3)
        with open(path, "a") as file:
            file.write('{"event": "evaluation", "steps": 2, "val')
        raise OSError(28, "No space left on device")
    record = read_record(path)
    assert record.error is not None
    assert len(record.evaluations) == 1


@contextlib.contextmanager
def room_for(n_bytes: int, path: Path) -> Iterator[None]:
    """A disk that is full when the file has grown by this much."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + n_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("n_bytes", [0, 1, 40], ids=["no room", "room for a byte", "room for half a line"])
def test_a_line_that_does_not_fit_leaves_the_file_as_it_was(tmp_path, n_bytes: int) -> None:
    writer = writer_of(tmp_path / "record.jsonl")
    writer.append("evaluation", steps=1, seconds=0.0, values=VALUES)
    before = writer.path.read_bytes()
    for _ in range(2):
        with pytest.raises(OSError, match=r"No space left|File too large"), room_for(n_bytes, writer.path):
            writer.append("evaluation", steps=2, seconds=0.0, values=VALUES)
        assert writer.path.read_bytes() == before
    writer.append("evaluation", steps=3, seconds=0.0, values=VALUES)
    assert writer.path.read_bytes().startswith(before)
    assert [evaluation.steps for evaluation in read_record(writer.path).evaluations] == [1, 3]


def test_a_disk_that_was_full_for_a_while_leaves_the_failure(tmp_path) -> None:
    path = tmp_path / "record.jsonl"
    with pytest.raises(OSError, match="No space left"), writer_of(path) as writer:  # noqa: PT012
        writer.append("evaluation", steps=1, seconds=0.0, values=VALUES)
        with room_for(40, path):
            writer.append("evaluation", steps=2, seconds=0.0, values=VALUES)
    assert [line["event"] for line in lines_of(path)] == ["start", "evaluation", "end"]
    record = read_record(path)
    assert record.error is not None
    assert record.error.startswith("OSError: ")
    assert "No space left" in record.error
    assert len(record.evaluations) == 1


def test_a_disk_that_stays_full_leaves_whole_lines_without_an_end(tmp_path) -> None:
    path = tmp_path / "record.jsonl"
    writer = writer_of(path)
    before = path.read_bytes()
    with room_for(40, path), pytest.raises(OSError, match="No space left"), writer:
        writer.append("evaluation", steps=1, seconds=0.0, values=VALUES)
    assert writer.file.closed
    assert path.read_bytes() == before
    assert read_record(path).error == UNENDED


@pytest.fixture
def cut_off(tmp_path) -> Path:
    """A record that was killed while it wrote a line."""
    path = tmp_path / "record.jsonl"
    with writer_of(path) as writer:
        writer.append("evaluation", steps=1, seconds=0.0, values=VALUES)
    path.write_bytes(path.read_bytes() + b'{"event": "evaluation", "steps": 2, "val')
    return path


def test_a_resumed_record_goes_on_after_its_last_whole_line(cut_off) -> None:
    whole = cut_off.read_bytes()
    whole = whole[: whole.rindex(b"\n") + 1]
    with RecordWriter(cut_off).resume(1) as writer:
        writer.append("evaluation", steps=2, seconds=0.0, values=VALUES)
    assert cut_off.read_bytes().startswith(whole)
    assert [line["event"] for line in lines_of(cut_off)] == ["start", "evaluation", "resumed", "evaluation"]


@pytest.mark.parametrize("torn", [b"\n", b"\0\0" + b'{"event": "end", "status": "failed", "error": "full"}\n'], ids=repr)
def test_a_record_goes_on_without_a_last_line_that_its_reader_passes_over(cut_off, torn: bytes) -> None:
    """Followed by another line it would be a damaged one in the middle."""
    cut_off.write_bytes(cut_off.read_bytes() + torn)
    assert read_record(cut_off).error == UNENDED
    with RecordWriter(cut_off).resume(1) as writer:
        writer.append("evaluation", steps=2, seconds=0.0, values=VALUES)
    assert [line["event"] for line in lines_of(cut_off)] == ["start", "evaluation", "resumed", "evaluation"]
    assert [evaluation.steps for evaluation in read_record(cut_off).evaluations] == [1, 2]


def test_a_full_disk_leaves_no_hole_in_a_resumed_record(cut_off) -> None:
    with RecordWriter(cut_off).resume(1) as writer:
        before = cut_off.read_bytes()
        with pytest.raises(OSError, match="No space left"), room_for(40, cut_off):
            writer.append("evaluation", steps=2, seconds=0.0, values=VALUES)
        assert cut_off.read_bytes() == before
        writer.append("evaluation", steps=3, seconds=0.0, values=VALUES)
    assert b"\0" not in cut_off.read_bytes()
    assert [line["event"] for line in lines_of(cut_off)] == ["start", "evaluation", "resumed", "evaluation"]
    assert [evaluation.steps for evaluation in read_record(cut_off).evaluations] == [1, 3]


def test_a_full_disk_that_fails_a_resumed_run_leaves_its_end(cut_off) -> None:
    with pytest.raises(OSError, match="No space left"), RecordWriter(cut_off).resume(1) as writer, room_for(40, cut_off):
        writer.append("evaluation", steps=2, seconds=0.0, values=VALUES)
    assert [line["event"] for line in lines_of(cut_off)] == ["start", "evaluation", "resumed", "end"]
    assert "No space left" in (read_record(cut_off).error or "")


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), KeyboardInterrupt()], ids=repr)
def test_a_line_that_does_not_reach_the_disk_leaves_the_file_as_it_was(tmp_path, monkeypatch, error: BaseException) -> None:
    writer = writer_of(tmp_path / "record.jsonl")
    before = writer.path.read_bytes()

    def fsync(fd: int) -> None:
        raise error

    with monkeypatch.context() as patch, pytest.raises(type(error)):  # noqa: PT012
        patch.setattr(os, "fsync", fsync)
        writer.append("evaluation", steps=1, seconds=0.0, values=VALUES)
    assert writer.path.read_bytes() == before
    writer.append("evaluation", steps=1, seconds=0.0, values=VALUES)
    assert len(read_record(writer.path).evaluations) == 1


def test_a_first_line_that_does_not_reach_the_disk_leaves_nothing_of_it(tmp_path, monkeypatch) -> None:
    def fsync(fd: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", fsync)
    path = tmp_path / "record.jsonl"
    with pytest.raises(OSError, match="Input/output error"):
        writer_of(path)
    assert not path.exists() or path.read_bytes() == b""


@pytest.mark.parametrize("error", [RuntimeError("afterwards"), KeyboardInterrupt()], ids=repr)
def test_a_finished_run_stays_finished(tmp_path, error: BaseException) -> None:
    """An end is the last line."""
    path = tmp_path / "record.jsonl"
    with pytest.raises(type(error)), writer_of(path) as writer:  # noqa: PT012
        writer.finish(1, front_of([[1.0, 2.0]] * 3))
        raise error
    assert [line["event"] for line in lines_of(path)] == ["start", "end"]
    assert read_record(path).error is None


NOT_FINITE = [math.nan, math.inf, -math.inf, np.float64("nan"), np.array([[1.0, np.inf]]), {"deep": [1.0, (math.nan,)]}]


@pytest.mark.parametrize("number", NOT_FINITE, ids=repr)
def test_a_number_that_is_not_finite_is_refused_before_anything_is_written(tmp_path, number: Any) -> None:
    writer = writer_of(tmp_path / "record.jsonl")
    before = writer.path.read_bytes()
    with pytest.raises(ValueError):  # noqa: PT011
        writer.append("evaluation", steps=1, seconds=0.0, values=number)
    assert writer.path.read_bytes() == before
    writer.append("evaluation", steps=1, seconds=0.0, values=[[1.0, 2.0]] * 3)
    assert len(read_record(writer.path).evaluations) == 1


@pytest.mark.parametrize("content", [{"config": {"bound": math.inf}}, {"reference_point": [0.0, math.nan]}])
def test_a_start_that_is_refused_leaves_nothing(tmp_path, content: dict[str, Any]) -> None:
    with pytest.raises(ValueError):  # noqa: PT011
        writer_of(tmp_path / "record.jsonl", **content)
    assert not (tmp_path / "record.jsonl").exists()
    writer_of(tmp_path / "record.jsonl")


def test_what_json_cannot_hold_is_an_error_that_names_it(tmp_path) -> None:
    writer = writer_of(tmp_path / "record.jsonl")
    before = writer.path.read_bytes()
    with pytest.raises(TypeError, match="Path"):
        writer.append("note", place=tmp_path)
    assert writer.path.read_bytes() == before


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(3), RuntimeError("diverged")], ids=repr)
def test_a_run_that_breaks_off_leaves_a_readable_record(tmp_path, monkeypatch, error: BaseException) -> None:
    def learn(model: MOMBA, *args: Any, **kwargs: Any) -> None:
        raise error

    monkeypatch.setattr(MOMBA, "learn", learn)
    settings = settings_of(tmp_path / "run", n_preferences=2, n_episodes=1)
    with pytest.raises(type(error)):
        run(settings)
    record = read_record(tmp_path / "run" / "record.jsonl")
    assert record.error is not None
    assert record.error == ("RuntimeError: diverged" if isinstance(error, Exception) else UNENDED)
    assert [floor.policy for floor in record.floors] == ["standing still", "random actions"]
    assert record.evaluations == []
    assert (tmp_path / "run" / "model.zip").exists()


def test_a_bound_that_is_infinite_is_a_setting_like_others(tmp_path, monkeypatch) -> None:
    """Gymnasium's own default is healthy_z_range=(0.7, inf): who changes its lower end gives an infinite upper one."""

    def learn(model: MOMBA, *args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(MOMBA, "learn", learn)
    line = f"--env {ENV} --output {tmp_path / 'run'} --n-preferences 2 --n-episodes 1 --no-progress-bar --device cpu"
    with pytest.raises(SystemExit) as stop:
        main([*line.split(), "--set", "buffer_size=100", "--env-kwargs", "healthy_z_range=[0.5, .inf]"])
    assert stop.value.code == 130, f"refused with {stop.value.code!r}; left {list((tmp_path / 'run').glob('*'))}"
    start, *floors = lines_of(tmp_path / "run" / "record.jsonl")
    assert "0.5" in json.dumps(start["env_kwargs"])
    assert len(floors) == 2


# ------------------------------------------------------------------------------------------------------------ reading


def test_a_record_reads_as_it_was_written(valid) -> None:
    record = read_record(valid)
    assert (record.label, record.env, record.env_kwargs, record.seed, record.error) == ("momba", "E", {}, 0, None)
    assert record.config == {"hyperparameters": {"gamma": 0.99}}
    np.testing.assert_array_equal(record.reference_point, [0, 0])
    np.testing.assert_array_equal(record.preferences, PREFERENCES)
    assert record.general_policy is True
    assert [floor.policy for floor in record.floors] == ["standing still", "random actions"]
    assert [(e.steps, e.seconds) for e in record.evaluations] == [(10, 1.5), (20, 3.0)]
    np.testing.assert_array_equal(record.evaluations[0].values, [[1, 2]] * 3)
    np.testing.assert_array_equal(record.final_values, [[1, 3], [2, 2], [3, 1]])


def test_without_a_general_policy_values_are_sets_of_any_number(valid_set) -> None:
    record = read_record(valid_set)
    assert (record.general_policy, record.error) == (False, None)
    np.testing.assert_array_equal(record.preferences, PREFERENCES)
    np.testing.assert_array_equal(record.floors[0].values, [[1, 1]] * 2)
    assert [evaluation.values.tolist() for evaluation in record.evaluations] == [[[1, 2]], [[2, 2]] * 4]
    np.testing.assert_array_equal(record.final_values, [[1, 5], [2, 4], [3, 3], [4, 2], [5, 1]])


def test_without_a_general_policy_values_still_are_of_the_tasks_objectives(valid_set) -> None:
    whole = valid_set.read_bytes()
    for change in (
        put(1, "values", [[1.0]]),
        put(2, "values", [[1.0, 2.0, 3.0]] * 3),
        put(3, "values", []),
        put(3, "values", [[1.0, 2.0], [1.0]]),
        put(-1, "front", "returns", []),
        put(-1, "front", "returns", [[[1.0, 2.0, 3.0]]] * 3),
    ):
        valid_set.write_bytes(whole)
        rewrite(valid_set, change)
        refused(valid_set)


def test_a_general_policy_has_one_value_for_each_preference(valid_set) -> None:
    """The same lines, read as those of a general policy."""
    rewrite(valid_set, put(0, "general_policy", True))
    assert "(2, 2), not (3, 2)" in refused(valid_set)


def test_a_real_record_reads(tiny_run) -> None:
    record = read_record(str(tiny_run.path))
    assert record.error is None
    assert record.general_policy is True
    assert record.config == tiny_run.lines[0]["config"]
    assert asdict(record)["start"] == tiny_run.lines[0]
    np.testing.assert_allclose(record.final_values, tiny_run.result.front.values)


def test_a_record_without_an_end_is_not_finished(valid) -> None:
    lines = valid.read_bytes().splitlines(keepends=True)
    valid.write_bytes(b"".join(lines[:-1]))
    record = read_record(valid)
    assert record.error == UNENDED
    assert record.final_values is None
    assert len(record.evaluations) == 2


def test_a_line_that_was_cut_off_while_it_was_written_is_ignored(valid) -> None:
    whole = valid.read_bytes()
    ends = [i + 1 for i, byte in enumerate(whole) if byte == ord("\n")]
    rng = np.random.default_rng(0)
    for start, end, n_evaluations in ((ends[2], ends[3], 0), (ends[3], ends[4], 1), (ends[4], ends[5], 2)):
        for cut in [start, start + 1, end - 2, *rng.integers(start, end - 1, 10)]:
            valid.write_bytes(whole[:cut])
            record = read_record(valid)
            assert record.error == UNENDED
            assert len(record.evaluations) == n_evaluations


def test_whether_a_record_is_cut_off_at_its_start(valid) -> None:
    """Not even the first line is whole, to the end of which a line break belongs."""
    whole = valid.read_bytes()
    first = whole.index(b"\n")
    for cut in (0, 1, first // 2, first):
        valid.write_bytes(whole[:cut])
        assert is_cut_off_at_its_start(valid), cut
    for cut in (first + 1, first + 2, len(whole)):
        valid.write_bytes(whole[:cut])
        assert not is_cut_off_at_its_start(valid), cut
        read_record(valid)


def refused(path: Path) -> str:
    """The message of the error, which names the file."""
    with pytest.raises(FileFormatError) as error:
        read_record(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("line", [b"{", b"", b"not json", b"[1, 2]", b"7", b'{"steps": 1}', b'{"event": 3}', b"\xff\xfe\x00"])
def test_a_bad_line_in_the_middle_is_named(valid, line: bytes) -> None:
    lines = valid.read_bytes().split(b"\n")
    lines[3] = line
    valid.write_bytes(b"\n".join(lines))
    assert "line 4" in refused(valid)


@pytest.mark.parametrize("line", [b"\0" * 40, b"[1, 2]"], ids=["no JSON", "no event"])
def test_a_bad_line_in_the_middle_is_named_with_its_cure(valid, tmp_path, line: bytes) -> None:
    """A run has a folder of its own, whose record is record.jsonl; records that were put together in one have other names."""
    lines = valid.read_bytes().split(b"\n")
    valid.write_bytes(b"\n".join([*lines[:3], line, *lines[3:]]))
    assert refused(valid).endswith(f"Move or delete this run's file to go on without it: {valid}.")
    folder = tmp_path / "run"
    folder.mkdir()
    record = valid.rename(folder / "record.jsonl")
    assert refused(record).endswith(f"Move or delete this run's folder to go on without it: {folder}.")


@pytest.mark.parametrize(
    ("version", "versions"),
    [(2, {"sb3_momba": "9.9"}), (0, {}), ("1", {}), (None, {}), ([1], {}), (2, "absent"), (2, None), (2, ["sb3_momba 9.9"])],
)
def test_another_version_is_named_beside_the_one_that_is_read(valid, version: Any, versions: Any) -> None:
    def newer(events: list[dict[str, Any]]) -> None:
        events[0].update(version=version, versions=versions, reference_point="elsewhere")
        if versions == "absent":
            del events[0]["versions"]

    rewrite(valid, newer)
    message = refused(valid)
    assert f"version {version!r}" in message
    assert "version 1" in message


def rewrite(path: Path, change: Callable[[list[dict[str, Any]]], Any]) -> None:
    events = [json.loads(line) for line in path.read_text().splitlines()]
    change(events)
    path.write_text("".join(json.dumps(event) + "\n" for event in events))


def put(*place: Any) -> Callable[[list[dict[str, Any]]], None]:
    """put(line, key, ..., value): a change of one value."""
    *keys, last, value = place

    def change(events: Any) -> None:
        for key in keys:
            events = events[key]
        events[last] = value

    return change


BAD_VALUES = {
    "another format": put(0, "format", "sb3_momba.front"),
    "no format": lambda events: events[0].pop("format"),
    "no start": lambda events: events.pop(0),
    "two starts": lambda events: events.insert(1, events[0]),
    "no general policy": lambda events: events[0].pop("general_policy"),
    "unknown event": put(2, "event", "intermezzo"),
    "no label": lambda events: events[0].pop("label"),
    "no seed": lambda events: events[0].pop("seed"),
    "no configuration": lambda events: events[0].pop("config"),
    "a configuration of numbers": put(0, "config", 7),
    "a scalar reference point": put(0, "reference_point", 0.0),
    "an empty reference point": put(0, "reference_point", []),
    "a reference point of another length": put(0, "reference_point", [0.0, 0.0, 0.0]),
    "no preferences": put(0, "preferences", []),
    "ragged preferences": put(0, "preferences", [[0.0, 1.0], [1.0]]),
    "a floor of words": put(1, "values", [["a", "b"]] * 3),
    "a floor without values": lambda events: events[1].pop("values"),
    "more values than preferences": put(3, "values", [[1.0, 2.0]] * 4),
    "flat values": put(3, "values", [1.0, 2.0]),
    "values of 3 objectives": put(3, "values", [[1.0, 2.0, 3.0]] * 3),
    "a value that is null": put(3, "values", [[1.0, None]] * 3),
    "a value that is a huge integer": put(3, "values", [[1.0, 10**400]] * 3),
    "an evaluation without steps": lambda events: events[3].pop("steps"),
    "steps that stand still": put(4, "steps", 10),
    "steps that fall": put(4, "steps", 9),
    "the same evaluation twice": lambda events: events.insert(4, events[3]),
    "evaluations in another order": lambda events: events.insert(3, events.pop(4)),
    "steps that are a huge integer": put(3, "steps", 10**400),
    "steps that are a list": put(3, "steps", [10]),
    "seconds that are words": put(3, "seconds", "soon"),
    "seconds that are nan in words": put(3, "seconds", "nan"),
    "an end without status": lambda events: events[-1].pop("status"),
    "an end without front": lambda events: events[-1].pop("front"),
    "a failure without error": put(-1, "status", "failed"),
    "returns without episodes": put(-1, "front", "returns", [[1.0, 2.0]] * 3),
    "returns of no episode": put(-1, "front", "returns", [[]] * 3),
    "returns of other preferences": put(-1, "front", "returns", [[[1.0, 2.0]]] * 2),
}


@pytest.mark.parametrize("change", BAD_VALUES.values(), ids=BAD_VALUES)
def test_what_does_not_fit_is_refused(valid, change: Callable[[list[dict[str, Any]]], Any]) -> None:
    rewrite(valid, change)
    refused(valid)


def test_steps_that_do_not_rise_are_named(valid) -> None:
    rewrite(valid, put(4, "steps", 9))
    assert "from 10 steps to 9" in refused(valid)


@pytest.mark.parametrize("failed", [False, True], ids=["finished", "failed"])
@pytest.mark.parametrize("line", [0, 1, 3, 5], ids=["a start", "a floor", "an evaluation", "an end"])
def test_nothing_comes_after_the_end(valid, failed: bool, line: int) -> None:
    def go_on(events: list[dict[str, Any]]) -> None:
        if failed:
            events[-1] = {"event": "end", "status": "failed", "error": "RuntimeError: diverged"}
        events.append({**events[line], **({"steps": 30} if line == 3 else {})})

    rewrite(valid, go_on)
    assert "goes on after its end" in refused(valid)


def test_what_was_cut_off_after_the_end_is_ignored(valid) -> None:
    valid.write_bytes(valid.read_bytes() + b'{"event": "evalu')
    assert read_record(valid).error is None


@pytest.mark.parametrize(
    ("place", "number"),
    [
        *(
            (place, number)
            for place in ('"seconds": 1.5', "1.0", '"gamma": 0.99')
            for number in ("NaN", "Infinity", "-Infinity")
        ),
        *((place, number) for place in ('"seconds": 1.5', "1.0") for number in ("1e999", "-1e999")),
    ],
)
def test_numbers_that_are_not_finite_are_refused(valid, place: str, number: str) -> None:
    """1e999 is strict JSON that Python reads as infinity."""
    text = valid.read_text()
    assert place in text
    valid.write_text(text.replace(place, re.sub(r"[\d.]+$", number, place), 1))
    refused(valid)


GARBAGE = {
    "empty": b"",
    "one line break": b"\n",
    "only a torn line": b'{"event": "start", "format": "sb3_momba.record", "ver',
    "binary": bytes(range(256)) * 10,
    "a zip": b"PK\x03\x04" + b"\0" * 100 + b"\n",
    "utf-16": '{"event": "start"}\n'.encode("utf-16"),
    "nested": b"[" * 100_000 + b"\n",
    "nested dictionaries": b'{"event":' * 100_000 + b"\n",
    "a huge integer": b'{"event": "start", "version": ' + b"9" * 10_000 + b"}\n",
}


@pytest.mark.parametrize("content", GARBAGE.values(), ids=GARBAGE)
def test_garbage_is_refused(tmp_path, content: bytes) -> None:
    path = tmp_path / "record.jsonl"
    path.write_bytes(content)
    refused(path)


def test_a_folder_is_no_record(tmp_path) -> None:
    refused(tmp_path)


def test_a_missing_record_is_missing(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_record(tmp_path / "nowhere.jsonl")


def reads_or_is_refused(path: Path) -> Record | None:
    try:
        record = read_record(path)
    except FileFormatError as error:
        assert str(path) in str(error)  # noqa: PT017
        return None
    final = [] if record.final_values is None else [record.final_values]
    for values in [*(e.values for e in record.evaluations), *(floor.values for floor in record.floors), *final]:
        assert values.ndim == 2
        assert len(values) > 0
        assert values.shape[1:] == record.reference_point.shape
        assert values.shape == record.preferences.shape or not record.general_policy
        assert np.isfinite(values).all()
    assert (record.final_values is not None) == (record.error is None)
    assert np.isfinite(np.array([(e.steps, e.seconds) for e in record.evaluations], dtype=np.float64)).all()
    assert (np.diff([e.steps for e in record.evaluations]) > 0).all()
    return record


@pytest.fixture(params=["valid", "valid_set"], ids=["one policy", "a set of solutions"])
def either(request) -> Path:
    """A record with a general policy, and one without."""
    return request.getfixturevalue(request.param)


def test_damaged_bytes_are_read_or_refused(either) -> None:
    whole = either.read_bytes()
    rng = np.random.default_rng(0)
    outcomes = set()
    for trial in range(300):
        content = bytearray(whole)
        for _ in range(rng.integers(1, 4)):
            i, j = sorted(int(x) for x in rng.integers(0, len(content), 2))
            kind = (trial + _) % 5
            if kind == 0:
                content[i] = int(rng.integers(256))
            elif kind == 1:
                content[i : i + 3] = b""
            elif kind == 2:
                content[i:i] = rng.choice([b"0", b"9" * 30, b"e9", b"-", b"\n", b"null", b'"', b"]"])
            elif kind == 3:
                content = content[: max(i, j)]
            else:
                content[i:i] = content[i : min(j, i + 200)]
            if not content:
                break
        either.write_bytes(bytes(content))
        outcomes.add(reads_or_is_refused(either) is None)
    assert outcomes == {True, False}


ODD_VALUES = [
    None,
    True,
    False,
    0,
    -1,
    1,
    10**20,
    10**400,
    1e308,
    0.5,
    "",
    "a",
    "nan",
    [],
    [[]],
    [1.0, 2.0],
    {},
    {"a": 1},
    [None],
]


def places(x: Any, here: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where in nested lists and dictionaries something is."""
    items = x.items() if isinstance(x, dict) else enumerate(x) if isinstance(x, list) else ()
    for key, value in items:
        yield (*here, key)
        yield from places(value, (*here, key))


def test_damaged_values_are_read_or_refused(either) -> None:
    events = [json.loads(line) for line in either.read_text().splitlines()]
    everywhere = list(places(events))
    rng = np.random.default_rng(1)
    outcomes = set()
    for trial in range(400):
        changed = deepcopy(events)
        place = everywhere[rng.integers(len(everywhere))]
        target: Any = changed
        for key in place[:-1]:
            target = target[key]
        kind = trial % 4
        if kind == 0:
            del target[place[-1]]
        elif kind == 1 and isinstance(target, list):
            target.append(deepcopy(target[place[-1]]))
        else:
            target[place[-1]] = ODD_VALUES[rng.integers(len(ODD_VALUES))]
        either.write_text("".join(json.dumps(event) + "\n" for event in changed))
        outcomes.add(reads_or_is_refused(either) is None)
    assert outcomes == {True, False}


# ----------------------------------------------------------------------------------------------------- finding records


def test_records_are_found_in_files_and_folders_once(tmp_path, monkeypatch) -> None:
    for name in ("b/1/record.jsonl", "b/0/record.jsonl", "a/record.jsonl", "single.jsonl"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "b" / "notes.txt").touch()
    (tmp_path / "plain-name").touch()
    names = ["b/0/record.jsonl", "b/1/record.jsonl"]
    assert find_records([tmp_path / "b"]) == [tmp_path / name for name in names]
    everything = [tmp_path / name for name in ("a/record.jsonl", *names, "single.jsonl")]
    assert find_records([tmp_path]) == everything
    assert find_records([str(tmp_path), tmp_path / "b", tmp_path / "a" / "record.jsonl"]) == everything
    assert find_records([tmp_path / "single.jsonl", tmp_path / "a"]) == [everything[-1], everything[0]]
    assert find_records([tmp_path / "plain-name"]) == [tmp_path / "plain-name"]
    monkeypatch.chdir(tmp_path)
    assert find_records(["single.jsonl", tmp_path / "single.jsonl", "./b/../single.jsonl"]) == [tmp_path / "single.jsonl"]


def test_a_folder_named_like_a_record_is_none(tmp_path) -> None:
    (tmp_path / "old.jsonl").mkdir()
    (tmp_path / "old.jsonl" / "record.jsonl").touch()
    assert find_records([tmp_path]) == [tmp_path / "old.jsonl" / "record.jsonl"]


def test_a_missing_path_and_a_folder_without_records_are_errors(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match=re.escape(str(tmp_path / "nowhere"))):
        find_records([tmp_path, tmp_path / "nowhere"])
    for paths in ([tmp_path], iter([tmp_path])):
        with pytest.raises(FileNotFoundError, match=re.escape(str(tmp_path))):
            find_records(paths)


# ------------------------------------------------------------------------------------------------------- one preference


def test_a_run_for_one_preference_trains_and_is_evaluated_for_it_alone(tmp_path) -> None:
    settings = settings_of(tmp_path / "run", preference=[0.3, 0.7])
    result = run(settings)
    record = read_record(result.folder / "record.jsonl")
    np.testing.assert_allclose(record.preferences, [[0.3, 0.7]], rtol=1e-6)
    assert record.config["preference"] == [0.3, 0.7]
    assert record.final_values is not None
    assert record.final_values.shape == (1, 2)
    model = MOMBA.load(result.folder / "model.zip")
    front = evaluate_front(model, settings.env, preferences=[[0.3, 0.7]], n_episodes=settings.n_episodes)
    np.testing.assert_array_equal(front.values, record.final_values)
    buffer = MOMBA.resume(result.folder / "checkpoints", settings.env).replay_buffer
    assert buffer is not None
    np.testing.assert_allclose(buffer.preferences[: buffer.pos], np.full((buffer.pos, 1, 2), [0.3, 0.7]), rtol=1e-6)


def test_one_preference_and_a_sampler_of_others_are_an_error(tmp_path) -> None:
    settings = settings_of(tmp_path / "run", preference=[0.3, 0.7])
    settings.hyperparameters["preference_sampler"] = "cone"
    with pytest.raises(ValueError, match=r"preference=\[0.3, 0.7\] and preference_sampler='cone': leave one"):
        run(settings)
    with pytest.raises(ValueError, match="sums to"):
        run(settings_of(tmp_path / "run", preference=[0.3, 0.3]))
    assert not (tmp_path / "run").exists()


def test_the_command_line_takes_one_preference() -> None:
    settings = parse(["--env", "MO-Hopper-v4", "--preference", "0.3", "0.7", "--output", "x"])
    assert settings.preference == [0.3, 0.7]
    command = command_of(recorded_settings(settings))
    assert " ".join(command[-3:]) == "--preference 0.3 0.7"


def test_a_traceback_is_recorded_with_the_error(tmp_path) -> None:
    with pytest.raises(RuntimeError), writer_of(tmp_path / "r.jsonl"):
        raise RuntimeError("diverged")
    record = read_record(tmp_path / "r.jsonl")
    assert record.error == "RuntimeError: diverged"
    assert record.traceback.startswith("Traceback (most recent call last):")
    assert record.traceback.endswith("RuntimeError: diverged\n")


def test_what_failed_and_went_on_has_no_traceback_of_then(tmp_path) -> None:
    path = tmp_path / "r.jsonl"
    with pytest.raises(RuntimeError), writer_of(path):
        raise RuntimeError("diverged")
    with open(path, "a") as file:
        file.write('{"event": "resumed", "steps": 0}\n')
    record = read_record(path)
    assert (record.error, record.traceback) == (UNENDED, "")
