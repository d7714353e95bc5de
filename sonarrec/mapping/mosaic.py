"""`map --mosaic`: a picture of the floor from all frames of the logs, in the axes of the map."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray, FloatImage
from sonarrec.drawing.pen import Pen, landmark_colours, pixel_unit
from sonarrec.errors import SonarrecError, UsageError
from sonarrec.geometry import ground_range
from sonarrec.mapping.axes import Axes, GeographicOrigin
from sonarrec.mapping.build import SiteMap
from sonarrec.mapping.join import MappedLog
from sonarrec.nouns import Fan, Frame
from sonarrec.readers import open_log
from sonarrec.readers.log import Log
from sonarrec.readers.open import find_log
from sonarrec.recogniser.plane import working_plane
from sonarrec.recogniser.restore.saturation import Levels
from sonarrec.recogniser.restore.static_pixels import Unchanging
from sonarrec.recogniser.tiles import SIDE, Tiles, parts, placement, warped
from sonarrec.results.run_file import LogOptions, read_run
from sonarrec.results.same_log import check_same_log
from sonarrec.sonar import Sonar
from sonarrec.tables.outputs import (
    check_output,
    is_filled,
    replaced,
    with_mark,
    write_text,
    writing,
)

DISC_PX = 16  # radius of a disc in the picture, unless the frames are coarser
MOST_PX = 16_384  # of the longer side; a longer floor is drawn at a coarser scale
MOST_TILES = 64  # in memory, of half a megabyte each
OVERVIEW_PX = 1200  # of the picture behind map.png, at most
# Frames in a tile fade by OLD_SHARE for each new frame, once the path's standard error since then
# is MOST_ERROR disc radii: else objects would be seen twice. Nothing fades without newer frames.
MOST_ERROR, OLD_SHARE = 0.35, 0.5
USUAL_FRAMES = 40  # memory of the usual level by range
MOST_LEVELS = 30  # grey levels to which a pixel is clipped in the usual level
SPREAD = 42  # grey levels in the picture of one standard deviation
FEATHER = 1.0  # disc radii from the fan's edge, over which a frame's weight rises


@dataclass(frozen=True, slots=True)
class Mosaic:
    """The floor as one picture; at yaw 0 columns run to the right and rows opposite to ahead.

    overview: (rows, columns) uint8, reduced and without landmarks; 0 where nothing was seen.
    extent: its (left, right, bottom, top) in m.
    """

    path: Path
    overview: ByteImage
    extent: tuple[float, float, float, float]


def write_mosaic(
    path: Path, site: SiteMap, sonar: Sonar | None = None, origin: GeographicOrigin | None = None
) -> Mosaic:
    """Write the PNG and its world file; each log is read once more.

    sonar: as in MapOptions. origin: with it the world file is in degrees (WGS 84), else in the axes
    of the map. Raises SonarrecError where a log is not where its run found it, or has changed.
    """
    if path.suffix.lower() != ".png":
        raise UsageError(f"{path}: the mosaic is a PNG; give it a name that ends in .png")
    check_output(path, "picture", [_recording_of(log) for log in site.logs])
    if not is_filled(path):  # beside it the world file is ours as well
        check_output(world_file(path), "graph")
    left, right, bottom, top = _reach(site.logs)
    radius_m = site.landmark_set.radius_m
    finest = min(log.fan.metres_per_pixel for log in site.logs)
    pixel_m = max(radius_m / DISC_PX, finest, (right - left) / MOST_PX, (top - bottom) / MOST_PX)
    with Tiles(2, MOST_TILES) as tiles:
        for log in site.logs:
            with _opened(log, sonar or Sonar()) as recording:
                check_same_log(recording, log.folder, read_run(log.folder / "run.toml"))
                _add(tiles, recording, log, radius_m, pixel_m)
        if not list(tiles):
            raise SonarrecError(f"{path}: no frame has a pose, so there is no floor to draw")
        picture = _Picture(tiles, site, pixel_m)
        corner = picture.corner * (1, -1) * pixel_m  # left, top
        with writing(path), replaced(path) as new:
            _write_png(new, picture)
            write_text(world_file(path), _world(corner, pixel_m, site.ros_axes, origin))
    shrunk = np.concatenate(picture.overview)
    side = picture.shrink * pixel_m
    span = [length * side for length in shrunk.shape[::-1]]
    left, top = (corner + pixel_m * np.array([-0.5, 0.5])).tolist()
    return Mosaic(path, shrunk, (left, left + span[0], top - span[1], top))


def world_file(path: Path) -> Path:
    """The name of a PNG's world file."""
    return path.with_suffix(".pgw")


def _recording_of(log: MappedLog) -> Path:
    """Where the log's recording is. Raises SonarrecError where it is not."""
    stated = read_run(log.folder / "run.toml").input
    named = [Path(p) for p in (stated.path, stated.place and log.folder / stated.place) if p]
    found = next((path for path in named if path.exists()), None)
    if found is None:
        where = " or ".join(dict.fromkeys(map(str, named))) or "any place that run.toml states"
        raise SonarrecError(
            f"{log.folder}: --mosaic reads the log again, and it is not at {where}; put it back, "
            "or run it where it is"
        )
    return found


