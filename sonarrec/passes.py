"""What a pass is: the one rule for sightings.csv, the map, the review page and evaluation.

A pass of a landmark is a run of frames of one stretch. `evaluate` counts frames in which the whole
landmark is in view; the others count frames in which it was declared.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, IntArray, begins

PASS_GAP = 10
"""A pass ends after so many frames without, or where its stretch ends. So a shake of the sonar does
not end it."""


def ended(last: int, frame: int) -> bool:
    """Whether a pass with this last frame cannot go on in a later frame of its stretch."""
    return frame - last > PASS_GAP


def pass_begins(frame: IntArray, stretch: IntArray, *keys: npt.NDArray[Any]) -> BoolArray:
    """(n,) of each row whether it begins a pass.

    frame: (n,) numbers of the frames. stretch: (n,) numbers of their stretches. keys: (n,) what
    rows of one pass have in common, such as the landmark. Rows of equal keys must follow each
    other, by rising frame.
    """
    new = begins(stretch, *keys)
    new[1:] |= np.diff(frame) > PASS_GAP
    return new
