"""Counts: what truths and claims add to TP, TN, FP and FN by unit; those of several logs add up.

Scores have six digits, so the sums by score hold every point of a ROC exactly.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sonarrec.arrays import IntArray, Table, stacked
from sonarrec.errors import SonarrecError
from sonarrec.evaluation.mistakes import KINDS, MISSED, Mistake, find_wrong, over_frames
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
from sonarrec.records import follows
from sonarrec.results.columns import chosen

LOGS_ENOUGH = 10
"""With so many logs the unit is a log, since the passes of one log have much in common."""
MOST_UNITS = 400
"""If there are more passes, neighbours in time are merged into so many units. Intervals do not
become wider by that."""
BINS = 10
"""Bins of the stated probability, in the calibration table."""
TOTAL = "total"
"""Stands for all IDs: the micro average."""
MOST_ROWS = 2_000_000
"""If claims and errors have more rows, they are rounded in the sums by unit, so that memory stays
small."""
STEPS = {"position": 1e-5, "orientation": 0.01}
"""Steps, in m and deg, to which errors are rounded down if there are more than MOST_ROWS rows."""
MILLION = 10**DIGITS
"""Scores are counted in millionths: whole numbers are sorted faster."""
SCORES = np.unique(np.rint([0, *MILLION / (1 + np.exp(-np.linspace(-14, 14, 1868))), MILLION]))
"""In millionths. With more than MOST_ROWS rows, scores are rounded down to these. Rounding down
cannot raise an FPR of a curve. They are dense near 0 and 1, where curves are steep."""
BY = ["method", "protocol", "landmark"]
_UNIT = ["method", "landmark", "unit"]
_EXACT = {"claims": [*BY, "score"]} | {kind: ["method", "landmark", "value"] for kind in STEPS}
"""Of each table that may be rounded, the columns by which its unrounded rows are added up."""
_ADDED = {"claims": COUNTS} | {kind: ["n"] for kind in STEPS}
"""The columns of these tables that are added up."""


def count_log(log: Matched, *, rates_only: bool = False) -> dict[str, Table]:
    """What one log adds to these tables, by unit.

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
        for name, of in of_protocol.items():
            parts[name].append(of.with_columns(protocol=np.int8(p)))
        if protocol == "strict" and beneath is not None:
            for kind, errors in _errors(log, right).items():
                parts[kind].append(errors.added_up([*_UNIT, "value"]))
            parts["calibration"].append(_calibration(log, beneath))
    tables = {name: stacked(of) for name, of in parts.items()}
    if "wrong" in tables:  # frame by frame; only the mistakes over neighbouring frames are returned
        tables["mistakes"] = over_frames(log, tables.pop("wrong"))
    return tables


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
    found = right.select(["method", "truth"]).added_up(["method", "truth"])
    found = Table(method=found["method"], passage=log.truths["passage"][found["truth"]], right=1)
    return found[found["passage"] >= 0].added_up(["method", "passage"])


def _errors(log: Matched, right: Table) -> dict[str, Table]:
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
        kind: right.select(_UNIT).with_columns(value=of, n=1)[~np.isnan(of)]
        for kind, of in errors.items()
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
    found = Table(
        method=log.claims["method"][used],
        unit=unit[used],
        bin=np.minimum((most * BINS).astype(int), BINS - 1),
        n=1,
        stated=most.astype(float),
        right=1 * (p.argmax(axis=1) == true[used]),
    )
    return found.added_up(["method", "unit", "bin"])


class Units(NamedTuple):
    """The clusters that the bootstrap draws and tests swap as a whole: kind is pass or log."""

    kind: str
    number: int


