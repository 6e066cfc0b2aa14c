"""What a policy earns and how it moves under some preferences: the numbers of `evaluate_front`, and what only looks on."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_momba import MOMBA
from sb3_momba.envs.making import make_env
from sb3_momba.explorer.rendering import Policy, Recorder, load_model
from sb3_momba.pareto.evaluation import MAX_PARALLEL_EPISODES, ParetoFront, probe_environment, run_jobs

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]


@dataclass(frozen=True)
class Rollouts:
    """Episodes of one policy under P preferences.

    :param front: what they returned
    :param behaviour: of each preference, (P, F): the mean of each observation and action, then the standard deviation of each,
        over the steps of all episodes
    :param excess: `critic_excess` of each preference, (P, n_objectives)
    :param starts: the first observations, (E, observation_dim)
    """

    front: ParetoFront
    behaviour: Array
    excess: Array
    starts: Array32


def roll_out(policy: Policy, preferences: Array, n_episodes: int, seed: int) -> Rollouts:
    """Episodes under each preference, as `evaluate_front` runs them, with the same numbers.

    :param preferences: (P, n_objectives)
    :param seed: of each preference's first episode
    """
    model = load_model(policy.path)
    if policy.deterministic and probe_environment(policy.env, policy.env_kwargs).deterministic:
        n_episodes = 1
    jobs = [(k * n_episodes + e, w, seed + e) for k, w in enumerate(preferences.astype(np.float32)) for e in range(n_episodes)]
    results, behaviours, excesses, starts = [], [], [], []
    for first in range(0, len(jobs), MAX_PARALLEL_EPISODES):
        recorders: list[Recorder] = []

        def recorded(recorders: list[Recorder] = recorders) -> gym.Env:
            recorders.append(Recorder(make_env(policy.env, policy.env_kwargs)))
            return recorders[-1]

        some = jobs[first : first + MAX_PARALLEL_EPISODES]
        results.append(run_jobs(model, recorded, None, some, model.gamma, policy.deterministic))
        for recorder, (number, w, _) in zip(recorders, some, strict=True):
            observations, actions = np.stack(recorder.observations), np.stack(recorder.actions)
            moves = np.concatenate([observations[:-1], actions], axis=1).astype(np.float64)
            behaviours.append(np.concatenate([moves.mean(axis=0), moves.std(axis=0)]))
            excesses.append(critic_excess(model, observations, w, recorder.is_truncated))
            if number < n_episodes:
                starts.append(observations[0])
    returns, discounted, lengths = (np.concatenate(parts) for parts in zip(*results, strict=True))
    shape = (len(preferences), n_episodes)
    settings = {"env": policy.env, "seed": seed, "gamma": model.gamma, "deterministic_policy": policy.deterministic}
    front = ParetoFront(
        preferences, returns.reshape(*shape, -1), discounted.reshape(*shape, -1), lengths.reshape(shape), settings
    )
    behaviour, excess = (np.reshape(found, (*shape, -1)).mean(axis=1) for found in (behaviours, excesses))
    return Rollouts(front, behaviour, excess, np.stack(starts))


@th.no_grad()
def critic_excess(model: MOMBA, observations: Array32, preference: Array32, is_truncated: bool) -> Array:
    """By how much a critic's values at the start of an episode exceed its discounted return if they are right, in the units of
    the rewards: with H(s) = H(pi(. | s, w)) and n-step returns, Q(s_0, a_0, w) of eq. (3.1) holds

        alpha sum_{k >= 1, k n < T} gamma^{k n} H(s_{k n}), as entropy enters once for each bootstrap (eq. 3.3), and
        gamma^T (Q(s_T, a_T, w) + alpha H(s_T)) behind a time limit, which does not end what critics learn.

    H is estimated by -log pi of one sampled action per step; a_T is the mean action, as rollouts play it.

    :param observations: s_0 to s_T, (T + 1, observation_dim)
    :param preference: w, (n_objectives,)
    :param is_truncated: whether a time limit ended the episode
    :return: (n_objectives,), or (1,) for a critic of the scalarised return
    """
    last = len(observations) - 1
    s = np.concatenate([observations, np.broadcast_to(preference, (last + 1, len(preference)))], axis=1)
    with th.random.fork_rng():
        th.manual_seed(0)
        _, log_prob = model.actor.action_log_prob(model.policy.normalize(th.from_numpy(s)))
    steps = np.arange(last + 1)
    is_counted = (steps > 0) & (steps < last) & (steps % model.n_steps == 0)
    is_counted[last] = is_truncated
    bonuses = -float(model.alpha) * log_prob.double().numpy() * model.gamma**steps
    behind = is_truncated * model.gamma**last * critic_values(model, observations[last:], preference[None])[0]
    return np.asarray(bonuses[is_counted].sum() / model.policy.reward_factor + behind)


@th.no_grad()
def critic_values(model: MOMBA, starts: Array32, preferences: NDArray[Any]) -> Array:
    """What a critic expects from some observations on, under each preference, of the policy's mean action: the mean over the
    ensemble and the observations, in the units of the rewards.

    A critic learns the values of the policy that samples its actions; the mean action may earn more or less.

    :param starts: (E, observation_dim)
    :param preferences: (n, n_objectives)
    :return: (n, n_objectives), or (n, 1) for a critic of the scalarised return
    """
    n, n_starts = len(preferences), len(starts)
    pairs = np.concatenate([np.tile(starts, (n, 1)), np.repeat(preferences, n_starts, axis=0)], axis=1).astype(np.float32)
    s = model.policy.normalize(th.from_numpy(pairs))
    q = model.policy.value.mean(model.critic(s, model.actor(s, deterministic=True)))  # (n E, n_critics, n_objectives)
    expected = q.double().mean(dim=1).numpy().reshape(n, n_starts, -1).mean(axis=1)
    return model.policy.in_reward_units(expected, preferences)
