"""Statistics over runs, as rliable defines them (Agarwal et al., 2021, Deep Reinforcement Learning at the Edge of the
Statistical Precipice).

Scores are one array per task; its last dimension counts runs, whose number may differ between tasks. Dimensions before it are
batches, such as bootstrap samples.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import trim_mean

Array = NDArray[np.float64]
Scores = Sequence[ArrayLike]

REPETITIONS = 20_000
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A statistic and its confidence interval."""

    value: float
    low: float
    high: float


def interquartile_mean(scores: Scores) -> Array:
    """IQM: the mean of the middle half of all runs of all tasks, (...,)."""
    return np.asarray(trim_mean(np.concatenate([np.asarray(task) for task in scores], axis=-1), 0.25, axis=-1))


def probability_of_improvement(scores: Scores, others: Scores) -> Array:
    """P(X > Y) + P(X = Y) / 2 of a run X of `scores` and a run Y of `others` on the same task, mean over the tasks, (...,)."""
    if len(scores) != len(others):
        raise ValueError(f"Scores of {len(scores)} tasks cannot be compared with scores of {len(others)}.")
    tasks = []
    for x, y in zip(scores, others, strict=True):
        x, y = np.asarray(x)[..., :, None], np.asarray(y)[..., None, :]
        tasks.append(((x > y) + 0.5 * (x == y)).mean(axis=(-2, -1)))
    return np.asarray(np.mean(tasks, axis=0))


def estimate(
    statistic: Callable[..., Array],
    *samples: Scores,
    repetitions: int = REPETITIONS,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> Estimate:
    """A statistic with its percentile interval from a stratified bootstrap: runs are drawn anew within each task, each
    sample by itself.

    :param samples: each one the scores of a method, a sequence of tasks
    :raises ValueError: for no task, a task without runs, or a score that is not finite
    """
    if any(len(sample) == 0 for sample in samples):
        raise ValueError("There are no scores: give those of at least one task.")
    rng = np.random.default_rng(seed)
    drawn = [[_resample(task, repetitions, rng) for task in sample] for sample in samples]
    low, high = np.quantile(statistic(*drawn), [(1 - confidence) / 2, (1 + confidence) / 2])
    return Estimate(float(statistic(*samples)), float(low), float(high))


def _resample(scores: ArrayLike, repetitions: int, rng: np.random.Generator) -> Array:
    """(n_runs,) -> (repetitions, n_runs)."""
    runs = np.asarray(scores, dtype=np.float64)
    if runs.ndim != 1 or len(runs) == 0:
        raise ValueError(f"The scores of a task have shape {runs.shape}: give one number per run, of at least one run.")
    if not np.isfinite(runs).all():
        raise ValueError(f"The scores {runs.tolist()} are not all finite.")
    return runs[rng.integers(len(runs), size=(repetitions, len(runs)))]
