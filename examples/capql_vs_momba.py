"""CAPQL and Momba on one task with two seeds, and the report. `[STEPS [FOLDER [TASK]]]`

The same from the shell is `python -m sb3_momba.benchmark run` and then `report`: see docs/benchmark.md. Started again, it
goes on where it stopped; with the 30,000 steps of each run it takes an hour on two cores.
"""

import logging
import sys
from pathlib import Path

from sb3_momba.benchmark.grid import make_cells
from sb3_momba.benchmark.local import run_grid
from sb3_momba.benchmark.report import read_begun, write_report
from sb3_momba.benchmark.results import compare


def main(steps: int = 30_000, folder: Path = Path("runs/capql_vs_momba"), task: str = "MO-HalfCheetah-v4") -> None:
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    options = ["--steps", str(steps), "--eval-freq", str(max(1, steps // 3)), "--n-preferences", "20"]
    run_grid(make_cells(["momba", "capql"], [task], seeds=2, options=options, auto_ent_coef=0.01), folder)
    records = read_begun([folder])
    print(write_report(compare(records), records, folder, baseline="capql"))
    print(f"Written to {folder / 'report.md'}.")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(*map(int, given[:1]), *map(Path, given[1:2]), *given[2:])
