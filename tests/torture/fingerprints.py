"""All that a training goes on from, in one hash."""

import hashlib
from collections import deque
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_momba import MOMBA
from sb3_momba.buffers import STORED_ARRAYS
from sb3_momba.checkpoints.training_state import random_states, statistics_of


def fingerprint(model: MOMBA) -> str:
    """A hash of all that a training goes on from: parameters, optimisers, replay buffer, statistics, random numbers."""
    buffer = model.replay_buffer
    assert model.env is not None
    everything = [
        model.get_parameters(),
        model.alpha,
        [getattr(buffer, name)[: buffer.size()] for name in STORED_ARRAYS],
        [buffer.pos, buffer.full, buffer.n_added, buffer.rng.bit_generator.state],
        [model.num_timesteps, model._n_updates, model._episode_num, model._last_obs],
        statistics_of(model),
        random_states(model),
        model.env.env_method("episode_so_far"),
    ]
    return hash_of(everything)


def hash_of(x: Any) -> str:
    digest = hashlib.sha256()
    add_to(digest, x)
    return digest.hexdigest()


def add_to(digest: Any, x: Any) -> None:
    """Feed a nest of dictionaries, sequences, arrays, tensors and numbers to a hash."""
    if isinstance(x, th.Tensor):
        x = x.detach().cpu().numpy()
    if isinstance(x, dict):
        for key in sorted(x, key=repr):
            digest.update(repr(key).encode())
            add_to(digest, x[key])
    elif isinstance(x, list | tuple | deque):
        digest.update(f"{len(x)} items".encode())
        for item in x:
            add_to(digest, item)
    elif isinstance(x, np.ndarray):
        digest.update(f"{x.dtype} {x.shape}".encode() + x.tobytes())
    else:
        digest.update(repr(x.item() if isinstance(x, np.generic) else x).encode())


class Fingerprints(BaseCallback):
    """Of a training at every step at which a checkpoint could be."""

    model: MOMBA

    def __init__(self, every: int):
        super().__init__()
        self.every = every
        self.found: dict[int, str] = {}

    def _on_rollout_start(self) -> None:
        if self.num_timesteps > 0 and self.num_timesteps % self.every == 0:
            self.found[self.num_timesteps] = fingerprint(self.model)

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._on_rollout_start()
