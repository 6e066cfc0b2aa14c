"""Chapter 4 from records: whose runs count where, in which unit, what they come to by hand, and what is said of the rest."""

import itertools
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

import sb3_momba
from sb3_momba import recording
from sb3_momba.benchmark.__main__ import main
from sb3_momba.benchmark.chapter4 import layout
from sb3_momba.benchmark.chapter4.command import write_chapter
from sb3_momba.benchmark.chapter4.differences import differences, missing_note, steps_note
from sb3_momba.benchmark.chapter4.figure31 import predicted, reset_observations
from sb3_momba.benchmark.chapter4.layout import MOMBA
from sb3_momba.benchmark.chapter4.scores import (
    aggregate,
    aggregate_curve,
    check_one_setting,
    critic_parameters,
    fixed_values,
    label_of,
    main_units,
    normalisation_worth,
    runs_of,
    score_of,
    shapley_values,
    tasks_of,
    units,
)
from sb3_momba.benchmark.chapter4.sections import SECTIONS, levels
from sb3_momba.benchmark.chapter4.tables import table_4_2, table_4_3, table_4_4, table_4_5, unit_note
from sb3_momba.benchmark.chapter4.thesis import read_thesis
from sb3_momba.benchmark.report import write_report
from sb3_momba.benchmark.results import compare, curve_on
from sb3_momba.recording import plain
from sb3_momba.records import Record
from sb3_momba.zoo.configuration import read_configuration, shipped_configurations, with_defaults
from tests.stubs import tiny_model
from tests.test_benchmark import BAD, FRONT, PNG, box, hyperparameters, write_record

FIRST = Path(__file__).parent.parent / "docs" / "results" / "first"
HOPPER, WALKER, THREE = "MO-Hopper-v4", "MO-Walker2d-v4", "MO-Hopper-3obj-v4"
BASELINES = {"pgmorl", "gpi_ls", "gpi_ls_utd_1", "dpmorl", "dpmorl_state", "fixed_preference"}


@pytest.fixture(autouse=True)
def no_revision(monkeypatch) -> None:
    """Fake records ask neither git nor the machine."""
    for what in ("git_revision", "library_versions", "machine"):
        monkeypatch.setattr(recording, what, lambda: None)


@pytest.fixture
def fake(tmp_path) -> Callable[..., Record]:
    """Writes a record under the next name, `fake(label, values, curve, ...)`, and reads it."""
    folder = tmp_path / "records"

    def write(label: str, *args: Any, env: str = HOPPER, **kwargs: Any) -> Record:
        path = folder / f"{len(list(folder.glob('*'))):03}" / "record.jsonl"
        return write_record(path, *args, label=label, env=env, **kwargs)

    return write


@pytest.fixture
def fixed(fake) -> Callable[..., Record]:
    """A run trained and evaluated for one preference."""

    def write(value: Any, preference: Sequence[float], settings: dict[str, Any] | None = None, **kwargs: Any) -> Record:
        sampler = hyperparameters(preference_sampler=list(preference))
        floors = {"standing still": [[1.0] * len(preference)]}
        settings = {**sampler, "n_preferences": 1, "preferences": [list(preference)], **(settings or {})}
        return fake(
            "fixed_preference",
            None if value is None else [value],
            preferences=[preference],
            floors=floors,
            settings=settings,
            **kwargs,
        )

    return write


def cells_of(table: str) -> list[list[str]]:
    rows = [row.strip("| ").split(" | ") for row in table.splitlines() if row.startswith("|") and not row.startswith("|---")]
    return [[cell.strip() for cell in row] for row in rows]


# ------------------------------------------------------------------------------------------------ the thesis and its cells


def test_the_thesis_has_a_value_for_every_cell() -> None:
    thesis = read_thesis()
    assert set(thesis.methods) == set(layout.MAIN)
    assert set(thesis.conditioning) == set(layout.CONDITIONING)
    assert set(thesis.improvements) == set(layout.IMPROVEMENTS)
    assert len(thesis.tasks) == 7
    published = [*thesis.conditioning.values(), *(one for row in thesis.improvements.values() for one in row.values())]
    for task in thesis.tasks.values():
        for metric in ("hypervolume", "expected_utility"):
            assert set(task.scores[metric]) == set(layout.MAIN)
            published += task.scores[metric].values()
    assert len(published) == 4 + 8 + 7 * 2 * 5
    assert all(one.low <= one.value <= one.high for one in published)


def test_some_published_values() -> None:
    thesis = read_thesis()
    assert thesis.tasks["MO-Ant-v4"].scores["hypervolume"]["Momba"].value == pytest.approx(7.78e6)
    swimmer = thesis.tasks["MO-Swimmer-v4"].scores["expected_utility"]["PGMORL"]
    assert (swimmer.value, swimmer.low, swimmer.high) == pytest.approx((127, 107, 145))
    assert thesis.tasks[THREE].name == "Hopper-v3"
    assert thesis.methods["PGMORL"].steps == (12e6, 120e6)
    assert thesis.improvements["HER + PAR"]["distance"].value == 0.079


