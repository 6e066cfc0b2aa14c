"""Scores over environment steps, with their intervals: what a report draws."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from sb3_momba.benchmark.statistics import Estimate, estimate, interquartile_mean
from sb3_momba.pareto.plotting import in_legend, style_of

Array = NDArray[np.float64]

REPETITIONS = 2_000


@dataclass(frozen=True)
class Curve:
    """A score over environment steps, (n,) each."""

    steps: Array
    points: list[Estimate]


def curve_through(steps: Array, tasks: Sequence[Array]) -> Curve:
    """The IQM over the runs of all tasks at each step.

    :param tasks: the runs of each, (n_runs, n)
    """
    columns = [[curves[:, i] for curves in tasks] for i in range(len(steps))]
    return Curve(steps, [estimate(interquartile_mean, column, repetitions=REPETITIONS) for column in columns])


def draw_curve(axes: Axes, curve: Curve, name: str, style: int) -> None:
    """A line and the band of its interval; a single point is a mark."""
    colour, marker, line = style_of(style)
    values = [point.value for point in curve.points]
    axes.plot(curve.steps, values, line, color=colour, marker=marker if len(values) == 1 else None, label=in_legend(name))
    low, high = [point.low for point in curve.points], [point.high for point in curve.points]
    axes.fill_between(curve.steps, low, high, color=colour, alpha=0.2, linewidth=0)
