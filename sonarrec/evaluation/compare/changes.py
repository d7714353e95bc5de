"""Frames and IDs whose counts have changed, found log by log."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import IntArray
from sonarrec.evaluation.counting.scoring import PROTOCOLS, Scored, score
from sonarrec.evaluation.matching.joined import Joined

CHANGE = np.dtype([("frame", "i4"), ("landmark", "i4"), ("old", "i2", 3), ("new", "i2", 3)])
VERDICTS = {"better": -1, "worse": 1, "other": 0}
"""The sign of the number of errors that came."""
GAP = 2
"""Largest step in frames between equal changes of one run."""

ByMethod = Mapping[tuple[str, str], npt.NDArray[Any]]
"""The CHANGEs of each protocol and method, by frame, then in the order of the IDs."""


@dataclass(frozen=True, slots=True)
class FrameChange:
    """A frame and ID whose counts have changed for one method."""

    protocol: str
    method: str
    log: str
    frame: int
    landmark: int
    old: tuple[int, int, int]
    new: tuple[int, int, int]
    """TP, FP, FN there."""

    @property
    def verdict(self) -> str:
        """ "better", "worse" or "other", by the number of errors."""
        more = sum(self.new[1:]) - sum(self.old[1:])
        return "worse" if more > 0 else "better" if more < 0 else "other"


@dataclass(frozen=True, slots=True)
class FrameRun:
    """Equal changes in neighbouring frames."""

    first: FrameChange
    last_frame: int
    count: int
    """How many frames changed."""


@dataclass(frozen=True, slots=True)
class FrameChanges:
    """All changes."""

    rows: Mapping[int, ByMethod]
    """By the number of the log."""
    logs: tuple[tuple[int, str], ...]
    """Number and name of each log that counts, in order."""
    methods: tuple[tuple[str, str], ...]
    """Protocol and method, in order."""

    def __iter__(self) -> Iterator[FrameChange]:
        for protocol, method in self.methods:
            for number, log in self.logs:
                for row in self._rows(protocol, method, number):
                    yield _change(protocol, method, log, row)

    def verdicts(self) -> dict[str, int]:
        """How many changes are better, worse and other."""
        counts: Counter[int] = Counter()
        for of in self.methods:
            for number, _ in self.logs:
                counts.update(np.sign(_more_errors(self._rows(*of, number))).tolist())
        return {name: counts[sign] for name, sign in VERDICTS.items()}

    def runs(
        self, most: int, protocol: str | None = None, verdict: str | None = None
    ) -> tuple[list[FrameRun], int]:
        """The `most` longest runs, and how many there are; of one protocol and verdict if given.

        Runs of equal length are ordered by protocol, method, log, ID and change.
        """
        numbers: dict[str, list[int]] = {}
        for number, log in self.logs:
            numbers.setdefault(log, []).append(number)
        longest: list[FrameRun] = []
        count = 0
        for of in sorted(m for m in self.methods if protocol in (None, m[0])):
            for log in sorted(numbers):
                rows = np.concatenate([self._rows(*of, number) for number in numbers[log]])
                if verdict is not None:
                    rows = rows[np.sign(_more_errors(rows)) == VERDICTS[verdict]]
                rows, start, length = _runs(rows)
                count += len(start)
                for i in np.argsort(-length, kind="stable")[:most].tolist():
                    first, last = rows[start[i]], rows[start[i] + length[i] - 1]
                    run = FrameRun(_change(*of, log, first), int(last["frame"]), int(length[i]))
                    longest.append(run)
                # nsmallest is stable, so of runs of equal length the first ones are kept.
                longest = heapq.nsmallest(most, longest, key=lambda run: -run.count)
        return longest, count

    def _rows(self, protocol: str, method: str, number: int) -> npt.NDArray[Any]:
        return self.rows[number].get((protocol, method), np.empty(0, dtype=CHANGE))


def changed_frames(
    before: tuple[Joined, Sequence[Scored]], after: tuple[Joined, Sequence[Scored]]
) -> ByMethod:
    """The changes in one log, whose frames and truth are the same before and after.

    A method that is missing on one side counts as making no claims there.
    """
    methods = tuple(dict.fromkeys((*before[0].methods, *after[0].methods)))
    placed = before[0].placed and after[0].placed
    changes = {}
    for protocol in PROTOCOLS if placed else PROTOCOLS[:1]:
        for method in methods:
            a, b = (_scored_or_silent(*side, protocol, method) for side in (before, after))
            rows = _changes_between(a, b, after[0])
            if len(rows):
                changes[protocol, method] = rows
    return changes


def _scored_or_silent(
    joined: Joined, scored: Sequence[Scored], protocol: str, method: str
) -> Scored:
    """One method under one protocol; without claims if the method is missing."""
    for one in scored:
        if (one.protocol, one.method) == (protocol, method):
            return one
    more = replace(joined, methods=(*joined.methods, method))
    return score(more, len(joined.methods), protocol)


def _changes_between(a: Scored, b: Scored, joined: Joined) -> npt.NDArray[Any]:
    """The CHANGEs of one method from a (old) to b (new)."""
    frames = len(joined.frame)
    cells = [s.declared_by(np.arange(frames), joined.truth_frame_index, frames) for s in (a, b)]
    old, new = (c[:, :, [0, 2, 3]] for c in cells)
    frame, k = np.nonzero((old != new).any(axis=2))
    rows = np.empty(len(frame), dtype=CHANGE)
    rows["frame"], rows["landmark"] = joined.frame[frame], np.array(joined.ids)[k]
    rows["old"], rows["new"] = old[frame, k], new[frame, k]
    return rows


def _more_errors(rows: npt.NDArray[Any]) -> IntArray:
    """(n,) how many more errors there are than before."""
    more = rows["new"][:, 1:].sum(axis=1) - rows["old"][:, 1:].sum(axis=1)
    return np.asarray(more, dtype=np.int64)


def _runs(rows: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], IntArray, IntArray]:
    """(rows sorted by ID, change and frame; (R,) start of each run; (R,) its length)."""
    keys = [rows["landmark"], *rows["old"].T, *rows["new"].T, rows["frame"]]
    rows = rows[np.lexsort(keys[::-1])]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = np.diff(rows["frame"]) > GAP
    new[1:] |= np.diff(rows["landmark"]) != 0
    for side in ("old", "new"):
        new[1:] |= (np.diff(rows[side], axis=0) != 0).any(axis=1)
    start = np.flatnonzero(new)
    return rows, start, np.diff(np.append(start, len(rows)))


def _change(protocol: str, method: str, log: str, row: Any) -> FrameChange:
    old, new = ((int(c[0]), int(c[1]), int(c[2])) for c in (row["old"], row["new"]))
    return FrameChange(protocol, method, log, int(row["frame"]), int(row["landmark"]), old, new)
