"""Turns the frames of a log into 8-bit images of one fan, or polar images for that fan."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from sonarrec.arrays import ByteImage
from sonarrec.errors import Diagnostics, SonarrecError
from sonarrec.geometry import MAX_FAN_PIXELS, PolarToFan, fan_for_image, fan_for_polar
from sonarrec.nouns import BeamOrder, Fan, Frame, PingGeometry
from sonarrec.readers.decode.colour import LUMINANCE, find_map, is_coloured, strays
from sonarrec.readers.decode.grey import (
    GreyScale,
    dim_level,
    grey_scale,
    holds_amplitudes,
    next_to_black,
    single_channel,
    to_grey8,
)
from sonarrec.readers.decode.height import height_from_images
from sonarrec.readers.raw import UnusableError, showing
from sonarrec.sonar import Geometry, Sonar

MIN_SHARED_WINDOW = 0.5
"""A ping whose window covers less of the fan's is not used."""
SAME_BINS = 0.25
"""Range bins by which windows may differ that count as one. Sonars that measure the speed of sound
state another window with every ping, and to lay out an image anew takes long."""


class FrameMaker:
    """Turns the frames of one log into grey images. The first frame decides fan and grey scale.

    A polar ping states its own range window, which may change from ping to ping. Later pings are
    shown in the fan of the first (see `settle`), so that the scale stays the same; they are 0 where
    their window does not cover the fan. What the user states takes precedence over what pings
    state.

    sonar: the geometry; for polar pings that of the first one, once it was read. fan: None before
    the first frame. order_from: "found" or "assumed" for a beam order nobody stated; else None.
    """

    def __init__(
        self, stated: Sonar, where: str, diagnostics: Diagnostics, origin: str = "messages"
    ) -> None:
        """stated: the geometry that the user states; complete if frames do not state theirs. where:
        its name in messages. diagnostics: is told what contradicts the pings or was found out.
        origin: what states the rest, "messages" or "headers"."""
        self.sonar = self._stated = stated
        self.fan: Fan | None = None
        self.order_from: str | None = None
        self.colour_map: str = stated.colour_map or LUMINANCE
        self._note, self._where, self._origin = diagnostics.note, where, origin
        self._scales: dict[np.dtype[Any], GreyScale] = {}  # one for each type of pixel
        self._amplitudes = set[np.dtype[Any]]()  # types of integers that hold them
        self._in_colour = False  # whether a frame was, and its map was looked for
        self._strayed = False  # whether it was told that colours are of another map
        self._shape: tuple[int, ...] | None = None  # of images that do not state their geometry
        # Geometry and shape of the pings for which _to_fan was made.
        self._to_fan_of: tuple[PingGeometry, tuple[int, int]] | None = None
        self._to_fan: PolarToFan | None = None
        self._order: BeamOrder | None = None  # of polar samples; None before it is found
        self._noted_against = self._noted_cut = False

    def __call__(self, frame: Frame) -> Frame:
        """The frame with grey pixels in the fan. Raises UnusableError if it cannot be used,
        SonarrecError if the geometry does not fit the log."""
        if frame.pixels is None:
            raise UnusableError(str(frame.problem))
        pixels = single_channel(frame.pixels, self._map_of(frame))
        scale = self._scales.get(pixels.dtype)
        if scale is None:
            of_ping = frame.ping is not None and pixels.dtype.kind == "f"
            amplitudes = of_ping or pixels.dtype in self._amplitudes
            scale = grey_scale(self._stated, pixels, amplitudes, frame.white)
        image = np.zeros(pixels.shape, np.uint8) if scale is None else to_grey8(pixels, scale)
        image = self._image(image) if frame.ping is None else self._ping(image, frame.ping)
        if scale is not None:
            self._scales[pixels.dtype] = scale
        assert self.fan is not None
        return replace(frame, pixels=image, fan=self.fan, polar=self._to_fan)

    @property
    def scale(self) -> GreyScale | None:
        """How pixels become grey; None before the first usable frame."""
        return next(iter(self._scales.values()), None)

    def settle(self, first: Sequence[Frame]) -> None:
        """Find out what the pixels hold, and take the fan from the ping that most pings agree with.
        It need not be the first ping, since a driver may send one before it has its settings. A
        height that nobody states is estimated. first: the log's first frames. Raises SonarrecError
        if the geometry does not fit the log."""
        first = showing(first)
        coloured = [f.pixels for f in first if f.pixels is not None and _in_colour(f.pixels)]
        if coloured and not self._stated.colour_map:
            self._find_map(coloured)
        if self._stated.pixel_scale is None:
            self._find_amplitudes(first)
        pings = [(f, f.ping) for f in first if f.pixels is not None and f.ping]
        agreeing = [sum(_agree(a, b) for _, b in pings) for _, a in pings]
        if agreeing:
            with contextlib.suppress(UnusableError):
                self(pings[int(np.argmax(agreeing))][0])
        if self._stated.height_m is not None:
            return
        images = []
        for frame in first:
            with contextlib.suppress(UnusableError):
                if (made := self(frame)).shows:
                    images.append(made.image)
        if self.fan is not None and images:
            self.fan = replace(self.fan, height_m=height_from_images(images, self.fan))
        if self._to_fan is not None:
            self._to_fan.forget()  # a run makes no more fan images

    def _find_map(self, pictures: Sequence[np.ndarray], since: str = "") -> None:
        """Find the colour map of pictures; a note names it. since: the frame, if not the first."""
        self._in_colour = True
        self.colour_map = find_map(pictures) or LUMINANCE
        how = f"read as levels of the colour map {self.colour_map}"
        if self.colour_map == LUMINANCE:
            how = "of no known colour map, and read by their luminance"
        self._note(f"colours {since}{how}; colour_map in sonar.toml states another")

    def _map_of(self, frame: Frame) -> str:
        """The colour map of the log. If the first frames were grey, the first coloured one tells
        it."""
        if not self._stated.colour_map and not self._in_colour and _in_colour(frame.pixels):
            self._find_map([frame.pixels], f"begin at {frame.name} after grey frames, and are ")
        elif self._in_colour and not self._strayed and self.colour_map != LUMINANCE:
            self._strayed = strays(frame.pixels, self.colour_map)
            if self._strayed:
                self._note(
                    f"from {frame.name} on colours are not of the map {self.colour_map}, by which "
                    "they are read; if the map was changed, run each part as a log of its own"
                )
        return self.colour_map

    def _find_amplitudes(self, first: Sequence[Frame]) -> None:
        """Find the integer types that hold amplitudes; notes name them, and images that are dim."""
        images: dict[np.dtype[Any], list[np.ndarray]] = {}
        white = next((frame.white for frame in first if frame.white), None)
        for frame in first:
            if (grey := _grey_of_integers(frame, self.colour_map)) is not None:
                images.setdefault(grey.dtype, []).append(grey)
        for dtype, of_type in images.items():
            bits = 8 * dtype.itemsize
            if holds_amplitudes(of_type):
                self._amplitudes.add(dtype)
                self._note(
                    f"{bits}-bit pixels read as amplitudes, by their level and its "
                    "spread; --pixel-scale linear if they are logarithms"
                )
                continue
            dim = dim_level(of_type[0], white) if bits == 16 else None
            if dim and self._stated.full_scale is None:
                self._note(
                    f"{bits}-bit pixels read as grey levels, though dim ({dim}); --pixel-scale "
                    "log if they are amplitudes, or a lower full_scale in sonar.toml"
                )

    def _near_first(self, image: ByteImage) -> ByteImage:
        """A polar image with its nearest row on top."""
        is_far_first = self._stated.range_order == "far_first"
        return np.ascontiguousarray(image[::-1]) if is_far_first else image

    def _image(self, image: ByteImage) -> ByteImage:
        """The fan or polar image of a frame that does not state its geometry."""
        after_pings = self._shape is None and self.fan is not None
        if after_pings or self._stated.missing():
            raise UnusableError("it does not tell its geometry, as other messages of its topic do")
        if self.sonar.layout == "polar":
            if self.sonar.beam_order == "beam-major":
                image = np.ascontiguousarray(image.T)
            image = self._near_first(image)
        elif self._stated.range_order == "near_first":  # upside down
            image = np.ascontiguousarray(image[::-1])
        if self._shape is None:
            self._begin(image.shape)
            self._shape = image.shape
        (rows, columns), usual = image.shape, self._shape
        if image.shape != usual:
            raise UnusableError(f"{columns} x {rows} pixels in a log of {usual[1]} x {usual[0]}")
        if self._to_fan is not None or not self.sonar.flip:
            return image
        return np.ascontiguousarray(image[:, ::-1])

    def _begin(self, shape: tuple[int, int]) -> None:
        """Take the fan from the geometry that is stated, for images of this shape."""
        geometry = self.sonar.complete(self._where)
        view, bearings = self.sonar.field_of_view_deg, geometry.bearings_deg
        theirs = geometry.bearing_max_deg - geometry.bearing_min_deg
        # Some count from the middle of the first beam to that of the last, a beam less.
        if view and bearings and abs(view - theirs) > 1.01 * theirs / len(bearings):
            self._note(
                f"field_of_view_deg = {view:g} is not used: bearings_deg go before "
                f"it, and cover {theirs:.4g} deg"
            )
        if self.sonar.layout == "polar":
            self._to_fan = self._resampler(geometry, shape)
            self.fan = self._to_fan.fan
        else:
            self.fan = fan_for_image(geometry, *shape)

    def _ping(self, image: ByteImage, ping: PingGeometry) -> ByteImage:
        """The polar image of a frame that states its geometry."""
        if self._shape is not None:
            raise UnusableError("it tells its geometry, as the first messages of its topic do not")
        order = self._order or self._stated.beam_order or ping.beam_order
        if order is None and image.any():  # nothing can be found from a blank ping
            order = "beam-major" if looks_beam_major(image) else "range-major"
        if order == "beam-major":
            image = np.ascontiguousarray(image.reshape(image.shape[::-1]).T)
        image = self._near_first(image)
        # Evenly spaced bins do not state their number.
        before, shape = self._to_fan_of or (None, (0, 0))
        if before is None or shape != image.shape or not same_view(ping, before, shape[0]):
            sonar, self._to_fan = self._ping_resampler(ping, image.shape)
            self._to_fan_of = ping, image.shape
            if self.fan is None:
                self.sonar, self.fan = sonar, self._to_fan.fan
        if self._order is None and order is not None:
            self._order = order
            self.sonar = replace(self.sonar, beam_order=order)
            if not (self._stated.beam_order or ping.beam_order):
                self.order_from = "assumed" if image.shape[0] == image.shape[1] else "found"
                if self.order_from == "assumed":
                    self._note(
                        f"assumed to be {order}, which cannot be found of as many range "
                        f"bins as beams ({len(image)}); --beam-order states it"
                    )
                elif order == "beam-major":
                    self._note("read as beam-major, found from its first ping with echoes")
        return image

    def _ping_resampler(
        self, ping: PingGeometry, shape: tuple[int, int]
    ) -> tuple[Sonar, PolarToFan]:
        """(the geometry of a ping as far as the user does not state another, its resampler). shape:
        (bins, beams). Raises UnusableError if the ping cannot be shown in the log's fan,
        SonarrecError if what is stated does not fit the log."""
        sonar, against = _as_stated(ping, self._stated, bins=shape[0])
        try:
            geometry = sonar.complete(self._where)
            window = fan_for_polar(geometry, shape[0])
            if window.rows * window.columns > MAX_FAN_PIXELS:
                raise UnusableError(
                    f"its window, {window.range_min_m:.6g} to {window.range_max_m:.6g} m in "
                    f"{shape[0]} bins, makes a fan of {window.columns} x {window.rows} pixels"
                )
            to_fan = self._resampler(geometry, shape, self.fan)
        except SonarrecError as error:
            if self.fan is None:  # what is stated does not fit the log
                raise
            raise UnusableError(str(error).partition("\n")[0]) from None
        fan = to_fan.fan
        if not _covers(_ranges(window), _ranges(fan)):
            raise UnusableError(
                f"its window, {window.range_min_m:.3g} to {window.range_max_m:.3g} m, shows less "
                f"than half of the log's, {fan.range_min_m:.3g} to {fan.range_max_m:.3g} m"
            )
        in_fan = (_covers(of(fan), of(window)) for of in (_ranges, _bearings))
        if not self._noted_cut and not all(in_fan):
            self._noted_cut = True
            self._note(
                f"a ping shows {_extent(window)}; of that only what is in the fan "
                f"of the first pings, {_extent(fan)}, is used"
            )
        if against and not self._noted_against:
            self._noted_against = True
            self._note(f"stated against the {self._origin}: {', '.join(against)}")
        return sonar, to_fan

    def _resampler(
        self, geometry: Geometry, shape: tuple[int, int], fan: Fan | None = None
    ) -> PolarToFan:
        """The resampler for polar images of this shape (bins, beams). fan: of the log, if known.
        Raises SonarrecError as PolarToFan does. Without a fan the message names the log."""
        try:
            return PolarToFan(geometry, *shape, fan)
        except SonarrecError as error:
            if fan is not None:
                raise
            raise SonarrecError(f"{self._where}: {error}") from None


