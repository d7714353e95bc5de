"""Draws the estimates of a method onto a fan image, and their probabilities below it.

These correspond to the paper's Figure 13 (frames) and Figure 14 (probabilities over time).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.drawing.pen import (
    TRUTH,
    UNNAMED,
    Colour,
    Pen,
    disc_outline,
    landmark_colours,
    pen_on,
    pixel_unit,
)
from sonarrec.landmarks import LandmarkSet
from sonarrec.sonar.frame import Estimate, Fan, is_date, time_text
from sonarrec.sonar.geometry import pixel_from_polar

AROUND = 1.15
"""Radius, in discs, at which truth is drawn, so that estimates do not hide it."""
SYMBOL, READ = 1.3, 1.45
"""Radii, in discs, at which the ID's symbol is drawn, and the one that was read."""
TRAIL_FRAMES = 20
STRIP_FRAMES = 120
"""How far back trails and the probability strip reach."""

_TICK_FRAMES = 20  # between ticks of the strip's time axis
_EQUAL = 1e-5  # probabilities that differ less are equal; tables have six digits


class Mark(NamedTuple):
    """A landmark of the ground truth, at (x_px, y_px) of the fan image."""

    landmark: int
    x_px: float
    y_px: float


@dataclass(frozen=True, slots=True)
class Moment:
    """The estimates of one method in one frame, with its number, time (ns) and stretch."""

    index: int
    timestamp_ns: int
    estimates: tuple[Estimate, ...]
    stretch: int = 0


def trails(history: Sequence[Moment]) -> dict[int, FloatArray]:
    """(n, 2) fan pixels, oldest first, where each object of the newest frame was in its stretch.

    Only of methods that follow objects: numbers of single-frame candidates say nothing.
    """
    newest = history[-1]
    latest = [m for m in history if newest.index - m.index <= TRAIL_FRAMES]
    latest = [m for m in latest if m.stretch == newest.stretch]
    known = [e for moment in latest for e in moment.estimates]
    numbers = [e.object for e in newest.estimates if e.followed]
    return {n: np.array([(e.x_px, e.y_px) for e in known if e.object == n]) for n in numbers}


def caption(estimate: Estimate, landmarks: LandmarkSet, *, score: bool = False) -> str:
    """What is written at an object: "ID.3  0.97", with "?" undeclared, "" for none of these.

    score: the number is the score, as in tables of results, in place of the probability.
    """
    number = estimate.score
    if not score:
        number = float(estimate.probabilities[landmarks.ids.index(estimate.landmark)])
    if estimate.declared:
        return f"ID.{estimate.landmark}  {number:.2f}"
    if not np.max(estimate.probabilities[:-1]) > estimate.probabilities[-1]:
        return ""  # of equal ones it is none of these
    return f"ID.{estimate.landmark}?  {number:.2f}"


def outline_of(estimate: Estimate, fan: Fan, landmarks: LandmarkSet) -> FloatArray:
    """(n, 2) column and row, in fan pixels, of a disc's edge or a plate's corners."""
    if estimate.corners is not None:
        return np.stack(pixel_from_polar(fan, *estimate.corners.T), axis=1)
    return disc_outline(fan, landmarks.radius_m, estimate.x_px, estimate.y_px)


def draw_frame(
    image: ByteImage,
    fan: Fan,
    landmarks: LandmarkSet,
    estimates: Sequence[Estimate],
    *,
    paths: Mapping[int, FloatArray] | None = None,
    truth: Sequence[Mark] = (),
    score: bool = False,
    marked: int | None = None,
) -> ByteImage:
    """The frame with an outline, ID and probability for every estimate: one method's (Figure 13).

    image: (fan.rows, fan.columns) uint8. estimates: declared ones in the ID's colour, others thin
    and grey. paths: as `trails` gives them. truth: dashed white. score: in place of probabilities.
    marked: number of an object whose outline is twice as thick as that of other declared ones.
    Returns (rows, columns, 3) uint8 BGR, both sides a whole factor of the fan's.
    """
    pen = pen_on(image, fan)
    colours = landmark_colours(landmarks.ids)
    # The declared last, on top of the others.
    for e in sorted(estimates, key=lambda e: (e.declared, e.score)):
        colour = colours[e.landmark] if e.declared else UNNAMED
        if paths and e.object in paths:
            pen.line(paths[e.object], colour, 1)
        outline = outline_of(e, fan, landmarks)
        width = 1 if not e.declared else 4 if e.object == marked else 2
        pen.line(outline, colour, width, closed=True)
        farthest = AROUND
        if e.declared and e.read and np.isfinite(e.orientation_deg):
            _draw_symbols(pen, e, fan, landmarks, colour)
            farthest = READ
        around = outline.mean(axis=0) + farthest * (outline - outline.mean(axis=0))
        pen.label(caption(e, landmarks, score=score), around, colour)
    for mark in truth:
        outline = disc_outline(fan, AROUND * landmarks.radius_m, mark.x_px, mark.y_px)
        pen.dashes(outline, TRUTH)
        pen.label(f"ID.{mark.landmark}", outline, TRUTH, below=True)
    return pen.canvas


