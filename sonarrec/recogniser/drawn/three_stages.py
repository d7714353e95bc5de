"""The three stages for drawn plates, and their score of stage 1."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, Columns, FloatImage, Table
from sonarrec.config import Config
from sonarrec.landmarks import DrawnSet
from sonarrec.recogniser.drawn.drawings import Drawings
from sonarrec.recogniser.drawn.model import built_in_model
from sonarrec.recogniser.drawn.pose import PoseFitter
from sonarrec.recogniser.drawn.stage2 import Plates
from sonarrec.recogniser.drawn.stage3 import PlateMeasurement
from sonarrec.recogniser.estimates import Estimates
from sonarrec.recogniser.motion.odometry import Odometry
from sonarrec.recogniser.plane import Plane, working_plane
from sonarrec.recogniser.restore.beam_width import usual_beam_width_deg
from sonarrec.recogniser.stage1 import CandidateSelector, Levels, ScoreMaps, upsample
from sonarrec.recogniser.stage2 import ContinuityFilter
from sonarrec.recogniser.stage3.appearance import HALF_POWER
from sonarrec.recogniser.three_stages import FRAMEWORK, ThreeStages
from sonarrec.recogniser.tracks import Tracks
from sonarrec.sonar.frame import Fan, Motion, Selection
from sonarrec.sonar.geometry import PoseTable

HALF_SIDE_PX = 20.0  # half a plate's side in the working image, where the fan is no coarser


class PlateStages(ThreeStages):
    """The three stages for drawn plates."""

    _measurement: PlateMeasurement

    def __init__(
        self,
        config: Config,
        fan: Fan,
        landmarks: DrawnSet,
        method: str = FRAMEWORK,
        poses: PoseTable | None = None,
    ) -> None:
        """The arguments are those of DiscStages."""
        fitter = pose_fitter(config, fan, landmarks)
        plane, features = fitter.plane, config.features
        beam_width_deg = features.beam_width_deg or usual_beam_width_deg(fan)
        # A plate may be held: how the floor moves in the images says nothing of it.
        continuity = replace(config.continuity, motion="random_walk")
        self.plane, self.method = plane, method
        self._select = CandidateSelector(
            config.candidates, plane, landmarks, beam_width_deg, PlateScore(plane)
        )
        self.odometry = Odometry(plane, continuity, None if landmarks.pose == "free" else poses)
        self._tracks = Tracks()
        rng = np.random.default_rng(config.seed)
        groups = ContinuityFilter(continuity, plane, self._tracks, rng)
        self._plates = Plates(fitter, self._tracks, groups)
        self._measurement = PlateMeasurement(fitter, self._tracks, features.memory_frames)
        self._estimates = Estimates(config, plane, landmarks)

    def _follow(
        self, image: ByteImage, candidates: Selection, motion: Motion | None
    ) -> tuple[Table, Columns]:
        # Track the candidates by groups of particles (Eq. 3 and 4), and fit a pose to each plate.
        tracks = self._plates.step(image, candidates, motion)
        # Average the pictures of the plates along their tracks.
        return tracks.with_columns(**self._measurement.gather()), {}


def pose_fitter(config: Config, fan: Fan, landmarks: DrawnSet) -> PoseFitter:
    """What finds plates in a plane of their own."""
    # Without height there is no floor below the sonar: the plane is that of the fan itself.
    seen = replace(fan, height_m=0.0) if landmarks.pose == "free" else fan
    plane = working_plane("floor", seen, landmarks.radius_m, HALF_SIDE_PX)
    beam_width_deg = config.features.beam_width_deg or usual_beam_width_deg(fan)
    beam_sigma = float(np.radians(beam_width_deg / HALF_POWER))
    return PoseFitter(Drawings(landmarks), plane, landmarks.pose, beam_sigma, built_in_model())


# Sides of the window, in sides of a plate: along the range a tilted one is shorter.
WINDOW = (0.9, 0.65)
LEAST_SEEN = 0.7  # of the window inside the fan
# A drawing's levels differ between a tenth and half of a side. So many sigmas of the frame's grey
# levels, with those by which the whole is brighter than its surroundings, score 1; plates have .7
# to 1.9.
FULL_CONTRAST = 1.7
FINE_SHARE, BROAD_SHARE = 1 / 10, 1 / 2


class PlateScore:
    """How uneven a plate-sized window is inside, and how bright over its surroundings."""

    def __init__(self, plane: Plane) -> None:
        side = 2 * plane.axes[0]
        self._window = tuple(max(3, round(share * side)) for share in WINDOW)
        self._sizes = tuple(max(1, round(share * side)) for share in (FINE_SHARE, BROAD_SHARE))
        self._inside = plane.inside
        inside = plane.inside.astype(np.float32)
        seen = np.asarray(cv2.blur(inside, self._window), np.float32)
        self._share = np.where(seen >= LEAST_SEEN, 1 / np.maximum(seen, 0.1), 0).astype(np.float32)

    def __call__(self, image: ByteImage, levels: Levels) -> ScoreMaps:
        """As of `Detector`."""
        around, sigma = upsample(levels.mean, image.shape), levels.frame_sigma
        relief = (image - around) * self._inside
        fine, broad = (cv2.blur(relief, (size, size)) for size in self._sizes)
        inner = np.maximum(self._mean((fine - broad) ** 2), 0)
        bright = np.maximum(self._mean(relief), 0)
        score = np.sqrt(inner + bright**2) / np.float32(FULL_CONTRAST * sigma)
        # Of plateaus the middle is the candidate.
        peaks = np.asarray(cv2.GaussianBlur(score, (0, 0), self._sizes[0]), np.float32)
        return ScoreMaps(score, peaks, score, np.full((1, 1), sigma, np.float32))

    def _mean(self, values: FloatImage) -> FloatImage:
        return np.asarray(cv2.blur(values, self._window) * self._share, np.float32)
