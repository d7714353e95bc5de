"""The `offline` preset's second look, at the mean of many frames, in which speckle is averaged.

The sonar's motion says where each frame lies on the floor. Stage 1 searches their mean for discs,
and finds some that no single frame shows. Stage 3 judges these, and its beliefs are joined to the
estimates of every frame in which the disc is in view.
"""

from __future__ import annotations

import copy
import math
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray, FloatImage
from sonarrec.config import Config
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Estimate, Fan, FrameResult, Groups, Motion, Selection
from sonarrec.recogniser.estimates import declared
from sonarrec.recogniser.plane import working_plane
from sonarrec.recogniser.restore.beam_width import usual_beam_width_deg
from sonarrec.recogniser.stage1 import CandidateSelector, enlarged
from sonarrec.recogniser.stage3 import Evidence, likeliest
from sonarrec.recogniser.stage3.appearance import AppearanceMeasurement, Classifier
from sonarrec.recogniser.stage3.model import built_in_model
from sonarrec.recogniser.stage3.shape_matrix import STEP_DEG, ShapeSampler

MOST_STEP_ERROR = 0.25  # disc radii; a motion with a larger standard error begins a new mean
OLD_SHARE = 0.5  # weight of the frames of a look in the next
LEAST_WEIGHT = 2.0  # frames in a pixel of the mean that is searched
LEAST_FRAMES = 12  # in view of a disc; with fewer, a track knows as much as the mean
LEAST_SCORE = 0.25  # of a candidate: the mean is less noisy than a frame, so a low score will do
SIGMA_LEVELS, MIDDLE_LEVEL = 24, 128  # grey levels of the mean: a frame's deviation, and its mean
# The sums lie in square tiles of SIDE pixels; BLOCK_TILES along a side are searched together, and a
# tile is forgotten once all its pixels have faded to less than LEAST_KEPT frames.
SIDE, BLOCK_TILES, LEAST_KEPT = 256, 2, 1e-3
SAME_DISC = 0.25  # disc diameters up to which a track is of a disc
LEAST_SHARE = 0.5  # of a disc in view, from which on a frame shows it
FIRST_NUMBER = 1_000_000  # of the objects that have no track; tracks are fewer
# The joint belief is the product of these powers of the track's belief and the look's. They sum to
# more than 1 as in TrackBelief. A disc without a track needs more belief. Tuning seeds.
TRACK_EXPONENT, LOOK_EXPONENT, DECLARE_ALONE = 0.575, 0.575, 0.9
LEAST_BELIEF = 1e-4  # in the product
EXISTENCE = 0.99  # probability that a candidate of the mean exists
SPREAD = 0.02  # disc diameters: standard deviation of its position


@dataclass(frozen=True, slots=True)
class _Disc:
    """A disc in the mean.

    number: of its object, if it has no track. position: (2,) pixels of the grid. probabilities:
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

    def orientation_in(self, pose: FloatArray) -> float:
        """In a frame of this pose, as in Estimate."""
        return float((self.orientation_deg + math.degrees(pose[0])) % 360)


@dataclass(slots=True)
class _HalfLook:
    """The frames between two looks, which take part in both, and the discs of the latest look.

    poses: of the frames, (3,) yaw (rad), x and y (pixels of the grid; to the right and ahead of yaw
    0).
    """

    poses: list[FloatArray] = field(default_factory=list)
    discs: list[_Disc] = field(default_factory=list)


def looks_again(config: Config) -> bool:
    """Whether this method's results wait for a second look."""
    track = config.features.measurement == "track" and config.candidates.detector == "ring"
    return config.features.lag_frames > 0 and track and config.candidates.plane == "floor"


