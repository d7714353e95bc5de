"""The shape matrix averaged along the track.

It is kept in the object's own frame: angles count from the line of sight as the track began. A pan
leaves the line of sight alone; a sonar that is carried past turns it over the floor.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.nouns import Groups
from sonarrec.recogniser.stage3 import Evidence
from sonarrec.recogniser.stage3.shape_matrix import ANGLES, whole_steps

_T = TypeVar("_T", bound=np.generic)
# A track that comes back is judged by its new picture. The picture from before it left is added
# with weight OLD_SHARE if the two correlate by VERY_ALIKE, or after FRAMES_TO_EARN frames by
# LEAST_ALIKE: speckle is frozen to the floor, so two pictures of one landmark are alike.
VERY_ALIKE, FRAMES_TO_EARN, LEAST_ALIKE, OLD_SHARE = 0.75, 3, 0.5, 0.5


class _Picture(NamedTuple):
    """What a track showed: (L, ANGLES) faded sums of its cells, and of how often each was seen."""

    total: FloatArray
    seen: FloatArray
    chapter: int

    def alike(self, other: _Picture) -> float:
        """Correlation over the cells that both have shown; 0 where these are too few."""
        both = (self.seen > 0) & (other.seen > 0)
        if np.count_nonzero(both) < 2:
            return 0.0
        a, b = (p.total[both] / p.seen[both] for p in (self, other))
        a, b = a - a.mean(), b - b.mean()
        return float(a @ b / max(np.sqrt((a @ a) * (b @ b)), 1e-9))


class TrackMatrix:
    """The running average of each track's shape matrix, with angles from the line of sight.

    Frames fade with a memory of `memory_frames`; a cell counts by how often it was seen. A track
    that comes back into view begins a new picture and a new chapter. If the new picture turns out
    to be like the one before, the earlier chapter goes on (see FRAMES_TO_EARN).
    """

    def __init__(self, memory_frames: float, lines: int) -> None:
        self._keep = 1 - 1 / max(memory_frames, 1.0)
        self._numbers: list[int] = []
        self._sum: FloatArray = np.empty((0, lines, ANGLES))
        self._count: FloatArray = np.empty((0, lines, ANGLES))
        self._frames = np.empty(0, np.int64)
        self._chapters = np.empty(0, np.int64)
        self._last_chapter = 0
        # Pictures of tracks that left, or came back but have not shown yet that they are the same.
        self._before: dict[int, _Picture] = {}

    def step(self, groups: Groups, grey: FloatArray, seen: BoolArray) -> Evidence:
        """Add a frame's matrices (n, L, ANGLES). Returns the averages of what is in view.

        Tracks that are neither in view nor remembered are forgotten.
        """
        steps, _ = whole_steps(groups.sight_deg)
        grey, seen = _turned(grey, steps), _turned(seen, steps)
        place = {number: i for i, number in enumerate(self._numbers)}
        numbers, remembered = groups.numbers.tolist(), groups.remembered.tolist()
        for number in remembered:
            if number in place and number not in self._before:
                i = place[number]
                self._before[number] = _Picture(
                    self._sum[i].copy(), self._count[i].copy(), int(self._chapters[i])
                )
        still_known = {*numbers, *remembered}
        self._before = {k: p for k, p in self._before.items() if k in still_known}
        total = np.zeros((len(numbers), *self._sum.shape[1:]))
        count = np.zeros_like(total)
        frames = np.zeros(len(numbers), np.int64)
        chapters = self._last_chapter + 1 + np.arange(len(numbers))
        self._last_chapter += len(numbers)
        known = [i for i, number in enumerate(numbers) if number in place]
        before = [place[numbers[i]] for i in known]
        total[known], count[known] = self._sum[before], self._count[before]
        frames[known], chapters[known] = self._frames[before], self._chapters[before]
        total = self._keep * total + np.where(seen, grey, 0.0)
        count = self._keep * count + seen
        frames += 1
        self._numbers, self._sum, self._count = numbers, total, count
        self._frames, self._chapters = frames, chapters
        self._resume_pictures()
        count = _turned(count, -steps)
        return Evidence(_turned(total, -steps) / np.maximum(count, 1e-9), count, frames, chapters)

    def _resume_pictures(self) -> None:
        """Add to tracks that came back their pictures from before, or drop these.

        See FRAMES_TO_EARN.
        """
        if not self._before:
            return
        total, count, frames, chapters = self._sum, self._count, self._frames, self._chapters
        for i, number in enumerate(self._numbers):
            if (picture := self._before.get(number)) is None:
                continue
            alike = picture.alike(_Picture(total[i], count[i], int(chapters[i])))
            earned = frames[i] >= FRAMES_TO_EARN
            if alike >= (LEAST_ALIKE if earned else VERY_ALIKE):
                total[i] += OLD_SHARE * picture.total
                count[i] += OLD_SHARE * picture.seen
                frames[i] = max(frames[i], FRAMES_TO_EARN)
                chapters[i] = picture.chapter
                earned = True
            if earned:
                del self._before[number]


def _turned(cells: npt.NDArray[_T], steps: IntArray) -> npt.NDArray[_T]:
    """(n, L, ANGLES) matrices, each turned by so many of (n,) steps."""
    if not steps.any():
        return cells
    index = (np.arange(ANGLES) - steps[:, None]) % ANGLES
    return np.take_along_axis(cells, index[:, None], axis=2)
