"""Settings that cannot be: each error names the setting, its value and what it may be."""

import gymnasium as gym
import pytest
import torch as th

from sb3_momba import MOMBA
from sb3_momba.train import main, parse
from tests.stubs import TINY_SIMBA, StubEnv

BAD = {
    "vector_values='False'": {"vector_values": "False"},
    "her='yess'": {"her": "yess"},
    "batch_size=16.5": {"batch_size": 16.5},
    "learning_starts=-1": {"learning_starts": -1},
    "gradient_steps=-2": {"gradient_steps": -2},
    "gamma='abc'": {"gamma": "abc"},
    "gamma=True": {"gamma": True},
    "learning_rate=-1": {"learning_rate": -1},
    "learning_rate='lin_1e-3'": {"learning_rate": "lin_1e-3"},
    "best_return_scale=0": {"best_return_scale": 0},
    "target_entropy='foo'": {"target_entropy": "foo"},
    "critic_loss='huber' is not known: use one of ce, mse": {"critic_loss": "huber"},
    "critic_minimum='objective' needs": {"critic_minimum": "objective"},
    "her_kwargs: It has no 'kep_probability': did you mean 'keep_probability'": {
        "her": True,
        "her_kwargs": {"kep_probability": 0.5},
    },
    "her_kwargs=5": {"her": True, "her_kwargs": 5},
    "'keep_probability': 'high'": {"her": True, "her_kwargs": {"keep_probability": "high"}},
    "replay_buffer_kwargs: It has no 'foo'": {"replay_buffer_kwargs": {"foo": 1}},
    "SimbaPolicy has no argument 'actor_hidden': did you mean 'actor_hidden_dim'": {"policy_kwargs": {"actor_hidden": 8}},
    "normalize_features='flase'": {"policy_kwargs": {"normalize_features": "flase"}},
    "actor_hidden_dim=8.5": {"policy_kwargs": {"actor_hidden_dim": 8.5}},
    "critic_blocks=-1": {"policy_kwargs": {"critic_blocks": -1}},
    "support=[5]": {"policy_kwargs": {"support": [5]}},
    "support=(5, -5)": {"policy_kwargs": {"support": (5, -5)}},
    "train_freq=0: it must be a whole number of at least 1": {"train_freq": 0},
    "train_freq=-1": {"train_freq": (-1, "episode")},
    "stats_window_size='abc'": {"stats_window_size": "abc"},
    "seed=-1: give a whole number from 0": {"seed": -1},
    "seed=1.5": {"seed": 1.5},
    "device='gpu': give": {"device": "gpu"},
    "optimizer_class='AdamW': give a class of torch.optim": {"policy_kwargs": {"optimizer_class": "AdamW"}},
    "optimizer_kwargs: here Adam takes no 'lr'": {"policy_kwargs": {"optimizer_kwargs": {"lr": 1}}},
    "optimizer_kwargs: here Adam takes no 'foo'": {"policy_kwargs": {"optimizer_kwargs": {"foo": 1}}},
    "'critic_loss': ...}: that is an argument of MOMBA": {"policy_kwargs": {"critic_loss": "mse"}},
}


@pytest.mark.parametrize("message", BAD, ids=str)
def test_a_setting_that_cannot_be_is_named(message):
    with pytest.raises(ValueError, match=r".") as error:
        MOMBA("SimbaPolicy", StubEnv(), buffer_size=10, **BAD[message])
    assert message in str(error.value)


@pytest.mark.parametrize(("name", "value"), [("her", True), ("preference_alignment", "positive")])
def test_what_needs_a_preference_is_named_where_there_is_one_objective(name, value):
    with pytest.raises(ValueError, match=rf"^{name}={value!r} with one objective: .* set {name}=False\.$"):
        MOMBA("SimbaPolicy", StubEnv(n_objectives=1), buffer_size=10, vector_values=True, **{name: value})


@pytest.mark.parametrize("net_arch", [[8, 0], 8, {"pi": [8]}], ids=str)
def test_widths_that_cannot_be_are_named(net_arch):
    with pytest.raises(ValueError, match=r"net_arch=.*: give a list of widths"):
        MOMBA("MlpPolicy", StubEnv(), buffer_size=10, policy_kwargs={"net_arch": net_arch})


def test_the_mlp_has_no_weights_to_normalise():
    with pytest.raises(ValueError, match="MlpPolicy has no argument 'normalize_weights'"):
        MOMBA("MlpPolicy", StubEnv(), buffer_size=10, policy_kwargs={"normalize_weights": True})


