"""Grids as yaml: which runs they ask for, and what they refuse."""

import re
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from sb3_momba import train
from sb3_momba.baselines.settings import VARIANTS
from sb3_momba.benchmark import execution, grid
from sb3_momba.benchmark.grid import Cell, cells_of, make_cells, merged, read_grid, shipped_grids
from sb3_momba.envs.preferences import preference_grid
from sb3_momba.envs.registry import TASKS
from sb3_momba.files import FileFormatError, FolderInUseError, alone_in
from sb3_momba.train import as_arguments
from sb3_momba.zoo.configuration import check_hyperparameters, read_configuration, with_defaults
from tests.test_benchmark import write_record

MINE = {"variants": ["momba", "capql"], "tasks": ["MO-Hopper-v4", "MO-Ant-v4"], "seeds": 2}
NOTHING = {"grid": [], "conf": [], "env": [], "seeds": None, "auto_ent_coef": None}


def written(folder: Path, **entries: Any) -> str:
    path = folder / "mine.yml"
    path.write_text(yaml.safe_dump({**MINE, **entries}))
    return str(path)


def asked_for(*options: str, **given: Any) -> list[Cell]:
    return cells_of(Namespace(**{**NOTHING, **given}), options)


def test_a_grid_is_every_variant_on_every_task_with_every_seed(tmp_path) -> None:
    found = asked_for(grid=[written(tmp_path)])
    assert found == make_cells(MINE["variants"], MINE["tasks"], 2)
    assert len(found) == 8


def test_the_command_line_wins_over_a_grid(tmp_path) -> None:
    path = written(tmp_path, options={"steps": 500, "n_episodes": 2}, auto_ent_coef=0.05)
    found = asked_for("--steps", "300", grid=[path], env=["MO-Swimmer-v4"], seeds=1, auto_ent_coef=0.01)
    assert [cell.name for cell in found] == ["momba/MO-Swimmer-v4/0", "capql/MO-Swimmer-v4/0"]
    settings = train.parse(found[0].arguments(tmp_path))
    assert (settings.steps, settings.n_episodes, settings.hyperparameters["ent_coef"]) == (300, 2, "auto_0.01")


def test_options_are_words_of_the_training(tmp_path) -> None:
    options = {"steps": "3e4", "her": True, "set": {"gamma": 0.9, "policy_kwargs.support": [-1, 1]}, "reference_point": [-1, 0]}
    words = ["--steps", "3e4", "--her", "--set", "gamma=0.9", "--set"]
    assert as_arguments(options) == [*words, "policy_kwargs.support=[-1, 1]", "--reference-point", "-1", "0"]
    (cell, *_) = asked_for(grid=[written(tmp_path, options=options)])
    settings = train.parse(cell.arguments(tmp_path))
    assert (settings.steps, settings.reference_point) == (30_000, [-1, 0])
    assert settings.hyperparameters["gamma"] == 0.9
    assert settings.hyperparameters["policy_kwargs"]["support"] == [-1, 1]


def test_what_two_grids_share_is_run_once() -> None:
    several = asked_for(grid=["value_representation", "normalization"], env=["MO-Hopper-v4"], seeds=1)
    assert [cell.name for cell in several].count("momba/MO-Hopper-v4/0") == 1
    assert len(several) == 8 + 8 - 1


def test_grids_that_ask_for_one_run_in_two_ways_are_refused(tmp_path) -> None:
    (tmp_path / "b").mkdir()
    grids = [written(tmp_path, options={"steps": 5}), written(tmp_path / "b", options={"steps": 6})]
    with pytest.raises(ValueError, match=r"momba/MO-Hopper-v4/0 is asked for with --steps 5 and with --steps 6: run these"):
        asked_for(grid=grids)


