"""The chunks of an MCAP file: inflated in pieces under a bound, checked, of cut ones what is whole.

By hand because the `mcap` package inflates a chunk in one go, however large, and gives up one that
is cut.
"""

from __future__ import annotations

import errno
import struct
import tempfile
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO

import lz4.frame
import zstandard

from sonarrec.records import SonarrecError

# Inflated: what declares more, or inflates to more than it declares, is not read.
MAX_CHUNK_BYTES = 2**31
HELD_BYTES = 64 * 2**20  # of inflated chunks in memory together; what exceeds it goes to disk
MAX_WINDOW_BYTES = 2**27  # zstd keeps as much of what it wrote in memory
RECORD_HEAD = struct.Struct("<BQ")  # opcode, length of what follows
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, inflated size, CRC, length of compression
_PIECE = 2**20


class DamagedError(Exception):
    """A chunk that cannot be used; the text says why."""


@dataclass(frozen=True, slots=True)
class ChunkHead:
    """A chunk as its record states it, and where its data lie in the file.

    start_time, end_time: log times in ns. size: bytes when inflated. stored: bytes as they are
    stored; present: how many of those the file holds, fewer where it is cut.
    """

    position: int
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


def read_chunk_head(file: BinaryIO, position: int, file_size: int) -> ChunkHead | None:
    """The chunk whose record begins at `position`; None where the file ends inside the head.

    Raises DamagedError where it makes no sense.
    """
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
    if stored != length - _CHUNK_HEAD.size - name_length - 8:
        raise DamagedError("contradicts its own length")
    data_start = position + len(head) + name_length + 8
    present = min(stored, file_size - data_start)
    compression = name.decode(errors="replace")
    return ChunkHead(position, start, end, size, crc, compression, data_start, stored, present)


@dataclass(frozen=True, slots=True)
class Contents:
    """Records that can be read: the bytes of `file` from `start` to `end`.

    held: bytes of memory set aside for them.
    """

    file: BinaryIO
    start: int
    end: int
    held: int = 0


class ChunkStore:
    """Makes the contents of chunks readable, as many chunks at a time as are asked for.

    Uncompressed ones are read where they lie. Inflated ones are kept in memory up to HELD_BYTES,
    beyond that in one temporary file, in which their room is used again after release.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._free = HELD_BYTES
        self._spill: BinaryIO | None = None
        self._spilled: list[tuple[int, int]] = []  # (start, end) in use, rising

    def open(self, chunk: ChunkHead) -> Contents:
        """The contents of a chunk, checked; of the file's cut end, what is whole.

        Raises DamagedError where they cannot be used, SonarrecError where the temporary file finds
        no room.
        """
        if chunk.compression == "":
            if chunk.size != chunk.stored:
                raise DamagedError(f"does not hold the {chunk.size} bytes it declares")
            end = chunk.data_start + chunk.present
            if chunk.crc and not chunk.cut:
                _check(chunk, pieces_of(self._file, chunk.data_start, end))
            return Contents(self._file, chunk.data_start, end)
        if chunk.size > MAX_CHUNK_BYTES:
            raise DamagedError(f"declares {chunk.size} bytes, more than is inflated")
        contents = self._room(chunk.size)
        contents.file.seek(contents.start)
        try:
            written = _check(chunk, _inflate(self._file, chunk), contents.file)
        except DamagedError:
            self.release(contents)
            raise
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            raise SonarrecError(
                f"{tempfile.gettempdir()}: no room to inflate a chunk of {chunk.size} bytes; make "
                "room, or set TMPDIR to a folder that has some"
            ) from None
        return Contents(contents.file, contents.start, contents.start + written, contents.held)

    def release(self, contents: Contents) -> None:
        """Give back the room of contents that are no longer read."""
        self._free += contents.held
        if contents.file is self._spill:
            self._spilled = [used for used in self._spilled if used[0] != contents.start]

    def close(self) -> None:
        """Remove the temporary file, if there is one."""
        if self._spill is not None:
            self._spill.close()

    def _room(self, size: int) -> Contents:
        if size <= self._free:
            self._free -= size
            return Contents(BytesIO(), 0, size, size)
        if self._spill is None:
            self._spill = tempfile.TemporaryFile(prefix="sonarrec_")  # noqa: SIM115
        place = 0
        for used_start, used_end in self._spilled:
            if used_start - place >= size:
                break
            place = used_end
        self._spilled = sorted([*self._spilled, (place, place + max(size, 1))])
        return Contents(self._spill, place, place + size)


def pieces_of(file: BinaryIO, start: int, end: int, size: int = _PIECE) -> Iterator[bytes]:
    """The bytes of a file from `start` to `end`, a piece at a time; fewer where the file ends."""
    while start < end:
        file.seek(start)
        piece = file.read(min(size, end - start))
        if not piece:
            return
        start += len(piece)
        yield piece


def _check(chunk: ChunkHead, pieces: Iterable[bytes], out: BinaryIO | None = None) -> int:
    """Write the contents to `out`, where there is one, and return their length.

    Raises DamagedError where they are more or less than declared or fail the checksum.
    """
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


def _inflate(file: BinaryIO, chunk: ChunkHead) -> Iterator[bytes]:
    """The contents of a compressed chunk in pieces of at most some 16 MB."""
    end = chunk.data_start + chunk.present
    try:
        if chunk.compression == "zstd":
            yield from inflated_zstd(pieces_of(file, chunk.data_start, end))
        elif chunk.compression == "lz4":
            yield from inflated_lz4(file, chunk.data_start, end, chunk.cut)
        else:
            raise DamagedError(f"has the unknown compression {chunk.compression!r}")
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise DamagedError(f"does not inflate ({error})") from None


class _Source:
    """Pieces as a file, for zstandard."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces = pieces

    def read(self, _size: int) -> bytes:
        return next(self._pieces, b"")


