"""Scores results against truth: one folder, several, or a table of pairs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.errors import SonarrecError, printable
from sonarrec.evaluation.counting.parts import part_of, score_all
from sonarrec.evaluation.counting.pooled import Parts, Pooled, pool
from sonarrec.evaluation.counting.scoring import Scored
from sonarrec.evaluation.matching.fit import TruthCheck, left_out, scorable_logs
from sonarrec.evaluation.matching.joined import Joined, join
from sonarrec.evaluation.matching.options import ScoringOptions
from sonarrec.evaluation.matching.pairs import (
    FindBeside,
    Pair,
    find_truths_beside,
    truth_note,
    usable_pairs,
)
from sonarrec.evaluation.survey import LogToScore, SurveyedLog, UnreadableLog, map_logs, survey
from sonarrec.results.read import find_logs, read_frames
from sonarrec.results.same_log import counted_once
from sonarrec.truth.fits import of_other_logs, rows_on_frames
from sonarrec.truth.table import TruthTable, read_truth

DEFAULT = ScoringOptions()


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The result of `evaluate_whole`, with all frames and claims."""

    joined: Joined
    folders: tuple[Path, ...]
    """The results folder of each log of `joined`, as given."""
    scored: tuple[Scored, ...]
    """Every method under every protocol."""
    min_visible: float
    notes: tuple[str, ...]
    unused: tuple[str, ...]
    """Input that could not be used, one line each."""

    def pooled(self) -> Pooled:
        """The same as counts, without frames and claims."""
        parts = Parts()
        number = parts.put(part_of(self.joined, self.scored))
        result = pool(parts, [number], self.joined.logs, self.min_visible)
        return replace(result, folders=self.folders, notes=self.notes, unused=self.unused)


def evaluate_whole(
    results: str | Path | Sequence[Pair],
    ground_truth: str | Path | None = None,
    options: ScoringOptions = DEFAULT,
    *,
    subset: bool = False,
) -> Evaluation:
    """As `evaluate_many`, with all frames and claims.

    Logs of equal name get the names of their folders as given. subset: these are a few of the logs
    that `evaluate_many` scored, so it is no fault if none of them has a row in its truth, or a
    method.
    """
    inputs = _inputs(results, ground_truth, options)
    pooled, logs = _evaluate(inputs, options, whole=True, subset=subset)
    cases = [log.case for log in logs if log.case is not None]
    named = [replace(c.log, name=name) for c, name in zip(cases, pooled.logs, strict=True)]
    joined = join(named, [case.truth for case in cases], options.min_visible)
    return Evaluation(
        joined=joined,
        folders=pooled.folders,
        scored=score_all(joined),
        min_visible=options.min_visible,
        notes=pooled.notes,
        unused=pooled.unused,
    )


def evaluate_many(
    results: str | Path | Sequence[Pair],
    ground_truth: str | Path | None = None,
    options: ScoringOptions = DEFAULT,
    *,
    jobs: int | None = None,
    find_beside: FindBeside | None = None,
) -> Pooled:
    """Score results as `scores.evaluate` says, one log at a time.

    results: a folder, or pairs of a log's results and its truth. So memory does not grow with the
    logs. jobs: number of processes, as in `survey.map_logs`; it does not change the result.
    find_beside: finds truth beside logs on servers, as in `pairs.found_beside`.
    """
    inputs = _inputs(results, ground_truth, options, find_beside)
    return _evaluate(inputs, options, jobs=jobs)[0]


