"""What lies in the folder of a run, finished or not, as a report needs it."""

import contextlib
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_momba.envs.making import make_env
from sb3_momba.explorer.rendering import Film, Policy
from sb3_momba.files import FileFormatError
from sb3_momba.pareto.evaluation import ParetoFront
from sb3_momba.pareto.metrics import non_dominated, regrets, summarise
from sb3_momba.records import FILE_NAME as RECORD_NAME
from sb3_momba.records import Record, is_cut_off_at_its_start, read_record, whole_lines

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)


@dataclass
class Run:
    """One run, as a report shows it.

    :param name: its own among the report's runs
    :param values: mean return of each point of its newest front, (n, n_objectives)
    :param front: the same with the return of every episode, from the record or else from front.npz; None where neither has it
    :param model: the file of a model; None where there is none
    :param films: under the points' numbers
    :param no_films: why there are none
    """

    name: str
    record: Record
    values: Array
    front: ParetoFront | None
    model: Path | None
    films: dict[int, Film] = field(default_factory=dict)
    no_films: str = ""

    @property
    def preferences(self) -> Array | None:
        """Of each point, (n, n_objectives); None for a set of solutions that answer none."""
        return self.record.preferences if self.record.general_policy else None

    @property
    def spread(self) -> Array | None:
        """Standard deviation of each point's return over its episodes, (n, n_objectives); None if there is one episode."""
        if self.front is None or self.front.returns.shape[1] < 2:
            return None
        return np.asarray(self.front.returns.std(axis=1, ddof=1))

    @property
    def n_episodes(self) -> int | None:
        """Of each point; None where it is not recorded."""
        return None if self.front is None else self.front.returns.shape[1]

    @property
    def about_episodes(self) -> str:
        """What a point's numbers are."""
        n = self.n_episodes
        return (
            "Episodes not recorded" if n is None else "One episode" if n == 1 else f"Mean ± standard deviation of {n} episodes"
        )

    @property
    def regrets(self) -> Array | None:
        """max_i w.V_i - w.V_w of each preference w, (n,), of which `preference_regret` is the mean."""
        return None if self.preferences is None else regrets(self.values, self.preferences)

    @property
    def on_front(self) -> NDArray[np.bool_]:
        """Which points no other one dominates, (n,)."""
        return non_dominated(self.values)

    @property
    def policy(self) -> Policy:
        """What its films show."""
        assert self.model is not None
        deterministic = self.front is None or bool(self.front.settings.get("deterministic_policy", True))
        return Policy(self.model.resolve(), self.record.env, self.record.env_kwargs, deterministic)


def read_runs(folders: Sequence[Path]) -> list[Run]:
    """Runs of one task, in their order.

    :raises ValueError: for a folder that is no run or has nothing to show yet, and for runs that cannot stand in one report
    """
    runs = [read_run(folder) for folder in dict.fromkeys(folders)]
    first = runs[0]
    for run in runs[1:]:
        if run.record.task != first.record.task:
            raise ValueError(
                f"{first.record.path.parent} is a run of {first.record.task}, {run.record.path.parent} one of "
                f"{run.record.task}: their returns share no axes. Make a report of each task."
            )
        if run.values.shape[1] != first.values.shape[1]:
            raise ValueError(
                f"{first.record.path.parent} has {first.values.shape[1]} objectives, {run.record.path.parent} "
                f"{run.values.shape[1]}: make a report of each."
            )
    counts = Counter(run.name for run in runs)
    for run in runs:
        if counts[run.name] > 1:
            run.name = f"{run.name}, {run.record.path.parent}"
    return runs


