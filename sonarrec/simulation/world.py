"""The simulator's world: a grid of scatterers on the floor, with everything that lies there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.simulation.grid import Cells, PolarGrid, SquareGrid, smooth_noise
from sonarrec.simulation.motion import Plane, Pose
from sonarrec.simulation.objects import Layers, draw_object, ripples
from sonarrec.simulation.scene import Scene

TWIG = 0.12  # half the thickness of debris, in units of the noise that shapes it
PATCHES = 6  # processes from which the fading of each place is mixed


@dataclass(frozen=True, slots=True)
class View:
    """The part of the world in front of the sonar, by slant range (bins) and azimuth (n)."""

    azimuth_deg: FloatArray
    """(n,) in the world."""
    echoes: np.ndarray
    """(bins, n) complex64 amplitude of each scatterer."""
    glow: np.ndarray
    """(bins, n) float32 power of the objects' afterglow."""
    power: np.ndarray
    """(bins, n) float32 mean power of each scatterer."""
    depression_deg: FloatArray
    sine: FloatArray
    """depression_deg, sine: (bins, 1) or (bins, n), as from Plane.look."""


class World:
    """All scatterers on the floor, with their brightness, height and owner.

    Every cell of the grid holds one complex Gaussian scatterer. When the sonar pans, the view moves
    along the grid and the speckle stays the same. Sway and heave turn the phases of the scatterers.
    Leaning discs are as seen from the floor's origin; on a polar grid, so are slopes and shadows.
    """

    def __init__(self, scene: Scene, grid: PolarGrid | SquareGrid) -> None:
        self._scene, self._grid, self._plane = scene, grid, Plane.of(scene)
        rng = np.random.default_rng([scene.seed, 1])
        level = scene.floor.texture_db * self._noise(scene.floor.texture_m, rng)
        silted = any(item.silted for item in scene.items)
        leaning = any(item.lean_deg for item in scene.items)
        none = np.broadcast_to(np.float32(0), grid.shape)
        layers = Layers(
            level=level,
            owner=np.full(grid.shape, -1, np.int16),
            height=np.zeros(grid.shape, np.float32),
            relief=np.full(grid.shape, scene.floor.relief_m, np.float32),
            lifted=none.copy() if leaning else none,
            silt=self._noise(scene.floor.silt_m, 13) if silted else none,
            glitter=self._glitter() if scene.floor.glitter_db else none,
        )
        for number, item in enumerate(scene.items):
            draw_object(item, number, scene, grid, layers)
        self._rise: tuple[np.ndarray, np.ndarray] | None = None  # where squares rise, x and y
        self._relieve(layers)
        if isinstance(grid, SquareGrid):  # there `view` finds the shadows
            self._height = layers.height.ravel() if layers.height.any() else None
            shadow, kernel = np.zeros(grid.shape, bool), (3, 3)
        else:  # what is hidden behind something taller, from the floor's origin
            self._height, kernel = None, (3, 1)
            top = layers.height + layers.lifted
            shadow = _hidden(scene.sonar.height_m - top, grid.ground_m)
        amplitude = np.power(np.float32(10), layers.level / 20)
        amplitude[shadow] *= 10 ** (scene.noise.shadow_db / 20)
        amplitude[grid.floorless] = 0
        # Blurred, so that edges are no sharper than the grid of scatterers.
        self._amplitude = np.asarray(cv2.blur(amplitude, kernel)).ravel()

        self._cells = np.flatnonzero((layers.owner >= 0) & ~shadow)
        self._owner = layers.owner.ravel()[self._cells]
        self._plain = self._amplitude[self._cells]
        mixed = [
            self._noise(scene.fading.patch_m, rng).ravel()[self._cells] for _ in range(PATCHES)
        ]
        self._mix = np.stack(mixed, axis=1) / np.float32(math.sqrt(PATCHES))
        self._glow = np.zeros(level.size, np.float32)
        self._scatter = rng.standard_normal((level.size, 2), dtype=np.float32)
        self._scatter *= np.float32(math.sqrt(0.5))
        # The four of a cell taken for one value, so that all are fetched at once.
        self._phase_rates = _phase_rates(level.size, rng).view(np.complex128)[:, 0]

    def _noise(self, size_m: float, source: np.random.Generator | int) -> np.ndarray:
        """Smooth noise over the grid. source: a generator, or the number of one for this alone."""
        rng = (
            np.random.default_rng([self._scene.seed, source]) if isinstance(source, int) else source
        )
        return smooth_noise(rng, self._grid.shape, self._grid.cells(size_m))

    def _glitter(self) -> np.ndarray:
        """By how much each cell is brighter where it is of gravel, dB: single stones reflect much
        more than the others, and few of them most."""
        floor = self._scene.floor
        stones = self._noise(floor.glitter_m, 16)
        above = np.maximum(stones - np.quantile(stones, 1 - floor.glitter_share), 0)
        mean = np.float32(above.mean() / floor.glitter_share)
        return np.asarray(np.float32(floor.glitter_db) * np.minimum(above / mean, 3))

    def _relieve(self, layers: Layers) -> None:
        """Add bumps and ripples, whose slopes are lit by the sonar; then twigs and shade."""
        floor, grid = self._scene.floor, self._grid
        level, height, relief = layers.level, layers.height, layers.relief
        rough = relief.any()
        if rough:
            noise = self._noise(floor.relief_size_m, 6)
            height += relief * np.where(relief < 0, -np.abs(noise), noise)
        if floor.ripple_height_m:
            height += ripples(self._scene, grid, layers.owner < 0)
        if rough or floor.ripple_height_m:
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
            bends, where = (self._noise(floor.debris_m, rng) for _ in range(2))
            # The zeros of smooth noise are winding lines; a second noise cuts them into pieces.
            twigs = np.exp(-((bends / TWIG) ** 2)) / (1 + np.exp(-where / TWIG))
            level += np.float32(floor.debris_db) * twigs.astype(np.float32)
        if floor.light_db:
            patches = self._noise(floor.light_m, 7)
            level -= np.float32(floor.light_db) / (1 + np.exp(-patches / 0.06))

    def fade(self, object_db: FloatArray, patches: FloatArray, afterglow_db: FloatArray) -> None:
        """Set the brightness of all objects for the next frame.

        object_db, afterglow_db: (objects,), landmarks first. patches: (PATCHES,) standard normal,
        from which the fading of patches is mixed.
        """
        if not len(self._cells):
            return
        fading = self._scene.fading
        patch = self._mix @ patches.astype(np.float32)
        # Reflections get much weaker at times, but hardly stronger.
        gain_db = np.minimum(object_db[self._owner] + fading.patch_db * patch, 4.0)
        # As a power of e: that of 10 takes four times as long.
        amplitude = self._plain * np.exp(gain_db.astype(np.float32) * (math.log(10) / 20))
        self._amplitude[self._cells] = amplitude
        glow = 10 ** ((fading.ghost_db + afterglow_db) / 10)
        self._glow[self._cells] = amplitude**2 * glow.astype(np.float32)[self._owner]

    def view(self, range_m: FloatArray, pose: Pose, drift: Sequence[float]) -> View:
        """The part of the world in front of the sonar.

        range_m: (bins,) slant ranges. drift: (4,) time, sway right, sway forward and heave so far,
        in the units of self._phase_rates.
        """
        grid = self._grid
        azimuth = grid.azimuths(pose.pan_deg)
        cell: Cells
        if pose.roll_deg or self._plane.slope_deg:
            x, y, depression, sine = self._plane.view(pose, range_m, azimuth)
            ground = range_m[:, None] * np.cos(np.radians(depression))
            cell = grid.index(x, y)
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

        scatter = self._values(self._scatter.view(np.complex64)[:, 0], cell)
        rates = self._values(self._phase_rates, cell).view(np.float32)
        phase = rates.reshape(*scatter.shape, len(drift)) @ np.asarray(drift, np.float32)
        spin = np.empty(phase.shape, dtype=np.complex64)
        spin.real, spin.imag = np.cos(phase), np.sin(phase)
        amplitude = self._values(self._amplitude, cell)
        glow = self._values(self._glow, cell)
        if isinstance(grid, SquareGrid):
            amplitude = amplitude * self._shade(cell, pose, azimuth, ground)
        echoes = scatter * spin * amplitude
        if isinstance(grid, SquareGrid):
            echoes *= grid.evened(ground.mean(axis=1, keepdims=True)).astype(np.float32)
        return View(azimuth, echoes, glow, amplitude**2, depression, sine)

    def _values(self, values: np.ndarray, cell: Cells) -> np.ndarray:
        """(bins, n) what the cells hold. values: one for each cell of the grid."""
        if isinstance(cell, tuple):
            return np.asarray(values.reshape(self._grid.shape)[cell])
        return np.asarray(values.take(cell))  # four times as fast as values[cell]

    def _shade(
        self, cell: Cells, pose: Pose, azimuth_deg: FloatArray, ground: FloatArray
    ) -> np.ndarray | float:
        """Factor on the amplitude of each cell by slopes and shadows; for grids of squares."""
        if self._height is None:
            return 1.0
        near = np.maximum(ground, 1e-3).astype(np.float32)
        shaded = np.where(
            _hidden(np.float32(pose.height_m) - self._values(self._height, cell), near),
            np.float32(10 ** (self._scene.noise.shadow_db / 20)),
            np.float32(1),
        )
        if self._rise is None:
            return shaded
        azimuth = np.radians(azimuth_deg).astype(np.float32)
        slope = self._values(self._rise[0], cell) * np.sin(azimuth)
        slope += self._values(self._rise[1], cell) * np.cos(azimuth)
        return np.asarray(shaded * _lit(np.arctan(np.float32(pose.height_m) / near), slope))


