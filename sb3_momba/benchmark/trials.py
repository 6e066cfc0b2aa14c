"""The runs of a sweep as trials of Ray Tune, each in a process of its own. The only module that imports Ray."""

import contextlib
import io
import logging
import os
import socket
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

# Before Ray is imported: no statistics are sent, trials have the priority of any training, Ctrl-C ends the sweep, trials need
# no logs beside the runs' own.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_worker_niceness", "0")
os.environ.setdefault("TUNE_DISABLE_SIGINT_HANDLER", "1")
os.environ.setdefault("TUNE_DISABLE_AUTO_CALLBACK_LOGGERS", "1")

import ray
from ray import tune
from ray.tune.experiment import Trial
from rich.console import Console
from rich.live import Live
from rich.table import Table

from sb3_momba.benchmark import execution
from sb3_momba.benchmark.grid import Cell
from sb3_momba.files import LOCK
from sb3_momba.runs import resume
from sb3_momba.train import running_options

STATE = ".tune"  # Ray Tune's own files, in the output folder; nothing is read from them
OBJECT_STORE_BYTES = 100_000_000  # trials exchange a few numbers
SECONDS_BETWEEN_REPORTS = 2.0
SECONDS_FOR_AN_ADDRESS = 10.0
# Attempts to reach a cluster, each of 40 seconds where something else than Ray listens; of a head, seconds to start in.
ATTEMPTS = ("RAY_gcs_server_port_wait_time_s", "1")

logger = logging.getLogger(__name__)


@contextlib.contextmanager
def cluster(address: str | None, processors: int, threads: int) -> Iterator[None]:
    """Ray, on this machine alone with so many processors or on a cluster.

    :raises ConnectionError: if no cluster answers, or Ray does not start
    """
    arguments: dict[str, Any] = {"address": address}
    if address is None:
        arguments = {"address": "local", "num_cpus": processors, "object_store_memory": OBJECT_STORE_BYTES}
        arguments["include_dashboard"] = False
    elif address != "auto":
        _check_answers(address)
    with execution.on_sigterm(_interrupt):
        with _few_attempts() if address is not None else contextlib.nullcontext():
            _init(address, arguments, threads)
        try:
            with execution.on_sigterm(_interrupt):  # Ray has put its own handler in place.
                yield
        finally:
            ray.shutdown()


def _init(address: str | None, arguments: Mapping[str, Any], threads: int) -> None:
    try:
        ray.init(
            **arguments,
            runtime_env={"env_vars": {"OMP_NUM_THREADS": str(threads)}},
            log_to_driver=False,
            logging_level=logging.WARNING,
        )
    except Exception as error:  # Ray has no class of its own for what goes wrong here.
        if address is None:
            raise ConnectionError(
                f"Ray did not start on this machine: {error} Its logs lie in /tmp/ray/session_latest/logs. The half minute "
                "that it has is too little where processors are busy: try later, or use `benchmark run`, which needs no Ray."
            ) from error
        raise ConnectionError(
            f"Ray at {address!r} cannot be reached: {error} Give the address that `ray start --head` printed, and use the same "
            "version of Ray; if it asks for a token, this machine needs that of ~/.ray/auth_token there, or RAY_AUTH_TOKEN."
        ) from error


@contextlib.contextmanager
def _few_attempts() -> Iterator[None]:
    """Inside, Ray gives up a cluster that it cannot reach, unless the environment already says how long it may try."""
    name, attempts = ATTEMPTS
    is_ours = name not in os.environ
    if is_ours:
        os.environ[name] = attempts
    try:
        yield
    finally:
        if is_ours:
            del os.environ[name]


def _interrupt(*of_the_signal: Any) -> None:
    """What Ctrl-C does."""
    raise KeyboardInterrupt


def _check_answers(address: str) -> None:
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        raise ValueError(f'address={address!r}: give "host:port" of a Ray cluster, or "auto".')
    try:
        socket.create_connection((host, int(port)), SECONDS_FOR_AN_ADDRESS).close()
    except (OSError, OverflowError) as error:
        raise ConnectionError(
            f"No Ray cluster answers at {address}: {error}. Start one there with `ray start --head`."
        ) from error


