"""How landmarks and other objects look on the simulated floor, one function for each kind, and how
they rest on it: leaning, under silt, and on rippled sand."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, FloatArray
from sonarrec.landmarks import LandmarkSet
from sonarrec.simulation.grid import PolarGrid, SquareGrid, smooth_noise
from sonarrec.simulation.scene import (
    KINDS,
    ROUND,
    SYMBOLS,
    Placed,
    PlacedLandmark,
    PlacedObject,
    Scene,
    position_of,
)

WIRE_M, MESH_M = 0.012, 0.05  # wire netting: thickness of a wire, and from wire to wire
SILT_EDGE = 0.15  # width of the edge between bare and covered, in units of the smooth noise


def size_of(scene: Scene, item: Placed) -> tuple[float, float]:
    """(size, width) of an object, m; see KINDS."""
    radius = scene.landmark_set.radius_m
    if isinstance(item, PlacedLandmark):
        return radius, radius
    size, width, _, _ = KINDS[item.kind]
    size = item.size_m or size or radius
    return size, item.width_m or width or size


def object_radius(scene: Scene, item: Placed) -> float:
    """Radius (m) of the circle around an object, for its truth and for spacing."""
    size, width = size_of(scene, item)
    is_round = isinstance(item, PlacedLandmark) or item.kind in ROUND
    return size if is_round else math.hypot(size, width) / 2


class Layers(NamedTuple):
    """What the cells of a grid hold, (rows, columns) each."""

    level: np.ndarray
    """Brightness over the floor, dB."""
    owner: np.ndarray
    """Number of the object, -1: the floor."""
    height: np.ndarray
    """Of what lies there, m."""
    relief: np.ndarray
    """Standard deviation of the height, m; negative for bumps that only rise."""
    lifted: np.ndarray
    """How tall an object standing in the cell would have to be, for the sonar to see its top at the
    depression of the leaning disc that shows there, m."""
    silt: np.ndarray
    """Smooth noise that shapes it."""
    glitter: np.ndarray
    """By how much a cell is brighter if it is of a disc's bright parts, dB."""


class Canvas:
    """The cells of a box, on which one object is painted; all arrays have the shape of the box.

    u, v: position along and across the object, in units of radius_m. rho: distance from its middle,
    likewise. line: cosine between the direction from the middle and the line of sight. facing: by
    how much ring edges are brighter because they face the sonar, dB. texture: the level before
    painting.
    """

    def __init__(
        self,
        item: Placed,
        number: int,
        scene: Scene,
        grid: PolarGrid | SquareGrid,
        layers: Layers,
    ) -> None:
        self.item, self.number, self.discs = item, number, scene.landmark_set
        self.radius_m, self.width_m = size_of(scene, item)
        box = grid.box(item.ground_m, item.azimuth_deg, object_radius(scene, item))
        self.layers = Layers(*(layer[box] for layer in layers))  # views
        self.texture = self.layers.level.copy()
        specular_db, (x0, y0) = scene.fading.specular_db, position_of(item)
        dx, dy = grid.x_m[box] - x0, grid.y_m[box] - y0
        self.raised: list[FloatArray] | None = None  # lifted_m, lit_db
        if item.lean_deg:
            dx, dy, *raised = _raised(item, self.radius_m, scene, grid.x_m[box], grid.y_m[box])
            self.raised = raised
        cos, sin = (part(math.radians(item.orientation_deg)) for part in (math.cos, math.sin))
        self.u = (dx * cos + dy * sin) / self.radius_m
        self.v = (-dx * sin + dy * cos) / self.radius_m
        self.rho = np.hypot(self.u, self.v)
        # Edges that face the sonar, on the near and the far side, reflect more.
        self.line = (dx * x0 + dy * y0) / (np.maximum(np.hypot(dx, dy), 1e-6) * item.ground_m)
        self.facing = specular_db * (np.abs(self.line) - 0.5)

    def paint(
        self, where: BoolArray, level_db: FloatArray | float, gravel_m: float | None = None
    ) -> None:
        """Paint cells. where: (box) which. gravel_m: mean height of the gravel that they are made
        of, whose stones may glitter; None: of no gravel.

        They keep half of the floor's texture.
        """
        self.layers.relief[where] = -(gravel_m or 0.0)
        shade = np.broadcast_to(np.asarray(level_db, dtype=np.float32), where.shape)
        if gravel_m is not None:
            shade = shade + self.layers.glitter
        self.layers.level[where] = (shade + 0.5 * self.texture)[where]
        self.layers.owner[where] = self.number

    @property
    def ring(self) -> BoolArray:
        """The cells of a landmark's ring."""
        inner, outer = self.discs.ring
        return np.asarray((self.rho >= inner) & (self.rho <= outer))


