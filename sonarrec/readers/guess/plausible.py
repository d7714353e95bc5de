"""Checks whether a log's images contradict its stated geometry. Only clear cases are reported.

Four things are checked in the mean of the first frames: echoes outside of the stated fan, the
outline of the fan, that of images that are read as polar, and echoes from nearer than the stated
floor.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from sonarrec.arrays import ByteImage, FloatArray, quantile
from sonarrec.geometry import fan_mask, pixel_from_polar
from sonarrec.nouns import Fan, Frame, PolarImages
from sonarrec.readers.guess.outline import BACKGROUND, FanOutline, above_background, find_outline

FRAMES = 5
"""Number of first frames that are used. Each costs one addition of an image."""

_RINGS, _BEAMS = 96, 64  # of a polar picture of the fan
# Measured on the sample logs and on recordings of others. Share of echoes outside of the fan: .42
# or more if the fan is wrong, at most .03 if it is right. Grey level nearer than the floor, as a
# share of that of the floor: .96 or more if the stated height is 1.5 times too large; at most .58
# if it is right, or .84 if half of the picture is noise.
_OUTSIDE = 0.15  # share of the pixels outside of the stated fan that hold echoes
_FILLED = 0.6  # the same share, if the picture has no outline of a fan
# In 1,700 pictures, simulated and changed as viewers and codecs do, the apex was found within .036
# of where it was, in all but strongly compressed JPEGs within .010 (tests/studies/RESULTS.md).
_APART = 0.04  # of the fan's length: how far its apex and its far end may be from the stated ones
_PIXELS = 2.0  # in addition
_CUT = 0.2  # share of the stated fan that lies outside of the picture
_NARROWING = 0.1  # by how much each side of a fan narrows, in widths of the picture
_STRAIGHT = 0.02  # standard deviation of an edge from a line, in widths of the picture
_AS_BRIGHT = 0.9  # of the floor's grey level; what is brighter cannot be water
# Of the profile of levels by range, in its bright tenth: where a floor begins it rises by .90 and
# more over _EDGE rings, where it ends it falls by .36 at most (simulated), .50 (of a real river).
_EDGE, _SHARP, _LESS_SHARP, _DARK = 5, 0.75, 0.45, 0.2
_NEAR = 0.1  # least share of the range window nearer than the stated floor, for a check


class Plausibility:
    """Collects the first frames of a log; `contradictions` says what they contradict."""

    def __init__(self) -> None:
        self._fan: Fan | None = None
        self._polar = False
        # Of fan images, or of what `_cells` finds in polar ones.
        self._sum: FloatArray | None = None
        self._frames = 0

    def look(self, frame: Frame) -> None:
        """Add a frame; all after the first FRAMES are ignored."""
        if self._frames == FRAMES:
            return
        self._frames += 1
        picture = frame.pixels if frame.polar is None else _cells(frame, frame.polar)
        if self._sum is None:
            self._fan, self._polar = frame.fan, frame.polar is not None
            self._sum = np.zeros(picture.shape, np.float32)
        self._sum += picture

    def _picture(self) -> FloatArray:
        """Mean of the frames so far, of which there is one at least."""
        assert self._sum is not None
        return np.asarray(self._sum / self._frames)

    @cached_property
    def outline(self) -> FanOutline | None:
        """The fan's outline as the pictures show it, if they do and are fan images. It is looked
        for once: ask when all frames were added."""
        return None if self._sum is None or self._polar else find_outline(self._picture())

    def contradictions(self, *, height_stated: bool = True, rows_stated: bool = True) -> list[str]:
        """A line for each contradiction of the stated geometry, with the keys to look at.
        height_stated: whether the fan's height is stated, or was estimated from these very
        images. rows_stated: whether it is known which row of polar images is the nearest."""
        if self._sum is None or self._fan is None:
            return []
        picture = self._picture()
        if self._polar:
            polar_picture = picture
            shape = _polar_outline(polar_picture)
            if not (shape or rows_stated):
                shape = _upside_down(polar_picture, self._fan)
        else:
            polar_picture = as_polar(picture, self._fan)
            shape = _fan_outline(picture, self._fan, self.outline)
        # If the outline is wrong, ranges in the picture mean nothing.
        return shape or (_floor(polar_picture, self._fan) if height_stated else [])


def _rings_and_bearings(fan: Fan) -> tuple[FloatArray, FloatArray]:
    """(rings, 1) slant ranges (m) and (beams,) bearings (deg), evenly over the fan."""
    share = (np.arange(_RINGS) + 0.5) / _RINGS
    across = (np.arange(_BEAMS) + 0.5) / _BEAMS
    bearings = fan.bearing_min_deg + across * (fan.bearing_max_deg - fan.bearing_min_deg)
    return (fan.range_min_m + share * fan.window_m)[:, None], bearings


def as_polar(picture: FloatArray | ByteImage, fan: Fan) -> FloatArray:
    """(rings, beams) grey levels of the fan; NaN outside of the picture."""
    column, row = (
        np.rint(at).astype(int) for at in pixel_from_polar(fan, *_rings_and_bearings(fan))
    )
    inside = (column >= 0) & (column < fan.columns) & (row >= 0) & (row < fan.rows)
    cells = picture[np.clip(row, 0, fan.rows - 1), np.clip(column, 0, fan.columns - 1)]
    return np.where(inside, cells, np.nan)


def _cells(frame: Frame, polar: PolarImages) -> FloatArray:
    """As `as_polar`, of a frame of polar pixels; 0 where they show nothing. The fan image, which
    may have many times their number, is not made."""
    beam, range_bin, seen = polar.pixel(*np.broadcast_arrays(*_rings_and_bearings(frame.fan)))
    cells = frame.pixels[np.rint(range_bin).astype(int), np.rint(beam).astype(int)]
    return np.where(seen, cells, 0)


def levels_by_range(picture: FloatArray, fan: Fan) -> tuple[FloatArray, FloatArray]:
    """(n,) slant ranges (m) that the picture shows, and (n,) median grey levels there. picture: as
    `as_polar` gives it."""
    is_shown = ~np.isnan(picture).all(axis=1)
    if not is_shown.any():
        return np.empty(0), np.empty(0)
    # Sorting puts NaN last. nanmedian would load numpy.ma, and nanquantile goes row by row.
    ordered = np.sort(picture[is_shown], axis=1)
    row, count = np.arange(len(ordered)), np.count_nonzero(~np.isnan(ordered), axis=1)
    lower, upper = ordered[row, (count - 1) // 2], ordered[row, count // 2]
    return _rings_and_bearings(fan)[0][is_shown, 0], upper - (upper - lower) / 2


def _echoes(grey: FloatArray) -> float:
    """Share of pixels that differ from the commonest grey level: 0 for an even background."""
    return float(np.mean(above_background(grey) > BACKGROUND)) if grey.size else 0.0


def _fan_outline(picture: FloatArray, fan: Fan, found: FanOutline | None) -> list[str]:
    """A line if there are echoes outside of the stated fan, or if it is not where the picture's is,
    or exceeds the picture. found: the picture's outline."""
    outside = fan_mask(fan) == 0
    share = _echoes(picture[outside])
    beyond = share > _OUTSIDE and bool(np.mean(outside) > _OUTSIDE / 10)
    text = f"{share:.0%} of the picture outside of the stated fan holds echoes"
    if beyond and _echoes(picture[::-1][outside]) < _OUTSIDE / 3:
        return [f"{text}, but none if it is turned upside down (a fan has its far range on top)"]
    if found is not None:
        other = _other_outline(found, fan, beyond)
        nearest_px = fan.range_min_m / fan.metres_per_pixel - _APART * _far_px(found, fan) - _PIXELS
        if other or found.near_px is None or found.near_px > nearest_px:
            # If it is as stated, other things lie beside it, or a part of it is cut off.
            return other
    if beyond:
        if share > _FILLED:
            return [f"{text} (is it polar, --layout polar?)"]
        return [f"{text} (look at range_min_m, range_max_m, field_of_view_deg and layout)"]
    column, row = pixel_from_polar(fan, *_rings_and_bearings(fan))
    cut = np.mean((column < -1) | (column > fan.columns) | (row < -1) | (row > fan.rows))
    if cut > _CUT:
        return [
            f"{cut:.0%} of the stated fan lies outside of the picture, {fan.columns} x {fan.rows} "
            "pixels (is it polar, --layout polar? else look at metres_per_pixel and apex_px)"
        ]
    return []


