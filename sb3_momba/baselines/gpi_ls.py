"""GPI-LS for continuous actions (Alegre et al., 2023, Sample-Efficient Multi-Objective Learning via Generalized Policy
Improvement Prioritization), by morl-baselines.

One policy for all preferences. Every `timesteps_per_iter` steps it plays episodes under the corner weights that linear support
finds, to choose what to train next: those steps are `extra_steps`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th

from sb3_momba.baselines.library import CountedSteps, hyperparameters_of, imported, quiet_and_seeded
from sb3_momba.baselines.settings import BaselineSettings, completed, device_of
from sb3_momba.envs.making import make_env
from sb3_momba.envs.registry import raw_id
from sb3_momba.pareto.evaluation import ParetoFront, evaluate_front

OF_TRAIN = {"timesteps_per_iter": 10_000, "num_eval_episodes_for_front": 5}


class ConditionedPolicy:
    """The mean action of GPI-LS's policy network.

    :param network: (observations, preferences) -> actions
    """

    def __init__(self, network: Any, n_objectives: int, gamma: float, device: th.device):
        self.network = network
        self.n_objectives = n_objectives
        self.gamma = gamma
        self.device = device

    def predict(self, observation: np.ndarray, *, deterministic: bool = True) -> tuple[np.ndarray, Any]:
        """:param observation: [s, w], (batch, observation_dim + n_objectives)"""
        both = th.as_tensor(observation, dtype=th.float32, device=self.device)
        with th.no_grad():
            actions = self.network(both[:, : -self.n_objectives], both[:, -self.n_objectives :])
        return actions.cpu().numpy(), None


class Baseline:
    """See `sb3_momba.baselines.runs.Baseline`.

    :raises ValueError: for hyperparameters that cannot be, or steps that are no whole number of iterations
    """

    general_policy = True

    def __init__(self, settings: BaselineSettings, n_objectives: int):
        library = imported("multi_policy.gpi_pd.gpi_pd_continuous_action")
        parent = library.GPIPDContinuousAction
        # GPI-LS learns no dynamics, and with continuous actions GPI serves only to select weights.
        not_its = tuple(name for name in hyperparameters_of(parent) if name.startswith("dyna") or name == "use_gpi")
        known = {**hyperparameters_of(parent, not_its), **OF_TRAIN}
        self.hyperparameters = completed("gpi_ls", settings.hyperparameters, known)
        self.settings = settings
        buffer, batch, starts = (self.hyperparameters[name] for name in ("buffer_size", "batch_size", "learning_starts"))
        if buffer < batch:
            raise ValueError(f"buffer_size={buffer}: a minibatch of batch_size={batch} must fit.")
        if starts >= settings.steps:
            raise ValueError(f"learning_starts={starts} with steps={settings.steps:,}: nothing would ever be learned.")
        per_iteration = self.hyperparameters["timesteps_per_iter"]
        if settings.steps % per_iteration:
            fewer = settings.steps // per_iteration * per_iteration
            raise ValueError(
                f"steps={settings.steps:,} is no whole number of iterations of {per_iteration:,}: give "
                + (f"{fewer:,} or " if fewer else "")
                + f"{fewer + per_iteration:,}, or set timesteps_per_iter."
            )

        class WithoutLogs(library.GPILSContinuousAction):  # type: ignore[misc, name-defined]
            def close_wandb(self) -> None:
                """It is called whether anything was logged or not."""

        self.env = CountedSteps(make_env(raw_id(settings.env)))
        self.eval_env = CountedSteps(make_env(raw_id(settings.env)))
        own = {name: value for name, value in self.hyperparameters.items() if name not in OF_TRAIN}
        with quiet_and_seeded(settings.seed):
            self.agent = WithoutLogs(self.env, log=False, seed=settings.seed, device=device_of(settings.device), **own)
        self.policy = ConditionedPolicy(self.agent.policy, n_objectives, self.agent.gamma, self.agent.device)
        self.parameters = {
            "actor": sum(p.numel() for p in self.agent.policy.parameters()),
            "critic": sum(p.numel() for net in self.agent.q_nets for p in net.parameters()),
        }

    @property
    def steps(self) -> int:
        """Of the training, so far."""
        return self.env.n_steps

    @property
    def extra_steps(self) -> int:
        """Of the episodes that weights were chosen by, so far."""
        return self.eval_env.n_steps

    def train(self, between_steps: Callable[[], None]) -> None:
        """:param between_steps: called before each step"""
        self.env.before_step = between_steps
        for index, env in enumerate((self.env, self.eval_env)):
            env.reset(seed=self.settings.seed + index)  # The library resets without a seed.
            env.action_space.seed(self.settings.seed + index)
        with quiet_and_seeded(self.settings.seed):
            self.agent.train(
                self.settings.steps,
                self.eval_env,
                ref_point=np.zeros(self.agent.reward_dim),  # only for logs
                checkpoints=False,
                **{name: self.hyperparameters[name] for name in OF_TRAIN},
            )

    def evaluate(self, preferences: np.ndarray) -> ParetoFront:
        """The policy under each preference, (P, n_objectives)."""
        return evaluate_front(self.policy, self.settings.env, preferences=preferences, n_episodes=self.settings.n_episodes)

    def close(self) -> None:
        """Close the environments."""
        self.env.close()
        self.eval_env.close()
