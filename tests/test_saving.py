"""Files: what goes in comes out bit by bit, a damaged one is an error, and a broken write never costs the old one."""

import errno
import io
import os
import random
import re
import subprocess
import sys
import zipfile
from collections import deque
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_momba import MOMBA, MlpPolicy, PreferenceReplayBuffer, SimbaPolicy, files, make_mo_vec_env
from sb3_momba.envs.preferences import ConeSampler, FixedSampler, GainSampler, PerStepSampler, UniformSampler
from sb3_momba.files import FileFormatError, atomic_write, read_tree, write_tree
from tests.stubs import StubEnv, assert_same_tree, tiny_model

OBSERVATIONS = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
PREFERENCES = np.random.default_rng(1).dirichlet([1, 1], size=7)


def through_a_file(tree: Any) -> Any:
    file = io.BytesIO()
    assert write_tree(file, tree) == []
    again, left_out = read_tree(file)
    assert left_out == []
    return again


def saved(model: MOMBA) -> io.BytesIO:
    file = io.BytesIO()
    model.save(file)
    return file


def actions_of(model: MOMBA) -> np.ndarray:
    return model.predict(OBSERVATIONS, preference=PREFERENCES, deterministic=True)[0]


# -------------------------------------------------------------------------------------------------- round trips

DTYPES = ["bool", "int8", "uint8", "int16", "int32", "int64", "uint64", "float16", "float32", "float64", ">f4", ">i8"]
arrays = st.sampled_from(DTYPES).flatmap(
    lambda dtype: hnp.arrays(np.dtype(dtype), hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
)
native_arrays = arrays.filter(lambda x: x.dtype.isnative).map(np.ascontiguousarray)
tensors = native_arrays.map(lambda x: th.from_numpy(x.copy()))
numbers = st.integers(-(2**70), 2**70) | st.floats() | st.booleans()
scalars = st.none() | numbers | st.text()
keys = scalars.filter(lambda x: x == x) | st.tuples(st.integers(), st.text())
trees = st.recursive(
    scalars | arrays | tensors,
    lambda x: (
        st.lists(x, max_size=3)
        | st.lists(x, max_size=3).map(tuple)
        | st.builds(deque, st.lists(x, max_size=3), st.none() | st.integers(3, 5))
        | st.dictionaries(st.text() | st.just("~"), x, max_size=3)
        | st.dictionaries(keys, x, max_size=3)
    ),
    max_leaves=8,
)


@settings(deadline=None, max_examples=200)
@given(trees)
def test_a_tree_comes_back_bit_by_bit(tree):
    assert_same_tree(through_a_file(tree), tree)


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf"), -0.0, 5e-324, 1.7976931348623157e308, 0.1])
def test_floats_come_back_exactly(number):
    again = through_a_file({"x": number, "array": np.array([number])})
    assert repr(again["x"]) == repr(number)
    assert again["array"].tobytes() == np.array([number]).tobytes()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [(), (0,), (3, 0, 2), (1,), (2, 3)], ids=str)
def test_arrays_keep_dtype_and_shape_and_can_be_written_to(dtype, shape):
    array = np.arange(np.prod(shape, dtype=int)).reshape(shape).astype(dtype)
    again = through_a_file([array])[0]
    assert_same_tree(again, array)
    again[...] = 1
    if np.dtype(dtype).isnative:
        tensor = th.from_numpy(array.copy())
        assert_same_tree(through_a_file(tensor), tensor)


def test_views_and_fortran_order_keep_their_values():
    array = np.arange(24.0).reshape(4, 6)
    tree = {"transposed": array.T, "strided": array[::2, ::-3], "fortran": np.asfortranarray(array)}
    again = through_a_file(tree)
    for name in tree:
        np.testing.assert_array_equal(again[name], tree[name], strict=True)
    parameter = th.nn.Parameter(th.arange(6.0).view(2, 3).T)
    assert_same_tree(through_a_file(parameter), parameter.detach())


def test_numpy_scalars_come_back_as_numbers_of_python():
    tree = {"i": np.int64(3), "f": np.float32(0.1), "b": np.bool_(True), np.int64(4): 1}
    assert_same_tree(through_a_file(tree), {"i": 3, "f": float(np.float32(0.1)), "b": True, 4: 1})


@pytest.mark.parametrize(
    "keys",
    [
        ("a.b", "a"),
        ("a/b", "a_b"),
        ("a/b", "a\\b"),
        ("1", 1),
        ("", "."),
        ("../x", "/x"),
        ("A", "a"),
        ("a", "a_"),
        ("é", "e\u0301"),
    ],
    ids=repr,
)
def test_keys_whose_names_look_alike_do_not_collide(keys):
    tree = {key: {"b": np.full(2, i), "": np.full(3, i)} for i, key in enumerate(keys)}
    assert_same_tree(through_a_file(tree), tree)


@pytest.mark.parametrize("key", ["a\0b", "\ud800", "x" * 70_000, "tree.json", " ", "con", "~"], ids=lambda key: repr(key)[:12])
def test_any_string_can_be_the_key_of_an_array(key):
    tree = {key: np.ones(2), "other": np.zeros(3)}
    assert_same_tree(through_a_file(tree), tree)


OBJECTS = [
    UniformSampler(3),
    ConeSampler(2, 30.0),
    GainSampler(2, candidates=4, remembered_episodes=7),
    FixedSampler((0.25, 0.75)),
    PerStepSampler(UniformSampler(2)),
    TrainFreq(3, TrainFrequencyUnit.EPISODE),
    ConstantSchedule(0.1),
]


