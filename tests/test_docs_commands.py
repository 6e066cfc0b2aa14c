"""The commands of the README and of the pages of docs/: their own parsers understand them, and nothing runs."""

import argparse
import importlib.util
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

from sb3_momba import train
from sb3_momba.benchmark import __main__ as benchmark
from sb3_momba.benchmark import grid, local, sweep
from sb3_momba.zoo import __main__ as zoo
from tests.pages import BLOCK, PAGES, ROOT, commands, every_page


class UnderstoodError(Exception):
    pass


@pytest.fixture
def parse_only(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Commands stop where they would begin: what they are asked for has been understood by then."""

    def stop(*_: Any, **__: Any) -> None:
        raise UnderstoodError

    def check_cells(asked_for: list[grid.Cell], output: Path, *_: Any) -> None:
        for cell in asked_for[:: max(1, len(asked_for) // 3)]:
            cell.program.parse(cell.arguments(output / cell.name))
        raise UnderstoodError

    def after_parsing(script: Any, command: str, arguments: list[str]) -> None:
        parse = argparse.ArgumentParser.parse_args
        with monkeypatch.context() as patch:
            patch.setattr(argparse.ArgumentParser, "parse_args", lambda *given: stop(parse(*given)))
            patch.setattr(sys, "argv", [command, *arguments])
            script()

    monkeypatch.chdir(tmp_path)
    (tmp_path / "logs" / "momba").mkdir(parents=True)
    for env in ("mo-hopper-2obj-v5", "MO-Hopper-v4"):
        (tmp_path / "logs" / "momba" / f"{env}_1").mkdir()
    monkeypatch.setattr(local, "run_grid", check_cells)
    monkeypatch.setattr(sweep, "run_sweep", check_cells)
    for module, _ in benchmark.COMMANDS.values():
        if module not in (local, sweep):
            monkeypatch.setattr(module, "main", stop)
    monkeypatch.setattr(zoo, "call", after_parsing)


def understand(module: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    if module == "sb3_momba.train":
        if train.parse_resume(arguments) is None:
            train.parse(arguments)
        return
    main = importlib.import_module(f"{module}.__main__").main
    if not module.startswith(("sb3_momba.benchmark", "sb3_momba.zoo")):
        parse = argparse.ArgumentParser.parse_args

        def stop(*given: Any) -> None:
            raise UnderstoodError(parse(*given))

        monkeypatch.setattr(argparse.ArgumentParser, "parse_args", stop)
    with pytest.raises(UnderstoodError):
        main(arguments)


COMMANDS = [(page, command) for page in PAGES for command in commands(page)]


@pytest.mark.parametrize(("page", "command"), COMMANDS, ids=[f"{page.name}-{i}" for i, (page, _) in enumerate(COMMANDS)])
def test_commands_are_understood(
    page: Path, command: str, parse_only: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = shlex.split(command, comments=True)
    if words[:2] == ["python", "-m"]:
        understand(words[2], words[3:], monkeypatch)
    elif words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    else:
        assert words[:2] == ["pip", "install"], command
    setup = (ROOT / "setup.py").read_text()
    for extra in re.findall(r"\[([\w,]+)\]", command if words[0] == "pip" else ""):
        assert all(f'"{name}": [' in setup for name in extra.split(","))


@every_page
def test_modules_and_options_between_backticks_exist(page: Path) -> None:
    """These commands need not be complete."""
    text = " ".join(BLOCK.sub("", page.read_text()).split())
    sources = "".join(path.read_text() for path in (ROOT / "sb3_momba").rglob("*.py"))
    for command in re.findall(r"`(python -m (?:sb3_momba|tests)[^`]*)`", text):
        _, _, module, *words = command.split()
        assert importlib.util.find_spec(module) is not None, command
        for word in words:
            if word.startswith("--") and word not in ("--help", "--..."):
                assert f'"{word}"' in sources, command
            if word == words[0] and re.fullmatch(r"[a-z]\w+", word) and not module.startswith("tests"):
                assert f'"{word}"' in sources, command


@every_page
def test_targets_of_make_exist(page: Path) -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert set(re.findall(r"`make ([\w-]+)`", page.read_text())) <= set(targets)
