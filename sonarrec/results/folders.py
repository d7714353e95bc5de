"""Where a log's results go: a folder of its own, which only a finished run replaces.

A run writes into `<log>.part` beside `<log>` and takes its place at the end. One that is stopped
or killed leaves its part; what was there before stays whole.
"""

from __future__ import annotations

import errno
import os
from collections import defaultdict
from collections.abc import Container, Sequence
from pathlib import Path
from typing import IO

from sonarrec.files.locks import is_there, locked
from sonarrec.files.outputs import Kind, is_output
from sonarrec.records import PART, SonarrecError, UsageError, shown

LONGEST_NAME = 255
"""Bytes of a file's name, on all common file systems."""

TABLES = ("frames.csv", "estimates.csv", "sightings.csv")
ESTIMATES = ("estimates.csv", "estimates.parquet")
"""What the estimates may be in; see `estimates_of`."""
OURS = (*TABLES, "estimates.parquet", "run.toml")
"""What a run replaces. What was made from it goes as well, and all else in a results folder is the
user's."""
PAGES: dict[str, Kind] = {"report.html": "report", "compare.html": "comparison"}
"""Pages made from results, of which each bears a mark."""
MADE = {
    "evaluation": (
        *("confusion.csv", "per_log.csv", "roc.csv", "figures.csv", "tests.csv", "passes.csv"),
        *("reliability.csv", "roc.png", "roc_by_id.png", "det.png", "reliability.png"),
        *("compare.csv", "changes.csv", "compare.json", "evaluation.json"),
    ),
    "map": ("passes.csv", "factors.csv", "graph.g2o", "map.png", "map.geojson", "map.csv"),
}
"""Folders made from results, and what is made in them."""


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
                places = [str(logs[k][1]) for k in alike[names[i]]]
                if len(set(places)) == 1:
                    raise UsageError(f"{places[0]}: given {len(places)} times; name it once")
                raise UsageError(
                    f"{', '.join(places)}: their results would all go to {logs[i][0]}; run them "
                    "apart, each with an --out of its own"
                )


def possible_names(name: str, place: Path) -> list[str]:
    """Every name that `folder_names` may give to a log, by which others it is run with."""
    return [_named(name, place, depth) for depth in range(len(place.parents))]


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
    """Where a run writes before it takes the place of `folder`, or of what that is a link to."""
    place = _place(folder)
    return place.with_name(place.name + PART)


def _place(folder: Path) -> Path:
    return folder.resolve() if folder.is_symlink() else folder


def check_name(folder: Path) -> None:
    """Raises SonarrecError where the name is too long for what lies beside the folder in a run."""
    over = len(os.fsencode(_lock_file(folder).name)) - LONGEST_NAME
    if over > 0:
        raise SonarrecError(
            f"{shown(folder)}: a name too long for results by {over} bytes; shorten the log's"
        )


def lock(folder: Path) -> IO[bytes]:
    """Hold `folder` for this run until the file is closed: see `release`.

    Raises LockedError where another run writes there now.
    """
    path = _lock_file(folder)
    while True:
        file = path.open("wb")
        if not locked(file, alone=True):
            file.close()
            raise LockedError(
                f"{folder}: another run writes here now; wait for it, or choose another --out"
            )
        if is_there(file, path):
            return file
        file.close()  # whoever held it ended, and took it away, this very moment


def release(folder: Path, held: IO[bytes]) -> None:
    """Let others write to `folder` again."""
    _lock_file(folder).unlink(missing_ok=True)
    held.close()


def _lock_file(folder: Path) -> Path:
    place = _place(folder)
    return place.with_name(f".{place.name}.lock")


def _aside(folder: Path) -> Path:
    place = _place(folder)
    return place.with_name(f".{place.name}.old")


def restore(folder: Path) -> None:
    """Put right what a run left that was killed in `exchange`, or could not end it.

    That is an old result whose place was not taken yet, or what was still to be moved from it.
    Raises OSError where that cannot be done, SonarrecError where a file is in both.
    """
    place, old = _place(folder), _aside(folder)
    if old.is_dir():
        if place.exists():
            try:
                _clear(old, place)
            except FileExistsError as error:
                raise SonarrecError(
                    f"{error.filename}: also in {old}, left by an earlier run; move one of the two"
                ) from None
        else:
            old.rename(place)


def exchange(folder: Path) -> list[str]:
    """Let the finished part take the place of `folder`, whose other files it keeps.

    Returns a note where they could not be moved. Raises OSError where the part is still there.
    """
    place, old = _place(folder), _aside(folder)
    if place.exists():
        place.rename(old)
    part_of(folder).rename(place)
    try:
        if hasattr(os, "O_DIRECTORY"):
            handle = os.open(place.parent, os.O_RDONLY | os.O_DIRECTORY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)
        if old.is_dir():
            _clear(old, place)
    except OSError as error:  # the new results are where they belong
        return [f"{folder}: what was beside the results before is left in {old} ({error.strerror})"]
    return []


def _clear(old: Path, place: Path) -> None:
    """Delete in `old` what a run made and what was made from it, and move the rest.

    Raises OSError where some must stay.
    """
    for name, made in MADE.items():
        folder = old / name
        if folder.is_dir() and not folder.is_symlink():
            _take_over(folder, place / name, made)
    pages = (name for name, kind in PAGES.items() if is_output(old / name, kind))
    _take_over(old, place, {*OURS, *pages})


def _take_over(old: Path, place: Path, ours: Container[str]) -> None:
    """Delete the files of these names in `old`, move the rest to `place`, and remove `old`."""
    for entry in sorted(old.iterdir(), key=lambda e: e.name not in ours):
        if entry.name in ours and (entry.is_symlink() or not entry.is_dir()):
            entry.unlink()
            continue
        to = place / entry.name
        if to.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(to))
        place.mkdir(exist_ok=True)
        entry.rename(to)
    old.rmdir()
