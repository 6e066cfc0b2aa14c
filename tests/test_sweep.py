"""Sweeps on Ray: whatever is killed, every run ends once, with the record of a run that nothing happened to."""

import contextlib
import errno
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import uuid4

import numpy as np
import psutil
import pytest
from ray.cluster_utils import Cluster
from rich.console import Console

from sb3_momba import runs, train
from sb3_momba.benchmark import execution, trials
from sb3_momba.benchmark.__main__ import main
from sb3_momba.benchmark.grid import make_cells
from sb3_momba.checkpoints import callback
from sb3_momba.checkpoints.folders import checkpoints_in
from sb3_momba.files import alone_in
from sb3_momba.records import read_record

MARK = "SWEEP_OF_TEST"  # in the environment of each process that belongs to it
ENV = "mo-hopper-2obj-v5"
RUNS = [f"{conf}/{ENV}/{seed}" for seed in range(2) for conf in ("momba", "her")]
STEPS = 800
TINY = (
    "--steps {steps} --eval-freq 400 --n-preferences 5 --n-episodes 1 --checkpoint-freq 100 --set learning_starts=100 "
    "--set batch_size=16 --set policy_kwargs.actor_hidden_dim=16 --set policy_kwargs.critic_hidden_dim=16"
)


def sweep_arguments(output: Path, steps: int = STEPS, seeds: int = 2) -> list[str]:
    grid = ["sweep", "--conf", "momba", "her", "--env", ENV, "--seeds", str(seeds), "--output", str(output)]
    return [*grid, *TINY.format(steps=steps).split()]


def processes_of_trials() -> list[psutil.Process]:
    """Those of this test's nodes that train now."""
    found = []
    for process in psutil.process_iter(["name", "environ"]):
        if process.info["name"].startswith("ray::") and (process.info["environ"] or {}).get(MARK) == os.environ.get(MARK):
            with contextlib.suppress(psutil.NoSuchProcess):
                if "".join(process.cmdline()).startswith("ray::ImplicitFunc"):
                    found.append(process)
    return found


def wait_until(is_so: Callable[[], Any], seconds: float = 120) -> Any:
    until = time.monotonic() + seconds
    while not (found := is_so()):
        assert time.monotonic() < until, "it takes too long"
        time.sleep(0.05)
    return found


def with_checkpoint(output: Path) -> list[str]:
    return [run for run in RUNS if any(path.exists() for path in checkpoints_in(output / run / "checkpoints"))]


@pytest.fixture
def cluster(monkeypatch) -> Iterator[Cluster]:
    """A head without processors, and three nodes of one each."""
    monkeypatch.setenv(MARK, uuid4().hex)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    try:
        for _ in range(3):
            cluster.add_node(num_cpus=1)
        yield cluster
    finally:
        cluster.shutdown()
    wait_until(lambda: not processes_of_trials(), 30)


def test_what_is_killed_goes_on_and_its_record_is_that_of_a_run_that_nothing_happened_to(tmp_path, cluster: Cluster) -> None:
    calm, stormy = tmp_path / "calm", tmp_path / "stormy"
    command = [sys.executable, "-m", "sb3_momba.benchmark", *sweep_arguments(stormy), "--address", cluster.address]
    with open(tmp_path / "log", "wb") as log:
        driver = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        try:
            wait_until(lambda: len(with_checkpoint(stormy)) == 3)  # so that whoever is killed has something to go on from
            for number in (1, 2):
                wait_until(processes_of_trials)[0].kill()
                wait_until(lambda number=number: losses(tmp_path / "log") == number)
            process = wait_until(processes_of_trials)[0]
            cluster.remove_node(node_of(process, cluster), allow_graceful=False)
            wait_until(lambda: losses(tmp_path / "log") == 3)
            wait_until(lambda: not process.is_running() or process.status() == psutil.STATUS_ZOMBIE)
            wait_until(processes_of_trials)
            driver.send_signal(signal.SIGKILL)
            driver.wait()
            wait_until(lambda: not processes_of_trials(), 60)
            unfinished = [run for run in RUNS if not ended(stormy / run)]
            assert unfinished, "all of it came too late"
            shutil.rmtree(stormy / unfinished[0] / "checkpoints", ignore_errors=True)
            again = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, check=False, timeout=300)
        finally:
            driver.kill()
    said = (tmp_path / "log").read_text()
    assert again.returncode == 0, said
    main([*sweep_arguments(calm), "--workers", "2"])
    resumed = 0
    for run in RUNS:
        assert said.count(f"{run} finished") == 1
        assert what_came_of(stormy / run) == what_came_of(calm / run)
        resumed += (stormy / run / "record.jsonl").read_text().count('"event": "resumed"')
    assert resumed >= 2


