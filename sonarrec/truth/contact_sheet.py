"""A picture of ground truth on its recording: crops around the landmarks, a strip for each pass."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray, IntArray
from sonarrec.drawing.pen import Colour, disc_outline, landmark_colours
from sonarrec.errors import name_as_text, number_of
from sonarrec.nouns import Frame
from sonarrec.tables.outputs import plain, write_figure, writing
from sonarrec.truth.check import CheckedTruth

TILES = 8  # frames shown of a pass, from its first to its last
MOST_STRIPS = 40
SIDE = 120  # pixels of a tile
_GAP, _LEFT, _TOP, _CAPTION = 8, 150, 64, 18  # pixels between, left of, above and below tiles
_VIEW = 3.2  # disc radii from one side of a tile to the other
_NEW_PASS = 8  # frames without a row, at least, that part two passes
_FAULT: Colour = (255, 90, 90)
_UNKNOWN: Colour = (255, 255, 255)
_GROUND, _INK = "#16181c", "#d8dade"


_Strip = tuple[str, IntArray]
"""A line of tiles: its title, and the rows of the truth that they show."""


def draw_contact_sheet(truth: CheckedTruth, frames: Iterable[Frame], out: Path) -> int:
    """Write a PNG that shows where the truth puts the landmarks; its number of strips.

    First what was found wrong, then a strip for each pass of a landmark through the view, at most
    MOST_STRIPS of them, evenly chosen. frames: of the log, read as far as needed. 0, and no
    picture, where no row with a position lies on a frame of the log. Raises SonarrecError where
    `out` cannot be written.
    """
    strips = _strips(truth)
    if not strips:
        return 0
    wanted: dict[int, list[int]] = {}
    for row in np.unique(np.concatenate([rows for _, rows in strips])):
        wanted.setdefault(int(truth.frame[row]), []).append(int(row))
    tiles: dict[int, ByteImage] = {}
    for frame in frames:
        for row in wanted.get(frame.index, ()):
            scale, shift = _zoom(truth, row)
            enlarge = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
            tile = cv2.warpAffine(frame.image, enlarge, (SIDE, SIDE), flags=cv2.INTER_LINEAR)
            tiles[row] = np.asarray(tile, np.uint8)
        if frame.index >= max(wanted):
            break
    _draw(truth, strips, tiles, out)
    return len(strips)


def _strips(truth: CheckedTruth) -> list[_Strip]:
    """What to show: rows with faults first, then the passes, in order of time."""
    if truth.x_px is None:
        return []
    at = {int(line): n for n, line in enumerate(truth.line)}
    faulty = np.array(sorted({at[f.line] for f in truth.faults}), dtype=np.int64)
    faulty = faulty[truth.frame[faulty] >= 0]
    drawn, title = faulty[: 2 * TILES], "found wrong"
    if len(faulty) > len(drawn):
        title += f"\nfirst {len(drawn)} of\n{len(faulty)} rows"
    strips = [
        (title if start == 0 else "", drawn[start : start + TILES])
        for start in range(0, len(drawn), TILES)
    ]
    passes = sorted(_passes(truth), key=lambda rows: int(truth.frame[rows[0]]))
    for n in _spread(len(passes), MOST_STRIPS):
        rows = passes[n]
        first, last = truth.frame[rows[0]], truth.frame[rows[-1]]
        title = (
            f"ID.{truth.landmark[rows[0]]}\nframes {first} to {last}\n{number_of(len(rows), 'row')}"
        )
        if len(passes) > MOST_STRIPS:
            title += f"\npass {n + 1} of {len(passes)}"
        strips.append((title, rows[_spread(len(rows), TILES)]))
    return strips


def _spread(count: int, most: int) -> IntArray:
    """At most `most` of the numbers below `count`, evenly spread, with the first and the last."""
    if count <= most:
        return np.arange(count)
    return np.linspace(0, count - 1, most).round().astype(np.int64)


def _passes(truth: CheckedTruth) -> Iterator[IntArray]:
    """Rows of one ID each, rising in frame, split where the ID was out of view for long."""
    for landmark in np.unique(truth.landmark):
        rows = np.flatnonzero((truth.landmark == landmark) & (truth.frame >= 0))
        rows = rows[np.argsort(truth.frame[rows], kind="stable")]
        gaps = np.diff(truth.frame[rows])
        # Truth may be given for every tenth frame only.
        usual = float(np.median(gaps[gaps > 0])) if np.any(gaps > 0) else 1.0
        parts = np.split(rows, np.flatnonzero(gaps > max(_NEW_PASS, 3 * usual)) + 1)
        yield from (part for part in parts if len(part))


def _zoom(truth: CheckedTruth, row: int) -> tuple[float, FloatArray]:
    """(enlargement, shift in tile pixels) that put a landmark into the middle of its tile."""
    assert truth.x_px is not None
    assert truth.y_px is not None
    scale = SIDE * truth.fan.metres_per_pixel / (_VIEW * truth.landmarks.radius_m)
    return scale, (SIDE - 1) / 2 - scale * np.array([truth.x_px[row], truth.y_px[row]])


def _draw(
    truth: CheckedTruth, strips: list[_Strip], tiles: dict[int, ByteImage], out: Path
) -> None:
    """Lay the tiles out and write the PNG."""
    from matplotlib.figure import Figure

    step = SIDE + _CAPTION + _GAP
    width = _LEFT + TILES * (SIDE + _GAP)
    height = _TOP + len(strips) * step
    figure = Figure(figsize=(width / 100, height / 100), dpi=100, facecolor=_GROUND)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.axis("off")
    faults: dict[int, list[str]] = {}
    for fault in truth.faults:
        faults.setdefault(fault.line, []).append(fault.kind)
    title = f"{plain(name_as_text(truth.path.name))}: {truth.summary()}"
    axes.text(_GAP, 24, title, color=_INK, fontsize=12, va="center")
    legend = "outline: the disc as the truth puts it; below: frame, visible; found wrong in red"
    axes.text(_GAP, 46, legend, color=_INK, fontsize=8, va="center", alpha=0.8)
    for n, (caption, rows) in enumerate(strips):
        y = _TOP + n * step
        axes.text(_GAP, y + SIDE / 2, caption, color=_INK, fontsize=9, va="center")
        for k, row in enumerate(rows.tolist()):
            if row in tiles:
                kinds = faults.get(int(truth.line[row]), [])
                _draw_tile(axes, (_LEFT + k * (SIDE + _GAP), y), tiles[row], truth, row, kinds)
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="auto")
    with writing(out):
        write_figure(out, figure, facecolor=_GROUND)


def _draw_tile(
    axes: Any,
    corner: tuple[int, int],
    tile: ByteImage,
    truth: CheckedTruth,
    row: int,
    faults: Sequence[str],
) -> None:
    """Draw one tile with the disc's outline and its caption, in red if the row has faults.

    corner: the top left one, in pixels of the sheet. faults: their kinds.
    """
    from matplotlib.patches import Rectangle

    x, y = corner
    ink = np.array(_FAULT) / 255 if faults else _INK
    caption = f"{truth.frame[row]}   {truth.visible[row]:.2f}"
    if faults:
        caption = f"line {truth.line[row]}: {faults[0]}"
    axes.imshow(tile, "gray", vmin=0, vmax=255, extent=(x, x + SIDE, y + SIDE, y))
    assert truth.x_px is not None
    assert truth.y_px is not None
    scale, shift = _zoom(truth, row)
    centre = float(truth.x_px[row]), float(truth.y_px[row])
    edge = disc_outline(truth.fan, truth.landmarks.radius_m, *centre) * scale + shift
    # Pixel centres are whole numbers, and the picture's first pixel begins at its corner.
    outline = np.vstack([edge, edge[:1]]) + np.array([x + 0.5, y + 0.5])
    colours = landmark_colours(truth.landmarks.ids)
    colour = np.array(colours.get(int(truth.landmark[row]), _UNKNOWN)) / 255
    (line,) = axes.plot(*outline.T, color=colour, lw=1)
    border = Rectangle((x, y), SIDE, SIDE, fill=False, ec=ink, lw=2 if faults else 0)
    axes.add_patch(border)
    line.set_clip_path(border)
    axes.text(x, y + SIDE + 10, caption, color=ink, fontsize=8, va="center")
