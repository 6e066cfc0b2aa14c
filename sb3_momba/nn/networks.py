"""Preference-conditioned actor and critic ensemble on a trunk: SimbaV2's and the dense one are here.

A trunk turns (batch, inputs) into features (batch, trunk.features_dim), or (n_members, batch, features_dim) in an
ensemble. The preference is part of its input; `conditioning` (section 4.3.4) says where it comes in besides:

- "input": nowhere else
- "all": appended to the input of every hidden block
- "film": a FiLM layer at the end of every hidden block
- "film+all": both
"""

from typing import Any, NoReturn, Protocol

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_momba.nn.layers import (
    Film,
    HyperEmbedder,
    HyperHead,
    HyperLerpBlock,
    Linear,
    identity,
    in_float32,
    l2_normalize,
    orthogonal_,
)
from sb3_momba.nn.speed import compilable

CONDITIONINGS = ("input", "all", "film", "film+all")

SIMBA_LOG_STD_MIN, SIMBA_LOG_STD_MAX = -10.0, 2.0
SAC_LOG_STD_MIN, SAC_LOG_STD_MAX = -20.0, 2.0
CAPQL_EPS, CAPQL_LARGEST = 1e-6, 1e3
LOG_2 = 0.6931471805599453
HALF_LOG_2PI = 0.9189385332046727


class Architecture(Protocol):
    """What an actor or a critic is built from: one trunk, one kind of head, one range of log standard deviations."""

    def trunk(self, input_dim: int, preference_dim: int, n_members: int | None) -> "Trunk": ...

    def head(self, features_dim: int, output_dim: int, n_members: int | None) -> nn.Module: ...

    def log_std(self, raw: th.Tensor) -> th.Tensor: ...


class Trunk(nn.Module):
    """The common part of all trunks: where the preference enters.

    `shares_batches`: rows of a batch see each other while training, so that what is compared goes through together.
    """

    features_dim: int
    shares_batches = False

    def __init__(self, preference_dim: int, conditioning: str):
        super().__init__()
        if conditioning not in CONDITIONINGS:
            raise ValueError(f"conditioning={conditioning!r} is not known: use one of {', '.join(CONDITIONINGS)}.")
        if preference_dim == 0 and conditioning != "input":
            raise ValueError(f"conditioning={conditioning!r}: with one objective there is no preference to condition on.")
        self.appended_dim = preference_dim if "all" in conditioning else 0
        self.film_dim = preference_dim if "film" in conditioning else 0

    def append(self, x: th.Tensor, preference: th.Tensor) -> th.Tensor:
        """A block's input: x, with the preference behind it where `conditioning` says so."""
        if self.appended_dim == 0:
            return x
        return th.cat([x, preference.expand(*x.shape[:-1], -1)], dim=-1)


class SimbaTrunk(Trunk):
    """SimbaV2's embedder and hidden blocks (section 3.3). FiLM ends a block: l2((1 + g(w)) * x + b(w))."""

    def __init__(
        self,
        input_dim: int,
        preference_dim: int,
        hidden_dim: int,
        n_blocks: int,
        conditioning: str = "input",
        normalize_features: bool = True,
        n_members: int | None = None,
    ):
        super().__init__(preference_dim, conditioning)
        self.features_dim = hidden_dim
        self.normalize = l2_normalize if normalize_features else identity
        self.embedder = HyperEmbedder(input_dim, hidden_dim, self.normalize, n_members)
        self.blocks = nn.ModuleList(
            HyperLerpBlock(hidden_dim + self.appended_dim, hidden_dim, n_blocks, self.normalize, n_members)
            for _ in range(n_blocks)
        )
        self.films = nn.ModuleList(Film(preference_dim, hidden_dim, n_members) for _ in range(n_blocks) if self.film_dim > 0)

    def forward(self, x: th.Tensor, preference: th.Tensor) -> th.Tensor:
        x = self.embedder(x)
        for i, block in enumerate(self.blocks):
            x = block(x, self.append(x, preference))
            if self.film_dim > 0:
                x = self.normalize(self.films[i](x, preference))
        return x


