"""Stage 1: candidate selection (Section 3.2, Eq. 1 and 2, Figure 4).

The outline of a landmark as the sonar sees it is correlated with the image; local maxima of the
correlation (Hough) map above a threshold are candidates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.arrays import ByteImage, FloatArray, FloatImage, IndexArray
from sonarrec.config import Candidates
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.plane import Plane
from sonarrec.sonar.frame import Fan, Selection

# The ring filter compares the ring with the gap inside it, less a margin, and with the floor
# outside, in disc radii.
GAP_MARGIN = 0.03
OUTSIDE = (1.08, 1.35)
# Weight of the gap in that comparison; the floor outside has the rest. A ring always stands out
# from its plate, whatever the floor is like; but beams as wide as the gap fill it with echoes of
# ring and symbol. A share of 0.85 finds more rings that are darker than the floor (candidates near
# them .48 -> .74 and .96 -> .94 in two sets of tuning seeds), and more false ones.
GAP_SHARE, FILLED_GAP_SHARE = 0.75, 0.5
# Widths of the gap, in beams at the middle of the window, at which it is filled, and is clear.
FILLED_BEAMS, CLEAR_BEAMS = 1.0, 1.5
BLUR_PX = 13  # side of the Gaussian kernel before Canny; by hand
EDGE_TOLERANCE_PX = 2  # how far from the outline an edge may lie and still count; by hand
COARSE = 4  # pixels, of the grid on which the surroundings' brightness is measured
LEAST_SIGMA = 0.5  # grey levels
LEAST_LOCAL_SIGMA = 0.5  # share of the whole frame's sigma
# In large images a ring is searched for on blocks of SEARCHED x SEARCHED pixels, unless the disc's
# radius is then below LEAST_RADIUS blocks. There its score is COARSE_SHARE of that on pixels (the
# median on simulated and recorded logs; hardly one has less than LEAST_SHARE). Peaks are scored
# again on pixels, which costs as much as the search on LARGE images.
LARGE, SEARCHED, LEAST_RADIUS = 2**16, 2, 4.5
COARSE_SHARE, LEAST_SHARE = 0.77, 0.63
NEIGHBOURHOOD = np.ones((3, 3), np.uint8)  # a pixel and its neighbours
# At most MOST_PEAKS peaks are compared with each other on a floor with room for FLOOR_DISCS discs
# or fewer; a frame with more is all noise. On a larger floor the limits of peaks and candidates
# grow in proportion, up to MOST_FACTOR. All measured kinds of scene have smaller floors.
MOST_PEAKS, FLOOR_DISCS, MOST_FACTOR = 64, 300, 8


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
        self._surroundings = Surroundings(plane)
        discs = self._surroundings.cells / (np.pi * plane.axes[0] * plane.axes[1])
        factor = min(max(discs / FLOOR_DISCS, 1), MOST_FACTOR)
        self._most_peaks = round(factor * MOST_PEAKS)
        self._most = round(factor * config.max_candidates)
        self._diameter = 2 * plane.axes[0], 2 * plane.axes[1]
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
        levels = self._surroundings(image)
        maps = self._detector(image, levels)
        positions, scores = self._peaks(maps)
        score = np.clip(maps.score, 0, 1, out=maps.score)
        return Selection(score, positions, scores, levels.mean, maps.sigma, maps.step)

    def levels(self, selection: Selection, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) mean and standard deviation of the grey levels around (n, 2) positions, pixels."""
        around = self._surroundings
        return around.values_at(selection.mean, positions), around.values_at(
            selection.sigma, positions
        )

    def _peaks(self, maps: ScoreMaps) -> tuple[FloatArray, FloatArray]:
        """(n, 2) sub-pixel positions of peaks above the threshold, (n,) scores; best first."""
        peaks, least = maps.peaks, self._config.threshold
        searched = least if maps.on_pixels is None else LEAST_SHARE / COARSE_SHARE * least
        top = (peaks >= cv2.dilate(peaks, NEIGHBOURHOOD)) & (maps.peak_score >= searched)
        index = np.flatnonzero(top)
        height, scores = peaks.ravel()[index], maps.peak_score.ravel()[index].astype(float)
        order = np.lexsort((-height, -scores))[: self._most_peaks]
        positions, scores = _refine(peaks, index[order]), scores[order]
        if maps.on_pixels is not None:
            positions = maps.step * (positions + 0.5) - 0.5
            positions = positions[self._suppress_neighbours(positions, 2 * self._most)]
            positions, scores = maps.on_pixels(positions)
            order = np.argsort(-scores, kind="stable")[: np.count_nonzero(scores >= least)]
            positions, scores = positions[order], scores[order]
        kept = self._suppress_neighbours(positions, self._most)
        return positions[kept], np.minimum(scores[kept], 1)

    def _suppress_neighbours(self, positions: FloatArray, most: int) -> list[int]:
        """Indices of the peaks, best first, that are not too near a better one; `most` of them."""
        x, y = (positions / self._diameter).T
        near = np.square(x[:, None] - x) + np.square(y[:, None] - y) < self._config.separation**2
        kept: list[int] = []
        left = np.ones(len(positions), bool)
        for i in range(len(positions)):
            if left[i]:
                kept.append(i)
                if len(kept) == most:
                    break
                left &= ~near[i]
        return kept


