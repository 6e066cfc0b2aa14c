"""The examples, in short."""

import os
import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(name: str, *arguments: str, cwd: Path, timeout: float = 300) -> str:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    command = [sys.executable, EXAMPLES / name, *arguments]
    ended = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=timeout)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "Warning" not in ended.stderr, ended.stderr
    return ended.stdout


def test_an_environment_of_ones_own(tmp_path):
    said = run("custom_environment.py", "600", cwd=tmp_path)
    assert said.count("preference [") == 5


def test_a_sweep_and_its_report(tmp_path):
    said = run("sweep.py", "40", "sweep", cwd=tmp_path, timeout=900)
    assert said.count("2/2") == 4  # both variants on both tasks
    for name in ("report.md", "curve-MO-Hopper-v4.png", "front-MO-HalfCheetah-v4.png"):
        assert (tmp_path / "sweep" / name).exists()
