"""The contribution of one log to an evaluation: sums per unit, claims and errors."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.evaluation.counting.behaviour import (
    PassOutcomes,
    Switches,
    false_claims,
    minutes,
    on_truth,
    orientation_errors,
    pass_outcomes,
    position_errors,
    right_claims,
    switches,
)
from sonarrec.evaluation.counting.passes import (
    Units,
    find_passes,
    log_units,
    pass_units,
    unit_of_pass,
)
from sonarrec.evaluation.counting.reliability import calibration
from sonarrec.evaluation.counting.scoring import PROTOCOLS, Scored, score
from sonarrec.evaluation.matching.joined import Joined

CLAIM = np.dtype([("value", "f8"), ("unit", "i4"), ("count", "i4", 4)])
"""Claims of one score in one unit: the sum of their effects."""
ERROR = np.dtype([("value", "f8"), ("unit", "i4"), ("count", "i4", (1,))])


@dataclass(frozen=True, slots=True)
class PassTable:
    """P passes of landmarks, by log and time; see `passes.Passes`."""

    log_index: IntArray
    landmark_index: IntArray
    first_frame: IntArray
    last_frame: IntArray
    """(P,) frame numbers in the log."""
    unit: IntArray
    """(P,) unit of the kind "pass"."""


@dataclass(frozen=True, slots=True)
class ScoredPart:
    """The counts of one method under one protocol: L logs, K IDs."""

    protocol: str
    method: str
    base: IntArray
    """(L, K, 4) TP, TN, FP, FN without any claim."""
    declared: IntArray
    """(L, K, 4) TP, TN, FP, FN at the operating point."""
    outcomes: PassOutcomes


@dataclass(frozen=True, slots=True)
class Totals:
    """Facts about the logs scored: L logs, K IDs, M methods, U pass units, P passes."""

    logs: tuple[str, ...]
    ids: tuple[int, ...]
    methods: tuple[str, ...]
    placed: bool
    """Whether positions are known wherever the strict protocol needs them."""
    rounded: tuple[str, ...]
    """The logs whose scores had more than six digits."""
    timed: BoolArray
    """(L,) whether the duration of a frame is known."""
    frames: int
    positives: IntArray
    """(K,) how many truths count as positives under protocol strict."""
    ignored: int
    """How many truths protocol strict ignores, since less of them is in view."""
    gates: tuple[float, ...]
    """m, rising: the distances within which a claim is right."""
    estimates: IntArray
    """(M,) how many each method has."""
    unit_log: IntArray
    """(U,) into logs, for each unit of the kind "pass"."""
    passes: PassTable
    switches: tuple[Switches, ...]
    """Per method; empty if positions are not known."""


@dataclass(frozen=True, slots=True)
class Part(Totals):
    """The contribution of one log, or of several joined ones.

    Small enough to keep in memory for every log; see `pooled.Parts` on its claims and errors.
    """

    scored: tuple[ScoredPart, ...]
    blocks: dict[Hashable, npt.NDArray[Any]]
    """See `_blocks`."""


def part_of(
    joined: Joined, scored: Sequence[Scored] | None = None, *, rates_only: bool = False
) -> Part:
    """The contribution of the logs of `joined`.

    scored: every method under every protocol; None: score them here. rates_only: leave out errors,
    false claims per minute, switches and calibration.
    """
    if scored is None:
        scored = score_all(joined)
    if not scored:  # a log without any method still has positives and negatives
        scored = score_all(replace(joined, methods=("",)))
    passes, logs = find_passes(joined), len(joined.logs)
    units = pass_units(joined, passes)
    of_truth = joined.log_index[joined.truth_frame_index]
    unit_log = np.zeros(units.count, dtype=np.int64)
    unit_log[units.of_frame] = joined.log_index
    unit_log[units.of_truth] = of_truth
    nearest = on_truth(joined) if joined.placed and not rates_only else None
    positive = joined.truth_positive
    return Part(
        logs=joined.logs,
        ids=joined.ids,
        methods=joined.methods,
        placed=joined.placed,
        rounded=joined.logs if joined.rounded else (),
        timed=np.bincount(joined.log_index, np.isnan(joined.seconds), minlength=logs) == 0,
        frames=len(joined.frame),
        positives=np.bincount(joined.truth_landmark_index[positive], minlength=len(joined.ids)),
        ignored=int((~positive).sum()),
        gates=tuple(sorted({float(gate) for gate in joined.gate})),
        estimates=np.bincount(joined.method_index, minlength=len(joined.methods)),
        unit_log=unit_log,
        passes=PassTable(
            passes.log_index,
            passes.landmark_index,
            joined.frame[passes.first_frame_index],
            joined.frame[passes.last_frame_index],
            unit_of_pass(passes, units),
        ),
        scored=tuple(
            ScoredPart(
                s.protocol,
                s.method,
                s.base_by(joined.log_index, of_truth, logs),
                s.declared_by(joined.log_index, of_truth, logs),
                pass_outcomes(s, joined, passes),
            )
            for s in scored
        ),
        switches=() if nearest is None else tuple(switches(joined, nearest, passes)),
        blocks=_blocks(joined, scored, nearest, units),
    )


def score_all(joined: Joined) -> tuple[Scored, ...]:
    """Score every method under both protocols, or only "paper" if there are no positions."""
    return tuple(
        score(joined, m, protocol)
        for m in range(len(joined.methods))
        for protocol in PROTOCOLS
        if protocol == "paper" or joined.placed
    )


def _blocks(
    joined: Joined,
    scored: Sequence[Scored],
    nearest: IntArray | None,
    units: Units,
) -> dict[Hashable, npt.NDArray[Any]]:
    """Arrays by key.

    By pass units: ("base", protocol): (U, K, 4). ("made", protocol, method): (U, K, 4), added by
    the declared claims. ("claims", protocol, method, k): CLAIM of the k-th ID.
    ("position" or "orientation", method, k): ERROR. ("false", method): (U, K, 2).
    By units of each kind, since sums of fractions depend in the last bit on their order:
    ("minutes", kind): (U,). ("calibration", method, kind): (U, K + 2, C).

    nearest: from `on_truth`; None if only rates are wanted or positions are not known. units: from
    `pass_units`.
    """
    groups = units.of_frame, units.of_truth
    blocks: dict[Hashable, npt.NDArray[Any]] = {}
    for s in scored:
        base = s.base_by(*groups, units.count)
        blocks["base", s.protocol] = base  # the same for every method
        blocks["made", s.protocol, s.method] = s.declared_by(*groups, units.count) - base
        group = s.claims_by(*groups)
        for k in range(len(joined.ids)):
            of_id = s.landmark_index == k
            claims = by_unit(CLAIM, s.score[of_id], group[of_id], s.effect[of_id])
            blocks["claims", s.protocol, s.method, k] = claims
        if s.protocol == "strict" and nearest is not None:
            blocks |= _errors(s, joined, units.of_truth)
    if nearest is not None:
        by_kind = {"pass": units, "log": log_units(joined)}
        for kind, units_of_kind in by_kind.items():
            blocks["minutes", kind] = minutes(joined, units_of_kind)
        for m, method in enumerate(joined.methods):
            blocks["false", method] = false_claims(joined, nearest, units, m)
            for kind, units_of_kind in by_kind.items():
                rows = calibration(joined, nearest, units_of_kind, m)
                if rows is not None:
                    blocks["calibration", method, kind] = rows
    return blocks


def _errors(
    strict: Scored, joined: Joined, unit_of_truth: IntArray
) -> dict[Hashable, npt.NDArray[Any]]:
    """The "position" and "orientation" blocks of one method; see `_blocks`."""
    right = right_claims(strict)
    landmark = strict.landmark_index[right]
    unit = unit_of_truth[strict.truth[right]]
    blocks: dict[Hashable, npt.NDArray[Any]] = {}
    kinds: dict[str, FloatArray] = {
        "position": position_errors(strict, joined, right),
        "orientation": orientation_errors(strict, joined, right),
    }
    for name, error in kinds.items():
        for k in range(len(joined.ids)):
            of_id = (landmark == k) & ~np.isnan(error)
            one = np.ones((int(of_id.sum()), 1), dtype=np.int64)
            blocks[name, strict.method, k] = by_unit(ERROR, error[of_id], unit[of_id], one)
    return blocks


def by_unit(
    kind: np.dtype[Any], value: FloatArray, unit: IntArray, count: npt.NDArray[Any]
) -> npt.NDArray[Any]:
    """Rows of CLAIM or ERROR, one for each value in each unit. value, unit: (n,); count: (n, C)."""
    order = np.lexsort((value, unit))
    value, unit = value[order], unit[order]
    new = np.ones(len(value), dtype=bool)
    new[1:] = (np.diff(value) != 0) | (np.diff(unit) != 0)
    start = np.flatnonzero(new)
    rows = np.empty(len(start), dtype=kind)
    rows["value"], rows["unit"] = value[start], unit[start]
    if len(start):
        rows["count"] = np.add.reduceat(count[order], start, axis=0, dtype=np.int32)
    return rows
