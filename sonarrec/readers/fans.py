"""Turns what a log holds into 8-bit images of one fan: fan images, or polar ones that fill it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from sonarrec.geometry import MAX_FAN_PIXELS, PolarToFan, fan_for_image, fan_for_polar
from sonarrec.readers.pixels import (
    GreyScale,
    dim_level,
    grey_scale,
    holds_amplitudes,
    next_to_black,
    single_channel,
    to_grey8,
)
from sonarrec.readers.raw import RawFrame, UnusableError
from sonarrec.records import ByteImage, Fan, SonarrecError
from sonarrec.sonar import BeamOrder, Geometry, PingGeometry, Sonar

MIN_SHARED_WINDOW = 0.5
"""A ping whose window covers less of the fan's is not used."""


class FanImages:
    """Makes the images of one log; the first frame settles the fan and the grey scale.

    A polar message tells its own window, which may change from ping to ping: later pings lie in the
    fan of the first (see `settle`), so that a metre stays a metre, and show 0 where they hold
    nothing. What the user states goes before what messages tell.

    sonar: the geometry, of polar messages that of the first ping once it was read. fan: None
    before the first frame. notes: lines on what was stated against the messages, or found out.
    order_from: "found" or "assumed", of a beam order that nobody told; None of another.
    """

    def __init__(self, stated: Sonar, where: str, tells: str = "messages") -> None:
        """stated: by the user; complete where frames do not tell their geometry. where: names it
        in errors. tells: what of the log it is that tells the rest."""
        self.sonar = stated
        self._stated = stated
        self.fan: Fan | None = None
        self.notes: list[str] = []
        self.order_from: str | None = None
        self._where = where
        self._tells = tells
        self._scales: dict[np.dtype[Any], GreyScale] = {}  # one for each type of pixel
        self._shape: tuple[int, ...] | None = None
        self._resampled: tuple[PingGeometry, tuple[int, int]] | None = None  # what, and its shape
        self._to_fan: PolarToFan | None = None
        self._order: BeamOrder | None = None  # of polar samples; None before it is found
        self._amplitudes = set[np.dtype[Any]]()  # types of integers that hold them
        self._told_against = self._told_cut = False

    def __call__(self, raw: RawFrame) -> tuple[ByteImage, Fan, PolarToFan | None]:
        """A Frame's `pixels`, `fan` and `polar`.

        Raises UnusableError where the frame cannot be used, SonarrecError where the geometry
        cannot be that of the log.
        """
        if raw.pixels is None:
            raise UnusableError(str(raw.problem))
        pixels = single_channel(raw.pixels)
        scale = self._scales.get(pixels.dtype)
        if scale is None:
            told = raw.sonar is not None and pixels.dtype.kind == "f"
            amplitudes = told or pixels.dtype in self._amplitudes
            scale = grey_scale(self._stated, pixels, amplitudes)
        image = np.zeros(pixels.shape, np.uint8) if scale is None else to_grey8(pixels, scale)
        image = self._image(image) if raw.sonar is None else self._ping(image, raw.sonar)
        if scale is not None:
            self._scales[pixels.dtype] = scale
        assert self.fan is not None
        return image, self.fan, self._to_fan

    def settle(self, first: Sequence[RawFrame]) -> None:
        """Find out what integers are, and take the fan from the ping with which most agree.

        That need not be the first: a driver may send one before it has its settings. Two pings
        agree where each shows enough of the other's window and field of view. first: the log's
        first frames.
        """
        if self._stated.pixel_scale is None:
            self._find_amplitudes(first)
        pings = [(raw, raw.sonar) for raw in first if raw.pixels is not None and raw.sonar]
        agreeing = [
            sum(
                _shows(a, b) and _shows(b, a) and _as_wide(a, b) and _as_wide(b, a)
                for _, b in pings
            )
            for _, a in pings
        ]
        if agreeing and (best := int(np.argmax(agreeing))):
            with contextlib.suppress(UnusableError):
                self(pings[best][0])

    def _find_amplitudes(self, first: Sequence[RawFrame]) -> None:
        """Find the types of integers that hold amplitudes, and note them and what is dim."""
        images: dict[np.dtype[Any], list[np.ndarray]] = {}
        for raw in first:
            if (grey := _grey_of_integers(raw)) is not None:
                images.setdefault(grey.dtype, []).append(grey)
        for dtype, alike in images.items():
            bits = 8 * dtype.itemsize
            if holds_amplitudes(alike):
                self._amplitudes.add(dtype)
                self.notes.append(
                    f"{self._where}: {bits}-bit pixels read as amplitudes, by their level and its "
                    "spread; --pixel-scale linear if they are logarithms"
                )
            elif bits == 16 and self._stated.full_scale is None and (dim := dim_level(alike[0])):
                self.notes.append(
                    f"{self._where}: {bits}-bit pixels read as grey levels, though dim ({dim}); "
                    "--pixel-scale log if they are amplitudes, --full-scale if white is lower"
                )

    @property
    def scale(self) -> GreyScale | None:
        """How pixels become grey; None before the first frame that settles it."""
        return next(iter(self._scales.values()), None)

    def _image(self, image: ByteImage) -> ByteImage:
        """The fan or polar image of a frame that does not tell its geometry."""
        after_pings = self._shape is None and self.fan is not None
        if after_pings or self._stated.missing():
            raise UnusableError("it does not tell its geometry, as other messages of its topic do")
        polar = self.sonar.layout == "polar"
        if polar and self.sonar.beam_order == "beam-major":
            image = np.ascontiguousarray(image.T)
        if self._shape is None:
            geometry = self.sonar.complete(self._where)
            self._note_other_view(geometry)
            if polar:
                self._to_fan = self._resampler(geometry, image.shape)
                self.fan = self._to_fan.fan
            else:
                self.fan = fan_for_image(geometry, *image.shape)
            self._shape = image.shape
        if image.shape != self._shape:
            raise UnusableError(
                f"{image.shape[1]} x {image.shape[0]} pixels in a log of "
                f"{self._shape[1]} x {self._shape[0]}"
            )
        if self._to_fan is not None or not self.sonar.flip:
            return image
        return np.ascontiguousarray(image[:, ::-1])

    def _note_other_view(self, geometry: Geometry) -> None:
        """Note a stated field of view that is not that of the bearings stated beside it."""
        view, bearings = self.sonar.field_of_view_deg, geometry.bearings_deg
        if view is None or bearings is None:
            return
        theirs = geometry.bearing_max_deg - geometry.bearing_min_deg
        # From the middle of the first beam to that of the last, it is a beam less.
        if abs(view - theirs) > 1.01 * theirs / len(bearings):
            self.notes.append(
                f"{self._where}: field_of_view_deg = {view:g} is not used: bearings_deg go before "
                f"it, and cover {theirs:.4g} deg"
            )

    def _ping(self, image: ByteImage, told: PingGeometry) -> ByteImage:
        """The polar image of a frame that tells its geometry."""
        if self._shape is not None:
            raise UnusableError("it tells its geometry, as the first messages of its topic do not")
        order = self._order or self._stated.beam_order or told.beam_order
        if order is None and image.any():  # a blank ping decides nothing
            order = "beam-major" if looks_beam_major(image) else "range-major"
        if order == "beam-major":
            image = np.ascontiguousarray(image.reshape(image.shape[::-1]).T)
        if (told, image.shape) != self._resampled:  # even bins do not tell their number
            sonar, self._to_fan = self._resampling(told, image.shape)
            self._resampled = told, image.shape
            if self.fan is None:
                self.sonar, self.fan = sonar, self._to_fan.fan
        if self._order is None and order is not None:
            self._order = order
            self.sonar = replace(self.sonar, beam_order=order)
            if not (self._stated.beam_order or told.beam_order):
                self._note_order(order, image.shape)
        return image

    def _note_order(self, order: BeamOrder, shape: tuple[int, int]) -> None:
        """Note an order that nobody told, unless it is the usual one. shape: (bins, beams)."""
        if shape[0] == shape[1]:
            self.order_from = "assumed"
            self.notes.append(
                f"{self._where}: assumed to be {order}, which cannot be found of as many range "
                f"bins as beams ({shape[0]}); --beam-order states it"
            )
            return
        self.order_from = "found"
        if order == "beam-major":
            self.notes.append(
                f"{self._where}: read as beam-major, found from its first ping with echoes"
            )

    def _resampling(self, told: PingGeometry, shape: tuple[int, int]) -> tuple[Sonar, PolarToFan]:
        sonar, against = _as_stated(told, self._stated, bins=shape[0])
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
        if not _shows(window, fan):
            raise UnusableError(
                f"its window, {window.range_min_m:.3g} to {window.range_max_m:.3g} m, shows less "
                f"than half of the log's, {fan.range_min_m:.3g} to {fan.range_max_m:.3g} m"
            )
        if not self._told_cut and not (_shows(fan, window) and _as_wide(fan, window)):
            self._told_cut = True
            self.notes.append(
                f"{self._where}: a ping shows {_extent(window)}; of that only what is in the fan "
                f"of the first pings, {_extent(fan)}, is used"
            )
        if against and not self._told_against:
            self._told_against = True
            line = f"{self._where}: stated against the {self._tells}: {', '.join(against)}"
            self.notes.append(line)
        return sonar, to_fan

    def _resampler(
        self, geometry: Geometry, shape: tuple[int, ...], fan: Fan | None = None
    ) -> PolarToFan:
        """What resamples polar images of this shape. fan: of the log, where it has one.

        Raises SonarrecError as PolarToFan does, and names the log unless a ping of it is at fault.
        """
        bins, beams = shape
        try:
            return PolarToFan(geometry, bins, beams, fan)
        except SonarrecError as error:
            if fan is not None:
                raise
            raise SonarrecError(f"{self._where}: {error}") from None


