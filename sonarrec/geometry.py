"""Metres and pixels: sonar.toml, the fan image, polar to fan, and the floor.

Every conversion between metres and pixels in the program is made here.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from sonarrec.records import ByteImage, Fan, FloatArray, SonarrecError

EXAMPLE_SONAR_TOML = """\
[sonar]
layout = "fan"              # or "polar": rows = range bins (row 0 nearest), columns = beams
range_min_m = 1.25
range_max_m = 3.75
field_of_view_deg = 28.8
tilt_deg = 20.0             # downward
height_m = 0.68             # above the floor; optional
frame_rate_hz = 4.0         # where frames carry no time; optional
"""


@dataclass(frozen=True, slots=True)
class Sonar:
    """The sonar's geometry as a sonar.toml states it; None where it says nothing.

    layout: "fan" or "polar". Ranges and height in metres, angles in degrees (tilt downward),
    apex_px: (column, row) of the fan's apex. bearings_deg: one per beam of a polar image.
    """

    layout: Literal["fan", "polar"] | None = None
    range_min_m: float | None = None
    range_max_m: float | None = None
    field_of_view_deg: float | None = None
    tilt_deg: float | None = None
    height_m: float | None = None
    frame_rate_hz: float | None = None
    metres_per_pixel: float | None = None
    apex_px: tuple[float, float] | None = None
    bearings_deg: tuple[float, ...] | None = None

    def updated(self, other: Sonar) -> Sonar:
        """This geometry with every key that `other` states put in its place."""
        stated = {f.name: v for f in fields(other) if (v := getattr(other, f.name)) is not None}
        return replace(self, **stated)

    def as_table(self) -> dict[str, Any]:
        """The stated keys, in the order of the contract, as plain TOML values."""
        table = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None:
                table[field.name] = list(value) if isinstance(value, tuple) else value
        return table


def load_sonar(path: Path) -> Sonar:
    """Read a sonar.toml.

    Raises SonarrecError where the file cannot be read, is no TOML, lacks [sonar],
    or has a key or value that cannot be meant.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise SonarrecError(f"{path}: cannot be read ({error})") from None
    except tomllib.TOMLDecodeError as error:
        raise SonarrecError(f"{path}: not valid TOML ({error})") from None
    if set(document) != {"sonar"} or not isinstance(document["sonar"], dict):
        raise SonarrecError(f"{path}: expected one table [sonar]; like this:\n{EXAMPLE_SONAR_TOML}")
    return sonar_from_table(document["sonar"], str(path))


