"""The figures of chapter 4: numbers in, a PNG out. Each says whether there was anything to draw."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import NDArray

from sb3_momba.benchmark.chapter4.scores import Aggregate
from sb3_momba.benchmark.curves import Curve, draw_curve
from sb3_momba.benchmark.statistics import Estimate
from sb3_momba.pareto.plotting import COLOURS, LINES, default_style, label_axes, save_figure, scatter_front, style_of, verbatim

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FrontPanel:
    """One task's fronts by name, (n, n_objectives); None keeps the colour of one that is missing."""

    title: str
    objectives: Sequence[str]
    fronts: Mapping[str, Array | None]


@dataclass(frozen=True)
class CurvePanel:
    """Curves by name, None for one that is missing; and levels, each with its name."""

    title: str
    score: str
    curves: Mapping[str, Curve | None]
    levels: Mapping[str, float] = field(default_factory=dict)


def draw_fronts(panels: Sequence[FrontPanel], path: Path) -> bool:
    """A scatter of two or three objectives for each task that has a front."""
    shown = [panel for panel in panels if any(front is not None for front in panel.fronts.values())]
    if not shown:
        return False
    with default_style():
        columns, rows = layout(len(shown))
        figure = Figure(figsize=(4 * columns, 3.4 * rows + 0.6), layout="constrained")
        for place, panel in enumerate(shown, start=1):
            is_solid = len(panel.objectives) == 3
            axes = figure.add_subplot(rows, columns, place, projection="3d" if is_solid else None)
            for style, (name, front) in enumerate(panel.fronts.items()):
                if front is not None:
                    scatter_front(axes, front, name, style)
            label_axes(axes, panel.objectives, panel.title)
            if is_solid:
                axes.set_box_aspect(None, zoom=0.9)  # type: ignore[call-arg]  # Room for the labels, which layouts overlook.
                axes.locator_params(nbins=4)
        write(figure, path)
    return True


def draw_curves(panels: Sequence[CurvePanel], path: Path) -> bool:
    """Scores over steps with their intervals; levels are horizontal."""
    shown = [panel for panel in panels if any(curve is not None for curve in panel.curves.values())]
    if not shown:
        return False
    with default_style():
        columns, rows = layout(len(shown))
        figure = Figure(figsize=(4 * columns, 3 * rows + 0.6), layout="constrained")
        for place, panel in enumerate(shown, start=1):
            axes = figure.add_subplot(rows, columns, place)
            for style, (name, curve) in enumerate(panel.curves.items()):
                if curve is not None:
                    draw_curve(axes, curve, name, style)
            for style, (name, level) in enumerate(panel.levels.items(), start=1):
                axes.axhline(level, color="grey", linestyle=LINES[style % len(LINES)], linewidth=1, label=verbatim(name))
            axes.set(xlabel="environment steps", ylabel=panel.score, title=verbatim(panel.title))
            axes.xaxis.set_major_locator(MaxNLocator(5))
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.grid(alpha=0.3)
        write(figure, path)
    return True


def draw_estimates(panels: Mapping[str, Mapping[str, Aggregate]], path: Path) -> bool:
    """A row of points with intervals for each score, one point for each method."""
    if not any(one.estimate is not None for found in panels.values() for one in found.values()):
        return False
    with default_style():
        figure = Figure(figsize=(1 + 4 * len(panels), 3.4), layout="constrained")
        for place, (score, found) in enumerate(panels.items(), start=1):
            axes = figure.add_subplot(1, len(panels), place)
            draw_points(axes, {name: one.estimate for name, one in found.items()})
            axes.set_xlabel(score)
        write(figure, path, has_legend=False)
    return True


def draw_points(axes: Axes, found: Mapping[str, Estimate | None]) -> None:
    """Names from top to bottom; one that is missing keeps its line."""
    for place, one in enumerate(found.values()):
        if one is not None:
            error_bar(axes, one.value, place, one, place, across=True)
    axes.set_yticks(range(len(found)), [verbatim(name if one else f"{name} (missing)") for name, one in found.items()])
    axes.set_ylim(len(found) - 0.5, -0.5)
    axes.grid(alpha=0.3, axis="x")


