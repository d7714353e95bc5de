"""What one log adds to an evaluation: sums by unit, and the claims and errors behind them."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

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
    Passes,
    Units,
    find_passes,
    find_units,
    pass_units,
    unit_of_pass,
)
from sonarrec.evaluation.counting.reliability import calibration
from sonarrec.evaluation.counting.scoring import PROTOCOLS, Scored, score
from sonarrec.evaluation.matching.joined import Joined
from sonarrec.records import FloatArray, IntArray

CLAIM = np.dtype([("score", "f8"), ("unit", "i4"), ("effect", "i1", 4)])
ERROR = np.dtype([("error", "f8"), ("unit", "i4")])


@dataclass(frozen=True, slots=True)
class PassTable:
    """P passes of landmarks, by log and time; see `passes.Passes`."""

    log_index: IntArray
    landmark_index: IntArray
    first_frame: IntArray
    last_frame: IntArray
    """(P,) numbers in the log."""
    unit: IntArray
    """(P,) its unit of the kind "pass"."""


@dataclass(frozen=True, slots=True)
class ScoredPart:
    """One method under one protocol: L logs, K IDs."""

    protocol: str
    method: str
    base: IntArray
    """(L, K, 4) TP, TN, FP, FN with nothing claimed."""
    declared: IntArray
    """(L, K, 4) TP, TN, FP, FN at the operating point."""
    outcomes: PassOutcomes


@dataclass(frozen=True, slots=True)
class Totals:
    """What there is to score: L logs, K IDs, M methods, U pass units, P passes."""

    logs: tuple[str, ...]
    ids: tuple[int, ...]
    methods: tuple[str, ...]
    placed: bool
    """Whether positions are known wherever the strict protocol needs them."""
    timed: bool
    """Whether every frame stands for a known time."""
    frames: int
    positives: IntArray
    """(K,) truths whole in view."""
    ignored: int
    """Truths partly in view."""
    gates: tuple[float, ...]
    """m, the distances within which a claim is right, rising."""
    estimates: IntArray
    """(M,) of each method."""
    unit_log: IntArray
    """(U,) into logs, of each unit of the kind "pass"."""
    passes: PassTable
    switches: tuple[Switches, ...]
    """Per method; empty where positions are not known."""


@dataclass(frozen=True, slots=True)
class Part(Totals):
    """What one log, or some, add to an evaluation.

    Small enough to keep for every log, but for `blocks`: these are as long as the log, and go to
    the disk (`store.py`).
    """

    scored: tuple[ScoredPart, ...]
    blocks: dict[Hashable, npt.NDArray[Any]]
    """By what they hold: see `_blocks`."""


def part_of(
    joined: Joined, scored: Sequence[Scored] | None = None, *, rates_only: bool = False
) -> Part:
    """What the logs of `joined` add.

    scored: every method under every protocol; default: they are scored here. rates_only: nothing of
    errors, false claims a minute, switches and calibration.
    """
    if scored is None:
        scored = score_all(joined)
    if not scored:  # of a log without any method others still need what there was to claim
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
        timed=not np.isnan(joined.seconds).any(),
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
        blocks=_blocks(joined, scored, nearest, passes, units),
    )


def score_all(joined: Joined) -> tuple[Scored, ...]:
    """Every method under every protocol that positions allow."""
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
    passes: Passes,
    units: Units,
) -> dict[Hashable, npt.NDArray[Any]]:
    """Arrays by key.

    ("base", protocol): (U, K, 4) by pass units; ("made", protocol, method): what the declared
    claims add to it. ("claims", protocol, method, k): CLAIM by pass units, of the k-th ID.
    ("position" or "orientation", method, k): ERROR by pass units. ("false", method): (U, K, 2) by
    pass units. ("minutes", kind): (U,) and ("calibration", method, kind): (U, K + 2, C), by units
    of this kind: sums of fractions depend in the last bit on how they are put together.

    nearest: of `on_truth`; None where rates alone are wanted, or positions are not known. units: of
    `pass_units`.
    """
    groups = units.of_frame, units.of_truth
    found: dict[Hashable, npt.NDArray[Any]] = {}
    for s in scored:
        base = s.base_by(*groups, units.count)
        found["base", s.protocol] = base  # the same of every method
        found["made", s.protocol, s.method] = s.declared_by(*groups, units.count) - base
        group = s.claims_by(*groups)
        for k in range(len(joined.ids)):
            mine = s.landmark_index == k
            claims = np.empty(int(mine.sum()), dtype=CLAIM)
            claims["score"], claims["unit"] = s.score[mine], group[mine]
            claims["effect"] = s.effect[mine]
            found["claims", s.protocol, s.method, k] = claims
        if s.protocol == "strict" and nearest is not None:
            found |= _errors(s, joined, units.of_truth)
    if nearest is not None:
        by_kind = {"pass": units, "log": find_units(joined, passes, "log")}
        for kind, of in by_kind.items():
            found["minutes", kind] = minutes(joined, of)
        for m, method in enumerate(joined.methods):
            found["false", method] = false_claims(joined, nearest, units, m)
            for kind, of in by_kind.items():
                rows = calibration(joined, nearest, of, m)
                if rows is not None:
                    found["calibration", method, kind] = rows
    return found


def _errors(
    strict: Scored, joined: Joined, unit_of_truth: IntArray
) -> dict[Hashable, npt.NDArray[Any]]:
    """The "position" and "orientation" blocks of one method; see `_blocks`."""
    right = right_claims(strict)
    landmark = strict.landmark_index[right]
    unit = unit_of_truth[strict.truth[right]]
    found: dict[Hashable, npt.NDArray[Any]] = {}
    kinds: dict[str, FloatArray] = {
        "position": position_errors(strict, joined, right),
        "orientation": orientation_errors(strict, joined, right),
    }
    for name, error in kinds.items():
        for k in range(len(joined.ids)):
            mine = (landmark == k) & ~np.isnan(error)
            errors = np.empty(int(mine.sum()), dtype=ERROR)
            errors["error"], errors["unit"] = error[mine], unit[mine]
            found[name, strict.method, k] = errors
    return found
