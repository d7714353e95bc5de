"""`make fuzz`: damaged logs through `sonarrec info` and `sonarrec run`.

Whatever the damage, a command ends with one of its exit codes: no traceback, no hang, no memory
beyond the goal. File n is the same in every run; `--only n --keep DIR` writes it out and runs it.
"""

from __future__ import annotations

import argparse
import random
import re
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from sonarrec.cli import main as sonarrec
from sonarrec.simulation.mcap_writer import SCHEMAS, McapImageWriter
from sonarrec.sonar import Sonar
from tests.support.logs import SONAR_TOML
from tests.support.messages import WRITERS
from tests.support.one_core import one_core

LIMIT_S = 10
LIMIT_MB = 400
FRAMES, ROWS, COLUMNS = 12, 48, 40
BATCH = 25  # files per process: what one leaves behind does not reach far
EXTREMES = (
    0,
    1,
    2,
    0x7F,
    0x80,
    0xFF,
    2**15,
    2**16 - 1,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**62,
    2**64 - 1,
)
POLAR = Sonar(
    layout="polar",
    range_min_m=1.25,
    range_max_m=3.75,
    bearings_deg=tuple(np.linspace(-14, 14, COLUMNS).tolist()),
    tilt_deg=20.0,
).complete("test")
FLATBUFFERS = [name for name in WRITERS if "flatbuffer" in name]
COMPRESSIONS = (CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD)


@dataclass(frozen=True, slots=True)
class Recorded:
    """Messages of one kind as they are recorded, and what the file says of them."""

    schema: str
    schema_encoding: str
    schema_data: bytes
    message_encoding: str
    messages: list[bytes]


def recorded(kind: str, folder: Path) -> Recorded:
    """A few pings of one schema, or of one of the WRITERS, with some structure in them."""
    rng = np.random.default_rng(1)
    ramp = np.add.outer(np.arange(ROWS), np.arange(COLUMNS))
    noise = rng.integers(0, 30, (FRAMES, ROWS, COLUMNS))
    pings = [((ramp * (n + 1) + noise[n]) % 256).astype(np.uint8) for n in range(FRAMES)]
    path = folder / "whole.mcap"
    if kind in WRITERS:
        WRITERS[kind](path, pings, "none")
    else:
        with McapImageWriter(path, schema=kind, sonar=POLAR) as writer:
            for n, ping in enumerate(pings):
                writer.write(n * 250_000_000, ping)
    with path.open("rb") as file:
        found = list(make_reader(file).iter_messages())
    record, channel, _ = found[0]
    assert record is not None
    return Recorded(
        record.name,
        record.encoding,
        record.data,
        channel.message_encoding,
        [message.data for _, _, message in found],
    )


# Damage. Each takes and returns the bytes of a file, a message or a definition.