@pytest.mark.parametrize("x", OBJECTS, ids=lambda x: type(x).__name__)
def test_registered_objects_come_back_equal(x):
    again = through_a_file({"x": x})["x"]
    assert type(again) is type(x)
    assert getattr(again, "val", again) == getattr(x, "val", x)


def test_schedules_and_noise_come_back_with_their_values():
    tree = {
        "linear": LinearSchedule(1.0, 0.1, 0.5),
        "float": FloatSchedule(LinearSchedule(1.0, 0.1, 0.5)),
        "noise": NormalActionNoise(np.array([1.0, 2.0]), np.zeros(2)),
    }
    again = through_a_file(tree)
    for progress in (1.0, 0.8, 0.3, 0.0):
        assert again["linear"](progress) == again["float"](progress) == tree["linear"](progress)
    np.testing.assert_array_equal(again["noise"](), [1.0, 2.0])


def test_spaces_come_back_with_their_random_state():
    space = StubEnv().action_space
    space.seed(3)
    space.sample()
    again = through_a_file({"space": space})["space"]
    assert again == space
    np.testing.assert_array_equal(again.sample(), space.sample())


@pytest.mark.parametrize("cls", [SimbaPolicy, MlpPolicy, PreferenceReplayBuffer, ReplayBuffer, th.optim.Adam, th.optim.SGD])
def test_classes_of_torch_stable_baselines3_and_this_package_are_stored_by_name(cls):
    assert through_a_file({"cls": cls})["cls"] is cls


class LocalModule(th.nn.Module):
    pass


@pytest.mark.parametrize("x", [LocalModule, print, len, lambda: 1, partial(print), os.system], ids=lambda x: type(x).__name__)
def test_a_callable_is_left_out_with_a_warning_that_names_it(x):
    file = io.BytesIO()
    with pytest.warns(UserWarning, match=r"a\.b is a callable .*left out.*custom_objects"):
        assert write_tree(file, {"a": {"b": x, "c": 1}}) == ["a.b"]
    assert read_tree(file) == ({"a": {"c": 1}}, ["a.b"])


@pytest.mark.parametrize(
    ("leaf", "match"),
    [
        (object(), "a.b is a object"),
        (b"x", "a.b is a bytes"),
        ({1, 2}, "a.b is a set"),
        (1j, "a.b is a complex"),
        ([lambda: 1], r"a.b.0 is a function"),
        (np.array(["text"]), "a.b is an array of dtype <U4"),
        (np.array([object()]), "a.b is an array of dtype object"),
        (np.array([1j]), "a.b is an array of dtype complex128"),
        (np.zeros(2, dtype=[("x", "f4")]), "a.b is an array of dtype"),
        (th.zeros(2, dtype=th.bfloat16), "a.b"),
    ],
    ids=lambda x: type(x).__name__,
)
def test_anything_else_is_an_error_that_says_where_before_anything_is_written(leaf, match, tmp_path):
    with pytest.raises(TypeError, match=match):
        write_tree(tmp_path / "file", {"a": {"b": leaf}})
    assert os.listdir(tmp_path) == []


# ------------------------------------------------------------------------------------------------- whole or not at all

TREE = {
    "numbers": np.arange(6.0),
    "more": [np.arange(1500, dtype=np.int32).reshape(500, 3), th.ones(2, 2)],
    "text": "é",
    3: None,
}


def fail_at(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, call: int, error: BaseException) -> None:
    """The n-th call of a function raises."""
    original, calls = getattr(owner, name), []

    def function(*args: Any, **kwargs: Any) -> Any:
        calls.append(1)
        if len(calls) == call:
            raise error
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, name, function)


NO_SPACE = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("error", [NO_SPACE, KeyboardInterrupt(), MemoryError()], ids=lambda error: type(error).__name__)
@pytest.mark.parametrize(
    ("owner", "name", "call"),
    [(np.lib.format, "write_array", 1), (np.lib.format, "write_array", 3), (os, "fsync", 1), (os, "replace", 1)],
    ids=lambda x: getattr(x, "__name__", x),
)
def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, owner, name, call, error):
    path = tmp_path / "file.zip"
    write_tree(path, TREE)
    before = path.read_bytes()
    with monkeypatch.context() as patch:
        fail_at(patch, owner, name, call, error)
        with pytest.raises(type(error)):
            write_tree(path, {"new": [np.zeros(2), np.zeros(3), np.zeros(4)]})
    assert os.listdir(tmp_path) == ["file.zip"]
    assert path.read_bytes() == before
    write_tree(path, {"new": 1})
    assert read_tree(path) == ({"new": 1}, [])
    assert os.listdir(tmp_path) == ["file.zip"]


def test_an_exception_inside_atomic_write_leaves_no_file_at_all(tmp_path):
    def write_half() -> None:
        with atomic_write(tmp_path / "new") as file:
            file.write(b"half")
            raise KeyError

    with pytest.raises(KeyError):
        write_half()
    assert os.listdir(tmp_path) == []


def test_an_error_without_a_number_keeps_its_words(tmp_path):
    with pytest.raises(OSError, match="cannot write mode RGBA as JPEG"), atomic_write(tmp_path / "picture.jpg"):
        raise OSError("cannot write mode RGBA as JPEG")