def _in_colour(pixels: np.ndarray) -> bool:
    """Whether these are 8-bit pixels with several channels that are not all grey."""
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    return pixels.dtype == np.uint8 and channels in (3, 4) and is_coloured(pixels)


def _grey_of_integers(frame: Frame, colour_map: str) -> np.ndarray | None:
    """The grey levels of integer pixels, whose speckle tells what they hold; None for others."""
    pixels = frame.pixels
    if pixels is not None and pixels.dtype.kind in "ui" and pixels.itemsize <= 2:
        with contextlib.suppress(UnusableError):
            grey = single_channel(pixels, colour_map)
            deep = grey.itemsize == 2 and grey.any() and not next_to_black(grey, frame.white)
            if grey.dtype == np.uint8 or deep:
                return grey
    return None


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


def _agree(a: PingGeometry, b: PingGeometry) -> bool:
    """Whether two pings each show enough of the other's window and field of view."""
    pairs = ((a, b), (b, a))
    return all(_covers(of(x), of(y)) for of in (_ranges, _bearings) for x, y in pairs)


def same_view(a: PingGeometry, b: PingGeometry, bins: int) -> bool:
    """Whether images of so many bins show the same positions, to SAME_BINS, in two pings."""
    if a == b:
        return True
    in_a = replace(b, range_min_m=a.range_min_m, range_max_m=a.range_max_m, ranges_m=a.ranges_m)
    of_a, of_b = (np.array([*_ranges(p), *(p.ranges_m or ())]) for p in (a, b))
    if in_a != a or len(of_a) != len(of_b):
        return False
    bin_m = (a.range_max_m - a.range_min_m) / bins
    return bool(np.abs(of_a - of_b).max() <= SAME_BINS * bin_m)