def _opened(log: MappedLog, sonar: Sonar) -> Log:
    """The log's recording, as its run read it."""
    run = read_run(log.folder / "run.toml")
    options = run.complete(LogOptions(sonar), same_log=True)
    return open_log(find_log(_recording_of(log)), **options.arguments())


def _reach(logs: Sequence[MappedLog]) -> tuple[float, float, float, float]:
    """(left, right, bottom, top) in m of all that any frame may show."""
    poses = np.concatenate([log.path.pose[log.path.known, 1:] for log in logs])
    if not len(poses):
        return 0.0, 0.0, 0.0, 0.0
    far = max(float(ground_range(log.fan, log.fan.range_max_m)) for log in logs)
    (left, bottom), (right, top) = poses.min(axis=0) - far, poses.max(axis=0) + far
    return float(left), float(right), float(bottom), float(top)


class _Levelled:
    """Frames of one log on the floor, without the fall-off by range, the gain and the fan's rim."""

    def __init__(self, fan: Fan, radius_m: float, pixel_m: float) -> None:
        self._plane = plane = working_plane("floor", fan, radius_m, radius_m / pixel_m)
        self.pixel_m = fan.metres_per_pixel / plane.scale
        rows, columns = np.indices(plane.shape)
        self.apex = plane.apex
        distance = np.hypot(columns - plane.apex[0], rows - plane.apex[1])
        self._inside = plane.inside > 0
        self._ring = distance.astype(np.int32)[self._inside]
        self._count = np.maximum(np.bincount(self._ring), 1)
        self._usual: FloatArray | None = None
        edge = cv2.distanceTransform(plane.inside, cv2.DIST_L2, 5)
        self._weight = np.minimum(edge / (FEATHER * plane.axes[0]), 1).astype(np.float32) ** 2

    def __call__(self, frame: Frame) -> FloatImage:
        """(rows, columns, 2): grey level over the usual one at its range, times weight; weight."""
        level = self._plane.warp(frame.pixels, frame.polar)[self._inside].astype(np.float32)
        if self._usual is None:
            self._usual = np.bincount(self._ring, level) / self._count
        usual = self._usual[self._ring]
        # Strong deviations, such as a wall or its shadow, must not change the usual level.
        over = level - usual
        over -= np.median(over)
        held = np.clip(over, -MOST_LEVELS, MOST_LEVELS)
        self._usual = self._usual + np.bincount(self._ring, held) / self._count / USUAL_FRAMES
        picture = np.zeros((*self._inside.shape, 2), np.float32)
        picture[self._inside, 0] = over
        picture[..., 0] *= self._weight
        picture[..., 1] = self._weight
        return picture


def _add(tiles: Tiles, recording: Log, log: MappedLog, radius_m: float, pixel_m: float) -> None:
    """Add the frames of one log whose poses are known."""
    path, row_of = log.path, {int(n): row for row, n in enumerate(log.path.frame)}
    levelled: _Levelled | None = None
    began: dict[tuple[int, int], int] = {}  # row from which on frames count in each tile
    span = read_run(log.folder / "run.toml").span() or (0, None)
    for frame in Levels(radius_m).restored(Unchanging().filled(recording.within(span))):
        row = row_of.get(frame.index)
        if row is None or not np.isfinite(path.pose[row]).all():
            continue
        levelled = levelled or _Levelled(frame.fan, radius_m, pixel_m)
        yaw, position = math.radians(path.pose[row, 0]), path.pose[row, 1:] / pixel_m
        matrix = placement(yaw, position, levelled.apex, levelled.pixel_m / pixel_m)
        picture, first = warped(levelled(frame), matrix)
        covered = list(parts(picture.shape, first))
        middle = (np.array([tile for tile, _, _ in covered]) + 0.5) * SIDE * pixel_m * (1, -1)
        since = np.array([began.setdefault(tile, row) for tile, _, _ in covered])
        error = path.position_covariance(np.full(len(since), row), middle, since)
        unsure = np.trace(error, axis1=1, axis2=2) > (MOST_ERROR * radius_m) ** 2
        for (tile, inside, part), fades in zip(covered, unsure.tolist(), strict=True):
            sums = tiles.tile(tile)
            if fades:
                sums *= OLD_SHARE
                began[tile] = (began[tile] + row + 1) // 2
            sums[inside] += picture[part]


