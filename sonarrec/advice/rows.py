"""What cannot be true of a gt.csv, row by row: `sonarrec truth check`."""

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

from sonarrec.advice.truth import floor_position, of_another_geometry, sparse, unread_columns
from sonarrec.arrays import IntArray
from sonarrec.errors import Diagnostics, SonarrecError, number_of
from sonarrec.landmarks import LandmarkSet
from sonarrec.readers.log import Log
from sonarrec.readers.open import find_log
from sonarrec.results.folders import possible_names
from sonarrec.sonar.geometry import polar_from_pixel
from sonarrec.tables.read import line_numbers
from sonarrec.truth.check import SLACK, outside_image
from sonarrec.truth.match import match_times, share_in_image, wrong_times
from sonarrec.truth.table import TruthTable, read_rows, repeated_rows


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
    frame, stretch, faults = _frames(table, row, line, log)
    if unread := unread_columns(table):
        faults.append(Fault(1, "columns", unread.removeprefix(f"{path}: ")))
    known = ", ".join(map(str, landmarks.ids))
    for strange in np.setdiff1d(landmark, landmarks.ids):
        wrong = np.flatnonzero(landmark == strange)
        text = f"ID.{strange} is not in the set {landmarks.name!r} ({known})"
        text += f", in {number_of(len(wrong), 'row')}; --landmarks names another set"
        faults.append(Fault(line[wrong[0]], "landmark", text))
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
        floor = floor_position(fan, range_m, bearing_deg)
        share = share_in_image(fan, range_m, bearing_deg, radius_m)
        outside = outside_image(fan, range_m, bearing_deg, radius_m)
        columns = (landmark, visible, frame, stretch, range_m, bearing_deg, floor, share, outside)
        rows = [_Row(*cells) for cells in zip(line, *(c.tolist() for c in columns), strict=True)]
        faults += _outside(rows)
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
) -> tuple[IntArray, IntArray, list[Fault]]:
    """(the frames of these rows, -1 if the log has no such frame; their stretches; the faults)."""
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
    if table.key != "frame" and (wrong := wrong_times(stamps, keys, table.landmark[row])):
        faults.append(Fault(line[0], "times", f"all {table.key} {wrong}"))
    for n in np.flatnonzero(~known):
        text = f"frame {keys[n]} is not in the log, which has 0 to {last}"
        if table.key != "frame":
            text = f"no frame of the log is near {table.key} {keys[n]}"
        elif 0 <= keys[n] <= last:
            text = f"frame {keys[n]} of the log cannot be read"
        faults.append(Fault(line[n], "frame", text))
    index = np.searchsorted(numbers, frames)
    if few := sparse(index[frames >= 0], numbers):
        faults.append(Fault(line[0], "sparse", few))
    return frames, stretch[index], faults


class _Row(NamedTuple):
    """A row with a position. frame: -1 if the log has no such frame. stretch: of that frame. floor:
    m on the floor, to the right and ahead of the sonar. share: of the disc in the fan image.
    outside: whether all of it is clearly outside."""

    line: int
    landmark: int
    visible: float
    frame: int
    stretch: int
    range_m: float
    bearing_deg: float
    floor: list[float]
    share: float
    outside: bool


def _by_frame(rows: Iterable[_Row]) -> dict[int, list[_Row]]:
    """Those rows that are on a frame of the log, by frame, rising."""
    groups = defaultdict(list)
    for row in rows:
        groups[row.frame].append(row)
    return {frame: groups[frame] for frame in sorted(groups) if frame >= 0}


def _outside(rows: Iterable[_Row]) -> Iterator[Fault]:
    """Discs of which the fan image shows nothing, or less than is stated."""
    for row in rows:
        if row.outside:
            where = f"range {row.range_m:.2f} m, bearing {row.bearing_deg:.1f} deg"
            yield Fault(row.line, "outside", f"the whole disc is outside the fan ({where})")
        elif row.share + SLACK < row.visible <= 1:  # less may be: something else hides it
            text = f"visible {row.visible:.2f}, but {row.share:.2f} of the disc is in the fan image"
            yield Fault(row.line, "visible", text)


def _overlaps(rows: Iterable[_Row], radius_m: float) -> Iterator[Fault]:
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
