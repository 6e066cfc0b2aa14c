"""Train from the command line: `python -m sb3_momba.train --env mo-hopper-2obj-v5 --steps 1e6`.

The variants of the thesis carry the names of its Table A.1. Each run has a folder of its own; `sb3_momba/runs.py` says what is
in it.
"""

import argparse
import json
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

from sb3_momba.envs.workers import WorkerError
from sb3_momba.pareto import protocol
from sb3_momba.recording import plain
from sb3_momba.runs import RUNNING, RunResult, RunSettings, has_checkpoint, resume, run
from sb3_momba.zoo.configuration import (
    N_TIMESTEPS,
    Configuration,
    literal,
    read_configuration,
    shipped_configurations,
    with_defaults,
)

ARCHITECTURES = {"simba": "SimbaPolicy", "mlp": "MlpPolicy", "xqc": "XqcPolicy", "flashsac": "FlashSacPolicy"}
INTERRUPTED = (128 + signal.SIGINT, 128 + signal.SIGTERM)  # the exit codes of a training that a signal has ended


def report(result: RunResult) -> str:
    """A run's metrics over time beside those of policies that learned nothing, and where its picture is, as text."""
    picture = result.folder / "front.png"
    table = metrics_table(result.floors, result.timesteps, result.metrics)
    return f"{table}\nRun folder: {result.folder}" + (f"   Picture of the front: {picture}" if picture.exists() else "")


def metrics_table(
    floors: Mapping[str, Mapping[str, float]], timesteps: Sequence[int], metrics: Sequence[Mapping[str, float]]
) -> str:
    """The metrics of floors, by their names, and over the steps of a training, as text; a set of solutions has no regret."""
    columns = ("steps", "hypervolume", "expected utility", "preference regret")
    lines = ["  ".join(f"{column:>17}" for column in columns)]
    curve = [(f"{step:,}", m) for step, m in zip(timesteps, metrics, strict=True)]
    for name, m in [*floors.items(), *curve]:
        regret = f"{m['preference_regret']:.4g}" if "preference_regret" in m else "-"
        lines.append(f"{name:>17}  {m['hypervolume']:>17,.6g}  {m['expected_utility']:>17,.5g}  {regret:>17}")
    return "\n".join(lines)


