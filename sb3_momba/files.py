"""Atomic, pickle-free files: trees of numbers, strings, arrays and tensors in one zip archive.

The archive holds `tree.json`, strict JSON, and one NumPy `.npy` file per array. Reading one executes nothing: classes
are named, and found only among those that are registered here or that torch, stable_baselines3 and sb3_momba have
already imported.
"""

import contextlib
import glob
import io
import json
import math
import os
import re
import sys
import warnings
import zipfile
from collections import deque
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

import numpy as np
import psutil
import torch as th
from stable_baselines3.common.buffers import BaseBuffer
from torch import nn

TRUSTED_ROOTS = ("torch", "stable_baselines3", "sb3_momba")
NAMEABLE_BASES = (nn.Module, th.optim.Optimizer, BaseBuffer)
ARRAY_KINDS = "biuf"
LONGEST_NAME = 120
LOCK = ".lock"
WRONG_CONTENT = (KeyError, TypeError, IndexError, AttributeError, OverflowError, RuntimeError)

FilePath = str | os.PathLike[str] | io.BufferedIOBase

_codecs: dict[str, tuple[type, Callable[[Any], Any], Callable[[Any], Any]]] = {}


class FileFormatError(ValueError):
    """A file is damaged, or not what it should be; the message names it."""


def register(cls: type, to_tree: Callable[[Any], Any], from_tree: Callable[[Any], Any]) -> None:
    """Let trees hold instances of exactly `cls`: `from_tree(to_tree(x))` gives an equal x, and may only construct it."""
    _codecs[qualified_name(cls)] = (cls, to_tree, from_tree)


