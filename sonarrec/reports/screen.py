"""Scores and comparisons as text: lines for the terminal, cells for the report's tables too."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sonarrec.errors import number_of, printable
from sonarrec.evaluation.compare import Comparison, Judgement, rate_text
from sonarrec.evaluation.counts import TOTAL, Counts, Units
from sonarrec.evaluation.figures import MAIN, METRICS, Summary, units_text
from sonarrec.evaluation.uncertainty import LEVEL, MIN_UNITS
from sonarrec.evaluation.write import Evaluation

HEADLINE = ("tpr", "fpr")
"""Shown before the other figures, in the report in a table of their own."""
FALSE = "false claims per 100 frames"
COUNT_ROWS = {"TP": "tp", "TN": "tn", "FP": "fp", "FN": "fn", "beta": "total"}
TESTED = tuple(name for name, metric in METRICS.items() if metric.kind == "rates")
"""Those whose differences between methods are shown."""
WIDTH = 100
LABEL, COLUMN = 30, 23
LEGEND = "once: TPR without double claims (each ID once per frame); beta: all counts, in the paper"
MOST_ROWS = 24
"""Of the table of a comparison; of more those of logs that are not worse are left out."""
MOST_PASSES = 6
"""Changed passes that are listed."""
STAR = "* 0/0, printed as in the paper: there is nothing to measure"


class Cell(NamedTuple):
    """A value and, if known, its interval and the result of a test."""

    value: str
    low: str = ""
    high: str = ""
    test: str = ""


NONE = Cell("-")


class OperatingPoint(NamedTuple):
    """Rates of one method under one protocol, and its mistakes: FN and FP, and these in 100
    frames."""

    tpr: Cell
    fpr: Cell
    missed: int
    false: int
    false_per_100: str


def protocols(counts: Counts) -> list[str]:
    """The protocols that were scored, the stricter one first."""
    return [*reversed(counts.protocols)]


def labelled_frames(scored: int, left_out: int | None) -> list[str]:
    """A line on how many frames count if these are the labelled ones; left_out: None if all are."""
    if left_out is None:
        return []
    return [f"labelled frames only: {scored} of {scored + left_out}; the others are not scored"]


def over_units(units: Units) -> str:
    """The part of a table's caption about its intervals; empty if there are none."""
    return f"; {LEVEL:.0%} intervals over {units_text(units)}" if units.number >= MIN_UNITS else ""


def paper_table(
    counts: Counts, method: str, protocol: str, thousands: str = ""
) -> dict[str, list[str]]:
    """TPR to beta per ID and in total, in the layout of the paper; "0.0000*" for 0/0.

    The first row, "", has the headings. "once" is the TPR without double claims, of which only
    protocol paper has any. thousands: the separator in counts.
    """
    sums = [counts.count(method, protocol, landmark) for landmark in counts.landmarks]
    once = [rate(c.positives - c.fn, c.positives) for c in sums]
    rows = {
        "": [f"ID.{i}" for i in counts.ids] + ["Total"],
        "TPR": [rate(c.tp, c.tp + c.fn) for c in sums],
        "once": once if protocol == "paper" else [""] * len(sums),
        "FPR": [rate(c.fp, c.fp + c.tn) for c in sums],
    }
    for label, name in COUNT_ROWS.items():
        rows[label] = [f"{getattr(c, name):{thousands}}" for c in sums]
    return rows


def rates(counts: Counts, summary: Summary) -> list[tuple[str, list[OperatingPoint]]]:
    """For each method its operating points over all IDs, under every protocol."""
    rows = []
    for method in counts.methods:
        points = []
        for protocol in protocols(counts):
            tpr, fpr = (figure(summary.figure(protocol, method, n), n) for n in HEADLINE)
            points.append(_point(counts.count(method, protocol), tpr, fpr))
        rows.append((method, points))
    return rows


def rates_per_log(counts: Counts) -> list[tuple[str, list[OperatingPoint]]]:
    """For each log the operating points of methods over all IDs, under the stricter protocol."""
    main = protocols(counts)[0]
    return [
        (log, [_point(counts.count(method, main, TOTAL, log)) for method in counts.methods])
        for log in counts.logs
    ]


def _point(count: Any, tpr: Cell = NONE, fpr: Cell = NONE) -> OperatingPoint:
    """The rates to four digits, a dash for 0/0. tpr, fpr: cells with their intervals."""
    positives, negatives = count.tp + count.fn, count.fp + count.tn
    return OperatingPoint(
        tpr._replace(value=rate(count.tp, positives) if positives else NONE.value),
        fpr._replace(value=rate(count.fp, negatives) if negatives else NONE.value),
        count.fn,
        count.fp,
        number(count.false_per_100, 2),
    )


