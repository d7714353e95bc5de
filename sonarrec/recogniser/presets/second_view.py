"""The `offline` preset's second view: the mean of many frames, in which speckle is averaged.

The sonar's motion says where each frame lies on the floor. Stage 1 searches their mean for discs,
and finds some that no single frame shows. Stage 3 judges these, and its beliefs are joined to the
estimates of every frame in which the disc is in view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.estimates import declared
from sonarrec.recogniser.plane import working_plane
from sonarrec.recogniser.presets.mosaic import LEAST_WEIGHT, SIDE, Block, Mosaic, Pose
from sonarrec.recogniser.restore.beam_width import usual_beam_width_deg
from sonarrec.recogniser.stage1 import CandidateSelector, upsample
from sonarrec.recogniser.stage3 import Evidence, likeliest
from sonarrec.recogniser.stage3.appearance import AppearanceMeasurement, Classifier
from sonarrec.recogniser.stage3.model import built_in_model
from sonarrec.recogniser.stage3.shape_matrix import STEP_DEG, ShapeSampler
from sonarrec.records import Estimate, Fan, FrameResult, Groups, Motion, Selection

MOST_STEP_ERROR = 0.25  # disc radii; a motion with a larger standard error begins a new mean
OLD_SHARE = 0.5  # weight of the frames of a view in the next
LEAST_FRAMES = 12  # in view of a disc; with fewer, a track knows as much as the mean
LEAST_SCORE = 0.25  # of a candidate: the mean is less noisy than a frame, so a low score will do
SIGMA_LEVELS, MIDDLE_LEVEL = 24, 128  # grey levels of the mean: a frame's deviation, and its mean
SAME_DISC = 0.25  # disc diameters up to which a track is of a disc
LEAST_SHARE = 0.5  # of a disc in view, from which on a frame shows it
FIRST_NUMBER = 1_000_000  # of the objects that have no track; tracks are fewer
# The joint belief is the product of these powers of the track's belief and the view's. They sum to
# more than 1 as in TrackBelief. A disc without a track needs more belief. Tuning seeds.
TRACK_EXPONENT, VIEW_EXPONENT, DECLARE_ALONE = 0.575, 0.575, 0.9
LEAST_BELIEF = 1e-4  # in the product
EXISTENCE = 0.99  # probability that a candidate of the mean exists
SPREAD = 0.02  # disc diameters: standard deviation of its position


@dataclass(frozen=True, slots=True)
class Disc:
    """A disc in the mean.

    number: of its object, if it has no track. position: (2,) pixels of the mosaic. probabilities:
    (K + 1,). index, score: of the likeliest ID, and the belief in it. declared: whether that is
    enough without a track. orientation_deg: counter-clockwise from the right of yaw 0.
    """

    number: int
    position: FloatArray
    probabilities: FloatArray
    index: int
    score: float
    declared: bool
    orientation_deg: float
    orientation_sigma_deg: float

    def orientation_in(self, pose: Pose) -> float:
        """In a frame of this pose, as in Estimate."""
        return float((self.orientation_deg + math.degrees(pose.yaw)) % 360)


@dataclass(slots=True)
class _HalfView:
    """The frames between two views, which are part of both, and the discs of the latest view."""

    poses: list[Pose] = field(default_factory=list)
    discs: list[Disc] = field(default_factory=list)


def has_second_view(config: Config) -> bool:
    """Whether this method's results wait for a second view."""
    track = config.features.measurement == "track" and config.candidates.detector == "ring"
    return config.features.lag_frames > 0 and track and config.candidates.plane == "floor"


