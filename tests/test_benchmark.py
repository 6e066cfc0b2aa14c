"""Grids of runs, and comparing their records: whose result is whose, what each counts, and what the report says of it."""

import contextlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from sb3_momba import records, train
from sb3_momba.benchmark import grid
from sb3_momba.benchmark.__main__ import main
from sb3_momba.benchmark.grid import Cell, make_cells, run_grid
from sb3_momba.benchmark.report import median_run, write_report
from sb3_momba.benchmark.results import Run, Task, areas_under_curve, compare, curve_on
from sb3_momba.files import FileFormatError
from sb3_momba.records import Record, RecordWriter, read_record
from tests.stubs import TINY_SIMBA

ENV = "mo-hopper-2obj-v5"
PREFERENCES = [[0.0, 1.0], [0.5, 0.5], [1.0, 0.0]]
FLOORS = {"standing still": [[1.0, 1.0]] * 3, "random actions": [[0.5, 0.5]] * 3}
CONFIG = {"seed": 0, "device": "cpu", "hyperparameters": {"gamma": 0.99, "policy_kwargs": {"n_atoms": 11}}}
PNG = b"\x89PNG"


@pytest.fixture(autouse=True)
def no_revision(monkeypatch) -> None:
    """Fake records do not ask git."""
    monkeypatch.setattr(records, "git_revision", lambda: None)


@pytest.fixture
def fake(tmp_path) -> Callable[..., Record]:
    """Writes a record under the next name, `fake(values, curve, ...)`, and reads it."""
    folder = tmp_path / "records"

    def write(*args: Any, **kwargs: Any) -> Record:
        return write_record(folder / f"{len(list(folder.glob('*'))):03}" / "record.jsonl", *args, **kwargs)

    return write


def write_record(
    path: Path,
    values: Any = None,
    curve: dict[int, Any] | None = None,
    error: BaseException | str | None = None,
    floors: dict[str, Any] = FLOORS,
    settings: dict[str, Any] | None = None,
    **start: Any,
) -> Record:
    """A record of small numbers.

    :param values: of the final front, one for each preference; None: the run does not finish
    :param curve: steps and the values there
    :param error: that it fails with; "cut off": it has no end
    :param settings: added to the configuration
    """
    config = {**deepcopy(CONFIG), **(settings or {})}
    content = {"label": "a", "env": "E", "env_kwargs": {}, "seed": 0, "config": config, "reference_point": [0.0, 0.0]}
    writer = RecordWriter(path).start(
        **{**content, "preferences": PREFERENCES, "general_policy": True, "parameters": {"actor": 10, "critic": 200}, **start}
    )
    for policy, earned in floors.items():
        writer.append("floor", policy=policy, values=earned)
    for steps, measured in (curve or {}).items():
        writer.append("evaluation", steps=steps, seconds=steps / 10, values=measured)
    if values is not None:
        returns = np.asarray(values, dtype=np.float64)[:, None]
        writer.finish(max(curve or [100]), {"returns": returns})
    elif isinstance(error, BaseException):
        with pytest.raises(type(error)), writer:
            raise error
    return read_record(path)


def box(volume: float) -> list[list[float]]:
    """Values whose hypervolume above 0 is `volume`."""
    return [[volume, 1.0]] * 3


BAD = RuntimeError("diverged")
FRONT = [[1.0, 3.0], [2.0, 2.0], [3.0, 1.0]]  # hypervolume 6 above 0


def only(tasks: Sequence[Task]) -> Task:
    assert len(tasks) == 1
    return tasks[0]


def only_run(task: Task) -> Run:
    ((run,),) = task.methods.values()
    return run


# --------------------------------------------------------------------------------------------------- tasks and methods


def test_tasks_are_environments_with_their_arguments(fake) -> None:
    kwargs = [{"physics": "2020"}, {"physics": "current"}, {"physics": "2020"}, {}]
    tasks = compare([fake(FRONT, env_kwargs=one, seed=i) for i, one in enumerate(kwargs)])
    seeds = {task.name: [run.record.seed for run in task.methods["a"]] for task in tasks}
    assert sorted(seeds.values()) == [[0, 2], [1], [3]]
    (old,) = [name for name, of in seeds.items() if of == [0, 2]]
    assert old.startswith("E")
    assert "physics=2020" in old
    assert "E" in seeds


