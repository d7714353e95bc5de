"""The three stages on one screen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, nullcontext
from functools import partial
from itertools import islice

import cv2
import numpy as np

from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.poses import PoseTable
from sonarrec.recogniser.ahead import Ahead
from sonarrec.recogniser.beam_width import usual_beam_width_deg
from sonarrec.recogniser.estimates import EstimateMaker
from sonarrec.recogniser.followed import Batch, Followed, Looked
from sonarrec.recogniser.odometry import Odometry
from sonarrec.recogniser.plane import working_plane
from sonarrec.recogniser.stage1_candidates import CandidateSelector
from sonarrec.recogniser.stage2_continuity import ContinuityFilter
from sonarrec.recogniser.stage3_features import Measurement, shape_matrix
from sonarrec.recogniser.stage3_features.appearance import AppearanceMeasurement, Judge
from sonarrec.recogniser.stage3_features.model import load_model
from sonarrec.recogniser.stage3_features.published import PublishedMeasurement
from sonarrec.recogniser.stage3_features.smi import identify
from sonarrec.records import Fan, Frame, FrameResult

SMI = "smi"
FRAMEWORK = "framework"
# Stage 3 takes so many frames at once, for a third of the cost; more would hardly save more.
FRAMES_AT_ONCE = 16


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
        smi: str | None = SMI,
        poses: PoseTable | None = None,
    ) -> None:
        """fan: the geometry that all frames of the log share. model: default, the built-in one.

        method: the name of the framework's estimates. smi: the same of the single-frame method;
        None: it makes none. poses: what they tell of the sonar's motion stands in place of what
        the images show.
        """
        rng = np.random.default_rng(config.seed)
        select, features, radius_m = config.candidates, config.features, landmarks.radius_m
        self._plane = plane = working_plane(select.plane, fan, radius_m, select.disc_radius_px)
        beam_width_deg = features.beam_width_deg or usual_beam_width_deg(fan)
        self._select = CandidateSelector(select, plane, landmarks, beam_width_deg)
        self.odometry = Odometry(plane, config.continuity, poses)
        self._continuity = ContinuityFilter(config.continuity, plane, rng)
        self._sampler = sampler = shape_matrix.ShapeSampler(landmarks, plane.axes)
        bands, turned = sampler.bands, shape_matrix.turned_codes(landmarks)
        self._measurement: Measurement
        if features.measurement == "single":
            self._measurement = PublishedMeasurement(features, bands, landmarks, fan.window_m)
        else:
            self._measurement = AppearanceMeasurement(
                features,
                plane,
                sampler,
                landmarks,
                model or load_model(),
                beam_width_deg,
                config.continuity.remember_frames,
            )
        self._identify = partial(identify, bands=bands, turned=turned)
        self._estimates = EstimateMaker(config, plane, landmarks)
        self._method, self._smi = method, smi

    def recognise(self, frames: Iterable[Frame]) -> Iterator[FrameResult]:
        """The three stages over the frames of a log; see `together`."""
        return (result for (result,) in together([self], frames))

    def step(self, frame: Frame) -> FrameResult:
        """The three stages over the log's next frame alone."""
        return self.judge([self.follow(self.look(frame))])[0]

    def look(self, frame: Frame) -> Looked:
        """Stage 1 of any frame of the log."""
        image = self._plane.warp(frame.image)
        # Stage 1, candidate selection (Section 3.2): where could a landmark's circle be?
        return Looked(frame.index, frame.timestamp_ns, image, self._select(image))

    def follow(self, looked: Looked) -> Followed:
        """Stage 2 of the log's next frame, and the shape matrices for stage 3."""
        image, selection = looked.image, looked.selection
        # Stage 2, continuity evaluation (Section 3.3): which candidates are objects that persist?
        motion = self.odometry.step(image, looked.timestamp_ns)
        known = motion if motion is not None and motion.known else None
        groups = self._continuity.step(selection, known)
        # Shape matrices (Section 3.4.2) of the candidates, then of the groups.
        n = len(selection.positions)
        places = np.concatenate([selection.positions, groups.positions])
        sight = self._plane.line_of_sight(places)
        # Those of a group are turned in whole steps alone, to lie over each other exactly.
        sight[n:] -= np.radians(shape_matrix.whole_steps(groups.sights)[1])
        grey, seen = self._sampler(
            image, self._plane.inside, places, sight, selection.mean, selection.sigma
        )
        gathered = self._measurement.gather(groups, grey[n:], seen[n:])
        found = (selection.positions, selection.scores, grey[:n], seen[:n])
        return Followed(looked.frame, looked.timestamp_ns, *found, groups, gathered, motion)

    def judge(self, frames: Sequence[Followed]) -> list[FrameResult]:
        """Stage 3 of some frames, at least one, that come after those judged before.

        It says the same of each frame whatever others come with it.
        """
        batch = Batch(frames)
        # Stage 3, Bayesian feature estimation (Section 3.4): which landmark is each object?
        beliefs = self._measurement.beliefs(batch.groups, batch.gathered)
        tracked = self._estimates.of_groups(self._method, batch, beliefs)
        # Beside it shape-matrix identification of single frames (SMI), the paper's baseline.
        single = []
        if self._smi is not None:
            identified = self._identify(batch.grey, batch.seen)
            single = self._estimates.of_candidates(self._smi, batch, identified)
        return batch.results(single, tracked)


def together(
    recognisers: Sequence[Recogniser], frames: Iterable[Frame], *, ahead: bool = False
) -> Iterator[tuple[FrameResult, ...]]:
    """Several recognisers over the same frames: of each frame the result of each, in order.

    Results come FRAMES_AT_ONCE at once. Whatever breaks the frames off is raised when the results
    of those before it are out. ahead: read frames and do stage 1 in a thread of its own.
    """
    cv2.ipp.setUseIPP(False)  # off for one thread at a time, and this may be a new one
    looked = ([r.look(frame) for r in recognisers] for frame in frames)
    with closing(Ahead(looked)) if ahead else nullcontext(looked) as looks:
        left, broken = iter(looks), None
        while broken is None:
            followed: list[list[Followed]] = []
            try:
                for look in islice(left, FRAMES_AT_ONCE):
                    followed.append([r.follow(x) for r, x in zip(recognisers, look, strict=True)])
            except BaseException as error:  # Ctrl-C as well
                broken = error
            if not followed:
                break
            each = zip(recognisers, zip(*followed, strict=True), strict=True)
            yield from zip(*(r.judge(its) for r, its in each), strict=True)
    if broken is not None:
        raise broken
