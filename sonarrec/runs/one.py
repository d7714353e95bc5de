"""Runs one log through the recogniser and writes its results: `sonarrec run`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from heapq import nlargest
from pathlib import Path
from time import monotonic
from typing import Any

from sonarrec.errors import SonarrecError, is_url
from sonarrec.readers.log import FIRST_FRAMES
from sonarrec.readers.open import find_log, log_name, results_name
from sonarrec.results.folders import folder_names, part_of, rerun_left
from sonarrec.results.run_file import existing_results
from sonarrec.results.sightings import Sighting, Sightings, sightings_in
from sonarrec.results.write import ResultsWriter
from sonarrec.runs.job import Job, Observe, Outcome, Report
from sonarrec.runs.prepare import PreparedRun, prepare
from sonarrec.sonar.frame import Frame, Stamps

MOST_SIGHTINGS = 20
"""Kept of each method in an Outcome; sightings.csv has all."""


def result_names(logs: Sequence[str | Path]) -> list[str]:
    """The name of each log's results, all different, also of logs that do not exist now.

    Raises UsageError if two logs would have the same name.
    """
    named = []  # (the name of a log's results, where the log is)
    for log in logs:
        try:
            source = find_log(log)
            named.append((source.name, source.location.resolve()))
        except SonarrecError:  # reported when the log is run
            path = Path(log)
            with suppress(OSError):  # the current folder is gone
                path = path.absolute()
            named.append((results_name(log_name(Path(log))), path))
    return folder_names(named)


def run_job(job: Job, observe: Observe | None = None, report: Report = str) -> Outcome:
    """Run a job in this process. A fault of the input becomes an outcome; a bug raises."""
    start_s, local = monotonic(), job
    try:
        with at_hand(job) as local:
            outcome = run_log(local, observe, report)
            if is_url(job.out) and not outcome.up_to_date:
                from sonarrec.runs.remote import upload  # with fsspec, only where needed

                upload(local.folder, f"{job.out.rstrip('/')}/{job.name}")
    except SonarrecError as error:
        outcome = Outcome("failed", error=type(error)(local.shown(error)))
    return replace(outcome, seconds=monotonic() - start_s)


def plan_job(job: Job) -> str:
    """What `run_job` would do, and why; writes nothing. Raises SonarrecError as that would."""
    with at_hand(job) as local, prepare(local) as run:
        if local.overwrite:
            return "done again (asked for)"
        same, reason = existing_results(local.folder, run.table)
        if same is not None:
            return "; ".join(["up to date", *rerun_left(local.folder)])
        if reason:
            return f"done again ({reason})"
        stopped = part_of(local.folder).exists()
        return "done again (it was stopped before its end)" if stopped else "new"


@contextmanager
def at_hand(job: Job) -> Iterator[Job]:
    """The job with its log and its results on this machine, until the block ends.

    A file that cannot be opened inside raises SonarrecError, so that it costs this log only.
    """
    try:
        if not (is_url(job.log) or is_url(job.out)):
            yield job
            return
        from sonarrec.runs.remote import local_copy  # with fsspec, only where needed

        with local_copy(job) as local:
            yield local
    except OSError as error:
        if error.filename is None:  # not a fault of the input
            raise
        raise SonarrecError(f"{error.filename}: {error.strerror}") from None


def run_log(job: Job, observe: Observe | None = None, report: Report = str) -> Outcome:
    """Run a log that is at hand, and write its results.

    Results that would be the same are not made again, and those of another log are not replaced,
    except with `overwrite`. observe: called after each frame. report: called before the first
    frame with a line on what the run goes by. Raises SonarrecError for input or settings that
    cannot be used.
    """
    with prepare(job) as run:
        diagnostics, methods = run.log.diagnostics, run.recogniser.tracking
        # Are these very results there?
        if not job.overwrite:
            same, reason = existing_results(job.folder, run.table)
            if same is not None:
                return _outcome(
                    job.folder,
                    methods,
                    same.problems,
                    frames=same.frames_processed,
                    unusable=same.frames_unusable,
                    candidates=same.candidates,
                    notes=[job.shown(line) for line in rerun_left(job.folder)],
                    up_to_date=True,
                )
            if reason:
                diagnostics.note(f"earlier results are replaced ({reason})", about=job.folder)
        # Recognise the landmarks frame by frame, and write what is found.
        report(job.shown(run.basis))
        collector = Sightings(run.landmarks, run.fan, run.poses)
        with ResultsWriter(job.folder, run.landmarks, run.table, collector) as writer:
            _recognise(run, writer, observe)
            run.recogniser.report(diagnostics)
            problems = [job.shown(line) for line in diagnostics.problems]
            about_folder = writer.finish(problems, diagnostics.unusable)
        # Sum up.
        outcome = _outcome(
            job.folder,
            methods,
            problems,
            frames=writer.frames,
            unusable=diagnostics.unusable,
            candidates=writer.candidates,
        )
        if job.advise is not None:
            diagnostics.advise(job.advise(run, has_sightings=any(outcome.passes.values())))
        notes = [*diagnostics.notes, *about_folder]
        return replace(outcome, notes=[job.shown(line) for line in notes])


def _recognise(run: PreparedRun, writer: ResultsWriter, observe: Observe | None) -> None:
    """Recognise every frame and write the results, also those waiting when the run is stopped."""
    stamps = dict[int, Stamps]()  # of frames that are not written yet, in their order

    def frames() -> Iterator[Frame]:
        for frame in run.frames:
            stamps[frame.index] = frame.stamps
            if len(run.first) < FIRST_FRAMES:
                run.first.append(frame)
            yield frame

    try:
        for result in run.recogniser.recognise(frames()):
            writer.write(result, stamps[result.index])
            del stamps[result.index]
            if observe is not None:
                observe(result, run.frame_count)
    except BaseException:  # Ctrl-C as well: keep what is there
        if not writer.full:
            stamps.pop(writer.last, None)
            for result in run.recogniser.waiting():
                if result.index == next(iter(stamps), None):  # none twice, none after a gap
                    writer.write(result, stamps.pop(result.index))
        raise


def _outcome(
    folder: Path, methods: Sequence[str], problems: Sequence[str], **counted: Any
) -> Outcome:
    """The outcome of a log with results in `folder`, with what their sightings.csv holds.

    methods: those that follow objects. counted: other fields.
    """
    passes, landmarks = dict.fromkeys(methods, 0), Counter[int]()

    def of_method(method: str) -> Iterator[Sighting]:
        for sighting in sightings_in(folder / "sightings.csv"):
            if sighting.method == method:
                passes[method] += 1
                if method == methods[0]:
                    landmarks[sighting.landmark] += sighting.frames_declared
                yield sighting

    sightings: list[Sighting] = []
    for method in methods:
        longest = nlargest(MOST_SIGHTINGS, of_method(method), key=lambda s: s.frames_declared)
        sightings += sorted(longest, key=lambda s: (s.first_frame, s.last_frame))
    return Outcome(
        status="partial" if problems else "done",
        folder=folder,
        problems=problems,
        passes=passes,
        sightings=sightings,
        landmarks=dict(landmarks),
        **counted,
    )
