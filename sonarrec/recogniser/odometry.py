"""How the sonar moved between two frames: as a table tells it, else read off the frames.

Speckle is frozen to the floor while a sonar pans, so two frames are one polar picture moved along
the bearing; where the two match best is the pan.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.config import Continuity
from sonarrec.poses import PoseTable
from sonarrec.recogniser.plane import Plane
from sonarrec.records import ByteImage, FloatArray, Motion

RANGES = 128
BEARINGS = 192
# Of the field of view: how much of two frames must overlap for their match to be believed.
LEAST_OVERLAP = 0.4
# Standard error of a measured pan in steps of the bearing: where two frames match in full, and what
# is added where they do not match at all.
PAN_SIGMA, UNMATCHED_SIGMA = 0.1, 0.5
# A table of poses is held against the images where the sonar turned as far as this, and doubted
# where most of at least so many frames contradict it.
LEAST_TURN_DEG = 0.3
LEAST_COMPARED = 10


class PanEstimator:
    """Pan between consecutive working images by correlation along the bearing."""

    def __init__(self, plane: Plane) -> None:
        fan = plane.fan
        self.step_deg = (fan.bearing_max_deg - fan.bearing_min_deg) / BEARINGS
        bearing = fan.bearing_min_deg + (np.arange(BEARINGS) + 0.5) * self.step_deg
        margin = 0.5 * fan.window_m / RANGES
        range_m = np.linspace(fan.range_min_m + margin, fan.range_max_m - margin, RANGES)
        column, row = plane.from_polar(range_m[:, None], bearing[None])
        self._column = column.astype(np.float32)
        self._row = row.astype(np.float32)
        seen = cv2.remap(plane.inside, self._column, self._row, cv2.INTER_NEAREST)
        self._seen = np.asarray(seen, dtype=np.float32)
        self._cells = np.maximum(self._seen.sum(axis=1, keepdims=True), 1)
        shift = np.arange(2 * BEARINGS)
        shift = np.where(shift < BEARINGS, shift, shift - 2 * BEARINGS)
        self._shift = shift
        # The beams that two frames have in common at each shift: [low, high) of the later one.
        self._low = np.clip(-shift, 0, BEARINGS)
        self._high = np.clip(BEARINGS - shift, 0, BEARINGS)
        self._tried = np.abs(shift) <= (1 - LEAST_OVERLAP) * BEARINGS
        self._before: tuple[npt.NDArray[np.float32], FloatArray] | None = None

    def step(self, image: ByteImage) -> tuple[float, float]:
        """(pan in deg since the last image, correlation there, 0 to 1).

        The pan is positive where the sonar turned right, so that objects moved to the left.
        (0, 0) for the first image and for a blank one.
        """
        polar = np.asarray(cv2.remap(image, self._column, self._row, cv2.INTER_LINEAR), np.float32)
        polar *= self._seen
        # What does not turn with the floor would match at no shift: the fall-off with range is in
        # the mean of each range bin, the gain of each beam in the mean of each beam.
        polar -= polar.sum(axis=1, keepdims=True) / self._cells
        polar *= self._seen
        polar -= polar.mean(axis=0)
        polar *= self._seen
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
            float((self._shift[best] + np.clip(part, -0.5, 0.5)) * self.step_deg),
            float(np.clip(match[best], 0, 1)),
        )


class Odometry:
    """The sonar's motion from frame to frame: as a table tells it, else as the images show it."""

    def __init__(self, plane: Plane, config: Continuity, poses: PoseTable | None = None) -> None:
        self._images = PanEstimator(plane) if config.motion == "image" else None
        self._min_match = config.min_match
        self._poses = poses
        self._before_ns: int | None = None
        self._span: tuple[int, int] | None = None  # ns, of the frames
        self._frames = self._untold = self._compared = self._differing = 0

    def step(self, image: ByteImage, timestamp_ns: int) -> Motion | None:
        """The motion since the last frame, None where neither source knows it.

        image: the working image. timestamp_ns: of the frame.
        """
        seen = None
        if self._images is not None:
            pan_deg, match = self._images.step(image)
            sigma_deg = self._images.step_deg * (PAN_SIGMA + (1 - match) * UNMATCHED_SIGMA)
            seen = Motion(pan_deg, pan_sigma_deg=sigma_deg) if match >= self._min_match else None
        if self._poses is None:
            return seen
        self._frames += 1
        self._untold += not self._poses.covers(timestamp_ns)
        first, last = self._span or (timestamp_ns, timestamp_ns)
        self._span = min(first, timestamp_ns), max(last, timestamp_ns)
        before, self._before_ns = self._before_ns, timestamp_ns
        told = None if before is None else self._poses.motion(before, timestamp_ns)
        if told is not None and seen is not None:
            larger = max(abs(told.pan_deg), abs(seen.pan_deg))
            if larger >= LEAST_TURN_DEG:
                self._compared += 1
                self._differing += abs(told.pan_deg - seen.pan_deg) > 0.5 * larger
        return told or seen

    def problems(self) -> list[str]:
        """What of the table could not be used, so far."""
        if self._poses is None:
            return []
        if not self._untold:
            return list(self._poses.problems)
        assert self._span is not None
        told = "{:.3f} to {:.3f} s".format(*(self._poses.at[[0, -1]] / 1e9))
        log = "{:.3f} to {:.3f} s".format(*(t / 1e9 for t in self._span))
        return [
            *self._poses.problems,
            f"{self._poses.name}: no pose for {self._untold} of {self._frames} frames; it tells "
            f"{told}, and the frames are from {log}",
        ]

    def notes(self) -> list[str]:
        """What speaks against the table, so far: one line at most."""
        if self._compared < LEAST_COMPARED or self._differing <= self._compared / 2:
            return []
        assert self._poses is not None
        return [
            f"{self._poses.name}: the turns it tells are not those of the images in "
            f"{self._differing} of {self._compared} frames; yaw is in degrees, positive to the "
            "right, and its times are the frames'"
        ]
