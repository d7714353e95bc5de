"""Stage 1: candidate selection (Section 3.2, Eq. 1 and 2, Figure 4).

The outline of a landmark as the sonar sees it is correlated with the image; local maxima of the
correlation (Hough) map above a threshold are candidates.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.config import Candidates
from sonarrec.landmarks import LandmarkSet
from sonarrec.plane import Plane
from sonarrec.records import ByteImage, FloatArray, Selection

# The ring filter's dark surroundings, in disc radii: part of the gap inside, the floor outside.
GAP_MARGIN = 0.03
OUTSIDE = (1.08, 1.35)
COARSE = 4  # pixels, of the grid on which the surroundings' brightness is measured
LEAST_LOCAL_SIGMA = 0.5  # of the whole frame's
# Peaks that are compared with each other; a frame with more is noise from edge to edge.
MOST_PEAKS = 64


class CandidateSelector:
    """Finds circles of the landmarks' size in working images of one plane."""

    def __init__(self, config: Candidates, plane: Plane, landmarks: LandmarkSet) -> None:
        self._config = config
        self._inside = plane.inside
        self._inside_grey = plane.inside.astype(np.float32)
        self._cells = max(1, int(np.count_nonzero(plane.inside)))
        across, along = plane.axes
        margin = int(np.ceil(max(across, along) * OUTSIDE[1]))
        y, x = np.mgrid[-margin : margin + 1, -margin : margin + 1].astype(float)
        radius = np.hypot(x / across, y / along)
        pixel = 1 / min(across, along)
        if config.detector == "edge":
            outline = np.abs(radius - 1) < 0.5 * pixel
            self._kernel = (outline / outline.sum()).astype(np.float32)
            ring = outline.astype(float)
            # The fan's own edge is an edge too, and so is what the blur makes of it.
            border = config.blur_px // 2 + 1
            self._away = cv2.erode(plane.inside, np.ones((2 * border + 1,) * 2, np.uint8))
            self._tolerance = np.ones((2 * config.edge_tolerance_px + 1,) * 2, np.uint8)
        else:
            ring = _band(radius, landmarks.ring, pixel)
            gap = _band(
                radius, (landmarks.symbol[1] + GAP_MARGIN, landmarks.ring[0] - GAP_MARGIN), pixel
            )
            outside = _band(radius, OUTSIDE, pixel)
            self._kernel = (
                ring / ring.sum() - 0.5 * gap / gap.sum() - 0.5 * outside / outside.sum()
            ).astype(np.float32)
        self._margin = margin
        rows, columns = plane.shape
        self._coarse = (max(1, columns // COARSE), max(1, rows // COARSE))
        size = 4 * margin // COARSE + 1
        self._background = (size, size)
        seen = cv2.resize(self._inside_grey, self._coarse, interpolation=cv2.INTER_AREA)
        self._seen = np.maximum(np.asarray(cv2.blur(seen, self._background)), np.float32(1e-3))
        self._diameter = 2 * np.array(plane.axes)
        visible = self._correlate(self._inside_grey, ring.astype(np.float32))
        visible /= ring.sum()
        # A part of a ring is scored by what shows of it. The correlation is short by the share that
        # is hidden, its noise by the root of that: dividing by the root keeps the rate of chance
        # candidates the same up to the fan's edge.
        self._gain = np.where(
            visible >= config.min_visible, np.maximum(visible, config.min_visible) ** -0.5, 0
        ).astype(np.float32)

    def __call__(self, image: ByteImage) -> Selection:
        """Candidates in a working image (uint8, the plane's shape)."""
        mean = self._local_mean(image * self._inside_grey)
        relief = (image - mean) * self._inside_grey
        # A black or even frame has no relief; 1 keeps it so.
        sigma = float(np.sqrt(cv2.norm(relief, cv2.NORM_L2SQR) / self._cells)) or 1.0
        if self._config.detector == "edge":
            score = self._edge_score(image)
            # The tolerance makes plateaus; the middle of one is where the circle is, and its
            # best pixel is what the circle scores.
            size = 2 * self._config.edge_tolerance_px + 3
            hill = np.asarray(cv2.GaussianBlur(score, (size, size), 0), np.float32)
            best = cv2.dilate(score, np.ones((size, size), np.uint8))
        else:
            score = hill = best = self._ring_score(relief, sigma)
        top = hill == cv2.dilate(hill, np.ones((3, 3), np.uint8))
        row, column = np.nonzero((best >= self._config.threshold) & top)
        order = np.lexsort((-hill[row, column], -best[row, column]))[:MOST_PEAKS]
        row, column = row[order], column[order]
        positions = _refine(hill, column, row)
        kept = self._apart(positions)[: self._config.max_candidates]
        scores = np.minimum(best[row, column][kept], 1).astype(float)
        return Selection(np.clip(score, 0, 1), positions[kept], scores, mean, sigma)

    def _apart(self, positions: FloatArray) -> npt.NDArray[np.intp]:
        """Indices of the peaks, best first, that no better one is too near to."""
        offset = (positions[:, None] - positions[None]) / self._diameter
        near = np.hypot(offset[..., 0], offset[..., 1]) < self._config.separation
        kept = np.ones(len(positions), bool)
        for i in range(1, len(positions)):
            kept[i] = not (near[i, :i] & kept[:i]).any()
        return np.flatnonzero(kept)

    def _edge_score(self, image: ByteImage) -> npt.NDArray[np.float32]:
        """Share of the outline's pixels that lie on or near an edge, per pixel."""
        config = self._config
        sigma = float(cv2.meanStdDev(image, mask=self._inside)[1][0, 0])
        blurred = cv2.GaussianBlur(image, (config.blur_px | 1, config.blur_px | 1), 0)
        edges = cv2.Canny(blurred, config.canny_low * sigma, config.canny_high * sigma)
        edges = cv2.dilate(cv2.bitwise_and(edges, edges, mask=self._away), self._tolerance)
        on_edge = (edges > 0).astype(np.float32)
        return np.asarray(self._correlate(on_edge, self._kernel) * self._gain)

    def _ring_score(self, relief: npt.NDArray[np.float32], sigma: float) -> npt.NDArray[np.float32]:
        """Contrast of a bright ring over its surroundings, in shares of the full contrast.

        relief: (rows, columns) grey level over that of the surroundings. sigma: its deviation.
        """
        # Never far below the whole frame's: an even patch must not turn its noise into rings.
        least = (LEAST_LOCAL_SIGMA * sigma) ** 2
        local = cv2.sqrt(np.maximum(self._local_mean(relief * relief), least))
        score = self._correlate(relief, self._kernel) * self._gain
        return np.asarray(score / (local * np.float32(self._config.ring_full_contrast)))

    def _local_mean(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Mean of (rows, columns) values, 0 outside the fan, over each pixel's surroundings.

        Made on a coarse grid: it hardly changes from one pixel to the next.
        """
        coarse = cv2.resize(values, self._coarse, interpolation=cv2.INTER_AREA)
        mean = cv2.blur(coarse, self._background) / self._seen
        size = (values.shape[1], values.shape[0])
        return np.asarray(cv2.resize(mean, size, interpolation=cv2.INTER_LINEAR), np.float32)

    def _correlate(
        self, image: npt.NDArray[np.float32], kernel: npt.NDArray[np.float32]
    ) -> npt.NDArray[np.float32]:
        m = self._margin
        padded = cv2.copyMakeBorder(image, m, m, m, m, cv2.BORDER_CONSTANT, value=0)
        return cv2.matchTemplate(padded, kernel, cv2.TM_CCORR)  # type: ignore[return-value]


def _band(radius: FloatArray, band: tuple[float, float], pixel: float) -> FloatArray:
    """Share of each pixel that lies between two radii, softened by one pixel."""
    inner = np.clip((radius - band[0]) / pixel + 0.5, 0, 1)
    outer = np.clip((band[1] - radius) / pixel + 0.5, 0, 1)
    return np.asarray(np.minimum(inner, outer))


def _refine(
    score: npt.NDArray[np.float32], column: npt.NDArray[np.intp], row: npt.NDArray[np.intp]
) -> FloatArray:
    """(n, 2) peaks to a part of a pixel, by a parabola through three samples in each axis."""
    rows, columns = score.shape
    c = np.clip(column, 1, columns - 2)
    r = np.clip(row, 1, rows - 2)

    def offset(before: FloatArray, at: FloatArray, after: FloatArray) -> FloatArray:
        bend = before - 2 * at + after
        with np.errstate(divide="ignore", invalid="ignore"):
            shift = np.where(bend < 0, 0.5 * (before - after) / bend, 0.0)
        return np.asarray(np.clip(shift, -0.5, 0.5))

    x = column + offset(score[r, c - 1], score[r, c], score[r, c + 1])
    y = row + offset(score[r - 1, c], score[r, c], score[r + 1, c])
    return np.column_stack([x, y]).astype(float)
