"""Of many logs those that differ from the rest: failed, partial, badly scored, seen otherwise."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.batch import logs_table
from sonarrec.evaluation import cells
from sonarrec.evaluation.counting.pooled import Pooled
from sonarrec.evaluation.matching.options import ScoringOptions
from sonarrec.records import SonarrecError, UsageError, number_of, shown
from sonarrec.report.logs import follows_by_default
from sonarrec.results.run_file import read_run
from sonarrec.results.sightings_file import read_sightings

MOST_OF_A_KIND = 5
"""Logs named for one reason."""


@dataclass(frozen=True, slots=True)
class Standing:
    """A log that differs from the rest."""

    name: str
    folder: Path | None
    """Of its results; None where there are none."""
    reasons: tuple[str, ...]


def standing(
    folders: Sequence[Path],
    pooled: Pooled | None,
    place: Path | None,
    options: ScoringOptions,
    method: str | None,
) -> list[Standing]:
    """Logs that differ from the rest, those for which there is most to say first.

    place: the folder that holds the results, whose logs.csv tells of logs that have none. options:
    its landmarks and sonar are used in place of what run.toml says. method: whose mistakes count,
    by default as in `logs.read_logs`.
    Raises UsageError where no log that was scored has the method.
    """
    found: dict[str, list[str]] = {}
    where = {shown(folder.resolve().name): folder for folder in folders}
    if pooled is not None:
        where = dict(zip(pooled.logs, pooled.folders, strict=True))
        said = [*_unfinished(where, place), *_scored(pooled, method)]
    else:
        every, unread = _sightings(where, options)
        read = {name: where[name] for name in every}
        said = [*unread, *_unfinished(read, place), *_seen(every, method)]
    for name, reason in said:
        found.setdefault(name, []).append(reason)
    return [Standing(name, where.get(name), tuple(why)) for name, why in found.items()]


def chosen(folders: Sequence[Path], stand: Sequence[Standing]) -> list[Path]:
    """The folders in the order in which they have panels: those that differ, then others."""
    known = set(folders)
    first = [one.folder for one in stand if one.folder is not None and one.folder in known]
    return list(dict.fromkeys([*first, *folders]))


def _unfinished(where: dict[str, Path], place: Path | None) -> Iterator[tuple[str, str]]:
    """Those that failed or could not be used whole."""
    rows = []
    if place is not None:
        try:
            rows = logs_table.read_logs(place / logs_table.NAME)
        except SonarrecError:  # another program's
            rows = []
    stand = {row.log for row in rows if row.status in logs_table.USABLE}
    # A namesake of a log whose results stand was refused: that says nothing of them.
    failed = [row for row in rows if row.status == "failed" and row.log not in stand]
    for row in failed:
        yield row.log, f"failed: {row.message}"
    told = {row.log for row in failed}
    for name, folder in where.items():
        run = read_run(folder / "run.toml")
        if name not in told and not run.finished:
            yield name, "partial: the run was cut short"
        elif name not in told and run.input.problems:
            more = f" and {len(run.input.problems) - 1} more" * (len(run.input.problems) > 1)
            yield name, f"partial: {run.input.problems[0]}{more}"


def _scored(pooled: Pooled, method: str | None) -> Iterator[tuple[str, str]]:
    """The most mistakes, then the most false claims."""
    method = method or follows_by_default(pooled.methods)
    if method not in pooled.methods:
        there = ", ".join(pooled.methods)
        raise UsageError(f"--method {method}: no log that is scored has it; there is {there}")
    scored = cells.of(pooled, method, cells.protocols(pooled)[0])
    counts = [of_log[-1] for of_log in scored.counts_per_log()]
    mistakes = [count.fn + count.fp for count in counts]
    false = [count.fp for count in counts]
    for i in _most(mistakes):
        count = counts[i]
        whole = f" of {count.tp + count.fn}" * bool(count.tp + count.fn)
        told = f"{count.fn}{whole} missed, {number_of(count.fp, 'false claim')}"
        yield pooled.logs[i], f"most mistakes of {method}: {told}"
    for i in _most([n if n > 1 else 0 for n in false]):  # one tells nothing
        yield pooled.logs[i], f"most false claims of {method}: {false[i]}"


def _sightings(
    where: dict[str, Path], options: ScoringOptions
) -> tuple[dict[str, Counter[str]], list[tuple[str, str]]]:
    """How many sightings of each method the logs have, and of those that cannot be read why."""
    every: dict[str, Counter[str]] = {}
    unread = []
    for name, folder in where.items():
        try:
            found = read_sightings(folder, options.landmarks, options.sonar)
            every[name] = Counter(s.method for s in found)
        except SonarrecError as error:
            unread.append((name, f"cannot be read: {error}"))
    return every, unread


def _seen(every: dict[str, Counter[str]], method: str | None) -> Iterator[tuple[str, str]]:
    """Without truth: numbers of sightings, of one method, far from what is usual."""
    method = method or follows_by_default(sorted(set().union(*every.values())))
    count = [of_log[method] for of_log in every.values()]
    usual = float(np.median(count)) if count else 0.0
    names = list(every)
    for i in _most([abs(n - usual) for n in count]):
        yield names[i], f"sightings of {method}: {count[i]}, where {usual:g} are usual"


def _most(values: Sequence[float]) -> list[int]:
    """The few that are larger than is usual, the largest first."""
    usual = np.median(values) if len(values) else 0
    order = sorted(range(len(values)), key=lambda i: -values[i])
    return [i for i in order[:MOST_OF_A_KIND] if values[i] > usual]
