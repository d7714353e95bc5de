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

from sonarrec.records import BoolArray, FloatArray, IntArray

MOST_SIDE = 1024  # px; of larger pictures every second pixel is used, or every third, ...
BACKGROUND = 6.0  # grey levels about the background that hold no echo
SMEARED = 0.2  # of the fan's median level above the background: less may be an edge's
CLOSED = 7  # px; gaps in the fan up to this wide are speckle
LEAST_AREA = 0.1  # of the picture
LEAST_EDGE = 0.35  # length of either edge, in heights of the fan; of a disc less looks straight
LEAST_ROWS = 20  # that end on an edge
BESIDE = 0.2  # of its length: how far an edge may be from the ends of its side of the hull
ENDS = 0.05  # of an edge at either end that are left out: arcs begin there
ON_EDGE = 0.8  # least share of rows that end on the edge, within a pixel
TURNS = 8  # of the fit, each with less weight for what lies off the edge

Point = tuple[float, float]
"""(column, row)."""


@dataclass(frozen=True, slots=True)
class FanOutline:
    """The outline of a fan image, in pixels and degrees. near_px, far_px: distances of its ends
    from the apex, as far as there are echoes."""

    apex_column: float
    apex_row: float
    bearing_min_deg: float
    bearing_max_deg: float
    near_px: float
    far_px: float

    @property
    def view_deg(self) -> float:
        """The horizontal field of view, deg."""
        return self.bearing_max_deg - self.bearing_min_deg


def find_outline(picture: FloatArray) -> FanOutline | None:
    """The outline of the fan; None if the picture does not show two straight edges.

    picture: (rows, columns) grey levels, best the mean of some frames; far range on top.
    """
    step = math.ceil(max(picture.shape) / MOST_SIDE)
    lit = _lit(picture[::step, ::step])
    edges = _edges(lit)
    if edges is None:
        return None
    (left, left_at), (right, right_at) = edges
    if left - right < 1e-3:  # the edges do not meet below
        return None
    apex_row = (right_at - left_at) / (left - right)
    apex_column = left * apex_row + left_at
    some = np.flatnonzero(lit.any(axis=0))
    tops = lit.argmax(axis=0)[some]
    bottoms = len(lit) - 1 - lit[::-1].argmax(axis=0)[some]
    far = np.hypot(some - apex_column, tops - apex_row).max() + 0.5
    near = np.hypot(some - apex_column, bottoms - apex_row).min() - 0.5
    return FanOutline(
        apex_column=float(apex_column * step),
        apex_row=float(apex_row * step),
        bearing_min_deg=-math.degrees(math.atan(left)),
        bearing_max_deg=-math.degrees(math.atan(right)),
        near_px=float(near * step),
        far_px=float(far * step),
    )


def above_background(picture: FloatArray) -> FloatArray:
    """By how many grey levels each pixel differs from the commonest level, the background."""
    background = np.bincount(np.rint(picture).astype(int).ravel(), minlength=256).argmax()
    return np.asarray(np.abs(picture - background))


def _lit(picture: FloatArray) -> BoolArray:
    """(rows, columns) what differs from the background, without specks beside the fan."""
    above = above_background(picture)
    echoes = above > BACKGROUND
    # Codecs smear the edges: the brighter the fan, the farther.
    if echoes.any():
        echoes &= above > SMEARED * np.median(above[echoes])
    # Padded: else what lies near the picture's border would grow to it.
    padded = np.pad(echoes, CLOSED).astype(np.uint8)
    lit = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((CLOSED, CLOSED), np.uint8))
    count, labels, of_each, _ = cv2.connectedComponentsWithStats(lit)
    largest = 1 + int(of_each[1:, cv2.CC_STAT_AREA].argmax()) if count > 1 else -1
    return np.asarray(labels == largest)[CLOSED:-CLOSED, CLOSED:-CLOSED]


def _edges(lit: BoolArray) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """The left and the right edge, each as (slope, offset) of column = slope x row + offset."""
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
            edge = _line(some[of_side], ends_at[of_side] + 0.5 * outward)
            # Lines drawn across the edge may put the side beside it; the near arc's chord is a side
            # of which one end is far from where rows end.
            if edge is not None and all(
                abs(edge[0] * row + edge[1] - column) < BESIDE * length
                for column, row in (bottom, top)
            ):
                edges.append(edge)
                break
    return (edges[0], edges[1]) if len(edges) == 2 else None


def _sides(hull: np.ndarray, columns: int, outward: int) -> list[tuple[Point, Point]]:
    """(lower, upper end) of the hull's sides that may be the left (-1) or the right (1) edge, the
    longest first.

    They go outward as they go up, and do not run along the border of the picture.
    """
    border = CLOSED / 2
    middle = hull[:, 0].mean()
    sides = []
    corners = [(float(column), float(row)) for column, row in hull]
    for a, b in itertools.pairwise([*corners, corners[0]]):
        top, bottom = (a, b) if a[1] < b[1] else (b, a)
        beside = ((a[0] + b[0]) / 2 - middle) * outward > 0
        leans = (top[0] - bottom[0]) * outward >= 0
        cut = max(a[0], b[0]) < border or min(a[0], b[0]) > columns - 1 - border
        if beside and leans and not cut:
            sides.append((bottom, top))
    return sorted(sides, key=lambda side: -math.dist(*side))


def _line(row: IntArray, column: FloatArray) -> tuple[float, float] | None:
    """(slope, offset) of the line through most of the points; None if too many lie off it."""
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
