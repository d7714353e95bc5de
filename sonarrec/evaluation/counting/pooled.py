"""An evaluation of many logs, each read once: sums over them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import FloatArray, IntArray, joined
from sonarrec.evaluation.counting.behaviour import PassOutcomes, Switches
from sonarrec.evaluation.counting.curves import Count, Curve, counted, curve_of
from sonarrec.evaluation.counting.histogram import Table, sum_by_value, values_at_ranks
from sonarrec.evaluation.counting.parts import Part, ScoredPart, Totals, by_unit
from sonarrec.evaluation.counting.passes import LOGS_ENOUGH, MOST_UNITS, UnitKind, merged_units
from sonarrec.evaluation.counting.scoring import PROTOCOLS
from sonarrec.evaluation.counting.unit_sums import FPR_GRID, Blocks, grid_points
from sonarrec.results.read import in_order

MOST_ROWS = 4_000_000
"""Of claims and errors; see Parts."""
FINE_GRID = np.unique([*FPR_GRID, *(FPR_GRID[1:] + FPR_GRID[:-1]) / 2])
"""FPRs at which the scores of a few logs give the edges for all: theirs is not the final curve."""


@dataclass(frozen=True, slots=True, repr=False)
class PooledScored:
    """The counts of one method under one protocol over all logs: L logs, K IDs."""

    protocol: str
    method: str
    ids: tuple[int, ...]
    base: IntArray
    """(L, K, 4) TP, TN, FP, FN without any claim."""
    declared: IntArray
    """(L, K, 4) TP, TN, FP, FN at the method's operating point."""
    parts: Parts

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
        of = range(len(self.ids)) if k is None else [k]
        tables = [self.parts.values(("claims", self.protocol, self.method, i)) for i in of]
        return curve_of(base, sum_by_value(tables))


@dataclass(frozen=True, slots=True)
class PooledUnits:
    """As `passes.Units`, in terms of pass units."""

    kind: UnitKind
    count: int
    of_pass_unit: IntArray
    """(all pass units,) the unit of each pass unit."""


class Parts:
    """The parts of an evaluation in the order of its logs.

    Claims and errors are kept by value and unit. With more than MOST_ROWS of them values are exact
    in all, but by unit only as fine as intervals and tests need them, so that memory does not grow
    with the number of claims.
    """

    def __init__(self) -> None:
        self.coarse = False
        """Whether values by unit are coarse, and values in all are those of all parts."""
        self._parts: list[Part] = []
        self._blocks: dict[Hashable, dict[int, npt.NDArray[Any]]] = defaultdict(dict)
        self._fresh: dict[Hashable, dict[int, npt.NDArray[Any]]] = defaultdict(dict)
        self._rows = 0
        self._edges: dict[Hashable, FloatArray] = {}
        self._all: dict[Hashable, Table] = {}
        self._selected: dict[int, tuple[int, int]] = {}

    def put(self, part: Part) -> int:
        """Keep a part; returns its number."""
        number = len(self._parts)
        self._parts.append(replace(part, blocks={}))
        for key, array in part.blocks.items():
            self._blocks[key][number] = array
            if array.dtype.names is not None:
                self._fresh[key][number] = array
                self._rows += len(array)
        if self._rows > MOST_ROWS:
            self._coarsen()
        return number

    def _coarsen(self) -> None:
        """Keep the fresh values by unit no finer than intervals need them."""
        for key, fresh in self._fresh.items():
            rows = ((block["value"], block["count"]) for block in fresh.values())
            table = self._all[key] = sum_by_value([*filter(None, [self._all.get(key)]), *rows])
            if key not in self._edges and len(table[0]):
                self._edges[key] = self._new_edges(key, table)
            for number, block in fresh.items():
                if len(block):
                    value = _on_edges(key, block["value"], self._edges[key])
                    coarse = by_unit(block.dtype, value, block["unit"], block["count"])
                    self._blocks[key][number] = coarse
        self._fresh.clear()
        self._rows, self.coarse = 0, True

    def _new_edges(self, key: Any, table: Table) -> FloatArray:
        """Rising: of scores those at the FPRs of FPR_GRID, of errors 513 quantiles."""
        kind, *of, k = key
        if kind != "claims":
            ranks = np.linspace(0, table[1].sum() - 1, 513).astype(np.int64)
            return np.unique(values_at_ranks(table, ranks))
        bases = (s.base[:, k].sum(axis=0) for p in self._parts for s in p.scored if _is(s, *of))
        curve = curve_of(np.sum([*bases], axis=0), table)
        edges = np.unique(curve.threshold[grid_points(curve, FINE_GRID)])
        return edges[np.isfinite(edges)] if np.isfinite(edges).any() else table[0][:1]

    def select(self, numbers: Sequence[int]) -> list[Part]:
        """Select the parts that count; the others are ignored from now on."""
        selected = [self._parts[n] for n in numbers]
        logs = np.cumsum([0, *(len(part.logs) for part in selected)]).tolist()
        units = np.cumsum([0, *(len(part.unit_log) for part in selected)]).tolist()
        self._selected = {n: (logs[i], units[i]) for i, n in enumerate(numbers)}
        return selected

    def blocks(self, key: Hashable) -> Iterator[tuple[int, int, npt.NDArray[Any]]]:
        """(index of the first log, of the first pass unit, array) of each part that has the key."""
        for number, array in self._blocks.get(key, {}).items():
            if number in self._selected:
                yield *self._selected[number], array

    def values(self, key: Hashable) -> Table:
        """The scores with the summed effects of their claims, or the errors with their counts."""
        if self.coarse:
            self._coarsen()
        if key not in self._all:
            rows = ((block["value"], block["count"]) for _, _, block in self.blocks(key))
            self._all[key] = sum_by_value(rows)
        return self._all[key]