def test_cells_name_every_shipped_configuration_of_the_thesis() -> None:
    ours = {"capql_uniform", "actor_blocks_1", "alpha_start_1e-3", "alpha_start_1e-2", "alpha_start_5e-2", "bfloat16"}
    ours |= {"xqc", "flashsac", "trunk_xqc", "trunk_flashsac", "momba_plus", "td3"}
    assert layout.all_labels() - BASELINES == set(shipped_configurations()) - ours


def settings_of_configuration(label: str) -> dict[str, Any]:
    read = read_configuration(label, HOPPER)
    settings = plain(with_defaults(read.policy, read.hyperparameters))
    arch = settings["policy_kwargs"].pop("net_arch", None) or [256, 256]
    return {**settings, "policy": read.policy, "net_arch": arch if isinstance(arch, dict) else {"pi": arch, "qf": arch}}


def test_labels_that_one_cell_accepts_are_one_configuration() -> None:
    groups = [*layout.VALUES.values(), *layout.SCALING.values()]
    shared = {labels for methods in groups for labels in methods.values() if len(labels) > 1}
    assert len(shared) > 3
    for labels in shared:
        first, *others = [settings_of_configuration(label) for label in labels]
        assert all(other == first for other in others), labels


def test_the_first_label_that_has_runs_counts(fake) -> None:
    made = [
        fake("critic_simba_ce_256", FRONT),
        fake("value_simba_ce_scalarised", box(2.0)),
        fake("momba", box(9.0), env=WALKER),
    ]
    tasks = tasks_of(made)
    assert label_of(tasks[HOPPER], MOMBA) == "value_simba_ce_scalarised"
    assert [run.hypervolume for run in runs_of(tasks[HOPPER], MOMBA)] == [2]
    assert label_of(tasks[WALKER], MOMBA) == "momba"
    assert runs_of(tasks[HOPPER], ("her",)) == []
    assert runs_of(None, MOMBA) == []


# --------------------------------------------------------------------------------------------------- what can be one table


def test_two_settings_under_one_label_name_both_files_and_the_setting(fake) -> None:
    one = fake("momba", FRONT, settings={"steps": 30_000})
    other = fake("momba", FRONT, settings={"steps": 1_000_000}, seed=1)
    with pytest.raises(ValueError, match="apart") as error:
        tasks_of([one, other])
    for part in (str(one.path), str(other.path), "momba", HOPPER, "steps is 30000 and 1000000"):
        assert part in str(error.value)


def test_nested_settings_differ_too(fake) -> None:
    made = [fake("momba", FRONT, settings=hyperparameters(gamma=gamma)) for gamma in (0.9, 0.99)]
    with pytest.raises(ValueError, match=r"hyperparameters\.gamma is 0\.9 and 0\.99"):
        tasks_of(made)


def test_other_labels_and_other_tasks_may_have_other_settings(fake) -> None:
    made = [fake("momba", FRONT, settings={"steps": 1}), fake("her", FRONT, settings={"steps": 2})]
    made.append(fake("momba", FRONT, settings={"steps": 3}, env=WALKER))
    tasks = tasks_of(made)
    assert list(tasks) == [HOPPER, WALKER]
    assert steps_note(tasks, {"Momba": MOMBA, "HER": ("her",), "PAR": ("par",)}) == "Steps: Momba 1 or 3; HER 2.\n"
    assert steps_note(tasks, {"HER": ("her",), "PAR": ("par",)}) == ""


def test_runs_of_fixed_preferences_differ_in_the_preference_alone(fixed) -> None:
    made = [fixed([1.0, 3.0], [0.0, 1.0]), fixed([3.0, 1.0], [1.0, 0.0])]
    check_one_setting(made)
    with pytest.raises(ValueError, match="steps is None and 5"):
        check_one_setting([*made, fixed([2.0, 2.0], [0.5, 0.5], settings={"steps": 5})])


def test_one_task_made_in_two_ways_is_an_error(fake) -> None:
    made = [fake("momba", FRONT), fake("momba", FRONT, env_kwargs={"physics": "current"}, seed=1)]
    with pytest.raises(ValueError, match=rf"{HOPPER} and of {HOPPER} \(physics=current\)"):
        tasks_of(made)


def test_tasks_are_those_of_the_thesis_whatever_their_order(fake) -> None:
    made = [fake("momba", FRONT, env="momba/" + WALKER), fake("momba", FRONT, env="E"), fake("momba", FRONT)]
    assert list(tasks_of(made)) == list(tasks_of(made[::-1])) == [HOPPER, WALKER]


# ----------------------------------------------------------------------------------------------------------- normalisation


def test_units_are_interquartile_means_of_the_records_or_the_thesis(fake) -> None:
    made = [fake("pgmorl", box(volume), general_policy=False, seed=i) for i, volume in enumerate((2.0, 4.0, 6.0, 100.0))]
    found = main_units(tasks_of(made), "hypervolume")
    assert (found[HOPPER].value, found[HOPPER].published) == (5.0, False)
    assert (found[WALKER].value, found[WALKER].published) == (pytest.approx(3.47e6), True)
    assert len(found) == 7


