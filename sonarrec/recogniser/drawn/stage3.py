"""Stage 3 for plates: the picture averaged along the track, against every drawing and its rivals.

A small model, learned on simulated plates, turns what matches how well into beliefs, 'none of
these' among them; those of a track's frames are pooled as those of discs are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sonarrec.arrays import Columns, FloatArray, FloatImage, Table, stacked
from sonarrec.recogniser.drawn.drawings import FINE, best, levelled, uneven_light
from sonarrec.recogniser.drawn.pose import Fit, PoseFitter
from sonarrec.recogniser.stage3 import Beliefs, likeliest
from sonarrec.recogniser.stage3.opinions import Opinion, pooled
from sonarrec.recogniser.stage3.shape_matrix import STEP_DEG
from sonarrec.recogniser.tracks import Tracks

LEAST_FRAMES = 2  # with a picture, from which on an ID is declared
ANGLE_SIGMA_DEG = 2.0


class PlateMeasurement:
    """Beliefs from each track's averaged picture, frame after frame.

    Its columns of the tracks: picture: (n,) of _Averaged. opinion: (n,) the pool of its frames.
    """

    def __init__(self, fitter: PoseFitter, tracks: Tracks, memory_frames: float) -> None:
        self._fitter, self._drawings, self._tracks = fitter, fitter.drawings, tracks
        self._memory = memory_frames
        tracks.declare(picture=_Averaged, opinion=Opinion)

    def gather(self) -> Columns:
        """Add the pictures of a frame's plates to the averages of their tracks.

        Each plate is followed from now on by the drawing that its average matches best.

        The evidence: frames: (n,) with a picture. matches: (n, K) of the averaged picture with each
        ID. rival: (n,) with the best of the random drawings; 0 where the plate is not seen. odds:
        (n,) mean of Fit.odds. orientation_deg: (n, K) of each ID, and beyond_deg: (n,) the line of
        sight, counter-clockwise from the image's right. corners: (n, 4, 2) working pixels, in the
        image clockwise; NaN where not seen.
        """
        tracks, rows = self._tracks, self._tracks.in_view
        for row in np.flatnonzero(tracks["remembered"]):
            tracks["picture"][row] = _Averaged()
        for row in rows[tracks["seen"][rows]]:
            average, fit = tracks["picture"][row], tracks["fit"][row]
            way = self._add(average, fit, tracks["began"][row])
            tracks["fit"][row] = replace(fit, row=int(average.matches.argmax()), way=way)
        averaged = tracks["picture"][rows]
        fits = [tracks["fit"][row] if tracks["seen"][row] else None for row in rows]
        k, n = self._drawings.count, len(rows)
        sight = self._fitter.plane.line_of_sight(tracks["position"][rows])
        return {
            "opinion": tracks["opinion"][rows],
            "episode": np.zeros(n, int),
            "frames": np.array([t.frames for t in averaged], int),
            "matches": np.array([self._of_ids(t.matches) for t in averaged]).reshape(n, k),
            "rival": np.array([t.rival for t in averaged], np.float32),
            "odds": np.array([t.odds for t in averaged], np.float32),
            "orientation_deg": np.array(
                [self._of_ids(t.orientation_deg) for t in averaged]
            ).reshape(n, k),
            "beyond_deg": np.degrees(sight).astype(np.float32),
            "corners": np.array([self._corners(f) for f in fits]).reshape(n, 4, 2),
        }

    def beliefs(self, frames: Sequence[Table]) -> Beliefs:
        """Beliefs about the tracks of consecutive frames, by their evidence."""
        tracks = stacked(frames)
        matched = tracks["matches"], tracks["rival"], tracks["odds"]
        probabilities = pooled(tracks["opinion"], self._fitter.model.of_tracks(*matched))
        row, _ = likeliest(probabilities)
        rotation = tracks["orientation_deg"][np.arange(len(row)), row] - tracks["beyond_deg"]
        sigma = np.full(len(row), ANGLE_SIGMA_DEG / STEP_DEG)
        enough_evidence = (tracks["frames"] >= LEAST_FRAMES) & tracks["shown"]
        corners = np.stack(
            self._fitter.plane.to_polar(*np.moveaxis(tracks["corners"], 2, 0)), axis=2
        )
        # The two of the far edge first.
        edges = corners[:, :, 0] + np.roll(corners[:, :, 0], -1, axis=1)
        order = (np.arange(4) + edges.argmax(axis=1)[:, None]) % 4
        corners = np.take_along_axis(corners, order[:, :, None], axis=1)
        return Beliefs(probabilities, rotation / STEP_DEG, sigma, enough_evidence, corners)

    def _corners(self, fit: Fit | None) -> FloatArray:
        if fit is None:
            return np.full((4, 2), np.nan)
        corners = self._fitter.corners(fit.pose)
        return corners if np.linalg.det(fit.pose[2:].reshape(2, 2)) > 0 else corners[::-1]

    def _of_ids(self, values: FloatImage) -> FloatImage:
        return values if len(values) else np.zeros(self._drawings.count, np.float32)

    def _add(self, track: _Averaged, fit: Fit, began: int) -> int:
        """Add a fit's picture to a track's average, and compare that with the drawings.

        Returns the way in which it shows that of the ID that it matches best.
        """
        if began != track.began:
            track.picture, track.weight = np.zeros((FINE, FINE), np.float32), 0.0
            track.began, track.frames = began, 0
        light = uneven_light(FINE, self._fitter.range_ward(fit.pose[None]))
        flat = levelled(fit.picture.reshape(1, -1), light).reshape(FINE, FINE)
        share = fit.match**2
        track.weight = min(track.weight, self._memory) + share
        track.picture = track.picture + (flat - track.picture) * np.float32(share / track.weight)
        track.odds += (fit.odds - track.odds) * share / track.weight
        track.frames += 1
        matches = self._fitter.matches(track.picture, fit.pose)
        column, match = best(matches)
        k = self._drawings.count
        track.matches, track.rival = match[:k], float(match[k:].max())
        ways = np.array(self._drawings.ways)[column]
        across, down = fit.pose[2:].reshape(2, 2).T
        right = np.array([(1, 0), (0, -1), (-1, 0), (0, 1)])[ways[:k] % 4]
        right = np.where(ways[:k, None] >= 4, -right, right)
        x, y = right @ np.stack([across, down])[:, 0], right @ np.stack([across, down])[:, 1]
        track.orientation_deg = np.degrees(np.arctan2(-y, x)).astype(np.float32)
        return int(ways[track.matches.argmax()])


class _Averaged:
    """One group's averaged picture, and what it matches."""

    def __init__(self) -> None:
        self.picture: FloatImage = np.zeros((FINE, FINE), np.float32)
        self.weight, self.frames, self.began = 0.0, 0, 0
        self.matches: FloatImage = np.empty(0, np.float32)
        self.orientation_deg: FloatImage = np.empty(0, np.float32)
        self.rival = self.odds = 0.0
