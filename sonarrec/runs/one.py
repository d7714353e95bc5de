"""Runs one log through the recogniser and writes its results: `sonarrec run`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from heapq import nlargest
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Literal

from sonarrec.drawing.geometry import disc_width_px
from sonarrec.errors import SonarrecError, hidden, number_of
from sonarrec.nouns import Frame, FrameResult, Stamps
from sonarrec.readers.open import find_log, log_name, results_name
from sonarrec.readers.plausible import Plausibility
from sonarrec.results.folders import folder_names, part_of
from sonarrec.results.run_file import LogOptions, existing_results
from sonarrec.results.sightings import Sighting, Sightings, sightings_in
from sonarrec.results.write import ResultsWriter
from sonarrec.runs.prepare import PreparedRun, RunOptions, prepare

Observe = Callable[[FrameResult, int | None], None]
"""Called with each result and the number of frames, None where that is not known."""
MOST_SIGHTINGS = 20
"""Kept of each method in a Summary; sightings.csv has all."""


@dataclass(frozen=True, slots=True, repr=False)
class Summary:
    """How the run of one log went.

    folder: where the results are. frames: how many were processed. unusable: how many could not
    be. problems: a line for each thing that could not be used. notes: other lines for the user.
    candidates: over all frames. passes: how many sightings.csv has of each method that
    follows objects. sightings: of each of these the MOST_SIGHTINGS declared in the most frames, in
    order of first sight. landmarks: frames in which the first of these methods declared each ID,
    summed over its passes. up_to_date: these very results were there, so nothing was done.
    """

    folder: Path
    frames: int
    unusable: int
    candidates: int
    problems: list[str]
    notes: list[str]
    passes: dict[str, int]
    sightings: list[Sighting]
    landmarks: dict[int, int]
    up_to_date: bool = False

    def __repr__(self) -> str:
        passes = number_of(sum(self.passes.values()), "sighting")
        return f"<{self.folder}: {number_of(self.frames, 'frame')}, {passes}>"


def result_names(logs: Sequence[str | Path]) -> list[str]:
    """The name of each log's results, all different, also of logs that do not exist now.

    Raises UsageError if two logs cannot be told apart.
    """
    named = []  # (the name of a log's results, where the log is)
    for log in logs:
        try:
            source = find_log(log)
            named.append((source.name, source.place.resolve()))
        except SonarrecError:  # reported when the log is run
            place = Path(log)
            with suppress(OSError):  # the current folder is gone
                place = place.absolute()
            named.append((results_name(log_name(Path(log))), place))
    return folder_names(named)


def process(
    path: str | Path,
    out: str | Path,
    log_options: LogOptions,
    run_options: RunOptions,
    observe: Observe | None = None,
    *,
    name: str | None = None,
    overwrite: bool = False,
    begun: Callable[[str], object] = str,
    served_as: Callable[[str], str] = str,
) -> Summary:
    """Run one log and write `out`/<name>/, by default under the log's own name.

    Results that would be the same are not made again, and those of another log are not replaced,
    except with overwrite.
    begun: called before the first frame with a line on what the run goes by. served_as: puts the
    names of a server into a text, for a log that was fetched.
    Raises SonarrecError for input or settings that cannot be used.
    """
    with prepare(Path(path), Path(out), log_options, run_options, name, served_as) as job:
        told = job.log.diagnostics
        if not overwrite:
            existing = existing_results(job.folder, job.table)
            if existing.up_to_date:
                counts = existing.frames, existing.unusable, existing.candidates
                found = _longest(job.folder, job.recogniser.tracking)
                return Summary(job.folder, *counts, existing.problems, [], *found, up_to_date=True)
            if existing.reason:
                told.note(f"earlier results are replaced ({existing.reason})", about=job.folder)
        begun(served_as(job.basis))
        plausibility = Plausibility()
        sightings = Sightings(job.landmarks, job.fan, job.poses)
        with ResultsWriter(job.folder, job.landmarks, job.table, sightings) as writer:
            _recognise(job, writer, plausibility, observe)
            job.recogniser.tell(told)
            problems = [served_as(line) for line in told.problems]
            replaced = writer.finish(problems, told.unusable)
        found = _longest(job.folder, job.recogniser.tracking)
        _tell_notes(job, plausibility)
        last = [] if any(found[0].values()) or not job.recogniser.tracking else _to_check(job)
        notes = [served_as(line) for line in (*told.notes, *replaced, *last)]
        counts = writer.frames, told.unusable, writer.candidates
        return Summary(job.folder, *counts, problems, notes, *found)


def _recognise(
    job: PreparedRun, writer: ResultsWriter, plausibility: Plausibility, observe: Observe | None
) -> None:
    """Recognise every frame and write the results, also those waiting when the run is stopped."""
    stamps = dict[int, Stamps]()  # of frames that are not written yet, in their order

    def looked_at() -> Iterator[Frame]:
        for frame in job.frames:
            stamps[frame.index] = frame.stamps
            plausibility.look(frame)
            yield frame

    try:
        for result in job.recogniser.recognise(looked_at()):
            writer.write(result, stamps[result.index])
            del stamps[result.index]
            if observe is not None:
                observe(result, job.frame_count)
    except BaseException:  # Ctrl-C as well: keep what is there
        if not writer.full:
            stamps.pop(writer.last, None)
            for result in job.recogniser.waiting():
                if result.index == next(iter(stamps), None):  # none twice, none after a gap
                    writer.write(result, stamps.pop(result.index))
        raise


def _to_check(job: PreparedRun) -> list[str]:
    """What may be wrong where nothing is recognised, the likeliest first."""
    path, order = job.log.path, "near" if job.log.sonar.layout == "fan" else "far"
    wide = f"{disc_width_px(job.fan, job.landmarks):.0f} px wide here"
    topic = f"topic (`sonarrec info {path}` has all), " * ("topic" in job.log.reading())
    return [
        f"{path}: no landmark declared; check {topic}range order (`run --range-order "
        f"{order}_first`) and geometry (`sonarrec info {path} --preview FILE.png`)",
        f"{path}: then landmark set and size (`sonarrec landmarks`; a landmark of "
        f"{job.landmarks.name} is {wide}) and level (`run --pixel-scale log`)",
    ]


def _tell_notes(job: PreparedRun, plausibility: Plausibility) -> None:
    """Tell the user what showed at the end of the run."""
    note, (static, saturated) = job.log.diagnostics.note, job.recogniser.restored
    doubts = plausibility.contradictions()
    if doubts:
        look = f"`sonarrec info {job.log.path} --preview FILE.png`, with the same geometry"
        note(f"{'; '.join(doubts)}; look at {look}")
    if static:
        note(f"{static:.1%} of the picture never changes, and is filled from beside it")
    if saturated:
        note(f"{saturated:.0%} of the frames are saturated; a lower gain is better")
    if job.log.untimed:
        note("frames carry no time, so 1 Hz is assumed; give frame_rate_hz")


def _longest(
    folder: Path, methods: Sequence[str]
) -> tuple[dict[str, int], list[Sighting], dict[int, int]]:
    """`passes`, `sightings` and `landmarks` of a Summary; methods: those that follow objects."""
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
    return passes, sightings, dict(landmarks)


Status = Literal["waiting", "running", "done", "partial", "failed"]
GRACE_S = 10.0
"""Time that a process has after SIGTERM to write its results, before SIGKILL."""


@dataclass(frozen=True, slots=True)
class Task:
    """A log to run; it can be pickled, and handed to another process or machine."""

    path: str  # for a log on a server its URL without secrets
    name: str  # of its results folder, see runs.one.result_names
    out: str  # the folder for that folder
    log_options: LogOptions
    run_options: RunOptions
    overwrite: bool = False
    url: str = ""  # of a log on a server
    server_out: str = ""  # the folder of the results, if it is on a server


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a task."""

    status: Status  # `partial`: part of the log could not be used
    seconds: float = 0.0  # duration
    summary: Summary | None = None  # None if it failed
    folder: str = ""  # where its results are now: a path, or a URL
    error: SonarrecError | None = None  # if it failed
    fault: str = ""  # the traceback of a bug, if its process printed one

    @property
    def message(self) -> str:
        """One line on what could not be used; empty if all could."""
        if self.error is not None:
            return str(self.error)
        problems = self.summary.problems if self.summary else []
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        return problems[0] + more if problems else ""


