"""Sonar messages for tests, written by other people's packages from definitions kept here.

Each row of WRITERS makes one MCAP file of one message type in one encoding; images of 8 bits. The
geometry of polar pings is in numbers that every message holds exactly.
"""

from __future__ import annotations

import base64
import importlib
import importlib.resources
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import foxglove
import numpy as np
from flatbuffers import Builder
from foxglove.channels import CompressedImageChannel, RawImageChannel
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from foxglove.messages import CompressedImage, RawImage, Timestamp
from foxglove_schemas_flatbuffer.Time import CreateTime
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sonarrec.readers.messages.types import IMAGES, decoder_for, message_type
from sonarrec.sonar.frame import Frame
from sonarrec.sonar.stated import Sonar
from tests.support.logs import PERIOD_NS, mcap_file

# As the packages' own .msg files have them, FORMATS in short.
DEFINITIONS = {
    "foxglove_msgs/msg/RawImage": "TIME timestamp\nstring frame_id\nuint32 width\nuint32 height\n"
    "string encoding\nuint32 step\nuint8[] data",
    "foxglove_msgs/msg/CompressedImage": "TIME timestamp\nstring frame_id\nuint8[] data\n"
    "string format",
    "marine_acoustic_msgs/msg/PingInfo": "float32 frequency\nfloat32 sound_speed\n"
    "float32[] tx_beamwidths\nfloat32[] rx_beamwidths",
    "marine_acoustic_msgs/msg/SonarImageData": "bool is_bigendian\nuint32 DTYPE_UINT8=0\n"
    "uint32 DTYPE_FLOAT64 = 9 # the last\nuint32 dtype\nuint32 beam_count\nuint8[] data",
    "marine_acoustic_msgs/msg/ProjectedSonarImage": "std_msgs/Header header\nPingInfo ping_info\n"
    "geometry_msgs/Vector3[] beam_directions\nfloat32[] ranges\nSonarImageData image",
    "marine_acoustic_msgs/msg/RawSonarImage": "std_msgs/Header header\nPingInfo ping_info\n"
    "float32 sample_rate\nuint32 samples_per_beam\nuint32 sample0\nfloat32[] tx_delays\n"
    "float32[] tx_angles\nfloat32[] rx_angles\nSonarImageData image",
    "sonar_oculus/msg/OculusFire": "std_msgs/Header header\nuint8 mode\nuint8 gamma\nuint8 flags\n"
    "float64 range\nfloat64 gain\nfloat64 speed_of_sound\nfloat64 salinity",
    # An older and a newer version: the definition in the file tells which.
    "sonar_oculus/msg/OculusPing": "std_msgs/Header header\nsensor_msgs/Image ping\n"
    "OculusFire fire_msg\nuint32 ping_id\nuint32 status\nfloat64 frequency\nfloat64 temperature\n"
    "float64 pressure\nfloat64 speed_of_sound\nfloat64 start_time\nint16[] bearings\n"
    "float64 range_resolution\nuint32 num_ranges\nuint32 num_beams",
    "sonar_oculus/msg/OculusPingUncompressed": "std_msgs/Header header\nOculusFire fire_msg\n"
    "uint32 ping_id\nuint16 part_number\nuint32 start_time\nint16[] bearings\n"
    "float64 range_resolution\nuint32 num_ranges\nuint32 num_beams\n"
    "sensor_msgs/CompressedImage ping",
    "oculus_interfaces/msg/Ping": "std_msgs/Header header\nuint32 ping_id\n"
    "uint32 ping_firing_date\nfloat64 range\nfloat64 gain_percent\nfloat64 frequency\n"
    "float64 speed_of_sound_used\nfloat64 range_resolution\nfloat64 temperature\n"
    "float64 pressure\nuint8 master_mode\nbool has_gains\nuint16 n_ranges\nuint16 n_beams\n"
    "uint32 step\nuint8 sample_size\nint16[] bearings\nuint8[] ping_data",
}
SOUND_SPEED = 1500.0
BIN_M = 1 / 64
FIRST_BIN = 64  # of the messages that begin away from the sonar


