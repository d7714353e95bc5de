"""Reads the chunks of an MCAP file: inflates them in pieces, checks them, and salvages cut ones.

The `mcap` package is not used for this: it inflates a chunk in one go, however large, and gives up
on a chunk that is cut.
"""

from __future__ import annotations

import struct
import tempfile
import zlib
from collections.abc import Iterable, Iterator
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


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """The head of a chunk record, and where the chunk's data are in the file.

    position, end: bytes at which the record begins and ends. start_time, end_time: log times, ns.
    size: bytes after inflation. stored: bytes in the file, as declared. present: how many of those
    the file really has; fewer if it is cut.
    """

    position: int
    end: int
    start_time: int
    end_time: int
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


def read_chunk_head(file: IO[bytes], position: int, file_size: int) -> ChunkHead | None:
    """Read the head of the chunk record at `position`; None if the file ends inside the head.
    Raises DamagedError if the head contradicts itself."""
    file.seek(position)
    head = file.read(RECORD_HEAD.size + _CHUNK_HEAD.size)
    if len(head) < RECORD_HEAD.size + _CHUNK_HEAD.size:
        return None
    length = RECORD_HEAD.unpack_from(head)[1]
    start, end, size, crc, name_length = _CHUNK_HEAD.unpack_from(head, RECORD_HEAD.size)
    if name_length > 32:
        raise DamagedError("has no readable head")
    name, field = file.read(name_length), file.read(8)
    if len(field) < 8:
        return None
    stored = struct.unpack("<Q", field)[0]
    if stored > length - _CHUNK_HEAD.size - name_length - 8:  # a later version may append fields
        raise DamagedError("contradicts its own length")
    data_start = position + len(head) + name_length + 8
    present = min(stored, file_size - data_start)
    compression = name.decode(errors="replace")
    record_end = position + RECORD_HEAD.size + length
    return ChunkHead(
        position, record_end, start, end, size, crc, compression, data_start, stored, present
    )


@dataclass(frozen=True, slots=True)
class Contents:
    """A stretch of a file that holds records: the bytes of `file` from `start` to `end`.

    inflated: whether the file is one of its own, which holds what was compressed.
    """

    file: IO[bytes]
    start: int
    end: int
    inflated: bool = False

    def release(self) -> None:
        """Free the memory or disk space of what was inflated."""
        if self.inflated:
            self.file.close()


def open_chunk(file: IO[bytes], chunk: ChunkHead) -> Contents:
    """Inflate and check a chunk. If the file is cut inside it, return the part that is there.
    Raises DamagedError if the chunk cannot be used, OSError if the disk has no room for it."""
    if chunk.compression == "":
        if chunk.size != chunk.stored:
            raise DamagedError(f"does not hold the {chunk.size} bytes it declares")
        end = chunk.data_start + chunk.present
        if chunk.crc and not chunk.cut:
            _check(chunk, pieces_of(file, chunk.data_start, end))
        return Contents(file, chunk.data_start, end)
    if chunk.size > MAX_CHUNK_BYTES:
        raise DamagedError(f"declares {chunk.size} bytes, more than is inflated")
    out = tempfile.SpooledTemporaryFile(HELD_BYTES, prefix="sonarrec_")  # noqa: SIM115
    try:
        return Contents(out, 0, _check(chunk, _inflate(file, chunk), out), inflated=True)
    except DamagedError:
        out.close()
        raise


def pieces_of(file: IO[bytes], start: int, end: int) -> Iterator[bytes]:
    """Read the bytes from `start` to `end` in pieces; stop early if the file ends."""
    while start < end:
        file.seek(start)
        piece = file.read(min(_PIECE, end - start))
        if not piece:
            return
        start += len(piece)
        yield piece


def _check(chunk: ChunkHead, pieces: Iterable[bytes], out: IO[bytes] | None = None) -> int:
    """Check the inflated pieces of a chunk, write them to `out` if given, and return their length.
    Raises DamagedError if the length is not the declared one, or if the checksum is wrong. A cut
    chunk may be shorter, and its checksum is not compared."""
    written = crc = 0
    for piece in pieces:
        written += len(piece)
        if written > chunk.size:
            raise DamagedError(f"inflates to more than the {chunk.size} bytes it declares")
        crc = zlib.crc32(piece, crc)
        if out is not None:
            out.write(piece)
    if chunk.cut:
        return written
    if written < chunk.size:
        raise DamagedError(f"inflates to less than the {chunk.size} bytes it declares")
    if chunk.crc and crc != chunk.crc:
        raise DamagedError("fails its checksum")
    return written


def _inflate(file: IO[bytes], chunk: ChunkHead) -> Iterator[bytes]:
    """Inflate a compressed chunk, in pieces of at most about 16 MB. Raises DamagedError."""
    stored = pieces_of(file, chunk.data_start, chunk.data_start + chunk.present)
    try:
        if chunk.compression == "zstd":
            yield from inflated_zstd(stored)
        elif chunk.compression == "lz4":
            yield from inflated_lz4(stored)
        else:
            raise DamagedError(f"has the unknown compression {chunk.compression!r}")
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise DamagedError(f"does not inflate ({error})") from None


class _Source:
    """A file-like object that gives pieces one after the other, for zstandard."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces = pieces

    def read(self, _size: int) -> bytes:
        return next(self._pieces, b"")


def inflated_zstd(stored: Iterator[bytes]) -> Iterator[bytes]:
    """Inflate zstd frames, piece by piece; of a cut frame only whole blocks. Raises
    zstandard.ZstdError if they cannot be inflated."""
    decoder = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
    with decoder.stream_reader(_Source(stored), read_across_frames=True) as reader:  # type: ignore[arg-type]
        while piece := reader.read(_PIECE):
            yield piece


def inflated_lz4(stored: Iterator[bytes]) -> Iterator[bytes]:
    """Inflate LZ4 frames, in pieces of at most about 16 MB; of a cut frame only whole blocks.
    Raises RuntimeError if they cannot be inflated."""
    decoder = lz4.frame.LZ4FrameDecompressor()
    for piece in stored:
        while piece:
            if decoder.eof:  # another frame
                decoder = lz4.frame.LZ4FrameDecompressor()
            yield decoder.decompress(piece)
            piece = (decoder.eof and decoder.unused_data) or b""
