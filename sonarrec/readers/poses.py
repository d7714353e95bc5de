"""The sonar's poses: from a table (`run --odometry`) or a topic (`run --odometry-topic`)."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import MAX_PROBLEM_LINES, SonarrecError, UsageError, number_of
from sonarrec.readers.messages.fields import DefinitionError, Fields
from sonarrec.readers.messages.types import Decode, fields_decoder, message_type
from sonarrec.readers.open import find_log
from sonarrec.readers.raw import Message, Recording, UnusableError
from sonarrec.sonar.frame import Clock, Stamps
from sonarrec.sonar.geometry import PoseTable, pose_table
from sonarrec.tables import refuse_pipe

if TYPE_CHECKING:
    from sonarrec.tables.read import Table

POSES_FILE = "poses.csv"
"""The poses that belong to a log (or NAME.poses.csv), used if the user gives none."""
HEADER = "timestamp,yaw,x,y"
TUM = "timestamp tx ty tz qx qy qz qw"
"""The numbers of a line in the form of the TUM benchmark, as evo and SLAM programs write it."""
SIMILAR_NAMES = (
    *("x", "y", "x_m", "y_m", "px", "py", "pos_x", "pos_y", "position_x", "position_y"),
    *("east", "north", "east_m", "north_m", "easting", "northing"),
    *("lat", "lon", "latitude", "longitude"),
)
"""Names, in lower case, that other programs give to positions. They are refused: without x and y
the sonar would be taken to turn in one place."""
# How the unit of a column `timestamp` is recognised: a steady pan may have only two rows a
# minute, and nobody writes 2,000 a second. Steps in between must be milliseconds or microseconds.
SECONDS_BELOW = 50
NANOSECONDS_FROM = 500_000
# The message types read, with the fields that lead to the pose inside each.
POSES = {
    "nav_msgs/Odometry": ("pose", "pose"),
    "geometry_msgs/PoseStamped": ("pose",),
    "geometry_msgs/PoseWithCovarianceStamped": ("pose", "pose"),
}


def read_poses(path: Path) -> PoseTable:
    """Read a CSV table with a header such as HEADER, or lines in the form of TUM.

    x and y must both be there, or neither. timestamp_ns is in nanoseconds. timestamp is in ISO 8601
    with its UTC offset, in seconds if the median step from row to row is less than SECONDS_BELOW,
    or in nanoseconds if it is NANOSECONDS_FROM or more. Rows may be in any order; of several rows
    at one time the first counts. Lines of TUM have the axes of a topic (`read_topic`). Raises
    SonarrecError if the table cannot be used."""
    # Not at the top, because it loads pandas, which few runs need.
    from sonarrec.tables.read import Kind, read_header, read_table

    refuse_pipe(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
    source = {"name": path.name, "sha256": hashlib.sha256(content).hexdigest()}
    if len(lines := _tum_lines(path, content)):
        times_ns = _times_ns(path, {"timestamp": lines[:, 0]})
        poses = _ros_table(path.name, source, times_ns, lines[:, [1, 2, 4, 5, 6, 7]])
        return replace(poses, doubts=_first_is_qw(path.name, lines[:, 4:]))
    kinds: dict[str, Kind] = dict.fromkeys(("yaw", "x", "y"), "place")
    kinds |= {"timestamp_ns": "whole", "timestamp": "time"}
    table = read_table(path, kinds, ("yaw",), HEADER)
    if not {"timestamp", "timestamp_ns"} & table.keys():
        raise SonarrecError(
            f"{path}: wrong columns, neither timestamp nor timestamp_ns; "
            f"expected a header such as {HEADER}"
        )
    if ("x" in table) != ("y" in table):
        raise SonarrecError(f"{path}: x and y go together; give both or neither")
    similar = [name for name in read_header(path, HEADER) if name.lower() in SIMILAR_NAMES]
    if "x" not in table and similar:
        raise SonarrecError(
            f"{path}: no position can be read from the columns {', '.join(similar)}: expected x,y "
            "in metres (sonarrec help geometry); rename them, or drop them if the sonar only turns"
        )
    times_ns = _times_ns(path, table)
    still = np.zeros(len(times_ns))
    x, y = table.get("x", still), table.get("y", still)
    return pose_table(path.name, source, times_ns, table["yaw"], x, y)


def _tum_lines(path: Path, content: bytes) -> FloatArray:
    """(lines, 8) the numbers of TUM; (0,) if the file begins with something else.

    Raises SonarrecError, with its number, for a line that is no pose.
    """
    from sonarrec.tables.read import LARGEST

    poses: list[list[float]] = []
    for number, line in enumerate(content.decode("utf-8-sig", errors="replace").splitlines(), 1):
        if not (cells := line.partition("#")[0].split()):
            continue
        try:
            pose = [float(cell) for cell in cells]
        except ValueError:
            pose = []
        if not pose and not poses:
            break  # the header of a CSV table
        if len(pose) != 8 or not all(map(math.isfinite, pose)):
            raise SonarrecError(
                f"{path} line {number}: a pose in TUM form is 8 finite numbers with blanks between "
                f"them ({TUM}), not {line.strip()[:60]!r}; correct or delete the line"
            )
        if max(map(abs, pose[1:3])) > LARGEST or not any(pose[4:]):
            raise SonarrecError(
                f"{path} line {number}: no pose, since its position is beyond 1e9 m or its "
                "orientation qx qy qz qw is all zeros; correct or delete the line"
            )
        poses.append(pose)
    return np.array(poses)


def _first_is_qw(name: str, orientation: FloatArray) -> tuple[str, ...]:
    """A note if quaternions are upside down as TUM has them, and level, turning, with qw first.

    orientation: (N, 4) of any length but 0."""
    q = orientation.T / np.abs(orientation).max(axis=1)
    q *= np.copysign(1, q[0]) / np.linalg.norm(q, axis=0)
    (w, x, y, _), (_, *tilt, yaw) = np.mean(q**2, axis=1), np.var(q, axis=1)
    if w + x <= 0.5 or x + y >= 0.1 or yaw <= 4 * sum(tilt):
        return ()
    return (
        f"{name}: poses are upside down as {TUM[-11:]}, but level if qw is first: write it last",
    )


def _ros_table(
    name: str, source: Mapping[str, str], time_ns: IntArray, pose: FloatArray
) -> PoseTable:
    """The table of poses as ROS has them (REP 103): x ahead and y to the left of a sonar whose yaw
    is 0, z up. pose: (N, 6) x and y in m, and qx, qy, qz, qw, of any length but 0."""
    ahead, left = pose[:, :2].T
    x, y, z, w = pose[:, 2:].T / np.abs(pose[:, 2:]).max(axis=1)  # their squares do not underflow
    yaw = np.degrees(np.arctan2(2 * (w * z + x * y), w**2 + x**2 - y**2 - z**2))
    return replace(pose_table(name, source, time_ns, -yaw, -left, ahead), axes="ahead, left")


def _times_ns(path: Path, table: Table) -> IntArray:
    """(rows,) times in ns. Raises SonarrecError if they are all one, or in another unit."""
    times: np.ndarray = table["timestamp_ns" if "timestamp_ns" in table else "timestamp"]
    steps = np.diff(np.unique(times))
    if not len(steps):
        raise SonarrecError(f"{path}: a motion needs rows at two times or more")
    if "timestamp_ns" in table:
        return np.asarray(times, np.int64)
    step = float(np.median(steps))
    if SECONDS_BELOW <= step < NANOSECONDS_FROM:
        raise SonarrecError(
            f"{path}: timestamp must be seconds or nanoseconds; steps of {step:g} are "
            "neither (milliseconds or microseconds?); name nanoseconds timestamp_ns"
        )
    times = np.rint(times * 1e9 if step < SECONDS_BELOW else times)
    if np.abs(times).max() >= 2**63:
        raise SonarrecError(
            f"{path}: timestamp must be seconds or nanoseconds; these are neither (milliseconds?)"
        )
    return np.asarray(times, np.int64)


def read_topic(path: Path, topic: str, time: Clock) -> PoseTable:
    """Read the poses of one topic. time: which of a message's times counts; the same as for the
    frames. ROS counts angles counter-clockwise; at yaw 0, x points ahead and y to the left (REP
    103). Messages that cannot be read leave a gap and add a line to the table's problems. Raises
    SonarrecError if the file cannot be used or has fewer than two poses, UsageError if it has no
    such pose topic."""
    source = find_log(path)
    if not source.reader.has_topics:
        raise UsageError(
            f"{path}: --odometry-topic names a channel of an MCAP or a ROS bag; this log is neither"
        )
    poses, problems, count = dict[int, list[float]](), list[str](), 0
    log = source.recording()
    try:
        decoders = _decoders(log, topic)
        for number, message in enumerate(log.messages(decoders)):
            if message.data is None and message.problem is None:
                continue  # lost in a damaged chunk; the log's own faults report that
            try:
                stamp, pose = _pose(message, time, *decoders[message.channel])
                poses.setdefault(stamp, pose)
                count += 1
            except UnusableError as error:
                problems.append(f"message {number} of {topic}: {error}, skipped")
    finally:
        log.close()
    if len(poses) < 2:
        if count > 1:
            problems = [f"all have the {time} time {next(iter(poses))} ns"]
        why = f" ({problems[0]})" if problems else ""
        raise SonarrecError(f"{path}: {topic} has fewer than two poses that can be read{why}")
    if len(problems) > MAX_PROBLEM_LINES:
        more = len(problems) - MAX_PROBLEM_LINES
        problems[MAX_PROBLEM_LINES:] = [f"{number_of(more, 'more pose')} of {topic} skipped"]
    times_ns, poses_xy_q = np.array([*poses], np.int64), np.array([*poses.values()])
    table = _ros_table(topic, {"topic": topic}, times_ns, poses_xy_q)
    return replace(table, problems=tuple(problems))


def _decoders(log: Recording, topic: str) -> dict[int, tuple[Decode, tuple[str, ...]]]:
    """For every channel of the pose topic: its decoder, and the fields that lead to the pose."""
    kinds = {number: message_type(c.schema) for number, c in log.channels.items()}
    poses = {number: c for number, c in log.channels.items() if kinds[number] in POSES}
    decoders: dict[int, tuple[Decode, tuple[str, ...]]] = {}
    for number, c in poses.items():
        if c.topic == topic:
            form = kinds[number], c.schema_encoding, c.definition, c.message_encoding
            try:
                decode = fields_decoder(*form)
            except DefinitionError as error:
                raise SonarrecError(
                    f"{log.path}: the definition of {topic} cannot be used ({error})"
                ) from None
            if decode is not None:
                decoders[number] = decode, POSES[kinds[number]]
    if not decoders:
        topics = sorted({c.topic for c in poses.values()} - {topic})
        choice = f"there is {', '.join(topics)}" if topics else f"this reads {', '.join(POSES)}"
        raise UsageError(f"{log.path}: no pose topic {topic!r}; {choice}")
    return decoders


def _pose(
    message: Message, time: Clock, decode: Decode, path_to_pose: tuple[str, ...]
) -> tuple[int, list[float]]:
    """(time in ns, [x, y, qx, qy, qz, qw]: position in m, orientation as a quaternion)."""
    if message.data is None:
        raise UnusableError(str(message.problem))
    fields = pose = Fields(decode(message.data))
    for name in path_to_pose:
        pose = pose.inner(name)
    position = pose.inner("position")
    orientation = [pose.inner("orientation").number(k) for k in "xyzw"]
    if not any(orientation):
        raise UnusableError("its orientation is all zeros")
    stamps = Stamps(message.log_time, message.publish_time, fields.stamp_ns())
    if (stamp := getattr(stamps, time)) is None:
        raise UnusableError(f"without a {time} time")
    if stamp >= 2**63:
        raise UnusableError(f"its {time} time of {stamp} ns is beyond every clock")
    return stamp, [*(position.number(k) for k in "xy"), *orientation]
