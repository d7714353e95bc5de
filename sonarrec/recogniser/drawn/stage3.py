"""Stage 3 for plates: the picture averaged along the track, against every drawing and its rivals.

A small model, learned on simulated plates, turns what matches how well into beliefs, 'none of
these' among them; those of a track's frames are pooled as those of discs are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import FloatArray, FloatImage, joined
from sonarrec.recogniser.drawn.drawings import FINE, best, levelled, uneven_light
from sonarrec.recogniser.drawn.pose import Drawing, Fit, PoseFitter
from sonarrec.recogniser.stage3 import Beliefs, Evidence, likeliest
from sonarrec.recogniser.stage3.opinions import TrackBelief
from sonarrec.recogniser.stage3.shape_matrix import STEP_DEG
from sonarrec.records import Groups

LEAST_FRAMES = 2  # with a picture, from which on an ID is declared
ANGLE_SIGMA_DEG = 2.0


@dataclass(frozen=True, slots=True)
class PlateEvidence(Evidence):
    """Evidence on n plates. brightness, count: (n, FINE, FINE) averaged pictures."""

    matches: FloatImage
    """(n, K) of the averaged picture with each ID."""
    rival: FloatImage
    """(n,) with the best of the random drawings; 0 where the plate is not seen."""
    odds: FloatImage
    """(n,) mean of Fit.odds."""
    orientation_deg: FloatImage
    """(n, K) orientation of each ID, counter-clockwise from the image's right."""
    beyond_deg: FloatImage
    """(n,) the line of sight, the same way."""
    corners: FloatArray
    """(n, 4, 2) working pixels of the corners, in the image clockwise; NaN where not seen."""


class PlateMeasurement:
    """Beliefs from each track's averaged picture, frame after frame."""

    def __init__(self, fitter: PoseFitter, memory_frames: float, remember_frames: int) -> None:
        self._fitter, self._drawings = fitter, fitter.drawings
        self._memory = memory_frames
        self._belief = TrackBelief(fitter.drawings.count, remember_frames)
        self._tracks: dict[int, _Track] = {}

    def gather(
        self, groups: Groups, fits: Sequence[tuple[Fit, int] | None]
    ) -> tuple[PlateEvidence, list[Drawing | None]]:
        """Add the pictures of a frame's plates to the averages of their tracks.

        fits: of each group, and the number of its picture; None: not seen. Gives the evidence, and
        of each group that is seen the drawing that its average matches best.
        """
        numbers, sight = groups.numbers.tolist(), self._fitter.plane.line_of_sight(groups.positions)
        self._tracks = {n: self._tracks.get(n, _Track()) for n in numbers}
        for number, of_frame in zip(numbers, fits, strict=True):
            if of_frame is not None:
                self._add(self._tracks[number], *of_frame)
        tracks = [self._tracks[n] for n in numbers]
        k, n = self._drawings.count, len(numbers)
        evidence = PlateEvidence(
            brightness=np.array([t.picture for t in tracks]).reshape(n, FINE, FINE),
            count=np.full((n, FINE, FINE), [[[t.weight]] for t in tracks] if n else 0.0),
            frames=np.array([t.frames for t in tracks], np.int64),
            episodes=np.array([t.episode for t in tracks], np.int64),
            matches=np.array([self._of_ids(t.matches) for t in tracks]).reshape(n, k),
            rival=np.array([t.rival for t in tracks], np.float32),
            odds=np.array([t.odds for t in tracks], np.float32),
            orientation_deg=np.array([self._of_ids(t.orientation_deg) for t in tracks]).reshape(
                n, k
            ),
            beyond_deg=np.degrees(sight).astype(np.float32),
            corners=np.array([self._corners(f) for f in fits]).reshape(n, 4, 2),
        )
        best = [None if f is None else t.best for f, t in zip(fits, tracks, strict=True)]
        return evidence, best

    def beliefs(self, groups: Sequence[Groups], evidence: Evidence) -> Beliefs:
        """Beliefs about the groups of consecutive frames; evidence: from `gather`, concatenated."""
        assert isinstance(evidence, PlateEvidence)
        tracked = joined(groups)
        of_frames = self._fitter.model.of_tracks(evidence.matches, evidence.rival, evidence.odds)
        probabilities = self._belief(groups, evidence, of_frames)
        row, _ = likeliest(probabilities)
        rotation = evidence.orientation_deg[np.arange(len(row)), row] - evidence.beyond_deg
        sigma = np.full(len(row), ANGLE_SIGMA_DEG / STEP_DEG)
        enough_evidence = (evidence.frames >= LEAST_FRAMES) & tracked.in_view
        corners = np.stack(
            self._fitter.plane.to_polar(*np.moveaxis(evidence.corners, 2, 0)), axis=2
        )
        # The two of the far edge first.
        edges = corners[:, :, 0] + np.roll(corners[:, :, 0], -1, axis=1)
        order = (np.arange(4) + edges.argmax(axis=1)[:, None]) % 4
        corners = np.take_along_axis(corners, order[:, :, None], axis=1)
        return Beliefs(probabilities, rotation / STEP_DEG, sigma, enough_evidence, corners)

    def _corners(self, of_frame: tuple[Fit, int] | None) -> FloatArray:
        if of_frame is None:
            return np.full((4, 2), np.nan)
        corners = self._fitter.corners(of_frame[0].pose)
        return corners if np.linalg.det(of_frame[0].pose[2:].reshape(2, 2)) > 0 else corners[::-1]

    def _of_ids(self, values: FloatImage) -> FloatImage:
        return values if len(values) else np.zeros(self._drawings.count, np.float32)

    def _add(self, track: _Track, fit: Fit, began: int) -> None:
        """Add a fit's picture to a track's average, and compare that with the drawings."""
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
        track.best = int(track.matches.argmax()), int(ways[track.matches.argmax()])
        across, down = fit.pose[2:].reshape(2, 2).T
        right = np.array([(1, 0), (0, -1), (-1, 0), (0, 1)])[ways[:k] % 4]
        right = np.where(ways[:k, None] >= 4, -right, right)
        x, y = right @ np.stack([across, down])[:, 0], right @ np.stack([across, down])[:, 1]
        track.orientation_deg = np.degrees(np.arctan2(-y, x)).astype(np.float32)


class _Track:
    """One group's averaged picture, and what it matches."""

    def __init__(self) -> None:
        self.picture: FloatImage = np.zeros((FINE, FINE), np.float32)
        self.weight, self.frames, self.episode, self.began = 0.0, 0, 0, 0
        self.matches: FloatImage = np.empty(0, np.float32)
        self.orientation_deg: FloatImage = np.empty(0, np.float32)
        self.rival = self.odds = 0.0
        self.best: Drawing | None = None
