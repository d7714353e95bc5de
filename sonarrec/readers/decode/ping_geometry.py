"""Compares a ping's geometry with others' and the user's, and finds the order of its samples."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from sonarrec.arrays import ByteImage
from sonarrec.nouns import Fan
from sonarrec.sonar import PingGeometry, Sonar

MIN_SHARED_WINDOW = 0.5
"""A ping whose window covers less of the fan's is not used."""
SAME_BINS = 0.25
"""Range bins by which windows may differ that count as one. Sonars that measure the speed of sound
state another window with every ping, and to lay out an image anew takes long."""


def shows(window: Fan | PingGeometry, other: Fan | PingGeometry) -> bool:
    """Whether a range window covers enough of another."""
    near = max(window.range_min_m, other.range_min_m)
    far = min(window.range_max_m, other.range_max_m)
    return far - near >= MIN_SHARED_WINDOW * (other.range_max_m - other.range_min_m)


def as_wide(window: Fan | PingGeometry, other: Fan | PingGeometry) -> bool:
    """Whether a field of view covers enough of another."""
    (left, right), (from_deg, to_deg) = _bearings(window), _bearings(other)
    return min(right, to_deg) - max(left, from_deg) >= MIN_SHARED_WINDOW * (to_deg - from_deg)


def agree(a: PingGeometry, b: PingGeometry) -> bool:
    """Whether two pings each show enough of the other's window and field of view."""
    return shows(a, b) and shows(b, a) and as_wide(a, b) and as_wide(b, a)


def same_view(a: PingGeometry, b: PingGeometry, bins: int) -> bool:
    """Whether images of so many bins show the same places, to SAME_BINS, in two pings."""
    if a == b:
        return True
    in_a = replace(b, range_min_m=a.range_min_m, range_max_m=a.range_max_m, ranges_m=a.ranges_m)
    of_a, of_b = (np.array([p.range_min_m, p.range_max_m, *(p.ranges_m or ())]) for p in (a, b))
    if in_a != a or len(of_a) != len(of_b):
        return False
    bin_m = (a.range_max_m - a.range_min_m) / bins
    return bool(np.abs(of_a - of_b).max() <= SAME_BINS * bin_m)


def _bearings(window: Fan | PingGeometry) -> tuple[float, float]:
    if isinstance(window, Fan):
        return window.bearing_min_deg, window.bearing_max_deg
    return min(window.bearings_deg), max(window.bearings_deg)


def extent(fan: Fan) -> str:
    """A fan's window and field of view, for a line."""
    return (
        f"{fan.range_min_m:.3g} to {fan.range_max_m:.3g} m and "
        f"{fan.bearing_max_deg - fan.bearing_min_deg:.3g} deg"
    )


def as_stated(ping: PingGeometry, stated: Sonar, bins: int) -> tuple[Sonar, list[str]]:
    """A ping's geometry, replaced by what the user states, and a text for each contradiction.
    Ranges that agree to half a bin, and a field of view to half a beam, contradict nothing."""
    against = []
    if stated.layout == "fan":
        against.append('layout = "fan" (they are polar, and read so)')
    sonar = ping.as_sonar().updated(replace(stated, layout=None))
    bin_m = (ping.range_max_m - ping.range_min_m) / bins
    for key in ("range_min_m", "range_max_m"):
        mine, theirs = getattr(stated, key), getattr(ping, key)
        if mine is None:
            continue
        if abs(mine - theirs) > bin_m / 2:
            against.append(f"{key} = {mine:g} (not {theirs:.4g})")
            sonar = replace(sonar, ranges_m=stated.ranges_m)
        elif stated.ranges_m is None and ping.ranges_m is not None:
            sonar = replace(sonar, **{key: theirs})  # which fits the middles of the bins
    bearings = np.asarray(ping.bearings_deg)
    beam_deg = float(np.ptp(bearings)) / (len(bearings) - 1)
    if stated.bearings_deg is not None:
        mine = np.asarray(stated.bearings_deg)
        if mine.shape != bearings.shape or np.abs(mine - bearings).max() > beam_deg / 2:
            against.append("bearings_deg")
    elif stated.field_of_view_deg is not None:
        theirs = beam_deg * len(bearings)
        if abs(stated.field_of_view_deg - theirs) > beam_deg / 2:
            against.append(f"field_of_view_deg = {stated.field_of_view_deg:g} (not {theirs:.4g})")
            sonar = replace(sonar, bearings_deg=None)
    return sonar, against


def looks_beam_major(image: ByteImage) -> bool:
    """Whether samples that were taken to be range-major, (bins, beams), are beam-major instead.

    In range-major data the sample `beams` places later is the next range bin of the same beam; in
    beam-major data the sample `bins` places later is the next beam at the same range. Such a sample
    resembles the first one more than the samples around it do. If this decides nothing, as with
    equal numbers of bins and beams, the data are taken to be range-major, as most are.
    """
    bins, beams = image.shape
    samples = image.ravel()
    if bins == beams:
        return False
    by_range, by_beam = _resemblance(samples, beams), _resemblance(samples, bins)
    chance = max(0.03, 4 / math.sqrt(samples.size))  # three sigma of pure noise
    return by_beam < 1 - chance and by_beam < by_range


def _resemblance(samples: np.ndarray, lag: int) -> float:
    """Mean difference of samples `lag` apart, divided by that of samples a little less or more
    apart: small if samples `lag` apart resemble each other."""
    off = max(1, min(8, lag // 3))  # farther than a spot is wide
    at, near, far = (
        float(np.mean(cv2.absdiff(samples[k:], samples[:-k]))) for k in (lag, lag - off, lag + off)
    )
    return 2 * at / (near + far) if near + far else 1.0
