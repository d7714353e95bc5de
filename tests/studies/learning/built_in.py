"""A reader of stage 3 like the built-in one, learned from nothing by `make model`.

Three of the built-in reader's networks learned from earlier versions of the random pictures, and
one is what this made with seed 1.

Half of what it learns from are tracks of simulated recordings, as stages 1 and 2 give them; the
other half are pictures drawn at random (random_pictures.py), which differ more than those of any
simulator.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.config import preset
from sonarrec.learning.samples import describe, label
from sonarrec.recogniser.stage3.model_file import BUILT_IN
from sonarrec.recogniser.stage3.reader import LAST_LAYER, THETA, WEIGHT_STEPS, Weights
from sonarrec.simulation.render import render
from sonarrec.simulation.truth import Truth
from sonarrec.sonar.frame import Frame
from sonarrec.sonar.geometry import plane_from_polar
from tests.studies.learning.other_worlds import LEARNED_WORLDS
from tests.studies.learning.random_pictures import (
    MOST_IDS,
    UNKNOWN,
    Examples,
    draw,
    joined_examples,
)
from tests.studies.learning.random_scenes import KINDS_OF_SCENE, STRETCH_KINDS, random_scene
from tests.support.simulated import in_processes

FRAMES = 64  # of each recording: more recordings teach more than longer ones
EVERY = 4  # so many frames apart are those that teach: neighbours are much the same
# Seeds of the built-in reader. Those from 2000 on are for choosing settings (tuning seeds), those
# from 3000 on for figures that are reported: no recording serves two purposes.
MODEL_SEEDS = range(1000, 1100)
# How many recordings of each kind. Kinds beyond the basin, and those whose discs are few beams
# wide, have more: they differ more from one recording to the next.
RECORDINGS = {
    **dict.fromkeys(KINDS_OF_SCENE + STRETCH_KINDS, 34),
    **dict.fromkeys(LEARNED_WORLDS, 84),
    "tiny_discs": 84,
    # These change only the geometry or the floor, so they are near the basin's.
    **dict.fromkeys(("leaning", "ripples", "fish", "vehicle"), 16),
}
DRAWN, AT_ONCE = 60_000, 2_000  # pictures, and those of one seed
DISCS = 0.4  # the share of discs among the tracks that teach
ALIKE_FRAMES = 6  # the frames of one track count as at most so many
SEEDS = range(1, 5)  # of the networks


def examples_of(recording: tuple[str, int]) -> Examples:
    """The tracks of a random recording of a kind and seed, every EVERY-th frame of each."""
    kind, seed = recording
    truth: list[tuple[int, Truth]] = []
    scene = random_scene(seed, kind, wide=True, frames=FRAMES)

    def frames() -> Iterator[Frame]:  # as a reader would give them
        for frame in render(scene):
            truth.extend((frame.index, landmark) for landmark in frame.truth)
            yield Frame(frame.index, frame.timestamp_ns, frame.image, frame.fan)

    tracks = describe(frames(), preset("default"), scene.landmark_set, every=EVERY)
    polar = np.array([(t.range_m, t.bearing_deg) for _, t in truth]).reshape(-1, 2)
    rows = np.array([row for row, _ in truth], np.int64)
    index = np.array([tracks.landmarks.ids.index(t.landmark) for _, t in truth], np.int64)
    found = label(tracks, rows, index, plane_from_polar(*polar.T))
    n, ids = len(found.label), len(scene.landmark_set.ids)
    codes = np.zeros((n, MOST_IDS, len(THETA)), np.uint8)
    codes[:, :ids] = scene.landmark_set.codes(THETA)
    _, of_track, frames_of = np.unique(found.track, return_inverse=True, return_counts=True)
    p, lit = found.pictures, np.full((n, len(THETA)), UNKNOWN, np.int8)
    seen = p.brightness.astype(np.float16), p.count.astype(np.float16)
    about = p.existence.astype(np.float32), p.smear.astype(np.float32), codes, np.full(n, ids)
    shown = np.where(found.label == ids, MOST_IDS, found.label)
    return Examples(*seen, *about, shown, lit, np.minimum(1, ALIKE_FRAMES / frames_of[of_track]))


def drawn_examples(seed: int) -> Examples:
    """AT_ONCE pictures drawn at random."""
    rng = np.random.default_rng(seed)
    return joined_examples([draw(rng) for _ in range(AT_ONCE)])


def balanced(tracks: Examples) -> Examples:
    """The tracks, with the weights of discs raised so that their share is DISCS."""
    discs, weight = tracks.label < MOST_IDS, tracks.weight
    factor = DISCS / (1 - DISCS) * weight[~discs].sum() / weight[discs].sum()
    return tracks._replace(weight=np.where(discs, weight * factor, weight))


def joined_networks(networks: Sequence[Weights]) -> Weights:
    """The weights of a reader of networks that were learned one by one: their last layers' mean."""
    first, n = networks[0], len(networks)
    weights = {name: np.stack([w[name] for w in networks]) for name in first}
    for name in LAST_LAYER:
        of_each, bias = weights[name][:, :-1] / n, weights[name][:, -1].mean(keepdims=True)
        weights[name] = np.concatenate([of_each.ravel(), bias])
    return weights | {"scale": weights["scale"].mean(axis=0)}


def save_weights(weights: Weights, path: Path) -> None:
    """Write weights as built_in_weights reads them: multiples of 1 / WEIGHT_STEPS."""
    steps: dict[str, Any] = {
        name: np.rint(w * WEIGHT_STEPS).astype(np.int16) for name, w in weights.items()
    }
    np.savez_compressed(path, **steps)


def make_model(
    recordings: Sequence[tuple[str, int]], drawn: int = DRAWN, seeds: Sequence[int] = SEEDS
) -> None:
    """Learn the built-in reader and write it."""
    from tests.studies.learning.network import learn  # jax is needed for this alone

    tracks = joined_examples(in_processes(examples_of, recordings))
    pictures = joined_examples(in_processes(drawn_examples, range(drawn // AT_ONCE)))
    networks = [learn(balanced(tracks), pictures, seed) for seed in seeds]
    save_weights(joined_networks(networks), BUILT_IN)


if __name__ == "__main__":
    make_model([(k, seed) for k, n in RECORDINGS.items() for seed in MODEL_SEEDS[:n]])