def test_the_order_of_arguments_makes_no_other_task(fake) -> None:
    arguments = {"physics": "2020", "frame_skip": 2}
    one, other = fake(FRONT, env_kwargs=arguments), fake(FRONT, env_kwargs=dict(reversed(arguments.items())), seed=1)
    assert len(only(compare([one, other])).methods["a"]) == 2


def test_methods_are_labels(fake) -> None:
    runs = [fake(FRONT, label=label, seed=seed, settings={"seed": seed}) for label in "ab" for seed in range(3)]
    task = only(compare(runs))
    assert {name: [run.record.seed for run in runs] for name, runs in task.methods.items()} == {"a": [0, 1, 2], "b": [0, 1, 2]}


def hyperparameters(**changed: Any) -> dict[str, Any]:
    return {"hyperparameters": {**deepcopy(CONFIG["hyperparameters"]), **changed}}


def test_methods_of_one_label_are_told_apart_by_the_settings_that_differ(fake) -> None:
    task = only(
        compare(
            [
                fake(FRONT, seed=0, settings=hyperparameters(gamma=0.9)),
                fake(FRONT, seed=1, settings=hyperparameters(gamma=0.99)),
                fake(FRONT, seed=2, settings=hyperparameters(gamma=0.9)),
                fake(FRONT, label="b", settings=hyperparameters(gamma=0.5)),
            ]
        )
    )
    assert {name: [run.record.seed for run in runs] for name, runs in task.methods.items()} == {
        "a (gamma=0.9)": [0, 2],
        "a (gamma=0.99)": [1],
        "b": [0],
    }


def test_nested_and_several_settings_tell_methods_apart(fake) -> None:
    kwargs = [{"n_atoms": 11}, {"n_atoms": 51}, {"n_atoms": 51, "net_arch": [8, 8]}]
    task = only(compare([fake(FRONT, settings=hyperparameters(policy_kwargs=one)) for one in kwargs]))
    assert len(task.methods) == 3
    assert all("gamma" not in name for name in task.methods)
    assert any("n_atoms=51" in name and "net_arch=[8, 8]" in name for name in task.methods)


@pytest.mark.parametrize(
    "settings",
    [
        {"seed": 7},
        {"device": "cuda"},
        {"subprocesses": True},
        {"objectives": ["speed", "height"]},
        hyperparameters(gamma=0.990),
    ],
    ids=str,
)
def test_runs_of_one_method_may_differ_in_what_is_no_part_of_it(fake, settings: dict[str, Any]) -> None:
    assert list(only(compare([fake(FRONT), fake(FRONT, settings=settings, seed=1)])).methods) == ["a"]


def test_one_number_written_in_two_ways_is_one_setting(fake) -> None:
    one, other = (fake(FRONT, settings=hyperparameters(gamma=gamma)) for gamma in (1, 1.0))
    assert list(only(compare([one, other])).methods) == ["a"]


# -------------------------------------------------------------------------------------------------------------- scores


def test_scores_by_hand(fake) -> None:
    run = only_run(only(compare([fake(FRONT, {10: box(2.0), 20: FRONT})])))
    assert run.is_finished
    assert run.hypervolume == 6
    assert run.expected_utility == pytest.approx((3 + 2 + 3) / 3)
    assert run.preference_regret == 0
    assert run.inverted_generational_distance == 0
    np.testing.assert_array_equal(run.steps, [10, 20])
    np.testing.assert_array_equal(run.seconds, [1, 2])
    np.testing.assert_array_equal(run.curve, [2, 6])


def test_regret_is_what_the_answer_to_another_preference_would_have_been_worth(fake) -> None:
    run = only_run(only(compare([fake(FRONT[::-1])])))
    assert run.preference_regret == pytest.approx((2 + 0 + 2) / 3)
    assert run.expected_utility == pytest.approx(8 / 3)


def test_floors_by_hand(fake) -> None:
    floors = only(compare([fake(None, error=BAD, floors={}), fake(FRONT)])).floors
    assert floors == {"standing still": (1.0, 1.0), "random actions": (0.25, 0.5)}


@pytest.mark.parametrize("error", [BAD, "cut off"], ids=["failed", "cut off"])
def test_a_run_that_did_not_finish_counts_with_nothing(fake, error: Any) -> None:
    task = only(compare([fake(FRONT, seed=0), fake(None, {10: box(9.0)}, error, seed=1)]))
    _, failed = task.methods["a"]
    assert not failed.is_finished
    assert (failed.hypervolume, failed.expected_utility) == (0.0, 0.5)
    assert np.isnan(failed.preference_regret)
    assert np.isnan(failed.inverted_generational_distance)
    np.testing.assert_array_equal(failed.curve, [9])


