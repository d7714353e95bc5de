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

from sonarrec.arrays import BoolArray, FloatArray, IntArray, joined
from sonarrec.config import Continuity
from sonarrec.nouns import Groups, Motion, Selection
from sonarrec.recogniser.particles import LostGroups, ParticleGroups
from sonarrec.recogniser.plane import Plane

NEW_EXISTENCE = 0.5  # probability of existence of a group that has just begun
WHOLE = 0.9  # share of a disc in view from which on its object should be a candidate
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


class ContinuityFilter:
    """The particle groups of all objects in view."""

    def __init__(self, config: Continuity, plane: Plane, rng: np.random.Generator) -> None:
        self._config = config
        self._rng = rng
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
        )
        self._last_share = np.array(self._share.shape[::-1]) - 1
        self._next = 1
        self._groups = self._new(np.empty(0, np.int64), np.empty((0, 2)), *np.empty((2, 0)))
        self._lost = _no_lost_groups()

    def step(self, selection: Selection, motion: Motion | None = None) -> Groups:
        """The groups after one frame, by rising number.

        motion: of the sonar since the last frame; None if unknown.
        """
        # Predict.
        before = self._groups.places
        self._predict(motion)
        expected = self._groups.mean()
        # Weigh.
        positions, spread = self._weigh(selection, motion)
        # Strike.
        distances = self._distances(positions, selection.positions)
        hit = np.any(distances < self._config.merge, axis=1)
        pulled = self._pulled(positions, expected, motion)
        self._place(positions, hit & ~pulled, motion)
        shown, in_view = self._in_view(positions, before, hit, motion)
        self._strike(spread, hit, in_view)
        # Delete.
        kept = self._delete(pulled, in_view, motion)
        # Begin.
        born = self._begin(positions[kept], selection)
        return self._as_groups(positions[kept], spread[kept], shown[kept], born)

    def centre(self, groups: Groups) -> None:
        """Shift whole groups to the positions in `groups`, which were measured more exactly."""
        rows = np.flatnonzero(np.isin(self._groups.numbers, groups.numbers))
        shift = groups.positions - self._groups.mean()[rows]
        self._groups.particles[rows] += shift[:, None].astype(np.float32)
        self._groups.places[rows] = groups.positions

    def _as_groups(
        self, positions: FloatArray, spread: FloatArray, shown: BoolArray, born: FloatArray
    ) -> Groups:
        """The groups by rising number; born: (n, 2) centres of those that have just begun."""
        if len(born):
            # A recalled group has an old number, so the order must be restored.
            order = np.argsort(self._groups.numbers)
            self._groups = self._groups.take(order)
            wide = np.full((len(born), 2), self._sigma_new) / self._diameter
            positions = np.concatenate([positions, born])[order]
            spread = np.concatenate([spread, wide])[order]
            new_shown = self._shares(born) >= self._config.least_in_view
            shown = np.concatenate([shown, new_shown])[order]
        groups = self._groups
        return Groups(
            numbers=groups.numbers,
            positions=positions,
            spread=spread,
            existence=groups.existence,
            sight_deg=groups.sight_deg,
            in_view=shown,
            remembered=self._lost.numbers,
        )

    def _predict(self, motion: Motion | None) -> None:
        """Eq. 3: a random walk; a narrower one, after the sonar's motion, if that is known."""
        groups, sigma = self._groups, self._sigma
        if motion is not None:
            groups.particles = self._plane.moved(groups.particles, motion).astype(np.float32)
            self._carry(groups, motion)
            sigma = math.hypot(self._sigma_known, self._uncertain(motion))
        groups.walk(sigma, self._rng)

    def _weigh(self, selection: Selection, motion: Motion | None) -> tuple[FloatArray, FloatArray]:
        """Eq. 4, and resampling: (n, 2) positions, and spread per axis in disc diameters."""
        config, groups = self._config, self._groups
        weight = groups.weigh(selection.score_map, config)
        if motion is not None:
            weight = self._without_neighbours(weight, selection.positions)
        positions, spread = groups.weighted(weight)
        groups.resample(weight, self._rng)
        return positions, spread / self._diameter

    def _without_neighbours(self, weight: FloatArray, candidates: FloatArray) -> FloatArray:
        """(n, particles) weights, 0 for particles that are nearer to a neighbour's candidate.

        A group's own candidate is the one near its object's expected position. Where the circle of
        another candidate overlaps that of its own (false rings of a blotchy floor), particles
        beyond the middle between the two do not count, else the broader peak would attract the
        group.
        """
        groups = self._groups
        if len(groups) == 0 or len(candidates) == 0:
            return weight
        own = groups.places.copy()
        apart = self._distances(own, candidates)
        there = apart.min(axis=1) <= OWN_CANDIDATE
        own[there] = candidates[apart.argmin(axis=1)[there]]
        apart = self._distances(own, candidates)
        neighbours = (apart > OWN_CANDIDATE) & (apart < 1)
        if not neighbours.any():
            return weight
        theirs = np.zeros(weight.shape, bool)
        for candidate in np.flatnonzero(neighbours.any(axis=0)):
            place, beside = candidates[candidate], neighbours[:, candidate]
            # Which side of the perpendicular bisector a particle is on, in disc diameters.
            way = (place - own[beside]) / self._diameter**2
            middle = (place + own[beside]) / 2
            off = groups.particles[beside] - middle[:, None].astype(np.float32)
            theirs[beside] |= (off @ way[:, :, None].astype(np.float32))[..., 0] > 0
        kept = np.where(theirs, 0.0, weight)
        total = kept.sum(axis=1, keepdims=True)
        return np.where(total > 0, kept / np.maximum(total, 1e-12), weight)

    def _pulled(
        self, positions: FloatArray, expected: FloatArray, motion: Motion | None
    ) -> BoolArray:
        """(n,) which groups are too far from the (n, 2) positions where the motion expects them.

        Objects on the floor do not move, so such a group has left its object for another.
        """
        moved = np.hypot(*((positions - expected) / self._diameter).T)
        farthest = JUMP + 2 * self._uncertain(motion) / self._diameter[0]
        return np.asarray((moved > farthest) & (motion is not None))

    def _in_view(
        self, positions: FloatArray, before: FloatArray, hit: BoolArray, motion: Motion | None
    ) -> tuple[BoolArray, BoolArray]:
        """(n,) which groups show enough of the disc, and which are in view.

        Those just coming in count as in view. before: (n, 2) positions in the last frame.
        """
        shares = self._shares(self._groups.places)
        if motion is not None:
            # At the fan's edge particles may stay behind their object, or leave before it.
            shares = np.minimum(shares, self._shares(positions))
        shown = shares >= self._config.least_in_view
        if motion is None or shown.all():
            return shown, shown
        return shown, shown | (hit & (shares > self._shares(before)))

    def _uncertain(self, motion: Motion | None) -> float:
        """Standard error in pixels, at the middle of the window, of positions after a motion.

        0 after a pan alone, whose error sigma_known_px covers.
        """
        if motion is None or not (motion.right_m or motion.ahead_m):
            return 0.0
        fan = self._plane.fan
        turned = math.radians(motion.pan_sigma_deg) * (fan.range_min_m + fan.range_max_m) / 2
        return self._pixels(math.hypot(turned, motion.right_sigma_m, motion.ahead_sigma_m))

    def _pixels(self, metres: float) -> float:
        """A length on the floor in working pixels."""
        return metres * self._plane.scale / self._plane.fan.metres_per_pixel

    def _place(self, positions: FloatArray, there: BoolArray, motion: Motion | None) -> None:
        """Update the objects' positions: the group's own where `there`, else moved by the motion.

        Remembered groups are moved too, and their drift grows.
        """
        groups, lost = self._groups, self._lost
        if motion is None:
            groups.places = positions
            self._lost = _no_lost_groups()  # their positions are no longer known
            return
        groups.places[there] = positions[there]
        if len(lost):
            self._carry(lost, motion)
            away = np.hypot(*((lost.places - self._plane.apex) / self._diameter).T)
            turned = np.radians(motion.pan_sigma_deg) * away
            carried = 0.0
            if motion.right_m or motion.ahead_m:
                carried = math.hypot(motion.right_sigma_m, motion.ahead_sigma_m)
                carried = self._pixels(carried) / self._diameter[0]
            lost.drift += turned**2 + carried**2 + RECALL_DRIFT**2

    def _carry(self, table: ParticleGroups | LostGroups, motion: Motion) -> None:
        """Move positions by the sonar's motion, and rotate the lines of sight to them."""
        after = self._plane.moved(table.places, motion)
        table.sight_deg = table.sight_deg + self._plane.sight_turned(table.places, after, motion)
        table.places = after

    def _strike(self, spread: FloatArray, hit: BoolArray, in_view: BoolArray) -> None:
        """Count strikes of groups that are too wide, and update existence by hit or miss (Bayes).

        Existence does not change while the object is out of view, where a miss is no evidence.
        """
        config, groups = self._config, self._groups
        wide = (spread > config.spread_limit).any(axis=1)
        left = groups.strikes if config.count_strikes == "in_all" else 0
        groups.strikes = np.where(wide, groups.strikes + 1, left)
        hit_or_miss = np.where(hit, P_HIT_OBJECT, 1 - P_HIT_OBJECT)
        of_object = groups.existence * hit_or_miss
        hit_or_miss = np.where(hit, P_HIT_CLUTTER, 1 - P_HIT_CLUTTER)
        of_clutter = (1 - groups.existence) * hit_or_miss
        existence = np.clip(of_object / (of_object + of_clutter), 0.01, 0.99)
        groups.existence = np.where(in_view, existence, groups.existence)

    def _delete(self, pulled: BoolArray, in_view: BoolArray, motion: Motion | None) -> BoolArray:
        """Delete groups for the five reasons above. Returns (n,) which are kept."""
        config, groups = self._config, self._groups
        spread_out = groups.strikes >= config.strikes
        unlikely = groups.existence < config.min_existence
        astray = pulled & in_view
        alive = ~(spread_out | unlikely | astray)
        # Groups are ordered by age; of two on one object the older stays.
        near = np.tril(self._distances(groups.places, groups.places) < config.merge, k=-1)
        merged = (near & alive[None, :]).any(axis=1)
        alive &= ~merged
        out_of_view = ~in_view
        if motion is not None:
            self._forget()
            self._remember(alive & out_of_view)
        kept = alive & ~out_of_view
        self._groups = groups.take(kept)
        return kept

    def _forget(self) -> None:
        """Forget groups that were out of view too long, or did not show where they should."""
        lost = self._lost
        if len(lost) == 0:
            return
        lost.frames_left -= 1
        lost.missed += self._shares(lost.places) > WHOLE
        self._lost = lost.take((lost.frames_left > 0) & (lost.missed <= self._config.strikes))

    def _remember(self, left: BoolArray) -> None:
        """Remember groups that were deleted only because they are out of view. left: (n,) which."""
        if not left.any():
            return
        groups = self._groups
        count = np.count_nonzero(left)
        gone = LostGroups(
            numbers=groups.numbers[left],
            places=groups.places[left],
            existence=groups.existence[left],
            sight_deg=groups.sight_deg[left],
            frames_left=np.full(count, self._config.remember_frames),
            drift=np.zeros(count),
            missed=np.zeros(count, np.int64),
        )
        self._lost = joined([self._lost, gone])

    def _begin(self, positions: FloatArray, selection: Selection) -> FloatArray:
        """Start a group round every candidate without one. Returns their (n, 2) centres.

        positions: (m, 2) of the existing groups.
        """
        far = self._distances(selection.positions, positions) > self._config.new_group
        born = selection.positions[far.all(axis=1)]
        if len(self._lost) and len(born):
            # A candidate that may be a lost group waits until enough of it is in view to decide.
            near = (self._distances(born, self._lost.places) <= self._gate()).any(axis=1)
            hidden = self._shares(born) < RECALL_IN_VIEW
            born = born[~(near & hidden)]
        if len(born):
            self._groups = joined([self._groups, self._new(*self._recall(born))])
        return born

    def _recall(self, born: FloatArray) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        """Numbers, positions, existence and sight_deg of groups that begin at (n, 2) positions.

        A group that begins near a lost one takes over all of these but the position; the nearest
        pairs first. Others get a new number.
        """
        lost = self._lost
        numbers = np.zeros(len(born), np.int64)
        existence: FloatArray = np.full(len(born), NEW_EXISTENCE)
        sight_deg: FloatArray = np.zeros(len(born))
        distance = self._distances(born, lost.places)
        distance[distance > self._gate()] = np.inf
        while distance.size and distance.min() < np.inf:
            new, old = np.unravel_index(distance.argmin(), distance.shape)
            numbers[new], existence[new] = lost.numbers[old], lost.existence[old]
            sight_deg[new] = lost.sight_deg[old]
            distance[new], distance[:, old] = np.inf, np.inf
        self._lost = lost.take(~np.isin(lost.numbers, numbers))
        unknown = numbers == 0
        count = int(np.count_nonzero(unknown))
        numbers[unknown] = self._next + np.arange(count)
        self._next += count
        return numbers, born, existence, sight_deg

    def _gate(self) -> FloatArray:
        """(n,) largest distance at which a candidate recalls each lost group, in disc diameters."""
        return np.minimum(RECALL + 2 * np.sqrt(self._lost.drift), RECALL_MOST)

    def _new(
        self, numbers: IntArray, places: FloatArray, existence: FloatArray, sight_deg: FloatArray
    ) -> ParticleGroups:
        count, sigma = self._config.particles, self._sigma_new
        return ParticleGroups.around(numbers, places, existence, sight_deg, count, sigma, self._rng)

    def _shares(self, positions: FloatArray) -> FloatArray:
        """(n,) share of the disc inside the fan; -1 beyond the image."""
        pixel = np.rint(positions).astype(int) + 1
        column, row = np.minimum(
            np.maximum(pixel, 0), self._last_share
        ).T  # clip takes twice as long
        return np.asarray(self._share[row, column])

    def _distances(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """(len(a), len(b)) distances in disc diameters, along the semi-axes of the disc's image."""
        offset = (a[:, None] - b[None]) / self._diameter
        return np.asarray(np.hypot(offset[..., 0], offset[..., 1]))


def _no_lost_groups() -> LostGroups:
    return LostGroups(
        numbers=np.empty(0, np.int64),
        places=np.empty((0, 2)),
        existence=np.empty(0),
        sight_deg=np.empty(0),
        frames_left=np.empty(0, np.int64),
        drift=np.empty(0),
        missed=np.empty(0, np.int64),
    )
