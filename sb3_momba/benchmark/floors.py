"""`python -m sb3_momba.benchmark floors TASKS`: what standing still and random actions earn under the protocol of 4.1.2."""

import argparse

from sb3_momba.benchmark.tables import markdown
from sb3_momba.envs.preferences import preference_grid
from sb3_momba.pareto import protocol
from sb3_momba.pareto.evaluation import probe_environment
from sb3_momba.pareto.floors import evaluate_floors


def floor_table(tasks: list[str]) -> str:
    rows = [["task", "policy", "hypervolume", "expected utility"]]
    for task in tasks:
        n_objectives = probe_environment(task).n_objectives
        reference_point = protocol.reference_point_of(task, n_objectives)
        grid = preference_grid(n_objectives, protocol.N_PREFERENCES)
        for name, front in evaluate_floors(task, grid, protocol.N_EPISODES).items():
            rows.append([task, name, f"{front.hypervolume(reference_point):,.5g}", f"{front.expected_utility():,.5g}"])
    return markdown(rows)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("tasks", nargs="*", help="environment ids; by default those of the thesis")


def main(given: argparse.Namespace) -> None:
    print(floor_table(given.tasks or list(protocol.REFERENCE_POINTS)))
