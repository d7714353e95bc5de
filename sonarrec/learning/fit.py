"""Adapts the reader's last layer to labelled recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, selected
from sonarrec.errors import SonarrecError
from sonarrec.learning.samples import Samples
from sonarrec.recogniser.stage3.reader import LAST_LAYER, Reader, Weights, blocks

# Weight of the prior, in frames: on the squared change of each gain and bias, as the root mean
# square of what it does to log beliefs. The frames of a track share a memory of 40
# (features.memory_frames), and say hardly more than one would. Chosen of 10, 30 and 100 on
# recordings of four sites, each read by a model of the site's others, and by those of other sites.
PRIOR_WEIGHT = 30.0
LEAST_SPREAD = 1e-3
LEAST_STEP = 1e-3
"""Of a gain or bias; slopes are differences over it."""
MOST_STEPS = 50


def fit(
    recordings: Sequence[Samples],
    built_in: Weights,
    codes: FloatArray,
    prior_weight: float = PRIOR_WEIGHT,
) -> Weights:
    """The weights with the likeliest gain and bias of each output of the last layer.

    These six numbers say how faint the symbols are and how common discs are. To change each of the
    last layer's weights fits the recordings themselves better, and others of their site worse than
    the built-in reader does (`sonarrec help contribute`). The maximum of the penalised likelihood
    is found by Fisher's scoring; steps are halved until the likelihood rises.
    codes: (ANGLES, K, ANGLES) from `rotated_codes`. Raises SonarrecError where the recordings hold
    no landmark, or nothing but landmarks.
    """
    reader, ids = Reader(built_in, codes), codes.shape[1]
    label = np.concatenate([r.label for r in recordings])
    on, every = np.count_nonzero(label < ids), np.arange(len(label))
    if not 0 < on < len(label):
        what = "no landmark" if on == 0 else "nothing but landmarks"
        raise SonarrecError(
            f"tracks lie on {what} in all {len(label)} cases; a model needs landmarks and other "
            "objects"
        )
    outputs = [
        reader.last_layer(selected(r.pictures, rows))
        for r in recordings
        for rows in blocks(len(r.label))
    ]

    def log_probabilities(change: FloatArray) -> FloatArray:
        """(n, K + 1) log beliefs with these changes of the gains, then of the biases."""
        gain, bias = 1 + change[: len(LAST_LAYER)], change[len(LAST_LAYER) :]
        logs = []
        for lit, disc, other in outputs:
            lit_now = gain[0] * lit + bias[0] * (lit != 0)  # 0 where nothing was seen
            now = reader.judged(lit_now, gain[1] * disc + bias[1], gain[2] * other + bias[2])
            logs.append(now.log_beliefs)
        joined = np.concatenate(logs)
        return np.asarray(joined - np.logaddexp.reduce(joined, axis=1, keepdims=True))

    def with_slopes(change: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The log beliefs, and (n, K + 1, 6) their slopes along each change."""
        log_p = log_probabilities(change)
        moved = [log_probabilities(change + by) for by in LEAST_STEP * np.eye(len(change))]
        return log_p, np.stack([other - log_p for other in moved], axis=-1) / LEAST_STEP

    change: FloatArray = np.zeros(2 * len(LAST_LAYER))
    log_p, slopes = with_slopes(change)
    # A change counts by what it does to beliefs, for the outputs differ in size.
    penalty = prior_weight * ((slopes**2).mean(axis=(0, 1)) + LEAST_SPREAD**2)

    def loss(change: FloatArray) -> float:
        return float(penalty @ change**2 / 2 - log_probabilities(change)[every, label].sum())

    least = loss(change)
    for _ in range(MOST_STEPS):
        weighted = slopes * np.exp(log_p / 2)[..., None]
        information = np.einsum("nkd,nke->de", weighted, weighted) + np.diag(penalty)
        gradient = slopes[every, label].sum(axis=0) - penalty * change
        step = np.linalg.solve(information, gradient)
        while (new := loss(change + step)) > least and np.abs(step).max() > LEAST_STEP:
            step = step / 2
        if new > least - 1e-6 * abs(least):
            break
        change, least = change + step, new
        log_p, slopes = with_slopes(change)
    return _changed(built_in, change)


def _changed(weights: Weights, change: FloatArray) -> Weights:
    """The weights with other gains and biases of the last layer's outputs."""
    changed = dict(weights)
    for name, gain, bias in zip(LAST_LAYER, *change.reshape(2, -1), strict=True):
        changed[name] = (1 + gain) * weights[name]
        changed[name][-1] += bias
    return changed


def part_of(samples: Samples, which: BoolArray) -> Samples:
    """The samples that an (n,) mask chooses."""
    return Samples(selected(samples.pictures, which), samples.label[which], samples.track[which])