def _draw_symbols(
    pen: Pen, estimate: Estimate, fan: Fan, landmarks: LandmarkSet, colour: Colour
) -> None:
    """Around a disc, arcs where the ID's symbol is lit, and outside these, white, where it was read
    to be lit."""
    steps = len(estimate.read)
    middle = (np.arange(steps) + 0.5) * 2 * np.pi / steps
    sight, orientation = np.radians([90 - estimate.bearing_deg, estimate.orientation_deg])
    code = landmarks.codes((middle + sight - orientation) % (2 * np.pi))
    read = np.frombuffer(estimate.read.encode(), np.uint8) - ord("0")
    rows = (
        (code[landmarks.ids.index(estimate.landmark)] > 0.5, SYMBOL, colour),
        (read > 4, READ, TRUTH),
    )
    for lit, radius, ink in rows:
        for first in middle[lit] - np.pi / steps + sight:
            arc = np.linspace(first, first + 2 * np.pi / steps, 4)
            radius_m = radius * landmarks.radius_m
            pen.line(disc_outline(fan, radius_m, estimate.x_px, estimate.y_px, arc), ink, 2)


def draw_strip(history: Sequence[Moment], landmarks: LandmarkSet, width: int) -> ByteImage:
    """The probability of each ID along every track, up to the newest frame (Figure 14).

    history: one method's results; of more than STRIP_FRAMES frames the last are shown, and the axis
    begins with the first frame that is shown. Lines are thick where an ID is declared; methods that
    do not follow objects give points.
    Returns (rows, width, 3) uint8 BGR.
    """
    unit, newest = pixel_unit(width), history[-1]
    colours = landmark_colours(landmarks.ids)
    left, right = 34 * unit, width - 10 * unit
    # A legend of many IDs takes more lines.
    per_line = max(1, int((right - left - 210 * unit) / (46 * unit)))
    top = (24 + 16 * ((len(colours) - 1) // per_line)) * unit
    bottom, step = top + 92 * unit, (right - left) / (STRIP_FRAMES - 1)
    pen = Pen(np.zeros((round(bottom + 24 * unit), width, 3), np.uint8), unit)
    for n, (landmark, colour) in enumerate(colours.items()):
        corner = (left + n % per_line * 46 * unit, (15 + 16 * (n // per_line)) * unit)
        pen.text(f"ID.{landmark}", corner, colour)
    title = f"frame {newest.index}  {_clock(newest.timestamp_ns)}"
    pen.text(title, (right, 15 * unit), UNNAMED, align_right=True)
    for share in (0.0, 0.5, 1.0):
        level = bottom - share * (bottom - top)
        pen.lines(np.array([[[left, level], [right, level]]]), (70, 70, 70), 1)
        pen.text(f"{share:g}", (6 * unit, level + 5 * unit), UNNAMED)
    latest = [m for m in history if newest.index - m.index < STRIP_FRAMES]
    first = latest[0].index
    for moment in latest:
        # A first frame between two ticks has its own one, unless it would cover the next one.
        if moment.index % _TICK_FRAMES == 0 or (
            moment.index == first and first % _TICK_FRAMES < _TICK_FRAMES / 2
        ):
            tick = left + (moment.index - first) * step
            text = _clock(moment.timestamp_ns, short=True)
            pen.note(text, (tick, bottom + 21 * unit), UNNAMED, centred=True)
            pen.lines(np.array([[[tick, bottom], [tick, bottom + 5 * unit]]]), UNNAMED, 1)
    scale = np.array([step, -(bottom - top)])
    for start, end, landmark, thick in _steps(latest, landmarks):
        lines = np.stack([start, end], axis=1) * scale + (left, bottom)
        pen.lines(lines, colours[landmark], 1 + thick)
    return pen.canvas


def _steps(
    history: Sequence[Moment], landmarks: LandmarkSet
) -> Iterator[tuple[FloatArray, FloatArray, int, bool]]:
    """Steps of the probability of each ID along every track, thin ones first.

    (begin, end, ID, whether it is declared): (n, 2) frames since the first, and probability. Left
    out are estimates in which all are equal, since nothing was read there.
    """
    # Sorted by track and time, each estimate is joined to the one before it on the same track.
    rows = [
        (moment.index, e)
        for moment in history
        for e in moment.estimates
        if np.ptp(e.probabilities) > _EQUAL
    ]
    rows.sort(key=lambda row: (row[1].object, row[0]))
    if not rows:
        return
    frame = np.array([index - history[0].index for index, _ in rows], dtype=float)
    track = np.array([e.object if e.followed else -1 for _, e in rows])
    named = np.array([e.landmark if e.declared else None for _, e in rows])
    beliefs = np.array([e.probabilities for _, e in rows])
    joined = np.append(False, (track[1:] == track[:-1]) & (track[1:] >= 0))
    before = np.arange(len(rows)) - joined
    start = np.where(joined, frame[before], frame - 0.5)
    for declared in (False, True):
        for k, landmark in enumerate(landmarks.ids):
            wanted = (named == landmark) == declared
            begin = np.column_stack([start, beliefs[before, k]])
            end = np.column_stack([frame, beliefs[:, k]])
            yield begin[wanted], end[wanted], landmark, declared


def _clock(timestamp_ns: int, *, short: bool = False) -> str:
    """The time of day if the time is a date, else seconds. short: for a tick of the axis."""
    if is_date(timestamp_ns):
        return time_text(timestamp_ns) if short else f"{time_text(timestamp_ns, 2)} UTC"
    return f"{timestamp_ns / 1e9:.{1 if short else 2}f} s"
