"""A replay buffer of vector rewards and the preferences under which they were earned."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import psutil
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_momba.envs.preferences import corner_weights, preference_dim
from sb3_momba.envs.wrappers import LARGEST_REWARD
from sb3_momba.finite import all_finite

SMALLEST_CONCENTRATION = 1e-3
STEPS_OF_FRONT, EPISODES_OF_FRONT = 20_000, 100
SCALARISATION_TOLERANCE = 1e-4
STORED_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "preferences")


class PreferenceReplayBufferSamples(NamedTuple):
    """A minibatch. `observations` and `next_observations` carry the SAME preference (eqs. 3.3 and 3.11)."""

    observations: th.Tensor  # [s, w], (batch, observation_dim + preference_dim)
    actions: th.Tensor  # on [-1, 1], (batch, action_dim)
    next_observations: th.Tensor  # [s', w], like observations
    dones: th.Tensor  # 1 where the return ends (terminated, not truncated), (batch,)
    rewards: th.Tensor  # (batch, n_objectives), summed and discounted over n steps
    discounts: th.Tensor  # gamma^n of the n steps summed, (batch,)
    preferences: th.Tensor  # w, (batch, n_objectives)


class PreferenceReplayBuffer(ReplayBuffer):
    """Transitions (s, a, r, s', terminated, w) of Algorithm 1, raw and in float32.

    The wrapper's next observation carries the next preference, so s, s' and w are stored apart, and `sample` appends one
    w to both.

    :param buffer_size: transitions, over all environments
    :param observation_space: of the wrapped environment: [s, w], (observation_dim + preference_dim,)
    :param action_space: (action_dim,); actions are stored scaled to [-1, 1]
    :param device: of the minibatches; what is stored stays in main memory
    :param n_envs: environments that add a transition at each step
    :param optimize_memory_usage: SB3's switch, always off: a truncated episode's last state is stored nowhere else
    :param n_objectives: width of the rewards
    :param gamma: discount of the rewards within an n-step return
    :param n_steps: transitions that one reward sums over, cut short where an episode ends
    :param keep_probability: p_keep of hindsight relabelling, eq. (3.20); 1 switches it off
    :param concentration: k of eq. (3.20): w' ~ Dirichlet(k w), its parameters floored at 1e-3
    :param n_relabels: rows of a minibatch that come from one transition, each with a preference of its own
    :param corner_probability: share of the relabelled preferences that are drawn from the corner weights of the newest
        episodes' returns instead of eq. (3.20), as soon as there are any (after linear support); for six objectives at most
    :param seed: of the buffer's own random stream
    :param handle_timeout_termination: SB3's switch, always on: a truncated episode's last state keeps its value
    :raises ValueError: for a switch that is turned, or a number out of its range
    """

    observation_space: spaces.Box

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        *,
        n_objectives: int,
        gamma: float = 0.99,
        n_steps: int = 1,
        keep_probability: float = 1.0,
        concentration: float = 5.0,
        n_relabels: int = 1,
        corner_probability: float = 0.0,
        seed: int | None = None,
        handle_timeout_termination: bool = True,
    ):
        if optimize_memory_usage:
            raise ValueError("optimize_memory_usage=True cannot tell a truncated episode's last state: leave it False.")
        if not handle_timeout_termination:
            raise ValueError("handle_timeout_termination=False takes a truncated episode for a terminated one: leave it True.")
        if n_steps < 1:
            raise ValueError(f"n_steps={n_steps}: a return sums over at least 1 step.")
        if n_relabels < 1:
            raise ValueError(f"n_relabels={n_relabels}: each transition has at least 1 preference.")
        if not 0 <= keep_probability <= 1 or not 0 <= corner_probability <= 1 or concentration <= 0:
            raise ValueError(
                f"keep_probability={keep_probability}, corner_probability={corner_probability}, "
                f"concentration={concentration}: each of the first two is a probability, the third positive."
            )
        self.n_objectives = n_objectives
        self.preference_dim = preference_dim(n_objectives)
        raw_dim = observation_space.shape[0] - self.preference_dim
        raw_space = spaces.Box(observation_space.low[:raw_dim], observation_space.high[:raw_dim], dtype=np.float32)
        super().__init__(buffer_size, raw_space, action_space, device, n_envs)
        self.goes_on = True  # whether what comes next belongs to the same episodes as the newest row
        self.n_added = 0  # rows since the training began or the last `reset`, those overwritten among them
        self.n_resets = 0
        self.rewards = np.zeros((self.buffer_size, n_envs, n_objectives), dtype=np.float32)
        self.preferences = np.ones((self.buffer_size, n_envs, n_objectives), dtype=np.float32)
        self.gamma = gamma
        self.n_steps = n_steps
        self.keep_probability = keep_probability
        self.concentration = concentration
        self.n_relabels = n_relabels
        self.corner_probability = corner_probability
        self._returns = self._corners = np.zeros((0, n_objectives))
        self.seed(seed)

    def seed(self, seed: int | None) -> None:
        """Start the buffer's random stream, which is not that of an environment with the same seed."""
        self.rng = np.random.default_rng(None if seed is None else [seed, 2])

    def reset(self) -> None:
        """Forget all transitions."""
        super().reset()
        self.goes_on, self.n_added = True, 0
        self.n_resets += 1

    def check_memory(self) -> None:
        """
        :raises MemoryError: if the buffer cannot fit into this machine's memory once it is full
        """
        arrays = [getattr(self, name) for name in STORED_ARRAYS]
        unwritten = 1 - self.size() / self.buffer_size  # memory is taken only when it is written
        needed, available = unwritten * sum(array.nbytes for array in arrays), psutil.virtual_memory().available
        if needed > available:
            n = self.buffer_size * self.n_envs
            raise MemoryError(
                f"A replay buffer of buffer_size={n:,} transitions grows by {needed / 1e9:.1f} GB; {available / 1e9:.1f} GB "
                f"are free: choose buffer_size={int(0.8 * available / needed * n):,} or less."
            )

    @property
    def observation_dim(self) -> int:
        """Width of an observation without its preference."""
        return int(self.obs_shape[0])

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one step of every environment.

        :param obs: [s, w], (n_envs, observation_dim + preference_dim): this w is the one that the action saw
        :param next_obs: [s', next w], like obs; before the reset where an episode has ended
        :param reward: the scalar rewards, (n_envs,), or as another buffer holds them, (n_envs, n_objectives); used only where
            no PreferenceWrapper reports vectors
        :param infos: with `vector_reward` from PreferenceWrapper
        :raises ValueError: for shapes that do not fit, numbers that are not finite, or a reward larger than 1e10 in size
        """
        vector_rewards = self._vector_rewards(reward, infos)
        for observations in (obs, next_obs):
            if not all_finite(observations):
                index = int((~np.isfinite(observations)).any(axis=1).argmax())
                raise ValueError(f"Environment {index}: the observation {observations[index]} has a number that is not finite.")
        raw = self.observation_dim
        if obs.shape[-1] != raw + self.preference_dim:
            raise ValueError(
                f"Observations of shape {obs.shape}: the buffer takes [observation, preference], "
                f"{raw} + {self.preference_dim} wide."
            )
        if "preference" in infos[0]:
            self._check_wrapper_order(obs[:, raw:], reward, vector_rewards, infos)
        if self.preference_dim > 0:
            self.preferences[self.pos] = obs[:, raw:]
        super().add(obs[:, :raw], next_obs[:, :raw], action, vector_rewards, done, infos)
        self.n_added += 1

    def _check_wrapper_order(
        self, appended: np.ndarray, reward: np.ndarray, vector_rewards: np.ndarray, infos: list[dict[str, Any]]
    ) -> None:
        """Observations must end in the w, and rewards be the w.r, that PreferenceWrapper reports."""
        w = np.array([info["preference"] for info in infos])
        products = w * vector_rewards
        tolerance = SCALARISATION_TOLERANCE * (1 + np.abs(products).sum(axis=1))
        if self.preference_dim > 0 and not np.array_equal(appended, w):
            what = f"The observations end in {appended.tolist()}, not in the preferences {w.tolist()}"
        elif (np.abs(reward - products.sum(axis=1)) > tolerance).any():
            what = f"The rewards {np.asarray(reward).tolist()} are not the scalarised {products.sum(axis=1).tolist()}"
        else:
            return
        raise ValueError(
            f"{what}: a wrapper outside PreferenceWrapper changes them (put it inside, as in "
            "Monitor(PreferenceWrapper(YourWrapper(env)))), or the environment was stepped or reset outside learn() (use "
            "another one to evaluate, or model.set_env(env) before going on)."
        )

    @property
    def latest_rewards(self) -> np.ndarray:
        """Of the step stored last, (n_envs, n_objectives)."""
        return self.rewards[self.pos - 1]

    def _terminations(self, *index: Any) -> np.ndarray:
        return self.dones[index] * (1 - self.timeouts[index])

    def end_episodes(self, indices: Sequence[int] | None = None) -> None:
        """Truncate the trajectories that are not finished, as when the environments are reset from outside.

        :param indices: of these environments; by default all
        """
        if self.size() > 0:
            unfinished = self.dones[self.pos - 1] == 0
            if indices is not None:
                unfinished &= np.isin(np.arange(self.n_envs), indices)
            self.dones[self.pos - 1][unfinished] = 1
            self.timeouts[self.pos - 1][unfinished] = 1
        self.goes_on = True

    def _vector_rewards(self, reward: np.ndarray, infos: list[dict[str, Any]]) -> np.ndarray:
        expected = (self.n_envs, self.n_objectives)
        if all("vector_reward" in info for info in infos):
            vectors = [info["vector_reward"] for info in infos]
            for index, vector in enumerate(vectors):
                if np.shape(vector) != expected[1:]:
                    raise ValueError(f"Environment {index}: vector_reward has shape {np.shape(vector)}, not {expected[1:]}.")
            rewards = np.array(vectors)
        elif np.shape(reward) == expected:
            rewards = np.asarray(reward, dtype=np.float32)
        elif self.n_objectives == 1:
            rewards = np.asarray(reward, dtype=np.float32)
            if rewards.shape != (self.n_envs,):
                raise ValueError(
                    f"Rewards of shape {rewards.shape} where one number for each of {self.n_envs} environments is expected: "
                    "vector rewards need sb3_momba.make_mo_vec_env."
                )
            rewards = rewards[:, None]
        else:
            index = next(i for i, info in enumerate(infos) if "vector_reward" not in info)
            raise ValueError(
                f"Environment {index}: info has no 'vector_reward'. A wrapper outside PreferenceWrapper drops it: put that "
                "wrapper inside, as in Monitor(PreferenceWrapper(YourWrapper(env)))."
            )
        if not np.abs(rewards).max() <= LARGEST_REWARD:
            index, objective = np.argwhere(~(np.abs(rewards) <= LARGEST_REWARD))[0]
            raise ValueError(
                f"Environment {index}: the reward of objective {objective} is {rewards[index, objective]}: rewards must be "
                f"finite and at most {LARGEST_REWARD:g} in size. It was not stored."
            )
        return rewards

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> PreferenceReplayBufferSamples:  # type: ignore[override]
        """Uniformly, with replacement, and relabelled by eq. (3.20) where hindsight is on.

        :raises ValueError: if nothing is stored yet, or if n_relabels does not divide the batch
        """
        upper = self.buffer_size if self.full else self.pos
        if upper == 0:
            raise ValueError("The replay buffer is empty: nothing to sample.")
        if batch_size % self.n_relabels != 0:
            raise ValueError(f"batch_size={batch_size} is no multiple of n_relabels={self.n_relabels}.")
        return self._get_samples(self.rng.integers(upper, size=batch_size // self.n_relabels), env)

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None
    ) -> PreferenceReplayBufferSamples:
        if env is not None:
            raise ValueError("VecNormalize is not needed: the policy normalises observations, and rewards by their returns.")
        env_inds = self.rng.integers(self.n_envs, size=len(batch_inds)).repeat(self.n_relabels)
        batch_inds = batch_inds.repeat(self.n_relabels)
        rewards, discounts, last_inds = self._n_step_returns(batch_inds, env_inds)
        preferences = self._relabel(self.preferences[batch_inds, env_inds])
        appended = preferences[:, : self.preference_dim]
        observations = self.observations[batch_inds, env_inds]
        next_observations = self.next_observations[last_inds, env_inds]
        terminated = self._terminations(last_inds, env_inds)
        arrays = PreferenceReplayBufferSamples(
            observations=np.concatenate([observations, appended], axis=1),  # type: ignore[arg-type]
            actions=self.actions[batch_inds, env_inds],  # type: ignore[arg-type]
            next_observations=np.concatenate([next_observations, appended], axis=1),  # type: ignore[arg-type]
            dones=terminated,  # type: ignore[arg-type]
            rewards=rewards,  # type: ignore[arg-type]
            discounts=discounts,  # type: ignore[arg-type]
            preferences=preferences,  # type: ignore[arg-type]
        )
        return PreferenceReplayBufferSamples(*(th.as_tensor(array, device=self.device) for array in arrays))

    def _n_step_returns(self, batch_inds: np.ndarray, env_inds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sum of gamma^i r_{t+i} for i < n, gamma^n, and the index of the n-th transition, where n <= n_steps ends with
        the episode or with what is stored."""
        rewards = self.rewards[batch_inds, env_inds].copy()
        discounts = np.full(len(batch_inds), self.gamma, dtype=np.float32)
        last_inds = batch_inds.copy()
        newest = (self.pos - 1) % self.buffer_size
        for _ in range(self.n_steps - 1):
            goes_on = (self.dones[last_inds, env_inds] == 0) & (last_inds != newest)
            last_inds = np.where(goes_on, (last_inds + 1) % self.buffer_size, last_inds)
            rewards += np.where(goes_on, discounts, 0)[:, None] * self.rewards[last_inds, env_inds]
            discounts = np.where(goes_on, discounts * np.float32(self.gamma), discounts)
        return rewards, discounts, last_inds

    def _relabel(self, preferences: np.ndarray) -> np.ndarray:
        """Eq. (3.20): w' = w with probability p_keep, else w' ~ Dirichlet(k w), drawn in float64.

        :param preferences: w, (batch, n_objectives)
        :return: w', (batch, n_objectives)
        """
        if self.keep_probability == 1 or self.n_objectives == 1:
            return preferences
        parameters = np.maximum(self.concentration * preferences.astype(np.float64), SMALLEST_CONCENTRATION)
        relabelled = self.rng.standard_gamma(parameters)
        # Gamma draws with tiny parameters can all underflow to 0: then the preference stays.
        total = relabelled.sum(axis=1, keepdims=True)
        relabelled = np.where(total == 0, preferences, relabelled / np.where(total == 0, 1, total))
        keep = (self.rng.random(len(preferences)) < self.keep_probability)[:, None]
        if self.corner_probability > 0 and len(weights := self._corner_weights()) > 0:
            corners = self.rng.choice(weights, len(preferences))
            relabelled = np.where(self.rng.random((len(preferences), 1)) < self.corner_probability, corners, relabelled)
        return np.where(keep, preferences, relabelled).astype(np.float32)

    def _corner_weights(self) -> np.ndarray:
        """Of the newest returns, (n, n_objectives); computed only when these have changed, as it takes up to a second."""
        returns = self.newest_returns()
        if not np.array_equal(returns, self._returns):
            self._returns = returns
            self._corners = corner_weights(returns) if len(returns) > 0 else returns
        return self._corners

    def newest_returns(self) -> np.ndarray:
        """Undiscounted vector returns of the newest episodes, (n_episodes, n_objectives): at most 100 that ended within the
        last 20,000 transitions, never the oldest there of an environment. One that was cut off from outside counts as ended."""
        n_rows = min(self.size(), STEPS_OF_FRONT // self.n_envs)
        rows = np.arange(self.n_added - n_rows, self.n_added) % self.buffer_size
        sums = self.rewards[rows].astype(np.float64).cumsum(axis=0)
        ended = self.dones[rows] == 1
        most = max(EPISODES_OF_FRONT // self.n_envs, 1)
        return np.concatenate([np.diff(sums[ended[:, i], i], axis=0)[-most:] for i in range(self.n_envs)])
