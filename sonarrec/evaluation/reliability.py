"""Calibration: whether what is said to be 90 % sure is right nine times in ten."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonarrec.evaluation.curves import ratio
from sonarrec.evaluation.joined import Joined
from sonarrec.evaluation.passes import Units
from sonarrec.evaluation.uncertainty import Tally
from sonarrec.records import BoolArray, FloatArray, IntArray

BINS = 10
CALIBRATION = ("brier", "ece")


@dataclass(frozen=True, slots=True)
class Reliability:
    """One method's probabilities against what was there, in BINS equal steps from 0 to 1.

    landmark: an ID, "none", or "top": the most probable of all, none of these among them.
    count: (BINS,) estimates. mean: their mean probability. right: the share that was so; both
    NaN in empty bins.
    """

    method: str
    landmark: str
    count: IntArray
    mean: FloatArray
    right: FloatArray


def reliability(
    joined: Joined, nearest: IntArray, units: Units
) -> tuple[list[Reliability], list[Tally]]:
    """Reliability curves, and Brier score and expected calibration error (ECE) as tallies.

    nearest: (N,) of behaviour.on_truth; an estimate is of the landmark it lies on, else of none.
    Estimates on a landmark partly in view are left out, as in the rates, and so are those
    without probabilities. Per ID and for "none" the Brier score is the mean of (p - y)^2; under
    "total" it is their sum (Brier's own form, 0 to 2), and the ECE that of the most probable.
    """
    k = len(joined.ids)
    used = np.asarray(~np.isnan(joined.probability).any(axis=1))
    on_one = nearest >= 0
    outcome = np.full(len(nearest), k)
    unit = units.of_frame[joined.claim_frame]
    if len(joined.truth_landmark):
        outcome[on_one] = joined.truth_landmark[nearest[on_one]]
        used[on_one] &= joined.truth_positive[nearest[on_one]]
        unit = np.where(on_one, units.of_truth[nearest], unit)

    curves, tallies = [], []
    for m, method in enumerate(joined.methods):
        mine = np.flatnonzero(used & (joined.method == m))
        if not len(mine):
            continue
        p, y, u = joined.probability[mine], outcome[mine], unit[mine]
        squares = np.zeros(units.count)
        for c, label in enumerate([*map(str, joined.ids), "none"]):
            mean, was = p[:, c], y == c
            sums, square = _sums(mean, was, u, units.count)
            squares += square
            curves.append(_curve(method, label, sums))
            tallies.append(_tally(method, label, sums, square))
        top = p.argmax(axis=1)
        sums, _ = _sums(p.max(axis=1), top == y, u, units.count)
        curves.append(_curve(method, "top", sums))
        tallies.append(_tally(method, "total", sums, squares))
    return curves, tallies


def _sums(
    p: FloatArray, was: BoolArray, unit: IntArray, units: int
) -> tuple[FloatArray, FloatArray]:
    """(U, 3, BINS) count, sum of p and times it was so; (U,) sum of (p - was)^2."""
    cell = unit * BINS + np.minimum((p * BINS).astype(np.int64), BINS - 1)
    size = units * BINS
    table = [
        np.bincount(cell, minlength=size).astype(float),
        np.bincount(cell, p, minlength=size),
        np.bincount(cell[was], minlength=size).astype(float),
    ]
    square = np.bincount(unit, (p - was) ** 2, minlength=units).astype(float)
    return np.stack([t.reshape(units, BINS) for t in table], axis=1), square


def _curve(method: str, landmark: str, sums: FloatArray) -> Reliability:
    count, mean, right = sums.sum(axis=0)
    return Reliability(
        method, landmark, count.astype(np.int64), ratio(mean, count), ratio(right, count)
    )


def _tally(method: str, landmark: str, sums: FloatArray, square: FloatArray) -> Tally:
    rows = np.hstack([square[:, None], sums.reshape(len(sums), -1)])
    cases = int(np.count_nonzero(sums[:, 0].sum(axis=1)))
    return Tally(
        protocol="strict",
        method=method,
        landmark=landmark,
        names=CALIBRATION,
        values=tuple(_figures(rows.sum(axis=0)[None])[0].tolist()),
        cases=(cases, cases),
        sums=rows,
        figures=_figures,
    )


def _figures(rows: FloatArray) -> FloatArray:
    """(R, 2) Brier score and ECE from (R, 1 + 3 * BINS)."""
    count, mean, right = np.moveaxis(rows[:, 1:].reshape(len(rows), 3, BINS), 1, 0)
    total = count.sum(axis=1)
    return np.stack(
        [ratio(rows[:, 0], total), ratio(np.abs(mean - right).sum(axis=1), total)], axis=1
    )
