"""Pictures of Pareto fronts."""

import contextlib
import os
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sb3_momba.files import atomic_write
from sb3_momba.pareto.evaluation import ParetoFront
from sb3_momba.pareto.metrics import as_points, non_dominated

if TYPE_CHECKING:  # It takes half a second to import, and few processes draw.
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe & Ito (2008): told apart by the colour-blind.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
LINES = ("-", "--", ":", "-.")
# The most names of a legend on the axes, and the most characters in a line of it there and below them.
NAMES_ON_AXES, LINE_ON_AXES, LINE_BELOW = 8, 40, 60

Fronts = ParetoFront | ArrayLike | Mapping[str, "ParetoFront | ArrayLike"]


def plot_front(
    fronts: Fronts,
    path: str | os.PathLike[str] | None = None,
    objectives: Sequence[str] | None = None,
    title: str | None = None,
) -> "Figure":
    """Draw solution sets of two or three objectives; dominated solutions are faint.

    :param fronts: a ParetoFront, its values (n, n_objectives), or several of them under the names of the legend
    :param path: where to write the picture; its suffix chooses the format
    :param objectives: the axes' labels
    :param title: above the picture; none by default
    :raises ValueError: for another number of objectives, or fronts that differ in it
    """
    named = dict(fronts) if isinstance(fronts, Mapping) else {"": fronts}
    points = {name: front.values if isinstance(front, ParetoFront) else as_points(front) for name, front in named.items()}
    widths = {name: p.shape[1] for name, p in points.items()}
    if len(set(widths.values())) != 1 or next(iter(widths.values())) not in (2, 3):
        raise ValueError(f"plot_front draws fronts of 2 or of 3 objectives, not {widths}.")
    n_objectives = next(iter(widths.values()))
    labels = list(objectives) if objectives is not None else [f"Objective {i + 1}" for i in range(n_objectives)]
    if len(labels) != n_objectives:
        raise ValueError(f"objectives={labels}: {n_objectives} labels are needed.")

    # A Figure of its own, not pyplot's: nothing is kept alive, and no display is needed.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4.5), layout="constrained")
    axes = figure.add_subplot(projection="3d" if n_objectives == 3 else None)
    for i, (name, p) in enumerate(points.items()):
        scatter_front(axes, p, name, i)
    label_axes(axes, labels, title)
    if any(points):
        add_legend(figure, axes)
    if path is not None:
        save_figure(figure, path)
    return figure


def save_figure(figure: "Figure", path: str | os.PathLike[str], dpi: int = 150) -> None:
    """Write a picture atomically, in the format of its suffix; a PNG's bytes do not name who wrote them.

    :raises OSError: if the file cannot be written; an old one stands
    :raises ValueError: for a suffix that matplotlib does not know
    """
    kind = os.path.splitext(path)[1].lstrip(".").lower() or "png"
    with atomic_write(path) as file:
        figure.savefig(file, dpi=dpi, format=kind, metadata={"Software": None} if kind == "png" else None)


def default_style() -> contextlib.AbstractContextManager[None]:
    """Inside, no matplotlibrc, and nothing that another library has set, changes the pictures."""
    import matplotlib.style

    return matplotlib.style.context("default")


def verbatim(text: str) -> str:
    """A text in which matplotlib finds no formula."""
    return text.replace("$", r"\$")


def in_legend(name: str) -> str:
    """A name as the legend has it, in several lines where it is long."""
    return verbatim(textwrap.fill(name, LINE_BELOW))


def add_legend(figure: "Figure", axes: "Axes") -> None:
    """On the axes; with a long name or many names below them, on a canvas that grows by it, so that it covers nothing."""
    handles, names = axes.get_legend_handles_labels()
    if len(names) <= NAMES_ON_AXES and all(len(name) <= LINE_ON_AXES for name in names):
        axes.legend()
        return
    columns = max(1, LINE_BELOW // max(len(name) + 5 for name in names))  # 5 for the line before a name
    legend = figure.legend(handles, names, loc="outside lower center", ncols=columns)
    figure.set_figheight(figure.get_figheight() + legend.get_window_extent().height / figure.dpi)


def style_of(number: int) -> tuple[str, str, str]:
    """Colour, marker and line of the 0th, 1st, ... thing in a picture; the first 28 differ."""
    n = len(COLOURS)
    return COLOURS[number % n], MARKERS[(number + number // n) % n], LINES[number // n % len(LINES)]


def scatter_front(axes: "Axes", points: np.ndarray, name: str, style: int) -> None:
    """One solution set on two- or three-dimensional axes; dominated solutions are faint.

    :param points: (n, n_objectives)
    :param name: in the legend
    :param style: its number among those in the picture
    """
    colour, marker, line = style_of(style)
    on_front = non_dominated(points)
    axes.scatter(*points[~on_front].T, color=colour, marker=marker, s=14, alpha=0.25)  # type: ignore[misc]
    front = points[on_front]
    axes.scatter(*front.T, color=colour, marker=marker, s=26, label=in_legend(name))  # type: ignore[misc]
    if points.shape[1] == 2:
        front = front[front[:, 0].argsort()]
        axes.plot(*front.T, color=colour, linestyle=line, linewidth=1, alpha=0.6)


def label_axes(axes: "Axes", objectives: Sequence[str], title: str | None) -> None:
    """Names of two or three objectives on the axes of a front."""
    labels = [verbatim(label) for label in objectives]
    axes.set(xlabel=labels[0], ylabel=labels[1], title=verbatim(title or ""))
    if len(labels) == 3:
        axes.set_zlabel(labels[2])  # type: ignore[attr-defined]
    else:
        axes.grid(alpha=0.3)
