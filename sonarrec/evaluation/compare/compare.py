"""Two sets of results scored against one truth: what got better or worse, and in which frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from sonarrec.errors import SonarrecError, printable
from sonarrec.evaluation import metrics
from sonarrec.evaluation.compare.changes import ByMethod, FrameChanges
from sonarrec.evaluation.compare.log_pair import CountedPair, LogPair, count_pair
from sonarrec.evaluation.compare.pairing import pair_logs
from sonarrec.evaluation.compare.settings import SettingChange, changed_settings
from sonarrec.evaluation.counting.behaviour import PassOutcomes
from sonarrec.evaluation.counting.passes import UnitKind
from sonarrec.evaluation.counting.pooled import Parts, Pooled, PooledUnits, pool
from sonarrec.evaluation.counting.uncertainty import (
    Difference,
    bootstrap_weights,
    coin_tosses,
    differences,
)
from sonarrec.evaluation.counting.unit_sums import UnitSums
from sonarrec.evaluation.evaluate import DEFAULT, distinct_names, other_ids
from sonarrec.evaluation.matching.fit import scorable_logs
from sonarrec.evaluation.matching.options import ScoringOptions
from sonarrec.evaluation.matching.pairs import FindBeside, Pair
from sonarrec.evaluation.metrics import BY_NAME, MAIN
from sonarrec.evaluation.summary import units_text
from sonarrec.evaluation.survey import UnreadableLog, map_logs
from sonarrec.evaluation.write import PAPER_KEY
from sonarrec.results.run_file import RunFile, read_run
from sonarrec.truth.fits import rows_on_frames

FRAMES_FREE = 2
"""So many frames may get worse, whatever the band: 2 of 24 are no trend, though they are .083."""


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
    """The denominator: how many cases the rate is over."""

    @property
    def worse(self) -> float:
        """By how much it got worse; negative if it got better. 0/0 counts as 0."""
        up = float(np.nan_to_num(self.new) - np.nan_to_num(self.old))
        return up if self.rate == "fpr" else -up

    def is_regression(self, band: float) -> bool:
        """Whether it got worse by more than `band` and by more than FRAMES_FREE frames."""
        return self.worse > max(band, FRAMES_FREE / max(self.of, 1)) + 1e-9


@dataclass(frozen=True, slots=True)
class PassChange:
    """A pass of a landmark in which one method is right in more frames, or in fewer."""

    protocol: str
    method: str
    log: str
    landmark: int
    first_frame: int
    last_frame: int
    frames: int
    """Frames with the whole landmark in view."""
    old: int
    new: int
    """Frames of these in which it was claimed."""


@dataclass(frozen=True, slots=True)
class PassChanges:
    """All PassChange records. Each is made when it is asked for, since many logs have very many."""

    outcomes: tuple[tuple[PassOutcomes, PassOutcomes], ...]
    """Before and after, per method and protocol."""
    pooled: Pooled

    def __iter__(self) -> Iterator[PassChange]:
        pooled, passes = self.pooled, self.pooled.passes
        for a, b in self.outcomes:
            for i in np.flatnonzero(a.right != b.right).tolist():
                yield PassChange(
                    protocol=a.protocol,
                    method=a.method,
                    log=pooled.logs[passes.log_index[i]],
                    landmark=pooled.ids[passes.landmark_index[i]],
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
    """The results folders as given."""
    logs: tuple[str, ...]
    frames_compared: int
    units: str
    """What intervals and tests treat as independent, such as "12 passes"."""
    landmarks: tuple[int, ...]
    settings: tuple[SettingChange, ...]
    """The settings that differ."""
    rates: tuple[RateChange, ...]
    frames: FrameChanges
    passes: PassChanges
    differences: tuple[Difference, ...]
    """New minus old, per ID and in total, with interval and p-value."""
    lost: tuple[str, ...]
    """Methods that only the old results have."""
    gained: tuple[str, ...]
    """Methods that only the new results have."""
    unplaced: bool
    """Whether protocol strict could be scored for the old results only."""
    notes: tuple[str, ...]
    unused: tuple[str, ...]
    """Input that could not be used, one line each."""

    def regressions(self, band: float) -> list[str]:
        """A line for each rate that got worse by more than `band`, and for each missing method or
        protocol."""
        lines = [f"{method}: no longer in the results" for method in self.lost]
        lines += ["protocol strict: no longer scored"] * self.unplaced
        for r in self.rates:
            if r.is_regression(band):
                name = "ID." * r.landmark_text.isdigit() + r.landmark_text
                lines.append(
                    f"{r.method}, {r.protocol}, {name}: {BY_NAME[r.rate].label} was "
                    f"{rate_text(r.old)}, is {rate_text(r.new)}"
                )
        return lines


def rate_text(rate: float) -> str:
    """A rate to four digits, or "0/0"."""
    return "0/0" if math.isnan(rate) else f"{rate:.4f}"


def compare(
    old: Path,
    new: Path,
    ground_truth: Path | Sequence[Pair] | None = None,
    options: ScoringOptions = DEFAULT,
    *,
    unit: UnitKind | None = None,
    jobs: int | None = None,
    find_beside: FindBeside | None = None,
) -> Comparison:
    """Compare two results folders, each of one log or of several, on their common frames.

    Logs are read one at a time, so memory does not grow with their number. A log that cannot be
    compared is left out if there are others.

    old, new: their logs are paired by name or SHA-256; if each holds one log, these are paired.
    ground_truth: one table for all logs, or pairs that name a truth per log; None: the truth
    beside each log. unit: as in `summary.summarise`. jobs, find_beside: as in
    `evaluate.evaluate_many`.
    Raises SonarrecError if no log can be compared, or if one truth is for all logs and cannot be
    read.
    """
    options.check()
    pairing = pair_logs(old, new, ground_truth, options, find_beside)
    counted = _count_pairs(pairing.pairs, jobs, options.min_visible)
    notes = [*dict.fromkeys(pairing.notes), *counted.notes, *_scored_before(old, new)]
    unused = [*dict.fromkeys([*pairing.unused, *counted.cut]), *counted.unused]
    settings = changed_settings(map(_runs, counted.used))
    before, after = counted.before, counted.after
    units = after.units(unit)
    changes = _method_changes(before, after, units)
    if not changes.methods:
        has = (f"{side} has {', '.join(p.methods)}" for side, p in ((old, before), (new, after)))
        raise SonarrecError(
            printable(f"nothing to compare: no method is in both; {'; '.join(has)}")
        )
    if before.placed != after.placed:
        without = new if before.placed else old
        notes.append(
            f"protocol strict is not compared: {without} has no positions that can be used"
        )
    return Comparison(
        old=str(old),
        new=str(new),
        logs=after.logs,
        frames_compared=after.frames,
        units=units_text(units),
        landmarks=after.ids,
        settings=tuple(settings),
        rates=tuple(changes.rates),
        frames=counted.frames(tuple(changes.methods)),
        passes=PassChanges(tuple(changes.outcomes), after),
        differences=tuple(changes.tests),
        lost=tuple(m for m in before.methods if m not in after.methods),
        gained=tuple(m for m in after.methods if m not in before.methods),
        unplaced=before.placed and not after.placed,
        notes=tuple(map(printable, notes)),
        unused=tuple(map(printable, unused)),
    )


def _scored_before(*sides: Path) -> Iterator[str]:
    """A note on each side whose evaluation.json is of a version that counted protocol paper
    otherwise."""
    for side in sides:
        path = side / "evaluation" / "evaluation.json"
        with suppress(OSError):
            text = path.read_bytes() if path.is_file() else b""
            if b'"min_visible"' in text and f'"{PAPER_KEY}"'.encode() not in text:
                yield (
                    f"{path}: scored by an earlier version, whose protocol paper ignored landmarks "
                    "partly in view; now every frame counts, so its figures of protocol paper "
                    "differ from those here; run `sonarrec evaluate` again"
                )


def _runs(pair: LogPair) -> tuple[str, RunFile, RunFile]:
    """(name, old run.toml, new run.toml), not kept: those of many logs take much memory."""
    before, after = (read_run(folder / "run.toml") for folder in pair.folders)
    return pair.name, before, after


@dataclass(frozen=True, slots=True)
class _CountedPairs:
    """The counts of all pairs that can be compared."""

    used: list[LogPair]
    before: Pooled
    after: Pooled
    """Of the same logs, frames and passes."""
    frames: Callable[[tuple[tuple[str, str], ...]], FrameChanges]
    """The changed frames of the given protocols and methods."""
    notes: list[str]
    cut: list[str]
    """A line for each part of a log that is not compared."""
    unused: list[str]
    """A line for each log that is not compared."""


def _count_pairs(pairs: Sequence[LogPair], jobs: int | None, min_visible: float) -> _CountedPairs:
    """Read and count all pairs.

    Raises SonarrecError if none can be compared, or if they have different IDs or no method.
    """
    before, after = Parts(), Parts()
    changes: dict[int, ByMethod] = {}
    logs: list[CountedPair] = []
    read: list[LogPair] = []
    unread: list[UnreadableLog] = []
    numbers: dict[int, int] = {}  # of a log, by its index in `logs`, the number of its parts
    ids: tuple[int, ...] | None = None
    folders = (folder for pair in pairs for folder in pair.folders)
    for pair, log in zip(pairs, map_logs(count_pair, pairs, folders, jobs), strict=True):
        counted = log
        if isinstance(counted, CountedPair) and counted.parts is not None:
            ids = ids or counted.ids
            if counted.ids != ids and set(counted.ids) == set(ids):
                counted = count_pair(replace(pair, ids=ids))  # again, in the first log's order
        if isinstance(counted, UnreadableLog):
            unread.append(counted)
            continue
        if counted.parts is not None:
            number = numbers[len(logs)] = before.put(counted.parts[0])
            after.put(counted.parts[1])
            changes[number] = counted.changes
        logs.append(replace(counted, parts=None, changes={}))
        read.append(pair)
    if not logs:
        raise unread[0].error
    scorable = scorable_logs([log.truth_check for log in logs])
    used = [logs[i] for i in scorable.usable]
    for log in used:
        if set(log.ids) != set(used[0].ids):
            raise other_ids(used[0].name, log.name)
    names = distinct_names([(read[i].name, read[i].new) for i in scorable.usable])
    part_numbers = [numbers[i] for i in scorable.usable]
    old, new = (pool(parts, part_numbers, names, min_visible) for parts in (before, after))
    if not (old.methods and new.methods):
        raise SonarrecError(f"{', '.join(names)}: estimates.csv names no method to score")
    notes = [*scorable.notes]
    compared = [method for method in new.methods if method in old.methods]
    for i, name in zip(scorable.usable, names, strict=True):
        notes += _notes_on_log(name, read[i], logs[i], compared)
    return _CountedPairs(
        used=[replace(read[i], name=n) for i, n in zip(scorable.usable, names, strict=True)],
        before=old,
        after=new,
        frames=partial(FrameChanges, changes, tuple(zip(part_numbers, names, strict=True))),
        notes=notes,
        cut=[line for log in logs for line in log.unused],
        unused=[*(counted.message("compared") for counted in unread), *scorable.unused],
    )


def _notes_on_log(
    name: str, pair: LogPair, log: CountedPair, methods: Sequence[str]
) -> Iterator[str]:
    """The notes of `evaluate` on one log. methods: those compared."""
    yield from rows_on_frames(name, log.truth_check.rows, log.truth_check.between)
    for folder, of_log in zip(pair.folders, log.methods, strict=True):
        missing = [method for method in methods if method not in of_log]
        if missing:
            yield f"{folder}: has no estimates of {', '.join(missing)}; this counts as no claim"


@dataclass(frozen=True, slots=True)
class _MethodChanges:
    """What changed for the methods that both sides have, under the protocols that both have."""

    methods: list[tuple[str, str]] = field(default_factory=list)
    """Protocol and method."""
    outcomes: list[tuple[PassOutcomes, PassOutcomes]] = field(default_factory=list)
    """Before and after, of each of these."""
    rates: list[RateChange] = field(default_factory=list)
    tests: list[Difference] = field(default_factory=list)


def _method_changes(before: Pooled, after: Pooled, units: PooledUnits) -> _MethodChanges:
    rng = np.random.default_rng(0)
    weights, tosses = bootstrap_weights(units.count, rng), coin_tosses(units.count, rng)
    index_before = {(s.protocol, s.method): n for n, s in enumerate(before.scored)}
    changes = _MethodChanges()
    for m, scored in enumerate(after.scored):
        n = index_before.get((scored.protocol, scored.method))
        if n is None:
            continue
        changes.methods.append((scored.protocol, scored.method))
        changes.outcomes.append((before.outcomes[n], after.outcomes[m]))
        # One ID at a time, since the curves of many logs are long.
        olds = metrics.rates_of(metrics.Case(before, units), before.scored[n])
        news = metrics.rates_of(metrics.Case(after, units), scored)
        for old, new in zip(olds, news, strict=True):
            changes.rates.extend(_rate_changes(old, new))
            old_tally, new_tally = (metrics.tally(metrics.rates, rate) for rate in (old, new))
            changes.tests.extend(differences(old_tally, new_tally, weights, tosses))
    return changes


def _rate_changes(old: UnitSums, new: UnitSums) -> Iterable[RateChange]:
    """The rates of MAIN that are known in the old or the new results."""
    tp, tn, fp, fn = new.exact.counts[0].tolist()
    for name in MAIN:
        was, now = (BY_NAME[name].value(rate) for rate in (old, new))
        if not (math.isnan(was) and math.isnan(now)):
            of = fp + tn if name == "fpr" else tp + fn
            yield RateChange(new.protocol, new.method, new.landmark_text, name, was, now, of)
