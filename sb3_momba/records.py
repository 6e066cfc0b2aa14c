"""Run records: what a run was and what came of it, in one append-only file that needs nothing but a JSON reader.

A record is JSON lines (UTF-8, strict JSON, one object a line). Every line has an `event`:

- `start`, the first line: `format`, `version`, `label` (the method's name), `env`, `env_kwargs`, `seed`, `config` (every
  setting of the run, defaults included), `reference_point` (n_objectives,), `preferences` (P, n_objectives),
  `general_policy`, `parameters` (trainable ones of each network), `versions`, `machine`, `git_revision` and `started` (UTC);
  and of a run that can be resumed `running`: how it is run, which no result depends on.
- `floor`, one for each policy that learned nothing: `policy`, `values` (n, n_objectives) and the metrics.
- `evaluation`, one for each point of the curve: `steps`, which rise, `seconds` (of training, without evaluations),
  `cpu_seconds` (the same, of processor time; not where environments have processes of their own), `evaluation_seconds` (so
  far), the metrics and `values` (n, n_objectives); and `extra_steps` of a method that plays episodes for itself which are not
  among its `steps`: how many steps they had so far.
- `resumed`, where the run went on from a checkpoint: its `steps` (evaluations after them were made again, and the later ones
  count), `running`, `versions`, `machine`, `git_revision` and `started`.
- `end`, the last line: `status`. A "finished" run has its `steps`, perhaps `extra_steps`, and its final `front`: `returns` and
  `discounted_returns` (n, episodes, n_objectives), `episode_lengths` (n, episodes), the `preferences` that they answer, where
  they answer any, and its `settings`; one that "failed" has its `error` and, if it failed while it ran, the `traceback`.

Values are mean undiscounted returns. With `general_policy` they are those of one policy under each preference, in their order,
and n is P; without it they are a set of n solutions, such as the policies of PGMORL, and there is no `preference_regret`.

A record without an `end` is of a run that still goes on or was killed. The metrics (`hypervolume`, `expected_utility`,
`preference_regret`, `n_non_dominated`) are there for the reader's convenience: they follow from the values.
"""

import json
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_momba.envs.registry import raw_id
from sb3_momba.files import FileFormatError, refuse_constant

FORMAT = "sb3_momba.record"
VERSION = 1
FILE_NAME = "record.jsonl"
UNENDED = "no end: killed, or still running"

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Floor:
    """What a policy earns that learned nothing: its mean returns, (n, n_objectives)."""

    policy: str
    values: Array


@dataclass(frozen=True)
class Evaluation:
    """One point of the curve; `seconds` and `cpu_seconds` (None where they were not noted) of training, `values`
    (n, n_objectives), `extra_steps` as in the record's last line."""

    steps: int
    seconds: float
    cpu_seconds: float | None
    values: Array
    extra_steps: int = 0


@dataclass(frozen=True)
class Record:
    """A record as it was read. `error` is None for a run that finished; one without an end counts as failed. `traceback` is
    empty where none was recorded. `extra_steps` are those of episodes that the method played for itself, beside its steps. Of a
    run that is looked at as it stood before its end, `whole` is the record to its end. `resumed` are the lines with which
    it went on."""

    path: Path
    label: str
    env: str
    env_kwargs: dict[str, Any]
    seed: int
    config: dict[str, Any]
    reference_point: Array
    preferences: Array
    general_policy: bool
    parameters: dict[str, int]
    start: dict[str, Any]
    floors: list[Floor]
    evaluations: list[Evaluation]
    final_values: Array | None
    error: str | None
    traceback: str = ""
    extra_steps: int = 0
    whole: "Record | None" = None
    resumed: tuple[dict[str, Any], ...] = ()

    @property
    def task(self) -> str:
        """The environment, `momba/` or raw, with the arguments that it was made with."""
        arguments = ", ".join(f"{name}={value}" for name, value in sorted(self.env_kwargs.items()))
        return f"{raw_id(self.env)} ({arguments})" if arguments else raw_id(self.env)

    @property
    def planned_steps(self) -> int:
        """That the run was asked for or, where it does not say, had."""
        planned = self.config.get("steps")
        if isinstance(planned, int | float):
            return int(planned)
        return self.evaluations[-1].steps if self.evaluations else 0


