"""`make ablation`: the default with one of its ideas at a time put back to the simpler way."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sonarrec.config import Config, preset, with_assignments
from sonarrec.evaluation.counting.passes import find_passes
from sonarrec.recogniser.recogniser import FRAMEWORK
from sonarrec.simulation.random_scenes import ALL_KINDS, KINDS_OF_SCENE, random_scene
from tests.studies.scenes import FRAMES, REPORTED, seeds, show, told
from tests.support.simulated import Job, recognise_all, score

ABLATIONS = {
    "the default": (),
    "random walk, no measured pan": ("continuity.motion=random_walk",),
    "no memory of lost objects": ("continuity.remember_frames=0",),
    "lost objects taken up half a diameter off": (
        "continuity.recall=0.5",
        "continuity.recall_in_view=0",
    ),
    "groups leave their own candidate for another's": ("continuity.own_candidate=2",),
    "each frame by itself": ("features.measurement=single",),
    "memory of one frame": ("features.memory_frames=1",),
    "cells of a symbol taken for independent": ("features.alike_radii=0",),
    "symbols as drawn, not as the beam smears them": ("features.beam_width_deg=0.01",),
    "circles in the fan, Eq. 1": ("candidates.plane=fan",),
    "edges, not rings": ("candidates.detector=edge",),
}
EQUAL_FPR = (0.002, 0.01)
"""Where TPRs are read off the curves, for another measurement may want another threshold."""


def variants() -> list[Config]:
    """One configuration per ablation; its preset's name is that of the ablation."""
    default = preset("default")
    return [
        replace(with_assignments(default, changes), preset=name)
        for name, changes in ABLATIONS.items()
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, recognise, score and tell."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.ablation", description=__doc__)
    parser.add_argument("--seeds", type=seeds, default=REPORTED[:4], help="first:end, end left out")
    parser.add_argument("--kinds", nargs="+", choices=ALL_KINDS, default=KINDS_OF_SCENE)
    parser.add_argument("--frames", type=int, default=FRAMES, help="of each recording")
    parser.add_argument("--out", type=Path, default=Path("build") / "ablation")
    asked = parser.parse_args(arguments)
    begun = time.monotonic()
    configs = variants()
    jobs = [
        Job(
            random_scene(seed, kind, frames=asked.frames),
            asked.out / f"{kind}_{seed}",
            configs,
        )
        for kind in asked.kinds
        for seed in asked.seeds
    ]
    recognise_all(jobs)
    found = score([job.folder for job in jobs])
    strict = {s.method: s for s in found.scored if s.protocol == "strict"}
    passes = len(find_passes(found.joined).first_frame_index)
    lines = []
    for name, changes in ABLATIONS.items():
        one = strict[f"{FRAMEWORK}:{name}"]
        count, curve = one.count(), one.curve()
        lines.append(
            {"in place": name, "setting": " ".join(changes)}
            | {"TPR": told(count.tpr, ".3f"), "FPR": told(count.fpr, ".4f")}
            | {f"at FPR {fpr:g}": told(curve.tpr_at(fpr), ".3f") for fpr in EQUAL_FPR}
        )
    show(
        f"TPR and FPR, protocol strict, at the operating point, and TPR at equal FPR;\n"
        f"{len(jobs)} recordings of {asked.frames} frames, {passes} passes of landmarks",
        lines,
    )
    print(f"\n{asked.out}; {(time.monotonic() - begun) / 60:.1f} minutes")


if __name__ == "__main__":
    main()
