"""`python -m sb3_momba.explorer report RUN`: what runs learned, as one page that needs nothing but a browser.

The page is page/page.html, into which its style, its script, Plotly's script and the numbers are put. What comes from a record
is escaped wherever it goes: as HTML, as a label of Plotly's, and inside the JSON of the numbers. The page's own policy lets it
run these scripts only and ask nothing of any network.
"""

import base64
import hashlib
import html
import json
import logging
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_momba import __version__
from sb3_momba.explorer import charts
from sb3_momba.explorer.reading import Run, measure, objectives_of, read_runs
from sb3_momba.explorer.rendering import FPS, Film, RenderingProcess, check_filmable, film
from sb3_momba.explorer.stage import RenderingError
from sb3_momba.files import atomic_write
from sb3_momba.records import common_reference_point

N_FILMS = 20

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)


def write_report(
    folders: Sequence[Path], path: Path, n_films: int | None = None, reference_point: ArrayLike | None = None
) -> list[Run]:
    """Write one HTML file about runs of one task.

    :param folders: of runs
    :param n_films: preferences of each run that are filmed; by default 20, shared by all runs, and at least 5 of each
    :param reference_point: of the hypervolume, (n_objectives,), instead of the records' own
    :return: the runs, with their films
    :raises ValueError: for folders that hold no runs of one task
    :raises ImportError: if Plotly is missing
    """
    script = plotly_script()
    runs = read_runs(folders)
    reference = common_reference_point(runs[0].record.task, [run.record for run in runs], reference_point)
    n_films = max(5, N_FILMS // len(runs)) if n_films is None else n_films
    for run in runs:
        add_films(run, n_films)
    page = to_html(runs, reference, script)
    with atomic_write(path) as file:
        file.write(page.encode())
    return runs


def plotly_script() -> str:
    """:raises ImportError: naming the extra"""
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise ImportError("A report needs the package plotly: `pip install 'sb3-momba[explorer]'`.") from error
    return str(get_plotlyjs())


def add_films(run: Run, n_films: int) -> None:
    """Film a run's policy under preferences spread over its own; where that cannot be, its `no_films` says why."""
    if run.model is None or run.preferences is None or n_films == 0:
        run.no_films = run.no_films or "none were asked for (--films 0)."
        return
    policy, seed = run.policy, 0 if run.front is None else int(run.front.settings.get("seed", 0))
    try:
        with RenderingProcess(needs_gl=check_filmable(policy)) as process:
            for k in spread_out(run.preferences, n_films):
                # Where its first episode stood among those of the evaluation.
                number = k * (run.n_episodes or 1)
                run.films[k] = process.call(film, policy, run.preferences[k], number, seed, process.backend)
                logger.info("%s: film %d of %d", run.name, len(run.films), min(n_films, len(run.preferences)))
    except (RenderingError, ValueError, OSError, ImportError, gym.error.Error) as error:
        run.films, run.no_films = {}, str(error)
        logger.warning("%s: no films: %s", run.name, error)


def spread_out(preferences: Array, n: int) -> list[int]:
    """Which n of the preferences lie far from each other, in their order: after the first one always that which is furthest
    from those so far."""
    chosen = [0]
    distances = np.linalg.norm(preferences - preferences[0], axis=1)
    while len(chosen) < min(n, len(preferences)):
        chosen.append(int(distances.argmax()))
        distances = np.minimum(distances, np.linalg.norm(preferences - preferences[chosen[-1]], axis=1))
    return sorted(set(chosen))


def to_html(runs: Sequence[Run], reference_point: Array, plotly: str) -> str:
    """The page.

    :param plotly: the script
    """
    objectives = objectives_of(runs[0].record)
    n_points = len(runs[0].values)
    regret = charts.regret(runs, objectives)
    front = charts.front(runs, objectives)
    front["data"].append(charts.selection(len(objectives)))
    if regret is not None:
        regret["data"].append(charts.selection(2))
    grown, states = charts.growth(runs, objectives)
    curves = charts.learning_curves(runs, reference_point)
    every_chart = {"front": front, **curves, "growth": grown, **({} if regret is None else {"regret": regret})}
    numbers = {
        "objectives": objectives,
        "ranges": charts.ranges_of([run.values for run in runs]).tolist(),
        "fps": FPS,
        "charts": every_chart,
        "states": states,
        "runs": [run_numbers(run, i) for i, run in enumerate(runs)],
    }
    script, css = page_file("common.js") + page_file("page.js"), page_file("page.css")
    plotly = plotly.replace("\r", "")
    named = ", ".join(objectives[:-1]) + f" and {objectives[-1]}" if len(objectives) > 1 else objectives[0]
    some = f"{len(runs)} runs under" if len(runs) > 1 else "One run under"
    filmed = any(run.films for run in runs)
    hint = "Move the slider or click a point"
    parts = {
        "script_hashes": f"'{csp_hash(plotly)}' '{csp_hash(script)}'",
        "title": html.escape(runs[0].record.task),
        "lead": html.escape(f"{some} {n_points} preference{'s' * (n_points > 1)} between {named}."),
        "choose_hint": f"{hint}: the film shows what the policy does under that preference." if filmed else f"{hint}.",
        "front_label": html.escape(f"The returns in {named} of each policy; the slider beside it moves over them"),
        "results": results(runs, reference_point),
        "notices": notices(runs),
        "curves": curve_section(runs, curves),
        "regret": "" if regret is None else page_file("regret.html"),
        "provenance": provenance(runs),
        "version": html.escape(__version__),
        "css": css,
        "data": json_in_html(numbers),
        "plotly": plotly,
        "js": script,
    }
    return fill(page_file("page.html"), parts)


def run_numbers(run: Run, i: int) -> dict[str, Any]:
    """What the page's script needs of a run."""
    films = [{"point": k, **film_numbers(one)} for k, one in run.films.items()]
    return {
        "name": run.name,
        "colour": charts.colour_of(i),
        "preferences": None if run.preferences is None else run.preferences.tolist(),
        "values": run.values.tolist(),
        "spread": None if run.spread is None else run.spread.tolist(),
        "regrets": None if run.regrets is None else run.regrets.tolist(),
        "on_front": run.on_front.tolist(),
        "episodes": run.about_episodes,
        "films": films,
        "no_films": run.no_films,
    }


def film_numbers(film: Film) -> dict[str, Any]:
    """What a page's script needs of a film."""
    return {
        "video": base64.b64encode(film.video).decode(),
        "returns": [[float(f"{x:.6g}") for x in frame] for frame in film.returns],
        "total": film.total.tolist(),
        "steps": film.steps,
        "speed": film.speed,
    }


def fill(template: str, parts: Mapping[str, str]) -> str:
    """A template's {{names}} replaced, once: what is put in is not looked at again."""
    pieces = template.split("{{")
    filled = [pieces[0]]
    for piece in pieces[1:]:
        name, rest = piece.split("}}", 1)
        filled += [parts[name], rest]
    return "".join(filled)


def page_file(name: str) -> str:
    """One of the page's files, with Unix line ends, as the hash of a script demands."""
    return resources.files("sb3_momba.explorer").joinpath("page", name).read_text("utf-8").replace("\r", "")


def csp_hash(script: str) -> str:
    """What lets a browser run this script and no other (Content Security Policy, level 3)."""
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def json_in_html(x: Any) -> str:
    """JSON that ends no script element, whatever its strings hold.

    :raises ValueError: for numbers that are not finite
    """
    text = json.dumps(x, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def results(runs: Sequence[Run], reference_point: Array) -> str:
    """A table of every run's newest metrics, and of policies that learned nothing."""
    titles = ("Run", "Steps", "Hypervolume", "Expected utility", "Preference regret", "On the front")
    rows = []
    for i, run in enumerate(runs):
        dot = f'<span class="dot" style="background:{charts.colour_of(i)}"></span>'
        steps = f"{run.record.evaluations[-1].steps:,}" if run.record.evaluations else ""
        rows.append(_row("run", dot + html.escape(run.name), [steps, *_metrics(run, run.values, reference_point)], titles))
    most = max(runs, key=lambda run: len(run.record.floors))
    for floor in most.record.floors:
        rows.append(_row("floor", html.escape(floor.policy), ["", *_metrics(most, floor.values, reference_point)], titles))
    head = "".join(f'<th scope="col">{title}</th>' for title in titles)
    return f'<table class="results"><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table>'


def _row(kind: str, name: str, cells: Sequence[str], titles: Sequence[str]) -> str:
    numbers = "".join(f'<td data-label="{title}">{cell}</td>' for title, cell in zip(titles[1:], cells, strict=True))
    return f'<tr class="{kind}"><th scope="row">{name}</th>{numbers}</tr>'


def _metrics(run: Run, values: Array, reference_point: Array) -> list[str]:
    metrics = measure(run, values, reference_point)
    shown = [charts.number(metrics[name]) if name in metrics else "" for name in charts.CURVES]
    return [*shown, f"{metrics['n_non_dominated']:.0f} of {len(values)}"]


def notices(runs: Sequence[Run]) -> str:
    """What a reader must know of the runs: those that did not finish, and protocols that differ."""
    texts = [
        f"{run.name} did not finish ({run.record.error}): its newest evaluation is shown, and its best model filmed."
        for run in runs
        if run.record.error is not None
    ]
    protocols = {(run.record.preferences.tobytes(), run.record.config.get("n_episodes")) for run in runs}
    if len(protocols) > 1:
        texts.append("These runs were evaluated under different preferences or numbers of episodes: compare them with care.")
    return "".join(f'<p class="notice">{html.escape(text)}</p>' for text in texts)


def curve_section(runs: Sequence[Run], curves: Mapping[str, Any]) -> str:
    """The learning curves, with a key."""
    if not curves:
        return ""
    strokes = [(charts.colour_of(i), "solid", run.name) for i, run in enumerate(runs)]
    most = max(runs, key=lambda run: len(run.record.floors))
    styles = ("dotted", "dashed")
    strokes += [(charts.MUTED, style, floor.policy) for floor, style in zip(most.record.floors, styles, strict=False)]
    key = "".join(
        f'<li><span class="stroke" style="border-color:{colour};border-top-style:{style}"></span>{html.escape(name)}</li>'
        for colour, style, name in strokes
    )
    boxes = "".join(
        f'<div><h3>{charts.CURVES[metric]}</h3><div class="chart" id="{metric}" role="img" '
        f'aria-label="{charts.CURVES[metric]} over environment steps"></div></div>'
        for metric in curves
    )
    head = f'<h2 id="curves-title">Learning curves</h2><ul class="key">{key}</ul>'
    return f'<section aria-labelledby="curves-title">{head}<div class="small-charts">{boxes}</div></section>'


def provenance(runs: Sequence[Run]) -> str:
    """Seeds, sizes, versions and machines."""
    parts = []
    for run in runs:
        start = run.record.start
        entries = {
            "Folder": run.record.path.parent,
            "Seed": run.record.seed,
            "Parameters": ", ".join(f"{name} {n:,}" for name, n in run.record.parameters.items()),
            "Started": start.get("started"),
            "Versions": _listed(start.get("versions")),
            "Machine": _listed(start.get("machine")),
            "Git revision": start.get("git_revision"),
        }
        items = "".join(f"<dt>{name}</dt><dd>{html.escape(str(x))}</dd>" for name, x in entries.items() if x)
        parts.append(f"<h3>{html.escape(run.name)}</h3><dl>{items}</dl>")
    return "".join(parts)


def _listed(entry: object) -> object:
    return ", ".join(f"{key} {value}" for key, value in entry.items()) if isinstance(entry, dict) else entry
