"""Figures besides rates: frames to a lasting ID, kinds of false claims, switches of ID and track,
errors of position and orientation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.evaluation.counting.histogram import Table, sum_by_value, values_at_ranks
from sonarrec.evaluation.counting.passes import Passes, Units
from sonarrec.evaluation.counting.scoring import Scored
from sonarrec.evaluation.counting.unit_sums import (
    Blocks,
    UnitSums,
    by_landmark,
    histogram_sums,
    plain_sums,
)
from sonarrec.evaluation.matching.joined import Joined, distance, nearest_truth
from sonarrec.nouns import follows


@dataclass(frozen=True, slots=True)
class PassOutcomes:
    """How one method did in each of P passes under one protocol."""

    protocol: str
    method: str
    frames: IntArray
    """(P,) frames with the whole landmark in view."""
    right: IntArray
    """(P,) frames of these in which it was claimed."""
    wait: FloatArray
    """(P,) frames from the first of these to the first one from which on it is claimed in all;
    infinite if it is not claimed in the last, NaN without a frame."""


@dataclass(frozen=True, slots=True)
class FalseClaims:
    """Declared claims that are not on a landmark of the claimed ID, (R,) each.

    Only frames of known duration count.
    """

    nowhere: FloatArray
    """On no landmark at all."""
    other: FloatArray
    """On a landmark of another ID."""
    minutes: FloatArray


@dataclass(frozen=True, slots=True)
class Switches:
    """Changes between neighbouring frames of a pass that have an estimate, of one method."""

    method: str
    ids: IntArray
    """(P,) changes of the declared ID."""
    tracks: IntArray | None
    """(P,) changes of the track on the landmark; None if the method has no tracks."""
    objects: bool
    """Whether any estimate on a landmark has the number of its candidate or track."""


@dataclass(frozen=True, slots=True)
class SwitchTotals:
    """Sums of the Switches of a method, (R,) each."""

    passes: FloatArray
    ids: FloatArray
    tracks: FloatArray | None = None


def pass_outcomes(scored: Scored, joined: Joined, passes: Passes) -> PassOutcomes:
    """How one method did in each pass."""
    truth, right = scored.positive, positive_is_claimed(scored, joined)
    of_pass = passes.of_truth[truth] >= 0  # not so for one that is half in view, in protocol paper
    truth, right = truth[of_pass], right[of_pass]
    number, frame = passes.of_truth[truth], joined.truth_frame_index[truth]
    count = len(passes.first_frame_index)
    wrong_last = passes.first_frame_index - 1
    np.maximum.at(wrong_last, number[~right], frame[~right])
    lasting = frame > wrong_last[number]
    settled = np.full(count, np.inf)
    np.minimum.at(settled, number[lasting], frame[lasting])
    frames = np.bincount(number, minlength=count)
    return PassOutcomes(
        protocol=scored.protocol,
        method=scored.method,
        frames=frames,
        right=np.bincount(number[right], minlength=count),
        wait=np.where(frames > 0, settled - passes.first_frame_index, np.nan),
    )


def wait_counts(
    outcomes: Sequence[PassOutcomes],
    ids: Sequence[int],
    landmark_index: IntArray,
    unit: IntArray,
    units: int,
) -> Iterator[UnitSums]:
    """Frames to a lasting ID, over the passes of each ID and of all.

    landmark_index, unit: (P,) of the passes. units: how many there are. A pass without a lasting
    ID counts as infinite.
    """
    edges = np.unique(np.concatenate([[np.inf], *(f.wait[f.frames > 0] for f in outcomes)]))
    for outcome in outcomes:
        for name, of_id in by_landmark(ids, landmark_index):
            labels = (outcome.protocol, outcome.method, name)
            seen = of_id & (outcome.frames > 0)
            one = np.ones((int(seen.sum()), 1), dtype=np.int64)
            yield histogram_sums(labels, [(outcome.wait[seen], one, unit[seen])], units, edges)


def on_truth(joined: Joined) -> IntArray:
    """(N,) for each claim the nearest truth of any ID in its frame, -1 if none is in its gate."""
    everything = np.arange(len(joined.claim_frame_index))
    return nearest_truth(joined, everything, joined.claim_frame_index, joined.truth_frame_index)


def false_claims(joined: Joined, nearest: IntArray, units: Units, method: int) -> IntArray:
    """(U, K, 2) declared claims of a method on no landmark, and on a landmark of another ID.

    Those in frames of unknown duration are left out, as in `minutes`. K: the claimed ID. nearest:
    from `on_truth`.
    """
    k = len(joined.ids)
    timed = ~np.isnan(joined.seconds)[joined.claim_frame_index]
    declared = np.flatnonzero(joined.declared & timed & (joined.method_index == method))
    truth, claimed = nearest[declared], joined.claim_landmark_index[declared]
    nowhere = truth < 0
    on_other, unit = ~nowhere, units.of_frame[joined.claim_frame_index[declared]]
    if len(joined.truth_landmark_index):
        on_other &= joined.truth_landmark_index[truth] != claimed
        unit = np.where(nowhere, unit, units.of_truth[truth])
    cell = unit * k + claimed
    kinds = [np.bincount(cell[kind], minlength=units.count * k) for kind in (nowhere, on_other)]
    return np.stack(kinds, axis=1).reshape(units.count, k, 2)


def minutes(joined: Joined, units: Units) -> FloatArray:
    """(U,) duration of the units' frames, without those of which it is not known."""
    seconds = np.nan_to_num(joined.seconds)
    return np.bincount(units.of_frame, seconds, minlength=units.count) / 60


