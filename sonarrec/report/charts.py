"""Charts as SVG paths and tick labels; colours, sizes and fonts are the style sheet's.

By hand: a chart library's SVG carries its own fonts, colours and size, ten times the bytes, or a
script, and the page has none.

Paths are drawn on a sheet of WIDTH x HEIGHT that the page stretches to any size, with strokes
that keep their width; tick labels are text beside it. So charts stay legible on any screen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from matplotlib.ticker import MaxNLocator

from sonarrec.drawing.pen import Colour
from sonarrec.evaluation.counting.pooled import PooledScored
from sonarrec.evaluation.counting.reliability import FEW, Reliability
from sonarrec.evaluation.roc import roc as evaluation_roc
from sonarrec.landmarks import LandmarkSet
from sonarrec.records import FloatArray, IntArray
from sonarrec.report.logs import ReportedLog, Track, alongside, true_landmark

WIDTH, HEIGHT = 2000, 1000
STYLES = 4
"""Line styles in the style sheet, which tell methods apart where one line covers another."""
MOST_POINTS = 400
"""Of one drawn line or row of bars: about one to three screen pixels each."""
UNSEEN = 0.01
"""A probability that stays below this all along a track is not drawn: it would lie on the axis."""


@dataclass(frozen=True, slots=True)
class Tick:
    """A label at a share (%) of the axis."""

    at: float
    text: str


@dataclass(frozen=True, slots=True)
class Shape:
    """One path of a chart. colour: index of the ID or method, None for neutral ink."""

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
    """One pair of axes. told: what it shows, in words, for those who cannot see it."""

    told: str
    shapes: list[Shape]
    x_ticks: list[Tick] = field(default_factory=list)
    y_ticks: list[Tick] = field(default_factory=list)
    dots: list[Dot] = field(default_factory=list)
    x_label: str = ""
    y_label: str = ""


@dataclass(frozen=True, slots=True)
class Axis:
    """Values from low to high, told as shares of the sheet."""

    low: float
    high: float

    def share(self, values: FloatArray | float) -> FloatArray:
        """0 at low, 1 at high."""
        return np.asarray((np.asarray(values, dtype=float) - self.low) / (self.high - self.low))

    def ticks(self, most: int = 6) -> list[Tick]:
        """Round values along the axis."""
        values = MaxNLocator(nbins=most, steps=[1, 2, 2.5, 5, 10]).tick_values(self.low, self.high)
        shares = self.share(np.asarray(values))
        inside = (shares > -1e-9) & (shares < 1 + 1e-9)
        return [
            Tick(round(100 * float(at), 2), f"{value:.12g}")
            for at, value in zip(shares[inside], np.asarray(values)[inside], strict=True)
        ]


UNIT = Axis(0.0, 1.0)


def polyline(x: FloatArray, y: FloatArray) -> str:
    """A path through points, shares of the sheet from the bottom left; it breaks at NaN."""
    drawn = np.isfinite(x) & np.isfinite(y)
    points = np.stack([np.where(drawn, x, 0), np.where(drawn, 1 - y, 0)], axis=1)
    at = np.rint(points * (WIDTH, HEIGHT)).astype(int)
    runs = np.split(np.arange(len(y)), np.flatnonzero(np.diff(drawn)) + 1)
    parts = []
    for run in runs:
        if len(run) and drawn[run[0]]:
            # A point alone is a line of no length: round caps make a dot of it.
            corners = at[run] if len(run) > 1 else at[[run[0], run[0]]]
            parts.append("M" + "L".join(f"{a} {b}" for a, b in corners.tolist()))
    return "".join(parts)


def thinned(y: FloatArray, most: int = MOST_POINTS) -> IntArray:
    """Indices of at most `most` values that keep every peak and dip: of each of `most` / 2 equal
    stretches the least and the greatest."""
    if len(y) <= most:
        return np.arange(len(y))
    size = -(-len(y) // (most // 2))
    padded = np.append(y, np.full(-len(y) % size, np.nan)).reshape(-1, size)
    low = np.argmin(np.where(np.isnan(padded), np.inf, padded), axis=1)
    high = np.argmax(np.where(np.isnan(padded), -np.inf, padded), axis=1)
    start = np.arange(len(padded)) * size
    return np.unique(np.concatenate([start + low, start + high]))


def frames_a_bar(frames: int, most: int = MOST_POINTS) -> int:
    """Of how many frames a bar of a row of `most` bars or fewer tells."""
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

    start: (n,) left edges, rising. height: (n,) 0 to 1. Where there are more than `most`,
    neighbours become one bar of the tallest one's height, or of their mean; neighbours of one
    height touch.
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
    right = np.maximum(right, left + 1)  # seen also where a long pause takes up the axis
    joins = np.zeros(len(first), dtype=bool)
    joins[1:] = (top[1:] == top[:-1]) & (left[1:] == right[:-1])
    begin = np.flatnonzero(~joins)
    end = np.append(begin[1:], len(first)) - 1
    return "".join(
        f"M{left[b]} {HEIGHT}v{-top[b]}h{right[e] - left[b]}v{top[b]}z"
        for b, e in zip(begin.tolist(), end.tolist(), strict=True)
        if top[b]
    )


def time_axis(log: ReportedLog) -> tuple[Axis, float]:
    """The whole log's axis, and the usual time between two frames."""
    period = float(np.median(np.diff(log.time))) if len(log.time) > 1 else 1.0
    return Axis(float(log.time[0]), float(log.time[-1]) + period), period


