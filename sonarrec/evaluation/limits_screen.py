"""A judgement as text: for the terminal, and in Markdown for a pull request."""

from __future__ import annotations

from collections.abc import Sequence

from sonarrec.errors import number_of, printable
from sonarrec.evaluation.limits import Judgement, Row

MOST_ROWS = 24
"""If there are more, those that are not worse are left out."""
HEADING = ("log", "method", "protocol", "TPR before", "now", "FPR before", "now", "")


def screen(judged: Judgement) -> str:
    """The sentence, then the table."""
    rows, left_out = _shown(judged.rows)
    cells = [HEADING, *map(_cells, rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [
        "  ".join(
            cell.ljust(width) if n in (0, 1, 2, 7) else cell.rjust(width)
            for n, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    ]
    return "\n".join(map(printable, [judged.sentence, *(lines if rows else []), *left_out]))


def markdown(judged: Judgement, changed: Sequence[str] = ()) -> str:
    """The same in Markdown. changed: settings that differ, a line each."""
    rows, left_out = _shown(judged.rows)
    lines = [f"**{_escaped(judged.sentence)}**", ""]
    if rows:
        lines += [_line(HEADING), "|---|---|---|---:|---:|---:|---:|---|"]
        lines += [_line([_escaped(cell) for cell in _cells(row)]) for row in rows]
    lines += ["", *left_out] if left_out else []
    lines += ["", *(f"- {_escaped(line)}" for line in changed)] if changed else []
    return "\n".join(map(printable, lines))


def _shown(rows: Sequence[Row]) -> tuple[Sequence[Row], list[str]]:
    """The rows to show, and a line on those left out."""
    if len(rows) <= MOST_ROWS:
        return rows, []
    totals = [row for row in rows if row.is_total]
    worse = [row for row in rows if row.mark == "worse" and not row.is_total]
    worse.sort(key=lambda row: -max(rate.worse for rate in row.rates()))
    shown = [*worse[:MOST_ROWS], *totals]
    more = len(worse) - len(worse[:MOST_ROWS])
    others = f", {more} of them worse" if more else ", none of them worse"
    return shown, [f"{number_of(len(rows) - len(shown), 'more row')}{others}"]


def _cells(row: Row) -> tuple[str, ...]:
    return (row.log, row.method, row.protocol, *row.texts, row.mark)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _escaped(text: str) -> str:
    """Names that hold marks of Markdown stay as they are."""
    return "".join(f"\\{c}" if c in r"\|*_`<[]" else c for c in text)
