"""Generations of checkpoints in one folder: each is whole or not there, whenever the process dies.

    FOLDER/0007-000050000/    the seventh checkpoint, at 50,000 steps: its files, and manifest.json, written last
    FOLDER/shared/            files that several checkpoints use, written once and never changed

A checkpoint is written into a folder with another name, every file is forced to the disk, and then the folder is renamed.
The manifest holds length and SHA-256 of every file, those of shared ones too, and its own.
"""

import contextlib
import hashlib
import json
import logging
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_momba.files import FileFormatError, refuse_constant, write_tree

FORMAT = "sb3_momba.checkpoint"
VERSION = 1
MANIFEST = "manifest.json"
SHARED = "shared"
NAME = re.compile(r"(\d{4,})-\d{9,}")
# Rows first to end - 1 of a replay buffer, counted since the training began; and a word that no other segment has.
SHARED_NAME = re.compile(r"(\d{12})-(\d{12})-[0-9a-f]{8}\.npz")
CHECKSUM_BLOCK = 2**20
HIDDEN = "."  # what a folder's name begins with while it is written or deleted

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Checkpoint:
    """One generation, as its manifest describes it.

    :param files: length and checksum of each file, by its path from the checkpoint's folder
    :param shared: names of the shared files, in the order in which they were written
    """

    folder: Path
    steps: int
    files: dict[str, dict[str, Any]]
    shared: list[str]


def number_of(folder: Path) -> int:
    """Of a checkpoint, from its folder's name; -1 where it is none."""
    match = NAME.fullmatch(folder.name)
    return int(match[1]) if match else -1


def checkpoints_in(root: Path) -> list[Path]:
    """The folders of all checkpoints, whole or damaged, the newest first."""
    found = [path for path in root.iterdir() if path.is_dir() and number_of(path) >= 0] if root.is_dir() else []
    return sorted(found, key=number_of, reverse=True)


def steps_of_newest(root: Path) -> int:
    """Of a folder's newest checkpoint, whole or damaged; -1 where there is none."""
    folders = checkpoints_in(root)
    return int(folders[0].name.partition("-")[2]) if folders else -1


def newest(path: str | os.PathLike[str]) -> Checkpoint:
    """The newest checkpoint of a folder that is whole, or the one that is given itself.

    A damaged one is passed over, and said.

    :raises FileNotFoundError: if there is none
    :raises FileFormatError: if none is whole, naming the file and its checksums
    """
    path = Path(path)
    if number_of(path) >= 0:
        return verified(path)
    folders = checkpoints_in(path)
    if not folders:
        raise FileNotFoundError(f"{path} has no checkpoint: give the folder of a MombaCheckpointCallback, or one in it.")
    for folder in folders:
        try:
            return verified(folder)
        except (FileFormatError, OSError) as error:
            logger.warning("A checkpoint is passed over: %s", error)
            last = error
    raise FileFormatError(
        f"None of the {len(folders)} checkpoints in {path} is whole; the oldest: {last} A model.zip in them that is whole can "
        "still be loaded by MOMBA.load, without the replay buffer."
    ) from last


def verified(folder: Path) -> Checkpoint:
    """A checkpoint whose files all have the length and checksum that its manifest states."""
    checkpoint = read_manifest(folder)
    for name, stated in checkpoint.files.items():
        file = folder / name
        if not file.is_file():
            raise FileFormatError(f"{file} is missing.")
        if file.stat().st_size != stated["bytes"]:
            raise FileFormatError(f"{file} has {file.stat().st_size} bytes where its manifest states {stated['bytes']}.")
        found = checksum(file)
        if found != stated["sha256"]:
            raise FileFormatError(f"{file} has the checksum {found} where its manifest states {stated['sha256']}.")
    return checkpoint


def read_manifest(folder: Path) -> Checkpoint:
    """
    :raises FileFormatError: if it is damaged or of another version
    """
    file = folder / MANIFEST
    try:
        whole = json.loads(file.read_bytes(), parse_constant=refuse_constant)
        content, stated = whole["content"], whole["sha256"]
        found = digest_of(content)
        checkpoint = Checkpoint(folder, *(content[name] for name in ("steps", "files", "shared")))
        is_ours = content["format"] == FORMAT and content["version"] == VERSION
        if not all(set(one) == {"bytes", "sha256"} for one in checkpoint.files.values()):
            raise TypeError("an entry of its files has no length and checksum")
        if not all(f"../{SHARED}/{name}" in checkpoint.files for name in checkpoint.shared):
            raise TypeError("a shared file has no length and checksum")
    except FileNotFoundError as error:
        raise FileFormatError(f"{file} is missing.") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FileFormatError(f"{file} is damaged: {type(error).__name__}: {error}") from error
    if found != stated:
        raise FileFormatError(f"{file} has the checksum {found} where it states {stated}.")
    if not is_ours:
        raise FileFormatError(
            f"{file} has format {content['format']!r}, version {content['version']}; this sb3_momba reads {FORMAT!r}, "
            f"version {VERSION}."
        )
    return checkpoint


