"""Finds rows of a gt.csv that cannot be true, by the log and its geometry."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import SonarrecError, number_of
from sonarrec.files.tables import line_numbers
from sonarrec.geometry import ground_range, pixel_from_polar, plane_from_polar, polar_from_pixel
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Fan
from sonarrec.readers.log import Log
from sonarrec.readers.open import find_log
from sonarrec.results.folders import possible_names
from sonarrec.truth.fits import columns_not_read, in_other_unit, unit_of_times
from sonarrec.truth.in_view import share_in_image
from sonarrec.truth.match import SLACK_PX, match_times, pixels_apart
from sonarrec.truth.table import TruthTable, read_rows, repeated_rows

SLACK = 0.1
"""Tolerance for labels made by eye: a tenth of the radius in place, of the area in `visible`."""


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
    notes: list[str]
    """On the columns."""
    problems: list[str]
    """Of the log."""

    def summary(self) -> str:
        """How many rows were checked, and how many faults there are."""
        faults = number_of(len(self.faults), "fault") if self.faults else "no fault"
        return f"{number_of(len(self.line), 'row')}, {faults}"


@dataclass(frozen=True, slots=True)
class _Places:
    """Where the landmarks of the log's N rows are.

    frame, landmark: (N,) as in CheckedTruth. range_m, bearing_deg: (N,). x_px, y_px: (N,) in the
    fan image. floor: (N, 2) m on the floor, to the right and ahead of the sonar.
    """

    frame: IntArray
    landmark: IntArray
    range_m: FloatArray
    bearing_deg: FloatArray
    x_px: FloatArray
    y_px: FloatArray
    floor: FloatArray


def check_truth(
    path: Path, log: Log, landmarks: LandmarkSet, *, max_pan_deg: float
) -> CheckedTruth:
    """Check a gt.csv against the log it describes: one pass over the log, for its frames.

    max_pan_deg: by how much the sonar may turn from one frame to the next.
    Raises SonarrecError if either cannot be read at all.
    """
    table = read_rows(path)
    row = _rows_on(table, log)
    lines = np.fromiter(line_numbers(path), np.int64, len(table.at))
    line, visible = lines[row], table.visible[row]
    frames, faults = _matched(table, row, line, log)
    assert log.fan is not None
    faults += _ids(line, table.landmark[row], landmarks)
    faults += _shares(line, visible)
    places = _places(table, row, frames, log.fan)
    if places is not None:
        faults += _repeats(table, row, lines)
        faults += _contradictions(line, pixels_apart(table, row, log.fan))
        faults += _outside(line, places, visible, log.fan, landmarks.radius_m)
        faults += _overlaps(line, places, landmarks.radius_m)
        changes = _changes(line, places, landmarks.radius_m)
        changed = {fault.line for fault in changes}
        jumps = _jumps(line, places, log.fan, landmarks.radius_m, max_pan_deg)
        faults += [*changes, *(jump for jump in jumps if jump.line not in changed)]
    return CheckedTruth(
        path=path,
        fan=log.fan,
        landmarks=landmarks,
        line=line,
        landmark=table.landmark[row],
        frame=frames,
        x_px=None if places is None else places.x_px,
        y_px=None if places is None else places.y_px,
        visible=visible,
        faults=sorted(faults, key=lambda fault: fault.line),
        others=len(table.at) - len(row),
        notes=columns_not_read(table),
        problems=log.diagnostics.problems,
    )


def _rows_on(table: TruthTable, log: Log) -> IntArray:
    """(N,) the rows on a log. Raises SonarrecError if the column `log` does not name it."""
    # Results are named by the log's name, with folders in front if another log has the same name.
    names = possible_names(log.name, find_log(log.path).place.resolve())
    row = table.rows_of(table.name_of(names))
    if len(table.at) and not len(row):
        named = ", ".join(sorted({repr(str(name)) for name in table.log}))
        raise SonarrecError(
            f"{table.path}: its log column does not name {log.name}; it has {named}"
        )
    return row


def _places(table: TruthTable, row: IntArray, frame: IntArray, fan: Fan) -> _Places | None:
    """Where the landmarks of these rows are; None if the table has no positions."""
    if table.position is None:
        return None
    kind, first, second = table.position[0], table.position[1][row], table.position[2][row]
    range_m, bearing_deg = first, second
    if kind != "polar":
        range_m, bearing_deg = polar_from_pixel(fan, first, second)
    # Nearer than the floor counts as straight below.
    floor = plane_from_polar(np.nan_to_num(ground_range(fan, range_m)), bearing_deg)
    pixels = pixel_from_polar(fan, range_m, bearing_deg)
    return _Places(frame, table.landmark[row], range_m, bearing_deg, *pixels, floor)


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
    return frames, _frames(line[~known], at[~known], table.key, numbers)


def _frames(line: IntArray, at: IntArray, key: str, numbers: IntArray) -> list[Fault]:
    """Frames that the log does not have."""
    last = int(numbers.max())
    faults = []
    for number, frame in zip(line, at, strict=True):
        if key != "frame":
            text = f"no frame of the log is near {key} {frame}"
        elif 0 <= frame <= last:
            text = f"frame {frame} of the log cannot be read"
        else:
            text = f"frame {frame} is not in the log, which has 0 to {last}"
        faults.append(Fault(int(number), "frame", text))
    return faults


def _ids(line: IntArray, landmark: IntArray, landmarks: LandmarkSet) -> list[Fault]:
    known = ", ".join(map(str, landmarks.ids))
    return [
        Fault(int(number), "landmark", f"ID.{i} is not in the set {landmarks.name!r} ({known})")
        for number, i in zip(line, landmark, strict=True)
        if i not in landmarks.ids
    ]


def _shares(line: IntArray, visible: FloatArray) -> list[Fault]:
    wrong = (visible < 0) | (visible > 1)
    return [
        Fault(int(number), "visible", f"visible is a share, 0 to 1, not {share:g}")
        for number, share in zip(line[wrong], visible[wrong], strict=True)
    ]


def _repeats(table: TruthTable, row: IntArray, lines: IntArray) -> list[Fault]:
    pairs = repeated_rows(table)
    return [
        Fault(int(lines[b]), "repeated", f"repeats line {lines[a]}")
        for a, b in pairs[np.isin(pairs[:, 1], row)]
    ]


def _contradictions(line: IntArray, apart_px: FloatArray) -> list[Fault]:
    """Rows whose pixels are not where their range and bearing are: one of them was edited."""
    return [
        Fault(
            int(line[n]),
            "position",
            f"x_px,y_px and range_m,bearing_deg are {apart_px[n]:.1f} pixels apart",
        )
        for n in np.flatnonzero(apart_px > SLACK_PX)
    ]


def _outside(
    line: IntArray, places: _Places, visible: FloatArray, fan: Fan, radius_m: float
) -> list[Fault]:
    """Discs that lie outside the fan, or show less than `visible` says.

    Something else may hide a landmark too, so `visible` may be less than the geometry allows.
    """
    share = share_in_image(fan, places.range_m, places.bearing_deg, radius_m)
    near = share_in_image(fan, places.range_m, places.bearing_deg, radius_m * (1 + SLACK))
    faults = []
    for n in np.flatnonzero((near == 0) | ((visible <= 1) & (visible > share + SLACK))):
        if near[n] == 0:
            where = f"range {places.range_m[n]:.2f} m, bearing {places.bearing_deg[n]:.1f} deg"
            text = f"the whole disc is outside the fan ({where})"
            faults.append(Fault(int(line[n]), "outside", text))
        else:
            text = f"visible {visible[n]:.2f}, but {share[n]:.2f} of the disc is in the fan image"
            faults.append(Fault(int(line[n]), "visible", text))
    return faults


def _overlaps(line: IntArray, places: _Places, radius_m: float) -> list[Fault]:
    """Two landmarks of one frame, of equal or different ID, that would lie on each other."""
    order = np.argsort(places.frame, kind="stable")
    frame = places.frame[order]
    faults = []
    # Neighbours in the order, then next but one, until no two of a frame are left.
    for step in range(1, len(order)):
        together = np.flatnonzero((frame[step:] == frame[:-step]) & (frame[step:] >= 0))
        if not len(together):
            break
        a, b = order[together], order[together + step]
        apart = np.hypot(*(places.floor[a] - places.floor[b]).T)
        # The same ID in the same place is a repeated row, which `_repeats` reports.
        other = (apart > 0) | (places.landmark[a] != places.landmark[b])
        for n in np.flatnonzero((apart < radius_m) & other):
            first, second = sorted((int(line[a[n]]), int(line[b[n]])))
            text = f"lies on the landmark of line {first}, {apart[n]:.2f} m away on the floor"
            faults.append(Fault(second, "overlap", text))
    return faults


def _changes(line: IntArray, places: _Places, radius_m: float) -> list[Fault]:
    """Landmarks that change their ID from one frame to the next, in one place.

    The step back after a wrong row is not a second fault.
    """
    order = np.argsort(places.frame, kind="stable")
    order = order[places.frame[order] >= 0]
    frame, landmark, floor = places.frame[order], places.landmark[order], places.floor[order]
    present = set(zip(frame.tolist(), landmark.tolist(), strict=True))
    first = np.searchsorted(frame, frame - 1)
    count = np.searchsorted(frame, frame - 1, side="right") - first
    wrong: dict[int, Fault] = {}
    for k in range(int(count.max(initial=0))):
        before = np.where(k < count, first + k, 0)
        apart = np.hypot(*(floor - floor[before]).T)
        for n in np.flatnonzero((k < count) & (apart < radius_m) & (landmark != landmark[before])):
            old, new, at = int(landmark[before[n]]), int(landmark[n]), int(frame[n])
            earlier = slice(first[n], first[n] + count[n])
            own = floor[earlier][landmark[earlier] == new] - floor[n]
            followed = (np.hypot(*own.T) < 3 * radius_m).any()  # it moved here, its neighbour left
            if (at, old) in present or followed or before[n] in wrong:
                continue
            text = f"ID.{new} where frame {at - 1} has ID.{old} (line {line[order[before[n]]]})"
            wrong[int(n)] = Fault(int(line[order[n]]), "changed", text)
    return list(wrong.values())


def _jumps(
    line: IntArray, places: _Places, fan: Fan, radius_m: float, max_pan_deg: float
) -> list[Fault]:
    """Rows too far from every row of the same ID in the last frame that has one.

    A pan turns everything about the sonar and leaves ranges as they are; a disc radius a frame is
    allowed for heave and drift. The step back after a wrong row is not a second fault. Nor is a
    second landmark of the ID that enters at an edge of the fan while the first stays in view.
    """
    order = np.lexsort((places.frame, places.landmark))
    order = order[places.frame[order] >= 0]
    landmark, frame = places.landmark[order], places.frame[order]
    range_m, bearing_deg = places.range_m[order], places.bearing_deg[order]
    # A group: the rows of one ID in one frame, nearly always one.
    new = np.diff(landmark, prepend=-1) != 0
    new |= np.diff(frame, prepend=-1) != 0
    starts = np.flatnonzero(new)
    sizes = np.diff(np.append(starts, len(order)))
    group = np.cumsum(new) - 1

    def nearest_in(back: int) -> tuple[FloatArray, IntArray]:
        """Per row, the least step from a row `back` groups earlier (1: the limit), and that row.

        (inf, -1) if the ID has no such group.
        """
        earlier = np.maximum(group - back, 0)
        count = np.where(group >= back, sizes[earlier], 0)
        least = np.full(len(order), np.inf)
        nearest = np.full(len(order), -1)
        for k in range(int(sizes.max(initial=0))):
            there = np.where(k < count, starts[earlier] + k, 0)
            gap = np.maximum(frame - frame[there], 1)
            turned = np.abs(bearing_deg - bearing_deg[there]) / (max_pan_deg * gap)
            moved = np.abs(range_m - range_m[there]) / (radius_m * gap)
            excess = np.maximum(turned, moved)
            better = (k < count) & (landmark[there] == landmark) & (excess < least)
            least, nearest = np.where(better, excess, least), np.where(better, there, nearest)
        return least, nearest

    (once, before), (twice, _) = nearest_in(1), nearest_in(2)
    far = np.flatnonzero((before >= 0) & (once > 1))
    stays = set(zip(group[once <= 1].tolist(), before[once <= 1].tolist(), strict=True))
    another = np.array([(int(group[b]), int(before[b])) in stays for b in far], dtype=bool)
    frames = np.maximum(frame[far] - frame[before[far]], 1)
    steps = (range_m[far], bearing_deg[far], radius_m * frames, max_pan_deg * frames)
    enters = another & _near_an_edge(fan, *steps, radius_m)
    wrong: dict[int, Fault] = {}
    for b in far[~enters]:
        a = int(before[b])
        if a in wrong and twice[b] <= 1:
            continue
        text = (
            f"ID.{landmark[b]} jumps by {bearing_deg[b] - bearing_deg[a]:+.1f} deg and "
            f"{range_m[b] - range_m[a]:+.2f} m from frame {frame[a]} (line {line[order[a]]}) "
            f"to {frame[b]}"
        )
        wrong[int(b)] = Fault(int(line[order[b]]), "jump", text)
    return list(wrong.values())


def _near_an_edge(
    fan: Fan,
    range_m: FloatArray,
    bearing_deg: FloatArray,
    moved_m: FloatArray,
    turned_deg: FloatArray,
    radius_m: float,
) -> BoolArray:
    """(N,) whether discs, after such a turn or move, may lie partly outside the fan image."""
    still = np.zeros(len(range_m))
    moves = ((moved_m, still), (-moved_m, still), (still, turned_deg), (still, -turned_deg))
    shares = [share_in_image(fan, range_m + m, bearing_deg + t, radius_m) for m, t in moves]
    return np.asarray(np.min(shares, axis=0) < 1)
