"""Records and chunks of an MCAP file: inflates chunks in pieces, checks them, salvages cut ones.

The `mcap` package is not used for this: it reads and inflates a chunk in one go, however large, and
gives up on a chunk that is cut.
"""

from __future__ import annotations

import struct
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO

import lz4.frame
import zstandard

MAX_CHUNK_BYTES = 2**31
"""Largest inflated size. A chunk that declares more, or inflates to more than it declares, is not
read."""
HELD_BYTES = 8 * 2**20
"""Inflated chunks up to this size are kept in memory, larger ones in a temporary file each."""
MAX_WINDOW_BYTES = 2**27  # of zstd: how much of its output it keeps in memory
RECORD_HEAD = struct.Struct("<BQ")  # opcode, length of what follows
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, inflated size, CRC, length of compression
_PIECE = 2**16  # bytes; lz4 inflates them to at most 255 times as many


class DamagedError(Exception):
    """A chunk that cannot be used; the text says why."""


def records_in(file: IO[bytes], at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start of the body, its length) of every whole record from `at` to `end`."""
    while at + RECORD_HEAD.size <= end:
        file.seek(at)
        head = file.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:  # the file has become shorter
            return
        opcode, length = RECORD_HEAD.unpack(head)
        body = at + RECORD_HEAD.size
        if opcode == 0 or body + length > end:
            return
        yield opcode, body, length
        at = body + length


@dataclass(frozen=True, slots=True)
class Chunk:
    """The head of a chunk record, and where its data are in the file. position, end: bytes at which
    the record begins and ends. start_time: first log time, ns. size: bytes after inflation. stored:
    bytes in the file, as declared, from data_start on. present: how many of those the file really
    has; fewer if it is cut."""

    position: int
    end: int
    start_time: int
    size: int
    crc: int
    compression: str
    data_start: int
    stored: int
    present: int

    @property
    def cut(self) -> bool:
        """Whether the file ends inside this chunk."""
        return self.present < self.stored


def read_chunk_head(file: IO[bytes], position: int, file_size: int) -> Chunk | None:
    """Read the head of the chunk record at `position`; None if the file ends inside the head.
    Raises DamagedError if the head contradicts itself."""
    file.seek(position)
    head = file.read(RECORD_HEAD.size + _CHUNK_HEAD.size)
    if len(head) < RECORD_HEAD.size + _CHUNK_HEAD.size:
        return None
    length = RECORD_HEAD.unpack_from(head)[1]
    start, _, size, crc, name_length = _CHUNK_HEAD.unpack_from(head, RECORD_HEAD.size)
    if name_length > 32:
        raise DamagedError("has no readable head")
    name, field = file.read(name_length), file.read(8)
    if len(field) < 8:
        return None
    stored = int.from_bytes(field, "little")
    if stored > length - _CHUNK_HEAD.size - name_length - 8:  # a later version may append fields
        raise DamagedError("contradicts its own length")
    data_start, end = position + len(head) + name_length + 8, position + RECORD_HEAD.size + length
    present = min(stored, file_size - data_start)
    compression = name.decode(errors="replace")
    return Chunk(position, end, start, size, crc, compression, data_start, stored, present)


@dataclass(frozen=True, slots=True)
class Contents:
    """A stretch of a file that holds records: the bytes of `file` from `start` to `end`. inflated:
    whether the file is one of its own, which holds what was compressed."""

    file: IO[bytes]
    start: int
    end: int
    inflated: bool = False

    def release(self) -> None:
        """Free the memory or disk space of what was inflated."""
        if self.inflated:
            self.file.close()


def open_chunk(file: IO[bytes], chunk: Chunk) -> Contents:
    """Inflate and check a chunk. If the file is cut inside it, return the part that is there.
    Raises DamagedError if the chunk cannot be used, OSError if the disk has no room for it."""
    if chunk.compression == "":
        if chunk.size != chunk.stored:
            raise DamagedError(f"does not hold the {chunk.size} bytes it declares")
        if chunk.crc and not chunk.cut:
            _check(file, chunk, None)
        return Contents(file, chunk.data_start, chunk.data_start + chunk.present)
    if chunk.size > MAX_CHUNK_BYTES:
        raise DamagedError(f"declares {chunk.size} bytes, more than is inflated")
    out = tempfile.SpooledTemporaryFile(HELD_BYTES, prefix="sonarrec_")  # noqa: SIM115
    try:
        return Contents(out, 0, _check(file, chunk, out), inflated=True)
    except DamagedError:
        out.close()
        raise


def _check(file: IO[bytes], chunk: Chunk, out: IO[bytes] | None) -> int:
    """Inflate a chunk, write it to `out` if given, and return its length. Raises DamagedError if
    that is not the declared one, or if the checksum is wrong. A cut chunk may be shorter, and its
    checksum is not compared."""
    written = crc = 0
    try:
        for piece in _inflated(file, chunk):
            written += len(piece)
            if written > chunk.size:
                raise DamagedError(f"inflates to more than the {chunk.size} bytes it declares")
            crc = zlib.crc32(piece, crc)
            if out is not None:
                out.write(piece)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise DamagedError(f"does not inflate ({error})") from None
    if not chunk.cut and written < chunk.size:
        raise DamagedError(f"inflates to less than the {chunk.size} bytes it declares")
    if not chunk.cut and chunk.crc and crc != chunk.crc:
        raise DamagedError("fails its checksum")
    return written


class _Stored:
    """What a chunk holds as it is stored, in pieces, as a file-like object for zstandard."""

    def __init__(self, file: IO[bytes], chunk: Chunk) -> None:
        self._file, self._at, self._end = file, chunk.data_start, chunk.data_start + chunk.present

    def read(self, _size: int = _PIECE) -> bytes:
        """The next piece; b"" at the end, also if the file has become shorter."""
        self._file.seek(self._at)
        piece = self._file.read(min(_PIECE, self._end - self._at))
        self._at += len(piece)
        return piece


def _inflated(file: IO[bytes], chunk: Chunk) -> Iterator[bytes]:
    """Inflate a chunk, in pieces of at most about 16 MB; of a cut frame only whole blocks. Raises
    zstandard.ZstdError, RuntimeError of lz4."""
    stored = _Stored(file, chunk)
    if chunk.compression == "":
        yield from iter(stored.read, b"")
    elif chunk.compression == "zstd":
        decoder = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
        with decoder.stream_reader(stored, read_across_frames=True) as reader:  # type: ignore[arg-type]
            yield from iter(lambda: reader.read(_PIECE), b"")
    elif chunk.compression == "lz4":
        lz4_decoder = lz4.frame.LZ4FrameDecompressor()
        for piece in iter(stored.read, b""):
            while piece:
                if lz4_decoder.eof:  # another frame
                    lz4_decoder = lz4.frame.LZ4FrameDecompressor()
                yield lz4_decoder.decompress(piece)
                piece = (lz4_decoder.eof and lz4_decoder.unused_data) or b""
    else:
        raise DamagedError(f"has the unknown compression {chunk.compression!r}")
