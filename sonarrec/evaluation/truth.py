"""Ground truth: gt.csv read, checked, written, and matched to the frames that were processed."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sonarrec.geometry import plane_position
from sonarrec.landmarks import LandmarkSet
from sonarrec.records import BoolArray, Fan, FloatArray, IntArray, SonarrecError
from sonarrec.tables import POSITION_KINDS, Kind, line_number, position_pair, read_table

HEADER = "frame,landmark,x_px,y_px,visible"


@dataclass(frozen=True, slots=True)
class TruthTable:
    """gt.csv as read. Arrays have one element per row of the file.

    key: "frame" or "timestamp_ns"; at: (R,) its values. landmark: (R,) IDs. visible: 0 to 1.
    log: (R,) names, or None. position: as tables.position_pair gives it, or None.
    orientation: (R,) deg, NaN where blank; None without the column.
    """

    path: Path
    key: str
    at: IntArray
    landmark: IntArray
    visible: FloatArray
    log: Any
    position: tuple[str, FloatArray, FloatArray] | None
    orientation: FloatArray | None


@dataclass(frozen=True, slots=True)
class Truth:
    """The landmarks in view of one log's processed frames. Arrays have one element per landmark.

    row: index into LogResults.frame. landmark: index into the set's ids. visible: 0 to 1.
    position: (T, 2) metres in the fan plane, or None where it is not known. orientation: (T,) deg,
    as in estimates.csv, or None.
    rows: rows of gt.csv that speak of this log. unprocessed: those of them on frames that were
    not processed. between: those, matched by time, for which a nearer stamp has the frame.
    """

    row: IntArray
    landmark: IntArray
    visible: FloatArray
    position: FloatArray | None
    orientation: FloatArray | None
    rows: int
    unprocessed: int
    between: int


def read_truth(path: Path) -> TruthTable:
    """Read gt.csv (see HEADER). A header alone is good: no landmark anywhere.

    Raises SonarrecError on wrong columns, on a cell that cannot be meant and on a repeated row.
    """
    table = read_rows(path)
    wrong = (table.visible < 0) | (table.visible > 1)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise SonarrecError(
            f"{path} line {line_number(path, row)}: visible is the share of the disc in view, "
            f"0 to 1, not {table.visible[row]:g}"
        )
    repeated = repeated_rows(table)
    if len(repeated):
        first, second = repeated[0]
        raise SonarrecError(
            f"{path} line {line_number(path, second)}: repeats line {line_number(path, first)} "
            f"(same {table.key}, landmark and position); delete one of them"
        )
    return table


def read_rows(path: Path) -> TruthTable:
    """Read gt.csv as it is written: `visible` of any value, and rows that repeat others.

    Raises SonarrecError on wrong columns and on a cell that is no number.
    """
    kinds: dict[str, Kind] = {
        "frame": "whole",
        "timestamp_ns": "whole",
        "landmark": "whole",
        "visible": "blank or number",
        "orientation_deg": "blank or number",
        "log": "text",
    }
    table = read_table(path, kinds | POSITION_KINDS, ("landmark",), HEADER)
    key = "frame" if "frame" in table else "timestamp_ns"
    if key not in table:
        raise SonarrecError(
            f"{path}: wrong columns, neither frame nor timestamp_ns; "
            f"expected a header such as {HEADER}"
        )
    visible = table.get("visible", np.ones(len(table["landmark"])))
    visible = np.where(np.isnan(visible), 1.0, visible)
    position = position_pair(path, table)
    return TruthTable(
        path=path,
        key=key,
        at=table[key],
        landmark=table["landmark"],
        visible=visible,
        log=table.get("log"),
        position=position,
        orientation=table.get("orientation_deg"),
    )


def repeated_rows(table: TruthTable) -> IntArray:
    """(n, 2) pairs of rows that are the same, rising; (0, 2) where positions are not told.

    One ID may be in view twice, but not twice in one place.
    """
    if table.position is None:
        return np.empty((0, 2), dtype=np.int64)
    log = np.zeros(len(table.at)) if table.log is None else table.log.codes
    cells = (table.position[2], table.position[1], table.landmark, table.at, log)
    order = np.lexsort(cells)
    same = np.ones(max(len(order) - 1, 0), dtype=bool)
    for cell in cells:
        same &= np.diff(cell[order]) == 0
    first = np.flatnonzero(same)
    pairs = np.sort(np.column_stack([order[first], order[first + 1]]), axis=1)
    return np.asarray(pairs[np.argsort(pairs[:, 1])], dtype=np.int64)


def write_truth(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a new gt.csv. Raises SonarrecError where it exists or cannot be written.

    A file that a person may have corrected by hand is never written over.
    """
    try:
        with path.open("x", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(header)
            writer.writerows(rows)
    except FileExistsError:
        raise SonarrecError(
            f"{path}: exists already and is left as it is; choose another --out"
        ) from None
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be written ({error.strerror})") from None


class ReadLog(Protocol):
    """The frames of one log to which truth is matched; a LogResults is one.

    frame: (F,) numbers, rising. timestamp_ns: (F,) or None. fan: for positions in pixels.
    """

    @property
    def name(self) -> str: ...
    @property
    def landmarks(self) -> LandmarkSet: ...
    @property
    def fan(self) -> Fan | None: ...
    @property
    def frame(self) -> IntArray: ...
    @property
    def timestamp_ns(self) -> IntArray | None: ...


def match_truth(table: TruthTable, log: ReadLog, tolerance_s: float | None = None) -> Truth:
    """The truth of one log, cut to the frames in its frames.csv.

    By time, a row belongs to the frame nearest to it, if that is within the tolerance (default:
    half the median time between frames), and a frame takes the rows of its nearest stamp only:
    truth denser than the frames must not show one landmark many times.
    Raises SonarrecError on an ID outside the landmark set, or where times cannot be compared.
    """
    mine = np.ones(len(table.at), bool) if table.log is None else np.asarray(table.log == log.name)
    ids = np.asarray(log.landmarks.ids)
    known = np.isin(table.landmark, ids) | ~mine
    if not known.all():
        bad = int(np.argmin(known))
        raise SonarrecError(
            f"{table.path} line {line_number(table.path, bad)}: landmark {table.landmark[bad]} "
            f"is not in the set {log.landmarks.name!r} ({', '.join(map(str, ids))}) used for "
            f"{log.name}; name the right set with --landmarks"
        )
    at = table.at[mine]
    if table.key == "frame":
        row = np.minimum(np.searchsorted(log.frame, at), len(log.frame) - 1)
        matched = log.frame[row] == at
        kept = matched
    else:
        if log.timestamp_ns is None:
            raise SonarrecError(
                f"{table.path} tells frames by timestamp_ns, but the frames.csv of {log.name} has "
                "no such column; add it, or give the truth by frame"
            )
        row, matched, kept = match_times(log.timestamp_ns, at, tolerance_s)
    position = None
    if table.position is not None:
        position = plane_position(table.position, log.fan)
    by_id = np.argsort(ids)
    chosen = np.flatnonzero(mine)[kept]
    return Truth(
        row=row[kept],
        landmark=by_id[np.searchsorted(ids, table.landmark[chosen], sorter=by_id)],
        visible=table.visible[chosen],
        position=None if position is None else position[chosen],
        orientation=None if table.orientation is None else table.orientation[chosen],
        rows=len(at),
        unprocessed=int(np.count_nonzero(~matched)),
        between=int(np.count_nonzero(matched & ~kept)),
    )


def match_times(
    timestamp_ns: IntArray, at: IntArray, tolerance_s: float | None = None
) -> tuple[IntArray, BoolArray, BoolArray]:
    """Per time in `at`: (nearest frame, as index; within the tolerance; of its nearest stamp).

    timestamp_ns: (F,) of the frames. at: (R,) ns. tolerance_s: default half the median time
    between frames.
    """
    order = np.argsort(timestamp_ns, kind="stable")
    times = timestamp_ns[order]
    if tolerance_s is not None:
        tolerance = tolerance_s * 1e9
    else:
        tolerance = float(np.median(np.diff(times))) / 2 if len(times) > 1 else 0.0
    after = np.clip(np.searchsorted(times, at), 1, max(len(times) - 1, 1))
    if len(times) == 1:
        near = np.zeros(len(at), dtype=np.int64)
    else:
        near = np.where(times[after] - at < at - times[after - 1], after, after - 1)
    away = np.abs(times[near] - at)
    matched = away <= tolerance
    # Per frame the stamp that is nearest, the earlier of two equally near; all its rows stay.
    best = np.lexsort((at, away, near))
    firsts = best[np.unique(near[best], return_index=True)[1]] if len(at) else best
    stamp = np.zeros(len(times), dtype=np.int64)
    stamp[near[firsts]] = at[firsts]
    return order[near], matched, matched & (at == stamp[near])
