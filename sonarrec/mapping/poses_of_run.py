"""Finds the poses that a log was run with, from what run.toml says about them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from sonarrec.errors import SonarrecError
from sonarrec.poses import PoseTable
from sonarrec.readers.poses_csv import read_poses
from sonarrec.results.run_file import RunFile


def poses_of_run(folder: Path, run: RunFile, tables: Sequence[Path]) -> PoseTable | None:
    """The poses that a log was run with; None if it had none.

    tables: searched first, by SHA-256. If none of them fits, the table is searched by its name: in
    the log if it is a folder, beside and above the log, beside and above the results, and in the
    working folder. A topic of poses is read from the log again. If the log was run without poses,
    or with a topic, and there is exactly one table, that table is used. Raises SonarrecError if the
    poses that were used cannot be found, or if there are several tables for a log without poses.
    """
    recorded = run.odometry
    log = Path(run.table.get("input", {}).get("path", ""))
    if len(tables) == 1 and (not recorded or "topic" in recorded):
        return read_poses(tables[0])
    if "topic" in recorded:
        from sonarrec.readers.mcap.poses import read_topic  # with its decompressors, where needed

        if not log.exists():
            raise SonarrecError(
                f"{folder}: its poses are the topic {recorded['topic']} of {log}, which is not "
                "there; give a table of them with --odometry"
            )
        return read_topic(log, str(recorded["topic"]), run.input.time or "log")
    if not recorded:
        if tables:
            raise SonarrecError(
                f"{folder}: run without poses, so nothing tells which of the {len(tables)} tables "
                "are its poses; give it one --odometry, or run the log again with its table"
            )
        return None
    name = str(recorded.get("name"))
    places = [log, *log.parents]
    for home in (folder.absolute(), folder.resolve()):  # beside a link; "." and ".." have no parent
        places += [home, home.parent, home.parent.parent]
    places.append(Path())
    for path in [*tables, *(place / name for place in places)]:
        if digest(path) == recorded.get("sha256"):
            return read_poses(path)
    raise SonarrecError(
        f"{folder}: the poses it was run with, {name}, are not there or have changed; give that "
        "table with --odometry, or run the log again"
    )


def digest(path: Path) -> str | None:
    """SHA-256 of a file; None if it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return None
