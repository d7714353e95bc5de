"""The counts of one log, and those of all logs together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import SonarrecError
from sonarrec.evaluation.behaviour import (
    PassOutcomes,
    Switches,
    calibration,
    errors,
    pass_outcomes,
    switches,
)
from sonarrec.evaluation.curves import Count, Curve, counted, curve_of
from sonarrec.evaluation.histogram import Key, Rows, Values, sum_by_unit, sum_by_value
from sonarrec.evaluation.judge import PROTOCOLS, judge
from sonarrec.evaluation.match import Matched, truth_beneath
from sonarrec.evaluation.passes import UnitKind, find_passes
from sonarrec.evaluation.tracking import tracking
from sonarrec.results.columns import chosen

NOBODY = "\0"
"""A method that claims nothing: its counts hold for those that a log lacks. No method that is read
has such a name."""
LOGS_ENOUGH = 10
"""With so many logs the unit is a log, since the passes of one log have much in common."""
MOST_UNITS = 400
"""If there are more, neighbours in time are merged; this makes intervals no wider."""


@dataclass(frozen=True, slots=True)
class PassTable:
    """P passes of landmarks, by log and time; see `passes.Passes`."""

    log_index: IntArray
    landmark_index: IntArray
    first_frame: IntArray
    last_frame: IntArray
    """(P,) frame numbers in the log."""
    unit: IntArray
    """(P,) pass unit."""


@dataclass(frozen=True, slots=True)
class LogCounts:
    """The counts of one log: K IDs, U pass units, P passes. Small enough to keep for every log."""

    name: str
    ids: tuple[int, ...]
    methods: tuple[str, ...]
    placed: bool
    """Whether positions are known wherever the strict protocol needs them."""
    rounded: bool
    """Whether its scores had more than six digits."""
    """Whether the duration of its frames is known."""
    frames: int
    positives: int
    """How many truths count as positives under protocol strict."""
    ignored: int
    """How many truths protocol strict ignores, since less of them is in view."""
    gates: tuple[float, ...]
    """m, the distance within which a claim is right; empty without a truth."""
    estimates: dict[str, int]
    """How many each method has."""
    units: int
    passes: PassTable
    sums: dict[Key, FloatArray | IntArray]
    """(U, ...) by pass unit. ("declared", protocol, method): (K, 4) TP, TN, FP, FN at the operating
    point. "minutes" and, with the method, "false_claims", "claimed" and "calibration": as the
    functions of these names in `behaviour` give them. ("tracking", method): as of
    `tracking.tracking`, all in the first unit, since tracks go on from pass to pass."""
    outcomes: dict[Key, PassOutcomes]
    """By protocol and method."""
    switches: dict[str, Switches]
    """By method."""
    values: dict[Key, Rows]
    """("claims", protocol, method, k): scores with the effects of claims of the k-th ID.
    ("position" or "orientation", method, k): errors."""


def count_log(log: Matched, *, rates_only: bool = False) -> LogCounts:
    """Count one log. rates_only: leave out what needs `truth_beneath`, and errors."""
    passes = find_passes(log)
    groups = passes.unit_of_frame, passes.unit_of_truth
    sums: dict[Key, FloatArray | IntArray] = {}
    outcomes: dict[Key, PassOutcomes] = {}
    values: dict[Key, Rows] = {}
    for protocol in PROTOCOLS if log.placed else PROTOCOLS[:1]:
        for method in (NOBODY, *log.methods):
            judged = judge(log, method, protocol)
            sums["declared", protocol, method] = judged.declared(*groups, passes.units)
            outcomes[protocol, method] = pass_outcomes(judged, log, passes)
            if method == NOBODY:
                continue
            group = judged.group(*groups)
            for k in range(len(log.ids)):
                of_id = judged.landmark_index == k
                rows = sum_by_unit(judged.score[of_id], group[of_id], judged.effect[of_id])
                values["claims", protocol, method, k] = rows
            if protocol == "strict" and not rates_only:
                for (name, k), found in errors(judged, log, passes.unit_of_truth).items():
                    values[name, method, k] = found
    switched: dict[str, Switches] = {}
    if log.placed and not rates_only:
        beneath = truth_beneath(log)
        switched = switches(log, beneath, passes)
        for m, method in enumerate(log.methods):
            if (stated := calibration(log, beneath, passes, m)) is not None:
                sums["calibration", method] = stated
            if (followed := tracking(log, beneath, m)) is not None:
                sums["tracking", method] = followed[None]
    return LogCounts(
        name=log.name,
        ids=log.ids,
        methods=log.methods,
        placed=log.placed,
        rounded=log.rounded,
        frames=len(log.frame),
        positives=int(log.truth_positive.sum()),
        ignored=int((~log.truth_positive).sum()),
        gates=(float(log.gate_m),) if len(log.truth_positive) else (),
        estimates={name: int((log.method_index == m).sum()) for m, name in enumerate(log.methods)},
        units=passes.units,
        passes=PassTable(
            np.zeros(len(passes.unit), dtype=np.int64),
            passes.landmark_index,
            log.frame[passes.first_frame_index],
            log.frame[passes.last_frame_index],
            passes.unit,
        ),
        sums=sums,
        outcomes=outcomes,
        switches=switched,
        values=values,
    )


@dataclass(frozen=True, slots=True, repr=False)
class Scored:
    """The counts of one method under one protocol over all logs: L logs, K IDs."""

    protocol: str
    method: str
    ids: tuple[int, ...]
    base: IntArray
    """(L, K, 4) TP, TN, FP, FN without any claim."""
    declared: IntArray
    """(L, K, 4) TP, TN, FP, FN at the method's operating point."""
    values: Values

    def __repr__(self) -> str:
        count = self.count()
        return f"<{self.method}, {self.protocol}: TPR {count.tpr:.4f}, FPR {count.fpr:.4f}>"

    def count(self, k: int | None = None) -> Count:
        """The counts at the operating point: of the k-th ID, or the sum over all."""
        base, declared = self.base.sum(axis=0), self.declared.sum(axis=0)
        if k is None:
            return counted(base.sum(axis=0), declared.sum(axis=0))
        return counted(base[k], declared[k])

    def counts_per_log(self) -> list[list[Count]]:
        """For each log the counts at the operating point: of each ID, then of all."""
        base, declared = (
            np.concatenate([counts, counts.sum(axis=1, keepdims=True)], axis=1)
            for counts in (self.base, self.declared)
        )
        return [list(map(counted, *log)) for log in zip(base, declared, strict=True)]

    def curve(self, k: int | None = None) -> Curve:
        """The ROC of the k-th ID, or the micro average over all."""
        base = self.base.sum(axis=0)
        base = base.sum(axis=0) if k is None else base[k]
        return curve_of(base, sum_by_value(map(self.values.table, self.keys(k))))

    def keys(self, k: int | None = None) -> list[Key]:
        """Of the claims of the k-th ID, or of all, in `values`."""
        of = range(len(self.ids)) if k is None else [k]
        return [("claims", self.protocol, self.method, i) for i in of]