class SecondLook:
    """The mean of the last frames of one log, and the discs in it, for one method's results."""

    def __init__(
        self,
        method: str,
        config: Config,
        fan: Fan,
        landmarks: LandmarkSet,
        model: Classifier | None,
    ) -> None:
        """config: one for which `looks_again`. model: by default the built-in one."""
        self._method, self._features = method, config.features
        select, features, radius_m = config.candidates, config.features, landmarks.radius_m
        self._landmarks, self._select = landmarks, replace(select, threshold=LEAST_SCORE)
        self._beam_width_deg = features.beam_width_deg or usual_beam_width_deg(fan)
        self._plane = plane = working_plane("floor", fan, radius_m, select.disc_radius_px)
        self._pixel_m = fan.metres_per_pixel / plane.scale
        self._inside = plane.inside.astype(np.float32)
        self._share = plane.disc_share()
        self._sampler = ShapeSampler(landmarks, plane.axes)
        self._measurement = AppearanceMeasurement(
            features,
            plane,
            self._sampler,
            landmarks,
            model or built_in_model(),
            self._beam_width_deg,
            config.continuity.remember_frames,
        )
        middle_m = (fan.range_min_m + fan.range_max_m) / 2
        self._error_of = np.array([math.radians(1) * middle_m, 1, 1]) / radius_m
        # By (column, row), which may be negative: (2, SIDE, SIDE) the sum of the pictures, and of
        # the frames that show each pixel.
        self._tiles = defaultdict[tuple[int, int], FloatImage](
            lambda: np.zeros((2, SIDE, SIDE), np.float32)
        )
        self._waiting: deque[tuple[ByteImage, FloatImage, FloatImage]] = deque()
        self._half = max(features.lag_frames // 2, 1)  # frames between two looks
        self._pose: FloatArray = np.zeros(3)
        self._now, self._before = _HalfLook(), _HalfLook()
        # The pose and the half look of each frame whose result is not final, by its number.
        self._seen: dict[int, tuple[FloatArray, _HalfLook]] = {}
        self._numbers = FIRST_NUMBER
        self._judged = 0

    def take(self, image: ByteImage, selection: Selection) -> None:
        """Add a frame's working image; its result follows in `learn`."""
        # The selection's score map is not needed, and is up to four times as large as the image.
        self._waiting.append((image, selection.mean, selection.sigma))

    def learn(self, result: FrameResult) -> None:
        """Add the oldest picture to the mean, by the motion in its result."""
        image, mean, sigma = self._waiting.popleft()
        self._move(result.motion)
        self._now.poses.append(self._pose)
        self._seen[result.index] = self._pose, self._now
        self._sum(image, mean, sigma)
        if len(self._now.poses) == self._half:
            self._look()

    def _sum(self, image: ByteImage, mean: FloatImage, sigma: FloatImage) -> None:
        """Add a picture to the mean. mean, sigma: as in Selection."""
        relief = image - enlarged(mean, image.shape)
        relief /= enlarged(sigma, image.shape)
        relief *= self._inside
        matrix = placement(self._pose[0], self._pose[1:], self._plane.apex)
        # The picture on the grid, and the tiles that hold it.
        right, bottom = self._inside.shape[1] - 1, self._inside.shape[0] - 1
        corners = np.array([[0, 0, 1], [right, 0, 1], [0, bottom, 1], [right, bottom, 1]])
        reached = corners @ matrix.T
        low = np.floor(reached.min(axis=0)).astype(int)
        width, height = (np.ceil(reached.max(axis=0)).astype(int) - low).tolist()
        matrix[:, 2] -= low
        (column, row), (left, top) = (of_low.tolist() for of_low in np.divmod(low, SIDE))
        columns, rows = (-(-(o + n) // SIDE) for o, n in ((left, width), (top, height)))
        seen = np.asarray(cv2.warpAffine(self._inside, matrix, (width, height)))
        # Pixels at the edge are interpolated with what was not seen.
        seen = (seen > 0.99).astype(np.float32)
        whole = np.zeros((2, rows * SIDE, columns * SIDE), np.float32)
        part = whole[:, top : top + height, left : left + width]
        part[0] = cv2.warpAffine(relief, matrix, (width, height))
        part[0] *= seen
        part[1] = seen
        blocks = whole.reshape(2, rows, SIDE, columns, SIDE)
        for i in range(rows):
            for j in range(columns):
                self._tiles[column + j, row + i] += blocks[:, i, :, j]

    def finish(self) -> None:
        """Look at the remaining frames: no more follow."""
        if self._now.poses:
            self._look()

    def _move(self, motion: Motion | None) -> None:
        """Update the pose by a motion; where that is too uncertain, begin a new mean."""
        sigma = np.full(3, np.inf)
        if motion is not None and motion.known:
            sigma = np.array([motion.pan_sigma_deg, motion.right_sigma_m, motion.ahead_sigma_m])
        if motion is None or np.linalg.norm(self._error_of * sigma) > MOST_STEP_ERROR:
            self.finish()
            self._tiles.clear()
            self._pose, self._now, self._before = np.zeros(3), _HalfLook(), _HalfLook()
            return
        yaw, x, y = self._pose
        right, ahead = motion.right_m / self._pixel_m, motion.ahead_m / self._pixel_m
        cos, sin = math.cos(yaw), math.sin(yaw)
        shift = right * cos + ahead * sin, ahead * cos - right * sin
        self._pose = np.array([yaw + math.radians(motion.pan_deg), x + shift[0], y + shift[1]])

    def _in_frame(self, pose: FloatArray, on_grid: FloatArray) -> FloatArray:
        """(n, 2) working pixels, in a frame of this pose, of (n, 2) pixels of the grid.

        The inverse of `placement`.
        """
        yaw, x, y = pose
        rotation = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
        return np.asarray((on_grid - (x, -y)) @ rotation.T + self._plane.apex)

    def _shares(self, positions: FloatArray) -> FloatArray:
        """(n,) share of a disc inside the fan; 0 beyond the image."""
        rows, columns = self._share.shape
        column, row = np.rint(positions).astype(int).T
        within = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        return np.where(within, self._share[row.clip(0, rows - 1), column.clip(0, columns - 1)], 0)

    def _look(self) -> None:
        """Search the mean for discs and judge them, for the frames of both halves."""
        found = [disc for block in self._blocks() for disc in self._discs(*block)]
        self._now.discs = self._before.discs = found
        self._before, self._now = self._now, _HalfLook()
        for place, tile in list(self._tiles.items()):
            tile *= OLD_SHARE
            if tile[1].max() < LEAST_KEPT:
                del self._tiles[place]

    def _blocks(self) -> Iterator[tuple[FloatImage, tuple[int, int], tuple[int, int]]]:
        """(sums of a block of tiles with a margin, their first pixel on the grid, the block's)."""
        margin = min(math.ceil(3 * self._plane.axes[0]), SIDE)
        size, empty = BLOCK_TILES * SIDE, np.zeros((2, SIDE, SIDE), np.float32)
        cut, near = slice(SIDE - margin, SIDE + size + margin), range(-1, BLOCK_TILES + 1)
        for column, row in sorted({(c // BLOCK_TILES, r // BLOCK_TILES) for c, r in self._tiles}):
            first = column * BLOCK_TILES, row * BLOCK_TILES
            around = [
                [self._tiles.get((first[0] + j, first[1] + i), empty) for j in near] for i in near
            ]
            sums = np.block(around)[:, cut, cut]
            seen = sums[1] >= LEAST_WEIGHT
            if not seen.any():
                continue
            down, across = (np.flatnonzero(seen.any(axis=a))[[0, -1]] for a in (1, 0))
            part = sums[:, down[0] : down[1] + 1, across[0] : across[1] + 1]
            left, top = column * size, row * size
            yield part, (left - margin + int(across[0]), top - margin + int(down[0])), (left, top)

    def _discs(
        self, sums: FloatImage, corner: tuple[int, int], block: tuple[int, int]
    ) -> list[_Disc]:
        """The discs in a block of the mean. The arguments are from `_blocks`."""
        total, count = sums
        inside = (count >= LEAST_WEIGHT).astype(np.uint8)
        plane = copy.copy(self._plane)
        plane.inside, plane.shape = inside, (inside.shape[0], inside.shape[1])
        mean = total / np.maximum(count, 1e-6)
        image = np.clip(MIDDLE_LEVEL + SIGMA_LEVELS * mean, 0, 255).astype(np.uint8)
        select = CandidateSelector(self._select, plane, self._landmarks, self._beam_width_deg)
        pixels = select(image * inside).positions
        on_grid = pixels + corner
        own = ((on_grid >= block) & (on_grid < np.array(block) + BLOCK_TILES * SIDE)).all(axis=1)
        pixels, on_grid = pixels[own], on_grid[own]
        n = len(pixels)
        if not n:
            return []
        poses = self._before.poses + self._now.poses
        shown = np.array([self._in_frame(pose, on_grid) for pose in poses])
        weight = np.array([self._shares(position) >= LEAST_SHARE for position in shown])
        towards = [
            np.exp(1j * (self._plane.line_of_sight(position) - pose[0]))
            for pose, position in zip(poses, shown, strict=True)
        ]
        sight = np.angle((weight * towards).sum(axis=0))
        # Positions in the first frame that shows each disc; its range gives the beam's smear.
        positions = shown[np.argmax(weight, axis=0), np.arange(n)]
        grey, seen = self._sampler(
            *(image, inside, pixels, sight),
            *(np.full(n, float(MIDDLE_LEVEL)), np.full(n, float(SIGMA_LEVELS))),
        )
        often, _ = self._sampler(
            np.minimum(count, 255).astype(np.uint8), inside, pixels, sight, np.zeros(n), np.ones(n)
        )
        often = np.minimum(often, self._features.memory_frames) * seen
        frames = weight.sum(axis=0)
        self._judged += n
        groups = Groups(
            self._judged - np.arange(n),
            positions,
            np.full((n, 2), SPREAD),
            np.full(n, EXISTENCE),
            np.zeros(n),
            frames > 0,
            np.empty(0, np.int64),
        )
        evidence = Evidence(grey, often, frames, np.zeros(n, np.int64))
        beliefs = self._measurement.beliefs([groups], evidence)
        orientation = np.degrees(sight) + beliefs.rotation * STEP_DEG
        best, scores = likeliest(beliefs.probabilities)
        claimed = declared(scores, max(self._features.declare, DECLARE_ALONE)) & beliefs.earned
        return [
            _Disc(
                self._number(on_grid[i]),
                on_grid[i],
                beliefs.probabilities[i],
                int(best[i]),
                float(scores[i]),
                bool(claimed[i]),
                float(orientation[i]),
                float(beliefs.rotation_sigma[i] * STEP_DEG),
            )
            for i in np.flatnonzero(frames >= LEAST_FRAMES).tolist()
        ]

    def _number(self, position: FloatArray) -> int:
        """The number of a disc's object: that of the last look's disc there, else a new one."""
        for disc in self._before.discs:
            if math.dist(disc.position, position) <= 2 * SAME_DISC * self._plane.axes[0]:
                return disc.number
        self._numbers += 1
        return self._numbers

    def revised(self, result: FrameResult) -> FrameResult:
        """A past result with the beliefs of the latest look at its frame."""
        pose, half = self._seen.pop(result.index)
        if not half.discs:
            return result
        positions = self._in_frame(pose, np.array([disc.position for disc in half.discs]))
        shares = self._shares(positions)
        estimates = list(result.estimates)
        own = [i for i, e in enumerate(estimates) if e.method == self._method]
        polar = np.array([(estimates[i].range_m, estimates[i].bearing_deg) for i in own])
        found = np.column_stack(self._plane.from_polar(*polar.reshape(-1, 2).T))
        distance = np.linalg.norm(positions[:, None] - found, axis=2) / (2 * self._plane.axes[0])
        both: list[tuple[int, _Disc]] = []  # the estimate of a disc's track
        added = []
        for n, disc in enumerate(half.discs):
            nearest = int(distance[n].argmin()) if own else -1
            if own and distance[n, nearest] <= SAME_DISC and distance[:, nearest].argmin() == n:
                both.append((own[nearest], disc))
            elif (
                disc.declared
                and shares[n] >= LEAST_SHARE
                and (not own or distance[n].min() > 2 * SAME_DISC)
            ):
                added.append(self._estimate(disc, positions[n], pose))
        if both:
            self._join(estimates, both, pose)
        tracks = result.tracks + len(added)
        return replace(result, estimates=(*estimates, *added), tracks=tracks)

    def _join(
        self, estimates: list[Estimate], both: Sequence[tuple[int, _Disc]], pose: FloatArray
    ) -> None:
        """Give tracks the joint belief of track and look. both: index of an estimate, its disc."""
        of_tracks = np.stack([estimates[i].probabilities for i, _ in both])
        of_look = np.stack([disc.probabilities for _, disc in both])
        pool = np.maximum(of_tracks, LEAST_BELIEF) ** TRACK_EXPONENT
        pool *= np.maximum(of_look, LEAST_BELIEF) ** LOOK_EXPONENT
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

    def _estimate(self, disc: _Disc, position: FloatArray, pose: FloatArray) -> Estimate:
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


def placement(yaw: float, position: FloatArray, apex: tuple[float, float]) -> FloatArray:
    """(2, 3) from the pixels (column, row, 1) of a floor plane's working image to the grid's.

    yaw (rad), position (2,): of the sonar; x and y in grid pixels, y against the rows. apex: of the
    image.
    """
    cos, sin = math.cos(yaw), math.sin(yaw)
    rotation = np.array([[cos, -sin], [sin, cos]])
    return np.column_stack([rotation, position * (1, -1) - rotation @ apex])
