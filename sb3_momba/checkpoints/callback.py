"""Checkpoints while training."""

import contextlib
import logging
import math
import os
import signal
import threading
import time
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

from stable_baselines3.common.callbacks import BaseCallback

from sb3_momba.checkpoints.checkpoint import write_checkpoint
from sb3_momba.checkpoints.folders import CheckpointWriter, steps_of_newest
from sb3_momba.files import alone_in

if TYPE_CHECKING:
    from sb3_momba.buffers import PreferenceReplayBuffer
    from sb3_momba.momba import MOMBA

SIGNALS = (signal.SIGINT, signal.SIGTERM)
SECONDS_OF_AN_ECHO = 1.0

logger = logging.getLogger(__name__)


class MombaCheckpointCallback(BaseCallback):
    """Write everything that the training is into `path`, every `save_freq` environment steps and at its end.

    `MOMBA.resume(path, env)` goes on from the newest checkpoint that is whole. SIGINT (Ctrl-C) and SIGTERM write one too, and
    then end the training by KeyboardInterrupt and SystemExit; a second signal, a second later or more, does not wait for it.
    Only one training at a time writes into a folder.

    :param save_freq: environment steps, over all training environments
    :param path: folder of the checkpoints
    :param keep: how many of them stay
    :param verbose: 1 prints a line for each checkpoint
    :raises ValueError: for save_freq or keep below 1; when the training starts, for a folder that another process writes
        into, or that holds checkpoints of another training with more steps
    """

    model: "MOMBA"

    def __init__(self, save_freq: int, path: str | os.PathLike[str], keep: int = 3, verbose: int = 0):
        super().__init__(verbose)
        if save_freq < 1:
            raise ValueError(f"save_freq={save_freq}: give the number of environment steps between checkpoints.")
        if keep < 1:
            raise ValueError(f"keep={keep}: at least one checkpoint must stay.")
        self.save_freq = int(save_freq)
        self.path = Path(path).resolve()
        self.writer = CheckpointWriter(self.path, keep)
        self.buffer: PreferenceReplayBuffer | None = None  # whose rows the writer's segments hold
        self.received: int | None = None
        self.received_at = -math.inf
        self.lock = contextlib.ExitStack()
        self.handlers: dict[int, Any] = {}

    def _init_callback(self) -> None:
        if self.buffer is not self.model.replay_buffer:
            self._begin(self.model.replay_buffer)
        self.saved_at = self.model.num_timesteps
        self.next_save = (self.model.num_timesteps // self.save_freq + 1) * self.save_freq

    def _begin(self, buffer: "PreferenceReplayBuffer") -> None:
        """Go on with the segments of the checkpoint that this training was resumed from, or with none."""
        self.writer.checksums = {}
        checkpoint, resumed_buffer = self.model._resumed_from or (None, None)
        if checkpoint is not None and buffer is resumed_buffer and checkpoint.folder.parent.resolve() == self.path:
            self.writer.go_on_from(checkpoint)
        elif (found := steps_of_newest(self.path)) > self.model.num_timesteps:
            raise ValueError(
                f"{self.path} holds checkpoints of another training, up to {found:,} steps, which new ones would displace: go "
                "on with MOMBA.resume, or choose another folder."
            )
        self.buffer = buffer

    def _on_training_start(self) -> None:
        self.lock.enter_context(alone_in(self.path))
        if threading.current_thread() is threading.main_thread():
            self.handlers = {number: signal.signal(number, self._note) for number in SIGNALS}

    def _note(self, number: int, frame: FrameType | None) -> None:
        """End soon; at a second signal at once, unless it is the first one's echo, sent to a process and to its group."""
        now = time.monotonic()
        if now < self.received_at + SECONDS_OF_AN_ECHO:
            return
        if self.received is not None:
            self._restore_handlers()
            signal.raise_signal(number)
        self.received, self.received_at = number, now

    def _restore_handlers(self) -> None:
        while self.handlers:
            signal.signal(*self.handlers.popitem())

    def _on_rollout_start(self) -> None:
        # Only here have the last transition and the updates that follow it been made.
        if self.model.num_timesteps >= self.next_save or self.received is not None:
            self.next_save = (self.model.num_timesteps // self.save_freq + 1) * self.save_freq
            self.save()
        if self.received is not None:
            self._end()

    def _end(self) -> NoReturn:
        number, self.received = self.received, None
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + (number or 0))

    def _on_step(self) -> bool:
        return True

    def after_learn(self) -> None:
        """However `learn` has ended: the signals and the folder are free again.

        :raises KeyboardInterrupt: if SIGINT came meanwhile
        :raises SystemExit: if SIGTERM did
        """
        self._restore_handlers()
        self.lock.close()
        if self.received is not None:
            self._end()

    def _on_training_end(self) -> None:
        if self.model._in_a_step:
            logger.warning(
                "A callback has stopped the training in the middle of a step: the newest checkpoint is that at %d steps.",
                self.saved_at,
            )
        elif self.saved_at < self.model.num_timesteps:
            self.save()

    def save(self) -> None:
        """Write a checkpoint now; not while updates are skipped, so that a training that diverges leaves its last good ones.

        :raises OSError: if it cannot be written; older checkpoints stay
        :raises TypeError: names an attribute that cannot be stored without pickle
        """
        if self.model._skipped_updates > 0:
            logger.warning("No checkpoint at %d steps: updates are being skipped.", self.model.num_timesteps)
            return
        write_checkpoint(self.model, self.writer)
        self.saved_at = self.model.num_timesteps
        if self.verbose >= 1:
            print(f"Checkpoint at {self.saved_at:,} steps in {self.path}")
