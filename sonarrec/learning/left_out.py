"""How well a learned model judges what it was not learned from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.learning.fit import fit
from sonarrec.learning.samples import Samples
from sonarrec.recogniser.stage3.model import AppearanceModel, built_in_model

FOLDS = 5
"""Parts of the landmarks and other tracks; each is left out once, to measure the model on it. With
fewer tracks of landmarks, or of others, the model is not measured."""


def gain_on_the_rest(
    parts: Sequence[Samples], prior: AppearanceModel | None
) -> tuple[float, float, float] | None:
    """Mean log likelihood by the built-in model and by models learned from the rest, and the
    standard error of the difference.

    The landmarks, each with all its tracks, and the other tracks are dealt into FOLDS parts; the
    two kinds are dealt separately, so that every part has both where there are enough. A landmark
    is an ID of a log: seen again in another track, it looks as it did. None with fewer than FOLDS
    tracks of either, and with one landmark.
    """
    # Of each log the unit, a landmark or other track, that each sample shows, numbered over all.
    units, kinds, tracks, count = [], [], np.zeros(2, int), 0
    for part in parts:
        ids = part.features.shape[1]
        numbers, track = np.unique(part.track, return_inverse=True)
        shown = np.full(len(numbers), ids)  # the first ID that each track shows
        np.minimum.at(shown, track, part.label)
        tracks += np.bincount(shown < ids, minlength=2)
        key = np.where(shown < ids, shown, ids + np.arange(len(shown)))
        keys, unit = np.unique(key[track], return_inverse=True)
        units.append(count + unit)
        kinds.append(keys < ids)
        count += len(keys)
    is_landmark = np.concatenate(kinds)
    if tracks.min() < FOLDS or np.count_nonzero(is_landmark) < 2:
        return None
    fold_of = np.empty(len(is_landmark), np.int64)
    for kind in (False, True):
        mine = np.flatnonzero(is_landmark == kind)
        fold_of[mine] = np.arange(len(mine)) % FOLDS
    folds = [fold_of[unit] for unit in units]
    built_in = built_in_model()
    before, after, of_unit = [], [], []
    for k in range(FOLDS):
        taught = [part_of(p, fold != k) for p, fold in zip(parts, folds, strict=True)]
        left_out = [part_of(p, fold == k) for p, fold in zip(parts, folds, strict=True)]
        learned = fit(taught, prior)
        before += [_log_likelihood(built_in, p) for p in left_out]
        after += [_log_likelihood(learned, p) for p in left_out]
        of_unit += [unit[fold == k] for unit, fold in zip(units, folds, strict=True)]
    was, now = np.concatenate(before), np.concatenate(after)
    error = _standard_error(now - was, np.concatenate(of_unit))
    return float(was.mean()), float(now.mean()), error


def _standard_error(values: FloatArray, cluster: IntArray) -> float:
    """Standard error of the mean of (n,) values that depend on each other within a cluster.

    cluster: (n,) numbers from 0, without a gap; two or more.
    """
    sums = np.bincount(cluster, values - values.mean())
    count = len(sums)
    return float(np.sqrt(count / (count - 1) * np.sum(sums**2)) / len(values))


def part_of(samples: Samples, mask: BoolArray) -> Samples:
    """The samples that an (n,) mask chooses."""
    return Samples(*(getattr(samples, f.name)[mask] for f in fields(Samples)))


def _log_likelihood(model: AppearanceModel, samples: Samples) -> FloatArray:
    """(n,) log probability of each sample's label."""
    likely = model.probabilities(samples.features, samples.smear)
    of_truth = likely[np.arange(len(samples.label)), samples.label]
    return np.asarray(np.log(np.maximum(of_truth, 1e-12)))
