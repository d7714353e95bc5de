"""The particles of stage 2, of many groups at once."""

from __future__ import annotations

import cv2
import numpy as np

from sonarrec.arrays import FloatArray, FloatImage
from sonarrec.config import Continuity
from sonarrec.recogniser.plane import as_complex


class Particles:
    """What happens to the particles of n groups, (n, particles, 2) float32 each time.

    They are (column, row) in working pixels.
    """

    def __init__(self, config: Continuity, rng: np.random.Generator) -> None:
        self._config, self._rng = config, rng
        self._share = np.full((1, config.particles), 1 / config.particles, np.float32)

    def around(self, positions: FloatArray, sigma: float) -> FloatImage:
        """Particles normally distributed round each of (n, 2) positions.

        sigma: standard deviation along each axis, pixels.
        """
        return self.walked(np.asarray(positions, np.float32)[:, None], sigma)

    def walked(self, particles: FloatImage, sigma: float) -> FloatImage:
        """Eq. 3: every particle takes a random step, Gaussian, `sigma` pixels in each axis."""
        noise = self._rng.standard_normal((len(particles), self._config.particles, 2), np.float32)
        noise *= np.float32(sigma)
        noise += particles
        return noise

    def mean(self, particles: FloatImage) -> FloatImage:
        """(n, 2) their mean. A product, since mean(axis=1) takes twenty times as long."""
        return np.asarray((self._share @ particles)[:, 0])

    def weigh(self, particles: FloatImage, score_map: FloatImage, step: int = 1) -> FloatArray:
        """Eq. 4: (n, particles) weights from the score map; each group's sum to 1.

        step: as in Selection.
        """
        config = self._config
        if len(particles) == 0:  # OpenCV refuses empty maps
            return np.empty(particles.shape[:2])
        where = particles
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

    def resampled(self, particles: FloatImage, weight: FloatArray) -> FloatImage:
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
        again = np.repeat(as_complex(particles).ravel(), drawn.ravel())
        return again.view(np.float32).reshape(groups, n, 2)


def weighted(particles: FloatImage, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 2) weighted means and standard deviations, in pixels. weight: from `weigh`."""
    mean = (weight[:, None] @ particles)[:, 0]
    # In one piece: subtracting along the last axis of two takes four times as long.
    offset = as_complex(particles) - as_complex(mean.astype(np.float32))[:, None]
    square = np.square(offset.view(np.float32), out=offset.view(np.float32))
    return mean, np.sqrt((weight[:, None] @ square.reshape(particles.shape))[:, 0])
