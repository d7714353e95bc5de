"""Parts of charts as SVG paths and tick labels: axes, lines, bars, landmarks, colours.

Colours, sizes and fonts are set in the style sheet. The paths are written by hand because a chart
library's SVG brings its own fonts, colours and size, ten times the bytes, or a script, and the page
has none.

Paths are drawn on a sheet of WIDTH x HEIGHT that the page stretches to any size, with strokes that
keep their width. Tick labels are text beside the sheet, so charts stay legible on any screen.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from matplotlib.ticker import MaxNLocator

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.drawing.pen import Colour
from sonarrec.landmarks import DrawnSet, LandmarkSet

WIDTH, HEIGHT = 2000, 1000
STYLES = 4
"""Line styles in the style sheet. They tell methods apart where one line covers another."""
MOST_POINTS = 400
"""Points of a line, or bars in a row, at most: about one per one to three screen pixels."""


@dataclass(frozen=True, slots=True)
class Tick:
    """A label on an axis; at: its position, % of the axis."""

    at: float
    text: str


@dataclass(frozen=True, slots=True)
class Shape:
    """One path of a chart. colour: index of the ID or method; None: grey."""

    path: str
    colour: int | None
    kind: str = "line"
    label: str = ""


@dataclass(frozen=True, slots=True)
class Dot:
    """A marked point, in % of the sheet from the left and from the bottom."""

    x: float
    y: float
    label: str
    colour: int | None
    kind: str = "dot"


@dataclass(frozen=True, slots=True)
class Chart:
    """One chart. description: what it shows, in words, for screen readers."""

    description: str
    shapes: list[Shape]
    x_ticks: list[Tick] = field(default_factory=list)
    y_ticks: list[Tick] = field(default_factory=list)
    dots: list[Dot] = field(default_factory=list)
    x_label: str = ""
    y_label: str = ""


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis from low to high; positions on it are shares of the sheet, 0 to 1."""

    low: float
    high: float

    def share(self, values: FloatArray | float) -> FloatArray:
        """Where values lie on the axis: 0 at low, 1 at high."""
        return np.asarray((np.asarray(values, dtype=float) - self.low) / (self.high - self.low))

    def ticks(self, most: int = 6) -> list[Tick]:
        """Round values along the axis."""
        values = MaxNLocator(nbins=most, steps=[1, 2, 2.5, 5, 10]).tick_values(self.low, self.high)
        shares = self.share(np.asarray(values))
        inside = (shares > -1e-9) & (shares < 1 + 1e-9)
        return [
            Tick(round(100 * float(share), 2), f"{value:.12g}")
            for share, value in zip(shares[inside], np.asarray(values)[inside], strict=True)
        ]


UNIT = Axis(0.0, 1.0)


def polyline(x: FloatArray, y: FloatArray) -> str:
    """A path through points given as shares of the sheet from the bottom left; NaN breaks it."""
    drawn = np.isfinite(x) & np.isfinite(y)
    points = np.stack([np.where(drawn, x, 0), np.where(drawn, 1 - y, 0)], axis=1)
    pixels = np.rint(points * (WIDTH, HEIGHT)).astype(int)
    runs = np.split(np.arange(len(y)), np.flatnonzero(np.diff(drawn)) + 1)
    parts = []
    for run in runs:
        if len(run) and drawn[run[0]]:
            # A point alone is a line of no length: round caps make a dot of it.
            corners = pixels[run] if len(run) > 1 else pixels[[run[0], run[0]]]
            parts.append("M" + "L".join(f"{a} {b}" for a, b in corners.tolist()))
    return "".join(parts)


