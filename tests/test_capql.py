"""`capql.yml` against morl-baselines' own CAPQL, and the plainest configuration against SB3's SAC: the same weights, the same
batch, the same noise."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import torch.nn.functional as F
from stable_baselines3 import SAC

from sb3_momba import MOMBA
from sb3_momba.buffers import PreferenceReplayBufferSamples
from sb3_momba.zoo.configuration import read_configuration
from tests.stubs import StubEnv

BATCH = 32


def batch_of(model: MOMBA, seed: int = 0) -> PreferenceReplayBufferSamples:
    """Random transitions of the model's shapes."""
    rng = np.random.default_rng(seed)
    n, d = model.policy.observation_dim, model.n_objectives
    w = rng.dirichlet(np.ones(d), BATCH)
    appended = w[:, : model.policy.preference_dim]
    arrays = PreferenceReplayBufferSamples(
        observations=np.concatenate([rng.normal(size=(BATCH, n)), appended], axis=1),
        actions=rng.uniform(-1, 1, (BATCH, model.action_space.shape[0])),
        next_observations=np.concatenate([rng.normal(size=(BATCH, n)), appended], axis=1),
        dones=rng.integers(0, 2, BATCH),
        rewards=rng.normal(size=(BATCH, d)),
        discounts=np.full(BATCH, model.gamma),
        preferences=w,
    )
    return PreferenceReplayBufferSamples(*(th.as_tensor(array, dtype=th.float32) for array in arrays))


# ------------------------------------------------------------------------------------------------------ morl-baselines


@pytest.fixture
def capql_pair():
    """Our CAPQL and morl-baselines', with the same weights, on a task with actions in [-1, 1]."""
    capql = pytest.importorskip("morl_baselines.multi_policy.capql.capql")
    env = gym.make("mo-halfcheetah-v5", disable_env_checker=True)
    theirs = capql.CAPQL(env, log=False, seed=0, device="cpu")
    configuration = read_configuration("capql", "mo-halfcheetah-v5")
    hyperparameters = {**configuration.hyperparameters, "buffer_size": 100}
    ours = MOMBA(configuration.policy, env, seed=1, device="cpu", **hyperparameters)
    copy_weights(theirs, ours)
    return theirs, ours


def copy_weights(theirs, ours: MOMBA) -> None:
    columns = critic_columns(ours)
    with th.no_grad():
        for layer, source in zip(actor_layers(ours), their_actor_layers(theirs), strict=True):
            layer.weight.copy_(source.weight.T)
            layer.bias.copy_(source.bias)
        for critic, networks in ((ours.critic, theirs.q_nets), (ours.critic_target, theirs.target_q_nets)):
            for member, network in enumerate(networks):
                sources = [module for module in network.net if isinstance(module, th.nn.Linear)]
                for i, (layer, source) in enumerate(zip([*critic.trunk.layers, critic.head], sources, strict=True)):
                    layer.weight[member].copy_((source.weight[:, columns] if i == 0 else source.weight).T)
                    layer.bias[member].copy_(source.bias)


def critic_columns(ours: MOMBA) -> list[int]:
    """Their critics read (s, a, w), ours [s, w, a]."""
    n, a, d = ours.policy.observation_dim, ours.action_space.shape[0], ours.n_objectives
    return [*range(n), *range(n + a, n + a + d), *range(n, n + a)]


def actor_layers(ours: MOMBA):
    return [*ours.actor.trunk.layers, ours.actor.mean_head, ours.actor.log_std_head]


def their_actor_layers(theirs):
    hidden = [module for module in theirs.policy.latent_pi if isinstance(module, th.nn.Linear)]
    return [*hidden, theirs.policy.mean, theirs.policy.log_std_linear]


def as_their_batch(batch: PreferenceReplayBufferSamples, n: int):
    """(s, a, w, r, s', done)."""
    return (
        batch.observations[:, :n],
        batch.actions,
        batch.preferences,
        batch.rewards,
        batch.next_observations[:, :n],
        batch.dones,
    )