def draw_groups(groups: Mapping[str, Mapping[str, Aggregate]], score: str, path: Path) -> bool:
    """Figure 4.7: in each group one point per member, side by side."""
    if not any(one.estimate is not None for members in groups.values() for one in members.values()):
        return False
    with default_style():
        figure = Figure(figsize=(1.6 * len(groups) + 1, 3.6), layout="constrained")
        axes = figure.add_subplot()
        for place, members in enumerate(groups.values()):
            for style, (name, one) in enumerate(members.items()):
                if one.estimate is not None:
                    x = place + 0.3 * (style - (len(members) - 1) / 2)
                    error_bar(axes, x, one.estimate.value, one.estimate, style, label=name)
        axes.set_xticks(range(len(groups)), [verbatim(name) for name in groups])
        axes.set_xlim(-0.5, len(groups) - 0.5)
        axes.set_ylabel(score)
        axes.grid(alpha=0.3, axis="y")
        write(figure, path)
    return True


def draw_scaling(lines: Mapping[str, Sequence[tuple[float, Estimate]]], score: str, path: Path) -> bool:
    """Figure 4.8.

    :param lines: (critic parameters, score) of each size, by configuration; an empty one keeps its colour
    """
    if not any(lines.values()):
        return False
    with default_style():
        figure = Figure(figsize=(6, 4), layout="constrained")
        axes = figure.add_subplot()
        for style, (name, points) in enumerate(lines.items()):
            if points:
                colour, _, line = style_of(style)
                axes.plot([x for x, _ in points], [one.value for _, one in points], line, color=colour, linewidth=1)
            for x, one in points:
                error_bar(axes, x, one.value, one, style, label=name)
        axes.set(xscale="log", xlabel="critic parameters", ylabel=score)
        axes.grid(alpha=0.3)
        write(figure, path)
    return True


def draw_normalisation(found: Mapping[str, Aggregate], shapley: Mapping[str, float], score: str, path: Path) -> bool:
    """Figure 4.9: the combinations to the left, the Shapley values to the right where they are known."""
    if not any(one.estimate is not None for one in found.values()):
        return False
    with default_style():
        figure = Figure(figsize=(9, 3.8), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(3, 2))
        draw_points(left, {name: one.estimate for name, one in found.items()})
        left.set_xlabel(score)
        right.bar(list(shapley), list(shapley.values()), color=COLOURS[0])
        right.axhline(0, color="black", linewidth=0.8)
        right.set(ylabel="Shapley value", title="" if shapley else "missing")
        right.grid(alpha=0.3, axis="y")
        write(figure, path, has_legend=False)
    return True


def error_bar(axes: Axes, x: float, y: float, one: Estimate, style: int, label: str = "", across: bool = False) -> None:
    """:param across: the interval lies along x"""
    lengths = [[max(one.value - one.low, 0)], [max(one.high - one.value, 0)]]
    colour, marker, _ = style_of(style)
    bars = {"xerr": lengths} if across else {"yerr": lengths}
    axes.errorbar([x], [y], **bars, color=colour, marker=marker, capsize=3, linestyle="", label=verbatim(label))  # type: ignore[arg-type]


def layout(n: int) -> tuple[int, int]:
    """Columns and rows of n panels: at most four side by side."""
    columns = min(n, 4)
    return columns, -(-n // columns)


def write(figure: Figure, path: Path, has_legend: bool = True) -> None:
    """With one legend for all panels."""
    entries = [entry for axes in figure.axes for entry in zip(*axes.get_legend_handles_labels(), strict=True)]
    named = {label: handle for handle, label in reversed(entries)}
    if has_legend and named:
        order = dict.fromkeys(label for _, label in entries)
        figure.legend([named[label] for label in order], list(order), loc="outside lower center", ncols=min(len(order), 5))
    save_figure(figure, path, dpi=120)
