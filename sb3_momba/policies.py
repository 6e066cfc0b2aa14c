"""Policies: actor, critic ensemble, target critics and running statistics in one module."""

from collections.abc import Callable
from copy import deepcopy
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import get_device
from torch import nn

from sb3_momba.envs.preferences import preference_dim
from sb3_momba.files import FileFormatError, FilePath, content_of, write_tree
from sb3_momba.formats import header, read_format
from sb3_momba.nn.flash_sac import FlashSacArchitecture
from sb3_momba.nn.layers import project_weights
from sb3_momba.nn.networks import Actor, Architecture, Critic, MlpArchitecture, SimbaArchitecture
from sb3_momba.nn.normalization import DeviationScale, ReturnScale, RunningStatistics
from sb3_momba.nn.values import DistributionalValue, ExpectedValue
from sb3_momba.nn.xqc import XqcArchitecture

POLICY_FORMAT = "sb3_momba.policy"
Self = TypeVar("Self", bound="MombaPolicy")


class MombaPolicy(BasePolicy):
    """What all policies share; a subclass chooses the architectures of actor and critic.

    `actor` and `critic` read normalised observations [(s - mean) / deviation, w]; `predict` and `normalize` take raw ones.

    :param observation_space: of [s, w], (observation_dim + preference_dim,)
    :param action_space: a bounded Box, (action_dim,)
    :param lr_schedule: learning rate as a function of the remaining progress, 1 at the start
    :param actor_architecture: builds the actor's layers
    :param critic_architecture: builds the layers of each critic
    :param n_objectives: injected by MOMBA, like the next five; see there
    :param critic_loss: "ce" or "mse"
    :param vector_values: critics of the vector return
    :param best_return_scale: what the largest return seen is scaled to
    :param return_scaling: "maximum" or "deviation"
    :param gamma: discount of the returns that are scaled
    :param n_critics: size of the ensemble
    :param n_atoms: atoms of a return distribution (critic_loss="ce")
    :param support: first and last atom, in scaled returns
    :param normalize_observations: by their running mean and deviation
    :param normalize_weights: unit-norm rows of the linear layers
    :param capql_log_prob: log pi as CAPQL's code has it: of the action within the environment's bounds, with 1e-6 inside
        the logarithm, clamped to [-1000, 1000]
    :param optimizer_class: of actor and critics, each with its own
    :param optimizer_kwargs: of its constructor, without the learning rate
    """

    action_space: spaces.Box
    arguments: dict[str, Any]  # of the constructor, from which `load` makes a policy again; a subclass adds its own

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        actor_architecture: Architecture,
        critic_architecture: Architecture,
        *,
        n_objectives: int = 1,
        critic_loss: str = "ce",
        vector_values: bool = False,
        best_return_scale: float | None = 3.0,
        return_scaling: str = "maximum",
        gamma: float = 0.99,
        n_critics: int = 2,
        n_atoms: int = 101,
        support: tuple[float, float] = (-5.0, 5.0),
        normalize_observations: bool = True,
        normalize_weights: bool = True,
        capql_log_prob: bool = False,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ):
        super().__init__(
            observation_space,
            action_space,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=True,
        )
        self.n_objectives = n_objectives
        self.preference_dim = preference_dim(n_objectives)
        self.observation_dim = int(observation_space.shape[0]) - self.preference_dim
        self.normalize_observations = normalize_observations
        self.normalize_weights = normalize_weights

        self.statistics = RunningStatistics(self.observation_dim)
        if return_scaling == "deviation" and best_return_scale is not None:
            self.return_scale: ReturnScale = DeviationScale(best_return_scale, gamma, n_objectives)
        else:
            self.return_scale = ReturnScale(best_return_scale, gamma)
        self.value = DistributionalValue(*support, n_atoms) if critic_loss == "ce" else ExpectedValue()
        action_dim = int(action_space.shape[0])
        half_width = th.as_tensor((action_space.high - action_space.low) / 2, dtype=th.float32)
        self.actor = Actor(
            actor_architecture, self.observation_dim, self.preference_dim, action_dim, half_width if capql_log_prob else None
        )
        self.critic = Critic(
            critic_architecture,
            self.observation_dim,
            self.preference_dim,
            action_dim,
            n_critics,
            n_values=n_objectives if vector_values else 1,
            n_atoms=self.value.n_outputs,
        )
        self.project_weights()
        self.critic_target = deepcopy(self.critic).requires_grad_(False)
        # Fused: one pass over the parameters instead of a dozen.
        fused = {"fused": True} if self.optimizer_class in (th.optim.Adam, th.optim.AdamW) else {}
        for network in (self.actor, self.critic):
            network.optimizer = self.optimizer_class(
                network.parameters(),
                lr=lr_schedule(1),  # type: ignore[call-arg]
                **{**fused, **self.optimizer_kwargs},
            )

    def normalize(self, observations: th.Tensor) -> th.Tensor:
        """[s, w] -> [(s - mean) / deviation, w], (batch, observation_dim + preference_dim); preferences stay as they are."""
        observations = observations.float()
        if not self.normalize_observations:
            return observations
        s, w = observations[:, : self.observation_dim], observations[:, self.observation_dim :]
        return th.cat([self.statistics(s), w], dim=-1)

    def project_weights(self) -> None:
        """Normalise the linear layers of actor and critics (Algorithm 1), unless weight normalisation is off."""
        if self.normalize_weights:
            project_weights(self.actor)
            project_weights(self.critic)

    @th.no_grad()
    def explore(self, observation: np.ndarray, noise: Callable[[th.Tensor], th.Tensor]) -> np.ndarray:
        """Actions on [-1, 1], (batch, action_dim), sampled with this standard normal noise.

        :param observation: raw [s, w], (batch, observation_dim + preference_dim)
        :param noise: of the shape of the mean that it is given
        """
        self.set_training_mode(False)
        mean, log_std = self.actor.distribution(self.normalize(th.as_tensor(observation, device=self.device)))
        return th.tanh(mean + log_std.exp() * noise(mean)).cpu().numpy()

    def set_training_mode(self, mode: bool) -> None:
        """SB3's, which acting and learning call in turn at every step; nn.Module's own way takes half as long as acting."""
        if mode != self.training:
            for module in self.modules():
                vars(module)["training"] = mode

    def save(self, path: FilePath) -> None:  # type: ignore[override]
        """Write the networks and their statistics into one file, exactly at `path`; the optimisers are the model's.

        :raises TypeError: names an argument that cannot be stored without pickle
        """
        spaces = {"observation_space": self.observation_space, "action_space": self.action_space}
        write_tree(
            path,
            {
                **header(POLICY_FORMAT),
                "policy": type(self).__name__,
                "arguments": {**spaces, **self.arguments},
                "state_dict": dict(self.state_dict()),
            },
        )

    @classmethod
    def load(cls: type[Self], path: FilePath, device: th.device | str = "auto") -> Self:  # type: ignore[override]
        """A policy from the file that `save` wrote: `predict` takes [observation, preference].

        :raises FileFormatError: if the file is damaged or no policy of this class
        """
        tree = read_format(path, POLICY_FORMAT)
        if tree.get("policy") != cls.__name__:
            raise FileFormatError(f"{path} holds a {tree.get('policy')}, not a {cls.__name__}: load it with that class.")
        with content_of(path):
            policy = cls(lr_schedule=cls._dummy_schedule, **tree["arguments"])
            policy.load_state_dict(tree["state_dict"])
        return policy.to(get_device(device))

    def forward(self, observation: th.Tensor, deterministic: bool = False) -> th.Tensor:
        """Actions on [-1, 1]: raw [s, w], (batch, observation_dim + preference_dim) -> (batch, action_dim).

        :param deterministic: the mean action instead of a sample
        """
        return self._predict(observation, deterministic)

    def _predict(self, observation: th.Tensor, deterministic: bool = False) -> th.Tensor:  # type: ignore[override]
        return self.actor(self.normalize(observation), deterministic)


