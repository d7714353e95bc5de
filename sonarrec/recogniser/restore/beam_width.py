"""Measures how wide the sonar's beams are, if neither messages nor settings state it.

One grain of speckle is as wide as a beam: on an even floor the picture's correlation along the
bearing falls off as the beam pattern does. Along the range speckle changes from bin to bin, while
landmarks, light and the floor's own pattern change slowly; a mean along the range takes these out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.config import Config
from sonarrec.geometry import pixel_from_polar
from sonarrec.nouns import Fan, Frame

FRAMES_FOR_BEAMS = 4
"""How many of a log's first frames are looked at."""
# (field of view up to, beam width) in degrees: acoustic cameras (DIDSON, ARIS), multibeam sonars
# of 60 deg, and those of 120 to 130.
USUAL_DEG = ((40.0, 0.4), (80.0, 0.6), (360.0, 1.0))
# A measured width is used only if it differs from the usual one by more than this factor: relief on
# the floor is correlated over more than a beam, and looks like beams twice as wide (tuning seeds).
CLEARLY = 2.2
NARROWEST_DEG, WIDEST_DEG = 0.15, 3.0
STEP_DEG = 0.05
MOST_ROWS = 256
# The correlation is measured at LAGS lags, up to 6 deg; its mean from BASE_FROM_DEG on counts as 0.
LAGS, BASE_FROM_DEG = int(6.0 / STEP_DEG), 4.0
RANGE_MEAN_PX = 7
CLIP = 2.5  # deviations
# The range of the correlation that is fitted: above it noise of single beams distorts the fall-off,
# below it chance does.
FIT_FROM, FIT_TO = 0.5, 0.06
# Variance of a Gaussian through the fall-off, in beam widths squared. The beam itself makes a part
# of it, interpolation between beams two thirds of a width apart the rest (simulated sonars).
VARIANCE = 0.45


def with_beams(
    configs: Sequence[Config], stated_deg: float | None, begin: Sequence[Frame]
) -> tuple[list[Config], list[str]]:
    """The settings, with the beam width filled in where they leave it open, and a note on it.

    stated_deg: the width that the log states, if any. begin: its first FRAMES_FOR_BEAMS frames, at
    least one. There is no note if the width is the usual one.
    """
    needs = [not c.features.beam_width_deg and c.features.measurement != "single" for c in configs]
    if not any(needs):
        return list(configs), []
    fan = begin[0].fan
    if stated_deg is not None:
        width, how = stated_deg, "the log states"
    else:
        width, measured = beam_width_deg(fan, (f.image for f in begin if f.fan == fan))
        how = "the first frames show" if measured else ""
        for polar in {f.polar for f in begin}:
            if polar is not None:
                polar.forget()  # a run makes no more fan images
    found = [
        replace(c, features=replace(c.features, beam_width_deg=width)) if need else c
        for c, need in zip(configs, needs, strict=True)
    ]
    if width == usual_beam_width_deg(fan):
        return found, []
    note = f"beams are taken to be {width:g} deg wide, as {how}"
    return found, [f"{note} (features.beam_width_deg sets another)"]


def usual_beam_width_deg(fan: Fan) -> float:
    """The usual width of sonars with the fan's field of view, between two-way half-power points."""
    view_deg = fan.bearing_max_deg - fan.bearing_min_deg
    return next(width for widest, width in USUAL_DEG if view_deg <= widest)


def beam_width_deg(fan: Fan, images: Iterable[ByteImage]) -> tuple[float, bool]:
    """(width, whether it was measured): the usual one, unless the images clearly show another.

    images: the first few of a log, (fan.rows, fan.columns).
    """
    usual, found = usual_beam_width_deg(fan), measured_width_deg(fan, images)
    if found is None or 1 / CLEARLY <= found / usual <= CLEARLY:
        return usual, False
    return round(found, 2), True


def measured_width_deg(fan: Fan, images: Iterable[ByteImage]) -> float | None:
    """The width that the images show; None if they do not show it."""
    pixel_deg = np.degrees(fan.metres_per_pixel / fan.range_max_m)
    last = fan.range_max_m - 0.03 * fan.window_m
    first = max(fan.range_min_m + 0.3 * fan.window_m, last - MOST_ROWS * fan.metres_per_pixel, 1e-3)
    range_m = np.arange(first, last, fan.metres_per_pixel)
    bearing = np.arange(fan.bearing_min_deg + 0.5, fan.bearing_max_deg - 0.5, STEP_DEG)
    if len(range_m) < 4 * RANGE_MEAN_PX or len(bearing) < 2 * LAGS:
        return None
    column, row = (
        a.astype(np.float32) for a in pixel_from_polar(fan, range_m[:, None], bearing[None])
    )
    rows = np.concatenate(
        [_correlations(cv2.remap(i, column, row, cv2.INTER_LINEAR)) for i in images]
    )
    if len(rows) < MOST_ROWS // 4:
        return None
    correlation = np.quantile(rows, 0.5, axis=0)
    base = correlation[int(BASE_FROM_DEG / STEP_DEG) :].mean()
    fall = (correlation - base) / (1 - base)
    begin, end = int(np.argmax(fall < FIT_FROM)), int(np.argmax(fall < FIT_TO))
    if not begin or end - begin < 3 or begin * STEP_DEG < pixel_deg:
        return None
    # A Gaussian fitted to the fall-off: a straight line in the logarithm over the squared lag.
    fit = slice(begin, end)
    lag = STEP_DEG * np.arange(LAGS)
    slope = -np.polyfit(lag[fit] ** 2, np.log(fall[fit]), 1, w=fall[fit])[0]
    if slope <= 0:
        return None
    width = float(np.sqrt(1 / (2 * slope * VARIANCE)))
    return width if NARROWEST_DEG <= width <= WIDEST_DEG else None


def _correlations(image: npt.ArrayLike) -> FloatArray:
    """(n, LAGS) autocorrelation of speckle along the bearing, of each row that shows any.

    image: (rows, columns) grey levels by range and bearing.
    """
    polar = np.asarray(image, np.float32)
    polar -= cv2.blur(polar, (1, RANGE_MEAN_PX), borderType=cv2.BORDER_REFLECT)
    polar -= polar.mean(axis=0)
    sigma = float(polar.std())
    polar = np.clip(polar, -CLIP * sigma, CLIP * sigma)
    polar -= polar.mean(axis=1, keepdims=True)
    columns = polar.shape[1]
    # So long that no lag meets a bearing from the other end, and quickly transformed.
    size = cv2.getOptimalDFTSize(columns + LAGS)
    spectrum = np.fft.rfft(polar, size, axis=1)
    power = spectrum.real**2 + spectrum.imag**2
    product = np.fft.irfft(power, size, axis=1)[:, :LAGS] / (columns - np.arange(LAGS))
    lit = product[:, 0] > 1e-3
    return np.asarray(product[lit] / product[lit, :1])
