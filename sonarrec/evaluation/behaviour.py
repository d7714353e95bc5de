"""Beyond rates: how soon an ID is right for good, what is claimed where nothing is, switches of
ID and track, and errors of position."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sonarrec.evaluation.counted import Counted, by_landmark, spread_count, sum_count
from sonarrec.evaluation.joined import Joined, distance, nearest_truth
from sonarrec.evaluation.passes import Passes, Units
from sonarrec.evaluation.scoring import Scored
from sonarrec.records import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class PassOutcomes:
    """How one method did in each of P passes under one protocol."""

    protocol: str
    method: str
    frames: IntArray
    """(P,) frames with the landmark whole in view."""
    right: IntArray
    """(P,) those of them in which it was claimed."""
    wait: FloatArray
    """(P,) frames from the first of them to the one from which on it was claimed in all, infinite
    where it was not claimed in the last."""


@dataclass(frozen=True, slots=True)
class FalseClaims:
    """Declared claims of an ID that are not on a landmark of it, (R,) each."""

    nowhere: FloatArray
    """On no landmark at all."""
    other: FloatArray
    """On a landmark of another ID."""
    minutes: FloatArray


@dataclass(frozen=True, slots=True)
class Switches:
    """Of one method, changes from one frame of a pass to the next one that has it."""

    method: str
    ids: IntArray
    """(P,) of the declared ID."""
    tracks: IntArray | None
    """(P,) of the track on the landmark; None where the method has none."""


@dataclass(frozen=True, slots=True)
class Switched:
    """Switches of a method, (R,) each."""

    passes: FloatArray
    ids: FloatArray
    tracks: FloatArray | None = None


def pass_outcomes(scored: Scored, joined: Joined, passes: Passes) -> PassOutcomes:
    """Each pass of a landmark under one method."""
    claimed = np.zeros(len(joined.truth_frame_index), dtype=bool)
    claimed[scored.truth[_right_claims(scored)]] = True
    truth = scored.positive
    number, frame, right = passes.of_truth[truth], joined.truth_frame_index[truth], claimed[truth]
    count = len(passes.first_frame_index)
    wrong_last = passes.first_frame_index - 1
    np.maximum.at(wrong_last, number[~right], frame[~right])
    lasting = frame > wrong_last[number]
    settled = np.full(count, np.inf)
    np.minimum.at(settled, number[lasting], frame[lasting])
    return PassOutcomes(
        protocol=scored.protocol,
        method=scored.method,
        frames=np.bincount(number, minlength=count),
        right=np.bincount(number[right], minlength=count),
        wait=settled - passes.first_frame_index,
    )


def wait_counts(
    outcomes: Sequence[PassOutcomes], joined: Joined, passes: Passes, units: Units
) -> Iterator[Counted]:
    """Frames to a lasting right ID over passes, per ID and in all.

    A pass in which it never comes counts as infinite.
    """
    edges = np.unique(np.concatenate([[np.inf], *(f.wait for f in outcomes)]))
    unit = _unit_of_pass(passes, units)
    for one in outcomes:
        for name, mine in by_landmark(joined, passes.landmark_index):
            labels = (one.protocol, one.method, name)
            yield spread_count(labels, one.wait[mine], unit[mine], units.count, edges)


def _unit_of_pass(passes: Passes, units: Units) -> IntArray:
    unit = np.zeros(len(passes.first_frame_index), dtype=np.int64)
    part = passes.of_truth >= 0
    unit[passes.of_truth[part]] = units.of_truth[part]
    return unit


def on_truth(joined: Joined) -> IntArray:
    """(N,) per claim the nearest truth of whatever ID in its frame, -1 with none in its gate."""
    everything = np.arange(len(joined.claim_frame_index))
    return nearest_truth(joined, everything, joined.claim_frame_index, joined.truth_frame_index)


def false_claim_counts(joined: Joined, nearest: IntArray, units: Units) -> Iterator[Counted]:
    """Declared claims on no landmark of their ID, per claimed ID and in all.

    nearest: of `on_truth`.
    """
    minutes = np.bincount(units.of_frame, joined.seconds, minlength=units.count) / 60
    declared = np.flatnonzero(joined.declared)
    truth, claimed = nearest[declared], joined.claim_landmark_index[declared]
    nowhere = truth < 0
    other, unit = ~nowhere, units.of_frame[joined.claim_frame_index[declared]]
    if len(joined.truth_landmark_index):
        other &= joined.truth_landmark_index[truth] != claimed
        unit = np.where(nowhere, unit, units.of_truth[truth])
    for m, method in enumerate(joined.methods):
        made = joined.method_index[declared] == m
        for name, mine in by_landmark(joined, claimed):
            some = (made & mine & kind for kind in (nowhere, other))
            parts = [np.bincount(unit[s], minlength=units.count) for s in some]
            yield sum_count(("strict", method, name), FalseClaims, [*parts, minutes])


def switches(joined: Joined, nearest: IntArray, passes: Passes) -> list[Switches]:
    """What changed from one frame of a pass to the next one that has it, per method.

    Of the estimates on a landmark whole in view the nearest speaks, for IDs the nearest declared
    one; frames with two landmarks of one ID are passed over, for which is which is not known.
    Candidates of the single-frame method (smi) are no tracks.
    """
    k = len(joined.ids)
    cell = joined.truth_frame_index * k + joined.truth_landmark_index
    alone = joined.truth_positive & (np.bincount(cell, minlength=1)[cell] == 1)
    claims = np.flatnonzero(nearest >= 0)
    claims = claims[alone[nearest[claims]]]
    # By method, pass and frame, the nearest first.
    truth = nearest[claims]
    away = distance(joined, claims, truth)
    order = np.lexsort((away, truth, joined.truth_frame_index[truth], passes.of_truth[truth]))
    claims = claims[order]
    found = []
    for m, method in enumerate(joined.methods):
        mine = claims[joined.method_index[claims] == m]
        tracked = method.partition(":")[0] != "smi" and bool((joined.claim_object[mine] >= 0).any())
        declared = mine[joined.declared[mine]]
        found.append(
            Switches(
                method=method,
                ids=_changes(joined.claim_landmark_index[declared], nearest[declared], passes),
                tracks=_changes(joined.claim_object[mine], nearest[mine], passes)
                if tracked
                else None,
            )
        )
    return found


def _changes(what: IntArray, truth: IntArray, passes: Passes) -> IntArray:
    """(P,) changes of `what` along each pass, the first element of each truth standing for it."""
    first = np.ones(len(truth), dtype=bool)
    first[1:] = np.diff(truth) != 0
    what, number = what[first], passes.of_truth[truth[first]]
    changed = (np.diff(what) != 0) & (np.diff(number) == 0)
    return np.bincount(number[1:][changed], minlength=len(passes.first_frame_index))


def switch_counts(
    found: Sequence[Switches], joined: Joined, passes: Passes, units: Units
) -> Iterator[Counted]:
    """Switches over passes, per ID and in all."""
    unit = _unit_of_pass(passes, units)
    for one in found:
        kinds = [one.ids] if one.tracks is None else [one.ids, one.tracks]
        for name, mine in by_landmark(joined, passes.landmark_index):
            summed = (np.bincount(unit[mine], kind[mine], units.count) for kind in kinds)
            columns = [np.bincount(unit[mine], minlength=units.count), *summed]
            yield sum_count(("strict", one.method, name), Switched, columns)


def position_counts(strict: Sequence[Scored], joined: Joined, units: Units) -> Iterator[Counted]:
    """Position errors (m) of right claims, per ID and in all.

    Claims beyond the gate are not right, so this says how exact the right ones are.
    """
    rights = [_right_claims(s) for s in strict]
    errors = [
        distance(joined, s.claim[right], s.truth[right])
        for s, right in zip(strict, rights, strict=True)
    ]
    return _error_counts(strict, rights, errors, joined, units)


def orientation_counts(strict: Sequence[Scored], joined: Joined, units: Units) -> Iterator[Counted]:
    """Orientation errors (deg) of right claims, where truth and estimates tell it.

    An ID that looks the same after a turn is not wrong by that turn.
    """
    rights = [_right_claims(s) for s in strict]
    errors = []
    for s, right in zip(strict, rights, strict=True):
        period = joined.turn_deg[s.landmark_index[right]]
        off = joined.claim_orientation[s.claim[right]] - joined.truth_orientation[s.truth[right]]
        errors.append(np.abs((off + period / 2) % period - period / 2))
    return _error_counts(strict, rights, errors, joined, units)


def _right_claims(scored: Scored) -> IntArray:
    """Which of its claims are declared and right."""
    return scored.made[scored.made_effect[:, 0] > 0]


def _error_counts(
    strict: Sequence[Scored],
    rights: Sequence[IntArray],
    errors: Sequence[FloatArray],
    joined: Joined,
    units: Units,
) -> Iterator[Counted]:
    """rights: per method its right claims, of which errors are; NaN where unknown."""
    known = [~np.isnan(error) for error in errors]
    pooled = [error[k] for error, k in zip(errors, known, strict=True)]
    if not any(map(len, pooled)):
        return
    # Steps as fine as the errors are dense, the same for every method.
    shares = np.linspace(0, 1, 513)
    edges = np.unique(np.quantile(np.concatenate(pooled), shares, method="inverted_cdf"))
    for s, right, error, k in zip(strict, rights, errors, known, strict=True):
        unit = units.of_truth[s.truth[right]]
        for name, mine in by_landmark(joined, s.landmark_index[right]):
            mine &= k
            yield spread_count(
                ("strict", s.method, name), error[mine], unit[mine], units.count, edges
            )
