"""The working plane, in which objects are searched: the fan itself, or the floor seen from above.

In the fan a floor circle is squeezed along the range and stretched across it (Eq. 1, and the
exact form in `geometry`). Resampled to the floor it is a circle of one known size everywhere,
a pan of the sonar is a rotation about the apex, and there are fewer pixels.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.arrays import ByteImage, FloatArray, FloatImage
from sonarrec.errors import SonarrecError
from sonarrec.sonar.frame import Fan, Motion, PolarImages
from sonarrec.sonar.geometry import (
    STEEPEST,
    Resampling,
    fan_mask,
    floor_depth,
    ground_range,
    in_fan,
    pixel_from_polar,
    polar_from_pixel,
    row_bands,
    slant_range,
)

Values = FloatArray | float
Pair = tuple[FloatArray, FloatArray]
"""(column, row), or (slant range, bearing)."""

MOST_CELLS = 2**15 - 2  # across an image that OpenCV resamples
# On a floor of more than LARGE pixels, as wide fans of 10 m have, a disc's radius is at most
# LARGE_RADIUS_PX, which takes .85 of the time of 12, and 11 MB less. On 22 recordings of tuning
# seeds (wide, and 60 deg wide) TPR was .004 less (standard error .004), false claims .3 fewer a
# recording. With smaller discs, rings are no longer searched for on blocks (stage1.py).
LARGE, LARGE_RADIUS_PX = 2**18, 9.0


def as_complex(positions: FloatArray) -> npt.NDArray[Any]:
    """(...,) complex numbers of (..., 2) positions, of the same precision.

    A pair is one element, which numpy's loops take in a fraction of the time.
    """
    double = positions.dtype == np.float64
    pairs = np.ascontiguousarray(positions).view(np.complex128 if double else np.complex64)
    return pairs[..., 0]


class Plane(ABC):
    """Makes working images of frames, and converts their pixels to slant range and bearing."""

    fan: Fan
    """The geometry of the frames' images."""
    shape: tuple[int, int]
    """(rows, columns) of the working image."""
    axes: tuple[float, float]
    """(across, along) semi-axes of a landmark's disc, in working pixels."""
    inside: ByteImage
    """`shape`, 1 where there is sonar data."""
    scale: float
    """Working pixels per fan pixel."""
    apex: tuple[float, float]
    """(column, row) of the sonar in working pixels. In either plane a pan rotates about it."""

    @abstractmethod
    def warp(self, pixels: ByteImage, polar: PolarImages | None = None) -> ByteImage:
        """The working image, `shape` uint8, of a Frame's `pixels` (uint8) and `polar`."""

    @abstractmethod
    def to_polar(self, column: Values, row: Values) -> Pair:
        """(slant range in m, bearing in deg) of working pixels; shapes broadcast."""

    @abstractmethod
    def from_polar(self, range_m: FloatArray, bearing_deg: FloatArray) -> Pair:
        """(column, row) in working pixels of slant ranges (m) and bearings (deg)."""

    @abstractmethod
    def to_fan(self, column: Values, row: Values) -> Pair:
        """(column, row) in fan pixels of working pixels; shapes broadcast."""

    @abstractmethod
    def _slant_per_pixel(self, position: FloatArray, distance: FloatArray) -> Values:
        """Derivative of the slant range by the distance from the apex, in metres per pixel.

        position: (n, 2) working pixels. distance: (n,) their distance from the apex, in pixels.
        """

    @abstractmethod
    def _shifted(self, column: FloatArray, row: FloatArray, motion: Motion) -> Pair:
        """(column, row) of static objects after the motion's shift, before its pan."""

    def disc_share(self) -> FloatImage:
        """`shape` float32: the share inside the fan of a disc centred on each pixel."""
        margin = [int(np.ceil(axis)) for axis in self.axes]
        y, x = np.mgrid[-margin[1] : margin[1] + 1, -margin[0] : margin[0] + 1].astype(float)
        disc = (np.hypot(x / self.axes[0], y / self.axes[1]) <= 1).astype(np.float32)
        share = cv2.filter2D(
            self.inside.astype(np.float32), -1, disc / disc.sum(), borderType=cv2.BORDER_CONSTANT
        )
        return np.asarray(share, np.float32)

    def polar_sigma(self, position: FloatArray, sigma: FloatArray) -> Pair:
        """Standard errors (n,) in slant range (m) and bearing (deg) of (n, 2) working pixels.

        sigma: (n, 2) (across, along) in disc diameters.
        """
        across, along = (2 * np.asarray(sigma) * self.axes).T
        x = position[:, 0] - self.apex[0]
        y = self.apex[1] - position[:, 1]
        distance = np.maximum(np.hypot(x, y), 1.0)
        radial = np.hypot(along * y, across * x) / distance
        turning = np.hypot(across * y, along * x) / distance**2
        return radial * self._slant_per_pixel(position, distance), np.degrees(turning)

    def moved(self, position: FloatArray, motion: Motion) -> FloatArray:
        """(..., 2) working pixels of static objects on the floor after a motion of the sonar."""
        if motion.right_m or motion.ahead_m:
            shifted = self._shifted(position[..., 0], position[..., 1], motion)
            position = np.stack(shifted, axis=-1).astype(position.dtype, copy=False)
        pan = math.radians(motion.pan_deg)
        points = as_complex(position)
        apex = points.dtype.type(complex(*self.apex))
        after = (points - apex) * points.dtype.type(complex(math.cos(pan), -math.sin(pan))) + apex
        return np.asarray(after.view(position.dtype).reshape(position.shape))

    def sight_rotation(self, before: FloatArray, after: FloatArray, motion: Motion) -> FloatArray:
        """(n,) rotation over the floor of the line of sight to static objects by a motion, deg.

        before, after: (n, 2) working pixels; the latter from `moved`. Counter-clockwise, seen from
        above; 0 after a pan alone.
        """
        if not (motion.right_m or motion.ahead_m):
            return np.zeros(len(before))
        rotation = np.degrees(self.line_of_sight(after) - self.line_of_sight(before))
        rotation -= motion.pan_deg
        return np.asarray((rotation + 180) % 360 - 180)

    def line_of_sight(self, position: FloatArray) -> FloatArray:
        """(n,) direction from the sonar to each of (n, 2) working pixels, rad.

        Counter-clockwise from the image's right, seen from above.
        """
        return np.asarray(np.arctan2(self.apex[1] - position[:, 1], position[:, 0] - self.apex[0]))