def bearings_deg(beams: int) -> np.ndarray:
    """Wider apart towards the edges, in whole hundredths of a degree."""
    place = np.linspace(-1, 1, beams)
    return np.round(place * (14 + 2 * np.abs(place)), 2)


def polar_toml(bins: int, first_bin: float, bearings: np.ndarray) -> str:
    """The sonar.toml of an image folder that says what the polar messages tell."""
    return (
        '[sonar]\nlayout = "polar"\ntilt_deg = 20.0\nheight_m = 0.5\nframe_rate_hz = 4.0\n'
        f"range_min_m = {first_bin * BIN_M}\nrange_max_m = {(first_bin + bins) * BIN_M}\n"
        f"bearings_deg = {bearings.tolist()}\n"
    )


TILT_TOML = "[sonar]\ntilt_deg = 20.0\nheight_m = 0.5\nframe_rate_hz = 4.0\n"


def stamp_ns(k: int) -> int:
    """The header's stamp of frame k: neither its log time nor its publish time."""
    return 1_700_000_000_000_000_007 + k * PERIOD_NS


def _clock(k: int) -> dict[str, int]:
    return dict(zip(("sec", "nanosec"), divmod(stamp_ns(k), 10**9), strict=True))


def header(k: int) -> dict[str, Any]:
    return {"seq": k, "stamp": _clock(k), "frame_id": "sonar"[: k % 2 * 5]}


def png(image: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.imencode(".png", image)[1]).ravel()


def image_fields(k: int, image: np.ndarray) -> dict[str, Any]:
    rows, columns = image.shape
    return {
        "header": header(k), "height": rows, "width": columns, "encoding": "mono8",
        "is_bigendian": 0, "step": columns, "data": image.ravel(),
    }  # fmt: skip


def compressed_fields(k: int, image: np.ndarray) -> dict[str, Any]:
    return {"header": header(k), "format": "mono8; png compressed mono8", "data": png(image)}


def foxglove_fields(k: int, image: np.ndarray) -> dict[str, Any]:
    return {"timestamp": _clock(k), "frame_id": "x", **image_fields(k, image)}


def foxglove_compressed_fields(k: int, image: np.ndarray) -> dict[str, Any]:
    return {"timestamp": _clock(k), "frame_id": "x", "data": png(image), "format": "png"}


def directions(bearings_deg: np.ndarray, across: str = "y", forward: str = "z") -> list[Any]:
    return [
        {"x": 0.0, "y": 0.0, "z": 0.0, across: math.sin(b), forward: math.cos(b)}
        for b in np.radians(bearings_deg).tolist()
    ]


_INFO = {
    "frequency": 1.2e6, "sound_speed": SOUND_SPEED,
    "tx_beamwidths": np.full(3, 0.3, np.float32), "rx_beamwidths": np.zeros(0, np.float32),
}  # fmt: skip


def samples(image: np.ndarray, dtype: int = 0) -> dict[str, Any]:
    return {
        "is_bigendian": image.dtype.byteorder == ">", "dtype": dtype,
        "beam_count": image.shape[1], "data": np.frombuffer(image.tobytes(), np.uint8),
    }  # fmt: skip


def projected_fields(k: int, image: np.ndarray) -> dict[str, Any]:
    middles = (FIRST_BIN + np.arange(len(image)) + 0.5) * BIN_M
    return {
        "header": header(k), "ping_info": _INFO,
        "beam_directions": directions(bearings_deg(image.shape[1])),
        "ranges": middles.astype(np.float32), "image": samples(image),
    }  # fmt: skip


def raw_fields(k: int, image: np.ndarray) -> dict[str, Any]:
    """Its bins lie about whole multiples of a bin's length: the window begins at a half."""
    nothing = np.zeros(0, np.float32)
    return {
        "header": header(k), "ping_info": _INFO, "sample_rate": SOUND_SPEED / (2 * BIN_M),
        "samples_per_beam": len(image), "sample0": FIRST_BIN, "tx_delays": nothing,
        "tx_angles": nothing,
        "rx_angles": np.radians(bearings_deg(image.shape[1])).astype(np.float32),
        "image": samples(image),
    }  # fmt: skip


