"""Finds rows of a gt.csv that cannot be true, by the log and its geometry."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.geometry import ground_range, pixel_from_polar, plane_from_polar, polar_from_pixel
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Fan
from sonarrec.readers.log import Log
from sonarrec.readers.open import find_log
from sonarrec.results.folders import possible_names
from sonarrec.tables.read import line_numbers
from sonarrec.truth.fits import in_other_unit, unit_of_times
from sonarrec.truth.match import SLACK_PX, match_times, pixels_apart, share_in_image
from sonarrec.truth.table import TruthTable, read_rows, repeated_rows

SLACK = 0.1
"""Tolerance for labels made by eye: a tenth of the radius in position, of the area in `visible`."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that cannot be true: the line of gt.csv, the kind of fault, and a description."""

    line: int
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class CheckedTruth:
    """A gt.csv checked against its log; N of its rows are on this log."""

    path: Path
    """Of gt.csv."""
    fan: Fan
    """Of the log."""
    landmarks: LandmarkSet
    line: IntArray
    """(N,) in gt.csv."""
    landmark: IntArray
    """(N,) IDs as written."""
    frame: IntArray
    """(N,) number in the log, -1 if the log has no such frame."""
    x_px: FloatArray | None
    y_px: FloatArray | None
    """(N,) in the fan image; None if the file has no positions."""
    visible: FloatArray
    """(N,) as written."""
    faults: list[Fault]
    """In order of the lines."""
    others: int
    """Number of rows on other logs."""
    diagnostics: Diagnostics
    """On the columns and the log."""

    def summary(self) -> str:
        """How many rows were checked, and how many faults there are."""
        faults = number_of(len(self.faults), "fault") if self.faults else "no fault"
        return f"{number_of(len(self.line), 'row')}, {faults}"


@dataclass(frozen=True, slots=True)
class _Rows:
    """The log's N rows with positions; the first four as in CheckedTruth. floor: (N, 2) m on the
    floor, to the right and ahead of the sonar."""

    line: IntArray
    landmark: IntArray
    frame: IntArray
    visible: FloatArray
    range_m: FloatArray
    bearing_deg: FloatArray
    floor: FloatArray

    def by_frame(self, chosen: IntArray) -> dict[int, IntArray]:
        """Some of the rows, those on frames of the log, by frame, rising."""
        chosen = chosen[np.argsort(self.frame[chosen], kind="stable")]
        chosen = chosen[self.frame[chosen] >= 0]
        frames, starts = np.unique(self.frame[chosen], return_index=True)
        return dict(zip(frames.tolist(), np.split(chosen, starts[1:]), strict=bool(len(frames))))

    def distances(self, row: int, others: IntArray) -> FloatArray:
        """(n,) m on the floor from a row to others."""
        return np.asarray(np.hypot(*(self.floor[others] - self.floor[row]).T))


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
    line, landmark, visible = lines[row], table.landmark[row], table.visible[row]
    frame, faults = _matched(table, row, line, log)
    fan, x_px, y_px = log.fan, None, None
    assert fan is not None
    known = ", ".join(map(str, landmarks.ids))
    for strange in np.setdiff1d(landmark, landmarks.ids):
        where = line[landmark == strange]
        text = f"ID.{strange} is not in the set {landmarks.name!r} ({known})"
        text += f", in {number_of(len(where), 'row')}; --landmarks names another set"
        faults.append(Fault(int(where[0]), "landmark", text))
    for n in np.flatnonzero((visible < 0) | (visible > 1)):
        text = f"visible is a share, 0 to 1, not {visible[n]:g}"
        faults.append(Fault(int(line[n]), "visible", text))
    if table.position is not None:
        kind, first, second = table.position[0], table.position[1][row], table.position[2][row]
        if kind != "polar":
            first, second = polar_from_pixel(fan, first, second)
        # Nearer than the floor counts as straight below.
        floor = plane_from_polar(np.nan_to_num(ground_range(fan, first)), second)
        rows = _Rows(line, landmark, frame, visible, first, second, floor)
        x_px, y_px = pixel_from_polar(fan, first, second)
        pairs = repeated_rows(table)
        for a, b in pairs[np.isin(pairs[:, 1], row)]:
            faults.append(Fault(int(lines[b]), "repeated", f"repeats line {lines[a]}"))
        apart = pixels_apart(table, row, fan)
        for n in np.flatnonzero(apart > SLACK_PX):  # one of the two was edited
            text = f"x_px,y_px and range_m,bearing_deg are {apart[n]:.1f} pixels apart"
            faults.append(Fault(int(line[n]), "position", text))
        faults += _outside(rows, fan, landmarks.radius_m)
        faults += _overlaps(rows, landmarks.radius_m)
        changes = [*_changes(rows, landmarks.radius_m)]
        changed = {fault.line for fault in changes}
        jumps = _jumps(rows, fan, landmarks.radius_m, max_pan_deg)
        faults += [*changes, *(jump for jump in jumps if jump.line not in changed)]
    diagnostics = Diagnostics()
    if table.not_read:
        diagnostics.note(table.not_read_text())
    diagnostics.problem(*log.diagnostics.problems)
    ordered = sorted(faults, key=lambda fault: fault.line)
    shown = (line, landmark, frame, x_px, y_px, visible, ordered)
    return CheckedTruth(path, fan, landmarks, *shown, len(table.at) - len(row), diagnostics)


