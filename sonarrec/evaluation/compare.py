"""Two sets of results scored against one truth: what got better or worse, and in which frames."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import Diagnostics, SonarrecError, printable
from sonarrec.evaluation import metrics, unit_sums
from sonarrec.evaluation.changes import ByMethod, FrameChanges
from sonarrec.evaluation.comparison import Comparison, PassChanges, RateChange, changed_settings
from sonarrec.evaluation.count import Adder, Counts
from sonarrec.evaluation.intervals import (
    Difference,
    Tally,
    bootstrap_weights,
    coin_tosses,
    differences,
)
from sonarrec.evaluation.logs import UnreadableLog, check_logs, first_ids, map_logs
from sonarrec.evaluation.match import ScoringOptions, scoring_options
from sonarrec.evaluation.metrics import MAIN
from sonarrec.evaluation.pairing import CountedPair, LogPair, count_pair, pair_logs
from sonarrec.evaluation.pairs import Pair, read_pairs
from sonarrec.evaluation.summary import SEED, units_text
from sonarrec.nouns import follows
from sonarrec.results.columns import chosen
from sonarrec.results.run_file import read_run
from sonarrec.truth.check import tell_rows


def compare(
    old: str | Path,
    new: str | Path,
    ground_truth: str | Path | Sequence[Pair] | None = None,
    options: ScoringOptions | None = None,
    *,
    pairs: str | Path | None = None,
    baseline: bool = False,
    jobs: int | None = 1,
    **scoring: Any,
) -> Comparison:
    """What got better or worse from old to new results, each of one log or of several.

    `verdict` of the result says it in a sentence; `table` has a row per method, `figures` all rates
    with their tests, `changes` every frame and ID that is counted otherwise. Nothing is written.
    Common frames are compared.

    Logs are read one at a time, so memory does not grow with their number. A log that cannot be
    compared is left out if there are others.

    old, new: their logs are paired by name or SHA-256; if each holds one log, these are paired.
    ground_truth: one table for all logs, or pairs that name a truth per log; None: the truth
    beside each log. pairs: a CSV that names the truth of each log. options: how it is scored; else
    `scoring`, as `evaluate` takes it, `method` to `sonar`. baseline: whether methods without
    tracks, which changes of stages 2 and 3 leave as they were, are compared too, if none is named
    in options. jobs: as of `evaluate`.
    Raises SonarrecError if no log can be compared, or if one truth is for all logs and cannot be
    read.
    """
    options = options or scoring_options(**scoring)
    options.check()
    told, old, new = Diagnostics(), Path(old), Path(new)
    truth = Path(ground_truth) if isinstance(ground_truth, str) else ground_truth
    truth = read_pairs(Path(pairs)) if pairs else truth
    logs = pair_logs(old, new, truth, options, told)
    used, before, after, changed = _count_pairs(logs, options, jobs, told)
    methods = _compared_methods(before, after, options.methods, baseline)
    told.note(*_incomplete(used, before, after, methods))
    # Of each log (name, old run.toml, new run.toml), not kept: those of many take much memory.
    runs = (
        (name, read_run(pair.old / "run.toml"), read_run(pair.new / "run.toml"))
        for name, pair in zip(after.logs, used, strict=True)
    )
    units = after.units()
    scored = {(s.protocol, s.method): s for s in before.scored}
    both = [
        s
        for method in methods
        for s in after.scored
        if s.method == method and (s.protocol, s.method) in scored
    ]
    if not both:
        has = (f"{side} has {', '.join(p.methods)}" for side, p in ((old, before), (new, after)))
        raise SonarrecError(
            printable(f"nothing to compare: no method is in both; {'; '.join(has)}")
        )
    if before.placed != after.placed:
        without = new if before.placed else old
        told.note(f"protocol strict is not compared: {without} has no positions that can be used")
    rng = np.random.default_rng(SEED)
    weights, tosses = bootstrap_weights(units.count, rng), coin_tosses(units.count, rng)
    rates: list[RateChange] = []
    tests: list[Difference] = []
    for s in both:
        # One ID at a time, since the curves of many logs are long.
        olds = unit_sums.rates_of(before, units, scored[s.protocol, s.method])
        for was, now in zip(olds, unit_sums.rates_of(after, units, s), strict=True):
            a, b = (metrics.tally(unit_sums.rates, rate) for rate in (was, now))
            rates += _rate_changes(a, b, now.exact.counts[0])
            tests += differences(a, b, weights, tosses)
    compared = tuple((s.protocol, s.method) for s in both)
    return Comparison(
        old=str(old),
        new=str(new),
        logs=after.logs,
        frames_compared=after.frames,
        units=units_text(units),
        landmarks=after.ids,
        settings=tuple(changed_settings(runs)),
        rates=tuple(rates),
        frames=FrameChanges(tuple(zip(after.logs, changed, strict=True)), compared),
        passes=PassChanges(before, after, compared),
        differences=tuple(tests),
        lost=tuple(m for m in methods if m not in after.methods),
        gained=tuple(m for m in methods if m not in before.methods),
        unplaced=before.placed and not after.placed,
        notes=tuple(told.notes),
        unused=tuple(told.problems),
    )


def _compared_methods(
    before: Counts, after: Counts, wanted: Sequence[str], baseline: bool
) -> tuple[str, ...]:
    """The methods to compare, also those of one side only; the arguments are those of `compare`."""
    there = chosen({*before.methods, *after.methods}, wanted, ", ".join(after.logs))
    tracking = tuple(filter(follows, there))
    if wanted or baseline or not {*tracking} & {*before.methods} & {*after.methods}:
        return there
    return tracking


def _incomplete(
    pairs: Sequence[LogPair], before: Counts, after: Counts, methods: Sequence[str]
) -> Iterator[str]:
    """A note on each log that lacks one of the methods of its side."""
    for pair, *parts in zip(pairs, before.parts, after.parts, strict=True):
        for folder, part, side in zip(pair.folders, parts, (before, after), strict=True):
            lacks = [m for m in methods if m in side.methods and m not in part.methods]
            if lacks:
                yield f"{folder}: has no estimates of {', '.join(lacks)}; this counts as no claim"


def _rate_changes(old: Tally, new: Tally, counts: FloatArray) -> Iterator[RateChange]:
    """The rates of MAIN that are known in the old or the new results. counts: (4,) of the new."""
    tp, tn, fp, fn = counts.tolist()
    for name in MAIN:
        was, now = (side.values[side.names.index(name)] for side in (old, new))
        if not (math.isnan(was) and math.isnan(now)):
            of = fp + tn if name == "fpr" else tp + fn
            yield RateChange(new.protocol, new.method, new.landmark_text, name, was, now, of)


def _count_pairs(
    pairs: Sequence[LogPair], options: ScoringOptions, jobs: int | None, told: Diagnostics
) -> tuple[list[LogPair], Counts, Counts, list[ByMethod]]:
    """Read and count all pairs: those that can be compared, what was before, after and changed.

    Both counts are of the same logs, frames and passes.
    Raises SonarrecError if none can be compared, or if they have different IDs or no method.
    """
    before, after = Adder(), Adder()
    changes: list[ByMethod] = []
    logs: list[CountedPair] = []
    used: list[tuple[LogPair, CountedPair]] = []
    unread: list[UnreadableLog] = []
    folders = (folder for pair in pairs for folder in pair.folders)
    ids = first_ids((pair.new for pair in pairs), options.landmarks)
    work = partial(count_pair, options=options, ids=ids)
    for pair, log in zip(pairs, map_logs(work, pairs, folders, jobs), strict=True):
        if isinstance(log, UnreadableLog):
            unread.append(log)
            continue
        logs.append(log)
        if log.counts is not None:
            for side, counts in zip((before, after), log.counts, strict=True):
                side.add(counts)
            changes.append(log.changes)
            used.append((pair, log))
            log.counts, log.changes = None, {}
    if not logs:
        raise unread[0].error
    fit_notes, misfits = check_logs([log.check for log in logs])
    old, new = (side.counts([pair.new for pair, _ in used]) for side in (before, after))
    told.note(*fit_notes)
    for (_, log), part in zip(used, old.parts, strict=True):
        tell_rows(told, part.name, log.check.rows, log.check.between)
    told.problem(*(line for log in logs for line in log.unused))
    told.problem(*(log.message("compared") for log in unread), *misfits)
    return [pair for pair, _ in used], old, new, changes
