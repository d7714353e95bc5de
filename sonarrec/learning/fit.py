"""Adapts the reader's last layer to labelled recordings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray, selected
from sonarrec.errors import SonarrecError
from sonarrec.learning.samples import Samples
from sonarrec.recogniser.stage3.reader import LAST_LAYER, Pictures, Reader, Weights, sigmoid

# Weight of the prior, in frames: on the squared change of each weight, as the root mean square of
# what it does to log beliefs. The frames of a track share a memory of 40 (features.memory_frames),
# and say hardly more than one would.
PRIOR_WEIGHT = 300.0
LEAST_SPREAD = 1e-3
AT_ONCE = 500
"""Samples whose layers, or curvatures, are in memory together."""


def fit(
    recordings: Sequence[Samples],
    built_in: Weights,
    codes: FloatArray,
    prior_weight: float = PRIOR_WEIGHT,
) -> Weights:
    """The weights with the likeliest last layer, near the built-in one.

    Beliefs are taken as linear in the last layer, with every rotation as likely as the built-in
    reader has it. So the penalised log likelihood is concave, and Newton's method finds its one
    maximum. codes: (ANGLES, K, ANGLES) from `rotated_codes`. Raises SonarrecError where the
    recordings hold no landmark, or nothing but landmarks.
    """
    reader, ids = Reader(built_in, codes), codes.shape[1]
    label = np.concatenate([r.label for r in recordings])
    on, total = np.count_nonzero(label < ids), len(label)
    if not 0 < on < total:
        what = "no landmark" if on == 0 else "nothing but landmarks"
        raise SonarrecError(
            f"tracks lie on {what} in all {total} cases; a model needs landmarks and other objects"
        )
    size = sum(len(built_in[name]) for name in LAST_LAYER)
    logs, slopes = np.empty((total, ids + 1)), np.empty((total, ids + 1, size), np.float32)
    end = 0
    for recording in recordings:
        for rows in _blocks(len(recording.label)):
            block = slice(end, end := end + rows.stop - rows.start)
            logs[block], slopes[block] = _linear(reader, part_of(recording, rows).pictures)
    # A change counts by what it does to beliefs, for the layers' results differ in size.
    spread = np.sqrt(np.einsum("nkd,nkd->d", slopes, slopes) / (total * (ids + 1))) + LEAST_SPREAD
    slopes /= spread
    change = _most_likely(logs, slopes, label, prior_weight) / spread
    weights, start = dict(built_in), 0
    for name in LAST_LAYER:
        end = start + len(built_in[name])
        weights[name] = built_in[name] + change[start:end]
        start = end
    return weights


def _linear(reader: Reader, pictures: Pictures) -> tuple[FloatArray, FloatArray]:
    """(n, K + 1) log beliefs by the reader, and (n, K + 1, D) their slopes along LAST_LAYER."""
    of_directions, of_object = reader.layers(pictures)
    reading = reader.reading(of_directions, of_object)
    lit, scale = reading.lit, reader.scale
    ids = reading.rotation.shape[1]
    free = sigmoid(reading.free)[:, None]  # the share of 'none' that is a free symbol
    directions = np.concatenate(
        [
            reader.expected_codes(lit) - sigmoid(lit)[:, None],
            (free * sigmoid(-np.abs(lit)) * np.sign(lit))[:, None],
        ],
        axis=1,
    )
    of_lit = scale * directions @ of_directions
    of_disc = np.repeat(of_object[:, None], ids + 1, axis=1)
    of_disc[:, -1] *= free
    of_other = np.zeros_like(of_disc)
    of_other[:, -1] = free * of_object
    slopes = np.concatenate([of_lit, of_disc, of_other], axis=2).astype(np.float32)
    return reading.log_beliefs, slopes


def _most_likely(
    logs: FloatArray, slopes: FloatArray, label: IntArray, prior_weight: float
) -> FloatArray:
    """(D,) the change of the last layer that makes the labels (n,) likeliest."""
    n, _, size = slopes.shape
    step: FloatArray = np.zeros(size)
    best, change, least = step, step, np.inf
    for _ in range(60):
        logits = logs + np.concatenate([slopes[rows] @ change for rows in _blocks(n)])
        top = logits.max(axis=1, keepdims=True)
        p = np.exp(logits - top)
        total = p.sum(axis=1, keepdims=True)
        p /= total
        loss = float((top + np.log(total)).sum() - logits[np.arange(n), label].sum())
        loss += 0.5 * prior_weight * float(change @ change)
        if loss > least + 1e-9 * abs(least):  # far from the minimum Newton's step overshoots
            step = step / 2
        else:
            gained, least, best = least - loss, loss, change
            if gained < 1e-7 * abs(loss):
                break
            gradient = -prior_weight * change
            curvature = prior_weight * np.eye(size)
            for rows in _blocks(n):
                block, likely = slopes[rows], p[rows]
                expected = np.einsum("nk,nkd->nd", likely, block)
                gradient += block[np.arange(len(block)), label[rows]].sum(axis=0)
                gradient -= expected.sum(axis=0)
                weighted = (block * np.sqrt(likely)[..., None]).reshape(-1, size)
                curvature += weighted.T @ weighted - expected.T @ expected
            step = np.linalg.solve(curvature, gradient)
        change = best + step
    return best


def _blocks(n: int) -> Iterator[slice]:
    """Slices of AT_ONCE of n samples."""
    return (slice(first, min(first + AT_ONCE, n)) for first in range(0, n, AT_ONCE))


def part_of(samples: Samples, which: BoolArray | slice) -> Samples:
    """The samples that an (n,) mask or a slice chooses."""
    return Samples(selected(samples.pictures, which), samples.label[which], samples.track[which])
