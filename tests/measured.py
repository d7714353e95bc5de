"""What simulated truth tells beyond `sonarrec evaluate`: errors of orientation, whether stated
uncertainties are what they say, and the score as a probability."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from sonarrec.evaluation.scoring import Scored
from sonarrec.landmarks import LandmarkSet
from sonarrec.records import FloatArray

BINS = 10
NORMAL_MEDIAN = 0.6745
"""Of |x| where x is normal with sigma 1."""


@dataclass(frozen=True, slots=True)
class Errors:
    """Of one method's right claims, (n,) each: estimate less truth, and the stated sigma.

    NaN where the method states none. Orientations are compared modulo the symbol's symmetry.
    """

    range_m: FloatArray
    range_sigma_m: FloatArray
    bearing_deg: FloatArray
    bearing_sigma_deg: FloatArray
    orientation_deg: FloatArray
    orientation_sigma_deg: FloatArray


def errors(found: Scored, folders: Sequence[Path], landmarks: LandmarkSet) -> Errors:
    """How far right claims are from the truth. found: one of `simulated.score(folders)`."""
    right = found.made[found.made_effect[:, 0] > 0]
    # The evaluation numbers claims and truths as the files hold them, one log after the other.
    told = _table(folders, "estimates.csv").iloc[found.claim[right]]
    true = _table(folders, "gt.csv").iloc[found.truth[right]]

    def less(name: str) -> FloatArray:
        # Explicitly numbers: the columns of a truth without a row are none.
        return told[name].to_numpy(float) - true[name].to_numpy(float)

    symmetry = {i: symmetry_deg(landmarks, i) for i in landmarks.ids}
    turn = true["landmark"].map(symmetry).to_numpy(float)
    return Errors(
        range_m=less("range_m"),
        range_sigma_m=told["range_sigma_m"].to_numpy(),
        bearing_deg=less("bearing_deg"),
        bearing_sigma_deg=told["bearing_sigma_deg"].to_numpy(),
        orientation_deg=(less("orientation_deg") + turn / 2) % turn - turn / 2,
        orientation_sigma_deg=told["orientation_sigma_deg"].to_numpy(),
    )


def _table(folders: Sequence[Path], name: str) -> pd.DataFrame:
    return pd.concat([pd.read_csv(folder / name) for folder in folders], ignore_index=True)


def symmetry_deg(landmarks: LandmarkSet, landmark: int) -> float:
    """The least turn that leaves a landmark's symbol as it is."""
    code = np.array(landmarks.sectors[landmarks.ids.index(landmark)])
    turns = range(1, len(code) + 1)
    return 360 / len(code) * next(t for t in turns if (np.roll(code, t) == code).all())


def sizes(error: FloatArray) -> tuple[float, float]:
    """(median, 95 %) of the size of errors that are known; NaN without any."""
    known = np.abs(error[~np.isnan(error)])
    if not len(known):
        return np.nan, np.nan
    median, most = np.quantile(known, [0.5, 0.95])
    return float(median), float(most)


def honesty(error: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """(root mean square of error / sigma, robustly; share of errors within 2 sigma).

    1 and .954 where sigma is what it says; NaN where none is stated. The square root is read off
    the median, as of a normal distribution, so that a few outliers do not make it.
    """
    stated = ~np.isnan(sigma)
    if not stated.any():
        return np.nan, np.nan
    size = np.abs(error[stated]) / np.maximum(sigma[stated], 1e-9)
    return float(np.median(size)) / NORMAL_MEDIAN, float(np.mean(size <= 2))


@dataclass(frozen=True, slots=True)
class Reliability:
    """`score` as the probability that the ID is right.

    count, said, was: (BINS,) by equal steps of the score: estimates, their mean score, the share
    that was right (NaN in empty steps). ece: expected calibration error. brier: mean squared.
    """

    count: FloatArray
    said: FloatArray
    was: FloatArray
    ece: float
    brier: float


def reliability(found: Scored) -> Reliability:
    """Over all estimates, declared or not, but those on a landmark partly in view."""
    right = found.truth >= 0
    step = np.minimum((found.score * BINS).astype(int), BINS - 1)
    count = np.bincount(step, minlength=BINS)
    said = np.bincount(step, found.score, minlength=BINS)
    was = np.bincount(step, right, minlength=BINS)
    total = count.sum()
    with np.errstate(invalid="ignore"):  # 0/0 without an estimate
        return Reliability(
            count=count,
            said=said / count,
            was=was / count,
            ece=float(np.abs(said - was).sum() / total),
            brier=float(((found.score - right) ** 2).sum() / total),
        )
