"""`make ablation`: the default with one of its ideas at a time put back to the simpler way."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

import numpy as np

from sonarrec.config import preset, with_assignments
from sonarrec.evaluation.count import Counts
from sonarrec.evaluation.curves import tpr_at
from sonarrec.recogniser.plane import FloorPlane
from sonarrec.recogniser.stage1 import RingScore, ScoreMaps
from sonarrec.recogniser.stage3.expected_symbol import expected_symbols
from sonarrec.recogniser.three_stages import FRAMEWORK
from sonarrec.simulation.render import render
from tests.studies.learning.other_worlds import OTHER_WORLDS
from tests.studies.learning.random_scenes import ALL_KINDS, KINDS_OF_SCENE, random_scene
from tests.studies.measured import errors
from tests.studies.results.record import options, save, show
from tests.studies.scenes import FRAMES, REPORTED, told
from tests.support.simulated import Job, in_processes, recognise, score

WORLDS = {"The pool": (KINDS_OF_SCENE, REPORTED[:4]), "Other worlds": (OTHER_WORLDS, REPORTED[:2])}
"""Kinds of scene and seeds of each table."""
EQUAL_FPR = (0.002, 0.01)
"""Where TPRs are read off the curves, for another measurement may want another threshold."""


@dataclass(frozen=True, slots=True)
class Ablation:
    """What stands in place of an idea.

    settings: `stage.key=value` over those of the preset. code: by dotted name within
    sonarrec.recogniser, what stands in the code's place; of ideas that have no setting.
    """

    settings: tuple[str, ...] = ()
    code: Mapping[str, object] = field(default_factory=dict)
    preset: str = "default"

    def __str__(self) -> str:
        code = (f"{name}={getattr(v, '__name__', v)}" for name, v in self.code.items())
        return " ".join([*self.settings, *code])


def spread_of_the_frame(self: RingScore, _: object, relief: np.ndarray, sigma: float) -> ScoreMaps:
    """`RingScore.__call__` with contrast counted in what the whole frame varies by."""
    score = self._correlate(relief) * self._gain / np.float32(sigma)
    return ScoreMaps(score, score, score, np.full((1, 1), sigma, np.float32))


def straight_ahead(_: FloorPlane, position: np.ndarray) -> np.ndarray:
    """`line_of_sight` that is the same everywhere: angles count from straight ahead."""
    return np.full(len(position), np.pi / 2)


_STAGE1, _STAGE3 = "stage1", "stage3"
ABLATIONS = {
    "the default": Ablation(),
    "circles in the fan, Eq. 1": Ablation(("candidates.plane=fan",)),
    "edges, not rings": Ablation(("candidates.detector=edge",)),
    "the gap counts no more than the floor": Ablation(code={f"{_STAGE1}.GAP_SHARE": 0.5}),
    "contrast in the whole frame's spread": Ablation(
        code={f"{_STAGE1}.RingScore.__call__": spread_of_the_frame}
    ),
    "random walk, no measured motion": Ablation(("continuity.motion=random_walk",)),
    "the pan alone is measured": Ablation(
        code={"motion.image_motion.SET_OUT": np.inf, "motion.image_motion.LEAST_SEARCHED": 2.0}
    ),
    "no memory of lost objects": Ablation(("continuity.remember_frames=0",)),
    "lost objects taken up half a diameter off": Ablation(
        ("continuity.recall=0.5", "continuity.recall_in_view=0")
    ),
    "what returns counts at once as what it was": Ablation(
        code={
            f"{_STAGE3}.track_matrix.AT_ONCE_CORRELATION": -2.0,
            f"{_STAGE3}.track_matrix.OLD_SHARE": 1.0,
        }
    ),
    "groups leave their own candidate for another's": Ablation(("continuity.own_candidate=2",)),
    "groups begin and walk as wide as the paper's": Ablation(("continuity.sigma_known_px=10",)),
    "each frame by itself": Ablation(("features.measurement=single",)),
    "memory of one frame": Ablation(("features.memory_frames=1",)),
    "angles from straight ahead, not the line of sight": Ablation(
        code={"plane.FloorPlane.line_of_sight": straight_ahead}
    ),
    "cells of a symbol taken for independent": Ablation(("features.alike_radii=0",)),
    "discs taken for evenly lit": Ablation(
        code={f"{_STAGE3}.expected_symbol.ILLUMINATION_SHARE": 0.0}
    ),
    "symbols as drawn, not as the beam smears them": Ablation(("features.beam_width_deg=0.01",)),
    "each frame's belief, not the pool of the track's": Ablation(
        code={f"{_STAGE3}.opinions.FRAME_EXPONENT": 1.0, f"{_STAGE3}.opinions.TRACK_EXPONENT": 0.0}
    ),
    "declared from the first frame, however few beams": Ablation(
        code={
            f"{_STAGE3}.appearance.LEAST_FRAMES": 1,
            f"{_STAGE3}.appearance.FRAMES_OF_FEW_BEAMS": 1,
        }
    ),
    "offline": Ablation(preset="offline"),
    "offline, spread though most frames disagree": Ablation(
        code={"presets.hindsight.LEAST_MEAN_BELIEF": 0.0}, preset="offline"
    ),
}


@dataclass(frozen=True, slots=True)
class Trial:
    """One recording and what is to recognise it. folders: of each ablation's results."""

    kind: str
    seed: int
    frames: int
    folders: Mapping[Path, Ablation]


