"""Recordings that were compressed as a whole: unpacked into a temporary file, a piece at a time.

Their readers need random access, which a compressed stream does not allow.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sonarrec.errors import SonarrecError


def _zstd(stored: Iterator[bytes]) -> Iterator[bytes]:
    from sonarrec.readers.containers.mcap.chunks import inflated_zstd

    return inflated_zstd(stored)


def _lz4(stored: Iterator[bytes]) -> Iterator[bytes]:
    from sonarrec.readers.containers.mcap.chunks import inflated_lz4

    return inflated_lz4(stored)


Unpack = Callable[[Iterator[bytes]], Iterator[bytes]]
PACKINGS: dict[str, Unpack] = {".zst": _zstd, ".zstd": _zstd, ".lz4": _lz4}
"""By the ending of a name: takes a file in pieces, yields its contents in pieces."""


@contextmanager
def unpacked(path: Path) -> Iterator[tuple[Path, str | None]]:
    """(the file to read, what is wrong with the compressed file or None).

    If it is cut or damaged, what could be unpacked before is used. The temporary file is unlinked
    at the end, when the reader has opened it, so it never outlives the reader.
    Raises SonarrecError if nothing can be unpacked, OSError if there is no room.
    """
    unpack = PACKINGS.get(path.suffix.lower())
    if unpack is None:
        yield path, None
        return
    import zstandard

    from sonarrec.readers.containers.mcap.chunks import pieces_of

    problem, written = None, 0
    handle, name = tempfile.mkstemp(prefix="sonarrec_", suffix=Path(path.stem).suffix)
    try:
        with os.fdopen(handle, "wb") as out, path.open("rb") as file:
            try:
                for piece in unpack(pieces_of(file, 0, path.stat().st_size)):
                    written += out.write(piece)
            except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
                if not written:
                    raise SonarrecError(f"{path}: cannot be unpacked ({error})") from None
                problem = (
                    f"damaged after {written} unpacked bytes ({error}); what came before is read"
                )
        yield Path(name), problem
    finally:
        with suppress(OSError):  # some systems do not unlink open files: then it stays
            Path(name).unlink()