def inflated_zstd(stored: Iterator[bytes]) -> Iterator[bytes]:
    """What zstd frames inflate to, a MiB at a time; of cut ones what is whole.

    Raises zstandard.ZstdError where they cannot be inflated.
    """
    # Of a block that is cut nothing can be had: its sequences are coded from its end backwards.
    decoder = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
    with decoder.stream_reader(_Source(stored), read_across_frames=True) as reader:  # type: ignore[arg-type]
        while piece := reader.read(_PIECE):
            yield piece


# LZ4 frames: https://github.com/lz4/lz4/blob/dev/doc/lz4_Frame_format.md. The library inflates
# whole blocks only; a cut one is decoded here as far as it goes.

_LZ4_PIECE = 2**16  # of lz4 at most 255 times as much comes out
_LZ4_REACH = 2**16  # how far back a match may reach, also into the blocks before
_LZ4_BLOCK_BYTES = {4: 2**16, 5: 2**18, 6: 2**20, 7: 2**22}


def inflated_lz4(file: BinaryIO, start: int, end: int, cut: bool) -> Iterator[bytes]:
    """What the LZ4 frames between two places of a file inflate to, in pieces of at most some 16 MB.

    cut: the last may be; then all that is there of it is given. Raises RuntimeError or DamagedError
    where they cannot be inflated.
    """
    decoder = lz4.frame.LZ4FrameDecompressor()
    history, at = b"", start
    for piece in pieces_of(file, start, end, _LZ4_PIECE):
        at += len(piece)
        while piece:
            if decoder.eof:  # another frame
                decoder, history, start = lz4.frame.LZ4FrameDecompressor(), b"", at - len(piece)
            inflated = decoder.decompress(piece)
            yield inflated
            if cut:
                history = (history + inflated)[-_LZ4_REACH:]
            piece = (decoder.eof and decoder.unused_data) or b""
    if cut and not decoder.eof:
        block, size = _lz4_last_block(file, start, end)
        yield lz4_cut_block(block, history, size)


def _lz4_last_block(file: BinaryIO, start: int, end: int) -> tuple[bytes, int]:
    """(compressed block that is cut, bytes it can inflate to) of the frame that is cut at `end`.

    No bytes where the cut lies between blocks, or in one stored as it is: the library gives that.
    """
    file.seek(start)
    head = file.read(6)
    if end - start < 7:
        return b"", 0
    flags, size = head[4], _LZ4_BLOCK_BYTES.get(head[5] >> 4 & 7, 0)
    at = start + 7 + (8 if flags & 0x08 else 0) + (4 if flags & 0x01 else 0)
    while at + 4 <= end:
        file.seek(at)
        length = struct.unpack("<I", file.read(4))[0]
        stored_as_is, length = length >> 31, length & 0x7FFFFFFF
        if at + 4 + length > end:
            return (b"" if stored_as_is else file.read(end - at - 4)), size
        at += 4 + length + (4 if flags & 0x10 else 0)
    return b"", 0


def lz4_cut_block(block: bytes, history: bytes, size: int) -> bytes:
    """What the beginning of a compressed LZ4 block says, at most `size` bytes.

    history: what the blocks before it inflated to; matches may reach into it.
    Raises DamagedError where a match reaches further back than there is anything.
    """
    out, most = bytearray(history), len(history) + size
    at = 0
    try:
        while len(out) < most:
            token = block[at]
            literals, at = _lz4_length(block, at + 1, token >> 4)
            out += block[at : at + literals]
            at += literals
            distance = block[at] | block[at + 1] << 8
            match, at = _lz4_length(block, at + 2, token & 15)
            if not 0 < distance <= len(out):
                raise DamagedError("does not inflate (a match before the beginning)")
            match = max(0, min(match + 4, most - len(out)))
            start = len(out) - distance
            pattern = out[start : start + match]  # repeats where it is shorter than the match
            out += (pattern * (match // distance + 1))[:match]
    except IndexError:  # the cut
        pass
    return bytes(out[len(history) : most])


def _lz4_length(block: bytes, at: int, nibble: int) -> tuple[int, int]:
    """(length, position after it) of a length whose first four bits are `nibble`."""
    length = nibble
    more = 255 if nibble == 15 else 0
    while more == 255:
        more = block[at]
        length += more
        at += 1
    return length, at