def _matched(
    table: TruthTable, row: IntArray, line: IntArray, log: Log
) -> tuple[IntArray, list[Fault]]:
    """(N,) the frame numbers of these rows, -1 if the log has no such frame; the faults."""
    seen = [(frame.index, frame.timestamp_ns) for frame in log]
    numbers, stamps = np.array(seen, dtype=np.int64).T
    at = table.at[row]
    if table.key == "frame":
        known = np.isin(at, numbers)
        frames = np.where(known, at, -1)
    else:
        unit = unit_of_times(stamps, at)
        if unit is not None:
            fault = Fault(int(line[0]), "frame", in_other_unit(unit, log.name))
            return np.full(len(at), -1), [fault]
        nearest, known, kept = match_times(stamps, at)
        # If truth is denser than the frames, the nearest row counts, as in scoring.
        frames = np.where(kept, numbers[nearest], -1)
    last = int(numbers.max())
    faults = []
    for n in np.flatnonzero(~known):
        text = f"frame {at[n]} is not in the log, which has 0 to {last}"
        if table.key != "frame":
            text = f"no frame of the log is near {table.key} {at[n]}"
        elif 0 <= at[n] <= last:
            text = f"frame {at[n]} of the log cannot be read"
        faults.append(Fault(int(line[n]), "frame", text))
    return frames, faults


def _outside(rows: _Rows, fan: Fan, radius_m: float) -> Iterator[Fault]:
    """Discs that lie outside the fan, or show less than `visible` says.

    Something else may hide a landmark too, so `visible` may be less than the geometry allows.
    """
    visible = rows.visible
    share, near = (
        share_in_image(fan, rows.range_m, rows.bearing_deg, radius)
        for radius in (radius_m, radius_m * (1 + SLACK))
    )
    for n in np.flatnonzero((near == 0) | ((visible <= 1) & (visible > share + SLACK))):
        kind = "visible"
        text = f"visible {visible[n]:.2f}, but {share[n]:.2f} of the disc is in the fan image"
        if near[n] == 0:
            where = f"range {rows.range_m[n]:.2f} m, bearing {rows.bearing_deg[n]:.1f} deg"
            kind, text = "outside", f"the whole disc is outside the fan ({where})"
        yield Fault(int(rows.line[n]), kind, text)


