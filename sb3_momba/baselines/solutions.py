"""What a method without a general policy has to offer: a set of policies, each with its returns."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_momba.pareto.evaluation import ParetoFront, Predictor, evaluate_front

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SolutionSet:
    """The returns of n policies over E episodes; E is 1 in an environment without randomness.

    :param returns: undiscounted vector returns, (n, E, n_objectives)
    :param discounted_returns: likewise
    :param episode_lengths: in steps, (n, E)
    :param settings: how they were measured, and what is known of each policy
    """

    returns: Array
    discounted_returns: Array
    episode_lengths: NDArray[np.int64]
    settings: dict[str, Any]

    @property
    def values(self) -> Array:
        """The mean return of each policy, (n, n_objectives)."""
        return np.asarray(self.returns.mean(axis=1))


def evaluate_policy(
    policy: Predictor,
    env: str | Callable[[], gym.Env],
    n_objectives: int,
    n_episodes: int,
    gamma: float | None = None,
    seed: int = 0,
    deterministic: bool = True,
) -> ParetoFront:
    """Play one policy, as `evaluate_front` plays one under one preference.

    :param policy: its `predict` gets observations of the environment with n_objectives entries behind them that say nothing
    :param seed: of the first episode
    """
    anything = np.full((1, n_objectives), 1 / n_objectives)
    return evaluate_front(
        policy, env, preferences=anything, n_episodes=n_episodes, gamma=gamma, seed=seed, deterministic=deterministic
    )


def as_set(played: Sequence[ParetoFront], **known: Any) -> SolutionSet:
    """The set of policies that were each played by `evaluate_policy`.

    :param known: of the policies, for the settings
    """
    return SolutionSet(
        np.concatenate([one.returns for one in played]),
        np.concatenate([one.discounted_returns for one in played]),
        np.concatenate([one.episode_lengths for one in played]),
        {**played[0].settings, **known},
    )