def false_claim_counts(
    method: str, ids: Sequence[int], claims: IntArray, minutes: FloatArray
) -> Iterator[UnitSums]:
    """FalseClaims per claimed ID and in all.

    claims: from the function `false_claims`. minutes: from the function `minutes`.
    """
    per_id = [(str(i), claims[:, k]) for k, i in enumerate(ids)]
    for name, kinds in [*per_id, ("total", claims.sum(axis=1))]:
        yield plain_sums(("strict", method, name), FalseClaims, [*kinds.T, minutes])


def switches(joined: Joined, nearest: IntArray, passes: Passes) -> list[Switches]:
    """The Switches of each method.

    The track is that of the estimate nearest to the landmark, the ID that of the nearest declared
    estimate. Frames with two landmarks of one ID are ignored, since they cannot be told apart.
    Candidates of the single-frame method (smi) are not tracks.
    """
    k = len(joined.ids)
    cell = joined.truth_frame_index * k + joined.truth_landmark_index
    alone = joined.truth_positive & (np.bincount(cell, minlength=1)[cell] == 1)
    claims = np.flatnonzero(nearest >= 0)
    claims = claims[alone[nearest[claims]]]
    # In order of pass and frame, the nearest claim first.
    truth = nearest[claims]
    away = distance(joined, claims, truth)
    order = np.lexsort((away, truth, joined.truth_frame_index[truth], passes.of_truth[truth]))
    claims = claims[order]
    of_methods = []
    for m, method in enumerate(joined.methods):
        of_method = claims[joined.method_index[claims] == m]
        tracked = follows(method)
        declared = of_method[joined.declared[of_method]]
        of_methods.append(
            Switches(
                method=method,
                ids=_changes(joined.claim_landmark_index[declared], nearest[declared], passes),
                tracks=_changes(joined.claim_object[of_method], nearest[of_method], passes)
                if tracked
                else None,
                objects=bool((joined.claim_object[of_method] >= 0).any()),
            )
        )
    return of_methods


def _changes(labels: IntArray, truth: IntArray, passes: Passes) -> IntArray:
    """(P,) changes of `labels` along each pass; the first element counts for each truth."""
    first = np.ones(len(truth), dtype=bool)
    first[1:] = np.diff(truth) != 0
    labels, number = labels[first], passes.of_truth[truth[first]]
    changed = (np.diff(labels) != 0) & (np.diff(number) == 0)
    return np.bincount(number[1:][changed], minlength=len(passes.first_frame_index))


def switch_counts(
    of_methods: Sequence[Switches],
    ids: Sequence[int],
    landmark_index: IntArray,
    unit: IntArray,
    units: int,
) -> Iterator[UnitSums]:
    """SwitchTotals per ID and in all; the arguments are those of `wait_counts`."""
    for of_method in of_methods:
        # All methods have the same columns, so that tests can swap them.
        record = SwitchTotals if of_method.tracks is not None else _without_tracks
        kinds = (
            of_method.ids,
            np.zeros_like(of_method.ids) if of_method.tracks is None else of_method.tracks,
        )
        for name, of_id in by_landmark(ids, landmark_index):
            summed = (np.bincount(unit[of_id], kind[of_id], units) for kind in kinds)
            columns = [np.bincount(unit[of_id], minlength=units), *summed]
            yield plain_sums(("strict", of_method.method, name), record, columns)


def _without_tracks(passes: FloatArray, ids: FloatArray, _: FloatArray) -> SwitchTotals:
    return SwitchTotals(passes, ids)


def position_errors(strict: Scored, joined: Joined, right: IntArray) -> FloatArray:
    """(n,) m, of the claims `right` (from `right_claims`), NaN if not known.

    At most the gate, since claims beyond it are not right.
    """
    return distance(joined, strict.claim[right], strict.truth[right])


def orientation_errors(strict: Scored, joined: Joined, right: IntArray) -> FloatArray:
    """(n,) deg, of the claims `right` (from `right_claims`), NaN if not known.

    A rotation after which the ID looks the same is no error.
    """
    period = joined.turn_deg[strict.landmark_index[right]]
    off = (
        joined.claim_orientation[strict.claim[right]]
        - joined.truth_orientation[strict.truth[right]]
    )
    return np.asarray(np.abs((off + period / 2) % period - period / 2))


def right_claims(scored: Scored) -> IntArray:
    """Indices of the claims that are declared and right."""
    return scored.declared_claim[scored.declared_effect[:, 0] > 0]


def positive_is_claimed(scored: Scored, joined: Joined) -> BoolArray:
    """(P,) whether each positive has a right claim."""
    claimed = np.zeros(len(joined.truth_frame_index), dtype=bool)
    claimed[scored.truth[right_claims(scored)]] = True
    return claimed[scored.positive]


def error_counts(
    methods: Sequence[str],
    ids: Sequence[int],
    errors: Callable[[str, int], tuple[Table, Blocks]],
    units: int,
) -> Iterator[UnitSums]:
    """Errors of right claims, per ID and in all.

    errors: gives those of a method and the k-th ID: all values, and the values by unit.
    """
    cases = {(m, k): errors(m, k) for m in methods for k in range(len(ids))}
    value, count = sum_by_value(table for table, _ in cases.values())
    if not len(value):
        return
    # The edges are quantiles of all errors, the same for every method; their ranks are those of
    # numpy's quantile with the method "inverted_cdf".
    ranks = np.ceil(count.sum() * np.linspace(0, 1, 513) - 1).clip(0).astype(np.int64)
    edges = np.unique(values_at_ranks((value, count), ranks))
    for method in methods:
        per_id = [(str(i), [cases[method, k]]) for k, i in enumerate(ids)]
        for name, some in [*per_id, ("total", [case for _, [case] in per_id])]:
            exact = sum_by_value(table for table, _ in some)
            blocks = (block for _, blocks in some for block in blocks)
            yield histogram_sums(("strict", method, name), blocks, units, edges, exact)
