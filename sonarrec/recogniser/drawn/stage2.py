"""Stage 2 for plates: the same continuity evaluation, with the plate's pose in the state.

A plate's pose is fitted near that of the frame before. Where its drawing is found there, that is a
candidate like those of stage 1; the particles gather on both. In a frame that shows nothing, such
as a blank ping, the pose waits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray, FloatImage, Table
from sonarrec.landmarks import WIDEST_SIGMA
from sonarrec.recogniser.drawn.pose import EXPLAINED, Fit, PoseFitter
from sonarrec.recogniser.stage2 import ContinuityFilter
from sonarrec.recogniser.tracks import Tracks
from sonarrec.sonar.frame import Motion, Selection

# Least correlation of a picture with its drawing where any pose was tried, and near that of the
# frame before: noise reaches .56 and .40.
LEAST_MATCH, LEAST_NEAR = 0.57, 0.48
LOST_FRAMES = 12  # without a picture; then the pose is looked for again
# A pose is looked for FIRST times in a track's first frames, then in every OFTEN-th while none is
# sure.
FIRST, OFTEN, SURE = 3, 16, 2.0  # log odds
BETTER = 1.0  # by how much likelier, in log odds, another pose must be, to be taken instead
FIRST_SEARCHES, SEARCHES = 2, 1  # in one frame, at most: where new groups wait, and else
PEAK = 0.25  # halves of a side, of the score of a plate that was found
SHOWN = 0.8  # least share of a plate inside the fan
POSE_SPREAD = 0.06  # of a fitted middle, in sides
SMOOTH_PX = 0.7  # the samples of a picture are coarser than pixels


def smooth(image: ByteImage) -> FloatImage:
    """A working image as poses are fitted in."""
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), SMOOTH_PX), np.float32)


class Plates:
    """The groups, and the poses of their plates.

    Its columns of the tracks: fit: (n,) the last Fit of the plate, None where none is known; seen:
    (n,) whether it is of this frame, and unseen: (n,) frames since. began: (n,) how often another
    pose was found: each time another picture begins. age: (n,) frames in view. searched: (n,) how
    often the pose was looked for.
    """

    def __init__(self, fitter: PoseFitter, tracks: Tracks, groups: ContinuityFilter) -> None:
        self._fitter, self._plane, self._groups = fitter, fitter.plane, groups
        self._tracks = tracks
        tracks.declare(fit=None, seen=False, unseen=0, began=0, age=-1, searched=0)

    def step(self, image: ByteImage, selection: Selection, motion: Motion | None) -> Table:
        """The tracks in view after one frame, each in the middle of its plate.

        motion: as in ContinuityFilter.
        """
        fine = smooth(image)
        known = self.follow(fine)
        self._groups.step(self.lead(selection, known), motion)
        self.search_plates(fine)
        return self._groups.centre()

    def follow(self, image: FloatImage) -> list[Fit]:
        """Fit every known plate in the next frame. Returns those that are seen, the best first."""
        tracks = self._tracks
        fits = tracks["fit"]
        known = [row for row, fit in enumerate(fits.tolist()) if fit is not None]
        followed = self._fitter.near(image, [fits[row] for row in known])
        for row, fit in zip(known, followed, strict=True):
            tracks["unseen"][row] += 1
            if self._is_clear(fit, LEAST_NEAR):
                fits[row], tracks["unseen"][row] = fit, 0
        tracks["seen"][known] = tracks["unseen"][known] == 0
        # Plates do not overlap: of two the better fit stays.
        seen: list[Fit] = []
        for fit, row in sorted(
            zip(fits[known], known, strict=True), key=lambda pair: -pair[0].odds
        ):
            others = [other.pose for other in seen]
            if tracks["unseen"][row] > LOST_FRAMES or self._overlaps(fit, others):
                fits[row], tracks["seen"][row] = None, False
            elif tracks["seen"][row]:
                seen.append(fit)
        return seen

    def lead(self, selection: Selection, seen: Sequence[Fit]) -> Selection:
        """Stage 1's selection, with the plates that were found, `seen`, as candidates."""
        if not seen:
            return selection
        score, positions = selection.score_map.copy(), selection.positions
        others = np.ones(len(positions), bool)
        for fit in reversed(seen):  # the best last
            self._explain(score, fit)
            others &= self._fitter.halves_off(fit.pose, positions) > EXPLAINED
        middles = np.array([fit.pose[:2] for fit in seen])
        return replace(
            selection,
            score_map=score,
            positions=np.concatenate([middles, positions[others]]),
            scores=np.concatenate([[fit.match for fit in seen], selection.scores[others]]),
        )

    def search_plates(self, image: FloatImage) -> None:
        """Look for the plates of new tracks, and put each track in the middle of its plate."""
        tracks, lost, rows = self._tracks, self._tracks["remembered"], self._tracks.in_view
        tracks["fit"][lost], tracks["seen"][lost] = None, False
        tracks["age"][lost], tracks["searched"][lost] = -1, 0
        tracks["age"][rows] += 1
        waiting = sorted((tracks["searched"][row], row) for row in rows if self._wanting(row))
        new = bool(waiting) and waiting[0][0] < FIRST
        self._search(image, [row for _, row in waiting[: FIRST_SEARCHES if new else SEARCHES]])
        seen = rows[tracks["seen"][rows]]
        for row in seen:
            tracks["position"][row] = tracks["fit"][row].pose[:2]
        tracks["spread"][seen] = POSE_SPREAD
        tracks["shown"] &= tracks["seen"]

    def _wanting(self, row: int) -> bool:
        """Whether the pose of a track's plate is to be looked for."""
        tracks = self._tracks
        sure = tracks["seen"][row] and tracks["fit"][row].odds >= SURE
        return bool(
            tracks["searched"][row] < FIRST or (not sure and tracks["age"][row] % OFTEN == 0)
        )

    def _search(self, image: FloatImage, rows: Sequence[int]) -> None:
        """Look for the plates of tracks; what is found is taken if it is clear, and better."""
        tracks, fits = self._tracks, self._tracks["fit"]
        tracks["searched"][rows] += 1
        positions = tracks["position"][rows]
        for n, row in enumerate(rows):
            if fits[row] is not None:
                positions[n] = fits[row].pose[:2]
        likeliest = self._fitter.search(image, positions, [self._others(row) for row in rows])
        for fit, row in zip(likeliest, rows, strict=True):
            known, others = fits[row], self._others(row)
            if not self._is_clear(fit, LEAST_MATCH) or self._overlaps(fit, others):
                continue
            if known is None or not tracks["seen"][row] or fit.odds > known.odds + BETTER:
                tracks["began"][row] = 0 if known is None else tracks["began"][row] + 1
                fits[row], tracks["seen"][row], tracks["unseen"][row] = fit, True, 0

    def _others(self, row: int) -> list[FloatArray]:
        """Poses of the known plates of all tracks but one."""
        fits = self._tracks["fit"]
        return [fit.pose for n, fit in enumerate(fits) if fit is not None and n != row]

    def _overlaps(self, fit: Fit, others: Sequence[FloatArray]) -> bool:
        """Whether a fit lies on another plate. others: poses."""
        return any(self._fitter.halves_off(o, fit.pose[:2]) < EXPLAINED for o in others)

    def _is_clear(self, fit: Fit, least: float) -> bool:
        """Whether a fit matches well enough, inside the fan, where beams resolve its drawing."""
        if fit.match < least or max(self._fitter.smear(fit.pose)) > WIDEST_SIGMA:
            return False
        return self._fitter.share_inside(fit.pose) >= SHOWN

    def _explain(self, score: FloatImage, fit: Fit) -> None:
        """Put a plate's match into a score map, a peak in its middle, in place of what is there."""
        column, row = np.rint(fit.pose[:2]).astype(int)
        reach = int(2 * EXPLAINED * self._plane.axes[0])
        top, left = max(row - reach, 0), max(column - reach, 0)
        part = score[top : row + reach + 1, left : column + reach + 1]
        y, x = np.mgrid[top : top + part.shape[0], left : left + part.shape[1]]
        off = self._fitter.halves_off(fit.pose, np.stack([x, y], axis=2))
        peak = fit.match * np.exp(-0.5 * (off / PEAK) ** 2)
        part[off <= EXPLAINED] = peak[off <= EXPLAINED]
