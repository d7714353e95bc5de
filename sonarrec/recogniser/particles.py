"""The groups of particles of stage 2, as tables with a row for each group."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Self

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, FloatArray, FloatImage, IndexArray, IntArray
from sonarrec.config import Continuity

Rows = BoolArray | IndexArray
"""Which rows to take, in which order: a mask, or indices."""


@dataclass(slots=True)
class Table:
    """Arrays with a row for each of n objects."""

    numbers: IntArray
    """(n,) of the groups, stable over frames."""
    places: FloatArray
    """(n, 2) working pixels: where each was last a candidate, moved with the floor since. Unlike
    the particles, they leave the fan with their object."""
    existence: FloatArray
    """(n,) probability that there is an object, 0 to 1."""
    sight_deg: FloatArray
    """(n,) deg, rotation over the floor of the line of sight to it since the group began."""

    def __len__(self) -> int:
        return len(self.numbers)

    def take(self, rows: Rows) -> Self:
        """The table with these rows alone; where a mask takes all, the table itself."""
        if rows.dtype == bool and rows.all():
            return self
        return type(self)(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(slots=True)
class ParticleGroups(Table):
    """The groups in view, a row each."""

    strikes: IntArray
    """(n,) frames in which the group was too wide, counted as Continuity.count_strikes says."""
    particles: npt.NDArray[np.float32]
    """(n, particles, 2) working pixels."""

    @classmethod
    def around(
        cls,
        numbers: IntArray,
        places: FloatArray,
        existence: FloatArray,
        sight_deg: FloatArray,
        count: int,
        sigma: float,
        rng: np.random.Generator,
    ) -> Self:
        """New groups of `count` particles, normally distributed round each of (n, 2) positions.

        sigma: standard deviation along each axis, pixels.
        """
        cloud = rng.standard_normal((len(places), count, 2), np.float32) * np.float32(sigma)
        particles = cloud + places[:, None].astype(np.float32)
        strikes = np.zeros(len(places), np.int64)
        return cls(numbers, places, existence, sight_deg, strikes, particles)

    def walk(self, sigma: float, rng: np.random.Generator) -> None:
        """Eq. 3: every particle takes a random step, Gaussian, `sigma` pixels in each axis."""
        noise = rng.standard_normal(self.particles.shape, np.float32)
        self.particles += noise * np.float32(sigma)

    def mean(self) -> npt.NDArray[np.float32]:
        """(n, 2) the particles' mean. A product, since mean(axis=1) takes twenty times as long."""
        count = self.particles.shape[1]
        return np.asarray((np.full((1, count), 1 / count, np.float32) @ self.particles)[:, 0])

    def weigh(self, score_map: FloatImage, config: Continuity) -> FloatArray:
        """Eq. 4: (n, particles) weights from the score map; each group's sum to 1."""
        if len(self) == 0:  # OpenCV refuses empty maps
            return np.empty(self.particles.shape[:2])
        # Outside the image nothing is hit.
        column, row = self.particles.transpose(2, 0, 1)
        hit = cv2.remap(score_map, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        likely = (hit ** np.float32(config.hit_power)).astype(float)
        if config.p_hit == "normalised":
            total = likely.sum(axis=1, keepdims=True)
            np.divide(likely, total, out=likely, where=total > 0)
        weight = config.z_hit * likely + config.z_rand / self.particles.shape[1]
        weight /= weight.sum(axis=1, keepdims=True)
        return np.asarray(weight)

    def weighted(self, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 2) weighted means and standard deviations, in pixels. weight: from `weigh`."""
        mean = (weight[:, None] @ self.particles)[:, 0]
        offset = self.particles - mean[:, None]
        return mean, np.sqrt((weight[:, None] @ offset**2)[:, 0])

    def resample(self, weight: FloatArray, rng: np.random.Generator) -> None:
        """Systematic resampling: as many particles again, drawn by their weights.

        Ticks lie 1 / particles apart on the cumulative weight, from a random start. A particle is
        drawn once for every tick in its share.
        """
        groups, n = weight.shape
        ticks = np.ceil(np.cumsum(weight, axis=1) * n - rng.random((groups, 1)))
        drawn = ticks.clip(0, n).astype(np.intp)
        drawn[:, -1] = n  # whatever rounding left
        drawn[:, 1:] -= drawn[:, :-1].copy()
        flat = self.particles.reshape(-1, 2)
        self.particles = np.repeat(flat, drawn.ravel(), axis=0).reshape(groups, n, 2)


@dataclass(slots=True)
class LostGroups(Table):
    """Groups that left the view; `places` are their positions now, outside it."""

    frames_left: IntArray
    """(n,) frames for which each is still remembered."""
    drift: FloatArray
    """(n,) variance of the position, in disc diameters squared."""
    missed: IntArray
    """(n,) frames in which its position was in view but it was no candidate."""