def _hundredths(beams: int) -> np.ndarray:
    return np.round(bearings_deg(beams) * 100).astype(np.int16)


def oculus_fields(k: int, image: np.ndarray, compressed: bool = False) -> dict[str, Any]:
    fire = {
        "header": header(k), "mode": 1, "gamma": 2, "flags": 3, "range": 4.0, "gain": 5.0,
        "speed_of_sound": 6.0, "salinity": 7.0,
    }  # fmt: skip
    ping = compressed_fields(k, image) if compressed else image_fields(k, image)
    if not compressed:
        ping["step"] = len(image)  # as the driver writes it: the number of bins
    return {
        "header": header(k), "fire_msg": fire, "ping_id": k, "part_number": 1, "status": 0,
        "frequency": 1.2e6, "temperature": 9.0, "pressure": 1.1, "speed_of_sound": 1500.0,
        "start_time": 1, "bearings": _hundredths(image.shape[1]), "range_resolution": BIN_M,
        "num_ranges": len(image), "num_beams": image.shape[1], "ping": ping,
    }  # fmt: skip


def oculus_interfaces_fields(k: int, image: np.ndarray) -> dict[str, Any]:
    return {
        "header": header(k), "ping_id": k, "ping_firing_date": 3, "range": 2.0,
        "gain_percent": 40.0, "frequency": 2.1e6, "speed_of_sound_used": 1500.0,
        "range_resolution": BIN_M, "temperature": 9.0, "pressure": 1.1, "master_mode": 2,
        "has_gains": False, "n_ranges": len(image), "n_beams": image.shape[1],
        "step": image.shape[1], "sample_size": 1, "bearings": _hundredths(image.shape[1]),
        "ping_data": image.ravel(),
    }  # fmt: skip


FIELDS: dict[str, Callable[[int, np.ndarray], dict[str, Any]]] = {
    "sensor_msgs/msg/Image": image_fields,
    "sensor_msgs/msg/CompressedImage": compressed_fields,
    "foxglove_msgs/msg/RawImage": foxglove_fields,
    "foxglove_msgs/msg/CompressedImage": foxglove_compressed_fields,
    "marine_acoustic_msgs/msg/ProjectedSonarImage": projected_fields,
    "marine_acoustic_msgs/msg/RawSonarImage": raw_fields,
    "sonar_oculus/msg/OculusPing": oculus_fields,
    "sonar_oculus/msg/OculusPingUncompressed": lambda k, i: oculus_fields(k, i, compressed=True),
    "oculus_interfaces/msg/Ping": oculus_interfaces_fields,
}


def store(ros1: bool) -> Any:
    """A rosbags typestore that knows DEFINITIONS."""
    types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        clock = "time" if ros1 else "builtin_interfaces/Time"
        types.register(get_types_from_msg(text.replace("TIME", clock), name))
    return types


STORES = {ros1: store(ros1) for ros1 in (False, True)}


def serialised(name: str, fields: dict[str, Any], ros1: bool = False, little: bool = True) -> bytes:
    """One message by rosbags; fields that the definition lacks are left out."""
    types = STORES[ros1]

    def build(kind: str, values: dict[str, Any]) -> Any:
        made = {}
        for field, (what, detail) in types.fielddefs[kind][1]:
            value = values[field]
            if what.name == "NAME":
                value = build(detail, value)
            elif what.name == "SEQUENCE" and detail[0][0].name == "NAME":
                value = [build(detail[0][1], v) for v in value]
            made[field] = value
        return types.types[kind](**made)

    message = build(name, fields)
    if ros1:
        return bytes(types.serialize_ros1(message, name))
    return bytes(types.serialize_cdr(message, name, little_endian=little))


def definition(name: str, ros1: bool = False) -> bytes:
    """The definition with its dependencies, as rosbags writes it."""
    return str(STORES[ros1].generate_msgdef(name, ros_version=1 if ros1 else 2)[0]).encode()


Maker = Callable[[Path, list[np.ndarray], str], None]
"""Writes images to an MCAP file, with a compression."""


