"""What simulated truth tells beyond `sonarrec evaluate`: whether stated uncertainties are what
they say, and the score as a probability."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from sonarrec.arrays import BoolArray, FloatArray
from sonarrec.evaluation.judge import judge
from tests.support.simulated import matched

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


def errors(folders: Sequence[Path], method: str) -> Errors:
    """How far right claims of a method are from the truth. folders: as `recognise` writes them."""
    columns = []
    for folder in folders:
        log = matched(folder)
        found = judge(log, method, "strict")
        claim, truth = found.claim[found.right], found.truth[found.right]
        told, true = log.claim_position[claim].T, log.truth_position[truth].T
        turn = log.turn_deg[found.landmark_index[found.right]]
        off = log.claim_orientation[claim] - log.truth_orientation[truth]
        sigmas = pd.read_csv(folder / "estimates.csv", usecols=SIGMAS)[SIGMAS].to_numpy()[claim].T
        columns.append(
            (
                *(np.hypot(*told) - np.hypot(*true), sigmas[0]),
                *(np.degrees(np.arctan2(*told) - np.arctan2(*true)), sigmas[1]),
                *((off + turn / 2) % turn - turn / 2, sigmas[2]),
            )
        )
    return Errors(*map(np.concatenate, zip(*columns, strict=True)))


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


def stated(folders: Sequence[Path], method: str) -> tuple[FloatArray, BoolArray]:
    """The scores of a method and whether each is right: of all estimates, declared or not, but
    those on a landmark partly in view."""
    found = [judge(matched(folder), method, "strict") for folder in folders]
    return np.concatenate([f.score for f in found]), np.concatenate([f.truth >= 0 for f in found])


def calibration_error(score: FloatArray, right: BoolArray) -> float:
    """The expected one of (n,) scores, taken for the probability that the ID is right."""
    step = np.minimum((score * BINS).astype(int), BINS - 1)
    return float(np.abs(np.bincount(step, score - right)).sum() / len(score))