def thinned(y: FloatArray, most: int = MOST_POINTS) -> IntArray:
    """Indices of at most `most` values that keep every peak and dip.

    They are the least and the greatest value of each of `most` / 2 equal stretches.
    """
    if len(y) <= most:
        return np.arange(len(y))
    size = -(-len(y) // (most // 2))
    padded = np.append(y, np.full(-len(y) % size, np.nan)).reshape(-1, size)
    low = np.argmin(np.where(np.isnan(padded), np.inf, padded), axis=1)
    high = np.argmax(np.where(np.isnan(padded), -np.inf, padded), axis=1)
    start = np.arange(len(padded)) * size
    return np.unique(np.concatenate([start + low, start + high]))


def frames_a_bar(frames: int, most: int = MOST_POINTS) -> int:
    """How many frames share a bar, in a row of at most `most` bars."""
    return -(-frames // most)


def bars(
    axis: Axis,
    start: FloatArray,
    width: float,
    height: FloatArray,
    most: int = MOST_POINTS,
    *,
    mean: bool = False,
) -> str:
    """A path of one bar per value above 0, from the bottom up.

    start: (n,) left edges, rising. height: (n,) 0 to 1. If there are more than `most`,
    neighbours are drawn as one bar: as high as the tallest or, with `mean`, as their mean.
    Neighbouring bars of equal height become one shape.
    """
    size = frames_a_bar(len(start), most)
    first = np.arange(0, len(start), size)
    last = np.minimum(first + size, len(start)) - 1
    if mean:
        tall = np.add.reduceat(height, first) / (last + 1 - first)
    else:
        tall = np.maximum.reduceat(height, first)
    top = np.rint(tall * HEIGHT).astype(int)
    left = np.minimum(np.rint(axis.share(start[first]) * WIDTH).astype(int), WIDTH - 1)
    right = np.append(start[1:], np.inf)[last]
    right = np.rint(axis.share(np.minimum(right, start[last] + width)) * WIDTH).astype(int)
    right = np.maximum(right, left + 1)  # visible even if a long pause takes up the axis
    joins = np.zeros(len(first), dtype=bool)
    joins[1:] = (top[1:] == top[:-1]) & (left[1:] == right[:-1])
    begin = np.flatnonzero(~joins)
    end = np.append(begin[1:], len(first)) - 1
    return "".join(
        f"M{left[b]} {HEIGHT}v{-top[b]}h{right[e] - left[b]}v{top[b]}z"
        for b, e in zip(begin.tolist(), end.tolist(), strict=True)
        if top[b]
    )


def glyph(landmarks: LandmarkSet, k: int) -> str:
    """A path that draws the k-th landmark, seen from above at orientation 0, on a 100 x 100 sheet.

    To be filled by the even-odd rule.
    """
    if isinstance(landmarks, DrawnSet):
        drawing = landmarks.drawings()[k]
        side = 98 / len(drawing)
        square = f"h{side:g}v{side:g}h{-side:g}z"
        cells = np.argwhere(drawing).tolist()
        return "".join(f"M{1 + c * side:g} {1 + r * side:g}{square}" for r, c in cells)
    ring = "".join(
        f"M{50 - r:g} 50a{r:g} {r:g} 0 1 0 {2 * r:g} 0a{r:g} {r:g} 0 1 0 {-2 * r:g} 0z"
        for r in (49 * share for share in landmarks.ring)
    )
    inner, outer = landmarks.symbol
    sectors = landmarks.sectors[k]
    step = 2 * np.pi / len(sectors)
    return ring + "".join(
        # In halves: an arc from a point to itself would be no arc.
        _wedge(n * step + half * step / 2, step / 2, inner, outer)
        for n, bright in enumerate(sectors)
        for half in range(2)
        if bright
    )


def _wedge(begin: float, angle: float, inner: float, outer: float) -> str:
    """Counter-clockwise from `begin` (rad from the right), between two shares of the radius."""
    angles = np.array([begin, begin + angle])
    x, y = np.cos(angles), np.sin(angles)
    (ax, bx), (ay, by) = 50 + 49 * outer * x, 50 - 49 * outer * y
    (cx, dx), (cy, dy) = 50 + 49 * inner * x, 50 - 49 * inner * y
    big, small = 49 * outer, 49 * inner
    return (
        f"M{ax:.1f} {ay:.1f}A{big:.1f} {big:.1f} 0 0 0 {bx:.1f} {by:.1f}"
        f"L{dx:.1f} {dy:.1f}A{small:.1f} {small:.1f} 0 0 1 {cx:.1f} {cy:.1f}z"
    )


def darkened(colour: Colour) -> str:
    """The colour, in hexadecimal, as dark as it has to be to stand out on white.

    The overlay's colours are made for black. Its hue stays; its luminance (WCAG 2) falls to what
    gives a contrast of 3.1 to 1, where 3 is asked of what is drawn.
    """
    share = np.array(colour) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    luminance = float(linear @ (0.2126, 0.7152, 0.0722))
    linear = linear * min(1.0, (1.05 / 3.1 - 0.05) / max(luminance, 1e-9))
    share = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return "#{:02x}{:02x}{:02x}".format(*np.rint(255 * share).astype(int).tolist())