def test_until_the_new_file_is_whole_the_old_one_stands(tmp_path):
    path = tmp_path / "deep" / "file"
    with atomic_write(path) as file:
        file.write(b"old")
        assert not path.exists()
    with atomic_write(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert os.listdir(path.parent) == ["file"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="The system has no pipes with names.")
def test_a_pipe_as_target_is_an_error_and_stays_one(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for name in ("pipe", "link"):
        with pytest.raises(OSError, match=f"{name} is no regular file: give the name of one"), atomic_write(tmp_path / name):
            pass
    assert (tmp_path / "pipe").is_fifo()
    assert sorted(os.listdir(tmp_path)) == ["link", "pipe"]


# ---------------------------------------------------------------------------------------------------- damaged files


def what_went_wrong(damaged: bytes) -> str | None:
    """Nothing, if a damaged file is an error of the right kind, or the damage was where nothing is stored."""
    try:
        tree, left_out = read_tree(io.BytesIO(damaged))
    except FileFormatError:
        return None
    except Exception as error:
        return type(error).__name__
    try:
        assert_same_tree({"tree": tree, "left_out": left_out}, {"tree": TREE, "left_out": []})
    except AssertionError:
        return "other values"
    return None


@pytest.fixture(scope="module")
def content() -> bytes:
    file = io.BytesIO()
    write_tree(file, TREE)
    return file.getvalue()


def test_a_truncated_file_is_an_error_at_every_length(content):
    for length in range(0, len(content), 3):
        with pytest.raises(FileFormatError):
            read_tree(io.BytesIO(content[:length]))


def test_a_file_with_its_front_cut_off_never_loads_wrong_values(content):
    assert {what_went_wrong(content[start:]) for start in range(1, len(content), 7)} == {None}


def positions_of_structure(content: bytes) -> list[int]:
    """All bytes outside the numbers of the one large array, and some of it."""
    start = content.index(TREE["more"][0].tobytes())
    stop = start + TREE["more"][0].nbytes
    return [*range(start), *range(start, stop, 97), *range(stop, len(content))]


def test_a_flipped_bit_never_loads_wrong_values(content):
    wrong: dict[str | None, list[int]] = {}
    for position in positions_of_structure(content):
        for bit in range(8):
            damaged = bytearray(content)
            damaged[position] ^= 1 << bit
            wrong.setdefault(what_went_wrong(bytes(damaged)), []).append(position)
    assert len(wrong.pop(None)) > 1000
    assert wrong == {}


def test_overwritten_bytes_never_load_wrong_values(content):
    rng = random.Random(0)
    positions = positions_of_structure(content)
    wrong = set()
    for _ in range(3000):
        damaged = bytearray(content)
        start = rng.choice(positions)
        n = rng.choice([1, 1, 2, 8])
        damaged[start : start + n] = rng.choice([b"\0", b"\xff", b"(", b"'", b",", b" ", b"9", bytes([rng.randrange(256)])]) * n
        wrong.add(what_went_wrong(bytes(damaged[: len(content)])))
    assert wrong == {None}


def rezipped(content: bytes, members: dict[str, bytes | None], compression: int = zipfile.ZIP_STORED) -> bytes:
    """Members replaced, or removed where None, with checksums that fit."""
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(file, "w", compression) as new:
        for name in old.namelist():
            member = members.get(name, old.read(name))
            if member is not None:
                new.writestr(name, member)
    return file.getvalue()


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b"\xff\xfe",
        b'{"tree": 1}',
        b'{"tree": NaN, "left_out": []}',
        b'{"tree": Infinity, "left_out": []}',
        b'{"tree": {"~": "array"}, "left_out": []}',
        b'{"tree": {"~": "array", "file": "missing"}, "left_out": []}',
        b'{"tree": {"~": "array", "file": 3}, "left_out": []}',
        b'{"tree": {"~": "array", "file": "../../etc/passwd"}, "left_out": []}',
        b'{"tree": {"~": "tuple", "items": 5}, "left_out": []}',
        b'{"tree": {"~": "deque", "items": [1], "maxlen": "x"}, "left_out": []}',
        b'{"tree": {"~": "dict", "items": [[[1], 2]]}, "left_out": []}',
        b'{"tree": {"~": "float", "value": "one"}, "left_out": []}',
        b'{"tree": {"~": "surprise"}, "left_out": []}',
        b'{"tree": {"~": ["tuple"]}, "left_out": []}',
        b'{"tree": {"~": {}}, "left_out": []}',
        b'{"tree": ' + b"[" * 100_000 + b"]" * 100_000 + b', "left_out": []}',
        b'{"tree": {"~": "object", "class": "sb3_momba.envs.preferences.UniformSampler", "state": 3}, "left_out": []}',
        b'{"tree": {"~": "class", "name": 3}, "left_out": []}',
    ],
    ids=lambda text: text[:60].decode(errors="replace"),
)
def test_a_tree_that_means_nothing_is_an_error_that_names_the_file(text, content, tmp_path):
    (tmp_path / "model.zip").write_bytes(rezipped(content, {"tree.json": text}))
    with pytest.raises(FileFormatError, match=r"model\.zip"):
        read_tree(tmp_path / "model.zip")


@pytest.mark.parametrize("header", [b"", b"\x93NUMPY", b"\x93NUMPY\x01\x00\x76\x00{'descr'", b"\x93NUMPY\x09\x00\x76\x00"])
def test_an_array_without_a_proper_header_is_an_error(header, content):
    with pytest.raises(FileFormatError):
        read_tree(io.BytesIO(rezipped(content, {"numbers.npy": header})))


