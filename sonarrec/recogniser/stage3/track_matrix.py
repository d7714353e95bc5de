"""The shape matrix averaged along the track.

It is kept in the object's own frame: angles count from the line of sight at the track's beginning.
A pan does not rotate the line of sight over the floor; a sonar that moves past the object does.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.recogniser.stage3 import Evidence
from sonarrec.recogniser.stage3.shape_matrix import ANGLES, rounded_steps
from sonarrec.records import Groups

_T = TypeVar("_T", bound=np.generic)
# A track that comes back into view is judged by its new picture. The picture from before it left is
# added with weight OLD_SHARE if the two correlate by at least AT_ONCE_CORRELATION, or from the
# RETURN_FRAMES-th frame on by RETURN_CORRELATION. Speckle stays with the floor, so two pictures of
# one landmark are similar.
AT_ONCE_CORRELATION, RETURN_FRAMES, RETURN_CORRELATION, OLD_SHARE = 0.75, 3, 0.5, 0.5


class _Picture(NamedTuple):
    """A track's picture: (L, ANGLES) faded sums of its cells and of how often each was seen."""

    total: FloatArray
    seen: FloatArray
    episode: int

    def correlation(self, other: _Picture) -> float:
        """Correlation over the cells that both have seen; 0 if fewer than two."""
        both = (self.seen > 0) & (other.seen > 0)
        if np.count_nonzero(both) < 2:
            return 0.0
        a, b = (p.total[both] / p.seen[both] for p in (self, other))
        a, b = a - a.mean(), b - b.mean()
        return float(a @ b / max(np.sqrt((a @ a) * (b @ b)), 1e-9))


class TrackMatrix:
    """The running average of each track's shape matrix, with angles from the line of sight.

    Frames fade with a memory of `memory_frames`; cells are weighted by how often they were seen. A
    track that comes back into view begins a new picture and a new episode. If the new picture
    proves similar to the one before, the earlier episode is resumed (see RETURN_FRAMES).
    """

    def __init__(self, memory_frames: float, lines: int) -> None:
        self._keep = 1 - 1 / max(memory_frames, 1.0)
        self._numbers: list[int] = []
        self._sum: FloatArray = np.empty((0, lines, ANGLES))
        self._count: FloatArray = np.empty((0, lines, ANGLES))
        self._frames = np.empty(0, np.int64)
        self._episodes = np.empty(0, np.int64)
        self._last_episode = 0
        # Earlier pictures of tracks out of view, or back but not yet known to be the same object.
        self._before: dict[int, _Picture] = {}

    def step(self, groups: Groups, grey: FloatArray, seen: BoolArray) -> Evidence:
        """Add a frame's matrices (n, L, ANGLES). Returns the averages of the n tracks in view.

        Tracks that are neither in view nor remembered are forgotten.
        """
        steps, _ = rounded_steps(groups.sight_deg)
        grey, seen = _rotated(grey, steps), _rotated(seen, steps)
        row = {number: i for i, number in enumerate(self._numbers)}
        numbers, remembered = groups.numbers.tolist(), groups.remembered.tolist()
        for number in remembered:
            if number in row and number not in self._before:
                i = row[number]
                self._before[number] = _Picture(
                    self._sum[i].copy(), self._count[i].copy(), int(self._episodes[i])
                )
        still_known = {*numbers, *remembered}
        self._before = {k: p for k, p in self._before.items() if k in still_known}
        total = np.zeros((len(numbers), *self._sum.shape[1:]))
        count = np.zeros_like(total)
        frames = np.zeros(len(numbers), np.int64)
        episodes = self._last_episode + 1 + np.arange(len(numbers))
        self._last_episode += len(numbers)
        known = [i for i, number in enumerate(numbers) if number in row]
        before = [row[numbers[i]] for i in known]
        total[known], count[known] = self._sum[before], self._count[before]
        frames[known], episodes[known] = self._frames[before], self._episodes[before]
        total = self._keep * total + np.where(seen, grey, 0.0)
        count = self._keep * count + seen
        frames += 1
        self._numbers, self._sum, self._count = numbers, total, count
        self._frames, self._episodes = frames, episodes
        self._resume_pictures()
        count = _rotated(count, -steps)
        return Evidence(_rotated(total, -steps) / np.maximum(count, 1e-9), count, frames, episodes)

    def _resume_pictures(self) -> None:
        """Add their earlier pictures to tracks that came back, or drop these (RETURN_FRAMES)."""
        if not self._before:
            return
        total, count, frames, episodes = self._sum, self._count, self._frames, self._episodes
        for i, number in enumerate(self._numbers):
            if (picture := self._before.get(number)) is None:
                continue
            correlation = picture.correlation(_Picture(total[i], count[i], int(episodes[i])))
            decided = frames[i] >= RETURN_FRAMES
            if correlation >= (RETURN_CORRELATION if decided else AT_ONCE_CORRELATION):
                total[i] += OLD_SHARE * picture.total
                count[i] += OLD_SHARE * picture.seen
                frames[i] = max(frames[i], RETURN_FRAMES)
                episodes[i] = picture.episode
                decided = True
            if decided:
                del self._before[number]


def _rotated(cells: npt.NDArray[_T], steps: IntArray) -> npt.NDArray[_T]:
    """Matrices (n, L, ANGLES), each rotated by its number of steps (n,)."""
    if not steps.any():
        return cells
    index = (np.arange(ANGLES) - steps[:, None]) % ANGLES
    return np.take_along_axis(cells, index[:, None], axis=2)