class Levels(NamedTuple):
    """The grey levels of one working image."""

    half: FloatImage
    """Mean of each block of SEARCHED x SEARCHED pixels, 0 outside the fan."""
    mean: FloatImage
    """Mean in each pixel's surroundings, on the coarse grid."""
    sigma: FloatImage
    """Standard deviation there; not far below that of the whole frame, else the noise of a uniform
    patch would score as rings."""
    frame_sigma: float
    """Standard deviation over the whole frame."""


class Surroundings:
    """Means over each pixel's surroundings, on a coarse grid, since they are smooth.

    cells: number of pixels in the fan.
    """

    def __init__(self, plane: Plane) -> None:
        size = 4 * _reach(plane) // COARSE + 1
        self._size = (size, size)
        self._inside = plane.inside
        self.cells = max(1, int(np.count_nonzero(plane.inside)))
        self._block = _downsampled(_padded_to_blocks(plane.inside).astype(np.float32), COARSE)
        self._seen = np.maximum(self._blur(self._block), np.float32(1e-3))

    def __call__(self, image: ByteImage) -> Levels:
        """The levels of a working image."""
        grey = _padded_to_blocks(image * self._inside)
        half = _downsampled(grey.astype(np.float32), SEARCHED)
        block = _downsampled(half, COARSE // SEARCHED)
        mean = np.asarray(self._blur(block) / self._seen, np.float32)
        # The relief is the level over that of the surroundings, which is even within a block.
        power = _downsampled(_downsampled(np.square(grey, dtype=np.uint16), 2), COARSE // 2).astype(
            np.float32
        )
        power += mean * (mean * self._block - 2 * block)
        # A black or uniform frame has only rounding errors as relief.
        variance = max(float(power.sum()), 0.0) * COARSE**2 / self.cells
        frame_sigma = max(math.sqrt(variance), LEAST_SIGMA)
        least = np.float32((LEAST_LOCAL_SIGMA * frame_sigma) ** 2)
        sigma = np.sqrt(np.maximum(self._blur(power) / self._seen, least), dtype=np.float32)
        return Levels(half, mean, sigma, frame_sigma)

    def values_at(self, coarse: FloatImage, positions: FloatArray) -> FloatArray:
        """(n,) values on the coarse grid, interpolated to the pixels at (n, 2) positions."""
        if len(positions) == 0:  # OpenCV refuses empty maps
            return np.empty(0)
        pixel = np.clip(np.rint(positions), 0, np.array(self._inside.shape[::-1]) - 1)
        column, row = ((pixel + 0.5) / COARSE - 0.5).astype(np.float32).T
        values = cv2.remap(coarse, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(values, float).ravel()

    def _blur(self, blocks: FloatImage) -> FloatImage:
        """Mean over each block's surroundings; 0 beyond the image."""
        return np.asarray(cv2.blur(blocks, self._size, borderType=cv2.BORDER_CONSTANT), np.float32)


def _padded_to_blocks(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(rows, columns) values, padded with 0 to whole blocks of the coarse grid."""
    rows, columns = (-side % COARSE for side in values.shape)
    filled = cv2.copyMakeBorder(values, 0, rows, 0, columns, cv2.BORDER_CONSTANT, value=0)
    return np.asarray(filled)


def _downsampled(values: npt.NDArray[Any], factor: int) -> npt.NDArray[Any]:
    """Means over blocks of factor x factor."""
    size = (values.shape[1] // factor, values.shape[0] // factor)
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA))


def upsample(coarse: FloatImage, shape: tuple[int, int], step: int = 1) -> FloatImage:
    """Values on the coarse grid interpolated to every pixel, or every block of step x step:
    `shape` (rows, columns) of them."""
    factor = COARSE // step
    size = (coarse.shape[1] * factor, coarse.shape[0] * factor)
    fine = cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(fine[: shape[0], : shape[1]], np.float32)


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
    step: int = 1
    """Of the working image's pixels from one of the maps' to the next."""
    on_pixels: Callable[[FloatArray], tuple[FloatArray, FloatArray]] | None = None
    """Where the maps are coarser than the image: (n, 2) exact positions, (column, row), and (n,)
    scores of the discs at or next to (n, 2) positions."""


class Detector(Protocol):
    """Scores how well a landmark's circle fits at every pixel."""

    def __call__(self, image: ByteImage, levels: Levels, /) -> ScoreMaps:
        """The score maps of a working image, which has these levels."""
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
        self._gain = _gain(plane.inside.astype(np.float32), outline.astype(float), config)
        # The fan's own edge, widened by the blur, must not count as an edge of the image.
        border = BLUR_PX // 2 + 1
        self._clear_of_edge = cv2.erode(plane.inside, np.ones((2 * border + 1,) * 2, np.uint8))
        self._tolerance = np.ones((2 * EDGE_TOLERANCE_PX + 1,) * 2, np.uint8)

    def __call__(self, image: ByteImage, levels: Levels) -> ScoreMaps:
        """Edges are found in the grey levels themselves."""
        config = self._config
        grey_sigma = float(cv2.meanStdDev(image, mask=self._inside)[1][0, 0])
        blurred = cv2.GaussianBlur(image, (BLUR_PX, BLUR_PX), 0)
        edges = cv2.Canny(blurred, config.canny_low * grey_sigma, config.canny_high * grey_sigma)
        edges = cv2.dilate(cv2.bitwise_and(edges, edges, mask=self._clear_of_edge), self._tolerance)
        on_edge = (edges > 0).astype(np.float32)
        score = self._correlate(on_edge) * self._gain
        # The tolerance makes plateaus. The circle is at the middle of a plateau, and gets the score
        # of its best pixel.
        size = 2 * EDGE_TOLERANCE_PX + 3
        peaks = np.asarray(cv2.GaussianBlur(score, (size, size), 0), np.float32)
        best = np.asarray(cv2.dilate(score, np.ones((size, size), np.uint8)), np.float32)
        return ScoreMaps(score, peaks, best, np.full((1, 1), levels.frame_sigma, np.float32))


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
        gap = landmarks.symbol[1] + GAP_MARGIN, landmarks.ring[0] - GAP_MARGIN

        def contrast(step: int) -> tuple[FloatArray, FloatArray]:
            """The kernel on blocks of step x step pixels, and the ring's part of it."""
            radius, pixel = _radii(plane, step)
            bands = [
                _downsampled(_band(radius, band, pixel), step)
                for band in (landmarks.ring, gap, OUTSIDE)
            ]
            ring, within, outside = (band / band.sum() for band in bands)
            kernel = ring - share * within - (1 - share) * outside
            return (kernel + kernel[::-1, ::-1]) / 2, bands[0]  # exactly symmetric

        large = plane.inside.size > LARGE and min(plane.axes) >= SEARCHED * LEAST_RADIUS
        self._step = step = SEARCHED if large else 1
        kernel, ring = contrast(step)
        self._inside = _downsampled(_padded_to_blocks(plane.inside).astype(np.float32), step)
        self._correlate = Correlation(kernel.astype(np.float32), self._inside.shape)
        self._gain = _gain(self._inside, ring, config) / np.float32(config.ring_full_contrast)
        scale = np.float32(1 if step == 1 else 1 / COARSE_SHARE)
        self._scaled_gain = self._gain * scale
        if step == 1:
            return
        # The kernel at a pixel and its neighbours, in a patch that holds them all.
        fine = contrast(1)[0]
        self._side = fine.shape[0] + 2
        shifts = [((row, 2 - row), (column, 2 - column)) for row in range(3) for column in range(3)]
        self._patch = np.stack([np.pad(fine, shift).ravel() for shift in shifts], axis=1)
        self._pixels = self._padded(plane.inside)

    def __call__(self, image: ByteImage, levels: Levels) -> ScoreMaps:
        """Contrast is in standard deviations of the relief around each pixel."""
        step, shape = self._step, self._inside.shape
        grey = levels.half if step == SEARCHED else _padded_to_blocks(image) * self._inside
        relief = upsample(levels.mean, shape, step) * self._inside
        np.subtract(grey, relief, out=relief)
        score = self._correlate(relief)
        score *= self._scaled_gain
        score /= upsample(levels.sigma, shape, step)
        exact = partial(self._on_pixels, image, levels) if step > 1 else None
        return ScoreMaps(score, score, score, levels.sigma, step, exact)

    def _on_pixels(
        self, image: ByteImage, levels: Levels, positions: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """As ScoreMaps.on_pixels."""
        around = self._surroundings
        # Whole blocks may exceed the image.
        pixel = np.minimum(np.rint(positions).astype(int), np.array(image.shape[::-1]) - 1)
        grey, inside = (self._patches(p, pixel) for p in (self._padded(image), self._pixels))
        # The surroundings' level is nearly even within a patch, and the kernel sums to 0.
        relief = grey - around.values_at(levels.mean, pixel)[:, None]
        relief *= inside
        contrast = (relief @ self._patch).reshape(-1, 3, 3)
        lines = np.stack([contrast[:, 1], contrast[:, :, 1]])  # along a row, and down a column
        before, middle, after = np.moveaxis(lines, 2, 0)
        shift = _vertex(before, middle, after, 1.0)
        gain = self._gain[tuple(pixel[:, ::-1].T // self._step)] / around.values_at(
            levels.sigma, pixel
        )
        scores = contrast.max(axis=(1, 2), initial=0) * gain
        # Rounded, since the last digits of a product depend on the processor.
        return np.round(pixel + shift.T, 4), np.round(scores, 6)

    def _patches(self, padded: ByteImage, pixel: IndexArray) -> ByteImage:
        """(n, side^2) the patches of (n, 2) pixels, from `_padded`."""
        every = np.lib.stride_tricks.sliding_window_view(padded, (self._side, self._side))
        return every[pixel[:, 1], pixel[:, 0]].reshape(len(pixel), self._side**2)

    def _padded(self, image: ByteImage) -> ByteImage:
        """An image with room for the patch of every pixel."""
        m = self._side // 2
        padded = cv2.copyMakeBorder(image, m, m, m, m, cv2.BORDER_CONSTANT, value=0)
        return np.asarray(padded, np.uint8)


class Correlation:
    """Does what `_correlate` does, by FFT, for many images of one shape and one symmetric kernel.

    For speed, arrays are reused from image to image, columns are transformed as rows, and precision
    is single: errors stay under a millionth of the largest sum. numpy keeps single precision only
    with norm="forward".
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
        # An image, and its transform, columns first. Any, since numpy's stubs know only 64 bits.
        self._padded: npt.NDArray[Any] = np.zeros((shape[0], size[1]), np.float32)
        self._both: npt.NDArray[Any] = np.zeros(self._kernel.shape, np.complex64)

    def __call__(self, image: FloatImage) -> FloatImage:
        """(rows, columns) of an image with the kernel centred on each pixel; 0 beyond it."""
        rows, columns = image.shape
        padded, both = self._padded, self._both
        by_rows = both.T[:rows]
        padded[:, :columns], padded[:, columns:] = image, 0
        np.fft.rfft(padded, norm="forward", out=by_rows)
        both[:, rows:] = 0
        np.fft.fft(both, norm="forward", out=both)
        both *= self._kernel
        np.fft.ifft(both, out=both)
        np.fft.irfft(by_rows, padded.shape[1], out=padded)
        return padded[:, :columns].copy()


def gap_share(landmarks: LandmarkSet, fan: Fan, beam_width_deg: float) -> float:
    """Weight of the gap against the floor outside, by the gap's width in beams."""
    middle_m = (fan.range_min_m + fan.range_max_m) / 2
    gap_m = (landmarks.ring[0] - landmarks.symbol[1]) * landmarks.radius_m
    beams = gap_m / (np.radians(beam_width_deg) * middle_m)
    return float(np.interp(beams, (FILLED_BEAMS, CLEAR_BEAMS), (FILLED_GAP_SHARE, GAP_SHARE)))


def _reach(plane: Plane) -> int:
    """Radius in pixels of the kernel, which includes the floor round a disc."""
    return int(np.ceil(max(plane.axes) * OUTSIDE[1]))


def _radii(plane: Plane, step: int = 1) -> tuple[FloatArray, float]:
    """Distance of each pixel of a kernel from its middle, and a pixel's size, in disc radii.

    The kernel is an odd number of blocks of step x step pixels wide.
    """
    across, along = plane.axes
    side = step * (2 * -(-_reach(plane) // step) + 1)
    offset = np.arange(side) + 0.5 - side / 2
    return np.hypot(offset / across, offset[:, None] / along), 1 / min(across, along)


def _gain(inside: FloatImage, ring: FloatArray, config: Candidates) -> FloatImage:
    """(rows, columns) factor of a score by how much of the ring lies inside the fan.

    inside: the share of each pixel in the fan. ring: weights of a kernel's pixels. Where less than
    min_visible shows, the factor is 0.
    """
    least = config.min_visible
    visible = _correlate(inside, ring.astype(np.float32))
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


def _refine(score: FloatImage, index: IndexArray) -> FloatArray:
    """(n, 2) sub-pixel peaks, (column, row), by a parabola through three samples in each axis.

    index: (n,) of the highest pixels, counted row by row.
    """
    rows, columns = score.shape
    row, column = np.divmod(index, columns)
    pixels, step = score.ravel(), np.array([[1], [columns]])  # along a row, and down a column
    inner_row, inner_column = np.maximum(row, 1), np.maximum(column, 1)
    inner = np.minimum(inner_row, rows - 2) * columns + np.minimum(inner_column, columns - 2)
    shift = _vertex(pixels[inner - step], pixels[inner], pixels[inner + step])
    return np.asarray((np.stack([column, row]) + shift).T, float)


def _vertex(
    before: FloatArray, middle: FloatArray, after: FloatArray, most: float = 0.5
) -> FloatArray:
    """Where a parabola through three samples has its maximum, at most so many steps from the
    middle; 0 if it has none."""
    bend = before - 2 * middle + after
    shift = 0.5 * (before - after) / np.minimum(bend, np.float32(-1e-12))
    return np.where(bend < 0, np.maximum(np.minimum(shift, most), -most), 0.0)