def value_of(parameter: th.Tensor) -> th.Tensor:
    return parameter.detach()


def gradient_of(parameter: th.Tensor) -> th.Tensor:
    return parameter.grad


def assert_same_actors(theirs, ours: MOMBA, pick=value_of, rtol: float = 1e-5) -> None:
    for layer, source in zip(actor_layers(ours), their_actor_layers(theirs), strict=True):
        assert_close(pick(layer.weight).T, pick(source.weight), rtol)
        assert_close(pick(layer.bias), pick(source.bias), rtol)


def assert_same_critics(critic, networks, columns: list[int], pick=value_of, rtol: float = 1e-5) -> None:
    for member, network in enumerate(networks):
        sources = [module for module in network.net if isinstance(module, th.nn.Linear)]
        for i, (layer, source) in enumerate(zip([*critic.trunk.layers, critic.head], sources, strict=True)):
            weight = pick(source.weight)[:, columns] if i == 0 else pick(source.weight)
            assert_close(pick(layer.weight)[member].T, weight, rtol)
            assert_close(pick(layer.bias)[member], pick(source.bias), rtol)


def assert_close(actual: th.Tensor, expected: th.Tensor, rtol: float) -> None:
    """Relative to the largest entry of the tensor: entries near 0 are sums that cancel."""
    th.testing.assert_close(actual, expected, rtol=rtol, atol=rtol * expected.abs().max().item())


def test_capql_acts_and_rates_actions_as_morl_baselines_does(capql_pair) -> None:
    theirs, ours = capql_pair
    batch = batch_of(ours)
    s, _, w, *_ = as_their_batch(batch, ours.policy.observation_dim)
    th.manual_seed(3)
    action, log_prob, _ = theirs.policy.sample(s, w)
    th.manual_seed(3)
    our_action, our_log_prob = ours.actor.action_log_prob(batch.observations)
    th.testing.assert_close(our_action, action, rtol=1e-5, atol=1e-6)
    th.testing.assert_close(our_log_prob, log_prob, rtol=1e-5, atol=1e-5)
    th.testing.assert_close(ours.actor(batch.observations, deterministic=True), theirs.policy.get_action(s, w))


def test_capql_target_and_critic_loss_are_those_of_morl_baselines(capql_pair) -> None:
    theirs, ours = capql_pair
    batch = batch_of(ours)
    s, a, w, r, s_next, done = as_their_batch(batch, ours.policy.observation_dim)
    th.manual_seed(4)
    with th.no_grad():
        next_action, log_prob, _ = theirs.policy.sample(s_next, w)
        q = th.stack([network(s_next, next_action, w) for network in theirs.target_q_nets]).amin(dim=0)
        target = r + (1 - done[:, None]) * theirs.gamma * (q - theirs.alpha * log_prob[:, None])
    loss = sum(F.mse_loss(network(s, a, w), target) for network in theirs.q_nets) / 2
    th.manual_seed(4)
    seen = []
    original = ours.policy.value.loss
    ours.policy.value.loss = lambda outputs, our_target: (seen.append(our_target), original(outputs, our_target))[1]
    our_loss, _ = ours._critic_loss(batch, ours.alpha)
    th.testing.assert_close(seen[0][:, 0, :, 0], target, rtol=1e-5, atol=1e-5)
    th.testing.assert_close(our_loss.detach(), loss.detach(), rtol=1e-5, atol=0)
    our_loss.backward()
    loss.backward()
    assert_same_critics(ours.critic, theirs.q_nets, critic_columns(ours), gradient_of)


@pytest.mark.parametrize("n_updates", [1, 10])
def test_capql_updates_are_those_of_morl_baselines(capql_pair, n_updates: int) -> None:
    theirs, ours = capql_pair
    for update in range(n_updates):
        batch = batch_of(ours, seed=update)
        theirs._sample_batch_experiences = lambda batch=batch: as_their_batch(batch, ours.policy.observation_dim)
        th.manual_seed(update)
        theirs.update()
        th.manual_seed(update)
        ours._gradient_step(batch)
        if update == 0:
            assert_same_actors(theirs, ours, gradient_of)
    assert_same_actors(theirs, ours)
    assert_same_critics(ours.critic, theirs.q_nets, critic_columns(ours))
    assert_same_critics(ours.critic_target, theirs.target_q_nets, critic_columns(ours))


