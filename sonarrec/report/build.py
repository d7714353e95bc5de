"""`sonarrec report`, for programs as well: results and truth in, one HTML file out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sonarrec.evaluation.cells import protocols
from sonarrec.evaluation.evaluate import DEFAULT, Evaluation, evaluate_many, evaluate_whole
from sonarrec.evaluation.matching.options import ScoringOptions
from sonarrec.evaluation.matching.pairs import Pair, read_pairs
from sonarrec.files.outputs import check_output, write_page
from sonarrec.report import frames
from sonarrec.report.logs import MOST_LOGS, ReportedLog, Seen, read_logs, seen, told_false
from sonarrec.report.mistakes import Episode, episodes, told
from sonarrec.report.page import MOST_MISTAKES, Drawn, Many, render
from sonarrec.report.pictures import Picture, Wanted
from sonarrec.report.recordings import match_recordings, open_recording
from sonarrec.report.standing import chosen, standing
from sonarrec.results.read import find_logs, not_whole
from sonarrec.sonar import Sonar
from sonarrec.truth.table import read_truth

MOST_SEEN = 6
MOST_MISTAKEN = 6
"""Pictures of sightings, and of each method's mistakes: each adds some 60 kB to the page."""


@dataclass(frozen=True, slots=True)
class Report:
    """What was written. pictures: of the log's frames; held: frames shown on a click. unused: one
    line for each part of the input that could not be used."""

    path: Path
    pictures: int
    held: int
    unused: tuple[str, ...]


# Long by its parameters and what is said of them.
def write_report(
    path: Path,
    results: Path | None = None,
    *,
    ground_truth: Path | None = None,
    pairs: Path | None = None,
    recordings: Sequence[Path] = (),
    options: ScoringOptions = DEFAULT,
    topic: str | None = None,
    method: str | None = None,
) -> Report:
    """Write the report on a results folder (of one log or of several) to `path`.

    pairs: in place of results and ground_truth, a table of them.
    recordings: the logs that the results came from, or folders with such logs, told apart by
    their names; without them the page has no frames. options: as of
    `evaluation.evaluate.evaluate_whole`. topic: chooses the channel of an MCAP recording, where
    run.toml does not tell it. method: whose sightings and tracks are shown, as in `logs.read_logs`.
    Raises SonarrecError where files cannot be used, read or written.
    """
    check_output(path, "report", [ground_truth, pairs, *recordings])
    rows = [] if pairs is None else read_pairs(pairs)
    if pairs is None:
        assert results is not None
        folders = find_logs(results)
        if ground_truth is not None:
            rows = [Pair(folder, ground_truth) for folder in folders]
    else:
        folders = [row.results for row in rows]
    in_all, pooled, stand = len(folders), None, []
    if in_all > MOST_LOGS:  # read one at a time; only some are shown
        if rows:
            given = rows if results is None else results
            pooled = evaluate_many(given, ground_truth, options)
        stand = standing(folders, pooled, results, options, method)
        folders = chosen(folders if pooled is None else pooled.folders, stand)
        folders = folders if pooled is None else folders[:MOST_LOGS]
        row_of = {row.results: row for row in reversed(rows)}  # of a log named twice the first
        rows = [row_of[folder] for folder in folders] if rows else rows
    evaluation: Evaluation | None = None
    if pairs is not None or pooled is not None:
        evaluation = evaluate_whole(rows, None, options, some=pooled is not None)
    elif ground_truth is not None:
        assert results is not None
        evaluation = evaluate_whole(results, ground_truth, options)
    logs, unread = _with_panels(folders, rows, evaluation, options, method)
    pooled = pooled or (None if evaluation is None else evaluation.pooled())
    in_all = in_all if pooled is None else len(pooled.logs)  # each once
    wrong = {}
    if evaluation is not None and pooled is not None:
        protocol = protocols(pooled)[0]
        wrong = {m: episodes(evaluation, m, protocol) for m in evaluation.joined.methods}
    drawn, missing = _draw_all(logs, evaluation, wrong, recordings, options.sonar or Sonar(), topic)
    own = (line for log in logs for line in not_whole(log.results, "shown"))
    unused = (*(own if pooled is None else pooled.unused), *unread, *missing)
    many = Many(in_all, stand)
    page = render(logs, evaluation, pooled, wrong, pairs or ground_truth, drawn, unused, many)
    write_page(path, page)
    return Report(path, len(drawn.pictures), sum(len(s.frames) for s in drawn.shown), unused)


def _with_panels(
    folders: Sequence[Path],
    rows: Sequence[Pair],
    evaluation: Evaluation | None,
    options: ScoringOptions,
    method: str | None,
) -> tuple[list[ReportedLog], list[str]]:
    """The logs that have panels, and a line for each that cannot be read.

    rows: the truth of each, where it is known.
    """
    if evaluation is None:
        no = [None] * len(folders)
        return read_logs(folders, no, no, options, method)
    # It tells equal names apart, counts copies of a log once and has left out what cannot be read.
    scored = dict(zip(evaluation.folders, evaluation.joined.logs, strict=True))
    first: dict[Path, Pair] = {}
    for row in rows:
        if row.results in scored:
            first.setdefault(row.results, row)  # it may be named twice
    mine = [*first.values()]
    tables = {file: read_truth(file) for file in {row.ground_truth for row in mine}}
    logs, unread = read_logs(
        [row.results for row in mine],
        [tables[row.ground_truth] for row in mine],
        [row.log for row in mine],
        options,
        method,
    )
    named = [replace(log, results=replace(log.results, name=scored[log.folder])) for log in logs]
    return named, unread


