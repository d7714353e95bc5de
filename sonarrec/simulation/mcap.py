"""Writes simulated frames into an MCAP: images, or polar pings that state their geometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from sonarrec.arrays import ByteImage
from sonarrec.readers.messages.ros import known_messages
from sonarrec.sonar.geometry import beam_bearings, bin_ranges
from sonarrec.sonar.stated import Geometry

TOPIC = "/sonar/image"
SOUND_SPEED = 1500.0  # m/s
FREQUENCY = 1_800_000.0  # Hz
ACOUSTIC = "marine_acoustic_msgs/msg"


class McapWriter:
    """Writes frames into one channel of an MCAP file. Use it as a context manager.

    After an exception the file gets no footer.
    """

    def __init__(self, path: Path, sonar: Geometry | None) -> None:
        """sonar: of polar images, whose pings state it; None: fan images. Raises OSError."""
        self._store, self._sonar, self._count = known_messages(False), sonar, 0
        self._name = f"{ACOUSTIC}/ProjectedSonarImage" if sonar else "sensor_msgs/msg/Image"
        self._file = path.open("wb")
        self._writer = Writer(self._file, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="sonarrec")
        text = self._store.generate_msgdef(self._name, ros_version=2)[0].encode()
        schema = self._writer.register_schema(self._name, "ros2msg", text)
        self._channel = self._writer.register_channel(TOPIC, "cdr", schema)

    def write(self, timestamp_ns: int, image: ByteImage) -> None:
        """Add a frame: (rows, columns) uint8, a fan image or (range bins, beams)."""
        sec, nanosec = divmod(timestamp_ns, 1_000_000_000)
        stamp = self._of("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        header = self._of("std_msgs/msg/Header", stamp=stamp, frame_id="sonar")
        values = self._image(image) if self._sonar is None else self._ping(image, self._sonar)
        data = self._store.serialize_cdr(self._of(self._name, header=header, **values), self._name)
        times = {"log_time": timestamp_ns, "publish_time": timestamp_ns}
        self._writer.add_message(self._channel, data=bytes(data), sequence=self._count, **times)
        self._count += 1

    def _of(self, name: str, **values: Any) -> Any:
        return self._store.types[name](**values)

    def _image(self, image: ByteImage) -> dict[str, Any]:
        rows, columns = image.shape
        shape = {"height": rows, "width": columns, "step": columns, "encoding": "mono8"}
        return {**shape, "is_bigendian": 0, "data": image.ravel()}

    def _ping(self, image: ByteImage, sonar: Geometry) -> dict[str, Any]:
        """z forward, y to the right; samples range-major."""
        bins, beams = image.shape
        widths = dict.fromkeys(("tx_beamwidths", "rx_beamwidths"), np.zeros(0, np.float32))
        info = {"frequency": FREQUENCY, "sound_speed": SOUND_SPEED, **widths}
        samples = {"is_bigendian": False, "dtype": 0, "beam_count": beams, "data": image.ravel()}
        bearings = np.radians(beam_bearings(sonar, beams)).tolist()
        return {
            "ping_info": self._of(f"{ACOUSTIC}/PingInfo", **info),
            "beam_directions": [
                self._of("geometry_msgs/msg/Vector3", x=0.0, y=np.sin(b), z=np.cos(b))
                for b in bearings
            ],
            "ranges": bin_ranges(sonar, bins).astype(np.float32),
            "image": self._of(f"{ACOUSTIC}/SonarImageData", **samples),
        }

    def __enter__(self) -> McapWriter:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()
