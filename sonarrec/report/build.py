"""`sonarrec report`, for programs as well: results and truth in, one HTML file out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarrec.evaluation.evaluate import Evaluation, evaluate
from sonarrec.outputs import check_output
from sonarrec.readers import open_log
from sonarrec.records import SonarrecError, UsageError
from sonarrec.report.logs import ReportedLog, read_logs, seen
from sonarrec.report.mistakes import episodes, told
from sonarrec.report.page import render
from sonarrec.report.pictures import Picture, Wanted, draw
from sonarrec.results.run_file import Given
from sonarrec.sonar import Sonar
from sonarrec.truth.table import read_truth

MOST_SEEN = 3
MOST_MISTAKEN = 6
"""Pictures of sightings, and of each method's mistakes: each adds some 60 kB to the page."""


@dataclass(frozen=True, slots=True)
class Report:
    """What was written. unused: one line for each part of the input that could not be used."""

    path: Path
    pictures: int
    unused: tuple[str, ...]


def write_report(
    path: Path,
    results: Path,
    *,
    ground_truth: Path | None = None,
    recordings: Sequence[Path] = (),
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    landmarks: str | None = None,
    sonar: Sonar | None = None,
    topic: str | None = None,
    method: str | None = None,
) -> Report:
    """Write the report on a results folder (of one log or of several) to `path`.

    recordings: the logs that the results came from, told apart by their names; without them the
    page has no frames. The other arguments are those of `evaluation.evaluate.evaluate`; topic
    chooses the channel of an MCAP recording, where run.toml does not tell it; method
    is the one whose sightings and tracks are shown, as in `logs.read_logs`.
    Raises SonarrecError where files cannot be used, read or written.
    """
    check_output(path, "report", [ground_truth, *recordings])
    sonar = sonar or Sonar()
    evaluation = None
    if ground_truth is not None:
        evaluation = evaluate(
            results,
            ground_truth,
            min_visible=min_visible,
            tolerance_s=tolerance_s,
            landmarks=landmarks,
            sonar=sonar,
        )
    logs = read_logs(
        results,
        None if ground_truth is None else read_truth(ground_truth),
        min_visible=min_visible,
        tolerance_s=tolerance_s,
        landmarks=landmarks,
        sonar=sonar,
        method=method,
    )
    pictures = _draw_all(logs, evaluation, recordings, sonar, topic)
    unused = evaluation.unused if evaluation is not None else tuple(_left_out(logs))
    page = render(logs, evaluation, ground_truth, pictures, unused)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be written ({error.strerror})") from None
    return Report(path, len(pictures), unused)


def _left_out(logs: Sequence[ReportedLog]) -> Iterator[str]:
    """What `evaluate` tells of results that are not whole, where nothing is evaluated."""
    for log in logs:
        name, found = log.results.name, log.results
        if not found.finished:
            yield (
                f"{name}: the run was cut short (run.toml says finished = false); "
                f"only its {len(found.frame)} frames are shown"
            )
        if found.strays:
            yield (
                f"{name}: {found.strays} estimates lie on frames that frames.csv does not list; "
                "they are not shown"
            )


def _draw_all(
    logs: Sequence[ReportedLog],
    evaluation: Evaluation | None,
    recordings: Sequence[Path],
    sonar: Sonar,
    topic: str | None,
) -> list[Picture]:
    """The frames worth seeing of the logs whose recordings were given."""
    sources = dict(_matched(logs, path) for path in recordings)
    wanted = _wanted([log for log in logs if log.results.name in sources], evaluation)
    drawn: dict[Wanted, Picture] = {}
    for log in logs:
        mine = [w for w in wanted if w.log == log.results.name]
        if mine:
            given = log.run.lay_under(Given(sonar, topic=topic), same_log=True)
            source, time = sources[log.results.name], given.time or "log"
            with open_log(source, sonar=given.sonar, topic=given.topic, time=time) as recording:
                drawn |= draw(recording, log, mine)
    return [drawn[w] for w in wanted]


def _matched(logs: Sequence[ReportedLog], path: Path) -> tuple[str, Path]:
    """(name of the log whose recording this is, path); the only log's whatever its name."""
    names = [log.results.name for log in logs]
    if len(names) == 1:
        return names[0], path
    for name in (path.resolve().name, path.stem):
        if name in names:
            return name, path
    raise UsageError(f"--log {path}: no results bear this name; there are {', '.join(names)}")


def _wanted(logs: Sequence[ReportedLog], evaluation: Evaluation | None) -> list[Wanted]:
    """Of each sighting the surest frame, in order of time; of each mistake the worst, in order."""
    seen = [
        Wanted(log.results.name, log.tracker, frame, f"Frame {frame}: {text}", is_mistake=False)
        for log in logs
        for frame, text in _surest(log)[: max(1, MOST_SEEN // len(logs))]
    ]
    wanted = seen[:MOST_SEEN]
    if evaluation is None:
        return wanted
    names = {log.results.name for log in logs}
    for method in evaluation.joined.methods:
        found = [e for e in episodes(evaluation, method) if e.log in names]
        wanted += [
            Wanted(
                e.log,
                method,
                e.worst,
                f"Frame {e.worst}: {told(e, evaluation.joined)}",
                is_mistake=True,
            )
            for e in found[:MOST_MISTAKEN]
        ]
    return wanted


def _surest(log: ReportedLog) -> list[tuple[int, str]]:
    """(frame, what is seen there) of each sighting; without any, of what came nearest to one."""
    found = [
        (s.surest, f"ID.{s.sighting.landmark}, score {s.sighting.best_score:.2f}")
        for s in seen(log)
    ]
    mine = np.flatnonzero(log.of_method(log.tracker))
    if found or not len(mine):
        return found
    best = mine[np.argmax(log.results.score[mine])]
    landmark = log.results.landmarks.ids[log.results.landmark[best]]
    text = f"nothing declared; nearest to it ID.{landmark}, score {log.results.score[best]:.2f}"
    return [(int(log.results.frame[log.results.row[best]]), text)]
