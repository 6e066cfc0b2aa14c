"""Grids of runs, and comparing their records: whose result is whose, what each counts, and what the report says of it."""

import contextlib
import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import gymnasium as gym
import matplotlib.image
import numpy as np
import pytest
import yaml
from scipy.spatial import ConvexHull

from sb3_momba import recording, runs, train
from sb3_momba.benchmark import execution, local, speed
from sb3_momba.benchmark.__main__ import main
from sb3_momba.benchmark.execution import has_to_run
from sb3_momba.benchmark.grid import Cell, make_cells
from sb3_momba.benchmark.local import run_grid
from sb3_momba.benchmark.report import write_report
from sb3_momba.benchmark.results import Run, Task, areas_under_curve, compare, curve_on, cut_at, median_run
from sb3_momba.benchmark.statistics import Estimate
from sb3_momba.benchmark.tables import as_text
from sb3_momba.files import FileFormatError, alone_in
from sb3_momba.nn.products import onednn_keeps_float32
from sb3_momba.pareto.metrics import convex_envelope, non_dominated
from sb3_momba.recording import RecordWriter, plain
from sb3_momba.records import UNENDED, Record, read_record
from sb3_momba.zoo.configuration import with_defaults
from tests.stubs import TINY_SIMBA

ENV = "mo-hopper-2obj-v5"
PREFERENCES = [[0.0, 1.0], [0.5, 0.5], [1.0, 0.0]]
FLOORS = {"standing still": [[1.0, 1.0]] * 3, "random actions": [[0.5, 0.5]] * 3}
CONFIG = {"seed": 0, "device": "cpu", "hyperparameters": {"gamma": 0.99, "policy_kwargs": {"n_atoms": 11}}}
PNG = b"\x89PNG"


