"""rl_zoo3's scripts with MOMBA registered: `python -m sb3_momba.zoo train|enjoy|optimize|plot`, with rl_zoo3's own options.

Raw ids become those of `momba/`, whose rewards are numbers. Needs `pip install "sb3-momba[zoo]"`.
"""

import argparse
import importlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_momba.envs.registry import PREFIX, preference_id
from sb3_momba.envs.workers import WorkerError
from sb3_momba.zoo.configuration import find_file

PROGRAM = "python -m sb3_momba.zoo"
NO_ENV = "--env is missing: give the id of an environment, such as mo-hopper-2obj-v5."
PLOTS = ("plot_train", "all_plots", "plot_from_file")


def import_rl_zoo3(module: str) -> Any:
    """One of rl_zoo3's modules.

    :raises ImportError: where it is not installed, with the command that does it
    """
    try:
        importlib.import_module("rl_zoo3")
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f'This needs rl_zoo3 ({error}): pip install "sb3-momba[zoo]"') from error


def call(script: Callable[[], None], command: str, arguments: Sequence[str]) -> None:
    """Run a script that reads `sys.argv`."""
    before = sys.argv
    sys.argv = [f"{PROGRAM} {command}", *arguments]
    try:
        script()
    finally:
        sys.argv = before


def new_parser(command: str) -> argparse.ArgumentParser:
    """For the options that are ours to read; all others are rl_zoo3's."""
    description = "The options that are read here; rl_zoo3's follow."
    return argparse.ArgumentParser(f"{PROGRAM} {command}", description=description, add_help=False, allow_abbrev=False)


def read(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Our options, and rl_zoo3's, which prints its help after ours."""
    given, rest = parser.parse_known_args(arguments)
    if wants_help(rest):
        print(parser.format_help(), flush=True)
    return given, rest


def wants_help(arguments: Sequence[str]) -> bool:
    return "-h" in arguments or "--help" in arguments


def task_options(given: argparse.Namespace, rest: Sequence[str]) -> list[str]:
    """The algorithm and the environment, in rl_zoo3's words.

    :raises ValueError: without an environment
    """
    for package in given.gym_packages:
        importlib.import_module(package)
    packages = ["--gym-packages", *given.gym_packages] if given.gym_packages else []
    if wants_help(rest):
        return packages
    if given.env is None:
        raise ValueError(NO_ENV)
    env = preference_id(given.env) if given.algo == "momba" else given.env
    return ["--algo", given.algo, "--env", env, *packages]


def add_task_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--algo", default="momba", help="momba by default")
    parser.add_argument("--env", help="raw id, or momba/ id")
    parser.add_argument("--gym-packages", nargs="+", default=[], help="modules that register environments")


def train(command: str, arguments: Sequence[str]) -> None:
    """rl_zoo3's train, with momba.yml as the default file and shipped configurations by name."""
    parser = new_parser(command)
    add_task_arguments(parser)
    parser.add_argument("-conf", "--conf", "--conf-file", help="yaml file, or a shipped configuration; momba by default")
    given, rest = read(parser, arguments)
    options = [*task_options(given, rest), *rest]
    script = import_rl_zoo3("rl_zoo3.train")
    manager = import_rl_zoo3("sb3_momba.zoo.manager")
    manager.register()
    if given.algo == manager.NAME:
        script.ExperimentManager = manager.MombaExperimentManager
        options += ["--conf-file", str(find_file(given.conf or manager.NAME))]
    elif given.conf is not None:
        options += ["--conf-file", given.conf]
    call(script.train, command, [*options, "-optimize"] if command == "optimize" else options)


def enjoy(command: str, arguments: Sequence[str]) -> None:
    """rl_zoo3's enjoy, with `--preference`."""
    parser = new_parser(command)
    add_task_arguments(parser)
    parser.add_argument("-f", "--folder", default="logs", help="logs by default")
    parser.add_argument("--preference", type=float, nargs="+", help="weights that sum to 1; by default the sampler's")
    given, rest = read(parser, arguments)
    options = [*task_options(given, rest), "--folder", given.folder, *rest]
    script = import_rl_zoo3("rl_zoo3.enjoy")
    manager = import_rl_zoo3("sb3_momba.zoo.manager")
    manager.register()
    if given.algo != manager.NAME and given.preference is not None:
        raise ValueError(f"--preference is for --algo {manager.NAME}: of {given.algo} it would change nothing. Leave it out.")
    if given.algo == manager.NAME:
        playing = importlib.import_module("sb3_momba.zoo.playing")
        own = importlib.import_module("rl_zoo3.utils").create_test_env
        script.create_test_env = playing.with_preference(own, given.preference)
    call(script.enjoy, command, options)


def plot(command: str, arguments: Sequence[str]) -> None:
    """One of rl_zoo3's plots, `plot_train` by default, with `--picture`."""
    name, rest = (arguments[0], arguments[1:]) if arguments and arguments[0] in PLOTS else (PLOTS[0], arguments)
    parser = new_parser(f"{command} {name}")
    parser.add_argument("--picture", type=Path, help="file to draw into, instead of a window")
    if name != "plot_from_file":
        parser.add_argument("-a", "--algo", "--algos", nargs="+", default=["momba"], help="momba by default")
        parser.add_argument("-e", "--env", nargs="+", help="raw ids, or momba/ ids")
        parser.add_argument("-f", "--exp-folder", "--exp-folders", nargs="+", default=["logs"], help="logs by default")
    given, options = read(parser, rest)
    script = getattr(import_rl_zoo3("rl_zoo3.plots"), name)
    if name != "plot_from_file" and not wants_help(options):
        if given.env is None:
            raise ValueError(NO_ENV)
        # rl_zoo3 looks for them in its folders' names, where a momba/ id has one dash and a raw one its own dots.
        names_of_folders = [env.replace("/", "-" if env.startswith(PREFIX) else ".") for env in given.env]
        for env, of_folder in zip(given.env, names_of_folders, strict=True):
            if not any(any(Path(folder, algo).glob(f"*{of_folder}*")) for folder in given.exp_folder for algo in given.algo):
                raise ValueError(
                    f"--env {env}: no run of {', '.join(given.algo)} in {', '.join(given.exp_folder)} has this name."
                )
        options += ["-a", *given.algo, "-f", *given.exp_folder, "-e", *names_of_folders]
    pyplot = importlib.import_module("matplotlib.pyplot")
    if given.picture is not None:
        pyplot.switch_backend("agg")
    call(script, f"{command} {name}", options)
    if given.picture is not None:
        numbers = pyplot.get_fignums()
        for number in numbers:
            stem = given.picture.stem if len(numbers) == 1 else f"{given.picture.stem}-{number}"
            pyplot.figure(number).savefig(given.picture.with_stem(stem))


COMMANDS = {"train": train, "enjoy": enjoy, "optimize": train, "plot": plot}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one of rl_zoo3's scripts with MOMBA registered.

    :param arguments: of the command line, the program's own by default
    :raises SystemExit: for what the user can mend, with one line that says how; after --help too
    """
    parser = argparse.ArgumentParser(prog=PROGRAM, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=COMMANDS, help="each has --help")
    parser.add_argument("options", nargs=argparse.REMAINDER, help="rl_zoo3's, and those of the manual")
    given = parser.parse_args(arguments)
    try:
        COMMANDS[given.command](given.command, given.options)
    except (AssertionError, ValueError, ImportError, OSError, WorkerError, gym.error.Error) as error:
        if not str(error):
            raise
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
