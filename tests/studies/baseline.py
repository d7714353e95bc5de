"""What an engineer would write in an afternoon: the rival that `make bench` measures against.

cv2.HoughCircles, the six-line shape matrix on every circle, a nearest-neighbour track with a
majority vote. Nothing of sonarrec's own recogniser is used.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from sonarrec.landmarks import LandmarkSet
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import fan_for_image, fan_mask
from sonarrec.sonar.stated import load_sonar

METHOD = "hough_majority"
ANGLES = 36
# (seed, kind of scene): none of them is reported on.
TUNING_SCENES = ((901, "plain"), (902, "plain"), (903, "near_miss"), (904, "fading"))


@dataclass(frozen=True, slots=True)
class Settings:
    """Of 512 searched, those with most TPR - 5 FPR over TUNING_SCENES (commit 8d855fe2 has how).

    scale: the image is shrunk by this before the search. blur: Gaussian kernel, pixels. edge,
    votes: HoughCircles' param1 and param2. slack: radii searched, as a share of the known one.
    similarity, ring: least share of agreeing cells, and of bright ring cells, for a vote.
    most: tracks vote over this many frames. share: of them that must agree. least: votes needed.
    """

    scale: float = 1.0
    blur: int = 9
    edge: float = 80.0
    votes: float = 8.0
    slack: float = 0.12
    similarity: float = 0.8
    ring: float = 0.6
    most: int = 40
    share: float = 0.35
    least: int = 2


HALF = Settings(scale=0.5, blur=7, edge=120.0, votes=5.0, slack=0.2)
"""At half the resolution; of 72 searched, again those with most TPR - 5 FPR over TUNING_SCENES."""


@dataclass(frozen=True, slots=True)
class Sight:
    """One circle: centre in fan pixels, its best ID (index), that ID's similarity, ring share."""

    x: float
    y: float
    best: int
    similarity: float
    ring: float


class HoughSmi:
    """The loop without memory: circles in one image, and what the shape matrix says of each."""

    def __init__(self, fan: Fan, landmarks: LandmarkSet, settings: Settings | None = None) -> None:
        self.settings = s = settings or Settings()
        # Eq. 1: the disc is squeezed along the range by cos(tilt).
        self._squeeze = float(np.cos(np.radians(fan.tilt_deg)))
        self.radius = landmarks.radius_m / fan.metres_per_pixel
        self._radii = tuple(round(self.radius * s.scale * (1 + d)) for d in (-s.slack, s.slack))
        self._mask = fan_mask(fan)
        inner, outer = landmarks.symbol, landmarks.ring
        lines = np.concatenate(
            [b[0] + (b[1] - b[0]) * (np.arange(3) + 0.5) / 3 for b in (inner, outer)]
        )
        angle = (np.arange(ANGLES) + 0.5) * 2 * np.pi / ANGLES
        across, ahead = self.radius, -self.radius * self._squeeze
        self._dx = (across * lines[:, None] * np.cos(angle)).astype(np.float32)
        self._dy = (ahead * lines[:, None] * np.sin(angle)).astype(np.float32)
        codes = landmarks.codes(angle)
        # (turns, IDs, angles), -1 or 1: agreement is linear in the bright cells per angle.
        self._templates = np.stack([np.roll(codes, t, axis=1) for t in range(ANGLES)]) * 2 - 1
        self._dark = (self._templates < 0).sum(axis=2) * 3

    def __call__(self, image: np.ndarray) -> list[Sight]:
        s = self.settings
        # Stretched along the range, so that discs are the circles HoughCircles looks for.
        stretch = s.scale / self._squeeze
        small = cv2.resize(image, None, fx=s.scale, fy=stretch, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (s.blur, s.blur), 0)
        radii = {
            "minDist": self._radii[0],
            "minRadius": self._radii[0],
            "maxRadius": self._radii[1],
        }
        limits = {"param1": s.edge, "param2": s.votes}
        found = cv2.HoughCircles(small, cv2.HOUGH_GRADIENT, dp=1, **radii, **limits)
        if found is None:
            return []
        return [
            sight
            for x, y, _ in found.reshape(-1, 3)
            if (sight := self._identify(image, x / s.scale, y / stretch)) is not None
        ]

    def _identify(self, image: np.ndarray, x: float, y: float) -> Sight | None:
        """The shape matrix of one circle; None where most of its ring lies outside the fan."""
        columns, rows = self._dx + np.float32(x), self._dy + np.float32(y)
        inside = cv2.remap(self._mask, columns, rows, cv2.INTER_NEAREST)
        if np.count_nonzero(inside[3:]) < 0.85 * inside[3:].size:
            return None
        grey = cv2.remap(image, columns, rows, cv2.INTER_LINEAR)
        level, _ = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
        bright = grey > level
        on = bright[:3].sum(axis=0)
        fit = (self._templates @ on + self._dark) / (3 * ANGLES)
        best = int(fit.max(axis=0).argmax())
        return Sight(x, y, best, float(fit[:, best].max()), float(bright[3:].mean()))


@dataclass(slots=True)
class _Track:
    number: int
    x: float
    y: float
    missed: int = 0
    votes: list[int] = field(default_factory=list)
    quality: list[float] = field(default_factory=list)


class MajorityTracks:
    """Nearest-neighbour tracks; each track claims the ID that most of its frames vote for."""

    GATE = 0.5  # disc radii from frame to frame
    PATIENCE = 5  # frames a track lives unseen

    def __init__(self, settings: Settings, radius_px: float) -> None:
        self._settings = settings
        self._gate = self.GATE * radius_px
        self._tracks: list[_Track] = []
        self._born = 0

    def step(self, sights: Iterable[Sight]) -> list[tuple[int, Sight, int, float, bool]]:
        """Per track seen in this frame: its number, sight, ID (index), score and claim."""
        s = self._settings
        free = list(self._tracks)
        told = []
        for track in free:
            track.missed += 1
        for sight in sights:
            gaps = [np.hypot(t.x - sight.x, t.y - sight.y) for t in free]
            if gaps and min(gaps) <= self._gate:
                track = free.pop(int(np.argmin(gaps)))
            else:
                track = _Track(self._born, sight.x, sight.y)
                self._born += 1
                self._tracks.append(track)
            track.x, track.y, track.missed = sight.x, sight.y, 0
            good = sight.similarity >= s.similarity and sight.ring >= s.ring
            track.votes = [*track.votes, sight.best if good else -1][-s.most :]
            track.quality = [*track.quality, sight.similarity * sight.ring][-s.most :]
            counts = Counter(v for v in track.votes if v >= 0)
            winner, votes = counts.most_common(1)[0] if counts else (sight.best, 0)
            score = votes / len(track.votes) * float(np.mean(track.quality))
            claim = votes >= s.least and votes > s.share * len(track.votes)
            told.append((track.number, sight, winner, score, claim))
        self._tracks = [t for t in self._tracks if t.missed <= self.PATIENCE]
        return told


def fan_of(folder: Path, image: np.ndarray) -> Fan:
    """The fan of a simulated fan log's images."""
    return fan_for_image(load_sonar(folder / "sonar.toml").complete("test"), *image.shape[:2])


def read_grey(path: Path) -> np.ndarray:
    """(rows, columns) uint8. Raises FileNotFoundError where there is no image."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise FileNotFoundError(path)
    return image
