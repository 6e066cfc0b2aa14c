"""Every equation of the algorithm against numbers worked out by hand and slow loops written from the text of the thesis.

Networks are replaced by stubs with known outputs, so that an expected loss or target is a line of arithmetic.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

from sb3_momba import MOMBA, PreferenceReplayBuffer
from sb3_momba.buffers import PreferenceReplayBufferSamples
from sb3_momba.envs.making import wrap_env
from sb3_momba.envs.preferences import FixedSampler
from sb3_momba.nn.distributional import cross_entropy, expectation, make_support, project
from sb3_momba.nn.normalization import ReturnScale, RunningStatistics

properties = settings(max_examples=60, deadline=None, derandomize=True, database=None)
seeds = st.integers(0, 2**32 - 1)

VARIANTS = [("ce", False), ("ce", True), ("mse", False), ("mse", True)]  # critic_loss, vector_values


class CountingEnv(gym.Env):
    """Observes [step of the episode, episode]; transition t of episode e earns (t + 1, 10 e + t, e - t)."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(
        self,
        n_objectives: int = 2,
        length: int = 3,
        terminated: bool = True,
        truncated: bool = False,
        first_episode: int = 0,
    ):
        self.reward_space = spaces.Box(-np.inf, np.inf, (n_objectives,))
        self.length, self.end = length, (terminated, truncated)
        self.episode, self.t = first_episode - 1, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        self.episode, self.t = self.episode + 1, 0
        return np.array([self.t, self.episode], dtype=np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool, bool, dict]:
        reward = counted_reward(self.episode, self.t)[: self.reward_space.shape[0]]
        self.t += 1
        ends = self.end if self.t == self.length else (False, False)
        return np.array([self.t, self.episode], dtype=np.float32), reward, *ends, {}


def counted_reward(episode: int, t: int) -> np.ndarray:
    return np.array([t + 1, 10 * episode + t, episode - t], dtype=np.float32)


def make_model(env: gym.Env | DummyVecEnv | None = None, policy: str = "MlpPolicy", **kwargs: Any) -> MOMBA:
    """A tiny MOMBA that only collects: learning starts after everything that these tests let it do."""
    small = {"net_arch": [4]} if policy == "MlpPolicy" else {"actor_hidden_dim": 4, "critic_hidden_dim": 8}
    kwargs["policy_kwargs"] = {**small, **kwargs.get("policy_kwargs", {})}
    defaults = {"buffer_size": 1000, "learning_starts": 10**6, "best_return_scale": None, "seed": 0, "device": "cpu"}
    model = MOMBA(policy, CountingEnv() if env is None else env, **{**defaults, **kwargs})
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def make_batch(rewards: Any, preferences: Any, dones: Any = None, discounts: Any = 0.5) -> PreferenceReplayBufferSamples:
    """Transitions with observations that no two have in common. Rewards and preferences are (batch, n_objectives)."""
    rewards = th.as_tensor(rewards, dtype=th.float32)
    preferences = th.as_tensor(preferences, dtype=th.float32).expand_as(rewards)
    n = len(rewards)
    numbers = th.arange(2 * n, dtype=th.float32).view(n, 2)
    return PreferenceReplayBufferSamples(
        observations=th.cat([numbers, preferences], dim=1),
        actions=th.full((n, 2), 0.25),
        next_observations=th.cat([-1 - numbers, preferences], dim=1),
        dones=th.zeros(n) if dones is None else th.as_tensor(dones, dtype=th.float32),
        rewards=rewards,
        discounts=th.as_tensor(discounts, dtype=th.float32).expand(n),
        preferences=preferences,
    )


