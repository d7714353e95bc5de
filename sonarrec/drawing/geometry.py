"""Draws the stated geometry onto a fan image: rings, bearings, the floor's near edge, discs."""

from __future__ import annotations

import math

import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.drawing.pen import (
    FLOOR,
    GRID,
    TRUTH,
    Pen,
    disc_outline,
    draw_picture,
    pen_on,
    pixel_unit,
)
from sonarrec.landmarks import LandmarkSet
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import floor_depth, pixel_from_polar
from sonarrec.sonar.stated import Sonar


def nice_steps(low: float, high: float, about: int) -> FloatArray:
    """(n,) round numbers within low to high, `about` of them: multiples of 1, 2 or 5."""
    wanted = (high - low) / about
    power = 10.0 ** math.floor(math.log10(wanted))
    step = min((n * power for n in (1, 2, 5, 10)), key=lambda nice: abs(math.log(nice / wanted)))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return np.arange(first, last + 1) * step


def draw_grid(pen: Pen, fan: Fan) -> None:
    """The stated fan's outline, range rings and bearings, each labelled."""
    low, high = fan.bearing_min_deg, fan.bearing_max_deg
    edge = [_ray(fan, low), _arc(fan, fan.range_max_m), _ray(fan, high)[::-1]]
    outline = np.concatenate([*edge, _arc(fan, fan.range_min_m)[::-1]])
    pen.lines(outline[None], GRID, 2, closed=True)  # first, or it would cover minus signs of labels
    for range_m in nice_steps(fan.range_min_m, fan.range_max_m, 5):
        ring = _arc(fan, range_m)
        pen.lines(ring[None], GRID, 1)
        pen.note(f"{range_m:g} m", ring[-1], GRID)
    for bearing in nice_steps(low, high, 6):
        ray = _ray(fan, bearing)
        pen.lines(ray[None], GRID, 1)
        pen.note(f"{bearing:g}", ray[-1], GRID, centred=True)


def _arc(fan: Fan, range_m: float) -> FloatArray:
    """(64, 2) fan pixels of a range ring, from the left edge of the fan to the right."""
    bearings = np.linspace(fan.bearing_min_deg, fan.bearing_max_deg, 64)
    return np.column_stack(pixel_from_polar(fan, range_m, bearings))


def _ray(fan: Fan, bearing_deg: float) -> FloatArray:
    """(2, 2) fan pixels of a bearing, from the near end of the window to the far."""
    ends = np.array([fan.range_min_m, fan.range_max_m])
    return np.column_stack(pixel_from_polar(fan, ends, bearing_deg))


def disc_width_px(fan: Fan, landmarks: LandmarkSet) -> float:
    """Width in pixels, across the line of sight, of a disc in the middle of the window."""
    column, row = pixel_from_polar(fan, (fan.range_min_m + fan.range_max_m) / 2, 0.0)
    outline = disc_outline(fan, landmarks.radius_m, float(column), float(row))
    return float(np.ptp(outline[:, 0]))


def draw_preview(image: ByteImage, fan: Fan, landmarks: LandmarkSet, stated: Sonar) -> ByteImage:
    """A frame with the stated geometry drawn on it: rings, bearings, the floor's edge, three discs.

    image: (fan.rows, fan.columns) uint8. The near edge of the floor is drawn at the slant range of
    the height; nothing nearer can be floor. The discs are at a sixth, half and five sixths of the
    window. stated: the geometry as stated; the legend tells what of it was estimated.
    Returns (rows, columns, 3) uint8 BGR: the frame as from draw_frame, with a legend below.
    """
    pen = pen_on(image, fan)
    draw_grid(pen, fan)
    near = floor_depth(fan)
    if fan.range_min_m <= near <= fan.range_max_m:
        edge = _arc(fan, near)
        pen.line(edge, FLOOR, 2)
        pen.note("floor", edge[len(edge) // 2], FLOOR, centred=True)
    for share, aside in ((1 / 6, 0.5), (1 / 2, 0.25), (5 / 6, 0.75)):
        bearing = fan.bearing_min_deg + aside * (fan.bearing_max_deg - fan.bearing_min_deg)
        column, row = pixel_from_polar(fan, fan.range_min_m + share * fan.window_m, bearing)
        outline = disc_outline(fan, landmarks.radius_m, float(column), float(row))
        pen.line(outline, TRUTH, 1, closed=True)
    # A legend, in the colours of what is drawn.
    height = "" if stated.height_m is not None else ", estimated (no height is stated)"
    tilt = "" if stated.tilt_deg is not None else " estimated"
    window = f"{fan.range_min_m:.4g} to {fan.range_max_m:.4g} m"
    before = near < fan.range_min_m
    where = ", before this window (normal)" if before else ""
    bearings = f"{fan.bearing_min_deg:.3g} to {fan.bearing_max_deg:.3g} deg"
    disc = f"{2 * landmarks.radius_m:.3g} m, {disc_width_px(fan, landmarks):.0f} px wide"
    lines = (
        (f"stated: {window}, {bearings}, tilt {fan.tilt_deg:g} deg{tilt}", GRID),
        (f"floor begins at {near:.3g} m{where}{height}", GRID if before else FLOOR),
        (f"disc of {landmarks.name}: {disc} in mid-window", TRUTH),
    )
    width = max(pen.canvas.shape[1], 512)
    unit = pixel_unit(width)
    legend = Pen(np.zeros((round((len(lines) * 18 + 8) * unit), width, 3), np.uint8), unit)
    for n, (text, colour) in enumerate(lines):
        legend.text(text, (6 * unit, (18 * n + 16) * unit), colour)
    return draw_picture(pen.canvas, legend.canvas)
