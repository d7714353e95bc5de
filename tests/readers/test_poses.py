"""The sonar's motion told by a table: trigonometry written out, and the simulator's poses."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from sonarrec.errors import SonarrecError
from sonarrec.readers.poses import read_poses, read_topic
from sonarrec.recogniser.plane import working_plane
from sonarrec.simulation.motion import poses
from sonarrec.simulation.scene import load_scene
from sonarrec.sonar.frame import Motion
from sonarrec.sonar.geometry import PoseTable, pose_table
from tests.support.command import SAMPLE, sample_log, sonarrec
from tests.support.drawn import make_fan
from tests.support.logs import cdr_compressed_image
from tests.support.messages import serialised
from tests.support.slow import but_first

HEIGHT = 0.68
BY_TOPIC = ("--topic", "/sonar", "--odometry-topic", "/odom")


def table_of(folder: Path, text: str) -> PoseTable:
    (folder / "odometry.csv").write_text(text)
    return read_poses(folder / "odometry.csv")


def motion(table: PoseTable, start_ns: int, end_ns: int) -> Motion:
    found = table.motion(start_ns, end_ns)
    assert found is not None
    return found


def seen_by(x: float, y: float, pose: tuple[float, float, float]) -> tuple[float, float]:
    """(slant range m, bearing deg) of a floor point for a sonar at (yaw deg, x, y)."""
    yaw, at_x, at_y = pose
    range_m = math.sqrt((x - at_x) ** 2 + (y - at_y) ** 2 + HEIGHT**2)
    return range_m, math.degrees(math.atan2(x - at_x, y - at_y)) - yaw


@settings(max_examples=30)
@given(
    kind=st.sampled_from(["fan", "floor"]),
    before=st.tuples(st.floats(-170, 170), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)),
    turn=st.floats(-25, 25),
    carried=st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4)),
    range_m=st.floats(1.6, 3.4),
    bearing_deg=st.floats(-12, 12),
)
def test_a_still_object_moves_by_trigonometry(kind, before, turn, carried, range_m, bearing_deg):
    after = (before[0] + turn, before[1] + carried[0], before[2] + carried[1])
    heading = math.radians(before[0] + bearing_deg)
    ground = math.sqrt(range_m**2 - HEIGHT**2)
    x, y = before[1] + ground * math.sin(heading), before[2] + ground * math.cos(heading)
    columns = np.array([before, after]).T
    table = pose_table("", {}, np.array([0, 10**9]), *columns)
    moved = motion(table, 0, 10**9)
    plane = working_plane(kind, make_fan(120, height_m=HEIGHT), 0.15, 10.0)
    first, second = (
        np.stack(plane.from_polar(*(np.array([v]) for v in seen_by(x, y, p))), axis=-1)
        for p in (before, after)
    )
    np.testing.assert_allclose(plane.moved(first, moved), second, atol=1e-6)
    many = np.broadcast_to(first, (3, 4, 1, 2))
    assert plane.moved(many, moved).shape == many.shape


def test_a_pose_between_two_rows_lies_on_the_line_between_them(tmp_path):
    table = table_of(tmp_path, "timestamp,yaw,x,y\n10,350,0,0\n11,4,0,2\n12,4,1,2\n")
    # 350 to 4 deg is a turn of 14 to the right, through 357 at half time.
    half = motion(table, 10_000_000_000, 10_500_000_000)
    assert half.pan_deg == pytest.approx(7)
    # Headed to 350 deg, a metre towards y is ahead and a little to the right.
    assert half.ahead_m == pytest.approx(math.cos(math.radians(10)))
    assert half.right_m == pytest.approx(math.sin(math.radians(10)))
    assert table.motion(11_000_000_000, 11_000_000_000) == Motion(0.0, 0.0, 0.0)


def test_times_in_iso_8601_are_those_of_a_clock(tmp_path):
    cells = ["2024-05-01T12:00:00Z", "2024-05-01 14:00:00.5+02:00", "2024-05-01T07:00:01-0500"]
    text = "timestamp,yaw\n" + "".join(f"{cell},{n}\n" for n, cell in enumerate(cells))
    times = table_of(tmp_path, text).time_ns
    assert times.tolist() == [1_714_564_800_000_000_000 + n * 500_000_000 for n in range(3)]
    days = table_of(tmp_path, "timestamp,yaw\n2024-05-01T12:00Z,0\n2024-05-02T12:00Z,1\n")
    assert np.diff(days.time_ns).tolist() == [86_400 * 10**9]


def test_without_x_and_y_the_sonar_only_turns(tmp_path):
    table = table_of(tmp_path, "timestamp_ns, yaw\n0, 1\n1000000000, -2\n")
    assert table.motion(0, 1_000_000_000) == Motion(-3.0, 0.0, 0.0)


@pytest.mark.parametrize("start", [0, 1_763_700_000])
@pytest.mark.parametrize(
    ("column", "unit"), [("timestamp", 1), ("timestamp", 10**9), ("timestamp_ns", 10**9)]
)
def test_seconds_and_nanoseconds_are_told_by_the_time_between_rows(tmp_path, start, column, unit):
    """At 20 rows a second, from 0 or since 1970; the frames lie between the rows."""
    lines = [f"{(start * 20 + i) * unit / 20:.0{2 if unit == 1 else 0}f},{i}" for i in range(40)]
    table = table_of(tmp_path, "\n".join([f"{column},yaw", *lines]))
    first = start * 10**9 + 125_000_000
    pan_deg = motion(table, first, first + 500_000_000).pan_deg
    assert pan_deg == pytest.approx(10, abs=1e-4)  # 10 rows; 1970's seconds are rounded


def test_rows_may_come_in_any_order_and_twice(tmp_path):
    table = table_of(tmp_path, "timestamp,yaw\n2,20\n0,0\n1,10\n1,10\n3,30\n")
    assert motion(table, 500_000_000, 2_500_000_000).pan_deg == pytest.approx(20)


def test_what_was_not_measured_is_not_told(tmp_path):
    times = [*np.arange(0, 5, 0.1), *np.arange(7, 9, 0.1)]  # nothing between 4.9 and 7 s
    table = table_of(tmp_path, "timestamp,yaw\n" + "".join(f"{t:.1f},{t:.1f}\n" for t in times))
    covered = {t: table.covers(round(t * 1e9)) for t in (-0.1, 0, 4.9, 5.0, 6.9, 7, 8.9, 8.91)}
    assert [t for t, told in covered.items() if told] == [0, 4.9, 7, 8.9]
    assert table.motion(4_000_000_000, 6_000_000_000) is None
    # What happened in between does not matter where both ends are told.
    assert motion(table, 4_000_000_000, 8_000_000_000).pan_deg == pytest.approx(4)


@pytest.fixture
def pings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Sixteen frames of the sample log, 4 a second, panning by 0.5 deg a frame."""
    monkeypatch.chdir(tmp_path)
    return sample_log(tmp_path / "pings", 16)


