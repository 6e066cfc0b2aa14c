"""`python -m sb3_momba.explorer report RUN` writes a page about runs, `strobe RUN` pictures of what their policies do;
`live MODEL` serves a page on which to choose a trade-off, and `calibrate MODEL` measures how well that page predicts."""

import argparse
import contextlib
import logging
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym

from sb3_momba.explorer import live
from sb3_momba.explorer.opening import write_calibration
from sb3_momba.explorer.rendering import quieten
from sb3_momba.explorer.report import write_report
from sb3_momba.explorer.stage import RenderingError
from sb3_momba.explorer.strobe import draw_strobe
from sb3_momba.files import no_link


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m sb3_momba.explorer", description=__doc__, allow_abbrev=False)
    commands = parser.add_subparsers(dest="command", required=True)

    report = commands.add_parser("report", help="one HTML file about runs of one task", allow_abbrev=False)
    report.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folder of a run")
    report.add_argument("--output", type=Path, help="the file; by default report.html in the first RUN")
    report.add_argument("--films", type=int, help="preferences filmed of each run, 0 for none; by default 20 for all runs")
    report.add_argument("--reference-point", type=float, nargs="+", help="of the hypervolume, instead of the records' own")

    strobe = commands.add_parser("strobe", help="a picture of the poses along each path", allow_abbrev=False)
    strobe.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    strobe.add_argument(
        "--preferences", nargs="+", type=weights, metavar="W1,W2,...", help="such as 1,0 0.5,0.5 0,1; by default four of them"
    )
    strobe.add_argument("--output", type=Path, help="the picture; by default strobe.png in RUN")
    strobe.add_argument("--steps", type=int, help="how long each path is; by default 3 s of simulated time")
    strobe.add_argument("--poses", type=int, default=8, help="how many of them are drawn along it")

    serving = commands.add_parser("live", help="choose a trade-off on a page of this machine", allow_abbrev=False)
    add_model(serving)
    serving.add_argument("--seeds", type=Path, nargs="+", default=[], metavar="RUN", help="the same method's, of other seeds")
    serving.add_argument("--keep", type=Path, metavar="FOLDER", help="where kept policies go; by default kept beside the model")
    serving.add_argument("--host", default=live.HOST, help="to listen on; by default this machine alone reaches it")
    serving.add_argument("--port", type=int, default=live.PORT, help="0 takes a free one; by default %(default)s")

    calibrating = commands.add_parser("calibrate", help="compare predictions with rollouts", allow_abbrev=False)
    add_model(calibrating)
    calibrating.add_argument("--preferences", type=int, default=100, help="drawn at random; by default %(default)s")
    calibrating.add_argument("--output", type=Path, help="the picture; by default calibration.png beside MODEL")

    words = sys.argv[1:] if arguments is None else arguments
    # argparse takes "-0.5,1.5" for an option, but not behind a space: what is wrong with it is said where weights are checked.
    given = parser.parse_args([f" {word}" if re.match(r"-[\d.]+,", word) else word for word in words])
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    quieten()
    try:
        if given.command == "live":
            with contextlib.suppress(KeyboardInterrupt):
                live.serve(given.model, given.env, given.seeds, given.keep, given.host, given.port)
            return
        if given.command == "report":
            if given.films is not None and given.films < 0:
                raise ValueError(f"--films {given.films}: give 0 or more.")
            path = given.output or no_link(given.runs[0] / "report.html", "--output")
            write_report(given.runs, path, given.films, given.reference_point)
        elif given.command == "calibrate":
            folder = given.model if given.model.is_dir() else given.model.parent
            path = given.output or no_link(folder / "calibration.png", "--output")
            write_calibration(given.model, given.env, given.preferences, path)
        else:
            path = given.output or no_link(given.run / "strobe.png", "--output")
            draw_strobe(given.run, path, given.preferences, given.steps, given.poses)
        print(f"Written to {path} ({path.stat().st_size / 1e6:.1f} MB).")
    except (ValueError, OSError, ImportError, RenderingError, gym.error.Error) as error:
        sys.exit(f"error: {error}")


def add_model(parser: argparse.ArgumentParser) -> None:
    """What `live` and `calibrate` are about."""
    parser.add_argument("model", type=Path, metavar="MODEL", help="folder of a run, or a model's file with --env")
    parser.add_argument("--env", help="the id of the environment of a model's file")


def weights(text: str) -> list[float]:
    """ "0.3,0.7" -> [0.3, 0.7]"""
    return [float(weight) for weight in text.split(",")]


if __name__ == "__main__":
    main()
