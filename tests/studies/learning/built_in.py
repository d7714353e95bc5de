"""The built-in appearance model, learned from simulated recordings.

`make model` (`python -m tests.studies.learning.built_in`) makes it again.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor

from sonarrec.config import preset
from sonarrec.learning.fit import fit
from sonarrec.learning.samples import Samples, describe
from sonarrec.recogniser.stage3.model import BUILT_IN
from sonarrec.simulation.scene import Scene
from sonarrec.simulation.truth import Truth
from tests.studies.learning.matrices import FRAMES, labelled, scene_frames
from tests.studies.learning.other_worlds import LEARNED_WORLDS
from tests.studies.learning.random_scenes import KINDS_OF_SCENE, STRETCH_KINDS, random_scene

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


def lessons() -> list[tuple[str, Samples]]:
    """Kind of scene and samples of every recording that the model learns from; on all cores."""
    recordings = [(kind, seed) for kind, n in RECORDINGS.items() for seed in MODEL_SEEDS[:n]]
    with ProcessPoolExecutor() as workers:
        samples = workers.map(simulated, *zip(*recordings, strict=True))
        return [(kind, sample) for (kind, _), sample in zip(recordings, samples, strict=True)]


def simulated(kind: str, seed: int) -> Samples:
    """Samples from one random simulated recording."""
    return samples_of(random_scene(seed, kind, wide=True, frames=FRAMES))


def samples_of(scene: Scene) -> Samples:
    """Samples from a simulated recording."""
    truth: list[tuple[int, Truth]] = []
    tracks = describe(scene_frames(scene, truth), preset("default"), scene.landmark_set)
    return labelled(tracks, truth)


def make_model() -> None:
    """Learn and write the built-in model, from every kind of scene that may be learned from."""
    parts = [samples for _, samples in lessons()]
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
