"""MombaPolicy: actor, critic ensemble, target critics and running statistics in one module."""

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import get_device

from sb3_momba.envs.preferences import check_preference, preference_dim
from sb3_momba.files import FileFormatError, FilePath, content_of, write_tree
from sb3_momba.finite import all_finite
from sb3_momba.formats import header, read_format
from sb3_momba.nn.layers import project_weights
from sb3_momba.nn.networks import Actor, Architecture, Critic
from sb3_momba.nn.normalization import DeviationScale, ReturnScale, RewardCenter, RunningStatistics
from sb3_momba.nn.values import DistributionalValue, ExpectedValue, ValueRepresentation

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
    :param n_objectives: injected by MOMBA, like the next seven; see there
    :param critic_loss: "ce" or "mse"
    :param vector_values: critics of the vector return
    :param best_return_scale: what the largest return seen is scaled to
    :param return_scaling: "maximum" or "deviation"
    :param reward_centering: whether critics learn by how much returns exceed what the mean reward is worth
    :param gamma: discount of the returns that are scaled, and of what the mean reward is worth
    :param deterministic_policy: the policy is its mean action (TD3), whether asked for a sample or not
    :param n_critics: size of the ensemble
    :param n_atoms: atoms of a return distribution (critic_loss="ce")
    :param support: first and last atom, in scaled returns
    :param normalize_observations: by their running mean and deviation
    :param normalize_weights: unit-norm rows of the linear layers, and what else an architecture keeps on a sphere
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
        reward_centering: bool = False,
        gamma: float = 0.99,
        deterministic_policy: bool = False,
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
        self.vector_values = vector_values
        self.deterministic_policy = deterministic_policy
        self.normalize_observations = normalize_observations
        self.normalize_weights = normalize_weights

        self.statistics = RunningStatistics(self.observation_dim)
        self.reward_center = RewardCenter(n_objectives, gamma) if reward_centering else None
        if return_scaling == "deviation" and best_return_scale is not None:
            self.return_scale: ReturnScale = DeviationScale(best_return_scale, gamma, n_objectives)
        else:
            self.return_scale = ReturnScale(best_return_scale, gamma)
        self.value: ValueRepresentation = DistributionalValue(*support, n_atoms) if critic_loss == "ce" else ExpectedValue()
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
        self.set_training_mode(False)  # Only `train` turns it on.

    def normalize(self, observations: th.Tensor) -> th.Tensor:
        """[s, w] -> [(s - mean) / deviation, w], (batch, observation_dim + preference_dim); preferences stay as they are."""
        observations = observations.float()
        if not self.normalize_observations:
            return observations
        s, w = observations[:, : self.observation_dim], observations[:, self.observation_dim :]
        return th.cat([self.statistics(s), w], dim=-1)

    def center(self, rewards: th.Tensor, discounts: th.Tensor) -> th.Tensor:
        """What critics learn from, (batch, n_objectives), not scaled yet: see RewardCenter."""
        return rewards if self.reward_center is None else self.reward_center(rewards, discounts)

    def observe_rewards(self, rewards: np.ndarray, dones: np.ndarray) -> None:
        """Update the statistics of rewards and their returns with one step.

        :param rewards: (n_envs, n_objectives)
        :param dones: where it ended an episode, (n_envs,)
        """
        if self.reward_center is not None:
            self.reward_center.statistics.update(rewards)
            rewards = rewards - self.reward_center.statistics.mean.cpu().numpy()
        self.return_scale.update(rewards, dones)

    @property
    def reward_factor(self) -> float:
        """What a reward is multiplied by before critics learn from it. With centring, what follows an end is worth -V."""
        lacking = 0.0 if self.reward_center is None else float(self.reward_center.value.abs().max())
        return self.return_scale.factor(lacking)

    def in_reward_units(self, values: np.ndarray, preferences: np.ndarray) -> np.ndarray:
        """Values as critics have them in the units of the rewards: no longer scaled, nor lacking the V of RewardCenter.

        :param values: (n, n_objectives), or (n, 1) of critics of the scalarised return
        :param preferences: w, (n, n_objectives)
        :return: of the shape of the values
        """
        values = values / self.reward_factor
        if self.reward_center is None:
            return values
        lacking = self.reward_center.value.cpu().numpy()
        return values + (lacking if self.vector_values else (preferences @ lacking)[:, None])

    def project_weights(self) -> None:
        """Normalise the linear layers of actor and critics (Algorithm 1), unless weight normalisation is off."""
        if self.normalize_weights:
            project_weights(self.actor)
            project_weights(self.critic)

    @th.no_grad()
    def reset_networks(self) -> None:
        """New weights for actor, critics and targets, and optimisers that remember nothing; the statistics stay."""
        new = type(self)(lr_schedule=self._dummy_schedule, **self._all_arguments).to(self.device)
        for name in ("actor", "critic", "critic_target"):
            getattr(self, name).load_state_dict(getattr(new, name).state_dict())
        for network in (self.actor, self.critic):
            network.optimizer.state.clear()

    @th.no_grad()
    def explore(self, observation: np.ndarray, noise: Callable[[th.Tensor], th.Tensor]) -> np.ndarray:
        """Actions on [-1, 1], (batch, action_dim), sampled with this standard normal noise.

        :param observation: raw [s, w], (batch, observation_dim + preference_dim)
        :param noise: of the shape of the mean that it is given
        """
        self.set_training_mode(False)
        mean, log_std = self.actor.distribution(self.normalize(th.as_tensor(observation, device=self.device)))
        return th.tanh(mean + log_std.exp() * noise(mean)).cpu().numpy()

    def with_preference(
        self,
        observation: np.ndarray,
        preference: Sequence[float] | np.ndarray | None,
        kept: Sequence[float] | np.ndarray | None = None,
    ) -> np.ndarray:
        """[s, w], as `predict` takes it, (..., observation_dim + preference_dim).

        :param observation: s with `preference`, or [s, w] without
        :param preference: (n_objectives,) or (batch, n_objectives)
        :param kept: the preference of an s that comes without one
        :raises ValueError: if one of both is missing, doubled or of the wrong shape
        """
        if isinstance(observation, (tuple, dict)):
            return observation  # SB3's own error
        observation = np.asarray(observation)
        if not all_finite(observation):
            raise ValueError(f"The observation {observation} has a number that is not finite: no action answers it.")
        raw, wrapped = self.observation_dim, self.observation_dim + self.preference_dim
        width = observation.shape[-1] if observation.ndim > 0 else 0
        if preference is None:
            if width != raw or raw == wrapped:
                return observation
            if kept is None:
                raise ValueError(
                    f"This observation has no preference: call predict(..., preference=w) with {self.n_objectives} weights; "
                    "for EvalCallback and evaluate_policy, make the environment by make_mo_vec_env."
                )
            preference = kept
        w = check_preference(preference, self.n_objectives)
        if wrapped == raw:
            return observation
        if width != raw:
            raise ValueError(
                f"With preference=, the observation must be the environment's own, {raw} wide, not {width}"
                + (", which carries a preference already." if width == wrapped else ".")
            )
        if observation.ndim < w.ndim or (w.ndim == 2 and len(w) != len(observation)):
            raise ValueError(f"Observations of shape {observation.shape} and preferences of shape {w.shape} do not match.")
        w = np.broadcast_to(w, (*observation.shape[:-1], self.n_objectives))
        return np.concatenate([observation, w], axis=-1, dtype=np.float32)

    def set_training_mode(self, mode: bool) -> None:
        """SB3's, which acting and learning call in turn at every step; nn.Module's own way takes half as long as acting."""
        if mode != self.training:
            for module in self.modules():
                vars(module)["training"] = mode

    def save(self, path: FilePath) -> None:  # type: ignore[override]
        """Write the networks and their statistics into one file, exactly at `path`; the optimisers are the model's.

        :raises TypeError: names an argument that cannot be stored without pickle
        """
        write_tree(
            path,
            {
                **header(POLICY_FORMAT),
                "policy": type(self).__name__,
                "arguments": self._all_arguments,
                "state_dict": dict(self.state_dict()),
            },
            whole=True,
        )

    @property
    def _all_arguments(self) -> dict[str, Any]:
        return {"observation_space": self.observation_space, "action_space": self.action_space, **self.arguments}

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
        return self.actor(self.normalize(observation), deterministic or self.deterministic_policy)
