"""Keyframes: earlier pictures to which a slow sonar's later ones are registered.

Steps from frame to frame are measured with a bias of up to a twentieth of a cell, which at a
constant speed always has the same sign. Over many frames these errors add up, and a sonar that
moves slowly seems to stand. A pose measured from a keyframe at some cells' distance has the error
of a single step.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.recogniser.motion.registration import FloorRegistration, Picture, Registration

# A keyframe is used at a distance of 6 to 12 cells, as long as it matches by LEAST_MATCH. Steps of
# more than MOST_STEP cells are measured from frame to frame: their bias matters little, and
# consecutive pictures overlap more.
KEYFRAME_CELLS, LEAST_MATCH, MOST_STEP = 12, 0.3, 2.0
STRETCH = 16  # frames over which a motion must be significant, else the sonar is taken to stand
# Chi-square, of 2 degrees of freedom, of a quick registration above which a full one is made.
SUSPECT = 9.0


class _Keyframe(NamedTuple):
    pose: FloatArray
    """(3,) of the sonar relative to the log's first picture, as Registration.motion."""
    picture: Picture


class Keyframes:
    """The last keyframes of one log, and the sonar's pose by them."""

    def __init__(self, registration: FloorRegistration) -> None:
        self._registration = registration
        self._pose: FloatArray = np.zeros(3)
        self._kept = deque[_Keyframe](maxlen=2)  # older first
        self._trail = deque[FloatArray](maxlen=STRETCH)  # the last poses

    def clear(self) -> None:
        """Forget all keyframes, after a motion that was not measured from one."""
        self._kept.clear()
        self._trail.clear()

    def registered(self, now: Picture, start: FloatArray) -> Registration | None:
        """The motion since the last picture, near `start`; None where no keyframe gives it.

        start: (3,) as Registration.motion.
        """
        if not self._kept or self._registration.cells(start) > MOST_STEP:
            return None
        keyframe = self._kept[0]
        expected = _between(keyframe.pose, _after(self._pose, start))
        refined = self._registration.refined(keyframe.picture, now, expected)
        if refined is None or refined.loose or refined.match < LEAST_MATCH:
            return None
        # The last picture's pose has an error of its own.
        motion = _between(self._pose, _after(keyframe.pose, refined.motion))
        return replace(refined, motion=motion, covariance=2 * refined.covariance)

    def keep(self, now: Picture, motion: FloatArray) -> None:
        """Take in a motion (3,) since the last picture; this one may become a keyframe."""
        self._pose = _after(self._pose, motion)
        self._trail.append(self._pose)
        distance = math.inf
        if self._kept:
            distance = self._registration.cells(_between(self._kept[0].pose, self._pose))
        if distance >= KEYFRAME_CELLS / 2 * len(self._kept):
            # Of two, the older goes.
            self._kept.append(_Keyframe(self._pose, now))

    def crept(self, now: Picture, yaw: float, sure: float) -> bool:
        """Whether a keyframe shows that a sonar taken to stand has moved; its pose is then updated.

        yaw: since the last picture, rad. sure: the chi-square, of 2 degrees of freedom, above
        which the sonar has moved.
        """
        if not self._kept:
            return False
        keyframe = self._kept[0]
        expected = _between(keyframe.pose, _after(self._pose, np.array([0.0, 0.0, yaw])))
        quick = self._registration.quick(keyframe.picture, now, float(expected[2]))
        if quick is None or quick.match < LEAST_MATCH:
            self.clear()
            return False
        if quick.translation(quick.motion) <= SUSPECT:
            return False
        refined = self._registration.refined(keyframe.picture, now, expected)
        if refined is None or refined.loose or refined.translation(refined.motion) <= sure:
            return False
        # The motion so far is not reported: the tracks have followed their discs without it.
        self._pose = _after(_after(keyframe.pose, refined.motion), np.array([0.0, 0.0, -yaw]))
        return True

    def under_way(self, registration: Registration) -> float | None:
        """The chi-square, of 2 degrees of freedom, of the translation over the last STRETCH frames.

        registration: from `registered`, whose covariance is used. None before STRETCH frames.
        """
        if len(self._trail) < STRETCH:
            return None
        return registration.translation(_between(self._trail[0], self._pose))


def _after(pose: FloatArray, motion: FloatArray) -> FloatArray:
    """(3,) the pose that a motion (3,) leads to from `pose` (3,)."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    right, ahead, yaw = motion
    way = [right * cos + ahead * sin, ahead * cos - right * sin, yaw]
    return np.asarray(pose + np.array(way))


def _between(pose: FloatArray, later: FloatArray) -> FloatArray:
    """(3,) the motion that leads from `pose` (3,) to `later` (3,)."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x, y, yaw = later - pose
    return np.array([x * cos - y * sin, x * sin + y * cos, yaw])
