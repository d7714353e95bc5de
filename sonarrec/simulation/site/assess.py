"""`sonarrec site`: would landmarks be recognised at the site of a recording, and at which range?

Landmarks are laid into the recording at several contrasts, each time at the same positions. Each
recording made like this is run and scored.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from sonarrec.drawing.results import Mark, draw_frame
from sonarrec.evaluation.by_range import recognition_rates
from sonarrec.evaluation.evaluate import evaluate_whole
from sonarrec.evaluation.matching.options import ScoringOptions
from sonarrec.evaluation.matching.pairs import Pair
from sonarrec.geometry import STEEPEST, floor_depth
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Estimate, FrameResult
from sonarrec.pipeline.prepare import RunOptions
from sonarrec.pipeline.run import process
from sonarrec.readers.pixels import decode_image
from sonarrec.recogniser.three_stages import FRAMEWORK
from sonarrec.results.run_file import LogOptions
from sonarrec.simulation.background import (
    Background,
    DiscLook,
    Layout,
    draw_layout,
    truth_of,
    without_room,
)
from sonarrec.simulation.background_files import write_backgrounds
from sonarrec.simulation.site.results import ENOUGH, ContrastResults, ExampleFrame, Site, sentences

RANGE_STEPS = 5  # into which the range window is divided
MIN_VISIBLE = 0.9  # share of a disc that must be in view for a landmark to count
FRAMES_TRIED = 100  # for the example that is drawn
Step = Callable[[str], None]
"""Called after each frame with what is being done."""


@dataclass(frozen=True, slots=True)
class SiteSetup:
    """What all recordings and their runs have in common.

    look: of the discs. run_options: with one Config. keep: whether the images stay.
    """

    background: Background
    landmarks: LandmarkSet
    look: DiscLook
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
    claims = _claims_as_it_is(log, log_options, out / "results", run_options, step)
    pairs: dict[float, list[Pair]] = {db: [] for db in contrasts}
    examples: list[ExampleFrame] = []
    for number, layout in enumerate(drawn, 1):

        def step_here(doing: str, number: int = number) -> None:
            step(f"layout {number} of {layouts}, {doing}")

        for db, pair, example in _run_layout(setup, layout, contrasts, out, number, step_here):
            pairs[db].append(pair)
            if number == 1:
                examples.append(example)
    results = _scored(background, pairs)
    return Site(
        log=background.where,
        frames=len(background.path),
        landmarks=landmarks.name,
        radius_m=landmarks.radius_m,
        plate_db=setup.look.plate_db,
        beam_width_deg=setup.look.beam_width_deg,
        dynamic_range_db=background.dynamic_range_db,
        preset=run_options.configs[0].preset,
        seed=seed,
        layouts=tuple(drawn),
        contrasts=tuple(results),
        empty=100 * claims / len(background.path),
        sentences=tuple(sentences(results, claims, len(background.path))),
        shown=tuple(examples),
        problems=tuple(background.problems),
        notes=(*background.notes, *without_room(drawn, count)),
    )


def _claims_as_it_is(
    log: Path, log_options: LogOptions, results: Path, run_options: RunOptions, step: Step
) -> int:
    """Run the recording unchanged, and count the IDs that are declared though there are none."""
    claims = 0

    def observe(result: FrameResult, _: int | None) -> None:
        nonlocal claims
        claims += len(_declared(result))
        step("recording as it is")

    process(log, results, log_options, run_options, observe, name="as_it_is", overwrite=True)
    return claims


def _run_layout(
    setup: SiteSetup,
    layout: Layout,
    contrasts: Sequence[float],
    out: Path,
    number: int,
    step: Step,
) -> Iterator[tuple[float, Pair, ExampleFrame]]:
    """Lay one layout into the recording at every contrast, and run each.

    number: of the layout, in the names of folders.
    Yields (contrast in dB, results with truth, example).
    """
    background, recordings = setup.background, out / "recordings" / f"layout_{number}"
    folders = {db: recordings / f"contrast_{db:g}" for db in contrasts}
    write_backgrounds(background, layout, setup.look, folders, lambda: step("discs"))
    frame = _most_landmarks(background, layout)
    for db, folder in folders.items():
        results = out / "results" / f"layout_{number}_contrast_{db:g}"
        declared = _declared_in(frame, folder, results, setup, partial(step, f"{db:g} dB"))
        example = _example(background, layout, folder, frame, db, declared)
        if not setup.keep:
            for image in folder.glob("*.png"):
                image.unlink()
        yield db, Pair(results, folder / "gt.csv"), example


def _declared_in(
    frame: int, recording: Path, results: Path, setup: SiteSetup, step: Callable[[], None]
) -> list[Estimate]:
    """Run a recording with discs; what is declared in one of its frames."""
    # The beam width is that of a run of the recording without discs.
    beam_width_deg = setup.background.beam_width_deg
    configs = [
        replace(c, features=replace(c.features, beam_width_deg=beam_width_deg))
        for c in setup.run_options.configs
    ]
    run_options = replace(setup.run_options, configs=configs)
    declared: list[Estimate] = []

    def observe(result: FrameResult, _: int | None) -> None:
        if result.index == frame:
            declared.extend(_declared(result))
        step()

    own = LogOptions(sonar_file=recording / "sonar.toml")  # not the geometry of an earlier run
    process(recording, results.parent, own, run_options, observe, name=results.name, overwrite=True)
    return declared


def _declared(result: FrameResult) -> list[Estimate]:
    return [e for e in result.estimates if e.method == FRAMEWORK and e.declared]


def _scored(background: Background, pairs: dict[float, list[Pair]]) -> list[ContrastResults]:
    """Score the runs at each contrast (dB), over RANGE_STEPS equal parts of the floor in view."""
    fan = background.fan
    nearest = max(fan.range_min_m, STEEPEST * floor_depth(fan))
    edges = np.linspace(nearest, fan.range_max_m, RANGE_STEPS + 1).tolist()
    results = []
    for db, runs in pairs.items():
        scored = evaluate_whole(runs, options=ScoringOptions(min_visible=MIN_VISIBLE))
        rates = recognition_rates(scored, FRAMEWORK, edges)
        near = far = math.nan
        for step in (r for r in rates.by_range if r.tpr.cases):
            if step.tpr.value < ENOUGH:
                break
            near, far = (step.near_m if math.isnan(near) else near), step.far_m
        results.append(ContrastResults(db, rates, near, far))
    return results


def _most_landmarks(background: Background, layout: Layout) -> int:
    """The frame, of FRAMES_TRIED, that shows the most whole landmarks; of several the last."""
    frames = len(background.path)
    # Late in the recording: the recogniser needs some frames first.
    tried = np.unique(
        np.linspace(min(10, frames - 1), frames - 1, FRAMES_TRIED).astype(int)
    ).tolist()

    def whole(frame: int) -> int:
        rows = truth_of(background, layout, frame)
        return sum(row.visible >= MIN_VISIBLE for row in rows)

    return int(max(tried, key=lambda frame: (whole(frame), frame)))


def _example(
    background: Background,
    layout: Layout,
    folder: Path,
    frame: int,
    contrast_db: float,
    declared: Sequence[Estimate],
) -> ExampleFrame:
    image = decode_image((folder / f"{frame:06d}.png").read_bytes())
    rows = truth_of(background, layout, frame)
    marks = [Mark(row.landmark, row.x_px, row.y_px) for row in rows]
    drawn = draw_frame(
        np.asarray(image, np.uint8),
        background.fan,
        layout.landmarks,
        declared,
        truth=marks,
        score=True,
    )
    return ExampleFrame(contrast_db, frame, drawn, len(marks), len(declared))