def test_runs_for_one_preference_each(tmp_path) -> None:
    entries = {"tasks": ["MO-Hopper-v4", "MO-Hopper-3obj-v4"], "variants": ["momba"], "seeds": 1}
    found = asked_for(grid=[written(tmp_path, **entries, fixed_preferences={2: 4, 3: 6})])
    assert [cell.name for cell in found[:4]] == [f"fixed_preference-0{n}/MO-Hopper-v4/0" for n in range(4)]
    assert len(found) == 4 + 6
    settings = [train.parse(cell.arguments(tmp_path)) for cell in found]
    assert {one.label for one in settings} == {"fixed_preference"}
    np.testing.assert_allclose([one.preference for one in settings[:4]], preference_grid(2, 4))
    np.testing.assert_allclose([one.preference for one in settings[4:]], preference_grid(3, 6))


def test_variations_are_the_first_variant_with_other_settings(tmp_path) -> None:
    variations = {"near": {"gamma": 0.9}, "wide": {"policy_kwargs.critic_hidden_dim": 1024, "critic_loss": "mse"}}
    path = written(tmp_path, tasks=["MO-Hopper-v4"], seeds=1, options={"set": {"gamma": 0.95}}, variations=variations)
    found = asked_for(grid=[path])
    assert [cell.name.split("/")[0] for cell in found] == ["momba", "near", "wide", "capql"]
    momba, near, wide, _ = settings = [train.parse(cell.arguments(tmp_path / cell.name)) for cell in found]
    assert [one.label for one in settings] == ["momba", "near", "wide", "capql"]
    assert [one.hyperparameters["gamma"] for one in (momba, near, wide)] == [0.95, 0.9, 0.95]
    assert wide.hyperparameters["critic_loss"] == "mse"
    assert wide.hyperparameters["policy_kwargs"]["critic_hidden_dim"] == 1024
    near.hyperparameters["gamma"] = 0.95
    assert near.hyperparameters == momba.hyperparameters


def test_a_variation_and_a_variant_of_one_name_are_an_error(tmp_path) -> None:
    with pytest.raises(ValueError, match=r"momba and capql have one name, capql/MO-Hopper-v4/0"):
        asked_for(grid=[written(tmp_path, variations={"capql": {"gamma": 0.9}})])


def test_a_number_of_objectives_without_preferences_is_an_error(tmp_path) -> None:
    path = written(tmp_path, tasks=["MO-Hopper-3obj-v4"], fixed_preferences={2: 20})
    with pytest.raises(ValueError, match=r"fixed_preferences=\{2: 20\}: MO-Hopper-3obj-v4 has 3 objectives"):
        asked_for(grid=[path])


def test_settings_that_cannot_be_are_named_with_their_run(tmp_path) -> None:
    (bad,) = make_cells(["value_mlp_ce_vector"], ["MO-Hopper-v4"], 1, ["--set", "policy_kwargs.critic_hidden_dim=16"])
    with pytest.raises(ValueError, match=r"^value_mlp_ce_vector/MO-Hopper-v4/0: policy_kwargs: MlpPolicy has no argument"):
        grid.checked([bad], tmp_path)
    (bad,) = make_cells(["gpi_ls"], ["MO-Hopper-v4"], 1, ["--steps", "130"])
    with pytest.raises(ValueError, match=r"^gpi_ls/MO-Hopper-v4/0: steps=130 is no whole number"):
        grid.checked([bad], tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="file is a file: give a folder"):
        grid.checked(make_cells(["momba"], ["MO-Hopper-v4"], 1), tmp_path / "file")


