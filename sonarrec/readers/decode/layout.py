"""Where the pixels of one log lie: its fan, and how each polar ping fills it.

A polar ping states its own range window, which may change from ping to ping. Later pings are shown
in the fan of the first, so that the scale stays the same; they are 0 where their window does not
cover the fan. What the user states takes precedence over what pings state.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sonarrec.arrays import ByteImage
from sonarrec.errors import SonarrecError
from sonarrec.readers.raw import PingGeometry, UnusableError
from sonarrec.sonar.frame import BeamOrder, Fan
from sonarrec.sonar.geometry import MAX_FAN_PIXELS, PolarToFan, fan_for_image, fan_for_polar
from sonarrec.sonar.stated import Geometry, Sonar

MIN_SHARED_WINDOW = 0.5
"""A ping whose window covers less of the fan's is not used."""
PITCHED_DEG = 2.0
SAME_BINS = 0.25
"""Range bins by which windows may differ that count as one. Sonars that measure the speed of sound
state another window with every ping, and it takes long to work out a layout for each."""


@dataclass(frozen=True, slots=True)
class Stated:
    """What the user states of a log: the geometry, complete if frames do not state theirs; and
    where, for messages."""

    sonar: Sonar
    where: str
    origin: str
    """What states the rest, "messages" or "headers"."""
    note: Callable[[str], None]
    """Receives a line on what was found out, or contradicts."""


@dataclass(frozen=True, slots=True)
class Layout:
    """The geometry that the first usable frame decided, as far as it does not follow the pings."""

    sonar: Sonar
    fan: Fan
    shape: tuple[int, int]
    """Of the last frame's pixels."""
    polar: PolarToFan | None = None
    """How its pixels fill the fan; None of fan images."""
    ping: PingGeometry | None = None
    """What it states; None of images that do not state their geometry."""
    order: BeamOrder | None = None
    """Of polar samples; None before it is found."""
    order_from: str | None = None
    """Either "found" or "assumed" if nobody stated it."""


def arranged(
    layout: Layout | None, image: ByteImage, ping: PingGeometry | None, stated: Stated
) -> tuple[Layout, ByteImage]:
    """(the layout, with the window of this frame; its fan image, or its polar one with the nearest
    range on top). layout: None for the first frame. Raises UnusableError if the frame cannot be
    shown in the fan, SonarrecError if what is stated does not fit the log."""
    if layout is not None and (layout.ping is None) != (ping is None):
        also, first = ("does not state", "do") if ping is None else ("states", "do not")
        raise UnusableError(f"it {also} its geometry, as the first messages of its topic {first}")
    if ping is None:
        return _image(layout, image, stated)
    return _ping(layout, image, ping, stated)


def _image(layout: Layout | None, image: ByteImage, stated: Stated) -> tuple[Layout, ByteImage]:
    """The fan or polar image of a frame that does not state its geometry."""
    sonar = stated.sonar
    if sonar.missing():
        raise UnusableError("it does not state its geometry; other messages of its topic do")
    is_fan = sonar.layout != "polar"
    if not is_fan and sonar.beam_order == "beam-major":
        image = image.T
    if sonar.range_order == ("near_first" if is_fan else "far_first"):  # upside down
        image = image[::-1]
    if layout is None:
        layout = _of_images(image.shape, stated)
    (rows, columns), usual = image.shape, layout.shape
    if image.shape != usual:
        raise UnusableError(f"{columns} x {rows} pixels in a log of {usual[1]} x {usual[0]}")
    if is_fan and sonar.flip:
        image = image[:, ::-1]
    return layout, np.ascontiguousarray(image)


def _of_images(shape: tuple[int, int], stated: Stated) -> Layout:
    """The layout of images of this shape, from the geometry that is stated."""
    sonar, geometry = stated.sonar, stated.sonar.complete(stated.where)
    view, bearings = sonar.field_of_view_deg, geometry.bearings_deg
    covered = geometry.bearing_max_deg - geometry.bearing_min_deg
    # Some count from the middle of the first beam to that of the last, a beam less.
    if view and bearings and abs(view - covered) > 1.01 * covered / len(bearings):
        stated.note(
            f"field_of_view_deg = {view:g} is not used: bearings_deg take precedence, and "
            f"cover {covered:.4g} deg"
        )
    if sonar.layout != "polar":
        return Layout(sonar, fan_for_image(geometry, *shape), shape)
    polar = _resampler(geometry, shape, stated)
    return Layout(sonar, polar.fan, shape, polar)


