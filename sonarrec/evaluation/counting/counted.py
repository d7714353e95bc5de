"""What each unit adds to the figures of a method, and the records that metrics are functions of.

Records have one row per set of units: one of everything, or one per draw of the bootstrap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sonarrec.evaluation.counting.curves import FPR_POINTS, Curve, ratio
from sonarrec.evaluation.counting.store import Blocks, ranked
from sonarrec.records import BoolArray, FloatArray, IntArray

FPR_GRID = np.unique(
    [
        *np.arange(60) / 1000,
        *np.arange(3, 51) / 50,
        *np.outer(FPR_POINTS, np.linspace(0.8, 1.2, 17)).ravel(),
        *FPR_POINTS,
    ]
)
"""FPRs at which resampled curves are held, dense about FPR_POINTS. Reported curves are exact."""
QUANTILES = (0.5, 0.9, 0.95)
"""Shares of values that metrics may ask for: `exact_spread` holds no others."""

Claims = Iterable[tuple[FloatArray, IntArray, IntArray]]
"""(n,) scores, (n, 4) effects and (n,) units of claims, any number of them at a time."""
Values = Callable[[], Iterable[tuple[FloatArray, IntArray]]]
"""Gives (n,) values and (n,) units, any number at a time, the same each time it is called."""


@dataclass(frozen=True, slots=True)
class Counted:
    """What the units add to one kind of record, of one method under one protocol."""

    protocol: str
    method: str
    landmark_text: str
    """An ID, "none" or "total"."""
    sums: FloatArray
    """(U, C) what each unit adds."""
    record: Callable[[FloatArray], Any]
    """The record of (R, C) summed rows."""
    exact: Any
    """The record of everything, of one row; `sums` may hold it in steps."""


@dataclass(frozen=True, slots=True)
class Rates:
    """Operating points and ROCs."""

    made: FloatArray
    """(R, 4) TP, TN, FP, FN at the operating point."""
    tpr: FloatArray
    fpr: FloatArray
    """(R, points) of the ROC, from the highest threshold down."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Values, counted in steps."""

    edges: FloatArray
    """(E,) values, rising."""
    reached: FloatArray
    """(R, E) how many do not exceed each of them."""

    def quantile(self, share: float) -> FloatArray:
        """(R,) the least value that as large a share does not exceed; NaN where there is none."""
        total = self.reached[:, -1:]
        found = self.edges[np.argmax(self.reached >= share * total - 1e-3, axis=1)]  # counts: whole
        return np.where(total[:, 0] > 0, found, np.nan)


def rate_count(
    labels: tuple[str, str, str], base: IntArray, declared: IntArray, curve: Curve, claims: Claims
) -> Counted:
    """What the units add to Rates.

    labels: protocol, method, landmark_text. base, declared: (U, 4) TP, TN, FP, FN with nothing
    claimed, and at the operating point. curve: of all claims.
    """
    units, bins = len(base), len(FPR_GRID)
    # A bin per step of the FPR, so that methods with other scores can be swapped bin by bin.
    at = np.maximum(np.searchsorted(curve.fpr, FPR_GRID, side="right") - 1, 0)
    steps = np.zeros((units, 4, bins))
    steps[:, :, 0] = base
    for score, effect, unit in claims:
        if len(score):
            bin_ = np.searchsorted(-curve.threshold[at], -score, side="left")
            first = int(unit.min())  # those of one log lie side by side
            cell = (unit - first) * bins + np.minimum(bin_, bins - 1)
            size = (int(unit.max()) - first + 1) * bins
            for c in range(4):
                added = np.bincount(cell, effect[:, c], minlength=size).reshape(-1, bins)
                steps[first : first + len(added), c] += added
    # A curve of sums is the sum of curves: added up here, once, and not in each draw.
    np.cumsum(steps, axis=2, out=steps)
    return Counted(
        *labels,
        sums=np.hstack([declared, steps.reshape(units, -1)]).astype(np.float32),
        record=_rates,
        exact=Rates(declared.sum(axis=0)[None], curve.tpr[None], curve.fpr[None]),
    )


def _rates(rows: FloatArray) -> Rates:
    """From (R, 4 + 4 * bins): the operating point, then the counts at each step of the curve."""
    tp, tn, fp, fn = np.moveaxis(rows[:, 4:].reshape(len(rows), 4, -1), 1, 0)
    tpr, fpr = np.zeros((2, len(rows), tp.shape[1] + 1), dtype=rows.dtype)
    tpr[:, 1:], fpr[:, 1:] = ratio(tp, tp + fn), ratio(fp, fp + tn)
    return Rates(rows[:, :4], tpr, fpr)


def spread_count(
    labels: tuple[str, str, str], values: Values, units: int, edges: FloatArray
) -> Counted:
    """What the units add to a Spread.

    labels: protocol, method, landmark_text. edges: rising, the last one no less than any value;
    resampled values count as the next edge, so equal edges make methods comparable.
    """
    sums = np.zeros((units, len(edges)), dtype=np.float32)
    for some, unit in values():
        if len(some):
            first = int(unit.min())
            place = (unit - first) * len(edges) + np.searchsorted(edges, some)
            size = (int(unit.max()) - first + 1) * len(edges)
            added = np.bincount(place, minlength=size).reshape(-1, len(edges))
            sums[first : first + len(added)] += added
    np.cumsum(sums, axis=1, out=sums)
    exact = exact_spread(lambda: (some for some, _ in values()))
    return Counted(*labels, sums, lambda rows: Spread(edges, rows), exact)


def exact_spread(values: Blocks) -> Spread:
    """All values in steps at their QUANTILES and their largest, so that these are exact."""
    total = sum(map(len, values()))
    if not total:
        return Spread(np.zeros(1), np.zeros((1, 1)))
    least = np.ceil(np.array([*QUANTILES, 1.0]) * total - 1e-3)  # as in Spread.quantile
    reached = np.clip(least, 1, total)
    return Spread(ranked(values, reached.astype(np.int64) - 1), reached[None])


def sum_count(
    labels: tuple[str, str, str],
    record: Callable[..., Any],
    columns: Sequence[FloatArray | IntArray],
) -> Counted:
    """Plain sums. columns: (U,) each, what the units add to the record's fields, in order."""
    sums = np.stack(columns, axis=1).astype(float)
    return Counted(*labels, sums, lambda rows: record(*rows.T), record(*sums.sum(axis=0)[:, None]))


def by_landmark(ids: Sequence[int], landmark_index: IntArray) -> list[tuple[str, BoolArray]]:
    """Per ID, then in all: its name and which elements are its own."""
    named = [(str(i), landmark_index == k) for k, i in enumerate(ids)]
    return [*named, ("total", np.ones(len(landmark_index), dtype=bool))]
