"""One log's results for the page: sightings, tracks, and the truth near estimates."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray, Table
from sonarrec.errors import SonarrecError
from sonarrec.evaluation.rows import Matched, ScoringOptions, match, truth_beneath
from sonarrec.results.columns import chosen, leading
from sonarrec.results.folders import log_of
from sonarrec.results.read import LogResults, of_methods, read_log
from sonarrec.results.sightings import Sighting, read_sightings
from sonarrec.sonar.frame import follows
from sonarrec.truth.match import match_truth
from sonarrec.truth.table import TruthTable

MOST_LOGS = 8  # logs with panels of their own: each adds some 40 kB to the page


@dataclass(frozen=True)
class ReportedLog:
    """One log's results and, where it is known, its truth. N estimates over F frames."""

    folder: Path
    results: LogResults
    tracker: str
    """The method whose tracks are shown."""
    matched: Matched | None
    """With the truth; None if that is not known."""
    sightings: list[Sighting]
    """The tracker's, in order of first sight."""

    @property
    def name(self) -> str:
        """The log's."""
        return self.results.name

    @property
    def ids(self) -> tuple[int, ...]:
        """The landmark set's."""
        return self.results.landmarks.ids

    @property
    def clock(self) -> str:
        """Unit of `time`: "s", or "frame" if there are no times that rise."""
        stamps = self.results.timestamp_ns
        return "frame" if stamps is None or (np.diff(stamps) <= 0).any() else "s"

    @cached_property
    def time(self) -> FloatArray:
        """(F,) seconds since the first frame, or frame numbers."""
        stamps = self.results.timestamp_ns
        if stamps is None or self.clock == "frame":
            return self.results.frame.astype(float)
        return np.asarray((stamps - stamps[0]) / 1e9)

    @property
    def period(self) -> float:
        """The median of `time` between two frames."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 1.0

    @cached_property
    def truth_near(self) -> IntArray | None:
        """(N,) index of the ID of the truth nearest to each estimate, -1 if none is within half a
        disc diameter; None without truth or positions."""
        if self.matched is None or not self.matched.placed:
            return None
        k = self.matched.truths["cell"] % len(self.ids)
        return np.asarray(np.append(k, -1)[truth_beneath(self.matched)])

    @cached_property
    def in_view(self) -> BoolArray | None:
        """(F, K) which landmarks count as in view; None without truth."""
        matched = self.matched
        return None if matched is None else self._present(matched.truths[matched.truths["strict"]])

    @cached_property
    def false(self) -> BoolArray | None:
        """(N,) whether each estimate, if declared, is false; None without truth. Landmarks partly
        in view count as present."""
        results, matched = self.results, self.matched
        if matched is None:
            return None
        if self.truth_near is not None:
            return np.asarray(self.truth_near != results.landmark_index)
        return ~self._present(matched.truths)[results.frame_index, results.landmark_index]

    def _present(self, truths: Table) -> BoolArray:
        """(F, K) which landmarks are in which frame, by some rows of the truth."""
        present = np.zeros((len(self.results.frame), len(self.ids)), dtype=bool)
        present.flat[truths["cell"]] = True
        return present

    def frame_of(self, estimate: int) -> int:
        """The number of an estimate's frame."""
        return int(self.results.frame[self.results.frame_index[estimate]])

    def seconds(self, timestamp_ns: int) -> float:
        """Seconds since the first frame, for a log with times."""
        assert self.results.timestamp_ns is not None
        return (timestamp_ns - int(self.results.timestamp_ns[0])) / 1e9

    def of_method(self, name: str) -> BoolArray:
        """(N,) which estimates are the method's."""
        if name not in self.results.methods:
            return np.zeros(len(self.results.frame_index), dtype=bool)
        return np.asarray(self.results.method == self.results.methods.index(name))


class LogToShow(NamedTuple):
    """A log to be read."""

    folder: Path
    truth: TruthTable | None = None
    log: str | None = None
    """Its name in the truth."""
    name: str | None = None
    """Its name on the page; None: its folder's."""


def read_logs(
    logs_to_show: Iterable[LogToShow], options: ScoringOptions
) -> tuple[list[ReportedLog], list[str]]:
    """The first MOST_LOGS logs that can be read, and a line for each that cannot.

    Of options.methods the tracks of the first are shown; by default those of the leading method.
    Raises SonarrecError if no log can be read or a truth does not fit its log, UsageError if no log
    has such a method.
    """
    logs: list[ReportedLog] = []
    unread: list[tuple[str, SonarrecError]] = []
    methods: set[str] = set()
    for log in logs_to_show:
        if len(logs) == MOST_LOGS:
            break
        try:
            results = read_log(log.folder, options.landmarks, options.sonar)
            sightings = list(read_sightings(log.folder, options.landmarks, options.sonar))
        except SonarrecError as error:
            unread.append((log.log or log_of(log.folder), error))
            continue
        methods.update(results.methods)
        results = of_methods(results, options.methods)
        matched = truth = None
        tracker = [*options.methods, leading(results.methods)][0]
        if log.truth is not None:
            truth_of = results if log.log is None else replace(results, name=log.log)
            truth = match_truth(log.truth, truth_of, options.tolerance_s)
        results = replace(results, name=log.name or results.name)
        if truth is not None:
            matched = match(results, truth, options)
        passes = [s for s in sightings if s.method == tracker]
        passes.sort(key=lambda s: (s.first_frame, s.last_frame))
        logs.append(ReportedLog(log.folder, results, tracker, matched, passes))
    if not logs:
        raise unread[0][1]
    chosen(methods, options.methods, logs[0].folder)  # raises for one that no log has
    return logs, [f"{error}; {name} is not shown" for name, error in unread]


