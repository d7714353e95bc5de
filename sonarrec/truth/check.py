"""Whether a gt.csv can be the truth of a log: as a whole, for scoring, and row by row."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, pairwise
from math import dist
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.geometry import (
    ground_range,
    in_image,
    pixel_from_polar,
    plane_from_polar,
    polar_from_pixel,
    polar_from_plane,
)
from sonarrec.landmarks import LandmarkSet
from sonarrec.readers.log import Log
from sonarrec.readers.open import find_log
from sonarrec.records import Fan
from sonarrec.results.folders import possible_names
from sonarrec.tables import composed
from sonarrec.tables.read import line_numbers
from sonarrec.truth.match import ReadLog, Truth, match_times, share_in_image, wrong_unit
from sonarrec.truth.table import TruthTable, read_rows, repeated_rows

SLACK = 0.1
"""Tolerance for labels made by eye: a tenth of the radius in position, of the area in `visible`."""
MOST_DIFFERENCE_PX = 3.0  # of two statements of one position by one geometry
MOST_FRAMES = 3  # named in a note
MOST_OUTSIDE = 0.1  # of positions; more are no slips
MOST_ADJACENT = 0.1  # of the steps between labelled frames, if every n-th is labelled
FEWEST = 5  # so many frames at least for a note on a pattern in them


# --- As a whole ----------------------------------------------------------------------------------


def misfit(table: TruthTable, log: ReadLog, truth: Truth) -> str | None:
    """Why a truth with rows on the log cannot be that of the log; None if it can.

    truth: as matched to the log.
    """
    keys, fan, times = table.keys[table.rows_of(log.name)], log.fan, log.timestamp_ns
    if table.key == "timestamp_ns" and times is not None and (unit := wrong_unit(times, keys)):
        return (
            f"{table.path}: its {table.key} ({keys.min()} to {keys.max()}) fit the times of "
            f"{log.name} ({times.min()} to {times.max()} ns) only if they are in {unit}; give them "
            "in ns"
        )
    if truth.rows and not len(truth.frame_index):
        near, of_frames = "on", log.frame
        if truth.tolerance_ns is not None and times is not None:
            near, of_frames = f"within {truth.tolerance_ns / 1e9:.4g} s of", times
        return (
            f"{table.path}: none of its {truth.rows} rows ({table.key} {keys.min()} to "
            f"{keys.max()}) lies {near} a processed frame of {log.name} "
            f"({number_of(len(log.frame), 'frame')}, {of_frames.min()} to "
            f"{of_frames.max()}); is this the truth of another log?"
        )
    outside = _outside_image(log, truth)
    if fan is not None and truth.position is not None and np.sum(outside) > len(outside) / 2:
        range_m, bearing_deg = (v[outside][0] for v in polar_from_plane(truth.position))
        return (
            f"{table.path}: {np.sum(outside)} of its {len(outside)} positions lie outside the "
            f"image of {log.name} ({fan.range_min_m:g} to {fan.range_max_m:g} m, "
            f"{fan.bearing_min_deg:g} to {fan.bearing_max_deg:g} deg); "
            f"such as {range_m:.4g} m, {bearing_deg:.4g} deg; are the units and the log right?"
        )
    return None


def without_rows(path: Path, rows: int, logs: Iterable[str], consequence: str) -> str:
    """Why a truth has no row on any of some logs.

    rows: how many it has. consequence: of having none, a clause.
    """
    if rows:
        return f"{path}: its log column names none of {', '.join(logs)}"
    return (
        f"{path}: it has no row, so {consequence}; a truth has a row per landmark in view "
        "(sonarrec help truth)"
    )


def report_rows(diagnostics: Diagnostics, name: str, truth_rows: int, between: int) -> None:
    """Tell if the truth has no row on a log, or rows between its frames.

    name: of the log. truth_rows, between: as in Truth.
    """
    if not truth_rows:
        diagnostics.note(f"{name}: no row in the ground truth, so it is taken to hold no landmark")
    if between:
        diagnostics.note(
            f"{name}: {number_of(between, 'ground-truth row')} between frames ignored, "
            "because others are nearer in time"
        )


def report_other_logs(
    diagnostics: Diagnostics, table: TruthTable, logs: Sequence[str], consequence: str
) -> None:
    """Tell of rows of the truth about other logs than `logs`. consequence: of that, a clause."""
    known = {composed(name) for name in logs}
    named = () if table.log is None else table.log
    others = [str(name) for name in named if composed(name) not in known]
    if others:
        names = sorted(set(others))
        listed = ", ".join(names[:5]) + f" and {len(names) - 5} more" * (len(names) > 5)
        diagnostics.problem(
            f"{table.path}: {len(others)} of {len(table.keys)} rows name logs that were not "
            f"given ({listed}); {consequence}"
        )


def unread_columns(table: TruthTable) -> str:
    """The columns that are not read and may have been meant to be; empty: none.

    Without positions these are all that have no meaning.
    """
    found = [(name, near) for name, near in table.unread if near or table.position is None]
    if not found:
        return ""
    names = ", ".join(name for name, _ in found)
    near = ", ".join(dict.fromkeys(near for _, near in found if near))
    asked = f"; rename to {near}" * bool(near)
    if not near and table.position is None:
        asked = "; positions are read from x_px and y_px, or range_m and bearing_deg"
    return f"{table.path}: {'columns' if found[1:] else 'column'} {names} not read{asked}"


def unchecked(table: TruthTable, name: str) -> str:
    """How many rows for a log are as `truth propose` wrote them, a clause; empty: none."""
    rows = table.rows_of(name)
    if not (proposed := np.count_nonzero(table.proposed[rows])):
        return ""
    return (
        f"{table.path}: {proposed} of {len(rows)} rows for {name} are unchecked proposals of "
        "`truth propose` (check them with `truth review`, or clear `source`)"
    )


def report_fit(
    diagnostics: Diagnostics, table: TruthTable, log: ReadLog, truth: Truth, check: str = ""
) -> None:
    """Tell what a reader should know of the positions on one log; a problem if many are wrong.

    truth: as matched to the log. check: the command that checks the truth of this log.
    """
    path, name = table.path, log.name
    outside = _outside_image(log, truth)
    if outside.any():
        found = log.frame[np.unique(truth.frame_index[outside])].tolist()
        listed = ", ".join(map(str, found[:MOST_FRAMES])) + " ..." * (len(found) > MOST_FRAMES)
        how = f"; {check} has their lines" * bool(check)
        add = diagnostics.problem if outside.mean() > MOST_OUTSIDE else diagnostics.note
        add(
            f"{path}: {np.sum(outside)} of {len(outside)} positions lie outside the image of "
            f"{name}, in frame{'s' * bool(found[1:])} {listed}{how}"
        )


def sparse(index: IntArray, frame: IntArray) -> str:
    """Whether rows are on every n-th frame or so, a clause; empty: no.

    index: of the rows, into frame, (F,) the numbers of the frames.
    """
    frames = np.unique(index)
    if len(frames) < FEWEST or np.mean(np.diff(frames) == 1) > MOST_ADJACENT:
        return ""
    first, last = frame[frames[[0, -1]]]
    return (
        f"{len(frames)} of {len(frame)} frames, from {first} to {last}, have a row; the others "
        "count as without a landmark, and claims there as false"
    )


def of_another_geometry(table: TruthTable, rows: IntArray, fan: Fan | None, name: str) -> str:
    """Whether pixels and metres of most rows on a log disagree, a clause; empty: no.

    name: of the log.
    """
    if fan is None or table.pixel is None or table.position is None:
        return ""
    stated = np.column_stack(pixel_from_polar(fan, *(v[rows] for v in table.position[1:])))
    difference_px = np.linalg.norm(table.pixel[rows] - stated, axis=1)
    difference_px = difference_px[np.isfinite(difference_px)]
    wrong = np.sum(difference_px > MOST_DIFFERENCE_PX)
    if wrong <= len(difference_px) / 2:
        return ""
    return (
        f"{wrong} of {len(difference_px)} rows have x_px, y_px and range_m, bearing_deg that "
        f"differ by more than {MOST_DIFFERENCE_PX:g} px in {name} (median "
        f"{np.median(difference_px):.0f} px); the truth seems to be of another log or geometry"
    )


def _outside_image(log: ReadLog, truth: Truth) -> BoolArray:
    """(T,) which discs lie wholly outside the fan; (0,) if positions or the fan are not known."""
    if log.fan is None or truth.position is None:
        return np.zeros(0, dtype=bool)
    return outside_image(log.fan, *polar_from_plane(truth.position), log.landmarks.radius_m)


def outside_image(
    fan: Fan, range_m: FloatArray, bearing_deg: FloatArray, radius_m: float
) -> BoolArray:
    """(T,) which floor discs, by their centres, lie wholly outside the fan image, and by more than
    SLACK."""
    outside = ~in_image(fan, range_m, bearing_deg)  # the centre
    near = share_in_image(fan, range_m[outside], bearing_deg[outside], radius_m * (1 + SLACK))
    outside[outside] = near == 0
    return outside


# --- Row by row ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that cannot be true: the line of gt.csv, the kind of fault, and a description."""

    line: int
    kind: str
    text: str


