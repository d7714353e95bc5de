"""Sightings: one for each pass of a landmark, collected frame by frame."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

from sonarrec.errors import UsageError
from sonarrec.geometry import ground_range
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Estimate, Fan, follows
from sonarrec.poses import PoseTable

PASS_GAP = 10
"""A pass ends after so many frames without a declaration."""


@dataclass(frozen=True, slots=True)
class Sighting:
    """One pass: the declarations of a landmark by one track; a row of sightings.csv.

    method: name. landmark: ID. track: None for a method that does not track objects. first_frame,
    last_frame: numbers in the log of the first and the last declaration; start_ns, end_ns: their
    times. frames_declared: how many frames have a declaration. mean_score, best_score: over the
    declarations, 0 to 1. range_m: mean slant range. bearing_deg: mean, positive to the right.
    orientation_deg: mean direction, 0 to 360; one of several for a symmetric symbol.
    range_sigma_m, bearing_sigma_deg, orientation_sigma_deg: standard error of one frame's estimate,
    root mean square over the declarations. x_m, y_m: mean position on the floor in the frame of the
    poses. NaN if not known.
    """

    method: str
    landmark: int
    track: int | None
    first_frame: int
    last_frame: int
    start_ns: int
    end_ns: int
    frames_declared: int
    mean_score: float
    best_score: float
    range_m: float
    bearing_deg: float
    orientation_deg: float
    range_sigma_m: float
    bearing_sigma_deg: float
    orientation_sigma_deg: float
    x_m: float
    y_m: float


def check_follows(method: str) -> None:
    """Raise UsageError if the method has no tracks."""
    if not follows(method):
        raise UsageError(f"--method {method}: it has no tracks, only candidates of single frames")


@dataclass(slots=True)
class _Mean:
    """The mean of the known values."""

    total: float = 0.0
    count: int = 0

    def add(self, value: float) -> None:
        if not math.isnan(value):
            self.total += value
            self.count += 1

    def value(self) -> float:
        return self.total / self.count if self.count else math.nan


@dataclass(slots=True)
class _Pass:
    """A pass that has not ended; fields as in `Sighting`.

    period_deg: the rotation after which the symbol looks the same. first_turn_deg: the first known
    orientation. means: the means by name.
    """

    method: str
    landmark: int
    track: int | None
    first_frame: int
    start_ns: int
    period_deg: float
    last_frame: int = -1
    end_ns: int = 0
    frames_declared: int = 0
    best_score: float = 0.0
    first_turn_deg: float = math.nan
    means: dict[str, _Mean] = field(default_factory=lambda: defaultdict(_Mean))

    def add(
        self, frame: int, timestamp_ns: int, estimate: Estimate, place: tuple[float, float]
    ) -> None:
        """Add a declaration. place: (x, y) on the floor, m, NaN if not known."""
        self.frames_declared += frame != self.last_frame
        self.last_frame, self.end_ns = frame, timestamp_ns
        self.best_score = max(self.best_score, estimate.score)
        if math.isnan(self.first_turn_deg):
            self.first_turn_deg = estimate.orientation_deg
        # Scaled so that rotations after which the symbol looks the same are equal.
        turn = math.radians(estimate.orientation_deg * 360 / self.period_deg)
        for name, value in (
            ("score", estimate.score),
            ("range", estimate.range_m),
            ("bearing", estimate.bearing_deg),
            ("cos", math.cos(turn)),
            ("sin", math.sin(turn)),
            ("range_sigma", estimate.range_sigma_m**2),
            ("bearing_sigma", estimate.bearing_sigma_deg**2),
            ("orientation_sigma", estimate.orientation_sigma_deg**2),
            ("x", place[0]),
            ("y", place[1]),
        ):
            self.means[name].add(value)

    def as_sighting(self) -> Sighting:
        """The pass as a row of sightings.csv."""
        mean = {name: mean.value() for name, mean in self.means.items()}
        return Sighting(
            method=self.method,
            landmark=self.landmark,
            track=self.track,
            first_frame=self.first_frame,
            last_frame=self.last_frame,
            start_ns=self.start_ns,
            end_ns=self.end_ns,
            frames_declared=self.frames_declared,
            mean_score=mean["score"],
            best_score=self.best_score,
            range_m=mean["range"],
            bearing_deg=mean["bearing"],
            orientation_deg=self._turn_deg(mean["cos"], mean["sin"]),
            range_sigma_m=math.sqrt(mean["range_sigma"]),
            bearing_sigma_deg=math.sqrt(mean["bearing_sigma"]),
            orientation_sigma_deg=math.sqrt(mean["orientation_sigma"]),
            x_m=mean["x"],
            y_m=mean["y"],
        )

    def _turn_deg(self, cos: float, sin: float) -> float:
        """The mean direction; of equivalent ones that nearest to the first orientation."""
        turn = math.degrees(math.atan2(sin, cos)) * self.period_deg / 360
        return (
            self.first_turn_deg + math.remainder(turn - self.first_turn_deg, self.period_deg)
        ) % 360


class Sightings:
    """Collects the passes of all methods; only open passes are kept in memory."""

    def __init__(
        self, landmarks: LandmarkSet, fan: Fan | None = None, poses: PoseTable | None = None
    ) -> None:
        """fan, poses: needed for positions on the floor."""
        self._fan, self._poses = fan, poses
        self._period_deg = dict(zip(landmarks.ids, landmarks.periods_deg().tolist(), strict=True))
        self._open: dict[tuple[str, int, int | None], _Pass] = {}

    def add(self, frame: int, timestamp_ns: int, estimates: Iterable[Estimate]) -> list[Sighting]:
        """Add the next frame; returns the passes that ended before it, in order of their ends."""
        ended = [p for p in self._open.values() if frame - p.last_frame > PASS_GAP]
        for pass_ in ended:
            del self._open[pass_.method, pass_.landmark, pass_.track]
        for e in estimates:
            if not e.declared:
                continue
            track = e.object if e.followed else None
            key = e.method, e.landmark, track
            if key not in self._open:
                self._open[key] = _Pass(*key, frame, timestamp_ns, self._period_deg[e.landmark])
            self._open[key].add(frame, timestamp_ns, e, self._place(timestamp_ns, e))
        return _in_order(ended)

    def close_all(self) -> list[Sighting]:
        """End and return the open passes."""
        ended = [*self._open.values()]
        self._open.clear()
        return _in_order(ended)

    def _place(self, timestamp_ns: int, estimate: Estimate) -> tuple[float, float]:
        """(x, y) on the floor in the frame of the poses, m; NaN if not known."""
        place = None
        if self._fan is not None and self._poses is not None:
            away = float(ground_range(self._fan, estimate.range_m))
            bearing = math.radians(estimate.bearing_deg)
            place = self._poses.place(
                timestamp_ns, away * math.sin(bearing), away * math.cos(bearing)
            )
        return place or (math.nan, math.nan)


def _in_order(passes: list[_Pass]) -> list[Sighting]:
    return [p.as_sighting() for p in sorted(passes, key=lambda p: (p.last_frame, p.first_frame))]
