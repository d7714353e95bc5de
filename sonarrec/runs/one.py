"""Runs one log through the recogniser and writes its results: `sonarrec run`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from heapq import nlargest
from pathlib import Path
from time import monotonic

from sonarrec.drawing.geometry import disc_width_px, hardly_seen, too_narrow
from sonarrec.errors import SonarrecError, command_line, is_url
from sonarrec.landmarks import load_landmarks
from sonarrec.readers.open import find_log, log_name, results_name
from sonarrec.readers.plausible import Plausibility
from sonarrec.records import Frame, Stamps
from sonarrec.results.folders import folder_names, part_of, rerun_left
from sonarrec.results.run_file import existing_results, rerun
from sonarrec.results.sightings import Sighting, Sightings, sightings_in
from sonarrec.results.write import ResultsWriter
from sonarrec.runs.job import Job, Observe, Outcome, Report
from sonarrec.runs.prepare import PreparedRun, prepare
from sonarrec.tables.outputs import free_name

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
        existing = existing_results(local.folder, run.table)
        if existing.up_to_date:
            return "; ".join(["up to date", *rerun_left(local.folder)])
        if existing.reason:
            return f"done again ({existing.reason})"
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
            existing = existing_results(job.folder, run.table)
            if existing.up_to_date:
                return _with_sightings(
                    methods,
                    Outcome(
                        status="partial" if existing.problems else "done",
                        folder=job.folder,
                        frames=existing.frames,
                        unusable=existing.unusable,
                        candidates=existing.candidates,
                        problems=existing.problems,
                        notes=[job.shown(line) for line in rerun_left(job.folder)],
                        up_to_date=True,
                    ),
                )
            if existing.reason:
                diagnostics.note(
                    f"earlier results are replaced ({existing.reason})", about=job.folder
                )
        # Recognise the landmarks frame by frame, and write what is found.
        report(job.shown(run.basis))
        plausibility = Plausibility()
        collector = Sightings(run.landmarks, run.fan, run.poses)
        with ResultsWriter(job.folder, run.landmarks, run.table, collector) as writer:
            _recognise(run, writer, plausibility, observe)
            run.recogniser.report(diagnostics)
            problems = [job.shown(line) for line in diagnostics.problems]
            about_folder = writer.finish(problems, diagnostics.unusable)
        # Sum up.
        outcome = _with_sightings(
            methods,
            Outcome(
                status="partial" if problems else "done",
                folder=job.folder,
                frames=writer.frames,
                unusable=diagnostics.unusable,
                candidates=writer.candidates,
                problems=problems,
            ),
        )
        notes = _notes(job, run, plausibility, about_folder, found=any(outcome.passes.values()))
        return replace(outcome, notes=[job.shown(line) for line in notes])


def _recognise(
    run: PreparedRun,
    writer: ResultsWriter,
    plausibility: Plausibility,
    observe: Observe | None,
) -> None:
    """Recognise every frame and write the results, also those waiting when the run is stopped."""
    stamps = dict[int, Stamps]()  # of frames that are not written yet, in their order

    def frames() -> Iterator[Frame]:
        for frame in run.frames:
            stamps[frame.index] = frame.stamps
            plausibility.inspect(frame)
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


def _notes(
    job: Job,
    run: PreparedRun,
    plausibility: Plausibility,
    about_folder: Sequence[str],
    *,
    found: bool,
) -> list[str]:
    """The notes for the user at the end of a run, without the problems.

    about_folder: of ResultsWriter.finish. found: whether any landmark was declared.
    """
    log, note, path = run.log, run.log.diagnostics.note, run.log.path
    static, saturated, cause = run.recogniser.restored
    doubts = plausibility.contradictions(log.sonar)
    narrow = too_narrow(run.fan, run.landmarks)  # which explains what the notes it omits would ask
    if doubts:
        note(f"{'; '.join(doubts)}; {_preview(job, run)} shows it")
    elif not narrow and (other := run.recogniser.sizes.other()):
        note(
            f"rings of about {other:.2g} m radius fit clearly better than those of "
            f"{run.landmarks.name}, {run.landmarks.radius_m:g} m; check radius_m and the range "
            f"window: {_preview(job, run)}"
        )
    for why in (hardly_seen(run.fan, run.landmarks), log.sonar.steep(run.fan.tilt_deg)):
        if why:
            note(why)
    if static:
        note(f"{static:.1%} of the picture never changes, and is filled from its neighbours")
    if saturated:
        note(f"{saturated:.0%} of the frames {cause}")
    if log.untimed:
        note("frames carry no time, so 1 Hz is assumed; give frame_rate_hz")
    notes = [*log.diagnostics.notes, *about_folder]
    if found or narrow or not run.recogniser.tracking:
        return notes
    # Nothing is recognised: what may be wrong, the likeliest first.
    wide = f"{disc_width_px(run.fan, run.landmarks):.0f} px wide here"
    topic = f"topic ({command_line('info', path)} has all), " * ("topic" in log.reading())
    scale = "linear" if log.reading().get("pixel_scale") == "log" else "log"
    return [
        *notes,
        f"{path}: no landmark declared; check {topic}range order "
        f"({_again(job, run, '--range-order', log.sonar.other_range_order)}) and geometry "
        f"({_preview(job, run)})",
        f"{path}: then landmark set and size ({_landmarks(job, run)}; a landmark of "
        f"{run.landmarks.name} is {wide}) and level ({_again(job, run, '--pixel-scale', scale)})",
    ]


def _again(job: Job, run: PreparedRun, *options: str) -> str:
    """The command that repeats a run with other options, and leaves its results as they are."""
    if job.urls:  # run.toml is on a server
        return f"`run` with {' '.join(options)}"
    poses = run.log_options.odometry
    return rerun(Path(job.log), job.folder / "run.toml", *options, poses=poses)


def _landmarks(job: Job, run: PreparedRun) -> str:
    """The command that shows the landmark set of a run."""
    own = [] if job.urls or run.landmarks == load_landmarks("basin") else [job.folder / "run.toml"]
    return command_line("landmarks", *own)


def _preview(job: Job, run: PreparedRun) -> str:
    """The command that draws the geometry of a run onto its first frame."""
    if job.urls:
        return "`sonarrec info --preview` of a copy"
    file, topic = job.folder / "run.toml", run.log.reading().get("topic")
    words: list[object] = ["info", Path(job.log), "--sonar", file]
    words += [] if topic is None else ["--topic", topic]
    words += [] if run.landmarks == load_landmarks("basin") else ["--landmarks", file]
    return command_line(*words, "--preview", free_name(Path(job.out, f"{job.name}_preview.png")))


def _with_sightings(methods: Sequence[str], outcome: Outcome) -> Outcome:
    """The outcome with what is in its sightings.csv. methods: those that follow objects."""
    passes, landmarks = dict.fromkeys(methods, 0), Counter[int]()

    def of_method(method: str) -> Iterator[Sighting]:
        for sighting in sightings_in(outcome.folder / "sightings.csv"):
            if sighting.method == method:
                passes[method] += 1
                if method == methods[0]:
                    landmarks[sighting.landmark] += sighting.frames_declared
                yield sighting

    sightings: list[Sighting] = []
    for method in methods:
        longest = nlargest(MOST_SIGHTINGS, of_method(method), key=lambda s: s.frames_declared)
        sightings += sorted(longest, key=lambda s: (s.first_frame, s.last_frame))
    return replace(outcome, passes=passes, sightings=sightings, landmarks=dict(landmarks))