def read_run(folder: Path) -> Run:
    """
    :raises ValueError: for a folder that is no run, or whose run has not been evaluated yet
    :raises FileFormatError: for a record that is damaged
    """
    path = folder / RECORD_NAME
    if not path.is_file():
        what = "has no record.jsonl" if folder.is_dir() else "is a file, not a folder" if folder.exists() else "does not exist"
        raise ValueError(
            f"{folder} is no run: it {what}. Give the folder that a training was started with as its --output, such as one of "
            "`python -m sb3_momba.train`."
        )
    if is_cut_off_at_its_start(path):
        raise ValueError(f"{folder} holds a run that was cut off before it began: there is nothing to report.")
    record = read_record(path)
    if record.final_values is None and not record.evaluations:
        why = f"it ended with {record.error!r}" if record.error else "it has none"
        raise ValueError(f"{folder} holds a run without an evaluation ({why}): there is nothing to report yet.")
    values = record.final_values if record.final_values is not None else record.evaluations[-1].values
    model = next((folder / name for name in models_of(record) if (folder / name).is_file()), None)
    front = final_front(record) or _front(folder, values)
    run = Run(f"{record.label}, seed {record.seed}", record, values, front, model)
    if model is None:
        run.no_films = "The run's folder has no model (model.zip or best_model.zip)."
    if not record.general_policy:
        run.no_films = "Its solutions are those of several policies, not of one that takes a preference."
    return run


def models_of(record: Record) -> tuple[str, str]:
    """Which model to show: of a finished run the last one, whose front it is; of others the best one that was evaluated."""
    return ("model.zip", "best_model.zip") if record.error is None else ("best_model.zip", "model.zip")


def final_front(record: Record) -> ParetoFront | None:
    """The front with which the record of a finished run ends; None where it does not, has no discounted returns, or is a set of
    solutions, which answer no preference.

    :raises FileFormatError: if it is damaged
    """
    if record.error is not None or not record.general_policy:
        return None
    try:
        *_, (_, end) = whole_lines(record.path)
        front = end["front"]
        if "discounted_returns" not in front:
            return None
        preferences, returns, discounted = (
            np.asarray(front[name], dtype=np.float64) for name in ("preferences", "returns", "discounted_returns")
        )
        lengths = np.asarray(front["episode_lengths"], dtype=np.int64)
        settings = dict(front.get("settings", {}))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FileFormatError(f"{record.path}: its final front is damaged: {type(error).__name__}: {error}.") from error
    if discounted.shape != returns.shape or lengths.shape != returns.shape[:2] or preferences.shape != returns.shape[::2]:
        raise FileFormatError(f"{record.path}: its final front has arrays that do not go together.")
    return ParetoFront(preferences, returns, discounted, lengths, settings)


def _front(folder: Path, values: Array) -> ParetoFront | None:
    """The run's front.npz, if it is of the values that are shown."""
    path = folder / "front.npz"
    if not path.is_file():
        return None
    try:
        front = ParetoFront.load(path)
    except FileFormatError as error:
        logger.warning("%s The report has no spread over episodes.", error)
        return None
    same = front.values.shape == values.shape and np.allclose(front.values, values)
    return front if same else None


def objectives_of(record: Record) -> list[str]:
    """Their names: the run's own, those that the environment's class has, or numbers.

    No environment "module:Id-v0" is made: the record of a stranger would import any module.
    """
    n = record.preferences.shape[1]
    named = record.config.get("objectives")
    if not named and ":" not in record.env:
        with contextlib.suppress(Exception):  # An environment need not be installed where its runs are looked at.
            env = make_env(record.env, record.env_kwargs)
            named = env.get_wrapper_attr("objectives") if env.has_wrapper_attr("objectives") else None
            env.close()
    if isinstance(named, list | tuple) and len(named) == n:
        return [str(name) for name in named]
    return [f"Objective {i + 1}" for i in range(n)]


def measure(run: Run, values: Array, reference_point: ArrayLike) -> dict[str, float]:
    """The metrics of one evaluation of a run, or of one of its floors, under the names of `summarise`."""
    return summarise(values, run.record.preferences, reference_point, run.record.general_policy)
