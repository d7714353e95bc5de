"""Two sets of results on one truth: what got better, what got worse, and in which frames."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.evaluation import metrics
from sonarrec.evaluation.counted import Counted, rate_counts
from sonarrec.evaluation.evaluate import Evaluation, check_options, pool
from sonarrec.evaluation.joined import Joined
from sonarrec.evaluation.metrics import BY_NAME, MAIN
from sonarrec.evaluation.passes import find_passes, find_units
from sonarrec.evaluation.scoring import Scored
from sonarrec.evaluation.uncertainty import (
    Difference,
    bootstrap_weights,
    coin_tosses,
    differences,
)
from sonarrec.records import SonarrecError, printable
from sonarrec.results.read import LogResults, find_logs, read_log
from sonarrec.sonar import Sonar
from sonarrec.truth.match import match_truth
from sonarrec.truth.table import read_truth

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
class FrameChange:
    """A frame and ID that one method no longer counts as before."""

    protocol: str
    method: str
    log: str
    frame: int
    landmark: int
    old: tuple[int, int, int]
    new: tuple[int, int, int]
    """TP, FP, FN there."""

    @property
    def verdict(self) -> str:
        """better, worse or other, by the number of errors."""
        more = sum(self.new[1:]) - sum(self.old[1:])
        return "worse" if more > 0 else "better" if more < 0 else "other"


@dataclass(frozen=True, slots=True)
class Comparison:
    """What `compare` found."""

    rates: tuple[RateChange, ...]
    frames: tuple[FrameChange, ...]
    differences: tuple[Difference, ...]
    """New less old, in total, with interval and p-value."""
    lost: tuple[str, ...]
    """Methods that only the old results have."""
    gained: tuple[str, ...]
    """Methods that only the new results have."""
    unused: tuple[str, ...]
    """Input that could not be used, one line each."""

    def regressions(self, band: float) -> list[str]:
        """One line per rate that got worse beyond the band, and per method that is gone."""
        lines = [f"{method}: no longer in the results" for method in self.lost]
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
    ground_truth: Path,
    *,
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    landmarks: str | None = None,
    sonar: Sonar | None = None,
) -> Comparison:
    """Compare two results folders, each of one log or of several, on the frames both hold.

    Logs go together by name, or where each side has one log. The other arguments are those of
    `evaluate.evaluate`. Raises SonarrecError where files cannot be used or nothing is in common.
    """
    check_options(min_visible, tolerance_s)
    table = read_truth(ground_truth)
    sides = [[read_log(f, landmarks, sonar) for f in find_logs(side)] for side in (old, new)]
    pairs, unused = _pair_up(old, new, *sides)
    if len(pairs) > 1 and table.log is None:
        raise SonarrecError(
            f"{ground_truth}: {new} holds {len(pairs)} logs, so the truth needs a log column that "
            "names their folders; or give the folders of one log"
        )
    cut = []
    for a, b in pairs:
        common = np.intersect1d(a.frame, b.frame)
        if not len(common):
            raise SonarrecError(f"{b.name}: {old} and {new} have no frame in common")
        for side, log in ((old, a), (new, b)):
            alone = len(log.frame) - len(common)
            if alone:
                unused.append(f"{log.name}: {alone} frames are in {side} only; not compared")
        cut.append((_only(a, common), _only(replace(b, name=a.name), common)))
    truths = [match_truth(table, b, tolerance_s) for _, b in cut]
    before = pool([a for a, _ in cut], truths, min_visible)
    after = pool([b for _, b in cut], truths, min_visible)
    return _compared(before, after, tuple(unused))


def _pair_up(
    old: Path, new: Path, before: list[LogResults], after: list[LogResults]
) -> tuple[list[tuple[LogResults, LogResults]], list[str]]:
    if len(before) == len(after) == 1:
        return [(replace(before[0], name=after[0].name), after[0])], []
    by_name = {log.name: log for log in before}
    pairs = [(by_name[log.name], log) for log in after if log.name in by_name]
    if not pairs:
        raise SonarrecError(f"{old} and {new} have no log of one name")
    common = {b.name for _, b in pairs}
    unused = [
        f"{log.name}: is in {side} only; not compared"
        for side, logs in ((old, before), (new, after))
        for log in logs
        if log.name not in common
    ]
    return pairs, unused


def _only(log: LogResults, frames: Any) -> LogResults:
    """The results on some of the log's frames, given by number."""
    kept = np.isin(log.frame, frames)
    mine = kept[log.frame_index]
    return replace(
        log,
        frame=log.frame[kept],
        timestamp_ns=None if log.timestamp_ns is None else log.timestamp_ns[kept],
        method=log.method[mine],
        frame_index=(np.cumsum(kept) - 1)[log.frame_index[mine]],
        landmark_index=log.landmark_index[mine],
        score=log.score[mine],
        declared=log.declared[mine],
        position=None if log.position is None else log.position[mine],
        orientation=log.orientation[mine],
        object=log.object[mine],
        probability=None if log.probability is None else log.probability[mine],
    )


