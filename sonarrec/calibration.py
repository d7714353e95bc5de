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

from sonarrec.config import Config, preset
from sonarrec.geometry import PolarToFan
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.recogniser import FRAMEWORK, Recogniser
from sonarrec.recogniser.stage3_features.description import FEATURES
from sonarrec.recogniser.stage3_features.model import BUILT_IN, AppearanceModel
from sonarrec.records import Fan, FloatArray, Frame, SonarrecError
from sonarrec.simulation.random_scenes import ALL_KINDS, random_scene
from sonarrec.simulation.scene import Scene, scene_sonar
from sonarrec.simulation.simulate import LandmarkTruth, render

# A track this near a true centre, in disc diameters, is on it; one farther than OFF is not. Those
# between are neither and teach nothing.
ON, OFF = 0.25, 0.5


@dataclass(frozen=True, slots=True)
class Tracks:
    """One recording's frames, and every track in every frame, described.

    frame, timestamp_ns: (F,) of the frames. row: (n,) index into frame. number: (n,) of the track.
    position: (n, 2) metres in the fan plane, right and ahead of the sonar. features: (n, K, F).
    """

    name: str
    landmarks: LandmarkSet
    fan: Fan | None
    frame: npt.NDArray[np.int64]
    timestamp_ns: npt.NDArray[np.int64]
    row: npt.NDArray[np.int64]
    number: npt.NDArray[np.int64]
    position: FloatArray
    features: FloatArray


@dataclass(frozen=True, slots=True)
class Samples:
    """Described tracks with what they truly are.

    features: (n, K, F). label: (n,) 0 to K - 1, the ID's place in the set; K, 'none of these'.
    track: (n,) the same for what is one track.
    """

    features: FloatArray
    label: npt.NDArray[np.int64]
    track: npt.NDArray[np.int64]


class _Recorder:
    """Stands in for the model while samples are gathered: keeps what it was asked about last."""

    def __init__(self) -> None:
        self.features: FloatArray = np.empty((0, 0, len(FEATURES)))

    def probabilities(self, features: FloatArray) -> FloatArray:
        self.features = features
        n, ids, _ = features.shape
        return np.full((n, ids + 1), 1 / (ids + 1))


def describe(
    frames: Iterable[Frame],
    config: Config,
    landmarks: LandmarkSet,
    *,
    name: str = "",
) -> Tracks:
    """Run stages 1 and 2 over a recording and describe every track in every frame."""
    recorder = _Recorder()
    recogniser = fan = None
    index, stamp, number, polar = [], [], [], []
    features: list[FloatArray] = [np.empty((0, len(landmarks.ids), len(FEATURES)))]
    rows: list[int] = []
    for row, frame in enumerate(frames):
        fan = fan or frame.fan
        recogniser = recogniser or Recogniser(config, fan, landmarks, recorder)
        result = recogniser.step(frame)
        tracks = [e for e in result.estimates if e.method == FRAMEWORK]
        index.append(frame.index)
        stamp.append(frame.timestamp_ns)
        rows += [row] * len(tracks)
        number += [e.object for e in tracks]
        polar += [(e.range_m, e.bearing_deg) for e in tracks]
        features.append(recorder.features[: len(tracks)])
    return Tracks(
        name,
        landmarks,
        fan,
        np.array(index, np.int64),
        np.array(stamp, np.int64),
        np.array(rows, np.int64),
        np.array(number, np.int64),
        _on_fan(np.array(polar).reshape(-1, 2)),
        np.concatenate(features),
    )


def label(
    tracks: Tracks, row: npt.NDArray[np.int64], landmark: npt.NDArray[np.int64], place: FloatArray
) -> Samples:
    """What the tracks of a recording truly are.

    row: (T,) frame, as index into tracks.frame, of each landmark of which anything shows.
    landmark: (T,) its place in the set. place: (T, 2) as Tracks.position.
    """
    ids = len(tracks.landmarks.ids)
    found = np.full(len(tracks.row), ids)
    nearest = np.full(len(tracks.row), np.inf)
    for at, what, where in zip(row, landmark, place, strict=True):
        here = np.flatnonzero(tracks.row == at)
        distance = np.linalg.norm(tracks.position[here] - where, axis=1)
        closer = here[distance < nearest[here]]
        found[closer], nearest[closer] = what, distance[distance < nearest[here]]
    distance = nearest / (2 * tracks.landmarks.radius_m)
    found[distance > ON] = ids
    taught = (distance <= ON) | (distance > OFF)
    return Samples(tracks.features[taught], found[taught], tracks.number[taught])


def _on_fan(polar: FloatArray) -> FloatArray:
    """(n, 2) metres right and ahead of the sonar, of (n, 2) slant range (m) and bearing (deg)."""
    bearing = np.radians(polar[:, 1])
    return np.asarray(polar[:, :1] * np.column_stack([np.sin(bearing), np.cos(bearing)]))


