"""What a sonar.toml, flags or a message state of the sonar, and whether it is complete."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sonarrec.records import SonarrecError

MIN_WINDOW_M = 0.01
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
CHOICES = {
    "layout": ("fan", "polar"),
    "beam_order": ("range-major", "beam-major"),
    "pixel_scale": ("linear", "log", "db"),
}
"""The keys of a Sonar that are one of a few words."""


@dataclass(frozen=True, slots=True)
class Sonar:
    """The sonar's geometry as a sonar.toml or a message states it; None where it says nothing.

    layout: "fan" or "polar". Ranges and height in metres, angles in degrees (tilt downward),
    apex_px: (column, row) of the fan's apex. bearings_deg: one per beam of a polar image, and
    ranges_m: one per range bin, at its middle, both where they are not evenly spaced.
    beam_order: of a polar image, "range-major" (a row per range bin) or "beam-major" (a row per
    beam). flip: left and right are exchanged. pixel_scale, full_scale, dynamic_range_db: how
    pixels become 8-bit grey, see `readers.pixels`.
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
    ranges_m: tuple[float, ...] | None = None
    beam_order: Literal["range-major", "beam-major"] | None = None
    flip: bool | None = None
    pixel_scale: Literal["linear", "log", "db"] | None = None
    full_scale: float | None = None
    dynamic_range_db: float | None = None

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


def sonar_from(given: Sonar | Mapping[str, Any] | None) -> Sonar:
    """The geometry that a program gives: a Sonar, keys of sonar.toml, or nothing."""
    return given if isinstance(given, Sonar) else sonar_from_table(given or {}, "sonar")


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
        if key in CHOICES:
            if value not in CHOICES[key]:
                allowed = " or ".join(f'"{choice}"' for choice in CHOICES[key])
                raise SonarrecError(f"{where}: {key} must be {allowed}, not {value!r}")
            values[key] = value
        elif key == "flip":
            if not isinstance(value, bool):
                raise SonarrecError(f"{where}: flip must be true or false, not {value!r}")
            values[key] = value
        elif key in ("apex_px", "bearings_deg", "ranges_m"):
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


def missing_keys(sonar: Sonar) -> list[str]:
    """The keys without which the geometry is not complete and which it does not state."""
    needed = ["range_min_m", "range_max_m", "tilt_deg"]
    if sonar.bearings_deg is None:
        needed.append("field_of_view_deg")
    return [key for key in needed if getattr(sonar, key) is None]


def check_sonar(sonar: Sonar, where: str) -> None:
    """Raise SonarrecError where the geometry is incomplete or contradicts itself."""
    missing = missing_keys(sonar)
    if missing:
        raise SonarrecError(
            f"{where}: sonar geometry lacks {', '.join(missing)}. Put a sonar.toml beside "
            f"the log (or use --sonar FILE, or flags such as --{missing[0].replace('_', '-')}); "
            f"like this:\n"
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
    if high - low < MIN_WINDOW_M:
        raise contradiction(f"a window of {high - low:g} m is shorter than {MIN_WINDOW_M:g} m")
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
    for key in ("frame_rate_hz", "metres_per_pixel", "dynamic_range_db"):
        value = getattr(sonar, key)
        if value is not None and value <= 0:
            raise contradiction(f"{key} = {value:g} must be above 0")
    if sonar.bearings_deg is not None:
        steps = np.diff(sonar.bearings_deg)
        if len(sonar.bearings_deg) < 2 or not (np.all(steps > 0) or np.all(steps < 0)):
            raise contradiction("bearings_deg must rise or fall steadily from beam to beam")
        if max(abs(b) for b in sonar.bearings_deg) >= 90:
            raise contradiction("bearings_deg must lie between -90 and 90")
    if sonar.ranges_m is not None:
        ranges = np.asarray(sonar.ranges_m)
        if len(ranges) < 2 or not np.all(np.diff(ranges) > 0):
            raise contradiction("ranges_m must rise from bin to bin")
        if not low <= ranges[0] < ranges[-1] <= high:
            raise contradiction("ranges_m must lie between range_min_m and range_max_m")
