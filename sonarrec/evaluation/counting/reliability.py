"""Calibration: whether estimates of probability 0.9 are right in nine of ten cases."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.evaluation.counting.curves import ratio
from sonarrec.evaluation.counting.passes import Units
from sonarrec.evaluation.counting.unit_sums import UnitSums
from sonarrec.evaluation.matching.joined import Joined

BINS = 10
FEW = 10
"""Bins with fewer estimates are not joined by the curve: their share is too uncertain."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Estimates in BINS equal bins of the probability that they state."""

    squares: FloatArray
    """(R,) sum of (p - y)^2."""
    count: FloatArray
    """(R, BINS) estimates."""
    stated: FloatArray
    """(R, BINS) sum of their probabilities."""
    right: FloatArray
    """(R, BINS) how many are right."""


@dataclass(frozen=True, slots=True)
class Reliability:
    """A reliability curve of one method, in the bins of Calibration."""

    method: str
    landmark_text: str
    """An ID, "none", or "top": the most probable of the IDs and "none"."""
    count: IntArray
    """(BINS,) estimates."""
    mean: FloatArray
    """(BINS,) their mean probability, NaN in empty bins."""
    right: FloatArray
    """(BINS,) the share that is right, NaN in empty bins."""


def calibration(joined: Joined, nearest: IntArray, units: Units, method: int) -> FloatArray | None:
    """(U, K + 2, 1 + 3 * BINS) sums for the Brier score and the expected calibration error.

    For one method: per ID, for "none" and in total; None if it states no probabilities.
    nearest: (N,) from behaviour.on_truth; an estimate's true class is the landmark that it lies on,
    else "none". Estimates on a landmark partly in view, and those without probabilities, are left
    out. Per ID and for "none" the squares are (p - y)^2; in total they are the sum of these
    (Brier's own form, 0 to 2), and the bins are those of the most probable class.
    """
    k = len(joined.ids)
    used = np.asarray(~np.isnan(joined.probability).any(axis=1)) & (joined.method_index == method)
    on_one = nearest >= 0
    outcome = np.full(len(nearest), k)
    unit = units.of_frame[joined.claim_frame_index]
    if len(joined.truth_landmark_index):
        outcome[on_one] = joined.truth_landmark_index[nearest[on_one]]
        used[on_one] &= joined.truth_positive[nearest[on_one]]
        unit = np.where(on_one, units.of_truth[nearest], unit)
    of_method = np.flatnonzero(used)
    if not len(of_method):
        return None
    p, y, u = joined.probability[of_method], outcome[of_method], unit[of_method]
    squares = np.zeros(units.count)
    rows = []
    for c in range(k + 1):
        steps, square = _sums(p[:, c], y == c, u, units.count)
        squares += square
        rows.append(_row(square, steps))
    steps, _ = _sums(p.max(axis=1), p.argmax(axis=1) == y, u, units.count)
    return np.stack([*rows, _row(squares, steps)], axis=1)


def calibration_counts(method: str, ids: Sequence[int], rows: FloatArray) -> Iterator[UnitSums]:
    """Calibration per ID, for "none" and in total. rows: from `calibration`."""
    for c, name in enumerate([*map(str, ids), "none", "total"]):
        sums = np.ascontiguousarray(rows[:, c])
        exact = _calibration(sums.sum(axis=0)[None])
        yield UnitSums("strict", method, name, sums, _calibration, exact)


def reliability(sums: Iterable[UnitSums]) -> Iterator[Reliability]:
    """The curves of records from `calibration_counts`."""
    for unit_sums in sums:
        count, stated, right = (
            a[0] for a in (unit_sums.exact.count, unit_sums.exact.stated, unit_sums.exact.right)
        )
        name = "top" if unit_sums.landmark_text == "total" else unit_sums.landmark_text
        mean, share = ratio(stated, count), ratio(right, count)
        yield Reliability(unit_sums.method, name, count.astype(np.int64), mean, share)


def _sums(
    p: FloatArray, was: BoolArray, unit: IntArray, units: int
) -> tuple[FloatArray, FloatArray]:
    """(U, 3, BINS) count, sum of p and how many are right; (U,) sum of (p - was)^2."""
    cell = unit * BINS + np.minimum((p * BINS).astype(np.int64), BINS - 1)
    size = units * BINS
    table = [
        np.bincount(cell, minlength=size).astype(float),
        np.bincount(cell, p, minlength=size),
        np.bincount(cell[was], minlength=size).astype(float),
    ]
    square = np.bincount(unit, (p - was) ** 2, minlength=units).astype(float)
    return np.stack([t.reshape(units, BINS) for t in table], axis=1), square


def _row(square: FloatArray, steps: FloatArray) -> FloatArray:
    return np.hstack([square[:, None], steps.reshape(len(steps), -1)])


def _calibration(rows: FloatArray) -> Calibration:
    """The record of (R, 1 + 3 * BINS) rows."""
    return Calibration(rows[:, 0], *np.moveaxis(rows[:, 1:].reshape(len(rows), 3, BINS), 1, 0))
