"""A replay buffer in immutable segments: a checkpoint writes only the transitions that are new."""

import secrets
from typing import Any

import numpy as np

from sb3_momba.buffers import STORED_ARRAYS, PreferenceReplayBuffer
from sb3_momba.checkpoints.folders import SHARED, SHARED_NAME, Checkpoint, CheckpointWriter
from sb3_momba.files import FileFormatError, read_tree


def segment_name(first: int, end: int) -> str:
    return f"{first:012d}-{end:012d}-{secrets.token_hex(4)}.npz"


def rows_of(name: str) -> tuple[int, int]:
    """First row and end of a segment.

    :raises FileFormatError: if it is none
    """
    match = SHARED_NAME.fullmatch(name)
    if match is None:
        raise FileFormatError(f"{name!r} is no segment of a replay buffer.")
    return int(match[1]), int(match[2])


def write_segments(buffer: PreferenceReplayBuffer, writer: CheckpointWriter) -> tuple[list[str], dict[str, Any]]:
    """Write what no segment holds yet; all of it where one of them is gone, or the buffer was emptied since.

    The newest row is no part of them: it still changes where its episode is ended from outside.

    :return: the segments that belong to this checkpoint, and the rest of the buffer's state
    """
    oldest, last = buffer.n_added - buffer.size(), max(buffer.n_added - 1, 0)
    names = [name for name in writer.checksums if rows_of(name)[1] > oldest]
    if buffer.n_resets != writer.n_resets or any(map(writer.lacks, names)):
        writer.checksums, writer.n_resets, names = {}, buffer.n_resets, []
    first = max(rows_of(names[-1])[1] if names else 0, oldest)
    if first < last:
        names.append(segment_name(first, last))
        writer.write_shared(names[-1], rows(buffer, first, last))
    newest = {} if buffer.n_added == 0 else rows(buffer, last, last + 1)
    return names, {"n_added": buffer.n_added, "rng": buffer.rng.bit_generator.state, "newest": newest}


def rows(buffer: PreferenceReplayBuffer, first: int, end: int) -> dict[str, np.ndarray]:
    """Rows first to end - 1, counted since the training began."""
    start, stop = first % buffer.buffer_size, (end - 1) % buffer.buffer_size + 1
    arrays = {name: getattr(buffer, name) for name in STORED_ARRAYS}
    if start < stop:
        return {name: array[start:stop] for name, array in arrays.items()}
    return {name: np.concatenate([array[start:], array[:stop]]) for name, array in arrays.items()}


def read_segments(buffer: PreferenceReplayBuffer, checkpoint: Checkpoint, state: dict[str, Any]) -> None:
    """Fill a new buffer.

    :raises FileFormatError: if the rows are not those that the checkpoint states
    """
    n_added = state["n_added"]
    oldest = max(n_added - buffer.buffer_size, 0)
    reached = oldest
    for name in checkpoint.shared:
        (first, end), (arrays, _) = rows_of(name), read_tree(checkpoint.folder.parent / SHARED / name)
        if first > reached:
            raise FileFormatError(f"{checkpoint.folder}: rows {reached} to {first - 1} of the replay buffer are missing.")
        put_rows(buffer, arrays, first, end, oldest)
        reached = end
    if n_added > 0:
        if reached != n_added - 1:
            raise FileFormatError(f"{checkpoint.folder}: its segments end at row {reached}, not at {n_added - 1}.")
        put_rows(buffer, state["newest"], n_added - 1, n_added, oldest)
    buffer.n_added, buffer.pos, buffer.full = n_added, n_added % buffer.buffer_size, n_added >= buffer.buffer_size
    buffer.rng.bit_generator.state = state["rng"]


def put_rows(buffer: PreferenceReplayBuffer, arrays: dict[str, np.ndarray], first: int, end: int, oldest: int) -> None:
    kept = np.arange(max(first, oldest), end)
    for name in STORED_ARRAYS:
        ours, theirs = getattr(buffer, name), arrays[name]
        if theirs.shape != (end - first, *ours.shape[1:]):
            raise FileFormatError(f"{name} of rows {first} to {end - 1} have shape {theirs.shape}: another environment?")
        ours[kept % buffer.buffer_size] = theirs[kept - first]
