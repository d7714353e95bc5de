"""Whether a gt.csv can be the truth of a log: as a whole, for scoring, and row by row."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import dist
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.geometry import ground_range, plane_from_polar, polar_from_pixel, polar_from_plane
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Fan
from sonarrec.readers.log import Log
from sonarrec.readers.open import find_log
from sonarrec.results.folders import possible_names
from sonarrec.tables.read import line_numbers
from sonarrec.truth.match import SLACK_PX, ReadLog, Truth, match_times, pixels_apart, share_in_image
from sonarrec.truth.table import TruthTable, read_rows, repeated_rows

SLACK = 0.1
"""Tolerance for labels made by eye: a tenth of the radius in position, of the area in `visible`."""
FEWEST = 5  # frames or rows from which on a pattern in them is told
_UNITS_NS = {"nanoseconds": 1, "microseconds": 10**3, "milliseconds": 10**6, "seconds": 10**9}


# --- As a whole ----------------------------------------------------------------------------------


def misfit(table: TruthTable, log: ReadLog, truth: Truth) -> str | None:
    """Why a truth with rows on the log cannot be that of the log; None if it can.

    truth: as matched to the log.
    """
    at, fan = table.at[table.rows_of(log.name)], log.fan
    if table.key != "frame" and log.timestamp_ns is not None:
        wrong = _other_unit(log.timestamp_ns, at, log.name)
        if wrong is not None:
            return f"{table.path}: {wrong}"
    if truth.rows and not len(truth.frame_index):
        near, of_frames = "on", log.frame
        if truth.tolerance_ns is not None and log.timestamp_ns is not None:
            near, of_frames = f"within {truth.tolerance_ns / 1e9:.4g} s of", log.timestamp_ns
        return (
            f"{table.path}: none of its {truth.rows} rows ({table.key} {at.min()} to {at.max()}) "
            f"lies {near} a processed frame of {log.name} ({number_of(len(log.frame), 'frame')}, "
            f"{of_frames.min()} to {of_frames.max()}); is this the truth of another log?"
        )
    outside = _outside_image(log, truth)
    if fan is not None and truth.position is not None and len(outside) and outside.all():
        range_m, bearing_deg = (values[0] for values in polar_from_plane(truth.position))
        return (
            f"{table.path}: none of its {len(outside)} positions lies in the image of {log.name} "
            f"({fan.range_min_m:g} to {fan.range_max_m:g} m, {fan.bearing_min_deg:g} to "
            f"{fan.bearing_max_deg:g} deg); the first is {range_m:.4g} m, {bearing_deg:.4g} deg; "
            "are the units and the log right?"
        )
    return None


def _other_unit(timestamp_ns: IntArray, at: IntArray, log: str) -> str | None:
    """That times cannot be nanoseconds but are of another unit; None if they can be.

    timestamp_ns: (F,) of frames. at: (R,). It is another unit if with it at least nine of ten rows
    have a frame, and these are three or more frames and three times as many as with nanoseconds. In
    ns, times of a clock that starts at 0 would nearly all fall on the first frame.
    """
    in_ns = 0
    for unit, unit_ns in _UNITS_NS.items():
        if len(at) and np.abs(at).max() < 2**63 // unit_ns:
            nearest, matched, _ = match_times(timestamp_ns, at * unit_ns)
            frames = len(np.unique(nearest[matched]))
            if unit_ns == 1:
                in_ns = frames
            elif matched.mean() >= 0.9 and frames >= 3 * max(in_ns, 1):
                return (
                    f"timestamp_ns must be nanoseconds; its times fit the frames of {log} only if "
                    f"they are {unit}"
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


def tell_rows(told: Diagnostics, name: str, truth_rows: int, between: int) -> None:
    """Tell if the truth has no row on a log, or rows between its frames.

    name: of the log. truth_rows, between: as in Truth.
    """
    if not truth_rows:
        told.note(f"{name}: no row in the ground truth, so it is taken to hold no landmark")
    if between:
        told.note(
            f"{name}: {number_of(between, 'ground-truth row')} between frames ignored, "
            "because others are nearer in time"
        )


def tell_other_logs(
    told: Diagnostics, table: TruthTable, logs: Sequence[str], consequence: str
) -> None:
    """Tell of rows of the truth about other logs than `logs`. consequence: of that, a clause."""
    others = [] if table.log is None else [str(name) for name in table.log if name not in logs]
    if others:
        names = sorted(set(others))
        listed = ", ".join(names[:5]) + f" and {len(names) - 5} more" * (len(names) > 5)
        told.problem(
            f"{table.path}: {len(others)} of {len(table.at)} rows name logs that were not "
            f"given ({listed}); {consequence}"
        )


def tell_fit(
    told: Diagnostics, table: TruthTable, log: ReadLog, truth: Truth, use: str, of_proposals: str
) -> None:
    """Tell what a reader should know of the rows on one log, and signs that they are not its own.

    truth: as matched to the log. use: what is done with range and bearing, a verb. of_proposals:
    the consequence of rows as `truth propose` wrote them, a clause.
    """
    rows, path, name, fan = table.rows_of(log.name), table.path, log.name, log.fan
    if table.not_read:
        told.note(table.not_read)
    if proposed := np.count_nonzero(table.proposed[rows]):
        told.note(
            f"{path}: by `source`, {proposed} of {len(rows)} rows for {name} are unchecked "
            f"proposals of `truth propose`; {of_proposals}. Clear `source` where you checked"
        )
    if outside := np.count_nonzero(_outside_image(log, truth)):
        told.note(
            f"{path}: {outside} of {len(truth.frame_index)} positions lie outside the image of "
            f"{name}; `sonarrec truth check` names them"
        )
    if fan is not None and (apart := np.sum(pixels_apart(table, rows, fan) > SLACK_PX)):
        told.note(
            f"{path}: {number_of(int(apart), 'row')} for {name} with x_px,y_px elsewhere than "
            f"range_m,bearing_deg, which {use}; `sonarrec truth check` tells which"
        )
    frames = np.unique(truth.frame_index)
    if len(frames) >= FEWEST and np.diff(frames).min() > 1:
        step = int(np.median(np.diff(frames)))
        told.note(
            f"{path}: of {name} about one frame in {step} has a row; frames between count as "
            "without a landmark, and claims there as false. Give every frame its rows"
        )
    if fan is not None and table.position is not None and table.position[0] == "polar":
        bearings = np.abs(table.position[2][rows])
        widest = max(-fan.bearing_min_deg, fan.bearing_max_deg)
        if len(rows) >= FEWEST and 0 < bearings.max() <= np.radians(widest):
            told.note(
                f"{path}: no bearing for {name} is beyond {bearings.max():.2g} deg, of "
                f"{widest:.3g} in view; are they in radians?"
            )


def _outside_image(log: ReadLog, truth: Truth) -> BoolArray:
    """(T,) which discs lie wholly outside the fan; (0,) if positions or the fan are not known."""
    fan, radius_m = log.fan, log.landmarks.radius_m
    if fan is None or truth.position is None:
        return np.zeros(0, dtype=bool)
    range_m, bearing_deg = polar_from_plane(truth.position)
    aside = bearing_deg - np.clip(bearing_deg, fan.bearing_min_deg, fan.bearing_max_deg)
    outside = np.asarray(
        (range_m < fan.range_min_m - radius_m)
        | (range_m > fan.range_max_m + radius_m)
        | (np.radians(np.abs(aside)) * range_m > radius_m)
    )
    # Only these are computed exactly, on the floor, since that takes long.
    share = share_in_image(fan, range_m[outside], bearing_deg[outside], radius_m)
    outside[outside] = share == 0
    return outside


# --- Row by row ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that cannot be true: the line of gt.csv, the kind of fault, and a description."""

    line: int
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class CheckedTruth:
    """A gt.csv checked against its log: how many rows are on this log and on others, the faults in
    order of the lines, and what is told of the columns and the log."""

    rows: int
    others: int
    faults: list[Fault]
    diagnostics: Diagnostics

    def summary(self) -> str:
        """How many rows were checked, and how many faults there are."""
        faults = number_of(len(self.faults), "fault") if self.faults else "no fault"
        return f"{number_of(self.rows, 'row')}, {faults}"


