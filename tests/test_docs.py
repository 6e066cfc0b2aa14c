"""What the README and the pages of docs/ promise: code that runs, links that lead somewhere, arguments that exist, and a site
without warnings. Their commands are in test_docs_commands.py."""

import contextlib
import importlib.util
import inspect
import io
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import gymnasium as gym
import matplotlib
import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3.common.callbacks import ProgressBarCallback
from stable_baselines3.common.noise import NormalActionNoise
from torch import nn

import sb3_momba
from sb3_momba import MOMBA, train
from sb3_momba.benchmark import grid
from sb3_momba.envs.registry import TASKS
from sb3_momba.policies import MlpPolicy, SimbaPolicy
from sb3_momba.policy import MombaPolicy
from sb3_momba.settings import policy_parameters
from tests.pages import (
    BLOCK,
    CALLS,
    PAGES,
    ROOT,
    anchors,
    blocks,
    every_page,
    finished_run,
    links,
    make_everything_short,
    put_the_hub_into,
)
from tests.test_docstrings import CLASSES, own_members

DOCS = ROOT / "docs"


def pages_with(language: str) -> Any:
    return pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, language)], ids=lambda page: page.name)


# -------------------------------------------------------------------------------------------------------------- links


@every_page
def test_links_lead_somewhere(page: Path) -> None:
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


@every_page
def test_no_placeholder_is_left(page: Path) -> None:
    assert not re.findall(r"^(?:[A-Z]{4,}(?:_[A-Z]+)*|TODO.*)$", page.read_text(), re.MULTILINE)


@every_page
def test_files_and_tests_between_backticks_exist(page: Path) -> None:
    for path, name in re.findall(r"`((?:tests|sb3_momba|examples|docs)/[\w/.]+)(?:::(\w+))?`", page.read_text()):
        assert (ROOT / path).exists(), path
        if name:
            assert f"def {name}(" in (ROOT / path).read_text(), name


class Page(HTMLParser):
    """What a page of the site links to, and what in it can be linked to."""

    def __init__(self, path: Path):
        super().__init__()
        self.links: set[str] = set()
        self.ids: set[str] = {""}
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.ids.add(given.get("id") or "")
        self.links |= {given[name] or "" for name in ("href", "src") if given.get(name)}


def test_the_site_is_made_without_warnings_and_has_no_dead_link(tmp_path: Path) -> None:
    options = ["-q", "-W", "--keep-going", "-n", "-b", "html", "-d", tmp_path / "doctrees"]
    command = [sys.executable, "-m", "sphinx", *options, DOCS, tmp_path / "html"]
    made = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert (made.returncode, made.stderr) == (0, "")
    site = {path.resolve(): Page(path) for path in (tmp_path / "html").rglob("*.html")}
    assert {path.stem for path in site} > {page.stem for page in DOCS.glob("*.md")}
    for path, page in site.items():
        for link in page.links:
            if re.match(r"[a-z]+:", link) or link.startswith("//"):
                continue
            file, _, anchor = unquote(link).partition("#")
            target = (path.parent / file.partition("?")[0]).resolve() if file else path
            assert target.is_file(), (path.name, link)
            if target in site:
                assert anchor in site[target].ids, (path.name, link)


# --------------------------------------------------------------------------------------------------------------- code


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    make_everything_short(monkeypatch)
    put_the_hub_into(tmp_path / "hub", monkeypatch)
    return tmp_path


@pages_with("python")
def test_python_of_the_pages_runs(page: Path, short: Path) -> None:
    """The blocks of a page one after the other; a comment behind a `print` is what it prints."""
    if page.stem in ("saving", "training"):
        finished_run("runs/hopper")
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks(page, "python"):
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            exec(compile(block, str(page), "exec"), names)
        promised = re.findall(r"^print\(.*\)  # (.+)$", block, re.MULTILINE)
        assert not promised or said.getvalue().splitlines() == promised