@pytest.fixture(autouse=True)
def no_revision(monkeypatch) -> None:
    """Fake records do not ask git."""
    monkeypatch.setattr(recording, "git_revision", lambda: None)


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
    extra_steps: int | None = None,
    **start: Any,
) -> Record:
    """A record of small numbers.

    :param values: of the final front, with a general policy one for each preference; None: the run does not finish
    :param curve: steps and the values there
    :param error: that it fails with; "cut off": it has no end
    :param settings: added to the configuration
    :param extra_steps: at the end, if it has one
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
        extra = {} if extra_steps is None else {"extra_steps": extra_steps}
        writer.finish(max(curve or [100]), {"returns": returns}, **extra)
    elif isinstance(error, BaseException):
        with pytest.raises(type(error)), writer:
            raise error
    writer.file.close()
    return read_record(path)


def box(volume: float) -> list[list[float]]:
    """Values whose hypervolume above 0 is `volume`."""
    return [[volume, 1.0]] * 3


BAD = RuntimeError("diverged")
FRONT = [[1.0, 3.0], [2.0, 2.0], [3.0, 1.0]]  # hypervolume 6 above 0
# From FRONT to the floors, on axes on which FRONT goes from 0 to 1 and the floors are (0, 0) and (-1/4, -1/4).
STILL_DISTANCE = (1 + np.sqrt(0.5) + 1) / 3
RANDOM_DISTANCE = (2 * np.hypot(0.25, 1.25) + np.hypot(0.75, 0.75)) / 3


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


def test_settings_that_came_after_a_record_have_their_defaults(fake) -> None:
    older = hyperparameters(gamma=0.99)
    now = plain(with_defaults("MlpPolicy", older["hyperparameters"]))
    made = [fake(FRONT, settings={"policy": "MlpPolicy", **settings}) for settings in (older, {"hyperparameters": now})]
    assert list(only(compare(made)).methods) == ["a"]
    now["policy_kwargs"]["activation_fn"] = "torch.nn.modules.activation.Tanh"
    made.append(fake(FRONT, settings={"policy": "MlpPolicy", "hyperparameters": now}))
    assert [name.partition("=")[0] for name in only(compare(made)).methods] == ["a (activation_fn"] * 2


# -------------------------------------------------------------------------------------------------------------- scores


def test_scores_by_hand(fake) -> None:
    run = only_run(only(compare([fake(FRONT, {10: box(2.0), 20: FRONT})])))
    assert run.is_finished
    assert run.hypervolume == 6
    assert run.expected_utility == pytest.approx((3 + 2 + 3) / 3)
    assert run.preference_regret == 0
    assert run.inverted_generational_distance == 0
    np.testing.assert_array_equal(run.steps, [10, 20])
    np.testing.assert_array_equal(run.curve, [2, 6])
    assert [evaluation.seconds for evaluation in run.record.evaluations] == [1, 2]
    np.testing.assert_array_equal(run.seconds, [1, 2])
    # Over time from standing still, 1, on.
    assert (run.mean_over_steps, run.mean_over_time) == (4, ((1 + 2) / 2 + (2 + 6) / 2) / 2)


def test_regret_is_what_the_answer_to_another_preference_would_have_been_worth(fake) -> None:
    run = only_run(only(compare([fake(FRONT[::-1])])))
    assert run.preference_regret == pytest.approx((2 + 0 + 2) / 3)
    assert run.expected_utility == pytest.approx(8 / 3)


def test_a_set_of_solutions_by_hand(fake) -> None:
    """As many as there happen to be; which one answers which preference is not said, so that regret is unknown."""
    floors = {name: values[:2] for name, values in FLOORS.items()}
    curve = {10: [[2.0, 1.0]], 20: [[1.0, 3.0], [3.0, 1.0]] * 3}
    made = [
        fake([[3.0, 1.0], [1.0, 3.0]], curve, floors=floors, general_policy=False),
        fake([*FRONT, [0.0, 0.0], [1.0, 1.0]], floors=floors, general_policy=False, label="b"),
        fake(FRONT, label="c"),
        fake(FRONT, general_policy=False, label="d"),
    ]
    task = only(compare(made))
    two, five, general, as_many = (runs[0] for runs in task.methods.values())
    assert (two.hypervolume, two.expected_utility) == (5, pytest.approx(8 / 3))
    assert two.inverted_generational_distance == pytest.approx(np.sqrt(0.5) / 3)
    np.testing.assert_array_equal(two.curve, [2, 5])
    assert (five.hypervolume, five.expected_utility) == (6, pytest.approx(8 / 3))
    assert five.inverted_generational_distance == 0
    assert np.isnan([run.preference_regret for run in (two, five, as_many)]).all()
    assert general.preference_regret == 0
    np.testing.assert_array_equal(task.reference_front, FRONT)
    assert task.floors["standing still"] == pytest.approx((1.0, 1.0, STILL_DISTANCE))


def test_floors_by_hand(fake) -> None:
    floors = only(compare([fake(None, error=BAD, floors={}), fake(FRONT)])).floors
    assert floors == {
        "standing still": pytest.approx((1.0, 1.0, STILL_DISTANCE)),
        "random actions": pytest.approx((0.25, 0.5, RANDOM_DISTANCE)),
    }


@pytest.mark.parametrize("general_policy", [True, False])
@pytest.mark.parametrize("error", [BAD, "cut off"], ids=["failed", "cut off"])
def test_a_run_that_did_not_finish_counts_with_nothing(fake, error: Any, general_policy: bool) -> None:
    made = [fake(FRONT, seed=0), fake(None, {10: box(9.0)}, error, seed=1, general_policy=general_policy)]
    _, failed = only(compare(made)).methods["a"]
    assert not failed.is_finished
    assert (failed.hypervolume, failed.expected_utility) == (0.0, 0.5)
    assert np.isnan(failed.preference_regret)
    assert failed.inverted_generational_distance == pytest.approx(RANDOM_DISTANCE)
    np.testing.assert_array_equal(failed.curve, [9])


def test_the_worse_floor_is_that_of_each_score(fake) -> None:
    """One has the lower utility, the other lies further from the front: on [0, 1] axes they are (0.2, 0.2) and (1, 0)."""
    floors = {"standing still": [[1.4, 1.4]] * 3, "random actions": [[3.0, 1.0]] * 3}
    distances = (2 * np.hypot(0.2, 0.8) + np.hypot(0.3, 0.3)) / 3, (np.sqrt(2) + np.sqrt(0.5) + 0) / 3
    assert distances[0] < distances[1]
    task = only(compare([fake(FRONT, floors=floors), fake(None, error=BAD, floors=floors, seed=1)]))
    assert task.floors["standing still"][1:] == pytest.approx((1.4, distances[0]))
    assert task.floors["random actions"][1:] == pytest.approx((2.0, distances[1]))
    failed = task.methods["a"][1]
    assert (failed.expected_utility, failed.inverted_generational_distance) == pytest.approx((1.4, distances[1]))


@pytest.mark.parametrize("error", [BAD, "cut off"], ids=["failed", "cut off"])
def test_a_run_that_failed_is_no_better_than_the_worst_that_is_known(fake, error: Any) -> None:
    task = only(compare([fake(FRONT, floors={}), fake(None, {10: FRONT}, error, floors={}, seed=1)]))
    finished, failed = task.methods["a"]
    assert failed.expected_utility == finished.expected_utility
    assert failed.inverted_generational_distance == finished.inverted_generational_distance
    assert np.isnan(failed.preference_regret)
    worse_than_a_floor = [fake([[0.1, 0.1]] * len(PREFERENCES)), fake(None, error=error, seed=1)]
    finished, failed = only(compare(worse_than_a_floor)).methods["a"]
    assert failed.expected_utility == finished.expected_utility == pytest.approx(0.1)


@pytest.mark.parametrize("error", [BAD, "cut off"], ids=["failed", "cut off"])
def test_without_anything_known_the_scores_of_a_run_that_failed_are_unknown(fake, error: Any) -> None:
    task = only(compare([fake(None, {10: FRONT}, error, floors={}, seed=1)]))
    assert task.floors == {}
    failed = task.methods["a"][0]
    assert failed.hypervolume == 0
    assert np.isnan([failed.expected_utility, failed.inverted_generational_distance, failed.preference_regret]).all()


def test_the_worse_floor_is_that_of_a_record_that_has_both(fake) -> None:
    """A run that was cut off between its floors does not hide the other one."""
    still = {"standing still": FLOORS["standing still"]}
    task = only(compare([fake(None, error="cut off", floors=still), fake(FRONT, seed=1)]))
    assert set(task.floors) == set(FLOORS)
    assert task.methods["a"][0].expected_utility == 0.5
    assert task.methods["a"][0].inverted_generational_distance == pytest.approx(RANDOM_DISTANCE)


def test_the_reference_point_is_the_records_or_the_given_one(fake) -> None:
    values = [[1.0, 3.0], [2.0, 2.0], [3.0, 1.0]]
    record = fake(values, {10: values}, reference_point=[0.0, 1.0])
    assert only_run(only(compare([record]))).hypervolume == 1 * 2 + 1 * 1
    task = only(compare([record], [1.0, 0.0]))
    assert only_run(task).hypervolume == 2 * 1 + 1 * 1
    np.testing.assert_array_equal(task.reference_point, [1, 0])
    np.testing.assert_array_equal(only_run(task).curve, [3])
    assert task.floors["standing still"] == pytest.approx((0.0, 1.0, STILL_DISTANCE))


def test_reference_points_that_differ_are_an_error(fake) -> None:
    differing = [fake(FRONT), fake(FRONT, reference_point=[1.0, 0.0])]
    with pytest.raises(ValueError, match="--reference-point") as error:
        compare(differing)
    assert re.search(r"\(1\.0, 0\.0\)|\[1\.0, 0\.0\]", str(error.value)), error.value
    assert len(only(compare(differing, [0.0, 0.0])).methods["a"]) == 2
    assert len(compare([differing[0], fake(FRONT, env="F", reference_point=[1.0, 0.0])])) == 2


@pytest.mark.parametrize("point", [[0.0], [0.0, 0.0, 0.0]], ids=str)
def test_a_reference_point_of_another_length_is_an_error(fake, point: list[float]) -> None:
    record = fake(FRONT)
    with pytest.raises(ValueError, match="2 objectives") as error:
        compare([record], point)
    for part in (str(point), str(record.path), "report tasks of other numbers of objectives apart."):
        assert part in str(error.value)


def test_tasks_of_different_numbers_of_objectives_are_an_error(fake) -> None:
    three = {"reference_point": [0.0] * 3, "preferences": [[1.0, 0.0, 0.0]], "floors": {}}
    with pytest.raises(ValueError, match="E"):
        compare([fake(FRONT), fake([[1.0, 1.0, 1.0]], **three)])


@pytest.mark.parametrize(
    "other",
    [
        {"preferences": [[0.0, 1.0], [0.4, 0.6], [1.0, 0.0]]},
        {"preferences": PREFERENCES[::-1]},
        {"preferences": PREFERENCES[:2], "values": FRONT[:2], "floors": {}},
        {"preferences": PREFERENCES[:2], "general_policy": False},
        {"settings": {"n_episodes": 2}},
        {"preferences": PREFERENCES[:2], "values": None, "error": "cut off", "floors": {}},
    ],
    ids=["other numbers", "another order", "fewer", "fewer, of a set", "other episodes", "of a run without an end"],
)
def test_records_of_one_task_that_were_evaluated_differently_are_an_error(fake, other: dict[str, Any]) -> None:
    """Hypervolume and expected utility grow with preferences and episodes."""
    same = {"settings": {"n_episodes": 5}}
    made = [fake(FRONT, **same), fake(FRONT, **same, seed=1), fake(**{"values": FRONT, "label": "b", **same, **other})]
    assert len(compare(made[:2])) == 1
    with pytest.raises(ValueError, match="report them apart") as error:
        compare(made)
    for record in (made[0], made[2]):
        assert str(record.path) in str(error.value)
    elsewhere = fake(**{"values": FRONT, "env": "F", **same, **other})
    assert len(compare([*made[:2], elsewhere])) == 2


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


def test_a_front_of_one_point_has_no_distances(fake) -> None:
    """It has no range that could become [0, 1]."""
    made = [fake([[2.0, 2.0]] * 3, label="a"), fake([[1.0, 2.0]] * 3, label="b"), fake(None, error=BAD, label="c")]
    task = only(compare(made))
    np.testing.assert_array_equal(task.reference_front, [[2, 2]])
    assert np.isnan([runs[0].inverted_generational_distance for runs in task.methods.values()]).all()
    assert np.isnan([distance for _, _, distance in task.floors.values()]).all()
    assert task.methods["c"][0].expected_utility == 0.5


def test_without_a_final_front_there_are_no_distances(fake) -> None:
    task = only(compare([fake(None, {10: FRONT}, BAD), fake(None, error="cut off", seed=1)]))
    assert task.reference_front.shape == (0, 2)
    assert np.isnan([run.inverted_generational_distance for run in task.methods["a"]]).all()
    assert np.isnan([distance for _, _, distance in task.floors.values()]).all()


def test_a_front_that_is_flat_on_one_axis_is_no_error(fake, tmp_path) -> None:
    """Three objectives of which one is the same for all solutions of the front."""
    shape = {"reference_point": [0.0] * 3, "preferences": np.eye(3), "floors": {"standing still": np.full((3, 3), 0.5)}}
    made = [fake([[1.0, 3.0, 2.0], [2.0, 2.0, 2.0], [3.0, 1.0, 2.0]], **shape), fake(np.ones((3, 3)), label="b", **shape)]
    task = only(compare(made))
    np.testing.assert_array_equal(task.reference_front, [[1, 3, 2], [2, 2, 2], [3, 1, 2]])
    distances = [runs[0].inverted_generational_distance for runs in task.methods.values()]
    assert not np.isinf(distances).any()
    assert distances[0] == 0 or np.isnan(distances[0])
    report_of(tmp_path / "report", made)


def test_the_reference_front_does_not_depend_on_the_preferences(fake) -> None:
    """A solution that is best only for a preference that nobody asked for belongs to it."""
    values = [[0.0, 4.0], [2.5, 2.5], [4.0, 0.0]]
    expected = convex_envelope(values)
    np.testing.assert_array_equal(expected, values)
    for preferences in ([[0.0, 1.0], [0.1, 0.9], [1.0, 0.0]], PREFERENCES, [[1.0, 0.0]] * 3):
        task = only(compare([fake(values, preferences=preferences, floors={})]))
        np.testing.assert_array_equal(task.reference_front, expected)


def test_what_no_preference_likes_best_is_not_in_the_reference_front(fake) -> None:
    """Of all methods; what was measured before the end does not count."""
    made = [
        fake([[0.0, 4.0], [1.0, 2.0], [2.0, 1.9]], {10: [[9.0, 9.0]] * 3}, label="a"),
        fake([[4.0, 0.0], [3.0, 2.0], [0.0, 4.0]], label="b"),
        fake(None, {10: [[9.0, 9.0]] * 3}, BAD, label="c"),
    ]
    np.testing.assert_array_equal(only(compare(made)).reference_front, [[0, 4], [3, 2], [4, 0]])


@pytest.mark.parametrize("general_policy", [True, False])
def test_what_reads_can_be_compared(fake, general_policy: bool) -> None:
    """Damaged numbers that pass as a record give results or a ValueError, never another exception."""
    record = fake(FRONT, {10: box(2.0), 20: FRONT}, general_policy=general_policy)
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


# ----------------------------------------------------------------------------------------------------- convex envelope


ENVELOPES = {
    "one point": ([[2.0, 3.0]], [0]),
    "one point twice": ([[2.0, 3.0]] * 2, [0]),
    "a dominated point": ([[1.0, 1.0], [2.0, 2.0]], [1]),
    "beyond the line of its neighbours": ([[0.0, 1.0], [0.6, 0.6], [1.0, 0.0]], [0, 1, 2]),
    "on the line of its neighbours": ([[0.0, 1.0], [0.5, 0.5], [1.0, 0.0]], [0, 1, 2]),
    "short of the line of its neighbours": ([[0.0, 1.0], [0.4, 0.5], [1.0, 0.0]], [0, 2]),
    "just short of it": ([[0.0, 1.0], [0.5, 0.4999999], [1.0, 0.0]], [0, 2]),
    "objectives of different units": ([[0.0, 1e-6], [4e5, 5e-7], [6e5, 6e-7], [1e6, 0.0]], [0, 2, 3]),
    "objectives of tiny units": ([[0.0, 1e-10], [4e-11, 5e-11], [1e-10, 0.0]], [0, 2]),
    "below 0": ([[-5.0, -1.0], [-4.0, -4.0], [-2.0, -2.0], [-1.0, -5.0]], [0, 2, 3]),
    "a tie of one objective": ([[0.0, 1.0], [0.5, 1.0], [1.0, 0.0], [1.0, -1.0]], [1, 2]),
    "a tie of one objective, of few points": ([[1.0, 1.0], [1.0, 0.0]], [0]),
    "one objective": ([[1.0], [3.0], [2.0], [3.0]], [1]),
    "the corners of a simplex": (np.eye(3), [0, 1, 2]),
    "beyond the plane of its neighbours": ([*np.eye(3), [0.34, 0.34, 0.34]], [0, 1, 2, 3]),
    "on the plane of its neighbours": ([*np.eye(3), [0.25, 0.25, 0.5]], [0, 1, 2, 3]),
    "short of the plane of its neighbours": ([*np.eye(3), [0.3, 0.3, 0.3]], [0, 1, 2]),
    "best only where the third objective counts nothing": ([*np.eye(3), [0.6, 0.6, -5.0]], [0, 1, 2, 3]),
    "best nowhere, with a third objective that is low": ([*np.eye(3), [0.4, 0.4, -5.0]], [0, 1, 2]),
    "best only for the third objective, with others": ([[2.0, 0.0, 1.0], [0.0, 2.0, 1.0], [0.5, 0.5, 1.0]], [0, 1, 2]),
    "best for the third objective, but dominated": ([[2.0, 0.0, 1.0], [0.0, 2.0, 1.0], [0.0, 0.5, 1.0]], [0, 1]),
    "one that is flat": ([[0.0, 1.0, 7.0], [0.6, 0.6, 7.0], [1.0, 0.0, 7.0], [0.4, 0.4, 7.0]], [0, 1, 2]),
    "a dominated one that ties with the best": ([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [0.0, 0.0, 2.0]], [2, 3]),
}


@pytest.mark.parametrize(("values", "best"), ENVELOPES.values(), ids=ENVELOPES)
def test_convex_envelopes_by_hand(values: Any, best: list[int]) -> None:
    """Whatever the order, and however often each one is there."""
    values = np.asarray(values, dtype=np.float64)
    expected = np.unique(values[best], axis=0)
    for given in (values, values[::-1], np.repeat(values, 2, axis=0)):
        np.testing.assert_array_equal(convex_envelope(given), expected)


def upper_vertices(points: np.ndarray) -> np.ndarray:
    """Corners of the hull between the best of the one objective and the best of the other, (n, 2)."""
    hull = ConvexHull(points)
    upper = hull.simplices[(hull.equations[:, :2] >= 0).all(axis=1)]
    corners = {*upper.ravel().tolist(), *points.argmax(axis=0).tolist()}
    return np.unique(points[sorted(corners)], axis=0)


@pytest.mark.parametrize("seed", range(20))
def test_convex_envelopes_of_random_points_are_the_upper_vertices_of_their_hull(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 60))
    angles = rng.uniform(0, np.pi / 2, n)
    arc = np.stack([np.cos(angles), np.sin(angles)], axis=1) * rng.choice([1.0, 0.99, 0.5], (n, 1))
    for points in (rng.normal(size=(n, 2)), rng.uniform(size=(n, 2)), arc):
        for units in ([1.0, 1.0], [1e-3, 1e4]):
            np.testing.assert_array_equal(convex_envelope(points * units), upper_vertices(points * units))


def upper_chain(points: np.ndarray) -> np.ndarray:
    """Non-dominated points above which no line between two others runs, in exact arithmetic, (n, 2)."""
    exact = sorted({(Fraction(x), Fraction(y)) for x, y in points.tolist()})
    best = [(x, y) for i, (x, y) in enumerate(exact) if all(y > other for _, other in exact[i + 1 :])]
    chain: list[tuple[Fraction, Fraction]] = []
    for x, y in best:
        while len(chain) > 1:
            (ax, ay), (bx, by) = chain[-2:]
            if (bx - ax) * (y - ay) <= (by - ay) * (x - ax):
                break
            chain.pop()
        chain.append((x, y))
    return np.array(chain, dtype=np.float64)


@pytest.mark.parametrize("seed", range(20))
def test_convex_envelopes_of_points_with_many_ties(seed: int) -> None:
    """Integers, which lie on lines and in rows: on a line all belong to it, of a row only the best."""
    rng = np.random.default_rng(seed)
    points = rng.integers(0, rng.integers(2, 12), (int(rng.integers(1, 60)), 2)).astype(np.float64)
    np.testing.assert_array_equal(convex_envelope(points), upper_chain(points))


@pytest.mark.parametrize("n_objectives", [2, 3, 4])
@pytest.mark.parametrize("kind", ["normal", "integers"])
def test_convex_envelopes_hold_what_each_preference_likes_best(n_objectives: int, kind: str) -> None:
    """With only non-dominated points, each one once."""
    rng = np.random.default_rng(n_objectives)
    shape = (40, n_objectives)
    points = rng.normal(size=shape) if kind == "normal" else rng.integers(0, 4, shape).astype(np.float64)
    envelope = convex_envelope(points)
    assert {tuple(v) for v in envelope.tolist()} <= {tuple(v) for v in points.tolist()}
    assert non_dominated(envelope).all()
    others_are_better = (points[None] >= envelope[:, None]).all(axis=2) & (points[None] > envelope[:, None]).any(axis=2)
    assert not others_are_better.any()
    preferences = rng.dirichlet(np.full(n_objectives, 0.5), 3_000)
    np.testing.assert_allclose((envelope @ preferences.T).max(axis=0), (points @ preferences.T).max(axis=0), atol=1e-12)


@pytest.mark.parametrize("n_objectives", [2, 3, 4])
def test_convex_envelopes_of_random_points_are_the_corners_of_what_they_dominate(n_objectives: int) -> None:
    """Of the points and their shadows, of which some coordinates are lower than any point's."""
    rng = np.random.default_rng(n_objectives)
    for _ in range(3):
        points = rng.normal(size=(30, n_objectives))
        shadows = [np.where(low, points.min() - 1, points) for low in np.ndindex((2,) * n_objectives)]
        dominated = np.concatenate(shadows)
        corners = ConvexHull(dominated).vertices
        expected = np.unique(dominated[corners[corners < len(points)]], axis=0)
        np.testing.assert_array_equal(convex_envelope(points), expected)


