"""Reads the sightings of a log's results from sightings.csv, or computes them from the tables."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.errors import SonarrecError
from sonarrec.nouns import Estimate
from sonarrec.results.columns import SIGHTING_COLUMNS
from sonarrec.results.folders import estimates_of
from sonarrec.results.run_file import RunFile, read_run
from sonarrec.results.sightings import Sighting, Sightings
from sonarrec.sonar import Sonar

ROWS = 20_000
"""Rows of estimates.csv that are read at a time."""


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
    return _compute_sightings(folder, run, landmarks, sonar)


def sightings_in(path: Path) -> Iterator[Sighting]:
    """The rows of a sightings.csv. Raises SonarrecError, with the line, for an invalid row."""
    line = 1
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for row in csv.DictReader(file):
                line += 1
                values: dict[str, Any] = {c.name: c.value(row[c.name]) for c in SIGHTING_COLUMNS}
                yield Sighting(**values)
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
    except KeyError as error:
        raise SonarrecError(f"{path}: wrong columns, no {error.args[0]}") from None
    except (csv.Error, TypeError, ValueError) as error:
        raise SonarrecError(f"{path} line {line}: no sighting ({error})") from None


def _compute_sightings(
    folder: Path, run: RunFile, landmarks: str | None, sonar: Sonar | None
) -> Iterator[Sighting]:
    from sonarrec.results.read import read_frames  # imports pandas, which a run does not need

    frames = read_frames(folder)
    times = frames.get("timestamp_ns", np.zeros(len(frames["frame"]), dtype=np.int64))
    time_of = dict(zip(frames["frame"].tolist(), times.tolist(), strict=True))
    landmark_set = run.landmark_set(landmarks)

    def declared() -> Iterator[tuple[int, Estimate]]:
        return (e for e in _declared_estimates(folder, run, landmarks, sonar) if e[0] in time_of)

    sightings = _passes(Sightings(landmark_set), declared(), time_of)
    if sightings is None:  # a table of another program, which must be sorted in memory
        sightings = _passes(Sightings(landmark_set), sorted(declared(), key=itemgetter(0)), time_of)
    return iter(sightings or ())


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


def _declared_estimates(
    folder: Path, run: RunFile, landmarks: str | None, sonar: Sonar | None
) -> Iterator[tuple[int, Estimate]]:
    """(frame, estimate) of every declared row of estimates.csv."""
    from sonarrec.results.read import estimate_tables  # imports pandas, as above
    from sonarrec.results.stream import estimates_in

    landmark_set, fan = run.landmark_set(landmarks), run.fan(sonar)
    for _, table in estimate_tables(estimates_of(folder), landmark_set, ROWS):
        declared = np.flatnonzero(table["declared"])
        yield from ((frame, e) for _, frame, e in estimates_in(table, declared, landmark_set, fan))
