"""Matches the recordings given with the logs: by name, and in folders also by SHA-256."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sonarrec.errors import SonarrecError, UsageError, name_as_text
from sonarrec.readers import open_log
from sonarrec.readers.log import Log
from sonarrec.readers.open import find_log, log_name, names_a_log, results_name
from sonarrec.reports.logs import ReportedLog
from sonarrec.results.read import check_same_log
from sonarrec.results.run_file import LogOptions
from sonarrec.sonar import Sonar


def open_recording(path: Path, log: ReportedLog, sonar: Sonar, topic: str | None) -> Log:
    """The recording, read as the run read it."""
    source = find_log(path)
    log_options = log.run.complete(LogOptions(sonar, topic=topic), same_log=True)
    if not source.reader.has_topics:  # then the topic in run.toml is of another log
        log_options = replace(log_options, topic=topic, time=None)
    return open_log(source, **log_options.arguments())


def match_recordings(
    logs: Sequence[ReportedLog], paths: Sequence[Path], sonar: Sonar, topic: str | None
) -> tuple[dict[str, Path], list[str]]:
    """The recording of each log, by the log's name, and a line for each that was not found.

    paths: recordings, or folders with recordings. A recording belongs to the log of its name; if
    there is one of each, they belong together. Raises UsageError if it belongs to no log.
    """
    sources: dict[str, Path] = {}
    missing: dict[str, str] = {}  # a line for each log that was not found so far
    for path in paths:
        inside, before = _inside(path), set(sources)
        if len(logs) == 1 and not inside:
            sources[logs[0].results.name] = path
            continue
        names = _possible_names(path)
        log_matches = [log for log in logs if log.results.name in names]
        log_matches = log_matches or [log for log in logs if _names(log) & names]
        if len(log_matches) > 1:  # logs of one name, distinguished by their folders
            log_matches = [log for log in log_matches if _same(log, [path], sonar, topic)[0]]
        if log_matches and not any(_names(log) & inside.keys() for log in logs):
            sources |= {log.results.name: path for log in log_matches}
            continue
        for log in logs:
            if log.results.name not in sources:
                candidates = [p for name in sorted(_names(log)) for p in inside.get(name, [])]
                source, problem = _same(log, list(dict.fromkeys(candidates)), sonar, topic)
                if source is None:
                    line = f"--log {path}: {problem}; the page has no frames of it"
                    missing[log.results.name] = line
                else:
                    sources[log.results.name] = source
        if not sources.keys() - before:
            listed = ", ".join(log.results.name for log in logs)
            raise UsageError(f"--log {path}: neither one of these logs nor holds any: {listed}")
    return sources, [line for name, line in missing.items() if name not in sources]


def _names(log: ReportedLog) -> set[str]:
    """Possible names of the log's recording: as it was given to the run, or as its folder."""
    source = log.run.table.get("input", {})
    path = Path(str(source.get("path", log.folder.resolve().name)))
    return {path.name, str(source.get("name", log_name(path))), log.results.name} - {""}


def _possible_names(path: Path) -> set[str]:
    """Possible names of a recording in run.toml: its file, the target of a link, or its results."""
    names = name_as_text(path.name), name_as_text(path.resolve().name)
    return {*names, results_name(log_name(path))}


def _inside(folder: Path) -> dict[str, list[Path]]:
    """Folders and log files below a folder, by their possible names."""
    by_name: dict[str, list[Path]] = defaultdict(list)
    for root, folders, files in os.walk(folder):
        folders.sort()
        for file in (*folders, *filter(names_a_log, sorted(files))):
            for name in _possible_names(path := Path(root, file)):
                by_name[name].append(path)
    return by_name


def _same(
    log: ReportedLog, candidates: Sequence[Path], sonar: Sonar, topic: str | None
) -> tuple[Path | None, str]:
    """The candidate that is the log's recording, and ""; or None, and the reason."""
    problem = f"no log of the name {log.results.name} in it"
    for path in candidates:
        try:
            with open_recording(path, log, sonar, topic) as recording:
                check_same_log(recording, log.folder, log.run)
        except SonarrecError as error:
            problem = f"{path} is not the log of {log.results.name} ({error})"
        else:
            return path, ""
    return None, problem
