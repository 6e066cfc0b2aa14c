"""rl_zoo3's scripts with MOMBA, from a shell, and what is the same as without rl_zoo3."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th
import yaml

from sb3_momba import MOMBA
from sb3_momba.train import main as train
from sb3_momba.zoo.__main__ import main
from sb3_momba.zoo.configuration import check_entry
from sb3_momba.zoo.tuning import convert_params, sample_params
from tests.stubs import TINY_SIMBA

TASK = "mo-hopper-2obj-v5"
RUN = Path("momba") / f"momba-{TASK}_1"
CALLBACK = "sb3_momba.pareto.callbacks.ParetoEvalCallback"
# As people write it: numbers that yaml 1.1 takes for strings, no policy, an entry under the raw id.
ENTRY = {
    "n_timesteps": 500,
    "learning_rate": "1e-3",
    "learning_starts": 100,
    "buffer_size": 1000,
    "batch_size": 16,
    "ent_coef": "auto_0.01",
    "env_kwargs": {"reset_noise_scale": 0.01},
    "preference_sampler": {"name": "cone", "angle": 30},
    "policy_kwargs": TINY_SIMBA,
    "callback": [{CALLBACK: {"eval_freq": 250, "n_preferences": 3, "n_episodes": 1}}],
}


def zoo(folder: Path, line: str) -> tuple[int, str]:
    """Exit code and all that was said."""
    command = [sys.executable, "-m", "sb3_momba.zoo", *line.split()]
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=600)
    return done.returncode, done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with a yaml file and the run that was trained with it, in `logs`."""
    path = tmp_path_factory.mktemp("zoo")
    (path / "tiny.yml").write_text(yaml.dump({TASK: ENTRY}))
    code, said = zoo(path, f"train --env {TASK} --conf-file tiny.yml --seed 3")
    assert code == 0, said
    return path


