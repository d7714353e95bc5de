"""Whether the IDs of a landmark set can be distinguished; a picture of the set; a sheet of plates.

Seen through beams that are wide at the landmark's distance, symbols differ less than as drawn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from html import escape
from typing import NamedTuple

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, ByteImage, FloatArray, FloatImage
from sonarrec.drawing.pen import TRUTH, Pen
from sonarrec.landmarks import DrawnSet, LandmarkSet

GRID, PLATE_GRID = 30, 56  # samples across a disc or plate
ROTATION_STEP_DEG = 5  # of a disc against the other; three times that against the line of sight
MOST_PAIRS = 12  # of the IDs that differ least as drawn: views of an ID take some 3 ms
HALF_POWER = 2.355  # width of a Gaussian beam, in its sigmas
SIDE_PX, MARGIN_PX, COLUMNS, MOST_DRAWN = 160, 30, 6, 70
MARGIN_MM = 10
SHEET_MARK = (
    "<!-- A sheet of `sonarrec landmarks`. Black: rough, bright to a sonar; grey lines: cuts -->"
)


class Distance(NamedTuple):
    """How much two IDs differ, at the rotation (and hand) at which they differ least."""

    ids: tuple[int, int]
    drawn: float
    """Share of the symbol's area, or of the plate's, in which they differ."""
    seen: float
    """The same of what beams leave of it, the mean square of the difference."""


@lru_cache(maxsize=4)  # the logs of one run share it
def distances(landmarks: LandmarkSet, beam_m: float) -> list[Distance]:
    """The distances of all pairs of IDs, or of the MOST_PAIRS that differ least, the nearest first.

    beam_m: width of a beam at the landmark, between half-power points.
    """
    rotations = _as_drawn(landmarks)
    drawn = next(rotations)
    agree = drawn @ drawn.T
    for other in rotations:
        np.maximum(agree, drawn @ other.T, out=agree)
    differ = (drawn.shape[1] - agree) / (2 * drawn.shape[1])
    first, second = np.triu_indices(len(drawn), 1)
    nearest = np.argsort(differ[first, second], kind="stable")[:MOST_PAIRS]
    pairs = np.stack([first, second], axis=1)[nearest].tolist()
    views = {k: _as_seen(landmarks, k, beam_m) for k in sorted({k for pair in pairs for k in pair})}
    separations = []
    for a, b in pairs:
        # One of the two is rotated against the other. Discs, which have more than four rotations,
        # are both rotated against the line of sight as well: 180 degrees of both change nothing.
        fixed, free = views[a][: 180 // ROTATION_STEP_DEG : 3], views[b]
        if isinstance(landmarks, DrawnSet):
            fixed, free = views[b][:1], views[a]
        seen = min(float(((view - free) ** 2).sum(axis=1).min()) for view in fixed)
        ids, share = (landmarks.ids[a], landmarks.ids[b]), float(differ[a, b])
        separations.append(Distance(ids, share, min(seen, share)))
    return sorted(separations, key=lambda d: (round(d.seen, 6), d.drawn, d.ids))


def _as_drawn(landmarks: LandmarkSet) -> Iterator[FloatArray]:
    """(K, cells) all IDs, bright 1 and dark -1, at every rotation (and hand) in which they show."""
    if isinstance(landmarks, DrawnSet):
        drawings = landmarks.drawings()  # of families with hundreds of IDs: a sample a cell
        if len({len(d) for d in drawings}) > 1:
            drawings = [_upsampled(d) > 0 for d in drawings]
        for plates in _views(np.stack(drawings), landmarks):
            yield 2 * plates.reshape(len(plates), -1).astype(np.float32) - 1
    else:
        signs = np.where(np.asarray(landmarks.sectors, bool), 1.0, -1.0)
        yield from (np.roll(signs, n, axis=1) for n in range(signs.shape[1]))


def _as_seen(landmarks: LandmarkSet, k: int, beam_m: float) -> FloatArray:
    """(views, samples) the k-th ID at every rotation (and hand), as beams show it.

    Scaled so that squared distances are shares of the symbol's area, or of the plate's.
    """
    if isinstance(landmarks, DrawnSet):
        plate = _upsampled(landmarks.drawings()[k])[None]
        views = [_smeared(view[0], beam_m, landmarks) for view in _views(plate, landmarks)]
        return np.stack(views).reshape(len(views), -1) / PLATE_GRID
    across = (np.arange(3 * GRID) + 0.5) * 2 / GRID - 3  # wider than the disc, for what is smeared
    inside = across[GRID : 2 * GRID]
    smear = max(beam_m / landmarks.radius_m, 1e-3)  # it lies across the line of sight
    beam = np.exp(-4 * math.log(2) * ((inside[:, None] - across) / smear) ** 2)
    beam /= beam.sum(axis=1, keepdims=True)
    x, y = np.meshgrid(inside, inside)
    degree, radius = np.floor(np.degrees(np.arctan2(y, x))).astype(int), np.hypot(x, y)
    rotation = np.arange(0, 360, ROTATION_STEP_DEG)[:, None, None]
    # Two rounds: the indices go from -535 to 179, and negative ones count from the end.
    drawn = landmarks.codes(np.radians(np.arange(720) + 0.5))[k, degree - rotation]
    inner, outer = landmarks.symbol
    drawn *= (radius >= inner) & (radius <= outer)
    drawn += (radius > landmarks.ring[0]) & (radius <= landmarks.ring[1])
    cells = math.pi * (outer**2 - inner**2) / (2 / GRID) ** 2
    return np.asarray((drawn @ beam).reshape(len(rotation), -1) / math.sqrt(cells), np.float32)


def _views(plates: BoolArray | ByteImage, landmarks: DrawnSet) -> Iterator[np.ndarray]:
    """(K, n, n) plates at every rotation by 90 degrees, and in both hands where both may show."""
    hands = [plates, plates[:, :, ::-1]] if landmarks.mirrored == "either" else [plates]
    yield from (np.rot90(hand, n, axes=(1, 2)) for hand in hands for n in range(4))


def _upsampled(drawing: BoolArray) -> ByteImage:
    cells, size = drawing.astype(np.uint8), (PLATE_GRID, PLATE_GRID)
    return np.asarray(cv2.resize(cells, size, interpolation=cv2.INTER_NEAREST))


def _smeared(plate: np.ndarray, beam_m: float, landmarks: DrawnSet) -> FloatImage:
    """(n, n) what beams, across the columns, leave of a plate. beam_m: at half power."""
    sigma = max(beam_m / HALF_POWER / (2 * landmarks.radius_m) * len(plate), 1e-3)
    smeared = cv2.GaussianBlur(plate.astype(np.float32), (0, 0), sigmaX=sigma, sigmaY=1e-3)
    return np.asarray(smeared)


def draw_landmarks(landmarks: LandmarkSet, beam_m: float) -> ByteImage:
    """(rows, columns, 3) uint8 BGR: discs or plates as drawn, and below each as beams show it."""
    ids = landmarks.ids[:MOST_DRAWN]
    columns, cell, height = min(len(ids), COLUMNS), SIDE_PX + MARGIN_PX, 2 * (SIDE_PX + MARGIN_PX)
    pen = Pen(np.zeros((-(-len(ids) // columns) * height, columns * cell, 3), np.uint8), 1.0)
    points = (np.arange(2 * SIDE_PX) + 0.5) / SIDE_PX - 1  # twice as fine as the picture
    x, y = np.meshgrid(points, -points)
    outside = np.hypot(x, y) > 1 if not isinstance(landmarks, DrawnSet) else np.zeros_like(x)
    sigma = max(beam_m / landmarks.radius_m * SIDE_PX / HALF_POWER, 1e-3)
    for k, number in enumerate(ids):
        top, left = k // columns * height + MARGIN_PX, k % columns * cell + MARGIN_PX // 2
        levels = 0.05 + 0.1 * outside + 0.9 * landmarks.pattern(k, x, y)
        drawn = np.clip(255 * levels, 0, 255).astype(np.float32)
        mirrored = isinstance(landmarks, DrawnSet) and landmarks.mirrored == "yes"
        shown = np.ascontiguousarray(drawn[:, ::-1]) if mirrored else drawn
        seen = cv2.GaussianBlur(shown, (0, 0), sigmaX=sigma, sigmaY=1)
        for n, picture in enumerate((drawn, seen)):
            row = top + n * (SIDE_PX + MARGIN_PX // 3)
            small = cv2.resize(picture, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA)
            pen.canvas[row : row + SIDE_PX, left : left + SIDE_PX] = small[..., None].round()
        pen.text(f"ID {number}", (left, top - 8), TRUTH)
    return pen.canvas


def sheet(landmarks: DrawnSet) -> str:
    """An SVG in millimetres, to scale: each plate with its rough cells black, to cut out."""
    size, columns = 2000 * landmarks.radius_m, min(len(landmarks.ids), 4)
    step = size + 3 * MARGIN_MM
    rows = -(-len(landmarks.ids) // columns)
    wide, high = columns * step, rows * step
    lines = [
        SHEET_MARK,
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{wide:g}mm" height="{high:g}mm" '
        f'viewBox="0 0 {wide:g} {high:g}">',
    ]
    for k, drawing in enumerate(landmarks.drawings()):
        x, y = MARGIN_MM + k % columns * step, 2 * MARGIN_MM + k // columns * step
        cell = size / len(drawing)
        path = "".join(
            f"M{x + c * cell:.3f} {y + r * cell:.3f}h{cell:.3f}v{cell:.3f}h{-cell:.3f}z"
            for r, c in np.argwhere(drawing).tolist()
        )
        lines += [
            f'<path d="{path}"/>',
            f'<rect x="{x:g}" y="{y:g}" width="{size:g}" height="{size:g}" fill="none" '
            'stroke="#888" stroke-width=".3"/>',
            f'<text x="{x:g}" y="{y - 3:g}" font-size="8">{escape(landmarks.name)} '
            f"ID {landmarks.ids[k]}, {size:g} mm</text>",
        ]
    return "\n".join([*lines, "</svg>", ""])