@pytest.mark.parametrize("shape", ["(5,)", "(7,)", "(10000000000000,)", "(-1,)", "(6", "(6,,)", "(06,)", "6", "(6.0,)", "'x'"])
def test_an_array_whose_header_does_not_fit_its_numbers_is_an_error(shape, content):
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    member = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + TREE["numbers"].tobytes()
    with pytest.raises(FileFormatError):
        read_tree(io.BytesIO(rezipped(content, {"numbers.npy": member})))


def test_a_missing_member_is_an_error(content):
    for name in ("tree.json", "numbers.npy"):
        with pytest.raises(FileFormatError, match=re.escape(name)):
            read_tree(io.BytesIO(rezipped(content, {name: None})))


def test_a_file_that_was_zipped_again_with_compression_still_loads(content):
    assert_same_tree(read_tree(io.BytesIO(rezipped(content, {}, zipfile.ZIP_DEFLATED)))[0], TREE)


def test_a_missing_file_is_file_not_found(tmp_path):
    for load in (MOMBA.load, read_tree, tiny_model(StubEnv()).load_replay_buffer):
        with pytest.raises(FileNotFoundError, match="nothing_here"):
            load(tmp_path / "nothing_here")


# ------------------------------------------------------------------------------------------------------ models


@pytest.mark.parametrize("policy", MOMBA.policy_aliases)
@pytest.mark.parametrize("ent_coef", ["auto_0.2", 0.1])
def test_a_loaded_model_has_the_same_parameters_optimisers_statistics_and_predictions(policy, ent_coef, tmp_path):
    model = tiny_model(StubEnv(), policy, ent_coef=ent_coef).learn(45)
    model.save(tmp_path / "model")
    again = MOMBA.load(tmp_path / "model")
    assert_same_tree(again.get_parameters(), model.get_parameters())
    assert len(again.critic.optimizer.state) == len(list(again.critic.parameters()))
    assert again.policy.reward_factor == model.policy.reward_factor != 1
    assert again.alpha == model.alpha
    np.testing.assert_array_equal(actions_of(again), actions_of(model))
    for name in (
        "num_timesteps",
        "_n_updates",
        "gamma",
        "tau",
        "batch_size",
        "seed",
        "n_objectives",
        "critic_loss",
        "train_freq",
    ):
        assert getattr(again, name) == getattr(model, name), name
    assert type(again.policy) is type(model.policy)


def test_a_model_and_its_buffer_train_on_bit_by_bit_as_the_original(tmp_path):
    model = tiny_model(StubEnv(), her=True, n_steps=2).learn(45)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    again = MOMBA.load(tmp_path / "model", env=StubEnv())
    again.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    again.set_logger(model.logger)
    for either in (model, again):
        th.manual_seed(5)
        either.train(gradient_steps=20, batch_size=16)
    assert again._n_updates == 45
    assert_same_tree(again.get_parameters(), model.get_parameters())


def test_two_models_of_one_file_learn_alike(tmp_path):
    model = tiny_model(StubEnv()).learn(45)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    parameters = []
    for _ in range(2):
        again = MOMBA.load(tmp_path / "model", env=StubEnv())
        again.load_replay_buffer(tmp_path / "buffer")
        again.learn(30, reset_num_timesteps=False)
        assert again.num_timesteps == 75
        assert again._n_updates == 55
        parameters.append(again.get_parameters())
    assert_same_tree(parameters[0], parameters[1])
    moved = zip(model.critic.parameters(), again.critic.parameters(), strict=True)
    assert all(not th.equal(old, new) for old, new in moved)


def test_loading_the_same_file_again_gives_the_same_file(tmp_path):
    model = tiny_model(StubEnv(), preference_sampler=PerStepSampler(UniformSampler(2))).learn(45)
    first = saved(model)
    again = saved(MOMBA.load(first))
    ours, theirs = read_tree(first)[0], read_tree(again)[0]
    for tree in (ours, theirs):
        tree["data"] = dict(sorted(tree["data"].items()))
    assert_same_tree(ours, theirs)


def test_saving_does_not_change_the_model():
    model = tiny_model(StubEnv()).learn(30)
    before, names = saved(model).getvalue(), set(model.__dict__)
    assert saved(model).getvalue() == before
    assert set(model.__dict__) == names


@pytest.mark.parametrize("name", ["model", "model.zip", "model.v1", "runs/deep/model"])
def test_a_name_loads_as_it_was_saved(name, tmp_path, monkeypatch):
    model = tiny_model(StubEnv())
    monkeypatch.chdir(tmp_path)
    for path in (name, tmp_path / name):
        model.save(path)
        np.testing.assert_array_equal(actions_of(MOMBA.load(path)), actions_of(model))
        other = tiny_model(StubEnv(), seed=1)
        other.set_parameters(path)
        np.testing.assert_array_equal(actions_of(other), actions_of(model))
    assert Path(name if Path(name).suffix else f"{name}.zip").exists()


def test_a_name_without_suffix_gets_one(tmp_path):
    model = tiny_model(StubEnv()).learn(3)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    assert sorted(os.listdir(tmp_path)) == ["buffer.npz", "model.zip"]


def test_a_directory_does_not_hide_the_file_of_the_same_name(tmp_path):
    model = tiny_model(StubEnv())
    (tmp_path / "model").mkdir()
    model.save(tmp_path / "model")
    np.testing.assert_array_equal(actions_of(MOMBA.load(tmp_path / "model")), actions_of(model))


