"""Figures of an evaluation with intervals, and tests of differences between methods."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import number_of, printable
from sonarrec.evaluation import metrics, unit_sums
from sonarrec.evaluation.behaviour import BINS
from sonarrec.evaluation.count import Counts, Units
from sonarrec.evaluation.curves import ratio
from sonarrec.evaluation.intervals import (
    LEVEL,
    MIN_UNITS,
    Difference,
    Figure,
    Tally,
    bootstrap_weights,
    coin_tosses,
    differences,
    interval,
    intervals,
    macro,
    replicates,
)
from sonarrec.nouns import follows

_PLURAL = {"pass": "es", "log": "s"}
TOO_BOLD = 0.05
"""Of beliefs in an ID that are clearly right less often than they state, a lead of less is not
told."""
BOLD_BINS = ((7, 9), (9, 10))
"""The bins whose beliefs are looked at together: 0.7 to 0.9, and 0.9 to 1."""
SEED = 0
"""Of the random draws, so that the same input gives the same intervals."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Figures with intervals, differences between methods, and calibration."""

    units: Units
    figures: tuple[Figure, ...]
    """Per protocol, method and landmark_text, by metric."""
    differences: tuple[Difference, ...]
    """Of each two methods, in total."""
    notes: tuple[str, ...]

    def figure(
        self, protocol: str, method: str, name: str, landmark_text: str = "total"
    ) -> Figure | None:
        """One figure; None if it was not measured."""
        wanted = (protocol, method, landmark_text, name)
        named = ((f, (f.protocol, f.method, f.landmark_text, f.name)) for f in self.figures)
        return next((f for f, name in named if name == wanted), None)


def summarise(counts: Counts) -> Summary:
    """Figures, intervals and tests of an evaluation."""
    units = counts.units()
    rng = np.random.default_rng(SEED)
    weights = bootstrap_weights(units.count, rng)
    tosses = coin_tosses(units.count, rng)
    figures: list[Figure] = []
    notes = _notes(units)
    # Tallies of one kind and protocol, which can be compared.
    alike: dict[tuple[str, object], list[Tally]] = defaultdict(list)
    for kind in metrics.KINDS:
        per_id: list[tuple[Tally, FloatArray]] = []
        beliefs: list[FloatArray] = []
        for counted in kind(counts, units):
            tally = metrics.tally(kind, counted)
            drawn = replicates(tally, weights)
            figures += intervals(tally, drawn)
            if kind is unit_sums.calibration:
                if tally.landmark_text == "total":
                    notes += _too_bold(tally.method, beliefs, weights, units)
                elif tally.landmark_text != "none":
                    beliefs.append(counted.sums[:, 1:])
            if tally.landmark_text != "total":
                per_id.append((tally, drawn))
                continue
            if kind is unit_sums.rates:
                figures += macro(*zip(*per_id, strict=True))
            per_id.clear()
            beliefs.clear()
            alike[tally.protocol, kind].append(tally)
    return Summary(
        units=units,
        figures=tuple(figures),
        differences=tuple(
            difference
            for group in alike.values()
            for pair in combinations(group, 2)
            # What one without tracks, the baseline, has is subtracted.
            for a, b in [sorted(pair, key=lambda t: follows(t.method))]
            for difference in differences(a, b, weights, tosses)
        ),
        notes=tuple(map(printable, notes)),
    )


def units_text(units: Units) -> str:
    """The number of units with their kind, such as "12 passes"."""
    return number_of(units.count, units.kind, _PLURAL[units.kind])


def over_units(summary: Summary) -> str:
    """The part of a table's caption about its intervals; empty if there are none."""
    if summary.units.count < MIN_UNITS:
        return ""
    return f"; {LEVEL:.0%} intervals over {units_text(summary.units)}"


def _too_bold(
    method: str, beliefs: Sequence[FloatArray], weights: FloatArray, units: Units
) -> Iterator[str]:
    """A line for each range of beliefs in an ID that are right clearly less often than they state.

    beliefs: of each ID, (U, 3 * BINS) as of `behaviour.calibration`. weights: of the bootstrap.
    """
    for first, end in BOLD_BINS:
        sums = np.sum(beliefs, axis=0).reshape(-1, 3, BINS)[:, :, first:end].sum(axis=2)
        if np.count_nonzero(sums[:, 0]) < MIN_UNITS:
            continue
        count, stated, right = sums.sum(axis=0)
        drawn = weights @ sums
        least, _ = interval(ratio(drawn[:, 1] - drawn[:, 2], drawn[:, 0]), units.count)
        if least > 0 and stated - right > TOO_BOLD * count:
            yield (
                f"{method}: IDs are stated too boldly: of {count:.0f} beliefs of "
                f"{first / BINS:g} to {end / BINS:g}, on average {stated / count:.2f}, "
                f"{right / count:.2f} are right ({LEVEL:.0%} sure over {units_text(units)}); see "
                "`sonarrec help calibrate`"
            )


def _notes(units: Units) -> list[str]:
    """Notes on missing intervals and figures, a line each."""
    notes = []
    if units.count < MIN_UNITS:
        kind = {"pass": "pass of a landmark", "log": "log"}[units.kind]
        notes.append(
            f"no intervals and no tests: only {number_of(units.count, 'independent unit')} "
            f"(each a {kind}), and "
            f"with fewer than {MIN_UNITS} no difference can be distinguished from chance"
        )
    return notes