@dataclass(frozen=True, slots=True, repr=False)
class Pooled(Totals):
    """The evaluation of all logs."""

    scored: tuple[PooledScored, ...]
    outcomes: tuple[PassOutcomes, ...]
    """In the order of `scored`."""
    parts: Parts
    min_visible: float
    folders: tuple[Path, ...] = ()
    """Results folder of each log, as given."""
    notes: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    """Input that could not be used, one line each."""

    def __repr__(self) -> str:
        return f"<evaluation of {len(self.logs)} logs, {self.frames} frames: {self.scored}>"

    def units(self, kind: UnitKind | None = None) -> PooledUnits:
        """The independent units of a kind: by default passes, or logs if there are LOGS_ENOUGH."""
        kind = kind or ("log" if len(self.logs) >= LOGS_ENOUGH else "pass")
        if kind == "log":
            return PooledUnits(kind, len(self.logs), self.unit_log)
        count = len(self.unit_log)
        return PooledUnits(kind, min(count, MOST_UNITS), merged_units(np.arange(count), count))

    def sums(self, key: tuple[str, ...], units: PooledUnits) -> IntArray:
        """(U, ...) sums of blocks that are by pass units; zeros (U, K, 4) if there are none."""
        sums: IntArray | None = None
        for _, first, rows in self.parts.blocks(key):
            if sums is None:
                sums = np.zeros((units.count, *rows.shape[1:]), dtype=rows.dtype)
            np.add.at(sums, units.of_pass_unit[first : first + len(rows)], rows)
        return np.zeros((units.count, len(self.ids), 4), np.int64) if sums is None else sums

    def sums_of_kind(self, key: tuple[str, ...], units: PooledUnits) -> npt.NDArray[Any] | None:
        """(U, ...) sums of blocks that are by units of each kind; None if there are none."""
        if units.kind == "pass":
            blocks = list(self.parts.blocks((*key, "pass")))
            return None if not blocks else self.sums((*key, "pass"), units)
        sums: npt.NDArray[Any] | None = None
        for first, _, rows in self.parts.blocks((*key, "log")):
            if sums is None:
                sums = np.zeros((units.count, *rows.shape[1:]))
            sums[first : first + len(rows)] = rows
        return sums

    def claims(self, scored: PooledScored, k: int | None, units: PooledUnits) -> Blocks:
        """The claims of the k-th ID, or of all, one log at a time."""
        for i in range(len(self.ids)) if k is None else [k]:
            key = ("claims", scored.protocol, scored.method, i)
            for _, first, c in self.parts.blocks(key):
                yield c["value"], c["count"], units.of_pass_unit[first + c["unit"]]

    def errors(self, name: str, units: PooledUnits, method: str, k: int) -> tuple[Table, Blocks]:
        """Errors of right claims of the k-th ID: all, and by unit. name: "position" or
        "orientation"."""
        key = name, method, k
        blocks = [
            (e["value"], e["count"], units.of_pass_unit[first + e["unit"]])
            for _, first, e in self.parts.blocks(key)
        ]
        return self.parts.values(key), blocks


