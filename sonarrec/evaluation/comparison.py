"""What a comparison of two results found, and its verdict in one sentence and one table."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from sonarrec.errors import number_of
from sonarrec.evaluation.changes import CHANGES, FrameChanges, change_cells
from sonarrec.evaluation.count import Counts
from sonarrec.evaluation.intervals import MIN_UNITS, Difference
from sonarrec.evaluation.judge import PROTOCOLS
from sonarrec.evaluation.metrics import BY_NAME
from sonarrec.results.run_file import RunFile, flat

FRAMES_FREE = 2
"""So many frames may get worse, whatever the band: 2 of 24 are no trend, though they are .083."""
RATES = ("tpr", "fpr")
"""Those that a verdict rests on."""
SAME = 5e-5
"""A smaller change of a rate does not show in its digits."""
SLIGHT = 0.1
"""A smaller share of the change of one rate, as the other changes, decides nothing."""
SIGNIFICANT = 0.05
"""The largest p that is not told as possibly due to chance."""
NOT_STATED = "not stated"
_LONGEST = 60
# Keys that differ between equal runs, or that are reported elsewhere.
_PASSED_OVER = {
    *("finished", "program.name", "program.methods", "input.name", "input.path", "input.place"),
    *("input.bytes", "input.sha256", "input.frames_processed", "input.frames_unusable"),
    *("input.candidates", "input.estimates", "input.sightings", "input.problems"),
    *("ran_on.processor", "ran_on.numpy", "ran_on.opencv"),
}


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

    def sign(self, band: float) -> int:
        """1 if it got worse by more than `band` and than FRAMES_FREE frames, -1 if better, or 0."""
        least = max(band, FRAMES_FREE / max(self.of, 1)) + 1e-9
        return int(np.sign(self.worse)) * (abs(self.worse) > least)


@dataclass(frozen=True, slots=True)
class SettingChange:
    """A key of run.toml that differs, its values as text, and the logs in which it differs."""

    key: str
    """Named as for `--set`; if there are several presets, with the preset in front."""
    old: str
    new: str
    logs: tuple[str, ...]


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

    before: Counts
    after: Counts
    methods: tuple[tuple[str, str], ...]
    """Protocol and method of those compared."""

    def __iter__(self) -> Iterator[PassChange]:
        counts, passes = self.after, self.after.passes
        for of in self.methods:
            a, b = self.before.outcomes(*of), counts.outcomes(*of)
            for i in np.flatnonzero(a.right != b.right).tolist():
                yield PassChange(
                    *of,
                    log=counts.logs[passes.log_index[i]],
                    landmark=counts.ids[passes.landmark_index[i]],
                    first_frame=int(passes.first_frame[i]),
                    last_frame=int(passes.last_frame[i]),
                    frames=int(b.frames[i]),
                    old=int(a.right[i]),
                    new=int(b.right[i]),
                )


@dataclass(frozen=True, slots=True, repr=False)
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

    @property
    def verdict(self) -> str:
        """Whether the new results are better or worse, in one sentence."""
        return _verdict(self)

    @property
    def table(self) -> pd.DataFrame:
        """A row per method: TPR and FPR over all IDs under each protocol, before and now."""
        of_method: dict[str, dict[str, float]] = {}
        for r in self.rates:
            if r.landmark_text == "total" and r.rate in RATES:
                name = f"{r.protocol} {r.rate.upper()}"
                row = of_method.setdefault(r.method, {})
                row |= {f"{name} old": r.old, f"{name} new": r.new}
        return pd.DataFrame.from_dict(of_method, orient="index").rename_axis("method")

    @property
    def figures(self) -> pd.DataFrame:
        """The rates of compare.csv, with interval and p of the difference."""
        tests = {(d.protocol, d.b, d.landmark_text, d.name): d for d in self.differences}
        keys = [(r.protocol, r.method, r.landmark_text, r.rate) for r in self.rates]
        rows = [
            (*key, r.old, r.new, tests[key].low, tests[key].high, tests[key].p)
            for key, r in zip(keys, self.rates, strict=True)
        ]
        columns = ["protocol", "method", "landmark", "rate", "old", "new", "low", "high", "p"]
        return pd.DataFrame(rows, columns=columns)

    @property
    def changes(self) -> pd.DataFrame:
        """The frames and IDs that are counted otherwise, as changes.csv."""
        rows = (change_cells(change) for change in self.frames)
        return pd.DataFrame(rows, columns=list(CHANGES))

    def __repr__(self) -> str:
        return f"<{self.verdict}>"

    @property
    def methods(self) -> tuple[tuple[str, str], ...]:
        """(protocol, method) of those in both results, the leading method first."""
        return self.frames.methods

    def regressions(self, band: float, methods: Container[str] | None = None) -> list[str]:
        """A line for each rate that got worse by more than `band`, and for each missing method or
        protocol. methods: those looked at; None: all."""
        looked_at = [m for m in self.lost if methods is None or m in methods]
        lines = [f"{method}: no longer in the results" for method in looked_at]
        lines += ["protocol strict: no longer scored"] * self.unplaced
        for r in self.rates:
            if (methods is None or r.method in methods) and r.sign(band) > 0:
                name = "ID." * r.landmark_text.isdigit() + r.landmark_text
                lines.append(
                    f"{r.method}, {r.protocol}, {name}: {BY_NAME[r.rate].label} was "
                    f"{rate_text(r.old)}, is {rate_text(r.new)}"
                )
        return lines


def rate_text(rate: float) -> str:
    """A rate to four digits, or "0/0"."""
    return "0/0" if math.isnan(rate) else f"{rate:.4f}"


def _verdict(found: Comparison) -> str:
    """Whether the new results are better or worse, by the leading method and the stricter protocol.

    Worse: a rate is worse, and the other one is not better by more than SLIGHT of that.
    """
    method = found.methods[0][1]
    *_, protocol = [protocol for protocol, of in found.methods if of == method]
    rates = [_total(found, protocol, method, rate) for rate in RATES]
    changed = [r for r in rates if r is not None and abs(r.worse) >= SAME]
    changed.sort(key=lambda r: -abs(r.worse))
    if not changed:
        word = "as good as"
    elif changed[-1].worse * changed[0].worse < 0 and abs(changed[-1].worse) > abs(
        SLIGHT * changed[0].worse
    ):
        word = "neither better nor worse than"
    else:
        word = "worse than" if changed[0].worse > 0 else "better than"
    texts = [f"{r.rate.upper()} {change_text(r)}" for r in rates if r is not None]
    parts = [f"{', '.join(texts)} ({method}, {protocol})", *_passes(found, protocol, method)]
    if changed:
        parts.append(_test(found, protocol, method, changed[0].rate))
    elif protocol != "paper":
        also = [r for rate in RATES if (r := _total(found, "paper", method, rate)) is not None]
        told = [f"{r.rate.upper()} {change_text(r)}" for r in also if abs(r.worse) >= SAME]
        parts += [f"but under protocol paper {', '.join(told)}"] if told else []
    missing = [f"{method} is missing" for method in found.lost]
    missing += ["protocol strict cannot be scored any more"] * found.unplaced
    return "; ".join([*missing, f"{found.new} is {word} {found.old}: {parts[0]}", *parts[1:]])


def rate_table(found: Sequence[Comparison]) -> list[list[str]]:
    """A heading, and a row for each method of each comparison: both protocols side by side."""
    protocols = [p for p in PROTOCOLS if any(p == of for one in found for of, _ in one.methods)]
    columns = [(protocol, rate) for protocol in protocols for rate in RATES]
    rows = [["", *(f"{protocol} {rate.upper()}" for protocol, rate in columns)]]
    for one in found:
        for method in dict.fromkeys(method for _, method in one.methods):
            cells = [_total(one, protocol, method, rate) for protocol, rate in columns]
            label = method if len(found) == 1 else f"{one.new}, {method}"
            rows.append([label, *("-" if c is None else change_text(c) for c in cells)])
    return rows


def change_text(r: RateChange) -> str:
    """A rate before and after; once if its digits are the same."""
    old, new = rate_text(r.old), rate_text(r.new)
    return old if old == new else f"{old} -> {new}"


def _total(found: Comparison, protocol: str, method: str, rate: str) -> RateChange | None:
    wanted = (protocol, method, "total", rate)
    named = ((r, (r.protocol, r.method, r.landmark_text, r.rate)) for r in found.rates)
    return next((r for r, name in named if name == wanted), None)


def _passes(found: Comparison, protocol: str, method: str) -> list[str]:
    """What became of the passes, if anything did."""
    old, new = (
        side.outcomes(protocol, method) for side in (found.passes.before, found.passes.after)
    )
    seen = new.frames > 0
    lost, gained = (
        seen & (old.right > 0) & (new.right == 0),
        seen & (old.right == 0) & (new.right > 0),
    )
    many = f"of {number_of(int(seen.sum()), 'pass', 'es')}"
    kinds = (
        (lost, f"{many} lost"),
        (gained, f"{many} gained"),
        (seen & (new.right < old.right) & ~lost, f"{many} with fewer frames right"),
        (seen & (new.right > old.right) & ~gained, f"{many} with more frames right"),
    )
    told = [(int(np.count_nonzero(which)), text) for which, text in kinds]
    return [f"{count} {text}" for count, text in told if count]


def _test(found: Comparison, protocol: str, method: str, rate: str) -> str:
    """p of the change of a rate, and what it means."""
    wanted = (protocol, method, "total", rate)
    [d] = [d for d in found.differences if (d.protocol, d.b, d.landmark_text, d.name) == wanted]
    if d.units < MIN_UNITS:
        noun, ending = ("log", "s") if "log" in found.units else ("pass", "es")
        return f"{number_of(d.units, noun, ending)}: too few to test"
    if math.isnan(d.p):
        return d.note
    chance = "" if d.p <= SIGNIFICANT else ", so it may be chance"
    return f"p = {d.p:.2g} over {found.units}{chance}"


def changed_settings(runs: Iterable[tuple[str, RunFile, RunFile]]) -> list[SettingChange]:
    """The differences between the old and the new run.toml of each log (name, old, new).

    Logs without a run.toml on one side are left out.
    """
    presets: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for name, before, after in runs:
        if not before.table or not after.table:
            continue
        old, new = (
            {key: value for key, value in flat(run.table) if key not in _PASSED_OVER}
            for run in (before, after)
        )
        for key in dict.fromkeys((*old, *new)):
            # A key of [fan] that follows one of [sonar] is told as that one alone.
            stated = key.replace("fan.", "sonar.", 1)
            follows = key.startswith("fan.") and old.get(stated) != new.get(stated)
            if old.get(key) != new.get(key) and not follows:
                was, now = (_text(side[key]) if key in side else NOT_STATED for side in (old, new))
                presets[key, was, now if was != now else "other values"].append(name)
    return [SettingChange(*change, tuple(logs)) for change, logs in presets.items()]


def _text(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."
