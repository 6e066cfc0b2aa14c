"""Policies in files of their own: they act as before, and say what else a file is."""

import io
import zipfile

import numpy as np
import pytest
import torch as th

from sb3_momba import MOMBA, MlpPolicy, SimbaPolicy
from sb3_momba.files import FileFormatError
from sb3_momba.policy import MombaPolicy
from tests.stubs import StubEnv, assert_same_tree, tiny_model

OBSERVATIONS = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
PREFERENCES = np.random.default_rng(1).dirichlet(np.ones(2), size=6).astype(np.float32)
VARIANTS = {
    "SimbaPolicy": {"policy": "SimbaPolicy"},
    "SimbaPolicy, vector, film": {"policy": "SimbaPolicy", "vector_values": True, "policy_kwargs": {"conditioning": "film"}},
    "MlpPolicy, mse": {"policy": "MlpPolicy", "critic_loss": "mse", "policy_kwargs": {"net_arch": {"pi": [4], "qf": [5, 6]}}},
    "MlpPolicy, SiLU, SGD": {
        **{"policy": "MlpPolicy", "best_return_scale": None},
        "policy_kwargs": {"activation_fn": th.nn.SiLU, "optimizer_class": th.optim.SGD, "optimizer_kwargs": {"momentum": 0.5}},
    },
    "XqcPolicy, film+all": {"policy": "XqcPolicy", "policy_kwargs": {"conditioning": "film+all", "normalize_weights": False}},
    "FlashSacPolicy, vector": {"policy": "FlashSacPolicy", "vector_values": True, "policy_kwargs": {"critic_blocks": 2}},
    "CAPQL's log pi": {"policy": "MlpPolicy", "policy_kwargs": {"capql_log_prob": True, "n_critics": 3, "ortho_init": True}},
}


def saved(policy: MombaPolicy) -> io.BytesIO:
    file = io.BytesIO()
    policy.save(file)
    return file


@pytest.mark.parametrize("kwargs", VARIANTS.values(), ids=VARIANTS)
def test_a_policy_comes_back_and_acts_alike(kwargs):
    model = tiny_model(StubEnv(), **kwargs).learn(40)
    again = type(model.policy).load(saved(model.policy))
    assert_same_tree(dict(again.state_dict()), dict(model.policy.state_dict()))
    actions, _ = again.predict(np.concatenate([OBSERVATIONS, PREFERENCES], axis=1), deterministic=True)
    expected, _ = model.predict(OBSERVATIONS, preference=PREFERENCES, deterministic=True)
    np.testing.assert_array_equal(actions, expected)
    assert type(again.actor.optimizer) is type(model.actor.optimizer)
    assert again.arguments == model.policy.arguments
    assert zipfile.is_zipfile(saved(again))


def test_a_policy_is_written_where_it_is_asked_for(tmp_path):
    policy = tiny_model(StubEnv()).policy
    policy.save(tmp_path / "policy")
    assert [path.name for path in tmp_path.iterdir()] == ["policy"]
    again = SimbaPolicy.load(str(tmp_path / "policy"), device="cpu")
    assert_same_tree(dict(again.state_dict()), dict(policy.state_dict()))


def test_its_own_class_loads_a_policy():
    file = saved(tiny_model(StubEnv()).policy)
    with pytest.raises(FileFormatError, match="holds a SimbaPolicy, not a MlpPolicy"):
        MlpPolicy.load(file)


def test_a_model_is_no_policy_and_a_policy_no_model(tmp_path):
    model = tiny_model(StubEnv())
    model.save(tmp_path / "model.zip")
    model.policy.save(tmp_path / "policy.zip")
    with pytest.raises(FileFormatError, match=r"holds 'sb3_momba\.model', not 'sb3_momba\.policy'"):
        SimbaPolicy.load(tmp_path / "model.zip")
    with pytest.raises(FileFormatError, match=r"holds 'sb3_momba\.policy', not 'sb3_momba\.model'"):
        MOMBA.load(tmp_path / "policy.zip")


def test_a_file_that_is_cut_off_is_named(tmp_path):
    (tmp_path / "policy").write_bytes(saved(tiny_model(StubEnv()).policy).getvalue()[:-100])
    with pytest.raises(FileFormatError, match="policy is damaged"):
        SimbaPolicy.load(tmp_path / "policy")


class WiderPolicy(MlpPolicy):
    """A user's policy with an argument of its own."""

    def __init__(self, *args, width: int = 8, **kwargs):
        super().__init__(*args, net_arch=[width, width], **kwargs)
        del self.arguments["net_arch"]
        self.arguments["width"] = width


def test_a_policy_of_the_user_comes_back():
    policy = MOMBA(WiderPolicy, StubEnv(), buffer_size=10, policy_kwargs={"width": 5}).policy
    again = WiderPolicy.load(saved(policy))
    assert_same_tree(dict(again.state_dict()), dict(policy.state_dict()))


class Sine(th.nn.Module):
    def forward(self, x: th.Tensor) -> th.Tensor:
        return x.sin()


def test_a_policy_is_saved_whole_or_not_at_all(tmp_path):
    policy = MOMBA("MlpPolicy", StubEnv(), buffer_size=10, policy_kwargs={"activation_fn": Sine, "net_arch": [8]}).policy
    with pytest.raises(TypeError, match="activation_fn is a type, which cannot be stored without pickle"):
        policy.save(tmp_path / "policy")
    assert list(tmp_path.iterdir()) == []


class PolicyWithNamedActivation(MlpPolicy):
    """A user's policy that takes another value for an argument of MlpPolicy's name."""

    def __init__(self, *args, activation_fn: str = "tanh", **kwargs):
        super().__init__(*args, activation_fn={"tanh": th.nn.Tanh, "relu": th.nn.ReLU}[activation_fn], **kwargs)


def test_the_values_of_a_users_policy_are_its_own_affair():
    kwargs = {"activation_fn": "tanh", "net_arch": [8]}
    policy = MOMBA(PolicyWithNamedActivation, StubEnv(), buffer_size=10, policy_kwargs=kwargs).policy
    assert any(isinstance(module, th.nn.Tanh) for module in policy.modules())


@pytest.mark.parametrize("method", ["predict", "save", "load"])
def test_the_actor_alone_says_whom_to_ask(method):
    with pytest.raises(NotImplementedError, match=r"use policy\.predict, policy\.save and policy\.load"):
        getattr(tiny_model(StubEnv()).actor, method)(OBSERVATIONS)