def flip_bits(data: bytearray, rng: random.Random) -> bytearray:
    for _ in range(rng.choice((1, 1, 2, 8, 40))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return data


def cut(data: bytearray, rng: random.Random) -> bytearray:
    return data[: rng.randrange(len(data))]


def swap(data: bytearray, rng: random.Random) -> bytearray:
    """Two stretches change places."""
    a, b, c, d = sorted(rng.randrange(len(data) + 1) for _ in range(4))
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def overwrite(data: bytearray, rng: random.Random) -> bytearray:
    """A number anywhere becomes an extreme one; near the beginning more often."""
    size = rng.choice((1, 2, 4, 8))
    place = rng.randrange(rng.choice((len(data), min(len(data), 120))))
    number = rng.choice(EXTREMES) & (256**size - 1)
    data[place : place + size] = number.to_bytes(size, rng.choice(("little", "big")))
    return data


def insert(data: bytearray, rng: random.Random) -> bytearray:
    """Zeros, noise, or a piece of itself."""
    place, size = rng.randrange(len(data)), rng.choice((1, 7, 100, 5000))
    start = rng.randrange(len(data))
    piece = rng.choice((bytes(size), rng.randbytes(size), bytes(data[start : start + size])))
    return data[:place] + piece + data[place:]


def lie(data: bytearray, rng: random.Random) -> bytearray:
    """The length of a record, or a size in a chunk's head, becomes another."""
    places, at = [], 8
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        places += [at + 1] + ([at + 9, at + 17, at + 25, at + 33, at + 45] if opcode == 6 else [])
        at += 9 + length
    place = rng.choice([p for p in places if p + 8 <= len(data)] or [1])
    old = struct.unpack_from("<Q", data, place)[0] if place + 8 <= len(data) else 0
    value = rng.choice((*EXTREMES, old + 1, old - 1, old * 2, old // 2, old + 2**56))
    data[place : place + 8] = struct.pack("<Q", value % 2**64)
    return data


ANYWHERE: tuple[Callable[[bytearray, random.Random], bytearray], ...] = (
    flip_bits, cut, swap, overwrite, insert,
)  # fmt: skip


def damaged(data: bytes, rng: random.Random, *more: Callable[..., bytearray]) -> bytes:
    """The bytes after one to four kinds of damage."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        if out:
            out = rng.choice((*ANYWHERE, *more))(out, rng)
    return bytes(out)


def write_damaged(kinds: list[Recorded], number: int, path: Path) -> None:
    """File `number`: one kind of message, its definition and messages damaged or the file."""
    rng = random.Random(number)
    kind = rng.choice(kinds)
    where = rng.choice(("file", "file", "messages", "definition", "all"))
    definition = kind.schema_data
    if where in ("definition", "all") and definition:
        definition = damaged(definition, rng)
    with path.open("wb") as file:
        writer = Writer(
            file,
            chunk_size=rng.choice((2000, 10_000, 10**6)),
            compression=rng.choice(COMPRESSIONS),
            use_chunking=rng.random() < 0.8,
            index_types=rng.choice((IndexType.ALL, IndexType.ALL, IndexType.NONE)),
            use_statistics=rng.random() < 0.8,
            enable_crcs=rng.random() < 0.5,
            enable_data_crcs=rng.random() < 0.3,
        )
        writer.start()
        schema = writer.register_schema(kind.schema, kind.schema_encoding, definition)
        channel = writer.register_channel("/sonar", kind.message_encoding, schema)
        for n, data in enumerate(kind.messages):
            if where in ("messages", "all") and rng.random() < 0.5:
                data = damaged(data, rng)
            writer.add_message(channel, n * 250_000_000, data, publish_time=n)
        writer.finish()
    if where in ("file", "all"):
        path.write_bytes(damaged(path.read_bytes(), rng, lie, lie, lie))
    # Where messages tell their own window, nothing stated may hide what they tell.
    own = kind.schema.endswith(("SonarImage", "Ping"))
    (path.parent / "sonar.toml").write_text("[sonar]\ntilt_deg = 20.0\n" if own else SONAR_TOML)


# Running


def peak_mb() -> float:
    """Most memory this process has held. (ru_maxrss begins with what its parent had held.)"""
    status = Path("/proc/self/status").read_text()
    return int(re.search(r"VmHWM:\s*(\d+) kB", status)[1]) / 1024


def run_batch(numbers: range, keep: Path | None) -> None:
    """Make and run the files; a line for each: number, exit codes, seconds, peak MB, failure.

    On one core, so that a hang and the memory are those of this process, in all stages.
    """
    with one_core(), tempfile.TemporaryDirectory(prefix="sonarrec_fuzz_") as name:
        folder = Path(name)
        kinds = [recorded(kind, folder) for kind in (*SCHEMAS, *FLATBUFFERS)]
        path = (keep or folder) / "damaged.mcap"
        for number in numbers:
            print(number, end=" ", flush=True)  # told even where the process dies of this file
            write_damaged(kinds, number, path)
            codes, failure = [], ""
            # Of processor time, however busy the machine; unhandled, so that they also end a hang
            # in a library. What waits for nothing takes none: five minutes of the clock.
            signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
            signal.alarm(300)
            start = time.perf_counter()
            for command in (["info", "-q"], ["run", "-q", "--out", str(folder / "out")]):
                result = CliRunner().invoke(sonarrec, [*command, str(path)])
                codes.append(result.exit_code)
                if not isinstance(result.exception, SystemExit | None):
                    failure = " ".join(traceback.format_exception(result.exception)[-2:])
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.alarm(0)
            peak = peak_mb()
            seconds = time.perf_counter() - start
            print(*codes, f"{seconds:.2f} {peak:.0f}", " ".join(failure.split()), flush=True)


def run_all(count: int, first: int = 0) -> tuple[list[str], str]:
    """(what failed, a summary) of files `first` to `first + count`."""
    failures: list[str] = []
    codes: Counter[str] = Counter()
    slowest = most = 0.0
    number, end = first, first + count
    while number < end:
        batch = min(BATCH, end - number)
        command = [sys.executable, "-m", "tests.studies.fuzz"]
        command += ["--first", str(number), "--batch", str(batch)]
        done = subprocess.run(command, capture_output=True, text=True)
        number += batch
        for line in done.stdout.splitlines():
            told, *rest = line.split(maxsplit=5)
            if len(rest) < 4:
                failures.append(f"file {told}: the process ended with {done.returncode}")
                number = int(told) + 1
                continue
            codes[f"info {rest[0]}, run {rest[1]}"] += 1
            slowest, most = max(slowest, float(rest[2])), max(most, float(rest[3]))
            if len(rest) > 4:
                failures.append(f"file {told}: {rest[4]}")
            if float(rest[3]) > LIMIT_MB:
                failures.append(f"file {told}, or one shortly before: {rest[3]} MB")
        if done.returncode and not done.stdout:
            raise RuntimeError(done.stderr)
    table = ", ".join(f"{name}: {times}" for name, times in codes.most_common())
    return failures, f"exit codes {table}; slowest {slowest:.1f} s, peak {most:.0f} MB"


def main() -> None:
    """A line for each failure, then a summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=2000, help="how many (default 2000)")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--batch", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--only", type=int, help="make and run one file in this process")
    parser.add_argument("--keep", type=Path, help="with --only: the folder to leave it in")
    options = parser.parse_args()
    if options.only is not None:
        run_batch(range(options.only, options.only + 1), options.keep)
    elif options.batch is not None:
        run_batch(range(options.first, options.first + options.batch), None)
    else:
        failures, summary = run_all(options.files, options.first)
        print("\n".join([*failures, f"{options.files} files, {len(failures)} failures: {summary}"]))
        sys.exit(bool(failures))


if __name__ == "__main__":
    main()
