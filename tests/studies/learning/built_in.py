"""The built-in appearance model, learned from simulated recordings.

`make model` (`python -m tests.studies.learning.built_in`) makes it again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sonarrec.config import preset
from sonarrec.geometry import PolarToFan, plane_from_polar
from sonarrec.learning.fit import fit
from sonarrec.learning.samples import Samples, describe, label
from sonarrec.recogniser.stage3.model import BUILT_IN
from sonarrec.records import Frame
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import scene_sonar
from sonarrec.simulation.truth import Truth
from tests.studies.learning.other_worlds import LEARNED_WORLDS
from tests.studies.learning.random_scenes import KINDS_OF_SCENE, STRETCH_KINDS, random_scene
from tests.support.simulated import in_processes

FRAMES = 64  # of each recording: more recordings teach more than longer ones
# Seeds of the built-in model. Those from 2000 on are for choosing settings (tuning seeds), those
# from 3000 on for figures that are reported: no recording serves two purposes.
MODEL_SEEDS = range(1000, 1060)
# How many recordings of each kind. Kinds beyond the basin, and those whose discs are few beams
# wide, have more: they differ more from one recording to the next.
RECORDINGS = {
    **dict.fromkeys(KINDS_OF_SCENE + STRETCH_KINDS, 24),
    **dict.fromkeys(LEARNED_WORLDS, 60),
    "tiny_discs": 60,
    # These change only the geometry or the floor, so they are near the basin's.
    **dict.fromkeys(("leaning", "ripples", "fish", "vehicle"), 12),
}


def samples_of(recording: tuple[str, int], every: int = 1) -> Samples:
    """Samples from a random recording of a kind and seed. every: so many frames apart."""
    kind, seed = recording
    truth: list[tuple[int, Truth]] = []
    scene = random_scene(seed, kind, wide=True, frames=FRAMES)

    def frames() -> Iterator[Frame]:  # as a reader would give them
        polar = None
        for frame in render(scene):
            truth.extend((frame.index, landmark) for landmark in frame.truth)
            if scene.sonar.layout == "polar" and polar is None:
                polar = PolarToFan(scene_sonar(scene).complete(scene.name), *frame.image.shape)
            yield Frame(frame.index, frame.timestamp_ns, frame.image, frame.fan, polar=polar)

    tracks = describe(frames(), preset("default"), scene.landmark_set)
    chosen = np.flatnonzero(tracks.row % every == 0)
    columns = ("row", "number", "position", "features", "smear")
    tracks = replace(tracks, **{name: getattr(tracks, name)[chosen] for name in columns})
    polar = np.array([(t.range_m, t.bearing_deg) for _, t in truth]).reshape(-1, 2)
    return label(
        tracks,
        np.array([row for row, _ in truth], np.int64),
        np.array([tracks.landmarks.ids.index(t.landmark) for _, t in truth], np.int64),
        plane_from_polar(*polar.T),
    )


def make_model() -> None:
    """Learn and write the built-in model, from every kind of scene that may be learned from."""
    recordings = [(kind, seed) for kind, n in RECORDINGS.items() for seed in MODEL_SEEDS[:n]]
    parts = in_processes(samples_of, recordings)
    count = sum(len(p.label) for p in parts)
    head = (
        "# Log odds of an ID against 'none of these' = bias + the curves of all features, which\n"
        "# description.py names: of sharp pictures and, as smeared_, of smeared ones.\n"
        "# Between the two their weighted mean (model.py).\n"
        f"# Made by `make model`: {len(parts)} simulated recordings of {FRAMES} frames, seeds\n"
        f"# from {MODEL_SEEDS.start} on of {len(RECORDINGS)} kinds of scene; "
        f"{count} tracks in frames.\n"
    )
    BUILT_IN.write_text(head + fit(parts).as_toml(), encoding="utf-8", newline="")


if __name__ == "__main__":
    make_model()
