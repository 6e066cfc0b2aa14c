"""What the README and the pages of docs/ promise: links that lead somewhere, names that exist, options that are taken."""

import importlib
import re
from pathlib import Path

import pytest

from sb3_momba.train import parse

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_placeholder_is_left(page: Path) -> None:
    assert not re.findall(r"^(?:[A-Z]{4,}(?:_[A-Z]+)*|TODO.*)$", page.read_text(), re.MULTILINE)


def test_the_functions_beside_the_equations_exist() -> None:
    page = (ROOT / "docs" / "algorithm.md").read_text()
    names = re.findall(r"`((?:nn|momba|envs|buffers|pareto|benchmark|MOMBA)\.[\w.*]+)`", page)
    assert len(names) > 25
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


def test_commands_of_the_readme_are_understood() -> None:
    commands = re.findall(r"^python -m sb3_momba\.train (.+)$", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert commands
    for command in commands:
        parse(command.split())


def test_python_of_the_pages_compiles() -> None:
    for page in PAGES:
        for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL):
            compile(block, page.name, "exec")