@dataclass(frozen=True, slots=True)
class Lane:
    """One row of a timeline: what truth or a method says of one ID, or of one track."""

    name: str
    chart: Chart
    is_truth: bool


def timeline(log: ReportedLog) -> list[tuple[int, list[Lane]]]:
    """Per ID (index) that is in view or declared anywhere: truth, the tracker, other methods.

    A bar stands where the method declares the ID; its height is the score. In a long log, where it
    tells of several frames, the best score is drawn faintly, and the mean over all of them on it:
    a bar of the best alone would look the same for one frame of hundreds as for all.
    """
    axis, period = time_axis(log)
    found = log.results
    order = sorted(found.methods, key=lambda m: (m != log.tracker, found.methods.index(m)))
    rows = []
    for k, landmark in enumerate(found.landmarks.ids):
        lanes = []
        anything = False
        if log.in_view is not None:
            there = log.in_view[:, k].astype(float)
            anything |= bool(there.any())
            told = f"ID.{landmark} is in view in {int(there.sum())} of {len(there)} frames"
            path = bars(axis, log.time, period, there)
            lanes.append(Lane("truth", Chart(told, [Shape(path, None, "bar")]), True))
        for method in order:
            mine = log.of_method(method) & found.declared & (found.landmark_index == k)
            surest = np.zeros(len(found.frame))
            np.maximum.at(surest, found.frame_index[mine], found.score[mine])
            claims = int(np.count_nonzero(np.bincount(found.frame_index[mine])))
            anything |= claims > 0
            told = f"{method} declares ID.{landmark} in {claims} of {len(surest)} frames"
            shapes = [Shape(bars(axis, log.time, period, surest), k, "bar")]
            if frames_a_bar(len(log.time)) > 1:
                mean = bars(axis, log.time, period, surest, mean=True)
                shapes = [replace(shapes[0], kind="bar faint"), Shape(mean, k, "bar")]
            lanes.append(Lane(method, Chart(told, shapes), False))
        if anything:
            rows.append((k, lanes))
    return rows


FOLLOWED = 0.15
"""Height of what tells only that a track was followed."""
SILENT_POINTS = 100
"""Of one track's row among those never declared."""