def _ping(
    layout: Layout | None, image: ByteImage, ping: PingGeometry, stated: Stated
) -> tuple[Layout, ByteImage]:
    """The polar image of a frame that states its geometry."""
    known = None if layout is None else layout.order
    order = known or stated.sonar.beam_order or ping.beam_order
    if order is None and image.any():  # nothing can be found from a blank ping
        order = "beam-major" if is_beam_major(image) else "range-major"
    if order == "beam-major":
        image = image.reshape(image.shape[::-1]).T
    if stated.sonar.range_order == "far_first":
        image = image[::-1]
    # Evenly spaced bins do not state their number.
    before = None if layout is None or layout.shape != image.shape else layout.ping
    if layout is None or before is None or not same_view(ping, before, image.shape[0]):
        layout = _of_window(layout, ping, image.shape, stated)
    if layout.order is None and order is not None:
        sonar = replace(layout.sonar, beam_order=order)
        layout = replace(layout, order=order, sonar=sonar)
        if not (stated.sonar.beam_order or ping.beam_order):
            is_square = image.shape[0] == image.shape[1]
            layout = replace(layout, order_from="assumed" if is_square else "found")
            if is_square:
                stated.note(
                    f"assumed to be {order}: its {len(image)} range bins are as many as its beams, "
                    "so the images do not show it; --beam-order states it"
                )
            elif order == "beam-major":
                stated.note("read as beam-major, found from its first ping with echoes")
    return layout, np.ascontiguousarray(image)


def _of_window(
    layout: Layout | None, ping: PingGeometry, shape: tuple[int, int], stated: Stated
) -> Layout:
    """The layout with a ping's window, as far as the user does not state another. shape: (bins,
    beams). Raises UnusableError if it cannot be shown in the log's fan, SonarrecError if what is
    stated does not fit the log."""
    sonar, against = _as_stated(ping, stated.sonar, bins=shape[0])
    try:
        geometry = sonar.complete(stated.where)
        window = fan_for_polar(geometry, shape[0])
        if window.rows * window.columns > MAX_FAN_PIXELS:
            raise UnusableError(
                f"its window, {window.range_min_m:.6g} to {window.range_max_m:.6g} m in {shape[0]} "
                f"bins, makes a fan of {window.columns} x {window.rows} pixels"
            )
        polar = _resampler(geometry, shape, stated, None if layout is None else layout.fan)
    except SonarrecError as error:
        if layout is None:  # what is stated does not fit the log
            raise
        raise UnusableError(str(error).partition("\n")[0]) from None
    if layout is None:
        if against:
            stated.note(f"what is stated differs from the {stated.origin}: {', '.join(against)}")
        if abs(ping.pitch_deg) > PITCHED_DEG:
            stated.note(
                f"beam directions are pitched by {ping.pitch_deg:.0f} deg, as by a mounting; "
                "bearings are measured in their plane, and you must still state tilt_deg"
            )
        return Layout(sonar, polar.fan, shape, polar, ping)
    fan = layout.fan
    if not _covers(_ranges(window), _ranges(fan)):
        raise UnusableError(
            f"its window, {window.range_min_m:.3g} to {window.range_max_m:.3g} m, shows less than "
            f"half of the log's, {fan.range_min_m:.3g} to {fan.range_max_m:.3g} m"
        )
    if not all(_covers(edges(fan), edges(window)) for edges in (_ranges, _bearings)):
        view_deg = fan.bearing_max_deg - fan.bearing_min_deg
        stated.note(
            f"some pings show more than the fan of the first ones, {fan.range_min_m:.3g} to "
            f"{fan.range_max_m:.3g} m and {view_deg:.3g} deg: only what is in it is used"
        )
    return replace(layout, shape=shape, polar=polar, ping=ping)


def _resampler(
    geometry: Geometry, shape: tuple[int, int], stated: Stated, fan: Fan | None = None
) -> PolarToFan:
    """The resampler for polar images of this shape (bins, beams). fan: of the log, if known.
    Raises SonarrecError as PolarToFan does. Without a fan the message names the log."""
    try:
        return PolarToFan(geometry, *shape, fan)
    except SonarrecError as error:
        if fan is not None:
            raise
        raise SonarrecError(f"{stated.where}: {error}") from None


def _ranges(window: Fan | PingGeometry) -> tuple[float, float]:
    return window.range_min_m, window.range_max_m