def test_a_unit_of_nothing_is_none(fake) -> None:
    tasks = tasks_of([fake("pgmorl", None, error=BAD, general_policy=False), fake("momba", FRONT, env=WALKER)])
    found = main_units(tasks, "hypervolume")
    assert HOPPER not in found
    assert "missing or not above 0 on Hopper-v4" in unit_note(tasks, found, "PGMORL", "hypervolume")
    assert "as the thesis has it on Walker2d-v4" in unit_note(tasks, found, "PGMORL", "hypervolume")
    assert set(units(tasks, MOMBA, "hypervolume")) == {WALKER}


def test_aggregates_by_hand(fake) -> None:
    """On Hopper Momba has 2 and 4, so that 6 is 2; on Walker it has 10, and HER failed."""
    made = [fake("momba", box(volume), seed=i) for i, volume in enumerate((2.0, 4.0))]
    made += [fake("momba", box(10.0), env=WALKER), fake("her", FRONT), fake("her", None, error=BAD, env=WALKER)]
    made += [fake("par", box(5.0), env=WALKER), fake("par", FRONT, env="MO-Ant-v4")]
    tasks = tasks_of(made)
    unit = units(tasks, MOMBA, "hypervolume")
    momba, her = (aggregate(tasks, labels, "hypervolume", unit) for labels in (MOMBA, ("her",)))
    assert momba.estimate is not None
    assert momba.estimate.value == pytest.approx(1.0)
    assert (her.finished, her.runs, her.tasks) == (1, 2, (HOPPER, WALKER))
    assert her.estimate is not None
    assert (her.estimate.value, her.estimate.low, her.estimate.high) == pytest.approx((1, 1, 1))
    par = aggregate(tasks, ("par",), "hypervolume", unit)  # On Ant there is no Momba.
    assert par.tasks == (WALKER,)
    assert par.estimate is not None
    assert par.estimate.value == pytest.approx(0.5)
    assert aggregate(tasks, ("her_par",), "hypervolume", unit).estimate is None


def test_a_failed_run_counts_with_nothing(fake) -> None:
    made = [fake("momba", box(6.0)), fake("momba", None, {10: box(9.0)}, BAD, seed=1)]
    assert aggregate(tasks_of(made), MOMBA, "hypervolume").estimate.value == 3.0  # type: ignore[union-attr]


def test_what_is_unknown_is_missing(fake) -> None:
    """Neither a floor nor a finished run says what a failed one earned."""
    tasks = tasks_of([fake("momba", None, error=BAD, floors={})])
    assert score_of(runs_of(tasks[HOPPER], MOMBA), "expected_utility") is None
    assert score_of(runs_of(tasks[HOPPER], MOMBA), "hypervolume").value == 0  # type: ignore[union-attr]
    assert aggregate(tasks, MOMBA, "expected_utility", main_units(tasks, "expected_utility")).estimate is None


# ---------------------------------------------------------------------------------------------------------------- the tables


def test_table_4_3_by_hand(fake) -> None:
    values = np.array(FRONT) * 1_000
    made = [fake("momba", values), fake("momba", None, error=BAD, seed=1), fake("pgmorl", values, general_policy=False)]
    rows = {tuple(row[:3]): row[3:] for row in cells_of(table_4_3(tasks_of(made)))}
    assert rows["environment", "metric", "of"] == [*layout.MAIN, "nothing learned"]
    # A hypervolume of 6e6 and one of 0; an expected utility of 8e3 / 3 and that of the worst floor, 0.5.
    assert rows["Hopper-v4", "HV / 10^7", "records"] == ["0.3 [0, 0.6]", "**0.6**", *["missing"] * 3, "1e-07"]
    assert rows["Hopper-v4", "EUM / 10^3", "records"] == ["1.334 [0.0005, 2.667]", "**2.667**", *["missing"] * 3, "0.001"]
    assert rows["Hopper-v4", "HV / 10^7", "thesis"][:2] == ["**1.81 [1.78, 1.85]**", "1.53 [1.4, 1.64]"]
    assert rows["Ant-v4", "HV / 10^6", "records"] == ["missing"] * 5
    assert rows["Swimmer-v4", "EUM / 10^2", "thesis"][1].startswith("**1.27")
    assert len(rows) == 1 + 7 * 2 * 2


def test_nothing_is_best_that_stands_alone(fake) -> None:
    assert "**0.6**" not in table_4_3(tasks_of([fake("momba", np.array(FRONT) * 1_000)]))


