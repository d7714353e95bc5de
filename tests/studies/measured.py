"""What simulated truth tells beyond `sonarrec evaluate`: whether stated uncertainties are what
they say, and the score as a probability."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from sonarrec.arrays import FloatArray
from sonarrec.evaluation.counting.scoring import Scored
from sonarrec.evaluation.evaluate import Evaluation

SIGMAS = ["range_sigma_m", "bearing_sigma_deg", "orientation_sigma_deg"]
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


def errors(evaluation: Evaluation, found: Scored, folders: Sequence[Path]) -> Errors:
    """How far right claims are from the truth. evaluation: `simulated.score(folders)`; found: one
    method of it."""
    joined = evaluation.joined
    right = found.declared_claim[found.declared_effect[:, 0] > 0]
    claim, truth = found.claim[right], found.truth[right]
    told, true = joined.claim_position[claim].T, joined.truth_position[truth].T
    turn = joined.turn_deg[found.landmark_index[right]]
    off = joined.claim_orientation[claim] - joined.truth_orientation[truth]
    # The evaluation numbers claims as the files hold them, one log after the other.
    sigmas = pd.concat([pd.read_csv(f / "estimates.csv", usecols=SIGMAS) for f in folders])
    range_sigma, bearing_sigma, orientation_sigma = sigmas[SIGMAS].to_numpy()[claim].T
    return Errors(
        range_m=np.hypot(*told) - np.hypot(*true),
        range_sigma_m=range_sigma,
        bearing_deg=np.degrees(np.arctan2(*told) - np.arctan2(*true)),
        bearing_sigma_deg=bearing_sigma,
        orientation_deg=(off + turn / 2) % turn - turn / 2,
        orientation_sigma_deg=orientation_sigma,
    )


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
