"""The examples, in short."""

import os
import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(name: str, *arguments: str, cwd: Path) -> str:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    command = [sys.executable, EXAMPLES / name, *arguments]
    ended = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "Warning" not in ended.stderr, ended.stderr
    return ended.stdout


def test_an_environment_of_ones_own(tmp_path):
    said = run("custom_environment.py", "600", cwd=tmp_path)
    assert said.count("preference [") == 5
