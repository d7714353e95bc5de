"""estimates.csv read back frame by frame, in memory that does not grow with the log."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import numpy as np

from sonarrec.geometry import pixel_from_polar, polar_from_pixel
from sonarrec.landmarks import LandmarkSet
from sonarrec.records import Estimate, Fan, SonarrecError, UsageError

NEEDED = ("frame", "method", "landmark", "score", "declared")
_HEADER = "frame,method,object,x_px,y_px,landmark,score,declared"
_FLAGS = {"0": False, "1": True, "false": False, "true": True}
_Row = dict[str, str]


def choose_method(path: Path, wanted: str | None) -> str:
    """The method to show: the one wanted, else the framework's, else the only one there is.

    Raises UsageError where that leaves a choice open or the method is not there, SonarrecError
    where the table cannot be read. A table without rows has every method.
    """
    there = sorted({row["method"] for _, row in _rows(path)})
    if wanted is not None:
        if there and wanted not in there:
            raise UsageError(f"{path}: no method {wanted!r}; there is {', '.join(there)}")
        return wanted
    if "framework" in there or not there:
        return "framework"
    ours = [name for name in there if name.startswith("framework")] or there
    if len(ours) > 1:
        raise UsageError(f"{path}: choose one of the methods with --method: {', '.join(ours)}")
    return ours[0]


def read_estimates(
    path: Path, method: str, landmarks: LandmarkSet, fan: Fan
) -> Iterator[tuple[int, tuple[Estimate, ...]]]:
    """(frame, its estimates by the method) for every frame that has any, in the table's order.

    What other programs leave out is filled in: a missing place from range and bearing (or the
    other way round), missing probabilities from the score, a missing object by -1.
    Raises SonarrecError, with the line, on a cell that cannot be meant and on frames that fall.
    """
    mine = ((number, row) for number, row in _rows(path) if row["method"] == method)
    parsed = (_parsed(path, number, row, landmarks, fan) for number, row in mine)
    last = -1
    for frame, group in groupby(parsed, key=lambda item: item[1]):
        rows = list(group)
        if frame <= last:
            raise SonarrecError(
                f"{path} line {rows[0][0]}: frame {frame} after frame {last}; "
                "sort the table by frame"
            )
        last = frame
        yield frame, tuple(estimate for _, _, estimate in rows)


def _rows(path: Path) -> Iterator[tuple[int, _Row]]:
    """(line number, row) of the table."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            table = csv.DictReader(file, skipinitialspace=True, restval="")
            missing = [name for name in NEEDED if name not in (table.fieldnames or ())]
            if missing:
                raise SonarrecError(
                    f"{path}: wrong columns, no {', '.join(missing)}; "
                    f"expected a header such as {_HEADER}"
                )
            for row in table:
                yield table.line_num, row
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise SonarrecError(f"{path}: not a readable CSV table ({error})") from None


def _parsed(
    path: Path, number: int, row: _Row, landmarks: LandmarkSet, fan: Fan
) -> tuple[int, int, Estimate]:
    """(line number, frame, estimate)."""
    try:
        return number, _whole(row, "frame"), _estimate(row, landmarks, fan)
    except ValueError as error:
        raise SonarrecError(f"{path} line {number}: {error}") from None


def _estimate(row: _Row, landmarks: LandmarkSet, fan: Fan) -> Estimate:
    """Raises ValueError that says what is wrong with the row."""
    landmark, score = _whole(row, "landmark"), _number(row, "score")
    if landmark not in landmarks.ids:
        raise ValueError(
            f"landmark {landmark} is not in the set {landmarks.name!r} "
            f"({', '.join(map(str, landmarks.ids))}); name the set used with --landmarks"
        )
    if (declared := _FLAGS.get(row["declared"].strip().lower())) is None:
        raise ValueError(f"declared must be 0 or 1, not {row['declared']!r}")
    if row.get("x_px") and row.get("y_px"):
        x_px, y_px = _number(row, "x_px"), _number(row, "y_px")
        range_m, bearing_deg = (float(v) for v in polar_from_pixel(fan, x_px, y_px))
    elif row.get("range_m") and row.get("bearing_deg"):
        range_m, bearing_deg = _number(row, "range_m"), _number(row, "bearing_deg")
        x_px, y_px = (float(v) for v in pixel_from_polar(fan, range_m, bearing_deg))
    else:
        raise ValueError("no place: neither x_px,y_px nor range_m,bearing_deg")
    beliefs = [f"p_{i}" for i in landmarks.ids] + ["p_none"]
    if all(row.get(name) for name in beliefs):
        probabilities = np.array([_number(row, name) for name in beliefs])
    else:
        probabilities = np.zeros(len(beliefs))
        probabilities[landmarks.ids.index(landmark)] = score
        probabilities[-1] = 1 - score
    return Estimate(
        method=row["method"],
        object=_whole(row, "object") if row.get("object") else -1,
        x_px=x_px,
        y_px=y_px,
        range_m=range_m,
        bearing_deg=bearing_deg,
        orientation_deg=math.nan,
        existence=_number(row, "existence") if row.get("existence") else 1.0,
        probabilities=probabilities,
        landmark=landmark,
        score=score,
        declared=declared,
    )


def _whole(row: _Row, name: str) -> int:
    try:
        return int(row[name])
    except ValueError:
        raise ValueError(f"{name} must be a whole number, not {row[name]!r}") from None


def _number(row: _Row, name: str) -> float:
    try:
        value = float(row[name])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{name} must be a number, not {row[name]!r}")
    return value
