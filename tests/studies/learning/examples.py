"""What the reader learns from: pictures with what they show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sonarrec.arrays import FloatArray, IntArray

MOST_IDS = 12  # of a set, while learning
UNKNOWN = -1


class Examples(NamedTuple):
    """n averaged shape matrices, as Pictures has them, with what they show."""

    brightness: FloatArray
    """(n, L, ANGLES)."""
    count: FloatArray
    """(n, L, ANGLES)."""
    existence: FloatArray
    """(n,)."""
    smear: FloatArray
    """(n,)."""
    codes: FloatArray
    """(n, MOST_IDS, ANGLES) of each one's set, zeros beyond its IDs."""
    ids: IntArray
    """(n,) how many IDs its set has."""
    label: IntArray
    """(n,) index of the ID, MOST_IDS for none."""
    lit: IntArray
    """(n, ANGLES) whether the symbol is lit in a direction, UNKNOWN where that is not known."""
    weight: FloatArray
    """(n,) how often it is learned from, relative to the others."""


def joined_examples(parts: Sequence[Examples]) -> Examples:
    """Examples of several parts as one."""
    return Examples(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
