"""Sightings: one for each pass of a landmark, collected frame by frame, written and read."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.geometry import PoseTable, ground_range
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Estimate, Fan, follows
from sonarrec.results.columns import text_cell
from sonarrec.results.run_file import RunFile, read_run
from sonarrec.sonar import Sonar

PASS_GAP = 10
"""A pass ends after so many frames without a declaration."""
ROWS = 20_000
"""Rows of estimates.csv that are read at a time."""


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

    def line(self) -> str:
        """The line of sightings.csv, by SIGHTING_COLUMNS."""
        cells = [text_cell(self.method)]
        for name in SIGHTING_COLUMNS[1:]:
            value = getattr(self, name)
            known = value is not None and not math.isnan(value)
            cells.append(f"{value:.{_DIGITS.get(name, 0)}f}" if known else "")
        return ",".join(cells) + "\n"


SIGHTING_COLUMNS = tuple(f.name for f in fields(Sighting))
_DIGITS = {
    **{"mean_score": 6, "best_score": 6},
    **{"range_m": 4, "bearing_deg": 3, "orientation_deg": 1},
    **{"range_sigma_m": 4, "bearing_sigma_deg": 3, "orientation_sigma_deg": 1},
    **{"x_m": 4, "y_m": 4},
}
"""After the decimal point in sightings.csv; the other columns are names and whole numbers."""


def _value(name: str, text: str) -> object:
    """The value of a cell of sightings.csv. Raises ValueError if the cell is invalid."""
    if name == "method":
        return text
    if name == "track" and not text:
        return None
    if name in _DIGITS:
        return float(text) if text or name.endswith("score") else math.nan
    return int(text)


def check_follows(method: str) -> None:
    """Raise UsageError if the method has no tracks."""
    if not follows(method):
        raise UsageError(f"--method {method}: it has no tracks, only candidates of single frames")


@dataclass(slots=True)
class _Pass:
    """A pass that has not ended; fields as in `Sighting`.

    period_deg: the rotation after which the symbol looks the same. first_orientation_deg: the first
    known one. total, count: sums over the known values, and how many these are, in the order of
    `add`.
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
    first_orientation_deg: float = math.nan
    total: list[float] = field(default_factory=lambda: [0.0] * 10)
    count: list[int] = field(default_factory=lambda: [0] * 10)

    def add(
        self, frame: int, timestamp_ns: int, estimate: Estimate, position: tuple[float, float]
    ) -> None:
        """Add a declaration. position: (x, y) on the floor, m, NaN if not known."""
        self.frames_declared += frame != self.last_frame
        self.last_frame, self.end_ns = frame, timestamp_ns
        self.best_score = max(self.best_score, estimate.score)
        if math.isnan(self.first_orientation_deg):
            self.first_orientation_deg = estimate.orientation_deg
        # Scaled so that rotations after which the symbol looks the same are equal.
        rotation = math.radians(estimate.orientation_deg * 360 / self.period_deg)
        values = (
            *(estimate.score, estimate.range_m, estimate.bearing_deg),
            *(math.cos(rotation), math.sin(rotation)),
            *(estimate.range_sigma_m**2, estimate.bearing_sigma_deg**2),
            *(estimate.orientation_sigma_deg**2, *position),
        )
        for k, value in enumerate(values):
            if not math.isnan(value):
                self.total[k] += value
                self.count[k] += 1

    def as_sighting(self) -> Sighting:
        """The pass as a row of sightings.csv."""
        means = [a / n if n else math.nan for a, n in zip(self.total, self.count, strict=True)]
        score, range_m, bearing, cos, sin, *squares, x, y = means
        # Of equivalent directions the one nearest to the first orientation.
        mean = math.degrees(math.atan2(sin, cos)) * self.period_deg / 360
        first = self.first_orientation_deg
        orientation = (first + math.remainder(mean - first, self.period_deg)) % 360
        return Sighting(
            *(self.method, self.landmark, self.track, self.first_frame, self.last_frame),
            *(self.start_ns, self.end_ns, self.frames_declared, score, self.best_score),
            *(range_m, bearing, orientation, *map(math.sqrt, squares), x, y),
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

    def add(self, frame: int, timestamp_ns: int, estimates: Iterable[Estimate]) -> list[Sighting]:
        """Add the next frame; returns the passes that ended before it, in order of their ends."""
        ended = {k: p for k, p in self._open.items() if frame - p.last_frame > PASS_GAP}
        for key in ended:
            del self._open[key]
        for e in estimates:
            if not e.declared:
                continue
            key = e.method, e.landmark, e.object if e.followed else None
            if key not in self._open:
                self._open[key] = _Pass(*key, frame, timestamp_ns, self._period_deg[e.landmark])
            position = None  # on the floor, in the frame of the poses
            if self._fan is not None and self._poses is not None:
                ground, bearing = (
                    float(ground_range(self._fan, e.range_m)),
                    math.radians(e.bearing_deg),
                )
                right, ahead = ground * math.sin(bearing), ground * math.cos(bearing)
                position = self._poses.place(timestamp_ns, right, ahead)
            self._open[key].add(frame, timestamp_ns, e, position or (math.nan, math.nan))
        return _in_order(ended.values())

    def close_all(self) -> list[Sighting]:
        """End and return the open passes."""
        ended = [*self._open.values()]
        self._open.clear()
        return _in_order(ended)


def _in_order(passes: Iterable[_Pass]) -> list[Sighting]:
    return [p.as_sighting() for p in sorted(passes, key=lambda p: (p.last_frame, p.first_frame))]


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
    return iter(_compute_sightings(folder, run, landmarks, sonar))


def sightings_in(path: Path) -> Iterator[Sighting]:
    """The rows of a sightings.csv. Raises SonarrecError, with the line, for an invalid row."""
    line = 1
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for row in csv.DictReader(file):
                line += 1
                values: dict[str, Any] = {n: _value(n, row[n]) for n in SIGHTING_COLUMNS}
                yield Sighting(**values)
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
    except KeyError as error:
        raise SonarrecError(f"{path}: wrong columns, no {error.args[0]}") from None
    except (csv.Error, TypeError, ValueError) as error:
        raise SonarrecError(f"{path} line {line}: no sighting ({error})") from None


def _compute_sightings(
    folder: Path, run: RunFile, landmarks: str | None, sonar: Sonar | None
) -> list[Sighting]:
    # They import pandas, which a run does not need.
    from sonarrec.results.read import estimate_tables, read_frames
    from sonarrec.results.stream import estimates_in

    frames = read_frames(folder)
    times = frames.get("timestamp_ns", np.zeros(len(frames["frame"]), dtype=np.int64))
    time_of = dict(zip(frames["frame"].tolist(), times.tolist(), strict=True))
    landmark_set, fan = run.landmark_set(landmarks), run.fan(sonar)

    def declared() -> Iterator[tuple[int, Estimate]]:
        for _, table in estimate_tables(folder / "estimates.csv", landmark_set, ROWS):
            rows = np.flatnonzero(table["declared"])
            for _, frame, estimate in estimates_in(table, rows, landmark_set, fan):
                if frame in time_of:
                    yield frame, estimate

    sightings = _passes(Sightings(landmark_set), declared(), time_of)
    if sightings is None:  # a table of another program, which must be sorted in memory
        sightings = _passes(Sightings(landmark_set), sorted(declared(), key=itemgetter(0)), time_of)
    return sightings or []


def _passes(
    gathered: Sightings, declared: Iterable[tuple[int, Estimate]], time_of: Mapping[int, int]
) -> list[Sighting] | None:
    """The passes of (frame, estimate) pairs; None if the frames are not in order."""
    sightings, last = list[Sighting](), -1
    for frame, group in groupby(declared, key=itemgetter(0)):
        if frame < last:
            return None
        sightings += gathered.add(frame, time_of[frame], (e for _, e in group))
        last = frame
    return [*sightings, *gathered.close_all()]