def _far_px(found: FanOutline, fan: Fan) -> float:
    """Distance of the far end from the apex; the stated one if it does not show."""
    return found.far_px or fan.range_max_m / fan.metres_per_pixel


def _other_outline(found: FanOutline, fan: Fan, beyond: bool) -> list[str]:
    """A line if the outline that was found is not the stated fan's, with the flags that state it. A
    dark edge or far end makes it narrower or shorter. beyond: whether there are echoes outside of
    the stated fan; else lines drawn into the picture may make it wider."""
    apart_px = math.hypot(found.apex_column - fan.apex_column, found.apex_row - fan.apex_row)
    near_px, far_px = (at / fan.metres_per_pixel for at in (fan.range_min_m, fan.range_max_m))
    view_deg = fan.bearing_max_deg - fan.bearing_min_deg
    apex = f"{found.apex_column:.1f}", f"{found.apex_row:.1f}"
    length = _far_px(found, fan)
    flags, also = [], ""
    if max(apart_px, length - far_px) > _APART * length + _PIXELS:
        flags.append(f"--apex-px {' '.join(apex)}")
        if found.far_px is None:
            also = ", and metres_per_pixel, which the pictures do not show"
        else:
            flags.append(f"--metres-per-pixel {fan.range_max_m / found.far_px:.4g}")
    if beyond and found.view_deg > (1 + _APART) * view_deg:
        flags.append(f"--field-of-view-deg {found.view_deg:.1f}")
    if not flags:
        return []
    return [
        f"the pictures show a fan of {found.view_deg:.1f} deg with apex_px = [{', '.join(apex)}] "
        f"and {found.ends}; stated or assumed "
        f"are {view_deg:.1f} deg, [{fan.apex_column:.1f}, {fan.apex_row:.1f}], {near_px:.0f} and "
        f"{far_px:.0f} px (if the stated ranges are right, give {' '.join(flags)}{also})"
    ]


