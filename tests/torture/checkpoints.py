"""Checkpoints of a small training, against the same training without any interruption."""

from pathlib import Path

from sb3_momba import MombaCheckpointCallback
from sb3_momba.checkpoints.folders import checkpoints_in, newest
from tests.torture.fingerprints import Fingerprints, fingerprint
from tests.torture.trainings import LEARNING_STARTS, SAVE_FREQ, new_model, resumed


def undisturbed_fingerprints(steps: int) -> dict[int, str]:
    """Of a training that is never interrupted and writes nothing, {steps: hash}."""
    fingerprints = Fingerprints(SAVE_FREQ)
    new_model().learn(steps, fingerprints)
    return fingerprints.found


def faults_of(folder: Path, undisturbed: dict[int, str]) -> tuple[int, list[str]]:
    """The steps of the newest checkpoint of a folder, and what is wrong with it: nothing, if it is whole and of one moment.

    :param undisturbed: fingerprints of the same training without any interruption, {steps: hash}
    """
    faults = []
    try:
        checkpoint = newest(folder)
        model = resumed(folder)
    except Exception as error:
        return 0, [f"does not load: {type(error).__name__}: {error}"]
    if checkpoint.folder != checkpoints_in(folder)[0]:
        faults.append("a newer one is damaged")
    steps, buffer = model.num_timesteps, model.replay_buffer
    if steps != checkpoint.steps:
        faults.append(f"the model is of step {steps}, its manifest of {checkpoint.steps}")
    if buffer.n_added != steps:
        faults.append(f"the model is of step {steps}, its replay buffer of {buffer.n_added}")
    if model._n_updates != max(steps - LEARNING_STARTS, 0):
        faults.append(f"{model._n_updates} updates after {steps} steps")
    if fingerprint(model) != undisturbed[steps]:
        faults.append(f"differs at step {steps} from a training that was never interrupted")
    return steps, faults


def before_a_checkpoint(folder: Path) -> tuple[MombaCheckpointCallback, dict[int, str]]:
    """A training with two checkpoints in a folder, and ten steps after the second; the next one removes the first of them
    and files that only it has used.

    :return: the callback that wrote them, and the fingerprints of both moments
    """
    model, fingerprints = new_model(), Fingerprints(SAVE_FREQ)
    callback = MombaCheckpointCallback(SAVE_FREQ, folder / "checkpoints", keep=2)
    model.learn(80, [fingerprints, callback])
    model.learn(SAVE_FREQ, fingerprints, reset_num_timesteps=False)
    return callback, fingerprints.found


def write_into(callback: MombaCheckpointCallback, folder: Path) -> None:
    """Let a callback go on in a copy of the folder that it was made for."""
    callback.path = callback.writer.root = folder / "checkpoints"
