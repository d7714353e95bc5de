"""Counts: what truths and claims add to TP, TN, FP and FN by unit; those of several logs add up.

Scores have six digits, so the sums by score hold every point of a ROC exactly.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sonarrec.arrays import IntArray, Table, stacked
from sonarrec.errors import SonarrecError
from sonarrec.evaluation.mistakes import KINDS, Mistake, find_wrong, over_frames
from sonarrec.evaluation.rows import (
    COUNTS,
    DIGITS,
    PROTOCOLS,
    Matched,
    effects,
    judge,
    positives,
    present,
    truth_beneath,
)
from sonarrec.results.columns import chosen
from sonarrec.sonar.frame import follows

LOGS_ENOUGH = 10
"""With so many logs the unit is a log, since the passes of one log have much in common."""
MOST_UNITS = 400
"""If there are more passes, neighbours in time are merged into so many units. Intervals do not
become wider by that."""
BINS = 10
"""Bins of the stated probability, in the calibration table."""
TOTAL = "total"
"""Stands for all IDs: the micro average."""
MILLION = 10**DIGITS
"""Scores are counted in millionths: whole numbers are sorted faster."""
LONG = {"claims", "position", "orientation"}
"""Tables with a row per claim: their integers have 32 bits."""
_UNIT = ["method", "landmark", "unit"]


class CountedLog(NamedTuple):
    """What one log adds to the counts."""

    name: str
    methods: tuple[str, ...]
    ids: tuple[int, ...]
    placed: bool
    """Whether protocol strict can be scored."""
    units: int
    passes: int
    frames: int
    positives: int
    """Truths that count under protocol strict."""
    truths: int
    gate_m: float
    tables: dict[str, Table]
    """Those of `count_log`; none any more once they were added up."""


def count_log(log: Matched, *, rates_only: bool = False) -> CountedLog:
    """One log with its rows of these tables, by unit.

    base: TP, TN, FP, FN without any claim, by protocol and landmark.
    declared: what the declared claims add, also by method.
    claims: what all claims add, also by score (in millionths).
    passes: a row per protocol and pass, with the number of its frames.
    right: by protocol, method and pass, the number of its frames in which it was claimed.
    position, orientation: the number n of right claims with an error, m and deg, by method,
    landmark and the error's value.
    calibration: see `_calibration`.
    mistakes: see `over_frames`.

    rates_only: leave out position, orientation, calibration and mistakes. Methods and protocols are
    indices, into the log's methods and PROTOCOLS.
    """
    parts: dict[str, list[Table]] = defaultdict(list)
    beneath = truth_beneath(log) if log.placed and not rates_only else None
    for p, protocol in enumerate(PROTOCOLS if log.placed else PROTOCOLS[:1]):
        truths, judged = log.truths[positives(log, protocol)], judge(log, protocol)
        declared = effects(judged[judged["declared"]], protocol)
        right = declared[declared["tp"] > 0]
        of_protocol = {
            "base": _without_claims(log, truths, protocol),
            "declared": declared.select([*_UNIT, *COUNTS]).added_up(_UNIT),
            "claims": _all_claims(effects(judged, protocol)),
            "passes": log.passes.with_columns(frames=_number_of(truths["passage"], log)),
            "right": _right(log, right),
        }
        if not rates_only:
            of_protocol["wrong"] = find_wrong(
                log, judged, protocol, beneath if protocol == "strict" else None
            )
        for name, pieces in of_protocol.items():
            parts[name].append(pieces.with_columns(protocol=np.int8(p)))
        if protocol == "strict" and beneath is not None:
            for kind, errors in errors_of(log, right).items():
                parts[kind].append(errors.added_up([*_UNIT, "value"]))
            parts["calibration"].append(_calibration(log, beneath))
    tables = {name: stacked(pieces) for name, pieces in parts.items()}
    if "wrong" in tables:  # frame by frame; only the mistakes over neighbouring frames are kept
        tables["mistakes"] = over_frames(log, tables.pop("wrong"))
    for name in LONG & tables.keys():
        small = {c: v.astype(np.int32) for c, v in tables[name].columns.items() if v.dtype == int}
        tables[name] = tables[name].with_columns(**small)
    return CountedLog(
        name=log.name,
        methods=log.methods,
        ids=log.ids,
        placed=log.placed,
        units=log.units,
        passes=len(log.passes),
        frames=len(log.frame),
        positives=int(log.truths["strict"].sum()),
        truths=len(log.truths),
        gate_m=float(log.gate_m),
        tables=tables,
    )


def _all_claims(judged: Table) -> Table:
    score = np.rint(judged["score"] * MILLION).astype(np.int32)
    every = judged.select([*_UNIT, *COUNTS]).with_columns(score=score)
    return every.added_up([*_UNIT, "score"])


def _without_claims(log: Matched, truths: Table, protocol: str) -> Table:
    """TN and FN of every ID and unit if nothing is claimed."""
    absent = ~present(log, protocol).reshape(-1, len(log.ids))
    tn = np.stack([np.bincount(log.unit, column, log.units) for column in absent.T]).astype(int)
    fn = np.zeros_like(tn)
    np.add.at(fn, (truths["cell"] % len(log.ids), truths["unit"]), 1)
    landmark, unit = np.repeat(log.ids, log.units), np.tile(np.arange(log.units), len(log.ids))
    return Table(landmark=landmark, unit=unit, tp=0, tn=tn.ravel(), fp=0, fn=fn.ravel())


def _number_of(passage: IntArray, log: Matched) -> IntArray:
    """(passes,) the number of truths in each. passage: (truths,) the index of each pass, or -1."""
    return np.bincount(passage[passage >= 0], minlength=len(log.passes))


def _right(log: Matched, right: Table) -> Table:
    """By method and pass, the number of its frames in which it was claimed.

    right: the right claims. Several of one truth count once. A truth without a pass is left out.
    """
    pairs = right.select(["method", "truth"]).added_up(["method", "truth"])
    pairs = Table(method=pairs["method"], passage=log.truths["passage"][pairs["truth"]], right=1)
    return pairs[pairs["passage"] >= 0].added_up(["method", "passage"])


def errors_of(log: Matched, right: Table) -> dict[str, Table]:
    """A row per right claim and kind of error; a rotation after which the ID looks the same is no
    error. Unknown ones are left out."""
    claims, truths = log.claims[right["claim"]], log.truths[right["truth"]]
    period = np.array([log.period_deg[i] for i in right["landmark"].tolist()], dtype=float)
    rotation = claims["orientation"] - truths["orientation"]
    errors = {
        "position": np.hypot(claims["x"] - truths["x"], claims["y"] - truths["y"]),
        "orientation": np.abs((rotation + period / 2) % period - period / 2),
    }
    return {
        kind: right.select(_UNIT).with_columns(value=error, n=1)[~np.isnan(error)]
        for kind, error in errors.items()
    }


def _calibration(log: Matched, beneath: IntArray) -> Table:
    """Of the most probable class of every estimate: n, the sum of its p and how many are right, by
    method, unit and bin of p.

    An estimate's true class is the landmark that it lies on, else "none". Estimates on a landmark
    partly in view, and those without probabilities, are left out.
    """
    none = len(log.ids)
    true, unit = np.full(len(beneath), none), log.unit[log.claims["at"]]
    on_one = beneath >= 0
    truths = log.truths[beneath[on_one]]
    true[on_one], unit[on_one] = truths["cell"] % max(none, 1), truths["unit"]
    used = np.asarray(~np.isnan(log.probability).any(axis=1))
    used[on_one] &= truths["strict"]
    p = log.probability[used]
    most = p.max(axis=1)
    estimates = Table(
        method=log.claims["method"][used],
        unit=unit[used],
        bin=np.minimum((most * BINS).astype(int), BINS - 1),
        n=1,
        stated=most.astype(float),
        right=1 * (p.argmax(axis=1) == true[used]),
    )
    return estimates.added_up(["method", "unit", "bin"])


class Units(NamedTuple):
    """The clusters that the bootstrap draws and tests swap as a whole: kind is pass or log."""

    kind: str
    number: int


class Count(NamedTuple):
    """Counts and rates of one method under one protocol, for an ID or in total."""

    tp: int
    tn: int
    fp: int
    fn: int
    positives: int
    """Truths that count, which are the FN without any claim."""
    frames: int
    """All that are scored, whatever is in view."""

    @property
    def total(self) -> int:
        """All counts."""
        return self.tp + self.tn + self.fp + self.fn

    @property
    def tpr(self) -> float:
        """TP / (TP + FN); NaN for 0/0."""
        return float(ratio(self.tp, self.tp + self.fn))

    @property
    def fpr(self) -> float:
        """FP / (FP + TN); NaN for 0/0."""
        return float(ratio(self.fp, self.fp + self.tn))

    @property
    def false_per_100(self) -> float:
        """False claims, which are the FP, in 100 frames; NaN without frames."""
        return float(ratio(100 * self.fp, self.frames))

    @property
    def tpr_once(self) -> float:
        """The TPR without further claims of an ID in a frame, which only protocol paper counts."""
        return float(ratio(self.positives - self.fn, self.positives))


def add_up(
    logs: Sequence[CountedLog], folders: Sequence[Path], methods: Sequence[str] = ()
) -> Counts:
    """The counts of logs of the same IDs; their tables go as they are joined.

    folders: one per log. Logs of one name are named by their folders. methods: those wanted; all if
    none is named. Raises SonarrecError if no log has a method to score, or if no log has a wanted
    one.
    """
    many = Counter(log.name for log in logs)
    names = tuple(
        log.name if many[log.name] == 1 else str(folder)
        for log, folder in zip(logs, folders, strict=True)
    )
    indexed = tuple(dict.fromkeys(method for log in logs for method in log.methods))
    scored = chosen(indexed, methods, ", ".join(names))
    if not scored:
        raise SonarrecError(f"{', '.join(names)}: estimates.csv names no method to score")
    parts: dict[str, list[Table]] = defaultdict(list)
    first = {"unit": 0, "passage": 0}  # of the next log
    for n, log in enumerate(logs):
        index = np.array([*map(indexed.index, log.methods), -1], dtype=np.int16)
        while log.tables:
            name, table = log.tables.popitem()
            of_all = {c: table[c] + first[c] for c in first.keys() & table.columns.keys()}
            if "method" in table.columns:
                of_all["method"] = index[table["method"]]
            if name not in LONG:
                of_all["log"] = np.full(len(table), n, dtype=np.int32)
            parts[name].append(table.with_columns(**of_all))
        first = {"unit": first["unit"] + log.units, "passage": first["passage"] + log.passes}
    tables = {name: stacked(parts.pop(name)) for name in [*parts]}
    return Counts(names, tuple(logs), scored, indexed, tables)


@dataclass(eq=False)
class Counts:
    """The sums over all logs, which have the same IDs."""

    logs: tuple[str, ...]
    """Their names, each different."""
    counted: tuple[CountedLog, ...]
    methods: tuple[str, ...]
    """Those that are scored."""
    indexed: tuple[str, ...]
    """All methods of the logs, which the tables have by their index."""
    tables: dict[str, Table]
    """Those of `count_log`, with units and passes numbered over all logs; the short ones also with
    `log`, the log's index."""
    _corners: dict[tuple[str, str, str], Table] = field(default_factory=dict, init=False)

    @property
    def ids(self) -> tuple[int, ...]:
        """Of the landmarks."""
        return self.counted[0].ids

    @property
    def landmarks(self) -> list[str]:
        """The IDs as text, then TOTAL."""
        return [*map(str, self.ids), TOTAL]

    @property
    def placed(self) -> bool:
        """Whether protocol strict is scored."""
        return all(log.placed for log in self.counted)

    @property
    def protocols(self) -> tuple[str, ...]:
        """Those that are scored."""
        return PROTOCOLS if self.placed else PROTOCOLS[:1]

    @property
    def frames(self) -> int:
        """Of all logs."""
        return sum(log.frames for log in self.counted)

    @property
    def positives(self) -> int:
        """Truths that count under protocol strict."""
        return sum(log.positives for log in self.counted)

    @property
    def ignored(self) -> int:
        """Truths that do not count under protocol strict."""
        return sum(log.truths for log in self.counted) - self.positives

    @property
    def gates(self) -> tuple[float, ...]:
        """All distances, m, within which claims are right, of logs with truth."""
        return tuple(sorted({log.gate_m for log in self.counted if log.truths}))

    def lacking(self) -> list[tuple[str, list[str]]]:
        """Logs without estimates of some methods: the log's name, and these methods."""
        lacks = ([m for m in self.methods if m not in log.methods] for log in self.counted)
        return [(name, methods) for name, methods in zip(self.logs, lacks, strict=True) if methods]

    @cached_property
    def units(self) -> Units:
        """The independent units: passes, or logs if there are LOGS_ENOUGH."""
        if len(self.logs) >= LOGS_ENOUGH:
            return Units("log", len(self.logs))
        return Units("pass", min(len(self._unit), MOST_UNITS))

    @cached_property
    def _unit(self) -> IntArray:
        """(units of all logs,) the unit of `units` that each is part of."""
        if len(self.logs) >= LOGS_ENOUGH:
            return np.repeat(np.arange(len(self.logs)), [log.units for log in self.counted])
        count = sum(log.units for log in self.counted)
        return np.arange(count) * min(count, MOST_UNITS) // count

    def rows(self, name: str, method: str = "", protocol: str = "") -> Table:
        """A table of all logs, or its rows of a method and a protocol, with units as of `units`."""
        rows = self.tables[name]
        if method:
            rows = rows[rows["method"] == self.indexed.index(method)]
        if protocol:
            rows = rows[rows["protocol"] == PROTOCOLS.index(protocol)]
        return rows.with_columns(unit=self._unit[rows["unit"]]) if "unit" in rows.columns else rows

    @cached_property
    def confusion(self) -> dict[tuple[str, str, str, str], Count]:
        """Counts and rates by method, protocol, log ("": all) and landmark, with the total."""
        counted, names = {}, [*COUNTS, "positives"]
        frames = [self.frames, *(log.frames for log in self.counted)]
        shape = (1 + len(self.logs), len(self.landmarks), len(names))
        for method in self.methods:
            for protocol in self.protocols:
                sums = np.zeros(shape, dtype=int)
                base = self.rows("base", protocol=protocol)
                unclaimed = base.with_columns(positives=base["fn"])
                for rows in (unclaimed, self.rows("declared", method, protocol)):
                    k = np.array([self.ids.index(i) for i in rows["landmark"].tolist()], dtype=int)
                    for n, name in enumerate(names):
                        if name in rows.columns:
                            np.add.at(sums[:, :, n], (1 + rows["log"], k), rows[name])
                sums[0] = sums.sum(axis=0)
                sums[:, -1] = sums.sum(axis=1)
                for n, log in enumerate(("", *self.logs)):
                    for landmark, counts in zip(self.landmarks, sums[n].tolist(), strict=True):
                        counted[method, protocol, log, landmark] = Count._make([*counts, frames[n]])
        return counted

    def count(self, method: str, protocol: str, landmark: str = TOTAL, log: str = "") -> Count:
        """One of `confusion`."""
        return self.confusion[method, protocol, log, landmark]

    def curves(self, method: str, protocol: str) -> Iterator[tuple[str, Table]]:
        """The ROC of each landmark: threshold, counts and rates, from infinity down.

        Equal scores are one point. At the last point every estimate is a claim; this need not be
        (1, 1), since a landmark without an estimate cannot be claimed.
        """
        every = self.rows("claims", method, protocol)
        of_ids = every.select(["landmark", "score", *COUNTS]).added_up(["landmark", "score"])
        for landmark in self.landmarks:
            steps = of_landmark(of_ids, landmark)
            if landmark == TOTAL:
                steps = steps.select(["score", *COUNTS]).added_up(["score"])
            base = of_landmark(self.rows("base", protocol=protocol), landmark)
            totals = {n: np.cumsum(np.append(steps[n], base[n].sum())[::-1]) for n in COUNTS}
            points = Table(
                **totals,
                threshold=np.append(steps["score"] / MILLION, np.inf)[::-1],
                tpr=ratio(totals["tp"], totals["tp"] + totals["fn"]),
                fpr=ratio(totals["fp"], totals["fp"] + totals["tn"]),
            )
            self._corners[method, protocol, landmark] = corners(points)
            yield landmark, points

    def curve(self, method: str, protocol: str, landmark: str = TOTAL) -> Table:
        """One of `curves`."""
        return dict(self.curves(method, protocol))[landmark]

    def corners(self, method: str, protocol: str, landmark: str = TOTAL) -> Table:
        """The corners of the ROC, see `corners`; kept, since they are few and often drawn."""
        if (method, protocol, landmark) not in self._corners:
            self.curve(method, protocol)
        return self._corners[method, protocol, landmark]

    @cached_property
    def mistakes(self) -> list[Mistake]:
        """All mistakes under the stricter protocol, sorted by number of frames, then by score.

        The most frames and the highest scores come first.
        """
        protocol, mistakes = self.protocols[-1], []
        of_all = self.rows("mistakes", protocol=protocol)
        for method in self.methods:
            lack = [n for n, log in enumerate(self.counted) if method not in log.methods]
            nobodys = (of_all["method"] < 0) & np.isin(of_all["log"], lack)
            table = of_all[nobodys | (of_all["method"] == self.indexed.index(method))]
            for row in zip(*(column.tolist() for column in table.columns.values()), strict=True):
                m = dict(zip(table.columns, row, strict=True))
                named = {
                    "log": self.logs[m["log"]],
                    "method": method,
                    "kind": KINDS[m["kind"]],
                    "landmark": self.ids[m["landmark"]],
                    "other": None if m["other"] < 0 else self.ids[m["other"]],
                    "protocol": protocol,
                    "at_start": m["at_start"] * follows(method),
                }
                mistakes.append(Mistake(**m | named))
        return sorted(mistakes, key=lambda m: (-m.frames, math.isnan(m.score), -m.score))

    @cached_property
    def passes(self) -> Table:
        """How each method did in each pass: frames (with the whole landmark in view), right (those
        in which it was claimed)."""
        parts = []
        for method in self.methods:
            for protocol in self.protocols:
                passes = self.rows("passes", protocol=protocol)
                claimed = self.rows("right", method, protocol)
                right = np.zeros(sum(log.passes for log in self.counted), dtype=int)
                right[claimed["passage"]] = claimed["right"]
                parts.append(
                    passes.with_columns(
                        log=np.array(self.logs)[passes["log"]],
                        method=method,
                        protocol=protocol,
                        right=right[passes["passage"]],
                    )
                )
        return stacked(parts)


