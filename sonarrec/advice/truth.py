"""What may be wrong with a truth as a whole."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import Advice, listed
from sonarrec.evaluation.rows import equal_pairs
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import (
    ground_range,
    in_image,
    pixel_from_polar,
    plane_from_polar,
    polar_from_plane,
)
from sonarrec.truth.check import SLACK, outside_of_log
from sonarrec.truth.match import ReadLog, Truth, share_in_image
from sonarrec.truth.table import TruthTable

MOST_DIFFERENCE_PX = 3.0  # of two statements of one position by one geometry
MOST_FRAMES = 3  # named in a note
MOST_OUTSIDE = 0.1  # of positions; more are no slips
MOST_ADJACENT = 0.1  # of the steps between labelled frames, if every n-th is labelled
FEWEST = 5  # so many frames at least for a note on a pattern in them


def of_truth(table: TruthTable, log: ReadLog, truth: Truth, min_visible: float) -> Iterator[Advice]:
    """On the truth of one log that is scored. truth: as matched to all frames of the log.

    min_visible: from which share in view a landmark counts.
    """
    path, name = table.path, log.name
    if proposed := unchecked(table, name):
        yield Advice(f"{proposed}; they say nothing about the results that they came from", True)
    if len(truth.visible) and (most := truth.visible.max()) < min_visible:
        yield Advice(
            f"{path}: `visible` is {most:.2g} at most in all rows on {name}, and counts from "
            f"{min_visible:g}, so that no landmark is ever in view; check positions and units",
            grave=True,
        )
    if other := of_another_geometry(table, table.rows_of(name), log.fan, name):
        yield Advice(f"{path}: {other}", grave=True)


def unread_columns(table: TruthTable) -> str:
    """The columns that are not read and may have been meant to be; empty: none.

    Without positions these are all that have no meaning.
    """
    unread = [(name, near) for name, near in table.unread if near or table.position is None]
    if not unread:
        return ""
    names = ", ".join(name for name, _ in unread)
    near = ", ".join(dict.fromkeys(near for _, near in unread if near))
    asked = f"; rename to {near}" if near else ""
    if not near and table.position is None:
        asked = "; positions are read from x_px and y_px, or range_m and bearing_deg"
    return f"{table.path}: {'columns' if unread[1:] else 'column'} {names} not read{asked}"


def unchecked(table: TruthTable, name: str) -> str:
    """How many rows for a log are as `truth propose` wrote them, a clause; empty: none."""
    rows = table.rows_of(name)
    if not (proposed := np.count_nonzero(table.proposed[rows])):
        return ""
    return (
        f"{table.path}: {proposed} of {len(rows)} rows for {name} are unchecked proposals of "
        "`truth propose` (check them with `truth review`, or clear `source`)"
    )


def of_positions(
    table: TruthTable, log: ReadLog, truth: Truth, check: str = "", min_visible: float | None = None
) -> Iterator[Advice]:
    """On positions on one log that lie outside of its image; grave if many do. If only few do, also
    on rows that count as missed without need.

    truth: as matched to the log. check: the command that checks the truth of this log. min_visible:
    from which share in view a landmark counts; None: no row counts as missed.
    """
    beyond = outside_of_log(log, truth)
    wrong = {f"lie outside the image of {log.name}": beyond}
    many = bool(np.sum(beyond) > MOST_OUTSIDE * len(beyond))
    if min_visible is not None and not many:
        wrong |= _counted_as_missed(log, truth, beyond, min_visible)
    for what, rows in wrong.items():
        if rows.any():
            frames = log.frame[np.unique(truth.frame_index[rows])].tolist()
            where = f"{'frames' if frames[1:] else 'frame'} {listed(frames, MOST_FRAMES)}"
            how = f"; {check} has their lines" if check else ""
            text = f"{np.sum(rows)} of {len(rows)} positions {what}, in {where}{how}"
            yield Advice(f"{table.path}: {text}", grave=many)


def _counted_as_missed(
    log: ReadLog, truth: Truth, beyond: BoolArray, min_visible: float
) -> dict[str, BoolArray]:
    """(T,) which rows count as missed without need, by what is wrong with them: the image's edge
    cuts their discs but `visible` counts (1 where it is not stated), or they lie on another row.

    beyond: (T,) which discs lie outside of the image, see above.
    """
    if log.fan is None or truth.position is None:
        return {}
    (range_m, bearing_deg), radius_m = polar_from_plane(truth.position), log.landmarks.radius_m
    floor = floor_position(log.fan, range_m, bearing_deg)
    # Shares are slow, so only where a side of the disc is not in the image.
    side_deg = np.degrees(np.arctan2(radius_m, np.linalg.norm(floor, axis=1)))
    sides = product((-radius_m, radius_m), (-side_deg, side_deg))
    inner = [in_image(log.fan, range_m + far, bearing_deg + right) for far, right in sides]
    edge = np.flatnonzero(~np.all(inner, axis=0) & ~beyond & (truth.visible >= min_visible))
    share = share_in_image(log.fan, range_m[edge], bearing_deg[edge], radius_m)
    cut, double = np.zeros((2, len(beyond)), bool)
    cut[edge] = (share < min_visible) & (truth.visible[edge] > share + SLACK)
    first, later = equal_pairs(truth.frame_index, truth.frame_index)
    near = np.linalg.norm(floor[first] - floor[later], axis=1) < radius_m
    double[later[near & (first < later)]] = True
    return {
        f"have less than {min_visible:g} of the disc in the image of {log.name} but no `visible` "
        "that says so, and count as missed": cut,
        f"lie on another row of {log.name}, and one of the two counts as missed": double,
    }


def floor_position(fan: Fan, range_m: FloatArray, bearing_deg: FloatArray) -> FloatArray:
    """(n, 2) m on the floor, to the right and ahead; nearer than the floor is straight below."""
    return plane_from_polar(np.nan_to_num(ground_range(fan, range_m)), bearing_deg)


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
    difference_px, exchanged_px = (
        np.linalg.norm(pixel - stated, axis=1)
        for pixel in (table.pixel[rows], table.pixel[rows, ::-1])
    )
    difference_px = difference_px[np.isfinite(difference_px)]
    wrong = np.sum(difference_px > MOST_DIFFERENCE_PX)
    if wrong <= len(difference_px) / 2:
        return ""
    if np.nanmedian(exchanged_px) <= MOST_DIFFERENCE_PX:
        return (
            f"x_px and y_px are exchanged, as range_m and bearing_deg tell in {name}; rename them"
        )
    factor = float(np.nanmedian(stated / table.pixel[rows]))
    scaled_px = np.linalg.norm(factor * table.pixel[rows] - stated, axis=1)
    if np.nanmedian(scaled_px) <= MOST_DIFFERENCE_PX:
        return (
            f"x_px and y_px would have to be {factor:.3g} times as large to agree with range_m and "
            f"bearing_deg in {name}; were they measured in pictures of another size?"
        )
    return (
        f"{wrong} of {len(difference_px)} rows have x_px, y_px and range_m, bearing_deg that "
        f"differ by more than {MOST_DIFFERENCE_PX:g} px in {name} (median "
        f"{np.median(difference_px):.0f} px); the truth seems to be of another log or geometry"
    )