def figures(
    summary: Summary, protocol: str, methods: Sequence[str], names: Sequence[str] = tuple(METRICS)
) -> list[tuple[str, list[Cell]]]:
    """The figures over all IDs that any method has: a label and a cell per method.

    names: of metrics.
    """
    rows = []
    for name in names:
        of_methods = [summary.figure(protocol, method, name) for method in methods]
        if any(of_methods):
            rows.append((METRICS[name].label, [figure(value, name) for value in of_methods]))
    return rows


def differences(summary: Summary, protocol: str) -> list[tuple[str, list[Cell]]]:
    """For each two methods their differences in the metrics of TESTED, with p or why not."""
    rows: dict[str, list[Cell]] = {}
    for d in summary.differences:
        if d.protocol == protocol and d.figure in TESTED:
            test = d.note if math.isnan(d.p) else f"p = {d.p:.2g}"
            cell = _cell(d.value_b - d.value_a, d.low, d.high, METRICS[d.figure].digits, "+")
            rows.setdefault(f"{d.b} minus {d.a}", []).append(cell._replace(test=test))
    return list(rows.items())


def figure(row: Any, name: str) -> Cell:
    """A row of the figures, of the metric of this name; a dash if there is none."""
    if row is None:
        return NONE
    return _cell(row.value, row.low, row.high, METRICS[name].digits)


def _cell(value: float, low: float, high: float, digits: int, sign: str = "") -> Cell:
    """A value with its interval if that is known; a dash if there is no value."""
    span = ("", "") if math.isnan(low) else (number(v, digits, sign) for v in (low, high))
    return Cell(number(value, digits, sign), *span)


def rate(part: int, total: int) -> str:
    """A rate to four digits, halves upward as in the paper; "0.0000*" for 0/0."""
    if total == 0:
        return "0.0000*"
    # In whole numbers: 52/640 = .08125 is printed as .0813; floating point would give .0812.
    digits = (2 * 10_000 * part + total) // (2 * total)
    return f"{digits // 10_000}.{digits % 10_000:04d}"


def number(value: float, digits: int, sign: str = "") -> str:
    """A number; a dash for NaN."""
    return NONE.value if math.isnan(value) else f"{value:{sign}.{digits}f}"


def screen(evaluation: Evaluation, details: bool = False) -> str:
    """The paper's tables, then figures with intervals and tests; with two methods forty lines.

    details: all figures, those of both protocols, and rates per log.
    """
    counts, summary = evaluation.counts, evaluation.summary
    main, *others = protocols(counts)
    lines = labelled_frames(counts.frames, evaluation.left_out) + _paper_tables(counts)
    names = [name for name, metric in METRICS.items() if metric.brief or details]
    for protocol in (main, *others) if details else (main,):
        lines += ["", f"protocol {protocol}, all IDs{over_units(counts.units)}"]
        columns = (WIDTH - LABEL) // COLUMN
        for first in range(0, len(counts.methods), columns):
            some = counts.methods[first : first + columns]
            lines.append(_row("", [m[: COLUMN - 1] for m in some]))
            rows = figures(summary, protocol, some, names)
            false = (counts.count(method, protocol).false_per_100 for method in some)
            rows.insert(len(HEADLINE), (FALSE, [Cell(number(value, 2)) for value in false]))
            lines += [_row(label, [_text(cell) for cell in row]) for label, row in rows]
    tests = differences(summary, main)
    if any(cell.test.startswith("p = ") for _, cells in tests for cell in cells):
        test = f"paired sign-flip test over {units_text(counts.units)}"
        lines += [*([""] if details else []), f"protocol {main}, differences; {test}"]
        for pair, cells in tests:
            by_label = {METRICS[n].label: cell for n, cell in zip(TESTED, cells, strict=True)}
            if details:
                lines += [f"{pair}, {label}: {_text(c, ' to ')}" for label, c in by_label.items()]
            else:
                main_ones = [(METRICS[n].label, by_label[METRICS[n].label]) for n in MAIN]
                lines.append(
                    f"{pair}: "
                    + "; ".join(f"{label} {c.value}, {c.test}" for label, c in main_ones)
                )
    if details and len(counts.logs) > 1:
        lines += _per_log(counts, main)
    return "\n".join(map(printable, lines))


