"""The short form of tests/torture: kills, full disks, damaged and malicious files, resumption, the cost of checks."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Processes are forked, killed and limited.")


ROWS = {
    "kill": "32",
    "operations": "32",
    "resume": "32",
    "mutate": "34 and 35",
    "disk": "29",
    "guards": "none",
}  # of the table of faults


@pytest.mark.parametrize("part", ROWS, ids=[f"{part}, row {rows}" for part, rows in ROWS.items()])
def test_every_promise_holds(part):
    # In a process of its own: one that has computed on several threads could not be forked.
    command = [sys.executable, "-m", "tests.torture", part, "--counts", "short"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    root = Path(__file__).parent.parent
    ended = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stdout + ended.stderr