def _overlaps(rows: _Rows, radius_m: float) -> Iterator[Fault]:
    """Two landmarks of one frame, of equal or different ID, that would lie on each other."""
    for group in rows.by_frame(np.arange(len(rows.line))).values():
        for k, a in enumerate(group[:-1].tolist(), 1):
            distance = rows.distances(a, group[k:])
            # The same ID in the same position is a repeated row, which is told already.
            other = (distance > 0) | (rows.landmark[group[k:]] != rows.landmark[a])
            for n in np.flatnonzero((distance < radius_m) & other):
                first, second = sorted((int(rows.line[a]), int(rows.line[group[k:][n]])))
                text = (
                    f"lies on the landmark of line {first}, {distance[n]:.2f} m away on the floor"
                )
                yield Fault(second, "overlap", text)


def _changes(rows: _Rows, radius_m: float) -> Iterator[Fault]:
    """Landmarks that change their ID in one position; the change back is not a second fault."""
    wrong: set[int] = set()
    frames = rows.by_frame(np.arange(len(rows.line)))
    for frame, group in frames.items():
        before = frames.get(frame - 1, group[:0])
        for b in group.tolist():
            new = rows.landmark[b]
            distance, other = rows.distances(b, before), rows.landmark[before] != new
            if (distance[~other] < 3 * radius_m).any():
                continue  # it moved here, its neighbour left
            for a in before[other & (distance < radius_m)].tolist():
                old = rows.landmark[a]
                if a not in wrong and b not in wrong and old not in rows.landmark[group]:
                    wrong.add(b)
                    text = f"ID.{new} where frame {frame - 1} has ID.{old} (line {rows.line[a]})"
                    yield Fault(int(rows.line[b]), "changed", text)


def _jumps(rows: _Rows, fan: Fan, radius_m: float, max_pan_deg: float) -> Iterator[Fault]:
    """Rows too far from every row of the same ID in the last frame that has one.

    A pan leaves ranges as they are; a disc radius a frame is allowed for heave and drift. No faults
    are the step back after a wrong row, and a second landmark of the ID that enters at an edge of
    the fan while the first stays in view.
    """

    def step_from(group: IntArray, b: int) -> tuple[float, int]:
        """The least step to row b from a group (1: the limit), and the row that it is from."""
        frames = max(int(rows.frame[b] - rows.frame[group[0]]), 1)
        rotation = np.abs(rows.bearing_deg[group] - rows.bearing_deg[b]) / (max_pan_deg * frames)
        shift = np.abs(rows.range_m[group] - rows.range_m[b]) / (radius_m * frames)
        step = np.maximum(rotation, shift)
        return float(step.min()), int(group[step.argmin()])

    wrong: set[int] = set()
    for landmark in np.unique(rows.landmark):
        groups = [*rows.by_frame(np.flatnonzero(rows.landmark == landmark)).values()]
        for k, (before, group) in enumerate(pairwise(groups)):
            steps = {b: step_from(before, b) for b in group.tolist()}
            stay = {a for step, a in steps.values() if step <= 1}
            for b, (step, a) in steps.items():
                frames = int(rows.frame[b] - rows.frame[a])
                if step <= 1:
                    continue
                if a in stay:  # b may be another one, which was partly outside before
                    shift_m, pan_deg = radius_m * frames, max_pan_deg * frames
                    range_m = rows.range_m[b] + np.array([shift_m, -shift_m, 0, 0])
                    bearing_deg = rows.bearing_deg[b] + np.array([0, 0, pan_deg, -pan_deg])
                    if (share_in_image(fan, range_m, bearing_deg, radius_m) < 1).any():
                        continue
                if a in wrong and k and step_from(groups[k - 1], b)[0] <= 1:
                    continue
                wrong.add(b)
                text = (
                    f"ID.{landmark} jumps by {rows.bearing_deg[b] - rows.bearing_deg[a]:+.1f} deg "
                    f"and {rows.range_m[b] - rows.range_m[a]:+.2f} m from frame {rows.frame[a]} "
                    f"(line {rows.line[a]}) to {rows.frame[b]}"
                )
                yield Fault(int(rows.line[b]), "jump", text)
