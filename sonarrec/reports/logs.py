"""One log's results for the page: sightings, tracks, and the truth near estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import SonarrecError
from sonarrec.evaluation.match import Matched, ScoringOptions, match, truth_beneath
from sonarrec.nouns import follows
from sonarrec.results.columns import chosen, leading
from sonarrec.results.folders import log_of
from sonarrec.results.read import LogResults, of_methods, read_log
from sonarrec.results.run_file import RunFile, read_run
from sonarrec.results.sightings import Sighting, read_sightings
from sonarrec.truth.match import Truth, match_truth
from sonarrec.truth.table import TruthTable

MOST_LOGS = 8  # logs with panels of their own: each adds some 40 kB to the page


@dataclass(frozen=True, slots=True)
class ReportedLog:
    """One log's results and, where it is known, its truth. N estimates over F frames."""

    folder: Path
    """The results folder."""
    results: LogResults
    tracker: str
    """The method whose tracks are shown."""
    truth: Truth | None
    matched: Matched | None
    """The results with their truth; None without one."""
    run: RunFile
    time: FloatArray
    """(F,) seconds since the first frame, or frame numbers if there are no times."""
    clock: str
    """Unit of `time`: "s" or "frame"."""
    truth_near: IntArray | None
    """(N,) index of the ID of the truth nearest to each estimate, -1 if none is within half a disc
    diameter; None without truth or positions."""
    in_view: BoolArray | None
    """(F, K) which landmarks count as in view; None without truth."""
    sightings: list[Sighting]
    """Of the tracker, in order of first sight."""

    @property
    def ids(self) -> tuple[int, ...]:
        """The landmark set's."""
        return self.results.landmarks.ids

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


@dataclass(frozen=True, slots=True)
class Track:
    """One object followed by the tracker."""

    number: int
    """Its number in estimates.csv."""
    estimates: IntArray
    """(n,) indices of its estimates, in frame order."""
    frame_index: IntArray
    """(n,) into the log's frames, rising."""


@dataclass(frozen=True, slots=True)
class LogToShow:
    """One log to be read for the page.

    name: also for the log column of its truth; None: the name of the folder.
    """

    folder: Path
    truth: TruthTable | None = None
    name: str | None = None


def read_logs(
    logs_to_show: Sequence[LogToShow], options: ScoringOptions
) -> tuple[list[ReportedLog], list[str]]:
    """The first MOST_LOGS logs that can be read, and a line for each that cannot.

    Of options.methods the tracks of the first are shown; by default those of the leading method.
    Raises SonarrecError if no log can be read or a truth does not fit its log, UsageError if no log
    has such a method.
    """
    logs: list[ReportedLog] = []
    unread: list[tuple[str, SonarrecError]] = []
    there: set[str] = set()
    wanted = options.methods
    for one in logs_to_show:
        if len(logs) == MOST_LOGS:
            break
        try:
            results = read_log(one.folder, options.landmarks, options.sonar)
            sightings = list(read_sightings(one.folder, options.landmarks, options.sonar))
        except SonarrecError as error:
            unread.append((one.name or log_of(one.folder), error))
            continue
        there.update(results.methods)
        results = of_methods(results, wanted)
        results = results if one.name is None else replace(results, name=one.name)
        truth = None
        if one.truth is not None:
            truth = match_truth(one.truth, results, options.tolerance_s)
        tracker = wanted[0] if wanted else leading(results.methods)
        passes = [s for s in sightings if s.method == tracker]
        logs.append(_reported_log(one.folder, results, truth, options, tracker, passes))
    if not logs:
        raise unread[0][1]
    for log in logs:
        if log.results.landmarks.ids != logs[0].results.landmarks.ids:
            raise SonarrecError(
                f"logs {logs[0].results.name} and {log.results.name} were run with different "
                "landmark IDs; report them one by one, or give --landmarks"
            )
    chosen(there, wanted, logs_to_show[0].folder)  # raises for one that no log has
    return logs, [f"{error}; {name} is not shown" for name, error in unread]


def _reported_log(
    folder: Path,
    log: LogResults,
    truth: Truth | None,
    options: ScoringOptions,
    tracker: str,
    passes: Sequence[Sighting],
) -> ReportedLog:
    time, clock = log.frame.astype(float), "frame"
    stamps = log.timestamp_ns
    if stamps is not None and (np.diff(stamps) > 0).all():
        time, clock = (stamps - stamps[0]) / 1e9, "s"
    in_view = matched = near = None
    if truth is not None:
        matched = match(log, truth, options.min_visible, within_m=options.within_m)
        if matched.placed:
            beneath = truth_beneath(matched)
            near = np.full(len(beneath), -1, dtype=np.int64)
            near[beneath >= 0] = matched.truth_landmark_index[beneath[beneath >= 0]]
        in_view = np.zeros((len(log.frame), len(log.landmarks.ids)), dtype=bool)
        whole = truth.visible >= options.min_visible
        in_view[truth.frame_index[whole], truth.landmark_index[whole]] = True
    run = read_run(folder / "run.toml")
    ordered = sorted(passes, key=lambda s: (s.first_frame, s.last_frame))
    return ReportedLog(
        folder, log, tracker, truth, matched, run, time, clock, near, in_view, sightings=ordered
    )