def _evaluate(
    inputs: _Inputs,
    options: ScoringOptions,
    *,
    jobs: int | None = None,
    whole: bool = False,
    subset: bool = False,
) -> tuple[Pooled, list[SurveyedLog]]:
    """Read, match and count the logs, one at a time; also gives those that are scored.

    whole: keep all that was read of them. jobs, subset: as above.
    """
    parts = Parts()
    numbers: dict[int, int] = {}
    counted: list[LogToScore] = []

    def surveyed_logs() -> Iterable[SurveyedLog | UnreadableLog]:
        ids: tuple[int, ...] = ()
        folders = (reading.folder for reading in inputs.readings)
        read = partial(survey, whole=whole)
        surveyed = map_logs(read, inputs.readings, folders, 1 if whole else jobs)
        for reading, log in zip(inputs.readings, surveyed, strict=True):
            if isinstance(log, SurveyedLog):
                ids = ids or log.ids
                if log.ids != ids and set(log.ids) == set(ids):  # count in the first log's order
                    reading = replace(reading, ids=ids)
                    log = read(reading)
            if isinstance(log, UnreadableLog):
                yield log
                continue
            if log.part is not None:
                numbers[len(counted)] = parts.put(log.part)
            counted.append(reading)
            yield replace(log, part=None)

    selection = _select_logs(inputs, surveyed_logs(), subset)
    logs = [selection.logs[i] for i in selection.scored]
    if parts.coarse and len(logs) < len(numbers):  # it has put the values of all logs together
        parts, again = Parts(), [counted[i] for i in selection.scored]
        surveyed = map_logs(survey, again, (reading.folder for reading in again), jobs)
        for i, log in zip(selection.scored, surveyed, strict=True):
            if isinstance(log, SurveyedLog) and log.part is not None:
                numbers[i] = parts.put(log.part)
    result = pool(
        parts, [numbers[i] for i in selection.scored], selection.names, options.min_visible
    )
    if not subset:
        _check_methods(logs, selection.names)
    result = replace(
        result,
        folders=tuple(log.folder for log in logs),
        notes=tuple(map(printable, [*selection.notes, *_notes(logs, result)])),
        unused=tuple(map(printable, selection.unused)),
    )
    return result, logs


@dataclass(frozen=True, slots=True)
class _Inputs:
    """The logs to read, with their truth."""

    readings: list[LogToScore]
    notes: list[str]
    unused: list[str]
    table: TruthTable | None = None
    """The truth of all logs; None if each has its own."""
    folder: Path | None = None
    """If there is a `table`: the results folder as given."""


def _inputs(
    results: str | Path | Sequence[Pair],
    ground_truth: str | Path | None,
    options: ScoringOptions,
    find_beside: FindBeside | None = None,
) -> _Inputs:
    """The logs to read and their truth; the arguments are those of `evaluate_many`."""
    options.check()
    if not isinstance(results, str | Path):
        pairs, unused = usable_pairs(results)
        readings = [LogToScore(p.results, p.ground_truth, options, p.log) for p in pairs]
        return _Inputs(readings, [], unused)
    folders = find_logs(Path(results))
    if ground_truth is None:  # each log with the truth beside it
        pairs, without = find_truths_beside(folders, find_beside)
        readings = [LogToScore(p.results, p.ground_truth, options) for p in pairs]
        return _Inputs(readings, list(map(truth_note, pairs)), without)
    path = Path(ground_truth)
    readings = [LogToScore(folder, path, options) for folder in folders]
    return _Inputs(readings, [], [], read_truth(path), Path(results))


@dataclass(frozen=True, slots=True)
class _LogSelection:
    """The logs that were read, which of them are scored, and the messages about them."""

    logs: list[SurveyedLog]
    """Those that could be read."""
    scored: list[int]
    """Indices of those that are scored."""
    names: list[str]
    """Names of those that are scored, all different."""
    notes: list[str]
    unused: list[str]


