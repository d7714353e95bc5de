"""The simulator's world: what lies on the floor, as a polar grid of scatterers fixed to it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sonarrec.records import FloatArray
from sonarrec.simulation.scene import KINDS, ROUND, SYMBOLS, PlacedLandmark, PlacedObject, Scene
from sonarrec.simulation.symbols import symbol

STEP_DEG = 0.1  # azimuth between scatterers: three or more within a beam
MARGIN_DEG = 4.0  # beyond the fan's edges, for side lobes
TWIG = 0.12  # half the thickness of debris, in that over which it winds
MARGIN_M = 0.25  # of slant range, for heave and sway


def object_radius(scene: Scene, thing: PlacedObject) -> float:
    """Radius (m) of the circle that an object's truth and spacing go by."""
    size, width = _size(scene, thing)
    return size if thing.kind in ROUND else math.hypot(size, width) / 2


def _size(scene: Scene, thing: PlacedObject) -> tuple[float, float]:
    size, width, _, _ = KINDS[thing.kind]
    size = thing.size_m or size or scene.landmark_set.radius_m
    return size, thing.width_m or width or size


def smooth_noise(
    rng: np.random.Generator, shape: tuple[int, int], cells: tuple[float, float]
) -> np.ndarray:
    """(shape) float32 Gaussian noise of unit variance, smooth over about `cells` rows, columns."""
    coarse = tuple(max(round(n / c), 1) + 3 for n, c in zip(shape, cells, strict=True))
    values = rng.standard_normal(coarse, dtype=np.float32)
    full = cv2.resize(values, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray(full / max(float(full.std()), 1e-6))


@dataclass(frozen=True, slots=True)
class View:
    """The part of the world before the sonar, on its own grid of slant ranges and azimuths.

    azimuth_deg: (n,) in the world. echoes: (bins, n) complex64 amplitude of each scatterer.
    glow: (bins, n) float32 power of objects that afterglow.
    """

    azimuth_deg: FloatArray
    echoes: np.ndarray
    glow: np.ndarray
    power: np.ndarray
    """(bins, n) float32 mean power of each scatterer."""


class World:
    """Layers over nominal slant range (rows) and azimuth (columns) seen from the floor's origin.

    Every cell holds one complex Gaussian scatterer with phases of its own; panning moves the
    view along the columns and so keeps speckle, sway and heave turn the phases.
    """

    PATCHES = 6  # processes from which every place's own fading is mixed

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self._scene = scene
        sonar, motion = scene.sonar, scene.motion
        self._bin_m = bin_m = (sonar.range_max_m - sonar.range_min_m) / sonar.range_bins
        first = max(sonar.range_min_m - MARGIN_M, bin_m)
        rows = math.ceil((sonar.range_max_m + MARGIN_M - first) / bin_m)
        self._first_m = first
        sway = math.hypot(motion.sway_x_m, motion.sway_y_m)
        reach = sonar.field_of_view_deg / 2 + MARGIN_DEG
        self._reach_deg = reach
        nearest = math.sqrt(max(first**2 - sonar.height_m**2, 0.25))
        reach += 4 * motion.yaw_jitter_deg + math.degrees(sway / nearest) + 1
        self._first_deg = motion.pan_min_deg - reach
        columns = math.ceil((motion.pan_max_deg + reach - self._first_deg) / STEP_DEG) + 1
        self._shape = shape = (rows, columns)

        slant = first + (np.arange(rows) + 0.5) * bin_m
        self._ground = np.sqrt(np.maximum(slant**2 - sonar.height_m**2, 1e-9))
        azimuth = np.radians(self._first_deg + np.arange(columns) * STEP_DEG)
        self._x = (self._ground[:, None] * np.sin(azimuth)).astype(np.float32)
        self._y = (self._ground[:, None] * np.cos(azimuth)).astype(np.float32)
        middle = (sonar.range_min_m + sonar.range_max_m) / 2
        deg_per_m = math.degrees(1 / middle)

        def cells(metres: float) -> tuple[float, float]:
            return metres / bin_m, metres * deg_per_m / STEP_DEG

        level = scene.floor.texture_db * smooth_noise(rng, shape, cells(scene.floor.texture_m))
        owner = np.full(shape, -1, dtype=np.int16)
        height = np.zeros(shape, dtype=np.float32)
        relief = np.full(shape, scene.floor.relief_m, dtype=np.float32)
        things: list[PlacedLandmark | PlacedObject] = [*scene.landmarks, *scene.objects]
        for number, item in enumerate(things):
            self._draw(item, number, level, owner, height, relief)
        self._relieve(cells, level, height, relief)
        shadow = self._shadow(height)
        amplitude = np.power(np.float32(10), level / 20)
        amplitude[shadow] *= 10 ** (scene.noise.shadow_db / 20)
        amplitude[slant <= sonar.height_m] = 0
        # Edges no sharper than the scatterers they stand for.
        amplitude = cv2.blur(amplitude, (3, 1))
        self._amplitude = amplitude.ravel()

        self._cells = np.flatnonzero((owner >= 0) & ~shadow)
        self._owner = owner.ravel()[self._cells]
        self._plain = self._amplitude[self._cells]
        self._mix = np.stack(
            [
                smooth_noise(rng, shape, cells(scene.fading.patch_m)).ravel()[self._cells]
                for _ in range(self.PATCHES)
            ],
            axis=1,
        ) / np.float32(math.sqrt(self.PATCHES))
        self._glow = np.zeros(rows * columns, dtype=np.float32)

        self._scatter = rng.standard_normal((rows * columns, 2), dtype=np.float32)
        self._scatter *= np.float32(math.sqrt(0.5))
        # How fast each scatterer's phase turns: with time, sway right, sway forward, heave. The
        # mean of exp(i phase) is the correlation: Cauchy rates make it exp(-time), Gaussian ones
        # exp(-distance^2 / 2).
        self._turn = rng.standard_normal((4, rows * columns), dtype=np.float32)
        with np.errstate(divide="ignore"):  # a draw of exactly 0 is clipped like any huge rate
            self._turn[0] /= rng.standard_normal(rows * columns, dtype=np.float32)
        np.clip(self._turn, -100, 100, out=self._turn)

    def _draw(
        self,
        item: PlacedLandmark | PlacedObject,
        number: int,
        level: np.ndarray,
        owner: np.ndarray,
        height: np.ndarray,
        relief: np.ndarray,
    ) -> None:
        """Lay one thing on the floor: its level (dB), its number, its height and relief (m)."""
        scene = self._scene
        place = math.radians(item.azimuth_deg)
        x0, y0 = item.ground_m * math.sin(place), item.ground_m * math.cos(place)
        if isinstance(item, PlacedLandmark):
            radius = scene.landmark_set.radius_m
            reach = radius
        else:
            radius, width = _size(scene, item)
            reach = object_radius(scene, item)
        box = self._box(item.ground_m, item.azimuth_deg, reach)
        dx, dy = self._x[box] - x0, self._y[box] - y0
        turn = math.radians(item.orientation_deg)
        u = (dx * math.cos(turn) + dy * math.sin(turn)) / radius
        v = (-dx * math.sin(turn) + dy * math.cos(turn)) / radius
        rho = np.hypot(u, v)
        # Edges that face the sonar, near and far, send more of the sound back.
        line = (dx * x0 + dy * y0) / (np.maximum(np.hypot(dx, dy), 1e-6) * item.ground_m)
        facing = scene.fading.specular_db * (np.abs(line) - 0.5)
        out, who, tall, rough = level[box], owner[box], height[box], relief[box]
        texture = out.copy()

        def paint(where: np.ndarray, value: FloatArray | float, gravel_m: float = 0.0) -> None:
            # Below 0: bumps only, above what lies there.
            rough[where] = -gravel_m
            shade = np.broadcast_to(np.asarray(value, dtype=np.float32), where.shape)
            out[where] = (shade + 0.5 * texture)[where]
            who[where] = number

        discs = scene.landmark_set
        ring = (rho >= discs.ring[0]) & (rho <= discs.ring[1])
        angle = np.arctan2(v, u)
        if isinstance(item, PlacedLandmark):
            k = discs.ids.index(item.id)
            bright = discs.pattern(k, u, v) > 0.5
            paint(rho <= 1, item.plate_db)
            paint(bright & ~ring, item.symbol_db, item.relief_m)
            paint(ring, item.bright_db + facing, item.relief_m)
            return
        _, _, tallness, usual = KINDS[item.kind]
        bright_db = usual if item.bright_db is None else item.bright_db
        long, wide = np.abs(u) * 2, np.abs(v) * 2 * radius / width
        if item.kind in ("blank", "spokes", "half_ring", *SYMBOLS):
            paint(rho <= 1, item.plate_db)
            if item.kind == "half_ring":
                ring &= angle >= 0
            paint(ring, bright_db + facing, item.relief_m)
            if item.kind in SYMBOLS:
                x, y = u / discs.symbol[1], v / discs.symbol[1]
                bright = symbol(item.kind, item.number, discs, x, y) & (rho >= discs.symbol[0])
                paint(bright, bright_db - 1, item.relief_m)
            if item.kind == "spokes":
                across = np.minimum(np.abs(u), np.abs(v))
                paint((across < 0.07) & (rho >= 0.12) & (rho <= discs.symbol[1]), bright_db)
        elif item.kind in ("filled", "cover"):
            paint(rho <= 1, bright_db, item.relief_m)
        elif item.kind == "stone":
            # Rounded: brightest in the middle of the side that faces the sonar.
            inside = rho <= 1 + 0.25 * np.sin(3 * angle + number) + 0.1 * np.sin(7 * angle)
            paint(inside, bright_db - 2 * rho - 2 * line * rho)
            tall[inside] = tallness * radius / 0.05
        elif item.kind == "tyre":
            torus = (rho <= 1) & (rho >= 0.55)
            paint(torus, bright_db + facing - 6 * ((rho - 0.78) / 0.22) ** 2)
            tall[torus] = tallness * np.sqrt(np.maximum(1 - ((rho[torus] - 0.775) / 0.23) ** 2, 0))
        elif item.kind == "mesh":
            inside = (long <= 1) & (wide <= 1)
            wire_m, gap_m = 0.012, 0.05
            su, sv = np.mod(u * radius, gap_m), np.mod(v * radius, gap_m)
            wire = inside & ((su < wire_m) | (sv < wire_m))
            paint(inside, -3.0)
            paint(wire, bright_db)
        elif item.kind == "beam":
            inside = (long <= 1) & (wide <= 1)
            paint(inside, bright_db - 2 * wide)
            tall[inside] = tallness
        elif item.kind == "wall":
            inside = (long <= 1) & (wide <= 1)
            paint(inside, bright_db)
            tall[inside & (v > 0)] = tallness

    def _relieve(
        self,
        cells: Callable[[float], tuple[float, float]],
        level: np.ndarray,
        height: np.ndarray,
        relief: np.ndarray,
    ) -> None:
        """Raise bumps, and lighten and darken slopes that face the sonar and turn from it.

        Then lay twigs, and patches of light and shade, over all. cells: rows and columns of so
        many metres.
        """
        floor = self._scene.floor
        if relief.any():
            rng = np.random.default_rng([self._scene.seed, 6])
            noise = smooth_noise(rng, relief.shape, cells(floor.relief_size_m))
            height += relief * np.where(relief < 0, -np.abs(noise), noise)
            ground = self._ground[:, None].astype(np.float32)
            grazing = np.arctan(np.float32(self._scene.sonar.height_m) / ground)
            slope = np.gradient(height, axis=0) / np.gradient(ground, axis=0)
            # Lambert's law, there and back.
            lit = np.sin(np.clip(grazing + np.arctan(slope), 0.02, np.pi / 2))
            level += 20 * np.log10(lit / np.sin(grazing))
        if floor.debris_db:
            rng = np.random.default_rng([self._scene.seed, 8])
            bends, where = (smooth_noise(rng, relief.shape, cells(floor.debris_m)) for _ in "ab")
            # Where smooth noise passes through 0 lie winding lines; a second one breaks them off.
            twigs = np.exp(-((bends / TWIG) ** 2)) / (1 + np.exp(-where / TWIG))
            level += np.float32(floor.debris_db) * twigs.astype(np.float32)
        if floor.light_db:
            rng = np.random.default_rng([self._scene.seed, 7])
            patches = smooth_noise(rng, relief.shape, cells(floor.light_m))
            level -= np.float32(floor.light_db) / (1 + np.exp(-patches / 0.06))

    def _box(self, ground_m: float, azimuth_deg: float, reach_m: float) -> tuple[slice, slice]:
        """Rows and columns of the grid that a circle of radius reach_m may touch."""
        reach_m *= 1.4
        near, far = np.searchsorted(self._ground, [ground_m - reach_m, ground_m + reach_m])
        if reach_m >= ground_m:
            return slice(near, far + 1), slice(0, self._shape[1])
        half = math.degrees(math.asin(reach_m / ground_m))
        left = (azimuth_deg - half - self._first_deg) / STEP_DEG
        right = (azimuth_deg + half - self._first_deg) / STEP_DEG
        return slice(near, far + 1), slice(max(math.floor(left), 0), max(math.ceil(right), 0) + 1)

    def _shadow(self, height: np.ndarray) -> np.ndarray:
        """Cells hidden behind something taller: a ray over every nearer top clears the floor."""
        sonar_height = self._scene.sonar.height_m
        ground = self._ground[:, None].astype(np.float32)
        # Depression of the line over each cell's top; what is nearer must not lie flatter.
        slope = (sonar_height - height) / ground
        flattest = np.minimum.accumulate(slope, axis=0)
        return np.asarray(slope > flattest + 1e-4)

    def fade(self, object_db: FloatArray, patches: FloatArray, afterglow_db: FloatArray) -> None:
        """Set every object's brightness for a frame.

        object_db, afterglow_db: (objects,) dB, landmarks first. patches: (PATCHES,) standard
        normal, mixed into patch fading.
        """
        if not len(self._cells):
            return
        fading = self._scene.fading
        patch = self._mix @ patches.astype(np.float32)
        # Reflections fail far more than they flare.
        gain_db = np.minimum(object_db[self._owner] + fading.patch_db * patch, 4.0)
        amplitude = self._plain * np.power(np.float32(10), gain_db.astype(np.float32) / 20)
        self._amplitude[self._cells] = amplitude
        glow = 10 ** ((fading.ghost_db + afterglow_db) / 10)
        self._glow[self._cells] = amplitude**2 * glow.astype(np.float32)[self._owner]

    def view(
        self,
        range_m: FloatArray,
        pan_deg: float,
        height_m: float,
        moved_m: tuple[float, float],
        turned: Sequence[float],
    ) -> View:
        """What lies before the sonar at slant ranges (bins,), seen from where it is now.

        moved_m: translation to the right and forward. turned: (4,) how far the scatterers'
        phases have turned, as self._turn counts them.
        """
        rows, columns = self._shape
        start = math.floor((pan_deg - self._reach_deg - self._first_deg) / STEP_DEG)
        stop = math.ceil((pan_deg + self._reach_deg - self._first_deg) / STEP_DEG) + 1
        column = np.arange(start, stop)
        azimuth = self._first_deg + column * STEP_DEG
        ground = np.sqrt(np.maximum(range_m**2 - height_m**2, 0))[:, None]
        nominal = self._scene.sonar.height_m
        if moved_m == (0.0, 0.0):
            slant0 = np.hypot(ground, nominal)
            column0 = column[None, :]
        else:
            x = ground * np.sin(np.radians(azimuth)) + moved_m[0]
            y = ground * np.cos(np.radians(azimuth)) + moved_m[1]
            slant0 = np.sqrt(x**2 + y**2 + nominal**2)
            column0 = np.rint((np.degrees(np.arctan2(x, y)) - self._first_deg) / STEP_DEG)
        row0 = np.clip(np.floor((slant0 - self._first_m) / self._bin_m), 0, rows - 1)
        column0 = np.clip(column0, 0, columns - 1)
        cell = (row0 * columns + column0).astype(np.int32)

        phase = np.zeros(cell.shape, dtype=np.float32)
        for rate, amount in zip(self._turn, turned, strict=True):
            if amount:
                phase += rate[cell] * np.float32(amount)
        scatter = self._scatter.view(np.complex64)[:, 0][cell]
        spin = np.empty(cell.shape, dtype=np.complex64)
        spin.real, spin.imag = np.cos(phase), np.sin(phase)
        amplitude = self._amplitude[cell]
        return View(azimuth, scatter * spin * amplitude, self._glow[cell], amplitude**2)
