"""Logs that a full disk does not turn into the end of a training."""

import logging
from collections.abc import Callable
from typing import Any

from stable_baselines3.common.logger import Logger

logger = logging.getLogger(__name__)


def forgive_full_disks(log: Logger) -> None:
    """A log that cannot be written is said once, and does not end a training."""
    for output in log.output_formats:
        write = output.write
        if not isinstance(write, ForgivingWrite):
            output.write = ForgivingWrite(write)  # type: ignore[method-assign]


class ForgivingWrite:
    def __init__(self, write: Callable[..., None]):
        self.write = write
        self.warned = False

    def __call__(self, *args: Any, **kwargs: Any) -> None:
        try:
            self.write(*args, **kwargs)
        except OSError as error:
            if not self.warned:
                self.warned = True
                owner = type(getattr(self.write, "__self__", None)).__name__
                logger.warning("A log (%s) cannot be written: %s. The training goes on without it.", owner, error)
