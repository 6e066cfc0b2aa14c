"""What the thesis published, from thesis.yml."""

from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import yaml

from sb3_momba.benchmark.results import Metric
from sb3_momba.benchmark.statistics import Estimate

Range = tuple[float, float]


@dataclass(frozen=True)
class PublishedMethod:
    """A row of Table 4.2; ranges are over the tasks."""

    classification: str
    policies: Range
    parameters: Range
    steps: Range


@dataclass(frozen=True)
class PublishedTask:
    """A task of Table 4.1 with its rows of Table 4.3.

    :param units: what the table divides a metric by
    :param scores: in absolute numbers, by metric and the method's title
    """

    name: str
    objectives: list[str]
    units: dict[Metric, float]
    scores: dict[Metric, dict[str, Estimate]]


@dataclass(frozen=True)
class Thesis:
    """Table 4.2 by the method's title, 4.4 and 4.5 by the configuration's, 4.1 and 4.3 by the environment's id."""

    methods: dict[str, PublishedMethod]
    conditioning: dict[str, Estimate]
    improvements: dict[str, dict[str, Estimate]]
    tasks: dict[str, PublishedTask]


@cache
def read_thesis() -> Thesis:
    content = yaml.safe_load((resources.files("sb3_momba.benchmark.chapter4") / "thesis.yml").read_text(encoding="utf-8"))
    return Thesis(
        methods={title: _method(**row) for title, row in content["methods"].items()},
        conditioning={title: Estimate(*numbers) for title, numbers in content["conditioning"].items()},
        improvements={
            title: {metric: Estimate(*numbers) for metric, numbers in row.items()}
            for title, row in content["improvements"].items()
        },
        tasks={env: _task(**row) for env, row in content["tasks"].items()},
    )


def _method(classification: str, **numbers: float | list[float]) -> PublishedMethod:
    ranges = {name: tuple(x) if isinstance(x, list) else (x, x) for name, x in numbers.items()}
    return PublishedMethod(classification, **ranges)  # type: ignore[arg-type]


def _task(name: str, objectives: list[str], **metrics: Any) -> PublishedTask:
    units, scores = {}, {}
    for metric, row in metrics.items():
        units[metric] = row.pop("unit")
        scores[metric] = {title: scaled(Estimate(*numbers), units[metric]) for title, numbers in row.items()}
    return PublishedTask(name, objectives, units, scores)  # type: ignore[arg-type]


def scaled(estimate: Estimate, factor: float) -> Estimate:
    return Estimate(estimate.value * factor, estimate.low * factor, estimate.high * factor)
