"""Stage 2 for plates: the same continuity evaluation, with the plate's pose in the state.

A plate's pose is fitted near that of the frame before. Where its drawing is found there, that is a
candidate like those of stage 1; the particles gather on both. In a frame that shows nothing, such
as a blank ping, the pose waits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray, FloatImage, IntArray
from sonarrec.landmarks import WIDEST_SIGMA
from sonarrec.recogniser.drawn.pose import EXPLAINED, Drawing, Fit, PoseFitter
from sonarrec.recogniser.stage2 import ContinuityFilter
from sonarrec.records import Groups, Motion, Selection

# Least correlation of a picture with its drawing where any pose was tried, and near that of the
# frame before: noise reaches .56 and .40.
LEAST_MATCH, LEAST_NEAR = 0.57, 0.48
LOST_FRAMES = 12  # without a picture; then the pose is looked for again
# A pose is looked for FIRST times in a track's first frames, then in every OFTEN-th while none is
# sure.
FIRST, OFTEN, SURE = 3, 8, 2.0  # log odds
BETTER = 1.0  # by how much likelier, in log odds, another pose must be, to be taken instead
FIRST_SEARCHES, SEARCHES = 2, 1  # in one frame, at most: where new groups wait, and else
PEAK = 0.25  # halves of a side, of the score of a plate that was found
SHOWN = 0.8  # least share of a plate inside the fan
POSE_SPREAD = 0.06  # of a fitted middle, in sides
SMOOTH_PX = 0.7  # the samples of a picture are coarser than pixels


def smooth(image: ByteImage) -> FloatImage:
    """A working image as poses are fitted in."""
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), SMOOTH_PX), np.float32)


@dataclass
class _Plate:
    """A group's plate."""

    fit: Fit
    seen: bool
    """In the frame at hand."""
    began: int
    """How often its pose was looked for and changed: each time another picture begins."""
    missed: int = 0


class Plates:
    """The groups, and the poses of their plates."""

    def __init__(self, fitter: PoseFitter, groups: ContinuityFilter) -> None:
        self._fitter, self._plane, self._groups = fitter, fitter.plane, groups
        self._plates: dict[int, _Plate] = {}
        self._ages: dict[int, int] = {}
        self._searched: dict[int, int] = {}

    def begin_stretch(self) -> None:
        """Forget the groups and their plates; numbers go on."""
        self._plates, self._ages, self._searched = {}, {}, {}
        self._groups.begin_stretch()

    def step(self, image: ByteImage, selection: Selection, motion: Motion | None) -> Groups:
        """The groups after one frame, each in the middle of its plate.

        motion: as in ContinuityFilter.
        """
        fine = smooth(image)
        self.follow(fine)
        groups = self.join(fine, self._groups.step(self.lead(selection), motion))
        self._groups.centre(groups)
        return groups

    def follow(self, image: FloatImage) -> None:
        """Fit every known plate in the next frame."""
        plates = [*self._plates.values()]
        fits = self._fitter.near(image, [plate.fit for plate in plates])
        for plate, fit in zip(plates, fits, strict=True):
            plate.seen = self._is_clear(fit, LEAST_NEAR)
            plate.missed = 0 if plate.seen else plate.missed + 1
            if plate.seen:
                plate.began += (fit.row, fit.way) != (plate.fit.row, plate.fit.way)
                plate.fit = fit
        # Plates do not overlap: of two the better fit stays.
        kept: dict[int, _Plate] = {}
        for number, plate in sorted(self._plates.items(), key=lambda item: -item[1].fit.odds):
            hidden = any(
                other.seen
                and self._fitter.halves_off(other.fit.pose, plate.fit.pose[:2]) < EXPLAINED
                for other in kept.values()
            )
            if plate.missed <= LOST_FRAMES and not hidden:
                kept[number] = plate
        self._plates = kept

    def lead(self, selection: Selection) -> Selection:
        """Stage 1's selection, with the plates that were found as candidates."""
        seen = [plate.fit for plate in self._plates.values() if plate.seen]
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

    def join(self, image: FloatImage, groups: Groups) -> Groups:
        """Look for the plates of new groups; the groups, each in the middle of its plate."""
        numbers = groups.numbers.tolist()
        self._ages = {n: self._ages.get(n, -1) + 1 for n in numbers}
        self._plates = {n: self._plates[n] for n in numbers if n in self._plates}
        self._searched = {n: self._searched.get(n, 0) for n in numbers}
        position = dict(zip(numbers, groups.positions, strict=True))
        waiting = sorted((self._searched[n], n) for n in numbers if self._wanting(n))
        new = bool(waiting) and waiting[0][0] < FIRST
        for _, number in waiting[: FIRST_SEARCHES if new else SEARCHES]:
            self._searched[number] += 1
            plate = self._plates.get(number)
            self._search(image, number, position[number] if plate is None else plate.fit.pose[:2])
        positions, spread = groups.positions.copy(), groups.spread.copy()
        shown = np.zeros(len(numbers), bool)
        for i, number in enumerate(numbers):
            plate = self._plates.get(number)
            if plate is not None and plate.seen:
                positions[i], spread[i], shown[i] = plate.fit.pose[:2], POSE_SPREAD, True
        return replace(groups, positions=positions, spread=spread, in_view=groups.in_view & shown)

    def of(self, groups: Groups) -> list[tuple[Fit, int] | None]:
        """For each group the fit in this frame, and the number of its picture; None: not seen."""
        plates = [self._plates.get(n) for n in groups.numbers.tolist()]
        return [(p.fit, p.began) if p is not None and p.seen else None for p in plates]

    def follow_by(self, numbers: IntArray, drawings: Sequence[Drawing | None]) -> None:
        """Follow each group by this drawing from now on; None: by the one it has."""
        for number, drawing in zip(numbers.tolist(), drawings, strict=True):
            if drawing is not None:
                plate = self._plates[number]
                plate.fit = replace(plate.fit, row=drawing[0], way=drawing[1])

    def _wanting(self, number: int) -> bool:
        """Whether the pose of a group's plate is to be looked for."""
        plate = self._plates.get(number)
        sure = plate is not None and plate.seen and plate.fit.odds >= SURE
        return self._searched[number] < FIRST or (not sure and self._ages[number] % OFTEN == 0)

    def _search(self, image: FloatImage, number: int, position: FloatArray) -> None:
        others = [p.fit.pose for n, p in self._plates.items() if n != number]
        fit, plate = self._fitter.search(image, position, others), self._plates.get(number)
        if not self._is_clear(fit, LEAST_MATCH):
            return
        if any(self._fitter.halves_off(other, fit.pose[:2]) < EXPLAINED for other in others):
            return
        if plate is None:
            self._plates[number] = _Plate(fit, seen=True, began=0)
        elif not plate.seen or fit.odds > plate.fit.odds + BETTER:
            self._plates[number] = _Plate(fit, seen=True, began=plate.began + 1)

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
