"""`make study`: the paper's experiment, many times over, so that what holds is told from chance.

Every sequence is the paper's scene with other places and rotations of all that lies on the floor,
another start of the pan, and another draw of all that is random. A sequence is one case: intervals
are bootstrapped over sequences, and the tests swap two methods in whole sequences.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.config import preset
from sonarrec.errors import SonarrecError
from sonarrec.evaluation.curves import PUBLISHED
from sonarrec.evaluation.intervals import LEVEL
from sonarrec.evaluation.summary import Summary, summarise
from sonarrec.evaluation.tables import Evaluation
from sonarrec.evaluation.write import write_evaluation
from sonarrec.simulation.objects import object_radius
from sonarrec.simulation.scene import PlacedLandmark, PlacedObject, Scene, load_scene
from tests.studies.results.record import options, save, show
from tests.studies.scenes import told
from tests.support.simulated import (
    METHODS,
    PRESETS,
    WHOLE,
    HoughRival,
    Job,
    in_processes,
    recognise,
    score,
)

STUDIED = range(4000, 4030)
"""Seeds of the sequences; nothing is learned or chosen on them."""
APART_M = 0.05
"""Least floor between two things."""
TRIES = 1000
FIGURES = {
    "tpr": ("TPR", ".3f"),
    "fpr": ("FPR", ".4f"),
    "tpr_at_fpr_0.0276": ("TPR at FPR .0276", ".3f"),
    "frames_to_id_median": ("frames to ID", ".0f"),
    "frames_to_id_90": ("90 %", ".0f"),
}
TESTED = ("tpr", "fpr", "tpr_at_fpr_0.0276")
# The paper's own question first; then ours against what there is.
PAIRS = (
    ("smi:paper", "paper"),
    ("smi:default", "default"),
    ("hough", "default"),
    ("paper", "default"),
    ("default", "offline"),
)


def varied(scene: Scene, seed: int) -> Scene:
    """The scene with its landmarks and objects elsewhere and turned, and another seed.

    Landmarks stay within the ground ranges that the scene's own ones span, objects within those
    of all things, and all within the pan; none touches another. Walls stay where they are.
    Raises SonarrecError where there is no room.
    """
    rng = np.random.default_rng([seed, 0])
    motion = scene.motion
    objects = [t for t in scene.objects if t.kind != "wall"]
    things: list[PlacedLandmark | PlacedObject] = [*scene.landmarks, *objects]
    ground = np.array([t.ground_m for t in things])
    count = len(scene.landmarks)
    low = np.full(len(things), ground.min())
    high = np.full(len(things), ground.max())
    low[:count], high[:count] = ground[:count].min(), ground[:count].max()
    radius = np.array(
        [scene.landmark_set.radius_m] * count + [object_radius(scene, t) for t in objects]
    )
    for _ in range(TRIES):
        ground = rng.uniform(low, high).round(3)
        azimuth = rng.uniform(motion.pan_min_deg, motion.pan_max_deg, len(things)).round(2)
        if (gaps(ground, azimuth, radius) > APART_M).all():
            break
    else:
        raise SonarrecError(f"{scene.name}: no room for its things to lie elsewhere")
    turn = rng.uniform(0, 360, len(things)).round(1)
    new = [
        replace(thing, ground_m=g, azimuth_deg=a, orientation_deg=t)
        for thing, g, a, t in zip(
            things, ground.tolist(), azimuth.tolist(), turn.tolist(), strict=True
        )
    ]
    start = round(rng.uniform(motion.pan_min_deg, motion.pan_max_deg), 1)
    return replace(
        scene,
        name=f"{scene.name}_{seed}",
        seed=seed,
        motion=replace(motion, pan_start_deg=start),
        landmarks=tuple(new[:count]),
        objects=(*new[count:], *(t for t in scene.objects if t.kind == "wall")),
    )


def gaps(ground_m: FloatArray, azimuth_deg: FloatArray, radius_m: FloatArray) -> FloatArray:
    """(pairs,) metres of floor between things, each taken for the circle around it."""
    place = ground_m * np.exp(1j * np.radians(azimuth_deg))
    first, second = np.triu_indices(len(place), 1)
    return np.abs(place[first] - place[second]) - radius_m[first] - radius_m[second]


def show_figures(summary: Summary, protocol: str) -> None:
    """Every method's figures with their intervals."""
    lines = []
    for name, method in METHODS.items():
        line = {"method": name}
        for figure, (column, form) in FIGURES.items():
            found = summary.figure(protocol, method, figure)
            if found is None:
                continue
            line[column] = told(found.value, form)
            if not math.isnan(found.low):
                line[column] += f" ({told(found.low, form)}-{told(found.high, form)})"
        lines.append(line)
    show(f"protocol {protocol}; {LEVEL:.0%} intervals over sequences", lines)


def show_tests(summary: Summary, protocol: str) -> None:
    """What tells the methods of PAIRS apart."""
    lines = []
    for a, b in PAIRS:
        line = {"": f"{b} less {a}"}
        for figure in TESTED:
            column, form = FIGURES[figure]
            # The evaluation has each pair once, in its own order.
            for d in summary.differences:
                if (d.protocol, d.name, {d.a, d.b}) == (protocol, figure, {METHODS[a], METHODS[b]}):
                    sign = 1 if d.b == METHODS[b] else -1
                    line[column] = f"{told(sign * d.value, '+' + form)}, p = {told(d.p, '.2g')}"
        lines.append(line)
    show(f"protocol {protocol}; differences, paired sign-flip test over sequences", lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, recognise, score and tell."""
    scene = load_scene("paper")
    asked = options("study", __doc__, STUDIED, scene.frames).parse_args(arguments)
    begun = time.monotonic()
    configs = [preset(name) for name in PRESETS]
    scene = replace(scene, frames=asked.frames)
    jobs = [
        Job(varied(scene, s), asked.out / "logs" / f"{scene.name}_{s}", configs, (HoughRival,))
        for s in asked.seeds
    ]
    in_processes(recognise, jobs)
    folders = tuple(job.folder for job in jobs)
    counts = score(folders)
    summary = summarise(counts, "log")
    files = write_evaluation(asked.out, Evaluation(counts, summary, WHOLE, folders, (), ()))
    print(
        f"{len(jobs)} sequences of {asked.frames} frames (seeds {asked.seeds.start} to "
        f"{asked.seeds.stop - 1}), {len(counts.passes.unit)} passes of landmarks"
    )
    for protocol in ("strict", "paper"):
        show_figures(summary, protocol)
    show_tests(summary, "strict")
    show_tests(summary, "paper")
    published = "; ".join(f"{name} {tpr:.3f} / {fpr:.4f}" for name, fpr, tpr in PUBLISHED)
    print(f"\nPublished, one sequence, protocol paper, TPR / FPR: {published}")
    for note in summary.notes:
        print(f"note: {note}")
    save(asked.record)
    minutes = (time.monotonic() - begun) / 60
    print(f"\n{asked.out}: {', '.join(files)}; {minutes:.1f} minutes")


if __name__ == "__main__":
    main()