def test_all_points_of_a_plane_are_in_its_envelope() -> None:
    """66 points that tie, in units that no binary number holds exactly."""
    grid = np.array([(a, b, 10 - a - b) for a in range(11) for b in range(11 - a)]) * [1 / 3, 7.7, 1234.5]
    assert len(convex_envelope(grid)) == 66
    assert len(convex_envelope(np.concatenate([grid, 0.999 * grid - 0.001]))) == 66


@pytest.mark.parametrize("values", [np.zeros((0, 2)), [1.0, 2.0], [[1.0, np.nan]], [[np.inf, 1.0]]], ids=str)
def test_what_has_no_convex_envelope_is_an_error(values: Any) -> None:
    with pytest.raises(ValueError, match="values"):
        convex_envelope(values)


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


def test_a_run_that_failed_early_has_nothing_for_the_rest(fake) -> None:
    """Two volumes of 10, one of them lost after a tenth of the time; and after a tenth of the steps, where no run went on."""
    curve = {100: box(10.0), 1000: box(10.0)}
    whole = fake(box(10.0), curve, settings={"steps": 1000})
    early = [fake(None, {100: box(10.0)}, BAD, settings={"steps": 1000}, label="b", seed=seed) for seed in range(2)]
    methods = only(compare([whole, *early])).methods
    assert [run.mean_over_time for run in methods["a"]] == pytest.approx([0.1 * (1 + 10) / 2 + 9])
    assert [run.mean_over_time for run in methods["b"]] == pytest.approx([0.1 * (1 + 10) / 2] * 2)
    assert [run.mean_over_steps for run in methods["b"]] == pytest.approx([0, 0], abs=0.01)


def test_who_evaluates_rarely_gains_nothing_over_time(fake) -> None:
    """From standing still, 1, both rise by one a second."""
    made = [fake(box(3.0), {10: box(2.0), 20: box(3.0)}), fake(box(3.0), {20: box(3.0)}, label="b")]
    often, rarely = (runs[0] for runs in only(compare(made)).methods.values())
    assert (often.mean_over_time, rarely.mean_over_time) == (2, 2)


def long(**changed: Any) -> dict[str, Any]:
    """Settings of a run of 30 steps."""
    return {"steps": 30, "hyperparameters": {"learning_rate": 1e-4, **changed}}


def test_a_longer_run_counts_as_it_stood_at_the_common_step(fake) -> None:
    """Beside one that was asked for 20 steps it is scored, drawn and named as one of 20, its own later steps forgotten."""
    short = fake(box(4.0), {10: box(2.0), 20: box(4.0)}, settings={**long(), "steps": 20})
    whole = fake(box(9.0), {10: box(3.0), 20: box(5.0), 30: box(9.0)}, settings=long(), seed=1)
    runs = only(compare(cut_at(record, 20) for record in (short, whole))).methods["a"]
    assert [run.hypervolume for run in runs] == [4, 5]
    assert [run.mean_over_steps for run in runs] == [3, 4]
    assert all(run.record.config["steps"] == 20 and run.steps[-1] == 20 for run in runs)
    assert cut_at(short, 20) is short


