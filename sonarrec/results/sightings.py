"""Sightings: one for each pass of a landmark, collected frame by frame, written and read."""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.landmarks import LandmarkSet
from sonarrec.passes import ended
from sonarrec.results.columns import SIGHTING_COLUMNS, Column, line_of, text_cell
from sonarrec.results.run_file import read_run
from sonarrec.sonar.frame import Estimate, Fan, follows
from sonarrec.sonar.geometry import PoseTable, ground_range
from sonarrec.sonar.stated import Sonar


@dataclass(frozen=True, slots=True)
class Sighting:
    """One pass: the declarations of a landmark by one track; a row of sightings.csv.

    What its fields mean: SIGHTING_COLUMNS. m, deg and ns; NaN if not known, and track None for a
    method that does not track objects.
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
    """One of several for a symmetric symbol."""
    range_sigma_m: float
    bearing_sigma_deg: float
    orientation_sigma_deg: float
    x_m: float
    y_m: float

    def line(self) -> str:
        """The line of sightings.csv; what is not known is empty."""
        values = {column.name: getattr(self, column.name) for column in SIGHTING_COLUMNS}
        return line_of(SIGHTING_COLUMNS, values | {"method": text_cell(self.method)})


def check_follows(method: str) -> None:
    """Raise UsageError if the method has no tracks."""
    if not follows(method):
        raise UsageError(f"--method {method}: it has no tracks, only candidates of single frames")


class _Pass:
    """A pass that has not ended."""

    def __init__(
        self, key: tuple[str, int, int | None], frame: int, timestamp_ns: int, period_deg: float
    ) -> None:
        """key: method, ID, track. period_deg: the rotation by which the symbol looks the same."""
        self._key, self._period_deg = key, period_deg
        self.first_frame, self._start_ns = frame, timestamp_ns
        self.last_frame, self._end_ns = -1, timestamp_ns
        self._frames, self._best = 0, 0.0
        self._first_orientation_deg = math.nan
        # By name, as in `add`: the sums of the known values, and how many these are.
        self._total = defaultdict[str, float](float)
        self._count = defaultdict[str, int](int)

    def add(
        self, frame: int, timestamp_ns: int, estimate: Estimate, position: tuple[float, float]
    ) -> None:
        """Add a declaration. position: (x, y) on the floor, m, NaN if not known."""
        self._frames += frame != self.last_frame
        self.last_frame, self._end_ns = frame, timestamp_ns
        self._best = max(self._best, estimate.score)
        if math.isnan(self._first_orientation_deg):
            self._first_orientation_deg = estimate.orientation_deg
        # Scaled so that rotations after which the symbol looks the same are equal.
        rotation = math.radians(estimate.orientation_deg * 360 / self._period_deg)
        values = {
            "score": estimate.score,
            "range_m": estimate.range_m,
            "bearing_deg": estimate.bearing_deg,
            "cos": math.cos(rotation),
            "sin": math.sin(rotation),
            "range_variance": estimate.range_sigma_m**2,
            "bearing_variance": estimate.bearing_sigma_deg**2,
            "orientation_variance": estimate.orientation_sigma_deg**2,
            "x_m": position[0],
            "y_m": position[1],
        }
        for name, value in values.items():
            if not math.isnan(value):
                self._total[name] += value
                self._count[name] += 1

    def _mean(self, name: str) -> float:
        """Of the known values; NaN if there is none."""
        return self._total[name] / self._count[name] if self._count[name] else math.nan

    def sighting(self) -> Sighting:
        """The pass as a row of sightings.csv."""
        mean, (method, landmark, track) = self._mean, self._key
        # Of equivalent directions the one nearest to the first orientation.
        direction = math.degrees(math.atan2(mean("sin"), mean("cos"))) * self._period_deg / 360
        first = self._first_orientation_deg
        orientation = (first + math.remainder(direction - first, self._period_deg)) % 360
        return Sighting(
            method=method,
            landmark=landmark,
            track=track,
            first_frame=self.first_frame,
            last_frame=self.last_frame,
            start_ns=self._start_ns,
            end_ns=self._end_ns,
            frames_declared=self._frames,
            mean_score=mean("score"),
            best_score=self._best,
            range_m=mean("range_m"),
            bearing_deg=mean("bearing_deg"),
            orientation_deg=orientation,
            range_sigma_m=math.sqrt(mean("range_variance")),
            bearing_sigma_deg=math.sqrt(mean("bearing_variance")),
            orientation_sigma_deg=math.sqrt(mean("orientation_variance")),
            x_m=mean("x_m"),
            y_m=mean("y_m"),
        )


class Sightings:
    """Collects the passes of all methods; only open passes are kept in memory."""

    def __init__(
        self, landmarks: LandmarkSet, fan: Fan | None = None, poses: PoseTable | None = None
    ) -> None:
        """fan, poses: needed for positions on the floor."""
        self._fan, self._poses = fan, poses
        self._period_deg = dict(zip(landmarks.ids, landmarks.periods_deg().tolist(), strict=True))
        self._open: dict[tuple[str, int, int | None], _Pass] = {}
        self._stretch = 0  # of the frame before

    def add(
        self, frame: int, timestamp_ns: int, estimates: Iterable[Estimate], stretch: int = 0
    ) -> list[Sighting]:
        """Add the next frame; returns the passes that ended before it, in order of their ends.

        stretch: as in Frame.
        """
        begins, self._stretch = stretch != self._stretch, stretch
        over = [k for k, p in self._open.items() if begins or ended(p.last_frame, frame)]
        passes = [self._open.pop(key) for key in over]
        for e in estimates:
            if not e.declared:
                continue
            key = e.method, e.landmark, e.object if e.followed else None
            if key not in self._open:
                period_deg = self._period_deg[e.landmark]
                self._open[key] = _Pass(key, frame, timestamp_ns, period_deg)
            self._open[key].add(frame, timestamp_ns, e, self._on_floor(timestamp_ns, e))
        return _in_order(passes)

    def _on_floor(self, timestamp_ns: int, e: Estimate) -> tuple[float, float]:
        """(x, y) in the frame of the poses, m; NaN if not known."""
        position = None
        if self._fan is not None and self._poses is not None:
            ground, bearing = float(ground_range(self._fan, e.range_m)), math.radians(e.bearing_deg)
            right, ahead = ground * math.sin(bearing), ground * math.cos(bearing)
            position = self._poses.position(timestamp_ns, right, ahead)
        return position or (math.nan, math.nan)

    def close_all(self) -> list[Sighting]:
        """End and return the open passes."""
        passes = [*self._open.values()]
        self._open.clear()
        return _in_order(passes)


def _in_order(passes: Iterable[_Pass]) -> list[Sighting]:
    return [p.sighting() for p in sorted(passes, key=lambda p: (p.last_frame, p.first_frame))]


def read_sightings(
    folder: Path, landmarks: str | None = None, sonar: Sonar | None = None
) -> Iterator[Sighting]:
    """The passes in one log's results, in order of their ends.

    They are read from sightings.csv if the results are finished, else computed from frames.csv and
    estimates.csv, without positions on the floor.
    landmarks, sonar: as in `read.read_log`. Raises SonarrecError if a file cannot be used.
    """
    run, path = read_run(folder / "run.toml"), folder / "sightings.csv"
    if run.finished and path.is_file():
        return sightings_in(path)
    from sonarrec.results.read import declared_by_frame  # imports pandas, which no run needs

    sightings, ended = Sightings(run.landmark_set(landmarks)), list[Sighting]()
    for frame, timestamp_ns, stretch, estimates in declared_by_frame(folder, landmarks, sonar):
        ended += sightings.add(frame, timestamp_ns, estimates, stretch)
    return iter(ended + sightings.close_all())


def sightings_in(path: Path) -> Iterator[Sighting]:
    """The rows of a sightings.csv. Raises SonarrecError, with the line, for an invalid row."""
    line = 1
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for row in csv.DictReader(file):
                line += 1
                yield Sighting(**{c.name: _value(c, row[c.name]) for c in SIGHTING_COLUMNS})
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
    except KeyError as error:
        raise SonarrecError(f"{path}: wrong columns, no {error.args[0]}") from None
    except (csv.Error, TypeError, ValueError) as error:
        raise SonarrecError(f"{path} line {line}: no sighting ({error})") from None


def _value(column: Column, text: str) -> Any:
    """The value of a cell. Raises ValueError if it is invalid."""
    if column.form == "%s":
        return text
    if column.form == "%d":
        return None if column.name == "track" and not text else int(text)
    return float(text or "nan")
