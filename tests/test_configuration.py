"""Yaml files in rl_zoo3's format, read without rl_zoo3."""

import gymnasium as gym
import pytest
import yaml
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.utils import LinearSchedule

from sb3_momba.envs.registry import preference_id
from sb3_momba.runs import hyperparameters_of
from sb3_momba.train import parse
from sb3_momba.zoo.configuration import check_classes, check_entry, find_entry, literal, read_configuration, with_schedules
from tests.stubs import StubEnv

TASK = "mo-hopper-2obj-v5"


def test_entries_are_found_under_both_kinds_of_ids(tmp_path) -> None:
    path = tmp_path / "two.yml"
    path.write_text(yaml.dump({f"momba/{TASK}": {"gamma": 0.9}, "MO-Ant-v4": {"gamma": 0.8}, "default": {"gamma": 0.7}}))
    found = [find_entry(str(path), name)[1]["gamma"] for name in (TASK, f"momba/{TASK}", "momba/MO-Ant-v4", "MO-Hopper-v4")]
    assert found == [0.9, 0.9, 0.8, 0.7]


def test_the_environments_arguments_come_from_the_file_and_the_command_line(tmp_path) -> None:
    path = tmp_path / "env.yml"
    path.write_text(yaml.dump({"default": {"env_kwargs": {"physics": "current", "width": 64}}}))
    assert parse(["--env", "MO-Ant-v4", "--conf", str(path), "--env-kwargs", "width=32"]).env_kwargs == {
        "physics": "current",
        "width": 32,
    }


def test_one_preference_takes_the_place_of_a_configurations_sampler() -> None:
    given = ["--env", "MO-HalfCheetah-v4", "--conf", "momba_plus"]
    assert parse(given).hyperparameters["preference_sampler"] == "gain"
    one = parse([*given, "--preference", "0.5", "0.5"])
    assert hyperparameters_of(one)["preference_sampler"] == [0.5, 0.5]
    both = parse([*given, "--preference", "0.5", "0.5", "--set", "preference_sampler=uniform"])
    with pytest.raises(ValueError, match="leave one of them out"):
        hyperparameters_of(both)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"policy_kwargs": "dict(n_atoms=5)"}, "policy_kwargs='dict.n_atoms=5.' is Python code, and nothing is evaluated"),
        ({"normalize": True}, "normalize must be false"),
        ({"n_envs": 0}, "n_envs=0: it must be a whole number of at least 1"),
        ({"env_wraper": "x"}, "no hyperparameter 'env_wraper': did you mean 'env_wrapper'"),
        ({"policy_kwargs": {"n_atom": 5}}, "no argument 'n_atom': did you mean 'n_atoms'"),
    ],
)
def test_entries_that_cannot_be_are_named(entry: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_entry(entry)


@pytest.mark.parametrize("key", ["callback", "env_wrapper", "vec_env_wrapper"])
@pytest.mark.parametrize(
    "named",
    ["os.system", ["os.system"], {"os.system": {"command": "true"}}, [{"os.system": {"command": "true"}}]],
    ids=["name", "list", "mapping", "list of mappings"],
)
def test_what_is_no_callback_or_wrapper_is_refused(key: str, named: object) -> None:
    with pytest.raises(ValueError, match=f"{key}: 'os.system' is no subclass of "):
        check_classes(check_entry({key: named}))


@pytest.mark.parametrize(
    ("key", "name"),
    [
        ("callback", "sb3_momba.pareto.callbacks.ParetoEvalCallback"),
        ("callback", "stable_baselines3.common.callbacks.CheckpointCallback"),
        ("env_wrapper", "gymnasium.wrappers.RescaleAction"),
        ("vec_env_wrapper", "stable_baselines3.common.vec_env.VecCheckNan"),
    ],
)
def test_classes_are_named_for_what_they_are(key: str, name: str) -> None:
    others = {"callback": "gymnasium.Wrapper", "env_wrapper": "gymnasium.Env", "vec_env_wrapper": "gymnasium.Wrapper"}
    check_classes(check_entry({key: [name, {name: {}}]}))
    with pytest.raises(ValueError, match=f"{key}: '{others[key]}' is no subclass of "):
        check_classes(check_entry({key: [name, others[key]]}))


@pytest.mark.parametrize(
    "name", ["sb3_momba.files.os.system", "sb3_momba.none.Nothing", "sb3_momba..files.x", ".x.y", "..a", ""]
)
def test_classes_that_are_in_no_module_are_named(name: str) -> None:
    with pytest.raises(ValueError, match=f"callback: '{name}' cannot be imported"):
        check_classes({"callback": name})


@pytest.mark.parametrize("name", ["sb3_momba.files.read_tree", "sb3_momba.files.os", "sb3_momba"])
def test_what_is_no_class_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"callback: '{name}' is no subclass of BaseCallback"):
        check_classes({"callback": name})