def losses(log: Path) -> int:
    """How many processes the sweep has noticed to be gone."""
    return log.read_text().count("has lost its process")


def node_of(process: psutil.Process, cluster: Cluster) -> Any:
    """The node that a trial runs on."""
    (node,) = [node for node in cluster.worker_nodes if node.all_processes["raylet"][0].process.pid == process.ppid()]
    return node


def ended(folder: Path) -> bool:
    path = folder / "record.jsonl"
    return path.exists() and '"event": "end"' in path.read_text()


def what_came_of(folder: Path) -> dict[str, Any]:
    """All of a record that does not depend on machine and time, with exactly one end."""
    record = read_record(folder / "record.jsonl")
    ends = [event for event in map(json.loads, open(record.path)) if event["event"] == "end"]  # noqa: SIM115
    assert len(ends) == 1
    assert record.error is None
    return {
        "config": record.config,
        "floors": [(floor.policy, floor.values.tolist()) for floor in record.floors],
        "curve": [(evaluation.steps, evaluation.values.tolist()) for evaluation in record.evaluations],
        "front": ends[0]["front"],
        "model": np.load(folder / "pareto_evaluations.npz")["values"].tolist(),
    }


def test_what_a_training_raises_ends_it_and_the_others_go_on(tmp_path, capsys) -> None:
    """A reward that is not finite, from the 200th step on: no other attempt, its traceback is shown, failures are counted."""
    output = tmp_path / "sweep"
    arguments = ["sweep", "--conf", "momba", "--env", ENV, "tests.stubs:diverging-v0", "--seeds", "1", "--output", str(output)]
    arguments += [*TINY.format(steps=400).split(), "--workers", "2"]
    with pytest.raises(SystemExit, match="error: 1 run did not finish"):
        main(arguments)
    failed = "momba/tests.stubs:diverging-v0/0"
    said = capsys.readouterr().err
    assert f"\n{failed}\n    Traceback (most recent call last):" in said
    assert "the reward of objective 0 is nan" in said
    record = read_record(output / failed / "record.jsonl")
    assert "the reward of objective 0 is nan" in str(record.error)
    assert record.traceback.startswith("Traceback (most recent call last):")
    assert ended(output / f"momba/{ENV}/0")
    # Once more: nothing runs, so that nothing needs Ray.
    with pytest.raises(SystemExit, match="error: 1 run did not finish"):
        main([*arguments, "--address", "127.0.0.1:9"])


@pytest.fixture
def trial(tmp_path, monkeypatch) -> Callable[..., list[dict[str, Any]]]:
    """Runs one trial in this process; what it reports."""
    reports: list[dict[str, Any]] = []
    monkeypatch.setattr(trials.tune, "report", reports.append)
    monkeypatch.setattr(execution, "SECONDS_FOR_A_LOCK", 0.1)
    (cell,) = make_cells(["momba"], [ENV], 1, TINY.format(steps=300).split())
    settings = train.parse(cell.arguments(tmp_path / "sweep" / cell.name))

    def run(retry_failed: bool = False) -> list[dict[str, Any]]:
        about_all = {"output": str(tmp_path / "sweep"), "retry_failed": retry_failed}
        trials.train_cell({"trial": {"cell": cell, "settings": settings, **about_all}})
        return reports

    return run


def test_a_trial_says_how_far_it_is(tmp_path, trial) -> None:
    with alone_in(tmp_path / "sweep"):
        reports = trial()
    assert reports[0] == {"steps": 0}
    assert all(set(report) == {"steps"} for report in reports)
    assert ended(tmp_path / "sweep" / RUNS[0])


def test_a_node_that_does_not_see_the_folder_says_so(tmp_path, trial) -> None:
    assert "choose an --output that all nodes share" in trial()[-1]["error"]
    assert not (tmp_path / "sweep").exists()


def test_a_run_that_another_process_still_writes_is_left_alone(tmp_path, trial) -> None:
    folder = tmp_path / "sweep" / RUNS[0]
    with alone_in(tmp_path / "sweep"), alone_in(folder):
        assert "Another process writes into" in trial()[-1]["error"]
        assert [file.name for file in folder.iterdir()] == [".lock"]


