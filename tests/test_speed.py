"""What makes an update faster must not change its result, and must be used where it is meant to be."""

import copy
import subprocess
import sys

import pytest
import torch as th
from torch.utils.flop_counter import FlopCounterMode

from sb3_momba import MOMBA
from sb3_momba.nn import speed
from sb3_momba.nn.speed import without_weight_gradients
from tests.stubs import TINY_MLP, TINY_SIMBA, StubEnv

SMALL = {"actor_hidden_dim": 16, "critic_hidden_dim": 16}


def filled_model(policy: str = "SimbaPolicy", **kwargs) -> MOMBA:
    kwargs = {"learning_starts": 300, "buffer_size": 300, "batch_size": 32, "seed": 0, "device": "cpu", **kwargs}
    return MOMBA(policy, StubEnv(), **kwargs).learn(300)


@pytest.fixture
def recorded_compiler(monkeypatch):
    """torch.compile that only notes which methods were called through it, and with how many rows."""
    calls = []

    def compile(method, **kwargs):
        def called(network, *tensors):
            calls.append((network, method.__name__, len(tensors[0])))
            return method(network, *tensors)

        return called

    speed.compiled.cache_clear()
    monkeypatch.setattr(th, "compile", compile)
    yield calls
    speed.compiled.cache_clear()


def test_compiled_updates_are_the_plain_ones_in_float32():
    """To 1e-5 over 100 updates."""
    plain = filled_model(policy_kwargs=SMALL)
    compiled = filled_model(policy_kwargs=SMALL, compile=True)
    for model in (plain, compiled):
        model.replay_buffer.seed(1)
        th.manual_seed(1)
        model.train(100, 32)
    for name, start in plain.policy.state_dict().items():
        th.testing.assert_close(compiled.policy.state_dict()[name], start, rtol=1e-5, atol=1e-5, msg=name)
    for name, total in plain._metrics.sums.items():
        th.testing.assert_close(compiled._metrics.sums[name], total, rtol=1e-5, atol=1e-5, msg=name)


def test_only_updates_are_compiled(recorded_compiler):
    model = filled_model(policy_kwargs=TINY_SIMBA, compile=True)
    model.predict(StubEnv().observation_space.sample(), preference=[0.5, 0.5])
    assert recorded_compiler == []  # 300 steps have been taken and none learned from
    model.train(1, 32)
    networks = [model.actor, model.critic_target, model.critic, model.actor, model.critic]
    methods = ["distribution", *["values_and_features"] * 2, "distribution", "values_and_features"]
    assert recorded_compiler == [(network, method, 32) for network, method in zip(networks, methods, strict=True)]


def test_without_the_switch_nothing_is_compiled(recorded_compiler):
    filled_model(policy_kwargs=TINY_SIMBA).train(2, 32)
    assert recorded_compiler == []


def test_a_copy_of_a_compiled_network_computes_with_its_own_weights(recorded_compiler):
    model = filled_model(policy_kwargs=TINY_SIMBA, compile=True)
    copied = copy.deepcopy(model.actor)
    with th.no_grad():
        for parameter in copied.parameters():
            parameter.mul_(2)
    observations = th.rand(4, 5)
    assert not th.allclose(copied.distribution(observations)[0], model.actor.distribution(observations)[0])


def test_a_compiled_model_is_saved_and_loaded(tmp_path, recorded_compiler):
    filled_model(policy_kwargs=TINY_SIMBA, compile=True).save(tmp_path / "model")
    loaded = MOMBA.load(tmp_path / "model", env=StubEnv())
    assert loaded.compile
    assert loaded.critic_target.compiled
    assert not MOMBA.load(tmp_path / "model", compile=False).actor.compiled


def test_no_compiler_is_said_before_training(monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.raises(ValueError, match=r"compile=True needs a C\+\+ compiler"):
        MOMBA("SimbaPolicy", StubEnv(), compile=True, policy_kwargs=TINY_SIMBA)
    MOMBA("SimbaPolicy", StubEnv(), policy_kwargs=TINY_SIMBA)


def test_training_mode_reaches_every_module():
    policy = filled_model(policy_kwargs=TINY_SIMBA).policy
    for mode in (True, False, False, True):
        policy.set_training_mode(mode)
        assert {module.training for module in policy.modules()} == {mode}


@pytest.mark.parametrize(
    ("policy", "kwargs"), [(policy, TINY_MLP if policy == "MlpPolicy" else TINY_SIMBA) for policy in MOMBA.policy_aliases]
)
def test_the_actor_loss_asks_for_no_gradients_of_the_critics_weights(policy, kwargs):
    model = filled_model(policy, policy_kwargs=kwargs)
    batch = model._sample(32)
    with FlopCounterMode(display=False) as forward, th.no_grad():
        model.critic(batch.observations, batch.actions)
    actions = batch.actions.clone().requires_grad_(True)
    with without_weight_gradients(model.critic):
        q = model.critic(batch.observations, actions).sum()
    with FlopCounterMode(display=False) as backward:
        q.backward()
    # One product for each of the forward pass: the gradient of its input, never that of its weights.
    assert backward.get_total_flops() <= forward.get_total_flops()
    assert actions.grad.abs().sum() > 0
    assert all(parameter.requires_grad for parameter in model.critic.parameters())


def test_weights_have_gradients_again_after_an_error():
    model = filled_model(policy_kwargs=TINY_SIMBA)
    with pytest.raises(KeyError), without_weight_gradients(model.critic):
        raise KeyError
    assert all(parameter.requires_grad for parameter in model.critic.parameters())


FAULTS = """
import resource, torch as th
from tests.test_speed import filled_model
th.set_num_threads(1)
model = filled_model(batch_size=256)
model.train(10, 256)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
model.train(10, 256)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's malloc is meant")
def test_freed_memory_is_not_faulted_in_again():
    faults = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True).stdout
    assert int(faults) < 5_000  # without: some 40,000
