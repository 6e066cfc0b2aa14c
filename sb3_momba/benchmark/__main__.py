"""Comparing methods: grids of runs, on this machine or on Ray, reports from their records, and what must be beaten."""

import argparse
import sys
from collections.abc import Sequence

import gymnasium as gym

from sb3_momba.benchmark import floors, local, report, speed, sweep
from sb3_momba.benchmark.chapter4 import command as chapter4
from sb3_momba.benchmark.chapter4 import figure31
from sb3_momba.envs.workers import WorkerError

COMMANDS = {
    "run": (local, "train a grid of runs"),
    "sweep": (sweep, "train a grid of runs on Ray"),
    "report": (report, "compare records"),
    "chapter4": (chapter4, "the thesis's tables and figures of records"),
    "figure31": (figure31, "the return distributions of saved critics"),
    "floors": (floors, "measure policies that learned nothing"),
    "speed": (speed, "measure speed on this machine"),
}
# The options that they do not know are those of `python -m sb3_momba.train`.
HAND_ON = ("run", "sweep")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m sb3_momba.benchmark", description=__doc__, allow_abbrev=False)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, (module, text) in COMMANDS.items():
        module.add_arguments(commands.add_parser(name, help=text, allow_abbrev=False))
    given, rest = parser.parse_known_args(arguments)
    module, _ = COMMANDS[given.command]
    if rest and given.command not in HAND_ON:
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    try:
        module.main(given, *([rest] if given.command in HAND_ON else []))
    except (ValueError, OSError, MemoryError, ImportError, WorkerError, gym.error.Error) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("\nInterrupted: the same command goes on.", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