# Curves: knots at quantiles of what was seen, and how strongly a curve is drawn towards 0 and
# towards a straight line, in samples.
KNOTS = 8
RIDGE = 0.3
SMOOTHNESS = 30.0
# How much more strongly a curve is drawn towards that of a prior. A track's frames share a memory
# of 40 (features.memory_frames): so many say hardly more than one does. By `python -m tests.prior`
# 300 does next to no harm where a recording or two are all there is, and helps where landmarks look
# unlike those of the simulator; with 100 two recordings do harm there.
PRIOR_WEIGHT = 300.0


def fit(
    recordings: Sequence[Samples],
    prior: AppearanceModel | None = None,
    prior_weight: float = PRIOR_WEIGHT,
) -> AppearanceModel:
    """Most likely curves, by Newton's method on the concave penalised log likelihood.

    The recordings may differ in their number of IDs. prior: the model to which curves are drawn,
    in place of 0 and a straight line, `prior_weight` times as strongly. Raises SonarrecError where
    the recordings hold no landmark, or nothing but landmarks.
    """
    used = [r for r in recordings if len(r.label)]
    on = sum(np.count_nonzero(r.label < r.features.shape[1]) for r in used)
    total = sum(len(r.label) for r in used)
    if not 0 < on < total:
        what = "no landmark" if on == 0 else "nothing but landmarks"
        raise SonarrecError(
            f"{total} tracks in frames hold {what}; a model is learned from landmarks and others"
        )
    if prior is None:
        seen = np.concatenate([r.features.reshape(-1, len(FEATURES)) for r in used])
        shares = np.linspace(0.01, 0.99, KNOTS)
        knots = tuple(np.unique(np.quantile(values, shares).round(2)) for values in seen.T)
        penalty = _penalty(knots)
        centre: FloatArray = np.zeros(len(penalty))
    else:
        knots = prior.knots
        penalty = prior_weight * _penalty(knots, bias=RIDGE)
        centre = np.concatenate([[prior.bias], *prior.values])
    columns = [_basis(r.features, knots) for r in used]
    curves = centre
    before = np.inf
    for _ in range(60):
        loss, gradient, curvature = _likelihood(used, columns, curves)
        pull = penalty @ (curves - centre)
        loss += 0.5 * float((curves - centre) @ pull)
        step = np.linalg.solve(curvature + penalty, gradient - pull)
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


def _penalty(knots: Sequence[FloatArray], bias: float = 1e-3) -> FloatArray:
    """(D, D) quadratic form: RIDGE on every value, SMOOTHNESS on every second difference."""
    blocks = [np.full((1, 1), bias)]
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
MODEL_SEEDS = range(1000, 1010)


def simulated(seed: int, kind: str) -> Samples:
    """Samples from one random simulated recording."""
    return samples_of(random_scene(seed, kind, wide=True))


def samples_of(scene: Scene) -> Samples:
    """Samples from a simulated recording."""
    truth: list[tuple[int, LandmarkTruth]] = []
    tracks = describe(_frames(scene, truth), preset("default"), scene.landmark_set)
    ids = scene.landmark_set.ids
    return label(
        tracks,
        np.array([row for row, _ in truth], np.int64),
        np.array([ids.index(t.landmark) for _, t in truth], np.int64),
        _on_fan(np.array([(t.range_m, t.bearing_deg) for _, t in truth]).reshape(-1, 2)),
    )


def _frames(scene: Scene, truth: list[tuple[int, LandmarkTruth]]) -> Iterator[Frame]:
    """A scene's frames as a reader would give them; their truth is added to `truth`."""
    to_fan = None
    for frame in render(scene):
        truth += [(frame.index, landmark) for landmark in frame.truth]
        image = frame.image
        if scene.sonar.layout == "polar":
            to_fan = to_fan or PolarToFan(scene_sonar(scene).complete(scene.name), *image.shape)
            image = to_fan(image)
        yield Frame(frame.index, frame.timestamp_ns, image, frame.fan)


def make_model() -> None:
    """Write the built-in model anew: every kind of scene, MODEL_SEEDS of each."""
    drawn = [(seed, kind) for seed in MODEL_SEEDS for kind in ALL_KINDS]
    with ProcessPoolExecutor() as workers:
        parts = list(workers.map(simulated, *zip(*drawn, strict=True)))
    count = sum(len(p.label) for p in parts)
    head = (
        "# Log odds of an ID against 'none of these' = bias + the curves of all features, which\n"
        "# description.py names.\n"
        f"# Made by `make model`: {len(drawn)} simulated recordings (seeds\n"
        f"# {MODEL_SEEDS.start} to {MODEL_SEEDS.stop - 1} of every kind of scene), "
        f"{count} tracks in frames.\n"
    )
    BUILT_IN.write_text(head + fit(parts).as_toml(), encoding="utf-8")


if __name__ == "__main__":
    make_model()
