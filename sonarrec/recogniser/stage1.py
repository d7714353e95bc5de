"""Stage 1: candidate selection (Section 3.2, Eq. 1 and 2, Figure 4).

The outline of a landmark as the sonar sees it is correlated with the image; local maxima of the
correlation (Hough) map above a threshold are candidates.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.arrays import ByteImage, FloatArray, FloatImage, IndexArray
from sonarrec.config import Candidates
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Fan, Selection
from sonarrec.recogniser.plane import Plane

# The ring filter compares the ring with the gap inside it, less a margin, and with the floor
# outside, in disc radii.
GAP_MARGIN = 0.03
OUTSIDE = (1.08, 1.35)
# Weight of the gap in that comparison; the floor outside has the rest. A ring always stands out
# from its plate, whatever the floor is like; but beams as wide as the gap fill it with echoes of
# ring and symbol.
GAP_SHARE, FILLED_GAP_SHARE = 0.75, 0.5
# Widths of the gap, in beams at the middle of the window, at which it is filled, and is clear.
FILLED_BEAMS, CLEAR_BEAMS = 1.0, 1.5
BLUR_PX = 13  # side of the Gaussian kernel before Canny; by hand
EDGE_TOLERANCE_PX = 2  # how far from the outline an edge may lie and still count; by hand
COARSE = 4  # pixels, of the grid on which the surroundings' brightness is measured
LEAST_SIGMA = 0.5  # grey levels
LEAST_LOCAL_SIGMA = 0.5  # share of the whole frame's sigma
BESIDE = np.ones((3, 3), np.uint8)  # a pixel and its neighbours
# At most MOST_PEAKS peaks are compared with each other on a floor with room for FLOOR_DISCS discs
# or fewer; a frame with more is all noise. On a larger floor the limits of peaks and candidates
# grow in proportion, up to MOST_TIMES. All measured kinds of scene have smaller floors.
MOST_PEAKS, FLOOR_DISCS, MOST_TIMES = 64, 300, 8


class CandidateSelector:
    """Finds circles of the landmarks' size in working images of one plane."""

    def __init__(
        self,
        config: Candidates,
        plane: Plane,
        landmarks: LandmarkSet,
        beam_width_deg: float,
        detector: Detector | None = None,
    ) -> None:
        """beam_width_deg: as in Features. detector: by default the one that `config` names."""
        self._config = config
        self._inside = plane.inside
        self._cells = max(1, int(np.count_nonzero(plane.inside)))
        discs = self._cells / (np.pi * plane.axes[0] * plane.axes[1])
        times = min(max(discs / FLOOR_DISCS, 1), MOST_TIMES)
        self._most_peaks = round(times * MOST_PEAKS)
        self._most = round(times * config.max_candidates)
        self._diameter = 2 * np.array(plane.axes)
        self._surroundings = Surroundings(plane)
        self._detector: Detector
        if detector is not None:
            self._detector = detector
        elif config.detector == "edge":
            self._detector = EdgeScore(config, plane)
        else:
            share = gap_share(landmarks, plane.fan, beam_width_deg)
            self._detector = RingScore(config, plane, landmarks, self._surroundings, share)

    def __call__(self, image: ByteImage) -> Selection:
        """Candidates in a working image (uint8, the plane's shape), best first."""
        around = self._surroundings
        mean = around.mean(cv2.bitwise_and(image, image, mask=self._inside))
        relief = np.asarray(
            cv2.subtract(image, around.fine(mean), mask=self._inside, dtype=cv2.CV_32F), np.float32
        )
        # A black or uniform frame has only rounding errors as relief.
        sigma = float(np.sqrt(cv2.norm(relief, cv2.NORM_L2SQR) / self._cells))
        sigma = max(sigma, LEAST_SIGMA)
        maps = self._detector(image, relief, sigma)
        positions, scores = self._peaks(maps)
        score = np.clip(maps.score, 0, 1, out=maps.score)
        return Selection(score, positions, scores, mean, maps.sigma)

    def levels(self, selection: Selection, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) mean and standard deviation of the grey levels around (n, 2) positions, pixels."""
        around = self._surroundings
        return around.at(selection.mean, places), around.at(selection.sigma, places)

    def _peaks(self, maps: ScoreMaps) -> tuple[FloatArray, FloatArray]:
        """(n, 2) sub-pixel positions of peaks above the threshold, (n,) scores; best first."""
        peaks, score = maps.peaks, maps.peak_score
        top = (peaks >= cv2.dilate(peaks, BESIDE)) & (score >= self._config.threshold)
        row, column = np.divmod(np.flatnonzero(top), score.shape[1])
        order = np.lexsort((-peaks[row, column], -score[row, column]))[: self._most_peaks]
        row, column = row[order], column[order]
        positions = _refine(peaks, column, row)
        kept = self._apart(positions)
        return positions[kept], np.minimum(score[row, column][kept], 1).astype(float)

    def _apart(self, positions: FloatArray) -> list[int]:
        """Indices of the peaks, best first, that are not too near a better one."""
        offset = (positions[:, None] - positions[None]) / self._diameter
        far = np.hypot(offset[..., 0], offset[..., 1]) >= self._config.separation
        left = np.ones(len(positions), bool)
        kept: list[int] = []
        while left.any() and len(kept) < self._most:
            kept.append(int(left.argmax()))
            left &= far[kept[-1]]
            left[kept[-1]] = False  # also where separation is 0
        return kept


class Surroundings:
    """Means over each pixel's surroundings, on a coarse grid, since they are smooth."""

    def __init__(self, plane: Plane) -> None:
        size = 4 * _reach(plane) // COARSE + 1
        self._size = (size, size)
        self._shape = plane.inside.shape
        seen = self._sum(_whole(plane.inside.astype(np.float32)))
        self._seen = np.maximum(seen, np.float32(1e-3))

    def mean(self, values: npt.NDArray[Any]) -> FloatImage:
        """Local means, on the coarse grid, of (rows, columns) values that are 0 outside the fan."""
        return np.asarray(self._sum(_whole(values)) / self._seen, np.float32)

    def mean_square(self, values: FloatImage) -> FloatImage:
        """Local means of the values' squares, as `mean`."""
        whole = _whole(values)
        return np.asarray(self._sum(np.multiply(whole, whole, out=whole)) / self._seen, np.float32)

    def fine(self, coarse: FloatArray) -> FloatImage:
        """Values on the coarse grid interpolated to every pixel: (rows, columns)."""
        size = (coarse.shape[1] * COARSE, coarse.shape[0] * COARSE)
        rows, columns = self._shape
        fine = cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(fine[:rows, :columns], np.float32)

    def at(self, coarse: FloatImage, places: FloatArray) -> FloatArray:
        """(n,) values of `fine` at the pixels nearest to (n, 2) positions."""
        if len(places) == 0:  # OpenCV refuses empty maps
            return np.empty(0)
        rows, columns = self._shape
        pixel = np.rint(places).clip(0, (columns - 1, rows - 1))
        column, row = ((pixel + 0.5) / COARSE - 0.5).astype(np.float32).T
        border = cv2.BORDER_REPLICATE
        found = cv2.remap(coarse, column, row, cv2.INTER_LINEAR, borderMode=border)
        return np.asarray(found, float).ravel()

    def _sum(self, whole: npt.NDArray[Any]) -> FloatImage:
        """Sum over each pixel's surroundings, divided by their size. whole: from `_whole`."""
        size = (whole.shape[1] // COARSE, whole.shape[0] // COARSE)
        coarse = cv2.resize(whole, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        return np.asarray(cv2.blur(coarse, self._size, borderType=cv2.BORDER_CONSTANT), np.float32)


def _whole(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(rows, columns) values, padded with 0 to whole blocks of the coarse grid."""
    rows, columns = (-side % COARSE for side in values.shape)
    filled = cv2.copyMakeBorder(values, 0, rows, 0, columns, cv2.BORDER_CONSTANT, value=0)
    return np.asarray(filled)


class ScoreMaps(NamedTuple):
    """A detector's maps of one frame, each (rows, columns) float32."""

    score: FloatImage
    """Score of a disc centred on each pixel."""
    peaks: FloatImage
    """Scores, smoothed where they have plateaus; its local maxima are the candidates."""
    peak_score: FloatImage
    """Score of a candidate whose maximum is at this pixel."""
    sigma: FloatImage
    """Standard deviation of the grey levels in each pixel's surroundings, on their coarse grid; one
    value where it is the same everywhere."""


class Detector(Protocol):
    """Scores how well a landmark's circle fits at every pixel."""

    def __call__(self, image: ByteImage, relief: FloatImage, sigma: float, /) -> ScoreMaps:
        """The score maps of a working image.

        relief: (rows, columns) grey level over that of the surroundings; it may be overwritten.
        sigma: its standard deviation.
        """
        ...


class EdgeScore:
    """The paper's score: the share of the outline's pixels that lie on or near an edge."""

    def __init__(self, config: Candidates, plane: Plane) -> None:
        self._config = config
        self._inside = plane.inside
        radius, pixel = _radii(plane)
        outline = np.abs(radius - 1) < 0.5 * pixel
        kernel = (outline / outline.sum()).astype(np.float32)
        self._correlate = Correlation(kernel, plane.inside.shape)
        self._gain = _gain(plane, outline.astype(float), config)
        # The fan's own edge, widened by the blur, must not count as an edge of the image.
        border = BLUR_PX // 2 + 1
        self._away = cv2.erode(plane.inside, np.ones((2 * border + 1,) * 2, np.uint8))
        self._tolerance = np.ones((2 * EDGE_TOLERANCE_PX + 1,) * 2, np.uint8)

    def __call__(
        self,
        image: ByteImage,
        relief: FloatImage,  # noqa: ARG002
        sigma: float,
    ) -> ScoreMaps:
        """Edges are found in the grey levels, so the relief is not used."""
        config = self._config
        grey_sigma = float(cv2.meanStdDev(image, mask=self._inside)[1][0, 0])
        blurred = cv2.GaussianBlur(image, (BLUR_PX, BLUR_PX), 0)
        edges = cv2.Canny(blurred, config.canny_low * grey_sigma, config.canny_high * grey_sigma)
        edges = cv2.dilate(cv2.bitwise_and(edges, edges, mask=self._away), self._tolerance)
        on_edge = (edges > 0).astype(np.float32)
        score = self._correlate(on_edge) * self._gain
        # The tolerance makes plateaus. The circle is at the middle of a plateau, and gets the score
        # of its best pixel.
        size = 2 * EDGE_TOLERANCE_PX + 3
        peaks = np.asarray(cv2.GaussianBlur(score, (size, size), 0), np.float32)
        best = np.asarray(cv2.dilate(score, np.ones((size, size), np.uint8)), np.float32)
        return ScoreMaps(score, peaks, best, np.full((1, 1), sigma, np.float32))


class RingScore:
    """The default score: a bright ring's contrast over its surroundings, 1 for full contrast."""

    def __init__(
        self,
        config: Candidates,
        plane: Plane,
        landmarks: LandmarkSet,
        surroundings: Surroundings,
        share: float,
    ) -> None:
        """share: from `gap_share`."""
        self._surroundings = surroundings
        radius, pixel = _radii(plane)
        ring = _band(radius, landmarks.ring, pixel)
        gap = _band(
            radius, (landmarks.symbol[1] + GAP_MARGIN, landmarks.ring[0] - GAP_MARGIN), pixel
        )
        outside = _band(radius, OUTSIDE, pixel)
        kernel = (
            ring / ring.sum() - share * gap / gap.sum() - (1 - share) * outside / outside.sum()
        ).astype(np.float32)
        self._correlate = Correlation(kernel, plane.inside.shape)
        self._gain = _gain(plane, ring, config) / np.float32(config.ring_full_contrast)

    def __call__(
        self,
        image: ByteImage,  # noqa: ARG002
        relief: FloatImage,
        sigma: float,
    ) -> ScoreMaps:
        """Contrast is in standard deviations of the relief around each pixel."""
        # Not far below the whole frame's, else the noise of a uniform patch would score as rings.
        least = (LEAST_LOCAL_SIGMA * sigma) ** 2
        local = np.sqrt(np.maximum(self._surroundings.mean_square(relief), least))
        score = np.multiply(self._correlate(relief), self._gain, out=relief)
        score /= self._surroundings.fine(local)
        return ScoreMaps(score, score, score, local)


class Correlation:
    """Does what `_correlate` does, by FFT, for many images of one shape and one symmetric kernel.

    For speed, arrays are reused from image to image (each thread has its own), columns are
    transformed as rows, and precision is single: errors stay under a millionth of the largest sum.
    numpy keeps single precision only with norm="forward".
    """

    def __init__(self, kernel: FloatImage, shape: tuple[int, int]) -> None:
        """kernel: square, of an odd number of rows, the same after a rotation by 180 degrees.

        shape: of the images. Raises ValueError for another kernel.
        """
        if not np.array_equal(kernel, kernel[::-1, ::-1]):
            raise ValueError("the kernel is not symmetric")
        reach = kernel.shape[0] // 2
        # So large that the kernel does not wrap round from one side of an image to the other.
        size = [cv2.getOptimalDFTSize(max(side, reach + 1) + reach) for side in shape]
        # Its spectrum (half the columns, rows) is real, since it is symmetric: a sum of cosines of
        # its few pixels, without an array of the images' size in double precision.
        offset = np.arange(-reach, reach + 1)
        rows, columns = (2 * np.pi / side * np.outer(offset, np.arange(side)) for side in size)
        columns = columns[:, : size[1] // 2 + 1]
        spectrum = np.zeros((columns.shape[1], rows.shape[1]))
        for wave, sign in ((np.cos, 1), (np.sin, -1)):
            along = np.einsum("yx,yr->xr", kernel, wave(rows))  # not by BLAS, as in `pan`
            spectrum += sign * np.einsum("xc,xr->cr", wave(columns), along)
        # Times the factor by which an image's transforms are divided.
        self._kernel = np.asarray(spectrum * (size[0] * size[1]), np.float32)
        self._size = shape[0], size[1]
        self._free: list[tuple[npt.NDArray[Any], npt.NDArray[Any]]] = []

    def __call__(self, image: FloatImage) -> FloatImage:
        """(rows, columns) of an image with the kernel centred on each pixel; 0 beyond it."""
        rows, columns = image.shape
        padded, both = self._free.pop() if self._free else self._arrays()
        by_rows = both.T[:rows]
        padded[:, :columns], padded[:, columns:] = image, 0
        np.fft.rfft(padded, norm="forward", out=by_rows)
        both[:, rows:] = 0
        np.fft.fft(both, norm="forward", out=both)
        both *= self._kernel
        np.fft.ifft(both, out=both)
        np.fft.irfft(by_rows, padded.shape[1], out=padded)
        found = padded[:, :columns].copy()
        self._free.append((padded, both))
        return found

    # Any, since numpy's stubs know only transforms of 64 bits.
    def _arrays(self) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """(rows, padded columns) of an image, and of its transform, columns first."""
        return np.zeros(self._size, np.float32), np.zeros(self._kernel.shape, np.complex64)


def gap_share(landmarks: LandmarkSet, fan: Fan, beam_width_deg: float) -> float:
    """Weight of the gap against the floor outside, by the gap's width in beams."""
    middle_m = (fan.range_min_m + fan.range_max_m) / 2
    gap_m = (landmarks.ring[0] - landmarks.symbol[1]) * landmarks.radius_m
    beams = gap_m / (np.radians(beam_width_deg) * middle_m)
    return float(np.interp(beams, (FILLED_BEAMS, CLEAR_BEAMS), (FILLED_GAP_SHARE, GAP_SHARE)))


def _reach(plane: Plane) -> int:
    """Radius in pixels of the kernel, which includes the floor round a disc."""
    return int(np.ceil(max(plane.axes) * OUTSIDE[1]))


def _radii(plane: Plane) -> tuple[FloatArray, float]:
    """Distance of each pixel of a kernel from its middle, and a pixel's size, in disc radii."""
    across, along = plane.axes
    reach = _reach(plane)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(float)
    return np.hypot(x / across, y / along), 1 / min(across, along)


def _gain(plane: Plane, ring: FloatArray, config: Candidates) -> FloatImage:
    """(rows, columns) factor of a score by how much of the ring lies inside the fan.

    ring: weights of a kernel's pixels. Where less than min_visible shows, the factor is 0.
    """
    least = config.min_visible
    visible = _correlate(plane.inside.astype(np.float32), ring.astype(np.float32))
    visible /= ring.sum()
    # The correlation falls with the visible share, its noise with the root of that share. Divided
    # by the root, false candidates are as frequent at the fan's edge as within it.
    power = -0.5 if config.edge_gain == "root" else 0.0
    return np.where(visible >= least, np.maximum(visible, least) ** power, 0).astype(np.float32)


def _correlate(image: FloatImage, kernel: FloatImage) -> FloatImage:
    """(rows, columns) of the image with a kernel centred on each pixel; 0 beyond the image."""
    m = kernel.shape[0] // 2
    padded = cv2.copyMakeBorder(image, m, m, m, m, cv2.BORDER_CONSTANT, value=0)
    return np.asarray(cv2.matchTemplate(padded, kernel, cv2.TM_CCORR), np.float32)


def _band(radius: FloatArray, band: tuple[float, float], pixel: float) -> FloatArray:
    """Share of each pixel that lies between two radii, softened by one pixel."""
    inner = np.clip((radius - band[0]) / pixel + 0.5, 0, 1)
    outer = np.clip((band[1] - radius) / pixel + 0.5, 0, 1)
    return np.asarray(np.minimum(inner, outer))


def _refine(score: FloatImage, column: IndexArray, row: IndexArray) -> FloatArray:
    """(n, 2) sub-pixel peaks, by a parabola through three samples in each axis."""
    rows, columns = score.shape
    pixels, step = score.ravel(), np.array([[1], [columns]])  # along a row, and down a column
    at = row.clip(1, rows - 2) * columns + column.clip(1, columns - 2)
    before, after = pixels[at - step], pixels[at + step]  # (2, n)
    bend = before - 2 * pixels[at] + after
    shift = np.clip(0.5 * (before - after) / np.minimum(bend, np.float32(-1e-12)), -0.5, 0.5)
    shift[bend >= 0] = 0.0
    return np.asarray((np.stack([column, row]) + shift).T, float)