def pool(parts: Parts, numbers: Sequence[int], names: Sequence[str], min_visible: float) -> Pooled:
    """The evaluation of these parts, which have the same IDs. names: of their logs."""
    selected = parts.select(numbers)
    methods = in_order({method for part in selected for method in part.methods})
    placed = all(part.placed for part in selected)
    ids = selected[0].ids
    scored, outcomes = [], []
    for method in methods:
        for protocol in PROTOCOLS if placed else PROTOCOLS[:1]:
            scored_parts = [_scored_part(part, protocol, method) for part in selected]
            base, declared = (
                np.concatenate([getattr(s, n) for s in scored_parts]) for n in _COUNTS
            )
            scored.append(PooledScored(protocol, method, ids, base, declared, parts))
            part_outcomes = [s.outcomes for s in scored_parts]
            arrays = (np.concatenate([getattr(o, n) for o in part_outcomes]) for n in _OUTCOMES)
            outcomes.append(PassOutcomes(protocol, method, *arrays))
    first_log = np.cumsum([0, *(len(part.logs) for part in selected)])
    first_unit = np.cumsum([0, *(len(part.unit_log) for part in selected)])
    passes = [
        replace(part.passes, log_index=part.passes.log_index + log, unit=part.passes.unit + unit)
        for part, log, unit in zip(selected, first_log, first_unit, strict=False)
    ]
    estimates = [dict(zip(part.methods, part.estimates.tolist(), strict=True)) for part in selected]
    return Pooled(
        logs=tuple(names),
        ids=ids,
        methods=methods,
        placed=placed,
        rounded=tuple(name for part in selected for name in part.rounded),
        timed=np.concatenate([part.timed for part in selected]),
        frames=sum(part.frames for part in selected),
        positives=np.sum([part.positives for part in selected], axis=0),
        ignored=sum(part.ignored for part in selected),
        gates=tuple(sorted({gate for part in selected for gate in part.gates})),
        estimates=np.array([sum(n.get(m, 0) for n in estimates) for m in methods]),
        unit_log=np.concatenate(
            [part.unit_log + log for part, log in zip(selected, first_log, strict=False)]
        ),
        passes=joined(passes),
        scored=tuple(scored),
        outcomes=tuple(outcomes),
        switches=tuple(_switches(selected, method) for method in methods) if placed else (),
        parts=parts,
        min_visible=min_visible,
    )


_COUNTS = ("base", "declared")
_OUTCOMES = ("frames", "right", "wait")


def _on_edges(key: Any, value: FloatArray, edges: FloatArray) -> FloatArray:
    """Scores rounded down to an edge, which has the bin of a threshold; errors rounded up."""
    if key[0] == "claims":
        at = np.searchsorted(edges, value, side="right") - 1
    else:
        at = np.searchsorted(edges, value)
    return np.asarray(edges[at.clip(0, len(edges) - 1)])


def _is(scored: ScoredPart, protocol: str, method: str) -> bool:
    return (scored.protocol, scored.method) == (protocol, method)


def _scored_part(part: Part, protocol: str, method: str) -> ScoredPart:
    """One method under one protocol; without claims if the part lacks the method."""
    of_protocol = [s for s in part.scored if s.protocol == protocol]
    of_method = next((s for s in of_protocol if s.method == method), None)
    if of_method is not None:
        return of_method
    frames = of_protocol[0].outcomes.frames
    never = np.full(len(frames), np.inf)
    none = PassOutcomes(protocol, method, frames, np.zeros_like(frames), never)
    return ScoredPart(protocol, method, of_protocol[0].base, of_protocol[0].base, none)


def _switches(parts: Sequence[Part], method: str) -> Switches:
    """The Switches of one method over all logs; 0 in logs that lack it."""
    of_method = [next((s for s in part.switches if s.method == method), None) for part in parts]
    nothing = [np.zeros(len(part.passes.unit), dtype=np.int64) for part in parts]
    objects = any(switches.objects for switches in of_method if switches is not None)

    def concatenated(name: str) -> IntArray:
        columns = [
            n if s is None else getattr(s, name) for s, n in zip(of_method, nothing, strict=True)
        ]
        return np.concatenate(columns)

    tracked = objects and any(
        switches.tracks is not None for switches in of_method if switches is not None
    )
    return Switches(
        method, concatenated("ids"), concatenated("tracks") if tracked else None, objects
    )
