"""The charts of the report: timelines, tracks, ROC curves and landmarks, as SVG paths.

Colours, sizes and fonts are set in the style sheet. The paths are written by hand because a chart
library's SVG brings its own fonts, colours and size, ten times the bytes, or a script, and the page
has none.

Paths are drawn on a sheet of WIDTH x HEIGHT that the page stretches to any size, with strokes that
keep their width. Tick labels are text outside the sheet, so charts stay legible on any screen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.drawing.pen import Colour
from sonarrec.errors import number_of
from sonarrec.evaluation.counts import Counts
from sonarrec.evaluation.plots import roc as evaluation_roc
from sonarrec.reports.logs import ReportedLog, Track, alongside

WIDTH, HEIGHT = 2000, 1000
STYLES = 4
"""Line styles in the style sheet. They distinguish methods where one line covers another."""
MOST_POINTS = 400
"""Points of a line, or bars in a row, at most: about one per one to three screen pixels."""
UNSEEN = 0.01  # a probability that stays below this along the whole track is not drawn


Tick = tuple[float, str]
"""A label on an axis: its position, % of the axis, and its text."""


class Shape(NamedTuple):
    """One path of a chart."""

    path: str
    colour: int | None
    """Index of the ID or method; None: grey."""
    kind: str = "line"
    label: str = ""


class Dot(NamedTuple):
    """A marked point, in % of the sheet from the left and from the bottom."""

    x: float
    y: float
    label: str
    colour: int | None
    kind: str = "dot"


class Chart(NamedTuple):
    """One chart."""

    description: str
    """What it shows, in words, for screen readers."""
    shapes: Sequence[Shape]
    x_ticks: Sequence[Tick] = ()
    y_ticks: Sequence[Tick] = ()
    dots: Sequence[Dot] = ()
    x_label: str = ""
    y_label: str = ""


Lane = tuple[str, Chart, bool]
"""One row of an ID's timeline: its name, and whether it is of the truth."""


class Axis(NamedTuple):
    """An axis from low to high; positions on it are shares of the sheet, 0 to 1."""

    low: float
    high: float

    def share(self, values: FloatArray | float) -> FloatArray:
        """Where values lie on the axis: 0 at low, 1 at high."""
        return np.asarray((np.asarray(values, dtype=float) - self.low) / (self.high - self.low))

    def ticks(self, most: int = 6) -> list[Tick]:
        """Round values along the axis, with at most so many steps between them."""
        decade = 10.0 ** math.floor(math.log10((self.high - self.low) / most))
        for step in decade * np.array([0.5, 1, 2, 2.5, 5, 10]):
            first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
            if last - first <= most:
                break
        values = step * np.arange(first, last + 1)
        shares = zip(self.share(values).tolist(), values.tolist(), strict=True)
        return [(round(100 * share, 2), f"{value:.12g}") for share, value in shares]


UNIT = Axis(0.0, 1.0)


def time_axis(log: ReportedLog) -> Axis:
    """The time axis of the whole log."""
    return Axis(float(log.time[0]), float(log.time[-1]) + log.period)


def track_axis(log: ReportedLog, track: Track) -> Axis:
    """The time axis of a track, half a frame longer at both ends."""
    time = log.time[track.frame_index]
    return Axis(float(time[0]) - log.period / 2, float(time[-1]) + log.period / 2)


def timeline(log: ReportedLog) -> list[tuple[int, list[Lane]]]:
    """For each ID (index) that is in view or declared: rows of truth, the tracker, other methods.

    Bars mark frames in which the method declares the ID; their height is the score. In a long log a
    bar represents several frames: the best score is drawn faintly, and the mean over it, since the
    best alone would look the same for one frame of hundreds as for all.
    """
    results, axis, rows = log.results, time_axis(log), []
    order = sorted(results.methods, key=lambda m: (m != log.tracker, results.methods.index(m)))
    for k, landmark in enumerate(log.ids):
        declared = results.declared & (results.landmark_index == k)
        lanes, seen = [], declared.any()
        if log.in_view is not None:
            in_view = log.in_view[:, k]
            seen |= in_view.any()
            frames = f"{int(in_view.sum())} of {number_of(len(in_view), 'frame')}"
            bar = Shape(bars(axis, log.time, log.period, in_view.astype(float)), None, "bar")
            lanes.append(("truth", Chart(f"ID.{landmark} is in view in {frames}", [bar]), True))
        for method in order:
            lanes.append(_method_lane(log, k, method, declared & log.of_method(method)))
        if seen:
            rows.append((k, lanes))
    return rows