def _bearings(window: Fan | PingGeometry) -> tuple[float, float]:
    if isinstance(window, Fan):
        return window.bearing_min_deg, window.bearing_max_deg
    return min(window.bearings_deg), max(window.bearings_deg)


def _covers(span: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether a range window or field of view covers enough of another."""
    shared = min(span[1], other[1]) - max(span[0], other[0])
    return shared >= MIN_SHARED_WINDOW * (other[1] - other[0])


def agree(a: PingGeometry, b: PingGeometry) -> bool:
    """Whether two pings each show enough of the other's window and field of view."""
    pairs = ((a, b), (b, a))
    return all(_covers(edges(x), edges(y)) for edges in (_ranges, _bearings) for x, y in pairs)


def same_view(a: PingGeometry, b: PingGeometry, bins: int) -> bool:
    """Whether images of so many bins show the same positions, to SAME_BINS, in two pings."""
    of_a, of_b = (np.array([*_ranges(p), *(p.ranges_m or ())]) for p in (a, b))
    if a.bearings_deg != b.bearings_deg or len(of_a) != len(of_b):
        return False
    bin_m = (a.range_max_m - a.range_min_m) / bins
    return bool(np.abs(of_a - of_b).max() <= SAME_BINS * bin_m)


def _as_stated(ping: PingGeometry, stated: Sonar, bins: int) -> tuple[Sonar, list[str]]:
    """A ping's geometry, replaced by what the user states, and a text for each contradiction.
    Ranges that agree to half a bin, and a field of view to half a beam, contradict nothing."""
    against = []
    if stated.layout == "fan":
        against.append('layout = "fan" (they are polar, and read so)')
    keys = ("range_min_m", "range_max_m", "bearings_deg", "ranges_m", "beam_order")
    by_ping = Sonar(layout="polar", **{key: getattr(ping, key) for key in keys})
    sonar = by_ping.updated(replace(stated, layout=None))
    bin_m = (ping.range_max_m - ping.range_min_m) / bins
    for key in keys[:2]:
        value, of_ping = getattr(stated, key), getattr(ping, key)
        if value is None:
            continue
        if abs(value - of_ping) > bin_m / 2:
            against.append(f"{key} = {value:g} (not {of_ping:.4g})")
            sonar = replace(sonar, ranges_m=stated.ranges_m)
        elif stated.ranges_m is None and ping.ranges_m is not None:
            sonar = replace(sonar, **{key: of_ping})  # which fits the middles of the bins
    bearings = np.asarray(ping.bearings_deg)
    beam_deg = float(np.ptp(bearings)) / (len(bearings) - 1)
    if stated.bearings_deg is not None:
        value = np.asarray(stated.bearings_deg)
        if value.shape != bearings.shape or np.abs(value - bearings).max() > beam_deg / 2:
            against.append("bearings_deg")
        return sonar, against
    view, theirs_deg = stated.field_of_view_deg, beam_deg * len(bearings)
    if view is not None and abs(view - theirs_deg) > beam_deg / 2:
        against.append(f"field_of_view_deg = {view:g} (not {theirs_deg:.4g})")
        sonar = replace(sonar, bearings_deg=None)
    return sonar, against


def is_beam_major(image: ByteImage) -> bool:
    """Whether samples that were taken to be range-major, (bins, beams), are beam-major instead. In
    range-major data the sample `beams` positions later is the next range bin of the same beam; in
    beam-major data the sample `bins` positions later is the next beam at the same range. Such a
    sample resembles the first one more than the samples around it do. If this decides nothing, as
    with equal numbers of bins and beams, the data are taken to be range-major, as most are."""
    bins, beams = image.shape
    samples = image.ravel()
    if bins == beams:
        return False
    by_range, by_beam = _resemblance(samples, beams), _resemblance(samples, bins)
    chance = max(0.03, 4 / math.sqrt(samples.size))  # three sigma of pure noise
    return by_beam < 1 - chance and by_beam < by_range


def _resemblance(samples: np.ndarray, lag: int) -> float:
    """Mean difference of samples at this lag, divided by that at a slightly smaller or larger lag:
    small if samples at this lag resemble each other."""
    off = max(1, min(8, lag // 3))  # farther than a spot is wide
    at_lag, near, far = (
        float(np.mean(cv2.absdiff(samples[k:], samples[:-k]))) for k in (lag, lag - off, lag + off)
    )
    return 2 * at_lag / (near + far) if near + far else 1.0