class Counts:
    """The sums over all logs, which have the same IDs: `add` each, then `finish`.

    rates_only: leave out errors, calibration and mistakes. `finish` sets these attributes:

    logs: names of the logs, each different.
    names: the same as the logs have them.
    frames_of: number of frames of each log.
    ids: of the landmarks.
    landmarks: these as text, then TOTAL.
    methods: those that are scored.
    protocols: those that are scored.
    placed: whether protocol strict is scored.
    frames: number of frames of all logs.
    positives: number of truths that count under protocol strict.
    ignored: number of those that do not.
    gates: m, all distances within which claims of a log are right.
    """

    def __init__(self, *, rates_only: bool = False) -> None:
        self._rates_only = rates_only
        self._logs: list[dict[str, Any]] = []
        self._names: list[str] = []  # of methods, which tables have by their index
        self._tables: dict[str, list[Table]] = defaultdict(list)
        # Sums of the logs added before the last rounding: `_exact` by score or error, without
        # units; `_rounded` by unit, with rounded scores and errors.
        self._exact: dict[str, list[Table]] = defaultdict(list)
        self._rounded: dict[str, list[Table]] = defaultdict(list)
        self._rows = 0
        self._corners: dict[tuple[str, str, str], pd.DataFrame] = {}
        self._last: tuple[tuple[str, str], Table] = ("", ""), Table(landmark=[])  # see `_steps`

    def add(self, log: Matched) -> None:
        """Add the counts of a log."""
        self._names += [name for name in log.methods if name not in self._names]
        index = np.array([*map(self._names.index, log.methods), -1], dtype=np.int16)
        first = {name: sum(of[name] for of in self._logs) for name in ("unit", "passage")}
        for name, of in count_log(log, rates_only=self._rates_only).items():
            columns = dict(of.columns)
            if name == "mistakes":
                columns["log"] = np.full(len(of), len(self._logs))
            if "method" in columns:
                columns["method"] = index[of["method"]]
            for column in first.keys() & columns.keys():
                columns[column] = of[column] + first[column]
            if name in ("claims", *STEPS):
                self._rows += len(of)
                small = [c for c, values in columns.items() if values.dtype == np.int64]
                columns |= {c: columns[c].astype(np.int32) for c in small}
            self._tables[name].append(Table(**columns))
        self._logs.append(
            {
                "name": log.name,
                "ids": log.ids,
                "methods": log.methods,
                "placed": log.placed,
                "unit": log.units,
                "passage": len(log.passes),
                "frames": len(log.frame),
                "first_frame": int(log.frame[0]) if len(log.frame) else 0,
                "positives": int(log.truths["strict"].sum()),
                "truths": len(log.truths),
                "gates": {float(log.gate_m)} if len(log.truths) else set(),
            }
        )
        if self._rows > MOST_ROWS:
            self._round()

    def _round(self) -> None:
        """Round scores and errors in the sums by unit, so that memory does not grow with the logs.

        The sums over all units are kept unrounded.
        """
        for name in ("claims", *STEPS):
            if self._tables[name]:
                of, by = stacked(self._tables[name]), _EXACT[name]
                fresh = of.select([*by, *_ADDED[name]])
                self._exact[name] = [stacked([*self._exact[name], fresh]).added_up(by)]
                if name == "claims":
                    rows = np.searchsorted(SCORES, of["score"], side="right") - 1
                    of = of.with_columns(score=SCORES[rows])
                else:
                    of = of.with_columns(value=np.floor(of["value"] / STEPS[name]) * STEPS[name])
                of = stacked([*self._rounded[name], of])
                self._rounded[name] = [of.added_up(["unit", *by])]
                self._tables[name] = []
        self._rows = 0

    def finish(self, folders: Sequence[Path], methods: Sequence[str] = ()) -> Counts:
        """Set the attributes of the class, after the last log.

        folders: one per log. Logs of one name are named by their folders. methods: those wanted;
        all if none is named. Raises SonarrecError if no log has a method to score, or
        if no log has a wanted one.
        """
        for name, parts in self._tables.items():
            self._tables[name] = [stacked(parts)] if parts else []
        every = self._logs
        many = Counter(log["name"] for log in every)
        self.logs = tuple(
            log["name"] if many[log["name"]] == 1 else str(folder)
            for log, folder in zip(every, folders, strict=True)
        )
        self.names = tuple(log["name"] for log in every)
        self.frames_of = [log["frames"] for log in every]
        self.ids: tuple[int, ...] = every[0]["ids"]
        self.landmarks = [*map(str, self.ids), TOTAL]
        there = {method for log in every for method in log["methods"]}
        self.methods = chosen(there, methods, ", ".join(self.logs))
        if not self.methods:
            raise SonarrecError(f"{', '.join(self.logs)}: estimates.csv names no method to score")
        self.placed = all(log["placed"] for log in every)
        self.protocols = PROTOCOLS if self.placed else PROTOCOLS[:1]
        self.frames, self.positives, truths = (
            sum(log[name] for log in every) for name in ("frames", "positives", "truths")
        )
        self.ignored = truths - self.positives
        self.gates = tuple(sorted(set().union(*(log["gates"] for log in every))))
        return self

    def lacking(self) -> list[tuple[str, list[str]]]:
        """Logs without estimates of some methods: the log's name, and these methods."""
        lacks = ([m for m in self.methods if m not in log["methods"]] for log in self._logs)
        return [(name, methods) for name, methods in zip(self.logs, lacks, strict=True) if methods]

    @cached_property
    def _log_of(self) -> IntArray:
        """(units,) the index of each unit's log, before units are merged."""
        return np.repeat(np.arange(len(self.logs)), [log["unit"] for log in self._logs])

    @cached_property
    def units(self) -> Units:
        """The independent units: passes, or logs if there are LOGS_ENOUGH."""
        if len(self.logs) >= LOGS_ENOUGH:
            return Units("log", len(self.logs))
        return Units("pass", min(len(self._log_of), MOST_UNITS))

    def rows(self, name: str, method: str = "", protocol: str = "", exact: bool = False) -> Table:
        """A table of all logs, or its rows of a method and a protocol, with units as of `units`.

        exact: without units, as it was before rows were rounded.
        """
        parts = [*(self._exact if exact else self._rounded)[name], *self._tables[name]]
        if exact:
            parts = [of.select([*_EXACT[name], *_ADDED[name]]) for of in parts]
        if method:
            parts = [of[of["method"] == self._names.index(method)] for of in parts]
        if protocol:
            parts = [of[of["protocol"] == PROTOCOLS.index(protocol)] for of in parts]
        of = stacked(parts)
        if "unit" not in of.columns:
            return of
        log, count = self._log_of[of["unit"]], len(self._log_of)
        unit = of["unit"] * MOST_UNITS // count if count > MOST_UNITS else of["unit"]
        return of.with_columns(unit=log if self.units.kind == "log" else unit, log=log)

    def table(self, name: str) -> pd.DataFrame:
        """A table of all logs, with names in place of indices."""
        of = self.rows(name)
        names = {"method": self._names, "protocol": PROTOCOLS}
        named = {c: np.take(names[c], of[c]) for c in names if c in of.columns}
        return pd.DataFrame(of.columns).assign(**named)

    @cached_property
    def base(self) -> pd.DataFrame:
        """TP, TN, FP, FN without any claim."""
        return self.table("base")

    @cached_property
    def points(self) -> pd.DataFrame:
        """TP, TN, FP, FN at the operating point, by log, method, protocol, landmark and unit.

        positives: the number of truths that count, which are the FN without any claim.
        """
        base = self.base.assign(positives=self.base.fn)
        base = base.merge(pd.DataFrame({"method": self.methods}), how="cross")
        found = pd.concat([base, self.table("declared").assign(positives=0)])
        found = found.groupby(["log", *BY, "unit"], as_index=False).sum()
        return found[found.method.isin(self.methods) & found.protocol.isin(self.protocols)]

    @cached_property
    def confusion(self) -> pd.DataFrame:
        """Rates and counts by method, protocol, log ("": all) and landmark, with the total."""
        found = self.points.astype({"landmark": str}).drop(columns="unit")
        found["log"] = np.take(self.logs, found.log)
        found = pd.concat([found, found.assign(log="")])
        found = pd.concat([found, found.assign(landmark=TOTAL)])
        order = [self.methods, self.protocols, ["", *self.logs], self.landmarks]
        index = pd.MultiIndex.from_product(order, names=["method", "protocol", "log", "landmark"])
        found = with_rates(found.groupby(index.names).sum().reindex(index))
        found["total"] = found[COUNTS].sum(axis=1)
        # Only protocol paper counts further claims of an ID in view in one frame.
        found["tpr_once"] = ratio(found.positives - found.fn, found.positives)
        return found

    def count(self, method: str, protocol: str, landmark: str = TOTAL, log: str = "") -> Any:
        """The row of `confusion`: count.tp and so on."""
        row = self.confusion.loc[[(method, protocol, log, landmark)]]
        return next(row.itertuples(index=False))

    def _steps(self, method: str, protocol: str) -> Table:
        """The sums of all claims by ID and score. Only the last result is kept."""
        if self._last[0] != (method, protocol):
            every = self.rows("claims", method, protocol, exact=True)
            steps = every.select(["landmark", "score", *COUNTS]).added_up(["landmark", "score"])
            self._last = (method, protocol), steps
        return self._last[1]

    def curve(self, method: str, protocol: str, landmark: str = TOTAL) -> pd.DataFrame:
        """The ROC: threshold, counts and rates, from infinity down. Equal scores are one point.

        At the last point every estimate is a claim; this need not be (1, 1), since a landmark
        without an estimate cannot be claimed.
        """
        steps = self._steps(method, protocol)
        if landmark == TOTAL:
            steps = steps.select(["score", *COUNTS]).added_up(["score"])
        else:
            steps = steps[steps["landmark"] == int(landmark)]
        base = of_landmark(self.base, landmark)
        first = base.loc[base.protocol == protocol, COUNTS].sum()
        curve = {name: np.cumsum(np.append(steps[name], first[name])[::-1]) for name in COUNTS}
        curve["threshold"] = np.append(steps["score"] / MILLION, np.inf)[::-1]
        found = with_rates(pd.DataFrame(curve))
        self._corners[method, protocol, landmark] = corners(found)
        return found

    def corners(self, method: str, protocol: str, landmark: str = TOTAL) -> pd.DataFrame:
        """The corners of the ROC, see `corners`; kept, since they are few and often drawn."""
        if (method, protocol, landmark) not in self._corners:
            self.curve(method, protocol, landmark)
        return self._corners[method, protocol, landmark]

    @cached_property
    def mistakes(self) -> list[Mistake]:
        """All mistakes under the stricter protocol, sorted by number of frames, then by score.

        The most frames and the highest scores come first.
        """
        protocol, found = self.protocols[-1], []
        for method in self.methods:
            lack = [n for n, log in enumerate(self._logs) if method not in log["methods"]]
            of = self.rows("mistakes", protocol=protocol)
            nobodys = (of["method"] < 0) & np.isin(of["log"], lack)
            of = of[nobodys | (of["method"] == self._names.index(method))]
            for row in zip(*(column.tolist() for column in of.columns.values()), strict=True):
                m = dict(zip(of.columns, row, strict=True))
                at_start = m["first"] == m["last"] == self._logs[m["log"]]["first_frame"]
                found.append(
                    Mistake(
                        log=self.logs[m["log"]],
                        method=method,
                        kind=KINDS[m["kind"]],
                        landmark=self.ids[m["landmark"]],
                        other=None if m["other"] < 0 else self.ids[m["other"]],
                        first_frame=m["first"],
                        last_frame=m["last"],
                        frames=m["frames"],
                        score=m["score"],
                        times=m["times"],
                        worst_frame=m["worst"],
                        protocol=protocol,
                        at_start=int(at_start and KINDS[m["kind"]] == MISSED and follows(method)),
                    )
                )
        return sorted(found, key=lambda m: (-m.frames, math.isnan(m.score), -m.score))

    @cached_property
    def passes(self) -> pd.DataFrame:
        """How each method did in each pass: frames (with the whole landmark in view), right (those
        in which it was claimed)."""
        of = pd.MultiIndex.from_product([self.methods, self.protocols], names=BY[:2])
        found = of.to_frame(index=False).merge(self.table("passes"), on="protocol")
        right = self.table("right")[["method", "protocol", "passage", "right"]]
        found = found.merge(right, how="left", on=["method", "protocol", "passage"])
        return found.assign(
            log=np.take(self.logs, found.log), right=found.right.fillna(0).astype(int)
        )


