"""Evaluating the Pareto front while the model trains."""

import logging
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike
from stable_baselines3.common.callbacks import BaseCallback, EventCallback
from stable_baselines3.common.logger import Figure as LoggedFigure
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_momba.envs.preferences import check_preference, preference_grid
from sb3_momba.envs.registry import copies_of
from sb3_momba.files import atomic_write
from sb3_momba.pareto.evaluation import MAX_PARALLEL_EPISODES, ParetoFront, check_model_fits, evaluate_front, probe_environment
from sb3_momba.pareto.metrics import hypervolume
from sb3_momba.pareto.plotting import plot_front
from sb3_momba.pareto.protocol import N_EPISODES, N_PREFERENCES
from sb3_momba.recording import RecordWriter

STATE = (
    *("next_evaluation", "go_on", "is_evaluated", "timesteps", "metrics", "values", "evaluation_seconds"),
    *("last_mean_reward", "best_mean_reward", "best_score", "warned_of_reference_point"),
)

# The second one does not notice what else the machine is doing.
CLOCKS = {"seconds": time.perf_counter, "cpu_seconds": time.process_time}

logger = logging.getLogger(__name__)


class ParetoEvalCallback(EventCallback):
    """Evaluate the front every `eval_freq` environment steps and at the end of the training, each time after the updates
    that belong to those steps.

    Records `pareto/hypervolume`, `pareto/expected_utility`, `pareto/preference_regret` and `pareto/n_non_dominated`, and
    the front's picture where the logger takes figures. `last_mean_reward` and `best_mean_reward` are hypervolumes (mean
    returns where there is one objective), so that callbacks made for SB3's EvalCallback work.

    :param eval_env: id, callable, environment or VecEnv; see `evaluate_front`. By default copies of the training environment,
        which must come from an id, and its wrappers from Gymnasium's recordable ones
    :param eval_freq: environment steps, over all training environments
    :param n_preferences: how many equally spaced preferences; see `preference_grid`
    :param n_episodes: per preference
    :param seed: of each preference's first episode, the same in every evaluation
    :param reference_point: of the hypervolume, (n_objectives,); 0 by default
    :param deterministic: the policy's mean action instead of a sample
    :param log_path: folder for `pareto_evaluations.npz`, `front.npz` and `front.png`
    :param best_model_save_path: folder for `best_model.zip`, the model of the largest hypervolume
    :param callback_on_new_best: called after each new best hypervolume
    :param callback_after_eval: called after each evaluation; may stop the training
    :param objectives: names of the picture's axes, n_objectives of them
    :param n_workers: processes that share the episodes of an evaluation
    :param verbose: 1 prints a line for each evaluation
    :param preferences: to evaluate instead, (P, n_objectives), each on the simplex
    :param n_envs: copies of the environment in each process, at most
    :raises ValueError: for eval_freq, n_episodes, n_workers or n_envs below 1; when the training starts, for what `check`
        finds, or an eval_env that is the training environment
    """

    def __init__(
        self,
        eval_env: str | gym.Env | VecEnv | Callable[[], gym.Env] | None = None,
        eval_freq: int = 50_000,
        n_preferences: int = N_PREFERENCES,
        n_episodes: int = N_EPISODES,
        seed: int = 0,
        reference_point: ArrayLike | None = None,
        deterministic: bool = True,
        log_path: str | os.PathLike[str] | None = None,
        best_model_save_path: str | os.PathLike[str] | None = None,
        callback_on_new_best: BaseCallback | None = None,
        callback_after_eval: BaseCallback | None = None,
        objectives: list[str] | None = None,
        n_workers: int = 1,
        verbose: int = 0,
        preferences: ArrayLike | None = None,
        n_envs: int = MAX_PARALLEL_EPISODES,
    ):
        super().__init__(callback_after_eval, verbose=verbose)
        if eval_freq < 1:
            raise ValueError(f"eval_freq={eval_freq}: give the number of environment steps between evaluations.")
        if n_episodes < 1:
            raise ValueError(f"n_episodes={n_episodes}: at least one episode is needed.")
        if n_workers < 1:
            raise ValueError(f"n_workers={n_workers}: at least one process is needed.")
        if n_envs < 1:
            raise ValueError(f"n_envs={n_envs}: at least one copy of the environment is needed.")
        self.eval_env = eval_env
        self.copies_training_env = eval_env is None
        self.eval_freq = int(eval_freq)
        self.evaluation_kwargs: dict[str, Any] = {
            "n_preferences": n_preferences,
            "n_episodes": n_episodes,
            "seed": seed,
            "deterministic": deterministic,
            "n_workers": n_workers,
            "preferences": preferences,
            "n_envs": n_envs,
        }
        self.reference_point = reference_point
        self.log_path = None if log_path is None else Path(log_path)
        self.best_model_save_path = None if best_model_save_path is None else Path(best_model_save_path)
        self.callback_on_new_best = callback_on_new_best
        self.objectives = objectives
        self.front: ParetoFront | None = None
        self.timesteps: list[int] = []
        self.metrics: list[dict[str, float]] = []
        self.values: list[np.ndarray] = []
        self.evaluation_seconds = dict.fromkeys(CLOCKS, 0.0)
        self.last_mean_reward = -np.inf
        self.best_mean_reward = -np.inf
        self.best_score = (-np.inf, -np.inf)  # hypervolume, then expected utility
        self.warned_of_reference_point = False
        self.is_evaluated = True  # whether the model of this moment is; there is none yet

    def _init_callback(self) -> None:
        if self.eval_env is not None and shares_environment(self.eval_env, self.training_env):
            raise ValueError("eval_env is the training environment, whose episodes an evaluation would end: give it its own.")
        self.check(self.model)
        self.next_evaluation = (self.model.num_timesteps // self.eval_freq + 1) * self.eval_freq
        self.go_on = True
        self.is_evaluated = False
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.parent = self
            self.callback_on_new_best.init_callback(self.model)

    def check(self, model: Any) -> None:
        """Find out before a long training what an evaluation would stumble over.

        :raises ValueError: for an environment, a reference point or names that do not fit the model
        """
        if self.copies_training_env:
            try:
                self.eval_env = copies_of(model.get_env())
            except ValueError as error:
                raise ValueError(f"{error} Give ParetoEvalCallback an eval_env, such as an id.") from error
        assert self.eval_env is not None
        n_objectives = check_model_fits(model, probe_environment(self.eval_env))
        if self.evaluation_kwargs["preferences"] is None:
            preference_grid(n_objectives, self.evaluation_kwargs["n_preferences"])
        else:
            check_preference(np.atleast_2d(self.evaluation_kwargs["preferences"]), n_objectives)
        if self.reference_point is not None:
            hypervolume(np.zeros((1, n_objectives)), self.reference_point)
        if self.objectives is not None and len(self.objectives) != n_objectives:
            raise ValueError(f"objectives={self.objectives}: {n_objectives} names are needed, one per objective.")

    @property
    def scores(self) -> list[float]:
        """Of each evaluation, what `last_mean_reward` was: hypervolumes, or mean returns where there is one objective."""
        # With one objective the hypervolume above 0 says nothing that the mean return does not.
        is_vector = self.front is not None and self.front.n_objectives > 1
        return [measured["hypervolume" if is_vector else "expected_utility"] for measured in self.metrics]

    def state_dict(self) -> dict[str, Any]:
        """For a checkpoint: what has been measured, the newest front among it, and when to measure next."""
        front = None if self.front is None else vars(self.front)
        return {"front": front, **{name: getattr(self, name) for name in STATE}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what `state_dict` gave.

        :raises KeyError: if something is missing in it
        """
        self.front = None if state["front"] is None else ParetoFront(**state["front"])
        for name in STATE:
            setattr(self, name, state[name])

    def _on_rollout_start(self) -> None:
        # Only here have the last transition and the updates that follow it been made.
        if self.model.num_timesteps >= self.next_evaluation:
            self.next_evaluation = (self.model.num_timesteps // self.eval_freq + 1) * self.eval_freq
            self.go_on = self._evaluate()

    def _on_step(self) -> bool:
        self.is_evaluated = self.is_evaluated and not self.go_on
        return self.go_on

    def _on_training_end(self) -> None:
        if not self.is_evaluated:
            self._evaluate()

    def _evaluate(self) -> bool:
        """Measure, log and write the front; False where a callback wants the training to stop."""
        started = {name: clock() for name, clock in CLOCKS.items()}
        self.num_timesteps = self.model.num_timesteps
        self.is_evaluated = True
        self.front = front = evaluate_front(self.model, self.eval_env, **self.evaluation_kwargs)  # type: ignore[arg-type]
        measured = front.metrics(self.reference_point)
        self.timesteps.append(self.num_timesteps)
        self.metrics.append(measured)
        self.values.append(front.values)
        self.last_mean_reward = self.scores[-1]
        score = (self.last_mean_reward, measured["expected_utility"])
        if front.n_objectives > 1 and measured["hypervolume"] == 0 and not self.warned_of_reference_point:
            self.warned_of_reference_point = True
            logger.warning(
                "No value lies above the reference point %s: the hypervolume is 0, and the best model that of the largest "
                "expected utility. Give reference_point= (--reference-point) a point that is worse than what policies reach.",
                np.zeros(front.n_objectives).tolist() if self.reference_point is None else self.reference_point,
            )
        if self.verbose >= 1:
            print(f"Front at {self.num_timesteps:,} steps:", ", ".join(f"{k} {v:,.6g}" for k, v in measured.items()))
        if self.log_path is not None:
            self._write(front)
        self._log(front, measured)

        continue_training = True
        if score > self.best_score:
            self.best_score, self.best_mean_reward = score, self.last_mean_reward
            if self.best_model_save_path is not None:
                self.model.save(self.best_model_save_path / "best_model.zip")
            if self.callback_on_new_best is not None:
                continue_training = self.callback_on_new_best.on_step()
        for name, clock in CLOCKS.items():
            self.evaluation_seconds[name] += clock() - started[name]
        if self.callback is not None:
            continue_training = self._on_event() and continue_training
        return continue_training

    def _log(self, front: ParetoFront, measured: dict[str, float]) -> None:
        for name, value in measured.items():
            self.logger.record(f"pareto/{name}", value)
        if front.n_objectives in (2, 3):
            title = f"{front.settings['env']}, {self.num_timesteps:,} steps"
            path = None if self.log_path is None else self.log_path / "front.png"
            picture = LoggedFigure(plot_front(front, path, self.objectives, title), close=True)
            self.logger.record("pareto/front", picture, exclude=("stdout", "log", "json", "csv"))
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)

    def _write(self, front: ParetoFront) -> None:
        assert self.log_path is not None
        front.save(self.log_path / "front.npz")
        arrays = {name: np.array([m[name] for m in self.metrics]) for name in self.metrics[0]}
        arrays["timesteps"] = np.array(self.timesteps)
        arrays["preferences"] = front.preferences
        arrays["values"] = np.stack(self.values)  # (evaluations, P, n_objectives)
        with atomic_write(self.log_path / "pareto_evaluations.npz") as file:
            np.savez(file, allow_pickle=False, **arrays)


class RecordCallback(BaseCallback):
    """Appends each evaluation to a run's record: the `callback_after_eval` of a ParetoEvalCallback."""

    parent: ParetoEvalCallback

    def __init__(self, record: RecordWriter):
        super().__init__()
        self.record = record
        self.before = dict.fromkeys(CLOCKS, 0.0)

    def _on_training_start(self) -> None:
        spent = self.parent.evaluation_seconds
        self.started = {name: clock() - spent[name] - self.before[name] for name, clock in CLOCKS.items()}

    @property
    def seconds(self) -> dict[str, float]:
        """Of training so far, without evaluations: by the wall, and of this process's cores, unless others work for it."""
        spent = self.parent.evaluation_seconds
        noted = {name: round(clock() - self.started[name] - spent[name], 3) for name, clock in CLOCKS.items()}
        if isinstance(self.training_env.unwrapped, SubprocVecEnv):
            del noted["cpu_seconds"]
        return noted

    def state_dict(self) -> dict[str, Any]:
        return {"seconds": self.seconds}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.before = {**self.before, **state["seconds"]}

    def _on_step(self) -> bool:
        self.record.append(
            "evaluation",
            steps=self.parent.num_timesteps,
            **self.seconds,
            evaluation_seconds=round(self.parent.evaluation_seconds["seconds"], 3),
            **self.parent.metrics[-1],
            values=self.parent.values[-1],
        )
        return True


def shares_environment(env: Any, venv: VecEnv) -> bool:
    """Whether stepping `env` would step one of the environments of `venv` in this process."""
    if isinstance(env, VecEnv):
        return env.unwrapped is venv.unwrapped
    return isinstance(env, gym.Env) and any(one.unwrapped is env.unwrapped for one in getattr(venv.unwrapped, "envs", []))
