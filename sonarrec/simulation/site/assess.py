"""`sonarrec site`: would landmarks be recognised at the site of a recording, and at which range?

Landmarks are laid into the recording at several contrasts, each time at the same positions. Each
recording made like this is run and scored.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np

from sonarrec.drawing.results import Mark, draw_frame
from sonarrec.evaluation.match import match
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Estimate, Fan, FrameResult
from sonarrec.readers.decode.pixels import decode_image
from sonarrec.recogniser.three_stages import FRAMEWORK
from sonarrec.results.read import read_log
from sonarrec.results.run_file import LogOptions
from sonarrec.runs.one import process
from sonarrec.runs.prepare import RunOptions
from sonarrec.simulation.background import Background, nearest_floor_m
from sonarrec.simulation.background_files import DiscLook, write_backgrounds
from sonarrec.simulation.layout import Layout, draw_layout, truth_of, without_room
from sonarrec.simulation.site.results import (
    ENOUGH,
    ContrastResults,
    ExampleFrame,
    Site,
    recognition_rates,
    sentences,
)
from sonarrec.truth.match import match_truth
from sonarrec.truth.table import read_truth

RANGE_STEPS = 5  # into which the range window is divided
MIN_VISIBLE = 0.9  # share of a disc that must be in view for a landmark to count
FRAMES_TRIED = 100  # for the example that is drawn
Step = Callable[[str], None]  # called after each frame with what is being done


def assess(
    log: Path,
    log_options: LogOptions,
    out: Path,
    background: Background,
    landmarks: LandmarkSet,
    look: DiscLook,
    run_options: RunOptions,
    *,
    contrasts: Sequence[float],
    layouts: int,
    count: int | None,
    seed: int,
    keep: bool,
    step: Step,
) -> Site:
    """Lay, run and score; everything is written into the folder `out`.

    log, log_options: the recording; it is also run unchanged, to count claims without landmarks.
    run_options: with one Config. contrasts: dB, rising. layouts: number of layouts, with seeds from
    `seed` on. count: of the landmarks, as in `draw_layout`. keep: whether the images stay. Raises
    SonarrecError if input cannot be used or files cannot be written.
    """
    drawn = [draw_layout(background, landmarks, seed + n, count) for n in range(layouts)]
    as_it_is = out / "results" / "as_it_is"
    claims, _ = _run(log, as_it_is, log_options, run_options, partial(step, "recording as it is"))
    # The beam width is that of a run of the recording without discs.
    (config,), beam_width_deg = run_options.configs, background.beam_width_deg
    features = replace(config.features, beam_width_deg=beam_width_deg)
    own_options = replace(run_options, configs=[replace(config, features=features)])
    pairs: dict[float, list[tuple[Path, Path]]] = {db: [] for db in contrasts}
    examples: list[ExampleFrame] = []
    for number, layout in enumerate(drawn, 1):
        doing = f"layout {number} of {layouts}, "
        recordings = out / "recordings" / f"layout_{number}"
        folders = {db: recordings / f"contrast_{db:g}" for db in contrasts}
        write_backgrounds(background, layout, look, folders, partial(step, f"{doing}discs"))
        frame = _most_landmarks(background, layout)
        for db, folder in folders.items():
            results = out / "results" / f"layout_{number}_contrast_{db:g}"
            own = LogOptions(sonar_file=folder / "sonar.toml")  # not the geometry of an earlier run
            each = partial(step, f"{doing}{db:g} dB")
            _, declared = _run(folder, results, own, own_options, each, frame)
            if number == 1:
                examples.append(_example(background, layout, folder, frame, db, declared))
            if not keep:
                for image in folder.glob("*.png"):
                    image.unlink()
            pairs[db].append((results, folder / "gt.csv"))
    scored = tuple(_scored(background.fan, db, runs) for db, runs in pairs.items())
    frames = len(background.path)
    background.diagnostics.notes += without_room(drawn, count)
    return Site(
        about={
            "log": background.where,
            "frames": frames,
            "landmarks": landmarks.name,
            "radius_m": landmarks.radius_m,
            **asdict(look),
            "dynamic_range_db": background.dynamic_range_db,
            "preset": config.preset,
            "seed": seed,
        },
        layouts=tuple(drawn),
        contrasts=scored,
        empty=100 * claims / frames,
        sentences=tuple(sentences(scored, claims, frames)),
        shown=tuple(examples),
        diagnostics=background.diagnostics,
    )


def _run(
    log: Path,
    results: Path,
    log_options: LogOptions,
    run_options: RunOptions,
    step: Callable[[], None],
    frame: int = -1,
) -> tuple[int, list[Estimate]]:
    """Run a recording; how many IDs are declared in it, and those of one frame."""
    count, of_frame = 0, list[Estimate]()

    def observe(result: FrameResult, _: int | None) -> None:
        nonlocal count
        declared = [e for e in result.estimates if e.method == FRAMEWORK and e.declared]
        count += len(declared)
        of_frame.extend(declared if result.index == frame else ())
        step()

    process(
        log, results.parent, log_options, run_options, observe, name=results.name, overwrite=True
    )
    return count, of_frame


def _scored(fan: Fan, contrast_db: float, runs: Sequence[tuple[Path, Path]]) -> ContrastResults:
    """Score runs (results, truth) at one contrast, over RANGE_STEPS parts of the floor in view."""
    edges = np.linspace(nearest_floor_m(fan), fan.range_max_m, RANGE_STEPS + 1).tolist()
    logs = []
    for results, ground_truth in runs:
        log = read_log(results)
        logs.append(match(log, match_truth(read_truth(ground_truth), log), MIN_VISIBLE))
    rates = recognition_rates(logs, FRAMEWORK, edges)
    near = far = math.nan
    for step in (r for r in rates.by_range if r.tpr.cases):
        if step.tpr.value < ENOUGH:
            break
        near, far = (step.near_m if math.isnan(near) else near), step.far_m
    return ContrastResults(contrast_db, rates, near, far)


def _most_landmarks(background: Background, layout: Layout) -> int:
    """The frame, of FRAMES_TRIED, that shows the most whole landmarks; of several the last."""
    frames = len(background.path)
    # Late in the recording: the recogniser needs some frames first.
    tried = np.linspace(min(10, frames - 1), frames - 1, FRAMES_TRIED).astype(int)

    def whole(frame: int) -> int:
        return sum(row.visible >= MIN_VISIBLE for row in truth_of(background, layout, frame))

    return int(max(set(tried.tolist()), key=lambda frame: (whole(frame), frame)))


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
    pixels = np.asarray(image, np.uint8)
    drawn = draw_frame(pixels, background.fan, layout.landmarks, declared, truth=marks, score=True)
    return ExampleFrame(contrast_db, frame, drawn, len(marks), len(declared))
