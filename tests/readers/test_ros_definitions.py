"""Definitions in a log: read as they are, never run, and never believed too far."""

from __future__ import annotations

import itertools
import struct
import sys
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from sonarrec.errors import SonarrecError
from sonarrec.readers.messages.fields import DefinitionError
from sonarrec.readers.messages.ros import RosDecoder, known_messages, parse_definition, ros_decoder
from sonarrec.readers.messages.types import MESSAGES, decoder_for, message_type
from sonarrec.readers.raw import UnusableError
from tests.support import messages
from tests.support.logs import cdr_image, frames, mcap_file, read
from tests.support.messages import DEFINITIONS

IMAGE = frames(1)[0]
LE = b"\x00\x01\x00\x00"


def decoded(text: str, body: bytes, head: bytes = LE) -> dict[str, Any]:
    return RosDecoder(parse_definition(text, "pkg/Outer"), "pkg/Outer", ros1=False)(
        memoryview(head + body)
    )


def test_definitions_are_those_of_the_packages() -> None:
    """Ours, where a log brings none, against the ones kept with the tests."""
    for ros1 in (False, True):
        known = known_messages(ros1).fielddefs
        for name in DEFINITIONS:
            if not name.startswith("sonar_oculus/msg/OculusPing"):  # other versions than the tests'
                assert known[name][1] == messages.STORES[ros1].fielddefs[name][1]
    parts = {message_type(name) for name in DEFINITIONS} - set(MESSAGES)
    assert {name.rpartition("/")[2] for name in parts} == {
        *("PingInfo", "SonarImageData", "OculusFire")
    }


