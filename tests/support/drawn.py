"""Pictures with known truth for the tests, drawn from first principles.

Nothing here calls the code under test: geometry and patterns are written out again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np

from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import fan_for_image
from sonarrec.sonar.stated import Sonar

RING = (0.80, 1.00)
SYMBOL = (0.00, 0.62)
SECTORS = {1: (1, 0, 0, 0), 2: (1, 0, 1, 0), 3: (1, 1, 0, 0), 4: (1, 1, 1, 0)}
FINE = 3  # samples per pixel and axis
Pattern = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Brightness at places on a disc, in radii to the right and up."""


def make_fan(
    rows: int = 300,
    range_min_m: float = 1.25,
    range_max_m: float = 3.75,
    field_of_view_deg: float = 28.8,
    tilt_deg: float = 20.0,
    height_m: float | None = 0.68,
) -> Fan:
    """The fan of an image just wide enough for its field of view."""
    window = {"range_min_m": range_min_m, "range_max_m": range_max_m, "height_m": height_m}
    sonar = Sonar("fan", field_of_view_deg=field_of_view_deg, tilt_deg=tilt_deg, **window)
    half = range_max_m * math.sin(math.radians(field_of_view_deg / 2))
    columns = 2 * math.ceil(half / ((range_max_m - range_min_m) / rows)) + 1
    return fan_for_image(sonar.complete("test"), rows, columns)


def disc_pattern(sectors: Sequence[int], turn_rad: float = 0.0) -> Pattern:
    """Brightness 0 or 1 over the unit disc (x right, y up), first sector at `turn_rad`."""

    def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        radius = np.hypot(x, y)
        bright = (radius >= RING[0]) & (radius <= RING[1])
        inside = radius <= SYMBOL[1]  # angles take longest
        share = np.mod(np.arctan2(y[inside], x[inside]) - turn_rad, 2 * np.pi) / (2 * np.pi)
        sector = np.minimum((share * len(sectors)).astype(int), len(sectors) - 1)
        bright[inside] = np.asarray(sectors)[sector] == 1
        return bright.astype(float)

    return pattern


def _fine_grid(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """(row, column) of FINE x FINE samples in every pixel, pixel centres at whole numbers."""
    row, column = np.mgrid[0 : rows * FINE, 0 : columns * FINE]
    return (row + 0.5) / FINE - 0.5, (column + 0.5) / FINE - 0.5


def _pixels(fine: np.ndarray) -> np.ndarray:
    rows, columns = fine.shape[0] // FINE, fine.shape[1] // FINE
    return fine.reshape(rows, FINE, columns, FINE).mean(axis=(1, 3))


def draw_ellipse_disc(
    shape: tuple[int, int], centre: tuple[float, float], axes: tuple[float, float], pattern: Pattern
) -> np.ndarray:
    """(rows, columns) brightness 0 to 1 of a disc squeezed to semi-axes (across, along) pixels."""
    row, column = _fine_grid(*shape)
    return _pixels(pattern((column - centre[0]) / axes[0], (centre[1] - row) / axes[1]))


def draw_on_floor(
    fan: Fan, range_m: float, bearing_deg: float, radius_m: float, pattern: Pattern
) -> tuple[np.ndarray, np.ndarray]:
    """A disc on a flat floor as a fan image sees it.

    Returns the brightness 0 to 1 and where the fan is seen at all, both (rows, columns). The fan
    must know its height: ground range = sqrt(slant range^2 - height^2).
    """
    brightness = np.zeros((fan.rows, fan.columns))
    seen, box, x, y = _near_disc(fan, range_m, bearing_deg, radius_m)
    brightness[box] = _pixels(pattern(x, y))
    return brightness, seen.copy()


@lru_cache(maxsize=32)  # a megabyte each; the frames of a log, and plate and symbol of a frame
def _near_disc(
    fan: Fan, range_m: float, bearing_deg: float, radius_m: float
) -> tuple[np.ndarray, tuple[slice, slice], np.ndarray, np.ndarray]:
    """Where the fan is seen, the pixels about a disc, and the places of their samples on it."""
    assert fan.height_m is not None
    row, column = np.mgrid[0 : fan.rows, 0 : fan.columns]
    slant, bearing, x, y = _on_disc(fan, row, column, range_m, bearing_deg, radius_m)
    seen = (slant >= fan.range_min_m) & (slant <= fan.range_max_m)
    seen &= np.abs(np.degrees(bearing)) <= fan.bearing_max_deg
    rows, columns = np.nonzero(np.hypot(x, y) < 1.5)
    if not len(rows):
        return seen, np.s_[:0, :0], np.zeros((0, 0)), np.zeros((0, 0))
    box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    row, column = _fine_grid(*row[box].shape)
    pixels = row + rows.min(), column + columns.min()
    _, _, x, y = _on_disc(fan, *pixels, range_m, bearing_deg, radius_m)
    return seen, box, x, y


def _on_disc(
    fan: Fan,
    row: np.ndarray,
    column: np.ndarray,
    range_m: float,
    bearing_deg: float,
    radius_m: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Slant range (m), bearing (rad) and place on the disc (radii) of fan pixels."""
    assert fan.height_m is not None
    across = (column - fan.apex_column) * fan.metres_per_pixel
    ahead = (fan.apex_row - row) * fan.metres_per_pixel
    slant, bearing = np.hypot(across, ahead), np.arctan2(across, ahead)
    ground = np.sqrt(np.maximum(slant**2 - fan.height_m**2, 0))
    place = math.sqrt(range_m**2 - fan.height_m**2)
    b = math.radians(bearing_deg)
    x = (ground * np.sin(bearing) - place * math.sin(b)) / radius_m
    y = (ground * np.cos(bearing) - place * math.cos(b)) / radius_m
    return slant, bearing, x, y


def speckled(
    brightness: np.ndarray,
    seen: np.ndarray,
    rng: np.random.Generator,
    *,
    floor_db: float = -14.0,
    dark: np.ndarray | None = None,
) -> np.ndarray:
    """uint8 log-compressed picture (60 dB over 255 levels): Rayleigh speckle, black outside.

    dark: 0 to 1, where the floor is hidden by a plate 8 dB darker still.
    """
    floor = 10 ** (floor_db / 10)
    power = floor * (1.0 if dark is None else 1 - 0.84 * dark) * (1 - brightness) + brightness
    power = power * rng.exponential(size=power.shape)
    decibel = 10 * np.log10(np.maximum(power, 1e-9))
    grey = np.clip((decibel + 45) / 60 * 255, 1, 255)
    return np.where(seen, grey, 0).astype(np.uint8)


def whole_disc(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The pattern of a disc that is bright all over, which is the shape of a plate as well."""
    return (np.hypot(x, y) <= 1) * 1.0


def speckled_disc(
    rng: np.random.Generator,
    fan: Fan,
    range_m: float,
    bearing_deg: float,
    radius_m: float,
    pattern: Pattern,
) -> np.ndarray:
    """uint8 picture of a disc on its dark plate, with new speckle each time."""
    disc, seen = draw_on_floor(fan, range_m, bearing_deg, radius_m, pattern)
    plate, _ = draw_on_floor(fan, range_m, bearing_deg, radius_m, whole_disc)
    return speckled(disc, seen, rng, dark=plate)


def surroundings(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sigma of an image for ShapeSampler: (1,) each, for all objects the same."""
    return np.array([image.mean()]), np.array([image.std() or 1.0])
