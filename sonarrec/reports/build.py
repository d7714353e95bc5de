"""`sonarrec report`, for programs as well: results and truth in, one HTML file out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from sonarrec.advice.results import of_results
from sonarrec.errors import Diagnostics, SonarrecError, UsageError, is_url, number_of, refuse_url
from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.pairs import find_truths
from sonarrec.evaluation.rows import ScoringOptions, scoring_options
from sonarrec.evaluation.write import Evaluation
from sonarrec.reports import frames
from sonarrec.reports.frames import Picture, Shown, open_recording
from sonarrec.reports.logs import (
    JudgedSighting,
    LogToShow,
    ReportedLog,
    judged_sightings,
    read_logs,
)
from sonarrec.reports.overview import NO_TRUTH, SharedMistake, all_logs, shared, worst_first
from sonarrec.reports.page import MOST_MISTAKES, render
from sonarrec.results.read import find_logs, why_incomplete
from sonarrec.results.run_file import read_run
from sonarrec.runs.recorded import outdated, recorded_at
from sonarrec.sonar.stated import Sonar
from sonarrec.tables.outputs import below, check_output, write_page
from sonarrec.truth.table import read_truth

AnyPath = str | Path
MOST_SEEN = MOST_MISTAKEN = 6
"""Pictures of sightings, and of each method's mistakes: each adds some 60 kB to the page."""


@dataclass(frozen=True, slots=True, repr=False)
class Report:
    """What was written."""

    path: Path
    pictures: int
    """Drawn frames on the page."""
    held: int
    """Frames that a click shows."""
    unused: tuple[str, ...]
    """One line for each part of the input that could not be used."""
    notes: tuple[str, ...] = ()
    """What else to know."""


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
    """Write the results of one log or of several as one HTML page.

    Parameters
    ----------
    results : str or Path, default "sonarrec_out"
        The folder of one log's results, or a folder of such folders.
    out : str or Path, optional
        The page. Default: report.html in `results`.
    ground_truth : str or Path, optional
        One table for all logs. Default: each log's own gt.csv, if all have one.
    logs : str, Path or sequence of these, optional
        The recordings that the results came from, or folders of such. Default: where they were.
    topic : str, optional
        The image channel of an MCAP recording, if run.toml does not name it.
    options : ScoringOptions, optional
        How results are scored, in place of `scoring`.
    **scoring
        `method`, `min_visible`, `tolerance_s`, `within_m`, `landmarks` and `sonar` as in
        `evaluate`. The sightings and tracks of the first method are shown.

    Returns
    -------
    Report
        The path of the page, what it holds, and what could not be used.

    Raises
    ------
    SonarrecError
        Files cannot be used, read or written.
    UsageError
        An option is invalid.
    """
    options = options or scoring_options(**scoring)
    path, folders = (
        Path(refuse_url(out or below(Path(results), "report.html"))),
        find_logs(Path(results)),
    )
    truth_file = None if ground_truth is None else Path(refuse_url(ground_truth))
    given = [Path(logs)] if isinstance(logs, AnyPath) else [*map(Path, logs)]
    check_output(path, "report", [truth_file, *given])
    diagnostics, left_out = Diagnostics(), dict[Path, str]()
    evaluation = _evaluate(Path(results), folders, truth_file, options, diagnostics, left_out)
    to_show = _of_one_set(folders, evaluation, options, diagnostics, left_out)
    reported, unread = read_logs(to_show, options)
    rows = all_logs(Path(results), folders, evaluation, left_out)
    mistakes = {}
    if evaluation is not None:
        mistakes = _mistakes(evaluation, reported[0].tracker, several=len(rows) > 1)
    sonar = options.sonar or Sonar()
    pictures, shown, missing = _draw_all(reported, mistakes, (given, folders), sonar, topic)
    if evaluation is None:
        diagnostics.problem(
            *(line for log in reported for line in why_incomplete(log.results, "shown"))
        )
    unused = (*diagnostics.problems, *unread, *missing)
    page = render(reported, evaluation, mistakes, truth_file, pictures, shown, unused, rows)
    write_page(path, page)
    held = sum(len(log["frames"]) for log in shown)
    return Report(path, len(pictures), held, unused, tuple(outdated(folders)))


def _evaluate(
    results: Path,
    folders: Sequence[Path],
    truth_file: Path | None,
    options: ScoringOptions,
    diagnostics: Diagnostics,
    left_out: dict[Path, str],
) -> Evaluation | None:
    """The scores of the logs that have a truth; None if there is none. left_out: gets the others.

    truth_file: that of all logs; None: the gt.csv of each.
    """
    if truth_file is None:
        try:
            pairs = find_truths(folders, diagnostics)
        except UsageError:  # no log has one
            return None
        except SonarrecError as error:  # such as one for several logs that names none of them
            diagnostics.problem(f"{error}; nothing is scored")
            return None
        left_out |= dict.fromkeys({*folders} - {pair.results for pair in pairs}, NO_TRUTH)
        evaluation = evaluate_logs(pairs, None, options, of_results)
    else:
        evaluation = evaluate_logs(results, truth_file, options, of_results)
    diagnostics.problem(*evaluation.unused)
    return evaluation