def encoded(encode: Callable[[int, np.ndarray], bytes], **how: Any) -> Maker:
    """encode: frame number and image to the bytes of a message. how: of mcap_file."""

    def make(path: Path, images: list[np.ndarray], compression: str) -> None:
        timed = [("/sonar", k * PERIOD_NS, encode(k, image)) for k, image in enumerate(images)]
        mcap_file(path, timed, compression=compression, **how)

    return make


def by_rosbags(name: str, ros1: bool = False) -> Maker:
    """CDR in either byte order, or the serialisation of ROS 1."""
    return encoded(
        lambda k, image: serialised(name, FIELDS[name](k, image), ros1, little=k % 2 == 0),
        schema=name.replace("/msg/", "/") if ros1 else name,
        encoding="ros1" if ros1 else "cdr",
        schema_encoding="ros1msg" if ros1 else "ros2msg",
        schema_data=definition(name, ros1),
    )


def plain(value: Any, text: bool = True) -> Any:
    """Without arrays; bytes in base64 where JSON is to hold them."""
    if isinstance(value, dict):
        return {key: plain(inner, text) for key, inner in value.items()}
    if isinstance(value, np.ndarray) and value.dtype == np.uint8:
        data = value.tobytes()
        return base64.b64encode(data).decode() if text else data
    return value.tolist() if isinstance(value, np.ndarray) else value


def by_json(name: str, dotted: str) -> Maker:
    """As the BlueOS recorder writes them, or Foxglove, which calls its nanoseconds nsec."""

    def encode(k: int, image: np.ndarray) -> bytes:
        fields = plain(FIELDS[name](k, image))
        if dotted.startswith("foxglove."):
            clock = fields["timestamp"]
            fields["timestamp"] = {"sec": clock["sec"], "nsec": clock["nanosec"]}
        return json.dumps(fields).encode()

    schema = {"schema": dotted, "schema_encoding": "jsonschema"}
    return encoded(encode, encoding="json", schema_data=b'{"type": "object"}', **schema)


def by_foxglove(compressed: bool) -> Maker:
    """The Foxglove SDK writes the whole file, in protobuf."""
    options = {"none": None, "lz4": MCAPCompression.Lz4, "zstd": MCAPCompression.Zstd}

    def make(path: Path, images: list[np.ndarray], compression: str) -> None:
        context = foxglove.Context()
        settings = MCAPWriteOptions(compression=options[compression], chunk_size=4000)
        with foxglove.open_mcap(path, context=context, writer_options=settings):
            channel = (CompressedImageChannel if compressed else RawImageChannel)(
                "/sonar", context=context
            )
            for k, image in enumerate(images):
                time = Timestamp(*divmod(stamp_ns(k), 10**9))
                if compressed:
                    data = png(image).tobytes()
                    message = CompressedImage(timestamp=time, data=data, format="png")
                else:
                    rows, columns = image.shape
                    message = RawImage(
                        timestamp=time, frame_id="x", width=columns, height=rows,
                        encoding="mono8", step=columns, data=image.tobytes(),
                    )  # fmt: skip
                channel.log(message, log_time=k * PERIOD_NS)

    return make


def by_flatbuffers(message: str) -> Maker:
    """The flatbuffers package writes foxglove.RawImage or foxglove.CompressedImage, by the code
    that flatc made of their schemas."""
    module = message.replace("foxglove", "foxglove_schemas_flatbuffer")
    table, package = importlib.import_module(module), module.rpartition(".")[0]
    schema = importlib.resources.files(package) / f"{message.rpartition('.')[2]}.bfbs"

    def encode(k: int, image: np.ndarray) -> bytes:
        fields = plain(FIELDS[message.replace("foxglove.", "foxglove_msgs/msg/")](k, image), False)
        builder = Builder(len(fields["data"]) + 1024)
        # Texts and bytes lie outside the table, and before it; times and numbers inside.
        for key, value in fields.items():
            if isinstance(value, str):
                fields[key] = builder.CreateString(value)
            elif isinstance(value, bytes):
                fields[key] = builder.CreateByteVector(value)
        table.Start(builder)
        for key, value in fields.items():
            if key == "timestamp":
                value = CreateTime(builder, value["sec"], value["nanosec"])
            add = getattr(table, "Add" + key.title().replace("_", ""), None)
            if add is not None:  # else a field of ROS alone
                add(builder, value)
        builder.Finish(table.End(builder))
        return bytes(builder.Output())

    how = {"encoding": "flatbuffer", "schema_encoding": "flatbuffer"}
    return encoded(encode, schema=message, schema_data=schema.read_bytes(), **how)


