"""PGMORL (Xu et al., 2020, Prediction-Guided Multi-Objective Reinforcement Learning for Continuous Robot Control), by
morl-baselines.

A population of PPO policies, one for each weight. After a warm-up each generation chooses which policies to train under which
weights, by a model that predicts what that would gain. What is recorded is the set of the policies in its archive and of those
that it trains, each played with the observation statistics it was trained with.

The library's examples judge policies by stochastic episodes with normalised, clipped and discounted rewards, in an environment
whose statistics begin anew. Here, as in the authors' code, raw returns of mean actions count, unless `library_evaluation` is
set; the steps of both are `extra_steps`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from gymnasium.wrappers.utils import update_mean_var_count_from_moments
from numpy.typing import NDArray

from sb3_momba.baselines.library import CountedSteps, hyperparameters_of, imported, quiet_and_seeded
from sb3_momba.baselines.settings import BaselineSettings, completed
from sb3_momba.baselines.solutions import SolutionSet, as_set, evaluate_policy
from sb3_momba.envs.registry import raw_id
from sb3_momba.pareto.evaluation import ParetoFront

# They change nothing in the library.
WITHOUT_EFFECT = ("num_weight_candidates", "min_weight", "max_weight")
# Of the authors' scripts: 6 policies for two objectives, 15 for three; the library's defaults are those for two.
BY_OBJECTIVES = {
    2: {"delta_weight": 0.2},
    3: {"delta_weight": 0.25, "num_performance_buffer": 20},
}
WARMUP, GENERATION = 4, 20  # of the warm-up, in generations; of a generation, in iterations, at most
LENGTH = 24  # of a training, in generations, before these grow longer: of the authors' shortest one
LEAST_POLICIES = 4
JUDGED_BY, JUDGED_FROM = 5, 1_000_000  # episodes, and the seed of the first: others than those of the record
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


def schedule(steps: int, per_iteration: int, warmup: int | None, generation: int | None) -> tuple[int, int]:
    """How many iterations the warm-up and each generation have, so that both fill a training.

    A generation is a 24th of the training, and at most 20 iterations; the warm-up is four generations, and what is left over by
    whole ones. So it is in the authors' scripts for Swimmer (40 and 10 of 244) and HalfCheetah (80 and 20 of 610).

    :param per_iteration: steps of one iteration: of an environment, times environments, times policies
    :param warmup: if it is given
    :param generation: likewise
    :raises ValueError: if they do not fill it
    """
    n = steps // per_iteration
    if steps % per_iteration:
        least = (warmup or WARMUP) + (generation or 1)
        near = " or ".join(f"{k * per_iteration:,} ({k})" for k in sorted({max(n, least), max(n + 1, least)}))
        raise ValueError(
            f"steps={steps:,} is no whole number of iterations of {per_iteration:,} steps (steps_per_iteration x num_envs x "
            f"pop_size): give {near}."
        )
    if generation is None:
        generation = max(1, min(GENERATION, round(n / LENGTH)))
    if warmup is None:
        usual = WARMUP * generation
        warmup = usual + (n - usual) % generation
    if n < warmup + generation or (n - warmup) % generation:
        possible = warmup + max(1, (n - warmup) // generation) * generation
        raise ValueError(
            f"steps={steps:,} are {n} iterations of {per_iteration:,}: behind a warm-up of {warmup} there must be whole "
            f"generations of {generation}, at least one. Give {possible * per_iteration:,} ({possible}), or set "
            "warmup_iterations and evolutionary_iterations."
        )
    return warmup, generation


class Baseline:
    """See `sb3_momba.baselines.runs.Baseline`.

    :raises ValueError: for hyperparameters that cannot be, or steps that its schedule cannot fill
    """

    general_policy = False

    def __init__(self, settings: BaselineSettings, n_objectives: int):
        library = imported("multi_policy.pgmorl.pgmorl")
        if n_objectives not in BY_OBJECTIVES:
            raise ValueError(f"{settings.env} has {n_objectives} objectives: PGMORL takes two or three.")
        self.settings, self.n_objectives = settings, n_objectives
        self.hyperparameters = self._complete(library)
        names = ("_PGMORL__train_all_agents", "_PGMORL__eval_all_agents")
        if not all(hasattr(library.PGMORL, name) for name in names):
            raise ImportError("The installed morl-baselines is not the one that this adapter knows: install version 1.3.")
        outer = self

        # The library trains in one call that no callback reaches: these are the two methods that it goes through.
        class Watched(library.PGMORL):  # type: ignore[misc, name-defined]
            def _PGMORL__train_all_agents(self, *args: Any, **kwargs: Any) -> None:  # noqa: N802
                super()._PGMORL__train_all_agents(*args, **kwargs)
                if self.global_step < outer.settings.steps:  # At the end the archive comes first.
                    outer.between_steps()

            def _PGMORL__eval_all_agents(  # noqa: N802
                self,
                eval_env: Any,
                evaluations_before_train: list[np.ndarray],
                ref_point: np.ndarray,
                known_pareto_front: Any = None,
                add_to_prediction: bool = True,
            ) -> None:
                if outer.library_evaluation:
                    super()._PGMORL__eval_all_agents(
                        eval_env, evaluations_before_train, ref_point, known_pareto_front, add_to_prediction
                    )
                else:
                    outer.judge(evaluations_before_train, add_to_prediction)
                outer.note_archive()

        self.archived: dict[int, Archived] = {}
        self.judged_steps = 0
        own = {name: value for name, value in self.hyperparameters.items() if name != "library_evaluation"}
        env_id = raw_id(settings.env)
        make_one = imported("single_policy.ser.mo_ppo").make_env
        device = "auto" if settings.device == "auto" else th.device(settings.device)
        with quiet_and_seeded(settings.seed):
            try:
                self.agent = Watched(env_id, np.zeros(n_objectives), log=False, seed=settings.seed, device=device, **own)
            except TypeError as error:
                raise ValueError(f"{settings.env} cannot be made in the way that PGMORL needs it: {error}.") from error
            self.eval_env = CountedSteps(make_one(env_id, settings.seed, 1, "evaluation", self.agent.gamma)())
        networks = self.agent.networks[0]
        self.parameters = {
            "actor": sum(p.numel() for p in networks.actor_mean.parameters()) + networks.actor_logstd.numel(),
            "critic": sum(p.numel() for p in networks.critic.parameters()),
        }

    def _complete(self, library: Any) -> dict[str, Any]:
        given = self.settings.hyperparameters
        known = hyperparameters_of(library.PGMORL, WITHOUT_EFFECT)
        known.update({**BY_OBJECTIVES[self.n_objectives], "library_evaluation": False})
        complete = completed("pgmorl", given, known)
        if not 0 < complete["delta_weight"] <= 1:
            raise ValueError(f"delta_weight={complete['delta_weight']}: give the distance of weights, between 0 and 1.")
        n_weights = len(library.generate_weights(complete["delta_weight"], self.n_objectives))
        if given.get("pop_size", n_weights) != n_weights:
            raise ValueError(
                f"pop_size={given['pop_size']}: delta_weight={complete['delta_weight']} gives {n_weights} weights, and each "
                "has a policy."
            )
        if n_weights < LEAST_POLICIES:
            raise ValueError(
                f"delta_weight={complete['delta_weight']} gives {n_weights} weights: PGMORL predicts from {LEAST_POLICIES} "
                "policies or more."
            )
        complete["pop_size"] = n_weights
        batch = complete["steps_per_iteration"] * complete["num_envs"]
        if batch % complete["num_minibatches"] or batch < 2 * complete["num_minibatches"]:
            raise ValueError(
                f"num_minibatches={complete['num_minibatches']}: they must divide the batch of steps_per_iteration x num_envs "
                f"= {batch} into parts of at least two."
            )
        complete["warmup_iterations"], complete["evolutionary_iterations"] = schedule(
            self.settings.steps,
            batch * n_weights,
            given.get("warmup_iterations"),
            given.get("evolutionary_iterations"),
        )
        return complete

    @property
    def steps(self) -> int:
        """Of the training, so far, as the library counts them: a reset of its vector environment is one."""
        return int(self.agent.global_step)

    @property
    def extra_steps(self) -> int:
        """Of the episodes that policies were judged by, so far."""
        return self.eval_env.n_steps + self.judged_steps

    @property
    def library_evaluation(self) -> bool:
        """Whether the library judges its policies itself."""
        return bool(self.hyperparameters["library_evaluation"])

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

    def train(self, between_steps: Callable[[], None]) -> None:
        """:param between_steps: called after each iteration"""
        self.between_steps = between_steps
        with quiet_and_seeded(self.settings.seed):
            self.agent.train(self.settings.steps, self.eval_env, ref_point=np.zeros(self.n_objectives))

    def judge(self, evaluations_before_train: list[np.ndarray], add_to_prediction: bool) -> None:
        """Tell population, archive and predictions what each policy that is trained earns, in raw returns.

        :param evaluations_before_train: (n_objectives,) for each; overwritten by the new ones
        :param add_to_prediction: whether the training between the two is one to learn from
        """
        agent = self.agent
        for index, policy in enumerate(agent.agents):
            played = self._evaluate(Archived(policy, self.statistics), JUDGED_BY, JUDGED_FROM)
            self.judged_steps += int(played.episode_lengths.sum())
            value = played.values[0]
            agent.population.add(policy, value)
            agent.archive.add(policy, value)
            if add_to_prediction:
                agent.predictor.add(policy.weights.detach().cpu().numpy(), evaluations_before_train[index], value)
            evaluations_before_train[index] = value

    def note_archive(self) -> None:
        """The archive's policies, copies of those that were trained, with the statistics that they were archived with."""
        new, old = self.statistics, self.archived
        self.archived = {id(policy): old.get(id(policy)) or Archived(policy, new) for policy in self.agent.archive.individuals}

    def evaluate(self, preferences: np.ndarray) -> SolutionSet:
        """Every policy in the archive, and every one that is trained.

        :param preferences: which no policy answers
        """
        archive = list(self.archived.values())
        policies = [*archive, *(Archived(policy, self.statistics) for policy in self.agent.agents)]
        weights = [one.policy.weights.tolist() for one in policies]
        return as_set([self._play(one) for one in policies], archived=len(archive), weights=weights)

    def _play(self, one: "Archived") -> ParetoFront:
        if one.played is None:
            one.played = self._evaluate(one, self.settings.n_episodes, 0)
        return one.played

    def _evaluate(self, one: "Archived", n_episodes: int, seed: int) -> ParetoFront:
        agent, network = self.agent, one.policy.networks.actor_mean
        policy = NormalizedPolicy(network, one.statistics, self.n_objectives, agent.action_space, agent.device)
        return evaluate_policy(policy, self.settings.env, self.n_objectives, n_episodes, agent.gamma, seed)

    def close(self) -> None:
        """Close the environments."""
        self.agent.env.close()
        self.eval_env.close()


@dataclass
class Archived:
    """A policy with what its observations were normalised by; `played` is what it earned, once that is known."""

    policy: Any
    statistics: Statistics
    played: ParetoFront | None = None
