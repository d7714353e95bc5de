"""Measures the pan of a standing sonar by correlating its images along the bearing."""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.arrays import ByteImage, FloatArray, FloatImage
from sonarrec.recogniser.plane import Plane

RANGES = 128
BEARINGS = 192
LEAST_OVERLAP = 0.4  # of two frames, as a share of the field of view
MOST_SHIFT = int((1 - LEAST_OVERLAP) * BEARINGS)
CIRCLE = 320  # beams after zero-padding: no shift that is tried wraps round to the other edge
# Sub-cell rotations are biased low: side-lobe leakage rotates with the sonar. From frame to frame
# the bias would add up, so rotations are measured from a keyframe, an earlier picture 6 to 12 cells
# away, as long as it matches.
KEYFRAME_CELLS = 12
LEAST_KEYFRAME_MATCH = 0.5
KEYFRAME_SIGMA = 0.05  # cells, standard error of rotations from keyframes (simulated slow pans)


class _View(NamedTuple):
    """A picture, prepared for correlation."""

    spectrum: npt.NDArray[np.complexfloating[Any]]
    """(RANGES / 2, CIRCLE) Fourier transform of its zero-padded rows, two as one complex row: the
    real part of a product's inverse is then the sum of both rows' correlations."""
    energy: FloatArray
    """(BEARINGS + 1,) cumulative sum of squares over the beams, from 0."""


class PanEstimator:
    """Pan between consecutive working images by correlation along the bearing.

    range_m: (RANGES,), bearing_deg: (BEARINGS,) of the cells' middles. seen: (RANGES, BEARINGS)
    float32, 1 where a cell shows floor. picture: (RANGES, BEARINGS) float32 of the last image: grey
    level less the mean of its range bin and of its beam, 0 where nothing is seen. scatter_deg:
    standard error of rotations from keyframes.
    """

    def __init__(self, plane: Plane) -> None:
        fan = plane.fan
        self._step_deg = (fan.bearing_max_deg - fan.bearing_min_deg) / BEARINGS
        self.bearing_deg = fan.bearing_min_deg + (np.arange(BEARINGS) + 0.5) * self._step_deg
        self.scatter_deg = KEYFRAME_SIGMA * self._step_deg
        margin = 0.5 * fan.window_m / RANGES
        self.range_m = np.linspace(fan.range_min_m + margin, fan.range_max_m - margin, RANGES)
        column, row = plane.from_polar(self.range_m[:, None], self.bearing_deg[None])
        seen = cv2.remap(plane.inside, *_as_map(column, row), cv2.INTER_NEAREST)
        self.seen = np.asarray(seen, dtype=np.float32)
        self._map = _as_map(np.where(seen, column, -9), row)  # beyond the image it is 0
        self.picture: FloatImage = np.zeros_like(self.seen)
        self._share = 1 / np.maximum(self.seen.sum(axis=1, keepdims=True), 1)
        self._rows: npt.NDArray[Any] = np.zeros((RANGES // 2, CIRCLE), np.complex64)
        self._shift = shift = np.arange(-MOST_SHIFT, MOST_SHIFT + 1)
        # The beams [low, high) of the later frame that overlap the earlier one at each shift.
        self._low, self._high = np.maximum(-shift, 0), np.minimum(BEARINGS - shift, BEARINGS)
        self.begin_stretch()

    def begin_stretch(self) -> None:
        """The next image is as the first of a log."""
        self._before: _View | None = None
        self._heading = 0.0  # deg, sum of the pans since the first image
        # The heading and the view of each keyframe, the older first.
        self._keyframes = deque[tuple[float, _View]](maxlen=2)

    def step(self, image: ByteImage) -> tuple[float, float]:
        """(pan in deg since the last image, correlation at that pan, 0 to 1).

        The pan is positive to the right, so that objects move to the left. (0, 0) for the first
        image and for a blank one. image: the working image.
        """
        polar = cv2.remap(image, *self._map, cv2.INTER_LINEAR).astype(np.float32)
        # What does not move with the floor would bias the pan towards 0: the fall-off with range,
        # which is in the range bins' means, and the beams' gains, which are in the beams' means.
        mean = np.asarray(cv2.reduce(polar, 1, cv2.REDUCE_SUM)) * self._share
        # Not by BLAS: the last digits of its sums depend on the processor.
        of_mean = np.einsum("i,ij->j", mean[:, 0], self.seen)
        of_beam = (np.asarray(cv2.reduce(polar, 0, cv2.REDUCE_SUM)) - of_mean) / RANGES
        polar -= mean
        polar -= of_beam
        polar *= self.seen
        self.picture = polar
        self._rows.real[:, :BEARINGS], self._rows.imag[:, :BEARINGS] = np.split(polar, 2)
        # norm="forward" keeps float32; without it numpy computes in float64, in twice the time.
        spectrum = np.fft.fft(self._rows, norm="forward")
        energy = np.zeros(BEARINGS + 1)
        np.einsum("ij,ij->j", polar, polar).cumsum(out=energy[1:])
        view = _View(spectrum, energy)
        before, self._before = self._before, view
        if before is None:
            return 0.0, 0.0
        pan_deg, match = self._turn(before, view)
        return self._from_keyframe(before, view, pan_deg, match), match

    def _from_keyframe(self, before: _View, view: _View, pan_deg: float, match: float) -> float:
        """The pan since the last view, measured from a keyframe; `pan_deg` where none matches.

        pan_deg, match: measured from the last view to this one.
        """
        heading = self._heading + pan_deg
        if match < LEAST_KEYFRAME_MATCH:
            self._keyframes.clear()
        elif self._keyframes and self._keyframes[0][1] is not before:
            at, keyframe = self._keyframes[0]
            turn, alike = self._turn(keyframe, view)
            if alike < LEAST_KEYFRAME_MATCH or abs(at + turn - heading) > self._step_deg:
                self._keyframes.clear()
            else:
                heading = at + turn
        pan_deg, self._heading = heading - self._heading, heading
        away: float = KEYFRAME_CELLS
        if self._keyframes:
            away = abs(heading - self._keyframes[0][0]) / self._step_deg
        if away >= KEYFRAME_CELLS / 2 * len(self._keyframes):
            self._keyframes.append((heading, view))  # of two, the older goes
        return pan_deg

    def _turn(self, before: _View, now: _View) -> tuple[float, float]:
        """(rotation in deg from one view to another, correlation there, 0 to 1)."""
        # product[s] = sum over cells of now[b] * before[b + s]: s > 0 is a rotation to the right.
        crossed = (before.spectrum * now.spectrum.conj()).sum(axis=0)
        product = CIRCLE * np.fft.ifft(crossed, norm="forward").real[self._shift]
        low, high = self._low, self._high
        now_energy = now.energy[high] - now.energy[low]
        before_energy = before.energy[BEARINGS - low] - before.energy[BEARINGS - high]
        match = product / np.sqrt(np.maximum(now_energy * before_energy, 1e-9))
        best = int(match.argmax())
        left, right = match[max(best - 1, 0)], match[min(best + 1, len(match) - 1)]
        bend = left - 2 * match[best] + right
        part = 0.5 * (left - right) / bend if bend < 0 else 0.0
        return (
            float((self._shift[best] + min(max(part, -0.5), 0.5)) * self._step_deg),
            min(max(float(match[best]), 0.0), 1.0),
        )


def _as_map(column: FloatArray, row: FloatArray) -> tuple[FloatImage, FloatImage]:
    """Coordinates as cv2.remap takes them."""
    return column.astype(np.float32), row.astype(np.float32)