@dataclass(frozen=True, slots=True)
class Units:
    """The clusters that the bootstrap draws and tests swap as a whole."""

    kind: UnitKind
    count: int
    of_pass_unit: IntArray
    """(all pass units,) the unit of each pass unit."""


class Counts:
    """The sums over all logs, which have the same IDs in the same order.

    parts: of each log. values: those of their scores and errors that the parts no longer hold.
    methods: those wanted; all if none is named.
    """

    def __init__(
        self, parts: Sequence[LogCounts], values: Values, methods: Sequence[str] = ()
    ) -> None:
        self.parts = tuple(parts)
        self.values = values
        self.logs = tuple(part.name for part in parts)
        self.ids = parts[0].ids
        there = {method for part in parts for method in part.methods}
        self.methods = chosen(there, methods, ", ".join(self.logs))
        self.placed = all(part.placed for part in parts)
        self.protocols = PROTOCOLS if self.placed else PROTOCOLS[:1]
        self.frames = sum(part.frames for part in parts)
        self.positives = sum(part.positives for part in parts)
        self.ignored = sum(part.ignored for part in parts)
        self.gates = tuple(sorted({gate for part in parts for gate in part.gates}))
        self._first_unit = np.cumsum([0, *(part.units for part in parts)]).tolist()

    @cached_property
    def scored(self) -> tuple[Scored, ...]:
        """Every method under every protocol."""

        def summed(protocol: str, method: str) -> IntArray:
            found = (_of(part.sums, "declared", protocol, method) for part in self.parts)
            return np.stack([np.asarray(by_unit).sum(axis=0) for by_unit in found])

        return tuple(
            Scored(p, m, self.ids, summed(p, NOBODY), summed(p, m), self.values)
            for m in self.methods
            for p in self.protocols
        )

    @cached_property
    def passes(self) -> PassTable:
        """The passes of all logs."""
        tables = [
            replace(p.passes, log_index=p.passes.log_index + n, unit=p.passes.unit + first)
            for n, (p, first) in enumerate(zip(self.parts, self._first_unit, strict=False))
        ]
        names = PassTable.__dataclass_fields__
        return PassTable(*(np.concatenate([getattr(t, n) for t in tables]) for n in names))

    def outcomes(self, protocol: str, method: str) -> PassOutcomes:
        """How a method did in each pass of `passes`."""
        found = [_of(part.outcomes, protocol, method) for part in self.parts]
        names = PassOutcomes.__dataclass_fields__
        return PassOutcomes(*(np.concatenate([getattr(o, n) for o in found]) for n in names))

    def switches(self, method: str) -> Switches:
        """The Switches of one method in each pass of `passes`; 0 in logs that lack it."""
        none = [Switches(np.zeros(len(p.passes.unit), dtype=np.int64), None) for p in self.parts]
        found = [p.switches.get(method, n) for p, n in zip(self.parts, none, strict=True)]
        tracks = [n.ids if s.tracks is None else s.tracks for s, n in zip(found, none, strict=True)]
        tracked = any(s.tracks is not None for s in found)
        return Switches(
            np.concatenate([s.ids for s in found]), np.concatenate(tracks) if tracked else None
        )

    def units(self) -> Units:
        """The independent units: passes, or logs if there are LOGS_ENOUGH."""
        kind: UnitKind = "log" if len(self.logs) >= LOGS_ENOUGH else "pass"
        if kind == "log":
            of_log = np.repeat(np.arange(len(self.parts)), [part.units for part in self.parts])
            return Units(kind, len(self.parts), of_log)
        count = self._first_unit[-1]
        number = np.arange(count)
        number = number * MOST_UNITS // count if count > MOST_UNITS else number
        return Units(kind, min(count, MOST_UNITS), number)

    def sums(self, units: Units, *key: str) -> FloatArray | IntArray | None:
        """(U, ...) what the LogCounts have in `sums` under this key; None if none has any."""
        sums: FloatArray | IntArray | None = None
        for part, first in zip(self.parts, self._first_unit, strict=False):
            if (rows := _of(part.sums, *key)) is not None:
                if sums is None:
                    sums = np.zeros((units.count, *rows.shape[1:]), dtype=rows.dtype)
                np.add.at(sums, units.of_pass_unit[first : first + len(rows)], rows)
        return sums

    def declared(self, units: Units, protocol: str, method: str) -> IntArray:
        """(U, K, 4) TP, TN, FP, FN at the operating point; of NOBODY: without any claim."""
        return np.asarray(self.sums(units, "declared", protocol, method), dtype=np.int64)