def parse(arguments: Sequence[str] | None = None) -> RunSettings:
    parser = argparse.ArgumentParser(
        prog="python -m sb3_momba.train", description="Train MOMBA and evaluate its Pareto front.", allow_abbrev=False
    )
    task = parser.add_mutually_exclusive_group(required=True)
    task.add_argument("--env", help="environment id")
    task.add_argument("--resume", metavar="RUN", help="go on with a run that was cut off, in its folder, instead")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=whole_number, help="environment steps; by default the configuration's, or 1e6")
    parser.add_argument(
        "--conf", help=f"yaml file in rl_zoo3's format, or one of the shipped: {', '.join(shipped_configurations())}"
    )
    parser.add_argument("--label", help="the method's name in reports; by default the configuration's")
    parser.add_argument(
        "--preference", type=float, nargs="+", help="train and evaluate for this one alone (4.2.4); by default for all"
    )
    parser.add_argument("--output", help="folder of the run; by default runs/ENV/TIME-SEED")

    variant = parser.add_argument_group("variants (Table A.1)")
    variant.add_argument("--architecture", choices=ARCHITECTURES, help="simba by default")
    variant.add_argument("--critic-loss", choices=("ce", "mse"), help="ce by default")
    variant.add_argument("--vector-values", action="store_true", help="vector critic (3.2.2) instead of the scalarised one")
    variant.add_argument("--her", action="store_true", help="hindsight relabelling of preferences (3.20)")
    variant.add_argument("--preference-alignment-regularization", action="store_true", help="(3.21); needs --vector-values")
    variant.add_argument("--ent-coef", help='"auto_0.2" (default), "auto_0.01" for runs below 200,000 steps, or a number')
    variant.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="any argument of MOMBA, such as batch_size=128 or policy_kwargs.actor_blocks=1; may be repeated",
    )

    machine = parser.add_argument_group("running")
    machine.add_argument(
        "--env-kwargs", action="append", default=[], metavar="NAME=VALUE", help="of the environment, such as physics=current"
    )
    machine.add_argument("--n-envs", type=int, help="environments side by side")
    machine.add_argument("--subprocesses", action="store_true", help="each in a process of its own")
    machine.add_argument("--device", default="auto")
    add_running_arguments(machine)

    evaluation = parser.add_argument_group("evaluation")
    add_protocol_arguments(evaluation)
    evaluation.add_argument("--objectives", nargs="+", help="names for the picture's axes")

    given = parser.parse_args(arguments)
    configuration = read_configuration(given.conf, given.env) if given.conf else Configuration("SimbaPolicy", {})
    if given.conf and given.architecture and ARCHITECTURES[given.architecture] != configuration.policy:
        raise ValueError(
            f"--architecture {given.architecture}: the configuration {given.conf} is made for {configuration.policy}; leave "
            "one of them out."
        )
    if given.preference is not None and given.n_preferences != protocol.N_PREFERENCES:
        raise ValueError(f"--n-preferences {given.n_preferences}: --preference evaluates for one alone; leave one of them out.")
    hyperparameters = configuration.hyperparameters
    if given.preference is not None:
        hyperparameters.pop("preference_sampler", None)
    options = {
        "critic_loss": given.critic_loss,
        "vector_values": given.vector_values or None,
        "her": given.her or None,
        "preference_alignment": given.preference_alignment_regularization or None,
        "ent_coef": given.ent_coef,
    }
    hyperparameters.update({name: value for name, value in options.items() if value is not None})
    env_kwargs = configuration.env_kwargs
    for assignments, option, values in ((given.set, "--set", hyperparameters), (given.env_kwargs, "--env-kwargs", env_kwargs)):
        for assignment in assignments:
            assign(values, assignment, option)
    return RunSettings(
        env=given.env,
        output=given.output or f"runs/{given.env}/{time.strftime('%Y%m%d-%H%M%S')}-{given.seed}",
        steps=first_given(given.steps, configuration.n_timesteps, N_TIMESTEPS),
        seed=given.seed,
        policy=ARCHITECTURES[given.architecture] if given.architecture else configuration.policy,
        label=given.label or (Path(given.conf).stem if given.conf else "momba"),
        hyperparameters=hyperparameters,
        env_kwargs=env_kwargs,
        n_envs=first_given(given.n_envs, configuration.n_envs),
        subprocesses=given.subprocesses,
        eval_freq=given.eval_freq,
        n_preferences=given.n_preferences,
        n_episodes=given.n_episodes,
        reference_point=given.reference_point,
        preference=given.preference,
        objectives=given.objectives,
        device=given.device,
        progress_bar=given.progress_bar,
        **running_options(arguments),
    )


def add_protocol_arguments(parser: argparse._ActionsContainer) -> None:
    """How any method is evaluated."""
    parser.add_argument("--eval-freq", type=whole_number, default=50_000, help="environment steps")
    parser.add_argument("--n-preferences", type=int, default=protocol.N_PREFERENCES)
    parser.add_argument("--n-episodes", type=int, default=protocol.N_EPISODES, help="per policy and preference")
    parser.add_argument("--reference-point", type=float, nargs="+", help="of the hypervolume; the task's own by default, or 0")


def whole_number(text: str) -> int:
    """An integer that may be written 1e6."""
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not number.is_integer():
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number")
    return int(number)


def first_given(*values: int | None) -> int:
    """The first value that is not None."""
    return next(value for value in values if value is not None)


def assign(values: dict[str, Any], assignment: str, option: str = "--set") -> None:
    """Put "name=value" or "name.key=value" into a dictionary; the value is a yaml literal, never evaluated."""
    name, separator, text = assignment.partition("=")
    if not separator or not name:
        raise ValueError(f"{option} {assignment}: write NAME=VALUE.")
    *parents, key = name.split(".")
    for parent in parents:
        values = values.setdefault(parent, {})
        if not isinstance(values, dict):
            raise ValueError(f"{option} {assignment}: {parent} is {values!r}, which has no {key!r} inside.")
    try:
        values[key] = literal(yaml.safe_load(text))
    except yaml.YAMLError as error:
        raise ValueError(f"{option} {assignment}: {text!r} is no yaml literal.") from error


