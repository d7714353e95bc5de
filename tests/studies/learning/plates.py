"""The model of drawn plates, learned from simulated recordings: `make plate-model`.

Sets of random cells, blobs and strokes, and of AcTag24h4; in each recording plates of the set,
plates of other drawings, and bright figures. What is learned is what a match is worth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np

from sonarrec import landmarks
from sonarrec.advice.landmarks import PLATES_NEAR, PLATES_NEAR_SEEN
from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.config import preset
from sonarrec.drawing.landmarks import distances
from sonarrec.errors import SonarrecError
from sonarrec.landmarks import DrawnSet, landmarks_from_table, load_landmarks
from sonarrec.recogniser.drawn.model import MODEL, of_ids, of_one
from sonarrec.recogniser.drawn.pose import Fit, PoseFitter
from sonarrec.recogniser.drawn.stage2 import smooth
from sonarrec.recogniser.drawn.three_stages import PlateStages, pose_fitter
from sonarrec.simulation.render import SimulatedFrame, render
from sonarrec.simulation.scene import HeldPlate, PlateScene, scene_sonar
from sonarrec.simulation.truth import Truth
from sonarrec.sonar.frame import Frame
from sonarrec.sonar.geometry import PolarToFan, plane_from_polar
from tests.support.simulated import in_processes

SEEDS, FRAMES = range(1000, 1090), 24
LOOKED_AT = (1, 8)  # frames that teach what a single picture's matches are worth
SIDE, SIDE_M = 28, 0.3
PLACES = ((0.75, 0.0), (1.35, -16.0), (1.4, 16.0))  # m, deg
WIDEST_BEAM_M = 1.5 * np.radians(1.0)
NEAR_M, CORNERS_M = 0.06, 0.03
FRAMES_COUNTED, RIDGE = 4, 0.02


def random_sets(rng: np.random.Generator) -> tuple[DrawnSet, DrawnSet]:
    """A set, and strangers of the same kind: all of one family, or of any."""
    count, kind = int(rng.integers(1, 17)), int(rng.integers(len(FAMILIES) + 1))
    mirrored = str(rng.choice(["yes", "no", "either"]))

    def drawings() -> Iterator[BoolArray]:
        while True:
            family = kind if kind < len(FAMILIES) else int(rng.integers(len(FAMILIES)))
            yield FAMILIES[family](rng)

    taken = apart(drawings(), count + 8, mirrored)
    return set_of(taken[:count], mirrored), set_of(taken[count:], mirrored)


def apart(drawings: Iterable[BoolArray], count: int, mirrored: str) -> list[BoolArray]:
    """The first so many of which `sonarrec landmarks` would not warn beside those before."""
    taken: list[BoolArray] = []
    for drawing in drawings:
        try:
            near = distances(set_of([*taken, drawing], mirrored), WIDEST_BEAM_M)
        except SonarrecError:  # the same drawing, turned
            continue
        if all(d.drawn >= PLATES_NEAR and d.seen >= PLATES_NEAR_SEEN for d in near):
            taken.append(drawing)
        if len(taken) == count:
            break
    return taken


def set_of(drawings: Sequence[BoolArray], mirrored: str = "either") -> DrawnSet:
    """A set of plates SIDE_M wide with IDs from 0."""
    rows = [["".join("01"[int(c)] for c in line) for line in cells] for cells in drawings]
    landmark = [{"id": i, "cells": cells} for i, cells in enumerate(rows)]
    table = {"name": "s", "kind": "drawn", "size_m": SIDE_M, "mirrored": mirrored}
    made = landmarks_from_table({**table, "landmark": landmark}, "here")
    assert isinstance(made, DrawnSet)
    return made


def _tag(rng: np.random.Generator) -> BoolArray:
    return _family()[int(rng.integers(len(_family())))]


@cache
def _family() -> list[BoolArray]:
    with patch.object(landmarks, "MOST_IDS", 3000):  # of a set that is looked for
        family = load_landmarks(Path(__file__).with_name("actag24h4.toml"))
    assert isinstance(family, DrawnSet)
    return family.drawings()


def _cells(rng: np.random.Generator) -> BoolArray:
    return np.asarray(rng.random((int(rng.integers(4, 9)),) * 2) < rng.uniform(0.35, 0.6))


def _blobs(rng: np.random.Generator) -> BoolArray:
    smooth = cv2.GaussianBlur(rng.standard_normal((SIDE, SIDE)), (0, 0), rng.uniform(1.5, 3))
    return np.asarray(smooth > np.quantile(smooth, rng.uniform(0.4, 0.65)))


def _strokes(rng: np.random.Generator) -> BoolArray:
    """Four to six lines all over the plate, most of them from the end of the last."""
    while True:
        cells = np.zeros((SIDE, SIDE), np.uint8)
        ends = rng.integers(2, SIDE - 2, (int(rng.integers(5, 8)), 2)).tolist()
        thick = int(rng.integers(4, 6))
        for one, other in pairwise(ends):
            begin = one if rng.random() < 0.7 else rng.integers(2, SIDE - 2, 2).tolist()
            cv2.line(cells, begin, other, 1, thick)
        if min(cv2.boundingRect(cells)[2:]) > 0.8 * SIDE and cells.mean() < 0.6:
            return cells > 0


FAMILIES: tuple[Callable[[np.random.Generator], BoolArray], ...] = (_tag, _cells, _blobs, _strokes)


def random_scene(
    seed: int,
    sets: tuple[DrawnSet, DrawnSet] | None = None,
    least_db: float = 5.0,
    frames: int = FRAMES,
    most_deg: float = 60.0,
) -> PlateScene:
    """A recording of plates of the set and strangers, flat to tilted; least_db to 12 over
    what is round them."""
    rng = np.random.default_rng(seed)
    u, (known, strangers) = rng.uniform, sets or random_sets(rng)
    plates = []
    for range_m, bearing_deg in PLACES:
        if (kind := rng.random()) < 0.15:
            continue
        chosen = known if kind < 0.7 else strangers
        hand = {"yes": True, "no": False, "either": bool(rng.integers(2))}[known.mirrored]
        number = int(rng.choice(chosen.ids))
        place = {"range_m": range_m + u(-0.08, 0.08), "bearing_deg": bearing_deg + u(-3, 3)}
        place |= {"turned_deg": u(0, 360), "tilt_deg": u(0, most_deg), "axis_deg": u(-20, 20)}
        looks = {"mirrored": hand, "bright_db": u(least_db, 12), "dark_db": u(-8, 0)}
        plates.append(HeldPlate(number, **place, **looks, known=chosen is known))
    what = {"landmark_set": known, "others": strangers, "plate": tuple(plates)}
    sonar = {"beams": 192, "bins": 320, "beam_width_deg": u(0.4, 1.0), "pulse_m": u(0.004, 0.02)}
    water = {"swing": u(0, 0.6), "streaks": int(rng.integers(0, 5)), "light_db": u(0, 4)}
    water |= {"clutter": int(rng.integers(0, 5)), "floor_db": u(8, 18)}
    water |= {"blank_every": int(rng.choice([0, 7]))}
    return PlateScene(**what, **sonar, **water, seed=seed, frames=frames)


def stages_of(
    scene: PlateScene,
) -> tuple[PlateStages, PoseFitter, Iterator[tuple[SimulatedFrame, Frame]]]:
    """What recognises a recording, what finds plates in it, and its frames."""
    polar = PolarToFan(scene_sonar(scene).complete("scene"), scene.bins, scene.beams)
    config = preset("default")
    config = replace(config, features=replace(config.features, beam_width_deg=scene.beam_width_deg))
    frames = (
        (shot, Frame(shot.index, shot.timestamp_ns, shot.image, polar.fan, polar=polar))
        for shot in render(scene)
    )
    fitter = pose_fitter(config, polar.fan, scene.landmark_set)
    return PlateStages(config, polar.fan, scene.landmark_set), fitter, frames


def lessons_of_pictures(seed: int) -> list[Part]:
    """Of the fits that a search compares: matches by scale, and whether they are right."""
    stages, fitter, frames = stages_of(random_scene(seed, frames=LOOKED_AT[-1] + 1))
    fits: list[Fit] = []
    label: list[int] = []
    for shot, frame in (both for both in frames if both[0].index in LOOKED_AT):
        working = stages.working_image(frame)
        places = stages.stage1(working).positions
        for found in fitter.candidates(smooth(working), places, [[]] * len(places)):
            fits += found
            label += [not any(_fits(fitter, fit, true) for true in shot.truth) for fit in found]
    if not fits:
        return []
    features = of_one(np.array([fit.compared for fit in fits]))
    return [(features[:, None], np.array(label, int), np.ones(len(label)))]


def _fits(fitter: PoseFitter, fit: Fit, true: Truth) -> bool:
    """Whether it is the true drawing, with its corners where they are."""
    if fit.row != true.landmark:
        return False
    found = plane_from_polar(*fitter.plane.to_polar(*fitter.corners(fit.pose).T))
    wanted = plane_from_polar(*true.corners.T)
    offsets = [np.roll(way, n, axis=0) - found for way in (wanted, wanted[::-1]) for n in range(4)]
    return bool(min(np.hypot(*offset.T).mean() for offset in offsets) < CORNERS_M)


def lessons_of_tracks(seed: int) -> list[Part]:
    """Of every group that shows a plate, in every frame: features, and the true ID's index or K.

    A track's frames are much the same: together they count as FRAMES_COUNTED.
    """
    scene = random_scene(seed)
    ids = scene.landmark_set.ids
    stages, _, frames = stages_of(scene)
    found: list[tuple[FloatArray, ...]] = []
    for shot, frame in frames:
        image = stages.working_image(frame)
        tracks = stages.stage2(frame, image, stages.stage1(image)).tracks
        middles = plane_from_polar(*stages.plane.to_polar(*tracks["position"].T))
        label = np.full(len(middles), len(ids))
        for true in shot.truth:
            place = plane_from_polar(np.array([true.range_m]), np.array([true.bearing_deg]))
            label[np.hypot(*(middles - place).T) < NEAR_M] = ids.index(true.landmark)
        features = of_ids(tracks["matches"], tracks["rival"], tracks["odds"])
        kept = tracks["shown"]
        found.append((features[kept], label[kept], tracks["number"][kept]))
    features, label, track = (np.concatenate(part) for part in zip(*found, strict=True))
    _, index, count = np.unique(track, return_inverse=True, return_counts=True)
    return [(features, label, np.minimum(1, FRAMES_COUNTED / count[index]))] if len(label) else []


Part = tuple[FloatArray, IntArray, FloatArray]
"""(n, K, F) features, (n,) labels, 0 to K, and (n,) weights."""


def fit(examples: Sequence[Part]) -> FloatArray:
    """(F,) weights of the features, by Newton's method: the most likely, with a slight ridge."""
    weights = np.zeros(examples[0][0].shape[2])
    likelihood, gradient, curvature = _derivatives(weights, examples)
    for _ in range(100):
        step, share = np.linalg.solve(curvature, gradient), 1.0
        while (found := _derivatives(weights + share * step, examples))[0] < likelihood:
            share /= 2
        weights, gained = weights + share * step, found[0] - likelihood
        likelihood, gradient, curvature = found
        if gained < 1e-6:
            break
    return weights