def silent_lanes(log: ReportedLog, silent: Sequence[Track]) -> list[Lane]:
    """A row per track that was never declared: a low grey bar where it was followed, and bars as
    high as the score of its best guess, in the colour of that ID."""
    axis, period = time_axis(log)
    found = log.results
    lanes = []
    for track in silent:
        followed = np.full(len(track.at), FOLLOWED)
        start = log.time[track.frame_index]
        shapes = [Shape(bars(axis, start, period, followed, SILENT_POINTS), None, "bar")]
        for k in np.unique(found.landmark_index[track.at]).tolist():
            height = np.where(found.landmark_index[track.at] == k, found.score[track.at], 0.0)
            path = bars(axis, start, period, height, SILENT_POINTS)
            shapes.append(Shape(path, k, "bar", f"ID.{found.landmarks.ids[k]}"))
        truth = true_landmark(log, track)
        best = float(found.score[track.at].max())
        told = f"track {track.number}, {len(track.at)} frames, best score {best:.2f}"
        name = f"{track.number}" + ("" if truth is None else f" (on ID.{truth})")
        lanes.append(Lane(name, Chart(told, shapes), truth is not None))
    return lanes


def roc(scored: Sequence[PooledScored], k: int | None = None) -> Chart:
    """The ROC of each method under one protocol: of the k-th ID, or over all IDs."""
    shown = evaluation_roc(scored, k, 2 * MOST_POINTS)
    axis = Axis(0.0, shown.fpr_end)
    shapes = [
        Shape(polyline(axis.share(x.fpr), x.tpr), n, f"line style-{n % STYLES}", x.method)
        for n, x in enumerate(shown.lines)
    ]
    points = [(line.at, n, "dot") for n, line in enumerate(shown.lines)]
    marks = [*points, *((point, None, point.name) for point in shown.published)]
    dots = [
        Dot(100 * float(axis.share(point.fpr)), 100 * point.tpr, point.label, colour, kind)
        for point, colour, kind in marks
        if np.isfinite([point.fpr, point.tpr]).all()
    ]
    told = "; ".join(point.label for point, _, _ in marks)
    return Chart(told, shapes, axis.ticks(5), UNIT.ticks(5), dots, "FPR", "TPR")


def reliability(found: Reliability, method: int) -> Chart:
    """How often what a method says is so, against how sure it says it is, over its estimates.

    method: index, for the colour. Bars: how many estimates there are in each step, against the
    fullest one. The line breaks at steps of fewer than FEW estimates: a share of so few says
    next to nothing; their dots are hollow.
    """
    step = 1 / len(found.count)
    share = found.count / max(1, int(found.count.max()))
    some = found.count > 0
    enough = found.count >= FEW
    told = [
        f"said {said:.2f}, so in {right:.2f} of {count}" + ("" if many else ", too few to tell")
        for said, right, count, many in zip(
            found.mean[some], found.right[some], found.count[some], enough[some], strict=True
        )
    ]
    ends = np.array([0.0, 1.0])
    shapes = [
        Shape(bars(UNIT, np.arange(len(share)) * step, step, share), None, "bar faint"),
        Shape(polyline(ends, ends), None, "line thin"),
        Shape(
            polyline(found.mean, np.where(enough, found.right, np.nan)), method, label=found.method
        ),
    ]
    dots = [
        Dot(100 * float(x), 100 * float(y), label, method, "dot" if many else "few")
        for x, y, label, many in zip(
            found.mean[some], found.right[some], told, enough[some], strict=True
        )
    ]
    return Chart(
        f"{found.method}: {'; '.join(told)}",
        shapes,
        UNIT.ticks(5),
        UNIT.ticks(5),
        dots,
        "probability stated",
        "share that was so",
    )


@dataclass(frozen=True, slots=True)
class TrackPanel:
    """The probabilities that one method gives one track's object, and what it declares."""

    method: str
    chart: Chart
    declared: Chart