def check_truth(
    path: Path, log: Log, landmarks: LandmarkSet, *, max_pan_deg: float
) -> tuple[int, list[Fault], Diagnostics]:
    """Check a gt.csv against the log it describes: one pass over the log, for its frames.

    max_pan_deg: by how much the sonar may turn from one frame to the next. Returns the number of
    rows on this log, the faults in order of the lines, and the faults and notes of the log.
    Raises SonarrecError if either cannot be read at all.
    """
    table = read_rows(path)
    # Results are named by the log's name, with folders in front if another log has the same name.
    names = possible_names(log.name, find_log(log.path).location.resolve())
    row = table.rows_of(table.name_of(names))
    if len(table.keys) and table.log is not None and not len(row):
        named = ", ".join(sorted({repr(str(name)) for name in table.log}))
        raise SonarrecError(f"{path}: its log column does not name {log.name}; it has {named}")
    lines = np.fromiter(line_numbers(path), np.int64, len(table.keys))
    line, landmark, visible = lines[row].tolist(), table.landmark[row], table.visible[row]
    numbers, frame, stretch, faults = _frames(table, row, line, log)
    if few := sparse(np.searchsorted(numbers, frame[frame >= 0]), numbers):
        faults.append(Fault(line[0], "sparse", few))
    if unread := unread_columns(table):
        faults.append(Fault(1, "columns", unread.removeprefix(f"{path}: ")))
    known = ", ".join(map(str, landmarks.ids))
    for strange in np.setdiff1d(landmark, landmarks.ids):
        found = np.flatnonzero(landmark == strange)
        text = f"ID.{strange} is not in the set {landmarks.name!r} ({known})"
        text += f", in {number_of(len(found), 'row')}; --landmarks names another set"
        faults.append(Fault(line[found[0]], "landmark", text))
    for n in np.flatnonzero((visible < 0) | (visible > 1)):
        text = f"visible is a share, 0 to 1, not {visible[n]:g}"
        faults.append(Fault(line[n], "visible", text))
    if table.position is not None:
        fan, radius_m = log.fan, landmarks.radius_m
        assert fan is not None
        if other := of_another_geometry(table, row, fan, log.name):
            faults.append(Fault(line[0], "geometry", other))
        kind, range_m, bearing_deg = table.position[0], *(v[row] for v in table.position[1:])
        if kind != "polar":
            range_m, bearing_deg = polar_from_pixel(fan, range_m, bearing_deg)
        for a, b in lines[repeated_rows(table)].tolist():
            if b in line:
                faults.append(Fault(b, "repeated", f"repeats line {a}"))
        # Nearer than the floor counts as straight below.
        floor = plane_from_polar(np.nan_to_num(ground_range(fan, range_m)), bearing_deg)
        share = share_in_image(fan, range_m, bearing_deg, radius_m)
        outside = outside_image(fan, range_m, bearing_deg, radius_m)
        # Something else may hide a landmark too, so `visible` may be less.
        for n in np.flatnonzero(outside | ((visible <= 1) & (visible > share + SLACK))):
            kind = "visible"
            text = f"visible {visible[n]:.2f}, but {share[n]:.2f} of the disc is in the fan image"
            if outside[n]:
                where = f"range {range_m[n]:.2f} m, bearing {bearing_deg[n]:.1f} deg"
                kind, text = "outside", f"the whole disc is outside the fan ({where})"
            faults.append(Fault(line[n], kind, text))
        columns = (landmark, frame, stretch, range_m, bearing_deg, floor, share)
        rows = [_Row(*c) for c in zip(line, *(v.tolist() for v in columns), strict=True)]
        faults += _overlaps(rows, radius_m)
        faults += _changes(rows, radius_m)
        faults += _jumps(rows, radius_m, max_pan_deg)
    diagnostics = Diagnostics()
    diagnostics.problem(*log.diagnostics.problems)
    if others := len(table.keys) - len(row):
        diagnostics.note(f"{number_of(others, 'row')} of other logs not checked")
    return len(row), sorted(faults, key=lambda fault: fault.line), diagnostics