def qualified_name(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def nameable_class(cls: Any) -> bool:
    """Whether a class can be stored by its name: a module, optimiser or buffer of torch, stable_baselines3 or sb3_momba."""
    return (
        isinstance(cls, type)
        and issubclass(cls, NAMEABLE_BASES)
        and cls.__module__.split(".")[0] in TRUSTED_ROOTS
        and getattr(sys.modules.get(cls.__module__), cls.__qualname__, None) is cls
    )


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A file that takes the place of `path` only when it is whole and on disk; until then the old one stands.

    :raises OSError: naming `path`, which is left as it was
    """
    given, path = Path(path), Path(os.path.realpath(path))
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a directory: give the name of a file.")
    if given.exists() and not given.is_file():  # A pipe or a device such as /dev/null, which would become a file.
        raise OSError(f"{given} is no regular file: give the name of one.")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(f"{path} is read-only: choose another name, or make it writable.")
    delete_unfinished(path)
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(aside, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(aside, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            aside.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None and error.filename in (None, os.fspath(aside)):
            raise type(error)(error.errno, error.strerror, os.fspath(path)) from error
        raise


def no_link(path: Path, option: str) -> Path:
    """The path of what is written by default into a folder that may be a stranger's, where a link could lead to any file.

    :param option: by which another path is given
    :raises ValueError: if it is a link
    """
    if path.is_symlink():
        raise ValueError(f"{path} is a symbolic link to {os.readlink(path)}: say where to write with {option}.")
    return path


def delete_unfinished(path: Path) -> None:
    """What processes that are gone had begun to write in the place of `path`."""
    for aside in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
        process = aside.name.split(".")[-2]
        if process.isdecimal() and not psutil.pid_exists(int(process)):
            aside.unlink(missing_ok=True)


class FolderInUseError(ValueError):
    """Another process writes into a folder."""


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """The only process that writes into a folder, which is made if need be. (Not watched over on Windows.)

    :raises FolderInUseError: if another one does
    """
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / LOCK, "w") as lock:
        if fcntl is not None:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise FolderInUseError(
                    f"Another process writes into {folder}: wait for it, or choose another folder."
                ) from error
        yield


def write_tree(path: FilePath, tree: Any, whole: bool = False) -> list[str]:
    """Write a tree atomically; a file object is simply written to.

    Leaves are None, booleans, numbers, strings, NumPy arrays, tensors, registered objects and nameable classes; other
    callables inside dictionaries are left out with a warning.

    :param whole: nothing may be left out
    :return: where in the tree something was left out, such as "data.learning_rate"
    :raises TypeError: for any other leaf, naming where it is, before anything is written
    """
    encoder = _Encoder(whole)
    encoded = encoder.encode(tree, "")
    text = json.dumps({"tree": encoded, "left_out": encoder.left_out}, allow_nan=False, indent=1)
    for place in encoder.left_out:
        warnings.warn(
            f"{place} is a callable that cannot be stored without pickle: it is left out. Pass it again when you load, in "
            "custom_objects.",
            stacklevel=3,
        )
    if isinstance(path, io.IOBase):
        _write_archive(path, text, encoder.arrays)  # type: ignore[arg-type]
    else:
        with atomic_write(path) as file:  # type: ignore[arg-type]
            _write_archive(file, text, encoder.arrays)
    return encoder.left_out


def read_tree(path: FilePath) -> tuple[Any, list[str]]:
    """What `write_tree` wrote, and what it left out.

    :raises FileNotFoundError: if there is no such file
    :raises FileFormatError: if it is damaged or no tree
    """
    name = getattr(path, "name", "the file object") if isinstance(path, io.IOBase) else os.fspath(path)  # type: ignore[arg-type]
    try:
        with zipfile.ZipFile(path) as archive:  # type: ignore[arg-type]
            content = json.loads(archive.read("tree.json"), parse_constant=refuse_constant)
            left_out = [str(place) for place in content["left_out"]]
            return _Decoder(archive).decode(content["tree"]), left_out
    except (FileNotFoundError, IsADirectoryError, PermissionError):
        raise
    except FileFormatError as error:
        raise FileFormatError(f"{name}: {error}") from error
    except Exception as error:
        raise FileFormatError(f"{name} is damaged, or not a file of sb3_momba: {type(error).__name__}: {error}") from error


@contextlib.contextmanager
def content_of(path: FilePath) -> Iterator[None]:
    """Inside, a file's content is used: what does not fit is an error that names the file.

    :raises FileFormatError: in place of errors that content of a wrong type or shape leads to
    """
    try:
        yield
    except FileFormatError:
        raise
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    except WRONG_CONTENT as error:
        raise FileFormatError(f"{path} does not hold what it should: {type(error).__name__}: {error}") from error


def with_suffix(path: FilePath, suffix: str) -> FilePath:
    """SB3's habit: a name without a suffix gets one."""
    if isinstance(path, io.IOBase):
        return path
    path = Path(path)  # type: ignore[arg-type]
    return path if path.suffix else path.with_name(path.name + suffix)


def with_existing_suffix(path: FilePath, suffix: str) -> FilePath:
    """The path itself if there is such a file, else with the suffix appended."""
    if isinstance(path, io.IOBase) or Path(path).is_file():  # type: ignore[arg-type]
        return path
    suffixed = Path(f"{os.fspath(path)}{suffix}")  # type: ignore[arg-type]
    return suffixed if suffixed.is_file() else path


class _Encoder:
    def __init__(self, whole: bool) -> None:
        self.arrays: dict[str, np.ndarray] = {}
        self.left_out: list[str] = []
        self.whole = whole

    def encode(self, x: Any, place: str) -> Any:
        if x is None or isinstance(x, bool | str):
            return x
        if isinstance(x, int | np.integer | np.bool_):
            return x.item() if isinstance(x, np.generic) else int(x)
        if isinstance(x, float | np.floating):
            return float(x) if math.isfinite(x) else {"~": "float", "value": repr(float(x))}
        if isinstance(x, th.Tensor):
            if x.dtype == th.bfloat16:
                raise TypeError(f"{place} is a bfloat16 tensor, which NumPy's files do not have: store x.float().")
            return {"~": "tensor", "file": self._store(x.detach().cpu().numpy(), place)}
        if isinstance(x, np.ndarray):
            return {"~": "array", "file": self._store(x, place)}
        name = qualified_name(type(x))
        if name in _codecs and _codecs[name][0] is type(x):
            return {"~": "object", "class": name, "state": self._encode_whole(_codecs[name][1](x), place)}
        if isinstance(x, dict):
            return self._encode_dict(x, place)
        if type(x) in (list, tuple, deque):
            items = [self.encode(item, f"{place}.{i}") for i, item in enumerate(x)]
            if type(x) is list:
                return items
            return {"~": type(x).__name__, "items": items, "maxlen": getattr(x, "maxlen", None)}
        if nameable_class(x):
            return {"~": "class", "name": qualified_name(x)}
        raise TypeError(
            f"{place.lstrip('.')} is a {type(x).__name__}, which cannot be stored without pickle: remove it, or leave it out "
            "of a saved model with exclude=[...]."
        )

    def _encode_whole(self, state: Any, place: str) -> Any:
        """An object's state, of which nothing may be left out: it could not be made again."""
        outer, self.whole = self.whole, True
        try:
            return self.encode(state, place)
        finally:
            self.whole = outer

    def _encode_dict(self, x: dict[Any, Any], place: str) -> Any:
        pairs = []
        for key, value in x.items():
            where = f"{place}.{key}".lstrip(".")
            try:
                pairs.append((key, self.encode(value, where)))
            except TypeError:
                if self.whole or not callable(value):
                    raise
                self.left_out.append(where)
        if all(isinstance(key, str) for key in x) and "~" not in x:
            return dict(pairs)
        return {"~": "dict", "items": [[self.encode(key, place), value] for key, value in pairs]}

    def _store(self, array: np.ndarray, place: str) -> str:
        if array.dtype.kind not in ARRAY_KINDS:
            raise TypeError(f"{place} is an array of dtype {array.dtype}: only numbers can be stored.")
        plain = name = re.sub(r"[^A-Za-z0-9._-]", "_", place)[:LONGEST_NAME]
        for number in count(2):
            if name not in self.arrays:
                break
            name = f"{plain}_{number}"
        self.arrays[name] = array
        return name


class _Decoder:
    def __init__(self, archive: zipfile.ZipFile):
        self.archive = archive

    def decode(self, x: Any) -> Any:
        if isinstance(x, list):
            return [self.decode(item) for item in x]
        if not isinstance(x, dict):
            return x
        kind = x.get("~")
        if kind is None:
            return {key: self.decode(value) for key, value in x.items()}
        if kind == "float":
            return float(x["value"])
        if kind == "array":
            return self._load(x["file"])
        if kind == "tensor":
            return th.from_numpy(self._load(x["file"]))
        if kind == "tuple":
            return tuple(self.decode(item) for item in x["items"])
        if kind == "deque":
            return deque((self.decode(item) for item in x["items"]), maxlen=x["maxlen"])
        if kind == "dict":
            return {self.decode(key): self.decode(value) for key, value in x["items"]}
        if kind == "object":
            if x["class"] not in _codecs:
                raise FileFormatError(f"it names the class {x['class']!r}, which is not registered for files.")
            return _codecs[x["class"]][2](self.decode(x["state"]))
        if kind == "class":
            return _find_class(x["name"])
        raise FileFormatError(f"it holds a value of unknown kind {kind!r}: it may be of a newer version.")

    def _load(self, name: str) -> np.ndarray:
        # Read as a whole, so that its checksum is compared before it is understood.
        content = io.BytesIO(self.archive.read(f"{name}.npy"))
        array = np.lib.format.read_array(content, allow_pickle=False)
        if content.read(1):
            raise FileFormatError(f"its array {name!r} has more bytes than numbers.")
        return array


def _find_class(name: str) -> type:
    trusted = name.split(".")[0] in TRUSTED_ROOTS
    for i in range(len(name) - 1 if trusted else 0, 0, -1):
        if name[i] == "." and name[:i] in sys.modules:
            cls = getattr(sys.modules[name[:i]], name[i + 1 :], None)
            if isinstance(cls, type) and nameable_class(cls):
                return cls
            break
    raise FileFormatError(f"it names the class {name!r}, which is no known module, optimiser or buffer of {TRUSTED_ROOTS}.")


def _write_archive(file: BinaryIO, text: str, arrays: dict[str, np.ndarray]) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo("tree.json"), text)  # without the time: one tree is always the same bytes
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)


def refuse_constant(name: str) -> None:
    raise FileFormatError(f"its JSON holds {name}, which strict JSON does not have.")