def test_table_4_2_by_hand(fake) -> None:
    made = [fake("momba", FRONT, settings={"steps": 30_000}), fake("momba", FRONT, env=WALKER, parameters={"actor": 30})]
    several = {"general_policy": False, "settings": hyperparameters(pop_size=6)}
    made += [fake("pgmorl", FRONT[:n], {500: FRONT[:n]}, seed=n, extra_steps=10 * n, **several) for n in (1, 3)]
    made.append(fake("pgmorl", None, {900: FRONT}, BAD, seed=9, **several))
    made.append(fake("dpmorl_state", FRONT, general_policy=False, settings=hyperparameters(n_policies=4)))
    made.append(fake("dpmorl", FRONT, env=WALKER, general_policy=False))
    rows = {row[0]: row[1:] for row in cells_of(table_4_2(tasks_of(made)))}
    # 210 and 30 parameters; the second record says nothing of its steps.
    assert rows["Momba"] == ["General policy", "1", "1", "120", "2,500,805", "0 to 30,000", "1,000,000"]
    steps = ["500 to 900 + 0 to 30", "12,000,000 to 120,000,000"]
    assert rows["PGMORL"] == ["Multi-policy", "6", "6 to 15", "210", "17,551", *steps]
    assert rows["DPMORL"] == ["Multi-policy", "4", "10", "210", "17,477", "0", "10,000,000"]


def test_table_4_4_by_hand(fake) -> None:
    made = [fake("momba", box(4.0)), fake("conditioning_film", box(3.0))]
    rows = {row[0]: row[1:] for row in cells_of(table_4_4(tasks_of(made)))}
    assert rows["Concatenate input"] == ["1/1", "Hopper-v4", "1", "1.007 [0.995, 1.019]"]
    assert rows["FiLM"] == ["1/1", "Hopper-v4", "0.75", "0.966 [0.946, 0.981]"]
    assert rows["Concatenate all"] == [*["missing"] * 3, "0.994 [0.98, 1.007]"]


def test_table_4_5_by_hand(fake, fixed) -> None:
    """A run of a fixed preference is on the envelope too: (1, 3), (2.5, 2.5) and (3, 1), on [0, 1] axes (0, 1), (3/4, 3/4)
    and (1, 0)."""
    ends = [FRONT[0], FRONT[0], FRONT[2]]
    made = [fake("value_simba_ce_vector", ends), fake("her", FRONT), fake("momba", box(2.0)), fixed([2.5, 2.5], [0.5, 0.5])]
    np.testing.assert_array_equal(tasks_of(made)[HOPPER].reference_front, [[1, 3], [2.5, 2.5], [3, 1]])
    rows = {row[0]: row[1:] for row in cells_of(table_4_5(tasks_of(made)))}
    ends_distance, her_distance = np.hypot(0.75, 0.25) / 3, np.hypot(0.25, 0.25) / 3
    assert rows["Base"][:3] == ["1/1", "Hopper-v4", "2.5"]
    assert float(rows["Base"][6]) == pytest.approx(ends_distance, abs=1e-4)
    assert rows["HER"][2] == "3"
    assert float(rows["HER"][6]) == pytest.approx(her_distance, abs=1e-4)
    assert rows["HER"][3] == "1.001 [0.989, 1.011]"
    assert rows["PAR"] == [*["missing"] * 3, "1.005 [0.995, 1.014]", *["missing"] * 3, "0.094 [0.086, 0.101]"]


# --------------------------------------------------------------------------------------------------------------- the figures


def test_expected_utility_has_a_curve_by_hand(fake) -> None:
    """One that failed counts with the worst floor's 0.5 after its last evaluation."""
    made = [fake("momba", FRONT, {10: box(2.0), 20: FRONT}), fake("momba", None, {10: FRONT}, BAD, seed=1)]
    runs = runs_of(tasks_of(made)[HOPPER], MOMBA)
    np.testing.assert_allclose(runs[0].utility_curve, [(1 + 1.5 + 2) / 3, 8 / 3])
    steps, curves = curve_on(runs, "expected_utility")
    np.testing.assert_array_equal(steps, [10, 20])
    np.testing.assert_allclose(curves, [[1.5, 8 / 3], [8 / 3, 0.5]])
    np.testing.assert_array_equal(curve_on(runs)[1], [[2, 6], [6, 0]])


def test_aggregate_curves_by_hand(fake) -> None:
    """In units of 2 and 4: 1 to 3 from 10 to 30 steps on one task, 1 to 2 from 20 to 40 on the other."""
    made = [fake("momba", FRONT, {10: box(2.0), 30: FRONT}), fake("momba", box(8.0), {20: box(4.0), 40: box(8.0)}, env=WALKER)]
    made += [fake("her", box(2.0)), fake("her", box(4.0), env=WALKER)]
    tasks = tasks_of(made)
    unit = units(tasks, ("her",), "hypervolume")
    curve = aggregate_curve(tasks, MOMBA, "hypervolume", unit, 200_000)
    assert curve is not None
    np.testing.assert_array_equal(curve.steps, [20, 30])
    # Two runs: their mean, of 2 and 1, then 3 and 1.5.
    np.testing.assert_allclose([point.value for point in curve.points], [1.5, 2.25])
    cut = aggregate_curve(tasks, MOMBA, "hypervolume", unit, 25)
    assert cut is not None
    np.testing.assert_array_equal(cut.steps, [20, 25])
    np.testing.assert_allclose([point.value for point in cut.points], [1.5, (2.5 + 1.25) / 2])
    assert aggregate_curve(tasks, MOMBA, "hypervolume", unit, 15) is None
    assert aggregate_curve(tasks, ("par",), "hypervolume", unit, 200_000) is None
    assert aggregate_curve(tasks, MOMBA, "hypervolume", {}, 200_000) is None