# ----------------------------------------------------------------------------------------------------------- SB3's SAC


def test_the_plainest_configuration_has_sacs_losses_and_gradients() -> None:
    """One objective, dense networks, expected values, fixed alpha, nothing scaled; SB3 halves the critic loss."""
    env = StubEnv(n_objectives=None)
    sac = SAC("MlpPolicy", env, ent_coef=0.1, seed=0, device="cpu", buffer_size=100)
    ours = MOMBA(
        "MlpPolicy",
        env,
        critic_loss="mse",
        ent_coef=0.1,
        best_return_scale=None,
        seed=1,
        device="cpu",
        buffer_size=100,
        policy_kwargs={"normalize_observations": False},
    )
    with th.no_grad():
        linear = [module for module in sac.actor.latent_pi if isinstance(module, th.nn.Linear)]
        for layer, source in zip(actor_layers(ours), [*linear, sac.actor.mu, sac.actor.log_std], strict=True):
            layer.weight.copy_(source.weight.T)
            layer.bias.copy_(source.bias)
        for critic, source_critic in ((ours.critic, sac.critic), (ours.critic_target, sac.critic_target)):
            for member, network in enumerate(source_critic.q_networks):
                sources = [module for module in network if isinstance(module, th.nn.Linear)]
                for layer, source in zip([*critic.trunk.layers, critic.head], sources, strict=True):
                    layer.weight[member].copy_(source.weight.T)
                    layer.bias[member].copy_(source.bias)
    batch = batch_of(ours)

    th.manual_seed(5)
    with th.no_grad():
        next_action, log_prob = sac.actor.action_log_prob(batch.next_observations)
        q = th.cat(sac.critic_target(batch.next_observations, next_action), dim=1).amin(dim=1)
        target = batch.rewards[:, 0] + (1 - batch.dones) * sac.gamma * (q - 0.1 * log_prob)
    sac_loss = 0.5 * sum(F.mse_loss(q[:, 0], target) for q in sac.critic(batch.observations, batch.actions))
    sac_gradients = th.autograd.grad(sac_loss, list(sac.critic.parameters()))
    th.manual_seed(5)
    loss, _ = ours._critic_loss(batch, ours.alpha)
    th.testing.assert_close(loss, 2 * sac_loss, rtol=1e-5, atol=1e-6)
    loss.backward()
    layers = [*ours.critic.trunk.layers, ours.critic.head]
    ours_flat = [
        tensor for member in (0, 1) for layer in layers for tensor in (layer.weight.grad[member].T, layer.bias.grad[member])
    ]
    for gradient, sac_gradient in zip(ours_flat, sac_gradients, strict=True):
        th.testing.assert_close(gradient, 2 * sac_gradient, rtol=1e-4, atol=1e-6)

    th.manual_seed(6)
    action, log_prob = sac.actor.action_log_prob(batch.observations)
    q = th.cat(sac.critic(batch.observations, action), dim=1).amin(dim=1)
    sac_loss = (0.1 * log_prob - q).mean()
    sac_gradients = th.autograd.grad(sac_loss, list(sac.actor.parameters()))
    th.manual_seed(6)
    loss, _, _ = ours._actor_loss(batch, ours.alpha)
    th.testing.assert_close(loss, sac_loss, rtol=1e-5, atol=1e-6)
    gradients = th.autograd.grad(loss, [p for layer in actor_layers(ours) for p in (layer.weight, layer.bias)])
    for gradient, sac_gradient in zip(gradients, sac_gradients, strict=True):
        th.testing.assert_close(gradient.T if gradient.dim() == 2 else gradient, sac_gradient, rtol=1e-4, atol=1e-6)