def check_truth(
    path: Path, log: Log, landmarks: LandmarkSet, *, max_pan_deg: float
) -> CheckedTruth:
    """Check a gt.csv against the log it describes: one pass over the log, for its frames.

    max_pan_deg: by how much the sonar may turn from one frame to the next.
    Raises SonarrecError if either cannot be read at all.
    """
    table = read_rows(path)
    # Results are named by the log's name, with folders in front if another log has the same name.
    names = possible_names(log.name, find_log(log.path).place.resolve())
    row = table.rows_of(table.name_of(names))
    if len(table.at) and table.log is not None and not len(row):
        named = ", ".join(sorted({repr(str(name)) for name in table.log}))
        raise SonarrecError(f"{path}: its log column does not name {log.name}; it has {named}")
    lines = np.fromiter(line_numbers(path), np.int64, len(table.at))
    line, landmark, visible = lines[row].tolist(), table.landmark[row], table.visible[row]
    frame, faults = _frames(table, row, line, log)
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
        kind, range_m, bearing_deg = table.position[0], *(v[row] for v in table.position[1:])
        if kind != "polar":
            range_m, bearing_deg = polar_from_pixel(fan, range_m, bearing_deg)
        for a, b in lines[repeated_rows(table)].tolist():
            if b in line:
                faults.append(Fault(b, "repeated", f"repeats line {a}"))
        apart = pixels_apart(table, row, fan)
        for n in np.flatnonzero(apart > SLACK_PX):  # one of the two was edited
            text = f"x_px,y_px and range_m,bearing_deg are {apart[n]:.1f} pixels apart"
            faults.append(Fault(line[n], "position", text))
        # Nearer than the floor counts as straight below.
        floor = plane_from_polar(np.nan_to_num(ground_range(fan, range_m)), bearing_deg)
        columns = (line, *(v.tolist() for v in (landmark, frame, range_m, bearing_deg, floor)))
        rows = [_Row(*cells) for cells in zip(*columns, strict=True)]
        faults += _outside(rows, visible, fan, radius_m)
        faults += _overlaps(rows, radius_m)
        changes = [*_changes(rows, radius_m)]
        changed = {fault.line for fault in changes}
        jumps = _jumps(rows, fan, radius_m, max_pan_deg)
        faults += [*changes, *(jump for jump in jumps if jump.line not in changed)]
    diagnostics = Diagnostics()
    if table.not_read:
        diagnostics.note(table.not_read)
    diagnostics.problem(*log.diagnostics.problems)
    ordered = sorted(faults, key=lambda fault: fault.line)
    return CheckedTruth(len(row), len(table.at) - len(row), ordered, diagnostics)


