"""The PyTorch networks and the critic's update against numbers of SimbaV2's own JAX code, and Table 4.2's parameter counts.

`simbav2_golden.npz` holds parameters, a batch of 8 and what SimbaV2 makes of them: outputs, targets, loss, gradients, and the
critics after one step of Adam. The reference has a scalar reward; here a first objective with all the weight stands for it.
"""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import Logger
from torch import nn

from sb3_momba import MOMBA, MlpPolicy, SimbaPolicy
from sb3_momba.buffers import PreferenceReplayBufferSamples

OBSERVATION_DIM, N_OBJECTIVES, ACTION_DIM = 11, 2, 3
N_CRITICS, BATCH_SIZE, GAMMA, TAU, LEARNING_RATE = 2, 8, 0.99, 0.005, 1e-4

# The last part of a path in the golden file, by module: ours on the right.
NAMES = {
    r"^embedder/w/hyper_dense/kernel": "trunk.embedder.dense.weight",
    r"^embedder/scaler/scaler": "trunk.embedder.scaler.scaler",
    r"^encoder/layers_(\d)/mlp/w(\d)/hyper_dense/kernel": r"trunk.blocks.\1.dense\2.weight",
    r"^encoder/layers_(\d)/mlp/scaler/scaler": r"trunk.blocks.\1.scaler.scaler",
    r"^encoder/layers_(\d)/alpha_scaler/scaler": r"trunk.blocks.\1.lerp.scaler",
    r"^predictor/w(\d)/hyper_dense/kernel": r"head.dense\1.weight",
    r"^predictor/scaler/scaler": "head.scaler.scaler",
    r"^predictor/value_bias": "head.bias",
    r"^predictor/mean_w(\d)/hyper_dense/kernel": r"mean_head.dense\1.weight",
    r"^predictor/mean_scaler/scaler": "mean_head.scaler.scaler",
    r"^predictor/mean_bias": "mean_head.bias",
    r"^predictor/std_w(\d)/hyper_dense/kernel": r"log_std_head.dense\1.weight",
    r"^predictor/std_scaler/scaler": "log_std_head.scaler.scaler",
    r"^predictor/std_bias": "log_std_head.bias",
}


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(Path(__file__).with_name("simbav2_golden.npz")) as file:
        return dict(file)


def torch_name(jax_name: str) -> str:
    for pattern, name in NAMES.items():
        if re.match(pattern, jax_name):
            return re.sub(pattern, name, jax_name)
    raise KeyError(jax_name)


def in_torch_layout(golden: dict[str, np.ndarray], group: str, network: nn.Module) -> dict[str, th.Tensor]:
    """A group of the golden file's tensors under the names and in the shapes of `network`'s parameters."""
    shapes = {name: parameter.shape for name, parameter in network.named_parameters()}
    tensors = {}
    for path, array in golden.items():
        if path.startswith(f"{group}/"):
            name = torch_name(path.removeprefix(f"{group}/").removeprefix("VmapSimbaV2Critic_0/"))
            # An ensemble's scalers have one more dimension of size 1 here.
            tensors[name] = th.tensor(array.copy()).view(shapes[name]) if "scaler" in name else th.tensor(array.copy())
            assert tensors[name].shape == shapes[name], name
    return tensors


def load(golden: dict[str, np.ndarray], group: str, network: nn.Module) -> None:
    """Set every parameter of `network`, FiLM layers apart, which the reference does not have."""
    missing, unexpected = network.load_state_dict(in_torch_layout(golden, group, network), strict=False)
    assert not unexpected
    assert all(".films." in name for name in missing)


class TwoObjectives(gym.Env):
    """Only its spaces matter."""

    observation_space = spaces.Box(-np.inf, np.inf, (OBSERVATION_DIM,), np.float32)
    action_space = spaces.Box(-1, 1, (ACTION_DIM,), np.float32)
    reward_space = spaces.Box(-np.inf, np.inf, (N_OBJECTIVES,))


@pytest.fixture(params=["input", "film"])
def model(golden: dict[str, np.ndarray], request: pytest.FixtureRequest) -> MOMBA:
    """MOMBA with the reference's sizes and parameters. Untrained FiLM layers must not change any number."""
    model = MOMBA(
        "SimbaPolicy",
        TwoObjectives(),
        learning_rate=LEARNING_RATE,
        gamma=GAMMA,
        tau=TAU,
        ent_coef=1.0,
        buffer_size=10,
        policy_kwargs={"actor_hidden_dim": 16, "critic_hidden_dim": 32, "conditioning": request.param},
        device="cpu",
    )
    load(golden, "actor/params", model.actor)
    load(golden, "critic/params", model.critic)
    load(golden, "target/params", model.critic_target)
    return model


@pytest.fixture
def batch(golden: dict[str, np.ndarray]) -> PreferenceReplayBufferSamples:
    reward = th.tensor(golden["input/reward"])
    return PreferenceReplayBufferSamples(
        observations=th.tensor(golden["input/observation"]),
        actions=th.tensor(golden["input/action"]),
        next_observations=th.tensor(golden["input/next_observation"]),
        dones=th.tensor(golden["input/terminated"]),
        rewards=th.stack([reward, th.full_like(reward, 100.0)], dim=1),
        discounts=th.full((BATCH_SIZE,), GAMMA),
        preferences=th.tensor([1.0, 0.0]).expand(BATCH_SIZE, N_OBJECTIVES),
    )


