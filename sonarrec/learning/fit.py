"""The most likely curves of an appearance model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, FloatArray
from sonarrec.errors import SonarrecError
from sonarrec.learning.samples import Samples
from sonarrec.recogniser.stage3.model import AppearanceModel, smeared_share

KNOTS = 8  # of a curve, at quantiles of what was seen
# Penalties, in samples: on a curve's values, and on their second differences.
RIDGE = 0.1
SMOOTHNESS = 10.0
# The penalties' factor where they are on the differences from a prior. It is large because the
# frames of a track share a memory of 40 (features.memory_frames), and say hardly more than one
# would. 900 does next to no harm with a recording or two, and helps where landmarks look unlike the
# simulator's; with 120 two recordings do harm there.
PRIOR_WEIGHT = 900.0
AT_ONCE = 2000
"""Samples whose hat functions are in memory together: a few times 10 kB each."""


def fit(
    recordings: Sequence[Samples],
    prior: AppearanceModel | None = None,
    prior_weight: float = PRIOR_WEIGHT,
) -> AppearanceModel:
    """Most likely curves, by Newton's method on the concave penalised log likelihood.

    The curves of smeared pictures are those of sharp ones plus what the smear adds. Both parts have
    the same penalty, so without smeared pictures nothing is added. The recordings may differ in
    their number of IDs. prior: a model; the penalty is then on the differences from its curves,
    times `prior_weight`. Raises SonarrecError where the recordings hold no landmark, or nothing but
    landmarks.
    """
    labelled = [r for r in recordings if len(r.label)]
    on = sum(np.count_nonzero(r.label < r.features.shape[1]) for r in labelled)
    total = sum(len(r.label) for r in labelled)
    if not 0 < on < total:
        what = "no landmark" if on == 0 else "nothing but landmarks"
        raise SonarrecError(
            f"tracks lie on {what} in all {total} cases; a model needs landmarks and other objects"
        )
    if prior is None:
        features = np.concatenate([r.features.reshape(-1, r.features.shape[2]) for r in labelled])
        shares = np.linspace(0.01, 0.99, KNOTS)
        knots = tuple(np.unique(np.quantile(values, shares).round(2)) for values in features.T)
        penalty = np.kron(np.eye(2), _penalty(knots))
        centre: FloatArray = np.zeros(len(penalty))
    else:
        knots = prior.knots
        penalty = prior_weight * np.kron(np.eye(2), _penalty(knots, bias=RIDGE))
        sharp, smeared = np.concatenate([prior.bias[:, None], *prior.values], axis=1)
        centre = np.concatenate([sharp, smeared - sharp])
    best = _most_likely(labelled, knots, penalty, centre)
    both = best.reshape(2, -1).cumsum(axis=0)  # sharp, smeared
    ends = np.cumsum([1] + [len(k) for k in knots])
    values = [both[:, a:b] for a, b in pairwise(ends)]
    # Of a curve and the bias only the sum counts: curves are stated with mean 0.
    means = [v.mean(axis=1) for v in values]
    bias = both[:, 0] + np.sum(means, axis=0)
    return AppearanceModel(
        bias, knots, tuple(v - m[:, None] for v, m in zip(values, means, strict=True))
    )


def _most_likely(
    recordings: Sequence[Samples],
    knots: Sequence[FloatArray],
    penalty: FloatArray,
    centre: FloatArray,
) -> FloatArray:
    """(2 D,) the curves of least loss, as `_likelihood` has them, by Newton's method.

    penalty: (2 D, 2 D) quadratic form of what they differ by from `centre`, (2 D,).
    """
    best = curves = centre
    least, step = np.inf, np.zeros_like(centre)
    for _ in range(60):
        loss, gradient, curvature = _likelihood(recordings, knots, curves)
        slope = penalty @ (curves - centre)
        loss += 0.5 * float((curves - centre) @ slope)
        if loss > least + 1e-6 * abs(least):  # far from the minimum Newton's step overshoots
            step = step / 2
        else:
            gained, least, best = least - loss, loss, curves
            if gained < 1e-6 * abs(loss):
                break
            step = np.linalg.solve(curvature + penalty, gradient - slope)
            step = step / max(1.0, float(np.abs(step).max()) / 5)  # no curve by more than 5
        curves = best + step
    return best


def _basis(features: FloatArray, knots: Sequence[FloatArray]) -> npt.NDArray[np.float32]:
    """(n, K, D) of features (n, K, F): 1, then the hat functions at every curve's knots."""
    hats = [np.ones((*features.shape[:2], 1), np.float32)]
    for i, values in enumerate(knots):
        row = np.arange(len(values))
        index = np.interp(features[:, :, i], values, row)  # among the knots, between two of them
        hats.append(np.maximum(1 - np.abs(index[..., None] - row), 0).astype(np.float32))
    return np.concatenate(hats, axis=2)


def _penalty(knots: Sequence[FloatArray], bias: float = 1e-3) -> FloatArray:
    """(D, D) quadratic form: RIDGE on every value, SMOOTHNESS on every second difference."""
    form = np.diag([bias] + [RIDGE] * sum(map(len, knots)))
    start = 1
    for values in knots:
        bend, end = np.diff(np.eye(len(values)), 2, axis=0), start + len(values)
        form[start:end, start:end] += SMOOTHNESS * bend.T @ bend
        start = end
    return form


def _likelihood(
    recordings: Sequence[Samples], knots: Sequence[FloatArray], curves: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Minus the log likelihood, its negative gradient (2 D,) and its curvature (2 D, 2 D).

    curves: (2 D,) those of sharp pictures, then what the smear adds.
    """
    size = len(curves)
    loss, gradient, curvature = 0.0, np.zeros(size), np.zeros((size, size))
    blocks = ((r, first) for r in recordings for first in range(0, len(r.label), AT_ONCE))
    for recording, first in blocks:
        samples = part_of(recording, slice(first, first + AT_ONCE))
        # Made again in every step: kept, they are thirty times as large as the features.
        x = _basis(samples.features, knots)
        n, ids, _ = x.shape
        share = smeared_share(samples.smear).astype(np.float32)
        if share.any():  # else the smear adds nothing: half as wide is four times as quick
            x = np.concatenate([x, x * share[:, None, None]], axis=2)
        width = x.shape[2]
        # 'None of these' is the reference: its log odds are 0.
        logits = np.concatenate([x @ curves[:width], np.zeros((n, 1))], axis=1)
        top = logits.max(axis=1, keepdims=True)
        p = np.exp(logits - top)
        total = p.sum(axis=1, keepdims=True)
        p = (p / total)[:, :ids]
        rows = np.flatnonzero(samples.label < ids)
        label = samples.label[rows]
        loss += float((top + np.log(total)).sum() - logits[rows, label].sum())
        expected = np.einsum("nk,nkd->nd", p, x)
        gradient[:width] += x[rows, label].sum(axis=0, dtype=float) - expected.sum(axis=0)
        weighted = (x * np.sqrt(p)[..., None]).reshape(-1, width)
        curvature[:width, :width] += weighted.T @ weighted - expected.T @ expected
    return loss, gradient, curvature


def part_of(samples: Samples, which: BoolArray | slice) -> Samples:
    """The samples that an (n,) mask or a slice chooses."""
    return Samples(*(getattr(samples, f.name)[which] for f in fields(Samples)))