class MlpTrunk(Trunk):
    """Dense layers, by default with ReLU, as in SB3's SAC; a layer is a block."""

    def __init__(
        self,
        input_dim: int,
        preference_dim: int,
        net_arch: list[int],
        conditioning: str = "input",
        activation_fn: type[nn.Module] = nn.ReLU,
        n_members: int | None = None,
    ):
        super().__init__(preference_dim, conditioning)
        self.activation = activation_fn()
        self.features_dim = net_arch[-1] if net_arch else input_dim
        # The first layer reads the preference anyway, as part of the input.
        widths = [input_dim, *(width + self.appended_dim for width in net_arch)]
        self.layers = nn.ModuleList(Linear(*shape, n_members) for shape in zip(widths, net_arch, strict=False))
        self.films = nn.ModuleList(Film(preference_dim, width, n_members) for width in net_arch if self.film_dim > 0)

    def forward(self, x: th.Tensor, preference: th.Tensor) -> th.Tensor:
        for i, layer in enumerate(self.layers):
            x = self.activation(layer(x if i == 0 else self.append(x, preference)))
            if self.film_dim > 0:
                x = self.films[i](x, preference)
        return x


class SimbaArchitecture:
    """SimbaV2: unit-norm layers, hyperspherical features, log std in [-10, 2] by a tanh.

    :param hidden_dim: width h of the embedding; a block is 4h wide inside
    :param n_blocks: number of hidden blocks
    """

    def __init__(self, hidden_dim: int, n_blocks: int, conditioning: str, normalize_features: bool):
        self.hidden_dim, self.n_blocks = hidden_dim, n_blocks
        self.conditioning, self.normalize_features = conditioning, normalize_features

    def trunk(self, input_dim: int, preference_dim: int, n_members: int | None) -> Trunk:
        return SimbaTrunk(
            input_dim, preference_dim, self.hidden_dim, self.n_blocks, self.conditioning, self.normalize_features, n_members
        )

    def head(self, features_dim: int, output_dim: int, n_members: int | None) -> nn.Module:
        return HyperHead(features_dim, output_dim, n_members)

    def log_std(self, raw: th.Tensor) -> th.Tensor:
        return squash_log_std(raw)


class MlpArchitecture:
    """SB3 SAC's networks: dense layers, by default with ReLU, linear heads, log std clamped to [-20, 2]."""

    def __init__(self, net_arch: list[int], conditioning: str, ortho_init: bool, activation_fn: type[nn.Module] = nn.ReLU):
        self.net_arch, self.conditioning = net_arch, conditioning
        self.ortho_init, self.activation_fn = ortho_init, activation_fn

    def trunk(self, input_dim: int, preference_dim: int, n_members: int | None) -> Trunk:
        trunk = MlpTrunk(input_dim, preference_dim, self.net_arch, self.conditioning, self.activation_fn, n_members)
        if self.ortho_init:
            for layer in trunk.layers:
                orthogonal_(layer)
        return trunk

    def head(self, features_dim: int, output_dim: int, n_members: int | None) -> nn.Module:
        head = Linear(features_dim, output_dim, n_members)
        return orthogonal_(head) if self.ortho_init else head

    def log_std(self, raw: th.Tensor) -> th.Tensor:
        return th.clamp(raw, SAC_LOG_STD_MIN, SAC_LOG_STD_MAX)


def squash_log_std(raw: th.Tensor) -> th.Tensor:
    """-10 + 6 (1 + tanh(.)): SimbaV2's, in [-10, 2]."""
    return SIMBA_LOG_STD_MIN + 0.5 * (SIMBA_LOG_STD_MAX - SIMBA_LOG_STD_MIN) * (1 + th.tanh(raw))


