"""The output of `sonarrec run`: progress bar, tables or JSON, and logs.csv."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import click

from sonarrec.cli.bars import progress_of_frames, progress_of_logs
from sonarrec.cli.endings import FAILED, MISUSED, PARTLY, inform, say, tell
from sonarrec.errors import MissingError, SonarrecError, hidden, number_of, printable
from sonarrec.nouns import date_text, is_date
from sonarrec.results.folders import MADE, PAGES
from sonarrec.results.run_file import PROGRAM
from sonarrec.runs.logs_table import NAME, LogsTable
from sonarrec.runs.many import Watch
from sonarrec.runs.one import Summary
from sonarrec.runs.task import Outcome, Task

if TYPE_CHECKING:
    from sonarrec.results.sightings import Sighting

MOST_SHOWN = 10
"""If a call has more logs, their passes are not printed."""
MOST_ROWS = 100
"""Of the table of what was found in each log."""


@dataclass
class RunWatch(Watch):
    """Prints the progress and outcomes of a call, and writes logs.csv. A context manager.

    table: logs.csv of the tasks. out: folder of the results. server_out: its URL, if it stands for
    one on a server. jobs: how many tasks run in parallel.
    """

    tasks: Sequence[Task]
    table: LogsTable
    out: Path
    server_out: str
    jobs: int
    quiet: bool
    json: bool
    briefly: bool = False
    """Whether to tell problems only: not the geometry, notes and passes."""

    def __post_init__(self) -> None:
        self._outcomes: dict[int, Outcome] = {}
        self._printed = 0  # how many of the tasks, in order, were printed on stdout
        self._running: dict[int, tuple[int, int | None]] = {}  # frames done, of how many
        self._frames = 0  # frames of logs that have ended
        self._start_time_s = monotonic()
        self._bars = ExitStack()
        self._show_frame: Callable[..., None] | None = None  # moves the bar of frames
        self._show_logs: Callable[..., None] | None = None  # that of logs; None if one runs at once

    def __enter__(self) -> RunWatch:
        self.table.write()
        if self.jobs > 1:
            bar = progress_of_logs(self.quiet, len(self.tasks))
            self._show_logs = self._bars.enter_context(bar)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self._bars.close()
        if kind is not None:
            self.table.stopped()
        try:
            self.table.write()
            if self.server_out and kind is None:  # a stopped run does not wait for a server
                from sonarrec.runs.remote import put  # with fsspec, only where needed

                put(self.out / NAME, f"{self.server_out.rstrip('/')}/{NAME}")
        except SonarrecError as error:
            tell([str(error)])
        if self.table.fault and all(o.status != "failed" for o in self._outcomes.values()):
            tell([self.table.fault])  # else the disk is full, which was reported
        if self.json:
            logs = [self._document(i) for i in range(len(self.tasks))]
            click.echo(json.dumps({"program": PROGRAM, "logs": logs}, indent=2))

    def note(self, line: str) -> None:
        with self._over_the_bar():
            tell([], [line])

    def started(self, i: int) -> None:
        self.table.started(i)
        self._running[i] = 0, None
        if self._show_logs is None:
            self._bars.close()
            bar = progress_of_frames(self.quiet, title=f"{self.tasks[i].name}{self._prefix(i)}")
            self._show_frame = self._bars.enter_context(bar)

    def goes_by(self, i: int, line: str) -> None:
        if not (self.quiet or self.briefly):
            with self._over_the_bar():
                inform(f"{self.tasks[i].name}: {line}")

    def frames(self, i: int, done: int, total: int | None) -> None:
        self._running[i] = done, total
        self.table.frames(i, done)
        if self._show_frame is not None:
            self._show_frame(done, total)
        self._move_bar_of_logs()

    def ended(self, i: int, outcome: Outcome) -> None:
        self._outcomes[i] = outcome
        self._running.pop(i, None)
        self.table.ended(i, outcome)
        summary = outcome.summary
        if self._show_logs is None:
            self._bars.close()  # before printing
        self._move_bar_of_logs()
        with self._over_the_bar():
            if outcome.fault:
                click.echo(outcome.fault.rstrip(), err=True)
            if summary is not None:
                self._frames += summary.frames
                notes = [] if self.briefly else summary.notes
                tell(*(self._named(i, lines) for lines in (summary.problems, notes)))
            elif len(self.tasks) > 1:
                tell([outcome.message])
            self._print_ended()

    @property
    def error(self) -> SonarrecError | None:
        """The error of the first log, if it failed."""
        return self._outcomes[0].error if 0 in self._outcomes else None

    @property
    def with_results(self) -> list[int]:
        """The indices of the tasks that gave results."""
        return [i for i, o in sorted(self._outcomes.items()) if o.summary is not None]

    def exit_code(self) -> int:
        """The exit code of the call, after all have ended."""
        states = [outcome.status for outcome in self._outcomes.values()]
        if states and all(state == "failed" for state in states):
            errors = [outcome.error for outcome in self._outcomes.values()]
            return MISUSED if all(isinstance(e, MissingError) for e in errors) else FAILED
        return 0 if all(state == "done" for state in states) else PARTLY

    def count(self) -> None:
        """Print how many logs are done, up to date, partial and failed, if there are several."""
        self._report_outdated()
        counts: dict[str, list[str]] = {"done": [], "up to date": [], "partial": [], "failed": []}
        for i, outcome in sorted(self._outcomes.items()):
            counts[_in_words(outcome)].append(self.tasks[i].path)
        failed = counts["failed"]
        if len(self.tasks) > 1 and not self.quiet and not self.json:
            say("", *self._found())
        if len(self.tasks) == 1 or (self.quiet and not failed):
            return
        line = ", ".join(f"{len(paths)} {how}" for how, paths in counts.items() if paths)
        if len(failed) > MOST_SHOWN:
            line += f"; {NAME} in {hidden(self.server_out) or self.out} lists them"
        elif failed:
            line += f": {', '.join(failed)}"
        click.echo(printable(line), err=bool(failed) or self.json)

    def _found(self) -> Iterator[str]:
        """A row for each log: what was found in it."""
        width = max(3, *(min(len(task.name), 40) for task in self.tasks[:MOST_ROWS]))
        yield f"{'log':<{width}}  {'frames':>7}  {'notes':>5}  frames with a landmark declared"
        for i, outcome in sorted(self._outcomes.items())[:MOST_ROWS]:
            summary, name = outcome.summary, f"{self.tasks[i].name:<{width}}"
            if summary is None:
                yield f"{name}  {'-':>7}  {'-':>5}  failed"
                continue
            notes = "-" if summary.up_to_date else str(len(summary.notes))
            seen = [f"ID.{one}: {count}" for one, count in sorted(summary.landmarks.items())]
            lost = f"; {summary.unusable} unusable" if summary.unusable else ""
            found = ", ".join(seen) or "none"
            yield f"{name}  {summary.frames:>7}  {notes:>5}  {found}{lost}"
        if len(self._outcomes) > MOST_ROWS:
            yield f"{len(self._outcomes) - MOST_ROWS} more in {NAME}"

    def _report_outdated(self) -> None:
        """Print a note on pages and folders in OUT that were made from results replaced now."""
        summaries = [outcome.summary for outcome in self._outcomes.values()]
        if self.server_out or all(s is None or s.up_to_date for s in summaries):
            return
        older = [name for name in PAGES if (self.out / name).exists()]
        older += [name for name, made in MADE.items() if (self.out / name / made[-1]).is_file()]
        if older:
            stale = f"{', '.join(older)} show the results of before; make them again"
            tell([], [f"{self.out}: {stale}"])

    def _prefix(self, i: int) -> str:
        return f" ({i + 1} of {len(self.tasks)})" if len(self.tasks) > 1 else ""

    def _named(self, i: int, lines: Sequence[str]) -> list[str]:
        """The lines, with the name of the log in front if there are several logs."""
        task = self.tasks[i]
        if len(self.tasks) == 1:
            return list(lines)
        return [x if task.path in x else f"{task.name}: {x}" for x in lines]

    def _move_bar_of_logs(self) -> None:
        """Move the bar of logs that run in parallel, if there is one."""
        if self._show_logs is None:
            return
        shares = [done / total for done, total in self._running.values() if total]
        frames = self._frames + sum(done for done, _ in self._running.values())
        failed = sum(outcome.status == "failed" for outcome in self._outcomes.values())
        note = f"{len(self._outcomes)}/{len(self.tasks)} logs, {frames} frames, "
        note += f"{frames / max(monotonic() - self._start_time_s, 1e-3):.0f} frames/s"
        note += f", {failed} failed" if failed else ""
        self._show_logs(len(self._outcomes) + sum(shares), note=note)

    @contextmanager
    def _over_the_bar(self) -> Iterator[None]:
        """Print above the bar, not into it."""
        if "tqdm" not in sys.modules:  # no bar is shown
            yield
            return
        from tqdm import tqdm

        with tqdm.external_write_mode():
            yield

    def _print_ended(self) -> None:
        """Print the logs that have ended on stdout, in the order of the call."""
        while (outcome := self._outcomes.get(self._printed)) is not None:
            self._printed += 1
            summary = outcome.summary
            silent = self.quiet or self.json or self.briefly or len(self.tasks) > MOST_SHOWN
            if summary is None or silent:
                continue
            frames = number_of(summary.frames, "frame")
            lines = [] if summary.up_to_date else table(summary, outcome.folder)
            head = f"{outcome.folder}: {'up to date, ' * summary.up_to_date}{frames}"
            say(head, *(f"  {line}" for line in lines))

    def _document(self, i: int) -> dict[str, Any]:
        task, outcome = self.tasks[i], self._outcomes.get(i)
        document: dict[str, Any] = {"name": task.name, "log": task.path}
        if outcome is None:
            return document | {"status": "stopped" if i in self._running else "waiting"}
        document["status"] = outcome.status
        if outcome.summary is None:
            return document | {"message": outcome.message}
        sightings = outcome.summary.folder / "sightings.csv"
        return document | as_json(outcome.summary, outcome.folder, sightings)


def _in_words(outcome: Outcome) -> str:
    """The status of a log as the summary of a call counts it."""
    if outcome.summary is not None and outcome.summary.up_to_date:
        return "up to date" if outcome.status == "done" else "partial"
    return outcome.status if outcome.status in ("done", "partial") else "failed"


def table(summary: Summary, folder: str) -> list[str]:
    """Lines to print: the longest passes of each method, and how many more sightings.csv has.

    folder: of that file.
    """
    lines: list[str] = []
    for method, count in summary.passes.items():
        lines += [f"{method}:"] if len(summary.passes) > 1 else []
        sightings = [s for s in summary.sightings if s.method == method]
        if not sightings:
            lines.append("no landmark declared")
            continue
        dated = is_date(sightings[0].start_ns)
        wide = max(len(_end(s)) for s in sightings) if dated else None
        times = f"{'from UTC':<22}  {'to UTC':<{wide}}" if wide else f"{'from s':>9} {'to s':>9}"
        lines.append(
            f"landmark  track  frames       {times}  declared  best score  range m  bearing deg"
        )
        lines += [_row(s, wide) for s in sightings]
        if count > len(sightings):
            where = f"{folder}/sightings.csv"
            lines.append(f"these are the longest; {count - len(sightings)} more in {where}")
    return lines


def _row(s: Sighting, end_width: int | None) -> str:
    """A row. end_width: of the column of end dates; None if times are not dates."""
    track = "-" if s.track is None else s.track
    times = f"{s.start_ns / 1e9:>9.2f} {s.end_ns / 1e9:>9.2f}"
    if end_width is not None:
        times = f"{date_text(s.start_ns, 2):<22}  {_end(s):<{end_width}}"
    return (
        f"{s.landmark:>8}  {track:>5}  {f'{s.first_frame}-{s.last_frame}':<11}  {times}"
        f"  {s.frames_declared:>8}  {s.best_score:>10.3f}  {_number(s.range_m, 2):>7}"
        f"  {_number(s.bearing_deg, 1):>11}"
    )


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _end(s: Sighting) -> str:
    """The end of a pass, with the date if it differs from that of the start."""
    start, end = date_text(s.start_ns, 2), date_text(s.end_ns, 2)
    return end[11:] if end[:10] == start[:10] else end


def as_json(summary: Summary, folder: str, sightings: Path) -> dict[str, Any]:
    """The JSON object of a log, with all sightings of all methods.

    folder: where its results are. sightings: their sightings.csv. Null is for what is not known.
    """
    from sonarrec.results.sightings import sightings_in

    return {
        "folder": folder,
        "up_to_date": summary.up_to_date,
        "frames": summary.frames,
        "candidates": summary.candidates,
        "sightings": [
            {
                name: None if isinstance(value, float) and math.isnan(value) else value
                for name, value in asdict(sighting).items()
            }
            for sighting in (  # of results on a server the longest
                sightings_in(sightings) if sightings.is_file() else summary.sightings
            )
        ],
        "problems": summary.problems,
        "notes": summary.notes,
    }