def sonar_from_table(table: Mapping[str, Any], where: str) -> Sonar:
    """A Sonar from the keys of a [sonar] table; `where` names it in errors (SonarrecError)."""
    known = {field.name for field in fields(Sonar)}
    unknown = sorted(set(table) - known)
    if unknown:
        raise SonarrecError(
            f"{where}: unknown key {unknown[0]!r} in [sonar]; "
            f"known keys: {', '.join(sorted(known))}"
        )
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key == "layout":
            if value not in ("fan", "polar"):
                raise SonarrecError(f'{where}: layout must be "fan" or "polar", not {value!r}')
            values[key] = value
        elif key in ("apex_px", "bearings_deg"):
            if not isinstance(value, list | tuple) or not all(_is_number(v) for v in value):
                raise SonarrecError(f"{where}: {key} must be a list of numbers")
            if key == "apex_px" and len(value) != 2:
                raise SonarrecError(f"{where}: apex_px must be [column, row]")
            values[key] = tuple(float(v) for v in value)
        elif not _is_number(value):
            raise SonarrecError(f"{where}: {key} must be a finite number, not {value!r}")
        else:
            values[key] = float(value)
    return Sonar(**values)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def check_sonar(sonar: Sonar, where: str) -> None:
    """Raise SonarrecError where the geometry is incomplete or contradicts itself."""
    needed = ["range_min_m", "range_max_m", "tilt_deg"]
    if sonar.bearings_deg is None:
        needed.append("field_of_view_deg")
    missing = [key for key in needed if getattr(sonar, key) is None]
    if missing:
        raise SonarrecError(
            f"{where}: sonar geometry lacks {', '.join(missing)}. Put a sonar.toml beside "
            f"the log (or use --sonar FILE, or flags such as --range-min-m); like this:\n"
            f"{EXAMPLE_SONAR_TOML}"
        )
    low, high = sonar.range_min_m, sonar.range_max_m
    assert low is not None
    assert high is not None
    assert sonar.tilt_deg is not None

    def contradiction(text: str) -> SonarrecError:
        return SonarrecError(
            f"{where}: sonar geometry contradicts itself: {text}; "
            f"correct it in sonar.toml or by flag, like this:\n{EXAMPLE_SONAR_TOML}"
        )

    if not 0 <= low < high:
        raise contradiction(f"range_min_m = {low:g} must be >= 0 and below range_max_m = {high:g}")
    if sonar.field_of_view_deg is not None and not 0 < sonar.field_of_view_deg < 180:
        raise contradiction(
            f"field_of_view_deg = {sonar.field_of_view_deg:g} must be within 0 to 180"
        )
    if not 0 <= sonar.tilt_deg < 90:
        raise contradiction(f"tilt_deg = {sonar.tilt_deg:g} must be within 0 to 90 (downward)")
    if sonar.height_m is not None and not 0 < sonar.height_m < high:
        raise contradiction(
            f"height_m = {sonar.height_m:g} must be above 0 and below range_max_m = {high:g}, "
            "or no floor is in the window"
        )
    for key in ("frame_rate_hz", "metres_per_pixel"):
        value = getattr(sonar, key)
        if value is not None and value <= 0:
            raise contradiction(f"{key} = {value:g} must be above 0")
    if sonar.bearings_deg is not None:
        steps = np.diff(sonar.bearings_deg)
        if len(sonar.bearings_deg) < 2 or not (np.all(steps > 0) or np.all(steps < 0)):
            raise contradiction("bearings_deg must rise or fall steadily from beam to beam")
        if max(abs(b) for b in sonar.bearings_deg) >= 90:
            raise contradiction("bearings_deg must lie between -90 and 90")


def _bearing_limits(sonar: Sonar) -> tuple[float, float]:
    """The fan's two edges in degrees: half a beam beyond the outermost beam centres."""
    if sonar.bearings_deg is None:
        assert sonar.field_of_view_deg is not None
        return -sonar.field_of_view_deg / 2, sonar.field_of_view_deg / 2
    bearings = np.sort(np.asarray(sonar.bearings_deg))
    return (
        float(bearings[0] - (bearings[1] - bearings[0]) / 2),
        float(bearings[-1] + (bearings[-1] - bearings[-2]) / 2),
    )


def fan_for_image(sonar: Sonar, rows: int, columns: int) -> Fan:
    """The fan of a fan-layout image of `rows` x `columns` pixels. `sonar` has been checked."""
    assert sonar.range_min_m is not None
    assert sonar.range_max_m is not None
    assert sonar.tilt_deg is not None
    scale = sonar.metres_per_pixel or (sonar.range_max_m - sonar.range_min_m) / rows
    apex = sonar.apex_px or ((columns - 1) / 2, rows - 0.5 + sonar.range_min_m / scale)
    low, high = _bearing_limits(sonar)
    return Fan(
        rows=rows,
        columns=columns,
        metres_per_pixel=scale,
        apex_column=apex[0],
        apex_row=apex[1],
        range_min_m=sonar.range_min_m,
        range_max_m=sonar.range_max_m,
        bearing_min_deg=low,
        bearing_max_deg=high,
        tilt_deg=sonar.tilt_deg,
        height_m=sonar.height_m,
    )


