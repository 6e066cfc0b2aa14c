"""What files, checkpoints and resumption promise, put to the test: see the package."""

import argparse
import logging
import sys
import tempfile
import time
import warnings

import torch as th

from sb3_momba.benchmark.tables import markdown
from tests.torture.disk import disk
from tests.torture.guards import guards
from tests.torture.kill import kill
from tests.torture.measured import Counts
from tests.torture.million import million
from tests.torture.mutate import mutate
from tests.torture.operations import operations
from tests.torture.processes import new_folder
from tests.torture.resume import resume
from tests.torture.trainings import LEARNING_STARTS, new_model

COUNTS = {
    "long": {
        "kills": 500,
        "sb3_kills": 100,
        "every_write": 1,
        "points": 100,
        "resumed_steps": 260,
        "sb3_points": 8,
        "mutations": 10_000,
        "every_slot": 1,
        "limits": 40,
        "checkpoints": 5,
        "windows": 20,
        "window_steps": 40,
    },
    "short": {
        "kills": 8,
        "sb3_kills": 2,
        "every_write": 200,
        "points": 8,
        "resumed_steps": 40,
        "sb3_points": 1,
        "mutations": 300,
        "every_slot": 10,
        "limits": 6,
        "windows": 3,
        "window_steps": 4,
    },
}
PARTS = {
    "kill": kill,
    "operations": operations,
    "resume": resume,
    "mutate": mutate,
    "disk": disk,
    "million": million,
    "guards": guards,
}
MOST_SHOWN = 20


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"by default all: {', '.join(PARTS)}")
    parser.add_argument("--counts", choices=COUNTS, default="long")
    given = parser.parse_args()
    unknown = [part for part in given.parts if part not in PARTS]
    if unknown:
        parser.error(f"no part is called {unknown[0]!r}: {', '.join(PARTS)}")
    th.set_num_threads(1)  # a pool of threads does not survive a fork
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    parts = [name for name in given.parts or PARTS if name != "million" or given.counts == "long"]
    with new_folder() as folder:
        tempfile.tempdir = str(folder)  # for what SB3 leaves there, too
        new_model().learn(LEARNING_STARTS + 2)  # Now forked processes need not import anything.
        n_broken = sum(measure_and_print(name, COUNTS[given.counts]) for name in parts)
        tempfile.tempdir = None
    return 1 if n_broken else 0


def measure_and_print(name: str, counts: Counts) -> int:
    """How many promises did not hold."""
    start = time.perf_counter()
    measured = PARTS[name](counts)
    print(f"{name}: {PARTS[name].__doc__} ({time.perf_counter() - start:.0f} s)\n")
    print(markdown([[str(cell) for cell in row] for row in measured.rows]))
    for fault in measured.broken[:MOST_SHOWN]:
        print(f"NOT HELD: {fault}")
    if len(measured.broken) > MOST_SHOWN:
        print(f"NOT HELD: and {len(measured.broken) - MOST_SHOWN} more")
    print(flush=True)
    return len(measured.broken)


if __name__ == "__main__":
    sys.exit(main())
