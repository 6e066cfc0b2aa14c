"""What users of Stable-Baselines3's SAC reach for: its arguments, its calls, its errors."""

import io
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import NormalActionNoise

from sb3_momba import MOMBA, make_mo_vec_env
from tests.stubs import StubEnv, assert_same_tree, tiny_model


@pytest.mark.parametrize(
    "kwargs",
    [{"use_sde": True}, {"sde_sample_freq": 4}, {"use_sde_at_warmup": True}, {"target_update_interval": 2}],
    ids=str,
)
def test_arguments_of_sac_that_momba_has_not_are_refused_with_a_cure(kwargs):
    ((name, value),) = kwargs.items()
    with pytest.raises(ValueError, match=rf"{name}={value}: .*Leave it out"):
        tiny_model(StubEnv(), **kwargs)


def test_arguments_of_sac_that_ask_for_nothing_pass():
    tiny_model(StubEnv(), use_sde=False, sde_sample_freq=-1, use_sde_at_warmup=False, target_update_interval=1)


def test_gsde_cannot_be_switched_on_at_load():
    file = io.BytesIO()
    tiny_model(StubEnv()).save(file)
    with pytest.raises(ValueError, match=r"use_sde=True: .*without gSDE"):
        MOMBA.load(file, use_sde=True)


def test_an_argument_that_nobody_has_is_named_with_the_nearest():
    with pytest.raises(TypeError, match="MOMBA has no argument 'learning_rat': did you mean 'learning_rate'"):
        tiny_model(StubEnv(), learning_rat=1e-3)


@pytest.mark.parametrize(
    ("name", "value"),
    [("features_extractor_class", dict), ("share_features_extractor", True), ("log_std_init", -3), ("normalize_images", False)],
)
@pytest.mark.parametrize("policy", ["SimbaPolicy", "MlpPolicy"])
def test_arguments_of_sacs_policy_are_refused_with_a_cure(policy, name, value):
    with pytest.raises(ValueError, match=rf"policy_kwargs {name}=.*: (the networks read|MOMBA explores|observations are)"):
        tiny_model(StubEnv(), policy, policy_kwargs={name: value})


@pytest.mark.parametrize("name", ["net_arch", "activation_fn"])
def test_what_only_the_mlp_has_is_said_with_what_simba_has_instead(name):
    with pytest.raises(ValueError, match=rf"SimbaPolicy has no {name}: its sizes are .*MlpPolicy has it"):
        tiny_model(StubEnv(), policy_kwargs={name: [8]})


def test_a_policy_of_sac_that_momba_has_not_is_refused_with_those_that_it_has():
    with pytest.raises(ValueError, match="policy='CnnPolicy' is not known: use one of SimbaPolicy, MlpPolicy"):
        MOMBA("CnnPolicy", StubEnv())


@pytest.mark.parametrize("activation_fn", ["tanh", th.tanh, th.optim.Adam], ids=["a name", "a function", "another class"])
def test_an_activation_is_a_class_of_torch(activation_fn):
    with pytest.raises(ValueError, match=r"activation_fn=.*such as torch\.nn\.Tanh"):
        tiny_model(StubEnv(), "MlpPolicy", policy_kwargs={"activation_fn": activation_fn})


def test_networks_without_hidden_layers_are_linear_and_train():
    model = tiny_model(StubEnv(), "MlpPolicy", vector_values=True, critic_loss="mse", policy_kwargs={"net_arch": []})
    assert sum(parameter.numel() for parameter in model.actor.parameters()) == 2 * (3 + 2 + 1) * 2
    assert sum(parameter.numel() for parameter in model.critic.parameters()) == 2 * (3 + 2 + 2 + 1) * 2
    assert model.learn(30)._n_updates == 10


UNKNOWN_SPACES = {"actions": {"action_space": spaces.Discrete(2)}, "observations": {"observation_space": spaces.MultiBinary(3)}}


@pytest.mark.parametrize("space", UNKNOWN_SPACES.values(), ids=UNKNOWN_SPACES)
def test_spaces_are_refused_as_our_own_error_and_as_that_of_sb3(space):
    for kind in (ValueError, AssertionError):
        with pytest.raises(kind, match="is not"):
            tiny_model(StubEnv(**space))


class WithoutOptions(StubEnv):
    def reset(self, seed=None):
        return super().reset(seed=seed)


@pytest.mark.parametrize("n_objectives", [None, 2])
def test_an_environment_whose_reset_takes_no_options_trains(n_objectives):
    model = tiny_model(WithoutOptions(n_objectives)).learn(30)
    assert model._n_updates == 10


def test_what_is_included_is_saved_though_it_is_excluded_too():
    file = io.BytesIO()
    tiny_model(StubEnv(), verbose=0, gamma=0.5).save(file, exclude=["gamma", "tau"], include=["gamma"])
    assert MOMBA.load(file).gamma == 0.5


def test_custom_objects_replace_only_what_there_is(capsys):
    file = io.BytesIO()
    model = tiny_model(StubEnv())
    model.save(file)
    again = MOMBA.load(file, custom_objects={"learning_rate": 0.5, "dummy": 1.0}, print_system_info=True)
    assert again.learning_rate == 0.5
    assert not hasattr(again, "dummy")
    assert "SAVED MODEL SYSTEM INFO" in capsys.readouterr().out


def test_a_replay_buffer_is_loaded_where_there_is_none(tmp_path):
    model = tiny_model(StubEnv()).learn(25)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    before, model.replay_buffer = model.replay_buffer, None
    model.device = th.device("cuda")
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    assert model.replay_buffer.device.type == "cuda"
    for name in ("observations", "actions", "rewards", "dones", "timeouts", "preferences"):
        np.testing.assert_array_equal(getattr(model.replay_buffer, name), getattr(before, name))


def test_a_replay_buffer_is_extended_by_what_another_holds():
    model = tiny_model(StubEnv(1)).learn(25)
    old, buffer = deepcopy(model.replay_buffer), model.replay_buffer
    rows = [getattr(old, name)[:25] for name in ("observations", "next_observations", "actions", "rewards", "dones")]
    buffer.extend(*rows, [[{"TimeLimit.truncated": bool(one)}] for one in old.timeouts[:25, 0]])
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        assert_same_tree(getattr(buffer, name)[25:50], getattr(buffer, name)[:25])


def test_observations_without_their_preference_are_not_stored():
    buffer = tiny_model(make_mo_vec_env(StubEnv)).learn(25).replay_buffer
    row = [getattr(buffer, name)[0] for name in ("observations", "next_observations", "actions", "rewards", "dones")]
    with pytest.raises(ValueError, match=r"the buffer takes \[observation, preference\], 3 \+ 2 wide"):
        buffer.add(*row, [{}])
    assert buffer.pos == 25


def test_timeouts_are_always_told_from_ends():
    tiny_model(StubEnv(), replay_buffer_kwargs={"handle_timeout_termination": True})
    with pytest.raises(ValueError, match=r"handle_timeout_termination=False takes .*leave it True"):
        tiny_model(StubEnv(), replay_buffer_kwargs={"handle_timeout_termination": False})


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ("normal", "action_noise='normal': give an ActionNoise"),
        (NormalActionNoise(np.zeros(3), np.ones(3)), r"has shape \(3,\), an action \(2,\)"),
    ],
    ids=["a name", "another shape"],
)
def test_action_noise_that_cannot_be_is_named(noise, message):
    with pytest.raises(ValueError, match=message):
        tiny_model(StubEnv(), action_noise=noise)
