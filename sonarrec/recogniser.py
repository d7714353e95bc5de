"""The three stages on one screen."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sonarrec.appearance import AppearanceMeasurement, Judge
from sonarrec.appearance_model import load_model
from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.odometry import PanEstimator
from sonarrec.plane import Plane
from sonarrec.records import ByteImage, Estimate, Fan, FloatArray, Frame, FrameResult
from sonarrec.shape_matrix import STEP, ShapeSampler, identify, turned_codes
from sonarrec.stage1_candidates import CandidateSelector
from sonarrec.stage2_continuity import ContinuityFilter
from sonarrec.stage3_features import FeatureEstimator, measurement_model

SMI = "smi"
FRAMEWORK = "framework"


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
    ) -> None:
        """fan: the geometry that all frames of the log share. model: default, the built-in one."""
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
        self._odometry = PanEstimator(plane) if config.continuity.motion == "image" else None
        self._appearance = None
        if config.features.measurement == "track":
            self._appearance = AppearanceMeasurement(
                config.features.memory_frames, self._sampler, landmarks, model or load_model()
            )
            confusion: FloatArray = np.eye(len(landmarks.ids) + 1)
        else:
            confusion = measurement_model(landmarks, fan.window_m)
        self._features = FeatureEstimator(config.features, confusion)

    def step(self, frame: Frame) -> FrameResult:
        """The estimates of one frame, by the single-frame method and by the framework."""
        image = self._plane.warp(frame.image)
        selection = self._select(image)  # stage 1
        groups = self._continuity.step(selection, self._pan(image))  # stage 2

        places = np.concatenate([selection.positions, groups.positions])
        sight = self._plane.line_of_sight(places)
        grey, seen = self._sampler(
            image, self._plane.inside, places, sight, selection.mean, selection.sigma
        )
        single = identify(grey, seen, self._sampler.bands, self._turned)
        n = len(selection.positions)

        measured = single.measurement
        estimates = self._estimates(
            SMI,
            np.arange(n),
            places[:n],
            sight[:n] + single.turn[:n] * STEP,
            selection.scores,
            measured[:n],
            single.similarity[:n].max(axis=1) * single.ring[:n],
            self._config.smi.declare,
        )

        turns = single.turn[n:]
        measured = measured[n:]
        if self._appearance is not None:
            measured, turns = self._appearance.step(groups, grey[n:], seen[n:])
        beliefs = self._features.step(groups, measured)  # stage 3
        estimates += self._estimates(
            FRAMEWORK,
            groups.numbers,
            places[n:],
            sight[n:] + turns * STEP,
            groups.existence,
            beliefs,
            beliefs[:, : len(self._landmarks.ids)].max(axis=1),
            self._config.features.declare,
        )
        return FrameResult(
            frame.index, frame.timestamp_ns, n, len(groups.numbers), tuple(estimates)
        )

    def _pan(self, image: ByteImage) -> float | None:
        """Pan since the last frame (deg), where it is to be measured and could be."""
        if self._odometry is None:
            return None
        pan_deg, match = self._odometry.step(image)
        return pan_deg if match >= self._config.continuity.min_match else None

    def _estimates(
        self,
        method: str,
        objects: npt.NDArray[np.int64],
        places: FloatArray,
        orientations: FloatArray,
        existence: FloatArray,
        beliefs: FloatArray,
        scores: FloatArray,
        threshold: float,
    ) -> list[Estimate]:
        """One Estimate per object. beliefs: (n, K), or (n, K + 1) with 'none of these' last."""
        ids = self._landmarks.ids
        if beliefs.shape[1] == len(ids):
            beliefs = np.column_stack([beliefs, np.zeros(len(beliefs))])
        best = beliefs[:, : len(ids)].argmax(axis=1)
        column, row = self._plane.to_fan(places[:, 0], places[:, 1])
        range_m, bearing_deg = self._plane.to_polar(places[:, 0], places[:, 1])
        orientation_deg = np.degrees(orientations) % 360
        return [
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
            )
            for i in range(len(places))
        ]
