"""Figures of an evaluation with intervals, and tests of differences between methods."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import number_of, printable
from sonarrec.evaluation import metrics
from sonarrec.evaluation.counting.passes import UnitKind
from sonarrec.evaluation.counting.pooled import Pooled, PooledUnits
from sonarrec.evaluation.counting.reliability import Reliability, reliability
from sonarrec.evaluation.counting.uncertainty import (
    LEVEL,
    MIN_UNITS,
    Difference,
    Figure,
    Tally,
    bootstrap_weights,
    coin_tosses,
    differences,
    intervals,
    macro,
    replicates,
    unseen_share,
)
from sonarrec.evaluation.evaluate import Evaluation

_PLURAL = {"pass": "es", "log": "s"}
SEED = 0
"""Of the random draws, so that the same input gives the same intervals."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Figures with intervals, differences between methods, and calibration."""

    units: PooledUnits
    figures: tuple[Figure, ...]
    """Per protocol, method and landmark_text, by metric."""
    differences: tuple[Difference, ...]
    """Of each two methods, in total."""
    reliability: tuple[Reliability, ...]
    """Per method and landmark_text; empty if positions or probabilities are not known."""
    notes: tuple[str, ...]

    def figure(
        self, protocol: str, method: str, name: str, landmark_text: str = "total"
    ) -> Figure | None:
        """One figure; None if it was not measured."""
        wanted = (protocol, method, landmark_text, name)
        named = ((f, (f.protocol, f.method, f.landmark_text, f.name)) for f in self.figures)
        return next((f for f, name in named if name == wanted), None)


def summarise(evaluation: Evaluation | Pooled, unit: UnitKind | None = None) -> Summary:
    """Figures, intervals and tests of an evaluation.

    unit: what counts as independent; by default passes, or logs if there are ten or more.
    """
    pooled = evaluation if isinstance(evaluation, Pooled) else evaluation.pooled()
    units = pooled.units(unit)
    case = metrics.Case(pooled, units)
    rng = np.random.default_rng(SEED)
    weights = bootstrap_weights(units.count, rng)
    tosses = coin_tosses(units.count, rng)
    figures: list[Figure] = []
    curves: list[Reliability] = []
    # Tallies of one kind and protocol, which can be compared.
    alike: dict[tuple[str, object], list[Tally]] = defaultdict(list)
    for kind in metrics.KINDS:
        per_id: list[tuple[Tally, FloatArray]] = []
        for counted in kind(case):
            tally = metrics.tally(kind, counted)
            drawn = replicates(tally, weights)
            figures += intervals(tally, drawn)
            if kind is metrics.calibration:
                curves += reliability([counted])
            if tally.landmark_text != "total":
                per_id.append((tally, drawn))
                continue
            if kind is metrics.rates:
                figures += macro(*zip(*per_id, strict=True))
            per_id.clear()
            alike[tally.protocol, kind].append(tally)
    return Summary(
        units=units,
        figures=tuple(figures),
        differences=tuple(
            difference
            for group in alike.values()
            for a, b in combinations(group, 2)
            for difference in differences(a, b, weights, tosses)
        ),
        reliability=tuple(curves),
        notes=_notes(pooled, units, figures),
    )


def units_text(units: PooledUnits, count: int | None = None) -> str:
    """The number of units, or `count`, with their kind, such as "12 passes"."""
    many = units.count if count is None else count
    return number_of(many, units.kind, _PLURAL[units.kind])


def over_units(summary: Summary) -> str:
    """The part of a table's caption about its intervals; empty if there are none."""
    if summary.units.count < MIN_UNITS:
        return ""
    return f"; {LEVEL:.0%} intervals over {units_text(summary.units)}"


def _notes(pooled: Pooled, units: PooledUnits, figures: list[Figure]) -> tuple[str, ...]:
    """Notes on missing intervals and figures, a line each."""
    notes = []
    if units.count < MIN_UNITS:
        kind = {"pass": "pass of a landmark", "log": "log"}[units.kind]
        notes.append(
            f"no intervals and no tests: only {number_of(units.count, 'independent unit')} "
            f"(each a {kind}), and "
            f"with fewer than {MIN_UNITS} no difference can be distinguished from chance"
        )
    protocol = "strict" if pooled.placed else "paper"
    for figure in figures if units.count >= MIN_UNITS else ():
        facts = (figure.protocol, figure.landmark_text, figure.name, figure.value)
        if facts == (protocol, "total", "fpr", 0):
            most = f"{100 * unseen_share(figure.units):.2g}%"
            notes.append(
                f"{figure.method}: no false claim in {units_text(units, figure.units)}, so with "
                f"{LEVEL:.0%} confidence fewer than {most} of them have one"
            )
    if pooled.placed and not pooled.timed.all():
        notes.append(_without_minutes(pooled))
    return tuple(map(printable, notes))


def _without_minutes(pooled: Pooled) -> str:
    """A note on the logs that have no minutes."""
    untimed = [name for name, timed in zip(pooled.logs, pooled.timed, strict=True) if not timed]
    listed = ", ".join(untimed[:5]) + f" and {len(untimed) - 5} more" * (len(untimed) > 5)
    lack = f"leave out {listed}" if pooled.timed.any() else "are not given"
    return f"claims per minute {lack}: frames.csv has no timestamp_ns, or a single time"