class SimbaPolicy(MombaPolicy):
    """SimbaV2 actor and critics (Lee et al., 2025; section 3.3); the defaults are Table B.1's.

    `predict` takes [s, w], (batch, observation_dim + preference_dim), and gives actions, (batch, action_dim), in the
    environment's bounds.

    :param actor_hidden_dim: width of the actor's embedding
    :param actor_blocks: its hidden blocks
    :param critic_hidden_dim: width of a critic's embedding
    :param critic_blocks: its hidden blocks
    :param conditioning: "input", "all", "film" or "film+all" (section 4.3.4)
    :param normalize_features: hyperspherical normalisation of activations
    :param normalize_weights: unit-norm rows of the linear layers
    :param kwargs: see MombaPolicy
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        actor_hidden_dim: int = 128,
        actor_blocks: int = 2,
        critic_hidden_dim: int = 256,
        critic_blocks: int = 2,
        conditioning: str = "input",
        normalize_features: bool = True,
        normalize_weights: bool = True,
        **kwargs: Any,
    ):
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            SimbaArchitecture(actor_hidden_dim, actor_blocks, conditioning, normalize_features),
            SimbaArchitecture(critic_hidden_dim, critic_blocks, conditioning, normalize_features),
            normalize_weights=normalize_weights,
            **kwargs,
        )
        self.arguments = {
            "actor_hidden_dim": actor_hidden_dim,
            "actor_blocks": actor_blocks,
            "critic_hidden_dim": critic_hidden_dim,
            "critic_blocks": critic_blocks,
            "conditioning": conditioning,
            "normalize_features": normalize_features,
            "normalize_weights": normalize_weights,
            **kwargs,
        }


class MlpPolicy(MombaPolicy):
    """Dense networks, as SB3's SAC has them (Haarnoja et al., 2018; the MLP architecture of section 4.3).

    `predict` takes [s, w], (batch, observation_dim + preference_dim), and gives actions, (batch, action_dim), in the
    environment's bounds.

    :param net_arch: widths of the hidden layers, or `dict(pi=[...], qf=[...])` for actor and critics apart
    :param conditioning: "input", "all", "film" or "film+all" (section 4.3.4)
    :param ortho_init: orthogonal weights and zero biases at the start, as in CAPQL's code, instead of torch's own
    :param activation_fn: between the layers
    :param kwargs: see MombaPolicy
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        conditioning: str = "input",
        ortho_init: bool = False,
        activation_fn: type[nn.Module] = nn.ReLU,
        **kwargs: Any,
    ):
        if net_arch is None:
            net_arch = [256, 256]
        arch = net_arch if isinstance(net_arch, dict) else {"pi": net_arch, "qf": net_arch}
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            MlpArchitecture(arch["pi"], conditioning, ortho_init, activation_fn),
            MlpArchitecture(arch["qf"], conditioning, ortho_init, activation_fn),
            normalize_weights=False,
            **kwargs,
        )
        self.arguments = {
            "net_arch": net_arch,
            "conditioning": conditioning,
            "ortho_init": ortho_init,
            "activation_fn": activation_fn,
            **kwargs,
        }


