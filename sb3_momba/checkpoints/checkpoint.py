"""Writing a training into a checkpoint, and going on from one."""

import os
from typing import Any, TypeVar

import numpy as np
from stable_baselines3.common.type_aliases import GymEnv

from sb3_momba.checkpoints import environments
from sb3_momba.checkpoints.folders import CheckpointWriter, newest
from sb3_momba.checkpoints.replay_segments import read_segments, write_segments
from sb3_momba.checkpoints.training_state import (
    random_states,
    set_random_states,
    set_statistics,
    states_of_callbacks,
    statistics_of,
)
from sb3_momba.files import FileFormatError, content_of, read_tree
from sb3_momba.saving import PickleFreeSaving

MODEL, STATE = "model.zip", "state.zip"

Model = TypeVar("Model", bound=PickleFreeSaving)


def write_checkpoint(model: Any, writer: CheckpointWriter) -> None:
    """Between two rollouts, when the last transition is stored and its updates are made."""
    segments, buffer = write_segments(model.replay_buffer, writer)
    state = {
        "random": random_states(model),
        "buffer": buffer,
        "environments": environments.states_of(model.env),
        "statistics": statistics_of(model),
        "callbacks": states_of_callbacks(model._root_callback),
    }
    writer.write(model.num_timesteps, {MODEL: model.tree(), STATE: state}, segments)


def resume(cls: type[Model], path: str | os.PathLike[str], env: GymEnv, replay: bool = True, **kwargs: Any) -> Model:
    """See `MOMBA.resume`."""
    if env is None:
        raise ValueError(f"env=None: resuming {path} needs the training's environment.")
    if "seed" in kwargs:
        raise ValueError(f"seed={kwargs['seed']!r}: the random numbers of a checkpoint go on. Leave it out.")
    checkpoint = newest(path)
    missing = [file for file in (MODEL, STATE) if file not in checkpoint.files]
    if missing:
        raise FileFormatError(f"{checkpoint.folder} is not a whole checkpoint: it has no {missing[0]}.")
    model: Any = cls.load(checkpoint.folder / MODEL, env, force_reset=False, **kwargs)
    state, _ = read_tree(checkpoint.folder / STATE)
    with content_of(checkpoint.folder):
        episodes = state["environments"]
        if episodes is not None and len(episodes) != model.n_envs:
            raise FileFormatError(f"{checkpoint.folder} has {len(episodes)} environments, not {model.n_envs}: give as many.")
        environments.check(episodes, model.n_objectives, model.action_space)
        last = model._last_obs
        if np.shape(last) != (model.n_envs, *(model.observation_space.shape or ())):
            raise FileFormatError(f"{checkpoint.folder / MODEL} has last observations of shape {np.shape(last)}.")
        read_segments(model.replay_buffer, checkpoint, state["buffer"])
        set_statistics(model, state["statistics"])
    model._last_obs, ended = environments.bring_back(model.env, episodes, model._last_obs, replay)
    if ended:
        model.replay_buffer.end_episodes(ended)
        model.policy.return_scale.end_episodes(ended)
        model._negative_returns.end_episodes(ended)
    with content_of(checkpoint.folder):
        set_random_states(model, state["random"])
        model._states_of_callbacks = dict(state["callbacks"])
    model._resumed_from = checkpoint, model.replay_buffer
    return model  # type: ignore[no-any-return]