def recognise_trial(trial: Trial) -> None:
    """The recording is rendered once for all."""
    scene = random_scene(trial.seed, trial.kind, frames=trial.frames)
    frames = list(render(scene))
    for folder, ablation in trial.folders.items():
        config = with_assignments(preset(ablation.preset), ablation.settings)
        expected_symbols.cache_clear()  # of code that may be replaced
        with ExitStack() as changed:
            changed.enter_context(patch("tests.support.simulated.render", lambda _: frames))
            for name, instead in ablation.code.items():
                changed.enter_context(patch(f"sonarrec.recogniser.{name}", instead))
            recognise(Job(scene, folder, [config]))


def compare(ablations: Mapping[str, Ablation], asked: argparse.Namespace) -> None:
    """Recognise, score and print a table of each of the worlds that are asked for."""
    begun = time.monotonic()
    worlds = WORLDS if asked.kinds is None else {"kinds as asked for": (asked.kinds, asked.seeds)}
    for world, (kinds, numbers) in worlds.items():
        drawn = [(kind, seed) for kind in kinds for seed in numbers]
        folders = {
            name: [asked.out / str(i) / f"{kind}_{seed}" for kind, seed in drawn]
            for i, name in enumerate(ablations)
        }
        in_processes(
            recognise_trial,
            [
                Trial(kind, seed, asked.frames, {folders[n][i]: a for n, a in ablations.items()})
                for i, (kind, seed) in enumerate(drawn)
            ],
        )
        found = {name: score(folders[name]) for name in ablations}
        lines = [
            {"in place": name, "how": str(ablation)} | _figures(found[name], folders[name])
            for name, ablation in ablations.items()
        ]
        passes = len(next(iter(found.values())).passes.unit)
        show(
            f"{world}, {len(drawn)} recordings of {asked.frames} frames, {passes} passes of "
            "landmarks:\nTPR and FPR, protocol strict, at the operating point; TPR at equal FPR; "
            "median error of the\norientation of right claims",
            lines,
        )
    print(f"\n{asked.out}; {(time.monotonic() - begun) / 60:.1f} minutes")


def _figures(found: Counts, folders: Sequence[Path]) -> dict[str, str]:
    one = next(s for s in found.scored if (s.protocol, s.method) == ("strict", FRAMEWORK))
    count, curve = one.count(), one.curve()
    off = np.abs(errors(folders, FRAMEWORK).orientation_deg)
    return (
        {"TPR": told(count.tpr, ".3f"), "FPR": told(count.fpr, ".4f")}
        | {f"at FPR {fpr:g}": told(tpr_at(curve.fpr, curve.tpr, fpr), ".3f") for fpr in EQUAL_FPR}
        | {"deg": told(float(np.median(off)) if len(off) else np.nan, ".1f")}
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, recognise, score and tell."""
    parser = options("ablation", __doc__, REPORTED[:4], FRAMES)
    parser.add_argument("--kinds", nargs="+", choices=ALL_KINDS, help="default: WORLDS")
    asked = parser.parse_args(arguments)
    compare(ABLATIONS, asked)
    save(asked.record)


if __name__ == "__main__":
    main()
