"""Access to the fields of one message, with their types checked, for every encoding."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from sonarrec.readers.raw import UnusableError


class DefinitionError(Exception):
    """A message definition cannot be used; the text says why."""


class Fields:
    """The decoded fields of a message. In JSON, bytes are base64 or a list of numbers. Every method
    raises UnusableError if the field is missing or has another type."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def _get(self, name: str) -> Any:
        if name not in self._values:
            raise UnusableError(f"malformed message (no field {name!r})")
        return self._values[name]

    def _wrong(self, name: str, expected: str) -> UnusableError:
        return UnusableError(f"malformed message (field {name!r} is no {expected})")

    def inner(self, name: str) -> Fields:
        """A message inside this one."""
        value = self._get(name)
        if not isinstance(value, Mapping):
            raise self._wrong(name, "message")
        return Fields(value)

    def integer(self, name: str, default: int | None = None) -> int:
        """A whole number, 0 or more. default: for a missing field."""
        value = default if default is not None and name not in self else self._get(name)
        if not isinstance(value, int) or value < 0:
            raise self._wrong(name, "whole number")
        return int(value)

    def number(self, name: str) -> float:
        """A finite number."""
        value = self._get(name)
        if not isinstance(value, int | float) or not -1e300 < value < 1e300:
            raise self._wrong(name, "number")
        return float(value)

    def text(self, name: str) -> str:
        """A string; binary messages give its bytes, some with a closing zero."""
        value = self._get(name)
        if isinstance(value, bytes | memoryview | np.ndarray):
            value = bytes(value).rstrip(b"\0").decode(errors="replace")
        if not isinstance(value, str):
            raise self._wrong(name, "text")
        return value

    def octets(self, name: str) -> memoryview:
        """Bytes, without a copy if the message holds them as bytes."""
        value = self._get(name)
        try:
            if isinstance(value, str):
                value = base64.b64decode(value, validate=True)
            elif isinstance(value, list):
                value = bytes(value)
            return memoryview(value).cast("B")
        except (TypeError, ValueError):
            raise self._wrong(name, "bytes") from None

    def numbers(self, name: str) -> np.ndarray:
        """(n,) float64, finite."""
        try:
            array = np.asarray(self._get(name), dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise self._wrong(name, "list of numbers") from None
        if array.ndim != 1 or not np.isfinite(array).all():
            raise self._wrong(name, "list of numbers")
        return array

    def vectors(self, name: str) -> np.ndarray:
        """(n, 3) float64, finite, from a list of geometry_msgs/Vector3."""
        value = self._get(name)
        if isinstance(value, list) and all(isinstance(v, Mapping) for v in value):  # from JSON
            value = {axis: [v.get(axis, 0.0) for v in value] for axis in "xyz"}
        if not isinstance(value, Mapping):
            raise self._wrong(name, "list of vectors")
        columns = [Fields(value).numbers(axis) for axis in "xyz"]
        if len({len(column) for column in columns}) > 1:
            raise self._wrong(name, "list of vectors")
        return np.column_stack(columns)

    def sender(self) -> Iterator[str]:
        """The frame_id of the header, or Foxglove's, unless it is missing or empty."""
        header = self._values.get("header", self._values)
        if isinstance(header, Mapping) and "frame_id" in header:
            with suppress(UnusableError):
                yield from filter(None, [Fields(header).text("frame_id")])

    def stamp_ns(self) -> int | None:
        """The stamp of the header, or Foxglove's timestamp, ns; None if there is neither."""
        clock: Any = self._values.get("timestamp")
        header = self._values.get("header")
        if isinstance(header, Mapping):
            clock = header.get("stamp", clock)
        if not isinstance(clock, Mapping):
            return None
        # ROS 2, Foxglove and ROS 1 have different names for seconds and nanoseconds in JSON.
        sec = next((clock[k] for k in ("sec", "secs") if k in clock), None)
        nanosec = next((clock[k] for k in ("nanosec", "nsec", "nsecs") if k in clock), 0)
        if not isinstance(sec, int) or not isinstance(nanosec, int):
            return None
        stamp = sec * 10**9 + nanosec
        if not -(2**63) <= stamp < 2**63:
            raise UnusableError("malformed message (its stamp is no time in nanoseconds)")
        return stamp