def test_the_worse_floor_is_that_of_a_record_that_has_both(fake) -> None:
    """A run that was cut off between its floors does not hide the other one."""
    still = {"standing still": FLOORS["standing still"]}
    task = only(compare([fake(None, error="cut off", floors=still), fake(FRONT, seed=1)]))
    assert set(task.floors) == set(FLOORS)
    assert task.methods["a"][0].expected_utility == 0.5


def test_the_reference_point_is_the_records_or_the_given_one(fake) -> None:
    values = [[1.0, 3.0], [2.0, 2.0], [3.0, 1.0]]
    record = fake(values, {10: values}, reference_point=[0.0, 1.0])
    assert only_run(only(compare([record]))).hypervolume == 1 * 2 + 1 * 1
    task = only(compare([record], [1.0, 0.0]))
    assert only_run(task).hypervolume == 2 * 1 + 1 * 1
    np.testing.assert_array_equal(task.reference_point, [1, 0])
    np.testing.assert_array_equal(only_run(task).curve, [3])
    assert task.floors["standing still"] == (0.0, 1.0)


def test_reference_points_that_differ_are_an_error(fake) -> None:
    differing = [fake(FRONT), fake(FRONT, reference_point=[1.0, 0.0])]
    with pytest.raises(ValueError, match="--reference-point") as error:
        compare(differing)
    assert re.search(r"\(1\.0, 0\.0\)|\[1\.0, 0\.0\]", str(error.value)), error.value
    assert len(only(compare(differing, [0.0, 0.0])).methods["a"]) == 2
    assert len(compare([differing[0], fake(FRONT, env="F", reference_point=[1.0, 0.0])])) == 2


@pytest.mark.parametrize("point", [[0.0], [0.0, 0.0, 0.0]], ids=str)
def test_a_reference_point_of_another_length_is_an_error(fake, point: list[float]) -> None:
    with pytest.raises(ValueError, match="2 objectives") as error:
        compare([fake(FRONT)], point)
    assert str(point) in str(error.value)


def test_tasks_of_different_numbers_of_objectives_are_an_error(fake) -> None:
    three = {"reference_point": [0.0] * 3, "preferences": [[1.0, 0.0, 0.0]], "floors": {}}
    with pytest.raises(ValueError, match="E"):
        compare([fake(FRONT), fake([[1.0, 1.0, 1.0]], **three)])


@pytest.mark.parametrize("unit", [1.0, 100.0])
def test_distance_to_the_front_of_all_by_hand(fake, unit: float) -> None:
    """The envelope is what is the best for a preference, of all records; its range becomes [0, 1] on each axis."""
    scale = np.array([1.0, unit])
    best = np.array([[0.0, 4.0], [3.0, 3.0], [4.0, 0.0]]) * scale
    worse = np.array([[0.0, 2.0], [1.0, 1.0], [2.0, 0.0]]) * scale
    preferences = [[0.0, 1.0], [unit / (1 + unit), 1 / (1 + unit)], [1.0, 0.0]]
    records_ = [
        fake(best, label="best", preferences=preferences),
        fake(worse, label="worse", preferences=preferences),
        fake(None, {10: 9 * best}, BAD, label="failed", preferences=preferences),
    ]
    task = only(compare(records_))
    np.testing.assert_array_equal(task.reference_front, best)
    distances = {name: runs[0].inverted_generational_distance for name, runs in task.methods.items()}
    assert distances["best"] == 0
    assert distances["worse"] == pytest.approx((0.5 + np.hypot(0.5, 0.5) + 0.5) / 3)


def test_a_front_of_one_point_has_distances(fake) -> None:
    task = only(compare([fake([[2.0, 2.0]] * 3, label="a"), fake([[1.0, 2.0]] * 3, label="b")]))
    assert {name: runs[0].inverted_generational_distance for name, runs in task.methods.items()} == {"a": 0.0, "b": 1.0}


