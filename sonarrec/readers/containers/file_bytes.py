"""Reads bytes at any position of a file of any length, with little of it in memory at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_BLOCK = 2**20


class FileBytes:
    """A file opened for reading at any position. size: in bytes, when it was opened."""

    def __init__(self, path: Path) -> None:
        """Raises OSError if the file cannot be opened."""
        self._file = path.open("rb")
        self.size = self._file.seek(0, 2)

    def at(self, offset: int, count: int) -> bytes:
        """`count` bytes from `offset` on; fewer if the file ends before."""
        if offset >= self.size:
            return b""
        self._file.seek(offset)
        return self._file.read(min(count, self.size - offset))

    def find(self, mark: bytes, start: int, end: int) -> int | None:
        """Where `mark` first begins, at `start` or later and before `end`; None if nowhere."""
        while start < end:
            block = self.at(start, min(_BLOCK, end - start) + len(mark) - 1)
            position = block.find(mark)
            if position >= 0:
                return start + position
            start += _BLOCK
        return None

    @contextmanager
    def closed_on_error(self) -> Iterator[None]:
        """Close the file if the block raises, for constructors whose object nobody will close."""
        try:
            yield
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()
