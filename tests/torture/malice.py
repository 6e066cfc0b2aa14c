"""Files with a pickle that does something when it is loaded."""

import base64
import contextlib
import io
import json
import os
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import torch as th
from stable_baselines3 import SAC

from tests.torture.damage import archive_of, members_of
from tests.torture.examples import Attack, Kind
from tests.torture.processes import new_folder
from tests.torture.trainings import new_sac


class Malicious:
    """Its pickle makes a file wherever it is loaded."""

    def __init__(self, canary: Path):
        self.canary = canary

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return os.mkdir, (str(self.canary),)


def payloads_of(canary: Path) -> list[bytes]:
    """One object, pickled in the three ways that programs like this one unpickle."""
    malicious, array, torch_file = Malicious(canary), io.BytesIO(), io.BytesIO()
    np.save(array, np.array([malicious], dtype=object), allow_pickle=True)
    th.save(malicious, torch_file)
    return [pickle.dumps(malicious), array.getvalue(), torch_file.getvalue()]


def malicious_files(kind: Kind, canary: Path, every: int) -> Iterator[Attack]:
    """The pickles in place of the file and of each of its parts, and where other libraries would look for them."""
    original, payloads = (kind.folder / kind.file).read_bytes(), payloads_of(canary)
    slots = [(f"the file is pickle {i}", payload) for i, payload in enumerate(payloads)]
    if kind.content == "zip":
        slots += in_a_zip(members_of(original), payloads, canary)
    elif kind.content == "yaml":
        slots += in_yaml(original.decode().splitlines(), canary)
    else:
        slots += in_lines(original.splitlines(), payloads[0])
    for what, content in slots[::every] if every < len(slots) else slots:
        yield what, content, True


def in_a_zip(members: dict[str, bytes], payloads: list[bytes], canary: Path) -> Iterator[tuple[str, bytes]]:
    extra = {"data": sb3_data(canary), "data.pkl": payloads[0], "extra.npy": payloads[1], "policy.pth": payloads[2]}
    yield "extra members", archive_of({**members, **extra})
    for name in members:
        for i, payload in enumerate(payloads):
            yield f"{name} is pickle {i}", archive_of({**members, name: payload})


def in_yaml(lines: list[str], canary: Path) -> Iterator[tuple[str, bytes]]:
    for command in (f"!!python/object/apply:os.mkdir ['{canary}']", f"!!python/object/new:os.mkdir ['{canary}']"):
        yield f"{command} as the file", command.encode()
        yield f"{command} in a list", f"default: [{command}]".encode()
        for n, line in enumerate(lines):
            if ": " in line:
                changed = [*lines[:n], f"{line.split(': ')[0]}: {command}", *lines[n + 1 :]]
                yield f"line {n} is {command}", "\n".join(changed).encode()


def in_lines(lines: list[bytes], payload: bytes) -> Iterator[tuple[str, bytes]]:
    for n in range(len(lines)):
        yield f"line {n} is a pickle", b"\n".join([*lines[:n], payload, *lines[n + 1 :]])


def sb3_data(canary: Path) -> bytes:
    """The settings in a zip of SB3's, of which one is the pickle."""
    text = base64.b64encode(cloudpickle.dumps(Malicious(canary))).decode()
    return json.dumps({"policy_class": {":type:": "x", ":serialized:": text}}).encode()


def sb3_executes(what: str, canary: Path) -> bool:
    """Whether SB3 runs the same pickle in a file of its own format."""
    model = new_sac()
    with new_folder() as folder, contextlib.suppress(Exception):
        if what == "buffer":
            (folder / "buffer.pkl").write_bytes(pickle.dumps(Malicious(canary)))
            model.load_replay_buffer(folder / "buffer.pkl")
        else:
            model.save(folder / "model.zip")
            members = members_of((folder / "model.zip").read_bytes())
            (folder / "model.zip").write_bytes(archive_of({**members, "data": sb3_data(canary)}))
            SAC.load(folder / "model.zip", device="cpu")
    executed = canary.exists()
    if executed:
        canary.rmdir()
    return executed