def test_levels_are_the_records_or_the_thesis(fake) -> None:
    tasks = tasks_of([fake("pgmorl", FRONT, general_policy=False)])
    assert levels(tasks[HOPPER], HOPPER, "hypervolume") == {"PGMORL": 6.0, "DPMORL (thesis)": pytest.approx(0.88e7)}


def test_runs_of_fixed_preferences_form_one_front(fake, fixed, tmp_path) -> None:
    """Beside evaluations of other preferences, which they are not compared with."""
    made = [fixed([1.0, 3.0], [0.0, 1.0]), fixed([3.0, 1.0], [1.0, 0.0]), fixed([2.5, 1.0], [1.0, 0.0], seed=1)]
    made += [fixed(None, [0.5, 0.5], error=BAD), fake("momba", FRONT)]
    task = tasks_of(made)[HOPPER]
    assert list(task.methods) == ["momba"]
    values = fixed_values(task)
    assert values is not None
    assert sorted(values.tolist()) == [[1, 3], [2.5, 1], [3, 1]]
    rows = {row[0]: row[1:] for row in cells_of(SECTIONS["Figure 4.5: fixed preferences"]({HOPPER: task}, tmp_path))}
    assert rows["Hopper-v4"] == ["2", "20", "3/4", "5", "seed 0", "6"]
    assert rows["Hopper-v3"] == ["missing", "50", *["missing"] * 4]
    assert (tmp_path / "figure-4.5.png").read_bytes().startswith(PNG)


def test_the_report_of_any_task_says_that_fixed_preferences_are_not_in_it(fake, fixed, tmp_path) -> None:
    made = [fake("momba", FRONT), fixed([1.0, 3.0], [0.0, 1.0]), fixed([1.0, 1.0], [0.0, 1.0], env=WALKER)]
    text = write_report(compare(made), made, tmp_path)
    assert text.count("runs of a fixed preference each, 1/1,") == 2


def test_sizes_of_critics_are_means_over_the_tasks(fake) -> None:
    made = [fake("momba", FRONT, parameters={"actor": 1, "critic": 10}), fake("her", FRONT, parameters={})]
    tasks = tasks_of([*made, fake("momba", FRONT, parameters={"critic": 20}, env=WALKER)])
    assert critic_parameters(tasks, MOMBA) == 15
    assert critic_parameters(tasks, ("her",)) is None
    assert critic_parameters(tasks, ("par",)) is None


def test_missing_cells_are_named(fake) -> None:
    tasks = tasks_of([fake("momba", FRONT), fake("momba", FRONT, env=WALKER), fake("her", FRONT)])
    methods = {"Momba": MOMBA, "HER": ("her",), "PAR": ("par",), "both": ("her_par",)}
    assert missing_note(tasks, methods) == "Missing: HER (Walker2d-v4); PAR, both (all tasks).\n"
    assert missing_note(tasks, {"Momba": MOMBA}) == ""


# ------------------------------------------------------------------------------------------------------------ Shapley values


def worth(**values: float) -> dict[frozenset[str], float]:
    """worth(a=1, ab=2) of players a and b; `nobody` is the empty set."""
    return {frozenset() if name == "nobody" else frozenset(name): value for name, value in values.items()}


def test_shapley_values_of_the_glove_game() -> None:
    """A left glove and two right ones: a pair is worth 1 (2/3, 1/6, 1/6)."""
    found = shapley_values(worth(nobody=0, l=0, r=0, s=0, lr=1, ls=1, rs=0, lrs=1))
    assert found == {"l": pytest.approx(2 / 3), "r": pytest.approx(1 / 6), "s": pytest.approx(1 / 6)}


def test_shapley_values_by_hand() -> None:
    """f: (2 * (4-1) + (6-2) + (8-4) + 2 * (12-7)) / 6 and so on, with the orders fow, fwo, ofw, owf, wfo, wof."""
    values = worth(nobody=1, f=4, o=2, w=4, fo=6, fw=8, ow=7, fow=12)
    found = shapley_values(values)
    assert found["f"] == pytest.approx((3 + 3 + 4 + 5 + 4 + 5) / 6)
    assert found["o"] == pytest.approx((2 + 4 + 1 + 1 + 4 + 3) / 6)
    assert found["w"] == pytest.approx((6 + 4 + 6 + 5 + 3 + 3) / 6)
    assert sum(found.values()) == pytest.approx(12 - 1)


@given(st.lists(st.floats(-10, 10), min_size=8, max_size=8))
def test_shapley_values_are_means_over_all_orders(values: list[float]) -> None:
    players = ("FN", "ON", "WN")
    sets = [frozenset(some) for size in range(4) for some in itertools.combinations(players, size)]
    v = dict(zip(sets, values, strict=True))
    joined = dict.fromkeys(players, 0.0)
    for order in itertools.permutations(players):
        for i, player in enumerate(order):
            joined[player] += (v[frozenset(order[: i + 1])] - v[frozenset(order[:i])]) / 6
    assert shapley_values(v) == pytest.approx(joined, abs=1e-9)


