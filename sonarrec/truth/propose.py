"""Makes a gt.csv from the confident tracks of results, for a person to correct."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import dist
from pathlib import Path

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.errors import Diagnostics, SonarrecError, UsageError, number_of
from sonarrec.results.columns import leading
from sonarrec.results.folders import log_of
from sonarrec.results.read import LogResults, find_logs, read_log, why_incomplete
from sonarrec.results.sightings import check_follows
from sonarrec.sonar.frame import follows
from sonarrec.sonar.geometry import (
    ground_range,
    pixel_from_polar,
    plane_from_polar,
    polar_from_plane,
)
from sonarrec.truth.match import share_in_image
from sonarrec.truth.table import FILLED_IN, TRACKED, write_truth

HEADER = ("frame", "landmark", "x_px", "y_px", "visible", "track", "source")
LEAST_DECLARED = 5  # frames in which a track must have declared its ID
LEAST_AGREEMENT = 0.9  # share of the declarations of a track that must name the same ID
Occupied = defaultdict[tuple[int, int], list[list[float]]]
"""Floor positions proposed so far, by frame and ID."""


@dataclass(frozen=True, slots=True)
class ProposedTrack:
    """A track that declared an ID."""

    log: str
    track: int
    landmark: int
    """The ID it declared most often."""
    frames: tuple[int, int]
    """First and last."""
    rows: int
    """How many rows are proposed."""
    interpolated: int
    """How many of these are in gaps."""
    best_score: float
    """Along the track."""
    left_out: str
    """Why it is not proposed; empty if it is."""


def propose(
    results: Path, out: Path, *, method: str | None, min_score: float, max_gap: int
) -> tuple[list[ProposedTrack], Diagnostics]:
    """Write `out`, a new gt.csv, from the results of one log or of several.

    A track is proposed from its first to its last frame if it declared one ID in LEAST_DECLARED
    frames or more and its best score reaches `min_score`. Gaps of up to `max_gap` frames are filled
    in, linear in range and bearing, but not over a pause. `visible` is the share of the disc in the
    fan image. Returns every track that declared an ID, and what of the results is not used.
    Raises SonarrecError if no log can be read, the results cannot be used or `out` exists,
    UsageError on invalid numbers. method: None: the leading one.
    """
    if method is not None:
        check_follows(method)
    if not 0 <= min_score <= 1:
        raise UsageError(f"--min-score {min_score:g}: a score is within 0 to 1")
    folders, diagnostics = find_logs(results), Diagnostics()
    tracks: list[ProposedTrack] = []

    def rows() -> Iterator[tuple[object, ...]]:
        """The rows of gt.csv, one log in memory at a time."""
        unread: list[SonarrecError] = []
        for folder in folders:
            try:
                log = read_log(folder)
            except SonarrecError as error:
                unread.append(error)
                if len(unread) == len(folders):
                    raise unread[0] from None
                diagnostics.problem(f"{error}; {log_of(folder)} is not used")
                continue
            diagnostics.problem(*why_incomplete(log, "used"))
            of_log: list[tuple[object, ...]] = []
            of_tracks = proposals(folder, log, method, min_score=min_score, max_gap=max_gap)
            for track, proposed in of_tracks:
                tracks.append(track)
                of_log += [] if track.left_out else proposed
            name = (log.name,) if len(folders) > 1 else ()
            yield from ((*name, *row) for row in sorted(of_log))

    write_truth(out, (("log", *HEADER) if len(folders) > 1 else HEADER), rows())
    return tracks, diagnostics


def proposals(
    folder: Path,
    log: LogResults,
    method: str | None = None,
    *,
    min_score: float = 0.9,
    max_gap: int = 8,
    occupied: Occupied | None = None,
) -> Iterator[tuple[ProposedTrack, list[tuple[object, ...]]]]:
    """Each track that declared an ID, and its rows (HEADER), also of a track that is left out.

    method: None: the leading one. occupied: floor positions that have a row already. Raises
    SonarrecError if the results cannot be used.
    """
    occupied = defaultdict(list) if occupied is None else occupied
    for ids, estimates in _tracks(folder, log, method or leading(log.methods)):
        yield _propose(log, ids, estimates, min_score, max_gap, occupied)


def _tracks(folder: Path, log: LogResults, method: str) -> list[tuple[dict[int, int], IntArray]]:
    """The tracks that declared an ID, those with most declarations of one ID first: (how often
    each declared ID, their estimates, rising in frame). Raises SonarrecError if they cannot be
    used."""
    path = folder / "estimates.csv"
    if log.fan is None:
        raise SonarrecError(
            f"{folder / 'run.toml'}: does not state the sonar's geometry, which gives pixels "
            "and visible; run `sonarrec run` again"
        )
    if method not in log.methods or not follows(method):
        tracking = ", ".join(filter(follows, log.methods))
        choose = f"choose one with --method: {tracking}" if tracking else "nor any that has tracks"
        raise UsageError(f"{path} holds no method {method}; {choose}")
    of_method = np.flatnonzero(log.method == log.methods.index(method))
    if log.position is None or (log.object[of_method] < 0).any():
        raise SonarrecError(
            f"{path}: a track needs object, range_m and bearing_deg (or x_px, y_px); "
            "not every row has them"
        )
    of_method = of_method[np.lexsort((log.frame_index[of_method], log.object[of_method]))]
    _, starts = np.unique(log.object[of_method], return_index=True)
    tracks = []
    for track in np.split(of_method, starts[1:]):
        index, count = np.unique(log.landmark_index[track[log.declared[track]]], return_counts=True)
        if len(index):
            ids = [log.landmarks.ids[k] for k in index]
            tracks.append((dict(zip(ids, count.tolist(), strict=True)), track))
    return sorted(tracks, key=lambda track: -max(track[0].values()))


def _propose(
    log: LogResults,
    ids: dict[int, int],
    estimates: IntArray,
    min_score: float,
    max_gap: int,
    occupied: Occupied,
) -> tuple[ProposedTrack, list[tuple[object, ...]]]:
    """One of `_tracks`, and its rows of gt.csv.

    A position on the disc of an earlier one gives no row: there two tracks are on one disc.
    """
    assert log.position is not None
    assert log.fan is not None
    track, best_score = int(log.object[estimates[0]]), float(log.score[estimates].max())
    landmark, left_out = max(ids, key=lambda i: ids[i]), ""
    if ids[landmark] < LEAST_AGREEMENT * sum(ids.values()):
        left_out = "it declared several IDs: " + ", ".join(f"ID.{i}" for i in sorted(ids))
    elif ids[landmark] < LEAST_DECLARED:
        left_out = f"declared in {number_of(ids[landmark], 'frame')} only"
    elif best_score < min_score:
        left_out = f"best score below {min_score:g}"
    seen, first = np.unique(log.frame_index[estimates], return_index=True)
    rows: list[tuple[object, ...]] = []
    stretch = log.stretch
    near = ((a, b) for a, b in pairwise(seen) if b - a <= max_gap + 1)
    gaps = [np.arange(a, b) for a, b in near if stretch[a] == stretch[b]]
    index = np.unique(np.concatenate([seen, *gaps]))
    range_m, bearing_deg = (
        np.interp(index, seen, values)
        for values in polar_from_plane(log.position[estimates[first]])
    )
    x, y = pixel_from_polar(log.fan, range_m, bearing_deg)
    visible = share_in_image(log.fan, range_m, bearing_deg, log.landmarks.radius_m)
    floor = plane_from_polar(ground_range(log.fan, range_m), bearing_deg).tolist()
    source = np.where(np.isin(index, seen), TRACKED, FILLED_IN).tolist()
    for n, frame in enumerate(log.frame[index].tolist()):
        others = occupied[frame, landmark]
        doubled = any(dist(floor[n], other) < log.landmarks.radius_m for other in others)
        if not doubled and visible[n] > 0:
            if not left_out:
                others.append(floor[n])
            cells = f"{x[n]:.2f}", f"{y[n]:.2f}", f"{visible[n]:.3f}", track, source[n]
            rows.append((frame, landmark, *cells))
    frames = int(log.frame[seen[0]]), int(log.frame[seen[-1]])
    count, filled = len(rows), sum(row[-1] == FILLED_IN for row in rows)
    if left_out:
        count = filled = 0
    proposed = ProposedTrack(log.name, track, landmark, frames, count, filled, best_score, left_out)
    return proposed, rows
