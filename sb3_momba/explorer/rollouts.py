"""What a policy earns and how it moves under some preferences: the numbers of `evaluate_front`, and what only looks on."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_momba import MOMBA
from sb3_momba.envs.wrappers import make_env
from sb3_momba.explorer.rendering import Policy, load_model
from sb3_momba.pareto.evaluation import MAX_PARALLEL_EPISODES, ParetoFront, probe_environment, run_jobs

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]


@dataclass(frozen=True)
class Rollouts:
    """Episodes of one policy under P preferences.

    :param front: what they returned
    :param behaviour: of each preference, (P, F): the mean of each observation and action, then the standard deviation of each,
        over the steps of all episodes
    :param entropy_bonus: by how much a soft value at the episodes' starts exceeds the return, in the units of the rewards, (P,)
    :param starts: the first observations, (E, observation_dim)
    """

    front: ParetoFront
    behaviour: Array
    entropy_bonus: Array
    starts: Array32


class Diary(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps what the first episode after the last reset saw and did, until another one begins."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.observations: list[Array32] = []
        self.actions: list[Array32] = []
        self.is_over = self.is_truncated = False

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """The environment's."""
        observation, info = self.env.reset(**kwargs)
        self.latest = np.array(observation, dtype=np.float32)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """The environment's."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if not self.is_over:
            self.observations.append(self.latest)
            self.actions.append(np.array(action, dtype=np.float32))
            self.latest = np.array(observation, dtype=np.float32)
            self.is_over, self.is_truncated = terminated or truncated, truncated and not terminated
        return observation, reward, terminated, truncated, info


def roll_out(policy: Policy, preferences: Array, n_episodes: int, seed: int) -> Rollouts:
    """Episodes under each preference, as `evaluate_front` runs them, with the same numbers.

    :param preferences: (P, n_objectives)
    :param seed: of each preference's first episode
    """
    model = load_model(policy.path)
    if policy.deterministic and probe_environment(policy.env, policy.env_kwargs).deterministic:
        n_episodes = 1
    jobs = [(k * n_episodes + e, w, seed + e) for k, w in enumerate(preferences.astype(np.float32)) for e in range(n_episodes)]
    results, behaviours, bonuses, starts = [], [], [], []
    for first in range(0, len(jobs), MAX_PARALLEL_EPISODES):
        diaries: list[Diary] = []

        def kept(diaries: list[Diary] = diaries) -> gym.Env:
            diaries.append(Diary(make_env(policy.env, policy.env_kwargs)))
            return diaries[-1]

        some = jobs[first : first + MAX_PARALLEL_EPISODES]
        results.append(run_jobs(model, kept, None, some, model.gamma, policy.deterministic))
        for diary, (number, w, _) in zip(diaries, some, strict=True):
            observations, actions = np.stack(diary.observations), np.stack(diary.actions)
            moves = np.concatenate([observations, actions], axis=1).astype(np.float64)
            behaviours.append(np.concatenate([moves.mean(axis=0), moves.std(axis=0)]))
            bonuses.append(entropy_bonus(model, observations, w, diary.is_truncated))
            if number < n_episodes:
                starts.append(observations[0])
    returns, discounted, lengths = (np.concatenate(parts) for parts in zip(*results, strict=True))
    shape = (len(preferences), n_episodes)
    settings = {"env": policy.env, "seed": seed, "gamma": model.gamma, "deterministic_policy": policy.deterministic}
    front = ParetoFront(
        preferences, returns.reshape(*shape, -1), discounted.reshape(*shape, -1), lengths.reshape(shape), settings
    )
    behaviour = np.reshape(behaviours, (*shape, -1)).mean(axis=1)
    return Rollouts(front, behaviour, np.reshape(bonuses, shape).mean(axis=1), np.stack(starts))


@th.no_grad()
def entropy_bonus(model: MOMBA, observations: Array32, preference: Array32, is_truncated: bool) -> float:
    """alpha sum_{t >= 1} gamma^t H(pi(. | s_t, w)) along one episode, in the units of the rewards: the entropy part of a soft
    Q(s_0, a_0, w) (eq. 3.1), which in eq. (3.3) enters every objective alike.

    H is estimated by -log pi of one sampled action per step. A time limit does not end what critics learn: behind one, the
    mean entropy goes on for ever.

    :param observations: s_t, (T, observation_dim)
    """
    s = np.concatenate([observations, np.broadcast_to(preference, (len(observations), len(preference)))], axis=1)
    with th.random.fork_rng():
        th.manual_seed(0)
        _, log_prob = model.actor.action_log_prob(model.policy.normalize(th.from_numpy(s)))
    entropy = -log_prob.double().numpy()
    discounts = model.gamma ** np.arange(len(entropy))
    total = float((discounts * entropy)[1:].sum())
    if is_truncated and model.gamma < 1:
        total += float(model.gamma ** len(entropy) / (1 - model.gamma) * entropy.mean())
    return float(model.alpha) * total / model.policy.return_scale.factor


@th.no_grad()
def critic_returns(model: MOMBA, starts: Array32, preferences: Array, bonus: Array) -> Array:
    """What a vector critic expects of episodes under each preference: its mean over the ensemble and the starts, of the
    policy's mean action, less the entropy's part (eq. 3.1) and in the units of the rewards.

    :param starts: first observations, (E, observation_dim)
    :param preferences: (n, n_objectives)
    :param bonus: of each preference, in the units of the rewards, (n,)
    :return: discounted returns, (n, n_objectives)
    """
    n, n_starts = len(preferences), len(starts)
    pairs = np.concatenate([np.tile(starts, (n, 1)), np.repeat(preferences, n_starts, axis=0)], axis=1).astype(np.float32)
    s = model.policy.normalize(th.from_numpy(pairs))
    q = model.policy.value.mean(model.critic(s, model.actor(s, deterministic=True)))  # (n E, n_critics, n_objectives)
    expected = q.double().mean(dim=1).numpy().reshape(n, n_starts, -1).mean(axis=1)
    return np.asarray(expected / model.policy.return_scale.factor - bonus[:, None])
