"""A gt.csv from the confident tracks of results, for a person to correct."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from sonarrec.geometry import ground_range, pixel_from_polar, polar_from_plane
from sonarrec.records import (
    Fan,
    FloatArray,
    SonarrecError,
    UsageError,
    follows,
    name_as_text,
    number_of,
)
from sonarrec.results.folders import estimates_of
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
    """One track that declared an ID at all.

    landmark: the ID it declared most often. frames: first and last. rows: proposed for it;
    interpolated: of these, in gaps. best_score: along the track. left_out: why it is not proposed,
    "" where it is.
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
    """The tracks that declared an ID, and a line for each part of the results not to be used."""

    tracks: list[ProposedTrack] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def propose(results: Path, out: Path, *, method: str, min_score: float, max_gap: int) -> Proposal:
    """Write `out`, a new gt.csv, from the results of one log or of several.

    A track is taken, over its whole life, where it declared one ID in LEAST_DECLARED frames or
    more and its best score reaches `min_score`. Up to `max_gap` frames that it misses are filled
    in, linear in range and bearing. `visible` is the share of the disc in the fan image.
    Raises SonarrecError where no log can be read, the results cannot be used or `out` exists,
    UsageError on numbers that cannot be meant.
    """
    check_follows(method)
    if not 0 <= min_score <= 1:
        raise UsageError(f"--min-score {min_score:g}: a score is within 0 to 1")
    folders = find_logs(results)
    told = Proposal()
    rows = _proposed(folders, method, min_score, max_gap, told)
    write_truth(out, (("log", *HEADER) if len(folders) > 1 else HEADER), rows)
    return told


def _proposed(
    folders: Sequence[Path], method: str, min_score: float, max_gap: int, told: Proposal
) -> Iterator[tuple[object, ...]]:
    """The rows of gt.csv, one log in memory at a time.

    told: to which each track and each problem is added.
    """
    unread: list[SonarrecError] = []
    for folder in folders:
        try:
            log = read_log(folder)
        except SonarrecError as error:
            unread.append(error)
            if len(unread) == len(folders):
                raise unread[0] from None
            told.problems.append(f"{error}; {name_as_text(folder.resolve().name)} is not used")
            continue
        if log.fan is None:
            raise SonarrecError(
                f"{folder / 'run.toml'}: does not tell the sonar's geometry, which gives pixels "
                "and visible; run `sonarrec run` again"
            )
        told.problems += not_whole(log, "used")
        taken: dict[tuple[int, int], list[FloatArray]] = {}
        mine = []
        for track in _tracks(folder, log, method, min_score):
            found = [] if track.left_out else _rows(track, log, log.fan, max_gap, taken)
            mine += found
            told.tracks.append(
                ProposedTrack(
                    log.name,
                    track.number,
                    track.landmark,
                    (int(log.frame[track.frame_index[0]]), int(log.frame[track.frame_index[-1]])),
                    len(found),
                    sum(row[-1] == FILLED_IN for row in found),
                    track.best_score,
                    track.left_out,
                )
            )
        name = (log.name,) if len(folders) > 1 else ()
        yield from ((*name, *row) for row in sorted(mine))


@dataclass(frozen=True, slots=True)
class _Track:
    """A track that declared an ID; arrays have one element per frame that it has an estimate in."""

    number: int
    landmark: int
    frame_index: np.ndarray  # into LogResults.frame, rising
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
    tracks = []
    for one in np.split(mine, starts[1:]):
        declared = one[log.declared[one]]
        if not len(declared):
            continue
        landmarks, counts = np.unique(log.landmark_index[declared], return_counts=True)
        ids = [log.landmarks.ids[k] for k in landmarks]
        best = float(log.score[one].max())
        left_out = ""
        if counts.max() < LEAST_AGREEMENT * counts.sum():
            left_out = "it declared several IDs: " + ", ".join(f"ID.{i}" for i in sorted(ids))
        elif counts.max() < LEAST_DECLARED:
            left_out = f"declared in {number_of(int(counts.max()), 'frame')} only"
        elif best < min_score:
            left_out = f"best score below {min_score:g}"
        row, first = np.unique(log.frame_index[one], return_index=True)
        range_m, bearing_deg = polar_from_plane(log.position[one[first]])
        number, landmark = int(log.object[one[0]]), ids[int(counts.argmax())]
        track = _Track(number, landmark, row, range_m, bearing_deg, best, left_out)
        tracks.append((-int(counts.max()), track))
    return [track for _, track in sorted(tracks, key=lambda pair: pair[0])]


def _rows(
    track: _Track,
    log: LogResults,
    fan: Fan,
    max_gap: int,
    taken: dict[tuple[int, int], list[FloatArray]],
) -> list[tuple[object, ...]]:
    """The rows of gt.csv for a track.

    taken: floor positions proposed so far per (frame, ID), to which these are added; where they
    meet, a second track is on one disc and gives no row.
    """
    short = [np.arange(a, b) for a, b in pairwise(track.frame_index) if b - a <= max_gap + 1]
    at = np.unique(np.concatenate([track.frame_index, *short]))
    range_m = np.interp(at, track.frame_index, track.range_m)
    bearing_deg = np.interp(at, track.frame_index, track.bearing_deg)
    x, y = pixel_from_polar(fan, range_m, bearing_deg)
    visible = share_in_image(fan, range_m, bearing_deg, log.landmarks.radius_m)
    floor, turn = ground_range(fan, range_m), np.radians(bearing_deg)
    place = np.column_stack([floor * np.sin(turn), floor * np.cos(turn)])
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
