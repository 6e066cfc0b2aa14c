"""Two variants on two tasks with two seeds, side by side on Ray, and the report with its pictures.

    pip install "sb3-momba[benchmark]"
    python examples/sweep.py [STEPS [FOLDER]]

The same from the shell is `python -m sb3_momba.benchmark sweep` and then `report`, which take many more options: see
docs/benchmark.md. Started again, it goes on where it stopped. The 2,000 steps of each run take a few minutes and show the
machinery, not the methods, which need 30,000 and more.
"""

import logging
import sys
from pathlib import Path

from sb3_momba.benchmark.grid import make_cells
from sb3_momba.benchmark.report import read_begun, write_report
from sb3_momba.benchmark.results import compare
from sb3_momba.benchmark.sweep import run_sweep


def main(steps: int = 2_000, folder: Path = Path("runs/sweep")) -> None:
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    options = ["--steps", str(steps), "--eval-freq", str(steps // 2), "--n-preferences", "20", "--n-episodes", "1"]
    options += ["--set", "learning_starts=500"]
    cells = make_cells(["momba", "her"], ["MO-HalfCheetah-v4", "MO-Hopper-v4"], seeds=2, options=options, auto_ent_coef=0.01)
    for name, error in run_sweep(cells, folder).items():
        print(f"{name} failed:\n{error}")
    records = read_begun([folder])
    print(write_report(compare(records), records, folder))
    print(f"Written to {folder / 'report.md'}.")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(*([int(float(given[0]))] if given else []), *map(Path, given[1:]))
