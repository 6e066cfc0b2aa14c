"""The networks of XQC and FlashSAC against slow loops over their formulas, and which pass sees what."""

import inspect
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import Logger
from torch import nn

from sb3_momba import MOMBA, FlashSacPolicy, MlpPolicy, SimbaPolicy, XqcPolicy
from sb3_momba.nn.batch_norm import MOMENTUM, BatchNorm, without_batch_statistics
from sb3_momba.nn.descent import NonFiniteLossError, move_towards
from sb3_momba.nn.flash_sac import FlashSacArchitecture, UnitBatchNorm, UnitRmsNorm
from sb3_momba.nn.layers import HyperDense
from sb3_momba.nn.networks import Actor, Critic
from sb3_momba.nn.xqc import XqcArchitecture
from sb3_momba.train import parse
from tests.stubs import StubEnv, assert_same_tree, tiny_model
from tests.test_batch_norm import batch_norms, scramble

POLICIES = {"XqcPolicy": XqcPolicy, "FlashSacPolicy": FlashSacPolicy}
ARCHITECTURES = {"XqcPolicy": XqcArchitecture, "FlashSacPolicy": FlashSacArchitecture}
OBSERVATION_DIM, N_OBJECTIVES, ACTION_DIM, BATCH = 3, 2, 2, 6

every_policy = pytest.mark.parametrize("policy", POLICIES)


def make_critic(policy: str, conditioning: str = "input", n_critics: int = 2) -> Critic:
    th.manual_seed(0)
    critic = Critic(ARCHITECTURES[policy](8, 2, conditioning), OBSERVATION_DIM, N_OBJECTIVES, ACTION_DIM, n_critics, 1, 5)
    scramble(critic)
    return critic


def make_pairs(seed: int = 0, n: int = BATCH) -> tuple[th.Tensor, th.Tensor]:
    """Observations with preferences, and actions."""
    generator = th.Generator().manual_seed(seed)
    observations = seed + th.randn(n, OBSERVATION_DIM + N_OBJECTIVES, generator=generator)
    return observations, 2 * th.rand(n, ACTION_DIM, generator=generator) - 1


def trained(policy: str, steps: int = 45, **kwargs: Any) -> MOMBA:
    return tiny_model(StubEnv(), policy, **kwargs).learn(steps)


# ------------------------------------------------------------------------------------------- the networks, formula by formula


def normalised(norm: BatchNorm, x: np.ndarray, member: int, training: bool) -> np.ndarray:
    gain, shift, mean, variance = (
        getattr(norm, name).detach().numpy()[member, 0].astype(np.float64)
        for name in ("gain", "shift", "running_mean", "running_variance")
    )
    if training:
        mean, variance = x.mean(axis=0), x.var(axis=0)
    return (x - mean) / np.sqrt(variance + norm.eps) * gain + shift


def slow_xqc(trunk: Any, x: np.ndarray, w: np.ndarray, member: int, training: bool) -> np.ndarray:
    """x <- ReLU(BN(W x)) from BN(x) on."""
    x = normalised(trunk.input_norm, x, member, training)
    for i, (layer, norm) in enumerate(zip(trunk.layers, trunk.norms, strict=True)):
        read = np.concatenate([x, w], axis=1) if i > 0 and trunk.appended_dim else x
        x = np.maximum(normalised(norm, read @ layer.weight.detach().numpy()[member], member, training), 0)
        if trunk.film_dim:
            affine = (
                w @ trunk.films[i].affine.weight.detach().numpy()[member] + trunk.films[i].affine.bias[member].detach().numpy()
            )
            x = (1 + affine[:, :8]) * x + affine[:, 8:]
    return x