def test_the_calls_of_coming_from_run_on_both_sides(short: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (DOCS / "coming_from.md").read_text()
    pieces = sorted([*BLOCK.finditer(text), *CALLS.finditer(text)], key=lambda piece: piece.start())
    theirs: dict[str, Any] = {}
    ours: dict[str, Any] = {}
    for piece in pieces:
        left, right = piece.groups() if piece.re is CALLS else (piece[2], piece[2])
        for side, names, code in (("theirs", theirs, left), ("ours", ours, right)):
            (short / side).mkdir(exist_ok=True)
            monkeypatch.chdir(short / side)
            exec(code, names)
    for name in ("area", "utility", "distance"):
        assert np.isclose(theirs[name], ours[name]), name
    assert np.shape(theirs["values"]) == (20, 2)


def test_the_code_that_features_name_runs(short: Path) -> None:
    """`...` stands for a policy and an environment; cells that name a test beside their code are that test's."""
    cells_of_ours = re.findall(r"^\| [^|]+ \| (yes[^|]+) \|", (DOCS / "features.md").read_text(), re.MULTILINE)
    codes = [code for cell in cells_of_ours if "tests/" not in cell for code in re.findall(r"`([\w.]+[(\[].+?)`", cell)]
    finished_run("runs/hopper")
    names = {**vars(sb3_momba), "np": np, "NormalActionNoise": NormalActionNoise, "ProgressBarCallback": ProgressBarCallback}
    exec(PREPARATION, names)
    assert len(codes) > 20
    for code in codes:
        eval(code.replace("MOMBA(...", 'MOMBA("SimbaPolicy", "mo-hopper-2obj-v5"'), names)


PREPARATION = """
import gymnasium

import sb3_momba.hub

env = "mo-hopper-2obj-v5"
obs = gymnasium.make(env).reset()[0]
model = MOMBA("SimbaPolicy", env)
model.learn(100, MombaCheckpointCallback(10, "checkpoints"))
front = sb3_momba.evaluate_front(model, env)
"""


@pages_with("yaml")
def test_yaml_of_the_pages_is_taken(page: Path, tmp_path: Path) -> None:
    for number, block in enumerate(blocks(page, "yaml")):
        file = tmp_path / f"{number}.yml"
        file.write_text(block)
        if "variants:" in block:
            assert grid.read_grid(str(file)).seeds > 0
        else:
            train.parse(["--env", "mo-hopper-2obj-v5", "--conf", str(file)])


# ------------------------------------------------------------------------------------------------------ names and tables


def test_the_functions_beside_the_equations_exist() -> None:
    page = (DOCS / "algorithm.md").read_text()
    names = re.findall(r"`((?:nn|momba|envs|buffers|pareto|benchmark|MOMBA)\.[\w.*]+)`", page)
    assert len(names) > 40
    for name in names:
        for full in [name.replace("*", kind) for kind in ("DistributionalValue", "ExpectedValue")] if "*" in name else [name]:
            assert resolve(full.replace("MOMBA.", "momba.MOMBA.", 1)) is not None, full


def resolve(name: str) -> object:
    parts = name.split(".")
    for i in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module("sb3_momba." + ".".join(parts[:i]))
        except ModuleNotFoundError:
            continue
        for part in parts[i:]:
            found = getattr(found, part, None)
        return found
    return None


def test_every_number_of_an_equation_in_a_docstring_stands_on_the_page() -> None:
    sources = "".join(path.read_text() for path in (ROOT / "sb3_momba").rglob("*.py"))
    numbers = set(re.findall(r"\(([234]\.\d+)\)", sources))
    page = (DOCS / "algorithm.md").read_text()
    assert len(numbers) > 15
    assert {number for number in numbers if f"({number})" not in page} == set()


def test_every_hyperparameter_stands_once_on_its_page_with_its_default() -> None:
    rows = re.findall(r"^\| `(\w+)` \|([^|]*)\|", (DOCS / "hyperparameters.md").read_text(), re.MULTILINE)
    given = {name: default.strip().strip("*").strip("`") for name, default in rows}
    assert len(given) == len(rows)
    defaults = {}
    for one in (MOMBA, MombaPolicy, SimbaPolicy, MlpPolicy):
        known = list(inspect.signature(MOMBA).parameters) if one is MOMBA else policy_parameters(one)
        own = inspect.signature(one).parameters
        defaults |= {name: own[name].default for name in known if name in own and name[0] != "_" and name != "others"}
    assert set(given) == set(defaults)
    for name, default in defaults.items():
        if default is inspect.Parameter.empty:
            assert given[name] == "", name
        else:
            assert eval(given[name], {"th": th, "nn": nn}) == default, name


def test_bold_defaults_are_those_of_table_b_1() -> None:
    configured = yaml.safe_load((ROOT / "sb3_momba/zoo/hyperparams/momba.yml").read_text())["default"]
    table = {**configured["policy_kwargs"], **configured}
    bold = re.findall(r"^\| `(\w+)` \| \*\*`(.+?)`\*\* \|", (DOCS / "hyperparameters.md").read_text(), re.MULTILINE)
    assert len(bold) == 17
    for name, default in bold:
        value = eval(default)
        assert (list(value) if isinstance(value, tuple) else value) == table[name], name


def test_the_tasks_are_as_their_table_says() -> None:
    rows = [line.split(" | ") for line in (DOCS / "tasks.md").read_text().splitlines() if line.startswith("| `MO-")]
    assert [row[0].strip("|` ") for row in rows] == list(TASKS)
    for row, (env_id, (_, steps)) in zip(rows, TASKS.items(), strict=True):
        env = gym.make(env_id)
        assert (int(row[1]),) == env.observation_space.shape
        assert (int(row[2]),) == env.action_space.shape
        assert tuple(row[3].split("; ")) == env.unwrapped.objectives
        assert int(row[5]) == steps


def test_the_api_has_every_public_name_and_method() -> None:
    page = (DOCS / "api.md").read_text()
    entries = dict(re.findall(r":: (?:[\w.]+\.)?(\w+)\n((?:   .*\n)*)", page))
    assert set(sb3_momba.__all__) <= set(entries)
    for name, cls in CLASSES.items():
        listed = set(re.findall(r"\w+", entries[name]))
        for member, _ in own_members(cls):
            owner, method = member.split(".")
            assert method in listed or ":members:\n" in entries.get(owner, ""), member
