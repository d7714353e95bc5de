"""What one log's results say, gathered for the page: sightings, tracks, and what truth is near."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.evaluation.joined import join, nearest_truth
from sonarrec.records import BoolArray, FloatArray, IntArray, SonarrecError, UsageError
from sonarrec.results.read import LogResults, find_logs, read_log
from sonarrec.results.run_file import RunFile, read_run
from sonarrec.results.sightings import Sighting, Sightings
from sonarrec.sonar import Sonar
from sonarrec.truth.match import Truth, match_truth
from sonarrec.truth.table import TruthTable


@dataclass(frozen=True, slots=True)
class ReportedLog:
    """One log's results and, where it is known, its truth. N estimates over F frames."""

    folder: Path
    """Of the results."""
    results: LogResults
    tracker: str
    """The method that the page follows."""
    truth: Truth | None
    run: RunFile
    time: FloatArray
    """(F,) seconds since the first frame, or frame numbers where no times are given."""
    clock: str
    """Which of them: "s" or "frame"."""
    truth_near: IntArray | None
    """(N,) into the IDs: of the truth nearest to each estimate, -1 where none lies within half a
    disc diameter; None without truth or positions."""
    in_view: BoolArray | None
    """(F, K) which landmarks count as in view; None without truth."""

    def seconds(self, timestamp_ns: int) -> float:
        """Since the first frame, of a log that tells times."""
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
    """Its name in estimates.csv."""
    at: IntArray
    """(n,) its estimates, in frame order."""
    frame_index: IntArray
    """(n,) into the log's frames, rising."""


def read_logs(
    results: Path,
    truth: TruthTable | None,
    *,
    min_visible: float,
    tolerance_s: float | None,
    landmarks: str | None,
    sonar: Sonar,
    method: str | None,
) -> list[ReportedLog]:
    """Read every log of a results folder.

    method: the one to follow; None for the framework, or the first that follows objects.
    Raises SonarrecError where files cannot be used, UsageError where no log has the method.
    """
    logs = []
    for folder in find_logs(results):
        found = read_log(folder, landmarks, sonar)
        matched = None if truth is None else match_truth(truth, found, tolerance_s)
        follow = method or _tracker(found.methods)
        logs.append(_reported(folder, found, matched, min_visible, follow))
    for log in logs:
        if log.results.landmarks.ids != logs[0].results.landmarks.ids:
            raise SonarrecError(
                f"{results}: logs {logs[0].results.name} and {log.results.name} were run with "
                "different landmark IDs; report them one by one, or give --landmarks"
            )
    there = dict.fromkeys(name for log in logs for name in log.results.methods)
    if method is not None and method not in there:
        raise UsageError(f"{results}: no method {method!r}; there is {', '.join(there)}")
    return logs


def follows(method: str) -> bool:
    """Whether the method's object numbers mean the same object from one frame to the next."""
    return method.partition(":")[0] != "smi"


def _tracker(methods: Sequence[str]) -> str:
    followers = [name for name in methods if follows(name)]
    if "framework" in followers or not methods:
        return "framework"
    return (followers or list(methods))[0]


def _reported(
    folder: Path, log: LogResults, truth: Truth | None, min_visible: float, tracker: str
) -> ReportedLog:
    time, clock = log.frame.astype(float), "frame"
    stamps = log.timestamp_ns
    if stamps is not None and (np.diff(stamps) > 0).all():
        time, clock = (stamps - stamps[0]) / 1e9, "s"
    in_view = None
    if truth is not None:
        in_view = np.zeros((len(log.frame), len(log.landmarks.ids)), dtype=bool)
        whole = truth.visible >= min_visible
        in_view[truth.frame_index[whole], truth.landmark_index[whole]] = True
    return ReportedLog(
        folder=folder,
        results=log,
        tracker=tracker,
        truth=truth,
        run=read_run(folder / "run.toml"),
        time=time,
        clock=clock,
        truth_near=None if truth is None else _truth_near(log, truth, min_visible),
        in_view=in_view,
    )


def _truth_near(log: LogResults, truth: Truth, min_visible: float) -> IntArray | None:
    joined = join([log], [truth], min_visible)
    if not joined.placed:
        return None
    every = np.arange(len(log.frame_index))
    nearest = nearest_truth(joined, every, joined.claim_frame_index, joined.truth_frame_index)
    near = np.full(len(every), -1, dtype=np.int64)
    near[nearest >= 0] = truth.landmark_index[nearest[nearest >= 0]]
    return near


def sightings(log: ReportedLog) -> list[Sighting]:
    """What the tracker declared, in order of first sight: one entry per ID and track."""
    found = log.results
    mine = np.flatnonzero(log.of_method(log.tracker) & found.declared)
    mine = mine[np.argsort(found.frame_index[mine], kind="stable")]
    tracked = follows(log.tracker) and bool((found.object[mine] >= 0).all())
    gathered = Sightings(log.tracker)
    for n in mine.tolist():
        row, landmark_index = found.frame_index[n], found.landmark_index[n]
        gathered.declared(
            int(found.frame[row]),
            0 if found.timestamp_ns is None else int(found.timestamp_ns[row]),
            found.landmarks.ids[landmark_index],
            int(found.object[n]) if tracked else None,
            float(found.score[n]),
            None if log.truth_near is None else bool(log.truth_near[n] == landmark_index),
        )
    return gathered.found()


def tracks(log: ReportedLog, most: int) -> tuple[list[Track], int]:
    """The tracks most worth showing, in order of first sight, and how many there are in all.

    Those that are declared, or truly lie on a landmark, in the most frames; then the longest.
    """
    found = log.results
    if found.probability is None or not follows(log.tracker):
        return [], 0
    mine = np.flatnonzero(log.of_method(log.tracker) & (found.object >= 0))
    numbers, which = np.unique(found.object[mine], return_inverse=True)
    telling = found.declared[mine]
    if log.truth_near is not None:
        telling = telling | (log.truth_near[mine] >= 0)
    worth = np.bincount(which, weights=telling, minlength=len(numbers))
    length = np.bincount(which, minlength=len(numbers))
    chosen = np.lexsort((-length, -worth))[:most]
    shown = []
    for n in chosen.tolist():
        at = mine[which == n]
        at = at[np.unique(found.frame_index[at], return_index=True)[1]]
        shown.append(Track(int(numbers[n]), at, found.frame_index[at]))
    shown.sort(key=lambda track: (int(track.frame_index[0]), track.number))
    return shown, len(numbers)


def alongside(log: ReportedLog, track: Track, method: str) -> IntArray:
    """(n,) the method's estimate nearest to the track in each of its frames, -1 where none is.

    Nearest within half a disc diameter. Without positions nothing can be matched.
    """
    found = log.results
    matched = np.full(len(track.at), -1, dtype=np.int64)
    if found.position is None:
        return matched
    other = np.flatnonzero(log.of_method(method) & np.isin(found.frame_index, track.frame_index))
    beside = np.searchsorted(track.frame_index, found.frame_index[other])
    away = np.linalg.norm(found.position[other] - found.position[track.at[beside]], axis=1)
    order = np.argsort(-away, kind="stable")
    order = order[away[order] <= found.landmarks.radius_m]
    matched[beside[order]] = other[order]
    return matched


def true_landmark(log: ReportedLog, track: Track) -> int | None:
    """The ID that truly lies beneath the track most of the time; None where none does."""
    if log.truth_near is None:
        return None
    beneath = log.truth_near[track.at]
    if not (beneath >= 0).any():
        return None
    return log.results.landmarks.ids[int(np.bincount(beneath[beneath >= 0]).argmax())]
