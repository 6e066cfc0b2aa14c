"""Exported graphs: the policy's own actions under onnxruntime and torch.jit, and no file where they would be others."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch as th
from gymnasium import spaces

from sb3_momba import MOMBA, SimbaPolicy, __version__, export
from sb3_momba.nn import speed
from tests.stubs import StubEnv, tiny_model

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")

EXAMPLE = Path(__file__).parent.parent / "examples" / "export_and_run.py"
CONDITIONINGS = ["input", "all", "film", "film+all"]
VARIANTS = [(policy, n, kind) for policy in ("SimbaPolicy", "MlpPolicy") for n in (2, 3) for kind in CONDITIONINGS]
VARIANTS += [(policy, 1, "input") for policy in MOMBA.policy_aliases]
VARIANTS += [("XqcPolicy", 2, "film+all"), ("FlashSacPolicy", 3, "all")]
SUFFIXES = [".onnx", ".pt"]
# In float32 -2.3 + (1.1 - -2.3) is more than 1.1.
BOX = spaces.Box(np.array([-2.3, 0.1], np.float32), np.array([1.1, 7.0], np.float32))


def model_of(policy: str = "SimbaPolicy", n_objectives: int = 2, conditioning: str = "input", **kwargs: Any) -> MOMBA:
    """As after a training: no parameter is where it started, and the statistics are of observations far from 0."""
    policy_kwargs = {"conditioning": conditioning, **kwargs.pop("policy_kwargs", {})}
    env = StubEnv(n_objectives if n_objectives > 1 else None, action_space=BOX)
    model = tiny_model(env, policy, policy_kwargs=policy_kwargs, **kwargs)
    generator = th.Generator().manual_seed(1)
    with th.no_grad():
        for parameter in model.actor.parameters():
            parameter.add_(0.3 * th.randn(parameter.shape, generator=generator))
    model.policy.statistics.update(observations_of(50))
    return model


def observations_of(batch: int) -> np.ndarray:
    return np.random.default_rng(batch).normal([5, -30, 0.1], [3, 20, 0.01], size=(batch, 3)).astype(np.float32)


def preferences_of(batch: int, n_objectives: int) -> np.ndarray:
    return np.random.default_rng(batch).dirichlet(np.ones(n_objectives), size=batch).astype(np.float32)


def actions_in(path: Path, *inputs: np.ndarray) -> np.ndarray:
    """What a file's graph gives without this package's help."""
    if path.suffix.lower() == ".onnx":
        session = onnxruntime.InferenceSession(path)
        names = [x.name for x in session.get_inputs()]
        assert names == ["observation", "preference"][: len(inputs)]
        return session.run(["action"], dict(zip(names, inputs, strict=True)))[0]
    graph = th.jit.load(path)
    for _ in range(3):  # torch compiles a graph while it runs, after having seen some inputs
        actions = graph(*map(th.from_numpy, inputs)).numpy()
    return actions


# ---------------------------------------------------------------------------------------------------- the same actions


@pytest.mark.parametrize(("policy", "n_objectives", "conditioning"), VARIANTS)
def test_a_graph_gives_the_actions_of_predict_for_any_batch_size(policy, n_objectives, conditioning, tmp_path):
    model = model_of(policy, n_objectives, conditioning)
    for path in (tmp_path / "policy.onnx", tmp_path / "policy.pt"):
        model.export(path)
        for batch in (1, 7):
            observations, w = observations_of(batch), preferences_of(batch, n_objectives)
            expected, _ = model.predict(observations, preference=w, deterministic=True)
            actions = actions_in(path, observations, *([w] if n_objectives > 1 else []))
            assert actions.dtype == np.float32
            np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-5)
            assert np.ptp(expected, axis=0).min() > 0.01 or batch == 1


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".ts", ".ONNX"])
@pytest.mark.parametrize(("policy", "conditioning"), [("SimbaPolicy", "input"), ("MlpPolicy", "film+all")])
def test_a_preference_can_be_built_in(policy, conditioning, suffix, tmp_path):
    model, path = model_of(policy, 3, conditioning), tmp_path / f"policy{suffix}"
    model.export(path, preference=[0.2, 0.3, 0.5])
    for batch in (1, 7):
        expected, _ = model.predict(observations_of(batch), preference=[0.2, 0.3, 0.5], deterministic=True)
        np.testing.assert_allclose(actions_in(path, observations_of(batch)), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    "kwargs",
    [
        {"policy_kwargs": {"normalize_observations": False}},
        {"policy_kwargs": {"normalize_features": False, "normalize_weights": False}},
        {"critic_loss": "mse", "vector_values": True, "policy_kwargs": {"capql_log_prob": True}},
    ],
    ids=["raw", "no norms", "capql"],
)
def test_variants_of_the_policy(kwargs, suffix, tmp_path):
    model, path = model_of(**kwargs), tmp_path / f"policy{suffix}"
    model.export(path)
    expected, _ = model.predict(observations_of(7), preference=preferences_of(7, 2), deterministic=True)
    np.testing.assert_allclose(actions_in(path, observations_of(7), preferences_of(7, 2)), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_rounds_or_is_compiled_while_training_is_exported_in_float32(suffix, tmp_path, monkeypatch):
    model, path = tiny_model(StubEnv(), precision="bfloat16").learn(45), tmp_path / f"policy{suffix}"
    monkeypatch.setattr(speed, "compiled", lambda method: pytest.fail("an export compiles nothing"))
    model.actor.compiled = True
    model.policy.set_training_mode(True)
    model.export(path)
    expected, _ = model.predict(observations_of(7), preference=preferences_of(7, 2), deterministic=True)
    np.testing.assert_allclose(actions_in(path, observations_of(7), preferences_of(7, 2)), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_actions_stay_within_the_bounds_to_the_last_bit(suffix, tmp_path):
    for sign in (-1, 1):
        model, path = model_of(), tmp_path / f"policy{suffix}"
        with th.no_grad():
            model.actor.mean_head.bias += 100 * sign
        model.export(path)
        actions = actions_in(path, observations_of(7), preferences_of(7, 2))
        assert all(map(BOX.contains, actions))
        np.testing.assert_allclose(actions, np.tile(BOX.high if sign > 0 else BOX.low, (7, 1)), rtol=1e-6)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_before_the_first_step_and_after_loading(suffix, tmp_path):
    model, path = tiny_model(StubEnv()), tmp_path / f"policy{suffix}"
    model.save(tmp_path / "model")
    MOMBA.load(tmp_path / "model").export(path)
    expected, _ = model.predict(observations_of(7), preference=preferences_of(7, 2), deterministic=True)
    np.testing.assert_allclose(actions_in(path, observations_of(7), preferences_of(7, 2)), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_export_in_the_middle_of_a_training_changes_nothing_of_it(suffix, tmp_path):
    actors = []
    for exports in (False, True):
        model = tiny_model(StubEnv()).learn(45)
        if exports:
            model.export(tmp_path / f"policy{suffix}")
        model.learn(20, reset_num_timesteps=False)
        actors.append(th.nn.utils.parameters_to_vector(model.actor.parameters()))
    assert th.equal(*actors)


# ------------------------------------------------------------------------------------------------------------ the file


def test_inputs_outputs_and_metadata_of_onnx(tmp_path):
    path = tmp_path / "policy.onnx"
    model_of().export(path)
    session = onnxruntime.InferenceSession(path)
    described = [(x.name, x.shape, x.type) for x in [*session.get_inputs(), *session.get_outputs()]]
    assert described == [
        ("observation", ["batch", 3], "tensor(float)"),
        ("preference", ["batch", 2], "tensor(float)"),
        ("action", ["batch", 2], "tensor(float)"),
    ]
    metadata = session.get_modelmeta().custom_metadata_map
    assert metadata["sb3_momba"] == __version__
    assert metadata["policy"] == "SimbaPolicy"
    assert metadata["n_objectives"] == "2"
    np.testing.assert_array_equal(np.float32(json.loads(metadata["action_low"])), BOX.low)
    np.testing.assert_array_equal(np.float32(json.loads(metadata["action_high"])), BOX.high)
    assert "preference" not in metadata


def test_metadata_of_torchscript_and_of_a_built_in_preference(tmp_path):
    files = {export.METADATA: ""}
    model_of().export(tmp_path / "policy.pt", preference=[0.25, 0.75])
    th.jit.load(tmp_path / "policy.pt", _extra_files=files)
    metadata = json.loads(files[export.METADATA])
    assert metadata["sb3_momba"] == __version__
    assert json.loads(metadata["preference"]) == [0.25, 0.75]


def test_torchscript_runs_where_this_package_is_not(tmp_path):
    model, path = model_of(), tmp_path / "policy.pt"
    model.export(path)
    code = (
        "import sys; sys.modules['sb3_momba'] = None; import torch; "
        "print(torch.jit.load(sys.argv[1])(torch.ones(1, 3), torch.ones(1, 2) / 2).tolist())"
    )
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=True)
    expected, _ = model.predict(np.ones((1, 3)), preference=[0.5, 0.5], deterministic=True)
    np.testing.assert_allclose(json.loads(done.stdout), expected, atol=1e-5)


def test_the_example_runs_without_torch(tmp_path):
    tiny_model("mo-hopper-2obj-v5").export(tmp_path / "policy.onnx")
    done = subprocess.run([sys.executable, EXAMPLE, "run"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.count("return") == 3
    assert "torch was imported: False" in done.stdout


# ---------------------------------------------------------------------------------------------- what cannot be exported


@pytest.mark.parametrize("name", ["policy", "policy.zip", "policy.onnx.gz", ".onnx"])
def test_another_suffix_is_an_error_that_names_the_known_ones(name, tmp_path):
    with pytest.raises(ValueError, match=r"\.onnx, \.pt, \.ts"):
        model_of().export(tmp_path / name)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("preference", "match"),
    [
        ([0.5, 0.6], "sums to"),
        ([1.5, -0.5], "negative"),
        ([1.0], "one per objective"),
        ([0.2, 0.3, 0.5], "one per objective"),
        ([[0.5, 0.5], [0.1, 0.9]], "one can be built in"),
        ([float("nan"), 1.0], "not finite"),
        (0.5, "one can be built in"),
    ],
)
def test_a_wrong_preference_is_an_error(preference, match, tmp_path):
    with pytest.raises(ValueError, match=match):
        model_of().export(tmp_path / "policy.pt", preference=preference)
    assert os.listdir(tmp_path) == []


def test_with_one_objective_there_is_one_preference(tmp_path):
    model = model_of(n_objectives=1)
    model.export(tmp_path / "policy.onnx", preference=[1.0])
    expected, _ = model.predict(observations_of(7), deterministic=True)
    np.testing.assert_allclose(actions_in(tmp_path / "policy.onnx", observations_of(7)), expected, rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match="one per objective"):
        model.export(tmp_path / "policy.onnx", preference=[0.5, 0.5])


def test_without_onnx_the_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ImportError, match=r"pip install onnx.*extra `export`"):
        model_of().export(tmp_path / "policy.onnx")
    assert os.listdir(tmp_path) == []
    model_of().export(tmp_path / "policy.pt")


class Squared(SimbaPolicy):
    def _predict(self, observation: th.Tensor, deterministic: bool = False) -> th.Tensor:
        return super()._predict(observation, deterministic).square()


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("preference", [None, [0.5, 0.5]])
def test_a_policy_that_acts_otherwise_is_not_exported(preference, suffix, tmp_path):
    with pytest.raises(RuntimeError, match=r"differs from Squared\.predict"):
        model_of(Squared).export(tmp_path / f"policy{suffix}", preference)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("place", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file(place, suffix, tmp_path, monkeypatch):
    path = tmp_path / f"policy{suffix}"
    model_of().export(path)
    before = path.read_bytes()

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, place, full)
        with pytest.raises(OSError, match="No space"):
            model_of().export(path, preference=[0.5, 0.5])
    assert os.listdir(tmp_path) == [path.name]
    assert path.read_bytes() == before