def _frames(
    table: TruthTable, row: IntArray, line: list[int], log: Log
) -> tuple[IntArray, IntArray, IntArray, list[Fault]]:
    """(the numbers of all frames; those of these rows, -1 if the log has no such frame; their
    stretches; the faults)."""
    of_log = [(f.index, f.timestamp_ns, f.stretch) for f in log]
    numbers, stamps, stretch = np.array(of_log, dtype=np.int64).T
    keys, last = table.keys[row], int(numbers.max())
    if table.key == "frame":
        known = np.isin(keys, numbers)
        frames = np.where(known, keys, -1)
    else:
        nearest, known, kept = match_times(stamps, keys)
        # If truth is denser than the frames, the nearest row counts, as in scoring.
        frames = np.where(kept, numbers[nearest], -1)
    faults = []
    if table.key != "frame" and (unit := wrong_unit(stamps, keys)):
        faults.append(Fault(line[0], "unit", f"{table.key} fits the log's times only in {unit}"))
    for n in np.flatnonzero(~known):
        text = f"frame {keys[n]} is not in the log, which has 0 to {last}"
        if table.key != "frame":
            text = f"no frame of the log is near {table.key} {keys[n]}"
        elif 0 <= keys[n] <= last:
            text = f"frame {keys[n]} of the log cannot be read"
        faults.append(Fault(line[n], "frame", text))
    return numbers, frames, stretch[np.searchsorted(numbers, frames)], faults


