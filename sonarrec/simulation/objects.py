"""How landmarks and other objects look on the simulated floor, one function for each kind, and how
they rest on it: leaning, under silt, and on rippled sand."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, FloatArray
from sonarrec.simulation.grid import PolarGrid, SquareGrid, smooth_noise
from sonarrec.simulation.scene import (
    KINDS,
    ROUND,
    SYMBOLS,
    PlacedLandmark,
    PlacedObject,
    Scene,
    position_of,
)
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


SILT_EDGE = 0.15  # width of the edge between bare and covered, in units of the smooth noise


def raised_m(item: PlacedLandmark | PlacedObject, radius_m: float) -> float:
    """Height of the middle of a leaning disc above the floor, m."""
    return radius_m * math.sin(math.radians(item.lean_deg))


class RaisedDisc:
    """A leaning disc, as a sonar above the floor's origin sees it. Its lower edge is on the floor.

    A raised point has the same slant range as a nearer point of the floor, so it shows there.
    dx_m, dy_m: for each cell of a box, the point of the disc that shows there, from the disc's
    middle and along the disc. lifted_m: how tall an object standing in the cell would have to be,
    for the sonar to see its top at the same depression as the disc.
    """

    def __init__(
        self,
        item: PlacedLandmark | PlacedObject,
        radius_m: float,
        sonar_m: float,
        x_m: np.ndarray,
        y_m: np.ndarray,
    ) -> None:
        """sonar_m: the sonar's height. x_m, y_m: the cells' positions on the floor."""
        lean, towards = math.radians(item.lean_deg), math.radians(item.lean_towards_deg)
        x0, y0 = position_of(item)
        right, ahead = math.sin(towards), math.cos(towards)
        floor = np.hypot(x_m, y_m)
        range_ = np.hypot(floor, sonar_m)
        ex, ey = x_m / floor, y_m / floor
        # Along an azimuth the disc's height is rise times ground range, plus a constant.
        facing = ex * right + ey * ahead
        rise = math.tan(lean) * facing
        over = sonar_m - raised_m(item, radius_m) + math.tan(lean) * (x0 * right + y0 * ahead)
        root = np.maximum(range_**2 * (1 + rise**2) - over**2, 0)
        ground = (over * rise + np.sqrt(root)) / (1 + rise**2)
        dx, dy = ground * ex - x0, ground * ey - y0
        level = dx * right + dy * ahead
        self._height = level * math.tan(lean) + raised_m(item, radius_m)
        along = level * (1 / math.cos(lean) - 1)
        self.dx_m, self.dy_m = dx + along * right, dy + along * ahead
        self.lifted_m = sonar_m - floor * (sonar_m - self._height) / ground
        self._sine = math.sin(lean) * facing * ground + math.cos(lean) * (sonar_m - self._height)
        self._sonar_m = sonar_m
        rim = np.hypot(self.dx_m, self.dy_m) / radius_m
        # The raised edge faces the sonar or faces away from it.
        near = -(self.dx_m * x0 + self.dy_m * y0) / (radius_m * item.ground_m)
        most = 2 * raised_m(item, radius_m)
        self._edge = np.where(rim > 0.8, near * np.clip(self._height / most, 0, 1), 0.0)

    def lit_db(self, specular_db: float) -> FloatArray:
        """By how much the disc is brighter than if it lay level, dB.

        Lambert's law, for the way there and back; the edge that faces the sonar is brighter.
        """
        lit = np.maximum(self._sine / self._sonar_m, 0.02)
        return np.asarray(20 * np.log10(lit) + specular_db * self._edge)


def silt_over(noise: np.ndarray, disc: BoolArray, share: float) -> np.ndarray:
    """(box) 0 to 1: by how much silt covers each cell of a disc.

    share: of the cells, those that are at least half covered.
    """
    if not disc.any():
        return np.zeros(noise.shape, np.float32)
    most = np.quantile(noise[disc], 1 - share)
    return np.asarray(np.where(disc, 1 / (1 + np.exp((most - noise) / SILT_EDGE)), 0.0))


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
