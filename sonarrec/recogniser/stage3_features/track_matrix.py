"""The shape matrix averaged along the track.

It is kept in the object's own frame: angles count from the line of sight, which a pan leaves alone.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sonarrec.recogniser.stage3_features.shape_matrix import ANGLES
from sonarrec.records import FloatArray, Groups


class TrackMatrix:
    """The running average of each track's shape matrix.

    Frames fade with a memory of `memory_frames`; a cell counts by how often it was seen.
    """

    def __init__(self, memory_frames: float, lines: int) -> None:
        self._keep = 1 - 1 / max(memory_frames, 1.0)
        self._numbers: list[int] = []
        self._sum: FloatArray = np.empty((0, lines, ANGLES))
        self._count: FloatArray = np.empty((0, lines, ANGLES))

    def step(
        self, groups: Groups, grey: FloatArray, seen: npt.NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray]:
        """Add a frame's matrices (n, L, ANGLES). Returns the averages and the counts, same shape.

        Tracks that are neither in view nor remembered are forgotten.
        """
        place = {number: i for i, number in enumerate(self._numbers)}
        numbers = [*groups.numbers.tolist(), *groups.remembered.tolist()]
        total = np.zeros((len(numbers), *self._sum.shape[1:]))
        count = np.zeros_like(total)
        known = [i for i, number in enumerate(numbers) if number in place]
        before = [place[numbers[i]] for i in known]
        total[known], count[known] = self._sum[before], self._count[before]
        now = slice(len(groups.numbers))
        total[now] = self._keep * total[now] + np.where(seen, grey, 0.0)
        count[now] = self._keep * count[now] + seen
        self._numbers, self._sum, self._count = numbers, total, count
        return total[now] / np.maximum(count[now], 1e-9), count[now]
