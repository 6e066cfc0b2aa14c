"""How the throughput of a sweep grows with its workers: `python -m tests.sweep_throughput [STEPS]`, on a quiet machine.
Four runs of MO-HalfCheetah-v4, by one worker and by two, the time from the start of the sweep to its end."""

import sys
import tempfile
import time
from pathlib import Path

from sb3_momba.benchmark.grid import make_cells
from sb3_momba.benchmark.sweep import run_sweep


def seconds(workers: int, steps: int) -> float:
    options = ["--steps", str(steps), "--eval-freq", str(steps), "--n-preferences", "10", "--set", "learning_starts=100"]
    cells = make_cells(["momba"], ["MO-HalfCheetah-v4"], seeds=4, options=options)
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        failed = run_sweep(cells, Path(folder), workers=workers)
        assert not failed, failed
        return time.perf_counter() - started


def main(steps: int = 2_000) -> None:
    one, two = seconds(1, steps), seconds(2, steps)
    print(f"4 runs of {steps:,} steps: {one:.0f} s by one worker, {two:.0f} s by two: {one / two:.2f} times the throughput")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