def slow_flash_sac(trunk: Any, x: np.ndarray, w: np.ndarray, member: int, training: bool) -> np.ndarray:
    """x <- x + ReLU(BN(W_2 ReLU(BN(W_1 x)))) from W BN(x) on, then RMS norm."""
    weight = {name: p.detach().numpy()[member] for name, p in trunk.named_parameters()}
    x = normalised(trunk.embedder.norm, x, member, training) @ weight["embedder.dense.weight"]
    for i, block in enumerate(trunk.blocks):
        read = np.concatenate([x, w], axis=1) if trunk.appended_dim else x
        hidden = np.maximum(normalised(block.norm1, read @ weight[f"blocks.{i}.dense1.weight"], member, training), 0)
        x = x + np.maximum(normalised(block.norm2, hidden @ weight[f"blocks.{i}.dense2.weight"], member, training), 0)
        if trunk.film_dim:
            affine = w @ weight[f"films.{i}.affine.weight"] + weight[f"films.{i}.affine.bias"]
            x = (1 + affine[:, :8]) * x + affine[:, 8:]
    return x / np.sqrt((x**2).mean(axis=1, keepdims=True) + 1e-6) * weight["norm.gain"][0]


SLOW = {"XqcPolicy": slow_xqc, "FlashSacPolicy": slow_flash_sac}


@pytest.mark.parametrize("training", [True, False], ids=["training", "running averages"])
@pytest.mark.parametrize("conditioning", ["input", "film+all"])
@every_policy
def test_trunk_and_head_are_the_slow_loops(policy: str, conditioning: str, training: bool) -> None:
    critic = make_critic(policy, conditioning).train(training)
    observations, actions = make_pairs()
    outputs, features = critic.values_and_features(observations, actions)
    x, w = np.concatenate([observations, actions], axis=1), observations[:, OBSERVATION_DIM:].numpy()
    for member in range(2):
        expected = SLOW[policy](critic.trunk, x, w, member, training)
        np.testing.assert_allclose(features[member].detach(), expected, rtol=1e-4, atol=1e-5)
        logits = expected @ critic.head.dense.weight.detach().numpy()[member] + critic.head.bias.detach().numpy()[member]
        np.testing.assert_allclose(outputs[:, member, 0].detach(), logits, rtol=1e-4, atol=1e-4)


def test_ranges_of_the_log_standard_deviation() -> None:
    raw = th.tensor([-50.0, -1.0, 0.0, 50.0])
    assert XqcArchitecture(8, 1, "input").log_std(raw).tolist() == [-10, -1, 0, 2]
    squashed = FlashSacArchitecture(8, 1, "input").log_std(raw)
    np.testing.assert_allclose(squashed, [-10, -10 + 6 * (1 - np.tanh(1)), -4, 2], rtol=1e-6)


# With the head's bias; a batch norm has 2 numbers per feature. Inputs: 17 + 2, and 6 actions for the critics.
XQC_ACTOR = 2 * 19 + 19 * 256 + 3 * 256**2 + 4 * 2 * 256 + 2 * (256 + 1) * 6
XQC_CRITIC = 2 * 25 + 25 * 512 + 3 * 512**2 + 4 * 2 * 512 + (512 + 1) * 101
FLASH_ACTOR = 2 * 19 + 19 * 128 + 2 * (2 * 128 * 512 + 2 * 512 + 2 * 128) + 128 + 2 * (128 + 1) * 6
FLASH_CRITIC = 2 * 25 + 25 * 256 + 2 * (2 * 256 * 1024 + 2 * 1024 + 2 * 256) + 256 + (256 + 1) * 101


@pytest.mark.parametrize(
    ("policy", "counts"),
    [("XqcPolicy", (XQC_ACTOR, 2 * XQC_CRITIC)), ("FlashSacPolicy", (FLASH_ACTOR, 2 * FLASH_CRITIC))],
)
def test_parameter_counts_on_half_cheetah(policy: str, counts: tuple[int, int]) -> None:
    made = POLICIES[policy](spaces.Box(-np.inf, np.inf, (17 + 2,)), spaces.Box(-1, 1, (6,)), lambda _: 1e-4, n_objectives=2)
    assert tuple(sum(p.numel() for p in network.parameters()) for network in (made.actor, made.critic)) == counts


