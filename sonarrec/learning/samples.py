"""Makes samples from recordings with truth: every track in every frame, described and labelled."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.config import Config
from sonarrec.geometry import plane_from_polar
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.restore.saturation import Levels
from sonarrec.recogniser.restore.static_pixels import Unchanging
from sonarrec.recogniser.stage3.description import FEATURES
from sonarrec.recogniser.three_stages import DiscStages
from sonarrec.records import Fan, Frame

# In disc diameters: a track up to ON from a true centre shows the landmark, one farther than OFF
# does not. Those between are left out.
ON, OFF = 0.25, 0.5
HIDDEN = -1
"""The label of a track on a landmark that nothing is seen of."""


@dataclass(frozen=True, slots=True)
class Tracks:
    """One recording's frames, and every track in every frame, described.

    frame, timestamp_ns: (F,) of the frames. row: (n,) index into frame, rising. number: (n,) of the
    track. position: (n, 2) metres in the fan plane, right and ahead of the sonar. features:
    (n, K, F). smear: (n,) the beam's standard deviation across the line of sight, in disc radii.
    """

    name: str
    landmarks: LandmarkSet
    fan: Fan | None
    frame: IntArray
    timestamp_ns: IntArray
    row: IntArray
    number: IntArray
    position: FloatArray
    features: FloatArray
    smear: FloatArray


@dataclass(frozen=True, slots=True)
class Samples:
    """Described tracks with what they truly are.

    features: (n, K, F). smear: (n,) as Tracks. label: (n,) index of the ID in the set, K for 'none
    of these', HIDDEN where nothing can be learned. track: (n,) number of the track.
    """

    features: FloatArray
    smear: FloatArray
    label: IntArray
    track: IntArray


class _Recorder:
    """Takes the place of the model while samples are gathered; keeps the last features."""

    every_frame: ClassVar = True
    features: FloatArray
    smear: FloatArray

    def probabilities(self, features: FloatArray, smear: FloatArray) -> FloatArray:
        self.features, self.smear = features, smear
        n, ids, _ = features.shape
        return np.full((n, ids + 1), 1 / (ids + 1))


def describe(
    frames: Iterable[Frame], config: Config, landmarks: LandmarkSet, *, name: str = ""
) -> Tracks:
    """Run stages 1 and 2 over a recording and describe every track in every frame."""
    recorder = _Recorder()
    recogniser = fan = None
    times: list[tuple[int, int]] = []
    where: list[tuple[int, int]] = []
    polar: list[tuple[float, float]] = []
    features: list[FloatArray] = [np.empty((0, len(landmarks.ids), len(FEATURES)), np.float32)]
    smear: list[FloatArray] = [np.empty(0)]
    pictures = Levels(landmarks.radius_m).restored(Unchanging().filled(frames))
    for row, frame in enumerate(pictures):
        fan = fan or frame.fan
        recogniser = recogniser or DiscStages(config, fan, landmarks, recorder, smi=None)
        tracks = recogniser.step(frame).estimates
        times.append((frame.index, frame.timestamp_ns))
        where += [(row, e.object) for e in tracks]
        polar += [(e.range_m, e.bearing_deg) for e in tracks]
        features.append(recorder.features[: len(tracks)].astype(np.float32))  # half the memory
        smear.append(recorder.smear[: len(tracks)])
    index, stamp, of_frame, number = (
        column for pairs in (times, where) for column in np.array(pairs, np.int64).reshape(-1, 2).T
    )
    position = plane_from_polar(*np.array(polar).reshape(-1, 2).T)
    described = np.concatenate(features), np.concatenate(smear)
    return Tracks(name, landmarks, fan, index, stamp, of_frame, number, position, *described)


def _distances(
    tracks: Tracks, row: IntArray, position: FloatArray
) -> Iterator[tuple[slice, FloatArray]]:
    """(the tracks of its frame, their distances from it in disc diameters) of each landmark."""
    first, end = (np.searchsorted(tracks.row, row, side) for side in ("left", "right"))
    diameter = 2 * tracks.landmarks.radius_m
    for a, b, where in zip(first, end, position, strict=True):
        yield slice(a, b), np.linalg.norm(tracks.position[a:b] - where, axis=1) / diameter


def on_a_track(tracks: Tracks, row: IntArray, position: FloatArray) -> BoolArray:
    """(T,) whether a track lies on each landmark. row, position: as in `label`."""
    distances = _distances(tracks, row, position)
    return np.array([bool((distance <= ON).any()) for _, distance in distances], dtype=bool)


def label(tracks: Tracks, row: IntArray, landmark: IntArray, position: FloatArray) -> Samples:
    """Label the tracks of a recording by its truth.

    row: (T,) index into tracks.frame of each landmark that is at least partly in view. landmark:
    (T,) its index in the set, or HIDDEN. position: (T, 2) as Tracks.position.
    """
    ids = len(tracks.landmarks.ids)
    labels, nearest = np.full(len(tracks.row), ids), np.full(len(tracks.row), np.inf)
    for what, (here, distance) in zip(landmark, _distances(tracks, row, position), strict=True):
        closer = distance < nearest[here]
        labels[here][closer], nearest[here][closer] = what, distance[closer]
    labels[nearest > ON] = ids
    taught = (nearest <= ON) | (nearest > OFF)
    return Samples(
        tracks.features[taught], tracks.smear[taught], labels[taught], tracks.number[taught]
    )