def _select_logs(
    inputs: _Inputs, surveyed: Iterable[SurveyedLog | UnreadableLog], subset: bool = False
) -> _LogSelection:
    """Decide which logs are scored. subset: as in `evaluate_whole`.

    Raises SonarrecError if none can be read, or if they cannot be scored together.
    """
    logs: list[SurveyedLog] = []
    unread: list[UnreadableLog] = []
    for log in surveyed:
        if isinstance(log, SurveyedLog):
            logs.append(log)
        else:
            unread.append(log)
    if not logs:
        raise unread[0].error

    def frames(i: int) -> IntArray:
        return np.asarray(read_frames(logs[i].folder)["frame"])

    folders, recordings = [log.folder for log in logs], [log.recording for log in logs]
    truths = [log.ground_truth for log in logs]
    once = counted_once(folders, recordings, frames, "scored", truths)
    counted = [logs[i] for i in once.kept]
    unread_names = [log.name for log in unread]
    _check_names(inputs, [*(log.name for log in counted), *unread_names])
    faults = [UnreadableLog(log.name, log.error) for log in counted if log.error is not None]
    if len(faults) == len(counted):
        raise faults[0].error
    matching = [i for i in once.kept if logs[i].error is None]
    cases = [case for i in matching if (case := logs[i].truth_check) is not None]
    scorable = scorable_logs(cases, subset)
    scored = [matching[i] for i in scorable.usable]
    first = logs[scored[0]]
    for i in scored:
        if set(logs[i].ids) != set(first.ids):
            raise other_ids(first.name, logs[i].name)
    return _LogSelection(
        logs,
        scored,
        distinct_names([(logs[i].name, logs[i].folder) for i in scored]),
        [*inputs.notes, *once.notes, *scorable.notes],
        [
            *inputs.unused,
            *(log.message() for log in [*unread, *faults]),
            *scorable.unused,
            *_left_out(inputs, logs, unread_names, [cases[i] for i in scorable.usable]),
            *once.unused,
        ],
    )


def _check_names(inputs: _Inputs, logs: Sequence[str]) -> None:
    """Raise SonarrecError if one truth without a log column is for several logs (their names)."""
    table = inputs.table
    if table is not None and table.log is None and len(logs) > 1:
        raise SonarrecError(
            f"{table.path}: {inputs.folder} holds {len(logs)} logs ({', '.join(logs)}), so the "
            "truth needs a log column that names their folders; or give the folder of one log"
        )


def _left_out(
    inputs: _Inputs,
    logs: Sequence[SurveyedLog],
    unread: Sequence[str],
    usable: Sequence[TruthCheck],
) -> list[str]:
    """A line for each part of truth and results that is not scored.

    logs: those that could be read. unread: names of the others. usable: the scored ones.
    """
    if inputs.table is None:
        return [line for case in usable for line in left_out([case])]
    lines = left_out(usable)
    if [log.folder for log in logs] != [inputs.folder]:  # several logs were given, not one
        lines += of_other_logs(
            inputs.table, [*(log.name for log in logs), *unread], "they are not scored"
        )
    return lines


def distinct_names(logs: Sequence[tuple[str, Path]]) -> list[str]:
    """A different name for each log: its name or, if others share it, its folder.

    logs: (name, folder) of each.
    """
    many = Counter(name for name, _ in logs)
    return [name if many[name] == 1 else str(folder) for name, folder in logs]


def other_ids(first: str, other: str) -> SonarrecError:
    """The error for two logs (their names) whose landmark IDs differ."""
    return SonarrecError(
        f"logs {first} and {other} were run with different landmark IDs and "
        "cannot be pooled; evaluate them one by one, or give --landmarks"
    )


def _check_methods(logs: Sequence[SurveyedLog], names: Sequence[str]) -> None:
    """Raise SonarrecError if none of the logs has a method. names: of the logs."""
    if not any(log.methods for log in logs):
        raise SonarrecError(f"{', '.join(names)}: estimates.csv names no method to score")


def _notes(logs: Sequence[SurveyedLog], scored: Pooled) -> list[str]:
    """Notes on what was scored, a line each. logs: those of `scored`."""
    notes = []
    if not scored.placed:
        notes.append(
            "the strict protocol is not scored: truth or estimates have no positions, or they are "
            "in pixels and the geometry is not known (give --sonar FILE)"
        )
    for name, log in zip(scored.logs, logs, strict=True):
        if log.truth_check is not None:
            notes += rows_on_frames(name, log.truth_check.rows, log.truth_check.between)
        missing = [method for method in scored.methods if method not in log.methods]
        if missing:
            notes.append(
                f"{name}: has no estimates of {', '.join(missing)}; this counts as no claim"
            )
    notes += [f"{name}: scores are rounded to six digits" for name in scored.rounded]
    notes += [
        f"{method}: no estimate at all"
        for method, count in zip(scored.methods, scored.estimates, strict=True)
        if not count
    ]
    notes += [
        f"ID.{landmark} is never in view: its TPR is 0/0 and says nothing"
        for k, landmark in enumerate(scored.ids)
        if not any(s.base[:, k, 3].any() for s in scored.scored)
    ]
    return notes
