"""Stage 3, Bayesian feature estimation: which landmark is each object? (Section 3.4).

Two measurements turn shape matrices into beliefs. The published one (published.py) identifies
single frames and applies Tables 2 and 3 and Eq. 5 to 8. The default (appearance.py) averages the
matrix along the track, and small networks read its symbol (reader.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IndexArray


@dataclass(frozen=True, slots=True)
class Beliefs:
    """Which landmarks n objects are, and their orientations."""

    probabilities: FloatArray
    """(n, K + 1): every ID, then 'none of these'; rows sum to 1."""
    rotation: FloatArray
    """(n,) rotation of the likeliest ID from the line of sight, counter-clockwise, in steps of the
    shape matrix."""
    rotation_sigma: FloatArray
    """(n,) its standard error in steps, NaN where unknown."""
    enough_evidence: BoolArray
    """(n,) whether enough has been seen for an ID to be declared."""
    corners: FloatArray | None = None
    """(n, 4, 2) slant range (m) and bearing (deg) of a drawn plate's corners, those of the far edge
    first; NaN where it is not seen."""
    lit: FloatArray | None = None
    """(n, ANGLES) probability that the symbol is lit in each direction from the line of sight on,
    counter-clockwise; NaN where nothing was read."""


def rounded(values: FloatArray) -> FloatArray:
    """Values rounded to the tables' six digits, so that all processors choose the same maximum.

    Two IDs may fit equally well, for example where half of a disc is seen. The last digits of
    their sums depend on the processor; rounded they are equal, and the first ID is taken.
    """
    return np.asarray(np.round(values, 6))


def likeliest(probabilities: FloatArray) -> tuple[IndexArray, FloatArray]:
    """(n,) index of the likeliest ID by (n, K + 1) beliefs, and (n,) the belief in it."""
    best = rounded(probabilities[:, :-1]).argmax(axis=1)
    return best, probabilities[np.arange(len(best)), best]