def _grey_of_integers(raw: RawFrame) -> np.ndarray | None:
    """The pixels where their speckle is to tell what they hold; None of others."""
    if raw.pixels is None or raw.pixels.dtype.kind not in "ui" or raw.pixels.itemsize > 2:
        return None
    with contextlib.suppress(UnusableError):
        grey = single_channel(raw.pixels)
        if grey.dtype == np.uint8 or (
            grey.itemsize == 2 and grey.any() and not next_to_black(grey)
        ):
            return grey
    return None


def _shows(window: Fan | PingGeometry, other: Fan | PingGeometry) -> bool:
    """Whether a range window covers enough of another."""
    near = max(window.range_min_m, other.range_min_m)
    far = min(window.range_max_m, other.range_max_m)
    return far - near >= MIN_SHARED_WINDOW * (other.range_max_m - other.range_min_m)


def _as_wide(window: Fan | PingGeometry, other: Fan | PingGeometry) -> bool:
    """Whether a field of view covers enough of another."""
    (left, right), (from_deg, to_deg) = _bearings(window), _bearings(other)
    return min(right, to_deg) - max(left, from_deg) >= MIN_SHARED_WINDOW * (to_deg - from_deg)


def _bearings(window: Fan | PingGeometry) -> tuple[float, float]:
    if isinstance(window, Fan):
        return window.bearing_min_deg, window.bearing_max_deg
    return min(window.bearings_deg), max(window.bearings_deg)


