"""An example of every kind of file, and how it is loaded."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sb3_momba import MOMBA, MombaCheckpointCallback, SimbaPolicy, make_mo_vec_env
from sb3_momba.checkpoints.folders import MANIFEST, checkpoints_in, newest
from sb3_momba.pareto.evaluation import ParetoFront
from sb3_momba.recording import RecordWriter
from sb3_momba.records import read_record
from sb3_momba.zoo.configuration import SHIPPED, read_configuration
from tests.torture.trainings import SAVE_FREQ, TASK, new_model


@dataclass
class Kind:
    """A kind of files.

    :param folder: an example; it is copied before it is damaged
    :param file: the path in it of the file to damage
    :param load: the public loader, called with the folder
    :param content: "zip", "json", "json lines" or "yaml"
    """

    name: str
    folder: Path
    file: str
    load: Callable[[Path], Any]
    content: str


def kinds_of_files(folder: Path) -> list[Kind]:
    """An example of each, and how it is loaded."""
    model = new_model().learn(30, MombaCheckpointCallback(SAVE_FREQ, folder / "checkpoints", keep=1))
    (checkpoint,) = checkpoints_in(folder / "checkpoints")
    for name in ("model", "policy", "buffer", "record", "front", "configuration"):
        (folder / name).mkdir()
    model.save(folder / "model" / "model.zip")
    model.policy.save(folder / "policy" / "policy.zip")
    model.save_replay_buffer(folder / "buffer" / "buffer.npz")
    write_record(folder / "record" / "record.jsonl")
    a_front().save(folder / "front" / "front.npz")
    (folder / "configuration" / "c.yml").write_text((SHIPPED / "capql.yml").read_text())
    env = make_mo_vec_env(TASK, 1)

    def single(name: str, file: str, load: Callable[[Path], Any], content: str) -> Kind:
        return Kind(f"{name}, {file}", folder / name, file, lambda copy: load(copy / file), content)

    def of_checkpoint(file: str, content: str) -> Kind:
        def load(copy: Path) -> Any:
            return MOMBA.resume(copy / checkpoint.name, env, device="cpu")

        where = checkpoint.name if (checkpoint / file).exists() else "shared"
        shown = file if where == checkpoint.name else "shared segment"
        return Kind(f"checkpoint, {shown}", folder / "checkpoints", f"{where}/{file}", load, content)

    return [
        single("model", "model.zip", partial(MOMBA.load, device="cpu"), "zip"),
        single("policy", "policy.zip", partial(SimbaPolicy.load, device="cpu"), "zip"),
        single("buffer", "buffer.npz", model.load_replay_buffer, "zip"),
        of_checkpoint(MANIFEST, "json"),
        of_checkpoint("model.zip", "zip"),
        of_checkpoint("state.zip", "zip"),
        of_checkpoint(newest(checkpoint).shared[0], "zip"),
        single("record", "record.jsonl", read_record, "json lines"),
        single("front", "front.npz", ParetoFront.load, "zip"),
        single("configuration", "c.yml", lambda path: read_configuration(str(path), TASK), "yaml"),
    ]


def a_front() -> ParetoFront:
    rng = np.random.default_rng(0)
    returns = rng.normal(size=(3, 2, 2))
    return ParetoFront(np.eye(3, 2) + 0.1, returns, returns / 2, np.full((3, 2), 9), {"env": TASK, "seed": 0})


def write_record(path: Path) -> None:
    """A short record with a line of every kind."""
    front, values = a_front(), [[1.0, 2.0], [2.0, 1.0], [1.5, 1.5]]
    start = {"label": "momba", "env": TASK, "env_kwargs": {"x": 1}, "seed": 0, "config": {"gamma": 0.99, "her": True}}
    start |= {"reference_point": [0.0, 0.0], "preferences": values, "general_policy": True, "parameters": {"actor": 10}}
    with RecordWriter(path).start(**start) as writer:
        writer.append("floor", policy="random", values=values)
        for steps in (100, 200):
            writer.append("evaluation", steps=steps, seconds=1.5, cpu_seconds=1.0, evaluation_seconds=0.5, values=values)
        writer.finish(200, vars(front))


Attack = tuple[str, bytes, bool]  # what was done, the file's content, and whether a manifest is made to fit