def test_what_reads_can_be_compared(fake) -> None:
    """Damaged numbers that pass as a record give results or a ValueError, never another exception."""
    record = fake(FRONT, {10: box(2.0), 20: FRONT})
    lines = [json.loads(line) for line in record.path.read_text().splitlines()]
    keys = [(i, key) for i, line in enumerate(lines) for key in line if key not in ("event", "format", "version", "values")]
    odd = [None, True, -1, 0.5, 10**20, 10**400, "a", "nan", [], {}, [1.0, 2.0], {"a": None}, {"a": {"b": [1]}}]
    compared = 0
    for i, key in keys:
        for value in odd:
            changed = deepcopy(lines)
            changed[i][key] = value
            record.path.write_text("".join(json.dumps(line) + "\n" for line in changed))
            try:
                tasks = compare([read_record(record.path)])
            except ValueError:
                continue
            assert len(tasks) == 1, (key, value)
            compared += 1
    assert compared > 0


# -------------------------------------------------------------------------------------------------------------- curves


def curves_of(fake: Callable[..., Record], *runs: tuple[dict[int, float], bool]) -> list[Run]:
    """Runs of one method, each with its hypervolume over steps, and whether it finished."""
    made = []
    for seed, (volumes, is_finished) in enumerate(runs):
        curve = {steps: box(volume) for steps, volume in volumes.items()}
        last = list(curve.values())[-1:] or [None]
        made.append(fake(last[0] if is_finished else None, curve, None if is_finished else BAD, seed=seed))
    return only(compare(made)).methods["a"]


def test_curves_by_hand(fake) -> None:
    """Common steps are interpolated to; a run that failed has 0 after its last evaluation."""
    runs = curves_of(fake, ({10: 2, 20: 4, 30: 6}, True), ({10: 8}, False), ({10: 1, 30: 5}, True), ({}, False))
    steps, curves = curve_on(runs)
    np.testing.assert_array_equal(steps, [10, 20, 30])
    np.testing.assert_allclose(curves, [[2, 4, 6], [8, 0, 0], [1, 3, 5], [0, 0, 0]])
    np.testing.assert_allclose(areas_under_curve(runs), [4, 2, 3, 0])


def test_a_curve_that_stops_short_of_a_common_step_ends_there(fake) -> None:
    """Evaluated last at 25 of 30 steps."""
    runs = curves_of(fake, ({10: 2, 20: 4, 30: 6}, True), ({15: 3, 25: 5}, False))
    np.testing.assert_allclose(curve_on(runs)[1], [[2, 4, 6], [3, 4, 0]])


def test_curves_of_runs_that_all_failed(fake) -> None:
    runs = curves_of(fake, ({}, False), ({}, False))
    steps, curves = curve_on(runs)
    assert (steps.shape, curves.shape) == ((0,), (2, 0))
    assert areas_under_curve(runs) == [0, 0]


def test_one_evaluation_is_its_own_mean(fake) -> None:
    assert areas_under_curve(curves_of(fake, ({10: 3}, True), ({10: 5}, False))) == [3, 0]


@pytest.mark.parametrize(
    ("volumes", "median"),
    [([3, 1, 2], 2), ([4, 1, 3, 2], 2), ([5], 5), ([2, 1], 1), ([None, 3, 1, None, 2], 2), ([None], None)],
)
def test_the_median_run_is_a_finished_one(fake, volumes: list[float | None], median: float | None) -> None:
    """Of an even number the lower of the two in the middle."""
    made = [fake(None if v is None else box(v), error=BAD if v is None else None, seed=i) for i, v in enumerate(volumes)]
    run = median_run(only(compare(made)).methods["a"])
    assert (run and run.hypervolume) == median


# -------------------------------------------------------------------------------------------------------------- report


def report_of(folder: Path, made: Sequence[Record]) -> str:
    """The report's text, whose pictures all exist and whose tables are whole."""
    text = write_report(compare(made), made, folder)
    assert (folder / "report.md").read_text() == text
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", text)
    assert len(set(pictures)) == len(pictures), pictures
    assert set(pictures) == {path.name for path in folder.glob("*.png")}
    assert all((folder / name).read_bytes().startswith(PNG) for name in pictures)
    width = 0
    for line in text.splitlines():
        cells = len(re.split(r"(?<!\\)\|", line)) if line.startswith("|") else 0
        assert cells in (0, width) or width == 0, line
        width = cells
    return text


def rows_of(text: str, name: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith(f"| {name} |")]


