"""Metrics of the training: added up as tensors, turned into numbers only when the log is written."""

import warnings
from collections.abc import Sequence

import numpy as np
import torch as th
from stable_baselines3.common.logger import Logger
from torch import nn

BLIND_UPDATES = 1_000

Metrics = dict[str, th.Tensor]


class TrainingMetrics:
    """Sums of metrics since the last log, and a watch over critics that cannot see."""

    def __init__(self) -> None:
        self.sums: Metrics = {}
        self.counts: dict[str, int] = {}
        self.n_updates = 0
        self.blind_updates: th.Tensor | int = 0
        self.warned_blind = False

    def add(self, metrics: Metrics) -> None:
        """
        :param metrics: of one update, which need not be the same in all; scalars, or one number per objective; with
            `target_end_mass`
        """
        for name, value in metrics.items():
            self.sums[name] = self.sums[name] + value if name in self.sums else value
            self.counts[name] = self.counts.get(name, 0) + 1
        self.n_updates += 1
        self.blind_updates = (self.blind_updates + 1) * (metrics["target_end_mass"] > 0.5)
        if not self.warned_blind and self.n_updates % BLIND_UPDATES == 0 and self.blind_updates >= BLIND_UPDATES:
            self.warned_blind = True
            warnings.warn(
                f"For {BLIND_UPDATES} updates more than half of the critics' target mass has been on an end of their support: "
                "they cannot tell good from better. At the start this comes from a large entropy coefficient: try "
                'ent_coef="auto_0.01", a wider support, or a smaller best_return_scale.',
                stacklevel=2,
            )

    def record(self, logger: Logger) -> None:
        """Write the means since the last call as `train/NAME`, or `train/NAME_i` for each objective."""
        for name, total in self.sums.items():
            mean = np.atleast_1d((total / self.counts[name]).cpu().numpy())
            for i, number in enumerate(mean):
                logger.record(f"train/{name}" + (f"_{i}" if len(mean) > 1 else ""), float(number))
        self.sums, self.counts = {}, {}


class NegativeReturnWatch:
    """Warns once of the first episode whose undiscounted return is negative in an objective: eq. (3.21) assumes none."""

    def __init__(self) -> None:
        self.returns: np.ndarray | None = None
        self.warned = False

    def add(self, rewards: np.ndarray, dones: np.ndarray) -> None:
        """
        :param rewards: (n_envs, n_objectives)
        :param dones: where an episode has just ended, (n_envs,)
        """
        if self.returns is None or self.returns.shape != rewards.shape:
            self.returns = np.zeros(rewards.shape)
        self.returns += rewards
        ended = dones.astype(bool)
        if not self.warned and (self.returns[ended] < 0).any():
            self.warned = True
            warnings.warn(
                "preference_alignment assumes returns that are not negative (section 3.5.2): the cosine of eq. (3.21) steers "
                f"the wrong way where they are. An episode has just returned {self.returns[ended].min(axis=0).tolist()}. "
                "preference_alignment='positive' leaves such values alone.",
                stacklevel=2,
            )
        self.returns[ended] = 0

    def end_episodes(self, indices: Sequence[int] | None = None) -> None:
        """:param indices: the environments whose episodes end from outside; None: all"""
        if self.returns is not None:
            self.returns[slice(None) if indices is None else list(indices)] = 0


def weight_norm(network: nn.Module) -> float:
    """The l2 norm of all parameters together."""
    return float(th.stack([p.detach().square().sum() for p in network.parameters()]).sum().sqrt())