@dataclass(frozen=True, slots=True, eq=False)
class PolarGrid:
    """Where the samples of a polar image lie: rows are range bins, columns are beams.

    ranges_m: (rows,) slant ranges of the bins' centres, rising. bearings_deg: (columns,) of the
    beams' centres, rising or falling, positive to the right. Neither need be evenly spaced.
    range_limits_m, bearing_limits_deg: the edges, half a bin or beam beyond the outermost centres.
    """

    ranges_m: FloatArray
    bearings_deg: FloatArray
    range_limits_m: tuple[float, float]
    bearing_limits_deg: tuple[float, float]

    @classmethod
    def from_centres(cls, ranges_m: FloatArray, bearings_deg: FloatArray) -> PolarGrid:
        """Raises ValueError where the centres do not rise, or are no window in front of a sonar."""
        steps, turns = np.diff(ranges_m), np.diff(bearings_deg)
        if len(ranges_m) < 2 or ranges_m[0] < 0 or not np.all(steps > 0):
            raise ValueError("ranges do not rise from bin to bin")
        if len(bearings_deg) < 2 or not (np.all(turns > 0) or np.all(turns < 0)):
            raise ValueError("bearings do not run one way from beam to beam")
        if np.abs(bearings_deg).max() >= 90:
            raise ValueError("bearings reach 90 deg and more")
        edges = max(ranges_m[0] - steps[0] / 2, 0.0), ranges_m[-1] + steps[-1] / 2
        return cls(
            ranges_m,
            bearings_deg,
            (float(edges[0]), float(edges[1])),
            _edges(np.sort(bearings_deg)),
        )

    def same_as(self, other: PolarGrid) -> bool:
        """Whether samples lie in the same places, to what resampling can resolve."""
        return _alike(self.ranges_m, other.ranges_m) and _alike(
            self.bearings_deg, other.bearings_deg
        )


def _edges(centres: FloatArray) -> tuple[float, float]:
    """Half a step beyond the first and last of rising centres."""
    return (
        float(centres[0] - (centres[1] - centres[0]) / 2),
        float(centres[-1] + (centres[-1] - centres[-2]) / 2),
    )


def _alike(some: FloatArray, other: FloatArray) -> bool:
    """Equal to a 64th of a step: cv2.remap places to a 32nd."""
    if some is other:
        return True
    return some.shape == other.shape and bool(
        np.abs(some - other).max() * 64 <= np.abs(np.diff(some)).min()
    )


def fan_for_polar(sonar: Sonar, range_bins: int) -> Fan:
    """The fan into which a polar image of `range_bins` rows is resampled.

    One pixel is one range bin. Rows reach below range_min_m as far as the window's near
    corners do, so that nothing recorded is cut off.
    """
    assert sonar.range_min_m is not None
    assert sonar.range_max_m is not None
    assert sonar.tilt_deg is not None
    scale = (sonar.range_max_m - sonar.range_min_m) / range_bins
    low, high = _bearing_limits(sonar)
    widest = max(abs(low), abs(high))
    rows = math.ceil(
        (sonar.range_max_m - sonar.range_min_m * math.cos(math.radians(widest))) / scale
    )
    half = math.floor(sonar.range_max_m * math.sin(math.radians(widest)) / scale)
    return Fan(
        rows=rows,
        columns=2 * half + 1,
        metres_per_pixel=scale,
        apex_column=float(half),
        apex_row=sonar.range_max_m / scale - 0.5,
        range_min_m=sonar.range_min_m,
        range_max_m=sonar.range_max_m,
        bearing_min_deg=low,
        bearing_max_deg=high,
        tilt_deg=sonar.tilt_deg,
        height_m=sonar.height_m,
    )


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