def command_of(config: dict[str, Any]) -> list[str]:
    """The command line that a run's settings, as its record has them, come from: what differs from the defaults."""
    usual = {field.name: field.default for field in fields(RunSettings)}
    options = {name: config[name] for name in ("env", "steps", "seed")}
    for name in ("label", "n_envs", "eval_freq", "n_preferences", "n_episodes", "device", "subprocesses"):
        if config[name] != usual[name]:
            options[name] = config[name]
    for name in ("reference_point", "preference", "objectives"):
        if config.get(name) is not None:
            options[name] = config[name]
    if config["policy"] != usual["policy"]:
        options["architecture"] = {policy: name for name, policy in ARCHITECTURES.items()}[config["policy"]]
    defaults = flat(plain(with_defaults(config["policy"], {})))
    changed = {name: x for name, x in flat(config["hyperparameters"]).items() if name not in defaults or x != defaults[name]}
    if config.get("preference") is not None:
        del changed["preference_sampler"]
    options |= {"set": changed, "env_kwargs": config["env_kwargs"]}
    return ["python", "-m", "sb3_momba.train", *as_arguments(options)]


def as_arguments(options: Mapping[str, Any]) -> list[str]:
    """{"steps": 300, "set": {"gamma": 0.9}, "her": True} -> --steps 300 --set gamma=0.9 --her"""
    words: list[str] = []
    for name, value in options.items():
        option = f"--{name.replace('_', '-')}"
        if isinstance(value, dict):
            for key, item in value.items():
                words += [option, f"{key}={item if isinstance(item, str) else json.dumps(item)}"]
        elif isinstance(value, list):
            words += [option, *map(str, value)]
        else:
            words += [option] if value is True else [option, str(value)]
    return words


def flat(hyperparameters: dict[str, Any]) -> dict[str, Any]:
    """With `policy_kwargs.name` in place of a dictionary inside."""
    of_policy = {f"policy_kwargs.{name}": value for name, value in hyperparameters["policy_kwargs"].items()}
    return {**{name: value for name, value in hyperparameters.items() if name != "policy_kwargs"}, **of_policy}


def parse_resume(arguments: Sequence[str]) -> argparse.Namespace | None:
    """What `--resume` goes with; None where it is not given."""
    parser = argparse.ArgumentParser(prog="python -m sb3_momba.train", allow_abbrev=False, add_help=False)
    parser.add_argument("--resume", type=Path, metavar="RUN")
    add_running_arguments(parser)
    given, others = parser.parse_known_args(arguments)
    if given.resume is not None and others:
        raise ValueError(f"--resume goes on with a run's own settings: leave {others[0]} out.")
    return None if given.resume is None else given


def add_running_arguments(parser: argparse._ActionsContainer) -> None:
    """Those that no result depends on. Without defaults, as these would win over what a resumed run had."""
    parser.add_argument("--no-progress-bar", dest="progress_bar", action="store_false")
    parser.add_argument("--eval-workers", type=int, help="processes that share an evaluation")
    parser.add_argument("--eval-envs", type=int, help="copies of the environment in each of them, at most; by default 128")
    parser.add_argument("--checkpoint-freq", type=whole_number, help="environment steps between checkpoints")
    parser.add_argument("--keep-checkpoints", type=int, help="how many stay")


def running_options(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Those of `RUNNING` that a command line gives, among any others."""
    parser = argparse.ArgumentParser(allow_abbrev=False, add_help=False)
    add_running_arguments(parser)
    given, _ = parser.parse_known_args(arguments)
    return {name: value for name in RUNNING if (value := getattr(given, name)) is not None}


def main(arguments: Sequence[str] | None = None) -> None:
    arguments = sys.argv[1:] if arguments is None else arguments
    folder = None
    try:
        given = parse_resume(arguments)
        if given is None:
            settings = parse(arguments)
            folder = Path(settings.output)
            result = run(settings)
        else:
            folder = given.resume
            result = resume(folder, progress_bar=given.progress_bar, **running_options(arguments))
    except (ValueError, MemoryError, ImportError, OSError, WorkerError, gym.error.Error) as error:
        sys.exit(f"error: {error}")
    except (KeyboardInterrupt, SystemExit) as ending:
        code = 128 + signal.SIGINT if isinstance(ending, KeyboardInterrupt) else ending.code
        if code in INTERRUPTED:
            way_on = f" Go on with --resume {folder}." if folder is not None and has_checkpoint(folder) else ""
            print(f"\nInterrupted.{way_on}", file=sys.stderr)
        sys.exit(code)
    print(report(result))


if __name__ == "__main__":
    main()
