"""ROS message definitions: those we know, and the parser of those that logs bring along."""

from __future__ import annotations

import re
from dataclasses import dataclass

# Bodies as their packages define them; what is left out are comments and constants. `time` and
# the Header's `seq` are of ROS 1, builtin_interfaces/Time stands in their place in ROS 2.
_BODIES = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/PoseWithCovarianceStamped": """\
std_msgs/Header header
geometry_msgs/PoseWithCovariance pose""",
    "nav_msgs/Odometry": """\
std_msgs/Header header
string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist""",
    "sensor_msgs/Image": """\
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data""",
    "sensor_msgs/CompressedImage": """\
std_msgs/Header header
string format
uint8[] data""",
    "foxglove_msgs/RawImage": """\
builtin_interfaces/Time timestamp
string frame_id
uint32 width
uint32 height
string encoding
uint32 step
uint8[] data""",
    "foxglove_msgs/CompressedImage": """\
builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format""",
    "marine_acoustic_msgs/PingInfo": """\
float32 frequency
float32 sound_speed
float32[] tx_beamwidths
float32[] rx_beamwidths""",
    "marine_acoustic_msgs/SonarImageData": """\
bool is_bigendian
uint32 dtype
uint32 beam_count
uint8[] data""",
    "marine_acoustic_msgs/ProjectedSonarImage": """\
std_msgs/Header header
marine_acoustic_msgs/PingInfo ping_info
geometry_msgs/Vector3[] beam_directions
float32[] ranges
marine_acoustic_msgs/SonarImageData image""",
    "marine_acoustic_msgs/RawSonarImage": """\
std_msgs/Header header
marine_acoustic_msgs/PingInfo ping_info
float32 sample_rate
uint32 samples_per_beam
uint32 sample0
float32[] tx_delays
float32[] tx_angles
float32[] rx_angles
marine_acoustic_msgs/SonarImageData image""",
    "sonar_oculus/OculusFire": """\
std_msgs/Header header
uint8 mode
uint8 gamma
uint8 flags
float64 range
float64 gain
float64 speed_of_sound
float64 salinity""",
    "sonar_oculus/OculusPing": """\
std_msgs/Header header
sonar_oculus/OculusFire fire_msg
uint32 ping_id
uint16 part_number
uint32 start_time
int16[] bearings
float64 range_resolution
uint32 num_ranges
uint32 num_beams
sensor_msgs/Image ping""",
    "oculus_interfaces/Ping": """\
std_msgs/Header header
uint32 ping_id
uint32 ping_firing_date
float64 range
float64 gain_percent
float64 frequency
float64 speed_of_sound_used
float64 range_resolution
float64 temperature
float64 pressure
uint8 master_mode
bool has_gains
uint16 n_ranges
uint16 n_beams
uint32 step
uint8 sample_size
int16[] bearings
uint8[] ping_data""",
}

_NUMBERS = {
    "bool": "?", "byte": "B", "char": "B",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
    "float32": "f", "float64": "d",
}  # fmt: skip
_FIELD = re.compile(
    r"(?P<type>[\w/]+)(?:<=[0-9]+)?(?:\[(?P<bound>(?:<=)?[0-9]{0,9})\])?\s+"
    r"(?P<name>\w+)(?P<value>\s*=.*|\s+.*)?"  # a constant, or a field and its default
)
_SEPARATOR = re.compile(r"^=+\s*$", re.MULTILINE)
_MAX_DEPTH = 16


class DefinitionError(Exception):
    """A message definition cannot be understood; the text says why."""


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message.

    kind: a number's code in `struct` and numpy ("B", "d", ...), "string", or a message's Struct.
    count: None for a single value, 0 for a sequence that tells its length, else that many.
    """

    name: str
    kind: str | Struct
    count: int | None


@dataclass(frozen=True, slots=True)
class Struct:
    """One message: its fields in order."""

    name: str
    fields: tuple[Field, ...]


def definition_text(name: str, ros1: bool = False) -> str:
    """The definition of a message we know, its dependencies below lines of "=" as rosbag2 has it.

    name: package/Name. Raises KeyError for another.
    """
    parts = [_body(name, ros1)]
    told = {name}
    queue = _dependencies(name, ros1)
    while queue:
        dependency = queue.pop(0)
        if dependency not in told:
            told.add(dependency)
            parts.append(f"MSG: {dependency}\n{_body(dependency, ros1)}")
            queue += _dependencies(dependency, ros1)
    return f"\n{'=' * 80}\n".join(parts) + "\n"


def known(name: str) -> bool:
    """Whether definition_text knows the message."""
    return name in _BODIES


def _body(name: str, ros1: bool) -> str:
    body = _BODIES[name]
    if ros1:
        body = body.replace("builtin_interfaces/Time", "time")
        if name == "std_msgs/Header":
            body = f"uint32 seq\n{body}"
    return body


def _dependencies(name: str, ros1: bool) -> list[str]:
    types = [line.partition(" ")[0].removesuffix("[]") for line in _body(name, ros1).splitlines()]
    return [t for t in types if "/" in t]


def parse_definition(text: str, name: str) -> Struct:
    """The layout of message `name` (package/Name) from a definition with its dependencies.

    Constants, default values and comments are passed over: nothing in the text is evaluated.
    Raises DefinitionError where it cannot be understood.
    """
    head, *rest = _SEPARATOR.split(text)
    bodies = {name: head}
    for part in rest:
        title, _, body = part.strip().partition("\n")
        if title.startswith("MSG:"):
            bodies[title.removeprefix("MSG:").strip().replace("/msg/", "/")] = body
    return _Parser(bodies).struct(name, 0)


class _Parser:
    def __init__(self, bodies: dict[str, str]) -> None:
        self._bodies = bodies
        self._done: dict[str, Struct] = {}

    def struct(self, name: str, depth: int) -> Struct:
        if depth > _MAX_DEPTH:
            raise DefinitionError(f"{name} nests too deeply")
        if name not in self._done:
            body = self._bodies.get(name) or _BODIES.get(name)
            if body is None:
                raise DefinitionError(f"{name} is not defined")
            lines = (line.partition("#")[0].strip() for line in body.splitlines())
            fields = (self._field(line, name, depth) for line in lines if line)
            self._done[name] = Struct(name, tuple(f for f in fields if f is not None))
        return self._done[name]

    def _field(self, line: str, owner: str, depth: int) -> Field | None:
        match = _FIELD.fullmatch(line)
        if match is None:
            raise DefinitionError(f"{line[:60]!r} in {owner} is no field")
        if (match["value"] or "").lstrip().startswith("="):
            return None
        bound = match["bound"]
        if bound is None:
            count = None
        elif bound == "" or bound.startswith("<="):
            count = 0
        else:
            count = int(bound)
            if not count:
                raise DefinitionError(f"{line[:60]!r} in {owner} holds nothing")
        return Field(match["name"], self._kind(match["type"], owner, depth), count)

    def _kind(self, name: str, owner: str, depth: int) -> str | Struct:
        if name in _NUMBERS:
            return _NUMBERS[name]
        if name == "string":
            return name
        if name in ("time", "duration"):
            return Struct(name, (Field("sec", "I", None), Field("nanosec", "I", None)))
        full = name.replace("/msg/", "/")
        if "/" not in full:
            full = f"{owner.partition('/')[0]}/{full}"
            if name == "Header" and full not in self._bodies:
                full = "std_msgs/Header"  # ROS 1 lets its package be left out
        return self.struct(full, depth + 1)
