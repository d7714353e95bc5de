"""`sonarrec report --compare OLD NEW`: the changes between two results as one HTML page."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from heapq import nlargest
from pathlib import Path

from sonarrec import __version__
from sonarrec.errors import name_as_text
from sonarrec.evaluation import cells
from sonarrec.evaluation.compare.changes import FrameRun
from sonarrec.evaluation.compare.compare import Comparison, PassChange
from sonarrec.evaluation.compare.screen import outcome, settings_lines
from sonarrec.evaluation.counting.uncertainty import LEVEL, MIN_UNITS, Difference
from sonarrec.evaluation.metrics import BY_NAME, MAIN
from sonarrec.files.outputs import write_page
from sonarrec.report.templates import filled

MOST = 10
"""So many passes and runs of frames that got better are shown, and as many that got worse."""
SIGNIFICANT = 0.05
"""Differences with a lower p are marked better or worse."""


@dataclass(frozen=True, slots=True)
class Row:
    """One figure before and after. verdict: "better", "worse", or "" if it is not significant."""

    label: str
    old: str
    new: str
    difference: cells.Cell
    p: str
    units: int
    verdict: str


@dataclass(frozen=True, slots=True)
class Rates:
    """A table of figures of one method under one protocol, over all IDs or per ID."""

    method: str
    protocol: str
    rows: list[Row]


@dataclass(frozen=True, slots=True)
class Ranked:
    """The passes and runs that got better, or worse, most, and how many more there are."""

    verdict: str
    passes: list[PassChange]
    passes_left: int
    runs: list[FrameRun]
    runs_left: int


def write_comparison_page(path: Path, comparison: Comparison) -> None:
    """Write the page. Raises SonarrecError where it cannot be written."""
    write_page(path, render(comparison))


def render(comparison: Comparison) -> str:
    """The whole page as HTML."""
    # Changes are counted by the stricter protocol, as in the report.
    strict = any(r.protocol == "strict" for r in comparison.rates)
    protocol = "strict" if strict else "paper"
    return filled(
        "compare.html",
        version=__version__,
        old=name_as_text(comparison.old),
        new=name_as_text(comparison.new),
        found=comparison,
        level=f"{LEVEL:.0%}",
        least=MIN_UNITS,
        significant=SIGNIFICANT,
        protocol=protocol,
        rates=_in_total(comparison),
        per_id=_per_id(comparison, protocol),
        same_settings=not comparison.settings and any(settings_lines(comparison)),
        outcome=outcome,
        ranked=[_ranked(comparison, protocol, verdict) for verdict in ("worse", "better")],
    )


def _in_total(comparison: Comparison) -> list[Rates]:
    """Per method and protocol, every figure over all IDs."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for d in comparison.differences:
        if d.landmark_text == "total":
            groups.setdefault((d.b, d.protocol), []).append(_row(d, BY_NAME[d.name].label))
    return [Rates(method, protocol, rows) for (method, protocol), rows in groups.items()]


def _per_id(comparison: Comparison, protocol: str) -> list[Rates]:
    """Per method the main rates of every ID that has one, under one protocol."""
    groups: dict[str, list[Row]] = {}
    for d in comparison.differences:
        empty = math.isnan(d.value_a) and math.isnan(d.value_b)
        if d.protocol == protocol and d.landmark_text != "total" and d.name in MAIN and not empty:
            label = f"ID.{d.landmark_text} {BY_NAME[d.name].label}"
            groups.setdefault(d.b, []).append(_row(d, label))
    return [Rates(method, protocol, rows) for method, rows in groups.items()]


def _row(d: Difference, label: str) -> Row:
    digits = BY_NAME[d.name].digits
    verdict = ""
    if d.p < SIGNIFICANT and d.value:
        verdict = "better" if (d.value < 0) == (d.name == "fpr") else "worse"
    old, new = (cells.number(value, digits) for value in (d.value_a, d.value_b))
    p = cells.NONE.value if math.isnan(d.p) else f"{d.p:.2g}"
    return Row(label, old, new, cells.difference(d), p, d.units, verdict)


def _ranked(comparison: Comparison, protocol: str, verdict: str) -> Ranked:
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
    return Ranked(verdict, passes, changed - len(passes), runs, count - len(runs))
