"""Bytes of a file at any place, however long the file: a little of it in memory at a time."""

from __future__ import annotations

from pathlib import Path

_BLOCK = 2**20


class FileBytes:
    """A file opened for reading here and there. size: in bytes, as it was when it was opened."""

    def __init__(self, path: Path) -> None:
        """Raises OSError where the file cannot be opened."""
        self._file = path.open("rb")
        self.size = self._file.seek(0, 2)

    def at(self, offset: int, count: int) -> bytes:
        """`count` bytes from `offset` on; fewer where the file ends before."""
        if offset >= self.size:
            return b""
        self._file.seek(offset)
        return self._file.read(min(count, self.size - offset))

    def find(self, mark: bytes, start: int, end: int) -> int | None:
        """Where `mark` next begins at `start` or later and before `end`; None where nowhere."""
        while start < end:
            block = self.at(start, min(_BLOCK, end - start) + len(mark) - 1)
            place = block.find(mark)
            if place >= 0:
                return start + place
            start += _BLOCK
        return None

    def close(self) -> None:
        """Close the file."""
        self._file.close()
