"""`sonarrec site`: would landmarks be recognised at the site of a recording, and how far away?

Landmarks are laid into the recording at several contrasts, each time at the same places; each
recording made so is run and scored. What comes of it is site.html, site.csv and site.json.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.drawing.results import Mark, draw_frame
from sonarrec.evaluation.by_range import Rate, Recognised, recognised
from sonarrec.evaluation.counting.uncertainty import MIN_UNITS, unseen_share
from sonarrec.evaluation.evaluate import evaluate_whole
from sonarrec.evaluation.matching.options import ScoringOptions
from sonarrec.evaluation.matching.pairs import Pair
from sonarrec.files.outputs import write_csv, write_text, writing
from sonarrec.geometry import STEEPEST, floor_depth
from sonarrec.landmarks import LandmarkSet
from sonarrec.pipeline.prepared import Used
from sonarrec.pipeline.run import process
from sonarrec.readers.pixels import decode_image
from sonarrec.recogniser.three_stages import FRAMEWORK
from sonarrec.records import ByteImage, Estimate, FrameResult, number_of
from sonarrec.results.run_file import Given
from sonarrec.simulation.background import (
    Background,
    Layout,
    draw_layout,
    truth_of,
    write_backgrounds,
)

RANGE_STEPS = 5
ENOUGH = 0.9
"""Landmarks are recognised at a contrast where they are in this share of the frames with them."""
MIN_VISIBLE = 0.9
LOOKED_AT = 100  # frames among which the one to be shown is chosen
Step = Callable[[str], None]
"""Called after each frame with what is being done."""


@dataclass(frozen=True, slots=True)
class Shown:
    """A frame at one contrast, drawn on: truth dashed, declared landmarks in colour."""

    contrast_db: float
    frame: int
    image: ByteImage
    truth: int
    declared: int


@dataclass(frozen=True, slots=True)
class AtContrast:
    """What came of one contrast.

    near_m, far_m: slant ranges between which landmarks are recognised in ENOUGH of the frames, from
    the nearest step that holds a landmark on; NaN where they are not in that step.
    """

    contrast_db: float
    found: Recognised
    near_m: float
    far_m: float

    @property
    def reaches(self) -> bool:
        """Whether there is such a range."""
        return not math.isnan(self.far_m)

    @property
    def span(self) -> str:
        """The range in words."""
        return f"{self.near_m:.1f} to {self.far_m:.1f} m" if self.reaches else "-"


@dataclass(frozen=True, slots=True)
class Site:
    """What `sonarrec site` found out.

    contrasts: rising. empty: claims per 100 frames on the recording as it is, none of which is
    right if it holds no landmarks. sentences: the answer in words.
    """

    log: str
    frames: int
    landmarks: str
    radius_m: float
    plate_db: float
    beam_width_deg: float
    dynamic_range_db: float
    preset: str
    seed: int
    layouts: tuple[Layout, ...]
    contrasts: tuple[AtContrast, ...]
    empty: float
    sentences: tuple[str, ...]
    shown: tuple[Shown, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Laid:
    """What is the same of every recording that is made, and of its run.

    beam_width_deg: by which the discs are smeared. used: its one Config. keep: keep the images.
    """

    background: Background
    landmarks: LandmarkSet
    plate_db: float
    beam_width_deg: float
    used: Used
    keep: bool


def assess(
    log: Path,
    given: Given,
    out: Path,
    laid: Laid,
    *,
    contrasts: Sequence[float],
    layouts: int,
    count: int | None,
    seed: int,
    step: Step,
) -> Site:
    """Lay, run and score; everything goes into the folder `out`.

    log, given: the recording, which is also run as it is, for the claims on nothing. contrasts:
    dB, rising. layouts: how many times other places are drawn, from `seed` on. count: of the
    landmarks, as in `draw_layout`. Raises SonarrecError where input cannot be used or files cannot
    be written.
    """
    background, landmarks, used = laid.background, laid.landmarks, laid.used
    drawn = [draw_layout(background, landmarks, seed + n, count) for n in range(layouts)]
    claims = 0

    def claimed(result: FrameResult, _: int | None) -> None:
        nonlocal claims
        claims += len(_declared(result))
        step("recording as it is")

    results = out / "results"
    process(log, results, given, used, claimed, name="as_it_is", overwrite=True)
    pairs: dict[float, list[Pair]] = {db: [] for db in contrasts}
    shown: list[Shown] = []
    for number, layout in enumerate(drawn, 1):
        doing = f"layout {number} of {layouts}"
        for db, pair, picture in _run_layout(laid, layout, contrasts, out, number, doing, step):
            pairs[db].append(pair)
            if number == 1:
                shown.append(picture)
    found = _scored(background, pairs)
    return Site(
        log=background.where,
        frames=len(background.path),
        landmarks=landmarks.name,
        radius_m=landmarks.radius_m,
        plate_db=laid.plate_db,
        beam_width_deg=laid.beam_width_deg,
        dynamic_range_db=background.dynamic_range_db,
        preset=used.configs[0].preset,
        seed=seed,
        layouts=tuple(drawn),
        contrasts=tuple(found),
        empty=100 * claims / len(background.path),
        sentences=tuple(sentences(found, claims, len(background.path))),
        shown=tuple(shown),
        notes=(*background.problems, *background.notes),
    )


def _run_layout(
    laid: Laid,
    layout: Layout,
    contrasts: Sequence[float],
    out: Path,
    number: int,
    doing: str,
    step: Step,
) -> Iterator[tuple[float, Pair, Shown]]:
    """Lay one layout at every contrast and run each: contrast, results with truth, a picture."""
    background, landmarks = laid.background, laid.landmarks
    under = out / "recordings" / f"layout_{number}"
    folders = {db: under / f"contrast_{db:g}" for db in contrasts}
    write_backgrounds(
        background,
        layout,
        landmarks,
        folders,
        laid.plate_db,
        laid.beam_width_deg,
        lambda: step(f"{doing}, discs"),
    )
    # Judged by the beams that a run of the recording itself takes.
    configs = [
        replace(c, features=replace(c.features, beam_width_deg=background.beam_width_deg))
        for c in laid.used.configs
    ]
    used = replace(laid.used, configs=configs)
    told = _most_telling(background, layout, landmarks)
    for db, folder in folders.items():
        seen: list[Estimate] = []

        def observe(
            result: FrameResult, _: int | None, db: float = db, seen: list[Estimate] = seen
        ) -> None:
            if result.index == told:
                seen.extend(_declared(result))
            step(f"{doing}, {db:g} dB")

        name = f"layout_{number}_contrast_{db:g}"
        own = Given(sonar_file=folder / "sonar.toml")  # not the geometry of an earlier run
        process(folder, out / "results", own, used, observe, name=name, overwrite=True)
        picture = _picture(background, layout, landmarks, folder, told, db, seen)
        if not laid.keep:
            for image in folder.glob("*.png"):
                image.unlink()
        yield db, Pair(out / "results" / name, folder / "gt.csv"), picture


def _declared(result: FrameResult) -> list[Estimate]:
    return [e for e in result.estimates if e.method == FRAMEWORK and e.declared]


def _scored(background: Background, pairs: dict[float, list[Pair]]) -> list[AtContrast]:
    fan = background.fan
    nearest = max(fan.range_min_m, STEEPEST * floor_depth(fan))
    edges = np.linspace(nearest, fan.range_max_m, RANGE_STEPS + 1).tolist()
    found = []
    for db, rows in pairs.items():
        scored = evaluate_whole(rows, options=ScoringOptions(min_visible=MIN_VISIBLE))
        one = recognised(scored, FRAMEWORK, edges)
        near = far = math.nan
        for each in (r for r in one.by_range if r.tpr.cases):
            if each.tpr.value < ENOUGH:
                break
            near, far = (each.near_m if math.isnan(near) else near), each.far_m
        found.append(AtContrast(db, one, near, far))
    return found


def sentences(found: Sequence[AtContrast], claims: int, frames: int) -> list[str]:
    """The answer: from which contrast on, how far, how sure, and what is claimed falsely."""
    told = []
    good = len(found)
    while good and found[good - 1].found.tpr.value >= ENOUGH:
        good -= 1
    if good < len(found):
        one = found[good]
        rate = one.found.tpr
        more = " or more" if good + 1 < len(found) else ""
        told.append(
            f"At {one.contrast_db:g} dB{more} over the floor landmarks would be recognised in at "
            f"least {ENOUGH:.0%} of the frames that show them whole"
            + (f", {one.span} away." if one.reaches else ", all ranges taken together.")
        )
        if math.isnan(rate.low) and rate.units >= MIN_UNITS:
            one_in = max(round(1 / unseen_share(rate.units)), 2)
            told.append(
                f"That rests on {_passes(rate.units)}, which went alike: if one in {one_in} went "
                "wrong, so few might not show it."
            )
        elif math.isnan(rate.low):
            told.append(
                f"That rests on {_passes(rate.units)}, too few for an interval: more --layouts "
                "would tell."
            )
        elif rate.low < ENOUGH:
            told.append(
                f"That rests on {_passes(rate.units)} and is not certain: the 95% interval of "
                f"{rate.value:.3f} begins at {rate.low:.3f}."
            )
        else:
            told.append(
                f"That rests on {_passes(rate.units)}; the 95% interval of {rate.value:.3f} is "
                f"{rate.low:.3f} to {rate.high:.3f}."
            )
    else:
        best = max(found, key=lambda one: one.found.tpr.value)
        told.append(
            f"At none of these contrasts would landmarks be recognised in {ENOUGH:.0%} of the "
            f"frames that show them whole; at best in {best.found.tpr.value:.1%}, at "
            f"{best.contrast_db:g} dB."
        )
        near = [one for one in found if one.reaches]
        if near:
            told.append(f"From {near[0].span} they would be, at {near[0].contrast_db:g} dB.")
    worst = max(found, key=lambda one: one.found.false_per_100.value)
    false = worst.found.false_per_100
    told.append(
        f"False claims: at most {false.value:.1f} in 100 frames, at {worst.contrast_db:g} dB."
        if false.count
        else "No false claim was made."
    )
    if claims:
        told.append(
            f"On the recording as it is {100 * claims / frames:.1f} landmarks are claimed in 100 "
            "frames: if it holds none, these are false as well; if it holds some, the figures "
            "here mean little."
        )
    return told


def _passes(count: int) -> str:
    return number_of(count, "pass", "es") + " of landmarks through the view"


def _most_telling(background: Background, layout: Layout, landmarks: LandmarkSet) -> int:
    """The frame, of LOOKED_AT, that shows the most landmarks whole; the last of several."""
    frames = len(background.path)
    # Late in the recording: the recogniser needs some frames first.
    tried = np.unique(np.linspace(min(10, frames - 1), frames - 1, LOOKED_AT).astype(int)).tolist()

    def whole(frame: int) -> int:
        rows = truth_of(background, layout, landmarks, frame)
        return sum(row.visible >= MIN_VISIBLE for row in rows)

    return int(max(tried, key=lambda frame: (whole(frame), frame)))


def _picture(
    background: Background,
    layout: Layout,
    landmarks: LandmarkSet,
    folder: Path,
    frame: int,
    contrast_db: float,
    declared: Sequence[Estimate],
) -> Shown:
    image = decode_image((folder / f"{frame:06d}.png").read_bytes())
    rows = truth_of(background, layout, landmarks, frame)
    marks = [Mark(row.landmark, row.x_px, row.y_px) for row in rows]
    drawn = draw_frame(
        np.asarray(image, np.uint8), background.fan, landmarks, declared, truth=marks, score=True
    )
    return Shown(contrast_db, frame, drawn, len(marks), len(declared))


COLUMNS = (
    *("contrast_db", "range_from_m", "range_to_m", "landmark_frames", "passes", "recognised"),
    *("tpr", "tpr_low", "tpr_high", "frames", "false_claims", "false_per_100"),
    *("false_per_100_low", "false_per_100_high"),
)


def table(site: Site) -> list[dict[str, Any]]:
    """A row per contrast over all ranges (their columns empty), then one per step of range."""
    rows: list[dict[str, Any]] = []
    for one in site.contrasts:
        false = one.found.false_per_100
        steps = [(None, None, one.found.tpr)]
        steps += [(r.near_m, r.far_m, r.tpr) for r in one.found.by_range]  # type: ignore[misc]
        for near, far, rate in steps:
            row = dict.fromkeys(COLUMNS) | {
                "contrast_db": one.contrast_db,
                "range_from_m": _rounded(near),
                "range_to_m": _rounded(far),
                "landmark_frames": rate.cases,
                "passes": rate.units,
                "recognised": rate.count,
                **_three("tpr", rate),
            }
            if near is None:
                row |= {"frames": false.cases, "false_claims": false.count}
                row |= _three("false_per_100", false)
            rows.append(row)
    return rows


def _three(name: str, rate: Rate) -> dict[str, float | None]:
    return {
        name: _rounded(rate.value),
        f"{name}_low": _rounded(rate.low),
        f"{name}_high": _rounded(rate.high),
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else round(value, 4)


def as_document(site: Site) -> dict[str, Any]:
    """All figures and what they rest on, as plain values."""
    stated = (
        *("log", "frames", "landmarks", "radius_m", "plate_db", "beam_width_deg"),
        *("dynamic_range_db", "preset", "seed"),
    )
    return {
        **{name: getattr(site, name) for name in stated},
        "layouts": [{"seed": one.seed, "landmarks": one.landmarks} for one in site.layouts],
        "claims_per_100_as_it_is": round(site.empty, 4),
        "summary": list(site.sentences),
        "notes": list(site.notes),
        "contrasts": [
            {
                "contrast_db": one.contrast_db,
                "recognised_from_m": _rounded(one.near_m),
                "recognised_to_m": _rounded(one.far_m),
            }
            for one in site.contrasts
        ],
        "rates": table(site),
    }


def write_site(out: Path, site: Site, page: str) -> None:
    """site.html, site.csv and site.json. Raises SonarrecError where they cannot be written."""
    with writing(out):
        write_csv(out / "site.csv", COLUMNS, (row.values() for row in table(site)))
        text = json.dumps(as_document(site), indent=2, ensure_ascii=False)
        write_text(out / "site.json", text + "\n")
        write_text(out / "site.html", page)
