"""The three stages for drawn plates, on one screen: as `recogniser/three_stages.py` for discs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray, FloatImage
from sonarrec.config import Config
from sonarrec.geometry import PoseTable
from sonarrec.landmarks import DrawnSet
from sonarrec.nouns import Fan, FrameResult, Selection
from sonarrec.recogniser.between_stages import AfterStage2, Batch, WorkingImage
from sonarrec.recogniser.drawn.drawings import Drawings
from sonarrec.recogniser.drawn.model import built_in_model
from sonarrec.recogniser.drawn.pose import PoseFitter
from sonarrec.recogniser.drawn.stage2 import Plates
from sonarrec.recogniser.drawn.stage3 import PlateEvidence, PlateMeasurement
from sonarrec.recogniser.estimates import EstimateMaker
from sonarrec.recogniser.motion.odometry import Odometry
from sonarrec.recogniser.plane import Plane, working_plane
from sonarrec.recogniser.restore.beam_width import usual_beam_width_deg
from sonarrec.recogniser.stage1 import CandidateSelector, ScoreMaps
from sonarrec.recogniser.stage2 import ContinuityFilter
from sonarrec.recogniser.stage3.appearance import HALF_POWER
from sonarrec.recogniser.three_stages import ThreeStages

HALF_SIDE_PX = 20.0  # half a plate's side in the working image, where the fan is no coarser
SMOOTH_PX = 0.7  # a picture's samples lie further apart than pixels


class DrawnStages(ThreeStages):
    """As ThreeStages, for drawn plates: another score in stage 1, poses, and pictures of plates."""

    def __init__(
        self,
        config: Config,
        fan: Fan,
        landmarks: DrawnSet,
        method: str,
        poses: PoseTable | None = None,
    ) -> None:
        self.fan = fan
        rng = np.random.default_rng(config.seed)
        features = config.features
        # Without height there is no floor below the sonar: the plane is that of the fan itself.
        seen = replace(fan, height_m=0.0) if landmarks.pose == "free" else fan
        plane = working_plane("floor", seen, landmarks.radius_m, HALF_SIDE_PX)
        self._plane = plane
        beam_width_deg = features.beam_width_deg or usual_beam_width_deg(fan)
        self._select = CandidateSelector(
            config.candidates, plane, landmarks, beam_width_deg, PlateScore(plane)
        )
        # A plate may be held: how the floor moves in the images says nothing of it.
        continuity = replace(config.continuity, motion="random_walk")
        self.odometry = Odometry(plane, continuity, None if landmarks.pose == "free" else poses)
        self._continuity = ContinuityFilter(continuity, plane, rng)
        drawings, model = Drawings(landmarks), built_in_model()
        beam_sigma = float(np.radians(beam_width_deg / HALF_POWER))
        self._fitter = PoseFitter(drawings, plane, landmarks.pose, beam_sigma, model)
        self._plates = Plates(self._fitter, plane)
        self._pictures = PlateMeasurement(
            drawings, self._fitter, model, features.memory_frames, continuity.remember_frames
        )
        self._estimates = EstimateMaker(config, plane, landmarks)
        self._method = method

    def stage2(self, frame: WorkingImage, selection: Selection) -> AfterStage2:
        """Continuity evaluation: which candidates are objects that persist, and in which pose?"""
        image = smooth(frame.image)
        motion = self.odometry.step(frame.image, frame.timestamp_ns)
        self._plates.follow(image)
        known = motion if motion is not None and motion.known else None
        groups = self._continuity.step(self._plates.lead(selection), known)
        groups = self._plates.join(image, groups)
        self._continuity.centre(groups)
        sight = self._plane.line_of_sight(groups.positions)
        evidence, drawings = self._pictures.gather(groups, self._plates.of(groups), sight)
        self._plates.believe(groups.numbers, drawings)
        return AfterStage2(
            frame=frame.frame,
            timestamp_ns=frame.timestamp_ns,
            candidates=selection.positions,
            scores=selection.scores,
            grey=np.empty((len(selection.positions), 0, 0)),
            seen=np.empty((len(selection.positions), 0, 0), bool),
            groups=groups,
            evidence=evidence,
            motion=motion,
        )

    def stage3(self, frames: Sequence[AfterStage2]) -> list[FrameResult]:
        """Feature estimation: which drawing is on each plate?"""
        batch = Batch(frames)
        beliefs = self._pictures.beliefs(batch.groups, batch.evidence)
        estimates = self._estimates.of_groups(self._method, batch, beliefs)
        assert isinstance(batch.evidence, PlateEvidence)
        corners = batch.evidence.corners
        polar = np.stack(self._plane.to_polar(corners[..., 0], corners[..., 1]), axis=2)
        with_corners = [
            estimate if np.isnan(of_plate).any() else replace(estimate, corners=_from_far(of_plate))
            for estimate, of_plate in zip(estimates, polar, strict=True)
        ]
        return batch.results([], with_corners)


def smooth(image: ByteImage) -> FloatImage:
    """A working image as poses are fitted in."""
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), SMOOTH_PX), np.float32)


def _from_far(corners: FloatArray) -> FloatArray:
    """(4, 2) corners, with the two of the far edge first. corners: range first."""
    edges = corners[:, 0] + np.roll(corners[:, 0], -1)
    return np.roll(corners, -int(edges.argmax()), axis=0)


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
        inside = plane.inside.astype(np.float32)
        seen = np.asarray(cv2.blur(inside, self._window), np.float32)
        self._share = np.where(seen >= LEAST_SEEN, 1 / np.maximum(seen, 0.1), 0).astype(np.float32)

    def __call__(self, _: ByteImage, relief: FloatImage, sigma: float) -> ScoreMaps:
        """As of `Detector`."""
        fine, broad = (cv2.blur(relief, (size, size)) for size in self._sizes)
        inner = np.maximum(self._mean((fine - broad) ** 2), 0)
        bright = np.maximum(self._mean(relief), 0)
        score = np.sqrt(inner + bright**2) / np.float32(FULL_CONTRAST * sigma)
        # Of plateaus the middle is the candidate.
        peaks = np.asarray(cv2.GaussianBlur(score, (0, 0), self._sizes[0]), np.float32)
        return ScoreMaps(score, peaks, score, np.full((1, 1), sigma, np.float32))

    def _mean(self, values: FloatImage) -> FloatImage:
        return np.asarray(cv2.blur(values, self._window) * self._share, np.float32)
