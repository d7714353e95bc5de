"""`make returns`: what is claimed of landmarks while they are out of view, and when they come back.

The sonar pans to and fro over landmarks that leave the view and return: a remembered track that
texture calls back would be declared where its landmark is not.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pandas as pd

from sonarrec.config import preset
from sonarrec.recogniser.three_stages import FRAMEWORK
from sonarrec.simulation.scene import Scene
from tests.studies.learning.random_scenes import ALL_KINDS, random_scene
from tests.studies.results.record import add_record_option, save, show
from tests.studies.scenes import seeds, told
from tests.support.simulated import Job, in_processes, recognise

NAMES = ("default", "offline")
KINDS = ("plain", "any_floor", "light", "debris")
REPORTED = range(3000, 3003)
FRAMES = 400
MOST_WIDE_DEG, PAN_DEG_S = 40.0, 5.0
WHOLE = 0.9  # share of a disc in view from which it counts as returned


@dataclass(frozen=True, slots=True)
class Returns:
    """Of one preset in some recordings; frames are pairs of a frame and an ID.

    exits, returns: how often an ID left the view wholly, and was whole in view again after. away:
    frames with an ID that has been in view and is not. claims: of these, those in which it is
    declared. back: frames with an ID whole in view again. right: of these, those in which it is
    declared.
    """

    exits: int = 0
    returns: int = 0
    away: int = 0
    claims: int = 0
    back: int = 0
    right: int = 0

    def __add__(self, other: Returns) -> Returns:
        return Returns(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


def counted(visible: np.ndarray, declared: np.ndarray) -> Returns:
    """visible: (frames, K) greatest share of each ID's discs that shows. declared: (frames, K)."""
    shows, whole = visible > 0, visible >= WHOLE
    seen = np.logical_or.accumulate(whole, axis=0)
    away = seen & ~shows
    left = seen[1:] & shows[:-1] & ~shows[1:]
    gone = np.zeros_like(shows)
    gone[1:] = np.logical_or.accumulate(left, axis=0)
    back = whole & gone
    # Since it was last away: what comes back is counted once, whatever it does at the fan's edge.
    again, waiting = 0, np.zeros(visible.shape[1], bool)
    for left_now, whole_now in zip(np.pad(left, ((1, 0), (0, 0))), whole, strict=True):
        again += int(np.count_nonzero(waiting & whole_now))
        waiting = (waiting | left_now) & ~whole_now
    sums = (left, away, away & declared, back, back & declared)
    exits, *others = (int(np.count_nonzero(s)) for s in sums)
    return Returns(exits, again, *others)


def panning(seed: int, kind: str, frames: int) -> Scene:
    """A random scene over which the sonar pans fast, far enough to lose what it has seen."""
    scene = random_scene(seed, kind, frames=frames)
    motion = replace(
        scene.motion,
        pan_min_deg=-MOST_WIDE_DEG,
        pan_max_deg=MOST_WIDE_DEG,
        pan_deg_s=PAN_DEG_S,
    )
    return replace(scene, motion=motion)


def measured(folder: Path, ids: Sequence[int], frames: int, name: str) -> Returns:
    """What one preset made of a recording, from its results and its truth."""
    table = {k: np.zeros((frames, len(ids))) for k in ("visible", "declared")}
    truth = pd.read_csv(folder / "gt.csv")
    found = pd.read_csv(folder / "estimates.csv")
    found = found[(found["method"] == f"{FRAMEWORK}:{name}") & (found["declared"] == 1)]
    at = [list(ids).index(i) for i in truth["landmark"]]
    np.maximum.at(table["visible"], (truth["frame"], at), truth["visible"])
    table["declared"][found["frame"], [list(ids).index(i) for i in found["landmark"]]] = 1
    return counted(table["visible"], table["declared"] > 0)


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, recognise, count and tell."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.returns", description=__doc__)
    parser.add_argument("--seeds", type=seeds, default=REPORTED, help="first:end, end left out")
    parser.add_argument("--kinds", nargs="+", choices=ALL_KINDS, default=KINDS)
    parser.add_argument("--frames", type=int, default=FRAMES, help="of each recording")
    parser.add_argument("--out", type=Path, default=Path("build") / "returns")
    add_record_option(parser)
    asked = parser.parse_args(arguments)
    configs = [preset(name) for name in NAMES]
    drawn = {k: [panning(seed, k, asked.frames) for seed in asked.seeds] for k in asked.kinds}
    in_processes(
        recognise, [Job(s, asked.out / s.name, configs) for some in drawn.values() for s in some]
    )
    lines = []
    for name in NAMES:
        parts = {
            kind: [
                measured(asked.out / s.name, s.landmark_set.ids, asked.frames, name) for s in some
            ]
            for kind, some in drawn.items()
        }
        parts["all"] = [r for some in parts.values() for r in some]
        for kind, some in parts.items():
            r = sum(some, Returns())
            lines.append(
                {"preset": name, "kind": kind, "exits": str(r.exits), "returns": str(r.returns)}
                | {"away": str(r.away), "claimed while away": str(r.claims)}
                | {"back": str(r.back), "right": told(r.right / max(r.back, 1), ".3f")}
            )
    show("IDs that leave the view and return; frames away and back", lines)
    save(asked.record)


if __name__ == "__main__":
    main()
