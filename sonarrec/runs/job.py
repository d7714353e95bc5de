"""A job: one log to run; the events that it sends while it runs, and what became of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from sonarrec.config import Config
from sonarrec.errors import Advice, SonarrecError, as_usage, is_url, number_of, redact_url
from sonarrec.recogniser.stage3.model_file import model_from_table, read_model
from sonarrec.results.run_file import LogOptions, read_run
from sonarrec.results.sightings import Sighting
from sonarrec.sonar.frame import FrameResult

Observe = Callable[[FrameResult, int | None], None]
"""Called with each result and the number of frames, None where that is not known."""
GRACE_S = 10.0
"""Time that a process has after SIGTERM to write its results, before SIGKILL."""


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The user's choices for a run, except for how the log is read."""

    configs: Sequence[Config]
    """Several run side by side, each under its own method name."""
    landmarks: str | Path | None = None
    """A set by name or file; default: the earlier run's, basin."""
    model: Path | None = None
    """Of calibrate; default: the earlier run's, else the built-in one."""
    earlier_run: Path | None = None
    """A run.toml, whose geometry, landmarks and model serve where none are given; a plain file of
    settings has none of these."""

    def check(self) -> None:
        """Raise UsageError if one of the files is invalid, before any log is opened."""
        with as_usage():
            earlier = read_run(self.earlier_run)
            earlier.landmark_set(self.landmarks)
            if self.model is not None:
                read_model(self.model)
            elif earlier.model is not None:
                model_from_table(earlier.model, str(earlier.path))


@dataclass(frozen=True, slots=True)
class Job:
    """One log to run; it can be pickled, and handed to another process or machine."""

    log: str
    """Its path, or its URL with secrets: show `path`."""
    name: str
    """Of the folder of its results, see `result_names`."""
    out: str
    """The folder in which that lies, or its URL."""
    log_options: LogOptions
    run_options: RunOptions
    overwrite: bool = False
    urls: Mapping[str, str] = field(default_factory=dict)
    """Of temporary folders, see `local_copy`."""
    advise: Callable[..., Iterable[Advice]] | None = None
    """For its notes: called with the PreparedRun at its end, and whether it has_sightings."""

    @property
    def path(self) -> str:
        """Of the log; or its URL without secrets."""
        return redact_url(self.log) if is_url(self.log) else self.log

    @property
    def folder(self) -> Path:
        """That of the results, where they are on this machine."""
        return Path(self.out, self.name)

    @property
    def results(self) -> str:
        """The folder of the results, or its URL without secrets."""
        if is_url(self.out):
            return f"{redact_url(self.out).rstrip('/')}/{self.name}"
        return str(self.folder)

    def shown(self, text: object) -> str:
        """A text for the user, with the URLs of temporary folders."""
        text = str(text)
        for folder, url in self.urls.items():
            text = text.replace(folder, url)
        return text


Status = Literal["waiting", "running", "done", "partial", "failed"]


@dataclass(frozen=True, slots=True, repr=False)
class Outcome:
    """How the run of one log went."""

    status: Status
    """`partial` if part of the log could not be used."""
    folder: Path = Path()
    """Where the results are."""
    frames: int = 0
    """How many were processed."""
    unusable: int = 0
    """How many could not be."""
    candidates: int = 0
    """Over all frames."""
    problems: Sequence[str] = ()
    """A line for each thing that could not be used."""
    notes: Sequence[str] = ()
    """Other lines for the user."""
    passes: Mapping[str, int] = field(default_factory=dict)
    """How many sightings.csv has of each method that follows objects."""
    sightings: Sequence[Sighting] = ()
    """Of each of these the MOST_SIGHTINGS declared in the most frames, in order of first sight."""
    landmarks: Mapping[int, int] = field(default_factory=dict)
    """Frames in which the first of these methods declared each ID, summed over its passes."""
    up_to_date: bool = False
    """These very results were there, so nothing was done."""
    error: SonarrecError | None = None
    """Why it failed; then there are no results."""
    traceback: str = ""
    """Of a bug, if its process printed one."""
    seconds: float = 0.0
    """Duration."""

    @property
    def message(self) -> str:
        """One line on what could not be used; empty if all could."""
        if self.error is not None:
            return str(self.error)
        more = f" (and {len(self.problems) - 1} more)" if len(self.problems) > 1 else ""
        return self.problems[0] + more if self.problems else ""

    def __repr__(self) -> str:
        passes = number_of(sum(self.passes.values()), "sighting")
        return f"<{self.folder}: {number_of(self.frames, 'frame')}, {passes}>"


Event = str | tuple[int, int | None] | Outcome
"""What happens to a job: a line on what its run goes by; how many frames are done, of how many
(None: not known), 0 as it begins; its end."""
Report = Callable[[Event], object]
"""Called with each event of a job."""
