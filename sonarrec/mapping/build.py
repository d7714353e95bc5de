"""`sonarrec map`: makes one map from the results of one or several logs."""

from __future__ import annotations

import glob
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import Diagnostics, SonarrecError, UsageError
from sonarrec.landmarks import LandmarkSet, load_landmarks
from sonarrec.mapping.landmarks import (
    Landmark,
    MappedLog,
    Pass,
    find_passes,
    frames_of,
    join,
    moved,
    on_path,
    read_declared,
)
from sonarrec.mapping.path import (
    NO_DRIFT,
    Drift,
    measured_motion_paths,
    path_from_poses,
    read_frames,
)
from sonarrec.readers.poses import read_poses
from sonarrec.results.read import CountedOnce, choose_method, find_logs, recording
from sonarrec.results.run_file import RunFile, cut_short, read_run, tables_changed
from sonarrec.results.sightings import check_follows
from sonarrec.runs.recorded import outdated
from sonarrec.sonar.geometry import PoseTable
from sonarrec.sonar.stated import Sonar


@dataclass(frozen=True, slots=True)
class SiteMap:
    """The positions of the landmarks of a site, in the axes of the poses or of a first frame.

    x is to the right and y ahead of a sonar whose yaw is 0.
    """

    landmark_set: LandmarkSet
    landmarks: list[Landmark]
    left_out: int
    """Number of landmarks with too few frames."""
    logs: list[MappedLog]
    """Those that could be used, each recording once; a paused one without poses has a part for each
    path."""
    count: int
    """Of logs, not of parts."""
    diagnostics: Diagnostics
    ros_axes: bool
    """Whether the poses' own axes, in which the files are written, are x ahead and y to the left,
    and yaw counter-clockwise; else they are the map's."""

    @property
    def parts(self) -> list[list[MappedLog]]:
        """The logs that have common axes: all with poses, else each path alone."""
        return [self.logs] if self.logs[0].path.from_poses else [[log] for log in self.logs]

    def path_of(self, seen: Pass) -> int:
        """The number of the part in whose axes a pass lies, from 1."""
        own = ([log.path for log in logs] for logs in self.parts)
        return next(n for n, paths in enumerate(own, 1) if seen.path in paths)

    def position(self, position: FloatArray) -> FloatArray:
        """(..., 2) positions in the poses' axes, m."""
        if not self.ros_axes:
            return position
        return np.stack([position[..., 1], -position[..., 0]], axis=-1)

    def covariance(self, covariance: FloatArray) -> FloatArray:
        """(2, 2) covariance of a position in the poses' axes, m^2."""
        if not self.ros_axes:
            return covariance
        (xx, xy), (_, yy) = covariance
        return np.array([[yy, -xy], [-xy, xx]])

    def orientation(self, orientation_deg: float, landmark: int) -> float:
        """An orientation counter-clockwise from the poses' x axis, below the period of the ID's
        symbol."""
        period_deg = self.landmark_set.periods_deg()[self.landmark_set.ids.index(landmark)]
        return float((orientation_deg - 90 * self.ros_axes) % period_deg)


class SeveralFramesError(UsageError):
    """The logs have no poses, so that each has a coordinate frame of its own.

    folders: of the results of those that can be mapped, one by one.
    """

    def __init__(self, logs: Sequence[str], folders: Sequence[Path], left_out: Sequence[str]):
        """left_out: a line on each log that cannot be mapped."""
        super().__init__(
            f"without poses each log has a coordinate frame of its own ({', '.join(logs)}): give "
            "poses with --odometry, or map the logs one by one"
        )
        self.folders, self.left_out = folders, left_out