# FIELDS gives rows for CDR, ROS 1 and JSON to each message type. All that a new type needs is in
# `sonarrec help contribute`, "How to add".
WRITERS: dict[str, Maker] = {
    **{f"{name}, CDR": by_rosbags(name) for name in FIELDS},
    **{f"{name}, ROS 1": by_rosbags(name, ros1=True) for name in FIELDS},
    **{f"{name}, JSON": by_json(name, name.replace("/", ".")) for name in FIELDS},
    "foxglove.RawImage, JSON": by_json("foxglove_msgs/msg/RawImage", "foxglove.RawImage"),
    "foxglove.CompressedImage, JSON": by_json(
        "foxglove_msgs/msg/CompressedImage", "foxglove.CompressedImage"
    ),
    "foxglove.RawImage, protobuf": by_foxglove(compressed=False),
    "foxglove.CompressedImage, protobuf": by_foxglove(compressed=True),
    "foxglove.RawImage, flatbuffer": by_flatbuffers("foxglove.RawImage"),
    "foxglove.CompressedImage, flatbuffer": by_flatbuffers("foxglove.CompressedImage"),
}


def sidecars(writer: str, bins: int, beams: int) -> tuple[str, str]:
    """The sonar.toml of an MCAP of that writer, and that of the same frames in a folder; empty
    for images that are no pings. Raises KeyError for a type of pings that it does not know."""
    name, bearings = message_type(writer.partition(",")[0]), bearings_deg(beams)
    if name in IMAGES:
        return "", ""
    match name:
        case "marine_acoustic_msgs/ProjectedSonarImage":
            return TILT_TOML, polar_toml(bins, FIRST_BIN, bearings)
        case "marine_acoustic_msgs/RawSonarImage":  # middles at whole bins, bearings in 32 bits
            bearings = np.degrees(np.radians(bearings).astype(np.float32).astype(float))
            return TILT_TOML, polar_toml(bins, FIRST_BIN - 0.5, bearings)
        case (
            "sonar_oculus/OculusPing"
            | "sonar_oculus/OculusPingUncompressed"
            | "oculus_interfaces/Ping"
        ):
            return TILT_TOML, polar_toml(bins, 0, bearings)
    raise KeyError(f"{name}: add a case to `sidecars` in tests/support/messages.py")


# Logs of pings

PROJECTED = "marine_acoustic_msgs/msg/ProjectedSonarImage"
RAW = "marine_acoustic_msgs/msg/RawSonarImage"
OCULUS = "oculus_interfaces/msg/Ping"
BINS, BEAMS = 60, 24
BEARINGS_DEG = bearings_deg(BEAMS)
TILT = Sonar(tilt_deg=20.0)


def polar_frames(count: int = 3) -> list[np.ndarray]:
    """Bright blobs on speckle: samples resemble their neighbours, as a sonar's do."""
    rng = np.random.default_rng(7)
    images = []
    for _ in range(count):
        speckle = cv2.GaussianBlur(rng.normal(0, 1, (BINS, BEAMS)), (0, 0), 1.2)
        images.append(np.clip(90 + 90 * speckle, 1, 255).astype(np.uint8))
    return images


def ping_of(name: str, fields: dict[str, Any], **options: Any) -> Frame:
    decode = decoder_for(name, "ros2msg", definition(name), "cdr")
    assert decode is not None
    assert decode.polar
    return decode(memoryview(serialised(name, fields, **options)))


def log_of(path: Path, pings: list[dict[str, Any]], name: str = PROJECTED) -> Path:
    bytes_of = [("/a", k * PERIOD_NS, serialised(name, f)) for k, f in enumerate(pings)]
    mcap_file(path, bytes_of, schema=name)
    (path.parent / "sonar.toml").unlink()
    return path
