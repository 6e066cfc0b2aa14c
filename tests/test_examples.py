"""The examples, in short."""

import os
import subprocess
import sys
from pathlib import Path

from sb3_momba import MOMBA
from sb3_momba.train import parse
from sb3_momba.zoo.configuration import check_hyperparameters

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(name: str, *arguments: str, cwd: Path, timeout: float = 300) -> str:
    return call(EXAMPLES / name, *arguments, cwd=cwd, timeout=timeout)


def call(*arguments: str | Path, cwd: Path, timeout: float = 300) -> str:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    command = [sys.executable, *arguments]
    ended = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=timeout)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "Warning" not in ended.stderr, ended.stderr
    return ended.stdout


def test_the_quick_start(tmp_path):
    said = run("quickstart.py", "100", cwd=tmp_path)
    assert "hypervolume" in said
    assert "action for 30 % speed, 70 % height: [" in said
    assert (tmp_path / "front.png").exists()


def test_the_demo(tmp_path):
    said = run("demo.py", "40", cwd=tmp_path)
    assert "mo-hopper-2obj-v5, " in said
    assert "times that of the better of the two that learned nothing" in said
    (folder,) = (tmp_path / "runs" / "demo").iterdir()
    assert (folder / "model.zip").exists()
    assert said.endswith(f"-m sb3_momba.explorer report {folder.relative_to(tmp_path)}\n")


def test_an_environment_of_ones_own(tmp_path):
    said = run("custom_environment.py", "600", cwd=tmp_path)
    assert said.count("preference [") == 5


def test_a_preference_is_chosen_after_training(tmp_path):
    assert "preference [" in run("choose_a_preference.py", "100", cwd=tmp_path)


def test_one_objective(tmp_path):
    assert "mean return -" in run("single_objective.py", "600", cwd=tmp_path)


def test_environments_side_by_side(tmp_path):
    assert "after 200 steps" in run("parallel_environments.py", "200", cwd=tmp_path)


def test_a_training_goes_on(tmp_path):
    assert "100 of 100 steps" in run("resume.py", "100", "here", cwd=tmp_path)
    said = run("resume.py", "150", "here", cwd=tmp_path)
    assert "Going on at 100 steps" in said
    assert "150 of 150 steps" in said


def test_relabelling_and_alignment(tmp_path):
    said = run("her_and_par.py", "100", cwd=tmp_path)
    assert said.count("hypervolume") == 2


def test_two_methods_and_their_report(tmp_path):
    said = run("capql_vs_momba.py", "40", "grid", "MO-Hopper-v4", cwd=tmp_path)
    assert said.count("2/2") == 2
    assert "## Aggregate" in said


def test_hyperparameters_as_yaml(tmp_path):
    settings = parse(["--env", "mo-hopper-2obj-v5", "--conf", str(EXAMPLES / "zoo.yml")])
    assert (settings.steps, settings.hyperparameters["her"]) == (20_000, True)
    assert check_hyperparameters(settings.policy, settings.hyperparameters) is None
    zoo = ["-m", "sb3_momba.zoo", "train", "--env", "mo-hopper-2obj-v5", "--conf-file", EXAMPLES / "zoo.yml"]
    call(*zoo, "--n-timesteps", "60", "--hyperparams", "learning_starts:20", cwd=tmp_path)
    (model,) = (tmp_path / "logs").rglob("momba-*.zip")
    assert MOMBA.load(model).num_timesteps == 60


def test_a_sweep_and_its_report(tmp_path):
    said = run("sweep.py", "40", "sweep", cwd=tmp_path, timeout=900)
    assert said.count("2/2") == 4  # both variants on both tasks
    for name in ("report.md", "curve-MO-Hopper-v4.png", "front-MO-HalfCheetah-v4.png"):
        assert (tmp_path / "sweep" / name).exists()
