"""`python -m sb3_momba.baselines gpi_ls --env MO-Hopper-v4 --steps 2e5`: train another method, under the protocol of ours."""

import argparse
import sys
import time
from collections.abc import Sequence

import gymnasium as gym

from sb3_momba.baselines.runs import BaselineResult, run
from sb3_momba.baselines.schedules import default_steps
from sb3_momba.baselines.settings import VARIANTS, BaselineSettings
from sb3_momba.train import add_protocol_arguments, assign, metrics_table, whole_number


def parse(arguments: Sequence[str] | None = None) -> BaselineSettings:
    parser = argparse.ArgumentParser(prog="python -m sb3_momba.baselines", description=__doc__, allow_abbrev=False)
    parser.add_argument("algorithm", choices=VARIANTS)
    parser.add_argument("--env", required=True, help="environment id")
    parser.add_argument("--steps", type=whole_number, help="environment steps of all policies together; Table 4.2's by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--label", help="the method's name in reports; by default the algorithm's")
    parser.add_argument("--output", help="folder of the run; by default runs/ENV/ALGORITHM-TIME-SEED")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="any hyperparameter of the algorithm; may be repeated"
    )
    parser.add_argument("--device", default="auto")
    add_protocol_arguments(parser)
    given = parser.parse_args(arguments)
    algorithm, not_default = VARIANTS[given.algorithm]
    hyperparameters = dict(not_default)
    for assignment in given.set:
        assign(hyperparameters, assignment)
    return BaselineSettings(
        algorithm=algorithm,
        env=given.env,
        output=given.output or f"runs/{given.env}/{given.algorithm}-{time.strftime('%Y%m%d-%H%M%S')}-{given.seed}",
        steps=default_steps(algorithm, given.env) if given.steps is None else given.steps,
        seed=given.seed,
        label=given.label or given.algorithm,
        hyperparameters=hyperparameters,
        eval_freq=given.eval_freq,
        n_preferences=given.n_preferences,
        n_episodes=given.n_episodes,
        reference_point=given.reference_point,
        device=given.device,
    )


def report(result: BaselineResult) -> str:
    """A run's metrics over time beside those of policies that learned nothing, as text."""
    return f"{metrics_table(result.floors, result.timesteps, result.metrics)}\nRun folder: {result.folder}"


def main(arguments: Sequence[str] | None = None) -> None:
    try:
        result = run(parse(arguments))
    except (ValueError, MemoryError, ImportError, gym.error.Error) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("\nInterrupted: delete the folder, and start again.", file=sys.stderr)
        sys.exit(130)
    print(report(result))


if __name__ == "__main__":
    main()
