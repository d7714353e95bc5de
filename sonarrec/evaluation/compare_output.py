"""A comparison, and a judgement by limits: as text for the terminal, and as files."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from textwrap import indent

from sonarrec.errors import number_of, printable
from sonarrec.evaluation.changes import CHANGES, change_cells
from sonarrec.evaluation.comparison import Comparison, rate_table
from sonarrec.evaluation.limits import Judgement, Row
from sonarrec.evaluation.write import as_record, finite_or_none, json_text, write_table
from sonarrec.tables.outputs import (
    check_no_recording,
    check_output,
    check_tables,
    replaced,
    writing,
)

MOST_LINES = 12
"""Settings that are listed; compare.json has all."""
MOST_RUNS = 6
"""Runs of changed frames that are listed; changes.csv has all."""
MOST_ROWS = 24
"""Of a judgement; if there are more, those that are not worse are left out."""
HEADING = ("log", "method", "protocol", "TPR before", "now", "FPR before", "now", "")


def screen(found: Sequence[Comparison]) -> str:
    """A verdict on each new result, their rates in one table, then what changed.

    Changes of frames are those under the stricter protocol; changes.csv has those of both.
    """
    lines = [one.verdict for one in found]
    table = rate_table(found)
    widths = [max(map(len, column)) + 2 for column in zip(*table, strict=True)]
    lines += ["", *("".join(map(str.ljust, row, widths)).rstrip() for row in table), ""]
    for one in found:
        if found[1:]:
            lines.append(f"{one.new}:")
        lines += settings_lines(one)
        lines += [f"{method}: only in the old results" for method in one.lost]
        lines += [f"{method}: only in the new results" for method in one.gained]
        lines += _frame_lines(one, MOST_RUNS if not found[1:] else 1)
    return "\n".join(map(printable, lines))


def _frame_lines(comparison: Comparison, most: int) -> Iterable[str]:
    """How many frames and IDs have changed, and a line for each of the longest runs."""
    protocol = comparison.methods[-1][0]
    counts = comparison.frames.verdicts(protocol)
    yield (
        f"frames and IDs, protocol {protocol}: {counts['better']} better, {counts['worse']} worse, "
        f"{counts['other']} otherwise changed"
    )
    runs, count = comparison.frames.runs(most, protocol)
    several = len({method for _, method in comparison.methods}) > 1
    for run in runs:
        first, last = run.first, run.last_frame
        span = f"frame {first.frame}" if run.count == 1 else f"frames {first.frame}-{last}"
        method = f", {first.method}" * several
        change = f"{outcome(first.old)} -> {outcome(first.new)}"
        yield f"  {first.verdict}: {first.log} {span}{method}, ID.{first.landmark}: {change}"
    if count > most:
        yield f"  and {number_of(count - most, 'more run')}; changes.csv has all"


def settings_lines(comparison: Comparison) -> Iterable[str]:
    """A line per setting that differs, with the names of the logs if it differs in some only."""
    for change in comparison.settings[:MOST_LINES]:
        logs = "" if len(change.logs) == len(comparison.logs) else f" ({', '.join(change.logs)})"
        yield f"{change.key}: {change.old} -> {change.new}{logs}"
    more = len(comparison.settings) - MOST_LINES
    if more > 0:
        yield f"and {number_of(more, 'more setting')}; compare.json has all"
    if not comparison.settings and not any(
        "settings are not known" in note for note in comparison.notes
    ):
        yield "settings, version and landmark set: the same"


def outcome(counts: tuple[int, int, int]) -> str:
    """(TP, FP, FN) of one frame and ID in words, such as "FP + FN"."""
    named = [n for n, c in zip(("TP", "FP", "FN"), counts, strict=True) for _ in range(c)]
    return " + ".join(named) or "TN"


def judgement_screen(judged: Judgement) -> str:
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


COMPARE = ("protocol", "method", "landmark", "rate", "old", "new", "worse_by", "of")


def write_comparison(folder: Path, comparison: Comparison) -> tuple[str, ...]:
    """Write compare.csv, changes.csv and compare.json; returns their names.

    Raises as `write_evaluation`.
    """
    rates = (
        (r.protocol, r.method, r.landmark_text, r.rate, r.old, r.new, r.worse, r.of)
        for r in comparison.rates
    )
    changes = map(change_cells, comparison.frames)
    check_tables(folder, {"compare.csv": COMPARE, "changes.csv": CHANGES})
    check_output(folder / "compare.json", "JSON", header='{\n  "old": ')
    check_no_recording(folder, ["evaluation.json", "compare.csv"])
    with writing(folder):
        write_table(folder / "compare.csv", COMPARE, rates)
        write_table(folder / "changes.csv", CHANGES, changes)
        with (
            replaced(folder / "compare.json") as new,
            new.open("w", encoding="utf-8", newline="") as file,
        ):
            file.writelines(comparison_json(comparison))
    return ("compare.csv", "changes.csv", "compare.json")


def comparison_json(*found: Comparison) -> Iterator[str]:
    """compare.json piece by piece; a list of them if there are several."""
    for n, one in enumerate(found):
        if found[1:]:
            yield "," if n else "["
        yield from _comparison_json(one)
    if found[1:]:
        yield "]\n"


def _comparison_json(comparison: Comparison) -> Iterator[str]:
    """compare.json piece by piece: what was compared and how it was made, rates, tests, passes;
    0/0 is null."""
    document = {
        "old": comparison.old,
        "new": comparison.new,
        "verdict": comparison.verdict,
        "logs": list(comparison.logs),
        "frames": comparison.frames_compared,
        "landmarks": list(comparison.landmarks),
        "units": comparison.units,
        "settings": [asdict(change) for change in comparison.settings],
        "rates": [
            as_record(asdict(rate)) | {"worse_by": finite_or_none(rate.worse)}
            for rate in comparison.rates
        ],
        "differences": [as_record(asdict(difference)) for difference in comparison.differences],
        "passes": [],
        "frames_and_ids": comparison.frames.verdicts(),
        "lost": list(comparison.lost),
        "gained": list(comparison.gained),
        "notes": list(comparison.notes),
        "unused": list(comparison.unused),
    }
    # Of many logs the passes are many. No text in the document holds the key as it stands here:
    # in one its quotes are escaped.
    before, after = json_text(document).split('"passes": []')
    yield f'{before}"passes": ['
    end = ""
    for change in comparison.passes:
        yield ("," if end else "") + "\n" + indent(json.dumps(asdict(change), indent=2), " " * 4)
        end = "\n  "
    yield f"{end}]{after}"