def test_a_run_that_has_ended_is_not_begun_again(tmp_path, trial) -> None:
    """Ray begins a trial again whose process died after its last line."""
    path = tmp_path / "sweep" / RUNS[0] / "record.jsonl"
    with alone_in(tmp_path / "sweep"):
        trial()
        before = path.read_bytes()
        assert trial()[-1] == {"steps": 0}
    assert path.read_bytes() == before


def test_a_full_disk_ends_a_trial_which_goes_on_from_its_checkpoint_when_asked(tmp_path, trial, monkeypatch) -> None:
    folder = tmp_path / "sweep" / RUNS[0]

    def full(*args: Any) -> None:
        if checkpoints_in(folder / "checkpoints"):
            raise OSError(errno.ENOSPC, "No space left on device")
        real(*args)

    real = callback.write_checkpoint
    with alone_in(tmp_path / "sweep"):
        with monkeypatch.context() as patch:
            patch.setattr(callback, "write_checkpoint", full)
            assert "No space left on device" in trial()[-1]["error"]
        assert execution.state_of(folder) == "failed"
        trial()
        assert execution.state_of(folder) == "failed"  # A failure is not tried again unasked.
        trial(retry_failed=True)
    assert ended(folder)
    assert '"resumed", "steps": 100' in (folder / "record.jsonl").read_text()


def test_a_trial_that_goes_on_is_told_how_to_run_from_now_on(tmp_path, trial, monkeypatch) -> None:
    told: list[dict[str, Any]] = []
    monkeypatch.setattr(execution, "way_to_run", lambda *args: "go on")
    monkeypatch.setattr(trials, "resume", lambda folder, on_step, **running: told.append(running))
    with alone_in(tmp_path / "sweep"):
        execution.log_of(tmp_path / "sweep" / RUNS[0]).parent.mkdir(parents=True)
        trial()
    assert told == [{"progress_bar": False, "checkpoint_freq": 100}]


def test_what_cannot_begin_leaves_a_record_of_its_failure(tmp_path, trial, monkeypatch) -> None:
    def fails(*args: Any) -> None:
        raise MemoryError("too large")

    monkeypatch.setattr(runs, "run", fails)
    with alone_in(tmp_path / "sweep"):
        assert "too large" in trial()[-1]["error"]
    record = read_record(tmp_path / "sweep" / RUNS[0] / "record.jsonl")
    assert record.error == "it did not start: too large"
    assert "MemoryError: too large" in record.traceback


def test_the_table_says_what_runs_where_and_how_far() -> None:
    def fake(name: str, status: str, **result: Any) -> Any:
        trial = {"cell": SimpleNamespace(name=name), "settings": SimpleNamespace(steps=30_000)}
        return SimpleNamespace(config={"trial": trial}, status=status, last_result=result, num_failures=2)

    watch = trials.Watch(5)
    watch.on_trial_complete(1, [], fake("ends well", "TERMINATED"))
    watch.on_trial_complete(1, [], fake("ends badly", "TERMINATED", error="Traceback\nValueError: nan"))
    lost = fake("is lost", "ERROR")
    for error in (None, "OutOfMemory: killed"):
        lost.get_error = lambda error=error: error
        watch.on_trial_error(1, [], lost)
        assert watch.errors.pop("is lost") == "its process was lost 2 times" + (
            f", the last time by:\n{error}" if error else ""
        )
    running = fake("goes on", "RUNNING", node_ip="10.0.0.7", pid=4321, steps=12_000)
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(watch.table([running, fake("begins", "RUNNING"), fake("waits", "PENDING")]))
    said = " ".join(console.export_text().split())
    assert "4 of 5 runs have ended, 1 failed" in said
    assert "goes on │ 10.0.0.7 │ 4321 │ 12,000 │ 30,000 │ 2" in said
    assert "begins" in said
    assert "waits" not in said
    narrow = Console(width=60, record=True, file=io.StringIO())
    narrow.print(watch.table([fake("value_simba_ce_vector/MO-Swimmer-v4/9", "RUNNING", node_ip="10.0.0.7", pid=4321)]))
    assert "".join(line.split("│")[1].strip() for line in narrow.export_text().splitlines() if "│" in line) == (
        "value_simba_ce_vector/MO-Swimmer-v4/9"
    )
    assert watch.errors == {"ends badly": "Traceback\nValueError: nan"}


