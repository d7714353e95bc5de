"""The model of drawn plates, learned from simulated recordings: `make plate-model`.

Sets of random drawings, and of AcTag; in each recording plates of the set, plates of other
drawings of the same kind, and bright figures. What is learned is what a match is worth.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields, replace

import cv2
import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.config import preset
from sonarrec.geometry import PolarToFan, plane_from_polar
from sonarrec.landmarks import DrawnSet, landmarks_from_table, load_landmarks
from sonarrec.nouns import Frame
from sonarrec.recogniser.drawn.stage3 import MODEL, PlateEvidence, PlateModel, features
from sonarrec.recogniser.drawn.three_stages import DrawnStages
from sonarrec.simulation.plates import HeldPlate, PlateScene, plate_sonar, render_plates

SEEDS, FRAMES = (*range(1000, 1010), *range(1030, 1050), *range(1060, 1080)), 12
PLACES = ((0.75, 0.0), (1.35, -16.0), (1.4, 16.0))  # m, deg
NEAR_M = 0.06
FRAMES_COUNTED, RIDGE = 4, 0.02
PRIOR = 1.0  # added log odds: these recordings hold far more strangers than there are elsewhere


def random_sets(rng: np.random.Generator) -> tuple[DrawnSet, DrawnSet]:
    """A set, and another of the same kind for strangers."""
    kind, count = rng.integers(3), int(rng.integers(1, 13))
    if kind == 0:
        family = load_landmarks("actag24h4")
        ids = rng.permutation(len(family.ids))[: count + 8].tolist()
        table = {"name": "a", "kind": "drawn", "size_m": 0.3, "family": "actag24h4"}
        mirrored = str(rng.choice(["yes", "no"]))
        made = [
            landmarks_from_table({**table, "ids": part, "mirrored": mirrored}, "here")
            for part in (ids[:count], ids[count:])
        ]
    else:
        side = int(rng.integers(4, 9))
        drawings = [_cells(rng, side) if kind == 1 else _blobs(rng) for _ in range(count + 8)]
        mirrored = str(rng.choice(["yes", "no", "either"]))
        made = [set_of(part, mirrored) for part in (drawings[:count], drawings[count:])]
    one, other = made
    assert isinstance(one, DrawnSet)
    assert isinstance(other, DrawnSet)
    return one, other


def set_of(drawings: Sequence[BoolArray], mirrored: str = "either") -> DrawnSet:
    """A set of plates .3 m wide with IDs from 0."""
    rows = [["".join("01"[int(c)] for c in line) for line in cells] for cells in drawings]
    landmark = [{"id": i, "cells": cells} for i, cells in enumerate(rows)]
    table = {"name": "s", "kind": "drawn", "size_m": 0.3, "landmark": landmark}
    made = landmarks_from_table({**table, "mirrored": mirrored}, "here")
    assert isinstance(made, DrawnSet)
    return made


def _cells(rng: np.random.Generator, side: int) -> BoolArray:
    return np.asarray(rng.random((side, side)) < rng.uniform(0.35, 0.6))


def _blobs(rng: np.random.Generator) -> BoolArray:
    smooth = cv2.GaussianBlur(rng.standard_normal((28, 28)), (0, 0), rng.uniform(1.5, 3))
    return np.asarray(smooth > np.quantile(smooth, rng.uniform(0.4, 0.65)))


def random_scene(seed: int, sets: tuple[DrawnSet, DrawnSet] | None = None) -> PlateScene:
    """A recording of plates of the set and strangers, flat to tilted by 55 deg."""
    rng = np.random.default_rng(seed)
    known, strangers = sets or random_sets(rng)
    plates = []
    for range_m, bearing_deg in PLACES:
        kind = rng.random()
        if kind < 0.15:
            continue
        chosen = known if kind < 0.7 else strangers
        hand = {"yes": True, "no": False, "either": bool(rng.integers(2))}[known.mirrored]
        plates.append(
            HeldPlate(
                landmark=int(rng.choice(chosen.ids)),
                range_m=range_m + rng.uniform(-0.08, 0.08),
                bearing_deg=bearing_deg + rng.uniform(-3, 3),
                turned_deg=rng.uniform(0, 360),
                tilt_deg=rng.uniform(0, 50),
                axis_deg=rng.uniform(-20, 20),
                mirrored=hand,
                bright_db=rng.uniform(5, 12),
                dark_db=rng.uniform(-8, 0),
                known=chosen is known,
            )
        )
    return PlateScene(
        landmark_set=known,
        others=strangers,
        plate=tuple(plates),
        seed=seed,
        frames=FRAMES,
        beams=192,
        bins=320,
        beam_width_deg=rng.uniform(0.4, 1.0),
        swing=rng.uniform(0, 0.6),
        streaks=int(rng.integers(0, 5)),
        light_db=rng.uniform(0, 4),
        clutter=int(rng.integers(0, 5)),
        floor_db=rng.uniform(8, 18),
        blank_every=int(rng.choice([0, 7])),
    )


def lessons(seed: int) -> tuple[FloatArray, ...]:
    """Of every group that shows a plate, in every frame: (n, K) matches, (n,) the rival's and the
    lead, (n,) the index of the true ID or K, (n,) track."""
    scene = random_scene(seed)
    ids = scene.landmark_set.ids
    polar = PolarToFan(plate_sonar(scene).complete("scene"), scene.bins, scene.beams)
    fan = polar.fan
    config = preset("default")
    config = replace(config, features=replace(config.features, beam_width_deg=scene.beam_width_deg))
    stages = DrawnStages(config, fan, scene.landmark_set, "framework")
    found: list[tuple[FloatArray, ...]] = []
    for shot in render_plates(scene):
        frame = Frame(shot.index, shot.timestamp_ns, shot.image, fan, polar=polar)
        image = stages.working_image(frame)
        after = stages.stage2(image, stages.stage1(image))
        evidence = after.evidence
        assert isinstance(evidence, PlateEvidence)
        groups = after.groups
        range_m, bearing_deg = stages._plane.to_polar(*groups.positions.T)
        middles = plane_from_polar(range_m, bearing_deg)
        label = np.full(len(middles), len(ids))
        for true in shot.truth:
            place = plane_from_polar(np.array([true.range_m]), np.array([true.bearing_deg]))
            label[np.hypot(*(middles - place).T) < NEAR_M] = ids.index(true.landmark)
        kept = groups.in_view
        found.append(
            tuple(
                a[kept]
                for a in (evidence.matches, evidence.rival, evidence.lead, label, groups.numbers)
            )
        )
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))


def fit(parts: Sequence[tuple[FloatArray, ...]]) -> FloatArray:
    """(F,) weights of `features`, by Newton's method: the most likely, with a slight ridge.

    A track's frames are much alike: together they count as FRAMES_COUNTED.
    """
    examples = []
    for matches, rival, lead, label, track in parts:
        _, index, count = np.unique(track, return_inverse=True, return_counts=True)
        weight = np.minimum(1, FRAMES_COUNTED / count[index])
        examples.append((features(matches, rival, lead), label, weight))
    weights = np.zeros(4)
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
    weights: FloatArray, examples: Sequence[tuple[FloatArray, IntArray, FloatArray]]
) -> tuple[float, FloatArray, FloatArray]:
    """The log likelihood with its ridge, its gradient, and the negative of its curvature."""
    likelihood = -RIDGE * float(weights @ weights) / 2
    gradient, curvature = -RIDGE * weights, RIDGE * np.eye(len(weights))
    for of_ids, label, weight in examples:
        n, ids = of_ids.shape[:2]
        odds = np.concatenate([of_ids @ weights, np.zeros((n, 1))], axis=1)
        odds -= odds.max(axis=1, keepdims=True)
        share = np.exp(odds) / np.exp(odds).sum(axis=1, keepdims=True)
        likelihood += float(weight @ np.log(share[np.arange(n), label]))
        true = np.arange(ids) == label[:, None]
        mean = np.einsum("ik,ikf->if", share[:, :-1], of_ids)
        gradient = gradient + np.einsum("i,ik,ikf->f", weight, true - share[:, :-1], of_ids)
        curvature += np.einsum("i,ik,ikf,ikg->fg", weight, share[:, :-1], of_ids, of_ids)
        curvature -= np.einsum("i,if,ig->fg", weight, mean, mean)
    return likelihood, gradient, curvature


def make_model() -> None:
    """Learn and write the built-in model, on all cores."""
    with ProcessPoolExecutor() as workers:
        parts = [part for part in workers.map(lessons, SEEDS) if len(part[0])]
    names = [f.name for f in fields(PlateModel)]
    learned = fit(parts)
    learned[0] += PRIOR
    weights = zip(names, learned.tolist(), strict=True)
    head = (
        "# Log odds of an ID against 'none of these': these times the features of stage3.py.\n"
        f"# Made by `make plate-model`: {len(parts)} simulated recordings of {FRAMES} frames,\n"
        f"# seeds from {SEEDS[0]} on.\n"
    )
    MODEL.write_text(head + "".join(f"{name} = {weight:.3f}\n" for name, weight in weights))


if __name__ == "__main__":
    make_model()
