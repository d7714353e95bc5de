"""Makes samples from recordings with truth: the pictures of every track, and what they show."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray, joined, selected
from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.restore.saturation import Levels
from sonarrec.recogniser.restore.static_pixels import Unchanging
from sonarrec.recogniser.stage3.appearance import LEAST_EXISTENCE
from sonarrec.recogniser.stage3.reader import Pictures, Reading
from sonarrec.recogniser.stage3.shape_matrix import ANGLES
from sonarrec.recogniser.three_stages import DiscStages
from sonarrec.sonar.frame import Fan, Frame
from sonarrec.sonar.geometry import plane_from_polar

# In disc diameters: a track up to ON from a true centre shows the landmark, one farther than OFF
# does not. Those between are left out.
ON, OFF = 0.25, 0.5
HIDDEN = -1
"""The label of a track on a landmark that nothing is seen of."""


@dataclass(frozen=True, slots=True)
class Tracks:
    """One recording's frames, and the picture of every track in every frame."""

    name: str
    landmarks: LandmarkSet
    fan: Fan | None
    frame: IntArray
    timestamp_ns: IntArray
    """frame, timestamp_ns: (F,) of the frames."""
    row: IntArray
    """(n,) index into frame, rising."""
    number: IntArray
    """(n,) of the track."""
    position: FloatArray
    """(n, 2) metres in the fan plane, right and ahead of the sonar."""
    pictures: Pictures
    """Of the tracks."""


@dataclass(frozen=True, slots=True)
class Samples:
    """Pictures of tracks, with what these truly are."""

    pictures: Pictures
    label: IntArray
    """(n,) index of the ID in the set, K for 'none of these', HIDDEN where nothing can be
    learned."""
    track: IntArray
    """(n,) number of the track."""


class _Recorder:
    """Takes the place of the reader while samples are gathered; keeps the last pictures."""

    every_frame: ClassVar = True
    pictures: Pictures

    def __init__(self, ids: int) -> None:
        self._ids = ids

    def __call__(self, pictures: Pictures, /) -> Reading:
        self.pictures = pictures
        n, ids = len(pictures.smear), self._ids
        nothing = np.zeros((n, ids))
        return Reading(np.zeros((n, ANGLES)), np.zeros(n), np.zeros((n, ids + 1)), nothing, nothing)


def describe(
    frames: Iterable[Frame],
    config: Config,
    landmarks: LandmarkSet,
    *,
    name: str = "",
    every: int = 1,
) -> Tracks:
    """Run stages 1 and 2 over a recording. Tracks that may well be nothing, which stage 3 does not
    read, are left out. every: the tracks of every n-th frame are kept.
    """
    recorder = _Recorder(len(landmarks.ids))
    recogniser = fan = None
    times: list[tuple[int, int]] = []
    where: list[tuple[int, int]] = []
    polar: list[tuple[float, float]] = []
    of_frames: list[Pictures] = []
    pictures = Levels(landmarks.radius_m).restored(Unchanging().filled(frames))
    for row, frame in enumerate(pictures):
        fan = fan or frame.fan
        recogniser = recogniser or DiscStages(config, fan, landmarks, recorder, smi=None)
        tracks = recogniser.step(frame).estimates
        times.append((frame.index, frame.timestamp_ns))
        if row % every:
            continue
        likely = np.flatnonzero(recorder.pictures.existence >= LEAST_EXISTENCE)
        where += [(row, tracks[i].object) for i in likely]
        polar += [(tracks[i].range_m, tracks[i].bearing_deg) for i in likely]
        kept = selected(recorder.pictures, likely)
        cells = {k: getattr(kept, k).astype(np.float16) for k in ("brightness", "count")}
        of_frames.append(replace(kept, **cells))  # in a quarter of the memory
    index, stamp, of_frame, number = (
        column for pairs in (times, where) for column in np.array(pairs, np.int64).reshape(-1, 2).T
    )
    position = plane_from_polar(*np.array(polar).reshape(-1, 2).T)
    return Tracks(name, landmarks, fan, index, stamp, of_frame, number, position, joined(of_frames))


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
    for what, (near, distance) in zip(landmark, _distances(tracks, row, position), strict=True):
        closer = distance < nearest[near]
        labels[near][closer], nearest[near][closer] = what, distance[closer]
    labels[nearest > ON] = ids
    taught = (nearest <= ON) | (nearest > OFF)
    return Samples(selected(tracks.pictures, taught), labels[taught], tracks.number[taught])
