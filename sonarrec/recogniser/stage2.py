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
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.config import Continuity
from sonarrec.recogniser.particles import Particles
from sonarrec.recogniser.plane import Plane, as_complex
from sonarrec.records import Groups, Motion, Selection

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


@dataclass(slots=True)
class _Group:
    """What is known of a group, without its particles. There are few, so plain numbers do."""

    number: int
    """Stable over frames."""
    x: float
    """Working pixels, as `y`: where it was last a candidate, moved with the floor since. Unlike
    the particles it leaves the fan with its object."""
    y: float
    existence: float = NEW_EXISTENCE
    """Probability that there is an object, 0 to 1."""
    sight_deg: float = 0.0
    """Rotation over the floor of the line of sight to it since the group began."""
    too_wide: int = 0
    """Frames in which the group was too wide, counted as Continuity.count_strikes says."""
    # Of a remembered one:
    frames_left: int = 0
    """For which it is still remembered."""
    drift: float = 0.0
    """Variance of the position, in disc diameters squared."""
    missed: int = 0
    """Frames in which its position was in view but it was no candidate."""


class ContinuityFilter:
    """The particle groups of all objects in view."""

    def __init__(self, config: Continuity, plane: Plane, rng: np.random.Generator) -> None:
        self._config = config
        self._plane = plane
        self._sigma = config.sigma_px * plane.scale
        self._sigma_known = config.sigma_known_px * plane.scale
        # A candidate's position is known far better than a particle's random step. A group that
        # began as wide as that would move to neighbouring peaks before it has converged.
        self._sigma_new = self._sigma if config.motion == "random_walk" else self._sigma_known
        self._diameter = 2 * np.array(plane.axes)
        self._across, self._along = self._diameter.tolist()
        # The border stands for all positions beyond the image.
        self._share = cv2.copyMakeBorder(
            plane.disc_share(), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=-1
        )
        self._next = 1
        self._groups: list[_Group] = []  # by number
        self._particles = Particles(config, rng)  # of these, in their order
        self._lost: list[_Group] = []  # remembered out of view

    def begin_stretch(self) -> None:
        """Forget all groups; numbers go on."""
        self._groups, self._lost = [], []
        self._particles.keep([])

    def step(self, selection: Selection, motion: Motion | None = None) -> Groups:
        """The groups after one frame, by rising number.

        motion: of the sonar since the last frame; one that is not known is as good as None.
        """
        if motion is not None and not motion.known:
            motion = None
        particles = self._particles
        # Predict (Eq. 3): a random walk; a narrower one, after the sonar's motion, if it is known.
        before = [(g.x, g.y) for g in self._groups]
        sigma = self._sigma
        if motion is not None:
            particles.positions = self._plane.moved(particles.positions, motion)
            self._apply_motion([*self._groups, *self._lost], motion)
            sigma = math.hypot(self._sigma_known, self._uncertain(motion))
        particles.walk(sigma)
        expected = particles.mean()
        # Weigh (Eq. 4), and resample.
        weight = particles.weigh(selection.score_map, selection.step)
        if motion is not None:
            weight = self._without_neighbours(weight, selection.positions)
        positions, spread = particles.weighted(weight)
        particles.resample(weight)
        spread /= self._diameter
        # Count hits and misses.
        near = self._distances(positions, selection.positions) < self._config.merge
        hit: list[bool] = np.asarray(near.any(axis=1)).tolist()
        moved_off = self._moved_off_prediction(positions - expected, motion)
        self._update_positions(positions, hit, moved_off, motion)
        shown, in_view = self._in_view(positions, before, hit, motion)
        self._count_misses(spread, hit, in_view)
        # Delete.
        kept = self._delete(moved_off, in_view, motion)
        positions, spread, shown = positions[kept], spread[kept], [shown[i] for i in kept]
        # Begin.
        new = self._begin(positions, selection.positions)
        if new:
            starts = np.array([(g.x, g.y) for g in new])
            particles.begin(starts, self._sigma_new)
            groups = self._groups + new
            # A recalled group has an old number, so the order must be restored.
            order = sorted(range(len(groups)), key=lambda i: groups[i].number)
            self._groups = [groups[i] for i in order]
            particles.keep(order)
            wide = np.full((len(new), 2), self._sigma_new) / self._diameter
            positions = np.concatenate([positions, starts])[order]
            spread = np.concatenate([spread, wide])[order]
            shown += [self._visible_share(g.x, g.y) >= self._config.least_in_view for g in new]
            shown = [shown[i] for i in order]
        return Groups(
            numbers=np.array([g.number for g in self._groups], np.int64),
            positions=positions,
            spread=spread,
            existence=np.array([g.existence for g in self._groups], float),
            sight_deg=np.array([g.sight_deg for g in self._groups], float),
            in_view=np.array(shown, bool),
            remembered=np.array([g.number for g in self._lost], np.int64),
        )

    def centre(self, groups: Groups) -> None:
        """Shift whole groups to the positions in `groups`, which were measured more exactly."""
        shift = groups.positions - self._particles.mean()
        self._particles.positions += shift[:, None].astype(np.float32)
        for group, position in zip(self._groups, groups.positions.tolist(), strict=True):
            group.x, group.y = position

    def _without_neighbours(self, weight: FloatArray, candidates: FloatArray) -> FloatArray:
        """(n, particles) weights, 0 for particles that are nearer to a neighbour's candidate.

        A group's own candidate is the one near its object's expected position. Where the circle of
        another candidate overlaps that of its own (false rings of a blotchy floor), particles
        beyond the middle between the two do not count, else the broader peak would attract the
        group.
        """
        if not self._groups or len(candidates) < 2:
            return weight
        own = np.array([(g.x, g.y) for g in self._groups])
        distance = self._distances(own, candidates)
        if ((distance < 1 + OWN_CANDIDATE).sum(axis=1) < 2).all():
            return weight  # as usual
        near = distance.min(axis=1) <= OWN_CANDIDATE
        own[near] = candidates[distance.argmin(axis=1)[near]]
        distance = self._distances(own, candidates)
        neighbours = (distance > OWN_CANDIDATE) & (distance < 1)
        if not neighbours.any():
            return weight
        nearer = np.zeros(weight.shape, bool)
        for candidate in np.flatnonzero(neighbours.any(axis=0)):
            position, groups = candidates[candidate], neighbours[:, candidate]
            # Which side of the perpendicular bisector a particle is on, in disc diameters.
            way = (position - own[groups]) / self._diameter**2
            middle = (position + own[groups]) / 2
            off = self._particles.positions[groups] - middle[:, None].astype(np.float32)
            nearer[groups] |= (off @ way[:, :, None].astype(np.float32))[..., 0] > 0
        kept = np.where(nearer, 0.0, weight)
        total = kept.sum(axis=1, keepdims=True)
        return np.where(total > 0, kept / np.maximum(total, 1e-12), weight)

    def _moved_off_prediction(self, moved: FloatArray, motion: Motion | None) -> list[bool]:
        """Which groups are too far from where the motion expects them. moved: (n, 2) by how far.

        Objects on the floor do not move, so such a group has left its object for another.
        """
        if motion is None:
            return [False] * len(moved)
        farthest = JUMP + 2 * self._uncertain(motion) / self._across
        return [self._diameters(x, y) > farthest for x, y in moved.tolist()]

    def _in_view(
        self,
        positions: FloatArray,
        before: Sequence[tuple[float, float]],
        hit: Sequence[bool],
        motion: Motion | None,
    ) -> tuple[list[bool], list[bool]]:
        """Which groups show enough of the disc, and which are in view.

        Those just coming in count as in view. before: positions in the last frame.
        """
        shares = [self._visible_share(g.x, g.y) for g in self._groups]
        if motion is not None:
            # At the fan's edge particles may stay behind their object, or leave before it.
            of_particles = [self._visible_share(x, y) for x, y in positions.tolist()]
            shares = [min(both) for both in zip(shares, of_particles, strict=True)]
        shown = [share >= self._config.least_in_view for share in shares]
        if motion is None or all(shown):
            return shown, shown
        coming = [
            is_hit and share > self._visible_share(*position)
            for is_hit, share, position in zip(hit, shares, before, strict=True)
        ]
        return shown, [a or b for a, b in zip(shown, coming, strict=True)]

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

    def _update_positions(
        self,
        positions: FloatArray,
        hit: Sequence[bool],
        moved_off: Sequence[bool],
        motion: Motion | None,
    ) -> None:
        """Update the objects' positions: the group's own where it is hit, else moved by the motion.

        Remembered groups are moved too, and their drift grows.
        """
        rows = zip(self._groups, positions.tolist(), hit, moved_off, strict=True)
        for group, position, is_hit, is_off in rows:
            if motion is None or (is_hit and not is_off):
                group.x, group.y = position
        if motion is None:
            self._lost = []  # their positions are no longer known
        elif self._lost:
            shift = 0.0
            if motion.right_m or motion.ahead_m:
                shift = math.hypot(motion.right_sigma_m, motion.ahead_sigma_m)
                shift = self._pixels(shift) / self._across
            x, y = self._plane.apex
            for lost in self._lost:
                distance = self._diameters(lost.x - x, lost.y - y)
                by_pan = math.radians(motion.pan_sigma_deg) * distance
                lost.drift += by_pan**2 + shift**2 + RECALL_DRIFT**2

    def _apply_motion(self, groups: Sequence[_Group], motion: Motion) -> None:
        """Move positions by the sonar's motion, and rotate the lines of sight to them."""
        if not groups:
            return
        before = np.array([(g.x, g.y) for g in groups])
        after = self._plane.moved(before, motion)
        rotation = self._plane.sight_rotation(before, after, motion).tolist()
        for group, position, by in zip(groups, after.tolist(), rotation, strict=True):
            group.x, group.y = position
            group.sight_deg += by

    def _count_misses(
        self, spread: FloatArray, hit: Sequence[bool], in_view: Sequence[bool]
    ) -> None:
        """Count frames in which groups are too wide; update existence by hit or miss (Bayes).

        Existence does not change while the object is out of view, where a miss is no evidence.
        """
        config = self._config
        wide = np.asarray((spread > config.spread_limit).any(axis=1)).tolist()
        rows = zip(self._groups, wide, hit, in_view, strict=True)
        for group, is_wide, is_hit, is_seen in rows:
            if is_wide:
                group.too_wide += 1
            elif config.count_strikes != "in_all":
                group.too_wide = 0
            if is_seen:
                of_object = group.existence * (P_HIT_OBJECT if is_hit else 1 - P_HIT_OBJECT)
                clutter = P_HIT_CLUTTER if is_hit else 1 - P_HIT_CLUTTER
                of_clutter = (1 - group.existence) * clutter
                existence = of_object / (of_object + of_clutter)
                group.existence = min(max(existence, 0.01), 0.99)

    def _delete(
        self, moved_off: Sequence[bool], in_view: Sequence[bool], motion: Motion | None
    ) -> list[int]:
        """Delete groups for the five reasons in the module's docstring.

        Returns the indices of those kept.
        """
        config, groups = self._config, self._groups
        alive = [
            group.too_wide < config.strikes  # not spread out
            and group.existence >= config.min_existence  # nor unlikely
            and not (astray and seen)
            for group, astray, seen in zip(groups, moved_off, in_view, strict=True)
        ]
        # Groups are ordered by age; of two on one object the older stays.
        merged = [
            any(
                alive[k] and self._diameters(g.x - groups[k].x, g.y - groups[k].y) < config.merge
                for k in range(i)
            )
            for i, g in enumerate(groups)
        ]
        alive = [a and not m for a, m in zip(alive, merged, strict=True)]
        if motion is not None:
            self._drop_lost()
            self._lost += [
                replace(g, too_wide=0, frames_left=config.remember_frames)
                for g, a, seen in zip(groups, alive, in_view, strict=True)
                if a and not seen
            ]
        kept = [i for i, (a, seen) in enumerate(zip(alive, in_view, strict=True)) if a and seen]
        if len(kept) < len(groups):
            self._groups = [groups[i] for i in kept]
            self._particles.keep(kept)
        return kept

    def _drop_lost(self) -> None:
        """Drop groups that were out of view too long, or did not show where they should."""
        for lost in self._lost:
            lost.frames_left -= 1
            lost.missed += self._visible_share(lost.x, lost.y) > FULLY_VISIBLE
        self._lost = [
            g for g in self._lost if g.frames_left > 0 and g.missed <= self._config.strikes
        ]

    def _begin(self, positions: FloatArray, candidates: FloatArray) -> list[_Group]:
        """New groups, one at every candidate without one. positions: (m, 2) of the existing ones.

        One that begins near a remembered group takes over all of it but the position, the nearest
        pairs first; the others get a new number.
        """
        far = (self._distances(candidates, positions) > self._config.new_group).all(axis=1)
        starts = candidates[far].tolist()
        pairs = sorted(
            (distance, new, old)
            for new, (x, y) in enumerate(starts)
            for old, lost in enumerate(self._lost)
            if (distance := self._diameters(x - lost.x, y - lost.y)) <= _gate(lost)
        )
        # A candidate that may be a lost group waits until enough of it is in view to decide.
        waits = {new for _, new, _ in pairs if self._visible_share(*starts[new]) < RECALL_IN_VIEW}
        recalled: dict[int, int] = {}
        for _, new, old in pairs:
            if new not in waits and new not in recalled and old not in recalled.values():
                recalled[new] = old
        groups = []
        for new, (x, y) in enumerate(starts):
            if new in recalled:
                lost = self._lost[recalled[new]]
                groups.append(_Group(lost.number, x, y, lost.existence, lost.sight_deg))
            elif new not in waits:
                groups.append(_Group(self._next, x, y))
                self._next += 1
        back = recalled.values()
        self._lost = [lost for old, lost in enumerate(self._lost) if old not in back]
        return groups

    def _visible_share(self, x: float, y: float) -> float:
        """Share inside the fan of a disc at a pixel; -1 beyond the image."""
        rows, columns = self._share.shape
        row, column = min(max(round(y) + 1, 0), rows - 1), min(max(round(x) + 1, 0), columns - 1)
        return float(self._share[row, column])

    def _diameters(self, x: float, y: float) -> float:
        """Length of a way in disc diameters, along the semi-axes of the disc's image."""
        return math.hypot(x / self._across, y / self._along)

    def _distances(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """(len(a), len(b)) distances in disc diameters, as `_diameters`."""
        first, second = as_complex(a / self._diameter), as_complex(b / self._diameter)
        return np.asarray(np.abs(first[:, None] - second))


def _gate(lost: _Group) -> float:
    """Largest distance at which a candidate recalls a remembered group, in disc diameters."""
    return min(RECALL + 2 * math.sqrt(lost.drift), RECALL_MOST)