def test_a_report_of_two_objectives(fake, tmp_path) -> None:
    curve = {10: box(2.0), 20: FRONT}
    made = [fake(FRONT, curve, label="b", seed=seed) for seed in range(2)]
    made += [fake(box(1.0), {10: box(1.0), 20: box(1.0)}), fake(None, {10: box(1.0)}, BAD, seed=1), fake(seed=2)]
    text = report_of(tmp_path / "report", made)
    assert {path.suffix for path in (tmp_path / "report").iterdir()} == {".md", ".png"}
    assert len(list((tmp_path / "report").glob("*.png"))) == 2
    row = rows_of(text, "b")[0]
    assert row[1:4] == ["2/2", "20", "210"]
    assert [float(cell.split()[0]) for cell in row[4:]] == pytest.approx([6, 8 / 3, 0, 0, 4], rel=1e-3)
    assert rows_of(text, "a")[0][1:3] == ["1/3", "20"]
    assert rows_of(text, r"(standing still)")[0][4:6] == ["1", "1"]
    assert rows_of(text, r"(random actions)")[0][4:6] == ["0.25", "0.5"]
    assert rows_of(text, "b")[1][1].startswith("1 [1, 1]")  # P(b > a)
    assert rows_of(text, "a")[1][2].startswith("0 [0, 0]")
    assert "seed 1: RuntimeError: diverged" in text
    assert "seed 2: no end" in text
    assert f"sb3_momba {made[0].start['versions']['sb3_momba']}" in text
    assert made[0].start["machine"]["processor"] in text


@pytest.mark.parametrize("n_objectives", [1, 3, 4])
def test_fronts_are_drawn_of_two_or_three_objectives(fake, tmp_path, n_objectives: int) -> None:
    shape = {"reference_point": [0.0] * n_objectives, "preferences": np.eye(n_objectives)}
    values = np.eye(n_objectives) + 1
    floors = {"standing still": np.full((n_objectives, n_objectives), 0.5)}
    made = [fake(values, {10: values, 20: values}, floors=floors, **shape)]
    report_of(tmp_path / "report", made)
    assert len(list((tmp_path / "report").glob("*.png"))) == (2 if n_objectives == 3 else 1)


def test_a_report_of_one_evaluation(fake, tmp_path) -> None:
    text = report_of(tmp_path / "report", [fake(FRONT, {10: FRONT}, floors={})])
    assert rows_of(text, "a")[0][1:3] == ["1/1", "10"]
    assert "improvement" not in text


@pytest.mark.parametrize("curve", [{}, {10: box(1.0), 20: box(2.0)}], ids=["never evaluated", "evaluated"])
def test_a_report_of_runs_that_all_failed(fake, tmp_path, curve: dict[int, Any]) -> None:
    made = [fake(None, curve, error, label=label, floors={}) for label in "ab" for error in (BAD, "cut off")]
    text = report_of(tmp_path / "report", made)
    assert rows_of(text, "a")[0][1] == rows_of(text, "b")[0][1] == "0/2"
    assert text.count("diverged") == 2


def test_a_report_of_tasks_that_share_one_method(fake, tmp_path) -> None:
    made = [fake(FRONT, env="E"), fake(box(1.0), env="F", label="b"), fake(FRONT, env="F")]
    text = report_of(tmp_path / "report", made)
    assert text.index("## E") < text.index("## F")
    assert rows_of(text, "b")[1][1].startswith("0 [0, 0]")


def test_names_that_markdown_would_take_for_its_own(fake, tmp_path) -> None:
    made = [fake(FRONT, label="a|b"), fake(None, error=ValueError("two\nlines | bar"), label="c")]
    text = report_of(tmp_path / "report", made)
    after = text.split("## Runs that did not finish")[1].split("##")[0].strip().splitlines()
    assert len(after) == 1, after


def test_each_task_has_pictures_of_its_own(fake, tmp_path) -> None:
    """Whatever of its name a file's name cannot hold."""
    curve = {10: box(1.0), 20: FRONT}
    report_of(tmp_path / "report", [fake(FRONT, curve, env_kwargs={"x": x}) for x in ("a/b", "a:b")])
    assert len(list((tmp_path / "report").glob("*.png"))) == 4


# -------------------------------------------------------------------------------------------------- report, command line


def error_of(*arguments: str | Path) -> str:
    """The one line that a command ends with."""
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    message = stop.value.code
    assert isinstance(message, str), f"it ended with {message!r}"
    assert message.startswith("error: ")
    assert "\n" not in message
    return message


