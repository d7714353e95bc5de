"""Finds the logs that the arguments of a command name: files, folders of logs, globs, lists."""

from __future__ import annotations

import glob
import itertools
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from sonarrec.errors import UsageError, number_of
from sonarrec.readers.containers.bag_folder import is_bag_folder
from sonarrec.readers.containers.images import is_array, is_image
from sonarrec.readers.open import is_log_file, matches, not_read
from sonarrec.tables import natural_order

RESULTS = frozenset({"frames.csv", "evaluation.json", "map.csv"})
"""A folder with one of these holds results, so its images are no log."""


@dataclass(frozen=True, slots=True)
class NamedLog:
    """One log of a command."""

    path: str
    up_to: Path | None = None
    """The folder that the user named and that holds the log: the highest folder searched for files
    that belong to it. None if the user named the log itself."""


def logs_named(name: str, *, recursive: bool = False) -> list[NamedLog]:
    """The logs that an argument of a command names, in natural order. A folder of logs names every
    file and bag in it; with `recursive` also those in all folders below, and every folder of images
    there. A glob names each log that matches; if parts of a bag match, it names the bag. Any other
    argument is one log by itself; if it is none, that is reported when it is opened. Raises
    UsageError for a folder that holds images and other logs."""
    try:
        logs = _logs_below(name, recursive)
    except OSError:  # reported when it is opened
        logs = []
    return logs or [NamedLog(name)]


def logs_of(name: str) -> list[NamedLog]:
    """The logs of an argument that may be a campaign: as `logs_named`, and of a folder that is no
    log also those below it, such as folders of images."""
    path = Path(name)
    is_folder = path.is_dir() and not _is_bag(path)
    return logs_named(name, recursive=is_folder and _in_folder(path) != [path])


def unread_below(name: str, *, recursive: bool = False) -> str:
    """What a folder of logs holds that may be recordings, and is not read: files by ending, and
    folders of images."""
    top = Path(name)
    if not top.is_dir() or _is_bag(top):
        return ""
    entries = [*(top.rglob("*") if recursive else top.iterdir())]
    unread = []
    if files := not_read(entries):
        unread.append(f"{files} (sonarrec help formats has what is)")
    folders = (
        0 if recursive else sum(e.is_dir() and not _is_bag(e) and _is_images(e) for e in entries)
    )
    if folders and not _is_images(top):
        unread.append(f"{number_of(folders, 'folder')} of images (--recursive reads them)")
    return ", ".join(unread)


def log_arguments(names: Iterable[str], listed: Iterable[str]) -> list[str]:
    """The arguments of a command and the lines of a list, without empty lines, # comments and the
    quotes round a line. Raises UsageError if no log is named, or each image of a folder by itself.
    """
    lines = (re.sub(r"""^(["'])(.+)\1$""", r"\2", line.strip()) for line in listed)
    logs = [*names, *(line for line in lines if line and not line.startswith("#"))]
    if not logs:
        raise UsageError("--from-file: the list names no log")
    if len(images := [log for log in logs if is_image(Path(log))]) > 1:
        each = f"{len(images)} images, each as a log of its own, {images[0]} the first"
        raise UsageError(f"{each}; give their folder, or put the pattern in quotes")
    return logs


def _logs_below(name: str, recursive: bool) -> list[NamedLog]:
    """The logs of a folder or of a glob; none if the argument is neither, or one log by itself."""
    path = Path(name)
    if path.is_dir():
        if is_bag_folder(path):
            return []
        paths = list(_below(path)) if recursive else _in_folder(path)
        return _sorted(paths, path) if paths != [path] else []
    if not glob.has_magic(name) or path.exists():
        return []
    paths = matches(path)
    bags = {folder for folder in {f.parent for f in paths} if is_bag_folder(folder)}
    paths = [f.parent if f.parent in bags and is_log_file(f) else f for f in paths]
    logs = {p for p in paths if is_log_file(p) or (p.is_dir() and (_is_bag(p) or _is_images(p)))}
    images = [NamedLog(name)] if paths and not logs else []
    # The folder in front of the first wildcard: dives of dives/**/*.mcap.
    fixed = itertools.takewhile(lambda part: not glob.has_magic(part), path.parts[:-1])
    return [*images, *_sorted(logs, Path(*fixed))]


def _sorted(logs: Iterable[Path], up_to: Path) -> list[NamedLog]:
    return [NamedLog(str(log), up_to) for log in sorted(logs, key=natural_order)]


def _holds_results(folder: Path) -> bool:
    return any((folder / name).exists() for name in RESULTS)


def _is_images(folder: Path) -> bool:
    """Whether a folder holds images, or arrays, that do not belong to results."""
    return not _holds_results(folder) and any(is_image(e) or is_array(e) for e in folder.iterdir())


def _is_bag(folder: Path) -> bool:
    """Whether a folder is a bag or cannot be read. A folder that cannot be read is reported when it
    is opened; skipping it would hide its logs."""
    try:
        return is_bag_folder(folder)
    except OSError:
        return True


def _in_folder(folder: Path) -> list[Path]:
    """The logs of one folder: the folder itself if it holds images, else each file and bag in it;
    the folder itself if there is neither, and it holds arrays.
    Raises UsageError if it holds both, because it is not clear which are meant."""
    image, logs, bags, arrays = None, [], [], False
    with os.scandir(folder) as entries:
        for entry in entries:
            path = folder / entry.name
            if entry.name[0] == ".":
                continue
            if is_log_file(path):
                logs.append(path)
            elif image is None and is_image(path):
                image = path
            elif is_array(path):
                arrays = True
            elif entry.is_dir() and _is_bag(path):
                bags.append(path)
    if image is None:
        return [*logs, *bags] or ([folder] if arrays else [])
    if logs:
        first = min(logs, key=natural_order)
        raise UsageError(
            f"{folder}: holds images and other logs ({len(logs)}, {first.name} the first); choose "
            f"with a quoted glob, as '{folder}/*{image.suffix}' or '{folder}/*{first.suffix}'"
        )
    return [folder]


def _below(top: Path) -> Iterator[Path]:
    """The logs of a folder and of all folders below it, except hidden folders and results. Links to
    folders are followed, last in their folder. A folder is searched once, and folders that hold
    `top` are not searched."""
    met = {os.fspath(above) for above in top.resolve().parents}
    for parent, folders, _ in os.walk(top, followlinks=True):
        folder, real = Path(parent), os.path.realpath(parent)
        if real in met or _holds_results(folder):
            folders.clear()
            continue
        met.add(real)
        shown = [f for f in folders if f[0] != "."]
        bags = {f for f in shown if _is_bag(folder / f)}
        folders[:] = sorted(set(shown) - bags, key=lambda f: ((folder / f).is_symlink(), f))
        yield from {*_in_folder(folder), *(folder / bag for bag in bags)}