BAD = {
    "an entry that there is not": ({"task": []}, "A grid has no entry 'task': did you mean 'tasks'"),
    "seeds that are no number": ({"seeds": "ten"}, "seeds is 'ten'; it must be a whole number"),
    "no variants": ({"variants": []}, "variants is []; it must be a list of names"),
    "a variant that is no name": ({"variants": ["momba", 5]}, "variants is ['momba', 5]; it must be a list of names"),
    "a task that is no name": ({"tasks": [None]}, "tasks is [None]; it must be a list of names"),
    "preferences that are no number": ({"fixed_preferences": {2: "a"}}, "it must be a mapping of whole numbers"),
    "an option without a value": ({"options": {"steps": None}}, "it must be a mapping of options with their values"),
    "an option that is no name": ({"options": {5: 3}}, "it must be a mapping of options with their values"),
    "an environment among the options": ({"options": {"env": "MO-Ant-v4"}}, "none of seed, output, env"),
    "a start of alpha that is no number": ({"auto_ent_coef": "low"}, "auto_ent_coef is 'low'; it must be a number"),
    "a variation without settings": ({"variations": {"near": {}}}, "variations is {'near': {}}; it must be a mapping of names"),
    "a variation that is a path": ({"variations": {"../near": {"gamma": 0.9}}}, "names (letters, digits, _ . -)"),
    "a variation of the folder above": ({"variations": {"..": {"gamma": 0.9}}}, "names (letters, digits, _ . -)"),
    "a variation without a name": ({"variations": {"": {"gamma": 0.9}}}, "names (letters, digits, _ . -)"),
    "a variation like an option": ({"variations": {"--near": {"gamma": 0.9}}}, "names (letters, digits, _ . -)"),
    "a variation named like its variant": ({"variations": {"momba": {"gamma": 0.9}}}, "is the first variant's own name"),
    "variations for one preference": (
        {"variants": ["momba"], "variations": {"near": {"gamma": 0.9}}, "fixed_preferences": {2: 20}},
        "fixed_preferences and variations: use a grid for each",
    ),
    "no seeds": ({"seeds": 0}, "seeds=0: at least one"),
    "variants that are no list": ({"variants": "momba"}, "variants is 'momba'; it must be a list of names"),
    "options that are no mapping": ({"options": ["--steps"]}, "options is"),
    "an option that is the grid's own": ({"options": {"seed": 3}}, "none of seed, output, env"),
    "a variant that there is not": ({"variants": ["mombo"]}, "did you mean 'momba'"),
}


@pytest.mark.parametrize(("entries", "said"), BAD.values(), ids=BAD)
def test_what_is_no_grid_is_an_error(tmp_path, entries: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        asked_for(grid=[written(tmp_path, **entries)])


def test_what_is_missing_is_named(tmp_path) -> None:
    path = tmp_path / "mine.yml"
    path.write_text("variants: [momba]\ntasks: [MO-Ant-v4]\n")
    with pytest.raises(ValueError, match="has no seeds"):
        read_grid(str(path))
    path.write_text("- momba\n")
    with pytest.raises(ValueError, match=r"mine\.yml"):
        read_grid(str(path))
    path.write_text("variants: [momba\n")
    with pytest.raises(ValueError, match="is not valid yaml"):
        read_grid(str(path))
    with pytest.raises(ValueError, match="did you mean 'conditioning'"):
        read_grid("conditionin")


@pytest.mark.parametrize(
    "given", [{}, {"grid": ["utd"], "conf": ["momba"]}, {"conf": ["momba"]}, {"conf": ["momba"], "env": ["MO-Ant-v4"]}], ids=str
)
def test_grids_or_configurations_must_be_given(given: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="--conf"):
        asked_for(**given)


def test_no_cells_are_no_cells() -> None:
    assert merged([]) == []


def test_baselines_are_variants_like_others(tmp_path) -> None:
    path = written(tmp_path, variants=["momba", "gpi_ls_utd_1"], tasks=["MO-Hopper-v4"], seeds=1, auto_ent_coef=0.01)
    ours, theirs = asked_for("--steps", "1e4", grid=[path])
    assert theirs.name == "gpi_ls_utd_1/MO-Hopper-v4/0"
    settings = grid.checked([ours, theirs], tmp_path)[theirs.name]
    assert (settings.algorithm, settings.label, settings.steps) == ("gpi_ls", "gpi_ls_utd_1", 10_000)
    assert settings.hyperparameters == {"gradient_updates": 1}
    assert execution.has_to_run(theirs, settings)
    theirs.program.runs.record_failure(settings, "it did not start")
    assert not execution.has_to_run(theirs, settings)
    assert list(execution.failed([theirs], tmp_path)) == [theirs.name]


def test_what_an_option_makes_alike_is_not_trained_twice(tmp_path) -> None:
    alike = asked_for(grid=["alpha_start"], env=["MO-Hopper-v4"], seeds=1, auto_ent_coef=0.01)
    with pytest.raises(ValueError, match="alpha_start_5e-2/MO-Hopper-v4/0 have the same settings: leave one of"):
        grid.checked(alike, tmp_path)
    grid.checked(asked_for(grid=["alpha_start"], env=["MO-Hopper-v4"], seeds=1), tmp_path)


def test_a_folder_is_emptied_by_one_process_only(tmp_path, monkeypatch) -> None:
    """A training that goes on after its grid was killed keeps its folder."""
    monkeypatch.setattr(execution, "SECONDS_FOR_A_LOCK", 0.1)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "model.zip").write_text("mine")
    with alone_in(tmp_path / "run"), pytest.raises(FolderInUseError):
        execution.way_to_run(tmp_path / "run")
    assert (tmp_path / "run" / "model.zip").exists()
    assert execution.way_to_run(tmp_path / "run") == "begin"
    assert [path.name for path in (tmp_path / "run").iterdir()] == [".lock"]