class _Picture:
    """The bands of the picture, from the top down, with landmarks; and the `overview` of them."""

    def __init__(self, tiles: Tiles, site: SiteMap, pixel_m: float) -> None:
        self._tiles, self._site, self._pixel_m = tiles, site, pixel_m
        squares = pixels = 0.0
        bounds = []
        for tile in list(tiles):
            total, weight = np.moveaxis(tiles.tile(tile), -1, 0)
            row, column = np.nonzero(weight)
            squares += float(((total[row, column] / weight[row, column]) ** 2).sum())
            pixels += len(row)
            for ends in (np.min, np.max) if len(row) else ():
                bounds.append(np.array(tile) * SIDE + (ends(column), ends(row)))
        low, high = np.min(bounds, axis=0), np.max(bounds, axis=0)
        self.corner = low
        """(column, row) on the grid of the first pixel."""
        self.size = tuple((high - low + 1).tolist())
        self._spread = max(math.sqrt(squares / pixels), 1e-3)
        self.shrink = 1
        while max(self.size) / self.shrink > OVERVIEW_PX:
            self.shrink *= 2
        self.overview: list[ByteImage] = []

    def __iter__(self) -> Iterator[ByteImage]:
        """(rows, columns, 4) uint8 BGRA; transparent where nothing was seen."""
        (left, top), (columns, rows) = self.corner.tolist(), self.size
        unit = pixel_unit(min(max(self.size), 1280))
        for row in range(top // SIDE, (top + rows - 1) // SIDE + 1):
            here = slice(max(top - row * SIDE, 0), top + rows - row * SIDE)
            band = self._tiles.rows(row, left // SIDE, columns + left % SIDE)
            total, weight = np.moveaxis(band[here, left % SIDE :], -1, 0)
            mean = total / np.maximum(weight, 1e-12)
            grey = np.clip(128 + SPREAD / self._spread * mean, 1, 255).astype(np.uint8)
            grey *= weight > 0
            self.overview.append(grey[:: self.shrink, :: self.shrink])
            pen = Pen(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), unit)
            self._draw(pen, row * SIDE + here.start)
            shown = np.where(pen.canvas.any(axis=2) | (weight > 0), 255, 0).astype(np.uint8)
            yield np.dstack([pen.canvas, shown])

    def _draw(self, pen: Pen, top: int) -> None:
        """The landmarks on a band, and where their first sectors begin. top: its first row."""
        site = self._site
        colours, radius = landmark_colours(site.landmark_set.ids), site.landmark_set.radius_m
        angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
        for number, landmark in enumerate(site.landmarks, 1):
            outline = self._pixels(landmark.position, 1.1 * radius, angle, top)
            low, high = outline[:, 1].min(), outline[:, 1].max()
            if high < -SIDE / 4 or low > 1.25 * SIDE:
                continue
            pen.line(outline, colours[landmark.id], 1, closed=True)
            if not math.isnan(landmark.orientation_deg):
                sector = np.radians([landmark.orientation_deg])
                tip = [self._pixels(landmark.position, r * radius, sector, top) for r in (1.1, 1.4)]
                pen.line(np.concatenate(tip), colours[landmark.id], 1)
            if 0 <= low < len(pen.canvas):
                corner = float(outline[:, 0].max()), float(low)
                pen.note(f"ID.{landmark.id} ({number})", corner, colours[landmark.id])

    def _pixels(
        self, middle: FloatArray, radius_m: float, angle: FloatArray, top: int
    ) -> FloatArray:
        """(n, 2) pixels in a band, on a circle on the floor. angle: counter-clockwise, rad."""
        around = middle + radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
        pixels = around * (1, -1) / self._pixel_m - (self.corner[0], top)
        return np.asarray(pixels)


def _write_png(path: Path, picture: _Picture) -> None:
    """Write a picture band by band, since the whole may not fit into memory."""
    with path.open("wb") as file:

        def chunk(name: bytes, data: bytes) -> bytes:
            body = name + data
            return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

        head = struct.pack(">IIBBBBB", *picture.size, 8, 6, 0, 0, 0)
        file.write(with_mark(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head)))
        packer = zlib.compressobj(6)
        for band in picture:
            colours = cv2.cvtColor(band, cv2.COLOR_BGRA2RGBA).reshape(len(band), -1)
            lines = np.zeros((len(band), colours.shape[1] + 1), np.uint8)  # no filter
            lines[:, 1:] = colours
            if data := packer.compress(lines.tobytes()):
                file.write(chunk(b"IDAT", data))
        file.write(chunk(b"IDAT", packer.flush()) + chunk(b"IEND", b""))


def _world(
    corner: FloatArray, pixel_m: float, ros_axes: bool, origin: GeographicOrigin | None
) -> str:
    """The text of a world file: six numbers, by which pixels become positions."""
    # Steps to the right and down from the middle of the first pixel.
    steps = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, -1.0]])
    if origin is None:
        positions = Axes(ros_axes).position(corner + pixel_m * steps)
    else:
        # By steps of a metre: over a pixel's the degrees would lose digits.
        on_earth = origin.on_earth(corner + steps)
        positions = on_earth[0] + np.vstack([[0, 0], (on_earth[1:] - on_earth[0]) * pixel_m])
    first, right, below = np.asarray(positions)
    numbers = [*(right - first), *(below - first), *first]
    return "".join(f"{number:.12g}\n" for number in numbers)
