"""The image records of a `.glf`: a ZIP, in which a `.dat` holds record after record.

The `.dat` may be of any length, so it is read in pieces. Other records (the sonar's status, a
compass) are skipped.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path

from sonarrec.errors import SonarrecError
from sonarrec.readers.containers.file_bytes import FileBytes
from sonarrec.readers.containers.gemini.pings import (
    HEAD_3,
    RECORD,
    RECORD_MARK,
    begins,
    ended,
    record_length,
    zoomed,
)
from sonarrec.readers.raw import UnusableError

_PIECE = 2**20  # bytes
_ENTRY_MARK, _ENTRY_BYTES = b"PK\x03\x04", 30  # before a file in a ZIP
_STORED, _DEFLATED = 0, 8
_ENCRYPTED = 1  # of an entry's flags
_MARK = RECORD.to_bytes(2, "little") + RECORD_MARK.to_bytes(2, "little")
_MARK_AT = 21  # bytes from the beginning of a record


def pieces(path: Path) -> Iterator[bytes]:
    """The `.dat` of a file, in pieces.

    Python's zipfile is not used, because it does not open a file whose end is missing, and returns
    nothing of contents with a wrong checksum. Raises SonarrecError if the file is no such log; if
    it is cut or damaged, raises UnusableError after all that can be read.
    """
    file = FileBytes(path)
    try:
        method, at = _find_dat(file, str(path))
        inflater = zlib.decompressobj(-zlib.MAX_WBITS)
        while piece := file.at(at, _PIECE):
            at += len(piece)
            yield inflater.decompress(piece) if method == _DEFLATED else piece
            if inflater.eof:
                return
        if method == _DEFLATED:
            raise UnusableError("its end is missing")
    except zlib.error:
        raise UnusableError("its compressed contents are damaged") from None
    finally:
        file.close()


def _find_dat(file: FileBytes, where: str) -> tuple[int, int]:
    """(ZIP method of the `.dat`, where its contents begin). where: names the file."""
    at = file.find(_ENTRY_MARK, 0, 1)
    if at is None:
        raise SonarrecError(f"{where}: not a .glf of a Gemini, which is a ZIP")
    while at is not None:
        head = file.at(at, _ENTRY_BYTES)
        flags, method, name, extra = (
            int.from_bytes(head[i : i + 2], "little") for i in (6, 8, 26, 28)
        )
        if file.at(at + _ENTRY_BYTES, name).lower().endswith(b".dat"):
            if flags & _ENCRYPTED or method not in (_STORED, _DEFLATED):
                raise SonarrecError(
                    f"{where}: packed or encrypted in a way that is not read (ZIP method {method}, "
                    f"flags {flags:#x}); unpack it, and pack it again as a plain ZIP"
                )
            return method, at + _ENTRY_BYTES + name + extra
        at = file.find(_ENTRY_MARK, at + 1, file.size)
    raise SonarrecError(f"{where}: a ZIP without a .dat, which holds a Gemini's images")


def records(data: Iterator[bytes]) -> Iterator[tuple[int, bytes | None, str]]:
    """Yield (place, bytes, problem) of each image's record; no bytes if it is damaged.

    data: the `.dat`, in pieces. place: in the `.dat`. An error of `data` is raised after the
    records before it.
    """
    window = _Window(data)
    follows = True  # whether the window begins where a record ended
    while window.fill(HEAD_3.itemsize):
        if follows and not begins(window.head):
            yield window.place, None, "no record begins there; damaged"
        follows = False
        at = window.held.find(_MARK, _MARK_AT)
        window.drop(len(window.held) - HEAD_3.itemsize + 1 if at < 0 else at - _MARK_AT)
        if at < 0 or not window.fill(HEAD_3.itemsize):
            continue
        place, length = window.place, record_length(window.head)
        if length is None:
            window.drop(1)
        elif not window.fill(length):
            yield place, None, f"only {len(window.held)} of its {length} bytes are there"
            window.drop(_MARK_AT)
        elif not ended(record := bytes(window.held[:length])):
            yield place, None, "its end mark is missing; bytes are lost or wrong"
            window.drop(_MARK_AT)
        else:
            yield place, record, ""
            window.drop(length)
            follows = not zoomed(record)
    if window.broken is not None:
        raise window.broken


class _Window:
    """A part of the data, which moves on as records are found.

    held: the bytes that are not used yet. place: where they begin in the data. broken: the error
    that ended the data; None if there was none.
    """

    def __init__(self, data: Iterator[bytes]) -> None:
        self._data = data
        self.held, self.place = bytearray(), 0
        self.broken: UnusableError | None = None

    @property
    def head(self) -> bytes:
        """The first HEAD_3.itemsize bytes that are held."""
        return bytes(self.held[: HEAD_3.itemsize])

    def fill(self, count: int) -> bool:
        """Hold at least so many bytes; False if the data end before."""
        while len(self.held) < count:
            try:
                piece = next(self._data, None)
            except UnusableError as error:
                self.broken, piece = error, None
            if piece is None:
                return False
            self.held.extend(piece)
        return True

    def drop(self, count: int) -> None:
        """Release the first `count` bytes."""
        del self.held[:count]
        self.place += count