def find_records(paths: Iterable[str | os.PathLike[str]]) -> list[Path]:
    """The records among files and, recursively, in folders: *.jsonl, in the order of their names.

    :raises FileNotFoundError: for a path that does not exist, or if there is none at all
    """
    found: list[Path] = []
    given = [Path(path) for path in paths]
    for path in given:
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist: give record files, or folders that hold some.")
        found += sorted(file for file in path.rglob("*.jsonl") if file.is_file()) if path.is_dir() else [path]
    if not found:
        raise FileNotFoundError(f"No record (*.jsonl) lies in {', '.join(map(str, given))}.")
    return list(dict.fromkeys(path.resolve() for path in found))


def is_cut_off_at_its_start(path: Path) -> bool:
    """Whether not even the first line of a record was written to its end."""
    return b"\n" not in path.read_bytes()


def read_record(path: str | os.PathLike[str]) -> Record:
    """
    :raises FileFormatError: for a damaged file, or one of another format or version, naming it
    """
    path = Path(path)
    if path.is_dir():
        raise FileFormatError(f"{path} is a folder, not a record.")
    try:
        events = [event for _, event in whole_lines(path)]
        return _to_record(path, events)
    except FileFormatError as error:
        raise FileFormatError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        raise FileFormatError(f"{path} is damaged, or no record: {type(error).__name__}: {str(error).rstrip('.')}.") from error


def whole_lines(path: Path) -> Iterator[tuple[bytes, dict[str, Any]]]:
    """The lines of a record and what they hold, without a last one that was cut off while it was written.

    :raises FileFormatError: for any other line that holds no event
    """
    with open(path, "rb") as file:
        lines = file.readlines()
    for number, line in enumerate(lines, start=1):
        try:
            event = json.loads(line, parse_constant=refuse_constant)
        except ValueError as error:
            if number == len(lines) and number > 1:
                return
            raise FileFormatError(f"line {number} is no JSON: {str(error).rstrip('.')}. {_without(path)}") from error
        if not isinstance(event, dict) or not isinstance(event.get("event"), str):
            raise FileFormatError(f"line {number} has no event. {_without(path)}")
        yield line, event


def _without(path: Path) -> str:
    """How to do without a damaged run: a report and a grid stop at it. Its folder may hold other records, by other names."""
    what, place = ("folder", path.parent) if path.name == FILE_NAME else ("file", path)
    return f"Move or delete this run's {what} to go on without it: {place}."


