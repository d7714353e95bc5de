"""The three stages: the base class ThreeStages, and DiscStages for landmarks that are discs.

`drawn/three_stages.py` has those for drawn plates.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Protocol

import numpy as np

from sonarrec.arrays import ByteImage, Columns, Table, stacked
from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.estimates import Estimates, of_candidates
from sonarrec.recogniser.motion.odometry import Odometry
from sonarrec.recogniser.plane import Plane, working_plane
from sonarrec.recogniser.restore.beam_width import usual_beam_width_deg
from sonarrec.recogniser.stage1 import CandidateSelector
from sonarrec.recogniser.stage2 import ContinuityFilter
from sonarrec.recogniser.stage3 import Beliefs, shape_matrix
from sonarrec.recogniser.stage3.appearance import AppearanceMeasurement, Reads
from sonarrec.recogniser.stage3.model_file import built_in_weights
from sonarrec.recogniser.stage3.published import PublishedMeasurement
from sonarrec.recogniser.stage3.reader import Reader
from sonarrec.recogniser.tracks import Tracks
from sonarrec.sonar.frame import Estimate, Fan, Frame, FrameResult, Motion, Selection
from sonarrec.sonar.geometry import PoseTable

SMI = "smi"
FRAMEWORK = "framework"


@dataclass(frozen=True, slots=True)
class Tracked:
    """One frame after stage 2, with what stage 3 needs of its image.

    motion: of the sonar since the frame before. candidates: their columns as in Estimates, best
    first; of discs also grey, seen: (n, L, ANGLES) the shape matrices, and which of their cells lie
    inside the fan. tracks: those in view, with their evidence. stretch: as in Frame.
    """

    index: int
    timestamp_ns: int
    motion: Motion | None
    candidates: Table
    tracks: Table
    stretch: int


class Measurement(Protocol):
    """Stage 3 of one kind of landmark."""

    def beliefs(self, frames: Sequence[Table], /) -> Beliefs:
        """Beliefs about the tracks of consecutive frames, by their evidence."""
        ...


class ThreeStages(ABC):
    """Frames of one log in, estimates out, in the log's order; `DiscStages` or `PlateStages`.

    Everything random comes from one generator seeded by the configuration: the same frames and
    settings give the same estimates.
    """

    plane: Plane
    odometry: Odometry
    method: str  # name of the framework in the estimates
    _tracks: Tracks
    _select: CandidateSelector
    _measurement: Measurement
    _estimates: Estimates

    _stretch: int | None = None  # of the frame before, for `step` alone

    def begin_stretch(self) -> None:
        """End all tracks and the motion, since the next frame begins a stretch.

        `stage3` must have had all earlier frames.
        """
        self.odometry.begin_stretch()
        self._tracks.keep(np.zeros(len(self._tracks), bool))

    def judge_alone(self) -> None:  # noqa: B027
        """Let stage 3 declare IDs in the only frame of a log, where it can: plates need two."""

    def step(self, frame: Frame) -> FrameResult:
        """The three stages over one frame, which must be the log's next."""
        if self._stretch not in (None, frame.stretch):
            self.begin_stretch()
        self._stretch = frame.stretch
        image = self.working_image(frame)
        candidates = self.stage1(image)
        tracked = self.stage2(frame, image, candidates)
        return self.stage3([tracked])[0]

    def working_image(self, frame: Frame) -> ByteImage:
        """The frame in the working plane, (rows, columns), which the stages work on."""
        return self.plane.warp(frame.pixels, frame.polar)

    def stage1(self, image: ByteImage) -> Selection:
        """Candidate selection (Section 3.2): where could a landmark be?"""
        return self._select(image)

    def stage2(self, frame: Frame, image: ByteImage, candidates: Selection) -> Tracked:
        """Continuity evaluation (Section 3.3): which candidates are objects that persist?

        Frames must come in the log's order. What stage 3 needs of the image is sampled here too, so
        that images need not be kept.
        """
        # How did the sonar move since the frame before?
        motion = self.odometry.step(image, frame.timestamp_ns)
        tracks, shapes = self._follow(image, candidates, motion)
        return Tracked(
            index=frame.index,
            timestamp_ns=frame.timestamp_ns,
            motion=motion,
            candidates=of_candidates(candidates).with_columns(**shapes),
            tracks=tracks,
            stretch=frame.stretch,
        )

    @abstractmethod
    def _follow(
        self, image: ByteImage, candidates: Selection, motion: Motion | None
    ) -> tuple[Table, Columns]:
        """The tracks in view with their evidence, and the candidates' shape matrices."""

    def stage3(self, frames: Sequence[Tracked]) -> list[FrameResult]:
        """Bayesian feature estimation (Section 3.4): which landmark is each object?

        frames: one or more, in the log's order. How they are divided among calls affects only the
        rounding.
        """
        # Judge the evidence, and pool the beliefs along the tracks (Eq. 5 to 8).
        tracks = [f.tracks for f in frames]
        beliefs = self._measurement.beliefs(tracks)
        tracked = self._estimates.of_tracks(self.method, tracks, beliefs)
        # Each frame gets the estimates of its own candidates, then those of its own tracks.
        by_smi, of_tracks = iter(self.single_frame_estimates(frames)), iter(tracked)
        return [
            FrameResult(
                index=f.index,
                timestamp_ns=f.timestamp_ns,
                candidates=len(f.candidates),
                tracks=len(f.tracks),
                estimates=(
                    *islice(by_smi, len(f.candidates)),
                    *islice(of_tracks, len(f.tracks)),
                ),
                motion=f.motion,
                stretch=f.stretch,
            )
            for f in frames
        ]

    def single_frame_estimates(self, frames: Sequence[Tracked]) -> list[Estimate]:  # noqa: ARG002
        """The estimates of all candidates by the single-frame method; empty if it does not run."""
        return []


