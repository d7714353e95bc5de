"""Reads the sonar's poses from a topic of a recording: `sonarrec run --odometry-topic`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from sonarrec.errors import (
    MAX_PROBLEM_LINES,
    SonarrecError,
    UsageError,
    number_of,
)
from sonarrec.geometry import PoseTable, pose_table
from sonarrec.nouns import Clock, Stamps
from sonarrec.readers.containers.recording import Recording
from sonarrec.readers.messages.fields import DefinitionError, Fields
from sonarrec.readers.messages.types import Decode, fields_decoder, message_type
from sonarrec.readers.open import find_log
from sonarrec.readers.raw import UnusableError

# The message types read, with the fields that lead to the pose inside each.
POSES = {
    "nav_msgs/Odometry": ("pose", "pose"),
    "geometry_msgs/PoseStamped": ("pose",),
    "geometry_msgs/PoseWithCovarianceStamped": ("pose", "pose"),
}


def read_topic(path: Path, topic: str, time: Clock) -> PoseTable:
    """Read the poses of one topic.

    time: which of a message's times counts; the same as for the frames. ROS counts angles
    counter-clockwise; at yaw 0, x points ahead and y to the left (REP 103). Messages that cannot
    be read leave a gap and add a line to the table's problems.
    Raises SonarrecError if the file cannot be used or has fewer than two poses, UsageError if it
    has no such pose topic.
    """
    source = find_log(path)
    if not source.reader.has_topics:
        raise UsageError(
            f"{path}: --odometry-topic names a channel of an MCAP or a ROS bag; this log is neither"
        )
    log = source.recording()
    try:
        times, rows, problems = _read_poses(log, topic, time)
    finally:
        log.close()
    if len(set(times)) < 2:
        if len(times) > 1:
            problems = [f"all have the {time} time {times[0]} ns"]
        raise SonarrecError(
            f"{path}: {topic} has fewer than two poses that can be read"
            + (f" ({problems[0]})" if problems else "")
        )
    if len(problems) > MAX_PROBLEM_LINES:
        more = len(problems) - MAX_PROBLEM_LINES
        problems[MAX_PROBLEM_LINES:] = [f"{number_of(more, 'more pose')} of {topic} skipped"]
    ahead, left, x, y, z, w = np.array(rows).T
    yaw = np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2)))
    table = pose_table(topic, {"topic": topic}, np.array(times, np.int64), -yaw, -left, ahead)
    return replace(table, problems=tuple(problems), axes="ahead, left")


def _read_poses(
    log: Recording, topic: str, time: Clock
) -> tuple[list[int], list[list[float]], list[str]]:
    """(times in ns, poses from `_pose`, a line for each message that cannot be used)."""
    times, rows, problems = list[int](), list[list[float]](), list[str]()
    channels = _channels(log, topic)
    for number, message in enumerate(log.messages(channels)):
        if message.data is None and message.problem is None:
            continue  # lost in a damaged chunk; the log's own faults report that
        try:
            if message.data is None:
                raise UnusableError(str(message.problem))
            decode, path_to_pose = channels[message.channel]
            fields = Fields(decode(message.data))
            row = _pose(fields, path_to_pose)
            stamps = Stamps(message.log_time, message.publish_time, fields.stamp_ns())
            if (stamp := getattr(stamps, time)) is None:
                raise UnusableError(f"without a {time} time")
            if stamp >= 2**63:
                raise UnusableError(f"its {time} time of {stamp} ns is beyond every clock")
            times.append(stamp)
            rows.append(row)
        except UnusableError as error:
            problems.append(f"message {number} of {topic}: {error}, skipped")
    return times, rows, problems


def _channels(log: Recording, topic: str) -> dict[int, tuple[Decode, tuple[str, ...]]]:
    """For every channel of the pose topic: its decoder, and the fields that lead to the pose."""
    kinds = {number: message_type(c.schema) for number, c in log.channels.items()}
    poses = {number: c for number, c in log.channels.items() if kinds[number] in POSES}
    decoders: dict[int, tuple[Decode, tuple[str, ...]]] = {}
    for number, channel in poses.items():
        if channel.topic == topic:
            kind = kinds[number]
            try:
                decode = fields_decoder(
                    kind, channel.schema_encoding, channel.definition, channel.message_encoding
                )
            except DefinitionError as error:
                raise SonarrecError(
                    f"{log.path}: the definition of {topic} cannot be used ({error})"
                ) from None
            if decode is not None:
                decoders[number] = decode, POSES[kind]
    if not decoders:
        topics = sorted({c.topic for c in poses.values()} - {topic})
        choice = f"there is {', '.join(topics)}" if topics else f"this reads {', '.join(POSES)}"
        raise UsageError(f"{log.path}: no pose topic {topic!r}; {choice}")
    return decoders


def _pose(fields: Fields, path_to_pose: tuple[str, ...]) -> list[float]:
    """[x, y, qx, qy, qz, qw]: position in m, and orientation as a unit quaternion."""
    for name in path_to_pose:
        fields = fields.inner(name)
    position = fields.inner("position")
    orientation = [fields.inner("orientation").number(k) for k in "xyzw"]
    length = math.hypot(*orientation)
    if not length:
        raise UnusableError("its orientation is all zeros")
    return [*(position.number(k) for k in "xy"), *(v / length for v in orientation)]