def _extent(fan: Fan) -> str:
    return (
        f"{fan.range_min_m:.3g} to {fan.range_max_m:.3g} m and "
        f"{fan.bearing_max_deg - fan.bearing_min_deg:.3g} deg"
    )


def _as_stated(told: PingGeometry, stated: Sonar, bins: int) -> tuple[Sonar, list[str]]:
    """A message's geometry with what the user states in its place, and where they contradict.

    Ranges that agree to half a bin, and a field of view to half a beam, contradict nothing.
    """
    against = []
    if stated.layout == "fan":
        against.append('layout = "fan" (they are polar, and read so)')
    sonar = told.as_sonar().updated(replace(stated, layout=None))
    bin_m = (told.range_max_m - told.range_min_m) / bins
    for key in ("range_min_m", "range_max_m"):
        mine, theirs = getattr(stated, key), getattr(told, key)
        if mine is None:
            continue
        if abs(mine - theirs) > bin_m / 2:
            against.append(f"{key} = {mine:g} (not {theirs:.4g})")
            sonar = replace(sonar, ranges_m=stated.ranges_m)
        elif stated.ranges_m is None and told.ranges_m is not None:
            sonar = replace(sonar, **{key: theirs})  # the bins' own middles end there
    bearings = np.asarray(told.bearings_deg)
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

    In range-major data the sample `beams` on is the next range bin of the same beam, in beam-major
    data the one `bins` on is the next beam at the same range: it resembles the first more than its
    own neighbours there do. Data that decide nothing are range-major, as most are, and so are as
    many bins as beams, where the two are the same sample.
    """
    bins, beams = image.shape
    samples = image.ravel()
    if bins == beams:
        return False
    by_range, by_beam = _resemblance(samples, beams), _resemblance(samples, bins)
    chance = max(0.03, 4 / math.sqrt(samples.size))  # three sigma, where there is only noise
    return by_beam < 1 - chance and by_beam < by_range


def _resemblance(samples: np.ndarray, lag: int) -> float:
    """Mean difference of samples `lag` apart over that of samples a little nearer and farther."""
    off = max(1, min(8, lag // 3))  # farther than a spot is wide
    at, near, far = (
        float(np.mean(cv2.absdiff(samples[k:], samples[:-k]))) for k in (lag, lag - off, lag + off)
    )
    return 2 * at / (near + far) if near + far else 1.0
