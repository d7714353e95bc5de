"""MCAP logs in the shapes that cost readers most memory, and the peak memory of reading one."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.support.hard_logs import HardLog, noise_images

# Reads every frame; prints how many, and its own peak in KiB (bytes on macOS).
_READ = """
import resource, sys
from sonarrec.readers import open_log
from sonarrec.readers.containers import mcap_chunks as chunks
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


def _timed(size: int) -> Iterator[tuple[int, bytes]]:
    """Messages of `size` bytes in all."""
    images = noise_images()
    count = size // len(images[0])
    for number in range(count):
        yield number, images[number % len(images)]


def _one_chunk(path: Path, size: int, compression: str) -> None:
    with HardLog(path) as log:
        log.chunk(_timed(size), compression)


def _overlapping(path: Path, size: int, compression: str, chunks: int) -> None:
    """Message n is in chunk n % chunks: every chunk reaches over the whole log."""
    with HardLog(path) as log:
        messages = list(_timed(size))
        for chunk in range(chunks):
            log.chunk(messages[chunk::chunks], compression)


def shapes(path: Path, size: int) -> dict[str, Callable[[], None]]:
    """Writers of logs of about `size` bytes, by what is hard about them."""
    return {
        "one chunk, uncompressed": lambda: _one_chunk(path, size, ""),
        "10 overlapping chunks, lz4": lambda: _overlapping(path, size, "lz4", 10),
    }