def test_a_gpu_that_is_not_there_is_said(caplog):
    MOMBA("SimbaPolicy", StubEnv(), buffer_size=10, device="cpu", policy_kwargs=TINY_SIMBA)
    assert caplog.messages == []
    if not th.cuda.is_available():
        model = MOMBA("SimbaPolicy", StubEnv(), buffer_size=10, device="cuda", policy_kwargs=TINY_SIMBA)
        assert model.device.type == "cpu"
        assert caplog.messages == ["device='cuda': torch finds no GPU here, so the CPU is used."]


def test_optimizers_may_be_chosen():
    kwargs = {**TINY_SIMBA, "optimizer_class": th.optim.SGD, "optimizer_kwargs": {"momentum": 0.9}}
    model = MOMBA("SimbaPolicy", StubEnv(), buffer_size=10, policy_kwargs=kwargs)
    assert model.actor.optimizer.defaults["momentum"] == 0.9


@pytest.mark.parametrize(("steps", "is_said"), [(30, True), (31, False), (0, False)])
def test_a_training_that_ends_before_it_learns_is_said(steps, is_said, caplog):
    model = MOMBA("SimbaPolicy", StubEnv(), buffer_size=100, learning_starts=30, batch_size=8, policy_kwargs=TINY_SIMBA)
    model.learn(steps)
    assert [m for m in caplog.messages if "Nothing is learned before learning_starts=30" in m] == [*caplog.messages] * is_said
    assert (model._n_updates > 0) == (steps > 30)


def test_a_list_is_a_frequency_too():
    model = MOMBA("SimbaPolicy", StubEnv(), buffer_size=10, train_freq=[1, "episode"], policy_kwargs=TINY_SIMBA)
    assert model.train_freq.frequency == 1


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--set policy_kwargs=[", "no yaml literal"),
        ("--set gamma.a=1", "gamma"),
        ("--set critic_loss=huber", "use one of ce, mse"),
        ("--env-kwargs bogus=1", "cannot be made with env_kwargs={'bogus': 1}"),
        ("--eval-workers 0", "eval_workers=0"),
        ("--eval-envs 0", "eval_envs=0"),
        ("--seed -1", "seed=-1"),
        ("--device gpu", "device='gpu'"),
        ("--set policy=MlpPolicy", "policy='MlpPolicy' is no hyperparameter: give --architecture"),
        ("--set n_timesteps=100", "n_timesteps=100 is no hyperparameter: give --steps"),
        ("--set seed=3", "give --seed"),
        ("--set noise_std=0.1", "noise_std=0.1 needs rl_zoo3"),
        ("--set callback=x", "callback='x' is no hyperparameter: only a yaml file has it"),
        ("--set use_sde=true", "use_sde=True: MOMBA explores by its policy's own noise"),
        ("--preference 0.3 0.7 --n-preferences 50", "--n-preferences 50: --preference evaluates for one alone"),
        ("--conf momba --architecture mlp", "made for SimbaPolicy"),
        ("--env-kwargs physics=2021", "physics=2021 is not known"),
    ],
)
def test_a_bad_option_is_one_line_and_leaves_nothing(tmp_path, option, message):
    options = option.split(" ") if "gamma" not in option else ["--set", "gamma=1", "--set", "gamma.a=1"]
    with pytest.raises(SystemExit) as stop:
        main(["--env", "MO-Swimmer-v4", *options, "--output", str(tmp_path / "run"), "--no-progress-bar"])
    said = str(stop.value.code)
    assert message in said
    assert "\n" not in said
    assert not (tmp_path / "run").exists()


def test_what_sac_has_and_momba_need_not_may_be_written_down():
    assert parse(["--env", "MO-Swimmer-v4", "--set", "use_sde=false"]).hyperparameters == {"use_sde": False}


def test_an_output_inside_a_file_is_one_line(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as stop:
        main(["--env", "MO-Swimmer-v4", "--output", str(tmp_path / "file" / "run"), "--no-progress-bar"])
    assert str(stop.value.code).startswith("error: ")


def test_an_environment_of_ones_own_is_found_by_its_module():
    with pytest.raises(SystemExit, match="If it is your own, name the module that registers it too: 'my_module:Mine-v0'"):
        main(["--env", "Mine-v0", "--no-progress-bar"])
    with pytest.raises(gym.error.NameNotFound, match="'my_module:Mine-v0'"):
        MOMBA("SimbaPolicy", "Mine-v0")


@pytest.mark.parametrize("physics", ["physics=2020", "physics=current"])
def test_physics_are_given_on_the_command_line(tmp_path, physics):
    line = f"--env MO-Swimmer-v4 --env-kwargs {physics} --output {tmp_path}/run --steps 10 --n-preferences 2 --n-episodes 1"
    tiny = "--set buffer_size=100 --set policy_kwargs.actor_hidden_dim=8 --set policy_kwargs.critic_hidden_dim=8"
    main([*line.split(), *tiny.split(), "--no-progress-bar"])
    assert (tmp_path / "run" / "record.jsonl").exists()