T = TypeVar("T")


def _of(found: dict[Key, T], *key: str) -> T | None:
    """What a log has of a method, which is the last of the key, else what it has of NOBODY."""
    return found.get(key, found.get((*key[:-1], NOBODY)))


class Adder:
    """Adds logs one at a time."""

    def __init__(self) -> None:
        self.parts: list[LogCounts] = []
        self._values = Values()
        self._units = 0

    def add(self, log: LogCounts) -> None:
        """Add the counts of a log."""
        for key, (value, unit, number) in log.values.items():
            self._values.add(key, (value, unit + self._units, number))
        self.parts.append(replace(log, values={}))
        self._units += log.units

    def counts(self, folders: Sequence[Path], methods: Sequence[str] = ()) -> Counts:
        """The sums. folders: of the logs; where several have one name it is their names.

        methods: as in `Counts`. Raises SonarrecError if IDs differ, or if none has a method.
        """
        for part in self.parts:
            if set(part.ids) != set(self.parts[0].ids):
                raise SonarrecError(
                    f"logs {self.parts[0].name} and {part.name} were run with different landmark "
                    "IDs and cannot be pooled; evaluate them one by one, or give --landmarks"
                )
        many = Counter(part.name for part in self.parts)
        parts = [
            part if many[part.name] == 1 else replace(part, name=str(folder))
            for part, folder in zip(self.parts, folders, strict=True)
        ]
        counts = Counts(parts, self._values, methods)
        if not counts.methods:
            raise SonarrecError(f"{', '.join(counts.logs)}: estimates.csv names no method to score")
        return counts
