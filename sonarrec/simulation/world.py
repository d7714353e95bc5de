"""The simulator's world: what lies on the floor, as a polar grid of scatterers fixed to it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sonarrec.records import FloatArray
from sonarrec.simulation.grid import PolarGrid, SquareGrid, smooth_noise
from sonarrec.simulation.laid import RaisedDisc, ripples, silt_over
from sonarrec.simulation.motion import Pose
from sonarrec.simulation.plane import Plane
from sonarrec.simulation.scene import PlacedLandmark, PlacedObject, Scene, place_of
from sonarrec.simulation.things import Canvas, Place, draw_thing, object_radius, size_of

TWIG = 0.12  # half the thickness of debris, in that over which it winds


@dataclass(frozen=True, slots=True)
class View:
    """The part of the world before the sonar, on its own grid of slant ranges and azimuths.

    azimuth_deg: (n,) in the world. echoes: (bins, n) complex64 amplitude of each scatterer.
    glow: (bins, n) float32 power of objects that afterglow. power: (bins, n) float32 mean power of
    each scatterer. depression_deg, sine: (bins, 1) or (bins, n), as a Look has them.
    """

    azimuth_deg: FloatArray
    echoes: np.ndarray
    glow: np.ndarray
    power: np.ndarray
    depression_deg: FloatArray
    sine: FloatArray


class World:
    """Layers over the floor's grid: of slant range and azimuth seen from its origin, or squares.

    Every cell holds one complex Gaussian scatterer with phases of its own; panning moves the
    view along the columns and so keeps speckle, sway and heave turn the phases. Leaning discs, and
    on a polar grid lit slopes and shadows, are as seen from the origin.
    """

    PATCHES = 6  # processes from which every place's own fading is mixed

    def __init__(
        self, scene: Scene, rng: np.random.Generator, grid: PolarGrid | SquareGrid
    ) -> None:
        self._scene = scene
        self._grid = grid
        self._plane = Plane.of(scene)
        self._shape = shape = grid.shape
        cells = grid.cells
        level = scene.floor.texture_db * smooth_noise(rng, shape, cells(scene.floor.texture_m))
        owner = np.full(shape, -1, dtype=np.int16)
        height = np.zeros(shape, dtype=np.float32)
        relief = np.full(shape, scene.floor.relief_m, dtype=np.float32)
        things: list[PlacedLandmark | PlacedObject] = [*scene.landmarks, *scene.objects]
        self._silt = self._lifted = None
        if any(item.silted for item in things):
            silt_rng = np.random.default_rng([scene.seed, 13])
            self._silt = smooth_noise(silt_rng, shape, cells(scene.floor.silt_m))
        if any(item.lean_deg for item in things):
            self._lifted = np.zeros(shape, dtype=np.float32)
        for number, item in enumerate(things):
            self._draw(item, number, level, owner, height, relief)
        self._rise: tuple[np.ndarray, np.ndarray] | None = None  # where squares rise, x and y
        self._relieve(level, height, relief, owner)
        self._height = height.ravel() if isinstance(grid, SquareGrid) and height.any() else None
        shadow = self._shadow(height if self._lifted is None else height + self._lifted)
        amplitude = np.power(np.float32(10), level / 20)
        amplitude[shadow] *= 10 ** (scene.noise.shadow_db / 20)
        amplitude[grid.floorless] = 0
        # Edges no sharper than the scatterers they stand for.
        amplitude = cv2.blur(amplitude, (3, 1) if isinstance(grid, PolarGrid) else (3, 3))
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
        self._glow = np.zeros(owner.size, dtype=np.float32)

        self._scatter = rng.standard_normal((owner.size, 2), dtype=np.float32)
        self._scatter *= np.float32(math.sqrt(0.5))
        # How fast each scatterer's phase turns: with time, sway right, sway forward, heave. The
        # mean of exp(i phase) is the correlation: Cauchy rates make it exp(-time), Gaussian ones
        # exp(-distance^2 / 2).
        self._turn = rng.standard_normal((4, owner.size), dtype=np.float32)
        with np.errstate(divide="ignore"):  # a draw of exactly 0 is clipped like any huge rate
            self._turn[0] /= rng.standard_normal(owner.size, dtype=np.float32)
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
        scene, grid = self._scene, self._grid
        x0, y0 = place_of(item)
        if isinstance(item, PlacedLandmark):
            radius = reach = scene.landmark_set.radius_m
        else:
            radius, _ = size_of(scene, item)
            reach = object_radius(scene, item)
        box = grid.box(item.ground_m, item.azimuth_deg, reach)
        dx, dy = grid.x_m[box] - x0, grid.y_m[box] - y0
        raised = None
        if item.lean_deg:
            raised = RaisedDisc(item, radius, scene.sonar.height_m, grid.x_m[box], grid.y_m[box])
            dx, dy = raised.dx_m, raised.dy_m
        turn = math.radians(item.orientation_deg)
        u = (dx * math.cos(turn) + dy * math.sin(turn)) / radius
        v = (-dx * math.sin(turn) + dy * math.cos(turn)) / radius
        # Edges that face the sonar, near and far, send more of the sound back.
        line = (dx * x0 + dy * y0) / (np.maximum(np.hypot(dx, dy), 1e-6) * item.ground_m)
        facing = scene.fading.specular_db * (np.abs(line) - 0.5)
        place = Place(u, v, np.hypot(u, v), line, facing, radius)
        canvas = Canvas(place, number, level[box], owner[box], height[box], relief[box])
        draw_thing(item, scene, canvas)
        mine = canvas.owner == number
        if raised is not None and self._lifted is not None:
            canvas.level[mine] += raised.lit_db(scene.fading.specular_db)[mine]
            self._lifted[box][mine] = raised.lifted_m[mine]
        if item.silted and self._silt is not None:
            silt = silt_over(self._silt[box], mine, item.silted)
            canvas.level += silt * (canvas.texture - canvas.level)
            canvas.owner[silt > 0.5] = -1

    def _relieve(
        self, level: np.ndarray, height: np.ndarray, relief: np.ndarray, owner: np.ndarray
    ) -> None:
        """Raise bumps and ripples; lighten and darken slopes that face the sonar and turn from it.

        Then lay twigs, and patches of light and shade, over all.
        """
        floor, grid, cells = self._scene.floor, self._grid, self._grid.cells
        if relief.any():
            rng = np.random.default_rng([self._scene.seed, 6])
            noise = smooth_noise(rng, relief.shape, cells(floor.relief_size_m))
            height += relief * np.where(relief < 0, -np.abs(noise), noise)
        if floor.ripple_height_m:
            height += ripples(self._scene, grid, owner < 0)
        if relief.any() or floor.ripple_height_m:
            if isinstance(grid, PolarGrid):
                ground = grid.ground_m
                grazing = np.arctan(np.float32(self._scene.sonar.height_m) / ground)
                run = np.gradient(ground, axis=0)  # 0 where there is water alone
                slope = np.divide(
                    np.gradient(height, axis=0), run, out=np.zeros_like(height), where=run > 0
                )
                level += 20 * np.log10(_lit(grazing, slope))
            else:
                up, right = np.gradient(height, np.float32(grid.cell_m))
                self._rise = right.ravel(), up.ravel()
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

    def _shadow(self, height: np.ndarray) -> np.ndarray:
        """Cells hidden behind something taller; of squares, which `view` looks at, none."""
        if isinstance(self._grid, SquareGrid):
            return np.zeros(self._shape, bool)
        return _hidden(self._scene.sonar.height_m - height, self._grid.ground_m)

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

    def view(self, range_m: FloatArray, pose: Pose, turned: Sequence[float]) -> View:
        """What lies before the sonar at slant ranges (bins,), seen from where it is now.

        turned: (4,) how far the scatterers' phases have turned, as self._turn counts them.
        """
        grid = self._grid
        azimuth = grid.azimuths(pose.pan_deg)
        if pose.roll_deg or self._plane.slope_deg:
            look = self._plane.look(pose, range_m, azimuth)
            depression, sine = look.depression_deg, look.sine
            ground = range_m[:, None] * np.cos(np.radians(depression))
            cell = grid.index(look.x_m, look.y_m)
        else:
            height_m = pose.height_m
            sine = np.minimum(height_m / np.maximum(range_m, 1e-6), 1.0)[:, None]
            depression = np.degrees(np.arcsin(sine))
            sine = np.where(range_m[:, None] > height_m, sine, 0.0)
            ground = np.sqrt(np.maximum(range_m**2 - height_m**2, 0))[:, None]
            if isinstance(grid, PolarGrid) and (pose.x_m, pose.y_m) == (0.0, 0.0):
                cell = grid.index_from_origin(ground, azimuth)
            else:
                x = ground * np.sin(np.radians(azimuth)) + pose.x_m
                y = ground * np.cos(np.radians(azimuth)) + pose.y_m
                cell = grid.index(x, y)

        # `take`, here and below: four times as quick as rate[cell].
        phase = np.zeros(cell.shape, dtype=np.float32)
        for rate, amount in zip(self._turn, turned, strict=True):
            if amount:
                phase += rate.take(cell) * np.float32(amount)
        scatter = self._scatter.view(np.complex64)[:, 0].take(cell)
        spin = np.empty(cell.shape, dtype=np.complex64)
        spin.real, spin.imag = np.cos(phase), np.sin(phase)
        amplitude = self._amplitude.take(cell)
        glow = self._glow.take(cell)
        if isinstance(grid, SquareGrid):
            amplitude = amplitude * self._seen_now(cell, pose, azimuth, ground)
        echoes = scatter * spin * amplitude
        if isinstance(grid, SquareGrid):
            echoes *= grid.evened(ground.mean(axis=1, keepdims=True)).astype(np.float32)
        return View(azimuth, echoes, glow, amplitude**2, depression, sine)

    def _seen_now(
        self, cell: np.ndarray, pose: Pose, azimuth_deg: FloatArray, ground: FloatArray
    ) -> np.ndarray | float:
        """Amplitude that light and shadow leave of each cell of squares, seen from a pose."""
        if self._height is None:
            return 1.0
        near = np.maximum(ground, 1e-3).astype(np.float32)
        shaded = np.where(
            _hidden(np.float32(pose.height_m) - self._height.take(cell), near),
            np.float32(10 ** (self._scene.noise.shadow_db / 20)),
            np.float32(1),
        )
        if self._rise is None:
            return shaded
        azimuth = np.radians(azimuth_deg).astype(np.float32)
        slope = self._rise[0].take(cell) * np.sin(azimuth)
        slope += self._rise[1].take(cell) * np.cos(azimuth)
        return np.asarray(shaded * _lit(np.arctan(np.float32(pose.height_m) / near), slope))


def _hidden(below_m: np.ndarray, ground_m: np.ndarray) -> np.ndarray:
    """Cells, near ones first, behind something taller: a ray over every nearer top clears them.

    below_m: how far below the sonar each top is. ground_m: of the cells.
    """
    # Depression of the line over each cell's top; what is nearer must not lie flatter.
    slope = below_m / ground_m
    flattest = np.minimum.accumulate(slope, axis=0)
    return np.asarray(slope > flattest + 1e-4)


def _lit(grazing: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Amplitude of a slope that rises away from the sonar, to level floor: Lambert's law.

    Sent there and back it is the square of the sine, in power. grazing: of the floor, rad.
    """
    lit = np.sin(np.clip(grazing + np.arctan(slope), 0.02, np.pi / 2))
    return np.asarray(lit / np.sin(grazing))