def test_shapley_values_need_every_set() -> None:
    with pytest.raises(ValueError, match=r"\['a', 'b'\] is not known"):
        shapley_values(worth(nobody=0, a=1, b=1, c=1, ac=1, bc=1, abc=1))


def test_normalisations_are_worth_what_they_come_to_on_tasks_that_have_all(fake) -> None:
    volumes = dict(zip(layout.NORMALISATION, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0), strict=True))
    made = [fake(labels[0], box(volumes[title])) for title, labels in layout.NORMALISATION.items()]
    found, common = normalisation_worth(tasks_of(made), layout.NORMALISATION)
    assert common == (HOPPER,)
    assert found[frozenset()] == 1 / 8
    assert found[frozenset({"FN", "WN"})] == 6 / 8
    assert found[frozenset({"FN", "ON", "WN"})] == 1
    assert set(shapley_values(found)) == set(layout.NORMALISATIONS)
    # On another task one is lacking.
    made += [fake(labels[0], box(1.0), env=WALKER) for labels in list(layout.NORMALISATION.values())[1:]]
    assert normalisation_worth(tasks_of(made), layout.NORMALISATION) == (found, (HOPPER,))
    assert normalisation_worth(tasks_of(made[1:]), layout.NORMALISATION) == ({}, ())


# ------------------------------------------------------------------------------------------------ what differs from the thesis


def as_shipped(label: str, steps: int = 1_000_000, **changed: Any) -> dict[str, Any]:
    read = read_configuration(label, HOPPER)
    given = plain(with_defaults(read.policy, {**read.hyperparameters, **changed}))
    return {"steps": steps, "policy": read.policy, "n_envs": 1, "n_preferences": 100, "n_episodes": 5, "hyperparameters": given}


def test_differences_are_said_with_the_thesis_beside(fake, fixed) -> None:
    made = [fake(label, FRONT, settings=as_shipped(label, 30_000, ent_coef="auto_0.01")) for label in ("momba", "her")]
    made += [fake("par", FRONT, settings=as_shipped("par")), fake("capql", FRONT, settings=as_shipped("capql", 50_000))]
    made.append(fake("par", FRONT, settings=as_shipped("par", 7), env=WALKER, env_kwargs={"physics": "current"}))
    others = {"gpi_ls": 200_000, "gpi_ls_utd_1": 5_000, "pgmorl": 47_972_352}  # of 12M to 120M what its authors give Hopper
    made += [fake(label, FRONT, settings={"steps": steps, "n_episodes": 5}) for label, steps in others.items()]
    made.append(fake("pgmorl", FRONT, settings={"steps": 12_042_240, "n_episodes": 5}, env="MO-HalfCheetah-v4"))
    for label, is_seen in (("dpmorl", True), ("dpmorl_state", False)):
        settings = {"steps": 10_000_000, "n_episodes": 5, **hyperparameters(augment_state=is_seen)}
        made.append(fake(label, FRONT, settings=settings))
    single = {**as_shipped("momba", preference_sampler=[1.0, 0.0]), "n_preferences": 1, "n_episodes": 2}
    made.append(fixed([1.0, 3.0], [1.0, 0.0], settings=single))
    assert differences(tasks_of(made)) == [
        "- capql: steps 50,000 instead of 1,000,000.",
        "- dpmorl: augment_state True instead of False.",
        "- fixed_preference: n_episodes 2 instead of 5.",
        "- gpi_ls_utd_1: steps 5,000 instead of 200,000.",
        "- her, momba: ent_coef auto_0.01 instead of auto_0.2; steps 30,000 instead of 1,000,000.",
        "- par: env_kwargs.physics current instead of the default; steps 7 instead of 1,000,000.",
        "- pgmorl: steps 12,042,240 instead of 29,982,720.",
    ]


def test_runs_as_in_the_thesis_differ_in_nothing(fake, tmp_path) -> None:
    made = [fake("momba", FRONT, settings=as_shipped("momba"))]
    assert "Not run as in the thesis" not in write_chapter(made, tmp_path / "out")


# ----------------------------------------------------------------------------------------------------------- the whole chapter


def one_of_each(fake: Callable[..., Record], env: str, n_objectives: int, **start: Any) -> list[Record]:
    """A run of every label of chapter 4, momba's twice, and one of a label that it does not have."""
    made = []
    rng = np.random.default_rng(0)
    for label in [*sorted(layout.all_labels() - {"fixed_preference"}), "momba", "new"]:
        values = rng.uniform(1, 3, (3, n_objectives))
        curve = {100_000: values / 2, 200_000: values * 0.8, 300_000: values}
        is_general = label not in ("pgmorl", "dpmorl", "dpmorl_state")
        made.append(fake(label, values, curve, env=env, general_policy=is_general, **start))
    return made