def of_landmark(table: Table, landmark: str) -> Table:
    """The rows of an ID, given as text, or of all."""
    return table if landmark == TOTAL else table[table["landmark"] == int(landmark)]


def ratio(part: Any, total: Any) -> Any:
    """part / total; NaN if both are 0, infinite if only the total is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.divide(part, total)


def corners(curve: Table, most: int = 2000) -> Table:
    """The points needed to draw a curve: its corners and both ends.

    If these are more than `most`, each rate is divided into `most` / 2 equal steps. Of consecutive
    points in the same steps of both rates only the first is kept, and the last point of all.
    """
    step = np.stack([np.diff(curve["tp"] - curve["fn"]), np.diff(curve["fp"] - curve["tn"])]) != 0
    keep = np.ones(len(curve), dtype=bool)
    # Of three points on a horizontal or vertical line the middle one is not needed.
    keep[1:-1] = (step[:, 1:] != step[:, :-1]).any(axis=0) | step[:, 1:].all(axis=0)
    curve = curve[keep]
    if len(curve) > most:
        rates = np.nan_to_num([curve["tpr"], curve["fpr"]])
        moved = (np.diff(np.floor(rates * (most // 2))) != 0).any(axis=0)
        moved[-1] = True
        curve = curve[np.append(True, moved)]
    return curve
