"""MOMBA among rl_zoo3's algorithms, and what its experiments do otherwise than rl_zoo3's own. Needs the extra `zoo`."""

from functools import partial
from pathlib import Path
from typing import Any

import optuna
from huggingface_sb3 import EnvironmentName
from rl_zoo3 import ALGOS, exp_manager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_momba.envs.workers import WatchedSubprocVecEnv
from sb3_momba.momba import MOMBA
from sb3_momba.nn.descent import NonFiniteLossError
from sb3_momba.pareto.callbacks import ParetoEvalCallback
from sb3_momba.zoo.configuration import N_TIMESTEPS, check_classes, check_entry, find_entry, with_schedules
from sb3_momba.zoo.evaluation import EvaluationsFile, TrialEvalCallback, ZooEvalCallback
from sb3_momba.zoo.tuning import convert_params, sample_params

NAME = "momba"
MODULE: Any = exp_manager  # whose callbacks are replaced


def register() -> None:
    """Make `--algo momba` known to rl_zoo3."""
    ALGOS[NAME] = MOMBA
    HYPERPARAMS_SAMPLER[NAME] = sample_params
    HYPERPARAMS_CONVERTER[NAME] = convert_params  # type: ignore[assignment]


class MombaExperimentManager(exp_manager.ExperimentManager):
    """rl_zoo3's, with hyperparameters read as `python -m sb3_momba.train --conf` reads them, and fronts evaluated instead of
    mean rewards.

    Where the yaml file names a ParetoEvalCallback, that one evaluates, in trials with its preferences, its reference point
    and its number of episodes.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if self.vec_env_class is SubprocVecEnv:
            self.vec_env_class = WatchedSubprocVecEnv

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """rl_zoo3's, checked and with numbers for numbers; entries may have the raw id.

        :raises ValueError: for unknown names, with the nearest known one, and for classes that are no callbacks or wrappers
        """
        task = self.env_name
        if self.config.endswith((".yml", ".yaml")):
            self.env_name = EnvironmentName(find_entry(self.config, task.gym_id)[0])
        try:
            given, _ = super().read_hyperparameters()
        finally:
            self.env_name = task
        try:
            entry = check_entry(given)
            check_classes(entry)
        except ValueError as error:
            raise ValueError(f"{self.config}, or -params: {error}") from error
        entry.setdefault("n_timesteps", N_TIMESTEPS)
        if not self.eval_env_kwargs:
            self.eval_env_kwargs = entry.get("env_kwargs") or {}
        return entry, dict(sorted(entry.items()))

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        """SB3's own schedules, which our files can store."""
        return with_schedules(hyperparams)

    def create_callbacks(self) -> None:
        """rl_zoo3's; evaluations and their best model go into the run's folder."""
        named = [callback for callback in self.callbacks if isinstance(callback, ParetoEvalCallback)]
        settings: dict[str, Any] = {}
        if named:
            self.eval_freq = -1
            kwargs = named[0].evaluation_kwargs
            settings = {name: kwargs[name] for name in ("n_preferences", "preferences")}
            settings["reference_point"] = named[0].reference_point
            self.n_eval_episodes = kwargs["n_episodes"]
        MODULE.EvalCallback = ZooEvalCallback
        MODULE.TrialEvalCallback = partial(TrialEvalCallback, **settings)
        if self.optimize_hyperparameters:
            listed = self.specified_callbacks if isinstance(self.specified_callbacks, list) else [self.specified_callbacks]
            self.specified_callbacks = [entry for entry, made in zip(listed, self.callbacks, strict=False) if made not in named]
        super().create_callbacks()  # type: ignore[no-untyped-call]
        folder = Path(self.save_path)
        for callback in self.callbacks:
            if isinstance(callback, ParetoEvalCallback):
                callback.log_path = callback.log_path or folder
                callback.best_model_save_path = callback.best_model_save_path or folder
                if callback.callback is None:
                    callback.callback = EvaluationsFile(folder / "evaluations.npz", callback)

    def objective(self, trial: optuna.Trial) -> float:
        """rl_zoo3's; a training that diverges is a pruned trial."""
        try:
            return super().objective(trial)
        except NonFiniteLossError as error:
            raise optuna.TrialPruned(str(error)) from error
