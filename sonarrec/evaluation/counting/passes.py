"""Passes of landmarks through the view, and the units that count as independent.

Neighbouring frames show the same disc on the same floor through the same noise. If each counted as
independent, every difference would look significant. So the independent unit is a pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.evaluation.matching.joined import Joined

PASS_GAP = 10
"""A pass may have gaps of so many frames, so that a shake of the sonar does not end it."""
LOGS_ENOUGH = 10
"""With so many logs the unit is a log, since the passes of one log have much in common."""
MOST_UNITS = 400
"""If there are more, neighbours in time are merged; this makes intervals no wider."""

UnitKind = Literal["pass", "log"]


@dataclass(frozen=True, slots=True)
class Passes:
    """P passes of landmarks, by log and time."""

    log_index: IntArray
    """(P,) into Joined.logs."""
    landmark_index: IntArray
    """(P,) into Joined.ids."""
    first_frame_index: IntArray
    last_frame_index: IntArray
    """(P,) into Joined.frame: the first and the last frame with the landmark whole in view."""
    of_truth: IntArray
    """(T,) the pass that a truth is part of, -1 if it is not a positive."""


@dataclass(frozen=True, slots=True)
class Units:
    """The clusters that the bootstrap draws and tests swap as a whole."""

    count: int
    of_frame: IntArray
    """(F,) the unit of a frame's negatives and false claims."""
    of_truth: IntArray
    """(T,) the unit of a truth and its right claims."""


def find_passes(joined: Joined) -> Passes:
    """Runs of frames with the whole landmark in view and gaps of at most PASS_GAP frames.

    Landmarks of one ID that are in view together are one pass.
    """
    positive = np.flatnonzero(joined.truth_positive)
    frame, landmark = joined.truth_frame_index[positive], joined.truth_landmark_index[positive]
    order = np.lexsort((frame, landmark))
    frame, landmark = frame[order], landmark[order]
    log = joined.log_index[frame]
    new = np.ones(len(order), dtype=bool)
    new[1:] = (np.diff(landmark) != 0) | (np.diff(log) != 0) | (np.diff(frame) > PASS_GAP + 1)
    start = np.flatnonzero(new)
    end = np.append(start[1:], len(order))[: len(start)] - 1
    in_time = np.lexsort((frame[end], frame[start]))
    rank = np.empty(len(start), dtype=np.int64)
    rank[in_time] = np.arange(len(start))
    of_truth = np.full(len(joined.truth_frame_index), -1, dtype=np.int64)
    of_truth[positive[order]] = rank[np.cumsum(new) - 1]
    start, end = start[in_time], end[in_time]
    return Passes(log[start], landmark[start], frame[start], frame[end], of_truth)


def log_units(joined: Joined) -> Units:
    """The logs as units."""
    return Units(len(joined.logs), joined.log_index, joined.log_index[joined.truth_frame_index])


def find_units(joined: Joined, passes: Passes) -> Units:
    """The passes as units, at most MOST_UNITS of them.

    Passes that overlap by more than half of the shorter one are one unit, since landmarks seen
    together are seen equally well. A truth and its right claims belong to its pass. Everything
    else in a frame (IDs not in view, false claims of any ID) belongs to the unit nearest in time,
    with the border half-way between neighbours, since a distractor also lasts over many frames.
    A log without any landmark is one unit.
    """
    units = pass_units(joined, passes)
    return Units(
        min(units.count, MOST_UNITS),
        merged_units(units.of_frame, units.count),
        merged_units(units.of_truth, units.count),
    )


def merged_units(unit: IntArray, count: int) -> IntArray:
    """Numbers of `count` units, merged to at most MOST_UNITS."""
    return unit * MOST_UNITS // count if count > MOST_UNITS else unit


def pass_units(joined: Joined, passes: Passes) -> Units:
    """The passes as units, as in `find_units`, but never merged for their number."""
    of_pass = np.empty(len(passes.first_frame_index), dtype=np.int64)
    of_frame = np.empty(len(joined.frame), dtype=np.int64)
    count = 0
    for log in range(len(joined.logs)):
        here = np.flatnonzero(passes.log_index == log)
        spans: list[list[int]] = []
        for i in here.tolist():
            first, last = int(passes.first_frame_index[i]), int(passes.last_frame_index[i])
            if spans:
                shared = min(last, spans[-1][1]) - first + 1
                shorter = min(last - first, spans[-1][1] - spans[-1][0]) + 1
            if spans and 2 * shared > shorter:
                spans[-1][1] = max(last, spans[-1][1])
            else:
                spans.append([first, last])
            of_pass[i] = count + len(spans) - 1
        ends, starts = np.array([s[1] for s in spans[:-1]]), np.array([s[0] for s in spans[1:]])
        borders = np.maximum.accumulate((ends + starts) / 2)
        frames = np.flatnonzero(joined.log_index == log)
        of_frame[frames] = count + np.searchsorted(borders, frames)
        count += max(len(spans), 1)
    of_truth = of_frame[joined.truth_frame_index]
    positive = passes.of_truth >= 0
    of_truth[positive] = of_pass[passes.of_truth[positive]]
    return Units(count, of_frame, of_truth)


def unit_of_pass(passes: Passes, units: Units) -> IntArray:
    """(P,) the unit of each pass."""
    unit = np.zeros(len(passes.first_frame_index), dtype=np.int64)
    part = passes.of_truth >= 0
    unit[passes.of_truth[part]] = units.of_truth[part]
    return unit
