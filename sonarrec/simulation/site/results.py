"""What `sonarrec site` finds: rates under protocol strict, the answer in words, and files.

Intervals treat passes of landmarks as independent, not frames.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.arrays import ByteImage, FloatArray, IntArray
from sonarrec.errors import Diagnostics, number_of
from sonarrec.evaluation.intervals import MIN_UNITS, bootstrap_weights, interval, rate_interval
from sonarrec.evaluation.judge import judge
from sonarrec.evaluation.match import Matched
from sonarrec.evaluation.passes import find_passes
from sonarrec.simulation.layout import Layout
from sonarrec.tables.outputs import write_csv, write_text, writing

ENOUGH = 0.9
"""Landmarks count as recognised at a contrast if they are in this share of their frames."""


SEED = 0


@dataclass(frozen=True, slots=True)
class Rate:
    """A share or a number per frame, and its interval.

    cases: frames with a whole landmark in view, or all frames. units: passes of landmarks, or
    units of `passes.Passes`. count: recognised, or false. low, high: NaN if fewer than
    MIN_UNITS units have a case; of a number also if all are alike.
    """

    cases: int
    units: int
    count: int
    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class RangeRate:
    """The TPR of landmarks at slant ranges from near_m up to far_m."""

    near_m: float
    far_m: float
    tpr: Rate


@dataclass(frozen=True, slots=True)
class RecognitionRates:
    """One method: TPR in total and by range, and false claims per 100 frames."""

    tpr: Rate
    by_range: tuple[RangeRate, ...]
    false_per_100: Rate


def recognition_rates(
    logs: Sequence[Matched], method: str, edges_m: Sequence[float]
) -> RecognitionRates:
    """The rates of one method. edges_m: (n + 1,) rising, edges of n steps of slant range."""
    right, of_pass, range_m, false, of_frame = ([] for _ in range(5))
    passes = units = 0
    for log in logs:
        judged, found = judge(log, method, "strict"), find_passes(log)
        right.append(judged.positive_is_claimed.astype(float))
        of_pass.append(found.of_truth[judged.positive] + passes)
        range_m.append(np.hypot(*log.truth_position[judged.positive].T))
        wrong = judged.frame_index[judged.declared_claim[judged.declared_effect[:, 2] > 0]]
        false.append(np.bincount(wrong, minlength=len(log.frame)).astype(float))
        of_frame.append(found.unit_of_frame + units)
        passes, units = passes + len(found.unit), units + found.units
    true, unit, range_of, false_of, frames = map(
        np.concatenate, (right, of_pass, range_m, false, of_frame)
    )
    steps = []
    for near, far in pairwise(edges_m):
        here = (range_of >= near) & ((range_of < far) | (far == edges_m[-1]))
        steps.append(RangeRate(near, far, _rate(true[here], unit[here], passes)))
    false_per_100 = _rate(100 * false_of, frames, units, int(false_of.sum()))
    return RecognitionRates(_rate(true, unit, passes), tuple(steps), false_per_100)


def _rate(value: FloatArray, unit: IntArray, units: int, count: int | None = None) -> Rate:
    """The mean of (n,) values, with its interval. count: given if they are no share."""
    sums = np.stack([np.bincount(unit, w, units) for w in (value, np.ones(len(value)))], axis=1)
    sums = sums[sums[:, 1] > 0]
    total = int(value.sum()) if count is None else count
    mean = float(value.mean()) if len(value) else math.nan
    low = high = math.nan
    if len(sums) >= MIN_UNITS and count is None:
        low, high = rate_interval(*sums.T)
    elif len(sums) >= MIN_UNITS and np.ptp(sums[:, 0] / sums[:, 1]) > 0:
        drawn = bootstrap_weights(len(sums), np.random.default_rng(SEED)) @ sums
        low, high = interval(drawn[:, 0] / drawn[:, 1], len(sums))
    return Rate(len(value), len(sums), total, mean, low, high)


def span_text(near_m: float, far_m: float) -> str:
    """Slant ranges in words; to the centimetre, so that no span ends outside the window."""
    return f"{near_m:.2f} to {far_m:.2f} m"


@dataclass(frozen=True, slots=True)
class ExampleFrame:
    """A frame at one contrast, drawn on: truth dashed, declared landmarks in colour."""

    contrast_db: float
    frame: int
    image: ByteImage
    truth: int
    declared: int


@dataclass(frozen=True, slots=True)
class ContrastResults:
    """The results at one contrast.

    near_m, far_m: slant ranges between which landmarks are recognised in ENOUGH of the frames,
    starting at the nearest step with a landmark; NaN if they are not in that step.
    """

    contrast_db: float
    rates: RecognitionRates
    near_m: float
    far_m: float

    @property
    def reaches(self) -> bool:
        """Whether there is such a range."""
        return not math.isnan(self.far_m)

    @property
    def span(self) -> str:
        """The range in words."""
        return span_text(self.near_m, self.far_m) if self.reaches else "-"


@dataclass(frozen=True, slots=True)
class Site:
    """The results of `sonarrec site`.

    about: what was run, as in site.json. contrasts: rising. empty: claims per 100 frames on the
    recording itself; they are false if it holds no landmarks. sentences: the answer in words.
    """

    about: dict[str, Any]
    layouts: tuple[Layout, ...]
    contrasts: tuple[ContrastResults, ...]
    empty: float
    sentences: tuple[str, ...]
    shown: tuple[ExampleFrame, ...]
    diagnostics: Diagnostics


def sentences(results: Sequence[ContrastResults], claims: int, frames: int) -> list[str]:
    """The answer: from which contrast on, at which range, how certain, and false claims."""
    lines = []
    good = len(results)
    while good and results[good - 1].rates.tpr.value >= ENOUGH:
        good -= 1
    if good < len(results):
        one = results[good]
        rate = one.rates.tpr
        more = " or more" if good + 1 < len(results) else ""
        lines.append(
            f"At {one.contrast_db:g} dB{more} over the floor, landmarks would be recognised in at "
            f"least {ENOUGH:.0%} of the frames that show them whole"
            + (f", {one.span} away." if one.reaches else ", all ranges taken together.")
        )
        lines.append(_certainty(rate))
    else:
        one = max(results, key=lambda one: one.rates.tpr.value)
        lines.append(
            f"At none of these contrasts would landmarks be recognised in {ENOUGH:.0%} of the "
            f"frames that show them whole; at best in {one.rates.tpr.value:.1%}, at "
            f"{one.contrast_db:g} dB."
        )
        near = [one for one in results if one.reaches]
        if near:
            lines.append(f"From {near[0].span} they would be, at {near[0].contrast_db:g} dB.")
    worst = max(results, key=lambda one: one.rates.false_per_100.value)
    false = worst.rates.false_per_100
    lines.append(
        f"False claims: at most {false.value:.1f} in 100 frames, at {worst.contrast_db:g} dB."
        if false.count
        else "No false claim was made."
    )
    if claims:
        lines.append(
            f"In the recording itself {100 * claims / frames:.1f} landmarks are claimed in 100 "
            "frames. If it holds none, these are false too; if it holds some, the figures here "
            "mean little."
        )
    return lines


def _certainty(rate: Rate) -> str:
    """A sentence on how certain a TPR of ENOUGH or more is."""
    passes = number_of(rate.units, "pass", "es")
    basis = f"This is based on {passes} of landmarks through the view"
    if math.isnan(rate.low):
        return f"{basis}, too few for an interval; give more --layouts."
    interval = f"the 95% interval of {rate.value:.3f}"
    if rate.low < ENOUGH:
        return f"{basis} and is not certain: {interval} begins at {rate.low:.3f}."
    return f"{basis}; {interval} is {rate.low:.3f} to {rate.high:.3f}."


COLUMNS = (
    *("contrast_db", "range_from_m", "range_to_m", "landmark_frames", "passes", "recognised"),
    *("tpr", "tpr_low", "tpr_high", "frames", "false_claims", "false_per_100"),
    *("false_per_100_low", "false_per_100_high"),
)


def table(site: Site) -> list[dict[str, Any]]:
    """A row per contrast over all ranges (their columns empty), then one per step of range."""
    rows: list[dict[str, Any]] = []
    for one in site.contrasts:
        false = one.rates.false_per_100
        steps: list[tuple[float, float, Rate]] = [
            (math.nan, math.nan, one.rates.tpr),
            *((r.near_m, r.far_m, r.tpr) for r in one.rates.by_range),
        ]
        for near, far, rate in steps:
            found = map(_rounded, (near, far)), map(_rounded, (rate.value, rate.low, rate.high))
            counts = rate.cases, rate.units, rate.count
            cells: list[Any] = [one.contrast_db, *found[0], *counts, *found[1]]
            if math.isnan(near):
                cells += [false.cases, false.count]
                cells += map(_rounded, (false.value, false.low, false.high))
            rows.append(dict(zip_longest(COLUMNS, cells)))
    return rows


def _rounded(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 4)


def write_site(out: Path, site: Site, page: str) -> None:
    """Write site.html, site.csv and site.json. Raises SonarrecError if that fails."""
    rates = table(site)
    document = {
        **site.about,
        "layouts": [{"seed": one.seed, "landmarks": one.landmark_count} for one in site.layouts],
        "claims_per_100_as_it_is": round(site.empty, 4),
        "summary": list(site.sentences),
        "notes": [*site.diagnostics.problems, *site.diagnostics.notes],
        "contrasts": [
            {
                "contrast_db": one.contrast_db,
                "recognised_from_m": _rounded(one.near_m),
                "recognised_to_m": _rounded(one.far_m),
            }
            for one in site.contrasts
        ],
        "rates": rates,
    }
    with writing(out):
        write_csv(out / "site.csv", COLUMNS, (row.values() for row in rates))
        text = json.dumps(document, indent=2, ensure_ascii=False)
        write_text(out / "site.json", text + "\n")
        write_text(out / "site.html", page)