def _extent(fan: Fan) -> str:
    """A fan's window and field of view, for a line."""
    view_deg = fan.bearing_max_deg - fan.bearing_min_deg
    return f"{fan.range_min_m:.3g} to {fan.range_max_m:.3g} m and {view_deg:.3g} deg"


def _as_stated(ping: PingGeometry, stated: Sonar, bins: int) -> tuple[Sonar, list[str]]:
    """A ping's geometry, replaced by what the user states, and a text for each contradiction.
    Ranges that agree to half a bin, and a field of view to half a beam, contradict nothing."""
    against = []
    if stated.layout == "fan":
        against.append('layout = "fan" (they are polar, and read so)')
    keys = ("range_min_m", "range_max_m", "bearings_deg", "ranges_m", "beam_order")
    theirs = Sonar(layout="polar", **{key: getattr(ping, key) for key in keys})
    sonar = theirs.updated(replace(stated, layout=None))
    bin_m = (ping.range_max_m - ping.range_min_m) / bins
    for key in keys[:2]:
        mine, of_ping = getattr(stated, key), getattr(ping, key)
        if mine is None:
            continue
        if abs(mine - of_ping) > bin_m / 2:
            against.append(f"{key} = {mine:g} (not {of_ping:.4g})")
            sonar = replace(sonar, ranges_m=stated.ranges_m)
        elif stated.ranges_m is None and ping.ranges_m is not None:
            sonar = replace(sonar, **{key: of_ping})  # which fits the middles of the bins
    bearings = np.asarray(ping.bearings_deg)
    beam_deg = float(np.ptp(bearings)) / (len(bearings) - 1)
    if stated.bearings_deg is not None:
        mine = np.asarray(stated.bearings_deg)
        if mine.shape != bearings.shape or np.abs(mine - bearings).max() > beam_deg / 2:
            against.append("bearings_deg")
        return sonar, against
    view, theirs_deg = stated.field_of_view_deg, beam_deg * len(bearings)
    if view is not None and abs(view - theirs_deg) > beam_deg / 2:
        against.append(f"field_of_view_deg = {view:g} (not {theirs_deg:.4g})")
        sonar = replace(sonar, bearings_deg=None)
    return sonar, against


def looks_beam_major(image: ByteImage) -> bool:
    """Whether samples that were taken to be range-major, (bins, beams), are beam-major instead. In
    range-major data the sample `beams` places later is the next range bin of the same beam; in
    beam-major data the sample `bins` places later is the next beam at the same range. Such a sample
    resembles the first one more than the samples around it do. If this decides nothing, as with
    equal numbers of bins and beams, the data are taken to be range-major, as most are."""
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
