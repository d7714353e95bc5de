"""The default measurement: the appearance of a disc's shape matrix, averaged along its track.

The paper measures each frame by itself, and normalising its similarities loses 'this is no
landmark'. Here the grey shape matrix is averaged in the object's own frame (track_matrix.py),
described under every ID (description.py), and judged by a model of landmarks (model.py). The
beliefs of the track's frames so far are pooled (opinions.py), in place of Eq. 5 to 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, joined
from sonarrec.config import Features
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Groups
from sonarrec.recogniser.plane import Plane
from sonarrec.recogniser.stage3 import Beliefs, Evidence, likeliest
from sonarrec.recogniser.stage3.description import Describer
from sonarrec.recogniser.stage3.opinions import TrackBelief
from sonarrec.recogniser.stage3.shape_matrix import ShapeSampler
from sonarrec.recogniser.stage3.track_matrix import TrackMatrix

# An ID is declared from the LEAST_FRAMES-th frame of a track on, if enough of the disc is in view.
# Discs fewer than FEW_BEAMS beams wide need more, since one frame hardly shows their symbol.
LEAST_FRAMES, FEW_BEAMS, FRAMES_OF_FEW_BEAMS = 2, 5, 8
HALF_POWER = 2 * (2 * np.log(2)) ** 0.5  # width of a Gaussian at half power, in its sigmas


class Classifier(Protocol):
    """Judges discs by their features."""

    def probabilities(self, features: FloatArray, smear: FloatArray) -> FloatArray:
        """(n, K + 1): every ID, then 'none of these'; rows sum to 1.

        features: (n, K, F). smear: (n,) the beam's sigma across the line of sight, in disc radii.
        """
        ...


class AppearanceMeasurement:
    """Beliefs from each track's averaged shape matrix, frame by frame."""

    def __init__(
        self,
        config: Features,
        plane: Plane,
        sampler: ShapeSampler,
        landmarks: LandmarkSet,
        model: Classifier,
        beam_width_deg: float,
        remember_frames: int,
    ) -> None:
        """remember_frames: as in TrackBelief."""
        self._plane = plane
        self._matrix = TrackMatrix(config.memory_frames, len(sampler.radii))
        self._describe = Describer(
            sampler.bands, sampler.radii, landmarks, correlation_length=config.alike_radii
        )
        self._model = model
        self._belief = TrackBelief(len(landmarks.ids), remember_frames)
        self._beam_sigma = np.radians(beam_width_deg / HALF_POWER)
        self._radius_m = landmarks.radius_m

    def gather(self, groups: Groups, grey: FloatArray, seen: BoolArray) -> Evidence:
        """Add a frame's matrices to the tracks' averages, see Measurement."""
        return self._matrix.step(groups, grey, seen)

    def beliefs(self, groups: Sequence[Groups], evidence: Evidence) -> Beliefs:
        """The beliefs, see Measurement."""
        tracked = joined(groups)
        smear = self._smear(tracked.positions)
        description = self._describe(evidence.brightness, evidence.count, tracked.existence, smear)
        of_frames = self._model.probabilities(description.features, smear)
        probabilities = self._belief(groups, evidence, of_frames)
        best, _ = likeliest(probabilities)
        at = (np.arange(len(best)), best)
        # A beam is HALF_POWER sigmas wide, a disc two radii.
        few_beams = smear * HALF_POWER * FEW_BEAMS > 2
        earned = evidence.frames >= np.where(few_beams, FRAMES_OF_FEW_BEAMS, LEAST_FRAMES)
        earned &= tracked.in_view
        return Beliefs(
            probabilities, description.rotation[at], description.rotation_sigma[at], earned
        )

    def _smear(self, positions: FloatArray) -> FloatArray:
        """(n,) the beam's standard deviation across the line of sight, in disc radii.

        positions: (n, 2) working pixels.
        """
        range_m, _ = self._plane.to_polar(*positions.T)
        return np.asarray(self._beam_sigma * range_m / self._radius_m)
