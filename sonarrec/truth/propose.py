"""Makes a gt.csv from the confident tracks of results, for a person to correct."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import SonarrecError, UsageError, number_of
from sonarrec.geometry import ground_range, pixel_from_polar, plane_from_polar, polar_from_plane
from sonarrec.nouns import Fan, follows
from sonarrec.results.folders import estimates_of, log_of
from sonarrec.results.read import LogResults, find_logs, not_whole, read_log
from sonarrec.results.sightings import check_follows
from sonarrec.truth.in_view import share_in_image
from sonarrec.truth.table import FILLED_IN, TRACKED, write_truth

HEADER = ("frame", "landmark", "x_px", "y_px", "visible", "track", "source")
LEAST_DECLARED = 5
"""Frames in which a track must have declared its ID."""
LEAST_AGREEMENT = 0.9
"""Share of the declarations of a track that must name the same ID."""


@dataclass(frozen=True, slots=True)
class ProposedTrack:
    """A track that declared an ID.

    landmark: the ID it declared most often. frames: first and last. rows: number of rows proposed;
    interpolated: how many of these are in gaps. best_score: along the track. left_out: why it is
    not proposed; "" if it is.
    """

    log: str
    track: int
    landmark: int
    frames: tuple[int, int]
    rows: int
    interpolated: int
    best_score: float
    left_out: str


@dataclass(slots=True)
class Proposal:
    """The tracks that declared an ID, and a line for each part of the results that is not used."""

    tracks: list[ProposedTrack] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def propose(results: Path, out: Path, *, method: str, min_score: float, max_gap: int) -> Proposal:
    """Write `out`, a new gt.csv, from the results of one log or of several.

    A track is proposed from its first to its last frame if it declared one ID in LEAST_DECLARED
    frames or more and its best score reaches `min_score`. Gaps of up to `max_gap` frames are filled
    in, linear in range and bearing. `visible` is the share of the disc in the fan image.
    Raises SonarrecError if no log can be read, the results cannot be used or `out` exists,
    UsageError on invalid numbers.
    """
    check_follows(method)
    if not 0 <= min_score <= 1:
        raise UsageError(f"--min-score {min_score:g}: a score is within 0 to 1")
    folders = find_logs(results)
    proposal = Proposal()
    rows = _proposed(folders, method, min_score, max_gap, proposal)
    write_truth(out, (("log", *HEADER) if len(folders) > 1 else HEADER), rows)
    return proposal


def _proposed(
    folders: Sequence[Path], method: str, min_score: float, max_gap: int, proposal: Proposal
) -> Iterator[tuple[object, ...]]:
    """The rows of gt.csv, one log in memory at a time.

    Tracks and problems are added to `proposal`.
    """
    unread: list[SonarrecError] = []
    for folder in folders:
        try:
            log = read_log(folder)
        except SonarrecError as error:
            unread.append(error)
            if len(unread) == len(folders):
                raise unread[0] from None
            proposal.problems.append(f"{error}; {log_of(folder)} is not used")
            continue
        if log.fan is None:
            raise SonarrecError(
                f"{folder / 'run.toml'}: does not tell the sonar's geometry, which gives pixels "
                "and visible; run `sonarrec run` again"
            )
        proposal.problems += not_whole(log, "used")
        taken: dict[tuple[int, int], list[FloatArray]] = {}
        mine = []
        for track in _tracks(folder, log, method, min_score):
            found = [] if track.left_out else _rows(track, log, log.fan, max_gap, taken)
            mine += found
            first, last = log.frame[track.frame_index[[0, -1]]].tolist()
            proposal.tracks.append(
                ProposedTrack(
                    log=log.name,
                    track=track.number,
                    landmark=track.landmark,
                    frames=(first, last),
                    rows=len(found),
                    interpolated=sum(row[-1] == FILLED_IN for row in found),
                    best_score=track.best_score,
                    left_out=track.left_out,
                )
            )
        name = (log.name,) if len(folders) > 1 else ()
        yield from ((*name, *row) for row in sorted(mine))


@dataclass(frozen=True, slots=True)
class _Track:
    """A track that declared an ID; arrays have one element per frame that it has an estimate in."""

    number: int
    landmark: int  # the ID it declared most often
    declared: int  # in how many frames it declared that
    frame_index: IntArray  # into LogResults.frame, rising
    range_m: FloatArray
    bearing_deg: FloatArray
    best_score: float
    left_out: str


def _tracks(folder: Path, log: LogResults, method: str, min_score: float) -> list[_Track]:
    """The tracks of a method that declared an ID, those with most declarations first."""
    path = estimates_of(folder)
    if method not in log.methods:
        tracking = ", ".join(filter(follows, log.methods))
        choose = f"choose one with --method: {tracking}" if tracking else "nor any that has tracks"
        raise UsageError(f"{path} holds no method {method}; {choose}")
    mine = np.flatnonzero(log.method == log.methods.index(method))
    if log.position is None or (log.object[mine] < 0).any():
        raise SonarrecError(
            f"{path}: a track needs object, range_m and bearing_deg (or x_px, y_px); "
            "not every row has them"
        )
    mine = mine[np.lexsort((log.frame_index[mine], log.object[mine]))]
    _, starts = np.unique(log.object[mine], return_index=True)
    tracks = [
        _track(log, log.position, one, min_score)
        for one in np.split(mine, starts[1:])
        if log.declared[one].any()
    ]
    return sorted(tracks, key=lambda track: -track.declared)


def _track(log: LogResults, position: FloatArray, rows: IntArray, min_score: float) -> _Track:
    """The track with these estimates, by frame. position: (N, 2) of all estimates."""
    declared = rows[log.declared[rows]]
    landmarks, counts = np.unique(log.landmark_index[declared], return_counts=True)
    ids = [log.landmarks.ids[k] for k in landmarks]
    most, best_score = int(counts.max()), float(log.score[rows].max())
    left_out = ""
    if most < LEAST_AGREEMENT * len(declared):
        left_out = "it declared several IDs: " + ", ".join(f"ID.{i}" for i in sorted(ids))
    elif most < LEAST_DECLARED:
        left_out = f"declared in {number_of(most, 'frame')} only"
    elif best_score < min_score:
        left_out = f"best score below {min_score:g}"
    frame_index, first = np.unique(log.frame_index[rows], return_index=True)
    range_m, bearing_deg = polar_from_plane(position[rows[first]])
    return _Track(
        number=int(log.object[rows[0]]),
        landmark=ids[int(counts.argmax())],
        declared=most,
        frame_index=frame_index,
        range_m=range_m,
        bearing_deg=bearing_deg,
        best_score=best_score,
        left_out=left_out,
    )


def _rows(
    track: _Track,
    log: LogResults,
    fan: Fan,
    max_gap: int,
    taken: dict[tuple[int, int], list[FloatArray]],
) -> list[tuple[object, ...]]:
    """The rows of gt.csv for a track.

    taken: floor positions proposed so far, by frame and ID; new ones are added. A position on the
    disc of an earlier one gives no row: there two tracks are on one disc.
    """
    short = [np.arange(a, b) for a, b in pairwise(track.frame_index) if b - a <= max_gap + 1]
    at = np.unique(np.concatenate([track.frame_index, *short]))
    range_m = np.interp(at, track.frame_index, track.range_m)
    bearing_deg = np.interp(at, track.frame_index, track.bearing_deg)
    x, y = pixel_from_polar(fan, range_m, bearing_deg)
    visible = share_in_image(fan, range_m, bearing_deg, log.landmarks.radius_m)
    place = plane_from_polar(ground_range(fan, range_m), bearing_deg)
    source = np.where(np.isin(at, track.frame_index), TRACKED, FILLED_IN)
    rows: list[tuple[object, ...]] = []
    for n, frame in enumerate(log.frame[at].tolist()):
        others = taken.setdefault((frame, track.landmark), [])
        doubled = any(np.hypot(*(place[n] - o)) < log.landmarks.radius_m for o in others)
        if doubled or visible[n] == 0:
            continue
        others.append(place[n])
        position = (f"{x[n]:.2f}", f"{y[n]:.2f}", f"{visible[n]:.3f}")
        rows.append((frame, track.landmark, *position, track.number, str(source[n])))
    return rows