class JudgedSighting(NamedTuple):
    """A sighting and whether it is true."""

    log: ReportedLog
    sighting: Sighting
    estimates: IntArray
    """(n,) its declarations, in frame order."""
    surest: int
    """The one of the best score; of equal printed scores a true one, then that nearest to the
    middle of the fan (or of the pass, if positions are not known)."""
    right: int | None
    """How many are true; None if truth is not known."""
    wrong: str
    """If `surest` is a false claim, why."""


def judged_sightings(log: ReportedLog) -> list[JudgedSighting]:
    """The tracker's passes, in order of first sight."""
    results = log.results
    declared = np.flatnonzero(log.of_method(log.tracker) & results.declared)
    declared = declared[np.argsort(results.frame_index[declared], kind="stable")]
    frame, judged = results.frame[results.frame_index[declared]], []
    for s in log.sightings:
        first, end = np.searchsorted(frame, [s.first_frame, s.last_frame + 1])
        rows = declared[first:end]
        rows = rows[np.take(log.ids, results.landmark_index[rows]) == s.landmark]
        if s.track is not None:
            rows = rows[results.object[rows] == s.track]
        if len(rows):
            offset = results.frame_index[rows] - results.frame_index[rows[[0, -1]]].mean()
            if results.position is not None:
                offset = np.arctan2(*results.position[rows].T)
            false = np.zeros(len(rows), dtype=bool) if log.false is None else log.false[rows]
            best = np.lexsort((np.abs(offset), false, -results.score[rows].round(2)))[0]
            surest, right = int(rows[best]), None if log.false is None else int((~false).sum())
            wrong = "" if not false[best] else "the landmark is not in view"
            if wrong and log.truth_near is not None:
                k = int(log.truth_near[surest])
                wrong = "no landmark lies there" if k < 0 else f"it is ID.{log.ids[k]}"
            judged.append(JudgedSighting(log, s, rows, surest, right, wrong))
    return judged


class Track(NamedTuple):
    """One object followed by the tracker, by its number in estimates.csv."""

    number: int
    estimates: IntArray
    """(n,) indices, in frame order."""
    frame_index: IntArray
    """(n,) into the log's frames, rising."""


def tracks(log: ReportedLog) -> list[Track]:
    """The tracks with a declaration.

    First those with the most frames that are declared or on a landmark, then the longest.
    """
    results = log.results
    if results.probability is None or not follows(log.tracker):
        return []
    rows = np.flatnonzero(log.of_method(log.tracker) & (results.object >= 0))
    rows = rows[np.lexsort((results.frame_index[rows], results.object[rows]))]
    number, frame = results.object[rows], results.frame_index[rows]
    new = np.diff(number, prepend=-1) != 0
    rows = rows[new | (np.diff(frame, prepend=-1) != 0)]  # one for each frame
    begins = np.flatnonzero(np.diff(results.object[rows])) + 1
    listed = [
        Track(int(results.object[part[0]]), part, results.frame_index[part])
        for part in np.split(rows, begins)
        if len(part)
    ]
    telling = results.declared
    if log.truth_near is not None:
        telling = telling | (log.truth_near >= 0)
    listed.sort(key=lambda track: (-telling[track.estimates].sum(), -len(track.estimates)))
    return [track for track in listed if results.declared[track.estimates].any()]


def alongside(log: ReportedLog, track: Track, method: str) -> IntArray:
    """(n,) the method's estimate nearest to the track in each of its frames, -1 if none is within
    half a disc diameter. All -1 without positions.
    """
    results = log.results
    nearest = np.full(len(track.estimates), -1, dtype=np.int64)
    if results.position is None:
        return nearest
    rows = np.flatnonzero(log.of_method(method) & np.isin(results.frame_index, track.frame_index))
    frame = np.searchsorted(track.frame_index, results.frame_index[rows])
    at_track = results.position[track.estimates[frame]]
    distance = np.linalg.norm(results.position[rows] - at_track, axis=1)
    order = np.argsort(-distance, kind="stable")
    order = order[distance[order] <= results.landmarks.radius_m]
    nearest[frame[order]] = rows[order]
    return nearest


def true_landmark(log: ReportedLog, track: Track) -> int | None:
    """The true ID beneath the track in most of its frames; None if there is none."""
    if log.truth_near is None:
        return None
    beneath = log.truth_near[track.estimates]
    beneath = beneath[beneath >= 0]
    return log.ids[int(np.bincount(beneath).argmax())] if len(beneath) else None