def test_report_from_the_command_line(fake, tmp_path, capsys) -> None:
    record = fake(FRONT, {10: FRONT})
    main(["report", str(tmp_path / "records")])
    first = (tmp_path / "records" / "report.md").read_text()
    assert first in capsys.readouterr().out
    main(["report", str(record.path)])
    assert (record.path.parent / "report.md").read_text() == first
    main(["report", str(record.path), "--output", str(tmp_path / "new" / "place"), "--reference-point", "-1", "-1"])
    text = (tmp_path / "new" / "place" / "report.md").read_text()
    assert "[-1.0, -1.0]" in text
    assert rows_of(text, "a")[0][4].startswith("13 ")  # 2 x 4 + 1 x 3 + 1 x 2
    assert str(tmp_path / "new" / "place" / "report.md") in capsys.readouterr().out


def test_bad_input_ends_with_one_line_of_error(fake, tmp_path) -> None:
    (tmp_path / "empty").mkdir()
    assert str(tmp_path / "empty") in error_of("report", tmp_path / "empty")
    assert "nowhere" in error_of("report", tmp_path / "nowhere")
    garbage = tmp_path / "garbage"
    garbage.write_bytes(bytes(range(256)))
    assert str(garbage) in error_of("report", garbage)
    record = fake(FRONT)
    assert str(garbage) in error_of("report", record.path, "--output", garbage)
    assert "reference point [0.0]" in error_of("report", record.path, "--reference-point", "0")
    fake(FRONT, reference_point=[1.0, 0.0])
    assert "--reference-point" in error_of("report", tmp_path / "records")
    record.path.write_text(record.path.read_text().replace('"version": 1', '"version": 2'))
    assert "version 2" in error_of("report", tmp_path / "records")


def test_options_that_report_does_not_have_are_errors(fake, tmp_path, capsys) -> None:
    fake(FRONT)
    with pytest.raises(SystemExit) as stop:
        main(["report", str(tmp_path / "records"), "--seeds", "3"])
    assert stop.value.code == 2
    assert "--seeds" in capsys.readouterr().err


@pytest.mark.parametrize("parameters", [None, 7, {"actor": None}, {"actor": "many"}], ids=str)
def test_a_damaged_count_of_parameters_is_one_line_of_error(fake, tmp_path, parameters: Any) -> None:
    """The start promises the number of each network."""
    with contextlib.suppress(FileFormatError):
        fake(FRONT, parameters=parameters)
    error_of("report", tmp_path / "records")


# ---------------------------------------------------------------------------------------------------------------- grid


def parsed(cell: Cell, folder: Path) -> train.RunSettings:
    """What the training reads from a cell's command."""
    python, *rest = cell.command(folder)
    assert python == sys.executable
    assert rest[:2] == ["-m", "sb3_momba.train"]
    return train.parse(rest[2:])


def test_cells_are_every_configuration_environment_and_seed(tmp_path) -> None:
    envs = ["MO-Hopper-v4", "MO-Ant-v4"]
    cells = make_cells(["momba", "capql"], envs, 2, ["--steps", "3e4", "--n-episodes", "2"])
    runs = [(cell.seed, cell.env, cell.conf) for cell in cells]
    assert runs == [(seed, env, conf) for seed in range(2) for env in envs for conf in ("momba", "capql")]
    assert len({cell.name for cell in cells}) == 8
    for cell in cells:
        settings = parsed(cell, tmp_path)
        assert (settings.env, settings.seed, settings.label) == (cell.env, cell.seed, cell.conf)
        assert (settings.steps, settings.n_episodes, settings.output) == (30_000, 2, str(tmp_path))


def test_the_start_of_alpha_is_for_configurations_that_learn_it(tmp_path) -> None:
    (tmp_path / "auto.yml").write_text("default:\n  ent_coef: auto\n")
    (tmp_path / "silent.yml").write_text("default:\n  gamma: 0.9\n")
    (tmp_path / "fixed.yml").write_text("default:\n  ent_coef: 0.5\n")
    confs = ["momba", "capql", *(str(tmp_path / f"{name}.yml") for name in ("auto", "silent", "fixed"))]
    given = [parsed(cell, tmp_path).hyperparameters.get("ent_coef") for cell in make_cells(confs, [ENV], 1, [], 0.01)]
    assert given == ["auto_0.01", 0.2, "auto_0.01", "auto_0.01", 0.5]
    own = [parsed(cell, tmp_path).hyperparameters.get("ent_coef") for cell in make_cells(confs, [ENV], 1)]
    assert own == ["auto_0.2", 0.2, "auto", None, 0.5]


def test_a_configuration_that_does_not_exist_is_an_error(tmp_path) -> None:
    with pytest.raises(ValueError, match="did you mean 'capql'"):
        make_cells(["capq"], [ENV], 1)
    arguments = ["--env", ENV, "--seeds", "1", "--output", tmp_path / "grid"]
    assert "did you mean 'capql'" in error_of("run", "--conf", "capq", *arguments)
    assert not (tmp_path / "grid").exists()