def _of_one_set(
    folders: Sequence[Path],
    evaluation: Evaluation | None,
    options: ScoringOptions,
    diagnostics: Diagnostics,
    left_out: dict[Path, str],
) -> list[LogToShow]:
    """The logs of one landmark set, that of the evaluation or of most logs: scored ones first, the
    worst of them first. left_out: gets the others."""
    ids: dict[Path, frozenset[int]] = {}
    for folder in folders:
        with suppress(SonarrecError):  # reported where its tables are read
            landmarks = read_run(folder / "run.toml").landmark_set(options.landmarks)
            ids[folder] = frozenset(landmarks.ids)
    scored: Sequence[Path] = () if evaluation is None else evaluation.folders
    of_page = Counter(ids[f] for f in scored or folders if f in ids).most_common(1)
    others = [f for f in folders if f in ids and ids[f] != of_page[0][0]]
    for folder in others:
        left_out[folder] = "another landmark set"
        if evaluation is None:
            diagnostics.problem(f"{folder}: another landmark set than that of most logs; not shown")
    to_show = []
    if evaluation is not None:
        truth = cache(read_truth)
        for n in worst_first(evaluation.counts):
            name, gt = evaluation.counts.logs[n], evaluation.truths[n]
            to_show.append(LogToShow(scored[n], truth(gt), evaluation.counts.counted[n].name, name))
    return [*to_show, *(LogToShow(f) for f in folders if f not in {*scored, *others})]


def _mistakes(
    evaluation: Evaluation, first: str, *, several: bool
) -> dict[str, list[SharedMistake]]:
    """The mistakes of each method, on the page of several logs those of the first alone."""
    logs = len(evaluation.folders)
    methods = sorted(evaluation.counts.methods, key=lambda method: method != first)
    if several:  # those of the others would be most of the page
        methods = [first]
    return {method: shared(evaluation.counts.mistakes, method, logs) for method in methods}


def _draw_all(
    logs: Sequence[ReportedLog],
    mistakes: Mapping[str, Sequence[SharedMistake]],
    recordings: tuple[Sequence[Path], Sequence[Path]],
    sonar: Sonar,
    topic: str | None,
) -> tuple[list[Picture], list[Shown], list[str]]:
    """Pictures and frames of the logs' recordings; a line for each that was not found.

    recordings: those given, else they are looked for where they were; and the results of all logs,
    also of those without panels.
    """
    given, folders = recordings
    sources, missing = frames.match_recordings(logs, given, folders) if given else _where(logs)
    recorded = [log for log in logs if log.name in sources]
    passes = [s for log in recorded for s in judged_sightings(log)]
    pictures = [*_of_sightings(passes)]
    for method, of_method in mistakes.items():
        surest = [shared.shown(sources) for shared in of_method]
        for m in [m for m in surest if m.log in sources and not m.at_start][:MOST_MISTAKEN]:
            wrong = f"{m.in_words}."
            pictures.append(Picture(m.log, method, m.worst_frame, "mistake", "", wrong=wrong))
    held = frames.choose(recorded, _named_frames(passes, mistakes, pictures))
    most_bytes = frames.MOST_BYTES // max(1, sum(map(len, held.values())))  # for each frame
    shown = []
    for log in recorded:
        own = [picture for picture in pictures if picture.log == log.name]
        with open_recording(sources[log.name], log, sonar, topic) as recording:
            shown.append(frames.read_frames(recording, log, own, held[log.name], most_bytes))
    return pictures, shown, missing


def _where(logs: Sequence[ReportedLog]) -> tuple[dict[str, Path], list[str]]:
    """The recordings that results were made from, by the log's name; a line for each that is not
    there any more."""
    paths, missing = dict[str, Path](), list[str]()
    for log in logs:
        source = log.results.run.input
        try:
            paths[log.name] = Path(recorded_at(log.folder, source).path)
        except SonarrecError as error:
            if source.path is None or is_url(source.path):
                continue  # no log was ever here
            truth = "" if log.matched else " and --ground-truth, for its gt.csv is not found either"
            missing.append(f"{log.folder}: {error}; no frame of it is shown; give --log{truth}")
    return paths, missing


def _named_frames(
    passes: Sequence[JudgedSighting],
    mistakes: Mapping[str, Sequence[SharedMistake]],
    pictures: Sequence[Picture],
) -> Iterator[tuple[str, int]]:
    """(log, frame) of all frames that the page names, the most interesting first."""
    yield from ((picture.log, picture.frame) for picture in pictures)
    yield from ((s.log.name, s.log.frame_of(s.surest)) for s in passes)
    for of_method in mistakes.values():
        yield from ((m.log, m.worst_frame) for s in of_method[:MOST_MISTAKES] for m in s.members)
    for s in passes:
        yield s.log.name, s.sighting.first_frame
        yield s.log.name, s.sighting.last_frame


def _of_sightings(passes: Sequence[JudgedSighting]) -> Iterator[Picture]:
    """The surest frame of each declared landmark, then the shortest sightings."""

    def order(s: JudgedSighting) -> tuple[float, ...]:
        # Of equal scores as printed: a true claim first, then the longest sighting.
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
            marked=int(s.log.results.object[s.surest]),
        )