def draw_object(
    item: Placed, number: int, scene: Scene, grid: PolarGrid | SquareGrid, layers: Layers
) -> None:
    """Paint the parts of an object into the layers, set their heights, and cover it with silt."""
    canvas = Canvas(item, number, scene, grid, layers)
    if isinstance(item, PlacedLandmark):
        _landmark(item, canvas)
    else:
        _, _, tall_m, usual_db = KINDS[item.kind]
        bright_db = usual_db if item.bright_db is None else item.bright_db
        _DRAW[item.kind](item, canvas, bright_db, tall_m)
    on = canvas.layers
    own = on.owner == number
    if canvas.raised is not None:
        lifted_m, lit_db = canvas.raised
        on.level[own] += lit_db[own]
        on.lifted[own] = lifted_m[own]
    if item.silted:
        silt = np.zeros(own.shape, np.float32)
        if own.any():  # the share is of the cells that are at least half covered
            most = np.quantile(on.silt[own], 1 - item.silted)
            silt = np.where(own, 1 / (1 + np.exp((most - on.silt) / SILT_EDGE)), 0.0)
        on.level[...] += silt * (canvas.texture - on.level)
        on.owner[silt > 0.5] = -1


def _landmark(item: PlacedLandmark, on: Canvas) -> None:
    bright = on.discs.pattern(on.discs.ids.index(item.id), on.u, on.v) > 0.5
    on.paint(on.rho <= 1, item.plate_db)
    on.paint(bright & ~on.ring, item.symbol_db, item.relief_m)
    on.paint(on.ring, item.bright_db + on.facing, item.relief_m)


def _ringed(item: PlacedObject, on: Canvas, bright_db: float, _: float) -> None:
    """A plate with a landmark's ring, or half of it; without a symbol, or with one of no ID."""
    on.paint(on.rho <= 1, item.plate_db)
    half = np.arctan2(on.v, on.u) >= 0 if item.kind == "half_ring" else True
    on.paint(on.ring & half, bright_db + on.facing, item.relief_m)
    inner, outer = on.discs.symbol
    if item.kind in SYMBOLS:
        bright = symbol(item.kind, item.number, on.discs, on.u / outer, on.v / outer)
        on.paint(bright & (on.rho >= inner), bright_db - 1, item.relief_m)
    if item.kind == "spokes":
        across = np.minimum(np.abs(on.u), np.abs(on.v))
        on.paint((across < 0.07) & (on.rho >= 0.12) & (on.rho <= outer), bright_db)


def _filled(item: PlacedObject, on: Canvas, bright_db: float, _: float) -> None:
    on.paint(on.rho <= 1, bright_db, None if item.kind == "cover" else item.relief_m)


def _stone(_: PlacedObject, on: Canvas, bright_db: float, tall_m: float) -> None:
    """A rounded stone: brightest in the middle of the side that faces the sonar."""
    angle = np.arctan2(on.v, on.u)
    outline = 1 + 0.25 * np.sin(3 * angle + on.number) + 0.1 * np.sin(7 * angle)
    inside = on.rho <= outline
    on.paint(inside, bright_db - 2 * on.rho - 2 * on.line * on.rho)
    on.layers.height[inside] = tall_m * on.radius_m / 0.05


def _tyre(_: PlacedObject, on: Canvas, bright_db: float, tall_m: float) -> None:
    torus = (on.rho <= 1) & (on.rho >= 0.55)
    on.paint(torus, bright_db + on.facing - 6 * ((on.rho - 0.78) / 0.22) ** 2)
    round_ = np.sqrt(np.maximum(1 - ((on.rho[torus] - 0.775) / 0.23) ** 2, 0))
    on.layers.height[torus] = tall_m * round_


def _oblong(item: PlacedObject, on: Canvas, bright_db: float, tall_m: float) -> None:
    """Wire netting; a wooden beam, darker towards its sides; a wall, whose far half is its top."""
    wide = np.abs(on.v) * 2 * on.radius_m / on.width_m  # distance across it, 1 at its sides
    inside = (np.abs(on.u) * 2 <= 1) & (wide <= 1)
    if item.kind == "mesh":
        along, across = np.mod(on.u * on.radius_m, MESH_M), np.mod(on.v * on.radius_m, MESH_M)
        on.paint(inside, -3.0)
        on.paint(inside & ((along < WIRE_M) | (across < WIRE_M)), bright_db)
        return
    on.paint(inside, bright_db - (2 if item.kind == "beam" else 0) * wide)
    on.layers.height[inside if item.kind == "beam" else inside & (on.v > 0)] = tall_m