@pytest.fixture
def everything(fake, fixed) -> list[Record]:
    """A run of every label on two tasks, one of three objectives; one failed, one was cut off, one was recorded twice."""
    made = one_of_each(fake, HOPPER, 2)
    still = {"standing still": np.ones((3, 3))}
    made += one_of_each(fake, THREE, 3, preferences=np.eye(3), reference_point=np.zeros(3), floors=still)
    made.append(fake("momba", None, {100_000: FRONT}, BAD, seed=1))
    made.append(fake("her", None, {100_000: FRONT}, "cut off", seed=1))
    return [*made, fixed([1.0, 3.0], [0.0, 1.0]), fixed([3.0, 1.0], [1.0, 0.0])]


def test_every_table_and_figure_of_a_full_set_of_records(everything, tmp_path) -> None:
    text = write_chapter(everything, tmp_path / "out")
    drawn = {path.name for path in (tmp_path / "out").glob("*.png")}
    assert drawn == {f"figure-4.{i}.png" for i in (1, 2, 3, 4, 5, 7, 8, 9, 10, 11)}
    assert all((tmp_path / "out" / name).read_bytes().startswith(PNG) for name in drawn)
    assert all(f"({name})" in text for name in drawn)
    assert "Missing:" not in text
    assert "Recorded more than once on MO-Hopper-v4: momba, seed 0" in text
    assert "whose runs only widen the front of Table 4.5: new." in text
    assert "momba, seed 1: RuntimeError: diverged" in text
    assert (tmp_path / "out" / "chapter4.md").read_text() == text
    for title in SECTIONS:
        assert f"## {title}\n" in text


def test_one_run_leaves_the_rest_missing(fake, tmp_path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "figure-4.9.png").write_bytes(b"of other records")
    text = write_chapter([fake("capql", FRONT)], tmp_path / "out")
    assert not (tmp_path / "out" / "figure-4.9.png").exists()
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"chapter4.md", "figure-4.1.png", "figure-4.2.png"}
    assert text.count("Not drawn: there are no runs for it.") == 8
    assert "Missing: Momba, PGMORL, GPI-LS, DPMORL (all tasks)." in text
    assert "Shapley values: missing" in text


def test_runs_that_all_failed_make_a_chapter(fake, tmp_path) -> None:
    made = [fake(label, None, error=BAD) for label in ("momba", "her", "pgmorl")]
    text = write_chapter(made, tmp_path / "out")
    assert "| momba | missing | missing | missing | 0/1 |" in text
    assert "missing or not above 0 on Hopper-v4" in text


def test_the_chapter_is_the_same_from_everywhere(fake, tmp_path, monkeypatch) -> None:
    """From other folders, in another order of files, in another process with another matplotlibrc."""
    one_of_each(fake, HOPPER, 2)
    for seed in range(1, 7):  # The bootstrap draws runs by their number.
        values = np.random.default_rng(seed).uniform(1, 3, (3, 2))
        fake("momba", values, {100_000: values / 2, 300_000: values}, seed=seed)
    source = tmp_path / "records"
    one, other = tmp_path / "one", tmp_path / "elsewhere" / "other"
    other.mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    main(["chapter4", "records", "--output", "one"])
    for number, folder in enumerate(sorted(source.iterdir(), reverse=True)):
        shutil.copytree(folder, other / "copies" / f"{number:03}")
    (other / "matplotlibrc").write_text("lines.linewidth: 7\nfont.size: 20\n")
    command = [sys.executable, "-m", "sb3_momba.benchmark", "chapter4", str(other / "copies"), "--output", "out"]
    subprocess.run(command, cwd=other, check=True, capture_output=True)
    names = sorted(path.name for path in one.iterdir())
    assert len(names) == 10
    assert sorted(path.name for path in (other / "out").iterdir()) == names
    for name in names:
        content = (one / name).read_bytes()
        assert content == (other / "out" / name).read_bytes(), name
        assert str(tmp_path).encode() not in content


def test_the_chapter_of_the_first_records(tmp_path, capsys) -> None:
    main(["chapter4", str(FIRST), "--output", str(tmp_path)])
    assert f"Written to {tmp_path / 'chapter4.md'}." in capsys.readouterr().out
    text = (tmp_path / "chapter4.md").read_text()
    # As report.md has them.
    assert "| HalfCheetah-v4 | HV / 10^6 | records | **4.751 [4.697, 4.805]** |" in text
    assert "| momba | missing | 2/2 | missing | 2/2 | missing | missing | missing |" in text
    assert "- momba: ent_coef auto_0.01 instead of auto_0.2; steps 30,000 instead of 1,000,000.\n" in text
    assert "No records at all, and missing everywhere: Ant-v4, Hopper-v3, Humanoid-v4, Swimmer-v4, Walker2d-v4." in text
    assert "Table 4.5: capql_uniform." in text


def test_records_of_other_tasks_alone_are_an_error_that_says_what_can_be_done(fake, tmp_path) -> None:
    with pytest.raises(ValueError, match=r"the records are of E\. python -m sb3_momba\.benchmark report") as error:
        write_chapter([fake("momba", FRONT, env="E")], tmp_path / "out")
    assert HOPPER in str(error.value)
    assert not (tmp_path / "out").exists()


