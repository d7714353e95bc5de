"""A comparison in one sentence and one table."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sonarrec.errors import number_of
from sonarrec.evaluation.compare import Comparison, RateChange, rate_text
from sonarrec.evaluation.intervals import MIN_UNITS
from sonarrec.evaluation.judge import PROTOCOLS

RATES = ("tpr", "fpr")
"""Those that a verdict rests on."""
SAME = 5e-5
"""A smaller change of a rate does not show in its digits."""
SLIGHT = 0.1
"""A smaller share of the change of one rate, as the other changes, decides nothing."""
SIGNIFICANT = 0.05
"""The largest p that is not told as possibly due to chance."""


def verdict(found: Comparison) -> str:
    """Whether the new results are better or worse, by the leading method and the stricter protocol.

    Worse: a rate is worse, and the other one is not better by more than SLIGHT of that.
    """
    protocol, method = _leading(found)
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


def _leading(found: Comparison) -> tuple[str, str]:
    """(protocol, method) that the verdict is about."""
    method = found.methods[0][1]
    return [of for of in found.methods if of[1] == method][-1]


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