@dataclass(frozen=True, slots=True)
class JudgedSighting:
    """A sighting and whether it is true. n declarations, indices into the estimates."""

    sighting: Sighting
    estimates: IntArray
    """(n,) in frame order."""
    surest: int
    """The declaration of the best score. Of equal printed scores a true claim, then that nearest to
    the middle of the fan (or of the pass, if positions are not known)."""
    right: int | None
    """How many declarations are true; None if truth is not known."""
    is_false: bool
    """Whether `surest` is known to be a false claim."""


def judged_sightings(log: ReportedLog) -> list[JudgedSighting]:
    """The tracker's passes, in order of first sight."""
    results = log.results
    declared = np.flatnonzero(log.of_method(log.tracker) & results.declared)
    declared = declared[np.argsort(results.frame_index[declared], kind="stable")]
    frame, false = results.frame[results.frame_index[declared]], _false(log)
    judged = []
    for s in log.sightings:
        if s.landmark not in log.ids:
            continue
        first, end = np.searchsorted(frame, [s.first_frame, s.last_frame + 1])
        rows = declared[first:end]
        of_landmark = results.landmark_index[rows] == log.ids.index(s.landmark)
        if s.track is not None:
            of_landmark &= results.object[rows] == s.track
        if of_landmark.any():
            rows = rows[of_landmark]
            frames, position = results.frame_index[rows], results.position
            offset = frames - (frames[0] + frames[-1]) / 2
            if position is not None:
                offset = np.arctan2(*position[rows].T)
            wrong = np.zeros(len(rows), dtype=bool) if false is None else false[rows]
            best = np.lexsort((np.abs(offset), wrong, -results.score[rows].round(2)))[0]
            right = None if false is None else int((~wrong).sum())
            judged.append(JudgedSighting(s, rows, int(rows[best]), right, bool(wrong[best])))
    return judged


def _false(log: ReportedLog) -> BoolArray | None:
    """(N,) whether each estimate, if declared, is false; None if truth is not known. Landmarks
    partly in view count as present."""
    results, truth = log.results, log.truth
    if truth is None:
        return None
    if log.truth_near is not None:
        return np.asarray(log.truth_near != results.landmark_index)
    in_view = np.zeros((len(results.frame), len(results.landmarks.ids)), dtype=bool)
    in_view[truth.frame_index, truth.landmark_index] = True
    return ~in_view[results.frame_index, results.landmark_index]


def false_claim_text(log: ReportedLog, estimate: int) -> str:
    """A false claim in words."""
    if log.truth_near is None:
        return "the landmark is not in view"
    beneath = int(log.truth_near[estimate])
    return "no landmark lies there" if beneath < 0 else f"it is ID.{log.ids[beneath]}"


@dataclass(frozen=True, slots=True)
class Tracks:
    """The tracks to show, in order of first sight, and how many there are."""

    declared: list[Track]
    """Tracks with a declaration."""
    declared_in_all: int
    silent: list[Track]
    """Tracks without any."""
    silent_in_all: int


def tracks(log: ReportedLog, most: int, most_silent: int) -> Tracks:
    """At most so many of each kind: those with the most frames that are declared or on a landmark,
    then the longest."""
    results = log.results
    if results.probability is None or not follows(log.tracker):
        return Tracks([], 0, [], 0)
    of_tracker = np.flatnonzero(log.of_method(log.tracker) & (results.object >= 0))
    numbers, track_index = np.unique(results.object[of_tracker], return_inverse=True)
    claims = np.bincount(track_index, weights=results.declared[of_tracker], minlength=len(numbers))
    telling = results.declared[of_tracker]
    if log.truth_near is not None:
        telling = telling | (log.truth_near[of_tracker] >= 0)
    worth = np.bincount(track_index, weights=telling, minlength=len(numbers))
    length = np.bincount(track_index, minlength=len(numbers))
    order = np.lexsort((-length, -worth))
    declared, silent = order[claims[order] > 0], order[claims[order] == 0]

    def tracks_of(of: IntArray) -> list[Track]:
        tracks = []
        for n in of.tolist():
            rows = of_tracker[track_index == n]
            rows = rows[np.unique(results.frame_index[rows], return_index=True)[1]]
            tracks.append(Track(int(numbers[n]), rows, results.frame_index[rows]))
        return sorted(tracks, key=lambda track: (int(track.frame_index[0]), track.number))

    return Tracks(
        tracks_of(declared[:most]), len(declared), tracks_of(silent[:most_silent]), len(silent)
    )


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
    if not (beneath >= 0).any():
        return None
    return log.results.landmarks.ids[int(np.bincount(beneath[beneath >= 0]).argmax())]
