"""The reports in docs/results are what their records give, bit for bit, with the versions of constraints.txt."""

import re
from pathlib import Path

import matplotlib
import pytest

from sb3_momba.benchmark.__main__ import main

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "docs" / "results"
COMMANDS = {"report.md": "report", "chapter4.md": "chapter4"}
REPORTS = sorted(path for name in COMMANDS for path in RESULTS.rglob(name))
# What a report takes before the records beside it.
ON_CHEETAH = ("baselines/capql", "momba/momba", "momba/her_par")
BEFORE = {
    "comparison": ["evidence"],
    "beyond": ["evidence"],
    "reduced": [f"evidence/{method}/MO-HalfCheetah-v4" for method in ON_CHEETAH],
}
OPTIONS = {"reduced": ["--steps", "3e4"]}
PINNED = re.search(r"^matplotlib==([\d.]+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE)


@pytest.mark.parametrize("report", REPORTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_reports_are_made_of_the_committed_records(tmp_path, report: Path) -> None:
    folders = [*(RESULTS / name for name in BEFORE.get(report.parent.name, [])), report.parent]
    main([COMMANDS[report.name], *map(str, folders), *OPTIONS.get(report.parent.name, []), "--output", str(tmp_path)])
    assert PINNED is not None
    for made in sorted(tmp_path.iterdir()):
        if made.suffix == ".png" and matplotlib.__version__ != PINNED.group(1):
            continue  # Another release draws text otherwise.
        assert made.read_bytes() == (report.parent / made.name).read_bytes(), made.name
    pictures = re.findall(r"\]\(([^)]+\.png)\)", report.read_text())
    assert pictures
    assert all((tmp_path / picture).exists() for picture in pictures)
