"""An evaluation on screen: the paper's table layout, then figures with intervals and tests."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sonarrec.evaluation.cells import number, rate, with_interval
from sonarrec.evaluation.evaluate import Evaluation
from sonarrec.evaluation.metrics import DIGITS, ROWS, TESTED
from sonarrec.evaluation.scoring import Scored
from sonarrec.evaluation.summary import KINDS, Summary
from sonarrec.evaluation.uncertainty import LEVEL, MIN_UNITS, Difference

WIDTH = 100
LABEL, COLUMN = 30, 23


def paper_table(scored: Scored) -> list[str]:
    """The lines of one of the paper's tables: a heading, then TPR to Total, per ID and in all."""
    counts = [scored.count(k) for k in range(len(scored.ids))] + [scored.count()]
    rows: list[tuple[str, list[str]]] = [
        ("", [f"ID.{i} " for i in scored.ids] + ["Total "]),
        ("TPR", [rate(c.tp, c.tp + c.fn) for c in counts]),
        ("FPR", [rate(c.fp, c.fp + c.tn) for c in counts]),
    ]
    rows += [
        (label, [f"{getattr(c, label.lower())} " for c in counts])
        for label in ("TP", "TN", "FP", "FN", "Total")
    ]
    return [f"{label:<5}" + "".join(f"{cell:>8}" for cell in cells) for label, cells in rows]


def screen(evaluation: Evaluation) -> str:
    """All tables: per method, the protocols side by side where they fit 100 columns."""
    lines: list[str] = []
    undefined = False
    for method in evaluation.joined.methods:
        tables = [s for s in evaluation.scored if s.method == method]
        blocks = []
        for scored in tables:
            block = paper_table(scored)
            width = max(map(len, block))
            blocks.append([line.ljust(width) for line in [_title(scored, evaluation), *block]])
            undefined |= any("*" in line for line in block)
        lines += [method]
        if sum(len(b[1]) for b in blocks) + 3 * (len(blocks) - 1) <= WIDTH:
            lines += [" | ".join(row).rstrip() for row in zip(*blocks, strict=True)]
        else:
            lines += [line.rstrip() for block in blocks for line in [*block, ""]][:-1]
        lines.append("")
    if undefined:
        lines += ["* 0/0, printed as the paper prints it: nothing to measure here", ""]
    return "\n".join(lines)


def _title(scored: Scored, evaluation: Evaluation) -> str:
    if scored.protocol == "paper":
        return "protocol paper: position not checked"
    gates = sorted({float(gate) for gate in evaluation.joined.gate})
    return "protocol strict" + (
        f": centre within {' or '.join(f'{g:g}' for g in gates)} m" if gates else ""
    )


def summary_screen(evaluation: Evaluation, summary: Summary, details: bool = False) -> str:
    """The figures in total with their intervals, and the tests; with details per ID and log too."""
    joined = evaluation.joined
    main = "strict" if joined.placed else "paper"
    units = f"{summary.units.count} {KINDS[summary.units.kind]}"
    over = f"; {LEVEL:.0%} intervals over {units}" if summary.units.count >= MIN_UNITS else ""
    lines = []
    for protocol in ("strict", "paper") if details else (main,):
        if any(s.protocol == protocol for s in evaluation.scored):
            lines.append(f"protocol {protocol}, all IDs{over}")
            lines += _figure_table(summary, protocol, joined.methods)
            lines.append("")
    told = [d for d in summary.differences if d.protocol == main and d.name in TESTED]
    if any(not math.isnan(d.p) for d in told):
        lines.append(f"protocol {main}, differences; paired sign-flip test over {units}")
        lines += [_difference_line(d) for d in told]
        lines.append("")
    if details:
        lines += _per_id(summary, main, joined.methods)
        if len(joined.logs) > 1:
            lines += _per_log(evaluation, main)
    return "\n".join(lines)


def _figure_table(summary: Summary, protocol: str, methods: Sequence[str]) -> list[str]:
    """Rows are figures, columns methods, as many beside each other as fit."""
    lines = []
    beside = (WIDTH - LABEL) // COLUMN
    for first in range(0, len(methods), beside):
        some = methods[first : first + beside]
        lines.append(" " * LABEL + "".join(f"{m[: COLUMN - 1]:<{COLUMN}}" for m in some).rstrip())
        for name, label, digits in ROWS:
            found = [summary.figure(protocol, m, name) for m in some]
            if any(found):
                cells = "".join(f"{with_interval(f, digits):<{COLUMN}}" for f in found)
                lines.append(f"{label:<{LABEL}}{cells}".rstrip())
    return lines


def _difference_line(d: Difference) -> str:
    label = next(label for name, label, _ in ROWS if name == d.name)
    digits = DIGITS[d.name]
    text = f"{d.b} less {d.a}, {label}: {number(d.value, digits, '+')}"
    if not math.isnan(d.low):
        text += f" ({number(d.low, digits, '+')} to {number(d.high, digits, '+')})"
    return text + (f", {d.note}" if math.isnan(d.p) else f", p = {d.p:.2g}")


def _per_id(summary: Summary, protocol: str, methods: Sequence[str]) -> list[str]:
    names = ("tpr", "fpr", "auc")
    lines = [f"protocol {protocol}, per ID (macro: mean of the IDs; total: of all counts)"]
    lines.append(" " * LABEL + "".join(f"{n.upper():<{COLUMN}}" for n in names).rstrip())
    landmarks = list(dict.fromkeys(f.landmark for f in summary.figures if f.name == "tpr"))
    for method in methods:
        for landmark in landmarks:
            label = f"{method[: LABEL - 8]} {'ID.' * landmark.isdigit()}{landmark}"
            found = [summary.figure(protocol, method, name, landmark) for name in names]
            cells = [with_interval(f, DIGITS[n]) for f, n in zip(found, names, strict=True)]
            lines.append(f"{label:<{LABEL}}{''.join(f'{c:<{COLUMN}}' for c in cells)}".rstrip())
    return [*lines, ""]


def _per_log(evaluation: Evaluation, protocol: str) -> list[str]:
    joined = evaluation.joined
    lines = [f"protocol {protocol}, per log"]
    lines.append(
        f"{'':<{LABEL}}{'method':<{COLUMN}}{'TPR':>8}{'FPR':>9}{'TP':>7}{'FP':>6}{'FN':>6}"
    )
    counts = {
        s.method: s.counts_per_log(joined) for s in evaluation.scored if s.protocol == protocol
    }
    for i, log in enumerate(joined.logs):
        for method, per_log in counts.items():
            c = per_log[i][-1]
            cells = f"{number(c.tpr, 3):>8}{number(c.fpr, 4):>9}{c.tp:>7}{c.fp:>6}{c.fn:>6}"
            lines.append(f"{log[-LABEL + 1 :]:<{LABEL}}{method[: COLUMN - 1]:<{COLUMN}}{cells}")
    return [*lines, ""]
