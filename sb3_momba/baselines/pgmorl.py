"""PGMORL (Xu et al., 2020, Prediction-Guided Multi-Objective Reinforcement Learning for Continuous Robot Control), by
morl-baselines.

A population of PPO policies, one for each weight. After a warm-up each generation chooses which policies to train under which
weights, by a model that predicts what that would gain. What is recorded is the archive: of all policies that were judged those
that no other one dominates, each played with the observation statistics it was trained with.

The library's examples judge policies by stochastic episodes with normalised, clipped and discounted rewards, in an environment
whose statistics begin anew. Here, as in the authors' code, raw returns of mean actions count, of every iteration (see
`sb3_momba.baselines.judging`), unless `library_evaluation` is set; the steps of both are `extra_steps`.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from sb3_momba.baselines.judging import Judge
from sb3_momba.baselines.library import CountedSteps, hyperparameters_of, imported, quiet_and_seeded
from sb3_momba.baselines.schedules import iterations, schedule, script_of
from sb3_momba.baselines.settings import BaselineSettings, completed, device_of
from sb3_momba.baselines.solutions import SolutionSet
from sb3_momba.envs.registry import raw_id

# They change nothing in the library.
WITHOUT_EFFECT = ("num_weight_candidates", "min_weight", "max_weight")
# Of the authors' scripts: 6 policies for two objectives, 15 for three; the library's defaults are those for two.
BY_OBJECTIVES = {
    2: {"delta_weight": 0.2},
    3: {"delta_weight": 0.25, "num_performance_buffer": 20, "sparsity_coef": -1e6},
}
LEAST_POLICIES = 4
OF_THE_LIBRARY = ("_PGMORL__train_all_agents", "_PGMORL__eval_all_agents", "_PGMORL__task_weight_selection")


@contextlib.contextmanager
def remembered_predictions(predictor: Any) -> Iterator[None]:
    """The library asks for the same predictions once for each policy that it chooses, and each takes milliseconds."""
    predict, known = predictor.predict_next_evaluation, dict[tuple[bytes, bytes], Any]()

    def remembered(weight: np.ndarray, evaluation: np.ndarray) -> Any:
        key = (weight.tobytes(), evaluation.tobytes())
        if key not in known:
            known[key] = predict(weight, evaluation)
        return known[key]

    predictor.predict_next_evaluation = remembered
    try:
        yield
    finally:
        del predictor.predict_next_evaluation  # The method of its class is there again.


def begin_as_the_authors_do(networks: Any, layer_init: Callable[..., None]) -> None:
    """The library begins with mean actions of about 0 (gains of the last layers: 0.01 for the actor, 1 for the critic): where
    that is standing still, short trainings never leave it.

    :param networks: of one policy
    :param layer_init: the library's
    """
    layer_init(networks.actor_mean[-1], weight_gain=1.0)
    layer_init(networks.critic[-1], weight_gain=np.sqrt(2))


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
        if not all(hasattr(library.PGMORL, name) for name in OF_THE_LIBRARY):
            raise ImportError("The installed morl-baselines is not the one that this adapter knows: install version 1.3.")
        outer = self

        # The library trains in one call that no callback reaches: these are the methods that it goes through.
        class Watched(library.PGMORL):  # type: ignore[misc, name-defined]
            def _PGMORL__train_all_agents(self, *args: Any, **kwargs: Any) -> None:  # noqa: N802
                super()._PGMORL__train_all_agents(*args, **kwargs)
                if not outer.library_evaluation:
                    outer.judge.judge(outer.is_generation)
                if self.global_step < outer.settings.steps:  # At the end the library's own evaluation comes first.
                    outer.between_steps()

            def _PGMORL__eval_all_agents(self, *args: Any, **kwargs: Any) -> None:  # noqa: N802
                if outer.library_evaluation:
                    outer.judge.note_statistics()
                    with outer.judge.without_rollouts():
                        super()._PGMORL__eval_all_agents(*args, **kwargs)
                elif self.global_step == 0:
                    outer.judge.begin()

            def _PGMORL__task_weight_selection(self, *args: Any, **kwargs: Any) -> None:  # noqa: N802
                with outer.judge.without_rollouts(), remembered_predictions(self.predictor):
                    super()._PGMORL__task_weight_selection(*args, **kwargs)
                for policy in self.agents:  # Copies have a seed of the library's, the same in every run.
                    policy.seed, policy.np_random = self.seed, self.np_random
                of_generation = int(outer.hyperparameters["evolutionary_iterations"])
                self.evolutionary_iterations = min(of_generation, outer.n_iterations - outer.iteration)

        own = {name: value for name, value in self.hyperparameters.items() if name != "library_evaluation"}
        env_id = raw_id(settings.env)
        make_one = imported("single_policy.ser.mo_ppo").make_env
        device = device_of(settings.device)
        with quiet_and_seeded(settings.seed):
            try:
                self.agent = Watched(env_id, np.zeros(n_objectives), log=False, seed=settings.seed, device=device, **own)
            except TypeError as error:
                raise ValueError(f"{settings.env} cannot be made in the way that PGMORL needs it: {error}.") from error
            for networks in self.agent.networks:
                begin_as_the_authors_do(networks, imported("common.networks").layer_init)
            self.eval_env = CountedSteps(make_one(env_id, settings.seed, 1, "evaluation", self.agent.gamma)())
        self.judge = Judge(self.agent, settings.env)
        networks = self.agent.networks[0]
        self.parameters = {
            "actor": sum(p.numel() for p in networks.actor_mean.parameters()) + networks.actor_logstd.numel(),
            "critic": sum(p.numel() for p in networks.critic.parameters()),
        }

    def _complete(self, library: Any) -> dict[str, Any]:
        given = self.settings.hyperparameters
        script = script_of(self.settings.env)
        known = hyperparameters_of(library.PGMORL, WITHOUT_EFFECT)
        known.update({**BY_OBJECTIVES[self.n_objectives], "library_evaluation": False})
        known.update({"anneal_lr": True, "num_envs": script.num_envs, "gamma": script.gamma})
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
                "policies or more, and delta_weight must divide 1."
            )
        complete["pop_size"] = n_weights
        batch = complete["steps_per_iteration"] * complete["num_envs"]
        if batch % complete["num_minibatches"] or batch < 2 * complete["num_minibatches"]:
            raise ValueError(
                f"num_minibatches={complete['num_minibatches']}: they must divide the batch of steps_per_iteration x num_envs "
                f"= {batch} into parts of at least two."
            )
        self.n_iterations = iterations(self.settings.steps, batch * n_weights)
        complete["warmup_iterations"], complete["evolutionary_iterations"] = schedule(
            self.n_iterations, script, given.get("warmup_iterations"), given.get("evolutionary_iterations")
        )
        return complete

    @property
    def iteration(self) -> int:
        """How many iterations of all policies there were so far."""
        return self.steps * self.n_iterations // self.settings.steps

    @property
    def is_generation(self) -> bool:
        """Whether a generation ends here, or one would if the warm-up consisted of them."""
        warmup, generation = (self.hyperparameters[f"{name}_iterations"] for name in ("warmup", "evolutionary"))
        return (self.iteration - (warmup if self.iteration > warmup else 0)) % int(generation) == 0

    @property
    def steps(self) -> int:
        """Of the training, so far, as the library counts them: a reset of its vector environment is one."""
        return int(self.agent.global_step)

    @property
    def extra_steps(self) -> int:
        """Of the episodes that policies were judged by, so far."""
        return self.eval_env.n_steps + self.judge.n_steps

    @property
    def library_evaluation(self) -> bool:
        """Whether the library judges its policies itself."""
        return bool(self.hyperparameters["library_evaluation"])

    def train(self, between_steps: Callable[[], None]) -> None:
        """:param between_steps: called after each iteration"""
        self.between_steps = between_steps
        with quiet_and_seeded(self.settings.seed):
            self.agent.train(self.settings.steps, self.eval_env, ref_point=np.zeros(self.n_objectives))

    def evaluate(self, preferences: np.ndarray) -> SolutionSet:
        """Every policy in the archive.

        :param preferences: which no policy answers
        """
        return self.judge.solutions(self.settings.n_episodes)

    def close(self) -> None:
        """Close the environments."""
        self.agent.env.close()
        self.eval_env.close()