def _frames(
    table: TruthTable, row: IntArray, line: list[int], log: Log
) -> tuple[IntArray, list[Fault]]:
    """(the frame numbers of these rows, -1 if the log has no such frame; the faults)."""
    numbers, stamps = np.array([(f.index, f.timestamp_ns) for f in log], dtype=np.int64).T
    at, last = table.at[row], int(numbers.max())
    if table.key == "frame":
        known = np.isin(at, numbers)
        frames = np.where(known, at, -1)
    else:
        wrong = _other_unit(stamps, at, log.name)
        if wrong is not None:
            return np.full(len(at), -1), [Fault(line[0], "frame", wrong)]
        nearest, known, kept = match_times(stamps, at)
        # If truth is denser than the frames, the nearest row counts, as in scoring.
        frames = np.where(kept, numbers[nearest], -1)
    faults = []
    for n in np.flatnonzero(~known):
        text = f"frame {at[n]} is not in the log, which has 0 to {last}"
        if table.key != "frame":
            text = f"no frame of the log is near {table.key} {at[n]}"
        elif 0 <= at[n] <= last:
            text = f"frame {at[n]} of the log cannot be read"
        faults.append(Fault(line[n], "frame", text))
    return frames, faults


class _Row(NamedTuple):
    """A row with a position. frame: -1 if the log has no such frame. floor: m on the floor, to the
    right and ahead of the sonar."""

    line: int
    landmark: int
    frame: int
    range_m: float
    bearing_deg: float
    floor: list[float]


def _by_frame(rows: Iterable[_Row]) -> dict[int, list[_Row]]:
    """Those rows that are on a frame of the log, by frame, rising."""
    groups = defaultdict(list)
    for row in rows:
        groups[row.frame].append(row)
    return {frame: groups[frame] for frame in sorted(groups) if frame >= 0}


