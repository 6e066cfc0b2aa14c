"""The report's charts, as Plotly's figures: plain dictionaries of `data` and `layout`, made from runs.

Every string that comes from a record goes through `as_label`: Plotly reads HTML in its texts. A point's `customdata` is
[number of its run, number of the point]; what can be clicked is found by it.
"""

import html
from collections.abc import Sequence
from decimal import ROUND_HALF_UP, Context, Decimal
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_momba.explorer.reading import Run, measure
from sb3_momba.pareto.metrics import non_dominated
from sb3_momba.pareto.plotting import COLOURS

Array = NDArray[np.float64]
Chart = dict[str, Any]

SYMBOLS = ("circle", "square", "diamond", "cross", "x", "circle-open", "square-open")  # 3-D knows no others
DASHES = ("solid", "dash", "dot", "dashdot", "longdash")
FLOOR_DASHES = ("dot", "dash")
INK, MUTED, GRID = "#1f2933", "#52606d", "#e4e7eb"
TICKS = {"separatethousands": True, "exponentformat": "SI"}
CURVES = {"hypervolume": "Hypervolume", "expected_utility": "Expected utility", "preference_regret": "Preference regret"}
LONGEST_LABEL, LONGEST_NAME = 80, 20  # characters
SEE_THROUGH = 0.6  # opacity of a point: where several lie it is darker


def as_label(text: str) -> str:
    """A text of a record, which Plotly shows as it is."""
    text = " ".join(str(text).split())
    return html.escape(text if len(text) <= LONGEST_LABEL else text[: LONGEST_LABEL - 1] + "…", quote=False)


def number(x: float) -> str:
    """Four digits, as people write them: 0.1234, 12.34, 1,234, 1.234 M; common.js has the same, whose ties go away from 0."""
    for size, unit in ((1e12, ""), (1e9, " G"), (1e6, " M")):
        if abs(x) >= size:
            return f"{_rounded(x, 4):.3e}" if size == 1e12 else f"{_rounded(x / size, 4):.4g}{unit}"
    if abs(x) >= 1_000:
        return f"{Decimal(x).quantize(Decimal(1), ROUND_HALF_UP):,}"
    return f"{_rounded(x, 4):.4g}" if x == 0 or abs(x) >= 1e-3 else f"{_rounded(x, 2):.1e}".replace("e-0", "e-")


def _rounded(x: float, digits: int) -> float:
    return float(Context(digits, ROUND_HALF_UP).create_decimal(x)) + 0.0


def colour_of(run: int) -> str:
    """Of the run with this number."""
    return COLOURS[run % len(COLOURS)]


def learning_curves(runs: Sequence[Run], reference_point: Array) -> dict[str, Chart]:
    """A chart over environment steps for each metric that a run has, with policies that learned nothing as lines."""
    return {metric: chart for metric in CURVES if (chart := _learning_curve(runs, reference_point, metric)) is not None}


def _learning_curve(runs: Sequence[Run], reference_point: Array, metric: str) -> Chart | None:
    data: list[Chart] = []
    for i, run in enumerate(runs):
        measured = [measure(run, evaluation.values, reference_point) for evaluation in run.record.evaluations]
        if not measured or metric not in measured[0]:
            continue
        data.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                "name": as_label(run.name),
                "x": [evaluation.steps for evaluation in run.record.evaluations],
                "y": [m[metric] for m in measured],
                "text": [number(m[metric]) for m in measured],
                "line": {"color": colour_of(i), "width": 2, "dash": DASHES[i // len(COLOURS) % len(DASHES)]},
                "marker": {"size": 6, "symbol": SYMBOLS[i % len(SYMBOLS)]},
                "hovertemplate": "%{text} at %{x:,} steps<extra>%{fullData.name}</extra>",
            }
        )
    if not data:
        return None
    most = max(runs, key=lambda run: len(run.record.floors))
    end = max(max(trace["x"]) for trace in data)
    for floor, dash in zip(most.record.floors if metric != "preference_regret" else [], FLOOR_DASHES, strict=False):
        height = measure(most, floor.values, reference_point)[metric]
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": as_label(floor.policy),
                "x": [0, end],
                "y": [height, height],
                "line": {"color": MUTED, "width": 1.5, "dash": dash},
                "hovertemplate": f"{number(height)}<extra>%{{fullData.name}}</extra>",
            }
        )
    mode = "nonnegative" if metric == "preference_regret" else "normal"
    layout = _layout(_axis("environment steps", rangemode="tozero"), _axis("", rangemode=mode))
    return {"data": data, "layout": {**layout, "showlegend": False}}


def front(runs: Sequence[Run], objectives: Sequence[str], quantity: str = "return") -> Chart:
    """All runs' newest fronts: as points of two or three objectives, or as a line for each policy.

    :param quantity: what the axes show
    """
    ranges = ranges_of([run.values for run in runs])
    data = [trace for i, run in enumerate(runs) for trace in _front_traces(run, i, run.values, ranges, _texts(run, objectives))]
    return {"data": data, "layout": _front_layout(objectives, ranges, len(runs), quantity)}


