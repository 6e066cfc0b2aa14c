"""What the tests share: an environment whose every number can be computed by hand, and a model small enough to train."""

from collections import deque
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_momba import MOMBA

TINY_SIMBA = {
    "actor_hidden_dim": 8,
    "actor_blocks": 1,
    "critic_hidden_dim": 8,
    "critic_blocks": 1,
    "n_atoms": 11,
}
TINY_MLP = {"net_arch": [8, 8], "n_atoms": 11}


class StubEnv(gym.Env):
    """Counts its steps over all episodes: step t gives `observation_of(t)` and `reward_of(t)`.

    :param n_objectives: width of the reward; None: a number, and no `reward_space`
    :param episode_length: steps of an episode
    :param ending: how an episode ends: "truncated", "terminated" or "both"
    :param rewards: what to give instead at some steps, {t: reward}
    :param observations: what to give instead at some steps, {t: observation}
    :param cast: applied to every reward, such as `list`
    :param reuse_arrays: write every observation and every reward into the same array, and overwrite both at reset
    :param reward_space: instead of a Box with n_objectives entries
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        n_objectives: int | None = 2,
        episode_length: int = 10,
        ending: str = "truncated",
        *,
        observation_dim: int = 3,
        action_dim: int = 2,
        rewards: dict[int, Any] | None = None,
        observations: dict[int, Any] | None = None,
        cast: Callable[[np.ndarray], Any] | None = None,
        reuse_arrays: bool = False,
        observation_space: spaces.Space | None = None,
        action_space: spaces.Space | None = None,
        reward_space: spaces.Space | None = None,
        render_mode: str | None = None,
    ):
        self.observation_space = observation_space or spaces.Box(-np.inf, np.inf, (observation_dim,), np.float32)
        self.action_space = action_space or spaces.Box(-2.0, 2.0, (action_dim,), np.float32)
        if n_objectives is not None:
            self.reward_space = reward_space or spaces.Box(-np.inf, np.inf, (n_objectives,), np.float32)
        self.n_objectives = n_objectives
        self.observation_dim = observation_dim
        self.episode_length = episode_length
        self.ending = ending
        self.rewards = rewards or {}
        self.observations = observations or {}
        self.cast = cast
        self.reuse_arrays = reuse_arrays
        self.render_mode = render_mode
        self.n_steps = 0
        self.n_episodes = 0
        self.actions: list[np.ndarray] = []
        self._observation = np.zeros(observation_dim, dtype=np.float32)
        self._reward = np.zeros(n_objectives or 1, dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.options = options
        self.n_episodes += 1
        self.first_step = self.n_steps
        self._reward[:] = -99.0
        return self._observe(start_of_episode=True), {}

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self.actions.append(action)
        self.n_steps += 1
        ended = self.n_steps - self.first_step == self.episode_length
        terminated, truncated = ended and self.ending != "truncated", ended and self.ending != "terminated"
        return self._observe(), self._give_reward(), terminated, truncated, {"step": self.n_steps}

    def render(self) -> np.ndarray:
        return np.zeros((4, 4, 3), dtype=np.uint8)

    def _observe(self, start_of_episode: bool = False) -> Any:
        if self.n_steps in self.observations:
            return self.observations[self.n_steps]
        observation = observation_of(self.n_steps, self.observation_dim, start_of_episode)
        if not self.reuse_arrays:
            return observation
        self._observation[:] = observation
        return self._observation

    def _give_reward(self) -> Any:
        if self.n_steps in self.rewards:
            return self.rewards[self.n_steps]
        if self.n_objectives is None:
            return float(reward_of(self.n_steps, 1)[0])
        reward = reward_of(self.n_steps, self.n_objectives)
        if self.reuse_arrays:
            self._reward[:] = reward
            reward = self._reward
        return reward if self.cast is None else self.cast(reward)


def observation_of(step: int, dim: int = 3, start_of_episode: bool = False) -> np.ndarray:
    """What StubEnv shows after its step t: [t, t + 0.25, ...], and half more where t is the start of a new episode."""
    return (step + 0.25 * np.arange(dim) + 0.5 * start_of_episode).astype(np.float32)


def reward_of(step: int, n_objectives: int) -> np.ndarray:
    """What StubEnv gives for its step t: [t, -10 t, 100 t, ...], no larger than a million t."""
    return (step * (-10.0) ** np.minimum(np.arange(n_objectives), 6)).astype(np.float32)


def tiny_model(env: gym.Env | VecEnv | str, policy: str = "SimbaPolicy", **kwargs: Any) -> MOMBA:
    """MOMBA with networks of a few hundred parameters, which starts to train after 20 steps.

    `policy_kwargs` are added to the tiny ones.
    """
    tiny = TINY_MLP if policy == "MlpPolicy" else TINY_SIMBA
    kwargs["policy_kwargs"] = {**tiny, **(kwargs.get("policy_kwargs") or {})}
    return MOMBA(
        policy, env, **{"learning_starts": 20, "batch_size": 16, "buffer_size": 1_000, "seed": 0, "device": "cpu", **kwargs}
    )


def assert_same_tree(ours: Any, theirs: Any, place: str = "tree") -> None:
    """Two nests of dictionaries, lists, tuples, deques, arrays and tensors hold the same types and bit-equal numbers."""
    if isinstance(ours, dict):
        assert isinstance(theirs, dict), place
        assert_same_tree(list(ours), list(theirs), f"the keys of {place}")
        for (key, our), their in zip(ours.items(), theirs.values(), strict=True):
            assert_same_tree(our, their, f"{place}[{key!r}]")
        return
    assert type(ours) is type(theirs), f"{place}: {type(ours)} and {type(theirs)}"
    if isinstance(ours, list | tuple | deque):
        assert len(ours) == len(theirs), place
        assert getattr(ours, "maxlen", None) == getattr(theirs, "maxlen", None), place
        for i, (our, their) in enumerate(zip(ours, theirs, strict=True)):
            assert_same_tree(our, their, f"{place}[{i}]")
    elif isinstance(ours, np.ndarray | th.Tensor):
        assert ours.dtype == theirs.dtype, place
        our, their = np.asarray(ours), np.asarray(theirs)
        np.testing.assert_array_equal(our, their, err_msg=place, strict=True)
        assert our.tobytes() == their.tobytes(), place
    else:
        assert ours == theirs or (ours != ours and theirs != theirs), f"{place}: {ours!r} and {theirs!r}"


# Its training fails, its evaluations, which have a copy for each episode, do not get that far.
gym.register("diverging-v0", StubEnv, kwargs={"rewards": {200: np.array([np.nan, 1.0])}})
