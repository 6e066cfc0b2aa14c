"""The callbacks that stand where rl_zoo3 evaluates: scores are hypervolumes instead of mean rewards."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_momba.envs.registry import copies_of
from sb3_momba.files import atomic_write
from sb3_momba.pareto.callbacks import ParetoEvalCallback

if TYPE_CHECKING:
    import optuna

N_PREFERENCES = 20


class ZooEvalCallback(ParetoEvalCallback):
    """Stands where rl_zoo3 has SB3's EvalCallback: `last_mean_reward` and the best model are those of the hypervolume.

    :param eval_env: a VecEnv, of whose environment copies are evaluated
    :param n_eval_episodes: per preference
    :param eval_freq: steps of each training environment
    :param kwargs: of ParetoEvalCallback
    """

    def __init__(
        self,
        eval_env: VecEnv,
        eval_freq: int = 10_000,
        n_eval_episodes: int = 5,
        n_preferences: int = N_PREFERENCES,
        verbose: int = 1,
        **kwargs: Any,
    ):
        super().__init__(
            copies_of(eval_env), n_episodes=n_eval_episodes, n_preferences=n_preferences, verbose=verbose, **kwargs
        )
        self.steps_of_each = eval_freq

    def _init_callback(self) -> None:
        self.eval_freq = self.steps_of_each * self.training_env.num_envs
        super()._init_callback()


class TrialEvalCallback(ZooEvalCallback):
    """Stands where rl_zoo3 has its callback of that name: a trial's score is the hypervolume.

    :param kwargs: of ZooEvalCallback
    """

    def __init__(self, eval_env: VecEnv, trial: "optuna.Trial", **kwargs: Any):
        super().__init__(eval_env, verbose=0, **kwargs)
        self.trial = trial
        self.is_pruned = False

    def _evaluate(self) -> bool:
        go_on = super()._evaluate()
        self.trial.report(self.last_mean_reward, len(self.timesteps))
        self.is_pruned = self.trial.should_prune()
        return go_on and not self.is_pruned


class EvaluationsFile(BaseCallback):
    """Writes the hypervolumes as SB3's `evaluations.npz`, which rl_zoo3's plots read: the `callback_after_eval` of a
    ParetoEvalCallback.

    `timesteps` (n,) and `results` (n, 2), of n evaluations: rl_zoo3 averages over the last axis after squeezing, so that one
    column would be taken for the runs.
    """

    parent: ParetoEvalCallback

    def __init__(self, path: Path, parent: ParetoEvalCallback):
        super().__init__()
        self.path = path
        self.parent = parent

    def _on_step(self) -> bool:
        results = np.repeat(np.array(self.parent.scores)[:, None], 2, axis=1)
        with atomic_write(self.path) as file:
            np.savez(file, allow_pickle=False, timesteps=self.parent.timesteps, results=results)
        return True
