"""Composites discs into real frames: the frame's own speckle and light, the disc's pattern.

Grey is logarithmic: 255 levels cover the dynamic range in dB. With P as the power of the echoes, a
pixel of a disc is

    P / mean of P over the fine scale * mean of P over the light's scale * gain

This keeps the speckle and the light. The fine scale is a third of the disc's radius (5 cm for a
disc of 0.15 m), but at least FINE_BEAMS beam widths; the light's scale is 7/3 of the radius
(35 cm). Texture of the floor between these scales is dropped, because the disc covers the floor.
The gain is one level over the floor for ring and sectors and another for the plate. It is smeared
as the sonar smears: across the line of sight by the beam width, along it by SMEAR_M. Where the
smear reaches beyond the disc's edge, disc and frame are mixed by the disc's share of the pixel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray, FloatImage
from sonarrec.geometry import (
    fan_mask,
    floor_depth,
    ground_range,
    pixel_from_polar,
    polar_from_pixel,
    slant_range,
)
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Fan
from sonarrec.simulation.motion import Pose

FINE, LIGHT = 1 / 3, 7 / 3  # scales, in radii of the disc
# The fine mean must cover several cells of speckle. A mean over a single cell would remove the
# speckle, and a disc without speckle would be easier to recognise than a real one.
FINE_BEAMS = 5  # beam widths, in the middle of the window
LEAST_FINE_PX = 5
SMEAR_M = 0.02  # full width at half maximum along the range: a pulse
_HALF_POWER = 2 * math.sqrt(2 * math.log(2))  # full width at half maximum of a Gaussian, in sigmas
_TAIL = 2.0  # sigmas at which the smear ends; pixels beyond stay unchanged
_SAMPLES_PER_RADIUS = 40  # of the pattern, at least

DiscKind = Literal["landmark", "blank", "filled"]


@dataclass(frozen=True, slots=True)
class CompositeDisc:
    """A disc on the floor: a landmark, or a fake, which is blank or bright all over (filled).

    landmark: the ID; 0 for a fake. x_m, y_m: its centre, to the right and ahead of the sonar in the
    first frame. orientation_deg: counter-clockwise from the sonar's right in the first frame, seen
    from above.
    """

    kind: DiscKind
    landmark: int
    x_m: float
    y_m: float
    orientation_deg: float

    def seen_from(self, pose: Pose) -> tuple[float, float]:
        """(ground range in m, bearing in deg) of the disc's centre."""
        dx, dy = self.x_m - pose.x_m, self.y_m - pose.y_m
        bearing = math.degrees(math.atan2(dx, dy)) - pose.pan_deg
        return math.hypot(dx, dy), (bearing + 180) % 360 - 180


@dataclass(frozen=True, slots=True)
class Footprint:
    """The pixels that a disc covers in a frame.

    box: rows and columns. share: (box) 0 to 1, how much of each pixel is disc, smear included.
    bright: (box) 0 to 1, how much of each pixel is ring or sector.
    """

    box: tuple[slice, slice]
    share: FloatImage
    bright: FloatImage


