"""The particles of stage 2: a row for each group."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.arrays import FloatArray, FloatImage
from sonarrec.config import Continuity
from sonarrec.recogniser.plane import as_complex


class Particles:
    """n groups of as many particles each.

    positions: (n, particles, 2) float32, (column, row) in working pixels.
    """

    def __init__(self, config: Continuity, rng: np.random.Generator) -> None:
        self._config, self._rng = config, rng
        self._share: npt.NDArray[np.float32] = np.full(
            (1, config.particles), 1 / config.particles, np.float32
        )
        self.positions: npt.NDArray[np.float32] = np.empty((0, config.particles, 2), np.float32)

    def begin(self, positions: FloatArray, sigma: float) -> None:
        """Add a group of normally distributed particles round each of (n, 2) positions.

        sigma: standard deviation along each axis, pixels.
        """
        cloud = self._noise(len(positions), sigma) + positions[:, None].astype(np.float32)
        self.positions = np.concatenate([self.positions, cloud])

    def keep(self, rows: Sequence[int]) -> None:
        """Keep these groups alone, in this order."""
        self.positions = self.positions[rows]

    def walk(self, sigma: float) -> None:
        """Eq. 3: every particle takes a random step, Gaussian, `sigma` pixels in each axis."""
        self.positions += self._noise(len(self.positions), sigma)

    def _noise(self, groups: int, sigma: float) -> npt.NDArray[np.float32]:
        shape = (groups, self._config.particles, 2)
        noise = self._rng.standard_normal(shape, np.float32)
        noise *= np.float32(sigma)
        return noise

    def mean(self) -> npt.NDArray[np.float32]:
        """(n, 2) the particles' mean. A product, since mean(axis=1) takes twenty times as long."""
        return np.asarray((self._share @ self.positions)[:, 0])

    def weigh(self, score_map: FloatImage, step: int = 1) -> FloatArray:
        """Eq. 4: (n, particles) weights from the score map; each group's sum to 1.

        step: as in Selection.
        """
        config = self._config
        if len(self.positions) == 0:  # OpenCV refuses empty maps
            return np.empty(self.positions.shape[:2])
        where = self.positions
        if step > 1:
            where = where * np.float32(1 / step)
            where += np.float32(0.5 / step - 0.5)
        # Outside the image nothing is hit.
        hit = cv2.remap(score_map, where, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
        if config.hit_power == 4:  # as usual: a tenth of the power's time
            np.square(np.square(hit, out=hit), out=hit)
        else:
            hit = hit ** np.float32(config.hit_power)
        likely = hit.astype(float)
        if config.p_hit == "normalised":
            total = likely.sum(axis=1, keepdims=True)
            np.divide(likely, total, out=likely, where=total > 0)
        likely *= config.z_hit
        likely += config.z_rand / config.particles
        likely /= likely.sum(axis=1, keepdims=True)
        return np.asarray(likely)

    def weighted(self, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 2) weighted means and standard deviations, in pixels. weight: from `weigh`."""
        mean = (weight[:, None] @ self.positions)[:, 0]
        # In one piece: subtracting along the last axis of two takes four times as long.
        offset = as_complex(self.positions) - as_complex(mean.astype(np.float32))[:, None]
        square = np.square(offset.view(np.float32), out=offset.view(np.float32))
        return mean, np.sqrt((weight[:, None] @ square.reshape(self.positions.shape))[:, 0])

    def resample(self, weight: FloatArray) -> None:
        """Systematic resampling: as many particles again, drawn by their weights.

        Ticks lie on the cumulative weight at steps of 1 / particles, from a random start. A
        particle is drawn once for every tick in its share.
        """
        groups, n = weight.shape
        ticks = weight.cumsum(axis=1)
        ticks *= n
        ticks -= self._rng.random((groups, 1))
        drawn = np.ceil(ticks, out=ticks).astype(np.intp)
        np.minimum(drawn, n, out=drawn)
        drawn[:, -1] = n  # whatever rounding left
        drawn[:, 1:] -= drawn[:, :-1].copy()
        flat = as_complex(self.positions).ravel()
        again = np.repeat(flat, drawn.ravel())
        self.positions = again.view(np.float32).reshape(groups, n, 2)