Event = str | tuple[int, int | None] | Outcome
"""What happens to a log: a line on what its run goes by; how many frames are done, of how many
(None: not known), 0 as it begins; its end."""


def plan_task(task: Task) -> str:
    """What `run_task` would do, and why; writes nothing. Raises SonarrecError as that would."""
    with (
        _at_hand(task) as (path, out, served_as),
        prepare(path, out, task.log_options, task.run_options, task.name, served_as) as job,
    ):
        if task.overwrite:
            return "done again (asked for)"
        existing = existing_results(job.folder, job.table)
        if existing.up_to_date:
            return "up to date"
        if existing.reason:
            return f"done again ({existing.reason})"
        stopped = part_of(job.folder).exists()
        return "done again (it was stopped before its end)" if stopped else "new"


def run_task(
    task: Task, observe: Observe | None = None, begun: Callable[[str], object] = str
) -> Outcome:
    """Run a task in this process. A fault of the input becomes an outcome; a bug raises.

    begun: as of `process`.
    """
    start_s = monotonic()
    served_as: Callable[[str], str] = str
    try:
        with _at_hand(task) as (path, out, served_as):
            summary = process(
                path,
                out,
                task.log_options,
                task.run_options,
                observe,
                name=task.name,
                overwrite=task.overwrite,
                begun=begun,
                served_as=served_as,
            )
            if task.server_out and not summary.up_to_date:
                from sonarrec.runs.remote import put  # with fsspec, only where needed

                put(summary.folder, f"{task.server_out.rstrip('/')}/{task.name}")
    except SonarrecError as error:
        told = type(error)(served_as(str(error)))
        return Outcome("failed", monotonic() - start_s, error=told)
    status: Status = "partial" if summary.problems else "done"
    return Outcome(status, monotonic() - start_s, summary, served_as(str(summary.folder)))


@contextmanager
def _at_hand(task: Task) -> Iterator[tuple[Path, Path, Callable[[str], str]]]:
    """(what to open, the folder of the results, a function that puts a server's names in a text).

    A log on a server is fetched, and results for a server begin with those that it has. A file
    that cannot be opened inside raises SonarrecError, so that it costs this log only.
    """
    path, out, names = Path(task.path), Path(task.out), dict[str, str]()

    def served_as(text: str) -> str:
        for here, there in names.items():
            text = text.replace(here, there)
        return text

    with ExitStack() as stack:
        try:
            if task.url or task.server_out:
                from sonarrec.runs.remote import fetched, get  # with fsspec, only where needed
            if task.url:
                path, there = stack.enter_context(fetched(task.url))
                names[str(path.parent)] = there
            if task.server_out:
                out = Path(stack.enter_context(TemporaryDirectory(prefix="sonarrec-")))
                names[str(out)] = hidden(task.server_out.rstrip("/"))
                get(f"{task.server_out.rstrip('/')}/{task.name}", out / task.name)
            yield path, out, served_as
        except OSError as error:
            if error.filename is None:  # not a fault of the input
                raise
            raise SonarrecError(f"{error.filename}: {error.strerror}") from None
