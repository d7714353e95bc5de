"""The sonar's motion as its images show it: the pan where it stands, else surge, sway and yaw.

Most sonars stand on a tripod and pan. There the pan alone is measured, by correlation along the
bearing, which is cheap and robust; a quick registration of what the pan leaves over tells when the
sonar sets out. Under way, surge, sway and yaw are registered from frame to frame.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from sonarrec.recogniser.floor_cells import FloorCells
from sonarrec.recogniser.floor_keys import FloorKeys
from sonarrec.recogniser.plane import Plane
from sonarrec.recogniser.registration import FloorRegistration, Registered
from sonarrec.records import ByteImage, FloatArray, FloatImage, Motion

RANGES = 128
BEARINGS = 192
LEAST_OVERLAP = 0.4  # of two frames, as a share of the field of view
# A turn of about a cell is measured short, for a part of the picture turns along: what leaks from
# beam to beam. From frame to frame these errors would add up. So turns are measured from an earlier
# picture, a key, of 6 to 12 cells ago, as long as it matches.
KEY_CELLS = 12
LEAST_KEY_MATCH = 0.5
KEY_SIGMA = 0.05  # cells, by which turns from keys scatter (simulated slow pans)

# Least match of a registration that is believed: one that started from the last frame's motion,
# and one that was searched for. Pictures of different floor match by up to 0.2 (tuning seeds), with
# wide standard errors.
LEAST_NEAR, LEAST_SEARCHED = 0.1, 0.25
# A sonar has set out where a searched registration matches by this much more than the pan alone.
BETTER = 0.1
# A standing sonar may have set out where the match falls below this share of its usual value: the
# mean over the last USUAL_MEMORY frames, FIRST_USUAL to begin with.
USUAL_SHARE, FIRST_USUAL, USUAL_MEMORY = 0.75, 0.8, 20.0
LOOK_EVERY = 4  # frames between quick registrations of a standing sonar that matches as usual
# Where the pan explains little, any motion is searched for: in the next frame again, then after 2,
# 4 and so on, up to so many. Of a fast vehicle about every second pair of frames can be registered.
MOST_PAUSE = 8
# Evidence for a translation fades by this factor from frame to frame. Its chi-square, of 2 degrees
# of freedom: above the first a standing sonar sets out, below the second a moving one stands.
KEEP = 0.9
SET_OUT, STAND = 40.0, 10.0
LEAST_UNDER_WAY = 8  # frames before a moving sonar may be found to stand
# Standard errors where nothing is measured: about the last speed of a sonar under way, and where
# no speed is known.
LOST_M_S, LOST_DEG_S = 0.15, 8.0
UNKNOWN_M_S, UNKNOWN_DEG_S = 0.5, 20.0
MOST_LOST = 8  # frames in a row without a registration, after which the speed is not known
USUAL_STEP_S = 0.25  # between frames whose times do not rise
SCALE_ERROR = 0.005  # of the distance made, by an uncertain height and a floor that is not flat


class _View(NamedTuple):
    """A picture as PanEstimator correlates it."""

    spectrum: FloatImage
    """(RANGES, 2 BEARINGS) of its rows, zero-padded."""
    energy: FloatArray
    """(BEARINGS + 1,) sum of squares of the beams before each."""


class PanEstimator:
    """Pan between consecutive working images by correlation along the bearing.

    picture: (RANGES, BEARINGS) float32 of the last image: grey level less the mean of its range bin
    and of its beam, 0 where nothing is seen.
    """

    def __init__(self, plane: Plane) -> None:
        fan = plane.fan
        self.step_deg = (fan.bearing_max_deg - fan.bearing_min_deg) / BEARINGS
        self.bearing_deg = fan.bearing_min_deg + (np.arange(BEARINGS) + 0.5) * self.step_deg
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
        self._before: _View | None = None
        self._heading = 0.0  # deg, turned since the first image
        self._keys = deque[tuple[float, _View]](maxlen=2)  # the heading and the view, older first

    def step(self, image: ByteImage) -> tuple[float, float]:
        """(pan in deg since the last image, correlation there, 0 to 1).

        The pan is positive where the sonar turned right, so that objects moved to the left.
        (0, 0) for the first image and for a blank one.
        """
        polar = np.asarray(cv2.remap(image, self._column, self._row, cv2.INTER_LINEAR), np.float32)
        polar *= self.seen
        # What does not turn with the floor would pull the match to no shift. The means of the range
        # bins hold the fall-off with range, those of the beams the beams' gains.
        polar -= polar.sum(axis=1, keepdims=True) / self._cells
        polar *= self.seen
        polar -= polar.mean(axis=0)
        polar *= self.seen
        self.picture = polar
        view = self._view(polar)
        before, self._before = self._before, view
        if before is None:
            return 0.0, 0.0
        pan_deg, match = self._turn(before, view)
        return self._by_keys(before, view, pan_deg, match), match

    def _by_keys(self, before: _View, view: _View, pan_deg: float, match: float) -> float:
        """The pan since the last view, as the turn from a key says; where it does not match, as is.

        pan_deg, match: from the last view to this one.
        """
        heading = self._heading + pan_deg
        if match < LEAST_KEY_MATCH:
            self._keys.clear()
        elif self._keys and self._keys[0][1] is not before:
            at, key = self._keys[0]
            turn, alike = self._turn(key, view)
            if alike < LEAST_KEY_MATCH or abs(at + turn - heading) > self.step_deg:
                self._keys.clear()
            else:
                heading = at + turn
        pan_deg, self._heading = heading - self._heading, heading
        away = abs(heading - self._keys[0][0]) / self.step_deg if self._keys else KEY_CELLS
        if away >= KEY_CELLS / 2 * len(self._keys):
            self._keys.append((heading, view))  # the first of two goes, a turn of 12 cells away
        return pan_deg

    def _view(self, picture: FloatImage) -> _View:
        # Zero-padded to twice the width, so that no beam meets one from the other edge.
        wide = cv2.copyMakeBorder(picture, 0, 0, 0, BEARINGS, cv2.BORDER_CONSTANT)
        spectrum = np.asarray(cv2.dft(wide, flags=cv2.DFT_ROWS), np.float32)
        energy = np.concatenate([[0.0], np.cumsum((picture**2).sum(axis=0, dtype=float))])
        return _View(spectrum, energy)

    def _turn(self, before: _View, now: _View) -> tuple[float, float]:
        """(turn in deg from one view to another, correlation there, 0 to 1)."""
        # product[s] = sum over cells of now[b] * before[b + s]: s > 0 is a turn to the right.
        crossed = cv2.mulSpectrums(before.spectrum, now.spectrum, cv2.DFT_ROWS, conjB=True)
        summed = cv2.reduce(crossed, 0, cv2.REDUCE_SUM)
        product = cv2.idft(summed, flags=cv2.DFT_ROWS | cv2.DFT_SCALE)[0]
        low, high = self._low, self._high
        now_energy = now.energy[high] - now.energy[low]
        before_energy = before.energy[BEARINGS - low] - before.energy[BEARINGS - high]
        scale = np.sqrt(np.maximum(now_energy * before_energy, 1e-9))
        match = np.where(self._tried, product / scale, -1.0)
        best = int(match.argmax())
        left, right = match[best - 1], match[(best + 1) % len(match)]
        bend = left - 2 * match[best] + right
        part = 0.5 * (left - right) / bend if bend < 0 else 0.0
        return (
            float((self._shift[best] + np.clip(part, -0.5, 0.5)) * self.step_deg),
            float(np.clip(match[best], 0, 1)),
        )


@dataclass(slots=True)
class _Drift:
    """The evidence for a translation in the last frames, which fades from one to the next.

    A Gaussian in information form: matrix (2, 2), the sum of inverse covariances; vector (2,), the
    sum of these times the translations (m). sigma: (2,) standard error of a steady translation (m a
    frame) that these frames would show; None where there are none.
    """

    vector: FloatArray
    matrix: FloatArray
    sigma: FloatArray | None = None

    @classmethod
    def none(cls) -> _Drift:
        return cls(np.zeros(2), np.zeros((2, 2)))

    def add(self, found: Registered) -> float:
        """Take in a frame. Returns the chi-square, of 2 degrees of freedom, of not standing."""
        information = np.linalg.inv(found.covariance[:2, :2] + 1e-9 * np.eye(2))
        self.vector = KEEP * self.vector + information @ found.motion[:2]
        self.matrix = KEEP * self.matrix + information
        inverse = np.linalg.inv(self.matrix)
        # So much less does the faded mean of independent frames vary than inverse says.
        self.sigma = np.sqrt(np.diag(inverse) / (1 + KEEP))
        return float(self.vector @ inverse @ self.vector) * (1 + KEEP)


class ImageMotion:
    """The motion from image to image of one log."""

    def __init__(self, plane: Plane, min_match: float) -> None:
        """min_match: correlation below which a pan is not believed."""
        self.pan = PanEstimator(plane)
        self._min_match = min_match
        self._registration = FloorRegistration(
            FloorCells(plane.fan, self.pan.range_m, self.pan.bearing_deg, self.pan.seen)
        )
        self._keys = FloorKeys(self._registration)
        self._drift = _Drift.none()
        self._usual = FIRST_USUAL
        self._speed: FloatArray | None = None  # (3,) m, m and rad a second; None: it stands
        self._under_way = self._lost = 0  # frames
        self._unseen = 0  # frames since the last quick registration
        self._pan_sigma: float | None = None  # deg, by the last quick registration
        self._pause = self._unsearched = 0  # frames between searches, and since the last

    def step(self, image: ByteImage, seconds: float | None) -> Motion | None:
        """The motion since the last image; where it cannot be measured under way, the speed stays.

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
        """The pan alone since the last image, deg; None where it is not to be believed."""
        pan_deg, match = self.pan.step(image)
        return pan_deg if match >= self._min_match else None

    def _standing(self, before: FloatImage, pan_deg: float, match: float, seconds: float) -> Motion:
        """Of a sonar that stood so far."""
        turn = math.radians(pan_deg)
        drifts, crept, quick = False, False, None
        self._unseen += 1
        self._unsearched += 1
        poor = match < USUAL_SHARE * self._usual
        if match < USUAL_SHARE * FIRST_USUAL:  # the pan explains little, also where that is usual
            poor |= self._unsearched >= self._pause
        if poor or self._pan_sigma is None or self._unseen >= LOOK_EVERY:
            self._unseen = 0
            quick = self._registration.quick(before, self.pan.picture, turn)
            crept = self._keys.crept(self.pan.picture, turn, SET_OUT)
            drifts = (quick is not None and self._drift.add(quick) > SET_OUT) or crept
            self._pan_sigma = None
            if quick is not None:
                sigma = math.degrees(quick.sigma[2])
                self._pan_sigma = math.hypot(sigma, KEY_SIGMA * self.pan.step_deg)
        start = np.array([0.0, 0.0, turn])
        if drifts or poor:
            found = self._registered(before, start, searched=not drifts)
            least = match if drifts else match + BETTER
            if found is not None and found.match > least:
                self._drift, self._under_way = _Drift.none(), 0
                self._pause = 0
                if not crept:
                    self._keys.clear()
                return self._went(found, seconds)
            # It stands: pictures of this floor match no better.
            self._usual = match
            self._unsearched = 0
            self._pause = min(max(2 * self._pause, 1), MOST_PAUSE)
            if drifts and quick is not None:
                self._drift = _Drift.none()
                self._drift.add(quick)
        self._usual += (match - self._usual) / USUAL_MEMORY
        self._keys.keep(self.pan.picture, start)
        if match < self._min_match or self._pan_sigma is None or self._drift.sigma is None:
            return unknown(seconds)
        right, ahead = self._drift.sigma.tolist()
        return Motion(pan_deg, 0.0, 0.0, self._pan_sigma, right, ahead)

    def _moving(self, before: FloatImage, match: float, seconds: float) -> Motion:
        """Of a sonar under way."""
        assert self._speed is not None
        start = self._speed * seconds
        by_key = self._keys.registered(self.pan.picture, start)
        found = by_key
        if found is None:
            self._keys.clear()
            found = self._registered(before, start, searched=False)
            found = found or self._registered(before, start, searched=True)
        if found is not None:
            motion = self._went(found, seconds)
            self._under_way += 1
            evidence = self._drift.add(found)
            if by_key is not None and (way := self._keys.under_way(by_key)) is not None:
                evidence = way
            if evidence < STAND and self._under_way >= LEAST_UNDER_WAY:
                self._speed, self._usual = None, match
                self._keys.clear()
            return motion
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
        """A registration from `start` or from a search; None where it is not believed."""
        now = self.pan.picture
        if searched:
            start = self._registration.searched(before, now)
        found = self._registration.refined(before, now, start)
        if found is None or found.loose:
            return None
        return found if found.match >= (LEAST_SEARCHED if searched else LEAST_NEAR) else None

    def _went(self, found: Registered, seconds: float) -> Motion:
        """The motion of a sonar that is under way; its speed and place are kept."""
        self._keys.keep(self.pan.picture, found.motion)
        self._speed, self._lost = found.motion / seconds, 0
        return _motion(found)


def unknown(seconds: float) -> Motion:
    """Where nothing is measured, and all that is known is that vehicles are slow."""
    metres, degrees = UNKNOWN_M_S * seconds, UNKNOWN_DEG_S * seconds
    return Motion(0.0, 0.0, 0.0, degrees, metres, metres, known=False)


def _motion(found: Registered) -> Motion:
    """A registration as a Motion, its errors widened by SCALE_ERROR."""
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
