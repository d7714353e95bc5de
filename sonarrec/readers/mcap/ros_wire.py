"""Takes ROS messages apart by their definition: CDR (ROS 2) and the serialisation of ROS 1."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from sonarrec.readers.mcap.ros_definitions import Struct
from sonarrec.readers.raw import UnusableError

# Second byte of the encapsulation header: plain CDR and plain XCDR2, big- and little-endian.
_CDR_KINDS = {0: (">", 8), 1: ("<", 8), 6: (">", 4), 7: ("<", 4)}  # byte order, widest alignment
_MAX_ITEMS = 10_000  # strings and structures in sequences of a message: none read here has as many


def decode_cdr(layout: Struct, message: memoryview) -> dict[str, Any]:
    """The fields of a CDR message, with its 4-byte encapsulation header.

    Numbers come as such, sequences of numbers as arrays without a copy, sequences of structures
    of one kind of number (points, vectors) as a structure of arrays, other sequences as lists.
    Raises UnusableError where the bytes are no such message.
    """
    if len(message) < 4 or message[0] != 0 or message[1] not in _CDR_KINDS:
        raise UnusableError("malformed message (no CDR header)")
    order, widest = _CDR_KINDS[message[1]]
    return _Wire(message[4:], order, widest).struct(layout)


def decode_ros1(layout: Struct, message: memoryview) -> dict[str, Any]:
    """The fields of a ROS 1 message, as decode_cdr gives them. Raises UnusableError likewise."""
    return _Wire(message, "<", 1).struct(layout)


class _Wire:
    """Reads the values of one message in turn."""

    def __init__(self, body: memoryview, order: str, widest: int) -> None:
        """widest: numbers are aligned to their own size, but to no more than this."""
        self._body = body
        self._order = order
        self._widest = widest
        self._at = 0
        self._items_left = _MAX_ITEMS

    def _take(self, size: int, alignment: int = 1) -> int:
        """Where the next `size` bytes begin."""
        start = self._at + -self._at % min(alignment, self._widest)
        self._at = start + size
        if self._at > len(self._body):
            raise UnusableError("malformed message (it ends too early)")
        return start

    def _number(self, kind: str) -> Any:
        code = self._order + kind
        size = struct.calcsize(code)
        return struct.unpack_from(code, self._body, self._take(size, size))[0]

    def _string(self) -> str:
        size = self._number("I")
        start = self._take(size)
        return bytes(self._body[start : start + size]).rstrip(b"\0").decode(errors="replace")

    def _array(self, kind: str, count: int) -> np.ndarray:
        dtype = np.dtype(self._order + kind)
        start = self._take(count * dtype.itemsize, dtype.itemsize if count else 1)
        return np.frombuffer(self._body, dtype, count, start)

    def struct(self, layout: Struct) -> dict[str, Any]:
        """The fields of a message in order."""
        if not layout.fields and self._widest > 1:
            self._take(1)  # CDR knows no empty structure: it holds one byte
        fields = {}
        for field in layout.fields:
            kind, count = field.kind, field.count
            if count == 0:
                count = self._number("I")
            if isinstance(kind, Struct):
                fields[field.name] = (
                    self.struct(kind) if count is None else self._structs(kind, count)
                )
            elif kind == "string":
                fields[field.name] = (
                    self._string()
                    if count is None
                    else [self._string() for _ in self._items(count)]
                )
            else:
                fields[field.name] = (
                    self._number(kind) if count is None else self._array(kind, count)
                )
        return fields

    def _structs(self, layout: Struct, count: int) -> Any:
        kinds = {field.kind for field in layout.fields}
        if len(kinds) == 1 and all(field.count is None for field in layout.fields):
            (kind,) = kinds
            if isinstance(kind, str) and kind != "string":
                columns = len(layout.fields)
                table = self._array(kind, count * columns).reshape(count, columns)
                return {field.name: table[:, i] for i, field in enumerate(layout.fields)}
        return [self.struct(layout) for _ in self._items(count)]

    def _items(self, count: int) -> range:
        self._items_left -= count
        if self._items_left < 0:
            raise UnusableError("malformed message (too many elements)")
        return range(count)