def _paper_tables(counts: Counts) -> list[str]:
    """The tables of all methods, with both protocols side by side if they fit into WIDTH."""
    lines: list[str] = []
    for method in counts.methods:
        blocks = []
        for protocol in counts.protocols:
            gates = f": centre within {' or '.join(f'{g:g}' for g in counts.gates)} m"
            how = gates * bool(counts.gates) if protocol == "strict" else ": position not checked"
            table = paper_table(counts, method, protocol)
            rows = [  # a star stands behind the digits
                f"{label:<5}" + "".join(f"{c if '*' in c else c + ' ':>8}" for c in row)
                for label, row in table.items()
            ]
            width = max(map(len, rows))
            blocks.append([line.ljust(width) for line in (f"protocol {protocol}{how}", *rows)])
        if sum(len(b[1]) for b in blocks) + 3 * (len(blocks) - 1) <= WIDTH:
            rows = [" | ".join(row).rstrip() for row in zip(*blocks, strict=True)]
        else:
            rows = [line.rstrip() for block in blocks for line in [*block, ""]][:-1]
        lines += [method, *rows, ""]
    lines[-1:] = [LEGEND]
    return [*lines, STAR] if any("*" in line for line in lines) else lines


def _text(cell: Cell, to: str = "-") -> str:
    interval = f" ({cell.low}{to}{cell.high})" if cell.low else ""
    return f"{cell.value}{interval}" + (f", {cell.test}" if cell.test else "")


def _row(label: str, columns: Sequence[str]) -> str:
    return f"{label:<{LABEL}}{''.join(f'{c:<{COLUMN}}' for c in columns)}".rstrip()


def _per_log(counts: Counts, protocol: str) -> list[str]:
    lines = ["", f"protocol {protocol}, per log; FP/100: {FALSE}"]
    head = f"{'TPR':>8}{'FPR':>9}{'FP/100':>8}{'TP':>7}{'FP':>6}{'FN':>6}"
    lines.append(f"{'':<{LABEL}}{'method':<{COLUMN}}{head}")
    for log in counts.logs:
        for method in counts.methods:
            c = counts.count(method, protocol, TOTAL, log)
            lines.append(_row(log[-LABEL + 1 :], [method[: COLUMN - 1]]).ljust(LABEL + COLUMN))
            lines[-1] += f"{number(c.tpr, 3):>8}{number(c.fpr, 4):>9}"
            lines[-1] += f"{number(c.false_per_100, 2):>8}{c.tp:>7}{c.fp:>6}{c.fn:>6}"
    return lines


HEADING = (
    *("log", "method", "protocol", "TPR before", "now", "FPR before", "now"),
    *("FP/100 before", "now", ""),
)


def comparison(compared: Comparison, judged: Judgement) -> str:
    """The sentence of a comparison, its table, then the passes that changed most."""
    rows = judged.rows
    if len(rows) > MOST_ROWS:
        worse = [row for row in rows if row.log != TOTAL and row.mark == "worse"]
        rows = (*worse[:MOST_ROWS], *(row for row in rows if row.log == TOTAL))
    cells: list[tuple[str, ...]] = [HEADING]
    for row in rows:
        texts = (rate_text(value) for rate in (row.tpr, row.fpr) for value in (rate.old, rate.new))
        of_row = row.method, row.protocol, TOTAL, "" if row.log == TOTAL else row.log
        both = (side.count(*of_row).false_per_100 for side in (compared.before, compared.after))
        false = (f"{value:.2f}" for value in both)
        cells.append((row.log, row.method, row.protocol, *texts, *false, row.mark))
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [judged.sentence, *labelled_frames(compared.after.frames, compared.left_out)]
    for cell in cells if rows else ():
        texts = (f"{c:{'<<<>>>>>><'[n]}{widths[n]}}" for n, c in enumerate(cell))
        lines.append("  ".join(texts).rstrip())
    if more := len(judged.rows) - len(rows):
        lines.append(number_of(more, "more row"))
    return "\n".join(map(printable, [*lines, *_changed_passes(compared)]))


def _changed_passes(compared: Comparison) -> list[str]:
    """The passes in which the leading method, under the stricter protocol, changed most."""
    method = compared.methods[0][1]
    protocol = max(protocol for protocol, other in compared.methods if other == method)
    old, new = (
        passes[(passes["method"] == method) & (passes["protocol"] == protocol)]
        for passes in (compared.before.passes, compared.after.passes)
    )
    change = np.abs(new["right"] - old["right"])
    order = np.argsort(-change, kind="stable")[:MOST_PASSES]
    most = new.with_columns(old=old["right"])[order[change[order] > 0]]
    names = ("log", "first_frame", "last_frame", "landmark", "old", "right", "frames")
    return [
        f"{log} frames {first}-{last}, ID.{landmark}: "
        f"right in {was} -> {now} of {frames} ({method}, {protocol})"
        for log, first, last, landmark, was, now, frames in zip(
            *(most[name] for name in names), strict=True
        )
    ]
