"""DPMORL (Cai et al., 2023, Distributional Pareto-Optimal Multi-Objective Reinforcement Learning) on SB3's PPO.

Utility functions of vector returns are generated that differ from one another; for each one, PPO trains a policy of
[s_t, z_t], z_t the return so far, on the reward f(z_{t+1}) - f(z_t). The policies whose return distributions no other one
dominates are marked among the solutions.
"""

import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_momba.baselines.dominance import non_dominated_distributions
from sb3_momba.baselines.returns import AccumulatedReturn, UtilityReward, WithoutReward
from sb3_momba.baselines.settings import BaselineSettings, completed, device_of
from sb3_momba.baselines.solutions import SolutionSet, as_set, evaluate_policy
from sb3_momba.baselines.utilities import UtilityOfReturns, generate_utilities, linear_utilities
from sb3_momba.envs.making import make_env
from sb3_momba.envs.registry import raw_id
from sb3_momba.pareto.evaluation import ParetoFront, probe_environment
from sb3_momba.pareto.floors import RandomPolicy
from sb3_momba.settings import check_whole

OF_PPO: dict[str, Any] = {
    "n_epochs": 5,
    "batch_size": 64,
    "learning_rate": 3e-4,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "ent_coef": 0.0,
}
DEFAULTS: dict[str, Any] = {
    "n_policies": 10,
    "augment_state": True,
    "linear_share": 0.1,
    "random_episodes": 10,
    "n_envs": 20,
    "n_steps": None,
    "net_arch": [64, 64],
    **OF_PPO,
}
LONGEST_ROLLOUT = 2048  # steps of each environment, as in SB3
FEWEST_ROLLOUTS = 25  # of a policy: as many as a million steps have

logger = logging.getLogger(__name__)


class PolicyOfReturns:
    """An SB3 policy on observations behind which stand n_objectives entries that say nothing."""

    def __init__(self, policy: Any, n_objectives: int):
        self.policy = policy
        self.n_objectives = n_objectives

    def predict(self, observation: np.ndarray, *, deterministic: bool = True) -> tuple[np.ndarray, Any]:
        """:param observation: (batch, observation_dim + n_objectives)"""
        return self.policy.predict(observation[:, : -self.n_objectives], deterministic=deterministic)


class BetweenRollouts(BaseCallback):
    """Calls a function while the policy is what the steps so far have made of it."""

    def __init__(self, function: Callable[[], None]):
        super().__init__()
        self.function = function

    def _on_rollout_start(self) -> None:
        self.function()

    def _on_step(self) -> bool:
        return True


