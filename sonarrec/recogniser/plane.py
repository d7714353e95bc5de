"""The plane in which objects are looked for: the fan as it is, or the floor seen from above.

In the fan a floor circle is squeezed along the range and stretched across it (Eq. 1, and the
exact form in `geometry`). Resampled to the floor it is a circle of one known size everywhere,
a pan of the sonar is a rotation about the apex, and fewer pixels do the work.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.geometry import (
    STEEPEST,
    fan_mask,
    floor_depth,
    ground_range,
    in_fan,
    pixel_from_polar,
    polar_from_pixel,
    row_bands,
    slant_range,
)
from sonarrec.records import ByteImage, Fan, FloatArray, Motion, SonarrecError


class Plane:
    """Fan image to working image and back.

    shape: (rows, columns) of the working image. axes: (across, along) semi-axes in its pixels of a
    disc of the landmark's radius. inside: (rows, columns) uint8, 1 where there is sonar data.
    scale: working pixels per fan pixel.
    """

    def __init__(self, fan: Fan, radius_m: float, kind: str, disc_radius_px: float) -> None:
        """kind: "fan" or "floor". disc_radius_px: radius of a disc on the floor plane.

        Raises SonarrecError where the floor lies beyond the range window.
        """
        self.fan = fan
        self.kind = kind
        radius_px = radius_m / fan.metres_per_pixel
        if kind == "fan":
            self.scale = 1.0
            self.shape = (fan.rows, fan.columns)
            self.axes = (radius_px, radius_px * math.cos(math.radians(fan.tilt_deg)))
            self._apex = (fan.apex_column, fan.apex_row)
            self.inside: ByteImage = np.minimum(fan_mask(fan), 1)
            return
        self.scale = min(1.0, disc_radius_px / radius_px)
        self.axes = (radius_px * self.scale, radius_px * self.scale)
        self._metres = fan.metres_per_pixel / self.scale
        nearest = max(fan.range_min_m, STEEPEST * floor_depth(fan))
        if nearest >= fan.range_max_m:
            raise SonarrecError(
                f"sonar geometry: from height_m = {floor_depth(fan):g} hardly any floor lies "
                f"within range_max_m = {fan.range_max_m:g}; correct one of them, or use "
                "--preset paper"
            )
        near, far = (float(ground_range(fan, r)) for r in (nearest, fan.range_max_m))
        edges = np.radians([fan.bearing_min_deg, fan.bearing_max_deg])
        left, right = far * np.sin(edges) / self._metres
        bottom = near * np.cos(edges).min() / self._metres
        self._apex = (-math.floor(left), math.ceil(far / self._metres))
        self.shape = (
            self._apex[1] - math.floor(bottom) + 1,
            math.ceil(right) - math.floor(left) + 1,
        )
        # Whole-number shrinking averages speckle before the resampling picks pixels.
        self._shrink = max(1, round(1 / self.scale))
        self._map = np.empty((*self.shape, 2), np.int16)
        self._weights = np.empty(self.shape, np.uint16)
        floor = np.empty(self.shape, np.uint8)
        for band, row, column in row_bands(self.shape):
            range_m, bearing_deg = self.to_polar(column, row)
            fan_column, fan_row = pixel_from_polar(fan, range_m, bearing_deg)
            inside = in_fan(fan, range_m, bearing_deg) & (range_m >= nearest)
            inside &= (fan_column >= 0) & (fan_column <= fan.columns - 1)
            inside &= (fan_row >= 0) & (fan_row <= fan.rows - 1)
            floor[band] = inside
            self._map[band], self._weights[band] = cv2.convertMaps(
                ((fan_column + 0.5) / self._shrink - 0.5).astype(np.float32),
                ((fan_row + 0.5) / self._shrink - 0.5).astype(np.float32),
                cv2.CV_16SC2,
            )
        # The outermost pixels are mixed with the black outside.
        self.inside = np.asarray(
            cv2.erode(floor, np.ones((3, 3), np.uint8), borderValue=0), np.uint8
        )

    def warp(self, image: ByteImage) -> ByteImage:
        """(fan.rows, fan.columns) uint8 to the working image, `shape` uint8."""
        if self.kind == "fan":
            return image
        if self._shrink > 1:
            # Whole blocks only: a remainder would shift the scale by a part of a pixel.
            rows, columns = (-side % self._shrink for side in image.shape)
            if rows or columns:
                image = cv2.copyMakeBorder(image, 0, rows, 0, columns, cv2.BORDER_REPLICATE)  # type: ignore[assignment]
            size = (image.shape[1] // self._shrink, image.shape[0] // self._shrink)
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        return cv2.remap(image, self._map, self._weights, cv2.INTER_LINEAR)  # type: ignore[return-value]

    def disc_share(self) -> npt.NDArray[np.float32]:
        """`shape` float32: the share of a disc centred on each pixel that the fan shows."""
        margin = [int(np.ceil(axis)) for axis in self.axes]
        y, x = np.mgrid[-margin[1] : margin[1] + 1, -margin[0] : margin[0] + 1].astype(float)
        disc = (np.hypot(x / self.axes[0], y / self.axes[1]) <= 1).astype(np.float32)
        share = cv2.filter2D(
            self.inside.astype(np.float32), -1, disc / disc.sum(), borderType=cv2.BORDER_CONSTANT
        )
        return np.asarray(share, np.float32)

    def to_polar(
        self, column: FloatArray | float, row: FloatArray | float
    ) -> tuple[FloatArray, FloatArray]:
        """(slant range in m, bearing in deg) of working pixels; shapes broadcast."""
        if self.kind == "fan":
            return polar_from_pixel(self.fan, column, row)
        across = (np.asarray(column, dtype=float) - self._apex[0]) * self._metres
        along = (self._apex[1] - np.asarray(row, dtype=float)) * self._metres
        return (
            slant_range(self.fan, np.hypot(across, along)),
            np.degrees(np.arctan2(across, along)),
        )

    def from_polar(
        self, range_m: FloatArray, bearing_deg: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """(column, row) in working pixels of slant ranges (m) and bearings (deg)."""
        if self.kind == "fan":
            return pixel_from_polar(self.fan, range_m, bearing_deg)
        distance = ground_range(self.fan, range_m) / self._metres
        bearing = np.radians(bearing_deg)
        return self._apex[0] + distance * np.sin(bearing), self._apex[1] - distance * np.cos(
            bearing
        )

    def to_fan(
        self, column: FloatArray | float, row: FloatArray | float
    ) -> tuple[FloatArray, FloatArray]:
        """(column, row) in fan pixels of working pixels; shapes broadcast."""
        if self.kind == "fan":
            return np.asarray(column, dtype=float), np.asarray(row, dtype=float)
        return pixel_from_polar(self.fan, *self.to_polar(column, row))

    def polar_sigma(self, position: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Standard errors (n,) in slant range (m) and bearing (deg) of (n, 2) working pixels.

        sigma: (n, 2) (across, along) in disc diameters.
        """
        across, along = (2 * np.asarray(sigma) * self.axes).T
        x = position[:, 0] - self._apex[0]
        y = self._apex[1] - position[:, 1]
        distance = np.maximum(np.hypot(x, y), 1.0)
        radial = np.hypot(along * y, across * x) / distance
        turning = np.hypot(across * y, along * x) / distance**2
        metres = self.fan.metres_per_pixel
        if self.kind == "floor":
            # Slant range grows with the way along the floor by the cosine of the grazing angle.
            metres = self._metres * distance * self._metres / self.to_polar(*position.T)[0]
        return radial * metres, np.degrees(turning)

    def moved(self, position: FloatArray, motion: Motion) -> FloatArray:
        """(..., 2) where still objects on the floor, at working pixels, appear after a motion."""
        column, row = position[..., 0], position[..., 1]
        if motion.right_m or motion.ahead_m:
            column, row = self._carried(column, row, motion)
        # In either plane a pan is a rotation about the apex.
        x, y = column - self._apex[0], row - self._apex[1]
        pan = math.radians(motion.pan_deg)
        cos, sin = math.cos(pan), math.sin(pan)
        return np.stack(
            [self._apex[0] + x * cos + y * sin, self._apex[1] - x * sin + y * cos], axis=-1
        )

    def _carried(
        self, column: FloatArray, row: FloatArray, motion: Motion
    ) -> tuple[FloatArray, FloatArray]:
        """(column, row) of still objects once the sonar was carried, before it turns."""
        if self.kind == "floor":
            return column - motion.right_m / self._metres, row + motion.ahead_m / self._metres
        range_m, bearing_deg = self.to_polar(column, row)
        ground = np.nan_to_num(ground_range(self.fan, range_m))  # nearer than the floor: below
        bearing = np.radians(bearing_deg)
        across = ground * np.sin(bearing) - motion.right_m
        along = ground * np.cos(bearing) - motion.ahead_m
        return self.from_polar(
            slant_range(self.fan, np.hypot(across, along)), np.degrees(np.arctan2(across, along))
        )

    def line_of_sight(self, position: FloatArray) -> FloatArray:
        """(n,) direction away from the sonar at (n, 2) working pixels, rad.

        Counter-clockwise from the image's right, seen from above.
        """
        return np.asarray(
            np.arctan2(self._apex[1] - position[:, 1], position[:, 0] - self._apex[0])
        )
