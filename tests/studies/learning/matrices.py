"""Averaged shape matrices of simulated recordings, kept on disk with what they truly show.

Another description of the same matrices is then tried in seconds, without running stages 1 and 2.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from unittest.mock import patch

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.config import preset
from sonarrec.geometry import PolarToFan, plane_from_polar
from sonarrec.landmarks import LandmarkSet
from sonarrec.learning.samples import HIDDEN, Samples, Tracks, describe, label
from sonarrec.nouns import Frame
from sonarrec.recogniser.stage3.description import Describer
from sonarrec.recogniser.stage3.shape_matrix import ShapeSampler
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import Scene, scene_sonar
from sonarrec.simulation.truth import Truth
from tests.studies.learning.random_scenes import random_scene
from tests.studies.learning.second_renderer import MAP_KINDS, map_frames, map_scene

FRAMES = 64  # of each recording: more recordings teach more than longer ones
EVERY = 3  # so many frames apart are those that are kept: neighbours are alike


@dataclass(frozen=True, slots=True)
class Matrices:
    """What is kept of one recording; of n tracks in frames."""

    kind: str
    landmarks: LandmarkSet
    average: FloatArray
    """(n, L, ANGLES), and so is `count`: as Describer takes them."""
    count: FloatArray
    existence: FloatArray
    smear: FloatArray
    label: IntArray
    track: IntArray

    def samples(self) -> Samples:
        """The FEATURES of all tracks in frames, with their labels."""
        sampler = ShapeSampler(self.landmarks, (1.0, 1.0))
        length = preset("default").features.alike_radii
        describer = Describer(sampler.bands, sampler.radii, self.landmarks, length)
        features = describer(self.average, self.count, self.existence, self.smear).features
        return Samples(features, self.smear, self.label, self.track)


def gathered(wanted: Sequence[tuple[str, int]], folder: Path) -> list[tuple[str, Samples]]:
    """Kind and samples of recordings of these kinds and seeds; on all cores."""
    folder.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor() as workers:
        kinds, seeds = zip(*wanted, strict=True)
        paths = workers.map(gather, kinds, seeds, repeat(folder), chunksize=4)
        return list(workers.map(_samples, list(paths), chunksize=16))


def _samples(path: Path) -> tuple[str, Samples]:
    matrices = read(path)
    return matrices.kind, matrices.samples()


def gather(kind: str, seed: int, folder: Path) -> Path:
    """Recognise a recording as far as stage 2, and keep its matrices; returns their file."""
    path = folder / f"{kind}_{seed}.npz"
    if path.exists():
        return path
    truth: list[tuple[int, Truth]] = []
    if kind in MAP_KINDS:
        scene = map_scene(seed, kind, FRAMES)
        frames = map_frames(scene, kind, truth)
    else:
        scene = random_scene(seed, kind, wide=True, frames=FRAMES)
        frames = scene_frames(scene, truth)
    given: list[tuple[FloatArray, ...]] = []
    described = Describer.__call__

    def listen(self: Describer, *matrices: FloatArray) -> object:
        given.append(matrices)
        return described(self, *matrices)

    with patch.object(Describer, "__call__", listen):
        tracks = describe(frames, preset("default"), scene.landmark_set)
    # In place of features, the number of the track in the recording: what becomes of it is kept.
    numbered = replace(tracks, features=np.arange(len(tracks.row))[:, None, None])
    samples = labelled(numbered, truth)
    chosen = samples.features[:, 0, 0]
    kept = (samples.label != HIDDEN) & (tracks.row[chosen] % EVERY == 0)
    columns = [np.concatenate(column)[chosen[kept]] for column in zip(*given, strict=True)]
    half = [column.astype(np.float16) for column in columns[:2]]
    discs = scene.landmark_set
    partial = path.with_suffix(".part.npz")
    np.savez(
        partial,
        **dict(zip(("average", "count"), half, strict=True)),
        **dict(zip(("existence", "smear"), columns[2:], strict=True)),
        label=samples.label[kept],
        track=samples.track[kept],
        ids=discs.ids,
        sectors=discs.sectors,
        sizes=[discs.radius_m, *discs.ring, *discs.symbol],
    )
    partial.rename(path)
    return path


def read(path: Path) -> Matrices:
    """The matrices that `gather` kept."""
    kept = dict(np.load(path))
    radius, *bands = kept.pop("sizes").tolist()
    sectors = tuple(map(tuple, kept.pop("sectors").tolist()))
    ids = tuple(kept.pop("ids").tolist())
    discs = LandmarkSet("kept", radius, (bands[0], bands[1]), (bands[2], bands[3]), ids, sectors)
    average, count = (kept.pop(name).astype(float) for name in ("average", "count"))
    return Matrices(path.stem.rpartition("_")[0], discs, average, count, **kept)


def labelled(tracks: Tracks, truth: Iterable[tuple[int, Truth]]) -> Samples:
    """The tracks of a simulated recording with what they truly are. truth: with its frames."""
    truth = list(truth)
    polar = np.array([(t.range_m, t.bearing_deg) for _, t in truth]).reshape(-1, 2)
    return label(
        tracks,
        np.array([row for row, _ in truth], np.int64),
        np.array([tracks.landmarks.ids.index(t.landmark) for _, t in truth], np.int64),
        plane_from_polar(*polar.T),
    )


def scene_frames(scene: Scene, truth: list[tuple[int, Truth]]) -> Iterator[Frame]:
    """A scene's frames as a reader would give them; their truth is added to `truth`."""
    polar = None
    for frame in render(scene):
        truth += [(frame.index, landmark) for landmark in frame.truth]
        if scene.sonar.layout == "polar" and polar is None:
            polar = PolarToFan(scene_sonar(scene).complete(scene.name), *frame.image.shape)
        yield Frame(frame.index, frame.timestamp_ns, frame.image, frame.fan, polar=polar)
