"""Two sets of results on one truth: what got better, what got worse, and in which frames."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.evaluation import metrics
from sonarrec.evaluation.behaviour import pass_outcomes
from sonarrec.evaluation.counted import Counted, rate_counts
from sonarrec.evaluation.evaluate import Evaluation, check_options, pool
from sonarrec.evaluation.joined import Joined
from sonarrec.evaluation.metrics import BY_NAME, MAIN
from sonarrec.evaluation.pairs import Elsewhere, Pair
from sonarrec.evaluation.passes import Passes, find_passes, find_units
from sonarrec.evaluation.scoring import Scored
from sonarrec.evaluation.settings import SettingChange
from sonarrec.evaluation.sides import Sides, both_sides
from sonarrec.evaluation.summary import UNITS
from sonarrec.evaluation.uncertainty import (
    Difference,
    bootstrap_weights,
    coin_tosses,
    differences,
)
from sonarrec.records import printable
from sonarrec.sonar import Sonar

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
    frames: tuple[FrameChange, ...]
    passes: tuple[PassChange, ...]
    differences: tuple[Difference, ...]
    """New less old, per ID and in total, with interval and p-value."""
    lost: tuple[str, ...]
    """Methods that only the old results have."""
    gained: tuple[str, ...]
    """Methods that only the new results have."""
    notes: tuple[str, ...]
    """Worth knowing."""
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
    ground_truth: Path | Sequence[Pair] | None = None,
    *,
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    landmarks: str | None = None,
    sonar: Sonar | None = None,
    elsewhere: Elsewhere | None = None,
) -> Comparison:
    """Compare two results folders, each of one log or of several, on the frames both hold.

    Logs go together by name or SHA-256, or where each side has one log. ground_truth: one table,
    or pairs, of which each log takes that of its results; None: the truth beside each log. The
    other arguments are those of `evaluate.evaluate`. Raises SonarrecError where files cannot be
    used, logs differ or nothing is in common.
    """
    check_options(min_visible, tolerance_s)
    sides = both_sides(old, new, ground_truth, tolerance_s, landmarks, sonar, elsewhere)
    before, after = (pool(cases, min_visible) for cases in (sides.before, sides.after))
    return _compared((str(old), str(new)), before, after, sides)


def _compared(
    names: tuple[str, str], before: Evaluation, after: Evaluation, sides: Sides
) -> Comparison:
    joined = after.joined
    passes = find_passes(joined)
    units = find_units(joined, passes)
    rng = np.random.default_rng(0)
    weights, tosses = bootstrap_weights(units.count, rng), coin_tosses(units.count, rng)
    olds = {(s.protocol, s.method): s for s in before.scored}
    rates: list[RateChange] = []
    frames: list[FrameChange] = []
    of_passes: list[PassChange] = []
    found: list[Difference] = []
    for b in after.scored:
        a = olds.get((b.protocol, b.method))
        if a is not None:
            old, new = rate_counts(a, units), rate_counts(b, units)
            rates += _rate_changes(old, new)
            frames += _frame_changes(a, b, joined)
            of_passes += _pass_changes(a, b, joined, passes)
            for was, now in zip(old, new, strict=True):
                was_tally, now_tally = (metrics.tally(metrics.rates, side) for side in (was, now))
                found += differences(was_tally, now_tally, weights, tosses)
    ours, theirs = before.joined.methods, after.joined.methods
    return Comparison(
        old=names[0],
        new=names[1],
        logs=joined.logs,
        frames_compared=len(joined.frame),
        units=f"{units.count} {UNITS[units.kind]}",
        landmarks=joined.ids,
        settings=tuple(sides.settings),
        rates=tuple(rates),
        frames=tuple(frames),
        passes=tuple(of_passes),
        differences=tuple(found),
        lost=tuple(m for m in ours if m not in theirs),
        gained=tuple(m for m in theirs if m not in ours),
        notes=tuple(map(printable, sides.notes)),
        unused=tuple(map(printable, sides.unused)),
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


def _pass_changes(a: Scored, b: Scored, joined: Joined, passes: Passes) -> Iterable[PassChange]:
    old, new = (pass_outcomes(scored, joined, passes) for scored in (a, b))
    for i in np.flatnonzero(old.right != new.right).tolist():
        yield PassChange(
            protocol=a.protocol,
            method=a.method,
            log=joined.logs[passes.log_index[i]],
            landmark=joined.ids[passes.landmark_index[i]],
            first_frame=int(joined.frame[passes.first_frame_index[i]]),
            last_frame=int(joined.frame[passes.last_frame_index[i]]),
            frames=int(new.frames[i]),
            old=int(old.right[i]),
            new=int(new.right[i]),
        )


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
    verdicts = [c.verdict for c in found.frames]
    lines.append(
        f"frames and IDs: {verdicts.count('better')} better, {verdicts.count('worse')} worse, "
        f"{verdicts.count('other')} otherwise changed"
    )
    runs = frame_runs(found.frames)
    for run in runs[:most]:
        first, last = run[0], run[-1]
        span = f"frame {first.frame}" if len(run) == 1 else f"frames {first.frame}-{last.frame}"
        lines.append(
            f"  {first.verdict}: {first.log} {span}, {first.method}, {first.protocol}, "
            f"ID.{first.landmark}: {outcome(first.old)} -> {outcome(first.new)}"
        )
    if len(runs) > most:
        lines.append(f"  and {len(runs) - most} more runs; changes.csv has all")
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


def frame_runs(changes: Iterable[FrameChange]) -> list[list[FrameChange]]:
    """Equal changes in neighbouring frames, put together; the longest first."""

    def key(c: FrameChange) -> tuple[Any, ...]:
        return c.protocol, c.method, c.log, c.landmark, c.old, c.new

    runs: list[list[FrameChange]] = []
    for change in sorted(changes, key=lambda c: (*key(c), c.frame)):
        if runs and key(runs[-1][-1]) == key(change) and change.frame - runs[-1][-1].frame <= 2:
            runs[-1].append(change)
        else:
            runs.append([change])
    return sorted(runs, key=lambda run: -len(run))
