"""The check file: which logs are run and compared, what their results must keep; and the record."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from sonarrec.errors import SonarrecError, UsageError, as_usage, similar_name
from sonarrec.readers.named_logs import logs_named
from sonarrec.readers.open import find_log
from sonarrec.results.run_file import LogOptions, read_run
from sonarrec.results.write import write_run
from sonarrec.runs.one import result_names
from sonarrec.tables.outputs import replaced, writing
from sonarrec.tables.toml import Share, checked, from_table, read_toml
from sonarrec.truth.table import TRUTH_FILE

FILES = ("frames.csv", "estimates.csv", "run.toml")


@dataclass(frozen=True, slots=True)
class CheckedLog:
    """A [[log]] of the file. Paths are relative to the file."""

    path: str
    """As an argument of `sonarrec run`; a folder of logs, or a glob, names several."""
    ground_truth: str | None = None
    """None: the truth in the folder of the log."""
    name: str | None = None
    """Of its folder of results; None: as `sonarrec run` names it."""
    sonar: str | None = None
    """A sonar.toml, in place of the log's own."""
    topic: str | None = None


@dataclass(frozen=True, slots=True)
class CheckFile:
    """The file, as it was read. Paths are relative to it."""

    log: tuple[CheckedLog, ...]
    record: str | None = None
    """Folder of the recorded results; None: named as the file, without .toml."""
    preset: str | None = None
    config: str | None = None
    """A file of settings."""
    set: tuple[str, ...] = ()
    """Settings, as for --set."""
    landmarks: str | None = None
    """A landmark set by name or file."""
    model: str | None = None
    band: Share = 0.02
    method: tuple[str, ...] = ()
    least_tpr: dict[str, Any] = field(default_factory=dict)
    most_fpr: dict[str, Any] = field(default_factory=dict)
    min_visible: Share = 0.9


class LogToRun(NamedTuple):
    """A log of the check: what `run` and `evaluate` need to know."""

    name: str
    """Of its folder of results."""
    path: str
    stated: str
    """The path for the record, relative to the check file."""
    ground_truth: Path
    options: LogOptions


class Check(NamedTuple):
    """A check file and its folder."""

    path: Path
    file: CheckFile

    @property
    def record(self) -> Path:
        """The folder of the recorded results."""
        return self.path.parent / (self.file.record or self.path.stem)

    def path_to(self, name: str | None) -> Path | None:
        """A file that the check file names."""
        return None if name is None else self.path.parent / name

    @property
    def landmarks(self) -> str | None:
        """The landmark set: a file in the folder of the check file, else a name."""
        path = self.path_to(self.file.landmarks)
        return str(path) if path is not None and path.is_file() else self.file.landmarks

    def logs(self) -> list[LogToRun]:
        """Every log of the file. Raises UsageError for one without truth or of a wrong name."""
        logs: list[LogToRun] = []
        for n, entry in enumerate(self.file.log, 1):
            where, home = f"{self.path}: [[log]] {n}", self.path.parent
            named = logs_named(str(home / entry.path))
            if len(named) > 1 and (entry.name or entry.ground_truth):
                raise UsageError(
                    f"{where}: {entry.path} names {len(named)} logs, which cannot share a name or "
                    "a truth; give each its own [[log]]"
                )
            for source in named:
                options = LogOptions(
                    sonar_file=self.path_to(entry.sonar), topic=entry.topic, up_to=source.up_to
                )
                below = Path(source.path).is_relative_to(home)
                stated = Path(source.path).relative_to(home).as_posix() if below else source.path
                given = self.path_to(entry.ground_truth)
                truth = given or _truth_of_log(where, source.path, options)
                if not truth.is_file():
                    raise UsageError(f"{where}: {truth}: no such file")
                logs.append(LogToRun(entry.name or "", source.path, stated, truth, options))
        names = iter(result_names([log.path for log in logs if not log.name]))
        logs = [log._replace(name=log.name or next(names)) for log in logs]
        for log in logs:
            plain = log.name.isprintable() and log.name != ".." and Path(log.name).name == log.name
            if not plain or [x.name for x in logs].count(log.name) > 1:
                raise UsageError(
                    f"{self.path}: log name {log.name}: not the name of one folder; give each "
                    "[[log]] a name of its own"
                )
            if (self.record / log.name).resolve() == Path(log.path).resolve():
                raise UsageError(
                    f"{self.path}: record {self.record}: {log.path} is the log itself; name "
                    "another folder"
                )
        return logs


def _truth_of_log(where: str, path: str, options: LogOptions) -> Path:
    """The truth in the folder of a log. Raises UsageError if there is none. where: its [[log]]."""
    try:
        truth = find_log(path, options.up_to).companion(TRUTH_FILE)
    except SonarrecError as error:
        raise UsageError(f"{where}: {error}") from None
    if truth is None:
        raise UsageError(
            f"{where}: no {TRUTH_FILE} in or beside {path}; write it, or name it with "
            "ground_truth = ..."
        )
    return truth


def read_check(path: Path) -> Check:
    """Read a check file. Raises UsageError if it is not there or invalid."""
    if not path.is_file():
        what, meant = "no such file", similar_name(path)
        if path.is_dir():
            what, meant = "a folder, not a check file", ""
        raise UsageError(
            f"{path}: {what}; it names the logs to run, as in `sonarrec help check`{meant}"
        )
    with as_usage():
        file = from_table(CheckFile, read_toml(path), str(path))
        for key in ("least_tpr", "most_fpr"):
            for method, rate in getattr(file, key).items():
                checked(rate, Share, f"{path}: {key}.{method}")
    if not file.log:
        raise UsageError(f"{path}: names no log; give each its own [[log]] with a path")
    return Check(path, file)


def is_recorded(record: Path, name: str) -> bool:
    """Whether there are results of a log on record; half of them are none."""
    files = (record / name / file for file in FILES)
    return all(file.is_file() and file.stat().st_size for file in files)


def names_its_log(record: Path, name: str) -> bool:
    """Whether results on record say of which log they are."""
    return read_run(record / name / "run.toml").input.recording is not None


def save(results: Path, record: Path, logs: Sequence[LogToRun]) -> list[str]:
    """Record the results of the logs; returns notes.

    Nothing on record is replaced before all is written, or SonarrecError raised. Other files stay.
    """
    with writing(record), ExitStack() as stack:
        for log in logs:
            new = [stack.enter_context(replaced(record / log.name / name)) for name in FILES]
            for name, path in zip(FILES[:-1], new, strict=False):
                shutil.copyfile(results / log.name / name, path)
            run = read_toml(results / log.name / "run.toml")
            # What is committed must not change with the folder it was made in.
            run["input"] = {k: v for k, v in run["input"].items() if k != "place"}
            run["input"]["path"] = log.stated
            write_run(new[-1], run)
    names = {log.name for log in logs}
    left = (
        f for f in sorted(record.iterdir()) if f.name not in names and is_recorded(record, f.name)
    )
    return [f"{folder}: of no log in the check file any more; delete it" for folder in left]
