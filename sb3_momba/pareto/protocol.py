"""The protocol of section 4.1.2, as numbers that are versioned with the package."""

from collections.abc import Sequence

from sb3_momba.envs.registry import raw_id

N_PREFERENCES = 100
N_EPISODES = 5

# Of the hypervolume. A task whose good returns lie below 0 needs a point of its own here before results can be compared.
REFERENCE_POINTS = {
    "MO-Ant-v4": (0.0, 0.0),
    "MO-HalfCheetah-v4": (0.0, 0.0),
    "MO-Hopper-v4": (0.0, 0.0),
    "MO-Hopper-3obj-v4": (0.0, 0.0, 0.0),
    "MO-Humanoid-v4": (0.0, 0.0),
    "MO-Swimmer-v4": (0.0, 0.0),
    "MO-Walker2d-v4": (0.0, 0.0),
}


def reference_point_of(env_id: str, n_objectives: int) -> Sequence[float]:
    """The task's reference point, 0 for a task that has none here, (n_objectives,).

    :param env_id: the task's own, or with the prefix of those that carry PreferenceWrapper
    """
    return REFERENCE_POINTS.get(raw_id(env_id), (0.0,) * n_objectives)
