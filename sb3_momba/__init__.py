"""Multi-objective reinforcement learning for Stable-Baselines3: one run learns the whole Pareto front."""

__version__ = "0.1.0"

import sb3_momba.envs.registry  # noqa: F401  registers the tasks of the thesis, and momba/ ids
from sb3_momba.buffers import PreferenceReplayBuffer
from sb3_momba.checkpoints.callback import MombaCheckpointCallback
from sb3_momba.envs.checking import check_mo_env
from sb3_momba.envs.making import make_mo_vec_env
from sb3_momba.envs.wrappers import PreferenceWrapper
from sb3_momba.momba import MOMBA
from sb3_momba.pareto.callbacks import ParetoEvalCallback
from sb3_momba.pareto.evaluation import ParetoFront, evaluate_front
from sb3_momba.pareto.metrics import expected_utility, hypervolume, inverted_generational_distance, preference_regret
from sb3_momba.pareto.plotting import plot_front
from sb3_momba.policies import FlashSacPolicy, MlpPolicy, SimbaPolicy, XqcPolicy

__all__ = [
    "MOMBA",
    "FlashSacPolicy",
    "MlpPolicy",
    "MombaCheckpointCallback",
    "ParetoEvalCallback",
    "ParetoFront",
    "PreferenceReplayBuffer",
    "PreferenceWrapper",
    "SimbaPolicy",
    "XqcPolicy",
    "check_mo_env",
    "evaluate_front",
    "expected_utility",
    "hypervolume",
    "inverted_generational_distance",
    "make_mo_vec_env",
    "plot_front",
    "preference_regret",
]