def in_fan(fan: Fan, range_m: FloatArray, bearing_deg: FloatArray) -> np.ndarray:
    """Which slant ranges and bearings the sonar sees: bool, shapes broadcast."""
    return np.asarray(
        (range_m >= fan.range_min_m)
        & (range_m <= fan.range_max_m)
        & (bearing_deg >= fan.bearing_min_deg)
        & (bearing_deg <= fan.bearing_max_deg)
    )


def fan_mask(fan: Fan) -> ByteImage:
    """(rows, columns) uint8: 255 where the image holds sonar data, 0 outside the fan."""
    row, column = np.mgrid[0 : fan.rows, 0 : fan.columns]
    return in_fan(fan, *polar_from_pixel(fan, column, row)).astype(np.uint8) * 255


class PolarToFan:
    """Resamples polar images (rows = range bins, nearest first; columns = beams) into a fan."""

    def __init__(self, sonar: Sonar, range_bins: int, beams: int) -> None:
        """Raises SonarrecError where bearings_deg does not match the number of beams."""
        self.fan = fan = fan_for_polar(sonar, range_bins)
        if sonar.bearings_deg is not None and len(sonar.bearings_deg) != beams:
            raise SonarrecError(
                f"bearings_deg has {len(sonar.bearings_deg)} bearings but the images have {beams} "
                "beams; give one per image column"
            )
        row, column = np.mgrid[0 : fan.rows, 0 : fan.columns]
        range_m, bearing_deg = polar_from_pixel(fan, column, row)
        if sonar.bearings_deg is None:
            span = fan.bearing_max_deg - fan.bearing_min_deg
            beam = (bearing_deg - fan.bearing_min_deg) / span * beams - 0.5
        else:
            order = np.argsort(sonar.bearings_deg)
            beam = np.interp(
                bearing_deg, np.asarray(sonar.bearings_deg)[order], order.astype(float)
            )
        range_bin = (range_m - fan.range_min_m) / fan.metres_per_pixel - 0.5
        # Half a bin beyond the outermost centres repeats the outermost sample.
        beam = np.clip(beam, 0, beams - 1)
        range_bin = np.clip(range_bin, 0, range_bins - 1)
        self._columns, self._weights = cv2.convertMaps(
            beam.astype(np.float32), range_bin.astype(np.float32), cv2.CV_16SC2
        )
        self._outside = ~in_fan(fan, range_m, bearing_deg)

    def __call__(self, polar: ByteImage) -> ByteImage:
        """(range_bins, beams) uint8 to (fan.rows, fan.columns) uint8; 0 outside the fan."""
        image = cv2.remap(polar, self._columns, self._weights, cv2.INTER_LINEAR)
        image[self._outside] = 0
        return np.asarray(image, dtype=np.uint8)


# The floor. Eq. 1 squeezes a floor circle along the range by cos(tilt). On a flat floor the exact
# relation is ground range^2 = slant range^2 - height^2 at the same bearing: radially the circle
# shrinks by cos(grazing angle), across it grows by the inverse, and tilt drops out.


def floor_depth(fan: Fan) -> float:
    """Height of the sonar above the floor, m.

    Where it is not stated the beam's axis is taken to meet the floor in the middle of the window:
    there, and only there, the exact squeeze is Eq. 1's cos(tilt).
    """
    if fan.height_m is not None:
        return fan.height_m
    middle = (fan.range_min_m + fan.range_max_m) / 2
    return middle * math.sin(math.radians(fan.tilt_deg))


def ground_range(fan: Fan, range_m: FloatArray | float) -> FloatArray:
    """Ground range (m) of floor points at slant range (m); NaN nearer than the floor."""
    slant = np.asarray(range_m, dtype=float)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(slant**2 - floor_depth(fan) ** 2))


def slant_range(fan: Fan, ground_m: FloatArray | float) -> FloatArray:
    """Slant range (m) of floor points at ground range (m): the inverse of ground_range."""
    return np.asarray(np.hypot(np.asarray(ground_m, dtype=float), floor_depth(fan)))