class _Row(NamedTuple):
    """A row with a position. frame: -1 if the log has no such frame. stretch: of that frame. floor:
    m on the floor, to the right and ahead of the sonar. share: of the disc in the fan image."""

    line: int
    landmark: int
    frame: int
    stretch: int
    range_m: float
    bearing_deg: float
    floor: list[float]
    share: float


def _by_frame(rows: Iterable[_Row]) -> dict[int, list[_Row]]:
    """Those rows that are on a frame of the log, by frame, rising."""
    groups = defaultdict(list)
    for row in rows:
        groups[row.frame].append(row)
    return {frame: groups[frame] for frame in sorted(groups) if frame >= 0}


def _overlaps(rows: Sequence[_Row], radius_m: float) -> Iterator[Fault]:
    """Two landmarks of one frame, of equal or different ID, that would lie on each other."""
    for group in _by_frame(rows).values():
        for a, b in combinations(group, 2):
            distance = dist(a.floor, b.floor)
            # The same ID in the same position is a repeated row, which is another fault.
            if distance < radius_m and (distance or a.landmark != b.landmark):
                text = f"lies on the landmark of line {a.line}, {distance:.2f} m from its centre"
                yield Fault(b.line, "overlap", text)


def _changes(rows: Sequence[_Row], radius_m: float) -> Iterator[Fault]:
    """Landmarks that change their ID in one position; the change back is not a second fault."""
    wrong: set[int] = set()
    frames = _by_frame(rows)
    for frame, group in frames.items():
        before, ids = frames.get(frame - 1, []), {row.landmark for row in group}
        for b in group:
            near = [(dist(a.floor, b.floor), a) for a in before if a.stretch == b.stretch]
            if any(a.landmark == b.landmark and distance < 3 * radius_m for distance, a in near):
                continue  # it moved here, its neighbour left
            for distance, a in near:
                if distance < radius_m and a.landmark not in ids and not wrong & {a.line, b.line}:
                    wrong.add(b.line)
                    text = f"ID.{b.landmark} where frame {frame - 1} has ID.{a.landmark} (line "
                    yield Fault(b.line, "changed", f"{text}{a.line})")


def _jumps(rows: Sequence[_Row], radius_m: float, max_pan_deg: float) -> Iterator[Fault]:
    """Rows too far from every row of the same ID in the last frame that has one, in one stretch.

    A pan leaves ranges as they are; a disc radius a frame is allowed for heave and drift. One that
    is partly outside the fan may be a second landmark of the ID, which enters.
    """

    def step(a: _Row, b: _Row) -> float:
        """The step from one row to another; 1: the limit."""
        pan = abs(a.bearing_deg - b.bearing_deg) / max_pan_deg
        return max(pan, abs(a.range_m - b.range_m) / radius_m) / (b.frame - a.frame)

    for landmark in sorted({row.landmark for row in rows}):
        groups = _by_frame(row for row in rows if row.landmark == landmark).values()
        for before, group in pairwise(groups):
            for b in group:
                a = min(before, key=partial(step, b=b))
                if b.share == 1 and a.stretch == b.stretch and step(a, b) > 1:
                    pan, shift = b.bearing_deg - a.bearing_deg, b.range_m - a.range_m
                    text = f"ID.{landmark} jumps by {pan:+.1f} deg and {shift:+.2f} m from frame "
                    text += f"{a.frame} (line {a.line}) to {b.frame}"
                    yield Fault(b.line, "jump", text)
