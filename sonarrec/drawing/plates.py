"""As `landmarks`, of sets of drawn plates; and a sheet to cut plates from."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, ByteImage, FloatArray, FloatImage
from sonarrec.drawing.pen import TRUTH, Pen
from sonarrec.landmarks import IMAGE_CELLS, WIDEST_SIGMA, DrawnSet, views

GRID = 56  # samples along a plate's side
PLATE_PX, MARGIN_PX, MOST_COLUMNS = 140, 30, 7
# As seen, a share of the plate's area. AcTag24h10 has .20, AcTag24h4 .08, as drawn.
NEAR, NEAR_SEEN = 0.06, 0.03
THINNEST_BEAMS = 0.7  # cells; of simulated plates with cells as wide as a beam most are read
HALF_POWER = 2.355  # width of a Gaussian beam, in its sigmas
MARGIN_MM = 10
SHEET_MARK = (
    "<!-- A sheet of `sonarrec landmarks`. Black: rough, bright to a sonar; grey lines: cuts -->"
)


def plate_distances(
    landmarks: DrawnSet, beam_m: float, most: int
) -> list[tuple[int, int, FloatArray]]:
    """(row, row, [share of the cells that differ, of the seen plate]) of the `most` pairs of IDs
    that are most alike as drawn, in whatever quarter turn or hand. beam_m: at the plate."""
    drawings = landmarks.drawings()
    even = [cv2.resize(d.astype(np.uint8), (GRID, GRID), interpolation=0) for d in drawings]
    signs = 2.0 * np.stack(even).astype(np.float32) - 1
    sides = np.array([len(d) for d in drawings])
    if len(set(sides.tolist())) == 1:  # of families with hundreds of IDs: a sample a cell
        signs = 2.0 * np.stack(drawings).astype(np.float32) - 1
    flat = signs.reshape(len(signs), -1)
    agree = np.full((len(flat),) * 2, -np.inf, np.float32)
    for turned in _views(signs, landmarks):
        np.maximum(agree, flat @ turned.reshape(len(flat), -1).T, out=agree)
    agree[np.tril_indices(len(flat))] = -np.inf
    pairs = min(most, len(flat) * (len(flat) - 1) // 2)
    found = []
    for index in np.argsort(-agree, axis=None, kind="stable")[:pairs].tolist():
        a, b = divmod(index, len(flat))
        differ = (1 - float(agree[a, b]) / flat.shape[1]) / 2
        seen = min(
            float(((_smeared(one, beam_m, landmarks) - other) ** 2).mean())
            for other in [_smeared(even[b] > 0, beam_m, landmarks)]
            for one in views(even[a] > 0, landmarks.mirrored)
        )
        found.append((a, b, np.array([differ, min(seen, differ)])))
    return found


def _views(signs: FloatImage, landmarks: DrawnSet) -> list[FloatImage]:
    """All drawings, (K, n, n), in every quarter turn, and hand where both may show."""
    hands = [signs, signs[:, :, ::-1]] if landmarks.mirrored == "either" else [signs]
    return [np.rot90(hand, turn, axes=(1, 2)) for hand in hands for turn in range(4)]


def _smeared(plate: BoolArray, beam_m: float, landmarks: DrawnSet) -> FloatImage:
    """(n, n) what beams, across the columns, leave of a plate. beam_m: at half power."""
    sigma = max(beam_m / HALF_POWER / (2 * landmarks.radius_m) * len(plate), 1e-3)
    return np.asarray(
        cv2.GaussianBlur(np.asarray(plate, np.float32), (0, 0), sigmaX=sigma, sigmaY=1e-3)
    )


def plate_doubts(landmarks: DrawnSet, beam_m: float) -> list[str]:
    """What makes the plates hard to read, whatever else there is in the set."""
    side_m, cells = 2 * landmarks.radius_m, max(len(d) for d in landmarks.drawings())
    wide = f"beams are {1000 * beam_m:.0f} mm wide there"
    widest_m = HALF_POWER * WIDEST_SIGMA * landmarks.radius_m
    if beam_m > widest_m:
        share = widest_m / beam_m
        return [f"{wide}, too wide for the plates: no ID is read beyond {share:.2f} of this range"]
    cell_m = side_m / cells
    if cells == IMAGE_CELLS or cell_m > THINNEST_BEAMS * beam_m:  # an image's are no cells
        return []
    return [f"{wide}, and cells of {1000 * cell_m:.0f} mm too small for them"]


def draw_plates(landmarks: DrawnSet, beam_m: float) -> ByteImage:
    """(rows, columns, 3) uint8 BGR: plates as drawn, and below each as beams show it."""
    pairs = []
    for drawing in landmarks.drawings()[: 10 * MOST_COLUMNS]:
        size = (PLATE_PX, PLATE_PX)
        plate = cv2.resize(drawing.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        mirrored = plate[:, ::-1] if landmarks.mirrored == "yes" else plate
        seen = _smeared(mirrored > 0, beam_m, landmarks)
        pairs.append([30 + 220 * np.asarray(picture, float) for picture in (plate > 0, seen)])
    return draw_pairs(landmarks.ids[: len(pairs)], pairs, MOST_COLUMNS)


def draw_pairs(
    ids: Sequence[int], pairs: Sequence[Sequence[FloatArray]], most_columns: int
) -> ByteImage:
    """(rows, columns, 3) uint8 BGR: two square grey pictures of each ID, one below the other."""
    columns, side = min(len(ids), most_columns), len(pairs[0][0])
    cell, height = side + MARGIN_PX, 2 * side + 2 * MARGIN_PX
    pen = Pen(np.zeros((-(-len(ids) // columns) * height, columns * cell, 3), np.uint8), 1.0)
    for k, (number, pictures) in enumerate(zip(ids, pairs, strict=True)):
        top, left = k // columns * height + MARGIN_PX, k % columns * cell + MARGIN_PX // 2
        for n, picture in enumerate(pictures):
            at = top + n * (side + MARGIN_PX // 3)
            pen.canvas[at : at + side, left : left + side] = picture[..., None].round()
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
