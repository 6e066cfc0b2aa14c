"""What users of Stable-Baselines3's SAC reach for: its arguments, its calls, its errors."""

import io

import pytest

from sb3_momba import MOMBA
from tests.stubs import StubEnv, tiny_model


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


@pytest.mark.parametrize("name", ["net_arch"])
def test_what_only_the_mlp_has_is_said_with_what_simba_has_instead(name):
    with pytest.raises(ValueError, match=rf"SimbaPolicy has no {name}: its sizes are .*MlpPolicy has it"):
        tiny_model(StubEnv(), policy_kwargs={name: [8]})


def test_a_policy_of_sac_that_momba_has_not_is_refused_with_those_that_it_has():
    with pytest.raises(ValueError, match="policy='CnnPolicy' is not known: use one of SimbaPolicy, MlpPolicy"):
        MOMBA("CnnPolicy", StubEnv())