def _polar_outline(picture: FloatArray) -> list[str]:
    """A line if a picture read as polar has two straight edges that narrow to one end: a fan. Only
    40 % of the rows at either end are used, because farther off the arc of a wide fan cuts its
    edges."""
    echoes = picture > BACKGROUND
    count = round(0.4 * _RINGS)
    for rows in (echoes[-count:], echoes[:count][::-1]):  # narrow end last
        if not rows.any(axis=1).all():
            continue
        left, right = rows.argmax(axis=1), rows[:, ::-1].argmax(axis=1)
        at = np.arange(count)
        lines = [np.polyfit(at, side, 1) for side in (left, right)]
        away = [
            np.std(side - np.polyval(line, at))
            for side, line in zip((left, right), lines, strict=True)
        ]
        comes_in = [float(line[0]) * count for line in lines]
        if max(away) < _STRAIGHT * _BEAMS and min(comes_in) > _NARROWING * _BEAMS * 0.4:
            return ["read as polar, the picture has the outline of a fan (--layout fan)"]
    return []


def _upside_down(picture: FloatArray, fan: Fan) -> list[str]:
    """A line if the farthest rows are as the water before a floor: dark from one ring to the next,
    while a floor fades slowly where it ends."""
    _, rings = levels_by_range(picture, fan)
    far = float(quantile(rings[-round(_NEAR * len(rings)) :], 0.5))
    light, steps = float(quantile(rings, 0.9)), rings[_EDGE:] - rings[:-_EDGE]
    rise, fall = float(steps.max()), -float(steps.min())
    if far >= _DARK * light or fall <= max(_SHARP * light, rise / _LESS_SHARP):
        return []
    return [
        "its last rows, taken for the farthest, are dark as the water before a floor (are far "
        "ranges on top, --range-order far_first? near_first if not)"
    ]


def _floor(picture: FloatArray, fan: Fan) -> list[str]:
    """A line if echoes from nearer than the stated floor are as bright as the floor."""
    if fan.height_m is None:
        return []
    range_m, rings = levels_by_range(picture, fan)
    before, beyond = range_m < 0.95 * fan.height_m, range_m > 1.05 * fan.height_m
    if min(before.sum(), beyond.sum()) < _NEAR * _RINGS:
        return []
    near, floor = quantile(rings[before], 0.5), float(quantile(rings[beyond], 0.75))
    if near < max(_AS_BRIGHT * floor, BACKGROUND):
        return []
    return [
        f"from {fan.range_min_m:.3g} m on it is as bright as a floor, but the stated floor begins "
        f"at {fan.height_m:.3g} m (look at height_m, range_min_m and range_max_m)"
    ]