def test_policy_kwargs_are_never_changed_and_a_difference_is_an_error(tmp_path):
    policy_kwargs = {"net_arch": {"pi": [8], "qf": [4, 4]}, "n_atoms": 11, "optimizer_kwargs": {"eps": 1e-5}}
    given = {**policy_kwargs, "net_arch": {**policy_kwargs["net_arch"]}}
    model = MOMBA("MlpPolicy", StubEnv(), policy_kwargs=policy_kwargs, buffer_size=100, learning_starts=5).learn(10)
    assert model.policy_kwargs is policy_kwargs
    assert policy_kwargs == given
    model.save(tmp_path / "model")
    assert policy_kwargs == given
    again = MOMBA.load(tmp_path / "model", policy_kwargs=given)
    assert again.policy_kwargs == given
    assert given == policy_kwargs
    with pytest.raises(ValueError, match=r"policy_kwargs are .*'n_atoms': 11.*'n_atoms': 12.*cannot be changed at load"):
        MOMBA.load(tmp_path / "model", policy_kwargs={**given, "n_atoms": 12})


def test_a_class_in_policy_kwargs_comes_back():
    model = tiny_model(StubEnv(), policy_kwargs={"optimizer_class": th.optim.SGD})
    again = MOMBA.load(saved(model))
    assert type(again.actor.optimizer) is th.optim.SGD
    assert again.policy_kwargs == model.policy_kwargs


def test_a_class_that_a_subclass_keeps_as_an_attribute_comes_back():
    model = tiny_model(StubEnv())
    model.second_optimizer_class = th.optim.SGD
    assert MOMBA.load(saved(model)).second_optimizer_class is th.optim.SGD


@pytest.mark.parametrize("name", ["policy_class", "policy_kwargs", "observation_space", "action_space", "n_objectives"])
def test_a_model_saved_without_what_it_needs_says_so_at_load(name):
    file = io.BytesIO()
    tiny_model(StubEnv()).save(file, exclude=[name])
    for env in (None, StubEnv()):
        with pytest.raises(ValueError, match=name):
            MOMBA.load(file, env=env)


def test_a_model_saved_without_what_has_a_default_loads():
    file = io.BytesIO()
    tiny_model(StubEnv()).save(file, exclude=["tau", "_last_obs", "tensorboard_log", "learning_rate"])
    for env in (None, StubEnv()):
        assert MOMBA.load(file, env=env).tau == 0.005


def test_load_changes_attributes_on_request():
    again = MOMBA.load(saved(tiny_model(StubEnv())), learning_rate=0.5, gamma=0.9, custom_objects={"tau": 0.25})
    assert (again.learning_rate, again.gamma, again.tau) == (0.5, 0.9, 0.25)
    assert again.lr_schedule(1.0) == 0.5
    assert again.policy.return_scale.gamma == again.replay_buffer.gamma == 0.9


def test_a_function_as_learning_rate_is_left_out_and_comes_back_with_custom_objects():
    model = tiny_model(StubEnv(), learning_rate=lambda progress: 0.25 * progress).learn(25)
    with pytest.warns(UserWarning, match=r"data\.learning_rate is a callable .*custom_objects"):
        file = saved(model)
    with pytest.warns(UserWarning, match=r"learning_rate was not stored: pass custom_objects=\{'learning_rate': \.\.\.\}"):
        without = MOMBA.load(file)
    assert without.learning_rate == 1e-4
    again = MOMBA.load(file, custom_objects={"learning_rate": lambda progress: 0.5 * progress})
    assert again.lr_schedule(0.5) == 0.25


def sample_corner(rng: np.random.Generator) -> np.ndarray:
    return np.array([1.0, 0.0])


@pytest.mark.parametrize("sampler", [sample_corner, PerStepSampler(sample_corner)], ids=["function", "PerStepSampler"])
def test_a_sampler_of_the_user_is_left_out_and_comes_back_with_custom_objects(sampler):
    model = tiny_model(StubEnv(), preference_sampler=sampler)
    with pytest.warns(UserWarning, match="preference_sampler.* is a callable"):
        file = saved(model)
    with pytest.warns(
        UserWarning, match=r"preference_sampler.* was not stored.*custom_objects=\{'preference_sampler': \.\.\.\}"
    ):
        MOMBA.load(file)
    again = MOMBA.load(file, env=StubEnv(), custom_objects={"preference_sampler": sampler})
    assert again.preference_sampler is sampler
    assert again.env.reset()[0, 3:].tolist() == [1, 0]


class UserPolicy(MlpPolicy):
    pass


def test_a_policy_class_of_the_user_is_left_out_and_asked_for():
    model = MOMBA(UserPolicy, StubEnv(), buffer_size=100, policy_kwargs={"net_arch": [4]})
    with pytest.warns(UserWarning, match=r"data\.policy_class is a callable"):
        file = saved(model)
    with pytest.warns(UserWarning, match="policy_class"), pytest.raises(ValueError, match=r"custom_objects=\{'policy_class'"):
        MOMBA.load(file)
    again = MOMBA.load(file, custom_objects={"policy_class": UserPolicy})
    assert type(again.policy) is UserPolicy
    np.testing.assert_array_equal(actions_of(again), actions_of(model))