@pytest.mark.parametrize("env", [f"mo_gymnasium:{ENV}", ENV], ids=["with its module", "by its id"])
def test_environments_are_named_as_the_training_takes_them(env: str) -> None:
    assert make_cells(["momba"], [env], 1)[0].env == env


def test_each_cell_has_a_folder_of_its_own(tmp_path) -> None:
    """Two files of one name, in two folders, are two configurations; or it is an error."""
    confs = []
    for gamma in (0.9, 0.99):
        path = tmp_path / str(gamma) / "mine.yml"
        path.parent.mkdir()
        path.write_text(f"default:\n  gamma: {gamma}\n")
        confs.append(str(path))
    try:
        cells = make_cells(confs, [ENV], 1)
    except ValueError:
        return
    assert len({cell.name for cell in cells}) == len(cells)


@pytest.mark.parametrize("seeds", ["0", "-1"])
def test_a_grid_of_no_runs_is_an_error(tmp_path, seeds: str) -> None:
    error_of("run", "--conf", "momba", "--env", ENV, "--seeds", seeds, "--output", tmp_path)


class FakeTraining:
    """In the place of subprocess.run: writes the record that a training would, as `outcome` says for each seed."""

    def __init__(self, outcome: dict[int, str] | None = None):
        self.outcome = outcome or {}
        self.seeds: list[int] = []
        self.environments: list[dict[str, str]] = []

    def __call__(self, command: list[str], stdout: Any = None, env: Any = None, **kwargs: Any) -> SimpleNamespace:
        settings = train.parse(command[3:])
        self.seeds.append(settings.seed)
        self.environments.append(env or dict(os.environ))
        folder = Path(settings.output)
        assert not folder.exists() or not any(folder.iterdir()), "a training refuses this folder"
        outcome = self.outcome.get(settings.seed, "finishes")
        stdout.write(outcome.encode())
        if outcome == "does not start":
            return SimpleNamespace(returncode=1)
        error = {"fails": BAD, "is cut off": "cut off"}.get(outcome)
        config = train.recorded_settings(settings)
        write_record(
            folder / "record.jsonl", FRONT if error is None else None, error=error, seed=settings.seed, settings=config
        )
        (folder / "model.zip").touch()
        return SimpleNamespace(returncode=int(error is not None))


@pytest.fixture
def training(monkeypatch) -> Callable[..., FakeTraining]:
    def replace(outcome: dict[int, str] | None = None) -> FakeTraining:
        fake_training = FakeTraining(outcome)
        monkeypatch.setattr(subprocess, "run", fake_training)
        return fake_training

    return replace


def test_what_ended_is_not_run_again_and_what_was_cut_off_is(training, tmp_path) -> None:
    cells = make_cells(["momba"], [ENV], 4)
    first = training({1: "fails", 2: "is cut off", 3: "does not start"})
    assert run_grid(cells, tmp_path, processes=1) == 3
    assert sorted(first.seeds) == [0, 1, 2, 3]
    assert {environment["OMP_NUM_THREADS"] for environment in first.environments} == {"1"}
    failed = (tmp_path / cells[1].name / "record.jsonl").read_bytes()

    second = training()
    assert run_grid(cells, tmp_path, processes=2) == 1
    assert sorted(second.seeds) == [2, 3]
    assert (tmp_path / cells[1].name / "record.jsonl").read_bytes() == failed
    assert read_record(tmp_path / cells[2].name / "record.jsonl").error is None

    third = training()
    assert run_grid(cells, tmp_path) == 1
    assert third.seeds == []


def test_a_run_with_other_settings_is_not_taken_for_the_cells(training, tmp_path) -> None:
    training()
    run_grid(make_cells(["momba"], [ENV], 1, ["--steps", "3e4"]), tmp_path)
    longer = training()
    with pytest.raises(ValueError, match=r"holds a run with other settings \(steps\): choose another --output"):
        run_grid(make_cells(["momba"], [ENV], 2, ["--steps", "1e6"]), tmp_path)
    assert longer.seeds == []


def test_logs_lie_beside_the_folders(training, tmp_path) -> None:
    cells = make_cells(["momba"], [ENV], 2)
    training({1: "does not start"})
    run_grid(cells, tmp_path)
    logs = {path.relative_to(tmp_path).as_posix(): path.read_text() for path in tmp_path.rglob("*.log")}
    assert logs == {f"momba/{ENV}/0.log": "finishes", f"momba/{ENV}/1.log": "does not start"}