def _derivatives(
    weights: FloatArray, examples: Sequence[Part]
) -> tuple[float, FloatArray, FloatArray]:
    """The log likelihood with its ridge, its gradient, and the negative of its curvature."""
    likelihood = -RIDGE * float(weights @ weights) / 2
    gradient, curvature = -RIDGE * weights, RIDGE * np.eye(len(weights))
    for features, label, weight in examples:
        n, ids = features.shape[:2]
        odds = np.concatenate([features @ weights, np.zeros((n, 1))], axis=1)
        odds -= odds.max(axis=1, keepdims=True)
        share = np.exp(odds) / np.exp(odds).sum(axis=1, keepdims=True)
        likelihood += float(weight @ np.log(share[np.arange(n), label]))
        true = np.arange(ids) == label[:, None]
        mean = np.einsum("ik,ikf->if", share[:, :-1], features)
        gradient = gradient + np.einsum("i,ik,ikf->f", weight, true - share[:, :-1], features)
        curvature += np.einsum("i,ik,ikf,ikg->fg", weight, share[:, :-1], features, features)
        curvature -= np.einsum("i,if,ig->fg", weight, mean, mean)
    return likelihood, gradient, curvature


def make_model() -> None:
    """Learn and write the built-in model: first what a picture's matches are worth, then with that
    what those of a track are."""
    learned: dict[str, list[float]] = {"picture": [], "track": []}
    for name, lessons in (("picture", lessons_of_pictures), ("track", lessons_of_tracks)):
        parts = [part for parts in in_processes(lessons, SEEDS) for part in parts]
        learned[name] = fit(parts).round(3).tolist()
        MODEL.write_text(
            "# Weights of the features in model.py. Made by `make plate-model`:\n"
            f"# {len(SEEDS)} simulated recordings of {FRAMES} frames, seeds from {SEEDS[0]} on.\n"
            + "".join(f"{key} = {weights}\n" for key, weights in learned.items())
        )


if __name__ == "__main__":
    make_model()
