"""Multi-objective reinforcement learning for Stable-Baselines3: one run learns the whole Pareto front."""

__version__ = "0.1.0"

from sb3_momba.buffers import PreferenceReplayBuffer
from sb3_momba.envs.wrappers import PreferenceWrapper, make_mo_vec_env
from sb3_momba.momba import MOMBA
from sb3_momba.policies import MlpPolicy, SimbaPolicy

