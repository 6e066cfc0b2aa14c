"""What a grid says at its end."""

import sys
from collections.abc import Mapping
from pathlib import Path
from textwrap import indent

from sb3_momba.benchmark import report


def end(failures: Mapping[str, str], output: Path, with_report: bool) -> None:
    """Print what did not finish, by name, and the report if it is asked for; leave with an error if anything did not finish."""
    for name, text in failures.items():
        print(f"\n{name}\n{indent(text, '    ')}", file=sys.stderr)
    errors = []
    if with_report:
        try:
            report.tell(report.read_begun([output]), output)
        except (ValueError, OSError) as error:
            errors.append(f"There is no report: {error}")
    if failures:
        runs = "run" if len(failures) == 1 else "runs"
        errors.append(
            f"{len(failures)} {runs} did not finish ({', '.join(failures)}); their logs lie beside their folders in {output}. "
            "The same command goes on with what was cut off or never began, and with --retry-failed with what failed."
        )
    if errors:
        sys.exit(f"error: {' '.join(errors)}")
