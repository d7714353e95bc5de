"""Two sets of results on one truth: what got better, what got worse, and in which frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.evaluation import metrics
from sonarrec.evaluation.compare.both import BothCounted, BothReading, count_both
from sonarrec.evaluation.compare.changes import FrameChanges, put
from sonarrec.evaluation.compare.settings import SettingChange, changed_settings
from sonarrec.evaluation.compare.sides import both_sides
from sonarrec.evaluation.counting.behaviour import PassOutcomes
from sonarrec.evaluation.counting.counted import Counted
from sonarrec.evaluation.counting.passes import UnitKind
from sonarrec.evaluation.counting.pooled import Parts, Pooled, pooled
from sonarrec.evaluation.counting.store import Store
from sonarrec.evaluation.counting.uncertainty import (
    Difference,
    bootstrap_weights,
    coin_tosses,
    differences,
)
from sonarrec.evaluation.evaluate import DEFAULT, other_ids, told_apart
from sonarrec.evaluation.matching.fit import fit
from sonarrec.evaluation.matching.options import ScoringOptions
from sonarrec.evaluation.matching.pairs import Elsewhere, Pair
from sonarrec.evaluation.metrics import BY_NAME, MAIN
from sonarrec.evaluation.summary import units_text
from sonarrec.evaluation.survey import Unread, each
from sonarrec.records import SonarrecError, printable
from sonarrec.results.run_file import RunFile, read_run

FRAMES_FREE = 2
"""Frames that may turn worse whatever the band: two of 24 are no trend, though they are .083."""


@dataclass(frozen=True, slots=True)
class RateChange:
    """A rate of one method, before and after."""

    protocol: str
    method: str
    landmark_text: str
    """An ID or "total"."""
    rate: str
    """Name of a metric of MAIN."""
    old: float
    new: float
    """NaN where 0/0."""
    of: int
    """The frames, or claims, that it is taken over."""

    @property
    def worse(self) -> float:
        """By how much it got worse; below 0 it got better. A rate that was 0/0 counts as 0."""
        up = float(np.nan_to_num(self.new) - np.nan_to_num(self.old))
        return up if self.rate == "fpr" else -up

    def is_regression(self, band: float) -> bool:
        """Whether it got worse by more than the band, and by more than FRAMES_FREE frames."""
        return self.worse > max(band, FRAMES_FREE / max(self.of, 1)) + 1e-9


@dataclass(frozen=True, slots=True)
class PassChange:
    """A pass of a landmark through the view in which one method has more right frames, or fewer."""

    protocol: str
    method: str
    log: str
    landmark: int
    first_frame: int
    last_frame: int
    frames: int
    """With the landmark whole in view."""
    old: int
    new: int
    """Those of them in which it was claimed."""


@dataclass(frozen=True, slots=True)
class PassChanges:
    """All of them, each made as it is asked for: of many logs they are many."""

    outcomes: tuple[tuple[PassOutcomes, PassOutcomes], ...]
    """Before and after, of each method under each protocol."""
    found: Pooled

    def __iter__(self) -> Iterator[PassChange]:
        found, passes = self.found, self.found.passes
        for a, b in self.outcomes:
            for i in np.flatnonzero(a.right != b.right).tolist():
                yield PassChange(
                    protocol=a.protocol,
                    method=a.method,
                    log=found.logs[passes.log_index[i]],
                    landmark=found.ids[passes.landmark_index[i]],
                    first_frame=int(passes.first_frame[i]),
                    last_frame=int(passes.last_frame[i]),
                    frames=int(b.frames[i]),
                    old=int(a.right[i]),
                    new=int(b.right[i]),
                )


@dataclass(frozen=True, slots=True)
class Comparison:
    """What `compare` found."""

    old: str
    new: str
    """The folders as given."""
    logs: tuple[str, ...]
    frames_compared: int
    units: str
    """How many, and of what, intervals and tests rest on."""
    landmarks: tuple[int, ...]
    settings: tuple[SettingChange, ...]
    """What differs in how the results were made."""
    rates: tuple[RateChange, ...]
    frames: FrameChanges
    passes: PassChanges
    differences: tuple[Difference, ...]
    """New less old, per ID and in total, with interval and p-value."""
    lost: tuple[str, ...]
    """Methods that only the old results have."""
    gained: tuple[str, ...]
    """Methods that only the new results have."""
    unplaced: bool
    """Whether protocol strict is scored of the old results only."""
    notes: tuple[str, ...]
    """Worth knowing."""
    unused: tuple[str, ...]
    """Input that could not be used, one line each."""

    def regressions(self, band: float) -> list[str]:
        """One line per rate that got worse beyond the band, and per method or protocol that is
        gone."""
        lines = [f"{method}: no longer in the results" for method in self.lost]
        lines += ["protocol strict: no longer scored"] * self.unplaced
        for r in self.rates:
            if r.is_regression(band):
                name = "ID." * r.landmark_text.isdigit() + r.landmark_text
                lines.append(
                    f"{r.method}, {r.protocol}, {name}: {BY_NAME[r.rate].label} was "
                    f"{_told(r.old)}, is {_told(r.new)}"
                )
        return lines


def _told(rate: float) -> str:
    return "0/0" if math.isnan(rate) else f"{rate:.4f}"


def compare(
    old: Path,
    new: Path,
    ground_truth: Path | Sequence[Pair] | None = None,
    options: ScoringOptions = DEFAULT,
    *,
    unit: UnitKind | None = None,
    jobs: int | None = None,
    elsewhere: Elsewhere | None = None,
) -> Comparison:
    """Compare two results folders, each of one log or of several, on the frames both hold.

    Each log is read, counted and let go: memory does not grow with the logs.

    Logs go together by name or SHA-256, or where each side has one log. ground_truth: one table,
    or pairs, of which each log takes that of its results; None: the truth beside each log. unit:
    as of `summary.summarise`. jobs, elsewhere: as of `evaluate.evaluate_many`. A log that cannot be
    compared is left out of several. Raises SonarrecError where none is left, or the one truth of
    all of them cannot be read.
    """
    options.check()
    sides = both_sides(old, new, ground_truth, options.landmarks, elsewhere)
    readings = [
        BothReading(one.was, one.now, one.ground_truth, one.name, options) for one in sides.logs
    ]
    both = _counted(readings, jobs, options.min_visible)
    notes = [*dict.fromkeys(sides.notes), *both.notes]
    unused = [*dict.fromkeys([*sides.unused, *both.cut]), *both.unused]
    return _compared(
        both,
        unit,
        old=str(old),
        new=str(new),
        settings=tuple(changed_settings(map(_runs, both.used))),
        notes=tuple(map(printable, notes)),
        unused=tuple(map(printable, unused)),
    )


def _runs(of: BothReading) -> tuple[str, RunFile, RunFile]:
    """Read only now, one log at a time: of many logs these tables alone are large."""
    before, after = (read_run(folder / "run.toml") for folder in of.folders)
    return of.name, before, after


@dataclass(frozen=True, slots=True)
class _Both:
    """All logs on both sides, each of which was read once and let go."""

    used: list[BothReading]
    """Those that are compared."""
    before: Pooled
    after: Pooled
    """Of the same logs, frames and passes."""
    frames: Callable[[tuple[tuple[str, str], ...]], FrameChanges]
    """What changed, of each protocol and method that is asked for."""
    notes: list[str]
    cut: list[str]
    """A line for each part of a log that is not compared."""
    unused: list[str]
    """A line for each log that is not."""


def _counted(readings: Sequence[BothReading], jobs: int | None, min_visible: float) -> _Both:
    """The logs that can be compared, each read on both sides and counted.

    Raises SonarrecError where there is none, or where they have different IDs or no method.
    """
    store = Store()
    before, after = Parts(store, "old"), Parts(store, "new")
    logs: list[BothCounted] = []
    read: list[BothReading] = []
    unread: list[Unread] = []
    numbers: dict[int, int] = {}
    ids: tuple[int, ...] | None = None
    for reading, log in zip(readings, each(count_both, readings, jobs), strict=True):
        one = log
        if isinstance(one, BothCounted) and one.sides is not None:
            ids = ids or one.ids
            if one.ids != ids and set(one.ids) == set(ids):  # in the order of the first
                one = count_both(replace(reading, ids=ids))
        if isinstance(one, Unread):
            unread.append(one)
            continue
        if one.sides is not None:
            number = numbers[len(logs)] = before.put(one.sides[0])
            after.put(one.sides[1])
            put(store, number, one.changes)
        logs.append(replace(one, sides=None, changes={}))
        read.append(reading)
    if not logs:
        raise unread[0].error
    found = fit([log.checked for log in logs])
    used = [logs[i] for i in found.usable]
    for log in used:
        if set(log.ids) != set(used[0].ids):
            raise other_ids(used[0].name, log.name)
    names = told_apart([(read[i].name, read[i].now) for i in found.usable])
    kept = [numbers[i] for i in found.usable]
    old, new = (pooled(parts, kept, names, min_visible) for parts in (before, after))
    if not (old.methods and new.methods):
        raise SonarrecError(f"{', '.join(names)}: estimates.csv names no method to score")
    named = tuple(zip(kept, names, strict=True))
    return _Both(
        used=[replace(read[i], name=n) for i, n in zip(found.usable, names, strict=True)],
        before=old,
        after=new,
        frames=partial(FrameChanges, store, named),
        notes=found.notes,
        cut=[line for log in logs for line in log.unused],
        unused=[*(one.told("compared") for one in unread), *found.unused],
    )


def _compared(both: _Both, unit: UnitKind | None, **told: Any) -> Comparison:
    """told: the fields of Comparison that are known already."""
    before, after = both.before, both.after
    units = after.units(unit)
    rng = np.random.default_rng(0)
    weights, tosses = bootstrap_weights(units.count, rng), coin_tosses(units.count, rng)
    olds = {(s.protocol, s.method): n for n, s in enumerate(before.scored)}
    rates: list[RateChange] = []
    outcomes = []
    found: list[Difference] = []
    methods = []
    for m, b in enumerate(after.scored):
        n = olds.get((b.protocol, b.method))
        if n is not None:
            methods.append((b.protocol, b.method))
            outcomes.append((before.outcomes[n], after.outcomes[m]))
            # An ID at a time: a curve of many logs is long.
            old = metrics.rates_of(metrics.Case(before, units), before.scored[n])
            new = metrics.rates_of(metrics.Case(after, units), b)
            for was, now in zip(old, new, strict=True):
                rates += _rate_changes(was, now)
                was_tally, now_tally = (metrics.tally(metrics.rates, side) for side in (was, now))
                found += differences(was_tally, now_tally, weights, tosses)
    if not methods:
        has = (
            f"{told[k]} has {', '.join(p.methods)}" for k, p in (("old", before), ("new", after))
        )
        raise SonarrecError(
            printable(f"nothing to compare: no method is in both; {'; '.join(has)}")
        )
    if before.placed != after.placed:
        without = told["new"] if before.placed else told["old"]
        note = f"protocol strict is not compared: {without} lacks positions that can be used"
        told["notes"] = (*told["notes"], printable(note))
    return Comparison(
        logs=after.logs,
        frames_compared=after.frames,
        units=units_text(units),
        landmarks=after.ids,
        rates=tuple(rates),
        frames=both.frames(tuple(methods)),
        passes=PassChanges(tuple(outcomes), after),
        differences=tuple(found),
        lost=tuple(m for m in before.methods if m not in after.methods),
        gained=tuple(m for m in after.methods if m not in before.methods),
        unplaced=before.placed and not after.placed,
        **told,
    )


def _rate_changes(a: Counted, b: Counted) -> Iterable[RateChange]:
    tp, tn, fp, fn = b.exact.made[0].tolist()
    for name in MAIN:
        was, now = (BY_NAME[name].value(side) for side in (a, b))
        if not (math.isnan(was) and math.isnan(now)):
            of = fp + tn if name == "fpr" else tp + fn
            yield RateChange(b.protocol, b.method, b.landmark_text, name, was, now, of)


def screen(found: Comparison, most: int = 12) -> str:
    """What the runs were made with differently, totals with their tests, then the longest runs of
    changed frames."""
    whole = (d for d in found.differences if d.landmark_text == "total")
    tests = {(d.protocol, d.b, d.name): d for d in whole}
    totals: dict[str, list[str]] = {}
    few = ""
    for r in found.rates:
        if r.landmark_text == "total":
            text = f"{BY_NAME[r.rate].label} {_told(r.old)}"
            if r.new != r.old:
                test = tests[r.protocol, r.method, r.rate]
                text += f" -> {_told(r.new)}"
                text += "" if math.isnan(test.p) else f" (p = {test.p:.2g})"
                few = test.note.removesuffix(": no test") if math.isnan(test.p) else few
            totals.setdefault(f"{r.method}, {r.protocol}", []).append(text)
    lines = [*settings_lines(found, most)]
    lines += [f"{name}: {', '.join(texts)}" for name, texts in totals.items()]
    if few:
        lines.append(f"no p-values: {few}")
    lines += [f"{method}: only in the old results" for method in found.lost]
    lines += [f"{method}: only in the new results" for method in found.gained]
    verdicts = found.frames.verdicts()
    lines.append(
        f"frames and IDs: {verdicts['better']} better, {verdicts['worse']} worse, "
        f"{verdicts['other']} otherwise changed"
    )
    runs, count = found.frames.runs(most)
    for run in runs:
        first, last = run.first, run.last_frame
        span = f"frame {first.frame}" if run.count == 1 else f"frames {first.frame}-{last}"
        lines.append(
            f"  {first.verdict}: {first.log} {span}, {first.method}, {first.protocol}, "
            f"ID.{first.landmark}: {outcome(first.old)} -> {outcome(first.new)}"
        )
    if count > most:
        lines.append(f"  and {count - most} more runs; changes.csv has all")
    return "\n".join(map(printable, lines))


def settings_lines(found: Comparison, most: int = 12) -> Iterable[str]:
    """What differs in how the results were made; of some of several logs their names."""
    for change in found.settings[:most]:
        logs = "" if len(change.logs) == len(found.logs) else f" ({', '.join(change.logs)})"
        yield f"{change.key}: {change.old} -> {change.new}{logs}"
    if len(found.settings) > most:
        yield f"and {len(found.settings) - most} more settings; compare.json has all"
    if not found.settings and not any("settings are not known" in note for note in found.notes):
        yield "settings, version and landmark set: the same"


def outcome(counts: tuple[int, int, int]) -> str:
    """TP, FP, FN of one frame and ID in words."""
    named = [n for n, c in zip(("TP", "FP", "FN"), counts, strict=True) for _ in range(c)]
    return " + ".join(named) or "TN"
