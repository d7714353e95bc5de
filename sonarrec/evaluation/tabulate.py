"""An evaluation as text: the paper's tables, then figures with intervals and tests."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sonarrec.errors import printable
from sonarrec.evaluation import cells
from sonarrec.evaluation.cells import Cell, number
from sonarrec.evaluation.count import Counts, Scored
from sonarrec.evaluation.metrics import BY_NAME, MAIN
from sonarrec.evaluation.summary import Summary, over_units, units_text
from sonarrec.evaluation.tables import Evaluation

WIDTH = 100
LABEL, COLUMN = 30, 23
LEGEND = "once: TPR without double claims (each ID once per frame); beta: all counts, in the paper"


def paper_table(scored: Scored) -> list[str]:
    """The lines of one of the paper's tables: a heading, then TPR to beta, per ID and in total."""
    table = cells.paper_table(scored)
    # A star stands behind the digits.
    return [
        f"{label:<5}" + "".join(f"{cell if '*' in cell else cell + ' ':>8}" for cell in row)
        for label, row in [("", table.heading), *table.rows]
    ]


def screen(counts: Counts) -> str:
    """The tables of all methods, with both protocols side by side if they fit into WIDTH."""
    lines: list[str] = []
    undefined = False
    for method in counts.methods:
        tables = [s for s in counts.scored if s.method == method]
        blocks = []
        for scored in tables:
            block = paper_table(scored)
            width = max(map(len, block))
            blocks.append([line.ljust(width) for line in [_title(scored, counts), *block]])
            undefined |= any("*" in line for line in block)
        lines += [method]
        if sum(len(b[1]) for b in blocks) + 3 * (len(blocks) - 1) <= WIDTH:
            lines += [" | ".join(row).rstrip() for row in zip(*blocks, strict=True)]
        else:
            lines += [line.rstrip() for block in blocks for line in [*block, ""]][:-1]
        lines.append("")
    if counts.methods:
        lines += [LEGEND, ""]
    if undefined:
        lines += ["* 0/0, printed as in the paper: there is nothing to measure", ""]
    return "\n".join(map(printable, lines))


def _title(scored: Scored, counts: Counts) -> str:
    if scored.protocol == "paper":
        return "protocol paper: position not checked"
    gates = counts.gates
    return "protocol strict" + (
        f": centre within {' or '.join(f'{g:g}' for g in gates)} m" if gates else ""
    )


def summary_screen(evaluation: Evaluation, details: bool = False) -> str:
    """The figures in total with intervals and tests; details: also per ID and per log."""
    counts, summary = evaluation.counts, evaluation.summary
    main, *others = cells.protocols(counts)
    over = over_units(summary)
    lines = []
    for protocol in (main, *others) if details else (main,):
        lines.append(f"protocol {protocol}, all IDs{over}")
        beside = (WIDTH - LABEL) // COLUMN
        for first in range(0, len(counts.methods), beside):
            some = counts.methods[first : first + beside]
            lines.append(_row("", [m[: COLUMN - 1] for m in some]))
            for label, row in cells.figures(summary, protocol, some):
                lines.append(_row(label, list(map(_text, row))))
        lines.append("")
    tested = cells.tested_differences(summary, main)
    if any(not math.isnan(d.p) for d in tested):
        units = units_text(summary.units)
        lines.append(f"protocol {main}, differences; paired sign-flip test over {units}")
        for d in tested:
            text = _text(cells.difference(d), " to ")
            lines.append(f"{d.b} minus {d.a}, {BY_NAME[d.name].label}: {text}")
        lines.append("")
    if details:
        lines += _per_id(summary, main, counts.methods)
        if len(counts.logs) > 1:
            lines += _per_log(counts, main)
    return "\n".join(map(printable, lines))


def _text(cell: Cell, to: str = "-") -> str:
    interval = f" ({cell.low}{to}{cell.high})" if cell.low else ""
    return f"{cell.value}{interval}" + (f", {cell.test}" if cell.test else "")


def _row(label: str, columns: Sequence[str]) -> str:
    return f"{label:<{LABEL}}{''.join(f'{c:<{COLUMN}}' for c in columns)}".rstrip()


def _per_id(summary: Summary, protocol: str, methods: Sequence[str]) -> list[str]:
    lines = [f"protocol {protocol}, per ID (macro: mean of the IDs; total: of all counts)"]
    lines.append(_row("", [BY_NAME[name].label for name in MAIN]))
    landmarks = list(dict.fromkeys(f.landmark_text for f in summary.figures if f.name == MAIN[0]))
    for method in methods:
        for landmark in landmarks:
            label = f"{method[: LABEL - 8]} {'ID.' * landmark.isdigit()}{landmark}"
            found = (
                cells.figure(summary.figure(protocol, method, name, landmark), name)
                for name in MAIN
            )
            lines.append(_row(label, list(map(_text, found))))
    return [*lines, ""]


def _per_log(counts: Counts, protocol: str) -> list[str]:
    lines = [f"protocol {protocol}, per log"]
    lines.append(
        f"{'':<{LABEL}}{'method':<{COLUMN}}{'TPR':>8}{'FPR':>9}{'TP':>7}{'FP':>6}{'FN':>6}"
    )
    of_methods = {s.method: s.counts_per_log() for s in counts.scored if s.protocol == protocol}
    for i, log in enumerate(counts.logs):
        for method, per_log in of_methods.items():
            c = per_log[i][-1]
            lines.append(_row(log[-LABEL + 1 :], [method[: COLUMN - 1]]).ljust(LABEL + COLUMN))
            lines[-1] += f"{number(c.tpr, 3):>8}{number(c.fpr, 4):>9}{c.tp:>7}{c.fp:>6}{c.fn:>6}"
    return [*lines, ""]