class FanPlane(Plane):
    """The fan image itself, as the paper does: discs are squeezed by Eq. 1."""

    def __init__(self, fan: Fan, radius_m: float) -> None:
        radius_px = radius_m / fan.metres_per_pixel
        self.fan = fan
        self.scale = 1.0
        self.shape = (fan.rows, fan.columns)
        self.axes = (radius_px, radius_px * math.cos(math.radians(fan.tilt_deg)))
        self.apex = (fan.apex_column, fan.apex_row)
        self.inside = np.minimum(fan_mask(fan), 1)

    def warp(self, pixels: ByteImage, polar: PolarImages | None = None) -> ByteImage:
        return pixels if polar is None else polar(pixels)

    def to_polar(self, column: Values, row: Values) -> Pair:
        return polar_from_pixel(self.fan, column, row)

    def from_polar(self, range_m: FloatArray, bearing_deg: FloatArray) -> Pair:
        return pixel_from_polar(self.fan, range_m, bearing_deg)

    def to_fan(self, column: Values, row: Values) -> Pair:
        return np.asarray(column, dtype=float), np.asarray(row, dtype=float)

    def _slant_per_pixel(
        self,
        position: FloatArray,  # noqa: ARG002
        distance: FloatArray,  # noqa: ARG002
    ) -> Values:
        return self.fan.metres_per_pixel

    def _shifted(self, column: FloatArray, row: FloatArray, motion: Motion) -> Pair:
        range_m, bearing_deg = self.to_polar(column, row)
        ground = np.nan_to_num(ground_range(self.fan, range_m))  # nearer than the floor: below
        bearing = np.radians(bearing_deg)
        across = ground * np.sin(bearing) - motion.right_m
        along = ground * np.cos(bearing) - motion.ahead_m
        return self.from_polar(
            slant_range(self.fan, np.hypot(across, along)), np.degrees(np.arctan2(across, along))
        )


