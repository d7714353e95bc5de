"""The three stages on one screen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sonarrec.appearance import AppearanceMeasurement, Judge
from sonarrec.appearance_model import load_model
from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.odometry import Odometry
from sonarrec.plane import Plane
from sonarrec.poses import PoseTable
from sonarrec.records import Estimate, Fan, FloatArray, Frame, FrameResult
from sonarrec.shape_matrix import ANGLES, ShapeSampler, identify, turned_codes
from sonarrec.stage1_candidates import CandidateSelector
from sonarrec.stage2_continuity import ContinuityFilter
from sonarrec.stage3_features import FeatureEstimator, measurement_model

SMI = "smi"
FRAMEWORK = "framework"
STEP_DEG = 360 / ANGLES
HALF_POWER = 2 * (2 * np.log(2)) ** 0.5  # width of a Gaussian at half power, in its deviations
# Standard error of a group's mean, in shares of its particles' spread: chosen on tuning seeds, held
# against the truth by `make scenes`.
POSITION_SHARE = 0.22


class _Places(NamedTuple):
    """Where n objects lie.

    working: (n, 2) pixels of the working image. column, row: (n,) pixels of the fan image. range_m,
    bearing_deg: (n,) of the sonar.
    """

    working: FloatArray
    column: FloatArray
    row: FloatArray
    range_m: FloatArray
    bearing_deg: FloatArray

    def part(self, of: slice) -> _Places:
        return _Places(*(values[of] for values in self))


class Recogniser:
    """Frames of one log in, estimates out, in the log's order.

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
        with_smi: bool = True,
        poses: PoseTable | None = None,
    ) -> None:
        """fan: the geometry that all frames of the log share. model: default, the built-in one.

        method: the name under which the framework's estimates go. with_smi: whether those of the
        single-frame method are made as well. poses: what they tell of the sonar's motion stands in
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
        self._appearance = None
        if config.features.measurement == "track":
            self._appearance = AppearanceMeasurement(
                config.features, self._sampler, landmarks, model or load_model()
            )
            confusion: FloatArray = np.eye(len(landmarks.ids) + 1)
        else:
            confusion = measurement_model(landmarks, fan.window_m)
        self._features = FeatureEstimator(config.features, confusion)
        self._method = method
        self._with_smi = with_smi

    def step(self, frame: Frame) -> FrameResult:
        """The estimates of one frame, by the single-frame method and by the framework."""
        image = self._plane.warp(frame.image)
        selection = self._select(image)  # stage 1
        motion = self.odometry.step(image, frame.timestamp_ns)
        groups = self._continuity.step(selection, motion)  # stage 2

        working = np.concatenate([selection.positions, groups.positions])
        places = _Places(
            working, *self._plane.to_fan(*working.T), *self._plane.to_polar(*working.T)
        )
        sight = self._plane.line_of_sight(working)
        grey, seen = self._sampler(
            image, self._plane.inside, working, sight, selection.mean, selection.sigma
        )
        n = len(selection.positions)
        # The groups' own is wanted only where each frame is judged by itself.
        alone = slice(n if self._appearance is not None else None)
        single = identify(grey[alone], seen[alone], self._sampler.bands, self._turned)

        estimates = []
        if self._with_smi:
            estimates = self._estimates(
                SMI,
                np.arange(n),
                places.part(slice(n)),
                single.measurement[:n],
                single.turn[:n].astype(float),
                selection.scores,
                scores=single.similarity[:n].max(axis=1) * single.ring[:n],
                threshold=self._config.smi.declare,
            )

        tracked = places.part(slice(n, None))
        if self._appearance is not None:
            smear = self._smear(tracked.range_m)
            measured, turns, turn_sigma = self._appearance.step(groups, grey[n:], seen[n:], smear)
        else:
            measured, turns = single.measurement[n:], single.turn[n:].astype(float)
            turn_sigma = np.full(len(turns), np.nan)
        beliefs = self._features.step(groups, measured)  # stage 3
        estimates += self._estimates(
            self._method,
            groups.numbers,
            tracked,
            beliefs,
            turns,
            groups.existence,
            spread=groups.spread,
            turn_sigma=turn_sigma,
            threshold=self._config.features.declare,
        )
        return FrameResult(
            frame.index, frame.timestamp_ns, n, len(groups.numbers), tuple(estimates)
        )

    def _smear(self, range_m: FloatArray) -> FloatArray:
        """(n,) the beam's standard deviation across the line of sight, in disc radii."""
        sigma_deg = self._config.features.beam_width_deg / HALF_POWER
        return np.asarray(np.radians(sigma_deg) * range_m / self._landmarks.radius_m)

    def _estimates(
        self,
        method: str,
        objects: npt.NDArray[np.int64],
        places: _Places,
        beliefs: FloatArray,
        turns: FloatArray,
        existence: FloatArray,
        *,
        threshold: float,
        scores: FloatArray | None = None,
        spread: FloatArray | None = None,
        turn_sigma: FloatArray | None = None,
    ) -> list[Estimate]:
        """One Estimate per object.

        beliefs: (n, K), or (n, K + 1) with 'none of these' last. turns: (n,) from the line of
        sight, in steps. scores: default, the largest belief in an ID.
        """
        ids = self._landmarks.ids
        count = len(places.range_m)
        if beliefs.shape[1] == len(ids):
            beliefs = np.column_stack([beliefs, np.zeros(count)])
        best = beliefs[:, : len(ids)].argmax(axis=1)
        if scores is None:
            scores = beliefs[np.arange(count), best]
        range_sigma, bearing_sigma = np.full((2, count), np.nan)
        if spread is not None:
            range_sigma, bearing_sigma = self._plane.polar_sigma(
                places.working, POSITION_SHARE * spread
            )
        orientation_deg = (90 - places.bearing_deg + turns * STEP_DEG) % 360
        orientation_sigma = np.full(count, np.nan) if turn_sigma is None else turn_sigma * STEP_DEG
        return [
            Estimate(
                method=method,
                object=int(objects[i]),
                x_px=float(places.column[i]),
                y_px=float(places.row[i]),
                range_m=float(places.range_m[i]),
                bearing_deg=float(places.bearing_deg[i]),
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
