"""Makes the fields of the messages that are written: one function for each message type."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from sonarrec.geometry import beam_bearings, bin_ranges
from sonarrec.sonar import Geometry

FRAME_ID = "sonar"
SOUND_SPEED = 1500.0  # m/s
FREQUENCY = 1_800_000.0  # Hz

MakeFields = Callable[[int, np.ndarray, Any], dict[str, Any]]
"""Makes the fields of a message from time (ns), image, and geometry (None if it is not polar)."""


def _clock(timestamp_ns: int, *names: str) -> dict[str, int]:
    """Seconds and nanoseconds; names: of the two, by default those of ROS 2."""
    values = divmod(timestamp_ns, 1_000_000_000)
    return dict(zip(names or ("sec", "nanosec"), values, strict=True))


def _header(timestamp_ns: int) -> dict[str, Any]:
    return {"seq": 0, "stamp": _clock(timestamp_ns), "frame_id": FRAME_ID}


def _pixels(image: np.ndarray) -> dict[str, Any]:
    return {
        "height": image.shape[0],
        "width": image.shape[1],
        "encoding": "mono8" if image.dtype == np.uint8 else "mono16",
        "step": image.shape[1] * image.itemsize,
        "data": image.tobytes(),
    }


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def ros_image(timestamp_ns: int, image: np.ndarray, _: Geometry | None) -> dict[str, Any]:
    """sensor_msgs/Image."""
    return {"header": _header(timestamp_ns), **_pixels(image), "is_bigendian": 0}


def ros_compressed_image(
    timestamp_ns: int, image: np.ndarray, _: Geometry | None
) -> dict[str, Any]:
    """sensor_msgs/CompressedImage, with the format written as by image_transport."""
    kind = _pixels(image)["encoding"]
    return {
        "header": _header(timestamp_ns),
        "format": f"{kind}; png compressed {kind}",
        "data": _png(image),
    }


def foxglove_image(timestamp_ns: int, image: np.ndarray, _: Geometry | None) -> dict[str, Any]:
    """foxglove.RawImage."""
    return {"timestamp": _clock(timestamp_ns), "frame_id": FRAME_ID, **_pixels(image)}


def foxglove_compressed_image(
    timestamp_ns: int, image: np.ndarray, _: Geometry | None
) -> dict[str, Any]:
    """foxglove.CompressedImage."""
    return {
        "timestamp": _clock(timestamp_ns),
        "frame_id": FRAME_ID,
        "data": _png(image),
        "format": "png",
    }


def with_clock(
    make: MakeFields,
    seconds: str,
    nanoseconds: str,
    timestamp_ns: int,
    image: np.ndarray,
    sonar: Geometry,
) -> dict[str, Any]:
    """The fields of a foxglove message, with the names that an encoding has for its time."""
    stamp = {"timestamp": _clock(timestamp_ns, seconds, nanoseconds)}
    return make(timestamp_ns, image, sonar) | stamp


def _ping_info() -> dict[str, Any]:
    widths: dict[str, Any] = {"tx_beamwidths": [], "rx_beamwidths": []}
    return {"frequency": FREQUENCY, "sound_speed": SOUND_SPEED, **widths}


def _samples(image: np.ndarray) -> dict[str, Any]:
    """marine_acoustic_msgs/SonarImageData, range-major."""
    return {
        "is_bigendian": False,
        "dtype": 0 if image.dtype == np.uint8 else 2,
        "beam_count": image.shape[1],
        "data": image.tobytes(),
    }


def projected_sonar_image(timestamp_ns: int, image: np.ndarray, sonar: Geometry) -> dict[str, Any]:
    """marine_acoustic_msgs/ProjectedSonarImage: z forward, y to the right."""
    bearings = np.radians(beam_bearings(sonar, image.shape[1]))
    return {
        "header": _header(timestamp_ns),
        "ping_info": _ping_info(),
        "beam_directions": [
            {"x": 0.0, "y": y, "z": z}
            for y, z in zip(np.sin(bearings).tolist(), np.cos(bearings).tolist(), strict=True)
        ],
        "ranges": bin_ranges(sonar, image.shape[0]).tolist(),
        "image": _samples(image),
    }


def _bin_length(sonar: Geometry, bins: int) -> float:
    return (sonar.range_max_m - sonar.range_min_m) / bins


def raw_sonar_image(timestamp_ns: int, image: np.ndarray, sonar: Geometry) -> dict[str, Any]:
    """marine_acoustic_msgs/RawSonarImage. The range window is rounded to whole samples."""
    bin_m = _bin_length(sonar, image.shape[0])
    return {
        "header": _header(timestamp_ns),
        "ping_info": _ping_info(),
        "sample_rate": SOUND_SPEED / (2 * bin_m),
        "samples_per_beam": image.shape[0],
        "sample0": round(float(bin_ranges(sonar, image.shape[0])[0]) / bin_m),
        "tx_delays": [],
        "tx_angles": [],
        "rx_angles": np.radians(beam_bearings(sonar, image.shape[1])).tolist(),
        "image": _samples(image),
    }


def _from_the_sonar_on(image: np.ndarray, sonar: Geometry) -> np.ndarray:
    """The image with whole empty bins in front, because an Oculus records from range 0 on."""
    empty = round(sonar.range_min_m / _bin_length(sonar, image.shape[0]))
    return np.pad(image, ((empty, 0), (0, 0)))


def _hundredths(sonar: Geometry, beams: int) -> list[int]:
    return [round(b) for b in (beam_bearings(sonar, beams) * 100).tolist()]


def oculus_ping(timestamp_ns: int, image: np.ndarray, sonar: Geometry) -> dict[str, Any]:
    """sonar_oculus/OculusPing."""
    bin_m = _bin_length(sonar, image.shape[0])
    image = _from_the_sonar_on(image, sonar)
    return {
        "header": _header(timestamp_ns),
        "fire_msg": {
            "header": _header(timestamp_ns),
            **{"mode": 2, "gamma": 127, "flags": 0, "range": bin_m * image.shape[0]},
            **{"gain": 50.0, "speed_of_sound": SOUND_SPEED, "salinity": 0.0},
        },
        **{"ping_id": 0, "part_number": 0, "start_time": 0},
        "bearings": _hundredths(sonar, image.shape[1]),
        "range_resolution": bin_m,
        "num_ranges": image.shape[0],
        "num_beams": image.shape[1],
        "ping": ros_image(timestamp_ns, image, sonar),
    }


def oculus_interfaces_ping(timestamp_ns: int, image: np.ndarray, sonar: Geometry) -> dict[str, Any]:
    """oculus_interfaces/Ping, with rows that hold no gains."""
    bin_m = _bin_length(sonar, image.shape[0])
    image = _from_the_sonar_on(image, sonar)
    return {
        "header": _header(timestamp_ns),
        **{"ping_id": 0, "ping_firing_date": 0, "range": bin_m * image.shape[0]},
        **{"gain_percent": 50.0, "frequency": FREQUENCY, "speed_of_sound_used": SOUND_SPEED},
        **{"range_resolution": bin_m, "temperature": 10.0, "pressure": 1.0, "master_mode": 2},
        **{"has_gains": False, "n_ranges": image.shape[0], "n_beams": image.shape[1]},
        "step": image.shape[1] * image.itemsize,
        "sample_size": image.itemsize,
        "bearings": _hundredths(sonar, image.shape[1]),
        "ping_data": image.tobytes(),
    }
