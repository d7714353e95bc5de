"""`sonarrec report`, for programs as well: results and truth in, one HTML file out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.errors import local, number_of
from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.match import Matched, ScoringOptions, scoring_options
from sonarrec.evaluation.pairs import Pair, read_pairs
from sonarrec.evaluation.screen import protocols
from sonarrec.evaluation.write import Evaluation
from sonarrec.reports import frames
from sonarrec.reports.frames import Picture, PictureRequest
from sonarrec.reports.logs import (
    MOST_LOGS,
    JudgedSighting,
    LogToShow,
    ReportedLog,
    false_claim_text,
    judged_sightings,
    read_logs,
)
from sonarrec.reports.mistakes import Episode, episodes, in_words
from sonarrec.reports.page import MOST_MISTAKES, render
from sonarrec.reports.recordings import match_recordings, open_recording
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
    folders, known, evaluation = _choose(Path(results), truth_file, rows, options)
    shown_folders = folders[:MOST_LOGS]
    of_shown = [row for row in known if row.results in shown_folders]
    reported, unread = _with_panels(shown_folders, of_shown, evaluation, options)
    mistakes = {}
    matched = {log.results.name: log.matched for log in reported if log.matched is not None}
    if evaluation is not None:
        protocol = protocols(evaluation.counts)[0]
        there = {method for log in matched.values() for method in log.methods}
        methods = [method for method in evaluation.counts.methods if method in there]
        mistakes = {method: episodes(matched, method, protocol) for method in methods}
    sonar = options.sonar or Sonar()
    pictures, shown, missing = _draw_all(reported, matched, mistakes, recordings, sonar, topic)
    incomplete = (line for log in reported for line in not_whole(log.results, "shown"))
    unused = (*(incomplete if evaluation is None else evaluation.unused), *unread, *missing)
    in_all = len(folders if evaluation is None else evaluation.folders)
    truth = Path(pairs) if pairs else truth_file
    write_page(path, render(reported, evaluation, mistakes, truth, pictures, shown, unused, in_all))
    return Report(path, len(pictures), sum(len(s.frames) for s in shown), unused)


def _choose(
    results: Path,
    ground_truth: Path | None,
    rows: list[Pair] | None,
    options: ScoringOptions,
) -> tuple[list[Path], list[Pair], Evaluation | None]:
    """(the folders of the logs, their truth if it is known, their scores).

    rows: results and truth of each log, in place of the other two.
    """
    if rows is None:
        folders = find_logs(results)
        truth = [Pair(folder, ground_truth) for folder in folders] if ground_truth else []
    else:
        folders, truth = [row.results for row in rows], rows
    if not truth:
        return folders, [], None
    evaluation = evaluate_logs(rows or results, ground_truth, options)
    if len(folders) > MOST_LOGS:
        folders = [*evaluation.folders]  # those that can be scored
    return folders, truth, evaluation


def _with_panels(
    folders: Sequence[Path],
    rows: Sequence[Pair],
    evaluation: Evaluation | None,
    options: ScoringOptions,
) -> tuple[list[ReportedLog], list[str]]:
    """The logs that have panels, and a line for each that cannot be read. rows: their truth."""
    if evaluation is None:
        return read_logs([LogToShow(folder) for folder in folders], options)
    # The evaluation has distinct names, each recording once, and no log that cannot be read.
    scored = dict(zip(evaluation.folders, evaluation.counts.logs, strict=True))
    first: dict[Path, Pair] = {}
    for row in rows:
        if row.results in scored:
            first.setdefault(row.results, row)  # a log may be named twice
    truths = [*first.values()]
    tables = {file: read_truth(file) for file in {row.ground_truth for row in truths}}
    to_show = [LogToShow(row.results, tables[row.ground_truth], row.log) for row in truths]
    logs, unread = read_logs(to_show, options)
    named = (replace(log, results=replace(log.results, name=scored[log.folder])) for log in logs)
    return list(named), unread


def _draw_all(
    logs: Sequence[ReportedLog],
    matched: Mapping[str, Matched],
    mistakes: Mapping[str, Sequence[Episode]],
    recordings: Sequence[Path],
    sonar: Sonar,
    topic: str | None,
) -> tuple[list[Picture], list[frames.ShownLog], list[str]]:
    """Pictures and frames of the recordings given; a line for each recording not found."""
    sources, missing = match_recordings(logs, recordings, sonar, topic)
    recorded = [log for log in logs if log.results.name in sources]
    passes = [(log, s) for log in recorded for s in judged_sightings(log)]
    requests = _sighting_requests(recorded, passes)
    for method, of_method in mistakes.items():
        for e in [e for e in of_method if e.log in sources][:MOST_MISTAKEN]:
            wrong = f"{in_words(e, matched[e.log])}."
            requests.append(PictureRequest(e.log, method, e.worst, "mistake", "", wrong))
    frames_held = frames.choose(recorded, _named_frames(passes, mistakes, requests))
    most_bytes = frames.MOST_BYTES // max(1, sum(map(len, frames_held.values())))  # for each frame
    pictures: dict[PictureRequest, Picture] = {}
    shown_logs: list[frames.ShownLog] = []
    for log in recorded:
        name = log.results.name
        requested = [w for w in requests if w.log == name]
        with open_recording(sources[name], log, sonar, topic) as recording:
            taken, shown_log = frames.take(recording, log, requested, frames_held[name], most_bytes)
        pictures |= taken
        shown_logs.append(shown_log)
    return [pictures[w] for w in requests], shown_logs, missing


def _named_frames(
    passes: Sequence[tuple[ReportedLog, JudgedSighting]],
    mistakes: Mapping[str, Sequence[Episode]],
    requests: Sequence[PictureRequest],
) -> Iterator[tuple[str, int]]:
    """(log, frame) of all frames that the page names, the most interesting first."""
    yield from ((w.log, w.frame) for w in requests)
    yield from ((log.results.name, log.frame_of(s.surest)) for log, s in passes)
    for of_method in mistakes.values():
        yield from ((e.log, e.worst) for e in of_method[:MOST_MISTAKES])
    for log, s in passes:
        yield log.results.name, s.sighting.first_frame
        yield log.results.name, s.sighting.last_frame


def _sighting_requests(
    logs: Sequence[ReportedLog], passes: Sequence[tuple[ReportedLog, JudgedSighting]]
) -> list[PictureRequest]:
    """The surest frame of each declared landmark, then the shortest sightings."""
    if logs and not passes:
        return _nearest_to_declared(logs)

    def sure(pair: tuple[ReportedLog, JudgedSighting]) -> tuple[float, bool, int]:
        log, s = pair
        # Of scores that print alike: a true claim first, then the longest sighting.
        return -round(log.results.score[s.surest], 2), s.is_false, -s.sighting.frames_declared

    best = {
        k: min((pair for pair in passes if pair[1].sighting.landmark == k), key=sure)
        for k in sorted({s.sighting.landmark for _, s in passes})
    }
    others = [pair for pair in passes if not any(pair is b for b in best.values())]
    rare = sorted(others, key=lambda pair: pair[1].sighting.frames_declared)
    return [
        *(_sighting_request(log, s, "surest", "") for log, s in best.values()),
        *(
            _sighting_request(
                log, s, "rarest", f", declared in {number_of(s.sighting.frames_declared, 'frame')}"
            )
            for log, s in rare[: max(0, MOST_SEEN - len(best))]
        ),
    ]


def _sighting_request(
    log: ReportedLog, judged: JudgedSighting, group: str, more: str
) -> PictureRequest:
    score, frame = log.results.score[judged.surest], log.frame_of(judged.surest)
    wrong = f"False claim: {false_claim_text(log, judged.surest)}." if judged.is_false else ""
    caption = f"ID.{judged.sighting.landmark} ({score:.2f}){more}."
    return PictureRequest(log.results.name, log.tracker, frame, group, caption, wrong)


def _nearest_to_declared(logs: Sequence[ReportedLog]) -> list[PictureRequest]:
    """The estimate of the highest score, for logs in which nothing was declared."""
    nearest: tuple[float, ReportedLog, int] | None = None
    for log in logs:
        of_method = np.flatnonzero(log.of_method(log.tracker))
        if len(of_method):
            n = int(of_method[np.argmax(log.results.score[of_method])])
            score = float(log.results.score[n])
            if nearest is None or score > nearest[0]:
                nearest = score, log, n
    if nearest is None:
        return []
    score, log, n = nearest
    landmark = log.ids[log.results.landmark_index[n]]
    caption = f"Nothing declared; nearest to it ID.{landmark} ({score:.2f})."
    return [PictureRequest(log.results.name, log.tracker, log.frame_of(n), "surest", caption)]
