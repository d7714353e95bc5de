"""Turns the raw frames of a log into 8-bit images of one fan, or polar images for that fan."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sonarrec.arrays import ByteImage
from sonarrec.errors import Diagnostics, SonarrecError
from sonarrec.geometry import MAX_FAN_PIXELS, PolarToFan, fan_for_image, fan_for_polar
from sonarrec.nouns import Fan
from sonarrec.readers.decode.colour import LUMINANCE, find_map, is_coloured
from sonarrec.readers.decode.grey import (
    GreyScale,
    dim_level,
    grey_scale,
    holds_amplitudes,
    next_to_black,
    single_channel,
    to_grey8,
)
from sonarrec.readers.decode.ping_geometry import (
    agree,
    as_stated,
    as_wide,
    extent,
    looks_beam_major,
    same_view,
    shows,
)
from sonarrec.readers.guess.height import height_from_images
from sonarrec.readers.raw import RawFrame, UnusableError, showing
from sonarrec.sonar import BeamOrder, Geometry, PingGeometry, Sonar

MANY_SKIPPED = 10  # pings of another window: then the sonar was set to it, and a note says so


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
        self.sonar = stated
        self._stated = stated
        self.fan: Fan | None = None
        self._note = diagnostics.note
        self.order_from: str | None = None
        self._where = where
        self._origin = origin
        self._scales: dict[np.dtype[Any], GreyScale] = {}  # one for each type of pixel
        self._shape: tuple[int, ...] | None = None
        # Geometry and shape of the pings for which _to_fan was made.
        self._to_fan_of: tuple[PingGeometry, tuple[int, int]] | None = None
        self._to_fan: PolarToFan | None = None
        self._order: BeamOrder | None = None  # of polar samples; None before it is found
        self.colour_map: str = stated.colour_map or LUMINANCE
        self._in_colour = False  # whether a frame was
        self._amplitudes = set[np.dtype[Any]]()  # types of integers that hold them
        self._noted_against = self._noted_cut = False
        self._skipped = 0  # pings that show too little of the fan

    def __call__(self, raw: RawFrame) -> tuple[ByteImage, Fan, PolarToFan | None]:
        """The fields `pixels`, `fan` and `polar` of a Frame. Raises UnusableError if the frame
        cannot be used, SonarrecError if the geometry does not fit the log."""
        if raw.pixels is None:
            raise UnusableError(str(raw.problem))
        pixels = single_channel(raw.pixels, self._map_of(raw))
        scale = self._scales.get(pixels.dtype)
        if scale is None:
            of_ping = raw.sonar is not None and pixels.dtype.kind == "f"
            amplitudes = of_ping or pixels.dtype in self._amplitudes
            scale = grey_scale(self._stated, pixels, amplitudes, raw.white)
        image = np.zeros(pixels.shape, np.uint8) if scale is None else to_grey8(pixels, scale)
        image = self._image(image) if raw.sonar is None else self._ping(image, raw.sonar)
        if scale is not None:
            self._scales[pixels.dtype] = scale
        assert self.fan is not None
        return image, self.fan, self._to_fan

    def settle(self, first: Sequence[RawFrame]) -> None:
        """Find out what the pixels hold, and take the fan from the ping that most pings agree with.

        It need not be the first ping, since a driver may send one before it has its settings. A
        height that nobody states is estimated.
        first: the log's first frames. Raises SonarrecError if the geometry does not fit the log.
        """
        first = showing(first)
        in_colour = [
            raw.pixels for raw in first if raw.pixels is not None and _in_colour(raw.pixels)
        ]
        if self._stated.colour_map is None and in_colour:
            self._in_colour = True
            self._find_map(in_colour)
        if self._stated.pixel_scale is None:
            self._find_amplitudes(first)
        pings = [(raw, raw.sonar) for raw in first if raw.pixels is not None and raw.sonar]
        agreeing = [sum(agree(a, b) for _, b in pings) for _, a in pings]
        if agreeing:
            with contextlib.suppress(UnusableError):
                self(pings[int(np.argmax(agreeing))][0])
        if self._stated.height_m is not None:
            return
        images = []
        for raw in first:
            with contextlib.suppress(UnusableError):
                image, _, polar = self(raw)
                if image.any():
                    images.append(image if polar is None else polar(image))
        if self.fan is not None and images:
            self.fan = replace(self.fan, height_m=height_from_images(images, self.fan))
        if self._to_fan is not None:
            self._to_fan.forget()  # a run makes no more fan images

    def _find_map(self, pictures: Sequence[np.ndarray], since: str = "") -> None:
        """Find the colour map of pictures; a note names it. since: the frame, if not the first."""
        self.colour_map = find_map(pictures) or LUMINANCE
        how = f"read as levels of the colour map {self.colour_map}"
        if self.colour_map == LUMINANCE:
            how = "of no known colour map, and read by their luminance"
        self._note(f"colours {since}{how}; colour_map in sonar.toml states another")

    def _map_of(self, raw: RawFrame) -> str:
        """The colour map of the log. If the first frames were grey, the first coloured one tells
        it."""
        if not (self._stated.colour_map or self._in_colour or raw.pixels is None):
            self._in_colour = _in_colour(raw.pixels)
            if self._in_colour:
                self._find_map([raw.pixels], f"begin at {raw.name} after grey frames, and are ")
        return self.colour_map

    def _find_amplitudes(self, first: Sequence[RawFrame]) -> None:
        """Find the integer types that hold amplitudes; notes name them, and images that are dim."""
        images: dict[np.dtype[Any], list[np.ndarray]] = {}
        white = next((raw.white for raw in first if raw.white), None)
        for raw in first:
            if (grey := _grey_of_integers(raw, self.colour_map)) is not None:
                images.setdefault(grey.dtype, []).append(grey)
        for dtype, alike in images.items():
            bits = 8 * dtype.itemsize
            if holds_amplitudes(alike):
                self._amplitudes.add(dtype)
                self._note(
                    f"{bits}-bit pixels read as amplitudes, by their level and its "
                    "spread; --pixel-scale linear if they are logarithms"
                )
            elif (
                bits == 16
                and self._stated.full_scale is None
                and (dim := dim_level(alike[0], white))
            ):
                self._note(
                    f"{bits}-bit pixels read as grey levels, though dim ({dim}); "
                    "--pixel-scale log if they are amplitudes, or a lower full_scale in sonar.toml"
                )

    @property
    def scale(self) -> GreyScale | None:
        """How pixels become grey; None before the first usable frame."""
        return next(iter(self._scales.values()), None)

    def _image(self, image: ByteImage) -> ByteImage:
        """The fan or polar image of a frame that does not state its geometry."""
        after_pings = self._shape is None and self.fan is not None
        if after_pings or self._stated.missing():
            raise UnusableError("it does not tell its geometry, as other messages of its topic do")
        polar = self.sonar.layout == "polar"
        if polar and self.sonar.beam_order == "beam-major":
            image = np.ascontiguousarray(image.T)
        if polar:
            image = self._near_first(image)
        if self._shape is None:
            geometry = self.sonar.complete(self._where)
            view, bearings = self.sonar.field_of_view_deg, geometry.bearings_deg
            theirs = geometry.bearing_max_deg - geometry.bearing_min_deg
            # Some count from the middle of the first beam to that of the last, a beam less.
            if view and bearings and abs(view - theirs) > 1.01 * theirs / len(bearings):
                self._note(
                    f"field_of_view_deg = {view:g} is not used: bearings_deg go before "
                    f"it, and cover {theirs:.4g} deg"
                )
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

    def _near_first(self, image: ByteImage) -> ByteImage:
        """A polar image with its nearest row on top."""
        is_far_first = self._stated.range_order == "far_first"
        return np.ascontiguousarray(image[::-1]) if is_far_first else image

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
            if self._stated.beam_order or ping.beam_order:
                return image
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
        sonar, against = as_stated(ping, self._stated, bins=shape[0])
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
        if not shows(window, fan):
            self._skipped += 1
            if self._skipped == MANY_SKIPPED:
                flags = f"--range-min-m {window.range_min_m:.5g}"
                flags += f" --range-max-m {window.range_max_m:.5g}"
                if self._stated.height_m is None:  # else that of the first pings would be estimated
                    flags += " --height-m H"
                self._note(
                    f"the sonar's range was changed, and pings that show too little of that "
                    f"of the first ones are skipped; to read those, run them by themselves, with "
                    f"--frames A:B {flags} and an --out of their own"
                )
            raise UnusableError(
                f"its window, {window.range_min_m:.3g} to {window.range_max_m:.3g} m, shows less "
                f"than half of the log's, {fan.range_min_m:.3g} to {fan.range_max_m:.3g} m"
            )
        if not self._noted_cut and not (shows(fan, window) and as_wide(fan, window)):
            self._noted_cut = True
            self._note(
                f"a ping shows {extent(window)}; of that only what is in the fan "
                f"of the first pings, {extent(fan)}, is used"
            )
        if against and not self._noted_against:
            self._noted_against = True
            self._note(f"stated against the {self._origin}: {', '.join(against)}")
        return sonar, to_fan

    def _resampler(
        self, geometry: Geometry, shape: tuple[int, ...], fan: Fan | None = None
    ) -> PolarToFan:
        """The resampler for polar images of this shape (bins, beams). fan: of the log, if known.
        Raises SonarrecError as PolarToFan does. Without a fan the message names the log."""
        bins, beams = shape
        try:
            return PolarToFan(geometry, bins, beams, fan)
        except SonarrecError as error:
            if fan is not None:
                raise
            raise SonarrecError(f"{self._where}: {error}") from None


def _in_colour(pixels: np.ndarray) -> bool:
    """Whether these are 8-bit pixels with several channels that are not all grey."""
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    return pixels.dtype == np.uint8 and channels in (3, 4) and is_coloured(pixels)


def _grey_of_integers(raw: RawFrame, colour_map: str) -> np.ndarray | None:
    """The grey levels of integer pixels, whose speckle tells what they hold; None for others."""
    if raw.pixels is None or raw.pixels.dtype.kind not in "ui" or raw.pixels.itemsize > 2:
        return None
    with contextlib.suppress(UnusableError):
        grey = single_channel(raw.pixels, colour_map)
        if grey.dtype == np.uint8 or (
            grey.itemsize == 2 and grey.any() and not next_to_black(grey, raw.white)
        ):
            return grey
    return None