class FloorPlane(Plane):
    """The floor seen from above: discs are circles of one size."""

    def __init__(self, fan: Fan, radius_m: float, disc_radius_px: float) -> None:
        """disc_radius_px: radius of a disc in working pixels, unless the fan's pixels are coarser
        or the floor is LARGE.

        Raises SonarrecError where the floor lies beyond the range window.
        """
        self.fan = fan
        nearest = max(fan.range_min_m, STEEPEST * floor_depth(fan))
        if nearest >= fan.range_max_m:
            raise SonarrecError(
                f"sonar geometry: from height_m = {floor_depth(fan):g} hardly any floor lies "
                f"within range_max_m = {fan.range_max_m:g}; correct one of them, or use "
                "--preset paper"
            )
        near, far = (float(ground_range(fan, r)) for r in (nearest, fan.range_max_m))
        edges = np.radians([fan.bearing_min_deg, fan.bearing_max_deg])
        radius_px = radius_m / fan.metres_per_pixel
        finest = min(disc_radius_px, radius_px)
        if np.ptp(edges) * (far**2 - near**2) / 2 * (finest / radius_m) ** 2 > LARGE:
            finest = min(finest, LARGE_RADIUS_PX)
        self.scale = finest / radius_px
        self.axes = (radius_px * self.scale, radius_px * self.scale)
        self._pixel_m = fan.metres_per_pixel / self.scale
        left, right = far * np.sin(edges) / self._pixel_m
        bottom = near * np.cos(edges).min() / self._pixel_m
        self.apex = (-math.floor(left), math.ceil(far / self._pixel_m))
        rows = self.apex[1] - math.floor(bottom) + 1
        self.shape = (rows, math.ceil(right) + self.apex[0] + 1)
        if max(self.shape) > MOST_CELLS:
            raise SonarrecError(
                f"sonar geometry: the floor up to range_max_m = {fan.range_max_m:g} takes "
                f"{self.shape[1]} x {rows} cells of {self._pixel_m:.3g} m, more than {MOST_CELLS}; "
                "check the ranges and metres_per_pixel"
            )
        floor = np.empty(self.shape, np.uint8)
        for band, row, column in row_bands(self.shape):
            range_m, bearing_deg = self.to_polar(column, row)
            fan_column, fan_row = pixel_from_polar(fan, range_m, bearing_deg)
            inside = in_fan(fan, range_m, bearing_deg) & (range_m >= nearest)
            inside &= (fan_column >= 0) & (fan_column <= fan.columns - 1)
            inside &= (fan_row >= 0) & (fan_row <= fan.rows - 1)
            floor[band] = inside
        # The outermost pixels are interpolated with the black outside.
        self.inside = np.asarray(
            cv2.erode(floor, np.ones((3, 3), np.uint8), borderValue=0), np.uint8
        )
        self._polar: PolarImages | None = None
        # (bins, beams) shares of the blurred image and of the image itself, where it is polar.
        self._blur: tuple[FloatImage, FloatImage] | None = None
        self._resampling: Resampling | None = None  # of images that are as `_polar` says

    def _lay_out(self, polar: PolarImages | None) -> None:
        """Prepare for frames with this `polar`.

        A floor pixel is the mean of the area that it covers, so images are first shrunk by whole
        blocks. Polar images have closer beams at nearer ranges. Across the beams a blur, whose
        width depends on the range, replaces the blocks.
        """
        along_m = self.fan.metres_per_pixel if polar is None else polar.bin_m
        across, along = 1, max(1, round(self._pixel_m / along_m))
        self._polar, self._blur = polar, None
        if polar is None:
            across = along
        else:
            ground = np.maximum(
                np.nan_to_num(ground_range(self.fan, polar.ranges_m)), self._pixel_m
            )
            covered = self._pixel_m / (np.radians(polar.beam_deg) * ground)  # beams in a pixel
            # Variances in beams squared: a mean of three beams has 2/3; a mean over a floor pixel
            # and the interpolation between two of them have covered^2 (1/12 + 1/6).
            share = np.minimum(3 / 8 * covered**2, 1).astype(np.float32)
            share = np.repeat(share[:, None], polar.shape[1], axis=1)
            self._blur = share, 1 - share
        self._resampling = Resampling(self.shape, (along, across))
        for band, row, column in row_bands(self.shape):
            range_m, bearing_deg = self.to_polar(column, row)
            if polar is None:
                across_px, along_px = pixel_from_polar(self.fan, range_m, bearing_deg)
                seen = np.ones(range_m.shape, bool)
            else:
                across_px, along_px, seen = polar.pixel(range_m, bearing_deg)
            self._resampling.fill(band, across_px, along_px, seen)

    def warp(self, pixels: ByteImage, polar: PolarImages | None = None) -> ByteImage:
        # Polar images are resampled to the floor directly, since a fan has many more pixels.
        if self._resampling is None or polar is not self._polar:
            self._lay_out(polar)
        assert self._resampling is not None
        if self._blur is not None:
            blurred = cv2.blur(pixels, (3, 1), borderType=cv2.BORDER_REPLICATE)
            pixels = np.asarray(cv2.blendLinear(blurred, pixels, *self._blur), np.uint8)
        return self._resampling(pixels)

    def to_polar(self, column: Values, row: Values) -> Pair:
        across = (np.asarray(column, dtype=float) - self.apex[0]) * self._pixel_m
        along = (self.apex[1] - np.asarray(row, dtype=float)) * self._pixel_m
        return (
            slant_range(self.fan, np.hypot(across, along)),
            np.degrees(np.arctan2(across, along)),
        )

    def from_polar(self, range_m: FloatArray, bearing_deg: FloatArray) -> Pair:
        distance = ground_range(self.fan, range_m) / self._pixel_m
        bearing = np.radians(bearing_deg)
        return self.apex[0] + distance * np.sin(bearing), self.apex[1] - distance * np.cos(bearing)

    def to_fan(self, column: Values, row: Values) -> Pair:
        return pixel_from_polar(self.fan, *self.to_polar(column, row))

    def _slant_per_pixel(self, position: FloatArray, distance: FloatArray) -> Values:
        # A step along the floor times the cosine of the grazing angle, ground over slant range.
        ground_m = self._pixel_m * distance
        return np.asarray(ground_m * self._pixel_m / self.to_polar(*position.T)[0])

    def _shifted(self, column: FloatArray, row: FloatArray, motion: Motion) -> Pair:
        return column - motion.right_m / self._pixel_m, row + motion.ahead_m / self._pixel_m


def working_plane(kind: str, fan: Fan, radius_m: float, disc_radius_px: float) -> Plane:
    """The plane of this kind, "fan" or "floor"; the rest as FloorPlane.

    Raises SonarrecError for a disc that no image can hold, or as FloorPlane.
    """
    if radius_m > fan.range_max_m:
        raise SonarrecError(
            f"landmark set: a disc of radius_m = {radius_m:g} is larger than what this sonar sees, "
            f"range_max_m = {fan.range_max_m:g}; correct one of them"
        )
    if kind == "fan":
        return FanPlane(fan, radius_m)
    return FloorPlane(fan, radius_m, disc_radius_px)
