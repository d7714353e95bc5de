"""Stage 2: continuity evaluation with a particle filter (Section 3.3, Eq. 3 and 4).

Each candidate gets a group of particles that walk at random and gather where the score map of
stage 1 is high. A group that stays spread is no object and is deleted; the mean of a group is
the object's position.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.config import Continuity
from sonarrec.recogniser.plane import Plane
from sonarrec.records import FloatArray, Groups, Motion, Selection

NEW_EXISTENCE = 0.5  # of a group that has just begun


class _Lost:
    """Groups that left the view: where they would be seen, should it return to them."""

    def __init__(self) -> None:
        self.numbers = np.empty(0, np.int64)
        self.positions: FloatArray = np.empty((0, 2))
        self.existence: FloatArray = np.empty(0)
        self.frames_left = np.empty(0, np.int64)
        self.missed = np.empty(0, np.int64)

    def add(
        self,
        numbers: npt.NDArray[np.int64],
        positions: FloatArray,
        existence: FloatArray,
        frames: int,
    ) -> None:
        self.numbers = np.append(self.numbers, numbers)
        self.positions = np.concatenate([self.positions, positions])
        self.existence = np.append(self.existence, existence)
        self.frames_left = np.append(self.frames_left, np.full(len(numbers), frames))
        self.missed = np.append(self.missed, np.zeros(len(numbers), np.int64))

    def keep(self, kept: npt.NDArray[np.bool_]) -> None:
        self.numbers, self.positions = self.numbers[kept], self.positions[kept]
        self.existence, self.frames_left = self.existence[kept], self.frames_left[kept]
        self.missed = self.missed[kept]

    def pass_frame(self, in_view: npt.NDArray[np.bool_], strikes: int) -> None:
        """Forget those that were away too long, and those that do not show where they should."""
        self.frames_left -= 1
        self.missed += in_view
        self.keep((self.frames_left > 0) & (self.missed <= strikes))

    def recall(self, distance: FloatArray, most: float) -> tuple[npt.NDArray[np.int64], FloatArray]:
        """(n,) numbers and existence of what n newly seen objects are; number 0: none of these.

        distance: (n, m) between the new and the lost. The nearest pair goes first.
        """
        numbers = np.zeros(len(distance), np.int64)
        existence: FloatArray = np.full(len(distance), NEW_EXISTENCE)
        distance = distance.copy()
        while distance.size and distance.min() <= most:
            new, old = np.unravel_index(distance.argmin(), distance.shape)
            numbers[new], existence[new] = self.numbers[old], self.existence[old]
            distance[new], distance[:, old] = np.inf, np.inf
        self.keep(~np.isin(self.numbers, numbers))
        return numbers, existence


class ContinuityFilter:
    """The particle groups of all objects in view."""

    def __init__(self, config: Continuity, plane: Plane, rng: np.random.Generator) -> None:
        self._config = config
        self._rng = rng
        self._plane = plane
        self._sigma = config.sigma_px * plane.scale
        self._sigma_known = config.sigma_known_px * plane.scale
        self._diameter = 2 * np.array(plane.axes)
        self._share = plane.disc_share()
        self._next = 1
        self._numbers = np.empty(0, np.int64)
        self._strikes = np.empty(0, np.int64)
        self._existence = np.empty(0)
        self._particles = np.empty((0, config.particles, 2), np.float32)
        # Where each was last a candidate, moved with the floor: at the fan's edge, where the score
        # map ends, particles hang on when their object has gone.
        self._places: FloatArray = np.empty((0, 2))
        self._lost = _Lost()

    def step(self, selection: Selection, motion: Motion | None = None) -> Groups:
        """Predict, weigh and resample every group; delete the dead, begin the new.

        motion: of the sonar since the last frame; None where unknown.
        """
        config = self._config
        self._predict(motion)
        expected = _mean(self._particles)
        positions, spread = self._weigh(selection.score_map)
        hit = np.any(self._distances(positions, selection.positions) < config.merge, axis=1)
        count = len(positions)
        pulled = np.zeros(count, bool)
        if motion is None:
            self._places = positions
            self._lost = _Lost()  # nobody knows where they are now
        else:
            # The floor does not move: a group pulled this far has left its object for another.
            moved = np.hypot(*((positions - expected) / self._diameter).T)
            pulled = moved > config.jump
            places = np.concatenate([self._places, self._lost.positions])
            places = self._plane.moved(places, motion)
            self._places, self._lost.positions = places[:count], places[count:]
            there = hit & ~pulled
            self._places[there] = positions[there]
        share = self._shares(np.concatenate([self._places, self._lost.positions]))
        in_view = share[:count] >= config.least_in_view
        self._count(spread, hit, in_view)
        alive = self._survivors(pulled & in_view)
        if motion is not None:
            self._lost.pass_frame(share[count:] > 0.9, config.strikes)
            left = alive & ~in_view
            if left.any():
                self._lost.add(
                    self._numbers[left],
                    self._places[left],
                    self._existence[left],
                    config.remember_frames,
                )
        alive &= in_view
        self._keep(alive)
        born = self._begin(positions[alive], selection)
        positions = np.concatenate([positions[alive], born])
        spread = np.concatenate(
            [spread[alive], np.full((len(born), 2), self._sigma) / self._diameter]
        )
        order = np.argsort(self._numbers)  # those that came back go to their old place
        self._keep(order)
        return Groups(
            self._numbers.copy(),
            positions[order],
            spread[order],
            self._existence.copy(),
            self._lost.numbers.copy(),
        )

    def _predict(self, motion: Motion | None) -> None:
        """Eq. 3: a random walk; where the sonar's own motion is known a narrower one round it."""
        sigma = self._sigma
        if motion is not None:
            self._particles = self._plane.moved(self._particles, motion).astype(np.float32)
            sigma = self._sigma_known
        noise = self._rng.standard_normal(self._particles.shape, np.float32)
        self._particles += noise * np.float32(sigma)

    def _weigh(self, score_map: npt.NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
        """Eq. 4, and resampling.

        Returns the weighted means (n, 2) in pixels and spreads (n, 2) in disc diameters.
        """
        config = self._config
        groups, n = self._particles.shape[:2]
        if groups == 0:
            return np.empty((0, 2)), np.empty((0, 2))
        # Outside the image nothing is hit.
        column, row = self._particles.transpose(2, 0, 1)
        hit = cv2.remap(score_map, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        likely = hit ** np.float32(config.hit_power)
        weight = config.z_hit * likely.astype(float) + config.z_rand / n
        weight /= weight.sum(axis=1, keepdims=True)
        mean = (weight[:, None] @ self._particles)[:, 0]
        offset = self._particles - mean[:, None]
        spread = np.sqrt((weight[:, None] @ offset**2)[:, 0]) / self._diameter
        # Systematic resampling: a particle is drawn once for every tick that falls into its share
        # of the cumulative weight; the ticks are 1 / n apart from a random start.
        ticks = np.ceil(np.cumsum(weight, axis=1) * n - self._rng.random((groups, 1)))
        drawn = ticks.clip(0, n).astype(np.intp)
        drawn[:, -1] = n  # whatever rounding left
        drawn[:, 1:] -= drawn[:, :-1].copy()
        self._particles = np.repeat(self._particles.reshape(-1, 2), drawn.ravel(), axis=0).reshape(
            groups, n, 2
        )
        return mean, spread

    def _count(
        self, spread: FloatArray, hit: npt.NDArray[np.bool_], in_view: npt.NDArray[np.bool_]
    ) -> None:
        """Strikes for spread groups, and the Bayes filter of existence from hits and misses.

        What is out of view is missed without telling anything.
        """
        config = self._config
        wide = (spread > config.spread_limit).any(axis=1)
        self._strikes = np.where(wide, self._strikes + 1, 0)
        there = self._existence * np.where(hit, config.p_hit_object, 1 - config.p_hit_object)
        clutter = (1 - self._existence) * np.where(
            hit, config.p_hit_clutter, 1 - config.p_hit_clutter
        )
        existence = np.clip(there / (there + clutter), 0.01, 0.99)
        self._existence = np.where(in_view, existence, self._existence)

    def _survivors(self, astray: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Groups that are still believed in, but those astray."""
        config = self._config
        alive = (self._strikes < config.strikes) & (self._existence >= config.min_existence)
        alive &= ~astray
        # Groups are in order of age: of two on one object the older stays.
        near = np.tril(self._distances(self._places, self._places) < config.merge, k=-1)
        return np.asarray(alive & ~(near & alive[None, :]).any(axis=1))

    def _shares(self, positions: FloatArray) -> FloatArray:
        """(n,) share of the disc inside the fan; -1 beyond the image."""
        column, row = np.rint(positions).astype(int).T
        rows, columns = self._share.shape
        within = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        share = self._share[row.clip(0, rows - 1), column.clip(0, columns - 1)]
        return np.where(within, share, -1.0)

    def _keep(self, alive: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> None:
        self._numbers = self._numbers[alive]
        self._strikes = self._strikes[alive]
        self._existence = self._existence[alive]
        self._places = self._places[alive]
        self._particles = self._particles[alive]

    def _begin(self, positions: FloatArray, selection: Selection) -> FloatArray:
        """Start a group round every candidate that no group has. Returns their (n, 2) centres."""
        far = self._distances(selection.positions, positions) > self._config.new_group
        born = selection.positions[far.all(axis=1)]
        if len(born) == 0:
            return born
        shape = (len(born), self._particles.shape[1], 2)
        cloud = self._rng.standard_normal(shape, np.float32) * np.float32(self._sigma)
        self._particles = np.concatenate(
            [self._particles, cloud + born[:, None].astype(np.float32)]
        )
        numbers, existence = self._lost.recall(
            self._distances(born, self._lost.positions), self._config.recall
        )
        new = numbers == 0
        numbers[new] = self._next + np.arange(np.count_nonzero(new))
        self._next += int(np.count_nonzero(new))
        self._numbers = np.append(self._numbers, numbers)
        self._strikes = np.append(self._strikes, np.zeros(len(born), np.int64))
        self._existence = np.append(self._existence, existence)
        self._places = np.concatenate([self._places, born])
        return born

    def _distances(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """(len(a), len(b)) distances in disc diameters, as measured on the disc's own ellipse."""
        offset = (a[:, None] - b[None]) / self._diameter
        return np.asarray(np.hypot(offset[..., 0], offset[..., 1]))


def _mean(particles: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """(n, 2) of (n, particles, 2). As a product: mean(axis=1) takes twenty times as long."""
    count = particles.shape[1]
    return np.asarray((np.full((1, count), 1 / count, np.float32) @ particles)[:, 0])