def test_samplers_and_noise_of_the_library_come_back(tmp_path):
    noise = NormalActionNoise(np.zeros(2), np.full(2, 0.1))
    model = tiny_model(StubEnv(), preference_sampler=FixedSampler((0.25, 0.75)), action_noise=noise).learn(25)
    model.save(tmp_path / "model")
    again = MOMBA.load(tmp_path / "model", env=StubEnv())
    assert again.preference_sampler == FixedSampler((0.25, 0.75))
    assert again.env.reset()[0, 3:].tolist() == [0.25, 0.75]
    np.testing.assert_array_equal(again.action_noise._sigma, noise._sigma)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_noise_that_remembers_comes_back_where_it_was(n_envs):
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2), 0.3, 0.1, initial_noise=np.ones(2), dtype=np.float64)
    model = tiny_model(make_mo_vec_env(StubEnv, n_envs), action_noise=noise).learn(26 * n_envs)
    again = MOMBA.load(saved(model))
    assert_same_tree(draws(again.action_noise), draws(model.action_noise))
    for one in (model, again):
        one.action_noise.reset()
    assert_same_tree(draws(again.action_noise), draws(model.action_noise))


def draws(noise: ActionNoise) -> list[np.ndarray]:
    np.random.seed(0)  # noqa: NPY002
    return [noise() for _ in range(3)]


@pytest.mark.parametrize(("before", "after"), [(3, 2), (3, 1), (1, 3)])
def test_noise_fits_the_environments_that_a_model_is_loaded_with(before, after):
    noise = NormalActionNoise(np.zeros(2), np.full(2, 0.1))
    model = tiny_model(make_mo_vec_env(StubEnv, before), action_noise=noise).learn(30)
    again = MOMBA.load(saved(model), make_mo_vec_env(StubEnv, after)).learn(30)
    assert again.action_noise().shape == ((2,) if after == 1 else (after, 2))


def test_noise_that_cannot_be_stored_is_left_out_with_a_warning():
    class OwnNoise(NormalActionNoise):
        pass

    model = tiny_model(StubEnv(), action_noise=OwnNoise(np.zeros(2), np.ones(2)))
    with pytest.warns(UserWarning, match=r"data\.action_noise is a callable"):
        file = saved(model)
    with pytest.warns(UserWarning, match="action_noise was not stored"):
        assert MOMBA.load(file).action_noise is None


def test_parameters_go_from_model_to_model(tmp_path):
    model, other = tiny_model(StubEnv()).learn(30), tiny_model(StubEnv(), seed=1)
    model.save(tmp_path / "model.zip")
    assert not np.array_equal(actions_of(other), actions_of(model))
    for source in (model.get_parameters(), tmp_path / "model.zip", str(tmp_path / "model"), saved(model)):
        fresh = tiny_model(StubEnv(), seed=1)
        fresh.set_parameters(source)
        assert_same_tree(fresh.get_parameters(), model.get_parameters())
        np.testing.assert_array_equal(actions_of(fresh), actions_of(model))
    assert set(model.get_parameters()) == {"policy", "actor.optimizer", "critic.optimizer", "ent_coef_optimizer"}
    with pytest.raises(ValueError, match="do not match"):
        other.set_parameters({"policy": model.get_parameters()["policy"]})
    other.set_parameters({"policy": model.get_parameters()["policy"]}, exact_match=False)
    np.testing.assert_array_equal(actions_of(other), actions_of(model))


def test_parameters_of_another_network_are_refused(tmp_path):
    tiny_model(StubEnv(), policy_kwargs={"actor_hidden_dim": 16}).save(tmp_path / "wider")
    model = tiny_model(StubEnv())
    with pytest.raises((ValueError, RuntimeError), match="size mismatch"):
        model.set_parameters(tmp_path / "wider")


def test_every_parameter_except_the_optimisers_is_a_float_tensor():
    for name, state in tiny_model(StubEnv()).learn(25).get_parameters().items():
        if "optimizer" not in name:
            assert all(th.is_floating_point(tensor) for tensor in state.values())


OTHER_ENVIRONMENTS = [
    ("n_objectives", {"n_objectives": 3, "observation_dim": 2}, r"n_objectives=2.*n_objectives=3"),
    ("observation_space", {"observation_dim": 4}, r"observation_space=.*\(5,\).*observation_space=.*\(6,\)"),
    ("action_space", {"action_dim": 3}, r"action_space=.*\(2,\).*action_space=.*\(3,\)"),
]


@pytest.mark.parametrize(("name", "env_kwargs", "match"), OTHER_ENVIRONMENTS, ids=[row[0] for row in OTHER_ENVIRONMENTS])
def test_loading_with_another_environment_is_an_error_with_both_values(name, env_kwargs, match):
    file = saved(tiny_model(StubEnv()))
    for env in (StubEnv(**env_kwargs), make_mo_vec_env(StubEnv, env_kwargs=env_kwargs)):
        with pytest.raises(ValueError, match=match):
            MOMBA.load(file, env=env)


def test_loading_with_another_number_of_environments_trains():
    again = MOMBA.load(saved(tiny_model(StubEnv()).learn(25)), env=make_mo_vec_env(StubEnv, 3))
    assert again.n_envs == 3
    again.learn(30)
    assert again.replay_buffer.pos == 10


def test_a_model_without_environment_predicts_and_says_that_it_cannot_learn():
    again = MOMBA.load(saved(tiny_model(StubEnv())))
    assert again.env is None
    assert actions_of(again).shape == (7, 2)
    with pytest.raises(AssertionError, match="set the environment"):
        again.learn(5)
    again.set_env(StubEnv())
    assert again.learn(5).num_timesteps == 5