class Actor(nn.Module):
    """pi(a | s, w): a Gaussian squashed by tanh onto [-1, 1].

    Observations are [normalised s, w], shape (batch, observation_dim + preference_dim).

    :param action_scale: half the width of the action's bounds, (action_dim,), for log pi as CAPQL's code has it
    """

    optimizer: th.optim.Optimizer
    action_scale: th.Tensor | None
    compiled = False

    def __init__(
        self,
        architecture: Architecture,
        observation_dim: int,
        preference_dim: int,
        action_dim: int,
        action_scale: th.Tensor | None = None,
    ):
        super().__init__()
        self.register_buffer("action_scale", action_scale)
        self.observation_dim = observation_dim
        self.trunk = architecture.trunk(observation_dim + preference_dim, preference_dim, None)
        self.mean_head = architecture.head(self.trunk.features_dim, action_dim, None)
        self.log_std_head = architecture.head(self.trunk.features_dim, action_dim, None)
        self.squash_log_std = architecture.log_std

    @compilable
    def distribution(self, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Mean and log standard deviation before tanh, each (batch, action_dim)."""
        features = self.trunk(observations, observations[:, self.observation_dim :])
        return in_float32(self.mean_head(features)), self.squash_log_std(in_float32(self.log_std_head(features)))

    def forward(self, observations: th.Tensor, deterministic: bool = False) -> th.Tensor:
        """Actions on [-1, 1], (batch, action_dim)."""
        mean, log_std = self.distribution(observations)
        return th.tanh(mean if deterministic else mean + log_std.exp() * th.randn_like(mean))

    def predict(self, *_: Any, **__: Any) -> NoReturn:
        """SAC's actor predicts and is saved alone; this one does not know the observation statistics, the policy does."""
        raise NotImplementedError("The actor reads normalised observations: use policy.predict, policy.save and policy.load.")

    save = load = predict

    def action_log_prob(self, observations: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Sampled actions (batch, action_dim) and log pi(a | s, w) (batch,), the density on [-1, 1]."""
        mean, log_std = self.distribution(observations)
        noise = th.randn_like(mean)
        gaussian = mean + log_std.exp() * noise
        actions = th.tanh(gaussian)
        log_prob = -0.5 * noise.square() - log_std - HALF_LOG_2PI
        if self.action_scale is not None:
            log_jacobian = th.log(self.action_scale * (1 - actions.square()) + CAPQL_EPS)
            return actions, (log_prob - log_jacobian).sum(dim=-1).clamp(-CAPQL_LARGEST, CAPQL_LARGEST)
        # log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2x)), which stays finite where tanh saturates.
        log_jacobian = 2 * (LOG_2 - gaussian - F.softplus(-2 * gaussian))
        return actions, (log_prob - log_jacobian).sum(dim=-1)


class Critic(nn.Module):
    """An ensemble of critics Z_1..Z_n as one batched module.

    Observations are [normalised s, w], (batch, observation_dim + preference_dim); actions are on [-1, 1].

    :param n_values: how many returns are predicted: 1 (scalarised, section 3.2.1) or n_objectives (vector, 3.2.2)
    :param n_atoms: outputs per return: atoms of a distribution, or 1 for an expected value
    """

    optimizer: th.optim.Optimizer
    compiled = False

    def __init__(
        self,
        architecture: Architecture,
        observation_dim: int,
        preference_dim: int,
        action_dim: int,
        n_critics: int,
        n_values: int,
        n_atoms: int,
    ):
        super().__init__()
        self.observation_dim = observation_dim
        self.shape = (n_values, n_atoms)
        self.trunk = architecture.trunk(observation_dim + preference_dim + action_dim, preference_dim, n_critics)
        self.head = architecture.head(self.trunk.features_dim, n_values * n_atoms, n_critics)

    @compilable
    def values_and_features(
        self, observations: th.Tensor, actions: th.Tensor, *beside: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Logits, or expected values where n_atoms is 1, (batch, n_critics, n_values, n_atoms); and what the trunk made of
        state, preference and action, (n_critics, batch, features_dim).

        :param beside: observations and actions that join the batch whose statistics batch norm takes; without batch norm they
            are not even looked at
        """
        n = len(actions)
        joint = self.trunk.shares_batches and len(beside) > 0
        if joint:
            observations, actions = th.cat([observations, beside[0]]), th.cat([actions, beside[1]])
        features = self.trunk(th.cat([observations, actions], dim=-1), observations[:, self.observation_dim :])
        if joint:
            features = features[:, :n]
        return in_float32(self.head(features).unflatten(-1, self.shape).transpose(0, 1)), features

    def forward(self, observations: th.Tensor, actions: th.Tensor, *beside: th.Tensor) -> th.Tensor:
        """Logits, or expected values where n_atoms is 1: (batch, n_critics, n_values, n_atoms)."""
        return self.values_and_features(observations, actions, *beside)[0]