def growth(runs: Sequence[Run], objectives: Sequence[str]) -> tuple[Chart, list[Chart]]:
    """The fronts of all evaluations: the chart of the last ones, and for each number of steps at which a run was evaluated
    what changes: `steps` and the `data` of the traces."""
    ranges = ranges_of([evaluation.values for run in runs for evaluation in run.record.evaluations] + [r.values for r in runs])
    moments = sorted({evaluation.steps for run in runs for evaluation in run.record.evaluations})
    states = []
    for steps in moments:
        data = []
        for i, run in enumerate(runs):
            so_far = [evaluation for evaluation in run.record.evaluations if evaluation.steps <= steps]
            values = so_far[-1].values if so_far else np.empty((0, len(objectives)))
            data += _front_traces(run, i, values, ranges, None)
        states.append({"steps": steps, "data": data})
    layout = _front_layout(objectives, ranges, len(runs))
    return {"data": states[-1]["data"] if states else [], "layout": layout}, states


def ranges_of(values: Sequence[Array]) -> Array:
    """The least and the largest return of each objective, (2, n_objectives)."""
    every = np.concatenate(values)
    return np.array([every.min(axis=0), every.max(axis=0)])


def coordinates(values: Array, ranges: Array) -> dict[str, list[Any]]:
    """Where points are drawn: by their returns in two or three objectives, else as lines over axes from 0 to 1, one after
    the other with a gap behind each."""
    n, n_objectives = values.shape
    if n_objectives in (2, 3):
        return {axis: values[:, k].tolist() for k, axis in enumerate("xyz"[:n_objectives])}
    low, high = ranges
    heights = np.where(high > low, (values - low) / np.where(high > low, high - low, 1), 0.5)
    return {
        "x": [*range(n_objectives), None] * n,
        "y": [height for line in heights.tolist() for height in (*line, None)],
    }


def _front_traces(run: Run, i: int, values: Array, ranges: Array, texts: Sequence[str] | None) -> list[Chart]:
    """Those that no other one dominates, and the others, fainter."""
    on_front = non_dominated(values)
    traces = []
    for is_front in (False, True):
        order = np.flatnonzero(on_front == is_front)
        if values.shape[1] == 2:
            order = order[values[order, 0].argsort()]  # The line runs along the front.
        traces.append(_points(run, i, order, values, ranges, is_front, texts))
    return traces


def _points(
    run: Run, i: int, order: NDArray[np.int64], values: Array, ranges: Array, is_front: bool, texts: Sequence[str] | None
) -> Chart:
    n_objectives = values.shape[1]
    repeats = 1 if n_objectives in (2, 3) else n_objectives + 1
    is_line = n_objectives != 3 and (n_objectives != 2 or is_front)
    size, size_on_front = {2: (6, 10), 3: (4, 5)}.get(n_objectives, (6, 6))
    trace: Chart = {
        "type": "scatter3d" if n_objectives == 3 else "scatter",
        "mode": "lines+markers" if is_line else "markers",
        "name": as_label(run.name),
        "legendgroup": str(i),
        "showlegend": is_front,
        "opacity": 1.0 if is_front else 0.35,
        "marker": {
            "size": size_on_front if is_front else size,
            "color": colour_of(i),
            "symbol": SYMBOLS[i % len(SYMBOLS)],
            "opacity": SEE_THROUGH if n_objectives == 2 and is_front else 1.0,
            "line": {"width": 0},  # An outline of another colour would erase points that lie close together.
        },
        "line": {"color": colour_of(i), "width": 1},
        "customdata": [[i, int(k)] for k in order for _ in range(repeats)],
        **coordinates(values[order], ranges),
    }
    if texts is None:
        trace["hoverinfo"] = "skip"
    else:
        trace["text"] = [texts[k] for k in order for _ in range(repeats)]
        trace["hovertemplate"] = "%{text}<extra></extra>"
    return trace


def _texts(run: Run, objectives: Sequence[str]) -> list[str]:
    """What hovering over each point shows: preference, return, spread over episodes."""
    texts = []
    for k, values in enumerate(run.values):
        lines = [f"<b>{as_label(run.name)}</b>"]
        for j, name in enumerate(objectives):
            weight = "" if run.preferences is None else f"weight {run.preferences[k, j]:.2f}, "
            spread = "" if run.spread is None else f" ± {number(run.spread[k, j])}"
            lines.append(f"{as_label(name)}: {weight}return {number(values[j])}{spread}")
        texts.append("<br>".join([*lines, run.about_episodes]))
    return texts