def _to_record(path: Path, events: list[dict[str, Any]]) -> Record:
    start = events[0] if events else {}
    if start.get("event") != "start" or start.get("format") != FORMAT:
        raise FileFormatError(f"it is no record: its first line must be a start of format {FORMAT!r}.")
    if type(start.get("version")) is not int or start["version"] != VERSION:
        raise FileFormatError(
            f"it is a record of version {start.get('version')!r}, this sb3_momba reads version {VERSION}: read it with the "
            f"sb3_momba that wrote it, {_version_of(start)}."
        )
    reference_point = _numbers(start["reference_point"], "reference_point", (None,))
    preferences = _numbers(start["preferences"], "preferences", (None, len(reference_point)))
    general_policy = start["general_policy"]
    if not isinstance(general_policy, bool):
        raise FileFormatError(f"general_policy is {general_policy!r}, neither true nor false.")
    shape = (len(preferences) if general_policy else None, len(reference_point))
    floors: list[Floor] = []
    evaluations: list[Evaluation] = []
    final_values: Array | None = None
    error: str | None = UNENDED
    traceback = ""
    extra_steps = 0
    if not all(isinstance(event.get("running", {}), dict) for event in events):
        raise FileFormatError("running is no mapping.")
    for event in events[1:]:
        extra_steps = _whole(event.get("extra_steps", extra_steps), "extra_steps")
        if event["event"] == "resumed" and final_values is None:
            resumed_at = _whole(event["steps"], "steps")
            evaluations = [evaluation for evaluation in evaluations if evaluation.steps <= resumed_at]
            error, traceback = UNENDED, ""
        elif error != UNENDED or final_values is not None:
            raise FileFormatError("it goes on after its end.")
        elif event["event"] == "floor":
            floors.append(Floor(str(event["policy"]), _numbers(event["values"], "a floor's values", shape)))
        elif event["event"] == "evaluation":
            values = _numbers(event["values"], "an evaluation's values", shape)
            if evaluations and event["steps"] <= evaluations[-1].steps:
                raise FileFormatError(f"its evaluations go from {evaluations[-1].steps} steps to {event['steps']}.")
            cpu_seconds = None if "cpu_seconds" not in event else _finite(event["cpu_seconds"], "cpu_seconds")
            seconds = _finite(event["seconds"], "seconds")
            steps = _whole(event["steps"], "steps")
            evaluations.append(Evaluation(steps, seconds, cpu_seconds, values, extra_steps))
        elif event["event"] == "end" and event["status"] == "finished":
            returns = _numbers(event["front"]["returns"], "the front's returns", (shape[0], None, shape[1]))
            final_values, error = returns.mean(axis=1), None
        elif event["event"] == "end":
            error, traceback = str(event["error"]), str(event.get("traceback", ""))
        else:
            raise FileFormatError(f"it has an unknown event {event['event']!r}.")
    return Record(
        path=path,
        label=str(start["label"]),
        env=str(start["env"]),
        env_kwargs=dict(start["env_kwargs"]),
        seed=_whole(start["seed"], "seed"),
        config=dict(start["config"]),
        reference_point=reference_point,
        preferences=preferences,
        general_policy=general_policy,
        parameters={str(name): _whole(n, "parameters") for name, n in dict(start["parameters"]).items()},
        start=start,
        floors=floors,
        evaluations=evaluations,
        final_values=final_values,
        error=error,
        traceback=traceback,
        extra_steps=extra_steps,
        resumed=tuple(event for event in events if event["event"] == "resumed"),
    )


def _version_of(start: dict[str, Any]) -> str:
    versions = start.get("versions")
    return str(versions.get("sb3_momba")) if isinstance(versions, dict) else "of unknown version"


def _finite(x: Any, name: str) -> float:
    if isinstance(x, bool) or not isinstance(x, int | float) or not math.isfinite(x):
        raise FileFormatError(f"{name} is {x!r}, no finite number.")
    return float(x)


def _whole(x: Any, name: str) -> int:
    if not _finite(x, name).is_integer() or abs(x) > 2**53:
        raise FileFormatError(f"{name} is {x!r}, no whole number that can be.")
    return int(x)


def _numbers(x: Any, name: str, shape: tuple[int | None, ...]) -> Array:
    """A float64 array of this shape; None stands for any length above 0."""
    array = np.asarray(x, dtype=np.float64)
    fits = array.ndim == len(shape) and all(n in (None, m) and m > 0 for n, m in zip(shape, array.shape, strict=True))
    if not fits:
        raise FileFormatError(f"{name} has shape {array.shape}, not {shape}.")
    if not np.isfinite(array).all():
        raise FileFormatError(f"{name} holds a number that is not finite.")
    return array


def common_reference_point(name: str, records: Sequence[Record], given: ArrayLike | None) -> Array:
    """Of all records of a task, (n_objectives,).

    :raises ValueError: if they have several and none is given, or one of another length
    """
    points = sorted({tuple(record.reference_point.tolist()) for record in records})
    if given is None and len(points) > 1:
        raise ValueError(
            f"The records of {name} have the reference points {points}: choose one with --reference-point, or leave the others "
            "out."
        )
    reference = records[0].reference_point if given is None else np.asarray(given, dtype=np.float64)
    for record in records:
        if record.preferences.shape[1] != len(reference):
            raise ValueError(
                f"{name} has {record.preferences.shape[1]} objectives in {record.path}, the reference point "
                f"{reference.tolist()} has {len(reference)} numbers: report tasks of other numbers of objectives apart."
            )
    return reference
