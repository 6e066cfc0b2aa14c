"""What has to be beaten: policies that have learned nothing."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_momba.pareto.evaluation import MAX_PARALLEL_EPISODES, ParetoFront, evaluate_front, probe_environment
from sb3_momba.pareto.protocol import N_EPISODES

MEASURED = ("returns", "discounted_returns", "episode_lengths")


class ZeroActionPolicy:
    """Always the action nearest to 0: standing still, where 0 means that."""

    def __init__(self, action_space: spaces.Box):
        self.action = np.clip(0, action_space.low, action_space.high).astype(np.float32)

    def predict(self, observation: np.ndarray, *, deterministic: bool = True) -> tuple[np.ndarray, Any]:
        """:param observation: (batch, observation_dim)"""
        return np.tile(self.action, (len(observation), 1)), None


class RandomPolicy:
    """Uniform actions."""

    def __init__(self, action_space: spaces.Box, seed: int = 0):
        self.action_space = action_space
        self.rng = np.random.default_rng(seed)

    def predict(self, observation: np.ndarray, *, deterministic: bool = True) -> tuple[np.ndarray, Any]:
        """:param observation: (batch, observation_dim)"""
        low, high = self.action_space.low, self.action_space.high
        return self.rng.uniform(low, high, (len(observation), len(low))).astype(np.float32), None


def evaluate_floors(
    env: str | gym.Env | VecEnv | Callable[[], gym.Env],
    preferences: np.ndarray,
    n_episodes: int = N_EPISODES,
    seed: int = 0,
    n_envs: int = MAX_PARALLEL_EPISODES,
) -> dict[str, ParetoFront]:
    """Both, under the protocol of a learned policy.

    Random actions give a set of P noisy points, whose hypervolume is above that of their mean: a floor that favours nobody.

    :param preferences: (P, n_objectives)
    :param n_envs: copies of the environment, at most
    """
    action_space = probe_environment(env).action_space
    protocol: dict[str, Any] = {"n_episodes": n_episodes, "seed": seed, "n_envs": n_envs}
    random = evaluate_front(RandomPolicy(action_space, seed), env, preferences=preferences, deterministic=False, **protocol)
    still = evaluate_front(ZeroActionPolicy(action_space), env, preferences=preferences[:1], **protocol)
    # It is the same under every preference.
    tiled: dict[str, Any] = {name: np.repeat(getattr(still, name), len(preferences), axis=0) for name in MEASURED}
    return {"standing still": replace(still, preferences=random.preferences, **tiled), "random actions": random}