def _outside(
    rows: Sequence[_Row], visible: FloatArray, fan: Fan, radius_m: float
) -> Iterator[Fault]:
    """Discs that lie outside the fan, or show less than `visible` says.

    Something else may hide a landmark too, so `visible` may be less than the geometry allows.
    """
    range_m, bearing_deg = np.array([row[3:5] for row in rows]).reshape(-1, 2).T
    share, near = (
        share_in_image(fan, range_m, bearing_deg, radius)
        for radius in (radius_m, radius_m * (1 + SLACK))
    )
    for n in np.flatnonzero((near == 0) | ((visible <= 1) & (visible > share + SLACK))):
        kind = "visible"
        text = f"visible {visible[n]:.2f}, but {share[n]:.2f} of the disc is in the fan image"
        if near[n] == 0:
            where = f"range {range_m[n]:.2f} m, bearing {bearing_deg[n]:.1f} deg"
            kind, text = "outside", f"the whole disc is outside the fan ({where})"
        yield Fault(rows[int(n)].line, kind, text)


def _overlaps(rows: Sequence[_Row], radius_m: float) -> Iterator[Fault]:
    """Two landmarks of one frame, of equal or different ID, that would lie on each other."""
    for group in _by_frame(rows).values():
        for a, b in combinations(group, 2):
            distance = dist(a.floor, b.floor)
            # The same ID in the same position is a repeated row, which is told already.
            if distance < radius_m and (distance or a.landmark != b.landmark):
                text = f"lies on the landmark of line {a.line}, {distance:.2f} m away on the floor"
                yield Fault(b.line, "overlap", text)


def _changes(rows: Sequence[_Row], radius_m: float) -> Iterator[Fault]:
    """Landmarks that change their ID in one position; the change back is not a second fault."""
    wrong: set[int] = set()
    frames = _by_frame(rows)
    for frame, group in frames.items():
        before, ids = frames.get(frame - 1, []), {row.landmark for row in group}
        for b in group:
            near = [(dist(a.floor, b.floor), a) for a in before]
            if any(a.landmark == b.landmark and distance < 3 * radius_m for distance, a in near):
                continue  # it moved here, its neighbour left
            for distance, a in near:
                if distance < radius_m and a.landmark not in ids and not wrong & {a.line, b.line}:
                    wrong.add(b.line)
                    text = f"ID.{b.landmark} where frame {frame - 1} has ID.{a.landmark} (line "
                    yield Fault(b.line, "changed", f"{text}{a.line})")


def _jumps(rows: Sequence[_Row], fan: Fan, radius_m: float, max_pan_deg: float) -> Iterator[Fault]:
    """Rows too far from every row of the same ID in the last frame that has one.

    A pan leaves ranges as they are; a disc radius a frame is allowed for heave and drift. No faults
    are the step back after a wrong row, and a second landmark of the ID that enters at an edge of
    the fan while the first stays in view.
    """

    def step(a: _Row, b: _Row) -> float:
        """The step from one row to another; 1: the limit."""
        frames = max(b.frame - a.frame, 1)
        pan = abs(a.bearing_deg - b.bearing_deg) / (max_pan_deg * frames)
        return max(pan, abs(a.range_m - b.range_m) / (radius_m * frames))

    def may_enter(b: _Row, frames: int) -> bool:
        """Whether a row's disc may have been partly outside the fan so many frames before."""
        ranges = b.range_m + radius_m * frames * np.array([1, -1, 0, 0])
        bearings = b.bearing_deg + max_pan_deg * frames * np.array([0, 0, 1, -1])
        return bool((share_in_image(fan, ranges, bearings, radius_m) < 1).any())

    wrong: set[int] = set()
    for landmark in sorted({row.landmark for row in rows}):
        groups = [*_by_frame(row for row in rows if row.landmark == landmark).values()]
        for earlier, before, group in zip([[], *groups], groups, groups[1:], strict=False):
            from_row = {b.line: min(before, key=lambda a: step(a, b)) for b in group}
            stay = {from_row[b.line].line for b in group if step(from_row[b.line], b) <= 1}
            for b in group:
                a = from_row[b.line]
                if step(a, b) <= 1 or (a.line in stay and may_enter(b, b.frame - a.frame)):
                    continue
                if a.line in wrong and any(step(c, b) <= 1 for c in earlier):
                    continue
                wrong.add(b.line)
                pan, shift = b.bearing_deg - a.bearing_deg, b.range_m - a.range_m
                text = f"ID.{landmark} jumps by {pan:+.1f} deg and {shift:+.2f} m from frame "
                text += f"{a.frame} (line {a.line}) to {b.frame}"
                yield Fault(b.line, "jump", text)
