"""Measures the sonar's motion in its images: the pan where it stands, else surge, sway and yaw.

Most sonars stand on a tripod and pan. For these the pan alone is measured, by correlation along
the bearing, which is cheap and robust. Every few frames a quick registration tests whether the
sonar has started to move. A moving sonar's surge, sway and yaw are measured by registration:
against a keyframe where it is slow, else from frame to frame.
"""

from __future__ import annotations

import math

import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.recogniser.motion.keyframes import SUSPECT, Keyframes
from sonarrec.recogniser.motion.motion_grid import motion_grid
from sonarrec.recogniser.motion.pan import PanEstimator
from sonarrec.recogniser.motion.registration import FloorRegistration, Picture, Registration
from sonarrec.recogniser.plane import Plane
from sonarrec.sonar.frame import Motion

# Least match (correlation) at which a registration is accepted: one that started from the last
# frame's motion, and one that started from a search. Pictures of different floor match by up to 0.2
# (tuning seeds), with large standard errors.
LEAST_NEAR, LEAST_SEARCHED = 0.1, 0.25
# A standing sonar has started to move if a searched registration matches by this much more than
# the pan alone.
BETTER = 0.1
# A standing sonar may have started to move if the pan's match falls below USUAL_SHARE of its usual
# value: a running mean over about USUAL_MEMORY frames, which starts at FIRST_USUAL.
USUAL_SHARE, FIRST_USUAL, USUAL_MEMORY = 0.75, 0.8, 20.0
CHECK_EVERY = 8  # frames between quick registrations of a standing sonar that matches as usual
# If the pan matches poorly, any motion is searched for: again in the next frame, then after 2, 4
# and so on, up to MOST_PAUSE frames. About half of a fast vehicle's pairs of frames register.
MOST_PAUSE = 8
# Evidence for a translation fades by the factor KEEP a frame. By its chi-square, of 2 degrees of
# freedom, a standing sonar moves if it is above SET_OUT, and a moving one stands if below STAND.
KEEP = 0.9
SET_OUT, STAND = 40.0, 10.0
LEAST_UNDER_WAY = 8  # frames before a moving sonar may be found to stand
# Standard errors of the speed where nothing is measured: of a moving sonar, whose last speed is
# reported; and where no speed is known.
LOST_M_S, LOST_DEG_S = 0.15, 8.0
UNKNOWN_M_S, UNKNOWN_DEG_S = 0.5, 20.0
MOST_LOST = 8  # frames in a row without a registration, after which the speed counts as unknown
USUAL_STEP_S = 0.25  # between frames whose times do not rise
SCALE_ERROR = 0.005  # share of a shift, from an uncertain height and a floor that is not flat


class _Evidence:
    """The evidence for a translation in the last frames; that of older frames fades.

    A Gaussian in information form: matrix (2, 2), the sum of inverse covariances; vector (2,), the
    sum of these times the translations (m). sigma: (2,) standard error of the mean translation (m a
    frame); None before the first frame.
    """

    def __init__(self) -> None:
        self.vector: FloatArray = np.zeros(2)
        self.matrix: FloatArray = np.zeros((2, 2))
        self.sigma: FloatArray | None = None

    def add(self, registration: Registration) -> float:
        """Add a frame. Returns the chi-square, of 2 degrees of freedom, of the mean translation."""
        information = np.linalg.inv(registration.covariance[:2, :2] + 1e-9 * np.eye(2))
        self.vector = KEEP * self.vector + information @ registration.motion[:2]
        self.matrix = KEEP * self.matrix + information
        inverse = np.linalg.inv(self.matrix)
        # The faded mean of independent frames varies less than `inverse` says, by this factor.
        self.sigma = np.sqrt(np.diag(inverse) / (1 + KEEP))
        return float(self.vector @ inverse @ self.vector) * (1 + KEEP)


MIN_MATCH = 0.25  # correlation below which a pan counts as not measured; by hand