@pytest.fixture
def fixed_next_actions(
    model: MOMBA, batch: PreferenceReplayBufferSamples, golden: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In s' the actor takes the reference's actions. With alpha = 1, the given alpha * log pi is log pi."""
    sample = model.actor.action_log_prob

    def action_log_prob(observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        if observations is batch.next_observations:
            return th.tensor(golden["input/next_action"]), th.tensor(golden["input/alpha_log_prob"])
        return sample(observations)

    monkeypatch.setattr(model.actor, "action_log_prob", action_log_prob)


def assert_close(actual: th.Tensor, expected: np.ndarray | th.Tensor) -> None:
    np.testing.assert_allclose(actual.detach().numpy(), np.asarray(expected), rtol=1e-5, atol=1e-5)


def test_actor(model: MOMBA, batch: PreferenceReplayBufferSamples, golden: dict[str, np.ndarray]) -> None:
    mean, log_std = model.actor.distribution(batch.observations)
    assert_close(mean, golden["actor/mean"])
    assert_close(log_std.exp(), golden["actor/std"])


@pytest.mark.parametrize("network", ["critic", "target"])
def test_critics(model: MOMBA, batch: PreferenceReplayBufferSamples, golden: dict[str, np.ndarray], network: str) -> None:
    if network == "critic":
        logits = model.critic(batch.observations, batch.actions)
    else:
        logits = model.critic_target(batch.next_observations, th.tensor(golden["input/next_action"]))
    assert logits.shape == (BATCH_SIZE, N_CRITICS, 1, 101)
    assert_close(logits.log_softmax(dim=-1)[:, :, 0].transpose(0, 1), golden[f"{network}/log_prob"])
    assert_close(model.policy.value.mean(logits)[:, :, 0].T, golden[f"{network}/value"])


@pytest.mark.usefixtures("fixed_next_actions")
def test_critic_loss_target_and_gradients(
    model: MOMBA, batch: PreferenceReplayBufferSamples, golden: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    targets = []
    loss_of = model.policy.value.loss
    monkeypatch.setattr(model.policy.value, "loss", lambda outputs, target: targets.append(target) or loss_of(outputs, target))

    loss, _ = model._critic_loss(batch, model.alpha)

    assert_close(loss, golden["critic/loss"])
    # SimbaV2 chooses between the critics before the projection, the thesis after it: they differ in row 2 only, where the
    # episode ends and both critics' targets are the same.
    assert_close(targets[0][:, 0, 0], golden["target/projected"])
    loss.backward()
    gradients = in_torch_layout(golden, "critic/grads", model.critic)
    for name, parameter in model.critic.named_parameters():
        if ".films." not in name:
            assert_close(parameter.grad, gradients[name])
    assert all(parameter.grad is None for parameter in model.actor.parameters())
    assert all(parameter.grad is None for parameter in model.critic_target.parameters())


@pytest.mark.usefixtures("fixed_next_actions")
def test_one_update(
    model: MOMBA, batch: PreferenceReplayBufferSamples, golden: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(model, "_sample", lambda batch_size: batch)

    model.set_logger(Logger(folder=None, output_formats=[]))
    model.train(gradient_steps=1)

    after = in_torch_layout(golden, "critic/after_one_adam_step_and_projection", model.critic)
    gradients = in_torch_layout(golden, "critic/grads", model.critic)
    before = in_torch_layout(golden, "target/params", model.critic_target)
    critic, target = dict(model.critic.named_parameters()), dict(model.critic_target.named_parameters())
    for name, gradient in gradients.items():
        # Adam's first step is lr * g / (|g| + 1e-8): where g is a rounding error, the step is not defined to 1e-5.
        off = (critic[name] - after[name]).abs() > 1e-5
        assert off.float().mean() < 1e-3, name
        assert (gradient[off].abs() < 1e-7).all(), name
        assert_close(target[name], (1 - TAU) * before[name] + TAU * critic[name].detach())


# Table 4.1: width of observation and action, number of objectives.
TASKS = {
    "Ant": (27, 8, 2),
    "HalfCheetah": (17, 6, 2),
    "Hopper-v3": (11, 3, 3),
    "Hopper-v4": (11, 3, 2),
    "Humanoid": (376, 17, 2),
    "Swimmer": (8, 2, 2),
    "Walker2d": (17, 6, 2),
}


@pytest.mark.parametrize(
    ("policy_class", "kwargs", "total"),
    [
        pytest.param(SimbaPolicy, {"actor_blocks": 1}, 17_505_632, id="one actor block: Table 4.2's mean is 2,500,805"),
        pytest.param(SimbaPolicy, {}, 18_427_616, id="two actor blocks: Table B.1"),
        pytest.param(MlpPolicy, {"critic_loss": "mse", "vector_values": True}, 1_811_064, id="CAPQL"),
    ],
)
def test_parameter_count_over_the_seven_tasks(policy_class: type, kwargs: dict, total: int) -> None:
    count = 0
    for observation_dim, action_dim, n_objectives in TASKS.values():
        policy = policy_class(
            spaces.Box(-np.inf, np.inf, (observation_dim + n_objectives,)),
            spaces.Box(-1, 1, (action_dim,)),
            lambda _: 1e-4,
            n_objectives=n_objectives,
            **kwargs,
        )
        count += sum(p.numel() for network in (policy.actor, policy.critic) for p in network.parameters())
    assert count == total