def test_how_often_a_run_was_evaluated_makes_no_other_method(fake) -> None:
    often = fake(box(4.0), {10: box(2.0), 20: box(4.0)}, settings={**long(), "steps": 20, "eval_freq": 10})
    rarely = fake(box(9.0), {20: box(6.0), 40: box(9.0)}, settings={**long(), "steps": 40, "eval_freq": 20}, seed=1)
    runs = only(compare(cut_at(record, 20) for record in (often, rarely))).methods["a"]
    assert [run.hypervolume for run in runs] == [4, 6]


def test_a_run_that_failed_later_had_finished_its_first_steps(fake) -> None:
    curve = {10: box(2.0), 20: box(4.0)}
    failed = fake(None, curve, BAD, settings=long())
    assert (cut_at(failed, 20).error, cut_at(failed, 20).traceback) == (None, "")
    np.testing.assert_array_equal(cut_at(failed, 20).final_values, box(4.0))
    before = cut_at(failed, 25)
    assert before.error == failed.error
    assert before.final_values is None


@pytest.mark.parametrize(
    ("settings", "general_policy", "message"),
    [
        (long(), True, "cannot be cut at 15 steps, leave it out: it was evaluated at 10, 20"),
        (long(learning_rate="lin_3e-4_0"), True, "its learning rate, lin_3e-4_0, depends on how many it was asked for, 30"),
        (long(learning_rate={"class": "LinearSchedule", "start": 3e-4}), True, "its learning rate, .*, depends on how many"),
        (long(), False, "what it trains depends on how many it was asked for, 30"),
    ],
)
def test_runs_that_cannot_be_cut_are_named(fake, settings: dict[str, Any], general_policy: bool, message: str) -> None:
    record = fake(FRONT, {10: FRONT, 20: FRONT}, settings=settings, general_policy=general_policy)
    with pytest.raises(ValueError, match=f"{re.escape(str(record.path))}.*{message}"):
        cut_at(record, 15)


def test_a_report_at_equal_steps(fake, tmp_path, capsys) -> None:
    """It says which runs were longer, and whether they failed after that."""
    curve = {10: box(3.0), 20: box(5.0), 30: box(9.0)}
    records = [fake(box(9.0), curve, settings=long()), fake(None, curve, BAD, settings=long(), seed=1)]
    main(["report", *(str(record.path) for record in records), "--steps", "2e1", "--output", str(tmp_path / "cut")])
    lines = capsys.readouterr().out.splitlines()
    (row,) = [line.split("|")[1:6] for line in lines if line.startswith("| a ")]
    assert [cell.strip() for cell in row] == ["a", "2/2", "20", "210", "5"]
    assert "- Runs of 30 steps, as they stood at 20: 2" in lines
    assert "- Did not finish after that: 1" in lines


@pytest.mark.parametrize(
    ("steps", "message"),
    [("0", "--steps 0: give at least one"), ("abc", "'abc' is no whole number"), ("1.5", "'1.5' is no whole")],
)
def test_bad_steps_are_named(fake, tmp_path, capsys, steps: str, message: str) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["report", str(fake(FRONT).path), "--steps", steps, "--output", str(tmp_path / "cut")])
    assert message in f"{stop.value.code} {capsys.readouterr().err}"
    assert not (tmp_path / "cut").exists()


def test_a_curve_that_stops_short_of_a_common_step_ends_there(fake) -> None:
    """Evaluated last at 25 of 30 steps."""
    runs = curves_of(fake, ({10: 2, 20: 4, 30: 6}, True), ({15: 3, 25: 5}, False))
    steps, curves = curve_on(runs)
    np.testing.assert_array_equal(steps, [20, 30])
    np.testing.assert_allclose(curves, [[4, 6], [4, 0]])


def test_who_is_evaluated_late_is_not_credited_before_with_what_it_had_learned_then(fake) -> None:
    often = {10: 1, 20: 2, 30: 3, 40: 4}
    runs = curves_of(fake, (often, True), ({20: 4, 40: 6}, True))
    steps, curves = curve_on(runs)
    np.testing.assert_array_equal(steps, [20, 30, 40])
    np.testing.assert_allclose(curves, [[2, 3, 4], [4, 5, 6]])
    np.testing.assert_allclose(areas_under_curve(runs), [3, 5])
    assert np.isnan(areas_under_curve(curves_of(fake, (often, True), ({40: 4}, True)))).all()


def test_one_clock_for_all_runs_of_a_task(fake) -> None:
    """Processor time where all have it, the wall's where one lacks it."""

    def with_processor_time(record: Record) -> Record:
        text = record.path.read_text().replace('"seconds": ', '"cpu_seconds": 0.5, "seconds": ')
        record.path.write_text(text)
        return read_record(record.path)

    first, second = (fake(FRONT, {10: FRONT, 20: FRONT}, seed=seed) for seed in range(2))
    first = with_processor_time(first)
    task = only(compare([first, second]))
    assert (task.clock, task.seconds) == ("seconds", 2)
    task = only(compare([first, with_processor_time(second)]))
    assert (task.clock, task.seconds) == ("cpu_seconds", 0.5)


def test_curves_of_runs_that_all_failed(fake) -> None:
    runs = curves_of(fake, ({}, False), ({}, False))
    steps, curves = curve_on(runs)
    assert (steps.shape, curves.shape) == ((0,), (2, 0))
    areas = areas_under_curve(runs)
    assert len(areas) == 2
    assert np.isnan(areas).all()


def test_one_evaluation_makes_no_area(fake) -> None:
    with np.errstate(all="raise"):
        areas = areas_under_curve(curves_of(fake, ({10: 3}, True), ({10: 5}, False), ({}, False)))
    assert len(areas) == 3
    assert np.isnan(areas).all()


def test_an_area_begins_at_the_first_evaluation(fake) -> None:
    """Of the method, in units of its hypervolume: whose volume is constant has it as its mean."""
    runs = curves_of(fake, ({10: 3, 40: 3}, True), ({10: 1, 20: 2, 40: 8}, True))
    np.testing.assert_allclose(areas_under_curve(runs), [3, (15 + 100) / 30])


def test_areas_of_a_task_begin_where_all_methods_have_been_evaluated(fake) -> None:
    """At 20: the poor beginning of whom is evaluated often, 0 until then, counts no more than that of the other."""
    made = [fake(box(4.0), {10: box(0.0), 30: box(4.0), 40: box(4.0)}), fake(box(4.0), {20: box(2.0), 40: box(4.0)}, label="b")]
    made.append(fake(box(4.0), {40: box(4.0)}, label="once"))
    often, rarely, once = (runs[0].mean_over_steps for runs in only(compare(made)).methods.values())
    assert (often, rarely) == (3.5, 3)
    assert np.isnan(once)


@pytest.mark.parametrize(("steps", "said"), [(10_000, True), (9_990, False)])
def test_unequal_budgets_are_said(fake, tmp_path, steps: int, said: bool) -> None:
    made = [fake(box(4.0), {5_000: box(1.0), steps: box(4.0)}), fake(box(4.0), {5_000: box(1.0), 9_900: box(4.0)}, label="b")]
    text = write_report(compare(made), made, tmp_path)
    assert ("Methods had unequal numbers of steps on" in text) is said


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


@pytest.mark.parametrize(
    ("estimate", "text"),
    [
        (Estimate(1.0, 1.0, 1.0), "1"),
        (Estimate(0.0, 0.0, 0.0), "0"),
        (Estimate(12345.678, 12345.678, 12345.678), "1.235e+04"),
        (Estimate(1.0, 0.5, 2.0), "1 [0.5, 2]"),
        (Estimate(-1.0, -1.0, 0.25), "-1 [-1, 0.25]"),
        (Estimate(1234.0, 1000.0, 1234.0), "1,234 [1,000, 1,234]"),
    ],
    ids=str,
)
def test_an_interval_is_printed_where_it_has_width(estimate: Estimate, text: str) -> None:
    assert as_text(estimate) == text


def report_of(folder: Path, made: Sequence[Record], baseline: str | None = None) -> str:
    """The report's text, whose pictures all exist and whose tables are whole."""
    text = write_report(compare(made), made, folder, baseline)
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
    assert row[4:] == ["6", "2.667", "0", "0", "4", "2.75"]  # Equal runs have no interval.
    assert rows_of(text, "a")[0][1:3] == ["1/3", "20"]
    cells = rows_of(text, "a")[0][4:]
    scores = [1 / 3, (1 + 0.5 + 0.5) / 3, 0, (STILL_DISTANCE + 2 * RANDOM_DISTANCE) / 3]
    curve_means = [(1 + 0.5 + 0) / 3] * 2
    assert [float(cell.split()[0]) for cell in cells] == pytest.approx([*scores, *curve_means], rel=1e-3)
    assert ["[" in cell for cell in cells] == [True, True, False, True, True, True]  # The regret is of one run.
    assert rows_of(text, r"(standing still)")[0][4:] == ["1", "1", "", f"{STILL_DISTANCE:.4g}", "", ""]
    assert rows_of(text, r"(random actions)")[0][4:] == ["0.25", "0.5", "", f"{RANDOM_DISTANCE:.4g}", "", ""]
    assert rows_of(text, "b")[1][1] == "1 (1 tasks)"  # P(b > a)
    assert rows_of(text, "a")[1][2] == "0 (1 tasks)"
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


