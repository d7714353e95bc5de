"""What the paper published of its experiment (Section 4), and what it tells of its basin."""

from __future__ import annotations

from sonarrec.evaluation.rows import PAPER_MIN_VISIBLE

FRAMES = 992
IDS = (1, 2, 3, 4)
PRESENT = (1, 3, 4)
"""ID.2 was not in the basin: its TPR is 0/0."""
IN_VIEW = {1: 352, 3: 346, 4: 330}
"""TP + FN of Table 5, of 992 frames: about the share of the pan in which a place is in the fan."""
# TPR and FPR of ID.1 to ID.4 and in total. 0/0 is printed as 0.
TABLE_4 = {
    "tpr": (0.9751, 0.0, 0.7666, 0.7156, 0.8226),
    "fpr": (0.0813, 0.0030, 0.0310, 0.0559, 0.0381),
}
TABLE_5 = {
    "tpr": (0.9943, 0.0, 0.8671, 0.7242, 0.8648),
    "fpr": (0.0453, 0.0, 0.0325, 0.0468, 0.0276),
}
CLEAR = 16
"""Frames, about, after which ID.1 stood clear of the others (Figure 14)."""

HALF, WHOLE = PAPER_MIN_VISIBLE, 0.9
"""Shares of a disc inside the fan: from HALF on it is in view."""