def _draw_all(
    logs: Sequence[ReportedLog],
    evaluation: Evaluation | None,
    wrong: Mapping[str, Sequence[Episode]],
    recordings: Sequence[Path],
    sonar: Sonar,
    topic: str | None,
) -> tuple[Drawn, list[str]]:
    """The frames worth seeing of the logs whose recordings were given; what was not found."""
    sources, missing = match_recordings(logs, recordings, sonar, topic)
    there = [log for log in logs if log.results.name in sources]
    passes = [(log, s) for log in there for s in seen(log)]
    wanted = [*_seen(there, passes), *_mistaken(evaluation, wrong, sources)]
    held = frames.choose(there, _told(passes, wrong, wanted))
    pictures: dict[Wanted, Picture] = {}
    shown: list[frames.ShownLog] = []
    for log in there:
        name = log.results.name
        mine = [w for w in wanted if w.log == name]
        with open_recording(sources[name], log, sonar, topic) as recording:
            found, part = frames.take(recording, log, mine, held[name], _share(held))
        pictures |= found
        shown.append(part)
    return Drawn([pictures[w] for w in wanted], shown), missing


def _share(held: Mapping[str, Sequence[int]]) -> int:
    """Bytes for each frame held."""
    return frames.MOST_BYTES // max(1, sum(map(len, held.values())))


def _told(
    passes: Sequence[tuple[ReportedLog, Seen]],
    wrong: Mapping[str, Sequence[Episode]],
    wanted: Sequence[Wanted],
) -> Iterator[tuple[str, int]]:
    """(log, frame) of all that the page names, the most telling first."""
    yield from ((w.log, w.frame) for w in wanted)
    yield from ((log.results.name, log.frame_of(s.surest)) for log, s in passes)
    for found in wrong.values():
        yield from ((e.log, e.worst) for e in found[:MOST_MISTAKES])
    for log, s in passes:
        yield log.results.name, s.sighting.first_frame
        yield log.results.name, s.sighting.last_frame


def _seen(logs: Sequence[ReportedLog], seen: Sequence[tuple[ReportedLog, Seen]]) -> list[Wanted]:
    """The surest frame of each declared landmark, then the sightings of the fewest frames."""
    if logs and not seen:
        return _nearest_to_one(logs)

    def sure(one: tuple[ReportedLog, Seen]) -> tuple[float, bool, int]:
        log, s = one
        # Of scores that print alike a true one, then the longest sighting, not the first.
        return -round(log.results.score[s.surest], 2), s.is_false, -s.sighting.frames_declared

    best = {
        k: min((one for one in seen if one[1].sighting.landmark == k), key=sure)
        for k in sorted({s.sighting.landmark for _, s in seen})
    }
    left = [one for one in seen if not any(one is b for b in best.values())]
    rare = sorted(left, key=lambda one: one[1].sighting.frames_declared)
    return [
        *(_wanted(log, s, "surest", "") for log, s in best.values()),
        *(
            _wanted(log, s, "rarest", f", declared in {s.sighting.frames_declared} frames")
            for log, s in rare[: max(0, MOST_SEEN - len(best))]
        ),
    ]


def _wanted(log: ReportedLog, seen: Seen, group: str, more: str) -> Wanted:
    score, frame = log.results.score[seen.surest], log.frame_of(seen.surest)
    wrong = f"False claim: {told_false(log, seen.surest)}." if seen.is_false else ""
    more = more.replace(" 1 frames", " 1 frame")
    caption = f"ID.{seen.sighting.landmark} ({score:.2f}){more}."
    return Wanted(log.results.name, log.tracker, frame, group, caption, wrong)


def _nearest_to_one(logs: Sequence[ReportedLog]) -> list[Wanted]:
    """Where nothing was declared: what came nearest to it."""
    best: tuple[float, ReportedLog, int] | None = None
    for log in logs:
        mine = np.flatnonzero(log.of_method(log.tracker))
        if len(mine):
            n = int(mine[np.argmax(log.results.score[mine])])
            score = float(log.results.score[n])
            if best is None or score > best[0]:
                best = score, log, n
    if best is None:
        return []
    score, log, n = best
    landmark = log.ids[log.results.landmark_index[n]]
    told = f"Nothing declared; nearest to it ID.{landmark} ({score:.2f})."
    return [Wanted(log.results.name, log.tracker, log.frame_of(n), "surest", told)]


def _mistaken(
    evaluation: Evaluation | None,
    wrong: Mapping[str, Sequence[Episode]],
    sources: Mapping[str, Path],
) -> list[Wanted]:
    """The worst frame of the worst mistakes, per method."""
    return [
        Wanted(e.log, method, e.worst, "mistake", "", f"{told(e, evaluation.joined)}.")
        for method, found in wrong.items()
        for e in [e for e in found if e.log in sources][:MOST_MISTAKEN]
        if evaluation is not None
    ]
