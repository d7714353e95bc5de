"""Metres and pixels: the fan image, polar to fan, the floor, and where the sonar was.

Every conversion between metres and pixels of the fan is made here; that between metres and pixels
of the working image, seen from above, in recogniser/plane.py.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, ByteImage, FloatArray, IntArray
from sonarrec.errors import SonarrecError
from sonarrec.sonar.frame import Fan, Motion, PolarImages
from sonarrec.sonar.stated import Geometry

MAX_FAN_PIXELS = 2**24
MAX_SIDE = 2**15 - 2  # of the images that cv2.remap can read and make
# At slant ranges below this multiple of the height, the floor is seen so steeply that one pixel of
# slant range covers several pixels of floor.
STEEPEST = 1.05
BEYOND = -2  # column and row of a pixel outside every image, like its neighbours; it becomes 0
# Images of WIDE pixels or more are resampled AT_ONCE rows at a time, from their first pixel in the
# fan to their last. In smaller ones the calls would cost more than the pixels.
WIDE, AT_ONCE = 2**18, 32


def fan_for_image(sonar: Geometry, rows: int, columns: int) -> Fan:
    """The fan of a fan-layout image of `rows` x `columns` pixels."""
    scale = sonar.metres_per_pixel or (sonar.range_max_m - sonar.range_min_m) / rows
    apex = sonar.apex_px or ((columns - 1) / 2, rows - 0.5 + sonar.range_min_m / scale)
    return Fan(
        rows=rows,
        columns=columns,
        metres_per_pixel=scale,
        apex_column=apex[0],
        apex_row=apex[1],
        range_min_m=sonar.range_min_m,
        range_max_m=sonar.range_max_m,
        bearing_min_deg=sonar.bearing_min_deg,
        bearing_max_deg=sonar.bearing_max_deg,
        tilt_deg=sonar.tilt_deg,
        height_m=sonar.height_m,
    )


def fan_for_polar(sonar: Geometry, range_bins: int) -> Fan:
    """The fan into which a polar image of `range_bins` rows is resampled.

    One pixel is one range bin. Rows reach below range_min_m as far as the window's near
    corners do, so that nothing recorded is cut off.
    """
    scale = (sonar.range_max_m - sonar.range_min_m) / range_bins
    widest = max(abs(sonar.bearing_min_deg), abs(sonar.bearing_max_deg))
    rows = math.ceil(
        (sonar.range_max_m - sonar.range_min_m * math.cos(math.radians(widest))) / scale
    )
    half = math.floor(sonar.range_max_m * math.sin(math.radians(widest)) / scale)
    apex = float(half), sonar.range_max_m / scale - 0.5
    drawn = replace(sonar, metres_per_pixel=scale, apex_px=apex)
    return fan_for_image(drawn, rows, 2 * half + 1)


def pixel_from_polar(
    fan: Fan, range_m: FloatArray | float, bearing_deg: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """(column, row) in fan pixels of slant ranges (m) and bearings (deg); shapes broadcast."""
    bearing = np.radians(bearing_deg)
    distance = np.asarray(range_m, dtype=float) / fan.metres_per_pixel
    return fan.apex_column + distance * np.sin(bearing), fan.apex_row - distance * np.cos(bearing)


def polar_from_pixel(
    fan: Fan, column: FloatArray | float, row: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """(slant range in m, bearing in deg) of fan pixels; shapes broadcast."""
    across = np.asarray(column, dtype=float) - fan.apex_column
    along = fan.apex_row - np.asarray(row, dtype=float)
    return np.hypot(across, along) * fan.metres_per_pixel, np.degrees(np.arctan2(across, along))


def plane_position(pair: tuple[str, FloatArray, FloatArray], fan: Fan | None) -> FloatArray | None:
    """(rows, 2) metres in the fan plane, right and ahead of the sonar.

    pair: ("polar", slant ranges in m, bearings in deg) or ("pixel", columns, rows), each (rows,).
    None if it is in pixels and there is no fan to convert them into metres.
    """
    kind, first, second = pair
    if kind == "pixel":
        if fan is None:
            return None
        first, second = polar_from_pixel(fan, first, second)
    return plane_from_polar(first, second)


def plane_from_polar(range_m: FloatArray, bearing_deg: FloatArray) -> FloatArray:
    """(rows, 2) positions in the fan plane, as plane_position's, of slant ranges and bearings."""
    bearing = np.radians(bearing_deg)
    return np.column_stack([range_m * np.sin(bearing), range_m * np.cos(bearing)])


