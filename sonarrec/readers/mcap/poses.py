"""Reads a pose topic of an MCAP file: `sonarrec run --odometry-topic`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sonarrec.poses import PoseTable, pose_table
from sonarrec.readers.mcap.decode import fields_decoder
from sonarrec.readers.mcap.fields import Fields
from sonarrec.readers.mcap.images import schema_of
from sonarrec.readers.mcap.in_order import MessageReader
from sonarrec.readers.mcap.messages import message_type
from sonarrec.readers.mcap.salvage import McapFile
from sonarrec.readers.raw import UnusableError
from sonarrec.records import Clock, SonarrecError, UsageError

# Where the pose is inside each message.
POSES = {
    "nav_msgs/Odometry": ("pose", "pose"),
    "geometry_msgs/PoseStamped": ("pose",),
    "geometry_msgs/PoseWithCovarianceStamped": ("pose", "pose"),
}


def read_topic(path: Path, topic: str, time: Clock) -> PoseTable:
    """The poses of one topic, by the clock that names the frames.

    ROS counts angles counter-clockwise and has x ahead and y to the left at yaw 0 (REP 103).
    Messages that cannot be read are passed over: the table has a gap there.
    Raises SonarrecError where the file or too few of its messages can be used, UsageError where
    the topic cannot be meant.
    """
    if path.suffix.lower() != ".mcap":
        raise UsageError(f"{path}: --odometry-topic names a channel of an MCAP file; this is none")
    log = McapFile(path)
    try:
        decoders, kinds = {}, {}
        for channel in log.channels.values():
            schema = schema_of(log, channel)
            kind = message_type(schema.name)
            if kind in POSES:
                decode = fields_decoder(
                    kind, schema.encoding, schema.data, channel.message_encoding
                )
                if decode is not None:
                    decoders[channel.id], kinds[channel.id] = decode, kind
        chosen = {c for c in decoders if log.channels[c].topic == topic}
        if not chosen:
            topics = sorted({log.channels[c].topic for c in decoders})
            there = f"there is {', '.join(topics)}" if topics else f"this reads {', '.join(POSES)}"
            raise UsageError(f"{path}: no pose topic {topic!r}; {there}")
        rows = []
        for message in MessageReader(log, chosen):
            if message.data is None:
                continue
            try:
                fields = Fields(decoders[message.channel](message.data))
                stamps = {
                    "log": message.log_time,
                    "publish": message.publish_time,
                    "header": fields.stamp_ns(),
                }
                pose = fields
                for name in POSES[kinds[message.channel]]:
                    pose = pose.inner(name)
                place, turn = pose.inner("position"), pose.inner("orientation")
                row = [*(place.number(k) for k in "xy"), *(turn.number(k) for k in "xyzw")]
            except UnusableError:
                continue
            if (stamp := stamps[time]) is not None:
                rows.append((stamp, *row))
    finally:
        log.close()
    if len({row[0] for row in rows}) < 2:
        raise SonarrecError(f"{path}: {topic} has fewer than two poses that can be read")
    at = np.array([row[0] for row in rows], np.int64)
    ahead, left, x, y, z, w = np.array([row[1:] for row in rows]).T
    yaw = np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2)))
    return pose_table(topic, {"topic": topic}, at, -yaw, -left, ahead)
