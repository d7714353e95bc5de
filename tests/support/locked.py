"""Folders that this user may not look into, also where that is root."""

from __future__ import annotations

import ctypes
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

_VERSION = 0x20080522  # of the calls, see capget(2)
_BYPASS = 1 << 1 | 1 << 2  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH


@contextmanager
def locked(folder: Path) -> Iterator[Path]:
    """The folder, mode 000 meanwhile; the test is skipped where that keeps nobody out."""
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(0)
    try:
        with _as_others():
            try:
                next(folder.iterdir(), None)
            except PermissionError:
                yield folder
            else:
                pytest.skip("this user may read everywhere")
    finally:
        folder.chmod(0o700)


@contextmanager
def _as_others() -> Iterator[None]:
    """This thread without root's way past permissions."""
    if sys.platform != "linux":
        yield
        return
    libc = ctypes.CDLL(None)
    head = ctypes.create_string_buffer(struct.pack("Ii", _VERSION, 0))
    sets = ctypes.create_string_buffer(24)
    libc.capget(head, sets)
    effective, *others = struct.unpack("6I", sets.raw)
    libc.capset(head, struct.pack("6I", effective & ~_BYPASS, *others))
    try:
        yield
    finally:
        libc.capset(head, sets)