def test_objects_of_a_file_of_python_are_as_they_are() -> None:
    given = {"callback": [CheckpointCallback(1, "x")], "env_wrapper": [StubEnv, {StubEnv: {}}]}
    entry = check_entry(given)
    check_classes(entry)
    assert {key: entry[key] for key in given} == given


def test_what_only_rl_zoo3_can_do_is_an_error_elsewhere(tmp_path) -> None:
    path = tmp_path / "noise.yml"
    path.write_text(yaml.dump({"default": {"noise_type": "normal", "noise_std": 0.1}}))
    with pytest.raises(ValueError, match="noise_type needs rl_zoo3: train with python -m"):
        read_configuration(str(path), "MO-Ant-v4")


def test_learning_rates_that_fall_linearly() -> None:
    schedule = with_schedules({"learning_rate": "lin_3e-4"})["learning_rate"]
    assert isinstance(schedule, LinearSchedule)
    assert [schedule(x) for x in (1.0, 0.5, 0.0)] == pytest.approx([3e-4, 1.5e-4, 0])
    to_a_tenth = with_schedules({"learning_rate": "lin_3e-4_3e-5"})["learning_rate"]
    assert [to_a_tenth(x) for x in (1.0, 0.5, 0.0)] == pytest.approx([3e-4, 1.65e-4, 3e-5])
    assert with_schedules({"learning_rate": 1e-3}) == {"learning_rate": 1e-3}
    for bad in ("linear_3e-4", "lin_-1", "lin_nan"):
        with pytest.raises(ValueError, match=f"learning_rate='{bad}': give a number of at least 0, or lin_3e-4"):
            with_schedules({"learning_rate": bad})


def test_only_numbers_with_an_exponent_are_read_from_strings() -> None:
    """yaml 1.1 takes 1e-3 for a string; what is quoted is one."""
    read = literal({"a": "1e-3", "b": "1E6", "c": "007", "d": "nan", "e": ["2.5e+2", "x"], "f": "3"})
    assert read == {"a": 1e-3, "b": 1_000_000, "c": "007", "d": "nan", "e": [250, "x"], "f": "3"}


@pytest.mark.parametrize("rate", ["3e4", "lin_inf", "lin_nan", "lin_-1", "linear", "lin_", "lin_1e-3_x", "lin__1e-3"])
def test_learning_rates_that_cannot_be_are_named(rate: str) -> None:
    with pytest.raises(ValueError, match=f"learning_rate='{rate}': give a number of at least 0, or lin_3e-4"):
        with_schedules({"learning_rate": rate})


def test_an_entry_of_an_id_with_a_namespace_is_found_under_both(tmp_path) -> None:
    gym.register("mine/Stub-v0", StubEnv)
    try:
        path = tmp_path / "two.yml"
        path.write_text(yaml.dump({"mine/Stub-v0": {"gamma": 0.9}, "default": {"gamma": 0.7}}))
        assert preference_id("mine/Stub-v0") == "momba/mine.Stub-v0"
        found = [find_entry(str(path), name)[1]["gamma"] for name in ("mine/Stub-v0", "momba/mine.Stub-v0")]
        assert found == [0.9, 0.9]
    finally:
        for name in ("mine/Stub-v0", "momba/mine.Stub-v0"):
            gym.registry.pop(name, None)


@pytest.mark.parametrize("steps", ["1.9", "nan", "inf"])
def test_steps_are_whole(steps: str, capsys) -> None:
    with pytest.raises(SystemExit):
        parse(["--env", TASK, "--steps", steps])
    assert f"'{steps}'" in capsys.readouterr().err
