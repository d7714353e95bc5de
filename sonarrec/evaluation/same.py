"""Results of one recording count once, however often they are named."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.results.read import LogResults


@dataclass(frozen=True, slots=True)
class Once:
    """Which of several results count, by index, and what is said of the others."""

    kept: list[int]
    notes: list[str]
    unused: list[str]


def counted_once(folders: Sequence[Path], logs: Sequence[LogResults]) -> Once:
    """The first results of every recording; pooled, others would count as independent logs.

    A recording is told by SHA-256 and topic; where run.toml does not tell them, by what the tables
    hold. Results of different frames of one recording all count.
    """
    found = Once([], [], [])
    first: dict[Hashable, list[int]] = defaultdict(list)
    for i, (folder, log) in enumerate(zip(folders, logs, strict=True)):
        others = first[_recording(folder, log)]
        twin = next((k for k in others if np.intersect1d(logs[k].frame, log.frame).size), None)
        if twin is None:
            found.kept.append(i)
            others.append(i)
            continue
        digest = log.run.input.sha256
        told = f"SHA-256 {digest[:12]}..." if digest else "by its tables"
        line = f"{folder}: the same log as {folders[twin]} ({told}), which counts once"
        if _tables(folder) == _tables(folders[twin]):
            found.notes.append(line)
        else:
            found.unused.append(f"{line}; these other results of it are not scored")
    return found


def recording(log: LogResults) -> Hashable | None:
    """What tells one recording from another; None where run.toml does not say."""
    source = log.run.input
    return (source.sha256, source.topic) if source.sha256 else None


def _recording(folder: Path, log: LogResults) -> Hashable:
    """Also where run.toml does not say: a link, or a copy, has the same tables."""
    known = recording(log)
    if known is not None:
        return known
    # Two logs in which nothing was found may be alike; run.toml tells one from the other.
    place = None if len(log.frame_index) or log.run.table else folder.resolve()
    return _tables(folder), str(log.run.table), place


def _tables(folder: Path) -> str:
    digest = hashlib.sha256()
    for name in ("frames.csv", "estimates.csv"):
        with (folder / name).open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()
