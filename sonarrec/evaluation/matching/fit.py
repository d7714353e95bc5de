"""Whether a truth can be that of a log, and what of either could not be used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.records import SonarrecError
from sonarrec.results.read import LogResults, not_whole
from sonarrec.truth.fits import misfit, outside_image, pixels_elsewhere, without_rows
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
class Checked:
    """What is said of a log and its truth, without their rows."""

    name: str
    """Of the log."""
    table: Path
    """Of the truth."""
    table_rows: int
    rows: int
    """Those that speak of the log."""
    unprocessed: int
    """Those of them on frames that were not processed."""
    frames: int
    fault: str | None
    """Why the truth cannot be that of the log; None where it can."""
    notes: list[str]
    not_whole: list[str]
    """As `not_whole` of the results."""


@dataclass(frozen=True, slots=True)
class Fit:
    """Which of several can be scored, by index, and what is said of the others and of these."""

    usable: list[int]
    notes: list[str]
    unused: list[str]


def matched(folder: Path, table: TruthTable, log: LogResults, tolerance_s: float | None) -> Matched:
    """As `truth.match.match_truth`."""
    return Matched(folder, log, table, match_truth(table, log, tolerance_s))


def checked(case: Matched) -> Checked:
    """Whether a truth can be that of a log."""
    return Checked(
        name=case.log.name,
        table=case.table.path,
        table_rows=len(case.table.at),
        rows=case.truth.rows,
        unprocessed=case.truth.unprocessed,
        frames=len(case.log.frame),
        fault=misfit(case.table, case.log, case.truth),
        notes=_notes(case),
        not_whole=not_whole(case.log, "scored"),
    )


def fit(cases: Sequence[Checked], some: bool = False) -> Fit:
    """Leave out the logs whose truth cannot be theirs. Raises SonarrecError where none is left, or
    where no truth has a row, unless these are some of more logs."""
    if not some and not any(case.rows for case in cases):
        of = next((case for case in cases if case.table_rows), cases[0])
        names = [case.name for case in cases]
        raise SonarrecError(without_rows(of.table, of.table_rows, names, "nothing is scored"))
    found = Fit([i for i, case in enumerate(cases) if case.fault is None], [], [])
    told = [case.fault for case in cases if case.fault is not None]
    # A log without a row counts as empty beside others; by itself it says nothing.
    if told and not any(cases[i].rows for i in found.usable):
        raise SonarrecError(told[0])
    found.unused.extend(f"{case.fault}; {case.name} is not scored" for case in cases if case.fault)
    for i in found.usable:
        found.notes.extend(cases[i].notes)
    return found


def _notes(case: Matched) -> list[str]:
    """What is worth knowing of a truth before its log is scored by it, a line each."""
    table, log = case.table, case.log
    notes = []
    if table.not_read:
        notes.append(f"{table.path}: columns {', '.join(table.not_read)} are not read")
    rows = table.rows_of(log.name)
    proposed = np.count_nonzero(table.proposed[rows])
    if proposed:
        notes.append(
            f"{table.path}: by `source`, {proposed} of {len(rows)} rows for {log.name} are as "
            "`truth propose` wrote them; they say nothing about the results they came from. Empty "
            "`source` in the rows that a person has checked"
        )
    outside = int(np.count_nonzero(outside_image(case.log, case.truth)))
    if outside:
        notes.append(
            f"{table.path}: {outside} of {len(case.truth.frame_index)} positions lie outside the "
            f"image of {log.name}; `sonarrec truth check` names them"
        )
    return notes + pixels_elsewhere(table, log, "are scored")


def left_out(cases: Sequence[Checked]) -> list[str]:
    """One line per part of the input that was left out of what can be scored.

    cases: all of one truth.
    """
    if not cases:
        return []
    said = []
    lost = sum(case.unprocessed for case in cases)
    if lost:
        frames = sum(case.frames for case in cases)
        said.append(
            f"{cases[0].table}: {lost} of {cases[0].table_rows} rows lie on frames that were not "
            f"processed; they are not scored (the {frames} frames processed are)"
        )
    for case in cases:
        said += case.not_whole
    return said


def of_other_logs(table: TruthTable, logs: Sequence[str]) -> list[str]:
    """A line on the rows of logs that are not there, where there are any. logs: those there are."""
    if table.log is None:
        return []
    others = np.asarray(table.log)[~np.isin(table.log, logs)]
    if not len(others):
        return []
    names = sorted(set(map(str, others)))
    told = ", ".join(names[:5]) + f" and {len(names) - 5} more" * (len(names) > 5)
    return [
        f"{table.path}: {len(others)} of {len(table.at)} rows name logs that are not there "
        f"({told}); they are not scored"
    ]
