"""Learns the appearance model of stage 3 from recordings whose truth is known.

`make model` (`python -m sonarrec.calibration`) makes the built-in one from simulated recordings.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarrec.appearance import BUILT_IN, FEATURES, AppearanceModel
from sonarrec.config import Config, preset
from sonarrec.geometry import PolarToFan
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser import FRAMEWORK, Recogniser
from sonarrec.records import FloatArray, Frame
from sonarrec.simulation.random_scenes import KINDS_OF_SCENE, random_scene
from sonarrec.simulation.scene import Scene, scene_sonar
from sonarrec.simulation.simulate import render

# A track this near a true centre, in disc diameters, is on it; one farther than OFF is not. Those
# between are neither and teach nothing.
ON, OFF = 0.25, 0.5


@dataclass(frozen=True, slots=True)
class Truth:
    """One landmark of which something shows in one frame."""

    landmark: int
    range_m: float
    bearing_deg: float


@dataclass(frozen=True, slots=True)
class Samples:
    """Described tracks with what they truly are.

    features: (n, K, F). label: (n,) 0 to K - 1, the ID's place in the set; K, 'none of these'.
    """

    features: FloatArray
    label: npt.NDArray[np.int64]


class _Recorder:
    """Stands in for the model while samples are gathered: keeps what it was asked about last."""

    def __init__(self) -> None:
        self.features: FloatArray = np.empty((0, 0, len(FEATURES)))

    def probabilities(self, features: FloatArray) -> FloatArray:
        self.features = features
        n, ids, _ = features.shape
        return np.full((n, ids + 1), 1 / (ids + 1))


def gather(
    frames: Iterable[tuple[Frame, Sequence[Truth]]], config: Config, landmarks: LandmarkSet
) -> Samples:
    """Run stages 1 and 2 over a recording and describe every track in every frame."""
    recorder = _Recorder()
    recogniser = None
    features, labels = [], []
    for frame, truths in frames:
        recogniser = recogniser or Recogniser(config, frame.fan, landmarks, recorder)
        result = recogniser.step(frame)
        tracks = [e for e in result.estimates if e.method == FRAMEWORK]
        if not tracks:
            continue
        places = _on_fan([(e.range_m, e.bearing_deg) for e in tracks])
        label = np.full(len(tracks), len(landmarks.ids))
        taught = np.ones(len(tracks), bool)
        if truths:
            true_places = _on_fan([(t.range_m, t.bearing_deg) for t in truths])
            distance = np.linalg.norm(places[:, None] - true_places[None], axis=2)
            distance /= 2 * landmarks.radius_m
            nearest = distance.argmin(axis=1)
            ids = np.array([landmarks.ids.index(t.landmark) for t in truths])
            on = distance.min(axis=1) <= ON
            label[on] = ids[nearest[on]]
            taught = on | (distance.min(axis=1) > OFF)
        features.append(recorder.features[taught])
        labels.append(label[taught])
    if not features:
        return Samples(np.empty((0, len(landmarks.ids), len(FEATURES))), np.empty(0, np.int64))
    return Samples(np.concatenate(features), np.concatenate(labels))


def _on_fan(places: Sequence[tuple[float, float]]) -> FloatArray:
    """(n, 2) metres right and ahead of the sonar, of (slant range in m, bearing in deg)."""
    range_m, bearing_deg = np.array(places).T
    bearing = np.radians(bearing_deg)
    return np.column_stack([range_m * np.sin(bearing), range_m * np.cos(bearing)])


def fit(samples: Samples, ridge: float = 1.0) -> AppearanceModel:
    """Most likely weights, by Newton's method on the concave log likelihood.

    ridge: strength of the pull towards 0, in samples, so that a feature that tells nothing gets
    no weight.
    """
    n, _, count = samples.features.shape
    # 'None of these' has features 0: its log odds are the reference.
    x = np.concatenate([samples.features, np.zeros((n, 1, count))], axis=1)
    chosen = x[np.arange(n), samples.label].sum(axis=0)
    weights: FloatArray = np.zeros(count)
    for _ in range(50):
        p = AppearanceModel(weights).probabilities(samples.features)
        expected = np.einsum("nk,nkf->nf", p, x)
        gradient = chosen - expected.sum(axis=0) - ridge * weights
        curvature = np.einsum("nk,nkf,nkg->fg", p, x, x, optimize=True) - expected.T @ expected
        step = np.linalg.solve(curvature + ridge * np.eye(count), gradient)
        weights = weights + step / max(1.0, float(np.abs(step).max()) / 5)
        if np.abs(step).max() < 1e-6:
            break
    return AppearanceModel(weights)


# Seeds of the built-in model. Those from 2000 on are for choosing settings, those from 3000 on for
# figures that are reported: no recording serves two ends.
MODEL_SEEDS = range(1000, 1006)


def simulated(seed: int, kind: str) -> Samples:
    """Samples from one random simulated recording."""
    scene = random_scene(seed, kind)
    return gather(simulated_frames(scene), preset("default"), scene.landmark_set)


def simulated_frames(scene: Scene) -> Iterator[tuple[Frame, Sequence[Truth]]]:
    """A scene's frames as a reader would give them, with their truth."""
    to_fan = None
    for frame in render(scene):
        image = frame.image
        if scene.sonar.layout == "polar":
            to_fan = to_fan or PolarToFan(scene_sonar(scene), *image.shape)
            image = to_fan(image)
        truths = [Truth(t.landmark, t.range_m, t.bearing_deg) for t in frame.truth]
        yield Frame(frame.index, frame.timestamp_ns, image, frame.fan), truths


def make_model() -> None:
    """Write the built-in model anew: every kind of scene, MODEL_SEEDS of each."""
    drawn = [(seed, kind) for seed in MODEL_SEEDS for kind in KINDS_OF_SCENE]
    with ProcessPoolExecutor() as workers:
        parts = list(workers.map(simulated, *zip(*drawn, strict=True)))
    samples = Samples(
        np.concatenate([p.features for p in parts]), np.concatenate([p.label for p in parts])
    )
    model = fit(samples)
    lines = [
        "# Log odds of an ID against 'none of these' = sum of weight x feature; see appearance.py.",
        f"# Made by `make model`: {len(drawn)} simulated recordings (seeds {MODEL_SEEDS.start} to",
        f"# {MODEL_SEEDS.stop - 1} of every kind of scene), {len(samples.label)} tracks in frames.",
        "[weights]",
    ]
    lines += [f"{name} = {w:.4f}" for name, w in zip(FEATURES, model.weights, strict=True)]
    BUILT_IN.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    make_model()
