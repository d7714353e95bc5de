"""`sonarrec map`: makes one map from the results of one or several logs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.errors import SonarrecError, UsageError
from sonarrec.landmarks import LandmarkSet
from sonarrec.mapping.join import Landmark, MappedLog, join
from sonarrec.mapping.measured import measured_motion_path, read_frames
from sonarrec.mapping.passes import find_passes, read_declared
from sonarrec.mapping.path import Drift, SonarPath, path_from_poses
from sonarrec.mapping.poses_of_run import digest, poses_of_run
from sonarrec.poses import PoseTable
from sonarrec.results.folders import estimates_of
from sonarrec.results.read import find_logs
from sonarrec.results.run_file import RunFile, cut_short, read_run
from sonarrec.results.same_log import Recording, counted_once, recording
from sonarrec.results.sightings import check_follows
from sonarrec.results.stream import choose_method
from sonarrec.sonar import Sonar


@dataclass(frozen=True, slots=True)
class SiteMap:
    """Where the landmarks of a site lie, in the axes of the poses or of the first frame.

    x is to the right and y ahead of a sonar whose yaw is 0. left_out: number of landmarks with too
    few frames. logs: those that could be used, each recording once. problems: a line for each log,
    or part of one, that could not be used. notes: what a reader should know. ros_axes: whether the
    poses' own axes are x ahead and y to the left.
    """

    landmark_set: LandmarkSet
    landmarks: list[Landmark]
    left_out: int
    logs: list[MappedLog]
    problems: list[str]
    notes: list[str]
    ros_axes: bool

    def frames_of(self, passes: Iterable[tuple[int, int]]) -> int:
        """The number of frames with a declaration in some passes. passes: as Landmark.members.

        A frame in which two tracks lie on one landmark is one frame.
        """
        rows: dict[int, list[IntArray]] = defaultdict(list)
        for g, k in passes:
            rows[g].append(self.logs[g].rows_of(k))
        return sum(len(np.unique(np.concatenate(of_log))) for of_log in rows.values())


@dataclass(frozen=True, slots=True)
class _ReadLog:
    """One log that can be mapped, with its notes and problems for the SiteMap.

    table: SHA-256 of the table of its poses; None if they are not from a table.
    """

    folder: Path
    recording: Recording
    log: MappedLog
    table: str | None
    notes: list[str]
    problems: list[str]


@dataclass(frozen=True, slots=True)
class MapOptions:
    """How results are read and what goes into a map.

    odometry: tables of poses, see `poses_of_run`. drift: of these poses. method: of estimates.csv;
    None: `framework` or the only one. landmarks, sonar: replace what run.toml says. least_frames:
    landmarks declared in fewer frames, over all passes, are left out.
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
    options = options or MapOptions()
    folders = list(dict.fromkeys(log for folder in results for log in find_logs(folder)))
    logs_read, landmark_set, problems = _read_logs(folders, options)
    once = counted_once(
        [read.folder for read in logs_read],
        [read.recording for read in logs_read],
        lambda i: logs_read[i].log.path.frame,
        "used",
    )
    counted = [logs_read[i] for i in once.kept]
    logs = [read.log for read in counted]
    alone = [log.name for log in logs if not log.path.from_poses]
    if alone and len(logs) > 1:
        raise UsageError(
            f"without poses each log has a coordinate frame of its own ({', '.join(alone)}): give "
            "poses with --odometry, or map the logs one by one"
        )
    site = SiteMap(
        landmark_set=landmark_set,
        landmarks=join(logs, landmark_set),
        left_out=0,
        logs=logs,
        problems=[*problems, *(line for read in counted for line in read.problems), *once.unused],
        notes=[
            *(line for read in counted for line in read.notes),
            *once.notes,
            *_tables_not_used(options.odometry, logs_read),
        ],
        ros_axes=all(log.ros_axes for log in logs),
    )
    seen_enough = [
        landmark
        for landmark in site.landmarks
        if site.frames_of(landmark.members) >= options.least_frames
    ]
    return replace(site, landmarks=seen_enough, left_out=len(site.landmarks) - len(seen_enough))