class StubCritic(th.nn.Module):
    """Stands for a critic ensemble: `outputs(observations, actions)` is (batch, n_critics, n_values, n_outputs), whatever is
    beside them."""

    def __init__(self, outputs: Callable[[th.Tensor, th.Tensor], th.Tensor]):
        super().__init__()
        self.outputs = outputs

    def forward(self, observations: th.Tensor, actions: th.Tensor, *beside: th.Tensor) -> th.Tensor:
        return self.outputs(observations, actions)

    def values_and_features(
        self, observations: th.Tensor, actions: th.Tensor, *beside: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        return self.outputs(observations, actions), th.cat([observations, actions], dim=-1)


def only_for(outputs: th.Tensor, observations: th.Tensor, actions: th.Tensor) -> StubCritic:
    """A critic that answers `outputs`, and only if it is asked about these observations and actions."""

    def answer(asked_observations: th.Tensor, asked_actions: th.Tensor) -> th.Tensor:
        assert th.equal(asked_observations, observations)
        assert th.equal(asked_actions, actions)
        return outputs

    return StubCritic(answer)


def stub_policy(model: MOMBA, observations: th.Tensor, actions: th.Tensor, log_prob: th.Tensor) -> None:
    """The policy that takes `actions`, asked about `observations` only."""

    def action_log_prob(asked: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        assert th.equal(asked, observations)
        return actions, log_prob

    model.actor.action_log_prob = action_log_prob


def critic_loss(
    model: MOMBA,
    batch: PreferenceReplayBufferSamples,
    next_outputs: th.Tensor,
    outputs: th.Tensor | None = None,
    log_prob: th.Tensor | None = None,
    alpha: float = 0.0,
) -> tuple[float, th.Tensor]:
    """MOMBA's loss, and the target that it trains every critic towards, (batch, n_values, n_outputs)."""
    n = len(batch.rewards)
    next_actions = th.full((n, 2), -0.5)
    stub_policy(model, batch.next_observations, next_actions, th.zeros(n) if log_prob is None else log_prob)
    model.critic_target = only_for(next_outputs, batch.next_observations, next_actions)
    model.critic = only_for(th.zeros_like(next_outputs) if outputs is None else outputs, batch.observations, batch.actions)
    targets = []
    value = model.policy.value
    loss_of = type(value).loss
    value.loss = lambda outputs, target: targets.append(target) or loss_of(value, outputs, target)
    loss, _ = model._critic_loss(batch, th.tensor(alpha))
    return loss.item(), targets[0].squeeze(1)


def logits_of(probabilities: Any) -> th.Tensor:
    return th.as_tensor(probabilities, dtype=th.float32).clamp_min(1e-30).log()


def softmax(logits: np.ndarray) -> np.ndarray:
    exponentials = np.exp(logits - logits.max())
    return exponentials / exponentials.sum()


def phi(mass: Any, atoms: Any, support: Any) -> np.ndarray:
    """Eq. (3.7), sum by sum."""
    mass, atoms, support = (np.asarray(x, dtype=np.float64) for x in (mass, atoms, support))
    dz = (support[-1] - support[0]) / (len(support) - 1)
    projected = np.zeros(len(support))
    for i, z in enumerate(support):
        for j, y in enumerate(atoms):
            clipped = min(max(y, support[0]), support[-1])
            projected[i] += mass[j] * max(1 - abs(clipped - z) / dz, 0)
    return projected


# ------------------------------------------------------------------------------------- distributions (section 3.2)


def test_support() -> None:
    """Eq. (3.5), with Table B.1's 101 atoms on [-5, 5] as the default."""
    support = make_support(-5, 5, 101)
    assert len(support) == 101
    assert support[[0, 3, 50, 100]].tolist() == pytest.approx([-5, -4.7, 0, 5], abs=1e-6)
    assert th.equal(make_model().policy.value.support, support)


def test_expectation() -> None:
    """Eq. (3.6)."""
    assert expectation(th.tensor([[0.25, 0.5, 0.25]]), th.tensor([-1.0, 0.0, 3.0])).tolist() == [0.5]


@pytest.mark.parametrize(
    ("target", "entropy"),
    [
        ([0.25, 0.75], 0.25 * np.log(4) + 0.75 * np.log(4 / 3)),
        ([1.0, 0.0], np.log(4)),
        ([0.0, 1.0], np.log(4 / 3)),
    ],
)
def test_cross_entropy(target: list[float], entropy: float) -> None:
    """Eq. (3.8) with Z = softmax((0, log 3)) = (1/4, 3/4); a certain target tells H(target, Z) from H(Z, target)."""
    logits = th.tensor([0.0, np.log(3)])
    assert cross_entropy(th.tensor(target), logits).item() == pytest.approx(entropy)


@pytest.mark.parametrize(
    ("support", "atoms", "mass", "expected"),
    [
        pytest.param([0, 1, 2], [0.25, 0.25, 0.25], [1, 0, 0], [0.75, 0.25, 0], id="by nearness"),
        pytest.param([0, 1, 2], [-1, 0.5, 1.75], [0.2, 0.4, 0.4], [0.4, 0.3, 0.3], id="several atoms meet"),
        pytest.param([0, 1, 2], [2, 1, 0], [0.1, 0.2, 0.7], [0.7, 0.2, 0.1], id="on atoms"),
        pytest.param([0, 1, 2], [-7, 1, 9], [0.3, 0, 0.7], [0.3, 0, 0.7], id="past both ends"),
        pytest.param([0, 1, 2], [1.5, 1.5, 1.5], [0.2, 0.3, 0.5], [0, 0.5, 0.5], id="all atoms in one place"),
        pytest.param([0, 1, 2], [2, 2, 2], [0.2, 0.3, 0.5], [0, 0, 1], id="all on the last atom"),
        pytest.param([-1, 3], [0, 9], [0.5, 0.5], [0.375, 0.625], id="two atoms"),
    ],
)
def test_projection(support: list[float], atoms: list[float], mass: list[float], expected: list[float]) -> None:
    projected = project(th.tensor([mass]).float(), th.tensor([atoms]).float(), th.tensor(support).float())
    assert projected[0].tolist() == pytest.approx(expected, abs=1e-6)


def test_projection_leaves_a_distribution_on_the_support_as_it_is() -> None:
    """Rounding must not push the mass of any of the 101 atoms to a neighbour."""
    support = make_support(-5, 5, 101)
    th.testing.assert_close(project(th.eye(101), support, support), th.eye(101), rtol=0, atol=2e-5)


@properties
@given(seed=seeds, n_atoms=st.integers(2, 30), width=st.floats(0.5, 20), reach=st.floats(0.1, 5))
def test_projection_is_eq_3_7(seed: int, n_atoms: int, width: float, reach: float) -> None:
    rng = np.random.default_rng(seed)
    support = make_support(-width / 2, width, n_atoms)
    mass, atoms = rng.dirichlet(np.ones(n_atoms)), rng.uniform(-reach * width, reach * width, n_atoms)
    projected = project(th.tensor(mass).float(), th.tensor(atoms).float(), support).numpy()
    np.testing.assert_allclose(projected, phi(mass, atoms, support), atol=2e-5)
    assert (projected >= 0).all()
    assert projected.sum() == pytest.approx(1, abs=1e-5)


@properties
@given(seed=seeds, n_atoms=st.integers(2, 30), start=st.floats(-10, 10), width=st.floats(0.5, 20))
def test_projection_keeps_the_mean_inside_the_support(seed: int, n_atoms: int, start: float, width: float) -> None:
    rng = np.random.default_rng(seed)
    support = make_support(start, start + width, n_atoms)
    mass, atoms = rng.dirichlet(np.ones(n_atoms)), rng.uniform(start, start + width, n_atoms)
    projected = project(th.tensor(mass).float(), th.tensor(atoms).float(), support)
    assert expectation(projected, support).item() == pytest.approx(mass @ atoms, abs=1e-4)


# ------------------------------------------------------------------------------------------- critic loss and targets


def target_model(loss: str, vector: bool, n_objectives: int = 2, **kwargs: Any) -> MOMBA:
    """Critics on the atoms 0, 1, 2, 3, 4."""
    return make_model(
        CountingEnv(n_objectives),
        critic_loss=loss,
        vector_values=vector,
        policy_kwargs={"n_atoms": 5, "support": (0.0, 4.0)},
        **kwargs,
    )


def certain(values: list[float], loss: str) -> th.Tensor:
    """Outputs of two critics of one transition that both expect exactly `values`, (1, 2, n_values, n_outputs)."""
    values = th.tensor(values)
    outputs = logits_of(values[:, None] == th.arange(5)) if loss == "ce" else values[:, None]
    return outputs.expand(1, 2, -1, -1)


@pytest.mark.parametrize(
    ("loss", "vector", "done", "expected"),
    [
        # w.r = 1/4 * 3 + 3/4 * 1 = 1.5; 1.5 + 1/2 (2 + 1/2) = 2.75, three quarters of the way from atom 2 to atom 3.
        ("ce", False, 0, [[0, 0, 0.25, 0.75, 0]]),
        ("ce", False, 1, [[0, 0.5, 0.5, 0, 0]]),
        ("mse", False, 0, [[2.75]]),
        ("mse", False, 1, [[1.5]]),
        # 3 + 1/2 (0 + 1/2) = 3.25 and 1 + 1/2 (2 + 1/2) = 2.25: the entropy enters every component.
        ("ce", True, 0, [[0, 0, 0, 0.75, 0.25], [0, 0, 0.75, 0.25, 0]]),
        ("ce", True, 1, [[0, 0, 0, 1, 0], [0, 1, 0, 0, 0]]),
        ("mse", True, 0, [[3.25], [2.25]]),
        ("mse", True, 1, [[3], [1]]),
    ],
)
def test_target(loss: str, vector: bool, done: int, expected: list[list[float]]) -> None:
    """Eqs. (3.3), (3.11) and (3.14) and section 3.4.2 with r = (3, 1), w = (1/4, 3/4), gamma = 1/2, and an entropy term
    -alpha log pi = -1/4 * -2 = 1/2."""
    _, target = critic_loss(
        target_model(loss, vector),
        make_batch([[3, 1]], [0.25, 0.75], dones=[done], discounts=0.5),
        next_outputs=certain([0.0, 2.0] if vector else [2.0], loss),
        log_prob=th.tensor([-2.0]),
        alpha=0.25,
    )
    np.testing.assert_allclose(target[0], expected, atol=1e-6)


def test_the_lower_projected_target_is_chosen() -> None:
    """Atoms 0, 1, 2 shifted by 1 are clipped to 1, 2, 2. The first critic expects 2 of them before the projection and 1.5
    after it; the second 1.9 and 1.8."""
    model = make_model(policy_kwargs={"n_atoms": 3, "support": (0.0, 2.0)})
    batch = make_batch([[1, 1]], [0.5, 0.5], discounts=1.0)
    critics = logits_of([[[[0.5, 0.0, 0.5]], [[0.2, 0.7, 0.1]]]])
    for next_outputs in (critics, critics.flip(1)):
        _, target = critic_loss(model, batch, next_outputs)
        assert target[0, 0].tolist() == pytest.approx([0, 0.5, 0.5])


@pytest.mark.parametrize("loss", ["ce", "mse"])
@pytest.mark.parametrize(
    ("preference", "expected"),
    [
        # The critics expect (1, 4) and (2, 1). Objective by objective the lowest would be (1, 1), which is neither.
        ([0.9, 0.1], [1, 4]),  # 1.3 < 1.9
        ([0.1, 0.9], [2, 1]),  # 3.7 > 1.1
    ],
)
def test_of_vector_critics_one_is_chosen_as_a_whole(loss: str, preference: list[float], expected: list[int]) -> None:
    next_outputs = th.cat([certain([1.0, 4.0], loss)[:, :1], certain([2.0, 1.0], loss)[:, :1]], dim=1)
    model = target_model(loss, vector=True)
    _, target = critic_loss(model, make_batch([[0, 0]], preference, discounts=1.0), next_outputs)
    assert model.policy.value.target_mean(target)[0].tolist() == pytest.approx(expected)


def slow_critic_loss(
    loss: str,
    vector: bool,
    alpha: float,
    log_prob: np.ndarray,
    support: np.ndarray,
    next_outputs: np.ndarray,
    outputs: np.ndarray,
    rewards: np.ndarray,
    preferences: np.ndarray,
    dones: np.ndarray,
    discounts: np.ndarray,
) -> float:
    """Section 3.4.2's critic loss, transition by transition and critic by critic; eqs. (3.2), (3.3), (3.10) to (3.17)."""
    total = 0.0
    n, n_critics, n_values, _ = outputs.shape
    for b in range(n):
        w, reward = preferences[b], rewards[b] if vector else [preferences[b] @ rewards[b]]
        targets, worths = [], []
        for c in range(n_critics):
            parts, means = [], []
            for k in range(n_values):
                after = discounts[b] * (1 - dones[b])
                if loss == "ce":
                    atoms = [reward[k] + after * (z - alpha * log_prob[b]) for z in support]
                    part = phi(softmax(next_outputs[b, c, k]), atoms, support)
                    mean = part @ support
                else:
                    part = mean = reward[k] + after * (next_outputs[b, c, k, 0] - alpha * log_prob[b])
                parts.append(part)
                means.append(mean)
            targets.append(parts)
            worths.append(w @ means if vector else means[0])
        target = targets[int(np.argmin(worths))]
        for c in range(n_critics):
            for k in range(n_values):
                if loss == "ce":
                    total -= sum(target[k] * np.log(softmax(outputs[b, c, k])))
                else:
                    total += (target[k] - outputs[b, c, k, 0]) ** 2
    return total / n


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n_critics", [1, 2, 3])
@pytest.mark.parametrize(("loss", "vector"), VARIANTS)
def test_critic_loss_is_the_slow_loop(loss: str, vector: bool, n_critics: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = target_model(loss, vector, n_objectives=3)
    shape = (6, n_critics, 3 if vector else 1, 5 if loss == "ce" else 1)
    arrays = {
        "rewards": rng.normal(size=(6, 3)),
        "preferences": rng.dirichlet(np.ones(3), size=6),
        "dones": np.array([0, 1, 0, 0, 1, 0]),
        "discounts": rng.uniform(0.5, 1, size=6),
    }
    next_outputs, outputs = rng.normal(1, 2, size=shape), rng.normal(1, 2, size=shape)
    log_prob = rng.normal(size=6)
    actual, _ = critic_loss(
        model,
        make_batch(**arrays),
        th.tensor(next_outputs).float(),
        th.tensor(outputs).float(),
        th.tensor(log_prob).float(),
        alpha=0.7,
    )
    expected = slow_critic_loss(loss, vector, 0.7, log_prob, np.arange(5), next_outputs, outputs, **arrays)
    assert actual == pytest.approx(expected, rel=1e-5)


# --------------------------------------------------------------------------------------------------------- actor loss


def actor_loss(
    model: MOMBA,
    batch: PreferenceReplayBufferSamples,
    outputs: th.Tensor,
    log_prob: th.Tensor,
    alpha: float,
) -> th.Tensor:
    actions = th.full((len(batch.rewards), 2), -0.5)
    stub_policy(model, batch.observations, actions, log_prob)
    model.critic = only_for(outputs, batch.observations, actions)
    model.critic_target = None
    return model._actor_loss(batch, th.tensor(alpha))[0]


def test_actor_loss_by_hand() -> None:
    """Eq. (3.18). The critics expect (3, 1) in the first state and (0, 4) in the second: the minima are 1 and 0, the
    entropy terms 1/2 * 2 and 1/2 * -4. Loss: ((-1 + 1) + (0 - 2)) / 2 = -1."""
    log_prob = th.tensor([2.0, -4.0], requires_grad=True)
    q = th.tensor([[3.0, 1.0], [0.0, 4.0]], requires_grad=True)
    model = make_model(critic_loss="mse")
    loss = actor_loss(model, make_batch([[9, 9], [9, 9]], [0.5, 0.5], dones=[0, 1]), q[:, :, None, None], log_prob, alpha=0.5)
    loss.backward()
    assert loss.item() == -1
    assert q.grad.tolist() == [[0, -0.5], [-0.5, 0]]
    assert log_prob.grad.tolist() == [0.25, 0.25]


W_34 = th.tensor([3 / 7, 4 / 7])  # its length is 5/7


def test_preference_alignment_by_hand() -> None:
    """Eq. (3.21) with w = (3, 4) / 7. Q = (3, 4) lies along w: w.Q cos = 25/7 * 1. Q = (10, 0) is worth more, 30/7, but its
    cosine is 3/5: 18/7, the lower one. In units of w / |w| = u, the product is 5/7 (u.Q)^2 / |Q|, with the gradient
    5/7 (2 (u.Q) u / |Q| - (u.Q)^2 Q / |Q|^3) = 5/7 (12 (0.6, 0.8) / 10 - 36 (10, 0) / 1000) = 5/7 (0.36, 0.96)."""
    q = th.tensor([[[3.0, 4.0], [10.0, 0.0]]], requires_grad=True)
    log_prob = th.tensor([-3.0], requires_grad=True)
    model = make_model(critic_loss="mse", vector_values=True, preference_alignment=True)
    loss = actor_loss(model, make_batch([[0, 0]], W_34), q[..., None], log_prob, alpha=0.25)
    loss.backward()
    assert loss.item() == pytest.approx(-18 / 7 - 0.75)
    np.testing.assert_allclose(q.grad[0], [[0, 0], [-5 / 7 * 0.36, -5 / 7 * 0.96]], atol=1e-6)
    assert log_prob.grad.tolist() == [0.25]


def test_alignment_makes_a_gain_of_a_loss_unless_it_is_asked_not_to() -> None:
    """Q = -(3, 4) is worth -25/7, and lies opposite to w: the cosine is -1, and eq. (3.21) has +25/7."""
    for alignment, worth in ((True, 25 / 7), ("positive", -25 / 7)):
        q = th.tensor([[[-3.0, -4.0]]], requires_grad=True)
        model = make_model(critic_loss="mse", vector_values=True, preference_alignment=alignment)
        loss = actor_loss(model, make_batch([[0, 0]], W_34), q[..., None], th.tensor([0.0]), alpha=0.0)
        loss.backward()
        assert loss.item() == pytest.approx(-worth)
        assert bool((q.grad < 0).all()) == (alignment == "positive")  # a step against the gradient makes Q larger


def test_without_alignment_the_lower_scalarised_value_counts() -> None:
    q = th.tensor([[[3.0, 4.0], [10.0, 0.0]]])
    model = make_model(critic_loss="mse", vector_values=True)
    loss = actor_loss(model, make_batch([[0, 0]], W_34), q[..., None], th.tensor([-3.0]), alpha=0.25)
    assert loss.item() == pytest.approx(-25 / 7 - 0.75)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("loss", "vector", "alignment"),
    [
        *((loss, vector, False) for loss, vector in VARIANTS),
        *((loss, True, how) for loss in ("ce", "mse") for how in (True, "positive")),
    ],
)
def test_actor_loss_is_the_slow_loop(loss: str, vector: bool, alignment: bool | str, seed: int) -> None:
    """Eqs. (3.18) and (3.21), with Q by eqs. (3.12), (3.15) and (3.16)."""
    rng = np.random.default_rng(seed)
    model = target_model(loss, vector, n_objectives=3, preference_alignment=alignment)
    outputs = rng.normal(1, 2, size=(6, 2, 3 if vector else 1, 5 if loss == "ce" else 1))
    preferences, log_prob = rng.dirichlet(np.ones(3), size=6), rng.normal(size=6)
    batch = make_batch(np.zeros((6, 3)), preferences)
    actual = actor_loss(model, batch, th.tensor(outputs).float(), th.tensor(log_prob).float(), alpha=0.7).item()

    expected = 0.0
    for b, w in enumerate(preferences):
        worths = []
        for critic in outputs[b]:
            q = np.array([softmax(x) @ np.arange(5) if loss == "ce" else x[0] for x in critic])
            worth = w @ q if vector else q[0]
            if alignment is True or (alignment == "positive" and worth > 0):
                worth *= (w @ q) / np.linalg.norm(w) / np.linalg.norm(q)
            worths.append(worth)
        expected += (-min(worths) + 0.7 * log_prob[b]) / 6
    assert actual == pytest.approx(expected, rel=1e-5)


@properties
@given(seed=seeds, order=st.permutations(range(3)), variant=st.sampled_from([*VARIANTS, ("ce", True, True)]))
def test_the_order_of_objectives_does_not_matter(seed: int, order: list[int], variant: tuple) -> None:
    """Permuting objectives, with their preferences and their critics' outputs, permutes the targets of vector critics; all
    losses, and the targets of scalarised critics, stay as they are."""
    loss, vector, *alignment = variant
    rng = np.random.default_rng(seed)
    model = target_model(loss, vector, n_objectives=3, preference_alignment=bool(alignment))
    shape = (4, 2, 3 if vector else 1, 5 if loss == "ce" else 1)
    next_outputs, outputs = (th.tensor(rng.normal(1, 2, size=shape)).float() for _ in range(2))
    rewards, preferences = rng.normal(size=(4, 3)), rng.dirichlet(np.ones(3), size=4)
    log_prob = th.tensor(rng.normal(size=4)).float()

    def losses(order: list[int]) -> tuple[float, float, th.Tensor]:
        batch = make_batch(rewards[:, order], preferences[:, order])
        value_order = order if vector else [0]
        of_critic, target = critic_loss(
            model, batch, next_outputs[:, :, value_order], outputs[:, :, value_order], log_prob, 0.7
        )
        return of_critic, actor_loss(model, batch, outputs[:, :, value_order], log_prob, 0.7).item(), target

    critic_before, actor_before, target_before = losses([0, 1, 2])
    critic_after, actor_after, target_after = losses(order)
    assert critic_after == pytest.approx(critic_before, rel=1e-4)
    assert actor_after == pytest.approx(actor_before, rel=1e-4, abs=1e-5)
    th.testing.assert_close(target_after, target_before[:, order] if vector else target_before, rtol=1e-4, atol=1e-5)


# ------------------------------------------------------------------------------ what CAPQL's code does otherwise


def test_capql_takes_the_minimum_of_each_objective_and_the_mean_of_the_losses() -> None:
    """Critics that expect (1, 4) and (2, 1) have the target (1, 1), with which outputs of 0 and 2 have a squared error of 1
    each: 4 in sum, 1 in the mean. The actor maximises w.(1, 1) = 1, though the critics' w.Q are 1.3 and 1.9."""
    model = target_model("mse", vector=True, critic_minimum="objective", critic_loss_reduction="mean")
    batch = make_batch([[0, 0]], [0.9, 0.1], discounts=1.0)
    q = th.tensor([[[1.0, 4.0], [2.0, 1.0]]])[..., None]
    loss, target = critic_loss(model, batch, next_outputs=q, outputs=th.tensor([[[0.0, 2.0], [2.0, 0.0]]])[..., None])
    assert target.flatten().tolist() == [1, 1]
    assert loss == 1
    assert actor_loss(model, batch, q, th.tensor([0.0]), alpha=0.2).item() == pytest.approx(-1)


def test_capql_log_prob_is_that_of_the_unscaled_action() -> None:
    """log N(x; m, s) - log(scale (1 - tanh(x)^2) + 1e-6), where actions reach from -1 to 3 and from 0 to 1."""
    env = CountingEnv()
    env.action_space = spaces.Box(np.array([-1, 0], dtype=np.float32), np.array([3, 1], dtype=np.float32))
    actor = make_model(env, policy_kwargs={"capql_log_prob": True}).actor.double()
    observations = th.rand(32, 4, dtype=th.float64)
    actions, log_prob = actor.action_log_prob(observations)
    mean, log_std = actor.distribution(observations)
    gaussian = Normal(mean, log_std.exp()).log_prob(actions.atanh())
    jacobian = th.tensor([2.0, 0.5]) * (1 - actions**2) + 1e-6
    th.testing.assert_close(log_prob, (gaussian - jacobian.log()).sum(dim=1), rtol=1e-5, atol=1e-5)


# ---------------------------------------------------------------------------------------------------------- entropy


def test_alpha_loss_by_hand() -> None:
    """Eq. (3.19) with alpha = 0.2 and, for two actions, H_target = -2: -0.2 ((1 - 2) + (4 - 2)) / 2 = -0.1, and as alpha is
    exp(beta), the derivative in beta is the same number."""
    model = make_model(ent_coef="auto_0.2")
    loss = model._alpha_loss(th.tensor([1.0, 4.0]))
    loss.backward()
    assert model.alpha.item() == pytest.approx(0.2)
    assert loss.item() == pytest.approx(-0.1)
    assert model.log_ent_coef.grad.item() == pytest.approx(-0.1)


@pytest.mark.parametrize(("log_prob", "factor"), [(3.0, np.exp(0.01)), (1.0, np.exp(-0.01))])
def test_alpha_rises_where_the_policy_is_too_certain(log_prob: float, factor: float) -> None:
    """An entropy of -3 is below the target of -2, one of -1 above it. Adam's first step in beta is the learning rate."""
    model = make_model(ent_coef="auto_0.2", learning_rate=0.01)
    model.learn(5)
    sample = model.actor.action_log_prob
    model.actor.action_log_prob = lambda x: (sample(x)[0], sample(x)[1] * 0 + log_prob)
    model.train(gradient_steps=1, batch_size=4)
    assert model.alpha.item() == pytest.approx(0.2 * factor, rel=1e-5)


@pytest.mark.parametrize("mean", [-6.0, 0.0, 6.0])
@pytest.mark.parametrize("policy", ["SimbaPolicy", "MlpPolicy"])
def test_log_prob_is_that_of_a_gaussian_squashed_by_tanh(policy: str, mean: float) -> None:
    """On [-1, 1], the last term of a change of variables included; float64, so that tanh can be undone."""
    actor = make_model(policy=policy).actor.double()
    with th.no_grad():
        actor.mean_head.bias.fill_(mean)
        actor.log_std_head.bias.copy_(th.tensor([-0.5, 0.5]))
    observations = th.rand(32, 4, dtype=th.float64)
    actions, log_prob = actor.action_log_prob(observations)
    mean, log_std = actor.distribution(observations)
    reference = Independent(TransformedDistribution(Normal(mean, log_std.exp()), TanhTransform()), 1)
    assert log_prob.shape == (32,)
    th.testing.assert_close(log_prob, reference.log_prob(actions), rtol=1e-4, atol=1e-4)
    assert not th.equal(actions, actor.action_log_prob(observations)[0])


def test_log_prob_stays_finite_where_tanh_saturates() -> None:
    """log(1 - tanh(x)^2) = log 4 - 2 x for large x. With x = 50 and the smallest log standard deviation, -10, the rest of
    each action's log density is that of the noise, -(1 + log(2 pi)) / 2 on average, plus 10."""
    actor = make_model(policy="SimbaPolicy").actor
    with th.no_grad():
        actor.mean_head.bias.fill_(50.0)
        actor.log_std_head.bias.fill_(-100.0)
    observations = th.rand(1000, 4)
    mean, _ = actor.distribution(observations)
    actions, log_prob = actor.action_log_prob(observations)
    log_prob.sum().backward()
    assert (actions == 1).all()
    expected = (2 * mean - np.log(4)).sum(dim=1).mean().item() + 2 * (10 - (1 + np.log(2 * np.pi)) / 2)
    assert log_prob.mean().item() == pytest.approx(expected, abs=0.15)
    assert all(p.grad.isfinite().all() for p in actor.parameters())


# ------------------------------------------------------------------------------------------- normalisation statistics


@pytest.mark.parametrize("chunks", [[1] * 20, [20], [1, 7, 2, 10]])
def test_running_statistics_are_numpys(chunks: list[int]) -> None:
    """The offset of 1e5 would cost a sum of squares in float32 every digit of the variance."""
    data = np.random.default_rng(0).normal([0, 1e5, -3], [1, 0.5, 20], size=(20, 3))
    statistics = RunningStatistics(3)
    for start, stop in pairwise(np.cumsum([0, *chunks])):
        statistics.update(data[start:stop])
    np.testing.assert_allclose(statistics.mean, data.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(statistics.variance, data.var(axis=0), rtol=1e-9)
    offset_free = np.delete(data, 1, axis=1)
    normalised = np.delete(statistics(th.tensor(data).float()).numpy(), 1, axis=1)
    np.testing.assert_allclose(normalised, (offset_free - offset_free.mean(0)) / offset_free.std(0), atol=1e-5)


def test_before_the_second_observation_only_the_mean_is_subtracted() -> None:
    statistics = RunningStatistics(2)
    observation = th.tensor([[3.0, -1.0]])
    assert th.equal(statistics(observation), observation)
    statistics.update(np.array([[2.0, 2.0]]))
    assert statistics(observation).tolist() == [[1, -3]]


def sampled_twice(model: MOMBA, batch_size: int) -> tuple[PreferenceReplayBufferSamples, PreferenceReplayBufferSamples]:
    """The same minibatch, raw and as the update sees it."""
    minibatches = []
    for sample in (model.replay_buffer.sample, model._sample):
        model.replay_buffer.rng = np.random.default_rng(7)
        minibatches.append(sample(batch_size))
    return minibatches[0], minibatches[1]


def test_minibatches_are_normalised_with_the_statistics_of_all_states_so_far() -> None:
    """8 steps in episodes of 3 visit the steps 0, 1, 2 of episodes 0, 1 and 0, 1 of episode 2. A last state is no s_t."""
    model = make_model()
    model.learn(8)
    visited = np.array([[t, e] for e, length in enumerate([3, 3, 2]) for t in range(length)])
    raw, batch = sampled_twice(model, 64)
    for before, after in ((raw.observations, batch.observations), (raw.next_observations, batch.next_observations)):
        expected = (before[:, :2].numpy() - visited.mean(axis=0)) / visited.std(axis=0)
        np.testing.assert_allclose(after[:, :2], expected, atol=1e-5)
        assert th.equal(after[:, 2:], raw.preferences)
    assert th.equal(batch.preferences, raw.preferences)


def test_acting_leaves_the_statistics_alone() -> None:
    model = make_model()
    model.learn(8)
    model.predict(np.array([100.0, 100.0]), preference=[0.5, 0.5])
    assert model.policy.statistics.count.item() == 8
    assert model.policy.statistics.mean.tolist() == pytest.approx([7 / 8, 7 / 8])


def test_return_scale_by_hand() -> None:
    """G <- G / 2 + r in two environments with two objectives; 3 / the largest |G| so far."""
    scale = ReturnScale(best_return_scale=3.0, gamma=0.5)
    steps = [
        # rewards, dones, largest |G| so far
        ([[1, -4], [0, 0]], [0, 0], 4.0),
        ([[1, -4], [2, 0]], [1, 0], 6.0),  # G = (1.5, -6): the last reward of an episode counts
        ([[1, -4], [2, 0]], [0, 0], 6.0),  # the new episode starts at (1, -4); without a reset it would be at (1.75, -7)
        ([[0, 0], [10, 0]], [0, 0], 11.5),  # the other environment goes on: 2, 3, 11.5
        ([[0, 0], [0, 0]], [0, 0], 11.5),
    ]
    assert scale.factor() == 1
    for rewards, dones, largest in steps:
        scale.update(np.array(rewards), np.array(dones))
        assert scale.factor() == pytest.approx(3 / largest)


@pytest.mark.parametrize(("reward", "factor"), [(0.0, 1.0), (9e-9, 1.0), (1e-7, 3e7)])
def test_return_scale_is_1_while_returns_are_below_1e_8(reward: float, factor: float) -> None:
    scale = ReturnScale(best_return_scale=3.0, gamma=0.5)
    scale.update(np.array([[reward, -reward]]), np.array([1]))
    assert scale.factor() == pytest.approx(factor)


@pytest.mark.parametrize(("best_return_scale", "factor"), [(3.0, 3 / 20), (None, 1.0)])
def test_minibatch_rewards_are_scaled_by_the_best_return(best_return_scale: float | None, factor: float) -> None:
    """With gamma = 1/2, the second objective of episode 1 returns 10, 10/2 + 11 = 16 and 16/2 + 12 = 20: the most so far."""
    model = make_model(gamma=0.5, best_return_scale=best_return_scale)
    model.learn(6)
    raw, batch = sampled_twice(model, 32)
    assert raw.rewards.max() == 12
    np.testing.assert_allclose(batch.rewards, raw.rewards * factor, rtol=1e-6)


def test_a_new_call_of_learn_starts_a_new_return() -> None:
    """`learn` resets the environment: the rewards 1, 2 of episode 0 and 1, 2 of episode 1 return 2.5 each in the first
    objective; the second objective of episode 1 returns 10 and then 10/2 + 11 = 16, not 16.25."""
    model = make_model(CountingEnv(length=100), gamma=0.5, best_return_scale=3.0)
    model.learn(2)
    model.learn(2)
    assert model.policy.reward_factor == pytest.approx(3 / 16)


# ------------------------------------------------------------------------------------------------------ replay buffer


class NumberedSampler:
    """The k-th draw is (k, 1024 - k) / 1024, one draw per step."""

    per_step = True

    def __init__(self, first: int):
        self.next = first

    def __call__(self, rng: np.random.Generator) -> np.ndarray:
        self.next += 1
        return np.array([self.next - 1, 1025 - self.next]) / 1024


def test_s_and_next_s_carry_the_preference_that_the_action_saw() -> None:
    """Eqs. (3.3) and (3.11). An episode of 3 steps draws 4 preferences, one at its start and one after each step."""
    starts = {0: 0, 50: 512}  # first episode of each environment: its first draw
    envs = [
        lambda episode=episode, draw=draw: wrap_env(CountingEnv(first_episode=episode), NumberedSampler(draw))
        for episode, draw in starts.items()
    ]
    model = make_model(DummyVecEnv(envs))
    model.learn(20)
    batch = model.replay_buffer.sample(300)
    seen = set()
    for i in range(300):
        t, episode = (int(x) for x in batch.observations[i, :2])
        first = 50 if episode >= 50 else 0
        number = starts[first] + 4 * (episode - first) + t
        preference = [number / 1024, (1024 - number) / 1024]
        assert batch.preferences[i].tolist() == preference
        assert batch.observations[i].tolist() == [t, episode, *preference]
        assert batch.next_observations[i].tolist() == [t + 1, episode, *preference]
        assert batch.rewards[i].tolist() == counted_reward(episode, t)[:2].tolist()
        seen.add((t, episode))
    assert len(seen) == 20


@pytest.mark.parametrize(("terminated", "truncated", "bootstraps"), [(False, True, 1), (True, True, 0), (True, False, 0)])
@pytest.mark.parametrize("n_steps", [1, 2])
def test_truncation_bootstraps_and_termination_does_not(
    n_steps: int, terminated: bool, truncated: bool, bootstraps: int
) -> None:
    """Q(s') = 10 * step of s', which is 30 in the last state and 0 in the first one of the next episode.

    With w = (1/4, 3/4), w.r = t + 1/4; gamma = 1/2, and the entropy term is 1/2.
    """
    env = CountingEnv(terminated=terminated, truncated=truncated)
    sampler = FixedSampler((0.25, 0.75))
    model = make_model(env, critic_loss="mse", gamma=0.5, n_steps=n_steps, preference_sampler=sampler)
    model.learn(3)
    batch = model.replay_buffer.sample(50)
    next_outputs = (10 * batch.next_observations[:, :1])[:, None, None].expand(-1, 2, -1, -1)
    _, target = critic_loss(model, batch, next_outputs, log_prob=th.full((50,), -1.0), alpha=0.5)
    last = 2.25 + bootstraps * 0.5 * 30.5
    if n_steps == 1:
        expected = [0.25 + 0.5 * 10.5, 1.25 + 0.5 * 20.5, last]
    else:
        expected = [0.25 + 0.5 * 1.25 + 0.25 * 20.5, 1.25 + 0.5 * last, last]
    steps = batch.observations[:, 0].long().tolist()
    assert set(steps) == {0, 1, 2}
    assert target.flatten().tolist() == [expected[t] for t in steps]


def empty_buffer(size: int, n_objectives: int, n_envs: int = 1, **kwargs: Any) -> PreferenceReplayBuffer:
    observation_space = spaces.Box(-np.inf, np.inf, (2 + n_objectives,))
    action_space = spaces.Box(-1, 1, (1,))
    return PreferenceReplayBuffer(
        size, observation_space, action_space, "cpu", n_envs, n_objectives=n_objectives, seed=0, **kwargs
    )


@properties
@given(
    seed=seeds,
    n_steps=st.integers(1, 4),
    n_envs=st.integers(1, 3),
    capacity=st.integers(2, 8),
    n_stored=st.integers(1, 20),
    end_rate=st.sampled_from([0.0, 0.3, 1.0]),
)
def test_n_step_returns_are_the_slow_loop(
    seed: int, n_steps: int, n_envs: int, capacity: int, n_stored: int, end_rate: float
) -> None:
    """A return ends with the episode, or with the newest transition, and bootstraps from where it ends unless that is
    terminal. Rewards are whole numbers and gamma = 1/2: the sums are exact."""
    rng = np.random.default_rng(seed)
    buffer = empty_buffer(capacity * n_envs, 2, n_envs, gamma=0.5, n_steps=n_steps)
    rewards = rng.integers(-9, 10, size=(n_stored, n_envs, 2)).astype(np.float32)
    dones = rng.random((n_stored, n_envs)) < end_rate
    truncated = dones & (rng.random((n_stored, n_envs)) < 0.5)
    preferences = np.full((n_envs, 2), 0.5)
    for t in range(n_stored):
        now = np.stack([np.full(n_envs, t), np.arange(n_envs)], axis=1)
        later = now + np.array([0.5, 0])  # s' of t is not s of t + 1, as after a reset
        buffer.add(
            np.concatenate([now, preferences], axis=1),
            np.concatenate([later, preferences], axis=1),
            np.zeros((n_envs, 1)),
            np.zeros(n_envs),
            dones[t],
            [{"vector_reward": rewards[t, e], "TimeLimit.truncated": truncated[t, e]} for e in range(n_envs)],
        )

    batch = buffer.sample(400)
    seen = set()
    for i in range(400):
        start, env = (int(x) for x in batch.observations[i, :2])
        seen.add((start, env))
        total, discount = np.zeros(2), 1.0
        for t in range(start, min(start + n_steps, n_stored)):
            total += discount * rewards[t, env]
            discount /= 2
            if dones[t, env]:
                break
        assert batch.rewards[i].tolist() == total.tolist()
        assert batch.discounts[i].item() == discount
        assert batch.next_observations[i].tolist() == [t + 0.5, env, 0.5, 0.5]
        assert batch.dones[i].item() == (dones[t, env] and not truncated[t, env])
    assert seen == {(t, e) for t in range(max(0, n_stored - capacity), n_stored) for e in range(n_envs)}


def test_n_step_returns_end_where_learn_resets_the_environment() -> None:
    """A second call of `learn` begins an episode. The one before is cut off, which does not make its state terminal."""
    model = make_model(CountingEnv(length=100), n_steps=3)
    model.learn(5)
    model.learn(5)
    batch = model.replay_buffer.sample(200)
    assert set(batch.observations[:, 1].tolist()) == {0, 1}
    assert th.equal(batch.observations[:, 1], batch.next_observations[:, 1])
    assert (batch.dones == 0).all()


# ------------------------------------------------------------------------------------------- hindsight relabelling


def relabelled(model: MOMBA, preference: list[float]) -> np.ndarray:
    """20,000 samples' preferences, where all have been earned with one."""
    model.learn(20)
    batch = model.replay_buffer.sample(20_000)
    assert th.equal(batch.observations[:, 2:], batch.preferences)
    assert th.equal(batch.next_observations[:, 2:], batch.preferences)
    preferences = batch.preferences.numpy()
    np.testing.assert_allclose(preferences.sum(axis=1), 1, atol=1e-6)
    assert (preferences >= 0).all()
    np.testing.assert_allclose(model.replay_buffer.preferences[:20, 0], np.tile(preference, (20, 1)), atol=1e-7)
    return preferences


@pytest.mark.parametrize(
    ("her_kwargs", "keep", "concentration"),
    [(None, 0.2, 5), ({"keep_probability": 0.0, "concentration": 20.0}, 0.0, 20), ({"keep_probability": 0.7}, 0.7, 5)],
)
def test_hindsight(her_kwargs: dict[str, float] | None, keep: float, concentration: float) -> None:
    """Eq. (3.20), p_keep = 0.2 and k = 5 by default. Dirichlet(k w) has the mean w and, in each component, the variance
    w (1 - w) / (k + 1). Tolerances are four standard errors and more."""
    w = [0.25, 0.75]
    model = make_model(her=True, her_kwargs=her_kwargs, preference_sampler=FixedSampler((0.25, 0.75)))
    preferences = relabelled(model, w)
    kept = (preferences == w).all(axis=1)
    assert kept.mean() == pytest.approx(keep, abs=0.015)
    new = preferences[~kept]
    assert new[:, 0].mean() == pytest.approx(0.25, abs=0.01)
    assert new[:, 0].var() == pytest.approx(0.25 * 0.75 / (concentration + 1), rel=0.08)


def test_without_hindsight_preferences_stay() -> None:
    model = make_model(preference_sampler=FixedSampler((0.25, 0.75)))
    assert (relabelled(model, [0.25, 0.75]) == [0.25, 0.75]).all()


@pytest.mark.parametrize("w", [[1, 0, 0], [0, 0.5, 0.5], [0, 0, 1]])
def test_hindsight_in_corners_and_on_edges(w: list[float]) -> None:
    """Dirichlet has no parameter 0: a weight of 0 stays next to 0."""
    model = make_model(
        CountingEnv(3), her=True, her_kwargs={"keep_probability": 0.0}, preference_sampler=FixedSampler(tuple(w))
    )
    preferences = relabelled(model, w)
    np.testing.assert_allclose(preferences.mean(axis=0), w, atol=0.01)
    assert len(np.unique(preferences, axis=0)) > 1


# ------------------------------------------------------------------------------------------------- one gradient step


def snapshot(network: th.nn.Module) -> dict[str, th.Tensor]:
    return {name: parameter.detach().clone() for name, parameter in network.named_parameters()}


def assert_same(actual: dict[str, th.Tensor], expected: dict[str, th.Tensor]) -> None:
    for name in expected:
        th.testing.assert_close(actual[name], expected[name], rtol=0, atol=1e-6, msg=name)


def unit_rows(parameters: dict[str, th.Tensor]) -> dict[str, th.Tensor]:
    """Section 3.3's weight normalisation: linear layers only, scalers and biases stay."""
    return {name: p / p.norm(dim=-2, keepdim=True) if name.endswith("weight") else p for name, p in parameters.items()}


def test_one_gradient_step_is_algorithm_1() -> None:
    """Critic, actor, alpha, weight normalisation, target, in this order, each moving its own parameters only. The learning
    rate is large enough to tell projected weights from others."""
    model = make_model(policy="SimbaPolicy", learning_rate=0.05, tau=0.25, ent_coef="auto_0.2")
    model.learn(10)
    policy = model.policy
    networks = {"critic": model.critic, "actor": model.actor, "target": model.critic_target}
    history: list[tuple[str, dict[str, dict[str, th.Tensor]], float]] = []

    def recorded(event: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            result = function(*args, **kwargs)
            history.append((event, {name: snapshot(network) for name, network in networks.items()}, model.alpha.item()))
            return result

        return call

    model._sample = recorded("sample", model._sample)
    for event, optimizer in (
        ("critic", model.critic.optimizer),
        ("actor", model.actor.optimizer),
        ("alpha", model.ent_coef_optimizer),
    ):
        optimizer.step = recorded(event, optimizer.step)
    policy.project_weights = recorded("project", policy.project_weights)

    model.train(gradient_steps=1, batch_size=16)

    assert [event for event, _, _ in history] == ["sample", "critic", "actor", "alpha", "project"]
    start, critic, actor, alpha, project = (state for _, state, _ in history)
    end = {name: snapshot(network) for name, network in networks.items()}
    alphas = [number for _, _, number in history]

    assert_same(critic["actor"], start["actor"])
    assert all(not th.equal(critic["critic"][name], start["critic"][name]) for name in start["critic"])
    assert_same(actor["critic"], critic["critic"])
    assert all(not th.equal(actor["actor"][name], start["actor"][name]) for name in start["actor"])
    assert alphas[0] == alphas[1] == alphas[2] != alphas[3]
    for name in ("actor", "critic"):
        assert_same(alpha[name], actor[name])
        assert_same(project[name], unit_rows(alpha[name]))
        assert_same(end[name], project[name])
    assert_same(project["target"], start["target"])
    assert_same(end["target"], {k: 0.75 * start["target"][k] + 0.25 * end["critic"][k] for k in end["critic"]})


def test_targets_start_as_copies_of_projected_critics() -> None:
    model = make_model(policy="SimbaPolicy")
    critic = snapshot(model.critic)
    assert_same(critic, unit_rows(critic))
    assert_same(snapshot(model.critic_target), critic)
    assert_same(snapshot(model.actor), unit_rows(snapshot(model.actor)))


@pytest.mark.parametrize("policy", ["SimbaPolicy", "MlpPolicy"])
def test_the_critics_of_an_ensemble_start_apart(policy: str) -> None:
    """Clipped double Q-learning has nothing to choose between two equal critics."""
    for name, (first, second) in snapshot(make_model(policy=policy).critic).items():
        if name.endswith("weight"):
            assert not th.isclose(first, second).any(), name


def test_scalers_start_as_in_simbav2() -> None:
    """With h = 8 units: sqrt(2 / h) = 1/2 in the embedder, half of it in a block, 1 in the head. A block mixes 1 / (2 + 1) of
    x_ffn into x by a parameter that starts at 1 / sqrt(h)."""
    critic = make_model(policy="SimbaPolicy").critic
    starts = {"trunk.embedder.scaler.scaler": 0.5, "head.scaler.scaler": 1.0, "head.bias": 0.0}
    for block in (0, 1):
        starts |= {f"trunk.blocks.{block}.scaler.scaler": 0.25, f"trunk.blocks.{block}.lerp.scaler": 8**-0.5}
    parameters = snapshot(critic)
    assert starts.keys() == {name for name in parameters if not name.endswith("weight")}
    for name, start in starts.items():
        th.testing.assert_close(parameters[name], th.full_like(parameters[name], start))
    assert critic.trunk.blocks[0].lerp(th.ones(1, 8)).flatten().tolist() == pytest.approx([1 / 3] * 16)


def test_the_actor_step_follows_the_actor_loss() -> None:
    """The step's gradient is that of eq. (3.18) with the critics of the moment: nothing of the critic loss is left in it,
    and the critics keep the gradients of their own loss."""
    model = make_model(learning_rate=0.0, ent_coef=0.3)
    model.learn(10)
    batch = model._sample(16)
    model._sample = lambda batch_size: batch
    th.manual_seed(3)
    critic_gradients = th.autograd.grad(model._critic_loss(batch, model.alpha)[0], list(model.critic.parameters()))
    actor_gradients = th.autograd.grad(model._actor_loss(batch, model.alpha)[0], list(model.actor.parameters()))

    th.manual_seed(3)
    model.train(gradient_steps=1, batch_size=16)

    for network, gradients in ((model.critic, critic_gradients), (model.actor, actor_gradients)):
        for parameter, gradient in zip(network.parameters(), gradients, strict=True):
            th.testing.assert_close(parameter.grad, gradient)
    assert all(parameter.grad is None for parameter in model.critic_target.parameters())


@pytest.mark.parametrize("nth_loss", [1, 2], ids=["critic loss", "actor loss"])
def test_a_loss_that_is_not_a_number_changes_nothing_of_its_network(nth_loss: int) -> None:
    """Nor is there half an update: critics that have taken their step are projected, and their targets follow."""
    model = make_model(policy="SimbaPolicy", learning_rate=0.05)
    model.learn(10)
    sample, calls = model.actor.action_log_prob, []

    def action_log_prob(observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        calls.append(observations)
        actions, log_prob = sample(observations)
        return actions, log_prob * (th.nan if len(calls) == nth_loss else 1)

    model.actor.action_log_prob = action_log_prob
    before, old_target, beta = snapshot(model.policy), snapshot(model.critic_target), model.log_ent_coef.item()
    model.train(gradient_steps=1, batch_size=16)
    assert len(calls) == nth_loss
    assert model.log_ent_coef.item() == beta
    assert_same(snapshot(model.actor), {name[6:]: p for name, p in before.items() if name.startswith("actor.")})
    if nth_loss == 1:
        assert_same(snapshot(model.policy), before)
        return
    for name, parameter in model.critic.named_parameters():
        target = dict(model.critic_target.named_parameters())[name]
        th.testing.assert_close(target, old_target[name] + model.tau * (parameter - old_target[name]))
        if "dense" in name:
            th.testing.assert_close(parameter.norm(dim=-2), th.ones_like(parameter[..., 0, :]))