def pan_table(path: Path, count: int = 16, per_second: float = 1.0) -> Path:
    """The poses of the sample log's sonar: 4 frames a second, 2 deg a second to the right."""
    scene = replace(load_scene("sample_pan"), frames=count)
    lines = [f"{i / scene.rate_hz},{p.pan_deg * per_second}" for i, p in enumerate(poses(scene))]
    path.write_text("\n".join(["timestamp,yaw", *lines]) + "\n")
    return path


def test_frames_without_a_pose_are_told_once(pings):
    told = sonarrec("run", pings, "--odometry", pan_table(Path("short.csv"), 11), code=3)
    (problem,) = (line for line in told.stderr.splitlines() if "short.csv" in line)
    assert "0.000 to 2.500 s" in problem
    run = tomllib.loads(Path("sonarrec_out/pings/run.toml").read_text())
    assert run["input"]["problems"] == [problem.removeprefix("sonarrec: ")]


@pytest.mark.parametrize(("late_s", "is_told"), [(1.7e9, True), (2.0, False)])
def test_poses_by_another_clock_of_the_same_length_are_told(pings, late_s, is_told):
    lines = pan_table(Path("unix.csv"), 16).read_text().split()
    rows = [f"{float(line.split(',')[0]) + late_s:.3f},{line.split(',')[1]}" for line in lines[1:]]
    Path("unix.csv").write_text("\n".join([lines[0], *rows]) + "\n")
    told = sonarrec("run", pings, "--odometry", "unix.csv", code=3).stderr
    assert ("take 1700000000.000 s off" in told) == is_told


@pytest.mark.parametrize("factor", [-1.0, math.pi / 180, 0.5, 0.9, 1.1, 2.0])
def test_a_table_that_the_images_contradict_is_noted(pings, factor):
    told = sonarrec("run", pings, "--odometry", pan_table(Path("odd.csv"), per_second=factor))
    assert ("note: odd.csv" in told.stderr) == (factor not in (0.9, 1.1))
    assert (f"{1 / factor:.2g} times as far" in told.stderr) == (factor not in (-1.0, 0.9, 1.1))


