"""Definitions in a log: read as they are, never run, and never believed too far."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from sonarrec.readers.messages import MESSAGES, decoder_for, message_type
from sonarrec.readers.raw import UnusableError
from sonarrec.readers.ros_definitions import (
    DefinitionError,
    Struct,
    definition_text,
    known,
    parse_definition,
)
from tests.support import messages
from tests.support.logs import mcap_file
from tests.support.messages import (
    DEFINITIONS,
    OCULUS,
    PROJECTED,
    RAW,
    polar_frames,
    read,
    serialised,
)


def test_definitions_are_those_of_the_packages() -> None:
    """Ours, where a log brings none, against the ones kept with the tests."""
    for ros1 in (False, True):
        for name in messages.FIELDS:
            if name == "sonar_oculus/msg/OculusPing":
                continue  # the later version is ours, the older is the tests'
            short = message_type(name)
            if known(short):
                ours = parse_definition(definition_text(short, ros1), short)
                theirs = parse_definition(messages.definition(name, ros1).decode(), short)
                assert ours == theirs
    assert set(map(message_type, DEFINITIONS)) - set(MESSAGES) == {
        "marine_acoustic_msgs/PingInfo",
        "marine_acoustic_msgs/SonarImageData",
        "sonar_oculus/OculusFire",
    }


def test_a_definition_with_all_there_is() -> None:
    text = """\
# a comment
uint8 A=1
string B = "# no comment"   # a constant
int32 x 5                   # a default
string<=10 bounded
float64[<=3] few
uint8[4] four
Inner[] inner
builtin_interfaces/msg/Time when
===
MSG: pkg/Inner
float32 a
===
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
    layout = parse_definition(text, "pkg/Outer")
    counts = {f.name: f.count for f in layout.fields}
    assert counts == {"x": None, "bounded": None, "few": 0, "four": 4, "inner": 0, "when": None}
    assert isinstance(layout.fields[4].kind, Struct)


def test_a_header_without_its_package() -> None:
    other = "\n===\nMSG: pkg/Header\nuint8 own"
    for text, name in (("Header h", "std_msgs/Header"), ("Header h" + other, "pkg/Header")):
        (field,) = parse_definition(text, "pkg/Outer").fields
        assert isinstance(field.kind, Struct)
        assert field.kind.name == name


@pytest.mark.parametrize(
    "text",
    [
        "Self inner",
        "Missing x",
        "int32",
        "int32 x-y",
        "wstring x",
        "uint8[0] x",
        "uint8[99999999999] x",
        "int32[-1] x",
        "A a\n===\nMSG: pkg/A\nB b\n===\nMSG: pkg/B\nA a",
        "\x00",
    ],
)
def test_definitions_that_cannot_be_understood(text: str) -> None:
    with pytest.raises(DefinitionError):
        parse_definition(text, "pkg/Self")


def test_a_definition_that_lies_about_sizes() -> None:
    """Sequences that say they are long cost neither time nor memory."""
    head = b"\x00\x01\x00\x00"
    cases = {
        "Empty[] data\n===\nMSG: sensor_msgs/Empty\n": struct.pack("<I", 2**32 - 1),
        "string[] data": struct.pack("<I", 2**32 - 1) + bytes(100),
        "uint8[999999999] data": bytes(100),
        "Pair[] data\n===\nMSG: sensor_msgs/Pair\nuint8 a\nstring b": struct.pack("<I", 10**6)
        + bytes(6 * 10**6),
        "float64[] data": struct.pack("<I", 2**29) + bytes(100),
    }
    for text, body in cases.items():
        for wire, message in (("cdr", head + body), ("ros1", body)):
            decode = decoder_for("sensor_msgs/Image", "ros2msg", text.encode(), wire)
            assert decode is not None
            with pytest.raises(UnusableError):
                decode(memoryview(message))


def test_nothing_in_a_definition_is_run(tmp_path: Path) -> None:
    """A constant's name or value, a field's name, a bound: all are only text."""
    trap = f"__import__('pathlib').Path({str(tmp_path / 'ran')!r}).touch()"
    for text in (f"int32 X={trap}", f"int32 {trap}=1", f"uint8[{trap}] x", f"int32 x {trap}"):
        try:
            parse_definition(text + "\nuint8 y", "pkg/Name")
        except DefinitionError:
            continue
    assert not (tmp_path / "ran").exists()


def test_a_log_without_definitions_is_read_by_ours(tmp_path: Path) -> None:
    image = polar_frames(1)[0]
    for name in (PROJECTED, RAW, OCULUS, "sensor_msgs/msg/Image"):
        message = serialised(name, messages.FIELDS[name](0, image))
        path = mcap_file(tmp_path / "log.mcap", [("/a", 0, message)], schema=name,
                         schema_encoding="ros2idl", schema_data=b"module x {}")  # fmt: skip
        assert read(path)[0][0].image.any()
