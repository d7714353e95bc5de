"""A log's results folder, which only a finished run replaces.

A run writes into `<log>.part`, which replaces `<log>` at the end. A run that is stopped or killed
leaves its part, and older results stay complete.
"""

from __future__ import annotations

import errno
import os
from collections import Counter
from collections.abc import Container, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from sonarrec.errors import SonarrecError, UsageError, name_as_text
from sonarrec.tables import PART
from sonarrec.tables.outputs import Kind, below, is_output

TABLES = ("frames.csv", "estimates.csv", "sightings.csv")
OURS = (*TABLES, "run.toml")
"""Files that a run replaces. Files made from them are deleted; all others belong to the user."""
PAGES: dict[str, Kind] = {"report.html": "report"}
"""Pages made from results; they contain a mark."""
MADE = {
    "evaluation": (
        *("confusion.csv", "roc.csv", "figures.csv", "tests.csv", "passes.csv", "roc.png"),
        *("mistakes.csv", "compare.csv", "changes.csv", "compare.json", "evaluation.json"),
    ),
    "map": ("passes.csv", "map.png", "map.geojson", "map.csv"),
}
"""Folders made from results, and the files in them."""


def folder_names(logs: Sequence[tuple[str, Path]]) -> list[str]:
    """A name for the results of each log of one call.

    It is the log's name, with as many parent folders in front as make all names different.
    logs: (name, resolved path) of each. Raises UsageError if no folders make them different.
    """
    depth = [0] * len(logs)
    while True:
        names = [_name_at_depth(*log, n) for log, n in zip(logs, depth, strict=True)]
        count = Counter(names)
        if max(count.values(), default=1) == 1:
            return names
        for i, (name, path) in enumerate(logs):
            depth[i] += count[names[i]] > 1
            if depth[i] > len(path.parts):
                paths = [str(logs[k][1]) for k, other in enumerate(names) if other == names[i]]
                if len(set(paths)) == 1:
                    raise UsageError(f"{paths[0]}: given {len(paths)} times; name it once")
                raise UsageError(
                    f"{', '.join(paths)}: their results would all go to {name}; run each "
                    "with its own --out"
                )


def possible_names(name: str, path: Path) -> list[str]:
    """Every name that `folder_names` may give to a log, depending on the other logs."""
    return [_name_at_depth(name, path, depth) for depth in range(len(path.parents))]


def _name_at_depth(name: str, path: Path, depth: int) -> str:
    folders = path.parent.parts[1:]  # without the root
    return "-".join([*folders[len(folders) - min(depth, len(folders)) :], name])


class LockedError(SonarrecError):
    """Another run writes into the folder."""


def log_of(folder: Path) -> str:
    """The name of the log that a results folder is of."""
    return name_as_text(folder.resolve().name)


def is_file(path: Path) -> bool:
    """Whether there is such a file. Raises SonarrecError if its folder may not be looked into."""
    try:
        return path.is_file()
    except PermissionError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None


def part_of(folder: Path) -> Path:
    """The folder that a run writes; at its end it replaces `folder`."""
    folder = _named(folder)
    return folder.with_name(folder.name + PART)


def parent_of(folder: Path) -> Path:
    """The folder that holds the results of several logs, of which `folder` is one."""
    return _named(folder).parent


def _named(folder: Path) -> Path:
    """The folder by its name, also where it is given as "." or ".."."""
    return folder.resolve() if folder.name in ("", "..") else folder


def rerun_left(folder: Path) -> list[str]:
    """A line if a later run has left its part in addition to finished results."""
    if not (folder / "frames.csv").is_file() or not (part_of(folder) / "frames.csv").is_file():
        return []
    return [
        f"{folder}: from before a later run that was stopped, or still runs; what that one has "
        f"written is in {part_of(folder)}"
    ]


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """No other run writes `folder` until the end; what a killed run left is put right before.

    Raises LockedError if another run writes it, OSError, and SonarrecError if a file of the user
    is in both folders.
    """
    path = folder.with_name(f".{folder.name}.lock")
    while True:
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)  # a link may lead to any file
        with os.fdopen(os.open(path, flags, 0o666), "wb") as file:
            if not locked(file):
                raise LockedError(
                    f"{folder}: another run writes here now; wait for it, or choose another --out"
                )
            if not path.exists() or not os.path.samestat(os.fstat(file.fileno()), path.stat()):
                continue  # its holder ended and deleted it at this moment
            try:
                restore(folder)
                yield
            finally:
                path.unlink(missing_ok=True)
            return


def _aside(folder: Path) -> Path:
    """Where a run lays old results while it replaces them; one that fails there leaves them."""
    return folder.with_name(f".{folder.name}.old")


def restore(folder: Path) -> None:
    """Clean up after a run that was killed in `exchange` or could not finish it.

    Such a run leaves old results under another name: either nothing has replaced them yet, or not
    all of the user's files in them were moved.
    Raises OSError if that fails, SonarrecError if a file is in both folders.
    """
    old = below(folder.parent, _aside(folder).name)
    below(folder.parent, part_of(folder).name)
    try:
        if old.is_dir() and folder.exists():
            _clear(old, folder)
        elif old.is_dir():
            old.rename(folder)
    except FileExistsError as error:
        raise SonarrecError(
            f"{error.filename}: also in {old}, left by an earlier run; move one of the two"
        ) from None


def exchange(folder: Path) -> list[str]:
    """Replace `folder` by the finished part; the user's files in it are kept.

    Returns a note if these could not be moved. Raises OSError if the part could not be moved.
    """
    old = _aside(folder)
    if folder.exists():
        folder.rename(old)
    part_of(folder).rename(folder)
    try:
        _sync(folder.parent)
        if old.is_dir():
            _clear(old, folder)
    except OSError as error:  # the new results are in place
        return [f"{folder}: other files of the old folder are left in {old} ({error.strerror})"]
    return []


def _sync(folder: Path) -> None:
    """Make the names in a folder permanent, if the system can. Raises OSError."""
    if hasattr(os, "O_DIRECTORY"):
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _clear(old: Path, target: Path) -> None:
    """Delete results, and files made from them, in `old`, and move the rest to `target`."""
    for name, names in MADE.items():
        folder = old / name
        if folder.is_dir() and not folder.is_symlink():
            _move_files(folder, target / name, names)
    pages = (name for name, kind in PAGES.items() if is_output(old / name, kind))
    _move_files(old, target, {*OURS, *pages})


def _move_files(old: Path, target: Path, ours: Container[str]) -> None:
    """Delete the files of these names in `old`, move the rest to `target`, and remove `old`."""
    for entry in sorted(old.iterdir(), key=lambda e: e.name not in ours):
        if entry.name in ours and (entry.is_symlink() or not entry.is_dir()):
            entry.unlink()
            continue
        to = target / entry.name
        if to.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(to))
        target.mkdir(exist_ok=True)
        entry.rename(to)
    old.rmdir()


try:
    import fcntl
except ImportError:  # no such locks on this system
    fcntl = None  # type: ignore[assignment]


def locked(file: IO[bytes] | int, *, wait: bool = False) -> bool:
    """Lock an open file or folder; False if another process has locked it, unless it waits."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB * (not wait))
    except OSError:  # locked, or the file system has no locks
        return False
    return True