@pytest.mark.parametrize("late_s", [-2.0, 0.0, 2.0])
def test_another_clock_of_the_poses_is_named(tmp_path, late_s):
    """Frames 44 to 84 hold a turn of the sonar."""
    header, *lines = pan_table(tmp_path / "late.csv", 128).read_text().split()
    rows = [line.split(",") for line in lines]
    shifted = [f"{float(time) + late_s},{yaw}" for time, yaw in rows]
    (tmp_path / "late.csv").write_text("\n".join([header, *shifted]) + "\n")
    words = ("--frames", "44:84", "--odometry", tmp_path / "late.csv", "-o", tmp_path, "-q")
    told = sonarrec("run", SAMPLE, *words).stderr
    assert ("note: late.csv" in told) == bool(late_s)
    if late_s:
        assert f"{abs(late_s):g} s {'earlier' if late_s > 0 else 'later'}" in told


@pytest.mark.parametrize(("unit", "is_told"), [(1, False), (1000, True)])
def test_poses_of_an_impossible_speed_are_told(pings, unit, is_told):
    """.2 m a second, with a jitter of 2 cm at 20 rows a second."""
    jitter = 0.02 * (-1) ** np.arange(100)
    rows = [f"{n / 20},{n / 40},{unit * (n / 100 + jitter[n])},0" for n in range(100)]
    Path("fast.csv").write_text("\n".join(["timestamp,yaw,x,y", *rows]) + "\n")
    table = read_poses(Path("fast.csv"))
    assert bool(table.too_fast()) == is_told
    for words in (("run", pings), ("map", "sonarrec_out/pings")):
        told = sonarrec(*words, "--odometry", "fast.csv", "-q").stderr
        assert ("m/s" in told) == is_told


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "empty"),
        ("timestamp,heading\n0,1\n1,2", "no yaw"),
        ("time,yaw\n0,1\n1,2", "neither timestamp nor timestamp_ns"),
        ("timestamp,yaw,x\n0,1,2\n1,2,3", "x and y"),
        ("timestamp,yaw,X,Y\n0,1,2,3\n1,1,2,3", "columns X, Y"),
        ("timestamp,yaw,lat,lon\n0,1,2,3\n1,1,2,3", "columns lat, lon"),
        ("timestamp,yaw,x,y\n0,1,1e300,3\n1,1,2,3", "line 2: x"),
        ("timestamp,yaw\n0,1", "two times"),
        (
            "timestamp,yaw\n2024-05-01T12:00:00Z,1\n2024-05-01T12:00:01,2",
            "line 3: timestamp .* UTC offset .*, not '2024-05-01T12:00:01'",
        ),
        ("timestamp,yaw\n2024-05-01T12:00:00Z,1\n2300-05-01T12:00:00Z,2", "neither"),
        ("timestamp,yaw\n0,1\n100,1\n200,1", "100 are neither"),
        ("timestamp,yaw\n1763700000000000,1\n1763700000050000,2", "microseconds"),
        ("timestamp,yaw\n0,1\n1,north", "line 3: yaw .*'north'"),
        ("timestamp_ns,yaw\n0.5,1\n1,1", "line 2: timestamp_ns"),
        # In TUM form:
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 1", "line 2: .*TUM"),
        ("0 1 2 3 0 0 0 1\n# a\n1 1 2 3 0 0 x 1", "line 3: .*TUM"),
        ("0 1 2 3 0 0 nan 1\n1 1 2 3 0 0 0 1", "line 1: .*TUM"),
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 0", "line 2: no pose"),
        ("0 1 2 3 0 0 0 1\n1 1e12 2 3 0 0 0 1", "line 2: no pose"),
        ("0 1 2 3 0 0 0 1", "two times"),
        ("0 1 2 3 0 0 0 1\n100 1 2 3 0 0 0 1\n200 1 2 3 0 0 0 1", "100 are neither"),
    ],
)
def test_a_table_that_cannot_be_used(tmp_path, text, fault):
    with pytest.raises(SonarrecError, match=f"odometry.csv.*{fault}"):
        table_of(tmp_path, text)


