"""Old and new results of one log: cut to their common frames, matched with truth, counted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.errors import SonarrecError, number_of
from sonarrec.evaluation.changes import ByMethod, changed_frames
from sonarrec.evaluation.count import LogCounts, count_log
from sonarrec.evaluation.logs import TruthCheck, UnreadableLog, check_fit, truth_table
from sonarrec.evaluation.match import ScoringOptions, match
from sonarrec.results.read import LogResults, not_whole, read_log
from sonarrec.truth.match import match_truth


@dataclass(frozen=True, slots=True)
class LogPair:
    """The old and the new results of one log, to be read and counted."""

    old: Path
    new: Path
    """Results folders."""
    ground_truth: Path
    name: str
    """Name of the log, in messages and in the log column of the truth."""
    options: ScoringOptions
    ids: tuple[int, ...]
    """As in `logs.LogToScore`."""

    @property
    def folders(self) -> tuple[Path, ...]:
        return self.old, self.new


@dataclass(slots=True)
class CountedPair:
    """The counts of one LogPair."""

    name: str
    ids: tuple[int, ...]
    methods: tuple[tuple[str, ...], tuple[str, ...]]
    """Of the old and the new results."""
    check: TruthCheck
    unused: list[str]
    """A line for each part of the results that is not compared."""
    counts: tuple[LogCounts, LogCounts] | None
    """Of the old and the new results; None where the truth does not fit the log, or once they are
    added to those of others."""
    changes: ByMethod
    """Frames and IDs that are counted differently."""


def count_pair(pair: LogPair) -> CountedPair | UnreadableLog:
    """Read and count the old and the new results of one log."""
    try:
        return _count_pair(pair)
    except SonarrecError as fault:  # the other logs can be compared
        return UnreadableLog(pair.name, fault)


def _count_pair(pair: LogPair) -> CountedPair:
    """As `count_pair`.

    Raises SonarrecError if the results or the truth cannot be read, or if old and new results
    have no common frame.
    """
    options = pair.options
    table = truth_table(pair.ground_truth)
    old, new = (read_log(f, options.landmarks, options.sonar) for f in pair.folders)
    common = np.intersect1d(old.frame, new.frame)
    if not len(common):
        raise SonarrecError(f"{pair.old} and {pair.new} have no frame in common")
    unused = []
    for folder, log in ((pair.old, old), (pair.new, new)):
        alone = len(log.frame) - len(common)
        if alone:
            frames = number_of(alone, "frame")
            unused.append(f"{log.name}: {frames} in {folder} only; not compared")
        unused += not_whole(log, "scored")
    old, new = (_only(replace(log, name=pair.name), common) for log in (old, new))
    new_truth = match_truth(table, new, options.tolerance_s)
    check = check_fit(table, new, new_truth)
    labels = pair.name, new.landmarks.ids, (old.methods, new.methods), check, unused
    if check.fault is not None:
        return CountedPair(*labels, None, {})
    # Each side is scored as `evaluate` scores it: pixels lie where its own geometry puts them.
    old_truth = match_truth(table, replace(new, fan=old.fan or new.fan), options.tolerance_s)
    before = match(old, old_truth, options.min_visible, pair.ids)
    after = match(new, new_truth, options.min_visible, pair.ids)
    counts = count_log(before, rates_only=True), count_log(after, rates_only=True)
    return CountedPair(*labels, counts, changed_frames(before, after))


def _only(log: LogResults, frames: Any) -> LogResults:
    """The results on the frames of these numbers."""
    listed = np.isin(log.frame, frames)
    on_listed = listed[log.frame_index]  # (N,) whether an estimate lies on one of them
    return replace(
        log,
        frame=log.frame[listed],
        timestamp_ns=None if log.timestamp_ns is None else log.timestamp_ns[listed],
        method=log.method[on_listed],
        frame_index=(np.cumsum(listed) - 1)[log.frame_index[on_listed]],
        landmark_index=log.landmark_index[on_listed],
        score=log.score[on_listed],
        declared=log.declared[on_listed],
        position=None if log.position is None else log.position[on_listed],
        orientation=log.orientation[on_listed],
        object=log.object[on_listed],
        probability=None if log.probability is None else log.probability[on_listed],
    )
