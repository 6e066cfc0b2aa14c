"""FAULTS row 36: files that an earlier version wrote are read as they were meant; those of an unknown version are refused.

`python -m tests.test_old_files FOLDER` writes one file of each kind, and what is in them, with the code as it is. When a
format changes, make a folder of the new version; the older ones stay as they are.
"""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_momba import MOMBA, MombaCheckpointCallback, ParetoFront, evaluate_front
from sb3_momba.checkpoints.folders import MANIFEST, checkpoints_in, newest, sealed
from sb3_momba.files import FileFormatError, read_tree, write_tree
from sb3_momba.recording import RecordWriter
from sb3_momba.records import read_record
from tests.stubs import StubEnv, tiny_model

FOLDER = Path(__file__).parent / "files_of_version_1"
STEPS = 60
OBSERVATIONS = np.array([[0.0, 0.5, 1.0], [1.0, -1.0, 2.0]], dtype=np.float32)
PREFERENCES = np.array([[0.3, 0.7], [1.0, 0.0]], dtype=np.float32)


class Countdown(StubEnv):
    """StubEnv with episodes of seven steps that are all alike."""

    def __init__(self):
        super().__init__(episode_length=7)

    def reset(self, **kwargs):
        self.n_steps = 0
        return super().reset(**kwargs)


def content_of_model(model: MOMBA) -> dict:
    actions, _ = model.predict(OBSERVATIONS, preference=PREFERENCES, deterministic=True)
    return {"actions": actions.tolist(), "steps": model.num_timesteps, "alpha": float(model.alpha)}


def content_of_buffer(model: MOMBA) -> dict:
    buffer = model.replay_buffer
    return {"size": buffer.size(), "rewards": buffer.rewards[: buffer.size(), 0].tolist()}


def write_files(folder: Path) -> None:
    folder.mkdir(parents=True)
    model = tiny_model(Countdown(), her=True, buffer_size=100, learning_starts=30)
    model.learn(STEPS, MombaCheckpointCallback(STEPS, folder / "checkpoints", keep=1))
    model.save(folder / "model.zip")
    model.save_replay_buffer(folder / "replay_buffer.npz")
    front = evaluate_front(model, Countdown, n_preferences=3, n_episodes=2)
    front.save(folder / "front.npz")
    write_record(folder / "record.jsonl", front)
    content = {"model": content_of_model(model), "buffer": content_of_buffer(model), "values": front.values.tolist()}
    (folder / "content.json").write_text(json.dumps(content, indent=1))


def write_record(path: Path, front: ParetoFront) -> None:
    start = {"label": "momba", "env": "stub", "env_kwargs": {}, "seed": 3, "config": {}, "reference_point": [0.0, 0.0]}
    with RecordWriter(path).start(
        **start, preferences=front.preferences, general_policy=True, parameters={"actor": 1}
    ) as record:
        record.append("evaluation", steps=STEPS, seconds=1.5, **front.metrics(), values=front.values)
        record.finish(STEPS, vars(front))


@pytest.fixture
def expected():
    return json.loads((FOLDER / "content.json").read_text())


@pytest.fixture
def copied(tmp_path):
    return Path(shutil.copytree(FOLDER, tmp_path / "files"))


def assert_same(ours, theirs):
    assert ours.keys() == theirs.keys()
    for name in ours:
        np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-5, atol=1e-6, err_msg=name)


def test_row_36_a_model_predicts_what_it_did_and_trains_on(expected):
    model = MOMBA.load(FOLDER / "model.zip", Countdown(), device="cpu")
    assert_same(content_of_model(model), expected["model"])
    model.load_replay_buffer(FOLDER / "replay_buffer.npz")
    assert_same(content_of_buffer(model), expected["buffer"])
    assert model.learn(20, reset_num_timesteps=False).num_timesteps == STEPS + 20


def test_row_36_a_checkpoint_is_gone_on_from(expected, copied):
    model = MOMBA.resume(copied / "checkpoints", Countdown(), device="cpu")
    assert_same(content_of_model(model), expected["model"])
    assert_same(content_of_buffer(model), expected["buffer"])
    assert model.learn(20, reset_num_timesteps=False).num_timesteps == STEPS + 20


def test_row_36_a_front_and_a_record_hold_what_they_did(expected):
    np.testing.assert_allclose(ParetoFront.load(FOLDER / "front.npz").values, expected["values"])
    run = read_record(FOLDER / "record.jsonl")
    assert (run.label, run.seed, run.error) == ("momba", 3, None)
    np.testing.assert_allclose(run.final_values, expected["values"])


LOADERS = {
    "model.zip": MOMBA.load,
    "replay_buffer.npz": lambda path: MOMBA.load(FOLDER / "model.zip", Countdown()).load_replay_buffer(path),
    "front.npz": ParetoFront.load,
}


@pytest.mark.parametrize("version", [0, 2, None, "1"])
@pytest.mark.parametrize("name", LOADERS)
def test_row_36_a_file_of_an_unknown_version_is_refused(name, version, copied):
    tree, _ = read_tree(copied / name)
    write_tree(copied / name, {**tree, "version": version})
    with pytest.raises(FileFormatError, match=rf"{name} has format version {version!r}.* reads 1"):
        LOADERS[name](copied / name)


@pytest.mark.parametrize("version", [0, 2])
def test_row_36_a_record_of_an_unknown_version_is_refused(version, copied):
    record = copied / "record.jsonl"
    record.write_text(record.read_text().replace('"version": 1,', f'"version": {version},', 1))
    with pytest.raises(FileFormatError, match=rf"record of version {version}, this sb3_momba reads version 1"):
        read_record(record)


@pytest.mark.parametrize("version", [0, 2])
def test_row_36_a_checkpoint_of_an_unknown_version_is_refused(version, copied):
    (folder,) = checkpoints_in(copied / "checkpoints")
    content = {**json.loads((folder / MANIFEST).read_text())["content"], "version": version}
    (folder / MANIFEST).write_text(sealed(content))
    with pytest.raises(FileFormatError, match=rf"version {version}; this sb3_momba reads .*version 1"):
        newest(copied / "checkpoints")


if __name__ == "__main__":
    write_files(Path(sys.argv[1]))