BAD = {
    "a variant that does not exist": (["--conf", "mombo"], "did you mean 'momba'"),
    "an option that the training does not have": (["--stepz", "3"], "--stepz"),
    "an address without a port": (["--address", "somewhere"], 'give "host:port"'),
    "an address where nothing answers": (["--address", "127.0.0.1:9"], "No Ray cluster answers at 127.0.0.1:9"),
    "no workers": (["--workers", "0"], "workers=0"),
    "no threads": (["--threads", "0"], "threads=0"),
    "more threads than processors": (["--threads", "999"], "threads=999: this machine has"),
    "less than no GPU": (["--gpus", "-1"], "gpus=-1"),
    "less than no failures": (["--max-failures", "-1"], "max_failures=-1"),
}


@pytest.mark.parametrize(("options", "said"), BAD.values(), ids=BAD)
def test_bad_input_ends_with_one_line_of_error(tmp_path, capsys, monkeypatch, options: list[str], said: str) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    with pytest.raises(SystemExit) as stop:
        main(["sweep", "--conf", "momba", "--env", ENV, "--seeds", "1", "--output", str(tmp_path / "sweep"), *options])
    assert said in (str(stop.value) if isinstance(stop.value.code, str) else capsys.readouterr().err)
    assert not list(tmp_path.rglob("*.jsonl"))


def test_no_cluster_on_this_machine_is_one_line_of_error(tmp_path, monkeypatch) -> None:
    def finds_none(**kwargs: Any) -> None:
        raise ConnectionError("Could not find any running Ray instance.")

    monkeypatch.setattr(trials.ray, "init", finds_none)
    with pytest.raises(SystemExit, match="error: Ray at 'auto' cannot be reached: Could not find any running"):
        main([*sweep_arguments(tmp_path), "--address", "auto"])


def test_a_ray_that_does_not_start_is_one_line_of_error(tmp_path, monkeypatch) -> None:
    def is_too_slow(**kwargs: Any) -> None:
        raise Exception("The current node timed out during startup.")

    monkeypatch.setattr(trials.ray, "init", is_too_slow)
    with pytest.raises(SystemExit, match=r"error: Ray did not start on this machine.* timed out during startup"):
        main(sweep_arguments(tmp_path))


def test_sigterm_interrupts_a_sweep_as_ctrl_c_does(monkeypatch) -> None:
    before = signal.getsignal(signal.SIGTERM)
    ended = []
    monkeypatch.setattr(trials.ray, "init", lambda **kwargs: signal.signal(signal.SIGTERM, lambda *of_the_signal: os.abort()))
    monkeypatch.setattr(trials.ray, "shutdown", lambda: ended.append(True))
    try:
        with pytest.raises(KeyboardInterrupt), trials.cluster(None, 1, 1):
            signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert ended


def test_how_long_to_wait_for_a_cluster_does_not_stay_in_the_environment(monkeypatch) -> None:
    name, value = trials.ATTEMPTS
    seen = []
    monkeypatch.setattr(trials.ray, "init", lambda **kwargs: seen.append(os.environ.get(name)))
    monkeypatch.setattr(trials.ray, "shutdown", lambda: None)
    for before, address in ((None, None), (None, "auto"), ("7", "auto")):
        if before is not None:
            monkeypatch.setenv(name, before)
        with trials.cluster(address, 1, 1):
            assert os.environ.get(name) == before
    assert seen == [None, value, "7"]


def test_what_no_node_can_run_is_refused(tmp_path, monkeypatch) -> None:
    nodes = [{"Alive": True, "Resources": {"CPU": 4.0}}, {"Alive": False, "Resources": {"CPU": 16.0, "GPU": 1.0}}]
    monkeypatch.setattr(trials.ray, "nodes", lambda: nodes)
    for threads, gpus in ((8, 0.0), (1, 0.5)):
        with pytest.raises(ValueError, match=f"threads={threads}, gpus={gpus}: no node has as many"):
            trials.run_trials([], {}, tmp_path, None, threads, gpus, 0, False)


def test_two_sweeps_on_one_folder_are_refused(tmp_path) -> None:
    with alone_in(tmp_path), pytest.raises(SystemExit, match="Another process writes into"):
        main(sweep_arguments(tmp_path))


def test_without_ray_a_sweep_says_what_to_install(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "sb3_momba.benchmark.trials")
    monkeypatch.delattr("sb3_momba.benchmark.trials")
    with pytest.raises(SystemExit, match=r"pip install \"sb3-momba\[benchmark\]\""):
        main(sweep_arguments(tmp_path))