@settings(max_examples=30)
@given(
    yaw=st.floats(-math.pi, math.pi),
    pitch=st.floats(-1.3, 1.3),
    roll=st.floats(-1.3, 1.3),
    moved=st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-50, 50)),
    length=st.sampled_from([1.0, -1.0, 1e-200, 3.0]),
)
def test_tum_poses_head_along_their_x_axis(tmp_path_factory, yaw, pitch, roll, moved, length):
    """Half angles of yaw, pitch and roll make the quaternion; the heading is that of the rotated x
    axis on the floor, counted to the right. Roll, pitch and height have no part in it."""
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    quaternion = (
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
        cy * cp * cr + sy * sp * sr,
    )
    cells = " ".join(repr(v) for v in (*moved, *(length * q for q in quaternion)))
    text = f"# t tx ty tz qx qy qz qw\n1763700000.25 0 0 0 0 0 0 1\n\n1763700000.5\t{cells}\n"
    table = table_of(tmp_path_factory.mktemp("tum"), text)
    told = motion(table, *table.time_ns.tolist())
    assert np.diff(table.time_ns) == pytest.approx([250_000_000], abs=512)  # of 64 bits since 1970
    assert math.cos(math.radians(told.pan_deg)) == pytest.approx(math.cos(yaw), abs=1e-9)
    assert math.sin(math.radians(told.pan_deg)) == pytest.approx(-math.sin(yaw), abs=1e-9)
    assert (told.ahead_m, -told.right_m) == pytest.approx(moved[:2])
    # Positions of a map are in the file's own axes.
    place = table.position(int(table.time_ns[1]), 0.0, 1.0)
    assert place == pytest.approx((moved[0] + math.cos(yaw), moved[1] + math.sin(yaw)))


@pytest.mark.parametrize(("axis", "is_told"), [("z", False), ("w", True), ("x", False)])
@pytest.mark.parametrize("tilt_deg", [0, 20])
def test_a_quaternion_whose_w_comes_first_is_told(
    axis: str, is_told: bool, tilt_deg: float, tmp_path: Path
) -> None:
    """z: turns as TUM has it. w: with qw first. x: upside down (NED), so that it may be meant."""
    lines = []
    for second in range(10):
        yaw, tilt = math.radians(8 * second - 30) / 2, math.radians(tilt_deg) / 2
        cy, sy, ct, st = math.cos(yaw), math.sin(yaw), math.cos(tilt), math.sin(tilt)
        q = {"z": (-sy * st, cy * st, sy * ct, cy * ct), "x": (cy * ct, sy * ct, -sy * st, cy * st)}
        q["w"] = q["z"][3:] + q["z"][:3]
        lines.append(f"{second} 0 0 0 {' '.join(map(str, q[axis]))}\n")
    (tmp_path / "poses.txt").write_text("".join(lines))
    assert bool(read_poses(tmp_path / "poses.txt").doubts) == is_told


