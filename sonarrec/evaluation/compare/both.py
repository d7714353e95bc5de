"""One log on both sides: cut to the frames both hold, matched with its truth and counted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.evaluation.compare.changes import ByMethod, changed_frames
from sonarrec.evaluation.counting.parts import Part, part_of, score_all
from sonarrec.evaluation.matching.fit import Checked, checked, matched
from sonarrec.evaluation.matching.joined import join
from sonarrec.evaluation.matching.options import ScoringOptions
from sonarrec.evaluation.survey import Unread, truth_table
from sonarrec.records import SonarrecError
from sonarrec.results.read import LogResults, not_whole, read_log


@dataclass(frozen=True, slots=True)
class BothReading:
    """One log to be read on both sides and counted."""

    was: Path
    now: Path
    """Folders of its old and its new results."""
    ground_truth: Path
    name: str
    """Of the log, as it is told, and as the log column of the truth has it."""
    options: ScoringOptions
    ids: tuple[int, ...] | None = None
    """As of `survey.Reading`."""

    @property
    def folders(self) -> tuple[Path, ...]:
        return self.was, self.now


@dataclass(frozen=True, slots=True)
class BothCounted:
    """What was found of one log."""

    name: str
    ids: tuple[int, ...]
    checked: Checked
    unused: list[str]
    """A line for each part of either side that is not compared."""
    sides: tuple[Part, Part] | None
    """The old and the new one; None where the truth cannot be that of the log."""
    changes: ByMethod
    """Frames and IDs that are counted differently."""


def count_both(reading: BothReading) -> BothCounted | Unread:
    """Read one log's results on both sides."""
    try:
        return _counted(reading)
    except SonarrecError as fault:  # the other logs can be compared
        return Unread(reading.name, fault)


def _counted(reading: BothReading) -> BothCounted:
    """Raises SonarrecError where one of the sides or the truth cannot be read, or they share no
    frame."""
    (was, now), options = reading.folders, reading.options
    table = truth_table(reading.ground_truth)
    old, new = (read_log(f, options.landmarks, options.sonar) for f in reading.folders)
    common = np.intersect1d(old.frame, new.frame)
    if not len(common):
        raise SonarrecError(f"{was} and {now} have no frame in common")
    unused = []
    for side, log in ((was, old), (now, new)):
        alone = len(log.frame) - len(common)
        unused += [f"{log.name}: {alone} frames are in {side} only; not compared"] * bool(alone)
        unused += not_whole(log, "scored")
    old, new = (_only(replace(log, name=reading.name), common) for log in (old, new))
    case = matched(now, table, new, options.tolerance_s)
    found = checked(case)
    told = reading.name, new.landmarks.ids, found, unused
    if found.fault is not None:
        return BothCounted(*told, None, {})
    sides = []
    for log in (old, new):
        joined = join([log], [case.truth], options.min_visible, reading.ids)
        sides.append((joined, score_all(joined)))
    before, after = (part_of(*side, rates_only=True) for side in sides)
    return BothCounted(*told, (before, after), changed_frames(*sides))


def _only(log: LogResults, frames: Any) -> LogResults:
    """The results on some of the log's frames, given by number."""
    kept = np.isin(log.frame, frames)
    mine = kept[log.frame_index]
    return replace(
        log,
        frame=log.frame[kept],
        timestamp_ns=None if log.timestamp_ns is None else log.timestamp_ns[kept],
        method=log.method[mine],
        frame_index=(np.cumsum(kept) - 1)[log.frame_index[mine]],
        landmark_index=log.landmark_index[mine],
        score=log.score[mine],
        declared=log.declared[mine],
        position=None if log.position is None else log.position[mine],
        orientation=log.orientation[mine],
        object=log.object[mine],
        probability=None if log.probability is None else log.probability[mine],
    )