def test_a_definition_with_all_there_is() -> None:
    """And as others write them: short lines of =, CRLF, constants in small letters."""
    text = """\
# a comment
uint8 A=1
float32 pi__ = 3.14
string B = "# no comment"   # a constant
int32 x 5                   # a default
string<=10 bounded
float64[<=3] few
uint8[4] four
Inner[] inner
string[] names
Inner[2] two
Empty nothing
builtin_interfaces/msg/Time when
===
MSG: pkg/Inner
float32 a
string b
===
MSG: pkg/Empty
===
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
    body = struct.pack("<iI3sx", -7, 3, b"ab\0")
    body += struct.pack("<Id4B", 1, 0.5, 1, 2, 3, 4)
    body += struct.pack("<IfI2s2xfI1s3x", 2, 1.5, 2, b"x\0", 2.5, 1, b"\0")
    body += struct.pack("<II2s2xI3s1x", 2, 2, b"n\0", 3, b"mm\0")
    body += struct.pack("<fI1s3xfI1s", 3.5, 1, b"\0", 4.5, 1, b"\0")
    body += struct.pack("<B2xiI", 0, -1, 9)
    for written in (text, text.replace("\n", "\r\n")):
        fields = decoded(written, body)
        assert list(fields) == [
            "x", "bounded", "few", "four", "inner", "names", "two", "nothing", "when",
        ]  # fmt: skip
        assert fields["x"] == -7
        assert bytes(fields["bounded"]) == b"ab\0"
        assert fields["few"].tolist() == [0.5]
        assert fields["four"].tolist() == [1, 2, 3, 4]
        assert [(i["a"], bytes(i["b"])) for i in fields["inner"]] == [(1.5, b"x\0"), (2.5, b"\0")]
        assert [bytes(n) for n in fields["names"]] == [b"n\0", b"mm\0"]
        assert [i["a"] for i in fields["two"]] == [3.5, 4.5]
        assert fields["nothing"] == {}
        assert fields["when"] == {"sec": -1, "nanosec": 9}


def test_other_encodings_than_plain_cdr_are_told() -> None:
    with pytest.raises(UnusableError, match="XCDR2"):
        decoded("uint8 a", b"\x01", b"\x00\x07\x00\x00")


def test_ros1_by_hand() -> None:
    """ROS 1 aligns nothing, and its texts have no closing zero."""
    rows, columns = IMAGE.shape
    message = struct.pack("<IIII", 1, 3_000_000_000, 5, 2) + b"id"
    message += struct.pack("<III5sBII", rows, columns, 5, b"mono8", 0, columns, IMAGE.size)
    for definition in (b"", messages.definition("sensor_msgs/msg/Image", ros1=True)):
        decode = decoder_for("sensor_msgs/Image", "ros1msg", definition, "ros1")
        assert decode is not None
        ping = decode(memoryview(message + IMAGE.tobytes()))
        np.testing.assert_array_equal(ping.pixels, IMAGE)
        assert ping.stamp_ns == 3_000_000_000 * 10**9 + 5


@pytest.mark.parametrize("frame_id", [b"", b"no zero", b"caf\xe9\0", b"\0", b"two\0\0"])
def test_texts_that_rosbags_would_refuse(frame_id: bytes) -> None:
    decode = decoder_for("sensor_msgs/Image", "", b"", "cdr")
    assert decode is not None
    message = cdr_image(IMAGE, frame_id=frame_id)
    np.testing.assert_array_equal(decode(memoryview(message)).pixels, IMAGE)
    np.testing.assert_array_equal(decode(memoryview(message + bytes(9))).pixels, IMAGE)


NOT_UNDERSTOOD = {
    "it holds itself": "Self inner",
    "not defined": "Missing x",
    "no name": "int32",
    "no identifier": "int32 x-y",
    "wstring": "wstring x",
    "nothing": "uint8[0] x",
    "too many digits": "uint8[99999999999] x",
    "negative": "int32[-1] x",
    "a circle": "A a\n===\nMSG: pkg/A\nB b\n===\nMSG: pkg/B\nA a",
    "no text": "\x00",
    "too long": "#" * 300_000,
    "too many fields": "\n".join(f"int32 x{n}" for n in range(1001)),
    "too many lines": "\n".join(f"int32 x{n}" for n in range(20_000)),
    "code for each element": "string[999999] x",
    "a fixed array of messages": "A[999999999] x\n===\nMSG: pkg/A\nuint8 a",
    "seventeen deep": "M0 m\n" + "".join(
        f"===\nMSG: pkg/M{n}\nM{n + 1} m\n" for n in range(17)
    ) + "===\nMSG: pkg/M17\nint32 x",
}  # fmt: skip


@pytest.mark.parametrize("text", NOT_UNDERSTOOD.values(), ids=NOT_UNDERSTOOD)
def test_definitions_that_cannot_be_understood(text: str, tmp_path: Path) -> None:
    """One line says why, where no definition of ours serves."""
    with pytest.raises(DefinitionError) as caught:
        ros_decoder("pkg/Self", text.encode(), ros1=False)
    assert "\n" not in str(caught.value)

    def log(name: str) -> Path:
        return mcap_file(
            tmp_path / "log.mcap", [("/a", 0, cdr_image(IMAGE))],
            schema=name, schema_encoding="ros2msg", schema_data=text.encode(),
        )  # fmt: skip

    with pytest.raises(SonarrecError, match="/a"):
        read(log("sonar_oculus_interface/msg/OculusPing"))
    np.testing.assert_array_equal(read(log("sensor_msgs/msg/Image")).images, [IMAGE])


@pytest.mark.slow
def test_a_definition_that_lies_about_sizes() -> None:
    """Sequences that say they are long cost no memory."""
    cases = {
        "uint8[999999999] data": bytes(100),
        "Three[] data\n===\nMSG: sensor_msgs/Three\nfloat64 x\nfloat64 y": struct.pack("<I", 2**31)
        + bytes(100),
        "float64[] data": struct.pack("<I", 2**29) + bytes(100),
    }  # fmt: skip
    for text, body in cases.items():
        for wire, message in (("cdr", LE + body), ("cdr", b"\0\6\0\0" + body), ("ros1", body)):
            decode = decoder_for("sensor_msgs/Image", "ros2msg", text.encode(), wire)
            assert decode is not None
            tracemalloc.start()
            with pytest.raises(UnusableError):
                decode(memoryview(message))
            assert tracemalloc.get_traced_memory()[1] < 20e6
            tracemalloc.stop()


# Nothing in a definition is run

COMPILED: list[str] | None = None


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "compile" and COMPILED is not None:
        source = arguments[0]
        COMPILED.append(source.decode() if isinstance(source, bytes) else str(source))


@cache
def watch() -> None:
    """It cannot be taken away again, and slows whatever comes after."""
    sys.addaudithook(_watch)


@contextmanager
def compiled() -> Iterator[list[str]]:
    """Every source that Python compiles meanwhile."""
    global COMPILED
    watch()
    COMPILED = []
    try:
        yield COMPILED
    finally:
        COMPILED = None


def hostile(trap: str) -> Iterator[str]:
    """Definitions with code in every place there is."""
    for line in (
        "{}", "int32 {}", "int32 x {}", "int32 x # {}", "int32 X={}", "string X = '{}'",
        'string X="{}"', "string X = {}", "int32 {}=1", "uint8[{}] x", "uint8[<={}] x",
        "string<={} x", "{} x", "pkg/{} x", "{}[] x", "int32[3] x [{}]", "@{} int32 x",
        "int32 x\n===\nMSG: {}\nint32 x", "int32 x\n===\nMSG: pkg/{}\nint32 x",
        'int32 x\n"""\n{}\n"""', "int32 x\n===\nMSG: pkg/A'\n{}", "int32 x\\\n{}", "int32 x\r{}",
        "int32 x\x0b{}", "int32 x\u2028{}",
    ):  # fmt: skip
        yield line.format(trap) + "\nuint8 y"


def test_nothing_in_a_definition_is_run(tmp_path: Path) -> None:
    """A constant's name or value, a field's name, a bound, a comment: all are only text, and none
    of it is in any code that rosbags writes and runs."""
    traps = [
        f"__import__('pathlib').Path({str(tmp_path / 'ran')!r}).touch()  # MARKER",
        "MARKER = 1", "MARKER", "MARKER()", "MARKER'; MARKER", "\\n  MARKER()", "class MARKER",
    ]  # fmt: skip
    understood = 0
    for trap, ros1 in itertools.product(traps, (False, True)):
        for text in hostile(trap):
            with compiled() as sources:
                try:
                    decode = ros_decoder("pkg/Name", text.encode(), ros1)
                except DefinitionError:
                    continue
                assert decode is not None
                understood += 1
                with_head = LE + bytes(64)
                assert isinstance(decode(memoryview(bytes(64) if ros1 else with_head)), dict)
            assert sources, "rosbags no longer compiles code: look at what it does now"
            assert not [source for source in sources if "MARKER" in source]
    assert understood > 50
    assert not (tmp_path / "ran").exists()


def test_the_watch_sees_code_of_a_definition() -> None:
    """What rosbags makes of a definition as it stands: the test above can fail."""
    with compiled() as sources:
        messages.store(False).register(get_types_from_msg("int32 MARKER", "pkg/msg/Name"))
    assert any("MARKER" in source for source in sources)