def make_map(
    results: Sequence[Path],
    odometry: Path | None = None,
    drift: Drift = NO_DRIFT,
    method: str | None = None,
    *,
    landmarks: str | None = None,
    sonar: Sonar | None = None,
    min_frames: int = 3,
) -> SiteMap:
    """The map of the landmarks that a method declared.

    results: folders of the results of single logs, or folders that hold such folders. If a
    recording has several results, the first count. odometry: table of the poses of all logs, in
    place of those that they were run with. drift: of the poses. method: of estimates.csv; None:
    `framework` or the only one. landmarks, sonar: in place of those in run.toml. min_frames:
    landmarks declared in fewer, over all passes, are left out.
    Raises SonarrecError if none of the logs can be used, SeveralFramesError if they have no common
    axes.
    """
    if landmarks is not None:
        load_landmarks(landmarks)  # so that a fault is not one of each log
    diagnostics, copies = Diagnostics(), Diagnostics()
    folders = list(dict.fromkeys(log for folder in results for log in find_logs(folder)))
    logs, used = list[MappedLog](), list[Path]()
    landmark_set: LandmarkSet | None = None
    given = None if odometry is None else read_poses(odometry)
    once = CountedOnce("used", copies)
    for folder in folders:
        try:
            run = read_run(folder / "run.toml")
            own_set = run.landmark_set(landmarks)
            landmark_set = landmark_set or own_set
            if own_set.as_table() != landmark_set.as_table():
                raise SonarrecError(
                    f"{folder}: landmark set {own_set.name!r}, not {landmark_set.name!r} as the "
                    "others"
                )
            poses = given or _poses_of_run(folder, run)
            parts = _read_log(folder, run, own_set, poses, drift, method, sonar)
        except SonarrecError as error:
            if len(folders) == 1:
                raise
            diagnostics.problem(str(error))
            continue
        if once.add(folder, recording(folder, run)):
            logs += parts
            used.append(folder)
    if landmark_set is None or not logs:
        raise SonarrecError("\n".join(["no log can be mapped", *diagnostics.problems]))
    alone = list(dict.fromkeys(log.name for log in logs if not log.path.from_poses))
    if alone and len(used) > 1:
        raise SeveralFramesError(alone, used, diagnostics.problems)
    diagnostics.note(*outdated(used))
    for source in (*(log.diagnostics for log in logs), copies):
        diagnostics.note(*source.notes)
        diagnostics.problem(*source.problems)
    # Without poses each path has axes of its own.
    of_axes = [[log] for log in logs] if alone else [logs]
    kept, left_out = list[Landmark](), 0
    for part in of_axes:
        found_there = join(part, landmark_set)
        clear = [landmark for landmark in found_there if frames_of(landmark.members) >= min_frames]
        for i, k in moved(clear, landmark_set):
            distance_m = math.dist(clear[i].position, clear[k].position)
            diagnostics.note(
                f"landmarks {len(kept) + i + 1} and {len(kept) + k + 1} (ID.{clear[i].id}) "
                f"overlap: passes {distance_m:.2f} m from each other, more than 5 sigma; was it "
                f"moved{'' if alone else ', or is the clock of the poses another'}?"
            )
        left_out += len(found_there) - len(clear)
        kept += clear
    for number, landmark in enumerate(kept, 1):
        if (others := frames_of(landmark.others)) >= min_frames:
            diagnostics.note(
                f"landmark {number} (ID.{landmark.id}): other claims within a disc of it in "
                f"{others} frames; was it moved, or misread? (other_frames of map.csv)"
            )
    ros_axes = all(log.ros_axes for log in logs)
    return SiteMap(landmark_set, kept, left_out, logs, len(used), diagnostics, ros_axes)


def _read_log(
    folder: Path,
    run: RunFile,
    landmarks: LandmarkSet,
    poses: PoseTable | None,
    drift: Drift,
    method: str | None,
    sonar: Sonar | None,
) -> list[MappedLog]:
    """One log, in a part for each of its paths. Raises SonarrecError if it is unusable."""
    diagnostics, frames, ros_axes = Diagnostics(), read_frames(folder), False
    if poses is None:
        if drift != NO_DRIFT:
            raise UsageError("--drift applies to given poses, and there are none; give --odometry")
        paths = measured_motion_paths(folder, frames, diagnostics)
    elif "timestamp_ns" not in frames:
        raise SonarrecError(
            f"{folder}: frames.csv has no timestamp_ns, which is needed to find poses"
        )
    else:
        times = frames["timestamp_ns"]
        paths = [path_from_poses(frames["frame"], times, frames["stretch"], poses, drift)]
        ros_axes = poses.axes == "ahead, left"
        diagnostics.note(*poses.too_fast())
    fan = run.fan(sonar)
    if fan is None:
        raise SonarrecError(f"{folder}: no geometry in run.toml; give it with --sonar")
    table = folder / "estimates.csv"
    method = choose_method(table, method)
    check_follows(method)
    declared = read_declared(table, method, landmarks, fan, frames["frame"])
    logs, first = list[MappedLog](), 0
    for path in paths:
        passes = find_passes(on_path(declared, first, path), path, landmarks, fan)
        logs.append(MappedLog(folder.resolve().name, path, passes, fan, ros_axes, diagnostics))
        first += len(path.frame)
    if not run.finished:
        diagnostics.problem(cut_short(str(folder), len(frames["frame"]), "used"))
    elif changed := tables_changed(folder, run.input):
        diagnostics.problem(*(f"{folder}: {line}" for line in changed))
    used = sum(len(seen.row) for log in logs for seen in log.passes)
    if used < declared.rows:
        diagnostics.problem(
            f"{folder}: {declared.rows - used} of {declared.rows} declared estimates left out: no "
            "pose is known in their frames, they are nearer than the floor, or frames.csv does not "
            "list their frames"
        )
    return logs


def _poses_of_run(folder: Path, run: RunFile) -> PoseTable | None:
    """The poses that a log was run with; None if it had none.

    A topic is read from the log again. A table is searched, by its name and SHA-256, in and above
    the folder of the log, in and above that of the results, in the working folder, and in the
    folders in these. Raises SonarrecError if the poses are not found.
    """
    recorded, log = run.odometry, Path(run.table.get("input", {}).get("path", ""))
    if "topic" in recorded:
        from sonarrec.readers.poses import read_topic  # brings decompressors

        return read_topic(log, str(recorded["topic"]), run.input.time or "log")
    if not recorded:
        return None
    name, results = str(recorded.get("name")), folder.resolve()
    homes = (log, *log.parents[:2], results, *results.parents[:2], Path())
    below = (home.glob(f"*/{glob.escape(name)}") for home in homes)
    for path in chain((home / name for home in homes), chain.from_iterable(below)):
        if path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == recorded["sha256"]:
            return read_poses(path)
    raise SonarrecError(
        f"{folder}: the poses it was run with, {name}, are not found near the log, the results or "
        "here, or have changed; name that table with --odometry, or run the log again"
    )