@pytest.mark.filterwarnings("error::UserWarning")
def test_names_with_many_settings_are_below_the_axes(fake, tmp_path) -> None:
    curve = {10: box(1.0), 20: FRONT}
    settings = [{f"setting_{i}": i + j for i in range(12)} for j in range(3)]
    report_of(tmp_path / "report", [fake(FRONT, curve, settings=hyperparameters(**one)) for one in settings])
    for path in (tmp_path / "report").glob("*.png"):
        height, width, _ = matplotlib.image.imread(path).shape
        assert width == 900
        assert height > 675 + 3 * 60  # The canvas has grown by three names of three lines or more.


def test_a_report_of_one_evaluation(fake, tmp_path) -> None:
    text = report_of(tmp_path / "report", [fake(FRONT, {10: FRONT}, floors={})])
    assert rows_of(text, "a")[0][1:3] == ["1/1", "10"]
    assert rows_of(text, "a")[0][4:] == [
        "6",
        "2.667",
        "0",
        "0",
        "",
        "3",
    ]  # One evaluation has no mean over steps, and over time begins at 0.
    assert "improvement" not in text
    assert "## Aggregate" not in text


def test_a_report_of_sets_of_solutions(fake, tmp_path) -> None:
    """Their regret is unknown, beside that of a general policy."""
    curve = {10: box(1.0), 20: FRONT}
    made = [fake(FRONT, curve), fake([*FRONT, *box(1.0)], {10: [[1.0, 1.0]], 20: FRONT}, label="b", general_policy=False)]
    text = report_of(tmp_path / "report", made)
    assert rows_of(text, "a")[0][4:] == ["6", "2.667", "0", "0", "3.5", "2.25"]
    assert rows_of(text, "b")[0][4:] == ["6", "2.667", "", "0", "3.5", "2.25"]
    assert len(list((tmp_path / "report").glob("*.png"))) == 2


def test_a_report_of_one_solution_has_no_distances(fake, tmp_path) -> None:
    text = report_of(tmp_path / "report", [fake(box(2.0)), fake(None, error=BAD, seed=1)])
    for name in ("a", "(standing still)", "(random actions)"):
        assert rows_of(text, name)[0][7] == ""


def test_a_report_without_floors_leaves_blank_what_is_unknown_of_a_run_that_failed(fake, tmp_path) -> None:
    made = [fake(FRONT, floors={}), fake(None, error=BAD, floors={}, seed=1), fake(None, error=BAD, floors={}, label="b")]
    text = report_of(tmp_path / "report", made)
    hypervolume, *others = rows_of(text, "a")[0][4:]
    assert hypervolume.startswith("3 [0, 6]")
    assert others == ["2.667", "0", "0", "", ""]  # The regret is that of the run that is known.
    assert rows_of(text, "b")[0][4:] == ["0", "2.667", "", "0", "", ""]
    text = report_of(tmp_path / "nothing", [fake(None, error=BAD, floors={}, label="b")])
    assert rows_of(text, "b")[0][4:] == ["0", "", "", "", "", ""]


def test_a_report_says_where_hypervolumes_compare_nothing(fake, tmp_path) -> None:
    made = [fake([[-1.0, -x]] * 3, label=label, env=env) for env in "EF" for label, x in (("good", 1), ("bad", 9))]
    made += [fake(box(x), label=label, env="G") for label, x in (("good", 9.0), ("bad", 1.0))]
    text = report_of(tmp_path / "report", made)
    assert text.count("**Nothing lies above the reference point") == 2
    assert rows_of(text, "good")[-1] == ["good", "1 (1 tasks)", ""]


def test_a_report_names_settings_that_are_not_the_same_on_all_tasks(fake, tmp_path) -> None:
    settings = {"hyperparameters": {**CONFIG["hyperparameters"], "gamma": 0.9}}
    made = [fake(FRONT), fake(FRONT, env="F", settings=settings), fake(FRONT, label="b"), fake(FRONT, label="b", env="F")]
    text = report_of(tmp_path / "report", made, "b")
    assert text.count(" Not on all tasks with the same settings: a (gamma).") == 2


def test_a_report_names_what_a_resumed_run_went_on_with(fake, tmp_path) -> None:
    record = fake(FRONT, error="cut off")
    lines = record.path.read_text().splitlines(keepends=True)
    went_on = {
        "event": "resumed",
        "steps": 0,
        "versions": {"torch": "9"},
        "machine": {"cores": 64},
        "git_revision": "abc-dirty",
    }
    record.path.write_text("".join([*lines[:-1], json.dumps(went_on) + "\n", lines[-1]]))
    text = report_of(tmp_path / "report", [read_record(record.path)])
    assert "- Versions: torch 9\n" in text
    assert "- Machine: cores 64\n" in text
    assert "- Git revision: abc-dirty\n" in text


@pytest.mark.parametrize("curve", [{}, {10: box(1.0), 20: box(2.0)}], ids=["never evaluated", "evaluated"])
def test_a_report_of_runs_that_all_failed(fake, tmp_path, curve: dict[int, Any]) -> None:
    made = [fake(None, curve, error, label=label, floors={}) for label in "ab" for error in (BAD, "cut off")]
    text = report_of(tmp_path / "report", made)
    assert rows_of(text, "a")[0][1] == rows_of(text, "b")[0][1] == "0/2"
    *_, over_steps, over_time = rows_of(text, "a")[0]
    assert over_steps.startswith("1.5") if curve else over_steps == ""
    assert over_time == ""  # There is no time that every finished run had.
    assert text.count("diverged") == 2
    assert text.count(UNENDED) == 2


def test_a_report_of_tasks_that_share_one_method(fake, tmp_path) -> None:
    made = [fake(FRONT, env="E"), fake(box(1.0), env="F", label="b"), fake(FRONT, env="F")]
    text = report_of(tmp_path / "report", made)
    assert text.index("## E") < text.index("## F")
    assert rows_of(text, "b")[1][1] == "0 (1 tasks)"


def test_runs_without_an_end_are_counted_before_anything_else(fake, tmp_path) -> None:
    made = [fake(FRONT), fake(None, error="cut off", seed=1), fake(None, error=BAD, seed=2), fake(None, env="F")]
    text = report_of(tmp_path / "report", made)
    assert "**2 runs have no end" in text.split("## ")[0]
    assert "have no end" not in report_of(tmp_path / "other", [made[0], made[2]])


def test_seeds_that_other_methods_have_are_named(fake, tmp_path) -> None:
    """Their runs may have died before they could begin a record. On each task for itself; a run that failed is there."""
    made = [fake(FRONT, seed=seed) for seed in (0, 1, 2)]
    made += [fake(None, error=BAD, label="b", seed=1), fake(FRONT, label="c", seed=3)]
    made += [fake(FRONT, env="F", label=label, seed=7) for label in "ab"]
    text = report_of(tmp_path / "report", made)
    missing = [line for line in text.splitlines() if line.startswith("Not recorded")]
    expected = ["a, seed 3", "b, seed 0", "b, seed 2", "b, seed 3", "c, seed 0", "c, seed 1", "c, seed 2"]
    assert missing == [f"Not recorded: {run}." for run in expected]
    assert text.index("## E") < text.index(missing[0])
    assert text.index(missing[-1]) < text.index("## F")
    assert "Recorded more than once" not in text


def test_seeds_that_were_recorded_twice_are_named(fake, tmp_path) -> None:
    text = report_of(tmp_path / "report", [fake(FRONT), fake(FRONT), fake(FRONT, seed=1)])
    assert [line for line in text.splitlines() if "ecorded" in line] == ["Recorded more than once: a, seed 0."]


def test_extra_steps_have_a_column_where_there_are_some(fake, tmp_path) -> None:
    made = [fake(FRONT, {10: FRONT}), fake(FRONT, {10: FRONT}, label="b", extra_steps=3_000)]
    made += [fake(FRONT, {20: FRONT}, label="b", seed=1, extra_steps=4_000), fake(FRONT, {10: FRONT}, env="F")]
    text = report_of(tmp_path / "report", made)
    assert [row[:5] for row in rows_of(text, "a")[:2]] == [["a", "1/1", "10", "0", "210"], ["a", "1/1", "10", "210", "6"]]
    assert rows_of(text, "b")[0][:5] == ["b", "2/2", "20", "4,000", "210"]
    assert text.count("| extra steps |") == text.count("not among its steps") == 1


# ----------------------------------------------------------------------------------------------------------- aggregate


def aggregate_of(text: str) -> dict[str, list[str]]:
    """The cells of each method in the aggregate over tasks, without those of the curve."""
    after = text.split("## Aggregate\n")[1].split("\n## ")[0]
    table = [[cell.strip() for cell in line.split("|")[1:-1]] for line in after.splitlines() if line.startswith("|")]
    header, _, *rows = table
    assert header[:4] == ["method", "tasks", "normalised hypervolume", "normalised expected utility"]
    assert len({row[0] for row in rows}) == len(rows)
    return {name: cells[:3] for name, *cells in rows}


def value_of(cell: str) -> float:
    return float(cell.split()[0])


