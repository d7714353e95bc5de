"""Beyond rates: how soon an ID is right for good, what is claimed where nothing is, switches of
ID and track, and errors of position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sonarrec.evaluation.joined import Joined, distance, nearest_truth
from sonarrec.evaluation.passes import Passes, Units
from sonarrec.evaluation.scoring import Scored
from sonarrec.evaluation.tallies import quantile_tally, ratio_tally
from sonarrec.evaluation.uncertainty import Tally
from sonarrec.records import BoolArray, FloatArray, IntArray

WAITS = ("frames_to_id_median", "frames_to_id_90")
FALSE = ("false_claims_per_min", "wrong_ids_per_min")
SWITCHES = ("id_switches_per_pass", "track_switches_per_pass")
ERRORS = ("position_error_median_m", "position_error_95_m")
TURNS = ("orientation_error_median_deg", "orientation_error_95_deg")


@dataclass(frozen=True, slots=True)
class Followed:
    """How one method did in each of P passes under one protocol.

    frames: (P,) frames with the landmark whole in view; right: (P,) those of them in which it was
    claimed. wait: (P,) frames from the first of them to the one from which on it was claimed in
    all, infinite where it was not claimed in the last.
    """

    protocol: str
    method: str
    frames: IntArray
    right: IntArray
    wait: FloatArray


def follow(scored: Scored, joined: Joined, passes: Passes) -> Followed:
    """Each pass of a landmark under one method."""
    claimed = np.zeros(len(joined.truth_frame), dtype=bool)
    claimed[scored.truth[scored.made[scored.made_effect[:, 0] > 0]]] = True
    truth = scored.positive
    number, frame, right = passes.of_truth[truth], joined.truth_frame[truth], claimed[truth]
    count = len(passes.first)
    wrong_last = passes.first - 1
    np.maximum.at(wrong_last, number[~right], frame[~right])
    lasting = frame > wrong_last[number]
    settled = np.full(count, np.inf)
    np.minimum.at(settled, number[lasting], frame[lasting])
    return Followed(
        protocol=scored.protocol,
        method=scored.method,
        frames=np.bincount(number, minlength=count),
        right=np.bincount(number[right], minlength=count),
        wait=settled - passes.first,
    )


def wait_tallies(
    followed: Sequence[Followed], joined: Joined, passes: Passes, units: Units
) -> list[Tally]:
    """Frames to a lasting right ID over passes: median and 90 %, per ID and in all.

    A pass in which it never comes counts as infinite.
    """
    edges = np.unique(np.concatenate([[np.inf], *(f.wait for f in followed)]))
    unit = _unit_of_pass(passes, units)
    found = []
    for one in followed:
        for label, mine in _by_landmark(joined, passes.landmark):
            labels = (one.protocol, one.method, label)
            found.append(
                quantile_tally(
                    labels, WAITS, (0.5, 0.9), one.wait[mine], unit[mine], units.count, edges
                )
            )
    return found


def _unit_of_pass(passes: Passes, units: Units) -> IntArray:
    unit = np.zeros(len(passes.first), dtype=np.int64)
    part = passes.of_truth >= 0
    unit[passes.of_truth[part]] = units.of_truth[part]
    return unit


def _by_landmark(joined: Joined, landmark: IntArray) -> list[tuple[str, BoolArray]]:
    """Per ID, then in all: its name and which elements are its own."""
    named = [(str(i), landmark == k) for k, i in enumerate(joined.ids)]
    return [*named, ("total", np.ones(len(landmark), dtype=bool))]


def on_truth(joined: Joined) -> IntArray:
    """(N,) per claim the nearest truth of whatever ID in its frame, -1 with none in its gate."""
    everything = np.arange(len(joined.claim_frame))
    return nearest_truth(joined, everything, joined.claim_frame, joined.truth_frame)


def false_claim_tallies(joined: Joined, nearest: IntArray, units: Units) -> list[Tally]:
    """Declared claims a minute on no landmark at all, and on one of another ID; per claimed ID.

    nearest: of `on_truth`. What is no landmark is a distractor, or the bare floor.
    """
    minutes = np.bincount(units.of_frame, joined.seconds, minlength=units.count) / 60
    declared = np.flatnonzero(joined.declared)
    truth = nearest[declared]
    nowhere = truth < 0
    if len(joined.truth_landmark):
        other = ~nowhere & (joined.truth_landmark[truth] != joined.claim_landmark[declared])
        unit = np.where(
            nowhere, units.of_frame[joined.claim_frame[declared]], units.of_truth[truth]
        )
    else:
        other, unit = ~nowhere, units.of_frame[joined.claim_frame[declared]]
    found = []
    for m, method in enumerate(joined.methods):
        made = joined.method[declared] == m
        for label, mine in _by_landmark(joined, joined.claim_landmark[declared]):
            parts = [
                np.bincount(unit[made & mine & kind], minlength=units.count).astype(float)
                for kind in (nowhere, other)
            ]
            labels = ("strict", method, label)
            found.append(ratio_tally(labels, FALSE, parts, [minutes, minutes]))
    return found


@dataclass(frozen=True, slots=True)
class Switches:
    """Of one method, per pass: changes of the declared ID, and of the track on the landmark.

    (P,) each; tracks is None where the method has none.
    """

    method: str
    ids: IntArray
    tracks: IntArray | None


def switches(joined: Joined, nearest: IntArray, passes: Passes) -> list[Switches]:
    """What changed from one frame of a pass to the next one that has it, per method.

    Of the estimates on a landmark whole in view the nearest speaks, for IDs the nearest declared
    one; frames with two landmarks of one ID are passed over, for which is which is not known.
    Candidates of the single-frame method (smi) are no tracks.
    """
    k = len(joined.ids)
    cell = joined.truth_frame * k + joined.truth_landmark
    alone = joined.truth_positive & (np.bincount(cell, minlength=1)[cell] == 1)
    claims = np.flatnonzero(nearest >= 0)
    claims = claims[alone[nearest[claims]]]
    # By method, pass and frame, the nearest first.
    truth = nearest[claims]
    away = distance(joined, claims, truth)
    order = np.lexsort((away, truth, joined.truth_frame[truth], passes.of_truth[truth]))
    claims = claims[order]
    found = []
    for m, method in enumerate(joined.methods):
        mine = claims[joined.method[claims] == m]
        tracked = method.partition(":")[0] != "smi" and bool((joined.claim_object[mine] >= 0).any())
        declared = mine[joined.declared[mine]]
        found.append(
            Switches(
                method=method,
                ids=_changes(joined.claim_landmark[declared], nearest[declared], passes),
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
    return np.bincount(number[1:][changed], minlength=len(passes.first))


def switch_tallies(
    found: Sequence[Switches], joined: Joined, passes: Passes, units: Units
) -> list[Tally]:
    """Switches per pass, per ID and in all."""
    unit = _unit_of_pass(passes, units)
    tallies = []
    for one in found:
        kinds = [(SWITCHES[0], one.ids)]
        if one.tracks is not None:
            kinds.append((SWITCHES[1], one.tracks))
        for label, mine in _by_landmark(joined, passes.landmark):
            many = np.bincount(unit[mine], minlength=units.count).astype(float)
            parts = [
                np.bincount(unit[mine], changes[mine], minlength=units.count).astype(float)
                for _, changes in kinds
            ]
            names = tuple(name for name, _ in kinds)
            labels = ("strict", one.method, label)
            tallies.append(ratio_tally(labels, names, parts, [many] * len(kinds)))
    return tallies


def error_tallies(strict: Sequence[Scored], joined: Joined, units: Units) -> list[Tally]:
    """Errors of right claims, median and 95 %, per ID and in all: of position (m), and of
    orientation (deg) where truth and estimates tell it.

    Claims beyond the gate are not right, so this says how exact the right ones are. An ID that
    looks the same after a turn is not wrong by that turn.
    """
    rights = [s.made[s.made_effect[:, 0] > 0] for s in strict]
    away, turned = [], []
    for s, right in zip(strict, rights, strict=True):
        claim, truth = s.claim[right], s.truth[right]
        away.append(distance(joined, claim, truth))
        period = joined.turn_deg[s.landmark[right]]
        off = joined.claim_orientation[claim] - joined.truth_orientation[truth]
        turned.append(np.abs((off + period / 2) % period - period / 2))
    return [
        *_error_tallies(strict, rights, away, ERRORS, joined, units),
        *_error_tallies(strict, rights, turned, TURNS, joined, units),
    ]


def _error_tallies(
    strict: Sequence[Scored],
    rights: Sequence[IntArray],
    errors: Sequence[FloatArray],
    names: tuple[str, str],
    joined: Joined,
    units: Units,
) -> list[Tally]:
    """rights: per method its right claims, of which errors are; NaN where unknown."""
    known = [~np.isnan(error) for error in errors]
    pooled = np.concatenate([error[k] for error, k in zip(errors, known, strict=True)])
    if not len(pooled):
        return []
    # Steps as fine as the errors are dense, the same for every method.
    edges = np.unique(np.quantile(pooled, np.linspace(0, 1, 513), method="inverted_cdf"))
    found = []
    for s, right, error, k in zip(strict, rights, errors, known, strict=True):
        unit = units.of_truth[s.truth[right]]
        for label, mine in _by_landmark(joined, s.landmark[right]):
            labels, mine = ("strict", s.method, label), mine & k
            found.append(
                quantile_tally(
                    labels, names, (0.5, 0.95), error[mine], unit[mine], units.count, edges
                )
            )
    return found
