"""`sonarrec report`, for programs as well: results and truth in, one HTML file out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from sonarrec.errors import local, number_of
from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.match import ScoringOptions, scoring_options
from sonarrec.evaluation.pairs import Pair, read_pairs
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
from sonarrec.sonar import Sonar
from sonarrec.tables.outputs import check_output, write_page
from sonarrec.truth.table import read_truth

AnyPath = str | Path
MOST_SEEN = 6
MOST_MISTAKEN = 6
"""Pictures of sightings, and of each method's mistakes: each adds some 60 kB to the page."""


@dataclass(frozen=True, slots=True, repr=False)
class Report:
    """What was written.

    pictures: drawn frames on the page. held: frames that a click shows. unused: one line for each
    part of the input that could not be used.
    """

    path: Path
    pictures: int
    held: int
    unused: tuple[str, ...]

    def __repr__(self) -> str:
        return f"<{self.path}: {number_of(self.pictures, 'picture')}>"


def report(
    results: AnyPath = "sonarrec_out",
    out: AnyPath | None = None,
    *,
    ground_truth: AnyPath | None = None,
    pairs: AnyPath | None = None,
    logs: AnyPath | Sequence[AnyPath] = (),
    topic: str | None = None,
    options: ScoringOptions | None = None,
    **scoring: Any,
) -> Report:
    """Write results, of one log or of several, as one HTML page; returns what was written.

    out: default: report.html in `results`, or beside `pairs`: a table that names results and truth
    of each log, in place of results and ground_truth. Without either nothing is scored. logs: the
    recordings that the results came from, or folders with such; without them the page shows no
    frames. topic: the image channel of an MCAP recording, if run.toml does not name it. scoring: as
    `evaluate` takes it, `method` to `sonar`, or options made of them; the sightings and tracks of
    the first method are shown.
    Raises SonarrecError where files cannot be used, read or written.
    """
    options = options or scoring_options(**scoring)
    beside = Path(results) if pairs is None else Path(pairs).parent
    path = Path(local(out or beside / "report.html"))
    truth_file = None if ground_truth is None else Path(local(ground_truth))
    recordings = [Path(logs)] if isinstance(logs, AnyPath) else [*map(Path, logs)]
    check_output(path, "report", [truth_file, pairs and Path(pairs), *recordings])
    rows = None if pairs is None else read_pairs(Path(pairs))
    evaluation: Evaluation | None = None
    if rows is None and truth_file is None:
        to_show = [LogToShow(folder) for folder in find_logs(Path(results))]
        in_all = len(to_show)
    else:
        evaluation = evaluate_logs(rows or results, truth_file, options)
        to_show, in_all = _scored_logs(evaluation, rows, truth_file), len(evaluation.folders)
    reported, unread = read_logs(to_show, options)
    mistakes = {} if evaluation is None else _mistakes(reported, evaluation)
    sonar = options.sonar or Sonar()
    pictures, shown, missing = _draw_all(reported, mistakes, recordings, sonar, topic)
    incomplete = (line for log in reported for line in not_whole(log.results, "shown"))
    unused = (*(incomplete if evaluation is None else evaluation.unused), *unread, *missing)
    truth = Path(pairs) if pairs else truth_file
    write_page(path, render(reported, evaluation, mistakes, truth, pictures, shown, unused, in_all))
    return Report(path, len(pictures), sum(len(log["frames"]) for log in shown), unused)


def _scored_logs(
    evaluation: Evaluation, rows: Sequence[Pair] | None, truth_file: Path | None
) -> list[LogToShow]:
    """The first logs of an evaluation, which has distinct names, each recording once, and no log
    that cannot be read. rows: its pairs, or truth_file: the truth of all logs."""
    truth, to_show = cache(read_truth), list[LogToShow]()
    pair_of = {row.results: row for row in reversed(rows or ())}  # a log may be named twice
    for folder, name in zip(evaluation.folders, evaluation.counts.logs, strict=True):
        if len(to_show) < MOST_LOGS:
            pair = pair_of.get(folder) or Pair(folder, truth_file or folder)
            to_show.append(LogToShow(folder, truth(pair.ground_truth), pair.log, name))
    return to_show


def _mistakes(logs: Sequence[ReportedLog], evaluation: Evaluation) -> dict[str, list[Episode]]:
    """The mistakes in some logs by each method that any of them has."""
    matched = [log.matched for log in logs if log.matched is not None]
    protocol = protocols(evaluation.counts)[0]
    return {
        method: episodes(matched, method, protocol)
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
            *(s.log.name, s.log.tracker, s.log.frame_of(s.surest)),
            *("surest" if is_best else "rarest", f"{caption}."),
            f"False claim: {s.wrong}." if s.wrong else "",
        )
