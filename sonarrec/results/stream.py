"""estimates.csv read back frame by frame, in memory that does not grow with the log."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import SonarrecError
from sonarrec.geometry import pixel_from_polar, polar_from_pixel
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Estimate, Fan
from sonarrec.results.columns import (
    CORNERS,
    ESTIMATES_HEADER,
    belief_names,
    chosen,
    estimate_columns,
    leading,
    needed,
)
from sonarrec.results.read import estimate_tables
from sonarrec.tables.read import POSITION_KINDS, Table, line_number, read_tables

ROWS = 500
"""Read at a time."""
SIGMAS = ("range_sigma_m", "bearing_sigma_deg", "orientation_sigma_deg")


def choose_method(path: Path, choice: str | None) -> str:
    """The method to show: the one wanted, else the leading one.

    A table without rows counts as having every method. Raises UsageError if the method is missing,
    SonarrecError if the table cannot be read.
    """
    tables = read_tables(
        path, {"method": "text"}, needed(estimate_columns(())), ESTIMATES_HEADER, ROWS
    )
    usual = choice or leading(())
    names: set[str] = set()
    for _, table in tables:
        names |= {str(name) for name in table["method"].unique()}
        if usual in names:
            return usual  # usually in the first rows
    if not names:
        return usual
    return chosen(names, [choice], path)[0] if choice is not None else leading(names)


def read_estimates(
    path: Path, method: str, landmarks: LandmarkSet, fan: Fan
) -> Iterator[tuple[int, tuple[Estimate, ...]]]:
    """(frame, its estimates by the method) for every frame that has any, in order.

    Values that other programs leave out are filled in: pixels from range and bearing or the other
    way round, probabilities from the score, the object by -1.
    Raises SonarrecError, with the line, for an invalid cell and for frames out of order.
    """

    def rows() -> Iterator[tuple[int, int, Estimate]]:
        """(row of the file, frame, estimate) of each row of the method."""
        for first, table in estimate_tables(path, landmarks, ROWS):
            of_method = np.flatnonzero(np.asarray(table["method"] == method))
            for row, frame, estimate in estimates_in(table, of_method, landmarks, fan):
                if math.isnan(estimate.x_px):
                    raise SonarrecError(
                        f"{path} line {line_number(path, first + row)}: no position: neither "
                        "x_px,y_px nor range_m,bearing_deg"
                    )
                yield first + row, frame, estimate

    last = -1
    for frame, group in groupby(rows(), key=lambda item: item[1]):
        items = list(group)
        if frame <= last:
            raise SonarrecError(
                f"{path} line {line_number(path, items[0][0])}: frame {frame} after frame {last}; "
                "sort the table by frame"
            )
        last = frame
        yield frame, tuple(estimate for _, _, estimate in items)


def estimates_in(
    table: Table, rows: IntArray, landmarks: LandmarkSet, fan: Fan | None
) -> Iterator[tuple[int, int, Estimate]]:
    """(row, frame, estimate) of some rows of a table; missing values are computed or NaN."""
    x_px, y_px, range_m, bearing_deg = positions(table, fan)
    names, count = table["method"].categories, len(table["frame"])
    methods = np.array([str(name) for name in names], dtype=object)[table["method"].codes]
    blank = np.full(count, np.nan)
    objects = table.get("object", np.full(count, -1))
    existence = np.nan_to_num(table.get("existence", blank), nan=1.0)
    # Where probabilities are missing they are the score and its complement.
    score, columns = table["score"], belief_names(landmarks.ids)
    beliefs = np.zeros((count, len(columns)))
    beliefs[np.arange(count), landmarks.indices(table["landmark"])] = score
    beliefs[:, -1] = 1 - score
    if all(name in table for name in columns):
        in_table = np.column_stack([table[name] for name in columns])
        whole = np.isfinite(in_table).all(axis=1)
        beliefs[whole] = in_table[whole]
    corners = np.stack([table.get(name, blank) for name in CORNERS], axis=1).reshape(-1, 4, 2)
    turn, *sigmas = (table.get(name, blank) for name in ("orientation_deg", *SIGMAS))
    for n in rows.tolist():
        estimate = Estimate(
            method=methods[n],
            object=int(objects[n]),
            x_px=float(x_px[n]),
            y_px=float(y_px[n]),
            range_m=float(range_m[n]),
            bearing_deg=float(bearing_deg[n]),
            orientation_deg=float(turn[n]),
            existence=float(existence[n]),
            probabilities=beliefs[n],
            landmark=int(table["landmark"][n]),
            score=float(score[n]),
            declared=bool(table["declared"][n]),
            range_sigma_m=float(sigmas[0][n]),
            bearing_sigma_deg=float(sigmas[1][n]),
            orientation_sigma_deg=float(sigmas[2][n]),
            corners=None if np.isnan(corners[n]).any() else corners[n],
        )
        yield n, int(table["frame"][n]), estimate


def positions(
    table: Table, fan: Fan | None
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """x_px, y_px, range_m and bearing_deg, (rows,) each; NaN if not known.

    If the table has only one of the two pairs, the fan gives the other.
    """
    blank = np.full(len(table["frame"]), np.nan)
    x_px, y_px, range_m, bearing_deg = (table.get(name, blank) for name in POSITION_KINDS)
    if fan is None:
        return x_px, y_px, range_m, bearing_deg
    in_pixels = np.isfinite(x_px) & np.isfinite(y_px)
    in_polar = np.isfinite(range_m) & np.isfinite(bearing_deg)
    pixels = pixel_from_polar(fan, range_m, bearing_deg)
    polar = polar_from_pixel(fan, x_px, y_px)
    return (
        np.where(in_pixels, x_px, pixels[0]),
        np.where(in_pixels, y_px, pixels[1]),
        np.where(in_polar, range_m, polar[0]),
        np.where(in_polar, bearing_deg, polar[1]),
    )
