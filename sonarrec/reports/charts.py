"""The charts of the report: timelines, tracks and ROC curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import number_of
from sonarrec.evaluation.count import Scored
from sonarrec.evaluation.plots import roc as evaluation_roc
from sonarrec.reports.logs import ReportedLog, Track, alongside, true_landmark
from sonarrec.reports.svg import (
    MOST_POINTS,
    STYLES,
    UNIT,
    Axis,
    Chart,
    Dot,
    Shape,
    bars,
    frames_a_bar,
    polyline,
    thinned,
)

UNSEEN = 0.01  # a probability that stays below this along the whole track is not drawn


def time_axis(log: ReportedLog) -> tuple[Axis, float]:
    """The time axis of the whole log, and the median time between two frames."""
    period = float(np.median(np.diff(log.time))) if len(log.time) > 1 else 1.0
    return Axis(float(log.time[0]), float(log.time[-1]) + period), period


@dataclass(frozen=True, slots=True)
class Lane:
    """One row of a timeline: truth or a method, for one ID or one track."""

    name: str
    chart: Chart
    is_truth: bool


def timeline(log: ReportedLog) -> list[tuple[int, list[Lane]]]:
    """For each ID (index) that is in view or declared: rows of truth, the tracker, other methods.

    Bars mark frames in which the method declares the ID; their height is the score. In a long log a
    bar represents several frames: the best score is drawn faintly, and the mean over it, since the
    best alone would look the same for one frame of hundreds as for all.
    """
    results = log.results
    order = sorted(results.methods, key=lambda m: (m != log.tracker, results.methods.index(m)))
    axis, period = time_axis(log)
    rows = []
    for k in range(len(results.landmarks.ids)):
        declared = [
            log.of_method(method) & results.declared & (results.landmark_index == k)
            for method in order
        ]
        in_view = None if log.in_view is None else log.in_view[:, k]
        if (in_view is not None and in_view.any()) or any(map(np.any, declared)):
            lanes = []
            if in_view is not None:
                frames = f"{int(in_view.sum())} of {number_of(len(in_view), 'frame')}"
                bar = Shape(bars(axis, log.time, period, in_view.astype(float)), None, "bar")
                text = f"ID.{log.ids[k]} is in view in {frames}"
                lanes.append(Lane("truth", Chart(text, [bar]), True))
            lanes += [_method_lane(log, k, *pair) for pair in zip(order, declared, strict=True)]
            rows.append((k, lanes))
    return rows


def _method_lane(log: ReportedLog, k: int, method: str, declared: BoolArray) -> Lane:
    """The row of a method for the k-th ID. declared: (N,) its declarations of that ID."""
    results = log.results
    surest = np.zeros(len(results.frame))
    np.maximum.at(surest, results.frame_index[declared], results.score[declared])
    claims = len(np.unique(results.frame_index[declared]))
    axis, period = time_axis(log)
    shapes = [Shape(bars(axis, log.time, period, surest), k, "bar")]
    if frames_a_bar(len(log.time)) > 1:
        mean = bars(axis, log.time, period, surest, mean=True)
        shapes = [replace(shapes[0], kind="bar faint"), Shape(mean, k, "bar")]
    frames = number_of(len(surest), "frame")
    text = f"{method} declares ID.{log.ids[k]} in {claims} of {frames}"
    return Lane(method, Chart(text, shapes), False)


FOLLOWED = 0.15  # height of bars that show only that a track was followed
SILENT_POINTS = 100  # bars in the row of a track that was never declared


def silent_lanes(log: ReportedLog, silent: Sequence[Track]) -> list[Lane]:
    """A row per track that was never declared: low grey bars for the frames in which it was
    followed, and bars for the score of its most probable ID, in the colour of that ID."""
    axis, period = time_axis(log)
    results = log.results
    lanes = []
    for track in silent:
        followed = np.full(len(track.estimates), FOLLOWED)
        start = log.time[track.frame_index]
        shapes = [Shape(bars(axis, start, period, followed, SILENT_POINTS), None, "bar")]
        named = results.landmark_index[track.estimates]
        for k in np.unique(named).tolist():
            height = np.where(named == k, results.score[track.estimates], 0.0)
            path = bars(axis, start, period, height, SILENT_POINTS)
            shapes.append(Shape(path, k, "bar", f"ID.{results.landmarks.ids[k]}"))
        truth = true_landmark(log, track)
        best = float(results.score[track.estimates].max())
        frames = number_of(len(track.estimates), "frame")
        text = f"track {track.number}, {frames}, best score {best:.2f}"
        name = f"{track.number}" + ("" if truth is None else f" (on ID.{truth})")
        lanes.append(Lane(name, Chart(text, shapes), truth is not None))
    return lanes


def roc(scored: Sequence[Scored]) -> Chart:
    """The ROC of each method under one protocol, over all IDs."""
    curves = evaluation_roc(scored, 2 * MOST_POINTS)
    axis = Axis(0.0, curves.fpr_end)
    shapes = [
        Shape(polyline(axis.share(x.fpr), x.tpr), n, f"line style-{n % STYLES}", x.method)
        for n, x in enumerate(curves.lines)
    ]
    points = [(line.at, n, "dot") for n, line in enumerate(curves.lines)]
    marks = [*points, *((point, None, point.name) for point in curves.published)]
    dots = [
        Dot(100 * float(axis.share(point.fpr)), 100 * point.tpr, point.label, colour, kind)
        for point, colour, kind in marks
        if np.isfinite([point.fpr, point.tpr]).all()
    ]
    text = "; ".join(point.label for point, _, _ in marks)
    return Chart(text, shapes, axis.ticks(5), UNIT.ticks(5), dots, "FPR", "TPR")


@dataclass(frozen=True, slots=True)
class TrackPanel:
    """The probabilities of one method for one track, and its declarations."""

    method: str
    chart: Chart
    declared: Chart


def track_axis(log: ReportedLog, track: Track) -> Axis:
    """The time axis of a track, half a frame longer at both ends."""
    _, period = time_axis(log)
    time = log.time[track.frame_index]
    return Axis(float(time[0]) - period / 2, float(time[-1]) + period / 2)


def track_panels(log: ReportedLog, track: Track) -> list[TrackPanel]:
    """Probability over time for each method (the paper's Figure 14), the leading one first."""
    panels = []
    for method in log.results.methods:
        estimates = track.estimates if method == log.tracker else alongside(log, track, method)
        if (estimates >= 0).any():
            panels.append(_panel(log, track, method, estimates))
    return panels


def _panel(log: ReportedLog, track: Track, method: str, estimates: IntArray) -> TrackPanel:
    """The panel of a method. estimates: (n,) its one in each frame of the track, -1 for none."""
    results = log.results
    assert results.probability is not None
    axis = track_axis(log, track)
    _, period = time_axis(log)
    # One element per frame of the log, so that lines break where the object was not seen.
    rows = np.arange(track.frame_index[0], track.frame_index[-1] + 1)
    seen = estimates >= 0
    belief = np.full((len(rows), results.probability.shape[1]), np.nan)
    belief[track.frame_index[seen] - rows[0]] = results.probability[estimates[seen]]
    shapes, text = _probabilities(log, axis.share(log.time[rows]), belief)
    declared = []
    for k in range(len(log.ids)):
        claims = np.zeros(len(rows))
        mine = seen & results.declared[estimates] & (results.landmark_index[estimates] == k)
        claims[track.frame_index[mine] - rows[0]] = 1
        if mine.any():
            path = bars(axis, log.time[rows] - period / 2, period, claims)
            declared.append(Shape(path, k, "bar"))
    frames = number_of(int(seen.sum()), "frame")
    text = f"{method}, mean probability over {frames}: {text}"
    claims_chart = Chart(f"frames in which {method} declares an ID", declared)
    return TrackPanel(method, Chart(text, shapes, y_ticks=UNIT.ticks(2)), claims_chart)


def _probabilities(log: ReportedLog, x: FloatArray, belief: FloatArray) -> tuple[list[Shape], str]:
    """A line per ID and for "none", and their means as text. belief: (n, K + 1), NaN for a gap."""
    shapes, text = [], []
    for k in [len(log.ids), *range(len(log.ids))]:  # "none" first, so that IDs lie over it
        if np.nanmax(belief[:, k]) < UNSEEN:
            continue
        name, colour, kind = "none", None, "line thin"
        if k < len(log.ids):
            name, colour, kind = f"ID.{log.ids[k]}", k, "line"
        keep = thinned(belief[:, k])
        shapes.append(Shape(polyline(x[keep], belief[keep, k]), colour, kind, name))
        text.append(f"{name} {np.nanmean(belief[:, k]):.2f}")
    return shapes, ", ".join(text)


def truth_strip(log: ReportedLog, track: Track) -> Chart | None:
    """The true landmark beneath the track, frame by frame; None if not known."""
    if log.truth_near is None:
        return None
    axis = track_axis(log, track)
    _, period = time_axis(log)
    beneath = log.truth_near[track.estimates]
    start = log.time[track.frame_index] - period / 2
    shapes = [
        Shape(bars(axis, start, period, (beneath == k) * 1.0), k, "bar")
        for k in np.unique(beneath[beneath >= 0]).tolist()
    ]
    return Chart("the landmark that truly lies here", shapes)