def _phase_rates(scatterers: int, rng: np.random.Generator) -> np.ndarray:
    """(scatterers, 4) rates of the phases by time, sway right, sway forward and heave.

    The mean of exp(i phase) is the speckle's correlation: exp(-time) for Cauchy rates,
    exp(-distance^2 / 2) for Gaussian ones.
    """
    rate = np.empty((scatterers, 4), np.float32)
    for column in rate.T:
        column[:] = rng.standard_normal(scatterers, dtype=np.float32)
    with np.errstate(divide="ignore"):  # division by 0 gives a huge rate, clipped below
        rate[:, 0] /= rng.standard_normal(scatterers, dtype=np.float32)
    return np.clip(rate, -100, 100, out=rate)


def _hidden(below_m: np.ndarray, ground_m: np.ndarray) -> np.ndarray:
    """Whether each cell is hidden behind a nearer and taller one. Rows are near ones first.

    below_m: how far the top of each cell is below the sonar. ground_m: range of the cells.
    """
    # The slope of the line of sight to each top. A nearer top with a flatter line hides the cell.
    slope = below_m / ground_m
    flattest = np.minimum.accumulate(slope, axis=0)
    return np.asarray(slope > flattest + 1e-4)


def _lit(grazing: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Amplitude of a slope relative to level floor, by Lambert's law, there and back.

    grazing: angle on level floor, rad. slope: rise over run, with growing range.
    """
    lit = np.sin(np.clip(grazing + np.arctan(slope), 0.02, np.pi / 2))
    return np.asarray(lit / np.sin(grazing))
