"""What each unit adds to the figures of a method, and the records that metrics are functions of.

Records have one row per set of units: one of everything, or one per draw of the bootstrap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sonarrec.evaluation.curves import FPR_POINTS, ratio
from sonarrec.evaluation.joined import Joined
from sonarrec.evaluation.passes import Units
from sonarrec.evaluation.scoring import Scored
from sonarrec.records import BoolArray, FloatArray, IntArray

FPR_GRID = np.unique(
    [
        *np.arange(60) / 1000,
        *np.arange(3, 51) / 50,
        *np.outer(FPR_POINTS, np.linspace(0.8, 1.2, 17)).ravel(),
        *FPR_POINTS,
    ]
)
"""Steps at which resampled curves are held, close about FPR_POINTS. The curves told are exact."""


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


def rate_counts(scored: Scored, units: Units) -> list[Counted]:
    """Rates at the operating point and the ROC: per ID, then in total."""
    base = scored.base_by(units.of_frame, units.of_truth, units.count)
    declared = scored.declared_by(units.of_frame, units.of_truth, units.count)
    group = scored.claims_by(units.of_frame, units.of_truth)
    found = [
        _rate_count(scored, k, str(landmark), base[:, k], declared[:, k], group)
        for k, landmark in enumerate(scored.ids)
    ]
    whole = base.sum(axis=1), declared.sum(axis=1)
    return [*found, _rate_count(scored, None, "total", *whole, group)]


def _rate_count(
    scored: Scored,
    k: int | None,
    landmark_text: str,
    base: IntArray,
    declared: IntArray,
    group: IntArray,
) -> Counted:
    """k: index of an ID, None for all. base, declared: (U, 4). group: (n,) the claims' units."""
    mine = np.ones(len(group), dtype=bool) if k is None else scored.landmark_index == k
    claims, curve, units = np.flatnonzero(mine), scored.curve(k), len(base)
    # A bin per step of the FPR, so that methods with other scores can be swapped bin by bin.
    at = np.maximum(np.searchsorted(curve.fpr, FPR_GRID, side="right") - 1, 0)
    bins = np.searchsorted(-curve.threshold[at], -scored.score[claims], side="left")
    bins = np.minimum(bins, len(FPR_GRID) - 1)
    cell = group[claims] * len(FPR_GRID) + bins
    size = units * len(FPR_GRID)
    steps = np.hstack(
        [
            np.bincount(cell, scored.effect[claims, c], minlength=size).reshape(units, -1)
            for c in range(4)
        ]
    )
    steps[:, :: len(FPR_GRID)] += base
    return Counted(
        protocol=scored.protocol,
        method=scored.method,
        landmark_text=landmark_text,
        sums=np.hstack([declared, steps]).astype(np.float32),
        record=_rates,
        exact=Rates(declared.sum(axis=0)[None], curve.tpr[None], curve.fpr[None]),
    )


def _rates(rows: FloatArray) -> Rates:
    """From (R, 4 + 4 * bins): the operating point, then what each step of the curve adds."""
    tp, tn, fp, fn = np.moveaxis(np.cumsum(rows[:, 4:].reshape(len(rows), 4, -1), axis=2), 1, 0)
    start = np.zeros((len(rows), 1), dtype=rows.dtype)
    return Rates(
        rows[:, :4],
        np.hstack([start, ratio(tp, tp + fn)]),
        np.hstack([start, ratio(fp, fp + tn)]),
    )


def spread_count(
    labels: tuple[str, str, str],
    values: FloatArray,
    unit: IntArray,
    units: int,
    edges: FloatArray,
) -> Counted:
    """Values (n,) that lie in units (n,).

    labels: protocol, method, landmark_text. edges: rising, the last one no less than any value;
    resampled values count as the next edge, so equal edges make methods comparable.
    """
    place = unit * len(edges) + np.searchsorted(edges, values)
    sums = np.bincount(place, minlength=units * len(edges)).reshape(units, -1).astype(np.float32)
    own, count = np.unique(values, return_counts=True)
    exact = (
        Spread(own, np.cumsum(count, dtype=float)[None])
        if len(own)
        else Spread(edges[:1], np.zeros((1, 1)))
    )
    return Counted(*labels, sums, lambda rows: Spread(edges, np.cumsum(rows, axis=1)), exact)


def sum_count(
    labels: tuple[str, str, str],
    record: Callable[..., Any],
    columns: Sequence[FloatArray | IntArray],
) -> Counted:
    """Plain sums: columns, (U,) each, are what the units add to the fields of the record."""
    sums = np.stack(columns, axis=1).astype(float)
    return Counted(*labels, sums, lambda rows: record(*rows.T), record(*sums.sum(axis=0)[:, None]))


def by_landmark(joined: Joined, landmark_index: IntArray) -> list[tuple[str, BoolArray]]:
    """Per ID, then in all: its name and which elements are its own."""
    named = [(str(i), landmark_index == k) for k, i in enumerate(joined.ids)]
    return [*named, ("total", np.ones(len(landmark_index), dtype=bool))]
