"""The default measurement: the symbol read off a disc's shape matrix, averaged along its track.

The paper measures each frame by itself. It normalises the similarities, so that they cannot say
that a disc is no landmark. Here the grey shape matrix is averaged in the object's own frame
(track_matrix.py), and small networks read its symbol, whatever that is (reader.py). The beliefs
of the track's frames so far are pooled (opinions.py), in place of Eq. 5 to 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, joined
from sonarrec.config import Features
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.plane import Plane
from sonarrec.recogniser.stage3 import Beliefs, Evidence, likeliest
from sonarrec.recogniser.stage3.opinions import TrackBelief
from sonarrec.recogniser.stage3.reader import Pictures, Reading, sigmoid
from sonarrec.recogniser.stage3.shape_matrix import ANGLES, ShapeSampler
from sonarrec.recogniser.stage3.track_matrix import TrackMatrix
from sonarrec.records import Groups

# An ID is declared from the LEAST_FRAMES-th frame of a track on, if enough of the disc is in view.
# Discs fewer than FEW_BEAMS beams wide need more, since one frame hardly shows their symbol.
LEAST_FRAMES, FEW_BEAMS, FRAMES_OF_FEW_BEAMS = 2, 5, 8
# Most new tracks arise by chance and end soon. So a track is judged from its LEAST_FRAMES-th frame
# on, if its object exists with at least the probability LEAST_EXISTENCE.
LEAST_EXISTENCE = 0.5
HALF_POWER = 2 * (2 * np.log(2)) ** 0.5  # width of a Gaussian at half power, in its sigmas


class Reads(Protocol):
    """Reads symbols off pictures: a Reader, or what keeps the pictures to learn from."""

    every_frame: ClassVar[bool]
    """True while samples are gathered: every track is read in every frame."""

    def __call__(self, pictures: Pictures, /) -> Reading:
        """What is read off n pictures."""
        ...


class AppearanceMeasurement:
    """Beliefs from each track's averaged shape matrix, frame by frame."""

    least_frames: int = LEAST_FRAMES
    """Of a track, before it is judged."""

    def __init__(
        self,
        config: Features,
        plane: Plane,
        sampler: ShapeSampler,
        landmarks: LandmarkSet,
        read: Reads,
        beam_width_deg: float,
        remember_frames: int,
    ) -> None:
        """remember_frames: as in TrackBelief."""
        self._plane = plane
        self._matrix = TrackMatrix(config.memory_frames, len(sampler.radii))
        self._read = read
        self._ids = len(landmarks.ids)
        self._belief = TrackBelief(len(landmarks.ids), remember_frames)
        self._beam_sigma = np.radians(beam_width_deg / HALF_POWER)
        self._radius_m = landmarks.radius_m

    def gather(self, groups: Groups, grey: FloatArray, seen: BoolArray) -> Evidence:
        """Add a frame's matrices (n, L, ANGLES), from ShapeSampler, to the tracks' averages."""
        return self._matrix.step(groups, grey, seen)

    def beliefs(self, groups: Sequence[Groups], evidence: Evidence) -> Beliefs:
        """Beliefs about the groups of consecutive frames; evidence: from `gather`, concatenated."""
        tracked = joined(groups)
        smear = self._smear(tracked.positions)
        # Judge the tracks that are likely to be objects; of the others nothing is known.
        likely = evidence.frames >= self.least_frames
        likely &= tracked.existence >= LEAST_EXISTENCE
        due = np.flatnonzero(likely | self._read.every_frame)
        reading = self._read(
            Pictures(
                evidence.brightness[due], evidence.count[due], tracked.existence[due], smear[due]
            )
        )
        n, ids = len(smear), self._ids
        of_frames = np.full((n, ids + 1), 1 / (ids + 1))
        rotation, rotation_sigma = np.zeros((n, ids)), np.full((n, ids), np.nan)
        lit = np.full((n, ANGLES), np.nan)
        of_frames[due], lit[due] = reading.probabilities, sigmoid(reading.lit)
        rotation[due], rotation_sigma[due] = reading.rotation, reading.rotation_sigma
        probabilities = self._belief(groups, evidence, of_frames)
        best, _ = likeliest(probabilities)
        # A beam is HALF_POWER sigmas wide, a disc two radii.
        few_beams = smear * HALF_POWER * FEW_BEAMS > 2
        least_frames = np.where(few_beams, FRAMES_OF_FEW_BEAMS, self.least_frames)
        enough_evidence = evidence.frames >= least_frames
        enough_evidence &= tracked.in_view
        return Beliefs(
            probabilities,
            rotation[np.arange(n), best],
            rotation_sigma[np.arange(n), best],
            enough_evidence,
            lit=lit,
        )

    def _smear(self, positions: FloatArray) -> FloatArray:
        """(n,) the beam's standard deviation across the line of sight, in disc radii.

        positions: (n, 2) working pixels.
        """
        range_m, _ = self._plane.to_polar(*positions.T)
        return np.asarray(self._beam_sigma * range_m / self._radius_m)
