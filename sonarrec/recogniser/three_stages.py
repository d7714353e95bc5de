"""The three stages of one preset over the frames of one log, on one screen."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from sonarrec.config import Config
from sonarrec.geometry import PoseTable
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Fan, Frame, FrameResult, Selection
from sonarrec.recogniser.between_stages import AfterStage2, Batch, WorkingImage
from sonarrec.recogniser.estimates import EstimateMaker
from sonarrec.recogniser.motion.odometry import Odometry
from sonarrec.recogniser.plane import working_plane
from sonarrec.recogniser.restore.beam_width import usual_beam_width_deg
from sonarrec.recogniser.stage1 import CandidateSelector
from sonarrec.recogniser.stage2 import ContinuityFilter
from sonarrec.recogniser.stage3 import Measurement, shape_matrix
from sonarrec.recogniser.stage3.appearance import AppearanceMeasurement, Classifier
from sonarrec.recogniser.stage3.model import built_in_model
from sonarrec.recogniser.stage3.published import PublishedMeasurement
from sonarrec.recogniser.stage3.smi import identify

SMI = "smi"
FRAMEWORK = "framework"


class ThreeStages:
    """Frames of one log in, estimates out, in the log's order.

    Everything random comes from one generator seeded by the configuration: the same frames and
    settings give the same estimates.
    """

    def __init__(
        self,
        config: Config,
        fan: Fan,
        landmarks: LandmarkSet,
        model: Classifier | None = None,
        method: str = FRAMEWORK,
        smi: str | None = SMI,
        poses: PoseTable | None = None,
    ) -> None:
        """fan: the geometry of all frames of the log. model: by default the built-in one.

        method: name of the framework in the estimates. smi: name of the single-frame method; None
        if it is not to run. poses: of the sonar; where they give its motion, that is not measured
        in the images.
        """
        self.fan = fan
        rng = np.random.default_rng(config.seed)
        select, features, radius_m = config.candidates, config.features, landmarks.radius_m
        self._plane = plane = working_plane(select.plane, fan, radius_m, select.disc_radius_px)
        beam_width_deg = features.beam_width_deg or usual_beam_width_deg(fan)
        self._select = CandidateSelector(select, plane, landmarks, beam_width_deg)
        self.odometry = Odometry(plane, config.continuity, poses)
        self._continuity = ContinuityFilter(config.continuity, plane, rng)
        self._sampler = sampler = shape_matrix.ShapeSampler(landmarks, plane.axes)
        codes = shape_matrix.rotated_codes(landmarks)
        self._identify = partial(identify, bands=sampler.bands, codes=codes)
        self._measurement: Measurement
        if features.measurement == "single":
            self._measurement = PublishedMeasurement(
                features, self._identify, landmarks, fan.window_m
            )
        else:
            self._measurement = AppearanceMeasurement(
                features,
                plane,
                sampler,
                landmarks,
                model or built_in_model(),
                beam_width_deg,
                config.continuity.remember_frames,
            )
        self._estimates = EstimateMaker(config, plane, landmarks)
        self._method, self._smi = method, smi

    def step(self, frame: Frame) -> FrameResult:
        """The three stages over one frame, which must be the log's next."""
        image = self.working_image(frame)
        return self.stage3([self.stage2(image, self.stage1(image))])[0]

    def working_image(self, frame: Frame) -> WorkingImage:
        """The frame in the working plane, which stage 1 works on. Frames may come in any order."""
        image = self._plane.warp(frame.pixels, frame.polar)
        return WorkingImage(frame.index, frame.timestamp_ns, image)

    def stage1(self, image: WorkingImage) -> Selection:
        """Candidate selection (Section 3.2): where could a landmark's circle be?

        Frames may come in any order, and from several threads.
        """
        return self._select(image.image)

    def stage2(self, frame: WorkingImage, selection: Selection) -> AfterStage2:
        """Continuity evaluation (Section 3.3): which candidates are objects that persist?

        Frames must come in the log's order. The shape matrices for stage 3 are sampled here too, so
        that images need not be kept.
        """
        image = frame.image
        motion = self.odometry.step(image, frame.timestamp_ns)
        known = motion if motion is not None and motion.known else None
        groups = self._continuity.step(selection, known)
        # Shape matrices (Section 3.4.2) of the candidates, then of the groups.
        n = len(selection.positions)
        positions = np.concatenate([selection.positions, groups.positions])
        sight = self._plane.line_of_sight(positions)
        # A group's matrices are rotated by whole steps only, so that their cells coincide.
        sight[n:] -= np.radians(shape_matrix.whole_steps(groups.sight_deg)[1])
        levels = self._select.levels(selection, positions)
        grey, seen = self._sampler(image, self._plane.inside, positions, sight, *levels)
        evidence = self._measurement.gather(groups, grey[n:], seen[n:])
        return AfterStage2(
            frame=frame.frame,
            timestamp_ns=frame.timestamp_ns,
            candidates=selection.positions,
            scores=selection.scores,
            grey=grey[:n],
            seen=seen[:n],
            groups=groups,
            evidence=evidence,
            motion=motion,
        )

    def stage3(self, frames: Sequence[AfterStage2]) -> list[FrameResult]:
        """Bayesian feature estimation (Section 3.4): which landmark is each object?

        frames: one or more, in the log's order. How they are divided among calls affects only the
        rounding.
        """
        batch = Batch(frames)
        beliefs = self._measurement.beliefs(batch.groups, batch.evidence)
        tracked = self._estimates.of_groups(self._method, batch, beliefs)
        # The paper's baseline: shape-matrix identification (SMI) of single frames.
        single = []
        if self._smi is not None:
            identified = self._identify(batch.grey, batch.seen)
            single = self._estimates.of_candidates(self._smi, batch, identified)
        return batch.results(single, tracked)
