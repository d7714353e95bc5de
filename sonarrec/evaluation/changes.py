"""Frames and IDs whose counts have changed, found log by log."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import IntArray
from sonarrec.evaluation.judge import PROTOCOLS, judge
from sonarrec.evaluation.match import Matched

CHANGE = np.dtype([("frame", "i4"), ("landmark", "i4"), ("old", "i2", 3), ("new", "i2", 3)])
NONE = np.empty(0, dtype=CHANGE)
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


CHANGES = (
    *("protocol", "method", "log", "frame", "landmark", "change"),
    *("tp_old", "fp_old", "fn_old", "tp_new", "fp_new", "fn_new"),
)
"""Columns of changes.csv."""


def change_cells(c: FrameChange) -> tuple[object, ...]:
    """The cells of CHANGES."""
    return c.protocol, c.method, c.log, c.frame, c.landmark, c.verdict, *c.old, *c.new


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

    logs: tuple[tuple[str, ByMethod], ...]
    """The name of each log, and its changes."""
    methods: tuple[tuple[str, str], ...]
    """Protocol and method, in order."""

    def __iter__(self) -> Iterator[FrameChange]:
        for protocol, method in self.methods:
            for log, changes in self.logs:
                for row in changes.get((protocol, method), NONE):
                    yield _change(protocol, method, log, row)

    def verdicts(self, protocol: str | None = None) -> dict[str, int]:
        """How many changes are better, worse and other; under one protocol if given."""
        counts: Counter[int] = Counter()
        for of in self.methods:
            if protocol not in (None, of[0]):
                continue
            for _, changes in self.logs:
                counts.update(np.sign(_more_errors(changes.get(of, NONE))).tolist())
        return {name: counts[sign] for name, sign in VERDICTS.items()}

    def runs(
        self, most: int, protocol: str | None = None, verdict: str | None = None
    ) -> tuple[list[FrameRun], int]:
        """The `most` longest runs, and how many there are; of one protocol and verdict if given.

        Runs of equal length are ordered by protocol, method, log, ID and change.
        """
        longest: list[FrameRun] = []
        count = 0
        for of in sorted(m for m in self.methods if protocol in (None, m[0])):
            for log, changes in sorted(self.logs, key=lambda named: named[0]):
                rows = changes.get(of, NONE)
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


def changed_frames(before: Matched, after: Matched) -> ByMethod:
    """The changes in one log, whose frames and truth are the same before and after.

    A method that is missing on one side counts as making no claims there.
    """
    frames, ids = len(after.frame), np.array(after.ids)
    found = {}
    for protocol in PROTOCOLS if before.placed and after.placed else PROTOCOLS[:1]:
        for method in dict.fromkeys((*before.methods, *after.methods)):
            old, new = (
                judge(log, method, protocol).declared(
                    np.arange(frames), log.truth_frame_index, frames
                )[:, :, [0, 2, 3]]
                for log in (before, after)
            )
            frame, k = np.nonzero((old != new).any(axis=2))
            rows = np.empty(len(frame), dtype=CHANGE)
            rows["frame"], rows["landmark"] = after.frame[frame], ids[k]
            rows["old"], rows["new"] = old[frame, k], new[frame, k]
            if len(rows):
                found[protocol, method] = rows
    return found


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