def test_checkpoints_that_cannot_be_read_are_not_thrown_away(tmp_path) -> None:
    write_record(tmp_path / "run" / "record.jsonl", error="cut off")
    checkpoint = tmp_path / "run" / "checkpoints" / "0001-000000100"
    checkpoint.mkdir(parents=True)
    (checkpoint / "manifest.json").write_text("{}")
    with pytest.raises(FileFormatError):
        execution.way_to_run(tmp_path / "run")
    assert checkpoint.exists()


# ------------------------------------------------------------------------------------------------------- shipped grids


@pytest.mark.parametrize("name", shipped_grids())
def test_shipped_grids_are_of_the_seven_tasks(name: str) -> None:
    grid = read_grid(name)
    assert sorted(grid.tasks) == sorted(TASKS)
    assert len(set(grid.variants)) == len(grid.variants)
    for cell in make_cells(grid.variants, grid.tasks[:1], 1, as_arguments(grid.options), variations=grid.variations):
        assert cell.program.parse(cell.arguments(Path("x"))).label == (cell.method or cell.conf)


@pytest.mark.parametrize("name", ["ideas", "ideas_swimmer"])
def test_shipped_variations_are_settings_that_there_are_and_no_two_are_alike(name: str) -> None:
    """On any of the tasks: a variant may have settings of its own for some."""
    grid = read_grid(name)
    for task in grid.tasks:
        seen: dict[str, str] = {}
        for cell in make_cells(grid.variants, [task], 1, as_arguments(grid.options), variations=grid.variations):
            settings = cell.program.parse(cell.arguments(Path("x")))
            check_hyperparameters(settings.policy, settings.hyperparameters)
            complete = with_defaults(settings.policy, settings.hyperparameters)
            assert seen.setdefault(repr(sorted(complete.items(), key=str)), cell.name) == cell.name


def test_no_two_variants_of_the_shipped_grids_are_one_method() -> None:
    """What would be trained twice is Momba's under its own name."""
    seen: dict[str, str] = {}
    for name in shipped_grids():
        for conf in set(read_grid(name).variants) - set(VARIANTS):
            found = read_configuration(conf, "MO-Hopper-v4")
            what = repr((found.policy, sorted(with_defaults(found.policy, found.hyperparameters).items(), key=str)))
            assert seen.setdefault(what, conf) == conf


def test_the_sizes_of_chapter_4() -> None:
    """Sections 4.3.1 to 4.3.5 and 4.4: combinations and seeds."""
    sizes = {name: (len(read_grid(name).variants), read_grid(name).seeds) for name in shipped_grids()}
    assert sizes["value_representation"] == (8, 10)
    assert sizes["critic_scaling"] == (16, 10)
    assert sizes["normalization"] == (8, 10)
    assert sizes["conditioning"] == (4, 5)
    assert sizes["utd"] == (4, 10)
    assert sizes["her_par"] == (4, 10)
    fixed = asked_for(grid=["fixed_preference"])
    assert len(fixed) == 6 * 20 + 50


def test_grids_are_named_in_the_help(capsys) -> None:
    from sb3_momba.benchmark.__main__ import main

    with pytest.raises(SystemExit):
        main(["run", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert all(name in said.replace("- ", "-") for name in grid.shipped_grids())
