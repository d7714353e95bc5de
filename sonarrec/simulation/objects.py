"""How landmarks and other objects look on the simulated floor: one function for each kind."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray
from sonarrec.simulation.scene import KINDS, ROUND, SYMBOLS, PlacedLandmark, PlacedObject, Scene
from sonarrec.simulation.symbols import symbol

WIRE_M, MESH_M = 0.012, 0.05  # wire netting: thickness of a wire, and from wire to wire


def object_radius(scene: Scene, item: PlacedObject) -> float:
    """Radius (m) of the circle around an object, for its truth and for spacing."""
    size, width = size_of(scene, item)
    return size if item.kind in ROUND else math.hypot(size, width) / 2


def size_of(scene: Scene, item: PlacedObject) -> tuple[float, float]:
    """(size, width) of an object, m; see KINDS."""
    size, width, _, _ = KINDS[item.kind]
    size = item.size_m or size or scene.landmark_set.radius_m
    return size, item.width_m or width or size


class Surface(NamedTuple):
    """Where the cells of a box lie on an object; all arrays have the shape of the box.

    u, v: position along and across the object, in units of radius_m. rho: distance from its middle,
    likewise. line: cosine between the direction from the middle and the line of sight. facing: by
    how much ring edges are brighter because they face the sonar, dB.
    """

    u: np.ndarray
    v: np.ndarray
    rho: np.ndarray
    line: np.ndarray
    facing: np.ndarray
    radius_m: float


class Canvas:
    """The cells of a box, on which one object is painted.

    level: brightness over the floor, dB. owner: number of the object in each cell. height: m.
    relief: standard deviation of the height, m; negative for bumps that only rise. All are views of
    the world's arrays. texture: a copy of the level before painting.
    """

    def __init__(
        self,
        surface: Surface,
        number: int,
        level: np.ndarray,
        owner: np.ndarray,
        height: np.ndarray,
        relief: np.ndarray,
    ) -> None:
        self.surface, self.number = surface, number
        self.level, self.owner, self.height, self.relief = level, owner, height, relief
        self.texture = level.copy()

    def paint(self, where: BoolArray, level_db: FloatArray | float, gravel_m: float = 0.0) -> None:
        """Paint cells. where: (box) which. gravel_m: mean height of their bumps.

        They keep half of the floor's texture.
        """
        self.relief[where] = -gravel_m
        shade = np.broadcast_to(np.asarray(level_db, dtype=np.float32), where.shape)
        self.level[where] = (shade + 0.5 * self.texture)[where]
        self.owner[where] = self.number


def draw_object(item: PlacedLandmark | PlacedObject, scene: Scene, canvas: Canvas) -> None:
    """Paint the parts of an object, and set their heights."""
    if isinstance(item, PlacedLandmark):
        _landmark(item, scene, canvas)
        return
    _, _, tallness, usual_db = KINDS[item.kind]
    bright_db = usual_db if item.bright_db is None else item.bright_db
    _DRAW[item.kind](item, scene, canvas, bright_db, tallness)


def _ring(scene: Scene, rho: np.ndarray) -> BoolArray:
    inner, outer = scene.landmark_set.ring
    return np.asarray((rho >= inner) & (rho <= outer))


def _landmark(item: PlacedLandmark, scene: Scene, canvas: Canvas) -> None:
    on, discs = canvas.surface, scene.landmark_set
    ring = _ring(scene, on.rho)
    bright = discs.pattern(discs.ids.index(item.id), on.u, on.v) > 0.5
    canvas.paint(on.rho <= 1, item.plate_db)
    canvas.paint(bright & ~ring, item.symbol_db, item.relief_m)
    canvas.paint(ring, item.bright_db + on.facing, item.relief_m)


def _ringed(item: PlacedObject, scene: Scene, canvas: Canvas, bright_db: float, _: float) -> None:
    """A plate with a landmark's ring, or half of it; without a symbol, or with one of no ID."""
    on, discs = canvas.surface, scene.landmark_set
    canvas.paint(on.rho <= 1, item.plate_db)
    ring = _ring(scene, on.rho)
    if item.kind == "half_ring":
        ring &= np.arctan2(on.v, on.u) >= 0
    canvas.paint(ring, bright_db + on.facing, item.relief_m)
    if item.kind in SYMBOLS:
        x, y = on.u / discs.symbol[1], on.v / discs.symbol[1]
        bright = symbol(item.kind, item.number, discs, x, y) & (on.rho >= discs.symbol[0])
        canvas.paint(bright, bright_db - 1, item.relief_m)
    if item.kind == "spokes":
        across = np.minimum(np.abs(on.u), np.abs(on.v))
        canvas.paint((across < 0.07) & (on.rho >= 0.12) & (on.rho <= discs.symbol[1]), bright_db)


