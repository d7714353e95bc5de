"""Which recording results are of: checks against a log, and each recording counts once."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Protocol

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.results.read import read_frames
from sonarrec.results.run_file import RunFile

Recording = tuple[str | None, Hashable]
"""What identifies a recording: its SHA-256, None if not known, and a further key."""


TruthOf = tuple[Path, str]
"""The file of a log's truth, and a hash over the rows of the log."""


class CountedOnce:
    """Keeps the first results of each recording; copies would count as independent logs.

    Results of different frames of one recording all count.

    frames: gives the frame numbers of the i-th results; it is called only if two have one
    recording. action: what a command does with the results, such as "scored". told: of copies.
    """

    def __init__(self, frames: Callable[[int], IntArray], action: str, told: Diagnostics) -> None:
        self._frames, self._action, self._told = frames, action, told
        self._seen: list[tuple[Path, TruthOf | None]] = []
        self._first: dict[Recording, list[int]] = defaultdict(list)

    def add(self, folder: Path, of: Recording, truth: TruthOf | None = None) -> bool:
        """Whether these results count. of: from `recording`. truth: that of copies is not used."""
        i, counted = len(self._seen), self._first[of]
        self._seen.append((folder, truth))
        same = (k for k in counted if np.intersect1d(self._frames(k), self._frames(i)).size)
        twin = next(same, None)
        if twin is None:
            counted.append(i)
            return True
        first, truth_of_first = self._seen[twin]
        by = f"SHA-256 {of[0][:12]}..." if of[0] else "by its tables"
        line = f"{folder}: the same log as {first} ({by}), which counts once"
        if _tables(folder) != _tables(first):
            self._told.problem(f"{line}; these other results of it are not {self._action}")
        elif truth is None or truth_of_first is None or truth[1] == truth_of_first[1]:
            self._told.note(line)
        else:
            self._told.problem(f"{line}; its other truth, {truth[0]}, is not used")
        return False


def recording(folder: Path, run: RunFile, estimates: int) -> Recording:
    """What identifies a recording: SHA-256 and topic; if run.toml lacks them, the tables' contents.

    estimates: how many there are.
    """
    if run.input.recording:
        return run.input.recording
    # Tables without estimates may be equal by chance; then run.toml or the folder tells them apart.
    place = None if estimates or run.table else folder.resolve()
    return None, (_tables(folder), str(run.table), place)


def _tables(folder: Path) -> str:
    digest = hashlib.sha256()
    for path in (folder / "frames.csv", folder / "estimates.csv"):
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


class RecordedLog(Protocol):
    """What identifies a log; `readers.log.Log` has it."""

    @property
    def path(self) -> Path: ...
    @property
    def frame_count(self) -> int | None: ...
    def digest_source(self) -> tuple[int, str]: ...


def check_same_log(log: RecordedLog, folder: Path, run: RunFile) -> None:
    """Raise SonarrecError if the results in `folder` are of another log.

    Compared by size and SHA-256 or, if run.toml lacks them, by the number of frames.
    """
    made_from = run.input
    if made_from.sha256 is not None:
        size, digest = log.digest_source()
        if (size, digest) != (made_from.bytes, made_from.sha256):
            raise SonarrecError(
                f"{folder}: results of another log, {made_from.name} (SHA-256 "
                f"{made_from.sha256[:12]}...), not of {log.path} ({digest[:12]}...); give the log "
                f"they were made from, or `sonarrec run {log.path}`"
            )
        return
    last = last_frame(folder)
    if log.frame_count is not None and last >= log.frame_count:
        raise SonarrecError(
            f"{folder / 'frames.csv'}: results of another log: frame {last} is listed, but "
            f"{log.path} has only {number_of(log.frame_count, 'frame')}"
        )


def last_frame(folder: Path) -> int:
    """The number of the last frame that was processed; -1 if there is none."""
    return int(read_frames(folder)["frame"].max(initial=-1))


def check_one_log(old: Path, before: RunFile, new: Path, after: RunFile) -> str | None:
    """Raise SonarrecError if two results folders are of different logs or topics.

    Returns a note if a run.toml lacks the SHA-256, so that frames are matched by number; else None.
    """
    a, b = before.input, after.input
    if not a.sha256 or not b.sha256:
        without = " and ".join(str(f) for f, i in ((old, a), (new, b)) if not i.sha256)
        return f"{without}: no SHA-256 of the log in run.toml; frames are matched by number"
    if (a.sha256, a.topic) != (b.sha256, b.topic):
        names = (
            f"{i.name} (SHA-256 {i.sha256[:12]}...{f', topic {i.topic}' if i.topic else ''})"
            for i in (a, b)
            if i.sha256
        )
        raise SonarrecError(
            f"{old} and {new}: results of different logs, {' and '.join(names)}; compare results "
            "of one log"
        )
    return None