def pixel_from_plane(fan: Fan, position: FloatArray) -> FloatArray:
    """(rows, 2) column and row in fan pixels of positions in the fan plane, as plane_position's."""
    apex = (fan.apex_column, fan.apex_row)
    return np.asarray(position / fan.metres_per_pixel * (1, -1) + apex)


def polar_from_plane(position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(slant range in m, bearing in deg) of positions in the fan plane, as plane_position's."""
    right, ahead = position.T
    return np.hypot(right, ahead), np.degrees(np.arctan2(right, ahead))


def in_fan(fan: Fan, range_m: FloatArray, bearing_deg: FloatArray) -> BoolArray:
    """Whether the sonar sees slant ranges and bearings; shapes broadcast."""
    return np.asarray(
        (range_m >= fan.range_min_m)
        & (range_m <= fan.range_max_m)
        & (bearing_deg >= fan.bearing_min_deg)
        & (bearing_deg <= fan.bearing_max_deg)
    )


def in_image(fan: Fan, range_m: FloatArray, bearing_deg: FloatArray) -> BoolArray:
    """Whether the fan image shows slant ranges and bearings; shapes broadcast.

    The rows of most images reach from range_max_m to range_min_m straight ahead; they cut off the
    near corners of a wide fan.
    """
    column, row = pixel_from_polar(fan, range_m, bearing_deg)
    shown = in_fan(fan, range_m, bearing_deg)
    shown &= (row >= -0.5) & (row <= fan.rows - 0.5)
    # Fans are drawn as wide as whole pixels allow, so up to one pixel beyond still counts.
    return np.asarray(shown & (column >= -1) & (column <= fan.columns))


@functools.lru_cache(maxsize=1)  # three parts of a run need it
def fan_mask(fan: Fan) -> ByteImage:
    """(rows, columns) uint8: 255 where the image holds sonar data, 0 outside the fan. Read-only."""
    mask = np.empty((fan.rows, fan.columns), np.uint8)
    for band, row, column in row_bands(mask.shape):
        mask[band] = in_fan(fan, *polar_from_pixel(fan, column, row))
    mask *= 255
    mask.setflags(write=False)
    return mask


def row_bands(shape: tuple[int, int]) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
    """An image's rows a few at a time, so that intermediate arrays take little memory.

    shape: (rows, columns). Yields which rows the band has, and the rows (n, 1) and columns
    (columns,) of its pixels.
    """
    rows, columns = shape
    column = np.arange(columns, dtype=float)
    for first in range(0, rows, 64):
        row = np.arange(first, min(first + 64, rows), dtype=float)
        yield slice(first, first + 64), row[:, None], column


def bin_ranges(sonar: Geometry, bins: int) -> FloatArray:
    """(bins,) slant ranges (m) of the middles of a polar image's rows."""
    if sonar.ranges_m is not None:
        return np.asarray(sonar.ranges_m)
    step = (sonar.range_max_m - sonar.range_min_m) / bins
    return np.asarray(sonar.range_min_m + (np.arange(bins) + 0.5) * step)


def beam_bearings(sonar: Geometry, beams: int) -> FloatArray:
    """(beams,) bearings (deg) of the middles of a polar image's columns."""
    if sonar.bearings_deg is not None:
        return np.asarray(sonar.bearings_deg)
    low, high = sonar.bearing_min_deg, sonar.bearing_max_deg
    return np.asarray(low + (np.arange(beams) + 0.5) * (high - low) / beams)


class Resampling:
    """Resamples images bilinearly, by a table that is filled a few rows at a time.

    Pixels that were not filled are 0.
    """

    def __init__(self, shape: tuple[int, int], block: tuple[int, int] = (1, 1)) -> None:
        """shape: (rows, columns) of the resampled images. block: (down, across) how many pixels
        are averaged first; a mean has less speckle than a single pixel.
        """
        self._block = block
        self._columns = np.full((*shape, 2), BEYOND, np.int16)
        self._weights = np.zeros(shape, np.uint16)
        self._filled: list[tuple[slice, slice]] = []  # (rows, columns) that hold filled pixels

    def fill(self, band: slice, column: FloatArray, row: FloatArray, seen: BoolArray) -> None:
        """Set where each pixel of some rows comes from.

        band: the rows of the resampled images. column, row: position in the images, in pixels.
        seen: whether it is inside. All three are (rows of the band, columns).
        """
        down, across = self._block
        self._columns[band], self._weights[band] = cv2.convertMaps(
            ((column + 0.5) / across - 0.5).astype(np.float32),
            ((row + 0.5) / down - 0.5).astype(np.float32),
            cv2.CV_16SC2,
        )
        self._columns[band][~seen] = BEYOND
        for first in range(band.start, min(band.stop, len(self._columns)), AT_ONCE):
            rows = slice(first, min(first + AT_ONCE, band.stop))
            some = np.flatnonzero(
                seen[rows.start - band.start : rows.stop - band.start].any(axis=0)
            )
            if len(some):
                self._filled.append((rows, slice(some[0], some[-1] + 1)))

    def __call__(self, image: ByteImage) -> ByteImage:
        """An image (uint8) resampled, (rows, columns) uint8."""
        if max(self._block) > 1:
            # Filled up to whole blocks: a remainder would shift the scale by a part of a pixel.
            rows, columns = (-side % by for side, by in zip(image.shape, self._block, strict=True))
            if rows or columns:
                filled = cv2.copyMakeBorder(image, 0, rows, 0, columns, cv2.BORDER_REPLICATE)
                image = np.asarray(filled, np.uint8)
            size = (image.shape[1] // self._block[1], image.shape[0] // self._block[0])
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        # Pixels outside a fan cost as much as those inside, and a wide fan's corners are many.
        resampled = np.zeros(self._weights.shape, np.uint8)
        for part in self._filled if resampled.size >= WIDE else [(slice(None), slice(None))]:
            cv2.remap(
                image,
                self._columns[part],
                self._weights[part],
                cv2.INTER_LINEAR,
                dst=resampled[part],
                borderMode=cv2.BORDER_CONSTANT,
            )
        return resampled


class PolarToFan(PolarImages):
    """Evenly spaced bins and beams, or as `bearings_deg` and `ranges_m` of the geometry say."""

    def __init__(
        self, sonar: Geometry, range_bins: int, beams: int, fan: Fan | None = None
    ) -> None:
        """fan: that of the log's first ping, whose window may differ; None: the ping's own. Parts
        of the fan outside the ping's window are 0.

        Raises SonarrecError if bearings_deg or ranges_m do not match the image, if the fan would
        have more than MAX_FAN_PIXELS, or if it or the image has a side above MAX_SIDE.
        """
        for key, stated, name, count, side in (
            ("bearings_deg", sonar.bearings_deg, "beams", beams, "column"),
            ("ranges_m", sonar.ranges_m, "range bins", range_bins, "row"),
        ):
            if stated is not None and len(stated) != count:
                raise SonarrecError(
                    f"{key} has {len(stated)} {key.partition('_')[0]} but the images have {count} "
                    f"{name}; give one per image {side}"
                )
        self._own = fan_for_polar(sonar, range_bins)
        self.fan = fan = fan or self._own
        largest = max(range_bins, beams, fan.rows, fan.columns)
        if fan.rows * fan.columns > MAX_FAN_PIXELS or largest > MAX_SIDE:
            raise SonarrecError(
                f"polar images of {range_bins} range bins up to {fan.range_max_m:.6g} m make a fan "
                f"image of {fan.columns} x {fan.rows} pixels, more than {MAX_FAN_PIXELS}, or than "
                f"{MAX_SIDE} along a side; crop or shrink the images"
            )
        self._sonar, self.shape, self.bin_m = sonar, (range_bins, beams), self._own.metres_per_pixel
        self.ranges_m = bin_ranges(sonar, range_bins)
        self.beam_deg = (self._own.bearing_max_deg - self._own.bearing_min_deg) / beams

    def pixel(
        self, range_m: FloatArray, bearing_deg: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        sonar, own, (range_bins, beams) = self._sonar, self._own, self.shape
        if sonar.bearings_deg is None:
            span = own.bearing_max_deg - own.bearing_min_deg
            side = -bearing_deg if sonar.flip else bearing_deg
            beam = (side - own.bearing_min_deg) / span * beams - 0.5
        else:
            bearings = np.asarray(sonar.bearings_deg) * (-1 if sonar.flip else 1)
            order = np.argsort(bearings)
            beam = np.interp(bearing_deg, bearings[order], order.astype(float))
        if sonar.ranges_m is None:
            range_bin = (range_m - own.range_min_m) / own.metres_per_pixel - 0.5
        else:
            range_bin = np.interp(range_m, sonar.ranges_m, np.arange(range_bins, dtype=float))
        beam = np.clip(beam, 0, beams - 1)
        range_bin = np.clip(range_bin, 0, range_bins - 1)
        return beam, range_bin, in_fan(own, range_m, bearing_deg)

    @functools.cached_property
    def _resampling(self) -> Resampling:
        fan = self.fan
        resampling = Resampling((fan.rows, fan.columns))
        for band, row, column in row_bands((fan.rows, fan.columns)):
            range_m, bearing_deg = polar_from_pixel(fan, column, row)
            beam, range_bin, seen = self.pixel(range_m, bearing_deg)
            resampling.fill(band, beam, range_bin, seen & in_fan(fan, range_m, bearing_deg))
        return resampling

    def __call__(self, polar: ByteImage) -> ByteImage:
        return self._resampling(polar)

    def free(self) -> None:
        """Free what a call prepares for the next ones; a later call prepares it again."""
        self.__dict__.pop("_resampling", None)


# The floor. Eq. 1 squeezes a floor circle along the range by cos(tilt). On a flat floor the exact
# relation is ground range^2 = slant range^2 - height^2 at the same bearing: radially the circle
# shrinks by cos(grazing angle), across it grows by the inverse, and tilt drops out.


def floor_depth(fan: Fan) -> float:
    """Height of the sonar above the floor, m.

    If it is not stated, the beam's axis is assumed to meet the floor in the middle of the window:
    there, and only there, the exact squeeze is Eq. 1's cos(tilt).
    """
    if fan.height_m is not None:
        return fan.height_m
    middle = (fan.range_min_m + fan.range_max_m) / 2
    return middle * math.sin(math.radians(fan.tilt_deg))


def ground_range(fan: Fan, range_m: FloatArray | float) -> FloatArray:
    """Ground range (m) of floor points at slant range (m); NaN if nearer than the floor."""
    slant = np.asarray(range_m, dtype=float)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(slant**2 - floor_depth(fan) ** 2))


def slant_range(fan: Fan, ground_m: FloatArray | float) -> FloatArray:
    """Slant range (m) of floor points at ground range (m): the inverse of ground_range."""
    return np.asarray(np.hypot(np.asarray(ground_m, dtype=float), floor_depth(fan)))


def points_on_disc(radius_m: float, count: int) -> tuple[FloatArray, FloatArray]:
    """(count,) m to the right and ahead of the centre: points spread evenly over a disc, like the
    seeds of a sunflower."""
    n = np.arange(count) + 0.5
    distance, angle = radius_m * np.sqrt(n / count), n * (np.pi * (3 - math.sqrt(5)))
    return distance * np.cos(angle), distance * np.sin(angle)


FASTEST_M_S = 5.0  # of vehicles that see landmarks
POSE_GAP = 10
"""There is no pose in a gap between rows that is longer than this many usual steps."""


@dataclass(frozen=True, slots=True)
class PoseTable:
    """The sonar's poses at rising times; between two rows they follow a straight line.

    Positions and headings are the sonar's own on the floor. Only differences between rows count, so
    the origin and the direction of zero are free.
    """

    name: str
    """In messages."""
    source: Mapping[str, str]
    """What run.toml says of it."""
    time_ns: IntArray
    """(N,)."""
    pose: FloatArray
    """(N, 3) yaw in deg, positive to the right (clockwise seen from above) and without jumps of
    360, then x and y, the position on the floor in m, y ahead and x to the right of a sonar whose
    yaw is 0."""
    gap_ns: float
    """There is no pose between two rows with a longer gap."""
    problems: tuple[str, ...] = ()
    """A line for each row that could not be used."""
    doubts: tuple[str, ...] = ()
    """Notes on what the user may have mistaken."""
    axes: Literal["right, ahead", "ahead, left"] = "right, ahead"
    """The directions of x and y in the user's own table at yaw 0; in `pose` they are always right
    and ahead."""

    def covers(self, time_ns: int) -> bool:
        """Whether the pose at a time is known: from the first row to the last, but not in a gap."""
        return self._pose_at(time_ns) is not None

    def poses_at(self, times_ns: IntArray) -> FloatArray:
        """(N, 3) the poses at (N,) times, in the form of `pose`; NaN if not known."""
        after = np.clip(np.searchsorted(self.time_ns, times_ns), 1, len(self.time_ns) - 1)
        step = (self.time_ns[after] - self.time_ns[after - 1]).astype(float)
        share = ((times_ns - self.time_ns[after - 1]) / step)[:, None]
        known = (share >= 0) & (share <= 1)
        known &= (step <= self.gap_ns)[:, None] | (share == 0) | (share == 1)
        pose = self.pose[after - 1] * (1 - share) + self.pose[after] * share
        return np.where(known, pose, np.nan)

    def motion(self, before_ns: int, now_ns: int) -> Motion | None:
        """How the sonar moved between two times; None if either pose is not known."""
        before, now = self._pose_at(before_ns), self._pose_at(now_ns)
        if before is None or now is None:
            return None
        pan_deg, right, ahead = (now - before).tolist()
        heading = math.radians(before[0])
        cos, sin = math.cos(heading), math.sin(heading)
        return Motion(pan_deg, right * cos - ahead * sin, right * sin + ahead * cos)

    def position(self, time_ns: int, right_m: float, ahead_m: float) -> tuple[float, float] | None:
        """(x, y) in m, in the table's own axes, of a point right_m to the right and ahead_m ahead.

        None if the pose is not known.
        """
        pose = self._pose_at(time_ns)
        if pose is None:
            return None
        yaw_deg, x, y = pose.tolist()
        cos, sin = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
        right, ahead = x + right_m * cos + ahead_m * sin, y - right_m * sin + ahead_m * cos
        return (ahead, -right) if self.axes == "ahead, left" else (right, ahead)

    def too_fast(self) -> list[str]:
        """A note if the sonar moves faster than one can that sees landmarks; else none. Speeds are
        taken over a second or more, in which noise is little."""
        rows = min(max(1, round(1e9 / np.median(np.diff(self.time_ns)))), len(self.time_ns) - 1)
        distance_m = np.linalg.norm(self.pose[rows:, 1:] - self.pose[:-rows, 1:], axis=1)
        speed = np.median(distance_m / (self.time_ns[rows:] - self.time_ns[:-rows])) * 1e9
        asked = "too fast for a sonar; are x and y in metres, and the times right?"
        line = f"{self.name}: its poses move at {speed:.3g} m/s, {asked}"
        return [line] if speed > FASTEST_M_S else []

    def _pose_at(self, time_ns: int) -> FloatArray | None:
        """(3,) the pose at a time; None if not known."""
        (pose,) = self.poses_at(np.array([time_ns]))
        return None if np.isnan(pose).any() else pose


def pose_table(
    name: str,
    source: Mapping[str, str],
    time_ns: IntArray,
    yaw_deg: FloatArray,
    x_m: FloatArray,
    y_m: FloatArray,
) -> PoseTable:
    """A PoseTable of poses at two times or more, in any order; of several at one time the first
    counts."""
    time_ns, first = np.unique(time_ns, return_index=True)
    pose = np.column_stack([np.unwrap(yaw_deg[first], period=360), x_m[first], y_m[first]])
    return PoseTable(name, source, time_ns, pose, POSE_GAP * float(np.median(np.diff(time_ns))))
