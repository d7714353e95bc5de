"""Logs that differ from the rest: failed, partial, with many mistakes or unusual sightings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.errors import SonarrecError, number_of
from sonarrec.evaluation import cells
from sonarrec.evaluation.count import Counts
from sonarrec.evaluation.match import ScoringOptions
from sonarrec.evaluation.tables import Evaluation
from sonarrec.results.folders import log_of
from sonarrec.results.methods import leading
from sonarrec.results.run_file import read_run
from sonarrec.results.sightings import read_sightings
from sonarrec.runs import logs_table

MOST_OF_A_KIND = 5  # so many logs at most are named for one reason


@dataclass(frozen=True, slots=True)
class Outlier:
    """A log that differs from the rest."""

    name: str
    folder: Path | None
    """Its results folder; None if it has no results."""
    reasons: tuple[str, ...]


def outliers(
    folders: Sequence[Path],
    evaluation: Evaluation | None,
    folder: Path | None,
    options: ScoringOptions,
) -> list[Outlier]:
    """Logs that differ from the rest: failed and partial ones first.

    folder: that which holds the results; its logs.csv names the logs without results.
    options: its landmarks and sonar replace those in run.toml; the mistakes of the first of its
    methods count, by default those of the leading method.
    """
    reasons: dict[str, list[str]] = {}
    folder_of = {log_of(folder): folder for folder in folders}
    if evaluation is not None:
        folder_of = dict(zip(evaluation.counts.logs, evaluation.folders, strict=True))
        remarks = [*_unfinished(folder_of, folder), *_most_mistaken(evaluation.counts)]
    else:
        sightings: dict[str, Counter[str]] = {}
        remarks = []
        for name, results in folder_of.items():
            try:
                found = read_sightings(results, options.landmarks, options.sonar)
                sightings[name] = Counter(s.method for s in found)
            except SonarrecError as error:
                remarks.append((name, f"cannot be read: {error}"))
        folders_read = {name: folder_of[name] for name in sightings}
        remarks += _unfinished(folders_read, folder)
        # Without truth an unusual number of sightings tells which logs differ.
        method = next(iter(options.methods), leading(set().union(*sightings.values())))
        count = [of_log[method] for of_log in sightings.values()]
        usual = float(np.median(count)) if count else 0.0
        for i in _most([abs(n - usual) for n in count]):
            told = f"sightings of {method}: {count[i]}, where {usual:g} are usual"
            remarks.append(([*sightings][i], told))
    for name, reason in remarks:
        reasons.setdefault(name, []).append(reason)
    return [Outlier(name, folder_of.get(name), tuple(why)) for name, why in reasons.items()]


def failed_logs(folder: Path | None) -> list[Outlier]:
    """The logs that failed, by logs.csv in the folder, if there is one."""
    rows = []
    if folder is not None:
        with suppress(SonarrecError):  # raised where it is not a logs.csv of sonarrec
            rows = logs_table.read_logs(folder / logs_table.NAME)
    usable = {row.log for row in rows if row.status in logs_table.USABLE}
    # If the name has usable results too, they belong to another log of that name.
    failed = (row for row in rows if row.status == "failed" and row.log not in usable)
    return [Outlier(row.log, None, (f"failed: {row.message}",)) for row in failed]


def outliers_first(folders: Sequence[Path], outlying: Sequence[Outlier]) -> list[Path]:
    """The folders, those of outliers first."""
    listed = set(folders)
    first = (o.folder for o in outlying if o.folder is not None and o.folder in listed)
    return list(dict.fromkeys([*first, *folders]))


def _unfinished(folder_of: dict[str, Path], results: Path | None) -> Iterator[tuple[str, str]]:
    """(log, reason) of logs that failed or could not be used completely."""
    failed = failed_logs(results)
    for log in failed:
        yield log.name, log.reasons[0]
    failed_names = {log.name for log in failed}
    for name, folder in folder_of.items():
        run = read_run(folder / "run.toml")
        if name not in failed_names and not run.finished:
            yield name, "partial: the run was cut short"
        elif name not in failed_names and run.input.problems:
            more = f" and {len(run.input.problems) - 1} more" * (len(run.input.problems) > 1)
            yield name, f"partial: {run.input.problems[0]}{more}"


def _most_mistaken(counts: Counts) -> Iterator[tuple[str, str]]:
    """(log, reason) of logs with the most mistakes, then with the most false claims."""
    method = counts.methods[0]
    scored = cells.scored_by(counts, method, cells.protocols(counts)[0])
    of_logs = [of_log[-1] for of_log in scored.counts_per_log()]
    mistakes = [count.fn + count.fp for count in of_logs]
    false = [count.fp for count in of_logs]
    for i in _most(mistakes):
        count = of_logs[i]
        whole = f" of {count.tp + count.fn}" * bool(count.tp + count.fn)
        missed = f"{count.fn}{whole} missed"
        false_claims = number_of(count.fp, "false claim")
        yield counts.logs[i], f"most mistakes of {method}: {missed}, {false_claims}"
    for i in _most([n if n > 1 else 0 for n in false]):  # a single one means little
        yield counts.logs[i], f"most false claims of {method}: {false[i]}"


def _most(values: Sequence[float]) -> list[int]:
    """Indices of at most MOST_OF_A_KIND values above the median, the largest first."""
    usual = np.median(values) if len(values) else 0
    order = sorted(range(len(values)), key=lambda i: -values[i])
    return [i for i in order[:MOST_OF_A_KIND] if values[i] > usual]
