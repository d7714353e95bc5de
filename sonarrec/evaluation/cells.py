"""The evaluation's numbers as table cells."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from sonarrec.evaluation.count import Counts, Scored
from sonarrec.evaluation.curves import Count
from sonarrec.evaluation.intervals import Difference, Figure
from sonarrec.evaluation.metrics import BY_NAME, METRICS
from sonarrec.evaluation.summary import Summary

HEADLINE = ("tpr", "fpr")
"""Shown in a table of their own before the other figures."""
COUNT_ROWS = (("TP", "tp"), ("TN", "tn"), ("FP", "fp"), ("FN", "fn"), ("beta", "total"))
TESTED = tuple(metric for metric in METRICS if metric.tested)


@dataclass(frozen=True, slots=True)
class Cell:
    """A value and, if known, its interval and the result of a test."""

    value: str
    low: str = ""
    high: str = ""
    test: str = ""


NONE = Cell("-")


@dataclass(frozen=True, slots=True)
class Table:
    """One of the paper's tables."""

    method: str
    protocol: str
    heading: list[str]
    rows: list[tuple[str, list[str]]]
    """A label and its cells, one per heading."""


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """Rates and mistakes of one method at its operating point under one protocol."""

    tpr: Cell
    fpr: Cell
    missed: int
    """FN."""
    false: int
    """FP."""


def scored_by(counts: Counts, method: str, protocol: str) -> Scored:
    """The scores of one method under one protocol."""
    return next(s for s in counts.scored if (s.method, s.protocol) == (method, protocol))


def protocols(counts: Counts) -> list[str]:
    """The protocols that were scored, the stricter one first."""
    return [*reversed(counts.protocols)]


def paper_table(scored: Scored, thousands: str = "") -> Table:
    """TPR to beta per ID and in total, in the layout of the paper; "0.0000*" for 0/0.

    "once" is the TPR without double claims, of which only protocol paper has any. thousands: the
    separator in counts.
    """
    counts = [scored.count(k) for k in range(len(scored.ids))] + [scored.count()]
    once = [rate(c.tp - c.double, c.tp - c.double + c.fn) for c in counts]
    return Table(
        method=scored.method,
        protocol=scored.protocol,
        heading=[f"ID.{i}" for i in scored.ids] + ["Total"],
        rows=[
            ("TPR", [rate(c.tp, c.tp + c.fn) for c in counts]),
            ("once", once if scored.protocol == "paper" else [""] * len(counts)),
            ("FPR", [rate(c.fp, c.fp + c.tn) for c in counts]),
            *(
                (label, [f"{getattr(c, name):{thousands}}" for c in counts])
                for label, name in COUNT_ROWS
            ),
        ],
    )


def rates(counts: Counts, summary: Summary) -> list[tuple[str, list[OperatingPoint]]]:
    """For each method its operating points over all IDs, under every protocol."""
    return [
        (
            method,
            [
                _operating_point(
                    scored_by(counts, method, protocol).count(),
                    *(figure(summary.figure(protocol, method, n), n) for n in HEADLINE),
                )
                for protocol in protocols(counts)
            ],
        )
        for method in counts.methods
    ]


def rates_per_log(counts: Counts) -> list[tuple[str, list[OperatingPoint]]]:
    """For each log the operating points of methods over all IDs, under the stricter protocol."""
    protocol = protocols(counts)[0]
    of_methods = [scored_by(counts, m, protocol).counts_per_log() for m in counts.methods]
    return [
        (log, [_operating_point(per_log[i][-1]) for per_log in of_methods])
        for i, log in enumerate(counts.logs)
    ]


def _operating_point(count: Count, tpr: Cell = NONE, fpr: Cell = NONE) -> OperatingPoint:
    """The rates to four digits, a dash for 0/0. tpr, fpr: cells with their intervals."""
    positives, negatives = count.tp + count.fn, count.fp + count.tn
    return OperatingPoint(
        replace(tpr, value=rate(count.tp, positives) if positives else NONE.value),
        replace(fpr, value=rate(count.fp, negatives) if negatives else NONE.value),
        count.fn,
        count.fp,
    )


def figures(
    summary: Summary, protocol: str, methods: Sequence[str], beside: Sequence[str] = ()
) -> list[tuple[str, list[Cell]]]:
    """The figures over all IDs that any method has: a label and a cell per method.

    beside: metrics to leave out.
    """
    rows = []
    for metric in METRICS:
        of_methods = [summary.figure(protocol, m, metric.name) for m in methods]
        if metric.name not in beside and any(of_methods):
            rows.append((metric.label, [figure(one, metric.name) for one in of_methods]))
    return rows


def differences(summary: Summary, protocol: str) -> list[tuple[str, list[Cell]]]:
    """For each two methods their differences in the metrics of TESTED."""
    rows: dict[str, list[Cell]] = {}
    for d in tested_differences(summary, protocol):
        rows.setdefault(f"{d.b} minus {d.a}", []).append(difference(d))
    return list(rows.items())


def tested_differences(summary: Summary, protocol: str) -> list[Difference]:
    """The differences in the metrics of TESTED."""
    of_protocol = (d for d in summary.differences if d.protocol == protocol)
    return [d for d in of_protocol if BY_NAME[d.name].tested]


def figure(summary_figure: Figure | None, name: str) -> Cell:
    """A figure of the metric of this name; a dash if there is none."""
    if summary_figure is None:
        return NONE
    return cell(summary_figure.value, summary_figure.low, summary_figure.high, BY_NAME[name].digits)


def difference(d: Difference) -> Cell:
    """A difference with its sign, and p or the reason why there is none."""
    test = d.note if math.isnan(d.p) else f"p = {d.p:.2g}"
    return replace(cell(d.value, d.low, d.high, BY_NAME[d.name].digits, "+"), test=test)


def cell(value: float, low: float, high: float, digits: int, sign: str = "") -> Cell:
    """A value with its interval if that is known; a dash if there is no value."""
    span = ("", "") if math.isnan(low) else (number(v, digits, sign) for v in (low, high))
    return Cell(number(value, digits, sign), *span)


def rate(part: int, whole: int) -> str:
    """A rate to four digits, halves upward as in the paper; "0.0000*" for 0/0."""
    if whole == 0:
        return "0.0000*"
    # In whole numbers: 52/640 = .08125 is printed as .0813; floating point would give .0812.
    digits = (2 * 10_000 * part + whole) // (2 * whole)
    return f"{digits // 10_000}.{digits % 10_000:04d}"


def number(value: float, digits: int, sign: str = "") -> str:
    """A number; a dash for NaN, "never" for infinity."""
    if math.isnan(value):
        return NONE.value
    return "never" if math.isinf(value) else f"{value:{sign}.{digits}f}"