_DRAW: dict[str, Callable[[PlacedObject, Canvas, float, float], None]] = {
    **dict.fromkeys(("blank", "spokes", "half_ring", *SYMBOLS), _ringed),
    **dict.fromkeys(("filled", "cover"), _filled),
    **{"stone": _stone, "tyre": _tyre},
    **dict.fromkeys(("mesh", "beam", "wall"), _oblong),
}
"""The function that draws an object, by kind. Its last two arguments are the object's brightness
(dB over the floor) and height (m), as in KINDS."""


def raised_m(item: Placed, radius_m: float) -> float:
    """Height of the middle of a leaning disc above the floor, m."""
    return radius_m * math.sin(math.radians(item.lean_deg))


def _raised(
    item: Placed, radius_m: float, scene: Scene, x_m: np.ndarray, y_m: np.ndarray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """A leaning disc, its lower edge on the floor, as a sonar above the floor's origin sees it.

    A raised point has the same slant range as a nearer point of the floor, so it shows there. For
    each cell, at x_m, y_m: the point of the disc that shows there, from the disc's middle and along
    the disc (m, m); as Layers.lifted; and by how much it is brighter than if it lay level, dB: by
    Lambert's law, for the way there and back, and at the edge that faces the sonar.
    """
    sonar_m = scene.sonar.height_m
    lean, towards = math.radians(item.lean_deg), math.radians(item.lean_towards_deg)
    x0, y0 = position_of(item)
    right, ahead = math.sin(towards), math.cos(towards)
    floor = np.hypot(x_m, y_m)
    range_ = np.hypot(floor, sonar_m)
    ex, ey = x_m / floor, y_m / floor
    # Along an azimuth the disc's height is rise times ground range, plus a constant.
    facing = ex * right + ey * ahead
    rise, middle_m = math.tan(lean) * facing, raised_m(item, radius_m)
    over = sonar_m - middle_m + math.tan(lean) * (x0 * right + y0 * ahead)
    root = np.maximum(range_**2 * (1 + rise**2) - over**2, 0)
    ground = (over * rise + np.sqrt(root)) / (1 + rise**2)
    dx, dy = ground * ex - x0, ground * ey - y0
    level = dx * right + dy * ahead
    height = level * math.tan(lean) + middle_m
    along = level * (1 / math.cos(lean) - 1)
    dx, dy = dx + along * right, dy + along * ahead
    # The raised edge is on the near side or on the far side, seen from the sonar.
    near = -(dx * x0 + dy * y0) / (radius_m * item.ground_m)
    rim = np.hypot(dx, dy) / radius_m > 0.8
    edge = np.where(rim, near * np.clip(height / (2 * middle_m), 0, 1), 0.0)
    sine = math.sin(lean) * facing * ground + math.cos(lean) * (sonar_m - height)
    lit_db = 20 * np.log10(np.maximum(sine / sonar_m, 0.02)) + scene.fading.specular_db * edge
    return dx, dy, sonar_m - floor * (sonar_m - height) / ground, lit_db


def ripples(scene: Scene, grid: PolarGrid | SquareGrid, bare: BoolArray) -> np.ndarray:
    """Height (m) of sand ripples in each cell of the grid.

    bare: the cells without an object. Objects lie level, and the ripples fade out at their edges.
    Crests bend, and are sharper than troughs.
    """
    floor = scene.floor
    towards = math.radians(floor.ripple_towards_deg)
    rng = np.random.default_rng([scene.seed, 12])
    bends = smooth_noise(rng, grid.shape, grid.cells(6 * floor.ripple_length_m))
    across = grid.x_m * np.float32(math.sin(towards)) + grid.y_m * np.float32(math.cos(towards))
    phase = across / np.float32(floor.ripple_length_m) + np.float32(floor.ripple_bends) * bends
    phase = phase * np.float32(2 * np.pi)
    height = np.float32(floor.ripple_height_m / 2) * (np.cos(phase) + 0.25 * np.cos(2 * phase))
    rows, columns = (2 * math.ceil(n / 2) + 1 for n in grid.cells(0.015))
    return np.asarray(height * cv2.blur(bare.astype(np.float32), (columns, rows)))


LEAST_DIFFERENCE = 0.12
"""Share of the circle in which sectors must differ from every ID, at any rotation."""
LEAST_DIFFERENCE_BLOBS = 0.18
"""The same for patches, as a share of the area; more, because patches have edges all over."""
DIRECTIONS = 360  # into which the circle is divided
LETTERS = "AEFHKLNTVXYZ"
_GLYPH = 96  # pixels


def symbol(
    kind: str, number: int, landmarks: LandmarkSet, x: FloatArray, y: FloatArray
) -> BoolArray:
    """Whether a symbol of this kind is bright at x, y; has the shape of x and y.

    number: seed of the symbol. x, y: from its centre, in radii of the landmarks' symbols. Beyond
    radius 1 it is dark.
    """
    rng = np.random.default_rng([number, SYMBOLS.index(kind)])
    within = np.hypot(x, y) <= 1
    if kind == "bar":
        return np.asarray(within & (np.abs(y) < rng.uniform(0.15, 0.3)))
    if kind == "cross":
        half = rng.uniform(0.15, 0.3)
        return np.asarray(within & (np.minimum(np.abs(x), np.abs(y)) < half))
    if kind == "letter":
        text, face, thick = str(rng.choice(list(LETTERS))), cv2.FONT_HERSHEY_SIMPLEX, 14
        picture = np.zeros((_GLYPH, _GLYPH), np.uint8)
        (width, height), _ = cv2.getTextSize(text, face, 2.4, thick)
        corner = (_GLYPH - width) // 2, (_GLYPH + height) // 2
        cv2.putText(picture, text, corner, face, 2.4, 255, thick)
        return np.asarray(within & _values(picture > 0, x, y))
    if kind == "blobs":
        return np.asarray(within & _values(_blobs(landmarks, rng), x, y))
    lit = _sectors(kind, landmarks, rng)
    way = np.mod(np.arctan2(y, x), 2 * math.pi) / (2 * math.pi) * DIRECTIONS
    return np.asarray(within & lit[np.minimum(way.astype(int), DIRECTIONS - 1)])


def _values(picture: BoolArray, x: FloatArray, y: FloatArray) -> BoolArray:
    """Values of a square picture, which the symbol's circle fills, at x and y (in radii)."""
    size = len(picture)
    row, column = (np.clip((v + 1) / 2 * size, 0, size - 1).astype(int) for v in (-y, x))
    return np.asarray(picture[row, column])


def _blobs(landmarks: LandmarkSet, rng: np.random.Generator) -> BoolArray:
    """(_GLYPH, _GLYPH) smooth patches that differ from every ID, at any rotation."""
    y, x = 1 - 2 * (np.mgrid[:_GLYPH, :_GLYPH] + 0.5) / _GLYPH
    within = np.hypot(x, y) <= 1
    way = np.mod(np.arctan2(y, -x), 2 * math.pi)[within] / (2 * math.pi) * DIRECTIONS
    rotations = _rotations(landmarks)[:, np.minimum(way.astype(int), DIRECTIONS - 1)]
    while True:
        noise = rng.standard_normal((_GLYPH, _GLYPH))
        smooth = cv2.GaussianBlur(noise, (0, 0), rng.uniform(0.08, 0.2) * _GLYPH)
        lit = smooth > np.quantile(smooth, rng.uniform(0.3, 0.7))
        if np.mean(rotations != lit[within], axis=1).min() >= LEAST_DIFFERENCE_BLOBS:
            return np.asarray(lit)


def _sectors(kind: str, landmarks: LandmarkSet, rng: np.random.Generator) -> BoolArray:
    """(DIRECTIONS,) sectors round the circle that differ from every ID, at any rotation."""
    rotations = _rotations(landmarks)
    while True:
        if kind == "wedges":
            lit = np.zeros(DIRECTIONS, bool)
            for _ in range(int(rng.integers(1, 5))):
                begin, width = rng.integers(DIRECTIONS), int(rng.integers(25, 151))
                lit[(begin + np.arange(width)) % DIRECTIONS] = True
        else:
            parts = 8 if kind == "eighths" else int(rng.choice([3, 5, 6]))
            lit = (rng.random(parts) < 0.5)[np.arange(DIRECTIONS) * parts // DIRECTIONS]
        if 0 < lit.mean() < 1 and np.mean(rotations != lit, axis=1).min() >= LEAST_DIFFERENCE:
            return np.asarray(lit)


def _rotations(landmarks: LandmarkSet) -> BoolArray:
    """(rotations x K, DIRECTIONS) the sectors of every ID, rotated in steps of 5 degrees."""
    direction = (np.arange(DIRECTIONS) + 0.5) * 2 * math.pi / DIRECTIONS
    codes = landmarks.codes(direction) > 0.5
    return np.concatenate([np.roll(codes, step, axis=1) for step in range(0, DIRECTIONS, 5)])
