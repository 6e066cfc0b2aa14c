"""What PGMORL's policies earn, and what follows from it: archive, population and what its predictions learn from."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch as th
from gymnasium.wrappers.utils import update_mean_var_count_from_moments
from numpy.typing import NDArray

from sb3_momba.baselines.solutions import SolutionSet, as_set, evaluate_policy
from sb3_momba.pareto.evaluation import ParetoFront

JUDGED_BY, JUDGED_FROM = 6, 1_000_000  # episodes, and the seed of the first: others than those of the record
CLIP, EPSILON = 10.0, 1e-8  # of the library's normalised observations


@dataclass(frozen=True)
class Statistics:
    """Of observations: mean and variance, (observation_dim,)."""

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]


class NormalizedPolicy:
    """The mean action of one of PGMORL's networks.

    :param actor_mean: network of normalised observations
    """

    def __init__(self, actor_mean: th.nn.Module, statistics: Statistics, n_objectives: int, action_space: Any, device: Any):
        self.actor_mean = actor_mean
        self.statistics = statistics
        self.n_objectives = n_objectives
        self.low, self.high = action_space.low, action_space.high
        self.device = device

    def predict(self, observation: np.ndarray, *, deterministic: bool = True) -> tuple[np.ndarray, Any]:
        """:param observation: [s, w], (batch, observation_dim + n_objectives)"""
        s = observation[:, : -self.n_objectives]
        normalized = (s - self.statistics.mean) / np.sqrt(self.statistics.variance + EPSILON)
        inputs = th.as_tensor(np.clip(normalized, -CLIP, CLIP), dtype=th.float32, device=self.device)
        with th.no_grad():
            actions = self.actor_mean(inputs).cpu().numpy()
        return np.clip(actions, self.low, self.high), None


class Judge:
    """Plays the policies of the library's PGMORL, and keeps its archive, its population and the samples of its predictions.

    As in the authors' code, the policies of every iteration may enter the archive. Those of every generation's end, and as
    often during the warm-up, enter the population, and the predictions learn what each earns beside what its parent earned:
    the member of the population that it was trained from.

    What is known of a policy is noted on its network, as the library's copies of a policy take along its network alone:
    `statistics`, by which its observations are normalised, and `earned`, when it or its parent entered the population.

    :param agent: the library's PGMORL
    :param env: id of the task
    :ivar n_steps: of the episodes that were played for judging, so far
    """

    def __init__(self, agent: Any, env: str):
        self.agent = agent
        self.env = env
        self.n_objectives = int(agent.reward_dim)
        self.n_steps = 0
        self.played: WeakKeyDictionary[Any, ParetoFront] = WeakKeyDictionary()

    @property
    def statistics(self) -> Statistics:
        """Of the observations that all policies together were trained on so far.

        Each of the library's environments has its own, which all policies share.
        """
        seen = [env.get_wrapper_attr("obs_rms") for env in self.agent.env.envs]
        mean, variance, count = seen[0].mean, seen[0].var, seen[0].count
        for other in seen[1:]:
            mean, variance, count = update_mean_var_count_from_moments(  # type: ignore[no-untyped-call]
                mean, variance, count, other.mean, other.var, other.count
            )
        return Statistics(mean.copy(), variance.copy())

    def begin(self) -> None:
        """Judge the policies that were not trained yet: they are parents, and no solutions."""
        self.note_statistics()
        for policy in self.agent.agents:
            policy.networks.earned = self._judge(policy)

    def judge(self, is_generation: bool) -> None:
        """Judge every policy after an iteration.

        :param is_generation: whether they may become parents
        """
        self.note_statistics()
        agent = self.agent
        with self.without_rollouts():
            for policy in agent.agents:
                earned = self._judge(policy)
                if is_generation:
                    agent.predictor.add(policy.weights.detach().cpu().numpy(), policy.networks.earned, earned)
                    policy.networks.earned = earned
                    agent.population.add(policy, earned)
                agent.archive.add(policy, earned)

    def note_statistics(self) -> None:
        """Say by what the observations of the policies that are trained are normalised now."""
        statistics = self.statistics
        for policy in self.agent.agents:
            policy.networks.statistics = statistics

    @contextlib.contextmanager
    def without_rollouts(self) -> Iterator[None]:
        """Copies that are made inside hold no rollout, most of a policy's memory; those that are trained behind it have one."""
        rollouts = [policy.batch for policy in self.agent.agents]
        for policy in self.agent.agents:
            policy.batch = None
        try:
            yield
        finally:
            for policy, rollout in zip(self.agent.agents, rollouts, strict=True):
                policy.batch = rollout

    def solutions(self, n_episodes: int) -> SolutionSet:
        """The archive's policies, each played once."""
        policies = self.agent.archive.individuals
        for policy in policies:
            if policy not in self.played:
                self.played[policy] = self._play(policy, n_episodes, 0)
        return as_set([self.played[policy] for policy in policies], weights=[policy.weights.tolist() for policy in policies])

    def _judge(self, policy: Any) -> NDArray[np.float64]:
        """The mean return, (n_objectives,)."""
        played = self._play(policy, JUDGED_BY, JUDGED_FROM)
        self.n_steps += int(played.episode_lengths.sum())
        return np.asarray(played.values[0])

    def _play(self, policy: Any, n_episodes: int, seed: int) -> ParetoFront:
        agent, network = self.agent, policy.networks
        player = NormalizedPolicy(network.actor_mean, network.statistics, self.n_objectives, agent.action_space, agent.device)
        return evaluate_policy(player, self.env, self.n_objectives, n_episodes, agent.gamma, seed)
