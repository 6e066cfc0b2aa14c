"""Running statistics that put observations and rewards on the networks' scale (sections 3.3 and 3.4.1)."""

from collections.abc import Sequence

import numpy as np
import torch as th
from torch import nn

VARIANCE_EPS = 1e-8
SMALLEST_RETURN = 1e-8


class RunningStatistics(nn.Module):
    """Mean and variance of all observations seen, by the parallel algorithm of Chan et al. (1979), in float64.

    Before the second observation, normalisation only subtracts the mean.
    """

    count: th.Tensor
    mean: th.Tensor
    m2: th.Tensor

    def __init__(self, dim: int):
        super().__init__()
        self.register_buffer("count", th.zeros((), dtype=th.float64))
        self.register_buffer("mean", th.zeros(dim, dtype=th.float64))
        self.register_buffer("m2", th.zeros(dim, dtype=th.float64))

    @th.no_grad()
    def update(self, observations: np.ndarray) -> None:
        """:param observations: (n, dim)"""
        batch = th.as_tensor(observations, dtype=th.float64, device=self.mean.device)
        batch_mean = batch.mean(dim=0)
        total = self.count + len(batch)
        delta = batch_mean - self.mean
        self.m2 += (batch - batch_mean).square().sum(dim=0) + delta.square() * (self.count * len(batch) / total)
        self.mean += delta * (len(batch) / total)
        self.count += len(batch)

    @property
    def variance(self) -> th.Tensor:
        """(dim,), 1 before the second observation."""
        return th.where(self.count > 1, self.m2 / self.count.clamp_min(1), 1.0)

    @property
    def inverse_deviation(self) -> th.Tensor:
        """1 / sqrt(variance + eps), (dim,), float32."""
        return (self.variance + VARIANCE_EPS).rsqrt().float()

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(x - mean) / sqrt(variance + eps), (batch, dim) -> (batch, dim), float32."""
        return (observations - self.mean.float()) * self.inverse_deviation


class RewardCenter(nn.Module):
    """Reward centring (Naik et al., 2024): critics learn Q - V, by how much a return is more than V = r / (1 - gamma), what
    the mean reward r of all steps so far is worth for ever.

    Its best actions are those of Q, as V is the same everywhere; what follows the end of an episode is worth -V. What all
    values have in common need not be learned.

    :param n_objectives: width of the rewards
    :param gamma: discount, below 1
    """

    def __init__(self, n_objectives: int, gamma: float):
        super().__init__()
        self.gamma = gamma
        self.statistics = RunningStatistics(n_objectives)

    @property
    def value(self) -> th.Tensor:
        """V, (n_objectives,), float64."""
        return self.statistics.mean / (1 - self.gamma)

    def forward(self, rewards: th.Tensor, discounts: th.Tensor) -> th.Tensor:
        """Of R + d Q the R that makes it Q - V: R + d (Q - V) - V + d V.

        :param rewards: R, sums of one or several rewards, (batch, n_objectives)
        :param discounts: d of what follows, 0 where an episode ends, (batch,)
        :return: (batch, n_objectives)
        """
        return rewards - self.value.to(rewards.dtype) * (1 - discounts[:, None])


class ReturnScale(nn.Module):
    """Rewards are multiplied by best_return_scale / max |G_i|, the largest running return of any objective so far (reward
    normalisation, section 3.4.1).

    G <- gamma G + r runs along each episode of each environment. max_i |G_i| bounds |w.G| for every preference w, so one
    rule serves the scalarised and the vector critic. (G weighs an episode's end most; the return that critics learn weighs
    its beginning most, and can exceed it.)

    :param best_return_scale: what the best return becomes (Table B.1: 3.0), or None: rewards stay as they are
    """

    max_return: th.Tensor

    def __init__(self, best_return_scale: float | None, gamma: float):
        super().__init__()
        self.best_return_scale = best_return_scale
        self.gamma = gamma
        self.register_buffer("max_return", th.zeros((), dtype=th.float64))
        self.running_returns: np.ndarray | None = None

    def update(self, rewards: np.ndarray, dones: np.ndarray) -> None:
        """
        :param rewards: (n_envs, n_objectives)
        :param dones: where an episode has just ended, (n_envs,)
        """
        if self.running_returns is None or self.running_returns.shape != rewards.shape:
            self.running_returns = np.zeros(rewards.shape, dtype=np.float64)
        self.running_returns = self.gamma * self.running_returns + rewards
        self.observe(self.running_returns)
        self.running_returns[dones.astype(bool)] = 0.0

    def observe(self, returns: np.ndarray) -> None:
        """:param returns: G of every environment at this step, (n_envs, n_objectives)"""
        self.max_return.fill_(max(float(self.max_return), float(np.abs(returns).max())))

    def end_episodes(self, indices: Sequence[int] | None = None) -> None:
        """The next rewards begin new returns, in any number of environments.

        :param indices: in these environments only
        """
        if indices is None:
            self.running_returns = None
        elif self.running_returns is not None:
            self.running_returns[list(indices)] = 0.0

    def factor(self, value: float = 0.0) -> float:
        """What a reward is multiplied by; 1 while no return is above 1e-8.

        :param value: of this size are values that critics learn besides returns
        """
        largest = max(float(self.max_return), value)
        if self.best_return_scale is None or largest < SMALLEST_RETURN:
            return 1.0
        return self.best_return_scale / largest


class DeviationScale(ReturnScale):
    """Rewards are divided by the largest standard deviation of any objective's running return, or by max |G_i| /
    best_return_scale where that is larger, which keeps returns within the support (SimbaV2's code; FlashSAC).

    :param n_objectives: width of the rewards
    """

    def __init__(self, best_return_scale: float, gamma: float, n_objectives: int):
        super().__init__(best_return_scale, gamma)
        self.statistics = RunningStatistics(n_objectives)

    def observe(self, returns: np.ndarray) -> None:
        super().observe(returns)
        self.statistics.update(returns)

    def factor(self, value: float = 0.0) -> float:
        deviation = float(self.statistics.variance.max().sqrt())
        return min(super().factor(value), 1 / max(deviation, SMALLEST_RETURN))
