"""What has to be beaten: policies that have learned nothing."""

from typing import Any

import numpy as np
from gymnasium import spaces


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