def test_the_aggregate_by_hand(fake, tmp_path) -> None:
    """A box of volume v has the expected utility (1 + v) / 2; the baseline's IQM is 3 and 2 on E, 10 and 5.5 on F."""
    made = [fake(box(volume), env="E", label="a", seed=seed) for seed, volume in enumerate([2.0, 4.0])]
    made += [fake(box(10.0), env="F", label="a")]
    made += [fake(box(volume), env="E", label="b", seed=seed) for seed, volume in enumerate([6.0, 9.0])]
    made += [fake(box(5.0), env="F", label="b", seed=seed) for seed in range(2)]
    made += [fake(box(5.0), env="F", label="c")]
    text = report_of(tmp_path / "report", made, "a")
    cells = aggregate_of(text)
    assert {name: row[0] for name, row in cells.items()} == {"a": "2", "b": "2", "c": "1"}
    # Of a: 2/3, 4/3 and 1, and 1.5/2, 2.5/2 and 1. Of b: 2, 3 and twice 1/2, of which the middle half is 1/2 and 2.
    assert [value_of(cell) for cell in cells["a"][1:]] == pytest.approx([1, 1], rel=1e-3)
    assert [value_of(cell) for cell in cells["b"][1:]] == pytest.approx([(0.5 + 2) / 2, (3 / 5.5 + 3.5 / 2) / 2], rel=1e-3)
    assert all("[" in cell for name in "ab" for cell in cells[name][1:])
    assert cells["c"][1:] == ["0.5", f"{3 / 5.5:.4g}"]
    assert "In units of the IQM of a on each task" in text
    assert text.index("## F") < text.index("## Aggregate")
    assert "## Aggregate" not in report_of(tmp_path / "other", made)


def test_curves_in_the_aggregate_by_hand(fake, tmp_path) -> None:
    """Evaluated after 1 and 2 s, and 1 and 4 s: over the common 2 s, from standing still, 1, on."""
    made = [fake(box(4.0), {10: box(2.0), 20: box(4.0)}), fake(box(4.0), {10: box(1.0), 40: box(7.0)}, label="b")]
    text = report_of(tmp_path / "report", made, "a")
    assert rows_of(text, "a")[0][-2:] == ["3", f"{(1.5 + 3) / 2:g}"]
    assert rows_of(text, "b")[0][-2:] == ["4", f"{(1 + (1 + 3) / 2) / 2:g}"]
    assert rows_of(text, "b")[-2][-2:] == [f"{4 / 3:.4g}", f"{1.5 / 2.25:.4g}"]
    assert "up to 2 s" in text


def test_the_baselines_unit_is_an_interquartile_mean(fake, tmp_path) -> None:
    """Of 100, 4, 2 and 0 the middle half has the mean 3."""
    made = [fake(box(volume), label="a", seed=seed) for seed, volume in enumerate([100.0, 4.0, 2.0])]
    made += [fake(None, error=BAD, label="a", seed=3), fake(box(6.0), label="b")]
    cells = aggregate_of(report_of(tmp_path / "report", made, "a"))
    assert cells["b"][1] == "2"
    assert value_of(cells["a"][1]) == 1


def test_tasks_without_the_baseline_are_not_in_the_aggregate(fake, tmp_path) -> None:
    made = [fake(box(2.0), label="a"), fake(box(4.0), label="b"), fake(box(99.0), env="F", label="b")]
    made += [fake(box(1.0), env="F", label="c")]
    cells = aggregate_of(report_of(tmp_path / "report", made, "a"))
    assert cells == {"a": ["1", "1", "1"], "b": ["1", "2", f"{2.5 / 1.5:.4g}"], "c": ["0", "", ""]}


def test_what_is_unknown_or_has_no_unit_is_blank_in_the_aggregate(fake, tmp_path) -> None:
    made = [fake(box(2.0), label="a", floors={}), fake(None, error=BAD, label="b", floors={})]
    assert aggregate_of(report_of(tmp_path / "report", made, "a")) == {"a": ["1", "1", "1"], "b": ["1", "0", "1"]}
    assert aggregate_of(report_of(tmp_path / "other", made, "b")) == {"a": ["1", "", "1"], "b": ["1", "", "1"]}


def test_a_baseline_that_nobody_has_is_an_error_that_names_who_is_there(fake, tmp_path) -> None:
    made = [fake(FRONT, label="momba"), fake(FRONT, env="F", label="capql")]
    with pytest.raises(ValueError, match="'capq'") as error:
        report_of(tmp_path / "report", made, "capq")
    assert "capql, momba" in str(error.value)
    assert not (tmp_path / "report" / "report.md").exists()


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
    assert rows_of(text, "a")[0][4] == "13"  # 2 x 4 + 1 x 3 + 1 x 2
    assert str(tmp_path / "new" / "place" / "report.md") in capsys.readouterr().out


def test_a_baseline_from_the_command_line(fake, tmp_path) -> None:
    fake(box(2.0), label="a")
    fake(box(4.0), label="b")
    main(["report", str(tmp_path / "records"), "--baseline", "a"])
    assert aggregate_of((tmp_path / "records" / "report.md").read_text())["b"][:2] == ["1", "2"]
    message = error_of("report", tmp_path / "records", "--baseline", "c")
    assert "'c'" in message
    assert "a, b" in message


@pytest.mark.parametrize("content", [b"", b'{"event": "start", "format": "sb3_mom'], ids=["empty", "torn"])
def test_a_record_that_was_cut_off_in_its_first_line_is_left_out(fake, tmp_path, capsys, content: bytes) -> None:
    torn = tmp_path / "records" / "torn" / "record.jsonl"
    torn.parent.mkdir(parents=True)
    torn.write_bytes(content)
    assert "first line" in error_of("report", tmp_path / "records")
    assert not (tmp_path / "records" / "report.md").exists()
    capsys.readouterr()
    fake(FRONT)
    main(["report", str(tmp_path / "records")])
    said = [line for line in capsys.readouterr().out.splitlines() if str(torn) in line]
    assert len(said) == 1
    assert "cut off in its first line" in said[0]
    text = (tmp_path / "records" / "report.md").read_text()
    assert rows_of(text, "a")[0][1] == "1/1"
    assert str(torn) not in text


def test_records_that_were_evaluated_differently_end_with_one_line_of_error(fake, tmp_path) -> None:
    made = [fake(FRONT, settings={"n_episodes": n}, seed=n) for n in (5, 2)]
    message = error_of("report", tmp_path / "records")
    assert all(str(record.path) in message for record in made)


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


def parsed(cell: Cell, folder: Path) -> runs.RunSettings:
    """What the training reads from a cell's arguments."""
    return train.parse(cell.arguments(folder))


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
        assert not settings.progress_bar


def test_what_the_grid_says_wins_over_options(tmp_path) -> None:
    """Each cell has the place, the task and the seed that its name says."""
    options = ["--env", "MO-Ant-v4", "--conf", "capql", "--steps", "3e4"]
    for cell in make_cells(["momba"], [ENV], 2, options):
        settings = parsed(cell, tmp_path)
        assert (settings.env, settings.seed, settings.output) == (ENV, cell.seed, str(tmp_path))
        assert (settings.label, settings.steps) == ("momba", 30_000)


@pytest.mark.parametrize("options", [["--seed", "7"], ["--seed=7"], ["--output", "/elsewhere"], ["--resume", "RUN"]])
def test_options_that_each_cell_has_of_its_own_are_refused(options: list[str]) -> None:
    with pytest.raises(ValueError, match=rf"{options[0].split('=')[0]} is the grid's own"):
        make_cells(["momba"], [ENV], 2, options)


def test_options_of_several_values_do_not_swallow_what_the_grid_says(tmp_path) -> None:
    options = ["--reference-point", "-1", "-2", "--objectives", "speed", "height"]
    settings = parsed(make_cells(["momba"], [ENV], 1, options)[0], tmp_path)
    assert (settings.reference_point, settings.objectives, settings.env) == ([-1, -2], ["speed", "height"], ENV)


def test_what_is_repeated_is_taken_once() -> None:
    once = make_cells(["momba", "capql"], [ENV, "MO-Ant-v4"], 2)
    assert make_cells(["momba", "capql", "momba"], [ENV, "MO-Ant-v4", ENV, ENV], 2) == once


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
    """Two files of one name, in two folders, are two configurations that would share one."""
    confs = []
    for gamma in (0.9, 0.99):
        path = tmp_path / str(gamma) / "mine.yml"
        path.parent.mkdir()
        path.write_text(f"default:\n  gamma: {gamma}\n")
        confs.append(str(path))
    with pytest.raises(ValueError, match="rename one of them") as error:
        make_cells(confs, [ENV], 1)
    assert all(conf in str(error.value) for conf in confs)
    cells = make_cells([confs[0], "momba"], [ENV, "MO-Ant-v4"], 2)
    assert len({cell.name for cell in cells}) == len(cells) == 8


