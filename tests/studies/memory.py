"""`make memory`: the peak memory of reading 1 GB logs in the shapes that cost readers most.

Each shape is written to a temporary folder, read once by a process of its own as `sonarrec run`
reads it, and removed. Nothing is asserted here; tests/readers/test_hard_mcap.py
does that for small ones.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.studies.results.record import add_record_option, judge, save, show
from tests.support.hard_logs import HardLog, noise_images

GOAL_MB = 400
CHUNK_MESSAGES = 7  # about 1 MB, what recorders make

# Reads every frame; prints how many, and its own peak in KiB (bytes on macOS).
_READ = """
import resource, sys
from sonarrec.readers import open_log
from sonarrec.readers.containers.mcap import chunks
if len(sys.argv) > 2:
    chunks.HELD_BYTES = int(sys.argv[2])
from sonarrec.errors import SonarrecError
frames = 0
try:
    with open_log(sys.argv[1]) as log:
        for frame in log:
            frames += 1
except SonarrecError:
    pass
print(frames, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
# On Linux a new process is charged with the peak of the one it was forked from, until it runs
# its own program: so it is forked from a small one.
_LAUNCH = "import subprocess, sys; sys.exit(subprocess.run(sys.argv[1:]).returncode)"


def peak_of_reading(path: Path, held_bytes: int | None = None) -> tuple[int, float]:
    """(frames read, peak resident memory in MB) of a process that reads a log.

    held_bytes: in place of the reader's own bound on inflated chunks in memory.
    """
    command = [sys.executable, "-c", _LAUNCH, sys.executable, "-c", _READ, str(path)]
    command += [str(held_bytes)] if held_bytes is not None else []
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    return int(told[0]), int(told[1]) / (1024**2 if sys.platform == "darwin" else 1024)


def _timed(size: int, backwards: bool = False) -> Iterator[tuple[int, bytes]]:
    """Messages of `size` bytes in all."""
    images = noise_images()
    count = size // len(images[0])
    for number in range(count):
        yield (count - number if backwards else number), images[number % len(images)]


def _chunked(path: Path, size: int, compression: str, **options: bool) -> None:
    finished = options.pop("finished", True)
    with HardLog(path, finished=finished) as log:
        messages = list(_timed(size))
        for first in range(0, len(messages), CHUNK_MESSAGES):
            log.chunk(messages[first : first + CHUNK_MESSAGES], compression, **options)


def _one_chunk(path: Path, size: int, compression: str, backwards: bool = False) -> None:
    with HardLog(path) as log:
        log.chunk(_timed(size, backwards), compression)


def _overlapping(path: Path, size: int, compression: str, chunks: int) -> None:
    """Message n is in chunk n % chunks: every chunk reaches over the whole log."""
    with HardLog(path) as log:
        messages = list(_timed(size))
        for chunk in range(chunks):
            log.chunk(messages[chunk::chunks], compression)


def _loose(path: Path, size: int, backwards: bool = False) -> None:
    with HardLog(path) as log:
        log.loose(_timed(size, backwards))


def _tiny(path: Path, size: int) -> None:
    """Messages without a single byte, 31 bytes each with their heads."""
    with HardLog(path) as log:
        log.chunk(((number, b"") for number in range(size // 31)), indexed=False)
        log.loose(_timed(10**6))


def _cut(path: Path, write: Callable[[], None]) -> None:
    write()
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size * 9 // 10)


def shapes(path: Path, size: int) -> dict[str, Callable[[], None]]:
    """Writers of logs of about `size` bytes, by what is hard about them."""
    return {
        "chunks of 1 MB, zstd": lambda: _chunked(path, size, "zstd"),
        "chunks of 1 MB, zstd, cut": lambda: _cut(path, lambda: _chunked(path, size, "zstd")),
        "no index, no footer, lz4": lambda: _chunked(
            path, size, "lz4", indexed=False, finished=False
        ),
        "no chunks": lambda: _loose(path, size),
        "no chunks, backwards": lambda: _loose(path, size, backwards=True),
        "one chunk, uncompressed": lambda: _one_chunk(path, size, ""),
        "one chunk, lz4": lambda: _one_chunk(path, size, "lz4"),
        "one chunk, zstd": lambda: _one_chunk(path, size, "zstd"),
        "one chunk, lz4, cut": lambda: _cut(path, lambda: _one_chunk(path, size, "lz4")),
        "one chunk, zstd, cut": lambda: _cut(path, lambda: _one_chunk(path, size, "zstd")),
        "one chunk, zstd, backwards": lambda: _one_chunk(path, size, "zstd", backwards=True),
        "1000 overlapping chunks, zstd": lambda: _overlapping(path, size, "zstd", 1000),
        "10 overlapping chunks, lz4": lambda: _overlapping(path, size, "lz4", 10),
        "10 overlapping chunks, uncompressed": lambda: _overlapping(path, size, "", 10),
        "empty messages by the million": lambda: _tiny(path, size),
        "one message": lambda: _message_of(path, size),
    }


def _message_of(path: Path, size: int) -> None:
    with HardLog(path) as log:
        log.loose([(0, noise_images(count=1)[0]), (1, bytes(size))])


def main() -> None:
    """A row for every shape."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mb", type=int, default=1000, help="size of each log (default 1000)")
    add_record_option(parser)
    asked = parser.parse_args()
    size = asked.mb * 10**6
    with tempfile.TemporaryDirectory(prefix="sonarrec_memory_") as name:
        if shutil.disk_usage(name).free < 4 * size:
            sys.exit(f"{name}: too little room, {4 * size / 1e9:.0f} GB are needed")
        path = Path(name) / "log.mcap"
        lines = []
        for shape, write in shapes(path, size).items():
            write()
            start = time.perf_counter()
            frames, peak = peak_of_reading(path)
            taken = time.perf_counter() - start
            lines.append(
                {"shape": shape, "frames": frames, "MB": f"{peak:.0f}", "s": f"{taken:.1f}"}
            )
            path.unlink()
        show(f"Logs of {size / 1e6:.0f} MB", lines)
        judge("peak memory, MB", max(float(line["MB"]) for line in lines), GOAL_MB)
    save(asked.record)


if __name__ == "__main__":
    main()