def _compared(before: Evaluation, after: Evaluation, unused: tuple[str, ...]) -> Comparison:
    joined = after.joined
    units = find_units(joined, find_passes(joined))
    rng = np.random.default_rng(0)
    weights, tosses = bootstrap_weights(units.count, rng), coin_tosses(units.count, rng)
    olds = {(s.protocol, s.method): s for s in before.scored}
    rates: list[RateChange] = []
    frames: list[FrameChange] = []
    found: list[Difference] = []
    for b in after.scored:
        a = olds.get((b.protocol, b.method))
        if a is not None:
            old, new = rate_counts(a, units), rate_counts(b, units)
            rates += _rate_changes(old, new)
            frames += _frame_changes(a, b, joined)
            before_all, after_all = (metrics.tally(metrics.rates, side[-1]) for side in (old, new))
            found += differences(before_all, after_all, weights, tosses)
    ours, theirs = before.joined.methods, after.joined.methods
    return Comparison(
        rates=tuple(rates),
        frames=tuple(frames),
        differences=tuple(found),
        lost=tuple(m for m in ours if m not in theirs),
        gained=tuple(m for m in theirs if m not in ours),
        unused=unused,
    )


def _rate_changes(old: Sequence[Counted], new: Sequence[Counted]) -> Iterable[RateChange]:
    for a, b in zip(old, new, strict=True):
        tp, tn, fp, fn = b.exact.made[0].tolist()
        labels = a.protocol, a.method, a.landmark_text
        for name in MAIN:
            was, now = (BY_NAME[name].value(side) for side in (a, b))
            if not (math.isnan(was) and math.isnan(now)):
                of = fp + tn if name == "fpr" else tp + fn
                yield RateChange(*labels, name, was, now, of)


def _frame_changes(a: Scored, b: Scored, joined: Joined) -> Iterable[FrameChange]:
    frames = len(joined.frame)
    cells = [s.declared_by(np.arange(frames), joined.truth_frame_index, frames) for s in (a, b)]
    old, new = (c[:, :, [0, 2, 3]] for c in cells)
    for f, k in np.argwhere((old != new).any(axis=2)).tolist():
        was, now = old[f, k].tolist(), new[f, k].tolist()
        yield FrameChange(
            protocol=a.protocol,
            method=a.method,
            log=joined.logs[joined.log_index[f]],
            frame=int(joined.frame[f]),
            landmark=a.ids[k],
            old=(was[0], was[1], was[2]),
            new=(now[0], now[1], now[2]),
        )


def screen(found: Comparison, most: int = 12) -> str:
    """Totals before and after with their tests, then the longest runs of changed frames."""
    tests = {(d.protocol, d.b, d.name): d for d in found.differences}
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
    lines = [f"{name}: {', '.join(texts)}" for name, texts in totals.items()]
    if few:
        lines.append(f"no p-values: {few}")
    lines += [f"{method}: only in the old results" for method in found.lost]
    lines += [f"{method}: only in the new results" for method in found.gained]
    verdicts = [c.verdict for c in found.frames]
    lines.append(
        f"frames and IDs: {verdicts.count('better')} better, {verdicts.count('worse')} worse, "
        f"{verdicts.count('other')} otherwise changed"
    )
    runs = sorted(_runs(found.frames), key=lambda run: -len(run))
    for run in runs[:most]:
        first, last = run[0], run[-1]
        span = f"frame {first.frame}" if len(run) == 1 else f"frames {first.frame}-{last.frame}"
        lines.append(
            f"  {first.verdict}: {first.log} {span}, {first.method}, {first.protocol}, "
            f"ID.{first.landmark}: {_outcome(first.old)} -> {_outcome(first.new)}"
        )
    if len(runs) > most:
        lines.append(f"  and {len(runs) - most} more runs; changes.csv has all")
    return "\n".join(map(printable, lines))


def _outcome(counts: tuple[int, int, int]) -> str:
    named = [n for n, c in zip(("TP", "FP", "FN"), counts, strict=True) for _ in range(c)]
    return " + ".join(named) or "TN"


def _runs(changes: Iterable[FrameChange]) -> list[list[FrameChange]]:
    """Equal changes in neighbouring frames, put together."""

    def key(c: FrameChange) -> tuple[Any, ...]:
        return c.protocol, c.method, c.log, c.landmark, c.old, c.new

    runs: list[list[FrameChange]] = []
    for change in sorted(changes, key=lambda c: (*key(c), c.frame)):
        if runs and key(runs[-1][-1]) == key(change) and change.frame - runs[-1][-1].frame <= 2:
            runs[-1].append(change)
        else:
            runs.append([change])
    return runs