class DiscStages(ThreeStages):
    """The three stages for discs, and the paper's baseline: SMI of single frames."""

    _measurement: PublishedMeasurement | AppearanceMeasurement

    def __init__(
        self,
        config: Config,
        fan: Fan,
        landmarks: LandmarkSet,
        read: Reads | None = None,
        method: str = FRAMEWORK,
        smi: str | None = SMI,
        poses: PoseTable | None = None,
    ) -> None:
        """fan: the geometry of all frames of the log. read: by default the built-in reader.

        method: name of the framework in the estimates. smi: name of the single-frame method; None
        if it is not to run. poses: of the sonar; where they give its motion, that is not measured
        in the images.
        """
        select, features = config.candidates, config.features
        plane = working_plane(select.plane, fan, landmarks.radius_m, select.disc_radius_px)
        beam_width_deg = features.beam_width_deg or usual_beam_width_deg(fan)
        self.plane, self.method, self._smi = plane, method, smi
        self._select = CandidateSelector(select, plane, landmarks, beam_width_deg)
        self.odometry = Odometry(plane, config.continuity, poses)
        self._tracks = Tracks()
        self._track = ContinuityFilter(
            config.continuity, plane, self._tracks, np.random.default_rng(config.seed)
        )
        self._sample = shape_matrix.ShapeSampler(landmarks, plane.axes)
        codes = shape_matrix.rotated_codes(landmarks)
        self._identify = partial(shape_matrix.identify, bands=self._sample.bands, codes=codes)
        if features.measurement == "single":
            self._measurement = PublishedMeasurement(
                features, self._tracks, self._identify, landmarks, fan.window_m
            )
        else:
            self._measurement = AppearanceMeasurement(
                features,
                plane,
                self._tracks,
                len(self._sample.radii),
                landmarks,
                read or Reader(built_in_weights(), codes),
                beam_width_deg,
            )
        self._estimates = Estimates(config, plane, landmarks)
        self._declare_alone = features.declare_alone

    def begin_stretch(self) -> None:
        super().begin_stretch()
        if isinstance(self._measurement, PublishedMeasurement):
            self._measurement.begin_stretch()

    def judge_alone(self) -> None:
        if isinstance(self._measurement, AppearanceMeasurement):  # the published needs no other
            self._measurement.least_frames = 1
            self._estimates.declare = self._declare_alone

    def _follow(
        self, image: ByteImage, candidates: Selection, motion: Motion | None
    ) -> tuple[Table, Columns]:
        # Track the candidates by groups of particles (Eq. 3 and 4).
        tracks = self._track.step(candidates, motion)
        # Sample the shape matrices (Section 3.4.2) of the candidates, then of the tracks. Those of
        # a track are rotated by whole steps only, so that their cells coincide from frame to frame.
        n = len(candidates.positions)
        positions = np.concatenate([candidates.positions, tracks["position"]])
        sight = self.plane.line_of_sight(positions)
        sight[n:] -= np.radians(shape_matrix.rounded_steps(tracks["sight_deg"])[1])
        levels = self._select.levels(candidates, positions)
        grey, seen = self._sample(image, self.plane.inside, positions, sight, *levels)
        # Average those of the tracks.
        evidence = self._measurement.gather(grey[n:], seen[n:])
        return tracks.with_columns(**evidence), {"grey": grey[:n], "seen": seen[:n]}

    def single_frame_estimates(self, frames: Sequence[Tracked]) -> list[Estimate]:
        if self._smi is None:
            return []
        candidates = stacked([f.candidates for f in frames])
        identified = self._identify(candidates["grey"], candidates["seen"])
        return self._estimates.of_candidates(self._smi, candidates, identified)