def test_train_leaves_what_rl_zoo3_leaves_with_hypervolumes(folder: Path) -> None:
    run = folder / "logs" / RUN
    evaluations = np.load(run / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [250, 500]
    assert np.array_equal(evaluations["results"][:, 0], np.load(run / "pareto_evaluations.npz")["hypervolume"])
    assert (run / "best_model.zip").exists()
    assert (run / "0.monitor.csv").exists()
    assert MOMBA.load(run / f"momba-{TASK}.zip").num_timesteps == 500


def test_the_same_file_gives_the_same_model_without_rl_zoo3(folder: Path, caplog) -> None:
    line = f"--env {TASK} --conf {folder}/tiny.yml --seed 3 --output {folder}/train --n-preferences 2 --n-episodes 1"
    train([*line.split(), "--no-progress-bar"])
    assert "callback is left to python -m sb3_momba.zoo" in caplog.text
    ours, theirs = MOMBA.load(folder / "train" / "model.zip"), MOMBA.load(folder / "logs" / RUN / f"momba-{TASK}.zip")
    assert ours._n_updates == theirs._n_updates == 400
    one, other = ours.policy.state_dict(), theirs.policy.state_dict()
    assert all(th.equal(one[name], other[name]) for name in one)
    assert th.equal(ours.log_ent_coef, theirs.log_ent_coef)


def test_enjoy_with_a_preference(folder: Path) -> None:
    code, said = zoo(folder, f"enjoy --env {TASK} --no-render --load-best -n 300 --preference 0.3 0.7")
    assert code == 0, said
    lines = [line for line in said.splitlines() if line.startswith("Preference: ")]
    assert lines
    assert all(line.startswith("Preference: [0.3 0.7]  Returns: [") for line in lines)
    assert "Mean reward" in said


def test_plots(folder: Path) -> None:
    code, said = zoo(folder, f"plot all_plots -e {TASK} --no-million --picture front.png")
    assert code == 0, said
    assert f"|{TASK}|" in said.replace(" ", "")
    assert (folder / "front.png").stat().st_size > 10_000


def test_optimize_maximises_the_hypervolume(folder: Path) -> None:
    options = "-n 120 --n-trials 2 --n-evaluations 2 --n-startup-trials 0 --pruner none --no-optim-plots --seed 1"
    code, said = zoo(folder, f"optimize --env momba/{TASK} --conf tiny.yml {options} -f tuned --optimization-log-path trials")
    assert code == 0, said
    value = float(said.split("Value:")[1].split()[0])
    trials = [np.load(path) for path in sorted((folder / "trials").glob("*/pareto_evaluations.npz"))]
    assert [trial["timesteps"].tolist() for trial in trials] == [[60, 120]] * 2
    assert [len(trial["preferences"]) for trial in trials] == [3, 3]  # as the file's callback has it
    assert value == pytest.approx(max(trial["hypervolume"][-1] for trial in trials))
    assert list((folder / "tuned" / "momba").glob("report_*.csv"))


def test_trials_are_evaluated_under_the_preferences_of_the_file(folder: Path) -> None:
    corners = {**ENTRY, "callback": [{CALLBACK: {"preferences": [[1.0, 0.0], [0.0, 1.0]], "n_episodes": 1}}]}
    (folder / "corners.yml").write_text(yaml.dump({TASK: corners}))
    options = "-n 110 --n-trials 1 --n-evaluations 1 --no-optim-plots --optimization-log-path corners"
    code, said = zoo(folder, f"optimize --env momba/{TASK} --conf corners.yml {options} -f tuned-corners")
    assert code == 0, said
    (evaluations,) = (folder / "corners").glob("*/pareto_evaluations.npz")
    assert np.load(evaluations)["preferences"].tolist() == [[1, 0], [0, 1]]


def test_shipped_configurations_and_parameters_from_the_command_line(folder: Path) -> None:
    """Without a callback in the file, rl_zoo3's own evaluation is of fronts too."""
    tiny = "policy_kwargs:dict(net_arch=[8]) buffer_size:1000 learning_starts:50 n_envs:2"
    options = "-n 200 --eval-freq 100 --eval-episodes 1"
    code, said = zoo(folder, f"train --env {TASK} --conf capql {options} -f capql -params {tiny}")
    assert code == 0, said
    assert "Front at 100 steps: hypervolume" in said
    model = MOMBA.load(folder / "capql" / RUN / f"momba-{TASK}.zip")
    assert (model.critic_loss, model.policy_kwargs, model.n_envs) == ("mse", {"net_arch": [8]}, 2)
    assert np.load(folder / "capql" / RUN / "evaluations.npz")["timesteps"].tolist() == [100, 200]


def test_unknown_names_are_errors(folder: Path) -> None:
    code, said = zoo(folder, f"train --env {TASK} --conf tiny.yml -params btach_size:3")
    assert code == 1
    assert (
        said.splitlines()[-1]
        == "error: tiny.yml, or -params: MOMBA has no hyperparameter 'btach_size': did you mean 'batch_size'?"
    )
    assert "Traceback" not in said


def test_nothing_is_called_that_is_no_callback_or_wrapper(folder: Path) -> None:
    for callback in ("subprocess.Popen", "rl_zoo3.utils.get_class_by_name"):
        (folder / "shared.yml").write_text(yaml.dump({TASK: {**ENTRY, "callback": [{callback: {"args": "touch called"}}]}}))
        code, said = zoo(folder, f"train --env {TASK} --conf shared.yml -f shared")
        assert code == 1
        assert said.splitlines()[-1].startswith(f"error: shared.yml, or -params: callback: '{callback}' is no subclass of")
    assert not (folder / "called").exists()


def test_objects_of_ones_own_come_from_a_file_of_python(folder: Path) -> None:
    own = "class Own(BaseCallback):\n    def _on_step(self):\n        open('called', 'w').close()\n        return True\n"
    entry = f"hyperparams = {{'momba/{TASK}': {{**{ {**ENTRY, 'n_timesteps': 120}!r}, 'callback': [Own()]}}}}\n"
    (folder / "own.py").write_text("from stable_baselines3.common.callbacks import BaseCallback\n" + own + entry)
    code, said = zoo(folder, f"train --env {TASK} --conf own.py -f own --eval-freq -1")
    assert code == 0, said
    assert (folder / "called").exists()


@pytest.mark.parametrize("command", ["train", "enjoy", "optimize", "plot"])
def test_without_rl_zoo3_the_command_that_installs_it_is_said(command: str, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)
    with pytest.raises(SystemExit) as stop:
        main([command, "--env", TASK])
    assert 'pip install "sb3-momba[zoo]"' in str(stop.value.code)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train", "--env is missing"),
        ("plot all_plots", "--env is missing"),
        (f"train --env {TASK} --gym-packages no_such_package", "No module named 'no_such_package'"),
    ],
)
def test_a_bad_option_is_one_line(line: str, message: str) -> None:
    with pytest.raises(SystemExit) as stop:
        main(line.split())
    assert message in str(stop.value.code)
    assert "\n" not in str(stop.value.code)


def test_a_trial_becomes_arguments_of_momba() -> None:
    trial = LowestTrial()
    sampled = sample_params(trial, n_actions=3, n_envs=1, additional_args={})
    assert sampled == convert_params(trial.params)
    assert check_entry(sampled) == {"policy": "SimbaPolicy", **sampled}  # all of them names of MOMBA's
    assert (sampled["gamma"], sampled["batch_size"], sampled["gradient_steps"]) == (1 - 3e-3, 64, 1)


class LowestTrial:
    """Stands for Optuna's: suggests the lower bound of everything."""

    def __init__(self) -> None:
        self.params: dict[str, float] = {}
        self.user_attrs: dict[str, object] = {}

    def suggest_float(self, name: str, low: float, high: float, log: bool = False) -> float:
        self.params[name] = low
        return low

    def suggest_int(self, name: str, low: int, high: int) -> int:
        self.params[name] = low
        return low

    def set_user_attr(self, name: str, value: object) -> None:
        self.user_attrs[name] = value


def test_plots_of_what_never_ran_are_refused(folder: Path) -> None:
    code, said = zoo(folder, "plot all_plots -e mo-hoper --picture none.png")
    assert code == 1
    assert said.splitlines()[-1] == "error: --env mo-hoper: no run of momba in logs has this name."