def regret(runs: Sequence[Run], objectives: Sequence[str]) -> Chart | None:
    """What each preference loses because the policy answers another one better: over the weight of the first objective where
    there are two, else in order of size. None where no run has preferences."""
    two = len(objectives) == 2
    data = []
    for i, run in enumerate(runs):
        if run.regrets is None or run.preferences is None:
            continue
        order = run.preferences[:, 0].argsort() if two else run.regrets.argsort()[::-1]
        texts = _texts(run, objectives)
        data.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                "name": as_label(run.name),
                "x": run.preferences[order, 0].tolist() if two else list(range(1, len(order) + 1)),
                "y": run.regrets[order].tolist(),
                "text": [f"{texts[k]}<br>regret {number(run.regrets[k])}" for k in order],
                "customdata": [[i, int(k)] for k in order],
                "line": {"color": colour_of(i), "width": 2},
                "marker": {"size": 7, "symbol": SYMBOLS[i % len(SYMBOLS)]},
                "hovertemplate": "%{text}<extra></extra>",
            }
        )
    if not data:
        return None
    x = (
        _axis(f"weight of {as_label(objectives[0])}", range=[-0.03, 1.03])
        if two
        else _axis("preferences, largest regret first")
    )
    return {"data": data, "layout": {**_layout(x, _axis("regret", rangemode="tozero")), "showlegend": False}}


def selection(n_objectives: int) -> Chart:
    """The trace that marks what is selected, still without a point."""
    is_line = n_objectives not in (2, 3)
    return {
        "type": "scatter3d" if n_objectives == 3 else "scatter",
        "mode": "lines+markers" if is_line else "markers",
        "name": "selected",
        "showlegend": False,
        "hoverinfo": "skip",
        "x": [],
        "y": [],
        **({"z": []} if n_objectives == 3 else {}),
        "line": {"color": INK, "width": 3},
        "marker": {
            "size": 12 if n_objectives == 3 else 8 if is_line else 17,
            "color": INK,
            "symbol": "circle-open",
            "line": {"width": 3, "color": INK},
        },
    }


def _front_layout(objectives: Sequence[str], ranges: Array, n_runs: int, quantity: str = "return") -> Chart:
    n = len(objectives)
    legend = {"showlegend": n_runs > 1, "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"}}
    low, high = ranges
    margin = np.where(high > low, 0.06 * (high - low), np.maximum(np.abs(high) * 0.05, 1e-3))
    limits = np.stack([low - margin, high + margin], axis=1).tolist()
    if n in (2, 3):
        axes = [_axis(f"{as_label(name)} ({quantity})", range=limits[k]) for k, name in enumerate(objectives)]
        if n == 2:
            return {**_layout(*axes), **legend}
        scene = {
            f"{axis}axis": {"title": {"text": as_label(name)}, "range": limits[k], "gridcolor": GRID, "nticks": 5, **TICKS}
            for k, (axis, name) in enumerate(zip("xyz", objectives, strict=True))
        }
        camera = {"eye": {"x": 1.65, "y": 1.65, "z": 0.9}, "center": {"x": 0, "y": 0, "z": -0.15}}
        view = {"camera": camera, "aspectmode": "cube", "dragmode": "turntable"}
        return {**_layout(_axis(""), _axis("")), **legend, "scene": {**scene, **view}}
    x = _axis("", range=[-0.3, n - 0.7], tickvals=list(range(n)), ticktext=_short_names(objectives), gridcolor="#9aa5b1")
    # Upright, many names and numbers fit beside each other on a phone, and none reaches beyond an edge.
    angle, length, above = (0, 20, 0.12) if n < 5 else (-90, 52, 0.3)
    x |= {"tickangle": angle, "ticklabelstandoff": length, "showline": False}
    y = _axis("", range=[-0.03, 1 + above], showticklabels=False, showgrid=False, showline=False)
    note = {"showarrow": False, "textangle": angle, "bgcolor": "white"}
    lowest = {**note, "yref": "paper", "y": 0, "yanchor": "top"}  # between the axis and its name
    highest = {**note, "y": 1, "yanchor": "bottom", "yshift": 6}
    ends = ((lowest, low), (highest, high))
    notes = [{**end, "x": k, "text": number(float(one))} for end, row in ends for k, one in enumerate(row)]
    layout = {**_layout(x, y), **legend}
    layout["margin"]["t"] = 24
    layout["legend"].update(yref="container", y=0)
    return {**layout, "annotations": notes}


def _short_names(objectives: Sequence[str]) -> list[str]:
    return [as_label(name if len(name) <= LONGEST_NAME else name[: LONGEST_NAME - 1] + "…") for name in objectives]


def _axis(title: str, **options: Any) -> Chart:
    lines = {"gridcolor": GRID, "zeroline": False, "linecolor": MUTED, "automargin": True}
    return {"title": {"text": title, "standoff": 8}, **lines, **TICKS, **options}


def _layout(x: Chart, y: Chart) -> Chart:
    return {
        "xaxis": x,
        "yaxis": y,
        "autosize": True,
        "margin": {"l": 8, "r": 12, "t": 12, "b": 8},
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "hovermode": "closest",
        "hoverlabel": {"align": "left", "bgcolor": "white", "font": {"color": INK}},
        "dragmode": False,
    }