def _filled(item: PlacedObject, _: Scene, canvas: Canvas, bright_db: float, __: float) -> None:
    canvas.paint(canvas.surface.rho <= 1, bright_db, item.relief_m)


def _stone(_: PlacedObject, __: Scene, canvas: Canvas, bright_db: float, tallness: float) -> None:
    """A rounded stone: brightest in the middle of the side that faces the sonar."""
    on = canvas.surface
    angle = np.arctan2(on.v, on.u)
    outline = 1 + 0.25 * np.sin(3 * angle + canvas.number) + 0.1 * np.sin(7 * angle)
    inside = on.rho <= outline
    canvas.paint(inside, bright_db - 2 * on.rho - 2 * on.line * on.rho)
    canvas.height[inside] = tallness * on.radius_m / 0.05


def _tyre(_: PlacedObject, __: Scene, canvas: Canvas, bright_db: float, tallness: float) -> None:
    rho = canvas.surface.rho
    torus = (rho <= 1) & (rho >= 0.55)
    canvas.paint(torus, bright_db + canvas.surface.facing - 6 * ((rho - 0.78) / 0.22) ** 2)
    round_ = np.sqrt(np.maximum(1 - ((rho[torus] - 0.775) / 0.23) ** 2, 0))
    canvas.height[torus] = tallness * round_


def _oblong(item: PlacedObject, scene: Scene, canvas: Canvas) -> tuple[BoolArray, np.ndarray]:
    """For a rectangular object: the cells on it, and their distance across it (1 at its sides)."""
    on = canvas.surface
    wide = np.abs(on.v) * 2 * on.radius_m / size_of(scene, item)[1]
    return np.asarray((np.abs(on.u) * 2 <= 1) & (wide <= 1)), wide


def _mesh(item: PlacedObject, scene: Scene, canvas: Canvas, bright_db: float, _: float) -> None:
    on = canvas.surface
    inside, _wide = _oblong(item, scene, canvas)
    along, across = np.mod(on.u * on.radius_m, MESH_M), np.mod(on.v * on.radius_m, MESH_M)
    canvas.paint(inside, -3.0)
    canvas.paint(inside & ((along < WIRE_M) | (across < WIRE_M)), bright_db)


def _bar(
    item: PlacedObject, scene: Scene, canvas: Canvas, bright_db: float, tallness: float
) -> None:
    """A wooden beam, darker towards its sides, or a wall, whose far half is its top."""
    inside, wide = _oblong(item, scene, canvas)
    is_wall = item.kind == "wall"
    canvas.paint(inside, bright_db - (0 if is_wall else 2) * wide)
    canvas.height[inside & (canvas.surface.v > 0) if is_wall else inside] = tallness


_DRAW: dict[str, Callable[[PlacedObject, Scene, Canvas, float, float], None]] = {
    **dict.fromkeys(("blank", "spokes", "half_ring", *SYMBOLS), _ringed),
    **dict.fromkeys(("filled", "cover"), _filled),
    "stone": _stone,
    "tyre": _tyre,
    "mesh": _mesh,
    **dict.fromkeys(("beam", "wall"), _bar),
}
"""The function that draws an object, by kind. Its last two arguments are the object's brightness
(dB over the floor) and height (m), as in KINDS."""
