"""Earlier pictures, the keys, to which a slow sonar's later ones are registered.

From frame to frame a small step is measured long or short by up to a twentieth of a cell, at a
steady speed always to the same side: over many frames it adds up, and what creeps looks as if it
stood. Measured from a picture some cells ago, a place is off by no more than a single step.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sonarrec.recogniser.registration import FloorRegistration, Registered
from sonarrec.records import FloatArray, FloatImage

# A key is 6 to 12 cells away, as long as it matches. Steps of more than MOST_STEP cells are
# measured from frame to frame: such errors are small then, and pictures have more in common.
KEY_CELLS, LEAST_MATCH, MOST_STEP = 12, 0.3, 2.0
STRETCH = 12  # frames whose way, all together, must show, else the sonar stands
SUSPECT = 9.0  # chi-square, of 2 degrees of freedom, of the quick registration: look again


class _Key(NamedTuple):
    pose: FloatArray
    """(3,) of the sonar, as Registered.motion, from where the keys began."""
    picture: FloatImage


class FloorKeys:
    """The keys of one log, and where the sonar is by them."""

    def __init__(self, registration: FloorRegistration) -> None:
        self._registration = registration
        self._pose: FloatArray = np.zeros(3)
        self._keys = deque[_Key](maxlen=2)  # older first
        self._trail = deque[FloatArray](maxlen=STRETCH)  # the last poses

    def clear(self) -> None:
        """Begin anew, where a motion was not measured from a key."""
        self._keys.clear()
        self._trail.clear()

    def registered(self, now: FloatImage, start: FloatArray) -> Registered | None:
        """The motion since the last picture, near `start`; None where no key tells it.

        start: (3,) as Registered.motion.
        """
        if not self._keys or self._registration.floor.shift(start) > MOST_STEP:
            return None
        key = self._keys[0]
        expected = _between(key.pose, _after(self._pose, start))
        found = self._registration.refined(key.picture, now, expected)
        if found is None or found.loose or found.match < LEAST_MATCH:
            return None
        # The last picture's place has an error of its own.
        motion = _between(self._pose, _after(key.pose, found.motion))
        return replace(found, motion=motion, covariance=2 * found.covariance)

    def keep(self, now: FloatImage, motion: FloatArray) -> None:
        """Take in a motion (3,) since the last picture; this one may become a key."""
        self._pose = _after(self._pose, motion)
        self._trail.append(self._pose)
        away = math.inf
        if self._keys:
            away = self._registration.floor.shift(_between(self._keys[0].pose, self._pose))
        if away >= KEY_CELLS / 2 * len(self._keys):
            self._keys.append(_Key(self._pose, now))  # the older of two goes, 12 cells away

    def crept(self, now: FloatImage, turn: float, sure: float) -> bool:
        """Whether a key shows that a sonar taken to stand has moved; then its pose is set right.

        turn: rad, since the last picture. sure: the chi-square, of 2 degrees of freedom, above
        which it has.
        """
        if not self._keys:
            return False
        key = self._keys[0]
        expected = _between(key.pose, _after(self._pose, np.array([0.0, 0.0, turn])))
        quick = self._registration.quick(key.picture, now, float(expected[2]))
        if quick is None or quick.match < LEAST_MATCH:
            self.clear()
            return False
        if quick.translation(quick.motion) <= SUSPECT:
            return False
        found = self._registration.refined(key.picture, now, expected)
        if found is None or found.loose or found.translation(found.motion) <= sure:
            return False
        # What it crept so far is told to nobody: tracks have followed their discs.
        self._pose = _after(_after(key.pose, found.motion), np.array([0.0, 0.0, -turn]))
        return True

    def under_way(self, found: Registered) -> float | None:
        """The chi-square, of 2 degrees of freedom, of not standing over the last STRETCH frames.

        found: from `registered`. None where fewer were kept.
        """
        if len(self._trail) < STRETCH:
            return None
        return found.translation(_between(self._trail[0], self._pose))


def _after(pose: FloatArray, motion: FloatArray) -> FloatArray:
    """(3,) the pose after a motion (3,) from another."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    right, ahead, turn = motion
    way = [right * cos + ahead * sin, ahead * cos - right * sin, turn]
    return np.asarray(pose + np.array(way))


def _between(pose: FloatArray, later: FloatArray) -> FloatArray:
    """(3,) the motion that leads from one pose to another."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x, y, turn = later - pose
    return np.array([x * cos - y * sin, x * sin + y * cos, turn])