def test_a_file_of_another_format_or_version_is_an_error(tmp_path):
    model = tiny_model(StubEnv()).learn(5)
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.npz")
    with pytest.raises(FileFormatError, match=r"buffer\.npz holds 'sb3_momba\.replay_buffer', not 'sb3_momba\.model'"):
        MOMBA.load(tmp_path / "buffer.npz")
    with pytest.raises(FileFormatError, match=r"model\.zip holds 'sb3_momba\.model', not 'sb3_momba\.replay_buffer'"):
        model.load_replay_buffer(tmp_path / "model.zip")
    tree = {**read_tree(tmp_path / "model.zip")[0], "version": 99}
    write_tree(tmp_path / "newer.zip", tree)
    with pytest.raises(FileFormatError, match=r"newer\.zip has format version 99, .* reads 1"):
        MOMBA.load(tmp_path / "newer.zip")


def test_a_zip_of_a_version_that_there_is_not_is_damaged(tmp_path):
    """Byte 6 of an entry of the central directory says which version reads it."""
    path = tmp_path / "model.zip"
    tiny_model(StubEnv()).save(path)
    content = bytearray(path.read_bytes())
    content[content.index(b"PK\x01\x02") + 6] = 109
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"model\.zip is damaged.*version 10\.9"):
        MOMBA.load(path)


def test_a_damaged_model_file_is_an_error_that_names_it(tmp_path):
    path = tmp_path / "model.zip"
    tiny_model(StubEnv()).learn(25).save(path)
    content = path.read_bytes()
    rng = random.Random(0)
    for length in [0, 1, *(rng.randrange(len(content)) for _ in range(20)), len(content) - 1]:
        path.write_bytes(content[:length])
        with pytest.raises(FileFormatError, match=r"model\.zip"):
            MOMBA.load(path)
    tree = read_tree(io.BytesIO(content))[0]
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        infos = archive.infolist()
    for info in infos:
        damaged = bytearray(content)
        damaged[info.header_offset + 30 + len(info.filename) + 20 + info.file_size - 1] ^= 1
        path.write_bytes(damaged)
        if info.filename.endswith(".npy") and info.file_size > 128:
            with pytest.raises(FileFormatError, match=r"model\.zip"):
                MOMBA.load(path)
    path.write_bytes(content)
    assert_same_tree(MOMBA.load(path).get_parameters()["policy"], tree["params"]["policy"])


def test_parameters_that_do_not_fit_the_file_s_own_settings_are_an_error(tmp_path):
    tree = read_tree(saved(tiny_model(StubEnv())))[0]
    tree["data"]["policy_kwargs"]["actor_hidden_dim"] = 16
    write_tree(tmp_path / "mixed.zip", tree)
    with pytest.raises(FileFormatError, match=r"mixed\.zip holds parameters that do not fit its own settings"):
        MOMBA.load(tmp_path / "mixed.zip")


def test_another_kind_of_entropy_coefficient_at_load_blames_the_argument_and_not_the_file():
    file = saved(tiny_model(StubEnv()))
    with pytest.raises(ValueError, match="ent_coef"):
        MOMBA.load(file, ent_coef=0.3)


# ------------------------------------------------------------------------------------------------- replay buffers

STORED = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "preferences")


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("n_timesteps", [12, 150], ids=["partly filled", "wrapped around"])
def test_a_loaded_replay_buffer_holds_and_draws_the_same(n_envs, n_timesteps, tmp_path):
    model = tiny_model(make_mo_vec_env(StubEnv, n_envs), buffer_size=60 * n_envs, learning_starts=1000).learn(
        n_timesteps * n_envs
    )
    model.replay_buffer.sample(5)
    model.save_replay_buffer(tmp_path / "buffer")
    other = tiny_model(make_mo_vec_env(StubEnv, n_envs), buffer_size=9 * n_envs)
    other.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    ours, theirs = model.replay_buffer, other.replay_buffer
    for name in ("pos", "full", "buffer_size", "n_envs", "n_objectives"):
        assert getattr(theirs, name) == getattr(ours, name), name
    assert theirs.full == (n_timesteps > 60)
    for name in STORED:
        np.testing.assert_array_equal(getattr(theirs, name), getattr(ours, name), err_msg=name, strict=True)
    assert_same_tree(tuple(theirs.sample(30)), tuple(ours.sample(30)))
    assert other.buffer_size == 60 * n_envs
    other.learn(n_envs)
    assert theirs.pos == (ours.pos + 1) % 60


def test_a_model_that_takes_a_buffer_warns_of_its_negative_returns(tmp_path):
    tiny_model(StubEnv()).learn(30).save_replay_buffer(tmp_path / "buffer")
    model = tiny_model(StubEnv(), vector_values=True, preference_alignment=True)
    with pytest.warns(UserWarning, match="preference_alignment assumes returns that are not negative"):
        model.load_replay_buffer(tmp_path / "buffer")


def test_a_saved_model_knows_that_it_stopped_within_a_step(tmp_path):
    env = make_mo_vec_env(partial(StubEnv, episode_length=10), 1)
    model = tiny_model(env, learning_starts=100).learn(9, callback=lambda local, _: local["self"].num_timesteps < 4)
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer")
    again = MOMBA.load(tmp_path / "model.zip", env, force_reset=False)
    again.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    again.learn(3, reset_num_timesteps=False)
    np.testing.assert_array_equal(again.replay_buffer.dones[:6, 0], [0, 0, 1, 0, 0, 0])
    np.testing.assert_array_equal(np.floor(again.replay_buffer.observations[:6, 0, 0]), [0, 1, 2, 4, 5, 6])