class Composer:
    """Composites discs of one landmark set into fan images of one geometry."""

    def __init__(
        self, fan: Fan, landmarks: LandmarkSet, dynamic_range_db: float, beam_width_deg: float
    ) -> None:
        """dynamic_range_db: from black to white."""
        self.fan, self._landmarks = fan, landmarks
        self._db = dynamic_range_db / 255
        power = np.power(10, np.arange(256) * self._db / 10)
        power[0] = 0  # black holds no echo to be amplified
        self._power = power.astype(np.float32)
        self._beam_deg = max(beam_width_deg, 1e-3)
        self._inside = (fan_mask(fan) > 0).astype(np.float32)
        row, column = np.mgrid[0 : fan.rows, 0 : fan.columns].astype(float)
        range_m, bearing_deg = polar_from_pixel(fan, column, row)
        self._range = range_m.astype(np.float32)
        self._bearing = bearing_deg.astype(np.float32)
        radius_px = landmarks.radius_m / fan.metres_per_pixel
        middle_px = (fan.range_min_m + fan.range_max_m) / 2 / fan.metres_per_pixel
        cells_px = FINE_BEAMS * math.radians(self._beam_deg) * middle_px
        # The fine scale stays below a third of the light's, so that light is not taken for speckle.
        cells_px = min(cells_px, LIGHT * radius_px / 3)
        fine = _odd(max(FINE * radius_px, cells_px, LEAST_FINE_PX))
        self._scales = fine, _odd(max(LIGHT * radius_px, 3 * fine))
        self._seen = [_box_mean(self._inside, width) for width in self._scales]

    def compose(
        self,
        image: ByteImage,
        discs: Sequence[CompositeDisc],
        pose: Pose,
        contrasts_db: Sequence[float],
        plate_db: float,
    ) -> dict[float, ByteImage]:
        """A frame with discs on it, by contrast. Pixels that no disc covers are unchanged.

        image: (fan.rows, fan.columns) uint8. contrasts_db: levels of ring and sectors over the
        floor. plate_db: level of the plate.
        """
        power = self._power[image] * self._inside  # 0 where the frame is black
        fine, light = (
            _box_mean(power, width) / np.maximum(seen, np.float32(1e-6))
            for width, seen in zip(self._scales, self._seen, strict=True)
        )
        # The same without the texture between the two scales: discs are made of it.
        bare = power / np.maximum(fine, np.float32(1e-6)) * light
        footprints = [one for disc in discs if (one := self.footprint(disc, pose)) is not None]
        images = {}
        for contrast_db in contrasts_db:
            images[contrast_db] = composed = image.copy()
            ring, plate = (np.float32(10 ** (db / 10)) for db in (contrast_db, plate_db))
            for one in footprints:
                gain = ring * one.bright + plate * np.maximum(one.share - one.bright, 0)
                mixed = (1 - one.share) * power[one.box] + gain * bare[one.box]
                grey = np.log10(np.maximum(mixed, 1e-12)) * np.float32(10 / self._db)
                where = one.share > 0
                composed[one.box][where] = np.rint(np.clip(grey, 0, 255)).astype(np.uint8)[where]
        return images

    def footprint(self, disc: CompositeDisc, pose: Pose) -> Footprint | None:
        """The pixels that a disc covers, seen from a pose; None if it is out of view."""
        fan, radius = self.fan, self._landmarks.radius_m
        ground, bearing = disc.seen_from(pose)
        if ground <= radius or abs(bearing) > 120:
            return None
        range_m = float(slant_range(fan, ground))
        along_m = max(SMEAR_M, 2 * fan.metres_per_pixel) / _HALF_POWER
        across_deg = self._beam_deg / _HALF_POWER
        step_m = min(radius / _SAMPLES_PER_RADIUS, along_m / 2)
        step_deg = min(math.degrees(radius / _SAMPLES_PER_RADIUS / ground), across_deg / 2)
        tails = math.ceil(_TAIL * along_m / step_m), math.ceil(_TAIL * across_deg / step_deg)
        near, far = (float(slant_range(fan, ground + side * radius)) for side in (-1, 1))
        half_deg = math.degrees(math.asin(radius / ground))
        first_m = near - (tails[0] + 2) * step_m
        first_deg = bearing - half_deg - (tails[1] + 2) * step_deg
        bins = math.ceil((far - first_m) / step_m) + tails[0] + 3
        beams = math.ceil((bearing + half_deg - first_deg) / step_deg) + tails[1] + 3
        patch_m = first_m + np.arange(bins) * step_m
        patch_deg = first_deg + np.arange(beams) * step_deg
        box = self._box(patch_m, patch_deg)
        if box is None or range_m > fan.range_max_m + 2 * radius:
            return None
        share, bright = self._pattern(disc, pose, patch_m, patch_deg)
        size = (2 * tails[1] + 1, 2 * tails[0] + 1)
        across, along = across_deg / step_deg, along_m / step_m
        maps = (
            (self._bearing[box] - np.float32(first_deg)) / np.float32(step_deg),
            (self._range[box] - np.float32(first_m)) / np.float32(step_m),
        )
        smeared = []
        for sharp in (share, bright):
            blurred = cv2.GaussianBlur(
                sharp, size, sigmaX=across, sigmaY=along, borderType=cv2.BORDER_CONSTANT
            )
            resampled = cv2.remap(blurred, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            smeared.append(np.asarray(resampled * self._inside[box], np.float32))
        share, bright = smeared
        return Footprint(box, np.minimum(share, 1), bright)

    def _pattern(
        self, disc: CompositeDisc, pose: Pose, patch_m: FloatArray, patch_deg: FloatArray
    ) -> tuple[FloatImage, FloatImage]:
        """The disc and its bright parts on a polar patch: (bins, beams) float32 each, 0 or 1."""
        landmarks = self._landmarks
        ground = np.nan_to_num(ground_range(self.fan, patch_m))[:, None]
        world = np.radians(patch_deg + pose.pan_deg)
        u = (pose.x_m + ground * np.sin(world) - disc.x_m) / landmarks.radius_m
        v = (pose.y_m + ground * np.cos(world) - disc.y_m) / landmarks.radius_m
        cos, sin = (way(math.radians(disc.orientation_deg)) for way in (math.cos, math.sin))
        u, v = u * cos + v * sin, v * cos - u * sin
        rho = np.hypot(u, v)
        share = (rho <= 1) & (patch_m > floor_depth(self.fan))[:, None]
        if disc.kind == "landmark":
            bright = landmarks.pattern(landmarks.ids.index(disc.landmark), u, v) > 0.5
        elif disc.kind == "blank":
            bright = (rho >= landmarks.ring[0]) & (rho <= landmarks.ring[1])
        else:
            bright = np.ones_like(share)
        return share.astype(np.float32), (bright & share).astype(np.float32)

    def _box(self, patch_m: FloatArray, patch_deg: FloatArray) -> tuple[slice, slice] | None:
        """The rows and columns of the image that a polar patch covers; None if there are none."""
        bearing = np.array([patch_deg[0], patch_deg[-1], np.clip(0, patch_deg[0], patch_deg[-1])])
        column, row = pixel_from_polar(self.fan, patch_m[[0, -1], None], bearing)
        sides = []
        for where, size in ((row, self.fan.rows), (column, self.fan.columns)):
            low, high = max(math.floor(where.min()), 0), min(math.ceil(where.max()) + 1, size)
            if low >= high:
                return None
            sides.append(slice(low, high))
        return sides[0], sides[1]


def _box_mean(image: FloatImage, width: int) -> FloatImage:
    blurred = cv2.blur(image, (width, width), borderType=cv2.BORDER_CONSTANT)
    return np.asarray(blurred, np.float32)


def _odd(width: float) -> int:
    return 2 * math.floor(width / 2) + 1
