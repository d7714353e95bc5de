"""How strongly `sonarrec calibrate` holds to the built-in model: `python -m tests.studies.prior`.

A place is a sonar, a floor and a look of landmarks; three recordings each, with landmarks laid out
anew. A model is learned from the first, or the first two, and judged on the third. Tuning seeds.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np

from learning.built_in import samples_of
from learning.random_scenes import random_scene
from sonarrec.learning.fit import fit
from sonarrec.learning.samples import Samples
from sonarrec.recogniser.stage3_features.model import AppearanceModel, built_in_model

FRAMES = 160
WEIGHTS = (3.0, 30.0, 120.0, 300.0, 900.0, 3000.0)
# Kind of scene, and what of its picture is unlike the simulator's own range.
LIKE = (
    ("low_contrast", {}),
    ("fading", {}),
    ("jitter", {}),
    ("near_miss", {}),
    ("ring_widths", {}),
    ("all_hard", {}),
    ("plain", {"dynamic_range_db": 95.0, "gamma": 1.7}),
    ("plain", {"dynamic_range_db": 28.0, "gamma": 0.6}),
    ("near_miss", {"dynamic_range_db": 80.0, "gamma": 2.0}),
    ("fading", {"black_db": -6.0, "dynamic_range_db": 35.0}),
)
# Kind of scene, and by how many dB symbols and plates are brighter than the simulator makes them.
UNLIKE = (("plain", -5.0, 6.0), ("near_miss", 0.0, 9.0), ("near_miss", -7.0, 0.0))
PLACES = 4  # of each of these


def recordings(
    seed: int, kind: str, picture: dict[str, float], symbol_db: float = 0, plate_db: float = 0
) -> list[Samples]:
    """Samples of one place's three recordings."""
    first = random_scene(seed, kind)
    first = replace(first, picture=replace(first.picture, **picture))
    place = {
        part: getattr(first, part)
        for part in ("sonar", "landmark_set", "floor", "fading", "noise", "picture", "motion")
    }
    samples = []
    for scene in (first, *(random_scene(seed + 50 * n, kind, **place) for n in (1, 2))):
        landmarks = tuple(
            replace(x, symbol_db=x.symbol_db + symbol_db, plate_db=x.plate_db + plate_db)
            for x in scene.landmarks
        )
        objects = tuple(
            x if x.plate_db is None else replace(x, plate_db=x.plate_db + plate_db)
            for x in scene.objects
        )
        samples.append(
            samples_of(replace(scene, frames=FRAMES, landmarks=landmarks, objects=objects))
        )
    return samples


def log_likelihood(model: AppearanceModel, samples: Samples) -> float:
    """Mean over tracks in frames of the log probability of what each truly is."""
    p = model.probabilities(samples.features, samples.smear)
    of_truth = p[np.arange(len(samples.label)), samples.label]
    return float(np.log(np.maximum(of_truth, 1e-12)).mean())


def row(taught: list[Samples], judged: Samples) -> list[float]:
    """Built-in model, learned from scratch, learned with each weight."""
    built_in = built_in_model()
    models = [built_in, fit(taught), *(fit(taught, built_in, w) for w in WEIGHTS)]
    return [log_likelihood(model, judged) for model in models]


def main() -> None:
    """Print the mean over places, for one and for two recordings learned from."""
    like = [(2300 + i, kind, picture) for i, (kind, picture) in enumerate(LIKE)]
    unlike = [
        (2400 + 10 * place + i, kind, {}, *look)
        for place in range(PLACES)
        for i, (kind, *look) in enumerate(UNLIKE)
    ]
    print("mean log likelihood".ljust(24), "built-in", " scratch", *(f"{w:8g}" for w in WEIGHTS))
    with ProcessPoolExecutor() as workers:
        for name, places in (("as simulated", like), ("unlike it", unlike)):
            done = list(workers.map(recordings, *zip(*places, strict=True)))
            for count in (1, 2):
                mean = np.mean([row(parts[:count], parts[2]) for parts in done], axis=0)
                told = f"{name}, {count} recording{'s' * (count > 1)}"
                print(told.ljust(24), *(f"{value:8.3f}" for value in mean), flush=True)


if __name__ == "__main__":
    main()