class ImageMotion:
    """The sonar's motion from image to image of one log."""

    def __init__(self, plane: Plane) -> None:
        self.pan = PanEstimator(plane)
        self._registration = FloorRegistration(
            plane.fan, self.pan.range_m, self.pan.bearing_deg, self.pan.seen
        )
        self._picture = self._registration.picture(self.pan.picture)
        self._keyframes = Keyframes(self._registration)
        self.begin_stretch()

    def begin_stretch(self) -> None:
        """The next image is as the first of a log."""
        self.pan.begin_stretch()
        self._keyframes.clear()
        self._evidence = _Evidence()
        self._usual_match = FIRST_USUAL
        self._speed: FloatArray | None = None  # (3,) m, m and rad a second; None: it stands
        self._under_way = self._lost = 0  # frames
        self._since_quick = 0  # frames since the last quick registration
        self._pan_sigma: float | None = None  # deg, by the last quick registration
        self._pause = self._since_search = 0  # frames between searches, and since the last

    def step(self, image: ByteImage, seconds: float | None) -> Motion | None:
        """The motion since the last image; None for the first.

        Where the images of a moving sonar do not show its motion, its last speed is taken. image:
        the working image. seconds: since the last image; None for the first.
        """
        before = self._picture
        if before.grey is not self.pan.picture:  # poses gave the motion to the last image
            before = self._registration.picture(self.pan.picture)
        self.pan.add_image(image)
        now = self._picture = self._registration.picture(self.pan.picture)
        if seconds is None:
            return None
        if seconds <= 0:
            seconds = USUAL_STEP_S
        if self._speed is None:
            return self._standing(before, now, seconds)
        return self._moving(before, now, self._speed * seconds, seconds)

    def _standing(self, before: Picture, now: Picture, seconds: float) -> Motion:
        """The motion of a sonar that stood until now."""
        pan_deg, match = self.pan.rotation()
        yaw = math.radians(pan_deg)
        start = np.array([0.0, 0.0, yaw])
        self._since_quick += 1
        self._since_search += 1
        poor = match < USUAL_SHARE * self._usual_match
        if match < USUAL_SHARE * FIRST_USUAL:  # poor by any standard: search with pauses
            poor |= self._since_search >= self._pause
        quick, crept, moves = None, False, False
        if poor or self._pan_sigma is None or self._since_quick >= CHECK_EVERY:
            quick, crept, moves = self._quick_check(before, now, yaw)
        if moves or poor:
            registered = None
            if moves or not (quick is not None and _stands(quick)):
                registered = self._register(before, now, start, searched=not moves)
            if registered is not None and registered.match > (match if moves else match + BETTER):
                self._evidence, self._under_way, self._pause = _Evidence(), 0, 0
                if not crept:
                    self._keyframes.clear()
                return self._accept(registered, now, seconds)
            # The sonar stands, and pictures of this floor match no better.
            self._usual_match = match
            self._since_search = 0
            self._pause = min(max(2 * self._pause, 1), MOST_PAUSE)
            if moves and quick is not None:
                self._evidence = _Evidence()
                self._evidence.add(quick)
        self._usual_match += (match - self._usual_match) / USUAL_MEMORY
        self._keyframes.keep(now, start)
        if match < MIN_MATCH or self._pan_sigma is None or self._evidence.sigma is None:
            return unknown(seconds)
        right, ahead = self._evidence.sigma.tolist()
        return Motion(pan_deg, 0.0, 0.0, self._pan_sigma, right, ahead)

    def _quick_check(
        self, before: Picture, now: Picture, yaw: float
    ) -> tuple[Registration | None, bool, bool]:
        """(a quick registration, whether a keyframe shows a motion, whether that or the evidence
        of the last frames does). yaw: the pan since the picture before, rad."""
        quick = self._registration.quick(before, now, yaw)
        crept = self._keyframes.crept(now, yaw, SET_OUT)
        moves = (quick is not None and self._evidence.add(quick) > SET_OUT) or crept
        self._since_quick = 0
        self._pan_sigma = None
        if quick is not None:
            self._pan_sigma = math.hypot(math.degrees(quick.sigma[2]), self.pan.scatter_deg)
        return quick, crept, moves

    def _moving(self, before: Picture, now: Picture, start: FloatArray, seconds: float) -> Motion:
        """The motion of a sonar that was under way. start: (3,) the motion at its last speed."""
        by_keyframe = self._keyframes.registered(now, start)
        registration = by_keyframe
        if registration is None:
            self._keyframes.clear()
            registration = self._register(before, now, start, searched=False)
            registration = registration or self._register(before, now, start, searched=True)
        if registration is not None:
            motion = self._accept(registration, now, seconds)
            self._under_way += 1
            evidence = self._evidence.add(registration)
            if by_keyframe is not None:
                over_stretch = self._keyframes.under_way(by_keyframe)
                evidence = evidence if over_stretch is None else over_stretch
            if evidence < STAND and self._under_way >= LEAST_UNDER_WAY:
                self._speed, self._usual_match = None, registration.match
                self._keyframes.clear()
            return motion
        self._lost += 1
        if self._lost > MOST_LOST:
            self._speed, self._lost, self._usual_match = None, 0, FIRST_USUAL
            return unknown(seconds)
        right, ahead, yaw = start.tolist()
        metres, degrees = LOST_M_S * seconds, LOST_DEG_S * seconds
        return Motion(math.degrees(yaw), right, ahead, degrees, metres, metres)

    def _register(
        self, before: Picture, now: Picture, start: FloatArray, *, searched: bool
    ) -> Registration | None:
        """A registration from `start`, or from a search; None where it is not accepted."""
        if searched:
            start = motion_grid(self._registration.grid).best(before.grey, now.grey)
        least = LEAST_SEARCHED if searched else LEAST_NEAR
        refined = self._registration.refined(before, now, start)
        return None if refined is None or refined.loose or refined.match < least else refined

    def _accept(self, registration: Registration, now: Picture, seconds: float) -> Motion:
        """The motion by a registration, which also updates the speed and the keyframes.

        Its errors are widened by SCALE_ERROR.
        """
        self._keyframes.keep(now, registration.motion)
        self._speed, self._lost = registration.motion / seconds, 0
        right, ahead, yaw = registration.motion.tolist()
        sigma = np.hypot(registration.sigma, [SCALE_ERROR * right, SCALE_ERROR * ahead, 0])
        pan_deg, pan_sigma_deg = math.degrees(yaw), math.degrees(sigma[2])
        return Motion(pan_deg, right, ahead, pan_sigma_deg, float(sigma[0]), float(sigma[1]))


def _stands(quick: Registration) -> bool:
    """Whether a quick registration leaves no translation to search for: it matches, shows none."""
    return quick.match >= LEAST_SEARCHED + BETTER and quick.translation(quick.motion) <= SUSPECT


def unknown(seconds: float) -> Motion:
    """The motion if none is measured: 0, with standard errors of a slow vehicle's whole motion."""
    metres, degrees = UNKNOWN_M_S * seconds, UNKNOWN_DEG_S * seconds
    return Motion(0.0, 0.0, 0.0, degrees, metres, metres, known=False)
