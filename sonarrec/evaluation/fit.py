"""Whether a truth can be that of a log, and what of either could not be used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.geometry import polar_from_plane
from sonarrec.records import BoolArray, SonarrecError
from sonarrec.results.read import LogResults
from sonarrec.truth.in_view import share_in_fan
from sonarrec.truth.match import Truth, match_truth
from sonarrec.truth.table import TruthTable


@dataclass(frozen=True, slots=True)
class Matched:
    """One log's results and what a truth says of it."""

    folder: Path
    """Of the results."""
    log: LogResults
    table: TruthTable
    truth: Truth


@dataclass(frozen=True, slots=True)
class Fit:
    """Those of several that can be scored, and what is said of the others and of these."""

    usable: list[Matched]
    notes: list[str]
    unused: list[str]


def matched(folder: Path, table: TruthTable, log: LogResults, tolerance_s: float | None) -> Matched:
    """As `truth.match.match_truth`."""
    return Matched(folder, log, table, match_truth(table, log, tolerance_s))


def fit(cases: Sequence[Matched]) -> Fit:
    """Leave out the logs whose truth cannot be theirs. Raises SonarrecError where none is left, or
    where no truth has a row."""
    if not any(case.truth.rows for case in cases):
        _refuse_without_rows(cases)
    faults = [(case, _fault(case)) for case in cases]
    found = Fit([case for case, fault in faults if fault is None], [], [])
    told = [fault for _, fault in faults if fault is not None]
    # A log without a row counts as empty beside others; by itself it says nothing.
    if told and not any(case.truth.rows for case in found.usable):
        raise SonarrecError(told[0])
    found.unused.extend(
        f"{fault}; {case.log.name} is not scored" for case, fault in faults if fault
    )
    for case in found.usable:
        found.notes.extend(_notes(case))
    return found


def _refuse_without_rows(cases: Sequence[Matched]) -> None:
    with_rows = next((case.table for case in cases if len(case.table.at)), None)
    if with_rows is not None:
        names = ", ".join(case.log.name for case in cases)
        raise SonarrecError(f"{with_rows.path}: its log column names none of {names}")
    raise SonarrecError(
        f"{cases[0].table.path}: it has no row, so nothing is scored; a truth has a row per "
        "landmark in view (sonarrec help truth)"
    )


def _fault(case: Matched) -> str | None:
    """Why the truth cannot be that of the log; None where it can."""
    table, log, truth = case.table, case.log, case.truth
    if truth.rows and not len(truth.frame_index):
        at = table.at if table.log is None else table.at[np.asarray(table.log == log.name)]
        return (
            f"{table.path}: none of its {truth.rows} rows ({table.key} {at.min()} to {at.max()}) "
            f"lies on a processed frame of {log.name} ({len(log.frame)} frames, {log.frame[0]} to "
            f"{log.frame[-1]}); is this the truth of another log?"
        )
    outside = _outside(case)
    if len(outside) and outside.all():
        assert log.fan is not None
        assert truth.position is not None
        range_m, bearing_deg = (values[0] for values in polar_from_plane(truth.position))
        return (
            f"{table.path}: none of its {len(outside)} positions lies in the image of {log.name} "
            f"({log.fan.range_min_m:g} to {log.fan.range_max_m:g} m, {log.fan.bearing_min_deg:g} "
            f"to {log.fan.bearing_max_deg:g} deg), the first at {range_m:.4g} m and "
            f"{bearing_deg:.4g} deg; are these the units, and is this the log?"
        )
    return None


def _notes(case: Matched) -> list[str]:
    table, log = case.table, case.log
    notes = []
    if table.not_read:
        notes.append(f"{table.path}: columns {', '.join(table.not_read)} are not read")
    outside = int(np.count_nonzero(_outside(case)))
    if outside:
        notes.append(
            f"{table.path}: {outside} of {len(case.truth.frame_index)} positions lie outside the "
            f"image of {log.name}; `sonarrec truth check` names them"
        )
    return notes


def _outside(case: Matched) -> BoolArray:
    """(T,) which discs lie wholly outside the fan; none where positions or the fan are unknown."""
    fan, truth = case.log.fan, case.truth
    if fan is None or truth.position is None:
        return np.zeros(0, dtype=bool)
    radius = case.log.landmarks.radius_m
    range_m, bearing_deg = polar_from_plane(truth.position)
    aside = bearing_deg - np.clip(bearing_deg, fan.bearing_min_deg, fan.bearing_max_deg)
    outside = np.asarray(
        (range_m < fan.range_min_m - radius)
        | (range_m > fan.range_max_m + radius)
        | (np.radians(np.abs(aside)) * range_m > radius)
    )
    # Exactly, on the floor, of those alone: it takes long.
    share = share_in_fan(fan, range_m[outside], bearing_deg[outside], radius)
    outside[outside] = share == 0
    return outside


def left_out(cases: Sequence[Matched], elsewhere: int = 0) -> list[str]:
    """One line per part of the input that was left out of what can be scored.

    cases: all of one truth. elsewhere: its rows of logs that are not there.
    """
    if not cases:
        return []
    said = []
    table = cases[0].table
    lost = sum(case.truth.unprocessed for case in cases) + elsewhere
    if lost:
        frames = sum(len(case.log.frame) for case in cases)
        said.append(
            f"{table.path}: {lost} of {len(table.at)} rows lie on frames that were not processed; "
            f"they are not scored (the {frames} frames processed are)"
        )
    for case in cases:
        said += cut_short(case.log)
    return said


def cut_short(log: LogResults) -> list[str]:
    """One line per part of the results that cannot be used."""
    said = []
    if not log.finished:
        said.append(
            f"{log.name}: the run was cut short (run.toml says finished = false); "
            f"only its {len(log.frame)} frames are scored"
        )
    if log.strays:
        said.append(
            f"{log.name}: {log.strays} estimates lie on frames that frames.csv does not list; "
            "they are not scored"
        )
    return said