def run_trials(
    cells: Sequence[Cell],
    settings: Mapping[str, Any],
    output: Path,
    workers: int | None,
    threads: int,
    gpus: float,
    max_failures: int,
    retry_failed: bool,
) -> dict[str, str]:
    """Run each of these; what those that did not finish have said last, by name.

    :param settings: what the program of each cell has read, by the cell's name
    :raises ValueError: if no node has the processors that a run needs
    """
    resources: dict[str, float] = {"CPU": threads, **({"GPU": gpus} if gpus else {})}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]  # type: ignore[no-untyped-call]
    if not any(all(node.get(name, 0) >= amount for name, amount in resources.items()) for node in nodes):
        raise ValueError(f"threads={threads}, gpus={gpus}: no node has as many for one run; choose less, or add one.")
    about_all = {"output": str(output), "retry_failed": retry_failed}
    trials = [{"cell": cell, "settings": settings[cell.name], **about_all} for cell in cells]
    watch = Watch(len(trials))
    for name in ("ray.tune", "ray.train"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # Lost processes are told of here.
    tuner = tune.Tuner(
        tune.with_resources(train_cell, resources),
        param_space={"trial": tune.grid_search(trials)},
        tune_config=tune.TuneConfig(max_concurrent_trials=workers, trial_dirname_creator=lambda trial: trial.trial_id),
        run_config=tune.RunConfig(
            name=STATE,
            storage_path=str(output),
            failure_config=tune.FailureConfig(max_failures=max_failures),
            callbacks=[watch],
            verbose=0,
        ),
    )
    console = Console(stderr=True)
    with (
        Live(console=console, auto_refresh=False, transient=True, redirect_stdout=False) as live,
        contextlib.redirect_stdout(io.StringIO()),  # Ray Tune's own tables
    ):
        watch.live = live if console.is_terminal else None
        tuner.fit()
    return watch.errors


def train_cell(config: dict[str, Any]) -> None:
    """One trial. What its training raises ends it; only the death of its process, which raises nothing, lets it begin again."""
    trial = config["trial"]
    cell, settings, output = trial["cell"], trial["settings"], Path(trial["output"])
    folder = output / cell.name
    tune.report({"steps": 0})
    try:
        if not (output / LOCK).exists():
            raise FileNotFoundError(f"{socket.gethostname()} does not see {output}: choose an --output that all nodes share.")
        way = execution.way_to_run(folder, trial["retry_failed"])
        if way is None:
            return
        with (
            open(execution.log_of(folder), "a" if way == "go on" else "w", buffering=1) as log,
            contextlib.redirect_stdout(log),
            contextlib.redirect_stderr(log),
        ):
            try:
                if way == "go on":
                    resume(folder, Progress(), progress_bar=False, **running_options(cell.options))
                else:
                    cell.program.runs.run(settings, Progress())
            except Exception as error:
                if execution.state_of(folder) == "not begun":
                    cell.program.runs.record_failure(settings, f"it did not start: {error}", traceback.format_exc())
                raise
    except Exception:
        tune.report({"error": traceback.format_exc()})


class Progress:
    """Tells Ray Tune now and then how far a run is."""

    def __init__(self) -> None:
        self.next_report = 0.0

    def __call__(self, steps: int) -> None:
        if time.monotonic() >= self.next_report:
            tune.report({"steps": steps})
            self.next_report = time.monotonic() + SECONDS_BETWEEN_REPORTS


class Watch(tune.Callback):
    """What runs where and how far: a live table on a terminal, lines in the log elsewhere.

    :param n_trials: how many there are
    """

    def __init__(self, n_trials: int):
        self.n_trials = n_trials
        self.errors: dict[str, str] = {}
        self.n_ended = 0
        self.live: Live | None = None  # Ray Tune stores its callbacks, which a live table cannot be

    def on_trial_start(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        self._say(f"{name_of(trial)} {'starts' if trial.num_failures == 0 else 'starts again'}")

    def on_trial_recover(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        self._say(f"{name_of(trial)} has lost its process ({trial.num_failures} times)")

    def on_trial_complete(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        self._end(trial, trial.last_result.get("error"))

    def on_trial_error(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        lost, error = f"its process was lost {trial.num_failures} times", trial.get_error()  # None where it was not tried again
        self._end(trial, lost if error is None else f"{lost}, the last time by:\n{error}")

    def _end(self, trial: Trial, error: str | None) -> None:
        self.n_ended += 1
        if error is not None:
            self.errors[name_of(trial)] = error.rstrip()
        self._say(f"{name_of(trial)} {'finished' if error is None else 'failed: ' + error.rstrip().splitlines()[-1]}")

    def _say(self, line: str) -> None:
        if self.live is None:
            logger.info("%s", line)
        else:
            self.live.console.print(line, markup=False, highlight=False)

    def on_step_end(self, iteration: int, trials: list[Trial], **info: Any) -> None:
        if self.live is not None:
            self.live.update(self.table(trials), refresh=True)

    def table(self, trials: Sequence[Trial]) -> Table:
        """Of the runs that have a process now."""
        table = Table(title=f"{self.n_ended} of {self.n_trials} runs have ended, {len(self.errors)} failed")
        for column in ("run", "node", "process", "steps", "of", "processes lost"):
            table.add_column(column, justify="left" if column in ("run", "node") else "right", overflow="fold")
        for trial in trials:
            if trial.status == Trial.RUNNING:
                result = trial.last_result
                where = (str(result.get("node_ip", "")), str(result.get("pid", "")))
                steps = trial.config["trial"]["settings"].steps
                table.add_row(name_of(trial), *where, f"{result.get('steps', 0):,}", f"{steps:,}", str(trial.num_failures))
        return table


def name_of(trial: Trial) -> str:
    return str(trial.config["trial"]["cell"].name)