def test_bad_input_ends_with_one_line_of_error_before_anything_is_written(fake, tmp_path) -> None:
    for steps in (1, 2):
        fake("momba", FRONT, settings={"steps": steps})
    with pytest.raises(SystemExit, match=r"error: momba on MO-Hopper-v4 has two settings"):
        main(["chapter4", str(tmp_path / "records"), "--output", str(tmp_path / "out")])
    with pytest.raises(SystemExit, match="does not exist"):
        main(["chapter4", str(tmp_path / "nothing")])
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------------------------------------------------------- figure 3.1


class OneStep(gym.Env):
    """Earns (1, 3), whatever is done."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)
    reward_space = spaces.Box(-5, 5, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return self.np_random.uniform(-1, 1, 1).astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[Any, ...]:
        return np.zeros(1, np.float32), np.array([1, 3], np.float32), True, False, {}


@pytest.fixture
def one_step() -> Iterator[str]:
    gym.register("OneStep-v0", OneStep)
    yield "OneStep-v0"
    del gym.registry["OneStep-v0"]


def trained(env: str, **kwargs: Any) -> sb3_momba.MOMBA:
    policy_kwargs = {"net_arch": [32, 32], "n_atoms": 41}
    model = tiny_model(env, "MlpPolicy", learning_rate=3e-3, ent_coef=0.01, policy_kwargs=policy_kwargs, **kwargs)
    return model.learn(300)


def test_reset_observations_are_those_of_the_episodes_with_the_preference_last(one_step) -> None:
    found = reset_observations(one_step, np.array([0.25, 0.75]), 3, seed=5)
    starts = [OneStep().reset(seed=seed)[0][0] for seed in (5, 6, 7)]
    np.testing.assert_array_equal(found, [[start, 0.25, 0.75] for start in np.float32(starts)])


@pytest.mark.parametrize("centering", [False, True], ids=["", "centred"])
@pytest.mark.parametrize("vector", [False, True], ids=["scalarised", "vector"])
def test_predicted_distributions_by_hand(one_step, vector: bool, centering: bool) -> None:
    """Of one critic with all its mass, softmax of 40 against 0, on the second atom, and one with it on the third. A mean
    reward of (3, 1) is worth (6, 2), to w = (0.5, 0.5) 4."""
    model = tiny_model(one_step, vector_values=vector, reward_centering=centering, gamma=0.5)
    if centering:
        model.policy.reward_center.statistics.mean.copy_(th.tensor([3.0, 1.0]))
    model.policy.return_scale.max_return.fill_(6.0)  # Rewards are halved.
    n_values = 2 if vector else 1
    logits = th.zeros(3, 2, n_values, 11)
    logits[:, 0, :, 1] = logits[:, 1, :, 2] = 40.0
    model.policy.critic.forward = lambda observations, actions: logits
    state = th.get_rng_state()
    atoms, probabilities = predicted(model, np.array([[0.0, 0.5, 0.5]] * 3, np.float32))
    assert th.equal(th.get_rng_state(), state)
    lacking = np.array([[6], [2]] if vector else [[4]]) * centering
    np.testing.assert_allclose(atoms, [np.arange(-10, 11, 2)] * n_values + lacking)
    np.testing.assert_allclose(probabilities, [[0, 0.5, 0.5, *[0] * 8]] * n_values, atol=1e-12)


def test_figure_3_1_of_critics_that_have_learned(one_step, tmp_path, capsys) -> None:
    """Both know that (1, 3) is earned, so that w = (0.5, 0.5) is worth 2."""
    for name, vector in (("scalarised", False), ("vector", True)):
        trained(one_step, vector_values=vector).save(tmp_path / f"{name}.zip")
    models = [str(tmp_path / f"{name}.zip") for name in ("scalarised", "vector")]
    main(["figure31", one_step, *models, "--output", str(tmp_path / "one.png"), "--episodes", "8"])
    assert (tmp_path / "one.png").read_bytes().startswith(PNG)
    rows = cells_of(capsys.readouterr().out)[1:10]
    exact = {"objective 1": 1.0, "objective 2": 3.0}
    scalarised = {"[0, 1]": 3.0, "[0.5, 0.5]": 2.0, "[1, 0]": 1.0}
    assert len(rows) == 3 + 6
    for _, preference, name, by_critic, by_rollouts in rows:
        expected = exact.get(name) or scalarised[preference]
        assert float(by_rollouts) == expected
        assert float(by_critic) == pytest.approx(expected, abs=0.3)


def test_models_without_distributions_or_preferences_are_refused(one_step, tmp_path) -> None:
    tiny_model(one_step, critic_loss="mse").save(tmp_path / "mse.zip")
    tiny_model("Pendulum-v1").save(tmp_path / "single.zip")
    for name, said in (("mse", "predict no distribution"), ("single", "one objective"), ("nothing", "nothing.zip")):
        with pytest.raises(SystemExit, match=said):
            main(["figure31", one_step, str(tmp_path / f"{name}.zip"), "--output", str(tmp_path / "out.png")])
    assert not (tmp_path / "out.png").exists()
