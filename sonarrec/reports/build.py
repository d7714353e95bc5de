"""`sonarrec report`, for programs as well: results and truth in, one HTML file out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from sonarrec.errors import Diagnostics, SonarrecError, local, number_of
from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.match import ScoringOptions, scoring_options
from sonarrec.evaluation.pairs import Pair, find_truths_beside
from sonarrec.evaluation.screen import protocols
from sonarrec.evaluation.write import Evaluation
from sonarrec.reports import frames
from sonarrec.reports.frames import Picture, Shown, open_recording
from sonarrec.reports.logs import (
    MOST_LOGS,
    Episode,
    JudgedSighting,
    LogToShow,
    ReportedLog,
    episodes,
    in_words,
    judged_sightings,
    read_logs,
)
from sonarrec.reports.page import MOST_MISTAKES, render
from sonarrec.results.read import find_logs, not_whole
from sonarrec.results.run_file import read_run
from sonarrec.runs.recorded import recorded_at
from sonarrec.sonar import Sonar
from sonarrec.tables.outputs import check_output, write_page
from sonarrec.truth.table import read_truth

AnyPath = str | Path
MOST_SEEN = MOST_MISTAKEN = 6
"""Pictures of sightings, and of each method's mistakes: each adds some 60 kB to the page."""


@dataclass(frozen=True, slots=True, repr=False)
class Report:
    """What was written. pictures: drawn frames on the page. held: frames that a click shows.
    unused: one line for each part of the input that could not be used."""

    path: Path
    pictures: int
    held: int
    unused: tuple[str, ...]


def report(
    results: AnyPath = "sonarrec_out",
    out: AnyPath | None = None,
    *,
    ground_truth: AnyPath | None = None,
    logs: AnyPath | Sequence[AnyPath] = (),
    topic: str | None = None,
    options: ScoringOptions | None = None,
    **scoring: Any,
) -> Report:
    """Write results, of one log or of several, as one HTML page; returns what was written.

    out: default: report.html in `results`. ground_truth: one table; default: that beside each log,
    if all have one. logs: the recordings that the results came from, or folders with such; default:
    where they were. topic: the image channel of an MCAP recording, if run.toml does not name it.
    scoring: as `evaluate` takes it, `method` to `sonar`, or options made of them; the sightings and
    tracks of the first method are shown.
    Raises SonarrecError where files cannot be used, read or written.
    """
    options = options or scoring_options(**scoring)
    path, folders = Path(local(out or Path(results) / "report.html")), find_logs(Path(results))
    truth_file = None if ground_truth is None else Path(local(ground_truth))
    recordings = [Path(logs)] if isinstance(logs, AnyPath) else [*map(Path, logs)]
    recordings = recordings or [*_recorded(folders)]
    check_output(path, "report", [truth_file, *recordings])
    rows: list[Pair] = []
    with suppress(SonarrecError):  # there is none, or not one for each
        rows = find_truths_beside(folders, Diagnostics()) if truth_file is None else []
    evaluation, to_show = None, [LogToShow(folder) for folder in folders]
    if truth_file is not None or len(rows) == len(folders):
        evaluation = evaluate_logs(rows or results, truth_file, options)
        to_show = _scored_logs(evaluation, rows, truth_file)
    reported, unread = read_logs(to_show, options)
    mistakes = {} if evaluation is None else _mistakes(reported, evaluation)
    sonar = options.sonar or Sonar()
    pictures, shown, missing = _draw_all(reported, mistakes, recordings, sonar, topic)
    incomplete = (line for log in reported for line in not_whole(log.results, "shown"))
    unused = (*(incomplete if evaluation is None else evaluation.unused), *unread, *missing)
    truth = truth_file or (rows[0].ground_truth if evaluation else None)
    in_all = len(evaluation.folders if evaluation else folders)
    write_page(path, render(reported, evaluation, mistakes, truth, pictures, shown, unused, in_all))
    return Report(path, len(pictures), sum(len(log["frames"]) for log in shown), unused)


def _recorded(folders: Iterable[Path]) -> Iterator[Path]:
    """The logs that results were made from, those that are there."""
    for folder in folders:
        with suppress(SonarrecError):
            yield Path(recorded_at(folder, read_run(folder / "run.toml").input).path)


