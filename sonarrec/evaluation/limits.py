"""Whether results are good enough: against those before, and against absolute limits."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from sonarrec.errors import UsageError, number_of
from sonarrec.evaluation.comparison import Comparison, RateChange, rate_text
from sonarrec.evaluation.count import Scored
from sonarrec.evaluation.curves import Count
from sonarrec.evaluation.metrics import BY_NAME
from sonarrec.nouns import follows

EACH = ""
"""Stands for every method that is looked at, in the limits."""
MOST_NAMED = 3
"""Logs that a sentence names."""
TOTAL = "total"


@dataclass(frozen=True, slots=True)
class Limits:
    """What results must keep."""

    band: float | None = None
    """By how much a rate may be worse than before, if by more than two frames; None: not asked."""
    least_tpr: Mapping[str, float] = field(default_factory=dict)
    most_fpr: Mapping[str, float] = field(default_factory=dict)
    """By method, or EACH. They hold for the rates over all IDs and logs under protocol strict,
    under protocol paper where strict cannot be scored."""
    methods: tuple[str, ...] = ()
    """Those looked at; empty: all that follow objects, or all if none does."""

    @property
    def are_given(self) -> bool:
        """Whether anything is to be kept."""
        return self.band is not None or bool(self.least_tpr or self.most_fpr)

    def looked_at(self, methods: Sequence[str]) -> tuple[str, ...]:
        """The methods looked at, of those in the results. Raises UsageError for one not there."""
        named = {*self.methods, *self.least_tpr, *self.most_fpr} - {EACH}
        if unknown := sorted(named - set(methods)):
            has = ", ".join(methods)
            raise UsageError(f"method {unknown[0]}: the results have no such method, but {has}")
        following = tuple(filter(follows, methods))
        return self.methods or following or tuple(methods)

    def broken(self, scored: Iterable[Scored]) -> list[str]:
        """A line for each absolute limit that the results do not keep.

        Raises UsageError for a limit of a method that they lack.
        """
        rates = {(s.protocol, s.method): s.count() for s in scored}
        methods = tuple(dict.fromkeys(method for _, method in rates))
        looked_at = self.looked_at(methods)
        protocol = max(protocol for protocol, _ in rates)  # strict, if it is scored
        lines = []
        for method in methods:
            count = rates[protocol, method]
            for name, rate, limits in (
                ("TPR", count.tpr, self.least_tpr),
                ("FPR", count.fpr, self.most_fpr),
            ):
                limit = limits.get(method, limits.get(EACH) if method in looked_at else None)
                # A TPR of 0/0 shows nothing, so it keeps no limit.
                if limit is None or (rate >= limit if name == "TPR" else not rate > limit):
                    continue
                beyond = f"{'below' if name == 'TPR' else 'above'} {limit:g}"
                told = f"{name} {rate_text(rate)} ({method}, {protocol}) is {beyond}"
                lines.append(f"limit not kept: {told}")
        return lines


@dataclass(frozen=True, slots=True)
class Row:
    """The rates of one method under one protocol, before and now: of a log, or of all."""

    log: str
    """Its name, or TOTAL."""
    method: str
    protocol: str
    old: Count
    new: Count
    band: float
    """As in Limits."""

    @property
    def is_total(self) -> bool:
        return self.log == TOTAL

    @property
    def texts(self) -> tuple[str, str, str, str]:
        """TPR before and now, FPR before and now."""
        old, new = self.old, self.new
        return rate_text(old.tpr), rate_text(new.tpr), rate_text(old.fpr), rate_text(new.fpr)

    @property
    def mark(self) -> str:
        """ "worse" or "better" if a rate is by more than the band and two frames, else ""."""
        signs = {r.sign(self.band) for r in self.rates()}
        return "worse" if 1 in signs else "better" if -1 in signs else ""

    def rates(self) -> list[RateChange]:
        """The TPR and the FPR."""
        old, new, labels = self.old, self.new, (self.protocol, self.method, TOTAL)
        return [
            RateChange(*labels, "tpr", old.tpr, new.tpr, new.tp + new.fn),
            RateChange(*labels, "fpr", old.fpr, new.fpr, new.fp + new.tn),
        ]


@dataclass(frozen=True, slots=True)
class Judgement:
    """What `judge_by` found."""

    sentence: str
    """Begins with worse, limit not kept, better, as good, or unchanged."""
    rows: tuple[Row, ...]
    """Of every log, then of all if there are several."""
    faults: tuple[str, ...]
    """A line for each rate that is worse, and for each limit that is not kept."""


def judge_by(comparison: Comparison, limits: Limits) -> Judgement:
    """Judge new results by the old ones and by the limits.

    Worse is a rate over all IDs in one log, or of one ID or of all IDs in all logs.
    Raises UsageError if a method that the limits name is in neither.
    """
    band = math.inf if limits.band is None else limits.band
    after = comparison.passes.after
    compared = [method for _, method in comparison.methods]
    named = dict.fromkeys((*compared, *comparison.gained, *comparison.lost))
    looked_at = limits.looked_at(tuple(named))
    rows = tuple(_rows(comparison, looked_at, band))
    worse = [f"worse: {line}" for line in comparison.regressions(band, looked_at)]
    of_logs = [row for row in rows if not row.is_total and len(comparison.logs) > 1]
    worse += [
        f"worse: {row.log}: {row.method}, {row.protocol}: {BY_NAME[r.rate].label} was "
        f"{rate_text(r.old)}, is {rate_text(r.new)}"
        for row in of_logs
        for r in row.rates()
        if r.sign(band) > 0
    ]
    there = Limits(
        least_tpr={m: r for m, r in limits.least_tpr.items() if m in (EACH, *after.methods)},
        most_fpr={m: r for m, r in limits.most_fpr.items() if m in (EACH, *after.methods)},
        methods=tuple(m for m in looked_at if m in after.methods),
    )
    broken = there.broken(after.scored)
    return Judgement(_sentence(comparison, rows, worse, broken), rows, (*worse, *broken))


def _rows(comparison: Comparison, methods: Sequence[str], band: float) -> Iterator[Row]:
    before, after = comparison.passes.before, comparison.passes.after
    old = {(s.protocol, s.method): s for s in before.scored}
    pairs = [
        (old[s.protocol, s.method], s)
        for s in sorted(after.scored, key=lambda s: s.protocol, reverse=True)  # strict first
        if s.method in methods and (s.protocol, s.method) in old
    ]
    per_log = [tuple(s.counts_per_log() for s in pair) for pair in pairs]

    for n, log in enumerate(comparison.logs):
        for (_, s), (was, now) in zip(pairs, per_log, strict=True):
            yield Row(log, s.method, s.protocol, was[n][-1], now[n][-1], band)
    if len(comparison.logs) > 1:
        for was_all, s in pairs:
            yield Row(TOTAL, s.method, s.protocol, was_all.count(), s.count(), band)


def _sentence(
    comparison: Comparison, rows: Sequence[Row], worse: Sequence[str], broken: Sequence[str]
) -> str:
    logs = len(comparison.logs)
    totals = [row for row in rows if row.is_total or logs == 1]
    of_all = _over(comparison.logs)
    if worse:
        parts = [f"worse: {_of_worse(rows, totals, worse, comparison.logs)}"]
        return "; ".join([*parts, *broken])
    if broken:
        return f"{'; '.join(broken)}; otherwise no worse"
    if not totals:
        return f"as good: {of_all}"
    text = f"{_rates_text(totals[0])} {of_all}"
    if any(row.mark == "better" for row in rows):
        better = next((row for row in (*totals, *rows) if row.mark == "better"), totals[0])
        where = of_all if better in totals else f"in {better.log}"
        return f"better: {_rates_text(better)} {where}"
    changed = any(row.texts[0] != row.texts[1] or row.texts[2] != row.texts[3] for row in rows)
    return f"{'as good' if changed else 'unchanged'}: {text}"


def _over(logs: Sequence[str]) -> str:
    return f"in {logs[0]}" if len(logs) == 1 else f"over {number_of(len(logs), 'log')}"


def _of_worse(
    rows: Sequence[Row], totals: Sequence[Row], worse: Sequence[str], logs: Sequence[str]
) -> str:
    marked = [row for row in rows if row.mark == "worse"]
    if not marked:  # a curve, one ID, or a method that is gone
        more = f" (and {len(worse) - 1} more)" if len(worse) > 1 else ""
        return worse[0].removeprefix("worse: ") + more
    head = max(
        marked, key=lambda row: (row in totals, row.protocol, max(r.worse for r in row.rates()))
    )
    names = list(dict.fromkeys(row.log for row in marked if not row.is_total))
    text = _rates_text(head)
    if len(logs) == 1 or not names:
        return f"{text} {_over(logs)}"
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    where = _over(logs) if head.is_total else f"in {head.log}"
    on = f"on {len(names)} of {len(logs)} logs: {', '.join(names[:MOST_NAMED])}{more}"
    return f"{text} {where}; worse {on}"


def _rates_text(row: Row) -> str:
    """Such as "TPR 0.9861 -> 0.6903 (framework, strict)": what changed, or both if nothing did."""
    old_tpr, tpr, old_fpr, fpr = row.texts
    changed = [
        f"{name} {old} -> {new}"
        for name, old, new in (("TPR", old_tpr, tpr), ("FPR", old_fpr, fpr))
        if old != new
    ]
    return f"{', '.join(changed) or f'TPR {tpr}, FPR {fpr}'} ({row.method}, {row.protocol})"