def track_axis(log: ReportedLog, track: Track) -> Axis:
    """From the track's first frame to its last, half a frame more at both ends."""
    _, period = time_axis(log)
    time = log.time[track.frame_index]
    return Axis(float(time[0]) - period / 2, float(time[-1]) + period / 2)


def track_panels(log: ReportedLog, track: Track) -> list[TrackPanel]:
    """Probability over time (the paper's Figure 14), per method, the single-frame one first."""
    panels = []
    for method in log.results.methods:
        at = track.at if method == log.tracker else alongside(log, track, method)
        if (at >= 0).any():
            panels.append(_panel(log, track, method, at))
    return panels


def _panel(log: ReportedLog, track: Track, method: str, at: IntArray) -> TrackPanel:
    """at: (n,) the method's estimate in each of the track's frames, -1 for none."""
    found = log.results
    assert found.probability is not None
    axis = track_axis(log, track)
    _, period = time_axis(log)
    # One place per frame of the log, so that a line breaks where the object was not seen.
    rows = np.arange(track.frame_index[0], track.frame_index[-1] + 1)
    seen = at >= 0
    belief = np.full((len(rows), found.probability.shape[1]), np.nan)
    belief[track.frame_index[seen] - rows[0]] = found.probability[at[seen]]
    x = axis.share(log.time[rows])
    shapes, told = [], []
    for k in [belief.shape[1] - 1, *range(belief.shape[1] - 1)]:
        name = "none" if k == len(found.landmarks.ids) else f"ID.{found.landmarks.ids[k]}"
        if np.nanmax(belief[:, k]) < UNSEEN:
            continue
        keep = thinned(belief[:, k])
        colour = None if name == "none" else k
        kind = "line thin" if colour is None else "line"
        shapes.append(Shape(polyline(x[keep], belief[keep, k]), colour, kind, name))
        told.append(f"{name} {np.nanmean(belief[:, k]):.2f}")
    strip = []
    for k in range(len(found.landmarks.ids)):
        claims = np.zeros(len(rows))
        mine = seen.copy()
        mine[seen] = found.declared[at[seen]] & (found.landmark_index[at[seen]] == k)
        claims[track.frame_index[mine] - rows[0]] = 1
        if mine.any():
            strip.append(Shape(bars(axis, log.time[rows] - period / 2, period, claims), k, "bar"))
    count = int(seen.sum())
    return TrackPanel(
        method=method,
        chart=Chart(
            f"{method}, mean probability over {count} frames: {', '.join(told)}",
            shapes,
            y_ticks=UNIT.ticks(2),
        ),
        declared=Chart(f"frames in which {method} declares an ID", strip),
    )


def truth_strip(log: ReportedLog, track: Track) -> Chart | None:
    """Which landmark truly lies beneath the track, frame by frame; None where that is not known."""
    if log.truth_near is None:
        return None
    axis = track_axis(log, track)
    _, period = time_axis(log)
    beneath = log.truth_near[track.at]
    shapes = [
        Shape(
            bars(axis, log.time[track.frame_index] - period / 2, period, (beneath == k) * 1.0),
            k,
            "bar",
        )
        for k in np.unique(beneath[beneath >= 0]).tolist()
    ]
    return Chart("the landmark that truly lies here", shapes)


def glyph(landmarks: LandmarkSet, k: int) -> str:
    """A path that draws the k-th landmark, seen from above at orientation 0, on a 100 x 100 sheet.

    To be filled by the even-odd rule.
    """
    ring = "".join(_circle(share) for share in landmarks.ring)
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


def _circle(share: float) -> str:
    r = 49 * share
    return f"M{50 - r:g} 50a{r:g} {r:g} 0 1 0 {2 * r:g} 0a{r:g} {r:g} 0 1 0 {-2 * r:g} 0z"


def _wedge(begin: float, angle: float, inner: float, outer: float) -> str:
    """Counter-clockwise from `begin` (rad from the right), between two shares of the radius."""
    turn = np.array([begin, begin + angle])
    x, y = np.cos(turn), np.sin(turn)
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
