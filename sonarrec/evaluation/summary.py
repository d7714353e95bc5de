"""Everything that is told of an evaluation beyond its counts."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sonarrec.evaluation.behaviour import (
    Followed,
    Switches,
    error_tallies,
    false_claim_tallies,
    follow,
    on_truth,
    switch_tallies,
    switches,
    wait_tallies,
)
from sonarrec.evaluation.evaluate import Evaluation
from sonarrec.evaluation.passes import Passes, UnitKind, Units, find_passes, find_units
from sonarrec.evaluation.reliability import Reliability, reliability
from sonarrec.evaluation.tallies import macro, rate_tallies
from sonarrec.evaluation.uncertainty import (
    LEVEL,
    MIN_UNITS,
    Difference,
    Figure,
    Tally,
    bootstrap_weights,
    coin_tosses,
    differences,
    intervals,
    replicates,
)

KINDS = {"pass": "passes", "log": "logs"}
SEED = 0
"""Of the draws: the same input gives the same intervals."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Figures with intervals, differences between methods, passes and calibration.

    figures: per protocol, method and landmark (IDs, "total", "macro"). differences: of every two
    methods, in total. followed: per protocol and method; switches: per method, empty where
    positions are not known. notes: what the units cannot say.
    """

    units: Units
    passes: Passes
    figures: tuple[Figure, ...]
    differences: tuple[Difference, ...]
    followed: tuple[Followed, ...]
    switches: tuple[Switches, ...]
    reliability: tuple[Reliability, ...]
    notes: tuple[str, ...]

    def figure(
        self, protocol: str, method: str, name: str, landmark: str = "total"
    ) -> Figure | None:
        """One figure; None where it was not measured."""
        wanted = (protocol, method, landmark, name)
        return next(
            (f for f in self.figures if (f.protocol, f.method, f.landmark, f.name) == wanted), None
        )


def summarise(evaluation: Evaluation, unit: UnitKind | None = None, seed: int = SEED) -> Summary:
    """Figures, intervals and tests of an evaluation.

    unit: what may be taken for independent; by default the pass, with ten logs or more the log.
    """
    joined = evaluation.joined
    passes = find_passes(joined)
    units = find_units(joined, passes, unit)
    followed = [follow(scored, joined, passes) for scored in evaluation.scored]
    rng = np.random.default_rng(seed)
    weights = bootstrap_weights(units.count, rng)
    tosses = coin_tosses(units.count, rng)
    figures: list[Figure] = []
    tallies: list[Tally] = []
    for scored in evaluation.scored:
        rates = rate_tallies(scored, units)
        drawn = [replicates(tally, weights) for tally in rates]
        for tally, values in zip(rates, drawn, strict=True):
            figures += intervals(tally, values)
        figures += macro(rates[:-1], drawn[:-1])
        tallies.append(rates[-1])
    rest: list[Tally] = []
    rest += wait_tallies(followed, joined, passes, units)
    changed: list[Switches] = []
    curves: list[Reliability] = []
    if joined.placed:
        nearest = on_truth(joined)
        changed = switches(joined, nearest, passes)
        rest += switch_tallies(changed, joined, passes, units)
        rest += false_claim_tallies(joined, nearest, units)
        strict = [scored for scored in evaluation.scored if scored.protocol == "strict"]
        rest += error_tallies(strict, joined, units)
        curves, calibration = reliability(joined, nearest, units)
        rest += calibration

    for tally in rest:
        figures += intervals(tally, replicates(tally, weights))
    alike: dict[tuple[str, tuple[str, ...]], list[Tally]] = defaultdict(list)
    for tally in tallies + rest:
        if tally.landmark == "total":
            alike[tally.protocol, tally.names].append(tally)
    found = tuple(
        difference
        for group in alike.values()
        for a, b in combinations(group, 2)
        for difference in differences(a, b, weights, tosses)
    )
    return Summary(
        units=units,
        passes=passes,
        figures=tuple(figures),
        differences=found,
        followed=tuple(followed),
        switches=tuple(changed),
        reliability=tuple(curves),
        notes=_notes(evaluation, units, figures),
    )


def _notes(evaluation: Evaluation, units: Units, figures: list[Figure]) -> tuple[str, ...]:
    if units.count < MIN_UNITS:
        kind = {"pass": "pass of a landmark", "log": "log"}[units.kind]
        return (
            f"no intervals and no tests: only {units.count} independent units (each a {kind}), and "
            f"with fewer than {MIN_UNITS} no difference can be told from chance",
        )
    notes = []
    joined = evaluation.joined
    protocol = "strict" if joined.placed else "paper"
    for figure in figures:
        told = (figure.protocol, figure.landmark, figure.name, figure.value)
        if told == (protocol, "total", "fpr", 0):
            # None of n: with 95 % confidence a share below 1 - .05 ** (1 / n) has any.
            most = 1 - (1 - LEVEL) ** (1 / figure.units)
            notes.append(
                f"{figure.method}: no false claim in {figure.units} {KINDS[units.kind]}, so with "
                f"{LEVEL:.0%} confidence fewer than {most:.0%} of them have one"
            )
    if joined.placed and np.isnan(joined.seconds).any():
        notes.append("claims a minute are not told: frames.csv has no timestamp_ns")
    return tuple(notes)
