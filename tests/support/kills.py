"""Runs stopped at random moments, and what must hold of the results after each."""

from __future__ import annotations

import csv
import signal
import subprocess
import time
import tomllib
from contextlib import suppress
from pathlib import Path

import numpy as np

from sonarrec.results.folders import part_of, restore
from sonarrec.results.sightings import read_sightings, sightings_in
from sonarrec.results.write import AT_ONCE
from tests.support.batch import command, tables

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


def frames(folder: Path) -> list[int]:
    """The frames of both tables, whole ones only; fails where a row is torn."""
    found = {}
    for name in ("frames.csv", "estimates.csv"):
        text = (folder / name).read_text()
        assert text.endswith("\n"), f"{name} is torn"
        rows = list(csv.reader(text.splitlines()))
        assert {len(r) for r in rows} == {len(rows[0])}, f"{name} has rows of unequal length"
        found[name] = [int(r[0]) for r in rows[1:]]
    listed = len(found["frames.csv"])  # estimates are written first, so many frames at once
    assert set(found["estimates.csv"]) <= {*found["frames.csv"], *range(listed, listed + AT_ONCE)}
    return found["frames.csv"]


def finished(folder: Path) -> bool:
    return bool(tomllib.loads((folder / "run.toml").read_text())["finished"])


def assert_readable(part: Path) -> None:
    """All three tables of a part: whole rows, of the first frames of the log."""
    listed = frames(part)
    assert listed == list(range(len(listed)))
    assert (part / "sightings.csv").read_text().endswith("\n")
    passes = list(read_sightings(part)) if listed else []
    assert all(s.last_frame < len(listed) for s in passes)
    assert all(s.last_frame <= len(listed) for s in sightings_in(part / "sightings.csv"))


def stop_at_random(log: Path, out: Path, moments: int) -> tuple[int, int]:
    """Stop runs of a log by three signals, half of them at any moment from the program's start to
    its end, half while it writes.

    After each the results are one of the two that the settings give, whole, and the part is
    readable to its last whole frame. Returns how often a part was left, and a run was done.
    """
    folder = out / log.name
    words = [
        command("run", "-q", log, "-o", out, "--overwrite", "--set", f"seed={n}") for n in (0, 1)
    ]
    whole = []
    for one in words:
        begun = time.monotonic()
        subprocess.run(one, check=True)
        seconds = time.monotonic() - begun
        whole.append(tables(folder))
    assert whole[0] != whole[1]
    rng = np.random.default_rng(0)
    parts = done = 0
    for i, (share, number) in enumerate(
        zip(rng.uniform(0, 1, moments), rng.choice(SIGNALS, moments), strict=True)
    ):
        before, started = whole.index(tables(folder)), time.time_ns()
        process = subprocess.Popen(words[1 - before], stderr=subprocess.DEVNULL)
        while i % 2 and process.poll() is None and not _writes(part_of(folder), started):
            time.sleep(0.002)
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=share * seconds * (0.3 if i % 2 else 1.1))
        process.send_signal(number)
        process.wait()
        restore(folder)  # as the next run does
        assert finished(folder)
        done += whole.index(tables(folder)) != before  # raises where it is neither
        if (part_of(folder) / "sightings.csv").is_file():
            parts += 1
            assert_readable(part_of(folder))
    return parts, done


def _writes(part: Path, since_ns: int) -> bool:
    """Whether a run has begun its tables since then; a tick of the disk's clock earlier counts."""
    try:
        return (part / "sightings.csv").stat().st_mtime_ns > since_ns - 10**7
    except OSError:
        return False
