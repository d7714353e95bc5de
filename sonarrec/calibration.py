"""Learns the appearance model of stage 3 from recordings whose truth is known.

`make model` (`python -m sonarrec.calibration`) makes the built-in one from simulated recordings.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from sonarrec.appearance import FEATURES
from sonarrec.appearance_model import BUILT_IN, AppearanceModel
from sonarrec.config import Config, preset
from sonarrec.geometry import PolarToFan
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser import FRAMEWORK, Recogniser
from sonarrec.records import FloatArray, Frame, SonarrecError
from sonarrec.simulation.random_scenes import ALL_KINDS, random_scene
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


# Curves: knots at quantiles of what was seen, and how strongly a curve is drawn towards 0 and
# towards a straight line, in samples.
KNOTS = 8
RIDGE = 0.3
SMOOTHNESS = 3.0


def fit(recordings: Sequence[Samples]) -> AppearanceModel:
    """Most likely curves, by Newton's method on the concave penalised log likelihood.

    The recordings may differ in their number of IDs. Raises SonarrecError where they hold no
    landmark, or nothing but landmarks.
    """
    used = [r for r in recordings if len(r.label)]
    on = sum(np.count_nonzero(r.label < r.features.shape[1]) for r in used)
    total = sum(len(r.label) for r in used)
    if not 0 < on < total:
        what = "no landmark" if on == 0 else "nothing but landmarks"
        raise SonarrecError(
            f"{total} tracks in frames hold {what}; a model is learned from landmarks and others"
        )
    seen = np.concatenate([r.features.reshape(-1, len(FEATURES)) for r in used])
    shares = np.linspace(0.01, 0.99, KNOTS)
    knots = tuple(np.unique(np.quantile(values, shares).round(2)) for values in seen.T)
    columns = [_basis(r.features, knots) for r in used]
    penalty = _penalty(knots)
    curves: FloatArray = np.zeros(len(penalty))
    before = np.inf
    for _ in range(60):
        loss, gradient, curvature = _likelihood(used, columns, curves)
        loss += 0.5 * float(curves @ penalty @ curves)
        step = np.linalg.solve(curvature + penalty, gradient - penalty @ curves)
        if before - loss < 1e-6 * abs(loss):
            break
        before = loss
        # Far from the summit Newton's step overshoots: no curve moves by more than 5 at once.
        curves = curves + step / max(1.0, float(np.abs(step).max()) / 5)
    ends = np.cumsum([1] + [len(k) for k in knots])
    values = [curves[a:b] for a, b in pairwise(ends)]
    # Of a curve and the bias only the sum counts: curves are stated with mean 0.
    bias = float(curves[0]) + sum(float(v.mean()) for v in values)
    return AppearanceModel(bias, knots, tuple(v - v.mean() for v in values))


def _basis(features: FloatArray, knots: Sequence[FloatArray]) -> npt.NDArray[np.float32]:
    """(n, K, D) of features (n, K, F): 1, then every curve's hat functions."""
    hats = [np.ones((*features.shape[:2], 1), np.float32)]
    for i, at in enumerate(knots):
        unit = np.eye(len(at))
        value = features[:, :, i]
        hats.append(np.stack([np.interp(value, at, row) for row in unit], -1).astype(np.float32))
    return np.concatenate(hats, axis=2)


def _penalty(knots: Sequence[FloatArray]) -> FloatArray:
    """(D, D) quadratic form: RIDGE on every value, SMOOTHNESS on every second difference."""
    blocks = [np.full((1, 1), 1e-3)]
    for at in knots:
        bend = np.diff(np.eye(len(at)), 2, axis=0)
        blocks.append(RIDGE * np.eye(len(at)) + SMOOTHNESS * bend.T @ bend)
    size = sum(len(b) for b in blocks)
    form = np.zeros((size, size))
    start = 0
    for block in blocks:
        form[start : start + len(block), start : start + len(block)] = block
        start += len(block)
    return form


def _likelihood(
    recordings: Sequence[Samples], columns: Sequence[npt.NDArray[np.float32]], curves: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Minus the log likelihood, its negative gradient (D,) and its curvature (D, D)."""
    size = len(curves)
    loss, gradient, curvature = 0.0, np.zeros(size), np.zeros((size, size))
    for recording, x in zip(recordings, columns, strict=True):
        n, ids, _ = x.shape
        # 'None of these' is the reference: its log odds are 0.
        logits = np.concatenate([x @ curves, np.zeros((n, 1))], axis=1)
        top = logits.max(axis=1, keepdims=True)
        p = np.exp(logits - top)
        total = p.sum(axis=1, keepdims=True)
        p = (p / total)[:, :ids]
        rows = np.flatnonzero(recording.label < ids)
        label = recording.label[rows]
        loss += float((top + np.log(total)).sum() - logits[rows, label].sum())
        expected = np.einsum("nk,nkd->nd", p, x)
        gradient += x[rows, label].sum(axis=0) - expected.sum(axis=0)
        weighted = (x * np.sqrt(p)[..., None]).reshape(-1, size)
        curvature += weighted.T @ weighted - expected.T @ expected
    return loss, gradient, curvature


# Seeds of the built-in model. Those from 2000 on are for choosing settings, those from 3000 on for
# figures that are reported: no recording serves two ends.
MODEL_SEEDS = range(1000, 1006)


def simulated(seed: int, kind: str) -> Samples:
    """Samples from one random simulated recording."""
    scene = random_scene(seed, kind, wide=True)
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
    drawn = [(seed, kind) for seed in MODEL_SEEDS for kind in ALL_KINDS]
    with ProcessPoolExecutor() as workers:
        parts = list(workers.map(simulated, *zip(*drawn, strict=True)))
    count = sum(len(p.label) for p in parts)
    head = (
        "# Log odds of an ID against 'none of these' = bias + the curves of all features, which\n"
        "# appearance.py names.\n"
        f"# Made by `make model`: {len(drawn)} simulated recordings (seeds\n"
        f"# {MODEL_SEEDS.start} to {MODEL_SEEDS.stop - 1} of every kind of scene), "
        f"{count} tracks in frames.\n"
    )
    BUILT_IN.write_text(head + fit(parts).as_toml(), encoding="utf-8")


if __name__ == "__main__":
    make_model()
