"""`sonarrec site`: would landmarks be recognised at the site of a recording, and at which range?

Landmarks are laid into the recording at several contrasts, each time at the same positions. Each
recording made like this is run and scored.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sonarrec.drawing.results import Mark, draw_frame
from sonarrec.evaluation.by_range import recognition_rates
from sonarrec.evaluation.evaluate import evaluate_whole
from sonarrec.evaluation.matching.options import ScoringOptions
from sonarrec.evaluation.matching.pairs import Pair
from sonarrec.geometry import STEEPEST, floor_depth
from sonarrec.landmarks import LandmarkSet
from sonarrec.pipeline.prepare import RunOptions
from sonarrec.pipeline.run import process
from sonarrec.readers.pixels import decode_image
from sonarrec.recogniser.three_stages import FRAMEWORK
from sonarrec.records import Estimate, FrameResult
from sonarrec.report.site_results import ENOUGH, ContrastResults, ExampleFrame, Site, sentences
from sonarrec.results.run_file import LogOptions
from sonarrec.simulation.background import (
    Background,
    Layout,
    draw_layout,
    truth_of,
    write_backgrounds,
)

RANGE_STEPS = 5
MIN_VISIBLE = 0.9
LOOKED_AT = 100  # frames; one of them is shown
Step = Callable[[str], None]
"""Called after each frame with what is being done."""


@dataclass(frozen=True, slots=True)
class SiteSetup:
    """What all recordings and their runs have in common.

    beam_width_deg: by which the discs are smeared. run_options: with one Config.
    keep: whether the images stay.
    """

    background: Background
    landmarks: LandmarkSet
    plate_db: float
    beam_width_deg: float
    run_options: RunOptions
    keep: bool


def assess(
    log: Path,
    log_options: LogOptions,
    out: Path,
    setup: SiteSetup,
    *,
    contrasts: Sequence[float],
    layouts: int,
    count: int | None,
    seed: int,
    step: Step,
) -> Site:
    """Lay, run and score; everything is written into the folder `out`.

    log, log_options: the recording; it is also run unchanged, to count claims without landmarks.
    contrasts: dB, rising. layouts: number of layouts, with seeds from `seed` on. count: of the
    landmarks, as in `draw_layout`. Raises SonarrecError if input cannot be used or files cannot be
    written.
    """
    background, landmarks, run_options = setup.background, setup.landmarks, setup.run_options
    drawn = [draw_layout(background, landmarks, seed + n, count) for n in range(layouts)]
    claims = 0

    def claimed(result: FrameResult, _: int | None) -> None:
        nonlocal claims
        claims += len(_declared(result))
        step("recording as it is")

    results = out / "results"
    process(log, results, log_options, run_options, claimed, name="as_it_is", overwrite=True)
    pairs: dict[float, list[Pair]] = {db: [] for db in contrasts}
    shown: list[ExampleFrame] = []
    for number, layout in enumerate(drawn, 1):
        doing = f"layout {number} of {layouts}"
        for db, pair, picture in _run_layout(setup, layout, contrasts, out, number, doing, step):
            pairs[db].append(pair)
            if number == 1:
                shown.append(picture)
    found = _scored(background, pairs)
    return Site(
        log=background.where,
        frames=len(background.path),
        landmarks=landmarks.name,
        radius_m=landmarks.radius_m,
        plate_db=setup.plate_db,
        beam_width_deg=setup.beam_width_deg,
        dynamic_range_db=background.dynamic_range_db,
        preset=run_options.configs[0].preset,
        seed=seed,
        layouts=tuple(drawn),
        contrasts=tuple(found),
        empty=100 * claims / len(background.path),
        sentences=tuple(sentences(found, claims, len(background.path))),
        shown=tuple(shown),
        notes=(*background.problems, *background.notes),
    )


def _run_layout(
    setup: SiteSetup,
    layout: Layout,
    contrasts: Sequence[float],
    out: Path,
    number: int,
    doing: str,
    step: Step,
) -> Iterator[tuple[float, Pair, ExampleFrame]]:
    """Lay one layout at every contrast and run each: (contrast, results with truth, picture)."""
    background, landmarks = setup.background, setup.landmarks
    under = out / "recordings" / f"layout_{number}"
    folders = {db: under / f"contrast_{db:g}" for db in contrasts}
    write_backgrounds(
        background,
        layout,
        landmarks,
        folders,
        setup.plate_db,
        setup.beam_width_deg,
        lambda: step(f"{doing}, discs"),
    )
    # The beam width is that of a run of the recording itself.
    configs = [
        replace(c, features=replace(c.features, beam_width_deg=background.beam_width_deg))
        for c in setup.run_options.configs
    ]
    run_options = replace(setup.run_options, configs=configs)
    shown_frame = _most_landmarks(background, layout, landmarks)
    for db, folder in folders.items():
        seen: list[Estimate] = []

        def observe(
            result: FrameResult, _: int | None, db: float = db, seen: list[Estimate] = seen
        ) -> None:
            if result.index == shown_frame:
                seen.extend(_declared(result))
            step(f"{doing}, {db:g} dB")

        name = f"layout_{number}_contrast_{db:g}"
        own = LogOptions(sonar_file=folder / "sonar.toml")  # not the geometry of an earlier run
        process(folder, out / "results", own, run_options, observe, name=name, overwrite=True)
        picture = _picture(background, layout, landmarks, folder, shown_frame, db, seen)
        if not setup.keep:
            for image in folder.glob("*.png"):
                image.unlink()
        yield db, Pair(out / "results" / name, folder / "gt.csv"), picture


def _declared(result: FrameResult) -> list[Estimate]:
    return [e for e in result.estimates if e.method == FRAMEWORK and e.declared]


def _scored(background: Background, pairs: dict[float, list[Pair]]) -> list[ContrastResults]:
    fan = background.fan
    nearest = max(fan.range_min_m, STEEPEST * floor_depth(fan))
    edges = np.linspace(nearest, fan.range_max_m, RANGE_STEPS + 1).tolist()
    found = []
    for db, rows in pairs.items():
        scored = evaluate_whole(rows, options=ScoringOptions(min_visible=MIN_VISIBLE))
        one = recognition_rates(scored, FRAMEWORK, edges)
        near = far = math.nan
        for each in (r for r in one.by_range if r.tpr.cases):
            if each.tpr.value < ENOUGH:
                break
            near, far = (each.near_m if math.isnan(near) else near), each.far_m
        found.append(ContrastResults(db, one, near, far))
    return found


def _most_landmarks(background: Background, layout: Layout, landmarks: LandmarkSet) -> int:
    """The frame, of LOOKED_AT, that shows the most whole landmarks; of several the last."""
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
) -> ExampleFrame:
    image = decode_image((folder / f"{frame:06d}.png").read_bytes())
    rows = truth_of(background, layout, landmarks, frame)
    marks = [Mark(row.landmark, row.x_px, row.y_px) for row in rows]
    drawn = draw_frame(
        np.asarray(image, np.uint8), background.fan, landmarks, declared, truth=marks, score=True
    )
    return ExampleFrame(contrast_db, frame, drawn, len(marks), len(declared))
