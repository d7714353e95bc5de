"""Passes of landmarks through the view, and the units that count as independent.

Neighbouring frames show the same disc on the same floor through the same noise. If each counted as
independent, every difference would look significant. So the independent unit is a pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.evaluation.match import Matched

PASS_GAP = 10
"""A pass may have gaps of so many frames, so that a shake of the sonar does not end it."""

UnitKind = Literal["pass", "log"]


@dataclass(frozen=True, slots=True)
class Passes:
    """P passes of landmarks through one log, by time, and the units that they are.

    Passes that overlap by more than half of the shorter one are one unit, since landmarks seen
    together are seen equally well. A truth and its right claims belong to its pass. Everything
    else in a frame (IDs not in view, false claims of any ID) belongs to the unit nearest in time,
    with the border half-way between neighbours, since a distractor also lasts over many frames, or
    where a stretch begins between them.
    A log without any landmark is one unit.
    """

    landmark_index: IntArray
    """(P,) into Matched.ids."""
    first_frame_index: IntArray
    last_frame_index: IntArray
    """(P,) into Matched.frame: the first and the last frame with the landmark whole in view."""
    of_truth: IntArray
    """(T,) the pass that a truth is part of, -1 if it is not a positive."""
    unit: IntArray
    """(P,) the unit of a pass."""
    units: int
    """How many there are."""
    unit_of_frame: IntArray
    """(F,) the unit of a frame's negatives and false claims."""
    unit_of_truth: IntArray
    """(T,) the unit of a truth and its right claims."""


def find_passes(log: Matched) -> Passes:
    """Runs of frames of one stretch with the whole landmark in view and gaps of at most PASS_GAP
    frames.

    Landmarks of one ID that are in view together are one pass.
    """
    positive = np.flatnonzero(log.truth_positive)
    frame, landmark = log.truth_frame_index[positive], log.truth_landmark_index[positive]
    order = np.lexsort((frame, landmark))
    frame, landmark = frame[order], landmark[order]
    new = np.ones(len(order), dtype=bool)
    new[1:] = (np.diff(landmark) != 0) | (np.diff(frame) > PASS_GAP + 1)
    new[1:] |= np.diff(log.stretch[frame]) != 0
    start = np.flatnonzero(new)
    end = np.append(start[1:], len(order))[: len(start)] - 1
    in_time = np.lexsort((frame[end], frame[start]))
    rank = np.empty(len(start), dtype=np.int64)
    rank[in_time] = np.arange(len(start))
    of_truth = np.full(len(log.truth_frame_index), -1, dtype=np.int64)
    of_truth[positive[order]] = rank[np.cumsum(new) - 1]
    start, end = start[in_time], end[in_time]

    unit = np.zeros(len(start), dtype=np.int64)
    spans: list[list[int]] = []  # first and last frame of each unit
    for i, (first, last) in enumerate(zip(frame[start].tolist(), frame[end].tolist(), strict=True)):
        shared = min(last, spans[-1][1]) - first + 1 if spans else 0
        if spans and 2 * shared > min(last - first, spans[-1][1] - spans[-1][0]) + 1:
            spans[-1][1] = max(last, spans[-1][1])
        else:
            spans.append([first, last])
        unit[i] = len(spans) - 1
    ends, starts = np.array([s[1] for s in spans[:-1]]), np.array([s[0] for s in spans[1:]])
    borders = (ends + starts) / 2
    # Where stretches begin between two units, the border is at that nearest to half-way.
    begins = np.flatnonzero(np.diff(log.stretch)) + 0.5
    for i, border in enumerate(borders):
        between = begins[(begins > ends[i]) & (begins < starts[i])]
        if len(between):
            borders[i] = between[np.abs(between - border).argmin()]
    borders = np.maximum.accumulate(borders)
    unit_of_frame = np.searchsorted(borders, np.arange(len(log.frame)))
    unit_of_truth = unit_of_frame[log.truth_frame_index]
    unit_of_truth[of_truth >= 0] = unit[of_truth[of_truth >= 0]]
    return Passes(
        landmark_index=landmark[start],
        first_frame_index=frame[start],
        last_frame_index=frame[end],
        of_truth=of_truth,
        unit=unit,
        units=max(len(spans), 1),
        unit_of_frame=unit_of_frame,
        unit_of_truth=unit_of_truth,
    )
