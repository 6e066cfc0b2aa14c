"""Files that are damaged at random, in their bytes or in what they say."""

import io
import json
import random
import zipfile
from collections.abc import Iterator
from typing import Any

import yaml

from tests.torture.examples import Attack, Kind

OTHER_VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 3, 10**12, 10**30, 0.5, -1e308, "", "x", "nan", [], [1, "x"], {}, {"x": 1}),
    *({"~": "float", "value": "nan"}, {"~": "tuple", "items": [1, None]}, {"~": "array", "file": "x"}, {"~": "surprise"}),
)


def flipped(content: bytes, rng: random.Random) -> bytes:
    """One to eight bits are flipped."""
    damaged = bytearray(content)
    for _ in range(rng.choice([1, 1, 2, 8])):
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
    return bytes(damaged)


def cut(content: bytes, rng: random.Random) -> bytes:
    """The end, or a piece from anywhere, is missing."""
    start, stop = span(content, rng)
    return content[:start] + (b"" if rng.random() < 0.5 else content[stop:])


def inserted(content: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(content) + 1)
    return content[:start] + rng.randbytes(rng.choice([1, 2, 8, 100])) + content[start:]


def doubled(content: bytes, rng: random.Random) -> bytes:
    start, stop = span(content, rng)
    return content[:stop] + content[start:stop] + content[stop:]


def swapped(content: bytes, rng: random.Random) -> bytes:
    """Two neighbouring pieces have changed places."""
    start, stop = span(content, rng)
    middle = rng.randint(start, stop)
    return content[:start] + content[middle:stop] + content[start:middle] + content[stop:]


def span(content: bytes, rng: random.Random) -> tuple[int, int]:
    start = rng.randrange(len(content))
    return start, min(start + rng.choice([1, 4, 64, 1000, len(content)]), len(content))


BYTES = (flipped, cut, inserted, doubled, swapped)


def members_of(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def archive_of(members: dict[str, bytes]) -> bytes:
    """With checksums that fit."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return file.getvalue()


def with_a_damaged_member(content: bytes, rng: random.Random) -> bytes:
    members = members_of(content)
    name = rng.choice(list(members))
    members[name] = rng.choice(BYTES)(members[name], rng)
    return archive_of(members)


def with_an_exchanged_member(content: bytes, rng: random.Random) -> bytes:
    """A member has the content of another one, or none, or is missing."""
    members = members_of(content)
    name = rng.choice(list(members))
    members[name] = rng.choice([b"", *members.values()])
    if rng.random() < 0.2:
        del members[name]
    return archive_of(members)


def with_a_changed_tree(content: bytes, rng: random.Random) -> bytes:
    members = members_of(content)
    members["tree.json"] = json.dumps(with_another_value(json.loads(members["tree.json"]), rng)).encode()
    return archive_of(members)


def with_a_changed_line(content: bytes, rng: random.Random) -> bytes:
    lines = content.splitlines()
    number = rng.randrange(len(lines))
    lines[number] = json.dumps(with_another_value(json.loads(lines[number]), rng)).encode()
    return b"\n".join(lines) + b"\n"


def with_a_changed_document(content: bytes, rng: random.Random) -> bytes:
    return json.dumps(with_another_value(json.loads(content), rng)).encode()


def with_a_changed_configuration(content: bytes, rng: random.Random) -> bytes:
    return yaml.safe_dump(with_another_value(yaml.safe_load(content), rng)).encode()


def with_another_value(x: Any, rng: random.Random) -> Any:
    """One place of a JSON document holds something else."""
    container, key = rng.choice(list(places(x)))
    container[key] = rng.choice(OTHER_VALUES)
    return x


def places(x: Any) -> Iterator[tuple[Any, Any]]:
    """Every container in a JSON document with each of its keys."""
    items = list(x.items()) if isinstance(x, dict) else list(enumerate(x)) if isinstance(x, list) else []
    for key, item in items:
        yield x, key
        yield from places(item)


OTHERS = {
    "zip": (with_a_damaged_member, with_an_exchanged_member, with_a_changed_tree, with_a_changed_tree),
    "json": (with_a_changed_document,) * 3,
    "json lines": (with_a_changed_line,) * 3,
    "yaml": (with_a_changed_configuration,) * 3,
}


def mutations(kind: Kind, count: int) -> Iterator[Attack]:
    original = (kind.folder / kind.file).read_bytes()
    for number in range(count):
        rng = random.Random(f"{kind.name} {number}")
        change = rng.choice([*BYTES, *OTHERS[kind.content]])
        yield f"mutation {number}, {change.__name__}", change(original, rng), rng.random() < 0.7
