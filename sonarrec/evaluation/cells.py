"""The evaluation's numbers as the cells of tables."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sonarrec.evaluation.curves import Count
from sonarrec.evaluation.evaluate import Evaluation
from sonarrec.evaluation.metrics import DIGITS, ROWS, TESTED
from sonarrec.evaluation.scoring import Scored
from sonarrec.evaluation.summary import Summary
from sonarrec.evaluation.uncertainty import Figure

TESTED_LABELS = [label for name, label, _ in ROWS if name in TESTED]
HEADLINE = ("tpr", "fpr")


@dataclass(frozen=True, slots=True)
class Cell:
    """A value and, where known, its interval and what a test says of it."""

    value: str
    interval: str = ""
    test: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """One of the paper's tables: heading cells, then rows of a label and cells."""

    method: str
    protocol: str
    heading: list[str]
    rows: list[tuple[str, list[str]]]


@dataclass(frozen=True, slots=True)
class Rates:
    """A method's operating point under one protocol."""

    tpr: Cell
    fpr: Cell
    missed: int
    false: int


def of(evaluation: Evaluation, method: str, protocol: str) -> Scored:
    """One method under one protocol."""
    return next(s for s in evaluation.scored if (s.method, s.protocol) == (method, protocol))


def protocols(evaluation: Evaluation) -> list[str]:
    """Those that were scored, the stricter one first."""
    return [p for p in ("strict", "paper") if any(s.protocol == p for s in evaluation.scored)]


def paper_table(scored: Scored) -> Table:
    """TPR to Total per ID and in all, as published; "0.0000*" for 0/0."""
    counts = [scored.count(k) for k in range(len(scored.ids))] + [scored.count()]
    return Table(
        method=scored.method,
        protocol=scored.protocol,
        heading=[f"ID.{i}" for i in scored.ids] + ["Total"],
        rows=[
            ("TPR", [rate(c.tp, c.tp + c.fn).strip() for c in counts]),
            ("FPR", [rate(c.fp, c.fp + c.tn).strip() for c in counts]),
            *(
                (label, [f"{getattr(c, label.lower()):,}" for c in counts])
                for label in ("TP", "TN", "FP", "FN", "Total")
            ),
        ],
    )


def rates(evaluation: Evaluation, summary: Summary) -> list[tuple[str, list[Rates]]]:
    """Per method its operating point over all IDs under every protocol."""
    return [
        (
            method,
            [
                _rates(
                    of(evaluation, method, protocol).count(),
                    *(summary.figure(protocol, method, name) for name in HEADLINE),
                )
                for protocol in protocols(evaluation)
            ],
        )
        for method in evaluation.joined.methods
    ]


def rates_per_log(evaluation: Evaluation) -> list[tuple[str, list[Rates]]]:
    """Per log the operating point of every method over all IDs under the stricter protocol."""
    protocol, joined = protocols(evaluation)[0], evaluation.joined
    counts = [of(evaluation, m, protocol).counts_per_log(joined) for m in joined.methods]
    return [
        (log, [_rates(per_log[i][-1]) for per_log in counts]) for i, log in enumerate(joined.logs)
    ]


def _rates(count: Count, tpr: Figure | None = None, fpr: Figure | None = None) -> Rates:
    return Rates(
        Cell(_rate(count.tp, count.tp + count.fn), _interval(tpr, 3)),
        Cell(_rate(count.fp, count.fp + count.tn), _interval(fpr, 4)),
        count.fn,
        count.fp,
    )


def figures(evaluation: Evaluation, summary: Summary) -> list[tuple[str, list[Cell]]]:
    """The other figures over all IDs under the stricter protocol: a label, a cell per method."""
    protocol = protocols(evaluation)[0]
    rows = []
    for name, label, digits in ROWS:
        found = [summary.figure(protocol, m, name) for m in evaluation.joined.methods]
        if name not in HEADLINE and any(found):
            rows.append((label, [_cell(figure, digits) for figure in found]))
    return rows


def differences(evaluation: Evaluation, summary: Summary) -> list[tuple[str, list[Cell]]]:
    """Per two methods their differences in the figures of TESTED under the stricter protocol.

    Each with its p, or why there is none.
    """
    protocol = protocols(evaluation)[0]
    rows: dict[str, list[Cell]] = {}
    for d in summary.differences:
        if d.protocol == protocol and d.name in TESTED:
            digits = DIGITS[d.name]
            rows.setdefault(f"{d.b} less {d.a}", []).append(
                Cell(
                    number(d.value, digits, "+"),
                    _span(d.low, d.high, digits, "+"),
                    d.note if math.isnan(d.p) else f"p = {d.p:.2g}",
                )
            )
    return list(rows.items())


def _cell(figure: Figure | None, digits: int) -> Cell:
    if figure is None:
        return Cell("-")
    return Cell(number(figure.value, digits), _interval(figure, digits))


def _interval(figure: Figure | None, digits: int) -> str:
    return "" if figure is None else _span(figure.low, figure.high, digits)


def _span(low: float, high: float, digits: int, sign: str = "") -> str:
    if math.isnan(low):
        return ""
    return f"{number(low, digits, sign)} to {number(high, digits, sign)}"


def _rate(part: int, whole: int) -> str:
    """A rate to four digits; a dash where there is nothing to measure."""
    return rate(part, whole).strip() if whole else "-"


def rate(part: int, whole: int) -> str:
    """A rate to four digits, halves upward as in the paper; "0.0000*" for 0/0."""
    if whole == 0:
        return "0.0000*"
    # In whole numbers: 52/640 is .08125 and printed .0813, which binary rounding makes .0812.
    digits = (2 * 10_000 * part + whole) // (2 * whole)
    return f"{digits // 10_000}.{digits % 10_000:04d} "


def number(value: float, digits: int, sign: str = "") -> str:
    """A number; a dash for none, "never" for an infinite one."""
    if math.isnan(value):
        return "-"
    return "never" if math.isinf(value) else f"{value:{sign}.{digits}f}"


def with_interval(figure: Figure | None, digits: int) -> str:
    """A figure and, where known, its interval in brackets."""
    if figure is None:
        return "-"
    value = number(figure.value, digits)
    if math.isnan(figure.low):
        return value
    return f"{value} ({number(figure.low, digits)}-{number(figure.high, digits)})"
