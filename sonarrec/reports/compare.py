"""`sonarrec report --compare OLD NEW`: the changes between two results as one HTML page."""

from __future__ import annotations

import math
from collections.abc import Iterator
from heapq import nlargest
from pathlib import Path
from typing import Any

from sonarrec.errors import name_as_text
from sonarrec.evaluation import cells
from sonarrec.evaluation.compare_screen import outcome, settings_lines
from sonarrec.evaluation.comparison import SIGNIFICANT, Comparison, PassChange
from sonarrec.evaluation.intervals import LEVEL, MIN_UNITS, Difference
from sonarrec.evaluation.metrics import BY_NAME, MAIN
from sonarrec.nouns import VERSION
from sonarrec.reports.page import filled
from sonarrec.tables.outputs import write_page

MOST = 10  # so many passes and runs of frames that got better are shown, and as many that got worse
View = dict[str, Any]  # values of the template that belong together, by name


def write_comparison_page(path: Path, comparison: Comparison) -> None:
    """Write the page. Raises SonarrecError where it cannot be written."""
    # Changes are counted by the stricter protocol, as in the report.
    strict = any(r.protocol == "strict" for r in comparison.rates)
    protocol = "strict" if strict else "paper"
    in_total: dict[tuple[str, str], list[View]] = {}
    for d in comparison.differences:
        if d.landmark_text == "total":
            in_total.setdefault((d.b, d.protocol), []).append(_row(d, BY_NAME[d.name].label))
    page = filled(
        "compare.html",
        version=VERSION,
        old=name_as_text(comparison.old),
        new=name_as_text(comparison.new),
        verdict=name_as_text(comparison.verdict),
        found=comparison,
        level=f"{LEVEL:.0%}",
        least=MIN_UNITS,
        significant=SIGNIFICANT,
        protocol=protocol,
        rates=[{"method": m, "protocol": p, "rows": r} for (m, p), r in in_total.items()],
        per_id=_per_id(comparison, protocol),
        same_settings=not comparison.settings and any(settings_lines(comparison)),
        outcome=outcome,
        ranked=[_ranked(comparison, protocol, verdict) for verdict in ("worse", "better")],
    )
    write_page(path, page)


def _per_id(comparison: Comparison, protocol: str) -> list[View]:
    """Per method the main rates of every ID that has one, under one protocol."""
    groups: dict[str, list[View]] = {}
    for d in comparison.differences:
        empty = math.isnan(d.value_a) and math.isnan(d.value_b)
        if d.protocol == protocol and d.landmark_text != "total" and d.name in MAIN and not empty:
            label = f"ID.{d.landmark_text} {BY_NAME[d.name].label}"
            groups.setdefault(d.b, []).append(_row(d, label))
    return [{"method": m, "protocol": protocol, "rows": rows} for m, rows in groups.items()]


def _row(d: Difference, label: str) -> View:
    """One figure before and after. verdict: "" if it is not significant."""
    digits, verdict = BY_NAME[d.name].digits, ""
    if d.p < SIGNIFICANT and d.value:
        verdict = "better" if (d.value < 0) == (d.name == "fpr") else "worse"
    return {
        "label": label,
        "old": cells.number(d.value_a, digits),
        "new": cells.number(d.value_b, digits),
        "difference": cells.difference(d),
        "p": cells.NONE.value if math.isnan(d.p) else f"{d.p:.2g}",
        "units": d.units,
        "verdict": verdict,
    }


def _ranked(comparison: Comparison, protocol: str, verdict: str) -> View:
    """The passes and runs that got better, or worse, most, and how many more there are."""
    sign = -1 if verdict == "worse" else 1
    changed = 0

    def changes() -> Iterator[PassChange]:
        nonlocal changed
        for change in comparison.passes:
            if change.protocol == protocol and sign * (change.new - change.old) > 0:
                changed += 1
                yield change

    passes = nlargest(MOST, changes(), key=lambda p: abs(p.new - p.old))
    runs, count = comparison.frames.runs(MOST, protocol, verdict)
    return {
        "verdict": verdict,
        "passes": passes,
        "passes_left": changed - len(passes),
        "runs": runs,
        "runs_left": count - len(runs),
    }
