"""What each unit adds to rates, curves and quantiles, and how these follow from the sums."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sonarrec.evaluation.curves import FPR_POINTS, PARTIAL_FPR, area, ratio, tpr_at
from sonarrec.evaluation.passes import Units
from sonarrec.evaluation.scoring import Scored
from sonarrec.evaluation.uncertainty import Figure, Tally, intervals
from sonarrec.records import FloatArray, IntArray

RATES = ("tpr", "fpr")
CURVES = ("auc", f"pauc_{PARTIAL_FPR:g}", *(f"tpr_at_fpr_{fpr:g}" for fpr in FPR_POINTS))
FPR_GRID = np.unique(
    [
        *np.arange(60) / 1000,
        *np.arange(3, 51) / 50,
        *np.outer(FPR_POINTS, np.linspace(0.8, 1.2, 17)).ravel(),
        *FPR_POINTS,
    ]
)
"""Steps at which resampled curves are held, close about FPR_POINTS. The curves told are exact."""


def rate_tallies(scored: Scored, units: Units) -> list[Tally]:
    """TPR and FPR at the operating point and figures of the ROC: per ID, then in total."""
    base = scored.base_by(units.of_frame, units.of_truth, units.count)
    declared = scored.declared_by(units.of_frame, units.of_truth, units.count)
    group = scored.claims_by(units.of_frame, units.of_truth)
    per_id = []
    for k, landmark in enumerate(scored.ids):
        mine = np.flatnonzero(scored.landmark == k)
        per_id.append(
            _rate_tally(scored, k, str(landmark), base[:, k], declared[:, k], mine, group)
        )
    everything = np.arange(len(scored.landmark))
    total = _rate_tally(
        scored, None, "total", base.sum(axis=1), declared.sum(axis=1), everything, group
    )
    return [*per_id, total]


def _rate_tally(
    scored: Scored,
    k: int | None,
    landmark: str,
    base: IntArray,
    declared: IntArray,
    claims: IntArray,
    group: IntArray,
) -> Tally:
    """base, declared: (U, 4). claims: indices of those that the figures are about."""
    count, curve = scored.count(k), scored.curve(k)
    units = len(base)
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
    with_positives = int(np.count_nonzero(base[:, 3]))
    with_negatives = int(np.count_nonzero(declared[:, 1] + declared[:, 2]))
    both = min(with_positives, with_negatives)
    return Tally(
        protocol=scored.protocol,
        method=scored.method,
        landmark=landmark,
        names=RATES + CURVES,
        values=(
            count.tpr,
            count.fpr,
            curve.area(),
            curve.area(PARTIAL_FPR),
            *(curve.tpr_at(fpr) for fpr in FPR_POINTS),
        ),
        cases=(with_positives, with_negatives, *(both for _ in CURVES)),
        sums=np.hstack([declared, steps]).astype(np.float32),
        figures=_rate_figures,
    )


def _rate_figures(rows: FloatArray) -> FloatArray:
    """(R, RATES + CURVES) from (R, 4 + 4 * bins): operating point, then the curve's steps."""
    made = rows[:, :4]
    tp, tn, fp, fn = np.moveaxis(np.cumsum(rows[:, 4:].reshape(len(rows), 4, -1), axis=2), 1, 0)
    start = np.zeros((len(rows), 1), dtype=rows.dtype)
    tpr = np.hstack([start, ratio(tp, tp + fn)])
    fpr = np.hstack([start, ratio(fp, fp + tn)])
    return np.stack(
        [
            ratio(made[:, 0], made[:, 0] + made[:, 3]),
            ratio(made[:, 2], made[:, 2] + made[:, 1]),
            area(fpr, tpr),
            area(fpr, tpr, PARTIAL_FPR),
            *(tpr_at(fpr, tpr, most) for most in FPR_POINTS),
        ],
        axis=1,
    )


def macro(per_id: Sequence[Tally], drawn: Sequence[FloatArray]) -> list[Figure]:
    """The mean of each figure over the IDs that have it; drawn: the replicates of each ID's."""
    mean = Tally(
        protocol=per_id[0].protocol,
        method=per_id[0].method,
        landmark="macro",
        names=per_id[0].names,
        values=tuple(_mean_of_known(np.array([t.values for t in per_id])).tolist()),
        cases=tuple(max(cases) for cases in zip(*(t.cases for t in per_id), strict=True)),
        sums=np.empty((0, 0)),
        figures=_mean_of_known,
    )
    return intervals(mean, mean.figures(np.stack(drawn)))


def _mean_of_known(values: FloatArray) -> FloatArray:
    """Mean over the first axis of what is not NaN; NaN where nothing is."""
    known = ~np.isnan(values)
    return ratio(np.where(known, values, 0).sum(axis=0), known.sum(axis=0))


def ratio_tally(
    labels: tuple[str, str, str],
    names: tuple[str, ...],
    parts: Sequence[FloatArray],
    wholes: Sequence[FloatArray],
) -> Tally:
    """Figures that are sum(part) / sum(whole), each (U,) per unit.

    labels: protocol, method, landmark.
    """
    n = len(names)
    sums = np.stack([*parts, *wholes], axis=1).astype(float)

    def figures(rows: FloatArray) -> FloatArray:
        return ratio(rows[:, :n], rows[:, n:])

    values = figures(sums.sum(axis=0)[None])[0]
    return Tally(
        *labels,
        names=names,
        values=tuple(values.tolist()),
        cases=tuple(np.count_nonzero(sums[:, n:], axis=0).tolist()),
        sums=sums,
        figures=figures,
    )


def quantile_tally(
    labels: tuple[str, str, str],
    names: tuple[str, ...],
    shares: tuple[float, ...],
    values: FloatArray,
    unit: IntArray,
    units: int,
    edges: FloatArray,
) -> Tally:
    """The quantiles at `shares` of values (n,) that lie in units (n,): the least value that as
    large a share does not exceed.

    labels: protocol, method, landmark. edges: rising, the last one no less than any value;
    resampled values count as the next edge, so equal edges make methods comparable.
    """
    place = unit * len(edges) + np.searchsorted(edges, values)
    sums = np.bincount(place, minlength=units * len(edges)).reshape(units, -1).astype(np.float32)

    def figures(rows: FloatArray) -> FloatArray:
        reached = np.cumsum(rows, axis=1)
        total = reached[:, -1:]
        found = [
            edges[np.argmax(reached >= share * total - 1e-3, axis=1)]  # counts are whole
            for share in shares
        ]
        return np.where(total > 0, np.stack(found, axis=1), np.nan)

    exact = [
        float(np.quantile(values, share, method="inverted_cdf")) if len(values) else np.nan
        for share in shares
    ]
    cases = len(np.unique(unit))
    return Tally(
        *labels,
        names=names,
        values=tuple(exact),
        cases=tuple(cases for _ in names),
        sums=sums,
        figures=figures,
    )