@pytest.mark.parametrize("seeds", ["0", "-1"])
def test_a_grid_of_no_runs_is_an_error(tmp_path, seeds: str) -> None:
    with pytest.raises(ValueError, match=f"seeds={seeds}"):
        make_cells(["momba"], [ENV], int(seeds))
    assert f"seeds={seeds}" in error_of("run", "--conf", "momba", "--env", ENV, "--seeds", seeds, "--output", tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("processes", [0, -1])
def test_a_grid_without_processes_is_an_error(training, tmp_path, processes: int) -> None:
    fake_training = training()
    output = tmp_path / "grid"
    with pytest.raises(ValueError, match=f"processes={processes}"):
        run_grid(make_cells(["momba"], [ENV], 1), output, processes=processes)
    line = f"run --conf momba --env {ENV} --seeds 1 --output {output} --processes {processes}"
    assert f"processes={processes}" in error_of(*line.split())
    assert fake_training.seeds == []
    assert not output.exists()


UNKNOWN_ENVS = {
    "mo-hoper-2obj-v5": "Did you mean: `mo-hopper-2obj`",
    "MO-Hoper-v4": "Did you mean: `MO-Hopper`",
    "mo-hopper-2obj-v9": "`v5`",
    "mo_gymnasium:mo-hoper-2obj-v5": "Did you mean: `mo-hopper-2obj`",
}


@pytest.mark.parametrize(("env", "cure"), UNKNOWN_ENVS.items())
def test_an_environment_that_does_not_exist_is_refused_before_anything_runs(training, tmp_path, env: str, cure: str) -> None:
    fake_training = training()
    output = tmp_path / "grid"
    with pytest.raises(gym.error.Error, match=re.escape(cure)):
        run_grid(make_cells(["momba"], [ENV, env], 2), output)
    arguments = ["run", "--conf", "momba", "--env", ENV, env, "--seeds", "2", "--output", output]
    assert cure in error_of(*arguments)
    assert fake_training.seeds == []
    assert not output.exists()


def test_a_module_that_does_not_exist_is_one_line_of_error(training, tmp_path) -> None:
    fake_training = training()
    arguments = ["--seeds", "1", "--output", tmp_path / "grid"]
    assert "nowhere" in error_of("run", "--conf", "momba", "--env", f"nowhere:{ENV}", *arguments)
    assert fake_training.seeds == []


def test_an_environment_of_a_module_is_run(training, tmp_path) -> None:
    fake_training = training()
    main(f"run --conf momba --env mo_gymnasium:{ENV} --seeds 1 --output {tmp_path}".split())
    assert fake_training.seeds == [0]
    assert read_record(tmp_path / "momba" / f"mo_gymnasium:{ENV}" / "0" / "record.jsonl").error is None


@pytest.mark.parametrize("options", [["--stepz", "3"], ["--steps", "many"], ["--set"]], ids=" ".join)
def test_options_that_the_training_does_not_have_are_refused_before_anything_runs(
    training, tmp_path, capsys, options: list[str]
) -> None:
    fake_training = training()
    output = tmp_path / "grid"
    with pytest.raises(SystemExit) as stop:
        main(["run", "--conf", "momba", "--env", ENV, "--seeds", "2", "--output", str(output), *options])
    assert stop.value.code == 2
    assert options[0] in capsys.readouterr().err
    assert fake_training.seeds == []
    assert not output.exists()


def test_a_second_grid_on_the_same_folder_is_refused_while_one_runs(training, tmp_path, monkeypatch) -> None:
    first, second = (make_cells([conf], [ENV], 1) for conf in ("momba", "capql"))
    fake_training = training()
    refusals: list[str] = []

    def run_meanwhile(command: list[str], log: IO[bytes]) -> int:
        put_in_place(monkeypatch, fake_training)
        with pytest.raises(ValueError, match="Another process writes into") as error:
            run_grid(second, tmp_path / "grid")
        refusals.append(str(error.value))
        refusals.append(error_of("run", "--conf", "capql", "--env", ENV, "--seeds", "1", "--output", tmp_path / "grid"))
        assert len(run_grid(second, tmp_path / "other")) == 0
        return fake_training(command, log)

    put_in_place(monkeypatch, run_meanwhile)
    assert len(run_grid(first, tmp_path / "grid")) == 0
    assert len(refusals) == 2
    assert all(f"Another process writes into {tmp_path / 'grid'}" in refusal for refusal in refusals)
    assert not (tmp_path / "grid" / "capql").exists()
    assert len(run_grid(second, tmp_path / "grid")) == 0
    assert len(fake_training.seeds) == 3


def test_a_grid_that_was_killed_does_not_bar_the_next_one(training, tmp_path) -> None:
    """Nor one that ended with an error."""
    cells = make_cells(["momba"], [ENV], 1)
    training()
    with pytest.raises(RuntimeError, match="diverged"), alone_in(tmp_path):
        raise BAD
    code = "import fcntl, sys; f = open(sys.argv[1], 'w'); fcntl.flock(f, fcntl.LOCK_EX); print('locked', flush=True); input()"
    command = [sys.executable, "-c", code, str(tmp_path / ".lock")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        with pytest.raises(ValueError, match="Another process writes into"):
            run_grid(cells, tmp_path)
        other.kill()
    assert len(run_grid(cells, tmp_path)) == 0


class FakeTraining:
    """In the place of Trainings.run: writes the record that a training would, as `outcome` says for each seed."""

    def __init__(self, outcome: dict[int, str] | None = None):
        self.outcome = outcome or {}
        self.seeds: list[int] = []

    def __call__(self, command: list[str], log: IO[bytes]) -> int:
        assert command[:3] == [sys.executable, "-m", "sb3_momba.train"]
        settings = train.parse(command[3:])
        self.seeds.append(settings.seed)
        folder = Path(settings.output)
        runs.check_empty(folder)  # A training refuses others.
        outcome = self.outcome.get(settings.seed, "finishes")
        log.write(outcome.encode())
        if outcome in ("does not start", "is interrupted"):
            return 1 if outcome == "does not start" else 130
        error = {"fails": BAD, "is cut off": "cut off"}.get(outcome)
        config = runs.recorded_settings(settings)
        write_record(
            folder / "record.jsonl", FRONT if error is None else None, error=error, seed=settings.seed, settings=config
        )
        (folder / "model.zip").touch()
        return int(error is not None)


def put_in_place(monkeypatch: pytest.MonkeyPatch, training: Callable[[list[str], IO[bytes]], int]) -> None:
    monkeypatch.setattr(local.Trainings, "run", lambda trainings, command, log: training(command, log))


@pytest.fixture
def training(monkeypatch) -> Callable[..., FakeTraining]:
    def replace(outcome: dict[int, str] | None = None) -> FakeTraining:
        fake_training = FakeTraining(outcome)
        put_in_place(monkeypatch, fake_training)
        return fake_training

    return replace


def test_what_ended_is_not_run_again_and_what_was_cut_off_is(training, tmp_path) -> None:
    cells = make_cells(["momba"], [ENV], 4)
    first = training({1: "fails", 2: "is cut off", 3: "does not start"})
    assert len(run_grid(cells, tmp_path, processes=1)) == 3
    assert sorted(first.seeds) == [0, 1, 2, 3]
    failed = (tmp_path / cells[1].name / "record.jsonl").read_bytes()

    second = training()
    assert list(run_grid(cells, tmp_path, processes=2)) == [cells[1].name, cells[3].name]
    assert second.seeds == [2]
    assert "it did not start: does not start" in str(read_record(tmp_path / cells[3].name / "record.jsonl").error)
    assert (tmp_path / cells[1].name / "record.jsonl").read_bytes() == failed
    assert read_record(tmp_path / cells[2].name / "record.jsonl").error is None

    third = training()
    assert len(run_grid(cells, tmp_path)) == 2
    assert third.seeds == []
    fourth = training()
    assert run_grid(cells, tmp_path, retry_failed=True) == {}
    assert sorted(fourth.seeds) == [1, 3]


def test_a_run_with_other_settings_is_not_taken_for_the_cells(training, tmp_path) -> None:
    training()
    run_grid(make_cells(["momba"], [ENV], 1, ["--steps", "3e4"]), tmp_path)
    longer = training()
    with pytest.raises(ValueError, match=r"holds a run with other settings \(steps\): choose another --output"):
        run_grid(make_cells(["momba"], [ENV], 2, ["--steps", "1e6"]), tmp_path)
    assert longer.seeds == []


def test_a_run_that_was_cut_off_with_other_settings_is_not_thrown_away(training, tmp_path) -> None:
    training({0: "is cut off"})
    (cell,) = make_cells(["momba"], [ENV], 1, ["--steps", "3e4"])
    run_grid([cell], tmp_path)
    path = tmp_path / cell.name / "record.jsonl"
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"holds a run with other settings \(hyperparameters\.gamma, steps\)"):
        run_grid(make_cells(["momba"], [ENV], 1, ["--set", "gamma=0.5"]), tmp_path)
    assert path.read_bytes() == before


def test_settings_that_no_result_depends_on_may_differ(training, tmp_path) -> None:
    """The processes that share an evaluation are not recorded."""
    training()
    run_grid(make_cells(["momba"], [ENV], 1), tmp_path)
    again = training()
    (cell,) = make_cells(["momba"], [ENV], 1, ["--eval-workers", "2"])
    assert parsed(cell, tmp_path).eval_workers == 2
    assert len(run_grid([cell], tmp_path)) == 0
    assert again.seeds == []
    assert "eval_workers" not in read_record(tmp_path / cell.name / "record.jsonl").config


def test_what_goes_on_is_told_how_to_run_from_now_on(training, tmp_path, monkeypatch) -> None:
    """What the grid's options give; of the others the run's folder knows."""
    training({0: "is cut off"})
    run_grid(make_cells(["momba"], [ENV], 1, ["--keep-checkpoints", "6"]), tmp_path)
    commands: list[list[str]] = []
    monkeypatch.setattr(execution, "way_to_run", lambda *args: "go on")
    put_in_place(monkeypatch, lambda command, log: commands.append(command[3:]) or 0)
    folder = tmp_path / "momba" / ENV / "0"
    for options in ([], ["--eval-workers", "2", "--n-preferences", "100"]):
        run_grid(make_cells(["momba"], [ENV], 1, options), tmp_path)
        assert commands.pop() == ["--resume", str(folder), "--no-progress-bar", *options[:2]]


def test_what_has_to_run(tmp_path) -> None:
    (cell,) = make_cells(["momba"], [ENV], 1)
    settings = parsed(cell, tmp_path)
    content = {"settings": runs.recorded_settings(settings), "env": ENV}
    ended = {"finished": {"values": FRONT}, "failed": {"error": BAD}, "cut off": {"error": "cut off"}}
    for name, end in ended.items():
        write_record(tmp_path / name / "record.jsonl", **content, **end)
    (tmp_path / "empty").mkdir()
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "record.jsonl").write_bytes((tmp_path / "finished" / "record.jsonl").read_bytes()[:100])
    expected = {"finished": False, "failed": False, "cut off": True, "empty": True, "torn": True, "missing": True}
    assert {name: has_to_run(cell, replace(settings, output=str(tmp_path / name))) for name in expected} == expected
    other = train.parse([*cell.arguments(tmp_path), "--n-episodes", "2"])
    for name in ended:
        with pytest.raises(ValueError, match=r"other settings \(n_episodes\)"):
            has_to_run(cell, replace(other, output=str(tmp_path / name)))


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
    assert len(run_grid([cell], tmp_path)) == 0
    assert fake_training.seeds == [0]


