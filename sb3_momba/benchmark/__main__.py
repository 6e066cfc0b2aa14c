"""`python -m sb3_momba.benchmark run` trains a grid of runs, `sweep` does on Ray, `report` compares their records, `floors`
measures policies that learned nothing, `speed` this machine."""

import argparse
import sys
from collections.abc import Sequence

import gymnasium as gym

from sb3_momba.benchmark import floors, grid, report, speed, sweep


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m sb3_momba.benchmark", description=__doc__, allow_abbrev=False)
    commands = parser.add_subparsers(dest="command", required=True)
    grid.add_arguments(commands.add_parser("run", help="train a grid of runs", allow_abbrev=False))
    sweep.add_arguments(commands.add_parser("sweep", help="train a grid of runs on Ray", allow_abbrev=False))
    report.add_arguments(commands.add_parser("report", help="compare records", allow_abbrev=False))
    floors.add_arguments(commands.add_parser("floors", help="measure policies that learned nothing", allow_abbrev=False))
    speed.add_arguments(commands.add_parser("speed", help="measure speed on this machine", allow_abbrev=False))
    given, rest = parser.parse_known_args(arguments)
    try:
        if given.command == "run":
            grid.main(given, rest)
        elif given.command == "sweep":
            sweep.main(given, rest)
        elif rest:
            parser.error(f"unrecognized arguments: {' '.join(rest)}")
        elif given.command == "report":
            report.main(given)
        elif given.command == "floors":
            floors.main(given)
        else:
            speed.main(given)
    except (ValueError, OSError, ImportError, gym.error.Error) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
