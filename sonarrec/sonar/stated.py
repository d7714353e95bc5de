"""The sonar's geometry as a sonar.toml, flags or messages state it, and whether it is complete."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sonarrec.errors import SonarrecError, UsageError, as_usage
from sonarrec.sonar.frame import BeamOrder, ColourMap
from sonarrec.tables.toml import Finite, from_table, read_toml

MIN_WINDOW_M = 0.01
STEEPEST_TILT_DEG = 89.0  # of tilts that are assumed; at 90 every disc would be a line (Eq. 1)
RangeOrder = Literal["near_first", "far_first"]


@dataclass(frozen=True, slots=True)
class Geometry:
    """A complete geometry that does not contradict itself: `Sonar.complete` makes it."""

    range_min_m: float
    """The window's slant ranges."""
    range_max_m: float
    bearing_min_deg: float
    """The fan's edges: half a beam beyond the outermost beams' middles."""
    bearing_max_deg: float
    tilt_deg: float
    height_m: float | None
    """None: not known, see geometry.floor_depth."""
    metres_per_pixel: float | None
    """Of a fan image; None: its rows are the window."""
    apex_px: tuple[float, float] | None
    """(column, row); None: midway, below the window."""
    bearings_deg: tuple[float, ...] | None
    """Of a polar image's beams; None: evenly spaced."""
    ranges_m: tuple[float, ...] | None
    """Of its bins' middles; None: evenly spaced."""
    flip: bool


