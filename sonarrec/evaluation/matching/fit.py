"""Checks that a truth fits a log, and lists the parts of both that cannot be used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sonarrec.errors import SonarrecError, number_of
from sonarrec.results.read import LogResults, not_whole
from sonarrec.truth.fits import misfit, notes_on_fit, without_rows
from sonarrec.truth.match import Truth
from sonarrec.truth.table import TruthTable


@dataclass(frozen=True, slots=True)
class MatchedLog:
    """One log's results and its truth."""

    log: LogResults
    table: TruthTable
    truth: Truth


@dataclass(frozen=True, slots=True)
class TruthCheck:
    """How a truth fits a log, without the rows of either."""

    name: str
    """Name of the log."""
    table: Path
    """File of the truth."""
    table_rows: int
    """Rows in the file."""
    rows: int
    """Rows about this log."""
    unprocessed: int
    """Rows about it on frames that were not processed."""
    between: int
    """Rows about it between frames."""
    frames: int
    fault: str | None
    """Why the truth does not fit the log; None if it does."""
    notes: list[str]
    not_whole: list[str]
    """As `results.read.not_whole`."""


@dataclass(frozen=True, slots=True)
class ScorableLogs:
    """The logs that can be scored, by index, notes on them, and a line for each other log."""

    usable: list[int]
    notes: list[str]
    unused: list[str]


def check_fit(case: MatchedLog) -> TruthCheck:
    """Check that the truth fits the log."""
    return TruthCheck(
        name=case.log.name,
        table=case.table.path,
        table_rows=len(case.table.at),
        rows=case.truth.rows,
        unprocessed=case.truth.unprocessed,
        between=case.truth.between,
        frames=len(case.log.frame),
        fault=misfit(case.table, case.log, case.truth),
        notes=notes_on_fit(
            case.table,
            case.log,
            case.truth,
            "are scored",
            "they say nothing about the results that they came from",
        ),
        not_whole=not_whole(case.log, "scored"),
    )


def scorable_logs(cases: Sequence[TruthCheck], subset: bool = False) -> ScorableLogs:
    """The logs whose truth fits.

    Raises SonarrecError if there is none, or if no truth has a row. subset: as in `evaluate_whole`.
    """
    if not subset and not any(case.rows for case in cases):
        of = next((case for case in cases if case.table_rows), cases[0])
        names = [case.name for case in cases]
        raise SonarrecError(without_rows(of.table, of.table_rows, names, "nothing is scored"))
    scorable = ScorableLogs([i for i, case in enumerate(cases) if case.fault is None], [], [])
    faults = [case.fault for case in cases if case.fault is not None]
    # A log without a row counts as empty, but only if others have rows.
    if faults and not any(cases[i].rows for i in scorable.usable):
        raise SonarrecError(faults[0])
    scorable.unused.extend(
        f"{case.fault}; {case.name} is not scored" for case in cases if case.fault
    )
    for i in scorable.usable:
        scorable.notes.extend(cases[i].notes)
    return scorable


def left_out(cases: Sequence[TruthCheck]) -> list[str]:
    """A line for each part of the input that is not scored. cases: logs of one truth."""
    if not cases:
        return []
    lines = []
    unprocessed = sum(case.unprocessed for case in cases)
    if unprocessed:
        frames = sum(case.frames for case in cases)
        lines.append(
            f"{cases[0].table}: {unprocessed} of {cases[0].table_rows} rows lie on frames that "
            f"were not processed; they are not scored ({number_of(frames, 'frame')} processed)"
        )
    for case in cases:
        lines += case.not_whole
    return lines