def pose_log(
    path: Path,
    images: Path,
    yaw_of: list[float],
    schema: str = "nav_msgs/msg/Odometry",
    told: bool = True,
    lengths: Sequence[float] = (1.0,) * 16,
    changed: Callable[[int, int, bytes], tuple[int, bytes]] = lambda _, at, data: (at, data),
) -> Path:
    """An MCAP of the images, and of poses as rosbags writes them: ROS turns to the left.

    told: whether the file defines them. lengths: of each quaternion. changed: takes the number,
    time and bytes of a pose's message, returns its time and bytes.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    text = store.generate_msgdef(schema, ros_version=2)[0].encode() if told else b""
    zero, none = dict.fromkeys("xyz", 0.0), np.zeros(36)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        image_schema = writer.register_schema("sensor_msgs/msg/CompressedImage", "ros2msg", b"")
        channel = writer.register_channel("/sonar", "cdr", image_schema)
        pose_channel = writer.register_channel(
            "/odom", "cdr", writer.register_schema(schema, "ros2msg", text)
        )
        for number, image in enumerate(sorted(images.glob("*.png"))):
            at = number * 250_000_000
            writer.add_message(channel, at, cdr_compressed_image(image.read_bytes(), "png"), at)
            half = math.radians(-yaw_of[number]) / 2
            turned = {"z": lengths[number] * math.sin(half), "w": lengths[number] * math.cos(half)}
            pose: dict[str, Any] = {
                "position": {"x": 1.0, "y": 2.0, "z": 0.5},
                "orientation": {"x": 0.0, "y": 0.0, **turned},
            }
            header = {"stamp": {"sec": number, "nanosec": 7}, "frame_id": "odom"}
            fields: dict[str, Any] = {"header": header, "pose": pose}
            if schema.endswith("Odometry"):
                still = {"twist": {"linear": zero, "angular": zero}, "covariance": none}
                fields["pose"] = {"pose": pose, "covariance": none}
                fields |= {"child_frame_id": "sonar", "twist": still}
            at, data = changed(number, at, serialised(schema, fields))
            writer.add_message(pose_channel, at, data, at)
        writer.finish()
    path.with_suffix(".sonar.toml").write_bytes((images / "sonar.toml").read_bytes())
    return path


@pytest.mark.parametrize(
    ("schema", "told"),
    but_first([("nav_msgs/msg/Odometry", True), ("geometry_msgs/msg/PoseStamped", False)]),
    ids=["defined in the file", "known"],
)
def test_a_topic_is_as_good_as_a_table(pings, schema, told):
    yaw = [p.pan_deg for p in poses(replace(load_scene("sample_pan"), frames=16))]
    log = pose_log(Path("dive.mcap"), pings, yaw, schema, told)
    by_topic = sonarrec("run", log, *BY_TOPIC)
    assert "note: " not in by_topic.stderr
    table = read_topic(log, "/odom", "log")
    np.testing.assert_allclose(np.diff(table.pose[:, 0]), np.diff(yaw), atol=1e-9)
    assert table.pose[0, 1:].tolist() == [-2.0, 1.0]
    assert read_topic(log, "/odom", "header").time_ns.tolist() == [n * 10**9 + 7 for n in range(16)]
    by_table = ("--odometry", pan_table(Path("odometry.csv")), "--out", "by_table")
    sonarrec("run", log, "--topic", "/sonar", *by_table)
    tables = [Path(out) / "dive" / "estimates.csv" for out in ("sonarrec_out", "by_table")]
    places = [np.loadtxt(t, delimiter=",", skiprows=1, usecols=(0, 3, 4, 5)) for t in tables]
    np.testing.assert_allclose(*places, atol=0.02)  # the table is rounded
    # The topic is in run.toml: nothing has to be given again.
    sonarrec("run", log, "--config", "sonarrec_out/dive/run.toml", "--out", "again")
    assert Path("again/dive/estimates.csv").read_bytes() == tables[0].read_bytes()


@pytest.mark.slow
def test_a_topic_whose_z_points_down_is_noted(pings):
    """As of many vehicles (NED): its turns are to the right, where ROS has them to the left."""
    yaw = [-p.pan_deg for p in poses(replace(load_scene("sample_pan"), frames=16))]
    log = pose_log(Path("dive.mcap"), pings, yaw, "geometry_msgs/msg/PoseStamped")
    told = sonarrec("run", log, *BY_TOPIC).stderr
    assert "15 of 15 frames; z" in told
    assert "(REP 103)" in told
    assert "degrees" not in told


def test_an_orientation_may_be_of_any_length_but_none(pings):
    yaw, lengths = [3.0 * n for n in range(16)], [0.5**n for n in range(16)]
    lengths[2] = 0.0  # never filled in
    table = read_topic(pose_log(Path("dive.mcap"), pings, yaw, lengths=lengths), "/odom", "log")
    (problem,) = table.problems
    assert problem.startswith("message 2 of /odom")
    np.testing.assert_allclose(table.pose[:, 0], yaw[:2] + yaw[3:], atol=1e-9)


def test_a_topic_that_is_not_there_is_told_in_one_line(pings):
    log = pose_log(Path("dive.mcap"), pings, [0.0] * 16)
    for arguments, told in [
        ((log, "--odometry-topic", "/pose"), "there is /odom"),
        ((pings, "--odometry-topic", "/odom"), "this log is neither"),
        ((log, "--odometry-topic", "/odom", "--odometry", pan_table(Path("o.csv"))), "one of the"),
    ]:
        fault = sonarrec("run", *arguments, code=2).stderr
        assert told in fault
        assert fault.count("\n") == 1


def test_a_pose_that_cannot_be_used_is_a_line_and_a_gap(pings):
    """Here by its log time, beyond 63 bits, and by its bytes; the run goes on without them."""

    def changed(number: int, at: int, data: bytes) -> tuple[int, bytes]:
        return 2**63 + number if number in (7, 15) else at, data[:50] if number == 9 else data

    log = pose_log(Path("dive.mcap"), pings, [0.0] * 16, changed=changed)
    table = read_topic(log, "/odom", "log")
    assert len(table.time_ns) == 13
    assert [line.partition(":")[0] for line in table.problems] == [
        f"message {n} of /odom" for n in (8, 14, 15)
    ]
    told = sonarrec("run", log, *BY_TOPIC, code=3).stderr
    lines = [line for line in told.splitlines() if "/odom" in line]
    assert sum("every clock" in line for line in lines) == 2
    assert sum("malformed" in line for line in lines) == 1
