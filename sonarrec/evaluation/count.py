"""Counts: what a log adds to each method, protocol, ID and independent unit; logs add up.

Scores have six digits, so the histogram of the scores holds every point of a ROC exactly.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import SonarrecError
from sonarrec.evaluation.curves import Count, Curve, counted, curve_of
from sonarrec.evaluation.match import PROTOCOLS, Judged, Matched, distance, judge, truth_beneath
from sonarrec.evaluation.mistakes import KINDS, Mistake, Wrong, find_wrong, over_frames
from sonarrec.evaluation.passes import Passes, UnitKind, find_passes
from sonarrec.records import follows
from sonarrec.results.columns import chosen

Key = tuple[str | int, ...]
Table = tuple[FloatArray, IntArray]
"""(n,) distinct values, rising, and (n, C) the sums of what belongs to each."""
Rows = tuple[FloatArray, IntArray, IntArray]
"""(n,) values, (n,) the unit of each, and (n, C) the sums of what belongs to it there."""
NOBODY = "\0"
"""A method that claims nothing: its counts hold for those that a log lacks. No method that is read
has such a name."""
LOGS_ENOUGH = 10
"""With so many logs the unit is a log, since the passes of one log have much in common."""
MOST_UNITS = 400
"""If there are more, neighbours in time are merged; this makes intervals no wider."""
BINS = 10
"""Of the probability that an estimate states."""
PASS = np.dtype(
    [("log", "i8"), ("landmark", "i8"), ("first", "i8"), ("last", "i8"), ("unit", "i8")]
)
"""A pass: index of its log and of its ID, numbers of its first and last frame, its unit."""
OUTCOME = np.dtype([("frames", "i8"), ("right", "i8")])
"""How a method did in a pass: frames with the whole landmark in view; those in which it was
claimed."""
MOST_ROWS = 4_000_000
"""With more of them values by unit are rounded; see Values."""
STEPS = {"position": 1e-5, "orientation": 0.01}
"""m and deg to which errors are then rounded down: an edge of a histogram stays in its step."""
SCORES = np.unique(np.round([0, *1 / (1 + np.exp(-np.linspace(-14, 14, 1868))), 1], 6))
"""Those to which scores are then rounded down, so that no FPR of a curve rises: dense near 0 and 1,
where curves are steep."""


def sum_by_value(chunks: Iterable[Table]) -> Table:
    """The distinct values of chunks of (m,) values and (m, C) whole numbers, with their sums."""
    some = [chunk for chunk in chunks if len(chunk[0])]
    if not some:
        return np.empty(0), np.empty((0, 1), dtype=np.int64)
    value, of_value = np.unique(np.concatenate([v for v, _ in some]), return_inverse=True)
    number = np.concatenate([n for _, n in some])
    sums = [np.bincount(of_value, column, minlength=len(value)) for column in number.T]
    return value, np.stack(sums, axis=1).astype(np.int64)


def sum_by_unit(value: FloatArray, unit: IntArray, number: npt.NDArray[Any]) -> Rows:
    """One row for each value in each unit, in order. value, unit: (n,); number: (n, C)."""
    order = np.lexsort((value, unit))
    value, unit = value[order], unit[order]
    new = np.ones(len(value), dtype=bool)
    new[1:] = (np.diff(value) != 0) | (np.diff(unit) != 0)
    start = np.flatnonzero(new)
    if not len(start):
        return value, unit.astype(np.int32), np.empty((0, number.shape[1]), dtype=np.int32)
    sums = np.add.reduceat(number[order], start, axis=0, dtype=np.int32)
    return value[start], unit[start].astype(np.int32), sums


class Values:
    """The scores of claims and the errors of all logs, by key: ("claims", ...) or an error's name.

    Each log's are added by unit. With more than MOST_ROWS they stay exact in all, but by unit are
    rounded, so that memory does not grow with the number of claims.
    """

    def __init__(self) -> None:
        self._rows: dict[Key, list[Rows]] = defaultdict(list)
        self._rounded: dict[Key, list[Rows]] = defaultdict(list)
        self._exact: dict[Key, Table] = {}  # of those that are rounded
        self._tables: dict[Key, Table] = {}  # of all
        self._count = 0

    def add(self, key: Key, rows: Rows) -> None:
        """Add those of one log."""
        self._rows[key].append(rows)
        self._tables.pop(key, None)
        self._count += len(rows[0])
        if self._count > MOST_ROWS:
            for of in list(self._rows):
                self._round(of)
            self._count = 0

    def _round(self, key: Key) -> None:
        self._exact[key] = self.table(key)
        for value, unit, number in self._rows.pop(key):
            if step := STEPS.get(str(key[0])):
                coarse = np.floor(value / step) * step
            else:
                coarse = SCORES[np.searchsorted(SCORES, value, side="right") - 1]
            self._rounded[key].append(sum_by_unit(coarse, unit, number))

    def rows(self, key: Key) -> list[Rows]:
        """By unit, one for each log that has the key."""
        return [*self._rounded.get(key, ()), *self._rows.get(key, ())]

    def table(self, key: Key) -> Table:
        """In all."""
        if key not in self._tables:
            exact = [self._exact[key]] if key in self._exact else []
            fresh = ((value, number) for value, _, number in self._rows.get(key, ()))
            self._tables[key] = sum_by_value([*exact, *fresh])
        return self._tables[key]


@dataclass(frozen=True, slots=True)
class LogCounts:
    """The counts of one log: K IDs, U pass units, P passes. Small enough to keep for every log."""

    name: str
    ids: tuple[int, ...]
    methods: tuple[str, ...]
    placed: bool
    """Whether positions are known wherever the strict protocol needs them."""
    frames: int
    first_frame: int
    positives: int
    """How many truths count as positives under protocol strict."""
    ignored: int
    """How many truths protocol strict ignores, since less of them is in view."""
    gates: tuple[float, ...]
    """m, the distance within which a claim is right; empty without a truth."""
    units: int
    passes: npt.NDArray[Any]
    """(P,) PASS."""
    outcomes: dict[Key, npt.NDArray[Any]]
    """(P,) OUTCOME, by protocol and method."""
    sums: dict[Key, npt.NDArray[Any]]
    """(U, ...) by pass unit. ("declared", protocol, method): (K, 4) TP, TN, FP, FN at the operating
    point. ("calibration", method): as of `calibration`."""
    values: dict[Key, Rows]
    """("claims", protocol, method, k): scores with the effects of claims of the k-th ID.
    ("position" or "orientation", method, k): errors."""
    mistakes: dict[Key, npt.NDArray[Any]]
    """(n,) mistakes.ROWS, by protocol and method."""


def count_log(log: Matched, *, rates_only: bool = False) -> LogCounts:
    """Count one log. rates_only: leave out errors, calibration and mistakes."""
    passes = find_passes(log)
    beneath = truth_beneath(log) if log.placed and not rates_only else None
    groups = passes.unit_of_frame, passes.unit_of_truth
    sums: dict[Key, npt.NDArray[Any]] = {}
    outcomes: dict[Key, npt.NDArray[Any]] = {}
    values: dict[Key, Rows] = {}
    wrong: dict[Key, Wrong] = {}
    for protocol in PROTOCOLS if log.placed else PROTOCOLS[:1]:
        for method in (NOBODY, *log.methods):
            judged = judge(log, method, protocol)
            sums["declared", protocol, method] = judged.declared(*groups, passes.units)
            claimed = judged.positive_is_claimed
            outcomes[protocol, method] = _outcomes(judged, claimed, passes)
            if not rates_only:
                of = beneath if protocol == "strict" else None
                wrong[protocol, method] = find_wrong(log, judged, claimed, of)
            if method == NOBODY:
                continue
            group = judged.group(*groups)
            for k in range(len(log.ids)):
                of_id = judged.landmark_index == k
                rows = sum_by_unit(judged.score[of_id], group[of_id], judged.effect[of_id])
                values["claims", protocol, method, k] = rows
            if protocol == "strict" and not rates_only:
                for (name, k), found in _errors(judged, log, passes.unit_of_truth).items():
                    values[name, method, k] = found
    if beneath is not None:
        for m, method in enumerate(log.methods):
            if (stated := calibration(log, beneath, passes, m)) is not None:
                sums["calibration", method] = stated
    table = np.zeros(len(passes.unit), dtype=PASS)
    table["landmark"], table["unit"] = passes.landmark_index, passes.unit
    table["first"] = log.frame[passes.first_frame_index]
    table["last"] = log.frame[passes.last_frame_index]
    return LogCounts(
        name=log.name,
        ids=log.ids,
        methods=log.methods,
        placed=log.placed,
        frames=len(log.frame),
        first_frame=int(log.frame[0]),
        positives=int(log.truth_positive.sum()),
        ignored=int((~log.truth_positive).sum()),
        gates=(float(log.gate_m),) if len(log.truth_positive) else (),
        units=passes.units,
        passes=table,
        outcomes=outcomes,
        sums=sums,
        values=values,
        mistakes=over_frames(log, wrong),
    )


def _outcomes(judged: Judged, claimed: BoolArray, passes: Passes) -> npt.NDArray[Any]:
    """(P,) OUTCOME of one method in each pass. claimed: as of `positive_is_claimed`."""
    truth, right = judged.positive, claimed
    of_pass = passes.of_truth[truth] >= 0  # not so for one that is half in view, in protocol paper
    truth, right = truth[of_pass], right[of_pass]
    number = passes.of_truth[truth]
    found = np.zeros(len(passes.unit), dtype=OUTCOME)
    found["frames"] = np.bincount(number, minlength=len(found))
    found["right"] = np.bincount(number[right], minlength=len(found))
    return found


def _errors(strict: Judged, log: Matched, unit_of_truth: IntArray) -> dict[tuple[str, int], Rows]:
    """("position", k) and ("orientation", k): how often each error of right claims of the k-th ID.

    Positions in m, at most the gate, since claims beyond it are not right; orientations in deg: a
    rotation after which the ID looks the same is no error. Unknown ones are left out.
    """
    right = strict.right
    claim, truth, landmark = strict.claim[right], strict.truth[right], strict.landmark_index[right]
    period = log.turn_deg[landmark]
    off = log.claim_orientation[claim] - log.truth_orientation[truth]
    kinds: dict[str, FloatArray] = {
        "position": distance(log, claim, truth),
        "orientation": np.asarray(np.abs((off + period / 2) % period - period / 2)),
    }
    found = {}
    for name, error in kinds.items():
        for k in range(len(log.ids)):
            of_id = (landmark == k) & ~np.isnan(error)
            one = np.ones((int(of_id.sum()), 1), dtype=np.int64)
            found[name, k] = sum_by_unit(error[of_id], unit_of_truth[truth[of_id]], one)
    return found


def calibration(log: Matched, beneath: IntArray, passes: Passes, method: int) -> FloatArray | None:
    """(U, 3 * BINS) sums for the expected calibration error of one method's most probable class.

    Per bin of its probability the number, the sum of p and how many are right; None if the method
    states no probabilities. An estimate's true class is the landmark that it lies on, else "none".
    Estimates on a landmark partly in view, and those without probabilities, are left out.
    """
    used = np.asarray(~np.isnan(log.probability).any(axis=1)) & (log.method_index == method)
    on_one = beneath >= 0
    outcome = np.full(len(beneath), len(log.ids))
    unit = passes.unit_of_frame[log.claim_frame_index]
    if len(log.truth_landmark_index):
        outcome[on_one] = log.truth_landmark_index[beneath[on_one]]
        used[on_one] &= log.truth_positive[beneath[on_one]]
        unit = np.where(on_one, passes.unit_of_truth[beneath], unit)
    if not used.any():
        return None
    p = log.probability[used]
    most, right = p.max(axis=1), p.argmax(axis=1) == outcome[used]
    cell = unit[used] * BINS + np.minimum((most * BINS).astype(np.int64), BINS - 1)
    columns = (np.bincount(cell, w, passes.units * BINS) for w in (None, most, right))
    return np.hstack([column.reshape(passes.units, BINS) for column in columns])


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

    def count(self, k: int | None = None, log: int | None = None) -> Count:
        """The counts at the operating point, of the k-th ID or over all, in one log or in all."""
        logs = slice(None) if log is None else [log]
        ids = slice(None) if k is None else [k]
        return counted(*(of[logs][:, ids].sum(axis=(0, 1)) for of in (self.base, self.declared)))

    def named_counts(self, log: int | None = None) -> dict[str, Count]:
        """The counts of each ID, then "total"."""
        of = {str(i): self.count(k, log) for k, i in enumerate(self.ids)}
        return {**of, "total": self.count(None, log)}

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
    """The sums over all logs, which have the same IDs: `add` each, then `finish`.

    parts: of each log, without the `values` that are added up.
    """

    def __init__(self) -> None:
        self.parts: list[LogCounts] = []
        self.values = Values()
        self._first_unit = [0]

    def add(self, log: LogCounts) -> None:
        """Add the counts of a log."""
        first = self._first_unit[-1]
        for key, (value, unit, number) in log.values.items():
            self.values.add(key, (value, unit + first, number))
        self.parts.append(replace(log, values={}))
        self._first_unit.append(first + log.units)

    def finish(self, folders: Sequence[Path], methods: Sequence[str] = ()) -> Counts:
        """The sums. folders: of the logs; where several have one name it is their names.

        methods: those wanted; all if none is named.
        Raises SonarrecError if none has a method.
        """
        many = Counter(part.name for part in self.parts)
        self.logs = tuple(
            part.name if many[part.name] == 1 else str(folder)
            for part, folder in zip(self.parts, folders, strict=True)
        )
        self.ids = self.parts[0].ids
        there = {method for part in self.parts for method in part.methods}
        self.methods = chosen(there, methods, ", ".join(self.logs))
        if not self.methods:
            raise SonarrecError(f"{', '.join(self.logs)}: estimates.csv names no method to score")
        self.placed = all(part.placed for part in self.parts)
        self.protocols = PROTOCOLS if self.placed else PROTOCOLS[:1]
        self.frames, self.positives, self.ignored = (
            sum(getattr(part, name) for part in self.parts)
            for name in ("frames", "positives", "ignored")
        )
        self.gates = tuple(sorted({gate for part in self.parts for gate in part.gates}))
        return self

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

    def scored_by(self, method: str, protocol: str) -> Scored:
        """One method under one protocol."""
        return next(s for s in self.scored if (s.method, s.protocol) == (method, protocol))

    @cached_property
    def passes(self) -> npt.NDArray[Any]:
        """(P,) PASS of all logs."""
        found = np.concatenate([part.passes for part in self.parts])
        lengths = [len(part.passes) for part in self.parts]
        found["log"] = np.repeat(np.arange(len(self.parts)), lengths)
        found["unit"] += np.repeat(self._first_unit[:-1], lengths)
        return found

    def outcomes(self, protocol: str, method: str) -> npt.NDArray[Any]:
        """(P,) OUTCOME of a method in each pass of `passes`."""
        found = [_of(part.outcomes, protocol, method) for part in self.parts]
        return np.concatenate([of for of in found if of is not None])

    @cached_property
    def mistakes(self) -> list[Mistake]:
        """All that is wrong under the stricter protocol, made in the most frames first, then with
        the highest score."""
        protocol = self.protocols[-1]
        found = [
            Mistake(
                log=self.logs[n],
                method=method,
                kind=KINDS[kind],
                landmark=self.ids[k],
                other=None if other < 0 else self.ids[other],
                first_frame=first,
                last_frame=last,
                frames=frames,
                score=score,
                times=times,
                worst_frame=worst,
                protocol=protocol,
                at_start=int(kind == 1 and follows(method) and first == last == part.first_frame),
            )
            for method in self.methods
            for n, part in enumerate(self.parts)
            if (rows := _of(part.mistakes, protocol, method)) is not None
            for kind, k, other, first, last, frames, score, times, worst in rows.tolist()
        ]
        return sorted(found, key=lambda m: (-m.frames, math.isnan(m.score), -m.score))

    @cached_property
    def units(self) -> Units:
        """The independent units: passes, or logs if there are LOGS_ENOUGH."""
        if len(self.parts) >= LOGS_ENOUGH:
            of_log = np.repeat(np.arange(len(self.parts)), [part.units for part in self.parts])
            return Units("log", len(self.parts), of_log)
        count = self._first_unit[-1]
        number = np.arange(count)
        number = number * MOST_UNITS // count if count > MOST_UNITS else number
        return Units("pass", min(count, MOST_UNITS), number)

    def sums(self, *key: str) -> npt.NDArray[Any] | None:
        """(U, ...) by unit what the LogCounts have in `sums` under this key; None if none has any.

        Of a log that lacks a method, which is the last of the key, those of NOBODY.
        """
        sums: npt.NDArray[Any] | None = None
        for part, first in zip(self.parts, self._first_unit, strict=False):
            if (rows := _of(part.sums, *key)) is not None:
                if sums is None:
                    sums = np.zeros((self.units.count, *rows.shape[1:]), dtype=rows.dtype)
                np.add.at(sums, self.units.of_pass_unit[first : first + len(rows)], rows)
        return sums


T = TypeVar("T")


def _of(found: dict[Key, T], *key: str) -> T | None:
    """What a log has of a method, which is the last of the key, else what it has of NOBODY."""
    return found.get(key, found.get((*key[:-1], NOBODY)))
