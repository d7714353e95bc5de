"""Measures the pan of a standing sonar by correlating its images along the bearing."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import cached_property
from typing import Any

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
# the bias would add up, so rotations are measured from a keyframe, an earlier picture at a
# distance of 6 to 12 cells, as long as it matches.
KEYFRAME_CELLS = 12
LEAST_KEYFRAME_MATCH = 0.5
KEYFRAME_SIGMA = 0.05  # cells, standard error of rotations from keyframes (simulated slow pans)


class _View:
    """A picture, prepared for correlation where it is correlated."""

    def __init__(self, picture: FloatImage) -> None:
        self._picture = picture

    @cached_property
    def spectrum(self) -> npt.NDArray[np.complexfloating[Any]]:
        """(RANGES / 2, CIRCLE) Fourier transform of its zero-padded rows, two as one complex row:
        the real part of a product's inverse is then the sum of both rows' correlations."""
        rows = np.zeros((RANGES // 2, CIRCLE), np.complex64)
        rows.real[:, :BEARINGS] = self._picture[: RANGES // 2]
        rows.imag[:, :BEARINGS] = self._picture[RANGES // 2 :]
        # norm="forward" keeps float32; without it numpy computes in float64, in twice the time.
        return np.asarray(np.fft.fft(rows, norm="forward"))

    @cached_property
    def energy(self) -> FloatArray:
        """(BEARINGS + 1,) cumulative sum of squares over the beams, from 0."""
        energy = np.zeros(BEARINGS + 1)
        np.einsum("ij,ij->j", self._picture, self._picture).cumsum(out=energy[1:])
        return energy


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
        self._shift = shift = np.arange(-MOST_SHIFT, MOST_SHIFT + 1)
        # The beams [low, high) of the later frame that overlap the earlier one at each shift.
        self._low, self._high = np.maximum(-shift, 0), np.minimum(BEARINGS - shift, BEARINGS)
        self.begin_stretch()

    def begin_stretch(self) -> None:
        """The next image is as the first of a log."""
        # Of the last image and the one before; and of that whose pan was last measured.
        self._view: _View | None = None
        self._before: _View | None = None
        self._measured: _View | None = None
        self._heading = 0.0  # deg, sum of the pans since the first image
        # The heading and the view of each keyframe, the older first.
        self._keyframes = deque[tuple[float, _View]](maxlen=2)

    def step(self, image: ByteImage) -> tuple[float, float]:
        """`add_image`, then `rotation`."""
        self.add_image(image)
        return self.rotation()

    def add_image(self, image: ByteImage) -> None:
        """Receive the next image, a working image."""
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
        self._before, self._view = self._view, _View(polar)

    def rotation(self) -> tuple[float, float]:
        """(pan in deg between the last two images, correlation at that pan, 0 to 1).

        The pan is positive to the right, so that objects move to the left. (0, 0) after the first
        image and for a blank one.
        """
        before, view = self._before, self._view
        if before is not self._measured:  # the sonar moved meanwhile
            self._keyframes.clear()
        self._measured = view
        if before is None or view is None:
            return 0.0, 0.0
        earlier = [before]
        if self._keyframes and self._keyframes[0][1] is not before:
            earlier.append(self._keyframes[0][1])
        rotations = self._rotations(earlier, view)
        return self._from_keyframe(view, rotations), rotations[0][1]

    def _from_keyframe(self, view: _View, rotations: Sequence[tuple[float, float]]) -> float:
        """The pan since the last view, measured from a keyframe; that from the last view where none
        matches.

        rotations: as `_rotations`, from the last view and, if it is another, from the older
        keyframe.
        """
        pan_deg, match = rotations[0]
        heading = self._heading + pan_deg
        if match < LEAST_KEYFRAME_MATCH:
            self._keyframes.clear()
        elif len(rotations) > 1:
            before, (rotation, match) = self._keyframes[0][0], rotations[1]
            if match < LEAST_KEYFRAME_MATCH or abs(before + rotation - heading) > self._step_deg:
                self._keyframes.clear()
            else:
                heading = before + rotation
        pan_deg, self._heading = heading - self._heading, heading
        distance: float = KEYFRAME_CELLS
        if self._keyframes:
            distance = abs(heading - self._keyframes[0][0]) / self._step_deg
        if distance >= KEYFRAME_CELLS / 2 * len(self._keyframes):
            self._keyframes.append((heading, view))  # of two, the older goes
        return pan_deg

    def _rotations(self, before: Sequence[_View], now: _View) -> list[tuple[float, float]]:
        """(rotation in deg from an earlier view to this one, correlation there, 0 to 1) of each."""
        # product[s] = sum over cells of now[b] * before[b + s]: s > 0 is a rotation to the right.
        conjugate = now.spectrum.conj()
        crossed = np.stack([(view.spectrum * conjugate).sum(axis=0) for view in before])
        products = CIRCLE * np.fft.ifft(crossed, norm="forward").real[:, self._shift]
        low, high = self._low, self._high
        now_energy = now.energy[high] - now.energy[low]
        rotations = []
        for view, product in zip(before, products, strict=True):
            before_energy = view.energy[BEARINGS - low] - view.energy[BEARINGS - high]
            match = product / np.sqrt(np.maximum(now_energy * before_energy, 1e-9))
            best = int(match.argmax())
            left, middle, right = match[
                [max(best - 1, 0), best, min(best + 1, len(match) - 1)]
            ].tolist()
            bend = left - 2 * middle + right
            part = 0.5 * (left - right) / bend if bend < 0 else 0.0
            rotation = float(self._shift[best] + min(max(part, -0.5), 0.5)) * self._step_deg
            rotations.append((rotation, min(max(middle, 0.0), 1.0)))
        return rotations


def _as_map(column: FloatArray, row: FloatArray) -> tuple[FloatImage, FloatImage]:
    """Coordinates as cv2.remap takes them."""
    return column.astype(np.float32), row.astype(np.float32)
