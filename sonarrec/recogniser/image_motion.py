"""How the sonar moved, as its images show it: a turn alone where it stands, else all three.

Most sonars stand on a tripod and pan. There the turn alone is measured along the bearing, which is
cheap and robust, and a quick look at what it leaves over tells whether the sonar began to move. Of
a sonar under way surge, sway and yaw are registered from frame to frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from sonarrec.recogniser.plane import Plane
from sonarrec.recogniser.registration import FloorRegistration, Registered
from sonarrec.records import ByteImage, FloatArray, FloatImage, Motion

RANGES = 128
BEARINGS = 192
# Of the field of view: how much of two frames must overlap for their match to be believed.
LEAST_OVERLAP = 0.4

# Least match of a registration to be believed: one from the last frame's motion, and one that was
# searched for. Pictures of different floor match by up to 0.2 (tuning seeds), and loosely then.
LEAST_NEAR, LEAST_SEARCHED = 0.1, 0.25
# Standard errors (m, m, rad) beyond which a registration tells nothing.
LOOSEST = (0.015, 0.015, math.radians(0.6))
# By so much more must pictures match than by a turn alone for the sonar to have moved.
BETTER = 0.1
# A standing sonar whose pictures match by less than this share of what they usually do may have
# begun to move. What they do at first, before it is known.
USUAL_SHARE, FIRST_USUAL, USUAL_MEMORY = 0.75, 0.8, 20.0
# So often, in frames, a standing sonar that matches as usual is looked at for what a turn leaves.
LOOK_EVERY = 4
# Where a turn explains little, any motion is searched for: in the next frame again, then after two,
# four and so on, up to so many. Of a fast vehicle about every second pair of frames tells.
MOST_PAUSE = 8
# Forgetting of what says that the sonar moves, from frame to frame; chi-squares (2) above which it
# sets out, and below which it stands again.
KEEP = 0.9
SET_OUT, STAND = 40.0, 10.0
LEAST_UNDER_WAY = 8  # frames
# Standard errors where nothing is measured: of a sonar under way about its last speed, and of any.
LOST_M_S, LOST_DEG_S = 0.15, 8.0
UNKNOWN_M_S, UNKNOWN_DEG_S = 0.5, 20.0
MOST_LOST = 8  # frames
USUAL_STEP_S = 0.25
# Of the way made, what an unknown height and the flat floor may be wrong by.
SCALE_ERROR = 0.005


class PanEstimator:
    """Pan between consecutive working images by correlation along the bearing.

    picture: the last image's, (RANGES, BEARINGS) float32 grey over the mean of its range bin and
    of its beam, 0 where nothing is seen.
    """

    def __init__(self, plane: Plane) -> None:
        fan = plane.fan
        self._step_deg = (fan.bearing_max_deg - fan.bearing_min_deg) / BEARINGS
        self.bearing_deg = fan.bearing_min_deg + (np.arange(BEARINGS) + 0.5) * self._step_deg
        margin = 0.5 * fan.window_m / RANGES
        self.range_m = np.linspace(fan.range_min_m + margin, fan.range_max_m - margin, RANGES)
        column, row = plane.from_polar(self.range_m[:, None], self.bearing_deg[None])
        self._column = column.astype(np.float32)
        self._row = row.astype(np.float32)
        seen = cv2.remap(plane.inside, self._column, self._row, cv2.INTER_NEAREST)
        self.seen = np.asarray(seen, dtype=np.float32)
        self.picture: FloatImage = np.zeros_like(self.seen)
        self._cells = np.maximum(self.seen.sum(axis=1, keepdims=True), 1)
        shift = np.arange(2 * BEARINGS)
        shift = np.where(shift < BEARINGS, shift, shift - 2 * BEARINGS)
        self._shift = shift
        # The beams that two frames have in common at each shift: [low, high) of the later one.
        self._low = np.clip(-shift, 0, BEARINGS)
        self._high = np.clip(BEARINGS - shift, 0, BEARINGS)
        self._tried = np.abs(shift) <= (1 - LEAST_OVERLAP) * BEARINGS
        self._before: tuple[FloatImage, FloatArray] | None = None

    def step(self, image: ByteImage) -> tuple[float, float]:
        """(pan in deg since the last image, correlation there, 0 to 1).

        The pan is positive where the sonar turned right, so that objects moved to the left.
        (0, 0) for the first image and for a blank one.
        """
        polar = np.asarray(cv2.remap(image, self._column, self._row, cv2.INTER_LINEAR), np.float32)
        polar *= self.seen
        # What does not turn with the floor would match at no shift: the fall-off with range is in
        # the mean of each range bin, the gain of each beam in the mean of each beam.
        polar -= polar.sum(axis=1, keepdims=True) / self._cells
        polar *= self.seen
        polar -= polar.mean(axis=0)
        polar *= self.seen
        self.picture = polar
        # Twice as wide, so that no beam meets one from the other edge.
        wide = cv2.copyMakeBorder(polar, 0, 0, 0, BEARINGS, cv2.BORDER_CONSTANT)
        spectrum = np.asarray(cv2.dft(wide, flags=cv2.DFT_ROWS), np.float32)
        energy = np.concatenate([[0.0], np.cumsum((polar**2).sum(axis=0, dtype=float))])
        before, self._before = self._before, (spectrum, energy)
        if before is None:
            return 0.0, 0.0
        # product[s] = sum over cells of now[b] * before[b + s]: s > 0 is a turn to the right.
        crossed = cv2.mulSpectrums(before[0], spectrum, cv2.DFT_ROWS, conjB=True)
        summed = cv2.reduce(crossed, 0, cv2.REDUCE_SUM)
        product = cv2.idft(summed, flags=cv2.DFT_ROWS | cv2.DFT_SCALE)[0]
        low, high = self._low, self._high
        now_energy = energy[high] - energy[low]
        before_energy = before[1][BEARINGS - low] - before[1][BEARINGS - high]
        scale = np.sqrt(np.maximum(now_energy * before_energy, 1e-9))
        match = np.where(self._tried, product / scale, -1.0)
        best = int(match.argmax())
        left, right = match[best - 1], match[(best + 1) % len(match)]
        bend = left - 2 * match[best] + right
        part = 0.5 * (left - right) / bend if bend < 0 else 0.0
        return (
            float((self._shift[best] + np.clip(part, -0.5, 0.5)) * self._step_deg),
            float(np.clip(match[best], 0, 1)),
        )


@dataclass(slots=True)
class _Drift:
    """What the last frames, fading from one to the next, say of a translation.

    sigma: (2,) standard error of a steady motion (m a frame) that these frames would show; None
    where there are none.
    """

    pull: FloatArray
    weight: FloatArray
    sigma: FloatArray | None = None

    @classmethod
    def none(cls) -> _Drift:
        return cls(np.zeros(2), np.zeros((2, 2)))

    def add(self, found: Registered) -> float:
        """Take in a frame. Returns the chi-square (2) against a sonar that stands."""
        weight = np.linalg.inv(found.covariance[:2, :2] + 1e-9 * np.eye(2))
        self.pull = KEEP * self.pull + weight @ found.motion[:2]
        self.weight = KEEP * self.weight + weight
        inverse = np.linalg.inv(self.weight)
        self.sigma = np.sqrt(np.diag(inverse) / (1 + KEEP))
        return float(self.pull @ inverse @ self.pull) * (1 + KEEP)


class ImageMotion:
    """The motion from image to image of one log."""

    def __init__(self, plane: Plane, min_match: float) -> None:
        """min_match: correlation below which a turn alone is not believed."""
        self.pan = PanEstimator(plane)
        self._min_match = min_match
        self._registration = FloorRegistration(
            plane.fan, self.pan.range_m, self.pan.bearing_deg, self.pan.seen
        )
        self._drift = _Drift.none()
        self._usual = FIRST_USUAL
        self._speed: FloatArray | None = None  # (3,) a second; None: it stands
        self._under_way = self._lost = self._unseen = 0  # frames
        self._pan_sigma: float | None = None  # of a turn, as last looked at
        self._pause = self._unsearched = 0  # frames

    def step(self, image: ByteImage, seconds: float | None) -> Motion | None:
        """The motion since the last image; its last speed where a sonar under way loses the floor.

        image: the working image. seconds: since the last one, None for the first, which has none.
        """
        before = self.pan.picture
        pan_deg, match = self.pan.step(image)
        if seconds is None:
            return None
        if seconds <= 0:
            seconds = USUAL_STEP_S
        if self._speed is not None:
            return self._moving(before, match, seconds)
        return self._standing(before, pan_deg, match, seconds)

    def turn(self, image: ByteImage) -> float | None:
        """The turn alone since the last image, deg; None where it is not to be believed."""
        pan_deg, match = self.pan.step(image)
        return pan_deg if match >= self._min_match else None

    def _standing(self, before: FloatImage, pan_deg: float, match: float, seconds: float) -> Motion:
        """Of a sonar that stood so far."""
        turn = math.radians(pan_deg)
        worse, drifts, quick = match < USUAL_SHARE * FIRST_USUAL, False, None
        self._unseen += 1
        self._unsearched += 1
        poor = match < USUAL_SHARE * self._usual or (worse and self._unsearched >= self._pause)
        if poor or self._pan_sigma is None or self._unseen >= LOOK_EVERY:
            self._unseen = 0
            quick = self._registration.quick(before, self.pan.picture, turn)
            drifts = quick is not None and self._drift.add(quick) > SET_OUT
            self._pan_sigma = None if quick is None else math.degrees(quick.sigma[2])
        if drifts or poor:
            start = np.array([0.0, 0.0, turn])
            found = self._registered(before, start, searched=not drifts)
            least = match if drifts else match + BETTER
            if found is not None and found.match > least:
                self._drift, self._under_way = _Drift.none(), 0
                self._pause = 0
                return self._went(found, seconds)
            # So this is how a sonar that stands matches here.
            self._usual = match
            self._unsearched = 0
            self._pause = min(max(2 * self._pause, 1), MOST_PAUSE)
            if drifts and quick is not None:
                self._drift = _Drift.none()
                self._drift.add(quick)
        self._usual += (match - self._usual) / USUAL_MEMORY
        if match < self._min_match or self._pan_sigma is None or self._drift.sigma is None:
            return unknown(seconds)
        right, ahead = self._drift.sigma.tolist()
        return Motion(pan_deg, 0.0, 0.0, self._pan_sigma, right, ahead)

    def _moving(self, before: FloatImage, match: float, seconds: float) -> Motion:
        """Of a sonar under way."""
        assert self._speed is not None
        start = self._speed * seconds
        found = self._registered(before, start, searched=False)
        found = found or self._registered(before, start, searched=True)
        if found is not None:
            self._under_way += 1
            if self._drift.add(found) < STAND and self._under_way >= LEAST_UNDER_WAY:
                self._speed, self._usual = None, match
                return _motion(found)
            return self._went(found, seconds)
        self._lost += 1
        if self._lost > MOST_LOST:
            self._speed, self._lost, self._usual = None, 0, FIRST_USUAL
            return unknown(seconds)
        right, ahead, turn = start.tolist()
        metres, degrees = LOST_M_S * seconds, LOST_DEG_S * seconds
        return Motion(math.degrees(turn), right, ahead, degrees, metres, metres)

    def _registered(
        self, before: FloatImage, start: FloatArray, *, searched: bool
    ) -> Registered | None:
        """A registration to be believed, from `start` or from the best of the grid."""
        now = self.pan.picture
        if searched:
            start = self._registration.searched(before, now)
        found = self._registration.refined(before, now, start)
        if found is None or (found.sigma > LOOSEST).any():
            return None
        return found if found.match >= (LEAST_SEARCHED if searched else LEAST_NEAR) else None

    def _went(self, found: Registered, seconds: float) -> Motion:
        self._speed, self._lost = found.motion / seconds, 0
        return _motion(found)


def unknown(seconds: float) -> Motion:
    """Of a sonar of which nothing is known but that vehicles are slow."""
    metres, degrees = UNKNOWN_M_S * seconds, UNKNOWN_DEG_S * seconds
    return Motion(0.0, 0.0, 0.0, degrees, metres, metres, known=False)


def _motion(found: Registered) -> Motion:
    right, ahead, turn = found.motion.tolist()
    sigma = np.hypot(found.sigma, [SCALE_ERROR * right, SCALE_ERROR * ahead, 0])
    return Motion(
        math.degrees(turn),
        right,
        ahead,
        math.degrees(sigma[2]),
        float(sigma[0]),
        float(sigma[1]),
    )