def test_a_damaged_record_is_refused_before_anything_runs(training, tmp_path) -> None:
    """The record stays: it may be of a newer version."""
    cells = make_cells(["momba"], [ENV], 6)
    path = tmp_path / cells[0].name / "record.jsonl"
    path.parent.mkdir(parents=True)
    path.write_text("damaged\n")
    fake_training = training()
    arguments = ["--conf", "momba", "--env", ENV, "--seeds", "6", "--output", tmp_path, "--processes", "1"]
    assert str(path) in error_of("run", *arguments)
    assert path.read_text() == "damaged\n"
    assert fake_training.seeds == []


def test_what_is_no_run_is_not_thrown_away(training, tmp_path) -> None:
    """A training refuses a folder with something in it; a grid only clears what a run left."""
    cells = make_cells(["momba"], [ENV], 2)
    mine = tmp_path / cells[1].name / "thesis.txt"
    mine.parent.mkdir(parents=True)
    mine.write_text("years of work")
    fake_training = training()
    with pytest.raises(ValueError, match="holds something else than a run: choose another --output"):
        run_grid(cells, tmp_path)
    assert mine.read_text() == "years of work"
    assert fake_training.seeds == []


def test_a_file_in_the_place_of_a_folder_is_not_thrown_away(training, tmp_path) -> None:
    (cell,) = make_cells(["momba"], [ENV], 1)
    mine = tmp_path / cell.name
    mine.parent.mkdir(parents=True)
    mine.write_text("years of work")
    fake_training = training()
    with pytest.raises(ValueError, match="holds something else than a run"):
        run_grid([cell], tmp_path)
    assert mine.read_text() == "years of work"
    assert fake_training.seeds == []


def test_a_grid_with_failures_ends_with_their_number(training, tmp_path) -> None:
    arguments = ["--conf", "momba", "--env", ENV, "--seeds", "3", "--output", tmp_path, "--processes", "1"]
    for _ in range(2):
        training({0: "fails", 2: "fails"})
        message = error_of("run", *arguments, "--report")
        assert "2 runs did not finish" in message
        assert str(tmp_path) in message
        assert rows_of((tmp_path / "report.md").read_text(), "a")[0][1] == "1/3"  # the label of fake records


def test_options_are_handed_on(training, tmp_path, monkeypatch) -> None:
    seen: list[list[str]] = []
    fake_training = training()
    put_in_place(monkeypatch, lambda command, log: (seen.append(command), fake_training(command, log))[1])
    line = f"run --conf momba --env {ENV} --seeds 1 --output {tmp_path} --auto-ent-coef 0.01 --steps 3e4 --set gamma=0.9"
    main(line.split())
    settings = train.parse(seen[0][3:])
    assert settings.steps == 30_000
    assert settings.hyperparameters["gamma"] == 0.9
    assert settings.hyperparameters["ent_coef"] == "auto_0.01"
    assert not settings.progress_bar


def test_a_run_that_is_interrupted_while_it_starts_has_not_failed(training, tmp_path) -> None:
    (cell,) = make_cells(["momba"], [ENV], 1)
    training({0: "is interrupted"})
    assert run_grid([cell], tmp_path) == {cell.name: "no record: it never began"}
    again = training()
    assert run_grid([cell], tmp_path) == {}
    assert again.seeds == [0]


def test_an_interrupted_grid_begins_nothing_more(tmp_path, monkeypatch, capsys) -> None:
    begun: list[Any] = []

    def interrupted(command: list[str], log: IO[bytes]) -> int:
        begun.append(command)
        if len(begun) > 1:
            time.sleep(1)  # A run takes its time: by then the grid has heard of the first one.
        raise KeyboardInterrupt

    put_in_place(monkeypatch, interrupted)
    line = f"run --conf momba --env {ENV} --seeds 5 --processes 1 --output {tmp_path}"
    with pytest.raises(SystemExit) as stop:
        main(line.split())
    assert stop.value.code == 130
    assert "Interrupted" in capsys.readouterr().err
    assert len(begun) <= 2


def test_sigterm_ends_the_trainings_with_their_grid(tmp_path, monkeypatch, capsys) -> None:
    begun: list[subprocess.Popen[bytes]] = []

    class Training(subprocess.Popen[bytes]):
        """In place of a training: a process that waits, which the grid is told to end as soon as it runs."""

        def __init__(self, command: list[str], **kwargs: Any):
            if "sb3_momba.train" not in command:
                super().__init__(command, **kwargs)
                return
            super().__init__([sys.executable, "-c", "import time; time.sleep(600)"], **kwargs)
            begun.append(self)
            threading.Timer(0.5, signal.pthread_kill, (threading.main_thread().ident, signal.SIGTERM)).start()

        def terminate(self) -> None:
            if len(signals) == 0:
                signals.append(signal.SIGTERM)
                signal.raise_signal(signal.SIGTERM)  # A supervisor signals a process, and its group.
            super().terminate()

    signals: list[int] = []
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(local.subprocess, "Popen", Training)
    with pytest.raises(SystemExit) as stop:
        main(f"run --conf momba --env {ENV} --seeds 5 --processes 1 --output {tmp_path}".split())
    assert stop.value.code == 130
    assert "Interrupted" in capsys.readouterr().err
    assert [process.returncode for process in begun] == [-signal.SIGTERM]
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize(
    ("free", "said"),
    [([1_000], "The disk is full, 1,000 bytes are left"), ([10**10, 1_000, 1_000], "2 runs did not finish")],
    ids=["before anything", "meanwhile"],
)
def test_nothing_begins_on_a_full_disk(training, tmp_path, monkeypatch, free: list[int], said: str) -> None:
    fake_training = training()
    cells = make_cells(["momba"], [ENV], 2)
    with monkeypatch.context() as patch:
        left = iter(free)
        patch.setattr(execution.shutil, "disk_usage", lambda folder: SimpleNamespace(free=next(left)))
        message = error_of("run", "--conf", "momba", "--env", ENV, "--seeds", "2", "--output", tmp_path, "--report")
    assert said in message
    assert ("There is no report" in message) == (len(free) > 1)
    assert fake_training.seeds == []
    assert execution.failed(cells, tmp_path) == {cell.name: "no record: it never began" for cell in cells}
    assert run_grid(cells, tmp_path) == {}


def test_a_real_grid_of_one_run(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")  # Runs side by side have one thread each all the same.
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

    put_in_place(monkeypatch, lambda command, log: pytest.fail("it is run again"))
    main([*line.split(), *options.split(), "--report"])
    text = (tmp_path / "grid" / "report.md").read_text()
    assert rows_of(text, "tiny")[0][1:3] == ["1/1", "100"]
    assert text in capsys.readouterr().out


# ------------------------------------------------------------------------------------------------------------- speed


def test_speed_measures_the_parts_that_are_asked_for(capsys):
    main(["speed", "memory"])
    table = capsys.readouterr().out
    assert "### Memory" in table
    assert "### Updates" not in table
    # MO-Hopper-v4: 11 observations twice, 3 actions, 2 rewards and 2 weights in float32, two flags of a byte or more.
    gigabytes = float(re.search(r"MO-Hopper-v4 \| ([\d.]+)", table)[1])
    assert gigabytes == pytest.approx(4 * (11 + 11 + 3 + 2 + 2) / 1e3, abs=0.02)


def test_speed_counts_products_and_parameters():
    model = speed.filled_model(policy_kwargs=TINY_SIMBA)
    onednn_keeps_float32.cache_clear()  # as in a new process
    first, later = (speed.products_of_an_update(model) for _ in range(2))
    assert first == later > 0
    seconds, parameters = speed.cost_of_update({"policy_kwargs": TINY_SIMBA})
    assert parameters == sum(p.numel() for p in model.critic.parameters())
    assert 0 < seconds < 5


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("update", "'update' is no part of the measurement"),
        ("updates --threads 0", "--threads 0: give at least one"),
        ("updates --picture speed.png", "--picture speed.png is of the scaling"),
    ],
)
def test_what_speed_cannot_do_is_named(line: str, message: str) -> None:
    with pytest.raises(SystemExit, match=message):
        main(["speed", *line.split()])
