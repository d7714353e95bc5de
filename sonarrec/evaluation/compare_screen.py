"""A comparison as text for the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable

from sonarrec.errors import number_of, printable
from sonarrec.evaluation.compare import Comparison, rate_text
from sonarrec.evaluation.metrics import BY_NAME

MOST_LINES = 12
"""Settings, and runs of changed frames, that are listed; the files have all."""


def screen(comparison: Comparison) -> str:
    """Changed settings, rates in total with tests, and the longest runs of changed frames."""
    lines = [*settings_lines(comparison), *_rate_lines(comparison)]
    lines += [f"{method}: only in the old results" for method in comparison.lost]
    lines += [f"{method}: only in the new results" for method in comparison.gained]
    verdicts = comparison.frames.verdicts()
    lines.append(
        f"frames and IDs, of each method and protocol: {verdicts['better']} better, "
        f"{verdicts['worse']} worse, {verdicts['other']} otherwise changed"
    )
    lines += _frame_lines(comparison)
    return "\n".join(map(printable, lines))


def _rate_lines(comparison: Comparison) -> Iterable[str]:
    """A line per method and protocol, and one that says why there are no p-values."""
    whole = (d for d in comparison.differences if d.landmark_text == "total")
    tests = {(d.protocol, d.b, d.name): d for d in whole}
    totals: dict[str, list[str]] = {}
    no_test = ""
    for r in comparison.rates:
        if r.landmark_text == "total":
            text = f"{BY_NAME[r.rate].label} {rate_text(r.old)}"
            if rate_text(r.new) != rate_text(r.old):
                test = tests[r.protocol, r.method, r.rate]
                text += f" -> {rate_text(r.new)}"
                text += "" if math.isnan(test.p) else f" (p = {test.p:.2g})"
                no_test = test.note.removesuffix(": no test") if math.isnan(test.p) else no_test
            totals.setdefault(f"{r.method}, {r.protocol}", []).append(text)
    yield from (f"{name}: {', '.join(texts)}" for name, texts in totals.items())
    if no_test:
        yield f"no p-values: {no_test}"


def _frame_lines(comparison: Comparison) -> Iterable[str]:
    """A line per run of changed frames."""
    runs, count = comparison.frames.runs(MOST_LINES)
    for run in runs:
        first, last = run.first, run.last_frame
        span = f"frame {first.frame}" if run.count == 1 else f"frames {first.frame}-{last}"
        yield (
            f"  {first.verdict}: {first.log} {span}, {first.method}, {first.protocol}, "
            f"ID.{first.landmark}: {outcome(first.old)} -> {outcome(first.new)}"
        )
    if count > MOST_LINES:
        yield f"  and {number_of(count - MOST_LINES, 'more run')}; changes.csv has all"


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
