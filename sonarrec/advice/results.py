"""What may be wrong with the results of a log that is scored, and with its truth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from sonarrec.advice.readings import of_claims
from sonarrec.advice.truth import of_positions, of_truth, unread_columns
from sonarrec.errors import Advice, SonarrecError, command_line
from sonarrec.evaluation.evaluate import LogTables, LogToScore
from sonarrec.evaluation.rows import ScoringOptions, match
from sonarrec.results.folders import rerun_left
from sonarrec.results.read import LogResults
from sonarrec.runs.recorded import recorded_at
from sonarrec.sonar.frame import Clock
from sonarrec.sonar.stated import Sonar
from sonarrec.stretches import Breaks


def of_results(log: LogToScore, tables: LogTables, options: ScoringOptions) -> Iterator[Advice]:
    """On the results of one log, its only ones or old and new, and its truth."""
    table, results, truth = tables.truth, tables.results[-1], tables.truths[-1]
    matched = tables.matched[-1]
    if options.labelled_only:  # the others are asked as well
        matched = match(results, truth, options, matched.ids)
    yield from of_truth(table, results, truth, options.min_visible)
    yield from of_claims(table, results, matched, options)
    if unread := unread_columns(table):
        yield Advice(unread, grave=True)
    check = _check_of(table.path, results, options)
    yield from of_positions(table, results, truth, check, options.min_visible)
    yield from (Advice(line) for folder in log.results for line in rerun_left(folder))
    yield from _of_clock(results)


def _check_of(truth: Path, log: LogResults, options: ScoringOptions) -> str:
    """The command that checks the truth of the log that results were made from, as they read it;
    empty if the log is not there, or read in another geometry."""
    run = log.run
    if options.sonar not in (None, Sonar()):
        return ""
    with suppress(SonarrecError):
        recording = recorded_at(run.path.parent, run.input).path
        words: list[object] = ["truth", "check", truth, recording]
        words += ["--sonar", run.path, "--landmarks", options.landmarks or run.path]
        time = None if run.input.time == "log" else run.input.time
        for name, value in (("--topic", run.input.topic), ("--time", time)):
            words += [] if value is None else [name, value]
        return command_line(*words)
    return ""


def _of_clock(log: LogResults) -> Iterator[Advice]:
    """Whether the clock was set while the log was recorded."""
    if log.timestamp_ns is not None:
        breaks, clock = Breaks(), log.run.input.time
        for row in zip(log.frame.tolist(), log.timestamp_ns.tolist(), strict=True):
            breaks.add(*row)
        others: dict[Clock | None, Clock] = {"log": "header", "header": "log", "publish": "header"}
        for line in breaks.set_clock(others.get(clock) if log.run.input.topic else None):
            yield Advice(f"{log.name}: {line}")
