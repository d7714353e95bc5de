"""The three stages on one screen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.poses import PoseTable
from sonarrec.recogniser.odometry import Odometry
from sonarrec.recogniser.plane import Plane
from sonarrec.recogniser.stage1_candidates import CandidateSelector
from sonarrec.recogniser.stage2_continuity import ContinuityFilter
from sonarrec.recogniser.stage3_features.appearance import AppearanceMeasurement, Judge
from sonarrec.recogniser.stage3_features.model import load_model
from sonarrec.recogniser.stage3_features.published import FeatureEstimator, measurement_model
from sonarrec.recogniser.stage3_features.shape_matrix import ANGLES, ShapeSampler, turned_codes
from sonarrec.recogniser.stage3_features.smi import Identification, identify
from sonarrec.recogniser.stage3_features.track_matrix import TrackMatrix
from sonarrec.records import Estimate, Fan, FloatArray, Frame, FrameResult, Groups

SMI = "smi"
FRAMEWORK = "framework"
STEP_DEG = 360 / ANGLES
HALF_POWER = 2 * (2 * np.log(2)) ** 0.5  # width of a Gaussian at half power, in its deviations
# Standard error of a group's mean, in shares of its particles' spread: chosen on tuning seeds, held
# against the truth by `make scenes`.
POSITION_SHARE = 0.22


@dataclass(frozen=True, slots=True)
class Followed:
    """What stages 1 and 2 made of one frame, and what stage 3 needs of its picture.

    candidates: (n, 2) pixels of the working image. scores: (n,) of stage 1. grey, seen: (n, L,
    ANGLES) their shape matrices. groups: m of them. average, count: (m, L, ANGLES) of the groups,
    from TrackMatrix.
    """

    index: int
    timestamp_ns: int
    candidates: FloatArray
    scores: FloatArray
    grey: FloatArray
    seen: npt.NDArray[np.bool_]
    groups: Groups
    average: FloatArray
    count: FloatArray


class Recogniser:
    """Frames of one log in, estimates out, in the log's order.

    Stages 1 and 2 go frame by frame (`follow`). Stage 3 takes any number of frames at once
    (`judge`) and says the same of each whatever others come with it: most of its time goes into
    calling numpy, however little there is to count.

    Everything random comes from one generator seeded by the configuration: the same frames and
    settings give the same estimates.
    """

    def __init__(
        self,
        config: Config,
        fan: Fan,
        landmarks: LandmarkSet,
        model: Judge | None = None,
        method: str = FRAMEWORK,
        smi: str | None = SMI,
        poses: PoseTable | None = None,
    ) -> None:
        """fan: the geometry that all frames of the log share. model: default, the built-in one.

        method: the name under which the framework's estimates go. smi: the same of the single-frame
        method; None: it makes none. poses: what they tell of the sonar's motion stands in
        place of what the images show.
        """
        rng = np.random.default_rng(config.seed)
        self._config = config
        self._landmarks = landmarks
        self._plane = plane = Plane(
            fan, landmarks.radius_m, config.candidates.plane, config.candidates.disc_radius_px
        )
        self._sampler = ShapeSampler(landmarks, plane.axes)
        self._turned = turned_codes(landmarks)
        self._select = CandidateSelector(config.candidates, plane, landmarks)
        self._continuity = ContinuityFilter(config.continuity, plane, rng)
        self.odometry = Odometry(plane, config.continuity, poses)
        along_track = config.features.measurement == "track"
        memory = config.features.memory_frames if along_track else 1.0  # of this frame alone
        self._matrix = TrackMatrix(memory, len(self._sampler.radii))
        self._appearance = None
        if along_track:
            self._appearance = AppearanceMeasurement(
                config.features, self._sampler, landmarks, model or load_model()
            )
            confusion: FloatArray = np.eye(len(landmarks.ids) + 1)
        else:
            confusion = measurement_model(landmarks, fan.window_m)
        self._features = FeatureEstimator(config.features, confusion)
        self._method = method
        self._smi = smi

    def step(self, frame: Frame) -> FrameResult:
        """The estimates of one frame."""
        return self.judge([self.follow(frame)])[0]

    def follow(self, frame: Frame) -> Followed:
        """Stages 1 and 2 of the log's next frame."""
        image = self._plane.warp(frame.image)
        selection = self._select(image)  # stage 1
        motion = self.odometry.step(image, frame.timestamp_ns)
        groups = self._continuity.step(selection, motion)  # stage 2

        working = np.concatenate([selection.positions, groups.positions])
        sight = self._plane.line_of_sight(working)
        grey, seen = self._sampler(
            image, self._plane.inside, working, sight, selection.mean, selection.sigma
        )
        n = len(selection.positions)
        average, count = self._matrix.step(groups, grey[n:], seen[n:])
        return Followed(
            frame.index,
            frame.timestamp_ns,
            selection.positions,
            selection.scores,
            grey[:n],
            seen[:n],
            groups,
            average,
            count,
        )

    def judge(self, frames: Sequence[Followed]) -> list[FrameResult]:
        """Stage 3 of some frames, at least one, that come after those judged before.

        The estimates of each frame, by the single-frame method and by the framework.
        """
        singles: list[list[Estimate]] = [[] for _ in frames]
        if self._smi is not None:
            singles = self._single(frames, self._smi)
        return [
            FrameResult(
                frame.index,
                frame.timestamp_ns,
                len(frame.candidates),
                len(frame.groups.numbers),
                (*single, *tracked),
            )
            for frame, single, tracked in zip(frames, singles, self._tracked(frames), strict=True)
        ]

    def _single(self, frames: Sequence[Followed], method: str) -> list[list[Estimate]]:
        """Of each frame, what shape-matrix identification alone says of its candidates."""
        single = self._identify(
            np.concatenate([f.grey for f in frames]), np.concatenate([f.seen for f in frames])
        )
        counts = [len(f.candidates) for f in frames]
        return self._estimates(
            method,
            counts,
            np.concatenate([np.arange(n) for n in counts]),
            np.concatenate([f.candidates for f in frames]),
            single.measurement(),
            single.turn.astype(float),
            np.concatenate([f.scores for f in frames]),
            scores=single.similarity.max(axis=1) * single.ring,
            threshold=self._config.smi.declare,
        )

    def _tracked(self, frames: Sequence[Followed]) -> list[list[Estimate]]:
        """Of each frame, what the framework says of its groups."""
        groups = [f.groups for f in frames]
        counts = [len(g.numbers) for g in groups]
        positions = np.concatenate([g.positions for g in groups])
        existence = np.concatenate([g.existence for g in groups])
        average = np.concatenate([f.average for f in frames])
        count = np.concatenate([f.count for f in frames])
        if self._appearance is not None:
            measured, turns, turn_sigma = self._appearance(
                average, count, existence, self._smear(positions)
            )
        else:
            single = self._identify(average, count > 0)
            measured = single.measurement(self._config.features.least_ring)
            turns = single.turn.astype(float)
            turn_sigma = np.full(len(turns), np.nan)
        parts = np.split(measured, np.cumsum(counts)[:-1])
        beliefs = [self._features.step(g, q) for g, q in zip(groups, parts, strict=True)]  # stage 3
        return self._estimates(
            self._method,
            counts,
            np.concatenate([g.numbers for g in groups]),
            positions,
            np.concatenate(beliefs),
            turns,
            existence,
            spread=np.concatenate([g.spread for g in groups]),
            turn_sigma=turn_sigma,
            threshold=self._config.features.declare,
        )

    def _identify(self, grey: FloatArray, seen: npt.NDArray[np.bool_]) -> Identification:
        return identify(grey, seen, self._sampler.bands, self._turned)

    def _smear(self, positions: FloatArray) -> FloatArray:
        """(n,) the beam's standard deviation across the line of sight, in disc radii."""
        range_m, _ = self._plane.to_polar(*positions.T)
        sigma_deg = self._config.features.beam_width_deg / HALF_POWER
        return np.asarray(np.radians(sigma_deg) * range_m / self._landmarks.radius_m)

    def _estimates(
        self,
        method: str,
        counts: Sequence[int],
        objects: npt.NDArray[np.int64],
        positions: FloatArray,
        beliefs: FloatArray,
        turns: FloatArray,
        existence: FloatArray,
        *,
        threshold: float,
        scores: FloatArray | None = None,
        spread: FloatArray | None = None,
        turn_sigma: FloatArray | None = None,
    ) -> list[list[Estimate]]:
        """One Estimate per object, parted into frames of `counts` each.

        positions: (n, 2) pixels of the working image. beliefs: (n, K), or (n, K + 1) with 'none of
        these' last. turns: (n,) from the line of sight, in steps. scores: default, the largest
        belief in an ID.
        """
        ids = self._landmarks.ids
        count = len(positions)
        if beliefs.shape[1] == len(ids):
            beliefs = np.column_stack([beliefs, np.zeros(count)])
        best = beliefs[:, : len(ids)].argmax(axis=1)
        if scores is None:
            scores = beliefs[np.arange(count), best]
        range_sigma, bearing_sigma = np.full((2, count), np.nan)
        if spread is not None:
            range_sigma, bearing_sigma = self._plane.polar_sigma(positions, POSITION_SHARE * spread)
        column, row = self._plane.to_fan(*positions.T)
        range_m, bearing_deg = self._plane.to_polar(*positions.T)
        orientation_deg = (90 - bearing_deg + turns * STEP_DEG) % 360
        orientation_sigma = np.full(count, np.nan) if turn_sigma is None else turn_sigma * STEP_DEG
        estimates = [
            Estimate(
                method=method,
                object=int(objects[i]),
                x_px=float(column[i]),
                y_px=float(row[i]),
                range_m=float(range_m[i]),
                bearing_deg=float(bearing_deg[i]),
                orientation_deg=float(orientation_deg[i]),
                existence=float(existence[i]),
                probabilities=beliefs[i],
                landmark=ids[best[i]],
                score=float(scores[i]),
                declared=bool(scores[i] >= threshold),
                range_sigma_m=float(range_sigma[i]),
                bearing_sigma_deg=float(bearing_sigma[i]),
                orientation_sigma_deg=float(orientation_sigma[i]),
            )
            for i in range(count)
        ]
        ends = np.cumsum(counts).tolist()
        return [estimates[end - n : end] for end, n in zip(ends, counts, strict=True)]
