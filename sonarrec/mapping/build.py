"""`sonarrec map`: makes one map from the results of one or several logs."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sonarrec.errors import Diagnostics, SonarrecError, UsageError
from sonarrec.geometry import PoseTable
from sonarrec.landmarks import LandmarkSet
from sonarrec.mapping.join import Landmark, MappedLog, frames_of, join
from sonarrec.mapping.passes import find_passes, read_declared
from sonarrec.mapping.path import Drift, measured_motion_path, path_from_poses, read_frames
from sonarrec.readers.poses_csv import read_poses
from sonarrec.results.read import find_logs
from sonarrec.results.run_file import RunFile, cut_short, read_run, rows_lost
from sonarrec.results.same_log import CountedOnce, Recording, recording
from sonarrec.results.sightings import check_follows
from sonarrec.results.stream import choose_method
from sonarrec.sonar import Sonar


@dataclass(frozen=True, slots=True)
class SiteMap:
    """The positions of the landmarks of a site, in the axes of the poses or of the first frame.

    x is to the right and y ahead of a sonar whose yaw is 0. left_out: number of landmarks with too
    few frames. logs: those that could be used, each recording once. ros_axes: whether the poses'
    own axes are x ahead and y to the left.
    """

    landmark_set: LandmarkSet
    landmarks: list[Landmark]
    left_out: int
    logs: list[MappedLog]
    diagnostics: Diagnostics
    ros_axes: bool


@dataclass(frozen=True, slots=True)
class MapOptions:
    """How results are read, and which landmarks a map holds.

    odometry: tables of poses, see `_poses_of_run`. drift: of these poses. method: of estimates.csv;
    None: `framework` or the only one. landmarks, sonar: in place of those in run.toml.
    least_frames: landmarks declared in fewer frames, over all passes, are left out.
    """

    odometry: Sequence[Path] = ()
    drift: Drift = field(default_factory=Drift)
    method: str | None = None
    landmarks: str | None = None
    sonar: Sonar | None = None
    least_frames: int = 3


def make_map(results: Sequence[Path], options: MapOptions | None = None) -> SiteMap:
    """The map of the landmarks that a method declared.

    results: folders of the results of single logs, or folders that hold such folders. If a
    recording has several results, the first count. Raises SonarrecError if none of the logs can be
    used, or if they have no common axes.
    """
    options, diagnostics = options or MapOptions(), Diagnostics()
    found = list(dict.fromkeys(log for folder in results for log in find_logs(folder)))
    folders: list[Path] = []
    recordings: list[Recording] = []
    read: list[MappedLog] = []
    landmark_set: LandmarkSet | None = None
    tables_used: set[str | None] = set()
    for folder in found:
        try:
            run = read_run(folder / "run.toml")
            own_set = run.landmark_set(options.landmarks)
            landmark_set = landmark_set or own_set
            if own_set.as_table() != landmark_set.as_table():
                raise SonarrecError(
                    f"{folder}: landmark set {own_set.name!r}, not {landmark_set.name!r} as the "
                    "others"
                )
            poses = _poses_of_run(folder, run, options.odometry)
            log, estimates = _read_log(folder, run, own_set, poses, options)
        except SonarrecError as error:
            if len(found) == 1:
                raise
            diagnostics.problem(str(error))
            continue
        tables_used.add(None if poses is None else poses.source.get("sha256"))
        folders.append(folder)
        recordings.append(recording(folder, run, estimates))
        read.append(log)
    if landmark_set is None or not read:
        raise SonarrecError("\n".join(["no log can be mapped", *diagnostics.problems]))
    copies = Diagnostics()
    once = CountedOnce(lambda i: read[i].path.frame, "used", copies)
    each = zip(read, folders, recordings, strict=True)
    logs = [log for log, folder, of in each if once.add(folder, of)]
    alone = [log.name for log in logs if not log.path.from_poses]
    if alone and len(logs) > 1:
        raise UsageError(
            f"without poses each log has a coordinate frame of its own ({', '.join(alone)}): give "
            "poses with --odometry, or map the logs one by one"
        )
    for told in (*(log.diagnostics for log in logs), copies):
        diagnostics.note(*told.notes)
        diagnostics.problem(*told.problems)
    for table in options.odometry:
        if _digest(table) not in tables_used:
            diagnostics.note(
                f"{table}: not used, for no log was run with it; to map a log by it, run the log "
                "again with it"
            )
    landmarks = join(logs, landmark_set)
    seen_enough = [one for one in landmarks if frames_of(one.members) >= options.least_frames]
    left_out, ros_axes = len(landmarks) - len(seen_enough), all(log.ros_axes for log in logs)
    return SiteMap(landmark_set, seen_enough, left_out, logs, diagnostics, ros_axes)


def _read_log(
    folder: Path, run: RunFile, landmarks: LandmarkSet, poses: PoseTable | None, options: MapOptions
) -> tuple[MappedLog, int]:
    """One log, and the number of its declared estimates. Raises SonarrecError if it is unusable."""
    diagnostics = Diagnostics()
    frames = read_frames(folder)
    if poses is None:
        if options.drift != Drift():
            raise UsageError("--drift applies to given poses, and there are none; give --odometry")
        path = measured_motion_path(folder, frames, diagnostics)
    elif "timestamp_ns" not in frames:
        raise SonarrecError(
            f"{folder}: frames.csv has no timestamp_ns, which is needed to find poses"
        )
    else:
        path = path_from_poses(frames["frame"], frames["timestamp_ns"], poses, options.drift)
    fan = run.fan(options.sonar)
    if fan is None:
        raise SonarrecError(f"{folder}: no geometry in run.toml; give it with --sonar or its flags")
    table = folder / "estimates.csv"
    method = choose_method(table, options.method)
    check_follows(method)
    declared = read_declared(table, method, landmarks, fan, path.frame)
    passes = find_passes(declared, path, landmarks, fan)
    ros_axes = poses is not None and "topic" in poses.source
    log = MappedLog(folder.resolve().name, path, passes, fan, ros_axes, folder, diagnostics)
    if not run.finished:
        diagnostics.problem(cut_short(str(folder), len(path.frame), "used"))
    elif lost := rows_lost(folder, run.input):
        diagnostics.problem(*(f"{folder}: {line}" for line in lost))
    # The reasons why declared estimates are in no pass.
    without = int((~np.isfinite(log.path.pose[declared.row]).all(axis=1)).sum())
    near = len(declared.row) - without - sum(len(one.row) for one in log.passes)
    for count, why in (
        (declared.strays, "frames.csv does not list their frames"),
        (without, "no pose is known in their frames"),
        (near, "their slant range is no more than the sonar's height above the floor"),
    ):
        if count:
            whole = len(declared.row) + declared.strays
            diagnostics.problem(f"{folder}: {count} of {whole} declared estimates left out: {why}")
    return log, len(declared.row)


def _poses_of_run(folder: Path, run: RunFile, tables: Sequence[Path]) -> PoseTable | None:
    """The poses that a log was run with; None if it had none.

    tables: searched first, by SHA-256; a single one also serves a log that was run without poses
    or with a topic. Else a topic is read from the log again, and a table is searched by its name:
    in the log if it is a folder, beside and above the log, beside and above the results, and in
    the working folder. Raises SonarrecError if the poses cannot be found, or if there are several
    tables for a log without poses.
    """
    recorded = run.odometry
    log = Path(run.table.get("input", {}).get("path", ""))
    if len(tables) == 1 and (not recorded or "topic" in recorded):
        return read_poses(tables[0])
    if "topic" in recorded:
        from sonarrec.readers.messages.poses import read_topic  # brings decompressors

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
    homes = [log, *log.parents]
    for home in (folder.absolute(), folder.resolve()):  # beside a link; "." and ".." have no parent
        homes += [home, home.parent, home.parent.parent]
    for path in [*tables, *(home / name for home in [*homes, Path()])]:
        if _digest(path) == recorded.get("sha256"):
            return read_poses(path)
    raise SonarrecError(
        f"{folder}: the poses it was run with, {name}, are not there or have changed; give that "
        "table with --odometry, or run the log again"
    )


def _digest(path: Path) -> str | None:
    """SHA-256 of a file; None if it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return None