def rollout_steps(steps: int, n_policies: int, n_envs: int, n_steps: int | None) -> int:
    """Steps of each environment between two updates of a policy, so that rollouts fill the training.

    At most 2,048, and so few that a policy has at least 25 rollouts.

    :param steps: of all policies
    :param n_steps: if it is given
    :raises ValueError: if they do not fill it
    """
    if steps % (n_policies * n_envs):
        step = n_policies * n_envs
        near = " or ".join(f"{k * step:,}" for k in (steps // step, steps // step + 1) if k)
        raise ValueError(
            f"steps={steps:,} do not divide among n_policies={n_policies}, each with n_envs={n_envs} environments: give a "
            f"multiple of {step:,}, such as {near}."
        )
    if n_steps is not None:
        check_whole("n_steps", n_steps, 1)
    of_env = steps // n_policies // n_envs
    shares = f"each of the {n_envs} environments of a policy has {steps:,} / {n_policies} / {n_envs} = {of_env:,} steps"
    if n_steps is None:
        longest = max(1, min(LONGEST_ROLLOUT, of_env // FEWEST_ROLLOUTS))
        n_steps = next(n for n in range(longest, 0, -1) if of_env % n == 0)
        if n_steps < longest / 2:
            raise ValueError(f"{shares}, which no rollout of about {longest} divides: set n_steps, or give other steps.")
    if of_env % n_steps or n_steps * n_envs < 2:
        raise ValueError(
            f"n_steps={n_steps}: {shares}, which must be a multiple of it; and a rollout has at least two transitions."
        )
    return n_steps


class Baseline:
    """See `sb3_momba.baselines.runs.Baseline`.

    :raises ValueError: for hyperparameters that cannot be, or steps that do not divide among policies and environments
    """

    general_policy = False

    def __init__(self, settings: BaselineSettings, n_objectives: int):
        self.settings, self.n_objectives = settings, n_objectives
        chosen = self.hyperparameters = completed("dpmorl", settings.hyperparameters, DEFAULTS)
        if not 0 < chosen["linear_share"] <= 1:
            raise ValueError(f"linear_share={chosen['linear_share']}: give a share above 0 and up to 1.")
        n_policies, n_envs = chosen["n_policies"], chosen["n_envs"]
        chosen["n_steps"] = rollout_steps(settings.steps, n_policies, n_envs, chosen["n_steps"])
        limit, of_env = gym.spec(raw_id(settings.env)).max_episode_steps, settings.steps // n_policies // n_envs
        if limit is not None and of_env < limit:
            logger.warning(
                "Each of the n_envs=%d environments of a policy has %d steps, fewer than an episode of %s may have (%d): "
                "no policy may ever see a whole return. Give more steps, or fewer environments.",
                n_envs,
                of_env,
                settings.env,
                limit,
            )
        self.finished: list[Trained] = []
        self.finished_steps = self.extra_steps = 0
        # Any range will do for a model that is not trained, and only shows what can be built.
        self.low, self.high = np.zeros(n_objectives), np.ones(n_objectives)
        self.model = self._make_model(0, linear_utilities(n_objectives)[0])
        policy = self.model.policy
        actor = [policy.mlp_extractor.policy_net, policy.action_net]
        critic = [policy.mlp_extractor.value_net, policy.value_net]
        self.parameters = {
            "actor": sum(p.numel() for net in actor for p in net.parameters()) + policy.log_std.numel(),
            "critic": sum(p.numel() for net in critic for p in net.parameters()),
        }

    @property
    def steps(self) -> int:
        """Of the training, so far."""
        return self.finished_steps + self.model.num_timesteps

    def _augmented(self, low: np.ndarray, high: np.ndarray) -> gym.Env:
        env = make_env(raw_id(self.settings.env))
        return AccumulatedReturn(env, low, high, self.hyperparameters["augment_state"])

    def _make_model(self, index: int, utility: th.nn.Module) -> PPO:
        of_returns = UtilityOfReturns(utility, th.from_numpy(self.low), th.from_numpy(self.high))
        chosen = self.hyperparameters
        venv = DummyVecEnv([lambda: WithoutReward(self._augmented(self.low, self.high))] * chosen["n_envs"])
        self.venv = UtilityReward(venv, of_returns, self.n_objectives)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "You have specified a mini-batch size")  # The last one may be smaller.
            return PPO(
                "MlpPolicy",
                self.venv,
                n_steps=chosen["n_steps"],
                policy_kwargs={"net_arch": chosen["net_arch"]},
                seed=int(np.random.SeedSequence([self.settings.seed, index]).generate_state(1)[0]),
                device=device_of(self.settings.device),
                **{name: chosen[name] for name in OF_PPO},
            )

    def train(self, between_steps: Callable[[], None]) -> None:
        """:param between_steps: called before each rollout"""
        chosen = self.hyperparameters
        generator = th.Generator().manual_seed(self.settings.seed)
        utilities = generate_utilities(chosen["n_policies"], self.n_objectives, generator, chosen["linear_share"])
        self._see_random_actions()
        for index, utility in enumerate(utilities):
            self.venv.close()
            self.model = self._make_model(index, utility)
            self.model.learn(self.settings.steps // len(utilities), callback=BetweenRollouts(between_steps))
            self.finished.append(Trained(self.model.policy, self.low, self.high))
            self.finished_steps, self.model.num_timesteps = self.steps, 0
            # A utility stays what it is while a policy is trained for it; the next one covers what was seen until then.
            self.low, self.high = np.minimum(self.low, self.venv.low), np.maximum(self.high, self.venv.high)

    def _see_random_actions(self) -> None:
        """What range returns have, before any policy is trained."""
        env, n_episodes = self.settings.env, self.hyperparameters["random_episodes"]
        policy = RandomPolicy(probe_environment(env).action_space, self.settings.seed)
        seed = self.settings.seed
        played = evaluate_policy(policy, env, self.n_objectives, n_episodes, seed=seed, deterministic=False)
        self.extra_steps = int(played.episode_lengths.sum())
        self.low = np.minimum(0, played.returns.min(axis=(0, 1)))
        self.high = np.maximum(0, played.returns.max(axis=(0, 1)))
        self.high = np.where(self.high > self.low, self.high, self.low + 1)  # An objective of which nothing was seen yet.

    def evaluate(self, preferences: np.ndarray) -> SolutionSet:
        """The policies that are trained, and the one that is being trained. The settings name those that no other one
        dominates, as distributions of returns.

        :param preferences: which no policy answers
        """
        current = [Trained(self.model.policy, self.low, self.high)] if self.model.num_timesteps else []
        played = [self._play(one) for one in (*self.finished, *current)]
        return as_set(played, non_dominated=non_dominated_distributions(np.concatenate([one.returns for one in played])))

    def _play(self, one: "Trained") -> ParetoFront:
        if one.played is None:
            one.played = evaluate_policy(
                PolicyOfReturns(one.policy, self.n_objectives),
                partial(self._augmented, one.low, one.high),
                self.n_objectives,
                self.settings.n_episodes,
                self.hyperparameters["gamma"],
            )
        return one.played

    def close(self) -> None:
        """Close the environments."""
        self.venv.close()


@dataclass
class Trained:
    """A policy, with the range that its observations show returns in; `played` is what it earned, once that is known."""

    policy: Any
    low: np.ndarray
    high: np.ndarray
    played: ParetoFront | None = None
