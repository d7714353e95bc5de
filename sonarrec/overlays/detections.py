"""Detections for ROS 2: the declared estimates of a frame as a vision_msgs/Detection3DArray.

The frame `sonar` is level: x ahead, y to the left, z up, its origin in the sonar (REP 103).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from sonarrec.arrays import FloatArray
from sonarrec.geometry import floor_depth, ground_range
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Estimate, Fan

FRAME_ID = "sonar"
NAME = "vision_msgs/msg/Detection3DArray"
# vision_msgs 4, as in ROS 2 from Humble on.
_DEFINITIONS = {
    "ObjectHypothesis": "string class_id\nfloat64 score\n",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\n"
    "geometry_msgs/PoseWithCovariance pose\n",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nstring id\n",
    "Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}


@cache
def _store() -> Typestore:
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, f"vision_msgs/msg/{name}"))
    return store


def definition() -> bytes:
    """The message's definition with all inside it, as an MCAP's ros2msg schema."""
    return _store().generate_msgdef(NAME, ros_version=2)[0].encode()


def has_time(stamp_ns: int) -> bool:
    """Whether a message can have this time: ROS 2 counts seconds in 32 bits, 1901 to 2038."""
    return -(2**31) <= stamp_ns // 1_000_000_000 < 2**31


def detections_message(
    fan: Fan, stamp_ns: int, landmarks: LandmarkSet, estimates: Sequence[Estimate]
) -> bytes:
    """The declared estimates of a frame in CDR, with ID and score as class and score.

    Positions lie on the floor. The covariance of x, y (m) and of the turn about z (rad) follows
    from the standard errors; it is 0, which means unknown in ROS, if the method states none. A
    detection's id is its track's number. An unknown orientation is 0 with a variance of pi^2.
    stamp_ns: one that `has_time`.
    """
    stamp = _made("builtin_interfaces/msg/Time", *divmod(stamp_ns, 1_000_000_000))
    header = _made("std_msgs/msg/Header", stamp, FRAME_ID)
    size = _made("geometry_msgs/msg/Vector3", 2 * landmarks.radius_m, 2 * landmarks.radius_m, 0.0)
    detections = []
    for e in estimates:
        if e.declared:
            pose = _pose(fan, e)
            covariance = _covariance(fan, e).ravel()
            with_pose = _made(
                "vision_msgs/msg/ObjectHypothesisWithPose",
                _made("vision_msgs/msg/ObjectHypothesis", str(e.landmark), e.score),
                _made("geometry_msgs/msg/PoseWithCovariance", pose, covariance),
            )
            box = _made("vision_msgs/msg/BoundingBox3D", pose, size)
            number = str(e.object) if e.object >= 0 else ""
            detections.append(
                _made("vision_msgs/msg/Detection3D", header, [with_pose], box, number)
            )
    return bytes(_store().serialize_cdr(_made(NAME, header, detections), NAME))


def _made(name: str, *fields: Any) -> Any:
    """A message object."""
    return _store().types[name](*fields)


def _pose(fan: Fan, e: Estimate) -> Any:
    ground, bearing = _ground(fan, e), math.radians(e.bearing_deg)
    # Nearer than the floor only the direction is known: the position is straight below the sonar.
    down = math.sqrt(max(e.range_m**2 - ground**2, 0.0))
    half = 0.0 if math.isnan(e.orientation_deg) else math.radians(e.orientation_deg - 90) / 2
    x, y = ground * math.cos(bearing), -ground * math.sin(bearing)
    point = _made("geometry_msgs/msg/Point", x, y, -down)
    rotation = _made("geometry_msgs/msg/Quaternion", 0.0, 0.0, math.sin(half), math.cos(half))
    return _made("geometry_msgs/msg/Pose", point, rotation)


def _ground(fan: Fan, e: Estimate) -> float:
    return float(ground_range(fan, max(e.range_m, floor_depth(fan))))


def _covariance(fan: Fan, e: Estimate) -> FloatArray:
    """(6, 6) of x, y, z (m) and the turns about them (rad)."""
    covariance = np.zeros((6, 6))
    ground, bearing = _ground(fan, e), math.radians(e.bearing_deg)
    if not math.isnan(e.range_sigma_m) and not math.isnan(e.bearing_sigma_deg) and ground:
        along = np.array([math.cos(bearing), -math.sin(bearing)]) * e.range_sigma_m
        along *= e.range_m / ground
        across = np.array([math.sin(bearing), math.cos(bearing)]) * ground
        across *= math.radians(e.bearing_sigma_deg)
        covariance[:2, :2] = np.outer(along, along) + np.outer(across, across)
    if math.isnan(e.orientation_deg):
        covariance[5, 5] = math.pi**2
    elif not math.isnan(e.orientation_sigma_deg):
        covariance[5, 5] = math.radians(e.orientation_sigma_deg) ** 2
    return covariance