def _read_logs(
    folders: Sequence[Path], options: MapOptions
) -> tuple[list[_ReadLog], LandmarkSet, list[str]]:
    """(the logs that can be mapped, their landmark set, a line for each log that cannot).

    Raises SonarrecError if no log can be mapped.
    """
    logs_read: list[_ReadLog] = []
    problems: list[str] = []
    landmark_set: LandmarkSet | None = None
    for folder in folders:
        try:
            run = read_run(folder / "run.toml")
            own_set = run.landmark_set(options.landmarks)
            landmark_set = landmark_set or own_set
            if own_set.as_table() != landmark_set.as_table():
                raise SonarrecError(
                    f"{folder}: landmark set {own_set.name!r}, not {landmark_set.name!r} as the "
                    "others"
                )
            logs_read.append(_read_log(folder, run, own_set, options))
        except SonarrecError as error:
            if len(folders) == 1:
                raise
            problems.append(str(error))
    if landmark_set is None or not logs_read:
        raise SonarrecError("\n".join(["no log can be mapped", *problems]))
    return logs_read, landmark_set, problems


def _tables_not_used(tables: Sequence[Path], logs_read: Sequence[_ReadLog]) -> Iterator[str]:
    """A line for each table of poses that is of no log."""
    used = {read.table for read in logs_read}
    for table in tables:
        if digest(table) not in used:
            yield (
                f"{table}: not used, for no log was run with it; to map a log by it, run the log "
                "again with it"
            )


def _read_log(folder: Path, run: RunFile, landmarks: LandmarkSet, options: MapOptions) -> _ReadLog:
    """Read one log: its path and its passes. Raises SonarrecError if it cannot be mapped."""
    poses = poses_of_run(folder, run, options.odometry)
    path, notes = _path(folder, poses, options.drift)
    fan = run.fan(options.sonar)
    if fan is None:
        raise SonarrecError(f"{folder}: no geometry in run.toml; give it with --sonar or its flags")
    table = estimates_of(folder)
    method = choose_method(table, options.method)
    check_follows(method)
    declared = read_declared(table, method, landmarks, fan, path.frame)
    passes = find_passes(declared, path, landmarks, fan)
    name = folder.resolve().name
    ros_axes = poses is not None and "topic" in poses.source
    log = MappedLog(name, path, declared, passes, fan, ros_axes)
    problems = [] if run.finished else [cut_short(str(folder), len(path.frame), "used")]
    problems += _left_out(folder, log)
    return _ReadLog(
        folder=folder,
        recording=recording(folder, run, len(declared.row)),
        log=log,
        table=None if poses is None else poses.source.get("sha256"),
        notes=notes,
        problems=problems,
    )


def _left_out(folder: Path, log: MappedLog) -> Iterator[str]:
    """A line for each reason for which declared estimates of a log are in no pass."""
    listed, strays = len(log.declared.row), log.declared.strays
    whole = listed + strays
    without = int((~np.isfinite(log.path.pose[log.declared.row]).all(axis=1)).sum())
    near = listed - without - len(log.passes.order)
    for count, why in (
        (strays, "frames.csv does not list their frames"),
        (without, "no pose is known in their frames"),
        (near, "their slant range is no more than the sonar's height above the floor"),
    ):
        if count:
            yield f"{folder}: {count} of {whole} declared estimates left out: {why}"


def _path(folder: Path, poses: PoseTable | None, drift: Drift) -> tuple[SonarPath, list[str]]:
    """(the sonar's path in one log, notes on it)."""
    table = read_frames(folder)
    if poses is not None:
        if "timestamp_ns" not in table:
            raise SonarrecError(
                f"{folder}: frames.csv has no timestamp_ns, which is needed to find poses"
            )
        return path_from_poses(table["frame"], table["timestamp_ns"], poses, drift), []
    if drift != Drift():
        raise UsageError("--drift applies to given poses, and there are none; give --odometry")
    return measured_motion_path(folder, table)
