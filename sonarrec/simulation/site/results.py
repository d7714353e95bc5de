"""What `sonarrec site` finds: the answer in words, site.csv and site.json."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

from sonarrec.arrays import ByteImage
from sonarrec.errors import Diagnostics, number_of
from sonarrec.simulation.layout import Layout
from sonarrec.simulation.site.rates import Rate, RecognitionRates
from sonarrec.tables.outputs import write_csv, write_text, writing

ENOUGH = 0.9
"""Landmarks count as recognised at a contrast if they are in this share of their frames."""


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