@pytest.mark.parametrize("kwargs", [{}, {"reward_centering": True}, {"return_scaling": "deviation"}])
def test_a_model_that_has_seen_nothing_takes_its_statistics_from_a_buffer(tmp_path, kwargs):
    def statistics_of(model):
        return {
            name: x
            for name, x in model.policy.state_dict().items()
            if name.split(".")[0] not in ("actor", "critic", "critic_target")
        }

    collected = tiny_model(make_mo_vec_env(StubEnv, 2), **kwargs).learn(50)
    collected.save_replay_buffer(tmp_path / "buffer")
    fresh, other = (tiny_model(make_mo_vec_env(StubEnv, 2), **kwargs) for _ in range(2))
    fresh.load_replay_buffer(tmp_path / "buffer")
    th.testing.assert_close(statistics_of(fresh), statistics_of(collected), rtol=1e-12, atol=0)  # summed in another order
    other.learn(10)
    before = {name: x.clone() for name, x in statistics_of(other).items()}
    other.load_replay_buffer(tmp_path / "buffer")
    assert_same_tree(statistics_of(other), before)


def test_loading_a_buffer_ends_its_last_trajectory_as_truncated(tmp_path):
    model = tiny_model(make_mo_vec_env(partial(StubEnv, episode_length=5), 2)).learn(14)
    model.save_replay_buffer(tmp_path / "buffer")
    for cut in (True, False):
        model.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=cut)
        np.testing.assert_array_equal(model.replay_buffer.dones[:7, 0], [0, 0, 0, 0, 1, 0, 0])
        model.learn(2, reset_num_timesteps=False)
        np.testing.assert_array_equal(model.replay_buffer.dones[:7, 0], [0, 0, 0, 0, 1, 0, cut])
        np.testing.assert_array_equal(model.replay_buffer.timeouts[:7, 0], [0, 0, 0, 0, 1, 0, cut])
    assert (model.replay_buffer.sample(50).dones == 0).all()


def test_a_last_trajectory_that_has_ended_stays_as_it_ended(tmp_path):
    model = tiny_model(StubEnv(episode_length=5, ending="terminated")).learn(5)
    model.save_replay_buffer(tmp_path / "buffer")
    model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.dones[4, 0] == 1
    assert model.replay_buffer.timeouts[4, 0] == 0


def test_an_empty_buffer_can_be_saved_and_loaded():
    file = io.BytesIO()
    tiny_model(StubEnv()).save_replay_buffer(file)
    model = tiny_model(StubEnv()).learn(5)
    model.load_replay_buffer(file)
    assert model.replay_buffer.size() == 0


BUFFER_MISFITS = [
    ({"n_objectives": 3, "observation_dim": 3}, 1, r"n_objectives=2, this model has n_objectives=3"),
    ({"observation_dim": 4}, 1, r"observations have shape \(1, 3\), this model's \(1, 4\)"),
    ({"action_dim": 3}, 1, r"actions have shape \(1, 2\), this model's \(1, 3\)"),
    ({}, 2, r"n_envs=1, this model has n_envs=2"),
]


@pytest.mark.parametrize(("env_kwargs", "n_envs", "match"), BUFFER_MISFITS)
def test_a_buffer_of_another_environment_is_refused_and_the_old_one_kept(env_kwargs, n_envs, match, tmp_path):
    tiny_model(StubEnv()).learn(5).save_replay_buffer(tmp_path / "buffer")
    model = tiny_model(make_mo_vec_env(StubEnv, n_envs, env_kwargs=env_kwargs)).learn(8)
    buffer = model.replay_buffer
    with pytest.raises(ValueError, match=match):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is buffer
    assert model.buffer_size == 1000


@pytest.mark.parametrize("change", [{"pos": 4}, {"pos": -1}, {"pos": 2000}, {"full": True}])
def test_a_buffer_file_that_contradicts_itself_is_refused(change, tmp_path):
    model = tiny_model(StubEnv()).learn(5)
    model.save_replay_buffer(tmp_path / "buffer.npz")
    write_tree(tmp_path / "buffer.npz", {**read_tree(tmp_path / "buffer.npz")[0], **change})
    buffer = model.replay_buffer
    with pytest.raises(FileFormatError, match="length that it states"):
        model.load_replay_buffer(tmp_path / "buffer.npz")
    assert model.replay_buffer is buffer


def test_an_interrupted_save_leaves_the_old_model_and_buffer(tmp_path, monkeypatch):
    model = tiny_model(StubEnv()).learn(25)
    for save, name in ((model.save, "model.zip"), (model.save_replay_buffer, "buffer.npz")):
        save(tmp_path / name)
        before = (tmp_path / name).read_bytes()
        model.learn(5, reset_num_timesteps=False)
        with monkeypatch.context() as patch:
            fail_at(patch, files.np.lib.format, "write_array", 4, NO_SPACE)
            with pytest.raises(OSError, match="No space left"):
                save(tmp_path / name)
        assert (tmp_path / name).read_bytes() == before
        save(tmp_path / name)
        assert (tmp_path / name).read_bytes() != before
    assert sorted(os.listdir(tmp_path)) == ["buffer.npz", "model.zip"]


def test_what_a_killed_process_had_begun_to_write_is_deleted_by_the_next_write(tmp_path):
    killed = subprocess.Popen([sys.executable, "-c", ""])
    killed.wait()
    unfinished, running = (tmp_path / f".tree.zip.{number}.part" for number in (killed.pid, os.getppid()))
    for path in (unfinished, running, tmp_path / ".tree.zip.part", tmp_path / f".other.zip.{killed.pid}.part"):
        path.touch()
    write_tree(tmp_path / "tree.zip", {})
    assert not unfinished.exists()
    assert len(list(tmp_path.iterdir())) == 4
