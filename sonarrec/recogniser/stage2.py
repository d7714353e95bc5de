"""Stage 2: continuity evaluation with a particle filter (Section 3.3, Eq. 3 and 4).

Each candidate gets a group of particles that walk at random and gather where the score map of
stage 1 is high; the mean of a group is the object's position. A group is deleted for one of five
reasons:

1. spread out: it was too wide in some frames (the paper's only rule);
2. unlikely: its object was too seldom a candidate to exist;
3. astray: the sonar's motion is known, and the group left the position that follows from it;
4. merged: it met an older group, which keeps the object;
5. out of view: too little of its disc is inside the fan. If the sonar's motion is known, a group
   that is just coming in stays.

If the sonar's motion is known, a group that was deleted only because it is out of view is
remembered. A candidate near its position gets its number again. The group is forgotten if it was
out of view too long, if it did not show where it should, or if the motion is no longer known.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, FloatImage, IntArray, Table
from sonarrec.config import Continuity
from sonarrec.recogniser.plane import Plane, as_complex
from sonarrec.recogniser.tracks import Tracks
from sonarrec.sonar.frame import Motion, Selection

NEW_EXISTENCE = 0.5  # probability of existence of a group that has just begun
FULLY_VISIBLE = 0.9  # share of a disc in view from which on its object should be a candidate
# What follows was set by hand on simulated recordings; distances are in disc diameters. Where the
# motion is known, a group this far from where it should have taken it has left its object, and is
# deleted, or remembered where it is out of view.
JUMP = 0.25
# A candidate this near to where the motion takes a group's object is the group's own; particles
# nearer to another candidate do not count.
OWN_CANDIDATE = 0.2
# Existence: an object in view is a candidate in a frame, and an empty position is one again.
P_HIT_OBJECT, P_HIT_CLUTTER = 0.9, 0.4
# A candidate within RECALL of where the motion takes a remembered group may be its object. RECALL
# grows, to RECALL_MOST, by twice the standard error of that position, to which every frame adds
# RECALL_DRIFT. One of which less than RECALL_IN_VIEW, a share of the disc, is in the fan waits.
RECALL, RECALL_DRIFT, RECALL_MOST, RECALL_IN_VIEW = 0.2, 0.02, 0.5, 0.5
REPORTED = ("number", "position", "spread", "existence", "sight_deg", "shown")


class ContinuityFilter:
    """Follows all objects in view, each by a group of particles.

    Its columns of the tracks:

    particles: (n, particles, 2) float32, working pixels, as all positions. position: (n, 2) the
    particles' weighted mean. spread: (n, 2) their standard deviation per axis, in disc diameters.
    object_position: (n, 2) where the object was last a candidate, moved with the floor since;
    unlike the particles it leaves the fan with its object. existence: (n,) probability of an
    object, 0 to 1. sight_deg: (n,) by how many degrees, counter-clockwise seen from above, the line
    of sight to it has rotated over the floor since the track began; 0 if the sonar only pans.
    shown: (n,) whether enough of the disc is inside the fan (continuity.least_in_view); one that
    comes in shows less at first. too_wide: (n,) frames in which the group was too wide, counted as
    count_strikes says.

    Of a remembered track: frames_left: (n,) for which it is still remembered. drift: (n,) variance
    of object_position, in disc diameters squared. missed: (n,) frames in which that was in view but
    no candidate.
    """

    def __init__(
        self, config: Continuity, plane: Plane, tracks: Tracks, rng: np.random.Generator
    ) -> None:
        self._config = config
        self._plane = plane
        self._sigma = config.sigma_px * plane.scale
        self._sigma_known = config.sigma_known_px * plane.scale
        # A candidate's position is known far better than a particle's random step. A group that
        # began as wide as that would move to neighbouring peaks before it has converged.
        self._sigma_new = self._sigma if config.motion == "random_walk" else self._sigma_known
        self._diameter = 2 * np.array(plane.axes)
        # The border stands for all positions beyond the image.
        self._share = cv2.copyMakeBorder(
            plane.disc_share(), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=-1
        ).astype(float)
        self._particles = Particles(config, rng)
        self._tracks = tracks
        tracks.declare(
            particles=np.zeros((config.particles, 2), np.float32),
            position=np.zeros(2),
            spread=self._sigma_new / self._diameter,
            object_position=np.zeros(2),
            existence=NEW_EXISTENCE,
            sight_deg=0.0,
            shown=False,
            too_wide=0,
            frames_left=0,
            drift=0.0,
            missed=0,
        )

    def step(self, selection: Selection, motion: Motion | None = None) -> Table:
        """The tracks in view after one frame, with the columns REPORTED.

        motion: of the sonar since the last frame; one that is not known is as good as None.
        """
        tracks, step = self._tracks, self._particles
        if motion is None or not motion.known:
            motion = None
            tracks.keep(~tracks["remembered"])  # their objects are no longer known
        rows = tracks.in_view
        # Predict (Eq. 3): a random walk; a narrower one, after the sonar's motion, if it is known.
        particles, before = tracks["particles"][rows], tracks["object_position"][rows]
        sigma = self._sigma
        if motion is not None:
            particles = self._plane.moved(particles, motion)
            self._apply_motion(motion)
            sigma = math.hypot(self._sigma_known, self._uncertain(motion))
        particles = step.walked(particles, sigma)
        expected = step.mean(particles)
        # Weigh (Eq. 4), and resample.
        weight = step.weigh(particles, selection.score_map, selection.step)
        if motion is not None:
            objects = tracks["object_position"][rows]
            weight = self._without_neighbours(particles, weight, objects, selection.positions)
        position, spread = weighted(particles, weight)
        tracks["particles"][rows] = step.resampled(particles, weight)
        tracks["position"][rows], tracks["spread"][rows] = position, spread / self._diameter
        # Count hits and misses.
        near = self._distances(position, selection.positions) < self._config.merge
        hit = np.asarray(near.any(axis=1))
        astray = self._astray(position - expected, motion)
        own = hit & ~astray if motion is not None else np.ones(len(rows), bool)
        tracks["object_position"][rows[own]] = position[own]
        in_view = self._in_view(rows, before, hit, motion)
        self._count_misses(rows, hit, in_view)
        self._delete(rows, astray, in_view, motion)
        self._begin(selection.positions)
        return self._reported()

    def centre(self) -> Table:
        """Shift the groups in view to their `position`, which was measured more exactly.

        Returns as `step`.
        """
        tracks, rows = self._tracks, self._tracks.in_view
        tracks["object_position"][rows] = tracks["position"][rows]
        shift = tracks["position"][rows] - self._particles.mean(tracks["particles"][rows])
        tracks["particles"][rows] += shift[:, None].astype(np.float32)
        return self._reported()

    def _reported(self) -> Table:
        rows = self._tracks.in_view
        return Table(**{name: self._tracks[name][rows] for name in REPORTED})

    def _without_neighbours(
        self, particles: FloatArray, weight: FloatArray, objects: FloatArray, candidates: FloatArray
    ) -> FloatArray:
        """(n, particles) weights, 0 for particles that are nearer to a neighbour's candidate.

        A group's own candidate is the one near its object's expected place, (n, 2). Where the
        circle of another candidate overlaps that of its own (false rings of a blotchy floor),
        particles beyond the middle between the two do not count, else the broader peak would
        attract the group.
        """
        if not len(objects) or len(candidates) < 2:
            return weight
        distance = self._distances(objects, candidates)
        if ((distance < 1 + OWN_CANDIDATE).sum(axis=1) < 2).all():
            return weight  # as usual
        near = distance.min(axis=1, keepdims=True) <= OWN_CANDIDATE
        own = np.where(near, candidates[distance.argmin(axis=1)], objects)
        distance = self._distances(own, candidates)
        neighbours = (distance > OWN_CANDIDATE) & (distance < 1)
        if not neighbours.any():
            return weight
        group, candidate = np.nonzero(neighbours)
        # Which side of the perpendicular bisector a particle is on, in disc diameters.
        way = (candidates[candidate] - own[group]) / self._diameter**2
        middle = (candidates[candidate] + own[group]) / 2
        off = particles[group] - middle[:, None].astype(np.float32)
        nearer = np.zeros(weight.shape, bool)
        np.logical_or.at(nearer, group, (off @ way[:, :, None].astype(np.float32))[..., 0] > 0)
        kept = np.where(nearer, 0.0, weight)
        total = kept.sum(axis=1, keepdims=True)
        return np.where(total > 0, kept / np.maximum(total, 1e-12), weight)

    def _astray(self, moved: FloatArray, motion: Motion | None) -> BoolArray:
        """Which groups are too far from where the motion expects them. moved: (n, 2) by how far.

        Objects on the floor do not move, so such a group has left its object for another.
        """
        if motion is None:
            return np.zeros(len(moved), bool)
        farthest = JUMP + 2 * self._uncertain(motion) / self._diameter[0]
        return np.asarray(np.hypot(*(moved / self._diameter).T) > farthest)

    def _in_view(
        self, rows: IntArray, before: FloatArray, hit: BoolArray, motion: Motion | None
    ) -> BoolArray:
        """Which groups are in view: they show enough of the disc, or are just coming in.

        Fills the column `shown`. before: objects in the last frame.
        """
        tracks = self._tracks
        share = self._visible_share(tracks["object_position"][rows])
        if motion is not None:
            # At the fan's edge particles may stay behind their object, or leave before it.
            share = np.minimum(share, self._visible_share(tracks["position"][rows]))
        tracks["shown"][rows] = shown = share >= self._config.least_in_view
        if motion is None or shown.all():
            return shown
        return shown | (hit & (share > self._visible_share(before)))

    def _uncertain(self, motion: Motion) -> float:
        """Standard error in pixels, at the middle of the window, of positions after a motion.

        0 after a pan alone, whose error sigma_known_px covers.
        """
        if not (motion.right_m or motion.ahead_m):
            return 0.0
        fan = self._plane.fan
        by_pan = math.radians(motion.pan_sigma_deg) * (fan.range_min_m + fan.range_max_m) / 2
        return self._pixels(math.hypot(by_pan, motion.right_sigma_m, motion.ahead_sigma_m))

    def _pixels(self, metres: float) -> float:
        """A length on the floor in working pixels."""
        return metres * self._plane.scale / self._plane.fan.metres_per_pixel

    def _apply_motion(self, motion: Motion) -> None:
        """Move objects by the sonar's motion, and rotate the lines of sight to them."""
        tracks = self._tracks
        after = self._plane.moved(tracks["object_position"], motion)
        tracks["sight_deg"] += self._plane.sight_rotation(tracks["object_position"], after, motion)
        tracks["object_position"] = after

    def _count_misses(self, rows: IntArray, hit: BoolArray, in_view: BoolArray) -> None:
        """Count frames in which groups are too wide; update existence by hit or miss (Bayes).

        Existence does not change while the object is out of view, where a miss is no evidence.
        """
        tracks = self._tracks
        wide = (tracks["spread"][rows] > self._config.spread_limit).any(axis=1)
        tracks["too_wide"][rows[wide]] += 1
        if self._config.count_strikes != "in_all":
            tracks["too_wide"][rows[~wide]] = 0
        existence = tracks["existence"][rows]
        of_object = existence * np.where(hit, P_HIT_OBJECT, 1 - P_HIT_OBJECT)
        of_clutter = (1 - existence) * np.where(hit, P_HIT_CLUTTER, 1 - P_HIT_CLUTTER)
        updated = np.minimum(np.maximum(of_object / (of_object + of_clutter), 0.01), 0.99)
        tracks["existence"][rows[in_view]] = updated[in_view]

    def _delete(
        self, rows: IntArray, astray: BoolArray, in_view: BoolArray, motion: Motion | None
    ) -> None:
        """Delete groups for the five reasons in the module's docstring, or remember them."""
        tracks, config = self._tracks, self._config
        alive = tracks["too_wide"][rows] < config.strikes  # not spread out
        alive &= tracks["existence"][rows] >= config.min_existence  # nor unlikely
        alive &= ~(astray & in_view)
        # Tracks are ordered by age; of two on one object the older stays.
        objects = tracks["object_position"][rows]
        near = self._distances(objects, objects) < config.merge
        alive &= ~(near & alive & (rows[:, None] > rows)).any(axis=1)
        kept = np.zeros(len(tracks), bool)
        kept[rows] = alive & in_view
        if motion is not None:
            kept |= self._still_remembered(motion)
            left = rows[alive & ~in_view]
            kept[left] = tracks["remembered"][left] = True
            tracks["too_wide"][left] = tracks["drift"][left] = tracks["missed"][left] = 0
            tracks["frames_left"][left] = config.remember_frames
        tracks.keep(kept)

    def _still_remembered(self, motion: Motion) -> BoolArray:
        """(n,) the remembered tracks, but for those that were out of view too long, or did not show
        where they should. The drift of all grows."""
        tracks, lost = self._tracks, self._tracks["remembered"]
        if not lost.any():
            return lost
        shift = 0.0
        if motion.right_m or motion.ahead_m:
            shift = math.hypot(motion.right_sigma_m, motion.ahead_sigma_m)
            shift = self._pixels(shift) / self._diameter[0]
        objects = tracks["object_position"][lost]
        distance = np.hypot(*((objects - self._plane.apex) / self._diameter).T)
        by_pan = math.radians(motion.pan_sigma_deg) * distance
        tracks["drift"][lost] += by_pan**2 + shift**2 + RECALL_DRIFT**2
        tracks["frames_left"][lost] -= 1
        tracks["missed"][lost] += self._visible_share(objects) > FULLY_VISIBLE
        return np.asarray(
            lost & (tracks["frames_left"] > 0) & (tracks["missed"] <= self._config.strikes)
        )

    def _begin(self, candidates: FloatArray) -> None:
        """Begin a group at every candidate without one.

        One that begins near a remembered track takes over all of it but the position, the nearest
        pairs first; for the others new tracks begin.
        """
        tracks = self._tracks
        off = self._distances(candidates, tracks["position"][tracks.in_view])
        starts = candidates[(off > self._config.new_group).all(axis=1)]
        if not len(starts):
            return  # as usual
        lost = np.flatnonzero(tracks["remembered"])
        off = self._distances(starts, tracks["object_position"][lost])
        near = off <= np.minimum(RECALL + 2 * np.sqrt(tracks["drift"][lost]), RECALL_MOST)
        share = self._visible_share(starts)
        # A candidate that may be a lost object waits until enough of it is in view to decide.
        waits = near.any(axis=1) & (share < RECALL_IN_VIEW)
        rows = np.full(len(starts), -1)
        for new, old in sorted(np.argwhere(near).tolist(), key=lambda pair: off[*pair]):
            if not waits[new] and rows[new] < 0 and lost[old] not in rows:
                rows[new] = lost[old]
        fresh = (rows < 0) & ~waits
        rows[fresh] = tracks.begin(int(fresh.sum()))
        rows, starts, share = rows[~waits], starts[~waits], share[~waits]
        tracks["remembered"][rows] = False
        tracks["position"][rows] = tracks["object_position"][rows] = starts
        tracks["particles"][rows] = self._particles.around(starts, self._sigma_new)
        tracks["spread"][rows] = self._sigma_new / self._diameter
        tracks["shown"][rows] = share >= self._config.least_in_view

    def _visible_share(self, positions: FloatArray) -> FloatArray:
        """(n,) share inside the fan of discs at (n, 2) pixels; -1 beyond the image."""
        column, row = np.rint(positions).astype(int).T + 1
        index = np.ravel_multi_index((row, column), self._share.shape, "clip")
        return np.asarray(self._share.take(index))

    def _distances(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """(len(a), len(b)) distances in disc diameters, along the axes of the disc's image."""
        first, second = as_complex(a / self._diameter), as_complex(b / self._diameter)
        return np.asarray(np.abs(first[:, None] - second))


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