class CheckpointWriter:
    """The only writer of a folder of checkpoints.

    :param root: the folder; made when the first checkpoint is written
    :param keep: how many checkpoints stay
    """

    def __init__(self, root: str | os.PathLike[str], keep: int = 3):
        self.root = Path(root)
        self.keep = keep
        self.checksums: dict[str, dict[str, Any]] = {}  # of the shared files, in the order in which they were written
        self.n_resets = 0  # of the replay buffer whose transitions they hold

    @property
    def shared_folder(self) -> Path:
        return self.root / SHARED

    def go_on_from(self, checkpoint: Checkpoint) -> None:
        """Let the next checkpoint use the shared files of this one."""
        self.checksums = {name: checkpoint.files[f"../{SHARED}/{name}"] for name in checkpoint.shared}

    def lacks(self, name: str) -> bool:
        """Whether a shared file is gone, or not as long as it was."""
        file = self.shared_folder / name
        return not file.is_file() or file.stat().st_size != self.checksums[name]["bytes"]

    def write_shared(self, name: str, tree: Any) -> None:
        """A file that this checkpoint and later ones use."""
        self.shared_folder.mkdir(parents=True, exist_ok=True)
        file = self.shared_folder / name
        write_tree(file, tree)
        self.checksums[name] = described(file)

    def write(self, steps: int, trees: dict[str, Any], shared: list[str]) -> Path:
        """One checkpoint, and the end of those that are too many.

        :param trees: its own files by name, see `write_tree`
        :param shared: the names of the shared files that belong to it
        :return: its folder
        """
        self.root.mkdir(parents=True, exist_ok=True)
        numbers = [number_of(folder) for folder in checkpoints_in(self.root)]
        name = f"{max(numbers, default=0) + 1:04d}-{steps:09d}"
        aside = self.root / f"{HIDDEN}{name}.part"
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir()
        try:
            for file, tree in trees.items():
                write_tree(aside / file, tree)
            files = {file: described(aside / file) for file in trees}
            files.update({f"../{SHARED}/{file}": self.checksums[file] for file in shared})
            content = {"format": FORMAT, "version": VERSION, "steps": steps, "files": files, "shared": shared}
            with open(aside / MANIFEST, "w") as manifest:
                manifest.write(sealed(content))
                manifest.flush()
                os.fsync(manifest.fileno())
            if shared:
                sync_folder(self.shared_folder)
            sync_folder(aside)
            os.rename(aside, self.root / name)
        except BaseException:
            shutil.rmtree(aside, ignore_errors=True)
            raise
        sync_folder(self.root)
        self._tidy()
        return self.root / name

    def _tidy(self) -> None:
        """Delete the checkpoints that are too many, what was left half written or half deleted, and the shared files that
        nothing uses any more."""
        folders = checkpoints_in(self.root)
        for folder in folders[self.keep :]:
            delete(folder)
        for folder in self.root.glob(f"{HIDDEN}*"):
            if NAME.match(folder.name.lstrip(HIDDEN)):
                shutil.rmtree(folder, ignore_errors=True)
        used = {name for folder in folders[: self.keep] for name in shared_of(folder)}
        for file in self.shared_folder.glob("*") if self.shared_folder.is_dir() else ():
            if file.name not in used and SHARED_NAME.fullmatch(file.name):
                file.unlink(missing_ok=True)
        self.checksums = {name: stated for name, stated in self.checksums.items() if name in used}


def shared_of(folder: Path) -> list[str]:
    """The shared files of a checkpoint; of a damaged one nothing can be said."""
    with contextlib.suppress(FileFormatError):
        return read_manifest(folder).shared
    return []


def delete(folder: Path) -> None:
    """First out of sight, then gone: what is half deleted is no checkpoint."""
    hidden = folder.with_name(f"{HIDDEN}{folder.name}.old")
    shutil.rmtree(hidden, ignore_errors=True)
    os.rename(folder, hidden)
    shutil.rmtree(hidden, ignore_errors=True)


def described(file: Path) -> dict[str, Any]:
    return {"bytes": file.stat().st_size, "sha256": checksum(file)}


def checksum(file: Path) -> str:
    digest = hashlib.sha256()
    with open(file, "rb") as content:
        while block := content.read(CHECKSUM_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def sealed(content: dict[str, Any]) -> str:
    """A manifest's text: its content with its own checksum."""
    return json.dumps({"content": content, "sha256": digest_of(content)}, allow_nan=False, indent=1)


def digest_of(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, allow_nan=False, sort_keys=True).encode()).hexdigest()


def sync_folder(folder: Path) -> None:
    """Force the names in a folder to the disk, where the system can."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
