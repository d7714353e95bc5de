"""Draws what a method says onto a fan image, the probabilities below it, and the stated geometry.

The counterparts of the paper's Figure 13 (frames) and Figure 14 (probabilities over time).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np

from sonarrec.geometry import (
    STEEPEST,
    floor_depth,
    ground_range,
    pixel_from_polar,
    polar_from_pixel,
    slant_range,
)
from sonarrec.landmarks import LandmarkSet
from sonarrec.outputs import marked
from sonarrec.records import ByteImage, Estimate, Fan, FloatArray, SonarrecError

Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""

# Okabe and Ito's colours, told apart with any colour vision; those that stand out on black first.
OKABE_ITO: tuple[Colour, ...] = (
    (86, 180, 233),
    (204, 121, 167),
    (230, 159, 0),
    (0, 158, 115),
    (240, 228, 66),
    (213, 94, 0),
    (0, 114, 178),
)
UNNAMED: Colour = (200, 200, 200)
TRUTH: Colour = (255, 255, 255)
AROUND = 1.15
"""Radius, in discs, at which truth is drawn: it must not hide under an estimate."""
GRID: Colour = (110, 150, 160)
FLOOR: Colour = (230, 159, 0)
TRAIL_FRAMES = 20
STRIP_FRAMES = 120
"""How far back trails and the probability strip reach."""

_SMALLEST = 512  # pixels of the longer side below which a frame is enlarged to be legible
_FINE = 4  # fractional bits of the coordinates that OpenCV draws at
_TICK_FRAMES = 20  # between ticks of the strip's time axis
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_BLACK: Colour = (0, 0, 0)


@dataclass(frozen=True, slots=True)
class Mark:
    """A landmark that ground truth puts at (x_px, y_px) of the fan image."""

    landmark: int
    x_px: float
    y_px: float


@dataclass(frozen=True, slots=True)
class Moment:
    """What one method says in one frame: its number, its time in ns and the estimates."""

    index: int
    timestamp_ns: int
    estimates: tuple[Estimate, ...]


def landmark_colours(ids: Sequence[int]) -> dict[int, Colour]:
    """One colour per ID: Okabe and Ito's, then ever paler rounds of them."""
    rounds = -(-len(ids) // len(OKABE_ITO))
    colours = {}
    for n, landmark in enumerate(ids):
        pale = n // len(OKABE_ITO) / rounds
        red, green, blue = (round(c + pale * (255 - c)) for c in OKABE_ITO[n % len(OKABE_ITO)])
        colours[landmark] = (red, green, blue)
    return colours


def disc_outline(fan: Fan, radius_m: float, x_px: float, y_px: float) -> FloatArray:
    """(48, 2) column and row, in fan pixels, of the edge of a floor disc centred at a fan pixel.

    Exact for a flat floor: about an ellipse, squeezed along the range and stretched across it.
    Where the centre is too near for the floor the shape of the nearest floor is drawn around it.
    """
    range_m, bearing_deg = polar_from_pixel(fan, x_px, y_px)
    floor_m = np.maximum(range_m, STEEPEST * floor_depth(fan))
    ground, bearing = ground_range(fan, floor_m), np.radians(bearing_deg)
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    across = ground * np.sin(bearing) + radius_m * np.cos(turn)
    along = ground * np.cos(bearing) + radius_m * np.sin(turn)
    outline = np.column_stack(
        pixel_from_polar(
            fan,
            slant_range(fan, np.hypot(across, along)),
            np.degrees(np.arctan2(across, along)),
        )
    )
    drawn_at = np.array(pixel_from_polar(fan, floor_m, bearing_deg))
    return np.asarray(outline + np.array([x_px, y_px]) - drawn_at)


def trails(history: Sequence[Moment]) -> dict[int, FloatArray]:
    """(n, 2) fan pixels, oldest first, where each object of the newest frame has been.

    Only of methods that follow objects: numbers of single-frame candidates say nothing.
    """
    paths: dict[int, list[tuple[float, float]]] = {
        e.object: [] for e in history[-1].estimates if is_followed(e)
    }
    for result in history:
        if history[-1].index - result.index <= TRAIL_FRAMES:
            for e in result.estimates:
                if e.object in paths:
                    paths[e.object].append((e.x_px, e.y_px))
    return {number: np.array(path) for number, path in paths.items()}


def is_followed(estimate: Estimate) -> bool:
    """Whether the object's number means the same object in the next frame."""
    return estimate.method.partition(":")[0] != "smi" and estimate.object >= 0


def probability(estimate: Estimate, landmarks: LandmarkSet) -> float:
    """The probability of the most probable ID."""
    return float(estimate.probabilities[landmarks.ids.index(estimate.landmark)])


def caption(estimate: Estimate, landmarks: LandmarkSet, *, score: bool = False) -> str:
    """What is written at an object: "ID.3  0.97", with "?" undeclared, "" for none of these.

    score: the number is the score, as in tables of results, in place of the probability.
    """
    number = estimate.score if score else probability(estimate, landmarks)
    if estimate.declared:
        return f"ID.{estimate.landmark}  {number:.2f}"
    if np.argmax(estimate.probabilities) == len(landmarks.ids):
        return ""
    return f"ID.{estimate.landmark}?  {number:.2f}"


def enlargement(fan: Fan) -> int:
    """Whole number of times that draw_frame enlarges a fan image to be legible."""
    return -(-_SMALLEST // max(fan.rows, fan.columns))


def draw_frame(
    image: ByteImage,
    fan: Fan,
    landmarks: LandmarkSet,
    estimates: Sequence[Estimate],
    *,
    paths: Mapping[int, FloatArray] | None = None,
    truth: Sequence[Mark] = (),
    grid: bool = False,
    score: bool = False,
) -> ByteImage:
    """The frame with an outline, ID and probability for every estimate: one method's (Figure 13).

    image: (fan.rows, fan.columns) uint8. estimates: declared ones in the ID's colour, others thin
    and grey. paths: as `trails` gives them. truth: dashed white. grid: range rings and bearings
    below all that. score: scores in place of probabilities.
    Returns (rows, columns, 3) uint8 BGR, both sides `enlargement` times the fan's.
    """
    pen = _pen_on(image, fan)
    if grid:
        _draw_grid(pen, fan)
    colours = landmark_colours(landmarks.ids)
    # The declared last, on top of the others.
    for e in sorted(estimates, key=lambda e: (e.declared, e.score)):
        colour = colours[e.landmark] if e.declared else UNNAMED
        if paths and e.object in paths:
            pen.line(paths[e.object], colour, 1)
        outline = disc_outline(fan, landmarks.radius_m, e.x_px, e.y_px)
        pen.line(outline, colour, 2 if e.declared else 1, closed=True)
        around = disc_outline(fan, AROUND * landmarks.radius_m, e.x_px, e.y_px)
        pen.label(caption(e, landmarks, score=score), around, colour)
    for mark in truth:
        outline = disc_outline(fan, AROUND * landmarks.radius_m, mark.x_px, mark.y_px)
        pen.dashes(outline, TRUTH)
        pen.label(f"ID.{mark.landmark}", outline, TRUTH, below=True)
    return pen.canvas


def _pen_on(image: ByteImage, fan: Fan) -> _Pen:
    """A pen that draws in fan pixels on the image, enlarged to be legible."""
    scale = enlargement(fan)
    size = (fan.columns * scale, fan.rows * scale)
    enlarged = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return _Pen(cv2.cvtColor(enlarged, cv2.COLOR_GRAY2BGR), pixel_unit(max(size)), scale)


def nice_steps(low: float, high: float, about: int) -> FloatArray:
    """(n,) round numbers within low to high, `about` of them: multiples of 1, 2 or 5."""
    wanted = (high - low) / about
    power = 10.0 ** math.floor(math.log10(wanted))
    step = min((n * power for n in (1, 2, 5, 10)), key=lambda nice: abs(math.log(nice / wanted)))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return np.arange(first, last + 1) * step


def _draw_grid(pen: _Pen, fan: Fan) -> None:
    """The stated fan's outline, range rings and bearings, each labelled."""
    low, high = fan.bearing_min_deg, fan.bearing_max_deg
    for range_m in nice_steps(fan.range_min_m, fan.range_max_m, 5):
        ring = _arc(fan, range_m)
        pen.lines(ring[None], GRID, 1)
        pen.note(f"{range_m:g} m", ring[-1], GRID)
    for bearing in nice_steps(low, high, 6):
        ray = _ray(fan, bearing)
        pen.lines(ray[None], GRID, 1)
        pen.note(f"{bearing:g}", ray[-1], GRID, centred=True)
    edge = [_ray(fan, low), _arc(fan, fan.range_max_m), _ray(fan, high)[::-1]]
    outline = np.concatenate([*edge, _arc(fan, fan.range_min_m)[::-1]])
    pen.lines(outline[None], GRID, 2, closed=True)


def _arc(fan: Fan, range_m: float) -> FloatArray:
    """(64, 2) fan pixels of a range ring, from the left edge of the fan to the right."""
    bearings = np.linspace(fan.bearing_min_deg, fan.bearing_max_deg, 64)
    return np.column_stack(pixel_from_polar(fan, range_m, bearings))


def _ray(fan: Fan, bearing_deg: float) -> FloatArray:
    """(2, 2) fan pixels of a bearing, from the near end of the window to the far."""
    ends = np.array([fan.range_min_m, fan.range_max_m])
    return np.column_stack(pixel_from_polar(fan, ends, bearing_deg))


def disc_width_px(fan: Fan, landmarks: LandmarkSet) -> float:
    """How wide a disc of the set is, across the line of sight, in the middle of the window."""
    column, row = pixel_from_polar(fan, (fan.range_min_m + fan.range_max_m) / 2, 0.0)
    outline = disc_outline(fan, landmarks.radius_m, float(column), float(row))
    return float(np.ptp(outline[:, 0]))


def draw_preview(image: ByteImage, fan: Fan, landmarks: LandmarkSet) -> ByteImage:
    """A frame under what is stated of it: rings, bearings, the floor's near edge, three discs.

    image: (fan.rows, fan.columns) uint8. The floor's near edge is the slant range of the height:
    nothing nearer lies on the floor. The discs lie at a sixth, half and five sixths of the window.
    Returns (rows, columns, 3) uint8 BGR: the frame as of draw_frame, with a legend below.
    """
    pen = _pen_on(image, fan)
    _draw_grid(pen, fan)
    near = floor_depth(fan)
    if fan.range_min_m <= near <= fan.range_max_m:
        edge = _arc(fan, near)
        pen.line(edge, FLOOR, 2)
        pen.note("floor", edge[len(edge) // 2], FLOOR, centred=True)
    for share, aside in ((1 / 6, 0.5), (1 / 2, 0.25), (5 / 6, 0.75)):
        bearing = fan.bearing_min_deg + aside * (fan.bearing_max_deg - fan.bearing_min_deg)
        place = pixel_from_polar(fan, fan.range_min_m + share * fan.window_m, bearing)
        outline = disc_outline(fan, landmarks.radius_m, float(place[0]), float(place[1]))
        pen.line(outline, TRUTH, 1, closed=True)
    return draw_picture(pen.canvas, _legend(fan, landmarks, max(pen.canvas.shape[1], 512)))


def _legend(fan: Fan, landmarks: LandmarkSet, width: int) -> ByteImage:
    """Lines on what is stated, in the colours of what they explain."""
    unit = pixel_unit(width)
    assumed = "" if fan.height_m is not None else ", by the tilt (no height is stated)"
    begins = floor_depth(fan)
    window = f"{fan.range_min_m:.4g} to {fan.range_max_m:.4g} m"
    where = ": nearer than the window" if begins < fan.range_min_m else ""
    bearings = f"{fan.bearing_min_deg:.3g} to {fan.bearing_max_deg:.3g} deg"
    disc = f"{2 * landmarks.radius_m:.3g} m, {disc_width_px(fan, landmarks):.0f} px wide"
    lines = (
        (f"stated: {window}, {bearings}, tilt {fan.tilt_deg:g} deg", GRID),
        (f"floor from {begins:.3g} m{where}{assumed}", FLOOR),
        (f"disc of {landmarks.name}: {disc} in mid-window", TRUTH),
    )
    pen = _Pen(np.zeros((round((len(lines) * 18 + 8) * unit), width, 3), np.uint8), unit)
    for n, (text, colour) in enumerate(lines):
        pen.text(text, (6 * unit, (18 * n + 16) * unit), colour)
    return pen.canvas


def draw_strip(history: Sequence[Moment], landmarks: LandmarkSet, width: int) -> ByteImage:
    """The probability of each ID along every track, up to the newest frame (Figure 14).

    history: one method's results, of which the last STRIP_FRAMES frames are shown. Thick where
    declared; of methods that do not follow objects, points. Returns (rows, width, 3) uint8 BGR.
    """
    newest = history[-1]
    unit = pixel_unit(width)
    colours = landmark_colours(landmarks.ids)
    left, right = 34 * unit, width - 10 * unit
    # A legend of many IDs takes more lines.
    per_line = max(1, int((right - left - 210 * unit) / (46 * unit)))
    top = (24 + 16 * ((len(colours) - 1) // per_line)) * unit
    bottom = top + 92 * unit
    pen = _Pen(np.zeros((round(bottom + 24 * unit), width, 3), np.uint8), unit)
    for n, (landmark, colour) in enumerate(colours.items()):
        at = (left + n % per_line * 46 * unit, (15 + 16 * (n // per_line)) * unit)
        pen.text(f"ID.{landmark}", at, colour)
    told = f"frame {newest.index}  {_clock(newest.timestamp_ns)}"
    pen.text(told, (right, 15 * unit), UNNAMED, align_right=True)
    for share in (0.0, 0.5, 1.0):
        level = bottom - share * (bottom - top)
        pen.lines(np.array([[[left, level], [right, level]]]), (70, 70, 70), 1)
        pen.text(f"{share:g}", (6 * unit, level + 5 * unit), UNNAMED)
    step = (right - left) / (STRIP_FRAMES - 1)
    for result in history:
        ago = newest.index - result.index
        if result.index % _TICK_FRAMES == 0 and ago < STRIP_FRAMES:
            tick = right - ago * step
            told = _clock(result.timestamp_ns, short=True)
            pen.note(told, (tick, bottom + 21 * unit), UNNAMED, centred=True)
            pen.lines(np.array([[[tick, bottom], [tick, bottom + 5 * unit]]]), UNNAMED, 1)

    shown = [
        (result.index, e)
        for result in history
        if newest.index - result.index < STRIP_FRAMES
        for e in result.estimates
    ]
    if not shown:
        return pen.canvas
    # Sorted by track and time, each estimate is joined to the one before it on the same track.
    shown.sort(key=lambda row: (row[1].object, row[0]))
    frame = np.array([index for index, _ in shown])
    track = np.array([e.object if is_followed(e) else -1 for _, e in shown])
    named = np.array([e.landmark if e.declared else None for _, e in shown])
    joined = np.append(False, (track[1:] == track[:-1]) & (track[1:] >= 0))
    before = np.arange(len(shown)) - joined
    x = right - (newest.index - frame) * step
    beliefs = np.array([e.probabilities for _, e in shown])
    for thick in (False, True):
        for k, landmark in enumerate(landmarks.ids):
            y = bottom - beliefs[:, k] * (bottom - top)
            start = np.where(joined, x[before], x - step / 2)
            lines = np.stack([[start, y[before]], [x, y]]).transpose(2, 0, 1)
            pen.lines(lines[(named == landmark) == thick], colours[landmark], 1 + thick)
    return pen.canvas


def draw_picture(frame: ByteImage, strip: ByteImage) -> ByteImage:
    """A drawn frame above its strip, both centred; sides even, as video codecs want them."""
    rows, columns = frame.shape[0] + strip.shape[0], max(frame.shape[1], strip.shape[1])
    picture = np.zeros((rows + rows % 2, columns + columns % 2, 3), np.uint8)
    at = 0
    for part in (frame, strip):
        left = (picture.shape[1] - part.shape[1]) // 2
        picture[at : at + part.shape[0], left : left + part.shape[1]] = part
        at += part.shape[0]
    return picture


def write_png(path: Path, picture: ByteImage) -> None:
    """Write (rows, columns, 3) uint8 BGR. Raises SonarrecError where it cannot be written."""
    try:
        path.write_bytes(marked(cv2.imencode(".png", picture)[1].tobytes()))
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be written ({error.strerror})") from None


def _clock(timestamp_ns: int, *, short: bool = False) -> str:
    """Seconds, or the time of day where they count from 1970. short: for a tick."""
    seconds = timestamp_ns / 1e9
    if seconds < 1e8:
        return f"{seconds:.1f} s" if short else f"{seconds:.2f} s"
    if short:
        return f"{datetime.fromtimestamp(seconds, UTC):%H:%M:%S}"
    return f"{datetime.fromtimestamp(seconds, UTC):%H:%M:%S.%f}"[:-4] + " UTC"


def pixel_unit(longer_side: int) -> float:
    """Pixels of a picture per pixel of text and line width laid out for 512 of them."""
    return max(1.0, longer_side / 640)


class _Pen:
    """Anti-aliased lines and text; lines in pixels of the image before its enlargement."""

    def __init__(self, canvas: np.ndarray, unit: float, scale: int = 1) -> None:
        self.canvas: ByteImage = np.asarray(canvas, np.uint8)
        self._unit = unit
        self._thickness = max(1, round(unit))
        self._scale = scale

    def _enlarged(self, points: FloatArray) -> FloatArray:
        # Pixel centres are whole numbers before and after.
        return np.asarray((points + 0.5) * self._scale - 0.5)

    def lines(self, lines: FloatArray, colour: Colour, width: int, *, closed: bool = False) -> None:
        """(lines, points, 2) of one colour."""
        # Far outside is as good as farther outside, and fits into 32 bits.
        fixed = np.clip(self._enlarged(lines) * 2**_FINE, -1e8, 1e8).round().astype(np.int32)
        width = round(width * self._unit)
        cv2.polylines(self.canvas, list(fixed), closed, colour[::-1], width, cv2.LINE_AA, _FINE)

    def line(self, points: FloatArray, colour: Colour, width: int, *, closed: bool = False) -> None:
        """(points, 2), set off from what is below it."""
        self.lines(points[None], _BLACK, width + 1, closed=closed)
        self.lines(points[None], colour, width, closed=closed)

    def dashes(self, outline: FloatArray, colour: Colour) -> None:
        """A closed line of (a multiple of 4, 2) points, broken."""
        parts = np.roll(outline, 1, axis=0).reshape(-1, 4, 2)[:, :3]
        self.lines(parts, _BLACK, 3)
        self.lines(parts, colour, 1)

    def label(self, text: str, outline: FloatArray, colour: Colour, below: bool = False) -> None:
        """Text above (or below) an outline, kept inside the picture."""
        if not text:
            return
        low, high = self._enlarged(outline.min(axis=0)), self._enlarged(outline.max(axis=0))
        (width, height), drop = cv2.getTextSize(text, _FONT, self._unit / 2, self._thickness)
        gap = 5 * self._unit
        y = high[1] + gap + height if below or low[1] < gap + height else low[1] - gap
        x = (low[0] + high[0] - width) / 2
        x = min(max(x, 2), self.canvas.shape[1] - width - 2)
        y = min(max(y, height + 2), self.canvas.shape[0] - drop)
        rows = slice(max(0, round(y - height) - 3), round(y + drop))
        self.canvas[rows, max(0, round(x) - 3) : round(x + width) + 3] //= 4
        self.text(text, (x, y), colour)

    def note(
        self, text: str, at: FloatArray | tuple[float, float], colour: Colour, centred: bool = False
    ) -> None:
        """Text at a point of the image (its bottom left, or middle), kept inside the picture."""
        (width, height), _ = cv2.getTextSize(text, _FONT, self._unit / 2, self._thickness)
        x, y = self._enlarged(np.asarray(at, float))
        x, y = x + 3 * self._unit, y - 3 * self._unit
        x = min(max(x - (width / 2 if centred else 0), 2), self.canvas.shape[1] - width - 2)
        y = min(max(y, height + 2), self.canvas.shape[0] - 3)
        rows = slice(max(0, round(y - height) - 1), round(y) + 2)
        self.canvas[rows, max(0, round(x) - 1) : round(x + width) + 1] //= 3
        self.text(text, (x, y), colour)

    def text(
        self, text: str, at: tuple[float, float], colour: Colour, align_right: bool = False
    ) -> None:
        """Text from its bottom-left corner (or right), in pixels of the canvas."""
        width = int(cv2.getTextSize(text, _FONT, self._unit / 2, self._thickness)[0][0])
        corner = (round(at[0]) - (width if align_right else 0), round(at[1]))
        cv2.putText(
            self.canvas,
            text,
            corner,
            _FONT,
            self._unit / 2,
            colour[::-1],
            self._thickness,
            cv2.LINE_AA,
        )
