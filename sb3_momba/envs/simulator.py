"""MuJoCo, whatever MUJOCO_GL says: a name that it does not know keeps it from being imported, though most who simulate draw
nothing. Whoever draws says so."""

import os

try:
    import mujoco  # type: ignore[import-untyped]
except RuntimeError:
    unknown = os.environ.pop("MUJOCO_GL", "")
    import mujoco

    os.environ["MUJOCO_GL"] = unknown
from gymnasium.envs.mujoco import MujocoEnv

__all__ = ["MujocoEnv", "mujoco"]