def of_landmark(table: pd.DataFrame, landmark: str) -> pd.DataFrame:
    """The rows of an ID, given as text, or of all."""
    return table if landmark == TOTAL else table[table.landmark == int(landmark)]


def ratio(part: Any, total: Any) -> Any:
    """part / total; NaN if both are 0, infinite if only the total is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return part / total


def with_rates(of: pd.DataFrame) -> pd.DataFrame:
    """Counts with TPR, TP / (TP + FN), and FPR, FP / (FP + TN)."""
    tp, tn, fp, fn = (of[name].to_numpy() for name in COUNTS)
    return of.assign(tpr=ratio(tp, tp + fn), fpr=ratio(fp, fp + tn))


def corners(curve: pd.DataFrame, most: int = 2000) -> pd.DataFrame:
    """The points needed to draw a curve: its corners and both ends.

    If these are more than `most`, each rate is divided into `most` / 2 equal steps. Of consecutive
    points in the same steps of both rates only the first is kept, and the last point of all.
    """
    step = np.stack([np.diff(curve.tp - curve.fn), np.diff(curve.fp - curve.tn)]) != 0
    keep = np.ones(len(curve), dtype=bool)
    # Of three points on a horizontal or vertical line the middle one is not needed.
    keep[1:-1] = (step[:, 1:] != step[:, :-1]).any(axis=0) | step[:, 1:].all(axis=0)
    curve = curve[keep]
    if len(curve) > most:
        rates = np.nan_to_num(curve[["tpr", "fpr"]].to_numpy().T)
        moved = (np.diff(np.floor(rates * (most // 2))) != 0).any(axis=0)
        moved[-1] = True
        curve = curve[np.append(True, moved)]
    return curve