@dataclass(frozen=True, slots=True)
class Sonar:
    """The sonar's geometry as a sonar.toml, flags or a run.toml state it; None: not stated."""

    layout: Literal["fan", "polar"] | None = None
    range_min_m: Finite | None = None
    """Slant range."""
    range_max_m: Finite | None = None
    field_of_view_deg: Finite | None = None
    tilt_deg: Finite | None = None
    """Downward."""
    height_m: Finite | None = None
    """Above the floor."""
    frame_rate_hz: Finite | None = None
    """Where frames carry no time."""
    beam_width_deg: Finite | None = None
    """Two-way, between half-power points."""
    metres_per_pixel: Finite | None = None
    """Of a fan image."""
    apex_px: tuple[Finite, Finite] | None = None
    """(column, row) of the fan's apex."""
    bearings_deg: tuple[Finite, ...] | None = None
    """One per beam, where not evenly spaced."""
    ranges_m: tuple[Finite, ...] | None = None
    """One per bin, at its middle, where not evenly spaced."""
    beam_order: BeamOrder | None = None
    """Of a polar image: a row per range bin, or per beam."""
    range_order: RangeOrder | None = None
    """Of its rows, or of a beam's samples; None: near first."""
    flip: bool | None = None
    """Left and right are exchanged."""
    colour_map: ColourMap | None = None
    """Of pictures in false colour."""
    pixel_scale: Literal["linear", "log", "db"] | None = None
    """This and the next two: how pixels become 8-bit grey, see readers.decode.grey."""
    full_scale: Finite | None = None
    dynamic_range_db: Finite | None = None

    def updated(self, other: Sonar) -> Sonar:
        """This geometry, with the keys that `other` states replaced by its values."""
        return replace(self, **{key: getattr(other, key) for key in other.as_table()})

    def as_table(self) -> dict[str, Any]:
        """The stated keys as plain TOML values, in the order of the fields."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in values.items()
            if value is not None
        }

    def as_options(self) -> list[str]:
        """The stated keys as options of a command."""
        words = list[str]()
        for key, value in self.as_table().items():
            name = key.replace("_", "-")
            if isinstance(value, bool):
                words.append(f"--{name}" if value else f"--no-{name}")
                continue
            values = value if isinstance(value, list) else [value]
            texts = [v if isinstance(v, str) else f"{v:.10g}" for v in values]
            words.append(f"--{name}")
            words += texts if key == "apex_px" else [",".join(texts)]
        return words

    def missing(self) -> list[str]:
        """The keys that a complete geometry needs and that are not stated."""
        needed = ("range_min_m", "range_max_m", "tilt_deg", "field_of_view_deg")
        stated = {"tilt_deg": self.states_floor, "field_of_view_deg": self.bearings_deg is not None}
        return [key for key in needed if getattr(self, key) is None and not stated.get(key)]

    @property
    def order_of_ranges(self) -> RangeOrder:
        """Which end of the ranges is on top, as stated or by default."""
        return self.range_order or ("near_first" if self.layout == "polar" else "far_first")

    @property
    def other_range_order(self) -> RangeOrder:
        """That in which the images are not read."""
        return "near_first" if self.order_of_ranges == "far_first" else "far_first"

    @property
    def states_floor(self) -> bool:
        """Whether it states where the floor is, by the tilt or by the height."""
        return self.tilt_deg is not None or self.height_m is not None

    def complete(self, where: str) -> Geometry:
        """The complete geometry. Raises SonarrecError if it lacks a key or contradicts itself.

        If the height is stated but not the tilt, the beam's axis is assumed to meet the floor in
        the middle of the window. `geometry.floor_depth` assumes the same if only the tilt is.
        """
        low, high, beams = self.range_min_m, self.range_max_m, self.bearings_deg
        tilt = self.tilt_deg
        if tilt is None and self.height_m is not None and low is not None and high is not None:
            sine = min(max(2 * self.height_m / max(low + high, MIN_WINDOW_M), 0.0), 1.0)
            tilt = min(round(math.degrees(math.asin(sine)), 2), STEEPEST_TILT_DEG)
        view = self.field_of_view_deg if beams is None else 0.0  # not needed with the beams
        if low is None or high is None or tilt is None or view is None:
            missing = self.missing()
            raise SonarrecError(
                f"{where}: sonar geometry lacks {', '.join(missing)}; fill in the log's "
                f"sonar.toml, or give options such as --{missing[0].replace('_', '-')}"
            )
        wrong = self.contradiction()
        if wrong is not None:
            raise SonarrecError(_contradicts_itself(where, wrong))
        flip = bool(self.flip)
        least, most = (-view / 2, view / 2) if beams is None else _edges(beams, flip)
        return Geometry(
            range_min_m=low,
            range_max_m=high,
            bearing_min_deg=least,
            bearing_max_deg=most,
            tilt_deg=tilt,
            height_m=self.height_m,
            metres_per_pixel=self.metres_per_pixel,
            apex_px=self.apex_px,
            bearings_deg=beams,
            ranges_m=self.ranges_m,
            flip=flip,
        )

    def contradiction(self) -> str | None:
        """The first contradiction, in a few words; None if there is none."""
        return next((wrong for _, wrong in self._contradictions()), None)

    def check_stated(self, flags: Sonar, where: str) -> None:
        """Raise UsageError if what is stated is contradictory.

        flags: the part that options state; they are to blame where they are involved, else the
        file, which `where` names.
        """
        for keys, wrong in self._contradictions():
            stated = [f"--{k.replace('_', '-')}" for k in keys if getattr(flags, k) is not None]
            if stated:
                raise UsageError(f"{' and '.join(stated)}: {wrong}")
            raise UsageError(_contradicts_itself(where, wrong))

    def _contradictions(self) -> Iterator[tuple[tuple[str, ...], str]]:
        """(the keys involved, a few words) for each contradiction and impossible value."""
        low, high, tilt = self.range_min_m, self.range_max_m, self.tilt_deg
        window = ("range_min_m", "range_max_m")
        if low is not None and high is not None:
            if not 0 <= low < high:
                yield window, f"range_min_m = {low:g} must be >= 0 and below range_max_m = {high:g}"
            if high - low < MIN_WINDOW_M:
                yield window, f"a window of {high - low:g} m is shorter than {MIN_WINDOW_M:g} m"
        view, height = self.field_of_view_deg, self.height_m
        if view is not None and not 0 < view < 180:
            wrong = f"field_of_view_deg = {view:g} must be above 0 and below 180"
            yield ("field_of_view_deg",), wrong
        if tilt is not None and not 0 <= tilt < 90:
            yield ("tilt_deg",), f"tilt_deg = {tilt:g} must be 0 to below 90 (downward)"
        if height is not None and high is not None and not 0 < height < high:
            yield (
                ("height_m", "range_max_m"),
                f"height_m = {height:g} must be more than 0 and less than range_max_m = {high:g}, "
                "or no floor is in view (is it in metres?)",
            )
        for key in ("frame_rate_hz", "metres_per_pixel", "dynamic_range_db"):
            value = getattr(self, key)
            if value is not None and value <= 0:
                yield (key,), f"{key} = {value:g} must be above 0"
        width, beams, bins = self.beam_width_deg, self.bearings_deg, self.ranges_m
        if width is not None and not 0 < width <= 5:  # as features.beam_width_deg
            yield ("beam_width_deg",), f"beam_width_deg = {width:g} must be above 0, and at most 5"
        if beams is not None:
            if max(map(abs, beams), default=0) >= 90:
                yield ("bearings_deg",), "bearings_deg must lie between -90 and 90"
            if len(beams) < 2 or len(set(np.sign(np.diff(beams)))) > 1 or beams[0] == beams[1]:
                wrong = "bearings_deg must rise or fall from beam to beam, and be two or more"
                yield ("bearings_deg",), wrong
        if bins is not None:
            if len(bins) < 2 or min(np.diff(bins)) <= 0:
                yield ("ranges_m",), "ranges_m must rise from bin to bin"
            elif (low is not None and bins[0] < low) or (high is not None and bins[-1] > high):
                wrong = "ranges_m must lie between range_min_m and range_max_m"
                yield ("ranges_m", *window), wrong


def _contradicts_itself(where: str, wrong: str) -> str:
    fault = f"{where}: sonar geometry contradicts itself: {wrong}"
    return f"{fault}; correct it in sonar.toml or by flag"


def _edges(bearings_deg: tuple[float, ...], flip: bool) -> tuple[float, float]:
    """The fan's edges, deg: half a beam beyond the outermost beams' middles."""
    bearings = np.sort(np.asarray(bearings_deg) * (-1 if flip else 1))
    return (
        float(bearings[0] - (bearings[1] - bearings[0]) / 2),
        float(bearings[-1] + (bearings[-1] - bearings[-2]) / 2),
    )


def load_sonar(path: Path) -> Sonar:
    """Read a sonar.toml, or the geometry that a run.toml states.

    Raises UsageError if the file cannot be read, is not TOML, has no table [sonar], or has an
    unknown key or an invalid value.
    """
    with as_usage():
        document = read_toml(path)
        if set(document) != {"sonar"} and not {"program", "sonar"} <= set(document):
            raise SonarrecError(f"{path}: expected one table [sonar]; see `sonarrec help geometry`")
        return sonar_from_table(document["sonar"], str(path))


def sonar_from(sonar: Sonar | Mapping[str, Any] | None) -> Sonar:
    """The geometry that a program passes: a Sonar, keys of sonar.toml, or nothing."""
    return sonar if isinstance(sonar, Sonar) else sonar_from_table(sonar or {}, "sonar")


def sonar_from_table(table: object, where: str) -> Sonar:
    """A Sonar from the keys of a [sonar] table; `where` names it in errors (SonarrecError)."""
    return from_table(Sonar, table, where, section="sonar")
