"""Basics of all pictures: colours, a pen, the outline of a disc, frames put together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import (
    STEEPEST,
    floor_depth,
    ground_range,
    pixel_from_polar,
    polar_from_pixel,
    slant_range,
)
from sonarrec.tables.outputs import replaced, with_mark, writing

Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""
Point = FloatArray | tuple[float, float]

# Okabe and Ito's colours, distinct with any colour vision; first those that stand out on black.
OKABE_ITO: tuple[Colour, ...] = (
    *((86, 180, 233), (204, 121, 167), (230, 159, 0), (0, 158, 115)),
    *((240, 228, 66), (213, 94, 0), (0, 114, 178)),
)
UNNAMED: Colour = (200, 200, 200)
TRUTH: Colour = (255, 255, 255)
GRID: Colour = (110, 150, 160)
FLOOR: Colour = (230, 159, 0)

_SMALLEST = 512  # pixels of the longer side below which a frame is enlarged to be legible
_FINE = 4  # fractional bits of the coordinates that OpenCV draws at
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_BLACK: Colour = (0, 0, 0)


def landmark_colours(ids: Sequence[int]) -> dict[int, Colour]:
    """One colour per ID: Okabe and Ito's, then the same ones again, ever paler."""
    rounds = -(-len(ids) // len(OKABE_ITO))
    colours = {}
    for n, landmark in enumerate(ids):
        pale = n // len(OKABE_ITO) / rounds
        red, green, blue = (round(c + pale * (255 - c)) for c in OKABE_ITO[n % len(OKABE_ITO)])
        colours[landmark] = (red, green, blue)
    return colours


ALL_ROUND = np.linspace(0, 2 * np.pi, 48, endpoint=False)


def disc_outline(
    fan: Fan,
    radius_m: float,
    x_px: float,
    y_px: float,
    angle: FloatArray = ALL_ROUND,
) -> FloatArray:
    """(n, 2) column and row, in fan pixels, of the edge of a floor disc centred at a fan pixel.

    angle: (n,) of its points, counter-clockwise from the right, seen from above.

    Exact for a flat floor: almost an ellipse, squeezed along the range and stretched across it. If
    the centre is nearer than the floor can be, the outline has the shape of one at the nearest
    floor.
    """
    range_m, bearing_deg = polar_from_pixel(fan, x_px, y_px)
    floor_m = np.maximum(range_m, STEEPEST * floor_depth(fan))
    ground, bearing = ground_range(fan, floor_m), np.radians(bearing_deg)
    across = ground * np.sin(bearing) + radius_m * np.cos(angle)
    along = ground * np.cos(bearing) + radius_m * np.sin(angle)
    range_m = slant_range(fan, np.hypot(across, along))
    outline = np.column_stack(pixel_from_polar(fan, range_m, np.degrees(np.arctan2(across, along))))
    drawn_at = np.array(pixel_from_polar(fan, floor_m, bearing_deg))
    return np.asarray(outline + np.array([x_px, y_px]) - drawn_at)


def pixel_unit(longer_side: int) -> float:
    """Factor for text and line widths, which are designed for pictures of 512 pixels."""
    return max(1.0, longer_side / 640)


class Pen:
    """Anti-aliased lines and text; lines in pixels of the image before its enlargement."""

    def __init__(self, canvas: np.ndarray, unit: float, scale: int = 1) -> None:
        self.canvas: ByteImage = np.asarray(canvas, np.uint8)
        self._unit = unit
        self._thickness = max(1, round(unit))
        self._scale = scale

    def _in_canvas(self, points: FloatArray) -> FloatArray:
        # Pixel centres are whole numbers before and after.
        return np.asarray((points + 0.5) * self._scale - 0.5)

    def lines(self, lines: FloatArray, colour: Colour, width: int, *, closed: bool = False) -> None:
        """Draw (lines, points, 2) in one colour."""
        # Points far outside are moved nearer, so that they fit into 32 bits.
        fixed = np.clip(self._in_canvas(lines) * 2**_FINE, -1e8, 1e8).round().astype(np.int32)
        width = round(width * self._unit)
        cv2.polylines(self.canvas, list(fixed), closed, colour[::-1], width, cv2.LINE_AA, _FINE)

    def line(self, points: FloatArray, colour: Colour, width: int, *, closed: bool = False) -> None:
        """Draw (points, 2) with a dark rim that sets it off from the image."""
        self.lines(points[None], _BLACK, width + 1, closed=closed)
        self.lines(points[None], colour, width, closed=closed)

    def dashes(self, outline: FloatArray, colour: Colour) -> None:
        """Draw a closed line of (a multiple of 4, 2) points, dashed."""
        parts = np.roll(outline, 1, axis=0).reshape(-1, 4, 2)[:, :3]
        self.lines(parts, _BLACK, 3)
        self.lines(parts, colour, 1)

    def label(self, text: str, outline: FloatArray, colour: Colour, below: bool = False) -> None:
        """Write above (or below) an outline, inside the picture."""
        if not text:
            return
        low, high = self._in_canvas(outline.min(axis=0)), self._in_canvas(outline.max(axis=0))
        (width, height), drop = cv2.getTextSize(text, _FONT, self._unit / 2, self._thickness)
        gap = 5 * self._unit
        y = high[1] + gap + height if below or low[1] < gap + height else low[1] - gap
        x = (low[0] + high[0] - width) / 2
        x = min(max(x, 2), self.canvas.shape[1] - width - 2)
        y = min(max(y, height + 2), self.canvas.shape[0] - drop)
        rows = slice(max(0, round(y - height) - 3), round(y + drop))
        self.canvas[rows, max(0, round(x) - 3) : round(x + width) + 3] //= 4
        self.text(text, (x, y), colour)

    def note(self, text: str, point: Point, colour: Colour, centred: bool = False) -> None:
        """Write at a point of the image (its bottom left, or middle), inside the picture."""
        (width, height), _ = cv2.getTextSize(text, _FONT, self._unit / 2, self._thickness)
        x, y = self._in_canvas(np.asarray(point, float))
        x, y = x + 3 * self._unit, y - 3 * self._unit
        x = min(max(x - (width / 2 if centred else 0), 2), self.canvas.shape[1] - width - 2)
        y = min(max(y, height + 2), self.canvas.shape[0] - 3)
        rows = slice(max(0, round(y - height) - 1), round(y) + 2)
        self.canvas[rows, max(0, round(x) - 1) : round(x + width) + 1] //= 3
        self.text(text, (x, y), colour)

    def text(self, text: str, corner: Point, colour: Colour, align_right: bool = False) -> None:
        """Write from the bottom-left (or right) corner of the text, in pixels of the canvas."""
        width = int(cv2.getTextSize(text, _FONT, self._unit / 2, self._thickness)[0][0])
        left = round(corner[0]) - (width if align_right else 0)
        style = (_FONT, self._unit / 2, colour[::-1], self._thickness, cv2.LINE_AA)
        cv2.putText(self.canvas, text, (left, round(corner[1])), *style)


def pen_on(image: ByteImage, fan: Fan) -> Pen:
    """A pen that draws in fan pixels on the image, enlarged to be legible."""
    scale = -(-_SMALLEST // max(fan.rows, fan.columns))
    size = (fan.columns * scale, fan.rows * scale)
    upsampled = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return Pen(cv2.cvtColor(upsampled, cv2.COLOR_GRAY2BGR), pixel_unit(max(size)), scale)


def draw_picture(frame: ByteImage, strip: ByteImage) -> ByteImage:
    """A drawn frame above its strip, both centred; even sides, as video codecs need them."""
    rows, columns = frame.shape[0] + strip.shape[0], max(frame.shape[1], strip.shape[1])
    picture = np.zeros((rows + rows % 2, columns + columns % 2, 3), np.uint8)
    for top, part in ((0, frame), (frame.shape[0], strip)):
        left = (picture.shape[1] - part.shape[1]) // 2
        picture[top : top + part.shape[0], left : left + part.shape[1]] = part
    return picture


def write_png(path: Path, picture: ByteImage) -> None:
    """Write (rows, columns, 3) uint8 BGR. Raises SonarrecError if it cannot be written."""
    with writing(path), replaced(path) as new:
        new.write_bytes(with_mark(cv2.imencode(".png", picture)[1].tobytes()))