@pytest.mark.parametrize("content", [b"", b'{"event": "start", "format": "sb3_mom'], ids=["empty", "torn first line"])
def test_a_run_that_was_cut_off_in_its_first_line_is_run_again(training, tmp_path, content: bytes) -> None:
    (cell,) = make_cells(["momba"], [ENV], 1)
    path = tmp_path / cell.name / "record.jsonl"
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    fake_training = training()
    assert run_grid([cell], tmp_path) == 0
    assert fake_training.seeds == [0]


def test_a_damaged_record_does_not_stop_the_others(training, tmp_path) -> None:
    """The grid is refused before it starts, or all others are run. The record stays: it may be of a newer version."""
    cells = make_cells(["momba"], [ENV], 6)
    path = tmp_path / cells[0].name / "record.jsonl"
    path.parent.mkdir(parents=True)
    path.write_text("damaged\n")
    fake_training = training()
    arguments = ["--conf", "momba", "--env", ENV, "--seeds", "6", "--output", tmp_path, "--processes", "1"]
    error_of("run", *arguments)
    assert path.read_text() == "damaged\n"
    assert sorted(fake_training.seeds) in ([], [1, 2, 3, 4, 5])


def test_what_is_no_run_is_not_thrown_away(training, tmp_path) -> None:
    """A training refuses a folder with something in it; a grid only clears what a run left."""
    (cell,) = make_cells(["momba"], [ENV], 1)
    mine = tmp_path / cell.name / "thesis.txt"
    mine.parent.mkdir(parents=True)
    mine.write_text("years of work")
    training()
    with contextlib.suppress(AssertionError, ValueError, OSError):
        run_grid([cell], tmp_path)
    assert mine.exists()


def test_a_grid_with_failures_ends_with_their_number(training, tmp_path) -> None:
    arguments = ["--conf", "momba", "--env", ENV, "--seeds", "3", "--output", tmp_path, "--processes", "1"]
    for _ in range(2):
        training({0: "fails", 2: "fails"})
        message = error_of("run", *arguments)
        assert "2 runs failed" in message
        assert str(tmp_path) in message


def test_options_are_handed_on(training, tmp_path, monkeypatch) -> None:
    seen: list[list[str]] = []
    fake_training = training()
    monkeypatch.setattr(
        subprocess, "run", lambda command, **kwargs: (seen.append(command), fake_training(command, **kwargs))[1]
    )
    line = f"run --conf momba --env {ENV} --seeds 1 --output {tmp_path} --auto-ent-coef 0.01 --steps 3e4 --set gamma=0.9"
    main(line.split())
    settings = train.parse(seen[0][3:])
    assert settings.steps == 30_000
    assert settings.hyperparameters["gamma"] == 0.9
    assert settings.hyperparameters["ent_coef"] == "auto_0.01"
    assert not settings.progress_bar


def test_a_real_grid_of_one_run(tmp_path, monkeypatch, capsys) -> None:
    conf = tmp_path / "tiny.yml"
    entry = {"learning_starts": 50, "buffer_size": 200, "batch_size": 8, "policy_kwargs": TINY_SIMBA}
    conf.write_text(yaml.safe_dump({"default": entry}))
    line = f"run --conf {conf} --env {ENV} --seeds 1 --output {tmp_path / 'grid'} --processes 1"
    options = "--steps 100 --eval-freq 50 --n-preferences 3 --n-episodes 1 --device cpu --reference-point -10 -10"
    main([*line.split(), *options.split()])
    folder = tmp_path / "grid" / "tiny" / ENV / "0"
    record = read_record(folder / "record.jsonl")
    assert (record.label, record.env, record.seed, record.error) == ("tiny", ENV, 0, None)
    assert [evaluation.steps for evaluation in record.evaluations] == [50, 100]
    assert record.start["machine"]["torch_threads"] == 1
    assert (folder / "model.zip").exists()

    monkeypatch.setattr(grid.subprocess, "run", lambda *args, **kwargs: pytest.fail("it is run again"))
    main([*line.split(), *options.split()])
    main(["report", str(tmp_path / "grid")])
    text = (tmp_path / "grid" / "report.md").read_text()
    assert rows_of(text, "tiny")[0][1:3] == ["1/1", "100"]
    assert text in capsys.readouterr().out