class SecondView:
    """The mean of the last frames of one log, and the discs in it, for one method's results."""

    def __init__(
        self,
        method: str,
        config: Config,
        fan: Fan,
        landmarks: LandmarkSet,
        model: Classifier | None,
    ) -> None:
        """config: one for which `has_second_view`. model: by default the built-in one."""
        select, features = config.candidates, config.features
        self._method, self._features, self._landmarks = method, features, landmarks
        self._select = replace(select, threshold=LEAST_SCORE)
        self._beam_width_deg = features.beam_width_deg or usual_beam_width_deg(fan)
        self._plane = working_plane("floor", fan, landmarks.radius_m, select.disc_radius_px)
        self._pixel_m = fan.metres_per_pixel / self._plane.scale
        self._inside = self._plane.inside.astype(np.float32)
        self._share = self._plane.disc_share()
        self._sample = ShapeSampler(landmarks, self._plane.axes)
        self._measurement = AppearanceMeasurement(
            features,
            self._plane,
            self._sample,
            landmarks,
            model or built_in_model(),
            self._beam_width_deg,
            config.continuity.remember_frames,
        )
        middle_m = (fan.range_min_m + fan.range_max_m) / 2
        self._error_of = np.array([math.radians(1) * middle_m, 1, 1]) / landmarks.radius_m
        self._half = max(features.lag_frames // 2, 1)  # frames between two views
        self._mosaic, self._pose = Mosaic(), Pose()
        self._now, self._before = _HalfView(), _HalfView()
        # The pose and the half view of each frame whose result is not final, by its number.
        self._seen: dict[int, tuple[Pose, _HalfView]] = {}
        self._numbers = FIRST_NUMBER
        self._judged = 0

    def add(
        self, index: int, motion: Motion | None, image: ByteImage, candidates: Selection
    ) -> None:
        """Add a frame's working image to the mean. motion: of the sonar since the frame before."""
        self._move(motion)
        self._now.poses.append(self._pose)
        self._seen[index] = self._pose, self._now
        picture = image - upsample(candidates.mean, image.shape)
        picture /= upsample(candidates.sigma, image.shape)
        picture *= self._inside
        self._mosaic.add(picture, self._inside, self._pose.to_mosaic(self._plane.apex))
        if len(self._now.poses) == self._half:
            self._judge()

    def finish(self) -> None:
        """Judge the remaining frames: no more follow."""
        if self._now.poses:
            self._judge()

    def begin_stretch(self) -> None:
        """Begin a new mean."""
        self.finish()
        self._mosaic.clear()
        self._pose, self._now, self._before = Pose(), _HalfView(), _HalfView()

    def _move(self, motion: Motion | None) -> None:
        """Update the pose by a motion; where that is too uncertain, begin a new mean."""
        sigma = np.full(3, np.inf)
        if motion is not None and motion.known:
            sigma = np.array([motion.pan_sigma_deg, motion.right_sigma_m, motion.ahead_sigma_m])
        if motion is None or np.linalg.norm(self._error_of * sigma) > MOST_STEP_ERROR:
            self.begin_stretch()
        else:
            self._pose = self._pose.after(motion, self._pixel_m)

    def _judge(self) -> None:
        """Search the mean for discs and judge them, for the frames of both halves."""
        margin = min(math.ceil(3 * self._plane.axes[0]), SIDE)
        found = [disc for block in self._mosaic.blocks(margin) for disc in self._discs(block)]
        self._now.discs = self._before.discs = found
        self._before, self._now = self._now, _HalfView()
        self._mosaic.fade(OLD_SHARE)

    def _discs(self, block: Block) -> list[Disc]:
        """The discs in a block of the mean: stages 1 and 3, with the frames' poses as stage 2."""
        # Stage 1: the candidates in the mean.
        inside = (block.count >= LEAST_WEIGHT).astype(np.uint8)
        mean = block.total / np.maximum(block.count, 1e-6)
        image = np.clip(MIDDLE_LEVEL + SIGMA_LEVELS * mean, 0, 255).astype(np.uint8)
        plane = self._plane.cut(inside)
        select = CandidateSelector(self._select, plane, self._landmarks, self._beam_width_deg)
        pixels = select(image * inside).positions
        pixels = pixels[block.owns(pixels + block.corner)]
        n, in_mosaic = len(pixels), pixels + block.corner
        if not n:
            return []
        # Which frames show each candidate, and in which direction the sonar looks at it on average.
        poses = self._before.poses + self._now.poses
        in_frames = np.array([pose.to_frame(in_mosaic, self._plane.apex) for pose in poses])
        shown = np.array([self._shares(positions) >= LEAST_SHARE for positions in in_frames])
        directions = [
            np.exp(1j * (self._plane.line_of_sight(positions) - pose.yaw))
            for pose, positions in zip(poses, in_frames, strict=True)
        ]
        sight = np.angle((shown * directions).sum(axis=0))
        frames = shown.sum(axis=0)
        # Stage 3: the beliefs about their shape matrices.
        level, deviation = np.full(n, float(MIDDLE_LEVEL)), np.full(n, float(SIGMA_LEVELS))
        grey, seen = self._sample(image, inside, pixels, sight, level, deviation)
        count = np.minimum(block.count, 255).astype(np.uint8)
        often, _ = self._sample(count, inside, pixels, sight, np.zeros(n), np.ones(n))
        self._judged += n
        groups = Groups(
            numbers=self._judged - np.arange(n),
            # In the first frame that shows each; the range gives the beam's smear.
            positions=in_frames[np.argmax(shown, axis=0), np.arange(n)],
            spread=np.full((n, 2), SPREAD),
            existence=np.full(n, EXISTENCE),
            sight_deg=np.zeros(n),
            in_view=frames > 0,
            remembered=np.empty(0, np.int64),
        )
        evidence = Evidence(
            brightness=grey,
            count=np.minimum(often, self._features.memory_frames) * seen,
            frames=frames,
            episodes=np.zeros(n, np.int64),
        )
        beliefs = self._measurement.beliefs([groups], evidence)
        best, scores = likeliest(beliefs.probabilities)
        claimed = (
            declared(scores, max(self._features.declare, DECLARE_ALONE)) & beliefs.enough_evidence
        )
        orientation = np.degrees(sight) + beliefs.rotation * STEP_DEG
        return [
            Disc(
                number=self._number(in_mosaic[i]),
                position=in_mosaic[i],
                probabilities=beliefs.probabilities[i],
                index=int(best[i]),
                score=float(scores[i]),
                declared=bool(claimed[i]),
                orientation_deg=float(orientation[i]),
                orientation_sigma_deg=float(beliefs.rotation_sigma[i] * STEP_DEG),
            )
            for i in np.flatnonzero(frames >= LEAST_FRAMES).tolist()
        ]

    def _shares(self, positions: FloatArray) -> FloatArray:
        """(n,) share of a disc inside the fan, at (n, 2) working pixels; 0 beyond the image."""
        rows, columns = self._share.shape
        column, row = np.rint(positions).astype(int).T
        within = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        return np.where(within, self._share[row.clip(0, rows - 1), column.clip(0, columns - 1)], 0)

    def _number(self, position: FloatArray) -> int:
        """The number of a disc's object: that of the last view's disc there, else a new one."""
        for disc in self._before.discs:
            if math.dist(disc.position, position) <= 2 * SAME_DISC * self._plane.axes[0]:
                return disc.number
        self._numbers += 1
        return self._numbers

    def revised(self, result: FrameResult) -> FrameResult:
        """A past result with the beliefs of the latest view of its frame."""
        pose, half = self._seen.pop(result.index)
        if not half.discs:
            return result
        estimates = list(result.estimates)
        own = [i for i, e in enumerate(estimates) if e.method == self._method]
        polar = np.array([(estimates[i].range_m, estimates[i].bearing_deg) for i in own])
        tracks = np.column_stack(self._plane.from_polar(*polar.reshape(-1, 2).T))
        in_mosaic = np.array([disc.position for disc in half.discs])
        positions = pose.to_frame(in_mosaic, self._plane.apex)
        shown = self._shares(positions) >= LEAST_SHARE
        distance = np.linalg.norm(positions[:, None] - tracks, axis=2) / (2 * self._plane.axes[0])
        both: list[tuple[int, Disc]] = []  # a disc, and the estimate of its track
        alone: list[Estimate] = []
        for n, disc in enumerate(half.discs):
            nearest = int(distance[n].argmin()) if own else -1
            if own and distance[n, nearest] <= SAME_DISC and distance[:, nearest].argmin() == n:
                both.append((own[nearest], disc))
            elif disc.declared and shown[n] and (not own or distance[n].min() > 2 * SAME_DISC):
                alone.append(self._estimate(disc, positions[n], pose))
        if both:
            self._join(estimates, both, pose)
        return replace(result, estimates=(*estimates, *alone), tracks=result.tracks + len(alone))

    def _join(
        self, estimates: list[Estimate], both: Sequence[tuple[int, Disc]], pose: Pose
    ) -> None:
        """Give tracks the joint belief of track and view. both: index of an estimate, its disc."""
        of_tracks = np.stack([estimates[i].probabilities for i, _ in both])
        of_view = np.stack([disc.probabilities for _, disc in both])
        pool = np.maximum(of_tracks, LEAST_BELIEF) ** TRACK_EXPONENT
        pool *= np.maximum(of_view, LEAST_BELIEF) ** VIEW_EXPONENT
        beliefs = pool / pool.sum(axis=1, keepdims=True)
        best, scores = likeliest(beliefs)
        claimed = declared(scores, self._features.declare)
        for n, (i, disc) in enumerate(both):
            estimate, index = estimates[i], int(best[n])
            orientation = estimate.orientation_deg, estimate.orientation_sigma_deg
            if index == disc.index:
                orientation = disc.orientation_in(pose), disc.orientation_sigma_deg
            estimates[i] = replace(
                estimate,
                probabilities=beliefs[n],
                landmark=self._landmarks.ids[index],
                score=float(scores[n]),
                declared=bool(claimed[n]) and estimate.in_view,
                orientation_deg=orientation[0],
                orientation_sigma_deg=orientation[1],
            )

    def _estimate(self, disc: Disc, position: FloatArray, pose: Pose) -> Estimate:
        """An estimate of a disc that has no track."""
        plane = self._plane
        range_sigma, bearing_sigma = plane.polar_sigma(position[None], np.full((1, 2), SPREAD))
        column, row = plane.to_fan(*position)
        range_m, bearing_deg = plane.to_polar(*position)
        return Estimate(
            method=self._method,
            object=disc.number,
            x_px=float(column),
            y_px=float(row),
            range_m=float(range_m),
            bearing_deg=float(bearing_deg),
            orientation_deg=disc.orientation_in(pose),
            existence=EXISTENCE,
            probabilities=disc.probabilities,
            landmark=self._landmarks.ids[disc.index],
            score=disc.score,
            declared=True,
            range_sigma_m=float(range_sigma[0]),
            bearing_sigma_deg=float(bearing_sigma[0]),
            orientation_sigma_deg=disc.orientation_sigma_deg,
        )