class XqcPolicy(MombaPolicy):
    """XQC's actor and critics (Palenicek et al., 2025): dense layers of unit norm, batch norm before each ReLU.

    The sizes are those of the authors' code, and so are `critic_loss`, `n_atoms` and `support` by default. While training,
    (s, a) and (s', a') go through critics and target critics in one pass with common batch statistics. What the algorithm
    around them has otherwise, the configuration `xqc` says. Not theirs: observations are normalised by their running
    statistics too, which the input's batch norm undoes but for its eps, 1e-3, which then means the same in every unit.

    `predict` takes [s, w], (batch, observation_dim + preference_dim), and gives actions, (batch, action_dim), in the
    environment's bounds.

    :param actor_hidden_dim: width of the actor's layers
    :param actor_blocks: its hidden layers
    :param critic_hidden_dim: width of a critic's layers
    :param critic_blocks: its hidden layers
    :param conditioning: "input", "all", "film" or "film+all" (section 4.3.4)
    :param normalize_weights: unit-norm columns of the dense layers
    :param kwargs: see MombaPolicy
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        actor_hidden_dim: int = 256,
        actor_blocks: int = 4,
        critic_hidden_dim: int = 512,
        critic_blocks: int = 4,
        conditioning: str = "input",
        normalize_weights: bool = True,
        **kwargs: Any,
    ):
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            XqcArchitecture(actor_hidden_dim, actor_blocks, conditioning),
            XqcArchitecture(critic_hidden_dim, critic_blocks, conditioning),
            normalize_weights=normalize_weights,
            **kwargs,
        )
        self.arguments = {
            "actor_hidden_dim": actor_hidden_dim,
            "actor_blocks": actor_blocks,
            "critic_hidden_dim": critic_hidden_dim,
            "critic_blocks": critic_blocks,
            "conditioning": conditioning,
            "normalize_weights": normalize_weights,
            **kwargs,
        }


class FlashSacPolicy(MombaPolicy):
    """FlashSAC's actor and critics (Kim et al., 2026): inverted residual blocks with batch norm, unit-norm weights.

    The sizes are those of the authors' code, and so are `critic_loss`, `n_atoms` and `support` by default. While training,
    (s, a) and (s', a') go through critics and target critics in one pass with common batch statistics (the paper's cross-batch
    value prediction). What the algorithm around them has otherwise, the configuration `flashsac` says. Not theirs: the actor's
    statistics come from s alone instead of s and s'; running variances divide by n, not n - 1; observations are normalised by
    their running statistics too, which the input's batch norm undoes but for its eps.

    `predict` takes [s, w], (batch, observation_dim + preference_dim), and gives actions, (batch, action_dim), in the
    environment's bounds.

    :param actor_hidden_dim: width of the actor's embedding
    :param actor_blocks: its inverted residual blocks
    :param critic_hidden_dim: width of a critic's embedding
    :param critic_blocks: its inverted residual blocks
    :param conditioning: "input", "all", "film" or "film+all" (section 4.3.4)
    :param normalize_weights: unit-norm columns of the dense layers, gains and shifts of a fixed norm
    :param kwargs: see MombaPolicy
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        actor_hidden_dim: int = 128,
        actor_blocks: int = 2,
        critic_hidden_dim: int = 256,
        critic_blocks: int = 2,
        conditioning: str = "input",
        normalize_weights: bool = True,
        **kwargs: Any,
    ):
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            FlashSacArchitecture(actor_hidden_dim, actor_blocks, conditioning),
            FlashSacArchitecture(critic_hidden_dim, critic_blocks, conditioning),
            normalize_weights=normalize_weights,
            **kwargs,
        )
        self.arguments = {
            "actor_hidden_dim": actor_hidden_dim,
            "actor_blocks": actor_blocks,
            "critic_hidden_dim": critic_hidden_dim,
            "critic_blocks": critic_blocks,
            "conditioning": conditioning,
            "normalize_weights": normalize_weights,
            **kwargs,
        }
