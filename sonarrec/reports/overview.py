"""All logs of a report at a glance: their states and rates, and the mistakes that they share."""

from __future__ import annotations

from collections.abc import Container, Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonarrec.errors import SonarrecError, number_of
from sonarrec.evaluation.counts import TOTAL, Counts
from sonarrec.evaluation.mistakes import Mistake
from sonarrec.evaluation.write import Evaluation
from sonarrec.reports.screen import OperatingPoint, protocols, rates_per_log
from sonarrec.results.folders import log_of
from sonarrec.results.run_file import csv_rows, read_run
from sonarrec.runs.logs_table import NAME, USABLE, Row, read_logs

Points = Sequence[OperatingPoint]
NO_TRUTH = "no ground truth"
"""The note of a log that has none."""


@dataclass(frozen=True, slots=True)
class LogRow:
    """A row of the table of all logs."""

    name: str
    folder: Path | None
    """Of its results; None if there are none."""
    state: str
    """As in logs.csv, else by run.toml."""
    frames: int
    points: Points
    """Of each method of the evaluation; empty if the log is not scored."""
    note: str
    """Why it failed or is not scored, or what of it could not be used."""


def all_logs(
    results: Path,
    folders: Sequence[Path],
    evaluation: Evaluation | None,
    left_out: Mapping[Path, str],
) -> list[LogRow]:
    """The rows, the worst first: without results, then by TPR - FPR of the first method, then not
    scored.

    folders: those of results. left_out: why a log is not scored, where that is known.
    """
    listed: dict[str, Row] = {}
    with suppress(SonarrecError):  # a table of another program
        listed = {row.log: row for row in read_logs(results / NAME)}

    def row(
        folder: Path, frames: int, *, name: str = "", points: Points = (), note: str = ""
    ) -> LogRow:
        run = listed.get(log_of(folder))
        state, message = (run.status, run.message) if run else (_state(folder), "")
        return LogRow(name or log_of(folder), folder, state, frames, points, note or message)

    rows = [
        LogRow(entry.log, None, entry.status, entry.frames, (), entry.message)
        for entry in listed.values()
        if entry.log not in {log_of(folder) for folder in folders}
    ]
    scored: Sequence[Path] = ()
    if evaluation is not None:
        counts, scored = evaluation.counts, evaluation.folders
        names, frames = rates_per_log(counts), [log.frames for log in counts.counted]
        for n in worst_first(counts):
            name, points = names[n]
            rows.append(row(scored[n], frames[n], name=name, points=points))
    for folder in folders:
        if folder not in scored:
            note = left_out.get(folder, "not scored" if evaluation else "")
            rows.append(row(folder, _frames(folder), note=note))
    return rows


def headline(rows: Sequence[LogRow], evaluation: Evaluation | None) -> str:
    """A line on all logs: how many are scored, the rates of the first method, and what is wrong.

    rows: as of `all_logs`.
    """
    failed = sum(row.folder is None or row.state not in USABLE for row in rows)
    others = [row for row in rows if row.folder is not None and not row.points]
    without = sum(row.note == NO_TRUTH for row in others)
    parts = {
        "failed": failed,
        "partial": sum(row.state == "partial" for row in rows),
        "without ground truth": without,
        "not scored for another reason": sum(row.state in USABLE for row in others) - without,
    }
    if evaluation is None:
        line = f"{number_of(len(rows), 'log')}, none scored"
        parts = {name: parts[name] for name in ("failed", "partial")}
    else:
        counts = evaluation.counts
        method = counts.methods[0]
        count = counts.count(method, protocols(counts)[0])
        line = (
            f"{len(evaluation.folders)} of {number_of(len(rows), 'log')} scored: {method} has TPR "
            f"{count.tpr:.3f}, FPR {count.fpr:.4f}, {count.false_per_100:.2f} false claims in 100 "
            "frames"
        )
    wrong = ", ".join(f"{n} {what}" for what, n in parts.items() if n)
    return f"{line}; {wrong}" if wrong else line


def worst_first(counts: Counts) -> list[int]:
    """The logs of an evaluation by TPR - FPR of the first method; a rate of 0/0 is no loss."""
    main = protocols(counts)[0]
    of_logs = [counts.count(counts.methods[0], main, TOTAL, log) for log in counts.logs]
    good = [np.nan_to_num(c.tpr, nan=1) - np.nan_to_num(c.fpr) for c in of_logs]
    return [int(n) for n in np.argsort(good, kind="stable")]


def _state(folder: Path) -> str:
    with suppress(SonarrecError):
        return "done" if read_run(folder / "run.toml").finished else "cut short"
    return "unreadable"


def _frames(folder: Path) -> int:
    with suppress(OSError):
        return csv_rows(folder / "frames.csv")
    return 0


class SharedMistake(NamedTuple):
    """Mistakes of one method that are of the same kind and IDs, the longest first."""

    members: list[Mistake]

    def shown(self, logs: Container[str]) -> Mistake:
        """The first in these logs; the first of all, if it is in none."""
        return next((mistake for mistake in self.members if mistake.log in logs), self.members[0])

    @property
    def in_words(self) -> str:
        """A sentence."""
        if self.members[0].at_start:
            return "In view in the log's first frame, in which no track is declared"
        return self.members[0].in_words

    @property
    def logs(self) -> list[str]:
        """Each log once, by name."""
        return sorted({mistake.log for mistake in self.members})

    @property
    def frames(self) -> str:
        """In how many frames, and where these are the same in all logs."""
        spans = {mistake.span for mistake in self.members}
        total = sum(mistake.frames for mistake in self.members)
        return spans.pop() if len(spans) == 1 else f"{total} in all"


def shared(mistakes: Iterable[Mistake], method: str, logs: int) -> list[SharedMistake]:
    """A method's mistakes, of several logs those of the same kind and IDs as one, by their frames.

    What no method with tracks can know, in the first frame of a log, is one, and the last.
    """
    groups: dict[Hashable, list[Mistake]] = {}
    for n, m in enumerate(mistakes):
        if m.method == method:
            what = (m.kind, m.landmark, m.other) if logs > 1 else n
            groups.setdefault("at start" if m.at_start else what, []).append(m)
    order = sorted(groups.values(), key=lambda g: (g[0].at_start, -sum(m.frames for m in g)))
    return [SharedMistake(group) for group in order]
