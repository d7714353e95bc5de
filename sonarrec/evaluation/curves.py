"""Confusion counts, ROC curves, and figures of these."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import FloatArray, IntArray

FPR_POINTS = (0.01, 0.0276, 0.05)
"""FPRs for which the TPR is reported; .0276 is that of the paper's framework (Table 5)."""
PUBLISHED = (("SMI", 0.0381, 0.8226), ("framework", 0.0276, 0.8648))
"""(method, FPR, TPR) of Tables 4 and 5, Total: the paper's only two points."""


@dataclass(frozen=True, slots=True)
class Count:
    """A confusion count. Rates are NaN if they are 0/0."""

    tp: int
    tn: int
    fp: int
    fn: int
    double: int = 0
    """Those of TP that are further claims of an ID in view in one frame; protocol paper alone
    counts these, as published."""

    @property
    def tpr(self) -> float:
        """True positive rate, TP / (TP + FN)."""
        return self.tp / (self.tp + self.fn) if self.tp + self.fn else math.nan

    @property
    def tpr_once(self) -> float:
        """True positive rate without double claims: each ID counts once per frame."""
        positives = self.tp - self.double + self.fn
        return (positives - self.fn) / positives if positives else math.nan

    @property
    def fpr(self) -> float:
        """False positive rate, FP / (FP + TN)."""
        return self.fp / (self.fp + self.tn) if self.fp + self.tn else math.nan

    @property
    def total(self) -> int:
        """The paper's beta."""
        return self.tp + self.tn + self.fp + self.fn


def counted(base: IntArray, declared: IntArray) -> Count:
    """The count of TP, TN, FP, FN, (4,), that were `base` without any claim."""
    tp, tn, fp, fn = map(int, declared)
    return Count(tp, tn, fp, fn, double=tp + fn - int(base[3]))


@dataclass(frozen=True, slots=True)
class Curve:
    """A ROC: the counts at every threshold, from infinity down. Arrays are (points,).

    Equal scores are one point. Rates of 0/0 are NaN. At the last point every estimate is a claim;
    this need not be (1, 1), since a landmark without an estimate cannot be claimed.
    """

    threshold: FloatArray
    tp: IntArray
    tn: IntArray
    fp: IntArray
    fn: IntArray

    @property
    def tpr(self) -> FloatArray:
        """True positive rate at every threshold."""
        return ratio(self.tp, self.tp + self.fn)

    @property
    def fpr(self) -> FloatArray:
        """False positive rate at every threshold."""
        return ratio(self.fp, self.fp + self.tn)

    def turns(self, most: int = 2000) -> IntArray:
        """Indices of the points needed to draw the curve: its corners and both ends.

        If these are more than `most`, points are left out that stay within the same of `most` / 2
        equal steps of both rates.
        """
        step = np.stack([np.diff(self.tp - self.fn), np.diff(self.fp - self.tn)])
        keep = np.ones(len(self.tp), dtype=bool)
        # Of three points on a horizontal or vertical line the middle one is not needed.
        keep[1:-1] = ((step[:, 1:] != 0) != (step[:, :-1] != 0)).any(axis=0) | (
            step[:, 1:] != 0
        ).all(axis=0)
        index = np.flatnonzero(keep)
        if len(index) > most:
            rates = np.nan_to_num(np.stack([self.tpr[index], self.fpr[index]]))
            moved = (np.diff(np.floor(rates * (most // 2))) != 0).any(axis=0)
            moved[-1] = True
            index = index[np.concatenate([[True], moved])]
        return index


def curve_of(base: IntArray, claims: tuple[FloatArray, IntArray]) -> Curve:
    """The ROC of claims: (n,) scores, rising, and (n, 4) their effects. base: (4,) without any."""
    score, effect = claims
    counts = np.vstack([base, base + np.cumsum(effect[::-1], axis=0).reshape(-1, len(base))])
    return Curve(np.concatenate([[np.inf], score[::-1]]), *counts.T)


def ratio(part: FloatArray | IntArray, whole: FloatArray | IntArray) -> FloatArray:
    """part / whole; NaN for 0/0, infinite for more over 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(part / whole)


def area(fpr: FloatArray, tpr: FloatArray) -> FloatArray:
    """(...,) area under curves (..., points).

    1 is perfect, 0.5 is chance. Points are joined by straight lines, and the last point with
    (1, 1): beyond it every claim would be a guess. scikit-learn gives the same if frames and IDs
    without an estimate share the lowest score.
    """
    one = np.ones((*fpr.shape[:-1], 1), dtype=fpr.dtype)
    x = np.concatenate([fpr, one], axis=-1)
    y = np.concatenate([tpr, one], axis=-1)
    x0, x1, y0, y1 = x[..., :-1], x[..., 1:], y[..., :-1], y[..., 1:]
    return np.asarray(((x1 - x0) * (y0 + y1)).sum(axis=-1) / 2)


def tpr_at(fpr: FloatArray, tpr: FloatArray, most: float) -> FloatArray:
    """(...,) highest TPR among the points of curves (..., points) with an FPR of at most `most`.

    Without interpolation, since no threshold gives a point in between. NaN if a rate is NaN.
    """
    reached = np.where(fpr <= most, tpr, -np.inf).max(axis=-1)
    return np.asarray(np.where(np.isnan(tpr[..., 0]) | np.isnan(fpr[..., 0]), np.nan, reached))
