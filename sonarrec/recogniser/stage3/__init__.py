"""Stage 3: which landmark is it? (Section 3.4).

Two ways lead from shape matrices to beliefs, both a Measurement: the published one (published.py:
single frames identified, Tables 2 and 3, Eq. 5 to 8) and the default (appearance.py: the matrix
averaged along the track, described and judged by a model).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IndexArray, IntArray
from sonarrec.nouns import Groups


@dataclass(frozen=True, slots=True)
class Beliefs:
    """What n objects are, and how they lie."""

    probabilities: FloatArray
    """(n, K + 1): every ID, then 'none of these'; rows sum to 1."""
    turn: FloatArray
    """(n,) rotation of the likeliest ID from the line of sight, in steps of the shape matrix."""
    turn_sigma: FloatArray
    """(n,) its standard error in steps, NaN where unknown."""
    earned: BoolArray
    """(n,) whether enough has shown for an ID to be declared."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """The evidence on n objects, gathered along their tracks."""

    brightness: FloatArray
    """(n, L, ANGLES) shape matrices."""
    count: FloatArray
    """(n, L, ANGLES) how often each cell was seen."""
    frames: IntArray
    """(n,) frames since the object began, or came back."""
    chapters: IntArray
    """(n,) the number of the chapter of the track. A track that comes back into view with another
    picture begins a new chapter. 0 in the published measurement, which keeps no pictures.
    """


class Measurement(Protocol):
    """Turns the groups' shape matrices into beliefs. Frames must come in the log's order."""

    def gather(self, groups: Groups, grey: FloatArray, seen: BoolArray) -> Evidence:
        """Take in a frame's matrices, (n, L, ANGLES) from ShapeSampler."""
        ...

    def beliefs(self, groups: Sequence[Groups], evidence: Evidence) -> Beliefs:
        """Beliefs in the groups of some frames, one frame after another.

        evidence: from `gather`, of all those groups.
        """
        ...


def settled(values: FloatArray) -> FloatArray:
    """Values rounded to the tables' six digits, so that a choice among them is the same everywhere.

    Sums that are equal on paper differ in their last digits, and differently on each processor.
    Rounded they are equal, and the first is taken: for example where half of a disc is seen and two
    IDs fit it equally well.
    """
    return np.asarray(np.round(values, 6))


def likeliest(probabilities: FloatArray) -> tuple[IndexArray, FloatArray]:
    """(n,) index of the likeliest ID of (n, K + 1) beliefs, and (n,) the belief in it."""
    best = settled(probabilities[:, :-1]).argmax(axis=1)
    return best, probabilities[np.arange(len(best)), best]