@every_policy
def test_weights_stay_on_their_spheres(policy: str) -> None:
    for on in (True, False):
        model = trained(policy, policy_kwargs={"normalize_weights": on})
        norms = [m.weight.detach().norm(dim=-2).flatten() for m in model.policy.actor.modules() if isinstance(m, HyperDense)]
        for module in model.critic.modules():
            if isinstance(module, HyperDense):
                norms.append(module.weight.detach().norm(dim=-2).flatten())
            if isinstance(module, UnitBatchNorm):
                norms.append((module.gain.square() + module.shift.square()).mean(dim=-1).sqrt().detach().flatten())
            if isinstance(module, UnitRmsNorm):
                norms.append(module.gain.square().mean(dim=-1).sqrt().detach().flatten())
        assert np.allclose(th.cat(norms), 1, atol=1e-5) == on


# ------------------------------------------------------------------------------------------------- which pass sees what


@every_policy
def test_acting_depends_on_no_other_row(policy: str) -> None:
    critic = make_critic(policy)
    th.manual_seed(1)
    actor = Actor(ARCHITECTURES[policy](8, 2, "input"), OBSERVATION_DIM, N_OBJECTIVES, ACTION_DIM)
    scramble(actor)
    observations, actions = make_pairs()
    for network, call in (
        (critic, lambda n: critic(observations[:n], actions[:n])),
        (actor, lambda n: actor.distribution(observations[:n])[0]),
    ):
        network.eval()
        th.testing.assert_close(call(BATCH)[:2], call(2))
        network.train()
        assert not th.allclose(call(BATCH)[:2], call(2))
        with without_batch_statistics(network):
            th.testing.assert_close(call(BATCH)[:2], call(2))
        assert all(module.training for module in network.modules())


@every_policy
def test_two_batches_in_one_pass_are_one_batch(policy: str) -> None:
    critic = make_critic(policy)
    now, next_ = make_pairs(0), make_pairs(1)
    together = critic(th.cat([now[0], next_[0]]), th.cat([now[1], next_[1]]))
    halves = th.cat([critic(*now, *next_), critic(*next_, *now)])
    th.testing.assert_close(halves, together, rtol=1e-4, atol=1e-5)
    assert not th.allclose(critic(*now, *next_), critic(*now))
    critic.eval()
    th.testing.assert_close(critic(*now, *next_), critic(*now))


@pytest.mark.parametrize("policy", ["SimbaPolicy", "MlpPolicy"])
def test_without_batch_norm_what_is_beside_is_not_looked_at(policy: str) -> None:
    model = tiny_model(StubEnv(), policy)
    now = make_pairs(0)
    model.critic.train()
    assert th.equal(model.critic(*now, None, None), model.critic(*now))
    assert not batch_norms(model.policy)


def statistics_of(model: MOMBA) -> dict[str, th.Tensor]:
    return {name: buffer.clone() for name, buffer in model.policy.named_buffers() if ".running_" in name}


def updated_once(policy: str) -> tuple[MOMBA, Any]:
    """A model whose first update is on the minibatch that is given with it."""
    model = tiny_model(StubEnv(), policy, learning_starts=40).learn(40)
    model.set_logger(Logger(folder=None, output_formats=[]))
    batch = model._sample(16)
    model._sample = lambda batch_size: batch
    return model, batch


def input_norm(network: nn.Module) -> BatchNorm:
    return batch_norms(network.trunk)[0]


