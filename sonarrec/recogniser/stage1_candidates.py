"""Stage 1: candidate selection (Section 3.2, Eq. 1 and 2, Figure 4).

The outline of a landmark as the sonar sees it is correlated with the image; local maxima of the
correlation (Hough) map above a threshold are candidates.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from sonarrec.config import Candidates
from sonarrec.landmarks import LandmarkSet
from sonarrec.recogniser.plane import Plane
from sonarrec.records import ByteImage, FloatArray, Selection

# The ring filter's dark surroundings, in disc radii: part of the gap inside, the floor outside.
GAP_MARGIN = 0.03
OUTSIDE = (1.08, 1.35)
COARSE = 4  # pixels, of the grid on which the surroundings' brightness is measured
LEAST_SIGMA = 0.5  # grey levels
LEAST_LOCAL_SIGMA = 0.5  # of the whole frame's
# Peaks that are compared with each other; a frame with more is noise from edge to edge.
MOST_PEAKS = 64


class CandidateSelector:
    """Finds circles of the landmarks' size in working images of one plane."""

    def __init__(self, config: Candidates, plane: Plane, landmarks: LandmarkSet) -> None:
        self._config = config
        self._inside = plane.inside
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
        size = 4 * margin // COARSE + 1
        self._background = (size, size)
        inside = plane.inside.astype(np.float32)
        self._seen = np.maximum(self._local_sum(inside), np.float32(1e-3))
        self._diameter = 2 * np.array(plane.axes)
        visible = self._correlate(inside, ring.astype(np.float32))
        visible /= ring.sum()
        # A part of a ring is scored by what shows of it. The correlation is short by the share that
        # is hidden, its noise by the root of that: dividing by the root keeps the rate of chance
        # candidates the same up to the fan's edge.
        self._gain = np.where(
            visible >= config.min_visible, np.maximum(visible, config.min_visible) ** -0.5, 0
        ).astype(np.float32)

    def __call__(self, image: ByteImage) -> Selection:
        """Candidates in a working image (uint8, the plane's shape)."""
        mean = self._fine(self._local_mean(cv2.bitwise_and(image, image, mask=self._inside)))
        relief = np.subtract(image, mean, dtype=np.float32)
        relief *= self._inside
        # A black or even frame has no relief but that of rounding.
        sigma = float(np.sqrt(cv2.norm(relief, cv2.NORM_L2SQR) / self._cells))
        sigma = max(sigma, LEAST_SIGMA)
        if self._config.detector == "edge":
            score = self._edge_score(image)
            # The tolerance makes plateaus; the middle of one is where the circle is, and its
            # best pixel is what the circle scores.
            size = 2 * self._config.edge_tolerance_px + 3
            hill = np.asarray(cv2.GaussianBlur(score, (size, size), 0), np.float32)
            best = cv2.dilate(score, np.ones((size, size), np.uint8))
        else:
            score = hill = best = self._ring_score(relief, sigma)
        top = (hill == cv2.dilate(hill, np.ones((3, 3), np.uint8))) & (
            best >= self._config.threshold
        )
        found = cv2.findNonZero(top.view(np.uint8))
        column, row = np.empty((2, 0), np.intp) if found is None else found.reshape(-1, 2).T
        order = np.lexsort((-hill[row, column], -best[row, column]))[:MOST_PEAKS]
        row, column = row[order], column[order]
        positions = _refine(hill, column, row)
        kept = self._apart(positions)
        scores = np.minimum(best[row, column][kept], 1).astype(float)
        return Selection(np.clip(score, 0, 1, out=score), positions[kept], scores, mean, sigma)

    def _apart(self, positions: FloatArray) -> list[int]:
        """Indices of the peaks, best first, that no better one is too near to."""
        offset = (positions[:, None] - positions[None]) / self._diameter
        far = np.hypot(offset[..., 0], offset[..., 1]) >= self._config.separation
        left = np.ones(len(positions), bool)
        kept: list[int] = []
        while left.any() and len(kept) < self._config.max_candidates:
            kept.append(int(left.argmax()))
            left &= far[kept[-1]]
            left[kept[-1]] = False  # also where separation is 0
        return kept

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
        local = np.sqrt(np.maximum(self._local_mean(relief * relief), least))
        score = self._correlate(relief, self._kernel)
        score *= self._gain
        score *= self._fine(1 / (self._config.ring_full_contrast * local))
        return score

    def _local_mean(self, values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        """Mean of (rows, columns) values, 0 outside the fan, over each pixel's surroundings.

        On a coarse grid, for it hardly changes from one pixel to the next.
        """
        return np.asarray(self._local_sum(values) / self._seen, np.float32)

    def _local_sum(self, values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        """Sum over each pixel's surroundings, in units of their size, on a grid of whole blocks."""
        rows, columns = (-side % COARSE for side in values.shape)
        whole = cv2.copyMakeBorder(values, 0, rows, 0, columns, cv2.BORDER_CONSTANT, value=0)
        size = (whole.shape[1] // COARSE, whole.shape[0] // COARSE)
        coarse = cv2.resize(whole, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        return np.asarray(
            cv2.blur(coarse, self._background, borderType=cv2.BORDER_CONSTANT), np.float32
        )

    def _fine(self, coarse: FloatArray) -> npt.NDArray[np.float32]:
        """(rows, columns) of values on the coarse grid."""
        size = (coarse.shape[1] * COARSE, coarse.shape[0] * COARSE)
        rows, columns = self._inside.shape
        fine = cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(fine[:rows, :columns], np.float32)

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
    c = np.clip(column, 1, columns - 2)[:, None]
    r = np.clip(row, 1, rows - 2)[:, None]
    three = np.arange(-1, 2)
    before, at, after = np.stack([score[r, c + three], score[r + three, c]], axis=1).T  # (2, n)
    bend = before - 2 * at + after
    shift = np.clip(0.5 * (before - after) / np.minimum(bend, np.float32(-1e-12)), -0.5, 0.5)
    shift[bend >= 0] = 0.0
    return np.column_stack([column + shift[0], row + shift[1]]).astype(float)
