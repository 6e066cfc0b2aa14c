"""Environments that know the return so far, and reward what it adds to a utility: what DPMORL's policies act in."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn


def symlog(x: np.ndarray) -> np.ndarray:
    """sign(x) ln(1 + |x|) (Hafner et al., 2023, equation 9), elementwise: about x near 0, and small where x is large.

    A policy that learns earns many times what random actions do, by which returns are scaled first.
    """
    return np.sign(x) * np.log1p(np.abs(x))


class AccumulatedReturn(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Accumulates z_t, the undiscounted vector return of the episode so far, which is 0 at its start.

    - observation: float32 Box [s_t, symlog((z_t - low) / (high - low))]
    - reward: the environment's own vector
    - `info["accumulated_return"]`: a fresh float64 copy of z_{t+1}, (n_objectives,)

    :param env: with a vector reward
    :param low: (n_objectives,)
    :param high: likewise
    :param augment: whether z_t is observed
    """

    def __init__(self, env: gym.Env, low: np.ndarray, high: np.ndarray, augment: bool = True):
        super().__init__(env)
        box = env.observation_space
        assert isinstance(box, spaces.Box)
        self.low, self.width = low, high - low
        self.augment = augment
        self.z = np.zeros(len(low))
        unbounded = np.full(len(low) if augment else 0, np.inf)
        self.observation_space = spaces.Box(
            np.concatenate([box.low, -unbounded]).astype(np.float32),
            np.concatenate([box.high, unbounded]).astype(np.float32),
            dtype=np.float32,
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self.z = np.zeros(len(self.low))
        return self._observe(observation), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool, bool, dict[str, Any]]:  # type: ignore[override]
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.z = self.z + np.asarray(reward, dtype=np.float64)
        info = {**info, "accumulated_return": self.z.copy()}
        return self._observe(observation), reward, terminated, truncated, info  # type: ignore[return-value]

    def _observe(self, observation: np.ndarray) -> np.ndarray:
        seen = symlog((self.z - self.low) / self.width) if self.augment else ()
        return np.concatenate([observation, seen]).astype(np.float32)


class WithoutReward(gym.RewardWrapper[np.ndarray, np.ndarray]):
    """No reward: vectors do not pass through a VecEnv, outside of which `UtilityReward` gives the reward."""

    def reward(self, reward: Any) -> float:  # type: ignore[override]
        return 0.0


class UtilityReward(VecEnvWrapper):
    """The reward f(z_{t+1}) - f(z_t), whose sum over an episode is f(z_T) - f(0), the utility of its return.

    The end of an episode is the end of its return, by time or otherwise: no value is added for what would come after it.

    :param venv: of `WithoutReward(AccumulatedReturn(env, ...))`
    :param utility: f, (n, n_objectives) -> (n,)
    :param n_objectives: of z
    :ivar low: the smallest z_t seen so far, (n_objectives,)
    :ivar high: the largest
    """

    def __init__(self, venv: VecEnv, utility: Callable[[th.Tensor], th.Tensor], n_objectives: int):
        super().__init__(venv)
        self.utility = utility
        self.low, self.high = np.zeros((2, n_objectives))
        self.at_start = self._of(np.zeros((1, n_objectives)))[0]
        self.before = np.full(self.num_envs, self.at_start)

    def reset(self) -> Any:
        """Observations, (n_envs, observation_dim)"""
        self.before[:] = self.at_start
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Observations, rewards (n_envs,), dones and infos."""
        observations, _, dones, infos = self.venv.step_wait()
        z = np.stack([info["accumulated_return"] for info in infos])
        self.low, self.high = np.minimum(self.low, z.min(axis=0)), np.maximum(self.high, z.max(axis=0))
        after = self._of(z)
        rewards = after - self.before
        self.before = np.where(dones, self.at_start, after)
        for info in infos:
            info["TimeLimit.truncated"] = False
        return observations, rewards, dones, infos

    def _of(self, z: np.ndarray) -> np.ndarray:
        return self.utility(th.from_numpy(z)).numpy()