def _method_lane(log: ReportedLog, k: int, method: str, declared: BoolArray) -> Lane:
    """The row of a method for the k-th ID. declared: (N,) its declarations of that ID."""
    results, axis = log.results, time_axis(log)
    surest = np.zeros(len(results.frame))
    np.maximum.at(surest, results.frame_index[declared], results.score[declared])
    shapes = [Shape(bars(axis, log.time, log.period, surest), k, "bar")]
    if frames_a_bar(len(log.time)) > 1:
        mean = bars(axis, log.time, log.period, surest, mean=True)
        shapes = [shapes[0]._replace(kind="bar faint"), Shape(mean, k, "bar")]
    claims = len(np.unique(results.frame_index[declared]))
    frames = number_of(len(surest), "frame")
    text = f"{method} declares ID.{log.ids[k]} in {claims} of {frames}"
    return method, Chart(text, shapes), False


def roc(counts: Counts, protocol: str) -> Chart:
    """The ROC of each method under one protocol, over all IDs."""
    curves = evaluation_roc(counts, protocol, 2 * MOST_POINTS)
    axis = Axis(0.0, curves.fpr_end)
    shapes = [
        Shape(polyline(axis.share(x["fpr"]), x["tpr"]), n, f"line style-{n % STYLES}", method)
        for n, (method, x) in enumerate(curves.lines.items())
    ]
    points = [(point, n, "dot") for n, point in enumerate(curves.points)]
    marks = [*points, *((point, None, point.name) for point in curves.published)]
    dots = [
        Dot(100 * float(axis.share(point.fpr)), 100 * point.tpr, point.label, colour, kind)
        for point, colour, kind in marks
        if np.isfinite([point.fpr, point.tpr]).all()
    ]
    text = "; ".join(point.label for point, _, _ in marks)
    return Chart(text, shapes, axis.ticks(5), UNIT.ticks(5), dots, "FPR", "TPR")


def track_panels(log: ReportedLog, track: Track) -> list[tuple[str, Chart, Chart]]:
    """Probability over time for each method (the paper's Figure 14), the leading one first, and the
    frames in which the method declares an ID."""
    panels = []
    for method in log.results.methods:
        estimates = track.estimates if method == log.tracker else alongside(log, track, method)
        if (estimates >= 0).any():
            panels.append((method, *_panel(log, track, method, estimates)))
    return panels


def _panel(log: ReportedLog, track: Track, method: str, estimates: IntArray) -> tuple[Chart, Chart]:
    """The charts of a method. estimates: (n,) its one in each frame of the track, -1 for none."""
    results, axis = log.results, track_axis(log, track)
    assert results.probability is not None
    # One element per frame of the log, so that lines break where the object was not seen.
    first, end = track.frame_index[[0, -1]] + [0, 1]
    time, seen = log.time[first:end], estimates >= 0
    index, estimates = track.frame_index[seen] - first, estimates[seen]
    belief = np.full((len(time), len(log.ids) + 1), np.nan)
    belief[index] = results.probability[estimates]
    shapes, means, declared = [], [], []
    # "none" first, so that IDs lie over it.
    for k, name in [(len(log.ids), "none"), *enumerate(f"ID.{i}" for i in log.ids)]:
        if np.nanmax(belief[:, k]) >= UNSEEN:
            keep, colour = thinned(belief[:, k]), k if k < len(log.ids) else None
            line = polyline(axis.share(time[keep]), belief[keep, k])
            shapes.append(Shape(line, colour, "line thin" if colour is None else "line", name))
            means.append(f"{name} {np.nanmean(belief[:, k]):.2f}")
        claimed = results.declared[estimates] & (results.landmark_index[estimates] == k)
        if claimed.any():
            claims = np.zeros(len(time))
            claims[index[claimed]] = 1
            path = bars(axis, time - log.period / 2, log.period, claims)
            declared.append(Shape(path, k, "bar"))
    frames = number_of(int(seen.sum()), "frame")
    text = f"{method}, mean probability over {frames}: {', '.join(means)}"
    claims_text = f"frames in which {method} declares an ID"
    return Chart(text, shapes, y_ticks=UNIT.ticks(2)), Chart(claims_text, declared)


def truth_strip(log: ReportedLog, track: Track) -> Chart | None:
    """The true landmark beneath the track, frame by frame; None if not known."""
    if log.truth_near is None:
        return None
    beneath = log.truth_near[track.estimates]
    axis, start = track_axis(log, track), log.time[track.frame_index] - log.period / 2
    shapes = [
        Shape(bars(axis, start, log.period, (beneath == k) * 1.0), k, "bar")
        for k in np.unique(beneath[beneath >= 0]).tolist()
    ]
    return Chart("the landmark that truly lies here", shapes)


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


def frames_a_bar(frames: int) -> int:
    """How many frames share a bar, in a row of at most MOST_POINTS bars."""
    return -(-frames // MOST_POINTS)


def bars(
    axis: Axis, start: FloatArray, width: float, height: FloatArray, *, mean: bool = False
) -> str:
    """A path of one bar per value above 0, from the bottom up.

    start: (n,) left edges, rising. height: (n,) 0 to 1. If there are more than
    MOST_POINTS, neighbours are drawn as one bar: as high as the tallest or, with `mean`, as their
    mean. Neighbouring bars of equal height become one shape.
    """
    size = frames_a_bar(len(start))
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
