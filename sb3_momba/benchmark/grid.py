"""What a grid of runs consists of: every configuration on every environment with every seed.

A grid is a yaml file:

    variants: [momba, capql, gpi_ls] # shipped configurations, yaml files, or baselines
    tasks: [MO-Hopper-v4]            # environment ids
    seeds: 10                        # they are 0 to 9
    options: {eval_freq: 20_000}     # of `python -m sb3_momba.train`; none by default
    variations: {wide: {policy_kwargs.critic_hidden_dim: 1024}} # by name: the first variant with other settings
    auto_ent_coef: 0.01              # where variants that learn alpha start it; by default their own
    fixed_preferences: {2: 20}       # by number of objectives: one run of a single variant for each of so many (section 4.2.4)
"""

import argparse
import contextlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from importlib import resources
from pathlib import Path
from typing import Any, Protocol

import yaml

from sb3_momba import runs, train
from sb3_momba.baselines import __main__ as baselines
from sb3_momba.baselines import runs as baseline_runs
from sb3_momba.baselines.settings import VARIANTS
from sb3_momba.benchmark.results import FIXED_PREFERENCE
from sb3_momba.envs.preferences import preference_grid
from sb3_momba.pareto.evaluation import probe_environment
from sb3_momba.settings import check_names, is_number, nearest, parse_ent_coef
from sb3_momba.train import as_arguments
from sb3_momba.zoo.configuration import literal, read_configuration

SHIPPED = resources.files("sb3_momba.benchmark") / "grids"


def _is_list_of_names(x: Any) -> bool:
    return isinstance(x, list) and len(x) > 0 and all(isinstance(name, str) for name in x)


def _are_options(x: Any) -> bool:
    return isinstance(x, dict) and all(
        isinstance(name, str) and name.replace("_", "-") not in OF_THE_GRID and value is not None and value is not False
        for name, value in x.items()
    )


def _are_variations(x: Any) -> bool:
    return isinstance(x, dict) and all(
        isinstance(name, str) and re.fullmatch(r"\w[\w.-]*", name) and isinstance(settings, dict) and len(settings) > 0
        for name, settings in x.items()
    )


def _is_number_of(x: Any) -> bool:
    return isinstance(x, int) and not isinstance(x, bool)


# Each cell has its own.
OF_THE_GRID = ("seed", "output", "env", "conf", "label", "resume")
# What a grid's entries must be.
ENTRIES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "variants": (_is_list_of_names, "a list of names"),
    "tasks": (_is_list_of_names, "a list of names"),
    "seeds": (_is_number_of, "a whole number"),
    "options": (_are_options, f"a mapping of options with their values, none of {', '.join(OF_THE_GRID)}"),
    "variations": (_are_variations, "a mapping of names (letters, digits, _ . -) to settings such as {gamma: 0.9}"),
    "auto_ent_coef": (is_number, "a number"),
    "fixed_preferences": (
        lambda x: isinstance(x, dict) and all(map(_is_number_of, [*x, *x.values()])),
        "a mapping of whole numbers",
    ),
}


class Runs(Protocol):
    """What the module of a kind of run offers; settings are its own."""

    def check(self, settings: Any) -> None: ...

    def run(self, settings: Any, on_step: Callable[[int], None] | None = None) -> Any: ...

    def recorded_settings(self, settings: Any) -> dict[str, Any]: ...

    def record_failure(self, settings: Any, error: str, traceback: str = "") -> None: ...


@dataclass(frozen=True)
class Program:
    """What trains a cell.

    :param module: of its command line, `python -m module`
    :param parse: what reads that
    :param runs: what does with the settings that were read
    """

    module: str
    parse: Callable[[Sequence[str]], Any]
    runs: Runs


MOMBA = Program("sb3_momba.train", train.parse, runs)
BASELINES = Program("sb3_momba.baselines", baselines.parse, baseline_runs)


@dataclass(frozen=True)
class Cell:
    """One run.

    :param conf: yaml file or name of a shipped configuration, or a baseline's name
    :param options: further ones of `python -m sb3_momba.train` or `python -m sb3_momba.baselines`
    :param method: first part of the cell's name; by default the configuration's
    """

    conf: str
    env: str
    seed: int
    options: tuple[str, ...] = field(default=())
    method: str = ""

    @property
    def name(self) -> str:
        return f"{self.method or Path(self.conf).stem}/{self.env}/{self.seed}"

    @property
    def program(self) -> Program:
        return BASELINES if self.conf in VARIANTS else MOMBA

    def arguments(self, folder: Path) -> list[str]:
        """Of its program."""
        where = ["--env", self.env, "--seed", str(self.seed), "--output", str(folder)]
        if self.program is BASELINES:
            return [self.conf, *self.options, *where]
        return [*self.options, "--conf", self.conf, *where, "--no-progress-bar"]