@every_policy
def test_what_an_update_moves_the_running_averages_towards(policy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The actor's: s. The critics': (s, a) and (s', a') together, whatever the actor's loss asks. The target's stay."""
    model, batch = updated_once(policy)
    asked = []
    act = model.actor.action_log_prob
    monkeypatch.setattr(model.actor, "action_log_prob", lambda x: asked.append(act(x)) or asked[-1])
    model.train(1, 16)
    next_actions = asked[0][0]
    seen = th.cat([th.cat([batch.observations, batch.actions], 1), th.cat([batch.next_observations, next_actions], 1)])
    for member in range(2):
        th.testing.assert_close(input_norm(model.critic).running_mean[member, 0], MOMENTUM * seen.mean(0))
        expected = 1 - MOMENTUM + MOMENTUM * seen.var(0, correction=0)
        th.testing.assert_close(input_norm(model.critic).running_variance[member, 0], expected)
    assert (input_norm(model.critic_target).running_mean == 0).all()
    th.testing.assert_close(input_norm(model.actor).running_mean, MOMENTUM * batch.observations.mean(0))


@every_policy
def test_only_networks_that_learn_see_the_batch(policy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model, _ = updated_once(policy)
    passes = []
    for name in ("actor", "critic", "critic_target"):
        norm = input_norm(getattr(model, name))
        norm.register_forward_hook(lambda norm, x, y, name=name: passes.append((name, norm.training, len(x[0]))))
    model.train(1, 16)
    assert passes == [
        ("actor", False, 16),  # a' as it would be taken
        ("critic_target", True, 32),
        ("critic", True, 32),
        ("actor", True, 16),
        ("critic", False, 16),
    ]
    model.predict(StubEnv().observation_space.sample(), preference=[0.5, 0.5])
    assert passes[-1] == ("actor", False, 1)


@every_policy
def test_a_skipped_step_of_the_actor_leaves_its_running_averages(policy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model, _ = updated_once(policy)
    before = {name: tensor.clone() for name, tensor in model.actor.state_dict().items()}
    monkeypatch.setattr(model, "_actor_loss", lambda *_: (model.actor(th.zeros(4, 5)).sum() * th.nan, None, {}))
    model.train(1, 16)
    assert model._skipped_updates == 1
    for name, tensor in model.actor.state_dict().items():
        th.testing.assert_close(tensor, before[name], rtol=0, atol=1e-6)


@every_policy
def test_networks_rest_in_evaluation(policy: str, tmp_path: Path) -> None:
    """Else an action would depend on the other rows of its batch."""
    model = trained(policy)
    model.policy.save(tmp_path / "policy")
    loaded = type(model.policy).load(tmp_path / "policy")
    for rested in (model.policy, loaded, tiny_model(StubEnv(), policy).policy):
        assert not any(module.training for module in rested.modules())


@every_policy
def test_the_target_follows_in_its_parameters_alone(policy: str) -> None:
    critic, target = make_critic(policy), make_critic(policy)
    for parameter in critic.parameters():
        parameter.data.add_(1.0)
    for layer in batch_norms(critic):
        layer.running_mean.add_(1.0)
    before = {name: tensor.clone() for name, tensor in target.state_dict().items()}
    move_towards(target, critic, 0.25)
    for name, tensor in target.state_dict().items():
        expected = before[name] if ".running_" in name else before[name] + 0.25
        th.testing.assert_close(tensor, expected)


@every_policy
def test_a_skipped_update_leaves_the_running_averages(policy: str) -> None:
    model, batch = updated_once(policy)
    model.train(2, 16)
    before = statistics_of(model)
    assert len(before) > 10
    bad = batch._replace(observations=batch.observations.clone().fill_(float("nan")))
    with pytest.raises(NonFiniteLossError):
        model._gradient_step(bad)
    assert_same_tree(statistics_of(model), before)
    model.train(1, 16)
    assert all(tensor.isfinite().all() for tensor in model.policy.state_dict().values())
    assert not th.equal(
        statistics_of(model)["actor." + next(n for n in dict(model.actor.named_buffers()) if "running" in n)], th.zeros(5)
    )


# ------------------------------------------------------------------------------------- saving, precision, compiling, settings


@every_policy
def test_running_averages_are_saved_and_all_is_float(policy: str, tmp_path: Path) -> None:
    model = trained(policy)
    assert all(tensor.is_floating_point() for tensor in model.policy.state_dict().values())
    assert not any(".batch_" in name for name in model.policy.state_dict())
    model.save(tmp_path / "model")
    again = MOMBA.load(tmp_path / "model")
    assert_same_tree(statistics_of(again), statistics_of(model))
    observations = np.random.default_rng(0).normal(20, 9, size=(5, 3)).astype(np.float32)
    preference = [0.3, 0.7]
    expected, _ = model.predict(observations, preference=preference, deterministic=True)
    np.testing.assert_array_equal(again.predict(observations, preference=preference, deterministic=True)[0], expected)
    one_by_one = [model.predict(row, preference=preference, deterministic=True)[0] for row in observations]
    np.testing.assert_allclose(one_by_one, expected, rtol=1e-5, atol=1e-6)
    model.export(tmp_path / "policy.pt")  # which compares its actions with the policy's


def filled(policy: str, **kwargs: Any) -> MOMBA:
    model = tiny_model(StubEnv(), policy, learning_starts=60, **kwargs).learn(60)
    model.replay_buffer.seed(1)
    th.manual_seed(1)
    return model


@every_policy
def test_compiled_updates_are_the_plain_ones(policy: str) -> None:
    plain, compiled = filled(policy), filled(policy, compile=True)
    for model in (plain, compiled):
        model.replay_buffer.seed(1)
        th.manual_seed(1)
        model.train(5, 16)
    for name, total in plain._metrics.sums.items():
        th.testing.assert_close(compiled._metrics.sums[name], total, rtol=1e-4, atol=1e-4, msg=name)
    for name, expected in plain.policy.state_dict().items():
        # The next batch norm takes away what the input's adds: its gradient is a rounding error, Adam's step the sign of it.
        if name.endswith(("input_norm.shift", "embedder.norm.shift")):
            continue
        th.testing.assert_close(compiled.policy.state_dict()[name], expected, rtol=1e-4, atol=1e-4, msg=name)


@pytest.fixture
def page() -> str:
    return (Path(__file__).parent.parent / "docs" / "hyperparameters.md").read_text()


@every_policy
def test_their_arguments_stand_on_the_page(policy: str, page: str) -> None:
    names = list(inspect.signature(POLICIES[policy]).parameters)[3:-1]
    assert names == [
        *(f"{who}_{what}" for who in ("actor", "critic") for what in ("hidden_dim", "blocks")),
        "conditioning",
    ]
    defaults = [inspect.signature(POLICIES[policy]).parameters[name].default for name in names[:4]]
    row = re.search(rf"^\| {policy} \| (.+)", page, re.MULTILINE)
    assert row is not None
    assert [int(cell) for cell in row[1].split(" | ")[:4]] == defaults


@pytest.mark.parametrize(
    ("kwargs", "match"),
    [
        ({"net_arch": [64]}, "Policy has no net_arch: its sizes are actor_hidden_dim"),
        ({"normalize_features": False}, "Policy has no argument 'normalize_features'"),
        ({"critic_blocks": 0}, "critic_blocks=0: it must be a whole number of at least 1"),
        ({"normalize_weights": 1}, "normalize_weights=1: it is a switch"),
        ({"conditioning": "hyper"}, "conditioning='hyper' is not known"),
    ],
    ids=["net_arch", "features", "blocks", "weights", "conditioning"],
)
@every_policy
def test_settings_that_cannot_be_are_named(policy: str, kwargs: dict[str, Any], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        MOMBA(policy, StubEnv(), buffer_size=10, policy_kwargs=kwargs)


def test_the_command_line_knows_them() -> None:
    found = [parse(["--env", "E", "--architecture", name]).policy for name in ("simba", "mlp", "xqc", "flashsac")]
    assert found == list(MOMBA.policy_aliases) == [c.__name__ for c in (SimbaPolicy, MlpPolicy, XqcPolicy, FlashSacPolicy)]
    assert parse(["--env", "E", "--conf", "xqc"]).policy == "XqcPolicy"
    assert parse(["--env", "E", "--conf", "flashsac"]).hyperparameters["batch_size"] == 512
