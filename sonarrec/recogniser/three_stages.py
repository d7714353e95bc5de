"""The three stages of one preset over the frames of one log, and what they are made of for discs.

Drawn plates: `drawn/three_stages.py`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import islice

import numpy as np

from sonarrec.arrays import BoolArray, ByteImage, FloatArray, joined
from sonarrec.config import Config
from sonarrec.geometry import PoseTable
from sonarrec.landmarks import DrawnSet, LandmarkSet
from sonarrec.nouns import Estimate, Fan, Frame, FrameResult, Groups, Selection
from sonarrec.recogniser.between_stages import Parts, Tracked
from sonarrec.recogniser.estimates import Estimates
from sonarrec.recogniser.motion.odometry import Odometry
from sonarrec.recogniser.plane import working_plane
from sonarrec.recogniser.restore.beam_width import usual_beam_width_deg
from sonarrec.recogniser.stage1 import CandidateSelector
from sonarrec.recogniser.stage2 import ContinuityFilter
from sonarrec.recogniser.stage3 import Evidence, shape_matrix
from sonarrec.recogniser.stage3.appearance import AppearanceMeasurement, Classifier
from sonarrec.recogniser.stage3.model import built_in_model
from sonarrec.recogniser.stage3.published import PublishedMeasurement
from sonarrec.recogniser.stage3.smi import identify

SMI = "smi"
FRAMEWORK = "framework"


def of_discs(
    config: Config,
    fan: Fan,
    landmarks: LandmarkSet,
    model: Classifier | None,
    poses: PoseTable | None,
) -> Parts:
    """The parts for discs; the arguments are those of ThreeStages."""
    select, features = config.candidates, config.features
    plane = working_plane(select.plane, fan, landmarks.radius_m, select.disc_radius_px)
    beam_width_deg = features.beam_width_deg or usual_beam_width_deg(fan)
    detector = CandidateSelector(select, plane, landmarks, beam_width_deg)
    continuity = ContinuityFilter(config.continuity, plane, np.random.default_rng(config.seed))
    sampler = shape_matrix.ShapeSampler(landmarks, plane.axes)
    smi = partial(identify, bands=sampler.bands, codes=shape_matrix.rotated_codes(landmarks))
    measurement: PublishedMeasurement | AppearanceMeasurement
    if features.measurement == "single":
        measurement = PublishedMeasurement(features, smi, landmarks, fan.window_m)
    else:
        remember_frames, model = config.continuity.remember_frames, model or built_in_model()
        measurement = AppearanceMeasurement(
            features, plane, sampler, landmarks, model, beam_width_deg, remember_frames
        )

    def gather(
        image: ByteImage, selection: Selection, groups: Groups
    ) -> tuple[FloatArray, BoolArray, Evidence]:
        # Shape matrices (Section 3.4.2) of the candidates, then of the groups.
        n = len(selection.positions)
        positions = np.concatenate([selection.positions, groups.positions])
        sight = plane.line_of_sight(positions)
        # A group's matrices are rotated by whole steps only, so that their cells coincide.
        sight[n:] -= np.radians(shape_matrix.whole_steps(groups.sight_deg)[1])
        levels = detector.levels(selection, positions)
        grey, seen = sampler(image, plane.inside, positions, sight, *levels)
        return grey[:n], seen[:n], measurement.gather(groups, grey[n:], seen[n:])

    return Parts(
        plane=plane,
        detect=detector,
        odometry=Odometry(plane, config.continuity, poses),
        track=lambda _, selection, motion: continuity.step(selection, motion),
        gather=gather,
        beliefs=measurement.beliefs,
        identify=smi,
    )


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
        """fan: the geometry of all frames of the log. model: of discs, by default the built-in one.

        method: name of the framework in the estimates. smi: name of the single-frame method; None
        if it is not to run; plates have none. poses: of the sonar; where they give its motion, that
        is not measured in the images.
        """
        self.fan = fan
        if isinstance(landmarks, DrawnSet):
            # Imported where it is needed: most sets are of discs, and it costs a part of the start.
            from sonarrec.recogniser.drawn.three_stages import of_plates

            self.parts = of_plates(config, fan, landmarks, poses)
        else:
            self.parts = of_discs(config, fan, landmarks, model, poses)
        self.odometry = self.parts.odometry
        self._estimates = Estimates(config, self.parts.plane, landmarks)
        self._method, self._smi = method, smi

    def step(self, frame: Frame) -> FrameResult:
        """The three stages over one frame, which must be the log's next."""
        image = self.working_image(frame)
        return self.stage3([self.stage2(frame, image, self.stage1(image))])[0]

    def working_image(self, frame: Frame) -> ByteImage:
        """The frame in the working plane, (rows, columns), which stage 1 works on."""
        return self.parts.plane.warp(frame.pixels, frame.polar)

    def stage1(self, image: ByteImage) -> Selection:
        """Candidate selection (Section 3.2): where could a landmark's circle be?"""
        return self.parts.detect(image)

    def stage2(self, frame: Frame, image: ByteImage, selection: Selection) -> Tracked:
        """Continuity evaluation (Section 3.3): which candidates are objects that persist?

        Frames must come in the log's order. The shape matrices for stage 3 are sampled here too, so
        that images need not be kept.
        """
        motion = self.odometry.step(image, frame.timestamp_ns)
        known = motion if motion is not None and motion.known else None
        groups = self.parts.track(image, selection, known)
        grey, seen, evidence = self.parts.gather(image, selection, groups)
        found = selection.positions, selection.scores, grey, seen
        return Tracked(frame.index, frame.timestamp_ns, *found, groups, evidence, motion)

    def stage3(self, frames: Sequence[Tracked]) -> list[FrameResult]:
        """Bayesian feature estimation (Section 3.4): which landmark is each object?

        frames: one or more, in the log's order. How they are divided among calls affects only the
        rounding.
        """
        groups, evidence = [f.groups for f in frames], joined([f.evidence for f in frames])
        beliefs = self.parts.beliefs(groups, evidence)
        tracked = iter(self._estimates.of_groups(self._method, groups, evidence.episodes, beliefs))
        # The paper's baseline: shape-matrix identification (SMI) of single frames.
        single: Iterator[Estimate] = iter([])
        if self._smi is not None and self.parts.identify is not None:
            grey, seen = (np.concatenate([getattr(f, n) for f in frames]) for n in ("grey", "seen"))
            found = self.parts.identify(grey, seen)
            single = iter(self._estimates.of_candidates(self._smi, frames, found))
        return [
            FrameResult(
                index=f.index,
                timestamp_ns=f.timestamp_ns,
                candidates=len(f.candidates),
                tracks=len(f.groups.numbers),
                estimates=(
                    *islice(single, len(f.candidates)),
                    *islice(tracked, len(f.groups.numbers)),
                ),
                motion=f.motion,
            )
            for f in frames
        ]