@dataclass(frozen=True)
class Grid:
    """A yaml file's entries; see the module's docstring."""

    variants: list[str]
    tasks: list[str]
    seeds: int
    options: dict[str, Any] = field(default_factory=dict)
    variations: dict[str, dict[str, Any]] = field(default_factory=dict)
    auto_ent_coef: float | None = None
    fixed_preferences: dict[int, int] = field(default_factory=dict)


def shipped_grids() -> list[str]:
    """Names of the grids that come with the package."""
    return sorted(file.name.removesuffix(".yml") for file in SHIPPED.iterdir() if file.name.endswith(".yml"))


def read_grid(name: str) -> Grid:
    """
    :param name: a yaml file, or the name of a shipped grid
    :raises ValueError: for neither, for what is no yaml, and for entries that a grid does not have, lacks or cannot take
    """
    file = SHIPPED / f"{name}.yml" if name in shipped_grids() else Path(name)
    if not file.is_file():
        raise ValueError(f"{name!r} is neither a yaml file nor a shipped grid{nearest(name, shipped_grids())}")
    try:
        entries = literal(yaml.safe_load(file.read_text()))
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"{name} is not valid yaml, or asks for Python objects: {' '.join(str(error).split())}") from error
    check_names(name, entries, [entry.name for entry in fields(Grid)], "A grid has no entry")
    for entry in ("variants", "tasks", "seeds"):
        if entry not in entries:
            raise ValueError(f"{name} has no {entry}: a grid needs variants, tasks and seeds.")
    for entry, (fits, description) in ENTRIES.items():
        if entry in entries and not fits(entries[entry]):
            raise ValueError(f"{name}: {entry} is {entries[entry]!r}; it must be {description}.")
    if "variations" in entries and "fixed_preferences" in entries:
        raise ValueError(f"{name} has fixed_preferences and variations: use a grid for each.")
    if (first := Path(entries["variants"][0]).stem) in entries.get("variations", ()):
        raise ValueError(f"{name}: the variation {first!r} needs another name, this is the first variant's own name.")
    return Grid(**entries)


def make_cells(
    confs: Sequence[str],
    envs: Sequence[str],
    seeds: int,
    options: Sequence[str] = (),
    auto_ent_coef: float | None = None,
    fixed_preferences: Mapping[int, int] | None = None,
    variations: Mapping[str, Mapping[str, Any]] | None = None,
) -> list[Cell]:
    """Seeds vary slowest, so that whatever is finished compares all methods.

    :param seeds: how many
    :param auto_ent_coef: where configurations that learn alpha start it, all alike
    :param variations: by name: settings in which the first configuration is run besides
    :param fixed_preferences: by number of objectives how many preferences, each with a run of its own
    :raises ValueError: for a configuration that does not exist, or two of one name
    """
    for option in ("--seed", "--output", "--resume"):
        if any(given.split("=")[0] == option for given in options):
            raise ValueError(
                f"{option} is the grid's own for each run: give --seeds and the grid's --output; what was cut off goes on."
            )
    if seeds < 1:
        raise ValueError(f"seeds={seeds}: at least one is needed.")
    cells: list[Cell] = []
    for seed in range(seeds):
        for env in dict.fromkeys(envs):
            for conf in dict.fromkeys(confs):
                learned = learns_alpha(conf, env)
                start = ("--ent-coef", f"auto_{auto_ent_coef}") if auto_ent_coef is not None and learned else ()
                cell = Cell(conf, env, seed, (*start, *options))
                cells += _with_fixed_preferences(cell, fixed_preferences) if fixed_preferences else [cell]
                if conf == confs[0]:
                    cells += [_varied(cell, name, settings) for name, settings in (variations or {}).items()]
    return merged(cells)


def _varied(cell: Cell, name: str, settings: Mapping[str, Any]) -> Cell:
    return replace(cell, options=(*cell.options, *as_arguments({"set": settings}), "--label", name), method=name)


def learns_alpha(conf: str, env: str) -> bool:
    """:raises ValueError: for a configuration that does not exist"""
    if conf in VARIANTS:
        return False
    learned, _ = parse_ent_coef(read_configuration(conf, env).hyperparameters.get("ent_coef", "auto"))
    return learned


