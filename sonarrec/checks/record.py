"""The recorded results of a check: for each log its tables and its run.toml."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from sonarrec.checks.file import LogToRun
from sonarrec.results.folders import exchange, lock, part_of, release, restore
from sonarrec.results.write import write_run
from sonarrec.tables.outputs import writing
from sonarrec.tables.toml import read_toml

TABLES = ("frames.csv", "estimates.csv")
KEPT = (*TABLES, "run.toml")


def is_recorded(record: Path, name: str) -> bool:
    """Whether there are results of a log on record."""
    return all((record / name / table).is_file() for table in TABLES)


def save(results: Path, record: Path, logs: Sequence[LogToRun]) -> list[str]:
    """Record the results of the logs, in place of those on record; returns notes.

    Nothing on record is replaced before all is written. Results of logs that are no longer in the
    check file go. Raises SonarrecError if that cannot be written.
    """
    notes: list[str] = []
    with writing(record), ExitStack() as stack:
        record.mkdir(parents=True, exist_ok=True)
        for log in logs:
            folder = record / log.name
            stack.callback(release, folder, lock(folder))
            restore(folder)
            part = part_of(folder)
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir()
            for table in TABLES:
                shutil.copyfile(results / log.name / table, part / table)
            run = read_toml(results / log.name / "run.toml")
            # What is committed must not change with the folder it was made in.
            run["input"] = {k: v for k, v in run["input"].items() if k != "place"}
            run["input"]["path"] = log.stated
            write_run(part / "run.toml", run)
        for log in logs:
            notes += exchange(record / log.name)
        names = {log.name for log in logs}
        for folder in sorted(record.iterdir()):
            if folder.is_dir() and folder.name not in names and is_recorded(record, folder.name):
                _delete(folder)
                notes.append(f"{folder}: of no log in the check file any more, deleted")
    return notes


def _delete(folder: Path) -> None:
    """Delete what was recorded in a folder, and the folder if it is empty then."""
    for name in KEPT:
        (folder / name).unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()
