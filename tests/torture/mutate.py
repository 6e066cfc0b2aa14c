"""Damaged and malicious files, loaded one after the other."""

import contextlib
import json
import resource
import shutil
import signal
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

from sb3_momba.checkpoints.folders import MANIFEST, checkpoints_in, described, sealed
from sb3_momba.files import FileFormatError
from tests.torture.damage import mutations
from tests.torture.examples import Attack, Kind, kinds_of_files
from tests.torture.malice import malicious_files, sb3_executes
from tests.torture.measured import Counts, Measured, Rows, totals
from tests.torture.processes import new_folder, result_of, started, was_killed

MEMORY = 2**30  # bytes that a load may take
LONGEST_LOAD = 10.0  # seconds of processor time


class TooLongError(BaseException):
    """A load that does not come to an end; no handler of ordinary errors catches it."""


def seal(folder: Path) -> None:
    """Let the manifest of the only checkpoint in a folder state the checksums that its files have."""
    for checkpoint in checkpoints_in(folder):
        with contextlib.suppress(Exception):
            content = json.loads((checkpoint / MANIFEST).read_text())["content"]
            for name in content["files"]:
                if (checkpoint / name).is_file():
                    content["files"][name] = described(checkpoint / name)
            (checkpoint / MANIFEST).write_text(sealed(content))


def outcome_of(kind: Kind, content: bytes, sealed: bool, canary: Path) -> str:
    """What comes of loading a file with other content: "loaded", "refused", "executed" or an unexpected error's name."""
    with new_folder() as copy:
        shutil.copytree(kind.folder, copy, dirs_exist_ok=True)
        (copy / kind.file).write_bytes(content)
        if sealed:
            seal(copy)
        signal.setitimer(signal.ITIMER_PROF, LONGEST_LOAD)
        try:
            kind.load(copy)
            outcome = "loaded"
        except BaseException as error:
            is_named = isinstance(error, ValueError | OSError) and Path(kind.file).name in str(error)
            is_expected = isinstance(error, FileFormatError) or is_named
            outcome = "refused" if is_expected else f"{type(error).__name__}: {error} ({place_of(error)})"
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
    if canary.exists():
        canary.rmdir()
        return "executed"
    return outcome


def place_of(error: BaseException) -> str:
    """The line of the package that an error has passed last."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "sb3_momba" in Path(frame.filename).parts]
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "outside the package"


def note_outcomes(kind: Kind, attacks: list[Attack], canary: Path, notes: Path) -> None:
    """Load one file after the other, each with a limit on its memory and time."""

    def give_up(*_: Any) -> None:
        raise TooLongError

    signal.signal(signal.SIGPROF, give_up)
    limit_memory(MEMORY)
    with open(notes, "a") as file:
        for _, content, sealed in attacks:
            file.write(json.dumps(outcome_of(kind, content, sealed, canary)) + "\n")
            file.flush()


def limit_memory(room: int) -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + room, resource.RLIM_INFINITY))


def outcomes_of(kind: Kind, attacks: list[Attack], canary: Path) -> list[str]:
    """In a process of their own; where that dies, the rest in another one."""
    outcomes: list[str] = []
    with new_folder() as folder:
        while len(outcomes) < len(attacks):
            notes = folder / f"{len(outcomes)}"
            process = started(note_outcomes, kind, attacks[len(outcomes) :], canary, notes)
            ended_well = not was_killed(process)
            outcomes += [json.loads(line) for line in notes.read_text().splitlines()]
            if len(outcomes) < len(attacks):
                outcomes.append("the process ended" if ended_well else "the process was killed")
    return outcomes


def mutate(counts: Counts) -> Measured:
    """Damaged and malicious files: what is loaded, what is refused, and what should never come of it."""
    rows: Rows = [
        ["file", "mutations", "loaded all the same", "refused", "other errors", "malicious", "refused or ignored", "executed"]
    ]
    broken: list[str] = []
    with new_folder() as folder:
        canary = folder / "canary"
        kinds = kinds_of_files(folder)
        for i, kind in enumerate(kinds):
            count = counts["mutations"] // len(kinds) + (i < counts["mutations"] % len(kinds))
            damaged = list(mutations(kind, count))
            malicious = list(malicious_files(kind, canary, counts["every_slot"]))
            outcomes = outcomes_of(kind, [*damaged, *malicious], canary)
            of_damaged = Counter(map(in_short, outcomes[: len(damaged)]))
            of_malicious = Counter(map(in_short, outcomes[len(damaged) :]))
            fine = of_malicious["refused"] + of_malicious["loaded"]
            executed = of_damaged["executed"] + of_malicious["executed"]
            found = [of_damaged[outcome] for outcome in ("loaded", "refused", "other")]
            rows.append([kind.name, len(damaged), *found, len(malicious), fine, executed])
            for (what, _, _), outcome in zip([*damaged, *malicious], outcomes, strict=True):
                if outcome not in ("loaded", "refused"):
                    broken.append(f"{kind.name}, {what}: {outcome}")
        rows.append(["all", *totals(rows)])
        theirs = [result_of(sb3_executes, what, canary) for what in ("model", "buffer")]
        rows.append(["SB3's SAC: model, replay buffer", "", "", "", "", 2, theirs.count(False), theirs.count(True)])
    return Measured(rows, broken)


def in_short(outcome: str) -> str:
    return outcome if outcome in ("loaded", "refused", "executed") else "other"