def _with_fixed_preferences(cell: Cell, numbers: Mapping[int, int]) -> list[Cell]:
    n_objectives = probe_environment(cell.env).n_objectives
    if n_objectives not in numbers:
        raise ValueError(f"fixed_preferences={dict(numbers)}: {cell.env} has {n_objectives} objectives; say how many for it.")
    return [
        replace(
            cell,
            options=(*cell.options, "--label", FIXED_PREFERENCE, "--preference", *map(str, preference)),
            method=f"{FIXED_PREFERENCE}-{number:02}",
        )
        for number, preference in enumerate(preference_grid(n_objectives, numbers[n_objectives]).tolist())
    ]


def merged(cells: Iterable[Cell]) -> list[Cell]:
    """Each cell once.

    :raises ValueError: for two different ones of one name
    """
    by_name: dict[str, Cell] = {}
    for cell in cells:
        other = by_name.setdefault(cell.name, cell)
        if other.conf != cell.conf:
            raise ValueError(f"{other.conf} and {cell.conf} have one name, {cell.name}: rename one of them.")
        if other != cell:
            raise ValueError(
                f"{cell.name} is asked for with {' '.join(other.options) or 'no options'} and with "
                f"{' '.join(cell.options) or 'no options'}: run these grids in folders of their own."
            )
    return list(by_name.values())


@contextlib.contextmanager
def _named(cell: Cell) -> Iterator[None]:
    """An error inside says which cell it is of."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{cell.name}: {error}") from error


def checked(cells: Sequence[Cell], output: Path) -> dict[str, Any]:
    """What the program of each cell reads from its arguments, by the cell's name.

    :raises ValueError: for settings that cannot be
    :raises gymnasium.error.Error: for an environment that does not exist, naming the nearest
    """
    if output.exists() and not output.is_dir():
        raise ValueError(f"--output {output} is a file: give a folder.")
    settings: dict[str, Any] = {}
    for cell in cells:
        with _named(cell):
            settings[cell.name] = cell.program.parse(cell.arguments(output / cell.name))
    one_of_each = {(cell.conf, cell.env, cell.method): cell for cell in cells}.values()
    for cell in one_of_each:
        with _named(cell):
            cell.program.runs.check(settings[cell.name])
    by_settings: dict[str, Cell] = {}
    for cell in one_of_each:
        if cell.program is MOMBA:
            same = json.dumps({**cell.program.runs.recorded_settings(settings[cell.name]), "label": None}, sort_keys=True)
            other = by_settings.setdefault(same, cell)
            if other is not cell:
                raise ValueError(
                    f"{other.name} and {cell.name} have the same settings: leave one of them out, or the option that makes "
                    "them alike, such as --auto-ent-coef."
                )
    return settings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Those that say what a grid consists of; see `cells_of`."""
    parser.add_argument("--grid", nargs="+", default=[], help=f"yaml files, or shipped: {', '.join(shipped_grids())}")
    parser.add_argument("--conf", nargs="+", default=[], help="instead: shipped configurations, yaml files or baselines")
    parser.add_argument("--env", nargs="+", default=[], help="environment ids; by default the grid's")
    parser.add_argument("--seeds", type=int, help="how many, 0, 1, ...; by default the grid's")
    parser.add_argument("--output", type=Path, required=True, help="folder of the run folders")
    parser.add_argument("--retry-failed", action="store_true", help="run again what failed")
    parser.add_argument("--report", action="store_true", help="at the end, the report of what lies in the output folder")
    parser.add_argument(
        "--auto-ent-coef", type=float, help="where every configuration that learns alpha starts it; 0.01 below 200,000 steps"
    )
    parser.epilog = "Every other option is handed to python -m sb3_momba.train (or baselines), such as --steps 3e4."


def cells_of(given: argparse.Namespace, options: Sequence[str]) -> list[Cell]:
    """What the command line asks for; its own words win over a grid's, but not over the settings that make a variation.

    :raises ValueError: for neither grids nor configurations, or both
    """
    if bool(given.grid) == bool(given.conf):
        raise ValueError("Give either --grid, or --conf with --env and --seeds.")
    if given.conf and not (given.env and given.seeds is not None):
        raise ValueError("--conf needs --env and --seeds.")
    grids = [read_grid(name) for name in given.grid] or [Grid(given.conf, given.env, given.seeds)]
    cells: list[Cell] = []
    for grid in grids:
        cells += make_cells(
            grid.variants,
            given.env or grid.tasks,
            grid.seeds if given.seeds is None else given.seeds,
            [*as_arguments(grid.options), *options],
            grid.auto_ent_coef if given.auto_ent_coef is None else given.auto_ent_coef,
            grid.fixed_preferences,
            grid.variations,
        )
    return merged(cells)