def _scored_logs(
    evaluation: Evaluation, rows: Sequence[Pair], truth_file: Path | None
) -> list[LogToShow]:
    """The first logs of an evaluation, which has distinct names, each recording once, and no log
    that cannot be read. rows: its pairs, or truth_file: the truth of all logs."""
    truth, to_show = cache(read_truth), list[LogToShow]()
    pair_of = {row.results: row for row in rows}
    for folder, name in [*zip(evaluation.folders, evaluation.counts.logs, strict=True)][:MOST_LOGS]:
        pair = pair_of.get(folder) or Pair(folder, truth_file or folder)
        to_show.append(LogToShow(folder, truth(pair.ground_truth), pair.log, name))
    return to_show


def _mistakes(logs: Sequence[ReportedLog], evaluation: Evaluation) -> dict[str, list[Episode]]:
    """The mistakes in some logs by each method that any of them has."""
    matched = [log.matched for log in logs if log.matched is not None]
    return {
        method: episodes(matched, method, protocols(evaluation.counts)[0])
        for method in evaluation.counts.methods
        if any(method in log.methods for log in matched)
    }


def _draw_all(
    logs: Sequence[ReportedLog],
    mistakes: Mapping[str, Sequence[Episode]],
    recordings: Sequence[Path],
    sonar: Sonar,
    topic: str | None,
) -> tuple[list[Picture], list[Shown], list[str]]:
    """Pictures and frames of the recordings given; a line for each recording not found."""
    sources, missing = frames.match_recordings(logs, recordings)
    recorded = [log for log in logs if log.name in sources]
    passes = [s for log in recorded for s in judged_sightings(log)]
    pictures = [*_of_sightings(passes)]
    for method, of_method in mistakes.items():
        for e in [e for e in of_method if e.log in sources][:MOST_MISTAKEN]:
            wrong = f"{in_words(e)}."
            pictures.append(Picture(e.log, method, e.worst, "mistake", "", wrong))
    held = frames.choose(recorded, _named_frames(passes, mistakes, pictures))
    most_bytes = frames.MOST_BYTES // max(1, sum(map(len, held.values())))  # for each frame
    shown = []
    for log in recorded:
        mine = [picture for picture in pictures if picture.log == log.name]
        with open_recording(sources[log.name], log, sonar, topic) as recording:
            shown.append(frames.take(recording, log, mine, held[log.name], most_bytes))
    return pictures, shown, missing


def _named_frames(
    passes: Sequence[JudgedSighting],
    mistakes: Mapping[str, Sequence[Episode]],
    pictures: Sequence[Picture],
) -> Iterator[tuple[str, int]]:
    """(log, frame) of all frames that the page names, the most interesting first."""
    yield from ((picture.log, picture.frame) for picture in pictures)
    yield from ((s.log.name, s.log.frame_of(s.surest)) for s in passes)
    for of_method in mistakes.values():
        yield from ((e.log, e.worst) for e in of_method[:MOST_MISTAKES])
    for s in passes:
        yield s.log.name, s.sighting.first_frame
        yield s.log.name, s.sighting.last_frame


def _of_sightings(passes: Sequence[JudgedSighting]) -> Iterator[Picture]:
    """The surest frame of each declared landmark, then the shortest sightings."""

    def order(s: JudgedSighting) -> tuple[float, ...]:
        # Of scores that print alike: a true claim first, then the longest sighting.
        score = round(s.log.results.score[s.surest], 2)
        return s.sighting.landmark, -score, bool(s.wrong), -s.sighting.frames_declared

    best: dict[int, JudgedSighting] = {}
    for s in sorted(passes, key=order):
        best.setdefault(s.sighting.landmark, s)
    others = [s for s in passes if s is not best[s.sighting.landmark]]
    rarest = sorted(others, key=lambda s: s.sighting.frames_declared)
    for s in [*best.values(), *rarest[: max(0, MOST_SEEN - len(best))]]:
        caption = f"ID.{s.sighting.landmark} ({s.log.results.score[s.surest]:.2f})"
        is_best = s is best[s.sighting.landmark]
        if not is_best:
            caption += f", declared in {number_of(s.sighting.frames_declared, 'frame')}"
        yield Picture(
            log=s.log.name,
            method=s.log.tracker,
            frame=s.log.frame_of(s.surest),
            group="surest" if is_best else "rarest",
            caption=f"{caption}.",
            wrong=f"False claim: {s.wrong}." if s.wrong else "",
        )
