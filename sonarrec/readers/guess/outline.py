"""Finds the outline of the fan in a picture: where its apex is, how wide and how long it is.

Whoever exports pictures from a viewer often cannot say where the apex lies in them, and the usual
place holds only where the picture ends where the fan does.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, quantile

MOST_SIDE = 1024  # px; of larger pictures every second pixel is used, or every third, ...
BACKGROUND = 6.0  # grey levels about the background that hold no echo
SMEARED = 0.2  # of the fan's median level above the background: less may be an edge's
CLOSED = 7  # px; gaps in the fan up to this wide are speckle
AS_LARGE = 0.5  # least area of pieces, in that of the largest
LEAST_PIECE = 0.02  # of the picture: smaller ones would be many
LEAST_AREA = 0.1  # of the picture
LEAST_EDGE = 0.35  # length of either edge, in heights of the fan; of a disc less looks straight
LEAST_LEAN = 0.03  # columns outward a row; what is upright, a panel or the picture's border cuts
LEAST_ROWS = 40  # that end on an edge; in fewer a pixel makes too much of a difference
LEAST_COLUMNS = 20  # that end on an arc
BESIDE = 0.2  # of its length: how far an edge may be from the ends of its side of the hull
ENDS = 0.05  # of an edge at either end that are left out: arcs begin there
ON_EDGE = 0.8  # least share of rows that end on the edge, within a pixel
WITHIN = (2, 4, 6, 8)  # px; so far within an edge, but for dead beams, the fan is lit, ...
LIT = 0.4  # ... by this share of its median level: else it fades, and ends elsewhere
ROUND_PX = 4.0  # width of an arc; ...
ON_ARC = 0.5  # ... least share of columns that end on it, at one end of the fan
FEW = 0.05  # of columns: so many may end beyond the fan, on text
FADES = 0.3  # level beyond an end, of that within
TURNS = 8  # of the fit, each with less weight for what lies off the edge

Point = tuple[float, float]
"""(column, row)."""

Line = tuple[float, float]
"""(slope, offset) of column = slope x row + offset."""


@dataclass(frozen=True, slots=True)
class FanOutline:
    """The outline of a fan image, in pixels and degrees.

    near_px, far_px: distances of its ends from the apex; None for an end that does not show: one
    that fades, or that the picture's border or other things cut off.
    """

    apex_column: float
    apex_row: float
    bearing_min_deg: float
    bearing_max_deg: float
    near_px: float | None
    far_px: float | None

    @property
    def view_deg(self) -> float:
        """The horizontal field of view, deg."""
        return self.bearing_max_deg - self.bearing_min_deg

    @property
    def ends(self) -> str:
        """Where its ends are, for people."""
        if self.near_px is not None and self.far_px is not None:
            return f"its ends {self.near_px:.0f} and {self.far_px:.0f} px from there"
        if self.far_px is not None:
            return f"its far end {self.far_px:.0f} px from there, the near one dark or cut off"
        if self.near_px is not None:
            return f"its near end {self.near_px:.0f} px from there, the far one dark or cut off"
        return "its ends dark or cut off"


def find_outline(picture: FloatArray) -> FanOutline | None:
    """The outline of the fan; None if the picture does not show two straight edges, and an arc
    about the point where they meet. picture: (rows, columns) grey levels, best the mean of some
    frames; far range on top."""
    step = math.ceil(max(picture.shape) / MOST_SIDE)
    level, pieces = _pieces(picture[::step, ::step])
    if not pieces:
        return None
    # A shadow may cut it in pieces; else one of them is a panel beside it, or there are two fans.
    outline = _outline(level, np.any(pieces, axis=0), step)
    if outline is not None or len(pieces) == 1:
        return outline
    outlines = [one for piece in pieces if (one := _outline(level, piece, step)) is not None]
    return outlines[0] if len(outlines) == 1 else None


def _outline(level: FloatArray, lit: BoolArray, step: int) -> FanOutline | None:
    """As `find_outline`, of each step-th pixel. level, lit: as `_pieces` gives them."""
    edges = _edges(level, lit)
    if edges is None:
        return None
    (left, left_at), (right, right_at) = edges
    if left - right < 1e-3:  # the edges do not meet below
        return None
    apex_row = (right_at - left_at) / (left - right)
    apex = left * apex_row + left_at, apex_row
    far, far_is_round = _end(level, lit, edges, apex, 1)
    near, near_is_round = _end(level, lit, edges, apex, -1)
    if not (far_is_round or near_is_round):
        return None
    return FanOutline(
        apex_column=apex[0] * step,
        apex_row=apex[1] * step,
        bearing_min_deg=-math.degrees(math.atan(left)),
        bearing_max_deg=-math.degrees(math.atan(right)),
        near_px=None if near is None else near * step,
        far_px=None if far is None else far * step,
    )


def _end(
    level: FloatArray, lit: BoolArray, edges: tuple[Line, Line], apex: Point, outward: int
) -> tuple[float | None, bool]:
    """(distance of an end of the fan from the apex, px, whether it is an arc about it). The
    distance is None if something cuts the fan there, or if it fades. level, lit: as `_pieces` gives
    them. outward: 1 for the far end, -1 for the near one."""
    column = np.flatnonzero(lit.any(axis=0))
    row = (lit if outward > 0 else lit[::-1]).argmax(axis=0)[column]
    if outward < 0:
        row = len(lit) - 1 - row
    (left, left_at), (right, right_at) = edges
    inside = np.minimum(column - left * row - left_at, right * row + right_at - column)
    is_wide = bool(np.count_nonzero(inside > 2) >= LEAST_COLUMNS)
    column, row = (at[inside > (2 if is_wide else -2)] for at in (column, row))
    if not len(column):
        return None, False
    away = np.hypot(column - apex[0], row - apex[1])
    ordered = np.sort(outward * away)
    ends_on = np.searchsorted(ordered, ordered + ROUND_PX) - np.arange(len(ordered))
    is_round = is_wide and bool(ends_on.max() > ON_ARC * len(ordered))
    # A straight far end is the picture's border, or a bar. On the usual canvas the near end is
    # straight: the picture ends where its middle does.
    if outward > 0 and 2 * _spread(row) < _spread(away) > 1:
        return None, is_round
    most = quantile(ordered, 1 - FEW if is_wide else 1) + ROUND_PX
    end = outward * float(ordered[ordered <= most][-1]) + 0.5 * outward
    # Towards the bearings at which columns end, which are all bearings but those of the edges.
    across, along = (column - apex[0]) / away, (row - apex[1]) / away
    within, beyond = (
        np.mean(
            [
                _mean_level(level, apex[0] + at * across, apex[1] + at * along)
                for at in end + outward * np.arange(*span)
            ]
        )
        for span in ((-8, -2), (4, 10))
    )
    return (end if beyond <= FADES * within else None), is_round


def _spread(values: np.ndarray) -> float:
    """Width of the middle half of some values."""
    return float(quantile(values, 0.75) - quantile(values, 0.25))


def _mean_level(level: FloatArray, column: FloatArray, row: FloatArray) -> float:
    """Mean level at some points; 0 if they all lie outside of the picture."""
    column, row = np.rint(column).astype(int), np.rint(row).astype(int)
    is_in = (column >= 0) & (column < level.shape[1]) & (row >= 0) & (row < level.shape[0])
    return float(level[row[is_in], column[is_in]].mean()) if is_in.any() else 0.0


def above_background(picture: FloatArray) -> FloatArray:
    """By how many grey levels each pixel differs from the commonest level, the background."""
    background = np.bincount(np.rint(picture).astype(int).ravel(), minlength=256).argmax()
    return np.asarray(np.abs(picture - background))


def _pieces(picture: FloatArray) -> tuple[FloatArray, list[BoolArray]]:
    """How much pixels differ from the background, in medians of what differs at all; and whether
    they belong to each of the largest pieces of what does: all arrays of (rows, columns)."""
    above = above_background(picture)
    echoes = above > BACKGROUND
    median = float(quantile(above[echoes], 0.5)) if echoes.any() else 1.0
    # Codecs smear the edges: the brighter the fan, the farther.
    echoes &= above > SMEARED * median
    # Padded: else what lies near the picture's border would grow to it.
    padded = np.pad(echoes, CLOSED).astype(np.uint8)
    lit = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((CLOSED, CLOSED), np.uint8))
    _, labels, of_each, _ = cv2.connectedComponentsWithStats(lit)
    labels = labels[CLOSED:-CLOSED, CLOSED:-CLOSED]
    areas = of_each[:, cv2.CC_STAT_AREA]
    areas[0] = 0  # the background
    least = max(AS_LARGE * areas.max(), LEAST_PIECE * picture.size)
    return above / median, [np.asarray(labels == piece) for piece in np.flatnonzero(areas > least)]


def _edges(level: FloatArray, lit: BoolArray) -> tuple[Line, Line] | None:
    """The left and the right edge. None if they do not show. level, lit: as `_pieces` gives
    them."""
    if lit.mean() < LEAST_AREA:
        return None
    columns = lit.shape[1]
    some = np.flatnonzero(lit.any(axis=1))
    first = lit.argmax(axis=1)[some]
    last = columns - 1 - lit[:, ::-1].argmax(axis=1)[some]
    ends = np.concatenate([np.stack([first, some], 1), np.stack([last, some], 1)])
    hull = cv2.approxPolyDP(cv2.convexHull(ends.astype(np.int32)), CLOSED / 2, closed=True)[:, 0]
    edges = []
    for outward, ends_at in ((-1, first), (1, last)):
        for bottom, top in _sides(hull, columns, outward):
            length = math.dist(bottom, top)
            if length < LEAST_EDGE * len(some):
                return None
            margin = ENDS * (bottom[1] - top[1])
            of_side = (some >= top[1] + margin) & (some <= bottom[1] - margin)
            row = some[of_side].astype(float)
            edge = _line(row, ends_at[of_side] + 0.5 * outward)
            if edge is None:
                continue
            slope, offset = edge
            within = (_mean_level(level, slope * row + offset - outward * px, row) for px in WITHIN)
            if sum(within) < LIT * len(WITHIN):
                return None
            # Lines drawn across the edge may put the side beside it; the near arc's chord is a side
            # of which one end is far from where rows end.
            if all(
                abs(slope * at + offset - column) < BESIDE * length for column, at in (bottom, top)
            ):
                edges.append(edge)
                break
    return (edges[0], edges[1]) if len(edges) == 2 else None


def _sides(hull: np.ndarray, columns: int, outward: int) -> list[tuple[Point, Point]]:
    """(lower, upper end) of the hull's sides that may be the left (-1) or the right (1) edge, the
    longest first. They go outward as they go up, and do not run along the border of the picture, or
    of a panel."""
    border = CLOSED / 2
    middle = hull[:, 0].mean()
    sides = []
    corners = [(float(column), float(row)) for column, row in hull]
    for a, b in itertools.pairwise([*corners, corners[0]]):
        top, bottom = (a, b) if a[1] < b[1] else (b, a)
        beside = ((a[0] + b[0]) / 2 - middle) * outward > 0
        leans = (top[0] - bottom[0]) * outward > LEAST_LEAN * (bottom[1] - top[1])
        cut = max(a[0], b[0]) < border or min(a[0], b[0]) > columns - 1 - border
        if beside and leans and not cut:
            sides.append((bottom, top))
    return sorted(sides, key=lambda side: -math.dist(*side))


def _line(row: FloatArray, column: FloatArray) -> Line | None:
    """The line through most of the points; None if too many lie off it."""
    if len(row) < LEAST_ROWS:
        return None
    weight = np.ones(len(row))
    for _ in range(TURNS):
        slope, offset = np.polyfit(row, column, 1, w=weight)
        away = np.abs(column - (slope * row + offset))
        weight = 1 / np.maximum(1, away)
    if np.mean(away <= 1 + abs(slope)) < ON_EDGE:
        return None
    return float(slope), float(offset)
