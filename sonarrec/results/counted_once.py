"""Results of one recording count once, however often they are named."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.records import IntArray
from sonarrec.results.folders import estimates_of
from sonarrec.results.run_file import RunFile

Recording = tuple[str | None, Hashable]
"""A SHA-256, None where it is not known, and what else it takes."""


@dataclass(frozen=True, slots=True)
class TruthOf:
    """What a truth says of a log."""

    file: Path
    name: str
    """Of the log."""
    rows: int
    digest: str
    """Of these."""


@dataclass(frozen=True, slots=True)
class Once:
    """Which of several results count, by index, and what is said of the others."""

    kept: list[int]
    notes: list[str]
    unused: list[str]


def counted_once(
    folders: Sequence[Path],
    recordings: Sequence[Recording],
    frames: Callable[[int], IntArray],
    done: str,
    truths: Sequence[TruthOf] | None = None,
) -> Once:
    """The first results of every recording; together, others would count as independent logs.

    recordings: of `recording`; frames: gives the frame numbers of the i-th, asked where two are of
    one recording. Results of different frames of one recording all count. done: what a command does
    with those that count, such as "scored". truths: of each, where there are any; of copies only
    that of the first is used.
    """
    found = Once([], [], [])
    first: dict[Recording, list[int]] = defaultdict(list)
    for i, folder in enumerate(folders):
        others = first[recordings[i]]
        twin = next((k for k in others if np.intersect1d(frames(k), frames(i)).size), None)
        if twin is None:
            found.kept.append(i)
            others.append(i)
            continue
        digest = recordings[i][0]
        told = f"SHA-256 {digest[:12]}..." if digest else "by its tables"
        line = f"{folder}: the same log as {folders[twin]} ({told}), which counts once"
        if _tables(folder) != _tables(folders[twin]):
            found.unused.append(f"{line}; these other results of it are not {done}")
        elif truths is not None and (lost := _not_used(truths[i], truths[twin])):
            found.unused.append(f"{line}; {lost}")
        else:
            found.notes.append(line)
    return found


def recording(folder: Path, run: RunFile, estimates: int) -> Recording:
    """What tells one recording from another: SHA-256 and topic; where run.toml does not tell them,
    what the tables hold, for a link, or a copy, has the same.

    estimates: how many were read.
    """
    if run.input.recording:
        return run.input.recording
    # Two logs in which nothing was found may be alike; run.toml tells one from the other.
    place = None if estimates or run.table else folder.resolve()
    return None, (_tables(folder), str(run.table), place)


def _tables(folder: Path) -> str:
    return _digest([folder / "frames.csv", estimates_of(folder)])


def _not_used(truth: TruthOf, first: TruthOf) -> str | None:
    """What a truth says beside the one that is used; None where that is nothing."""
    if truth.digest == first.digest:
        return None
    if truth.file != first.file:
        return f"its other truth, {truth.file}, is not used"
    return f"its rows for {truth.name} in {truth.file} are not used" if truth.rows else None


def _digest(paths: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()
