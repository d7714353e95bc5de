"""Where a log's results go: a folder of its own, which only a finished run replaces.

A run writes into `<log>.part` beside `<log>` and takes its place at the end. One that is stopped
or killed leaves its part; what was there before stays whole.
"""

from __future__ import annotations

import os
import shutil
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from sonarrec.records import PART, SonarrecError, UsageError

TABLES = ("frames.csv", "estimates.csv", "sightings.csv")
ESTIMATES = ("estimates.csv", "estimates.parquet")
"""What the estimates may be in; see `estimates_of`."""
OURS = (
    *TABLES,
    "estimates.parquet",
    "run.toml",
    "evaluation",
    "map",
    "report.html",
    "compare.html",
)
"""What a run replaces, and what was made from it. All else in a results folder is the user's."""


def folder_names(logs: Sequence[tuple[str, Path]]) -> list[str]:
    """A name for the results of each log of one call.

    logs: (name, resolved place) of each. The name itself where no other log has it, else with as
    many of the place's folders in front as tell them apart. Raises UsageError where nothing does.
    """
    depth = [0] * len(logs)
    while True:
        names = [_named(*log, n) for log, n in zip(logs, depth, strict=True)]
        alike: dict[str, list[int]] = defaultdict(list)
        for i, name in enumerate(names):
            alike[name].append(i)
        clashing = [i for same in alike.values() if len(same) > 1 for i in same]
        if not clashing:
            return names
        for i in clashing:
            depth[i] += 1
            if depth[i] > len(logs[i][1].parts):
                same = ", ".join(str(logs[k][1]) for k in alike[names[i]])
                raise UsageError(
                    f"{same}: their results would all go to {logs[i][0]}; run them apart, "
                    "each with an --out of its own"
                )


def _named(name: str, place: Path, depth: int) -> str:
    folders = place.parent.parts[1:]  # without the root
    return "-".join([*folders[len(folders) - min(depth, len(folders)) :], name])


class LockedError(SonarrecError):
    """Another run writes into the folder."""


def estimates_of(folder: Path) -> Path:
    """The table of estimates in a folder: that which is there; CSV where both or none are."""
    places = [folder / name for name in ESTIMATES]
    return next((place for place in places if place.is_file()), places[0])


def part_of(folder: Path) -> Path:
    """Where a run writes before it takes the place of `folder`."""
    return folder.with_name(folder.name + PART)


def lock(folder: Path) -> IO[bytes]:
    """Hold `folder` for this run until the file is closed: see `release`.

    Raises LockedError where another run writes there now.
    """
    file = _lock_file(folder).open("wb")
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise LockedError(
            f"{folder}: another run writes here now; wait for it, or choose another --out"
        ) from None
    return file


def release(folder: Path, held: IO[bytes]) -> None:
    """Let others write to `folder` again."""
    _lock_file(folder).unlink(missing_ok=True)
    held.close()


def _lock_file(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.lock")


def _aside(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.old")


def restore(folder: Path) -> None:
    """Put an old result back whose run was killed between the two steps of `exchange`."""
    if _aside(folder).is_dir() and not folder.exists():
        _aside(folder).rename(folder)


def exchange(folder: Path) -> None:
    """Let the finished part take the place of `folder`, whose other files it keeps."""
    part, old = part_of(folder), _aside(folder)
    if folder.exists():
        shutil.rmtree(old, ignore_errors=True)
        folder.rename(old)
    part.rename(folder)
    if old.is_dir():
        for entry in old.iterdir():
            if entry.name not in OURS:
                entry.rename(folder / entry.name)
        shutil.rmtree(old)
    if hasattr(os, "O_DIRECTORY"):
        handle = os.open(folder.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
