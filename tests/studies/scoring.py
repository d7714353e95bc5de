"""`make scoring`: what `sonarrec evaluate` costs over many made-up logs, memory above all.

A line per number of logs and of frames each, of scoring them and of comparing two results of them.
The logs are links to a few different ones.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.support.made_up import make_logs, make_sides

GOAL_MB = 300

# Runs a command and prints its own peak in KiB (bytes on macOS).
_RUN = """
import resource, sys
from sonarrec.cli import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    assert end.code in (0, None, 3), end.code
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
# A new process is charged with the peak of the one it was forked from.
_LAUNCH = "import subprocess, sys; sys.exit(subprocess.run(sys.argv[1:]).returncode)"


def peak_of_scoring(pairs: Path, jobs: int = 1) -> float:
    """Peak resident memory, MB, of a process that scores a table of pairs."""
    return peak_of("evaluate", "--quiet", "--pairs", pairs, "--jobs", jobs)


def peak_of_comparing(old: Path, new: Path, pairs: Path, jobs: int = 1) -> float:
    """Peak resident memory, MB, of a process that compares two results."""
    return peak_of("evaluate", "--quiet", "--pairs", pairs, "--jobs", jobs, "--compare", old, new)


def peak_of(*words: object) -> float:
    """Peak resident memory, MB, of a process that runs a command, which must not fail."""
    command = [sys.executable, "-c", _LAUNCH, sys.executable, "-c", _RUN, *map(str, words)]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return int(told.split()[-1]) / (1024**2 if sys.platform == "darwin" else 1024)


@contextmanager
def _place() -> Iterator[Path]:
    place = Path(tempfile.mkdtemp())
    try:
        yield place / "made"
    finally:
        shutil.rmtree(place)


def timed(measure: Callable[[], float]) -> tuple[float, float]:
    """(what is measured, seconds)"""
    begun = time.monotonic()
    return measure(), time.monotonic() - begun


def main() -> int:
    """Measure; the exit code is 1 where a case takes more than GOAL_MB."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, nargs="*", default=[10, 100, 1000])
    parser.add_argument("--frames", type=int, nargs="+", default=[1000, 10_000])
    parser.add_argument("--jobs", type=int, default=1)
    asked = parser.parse_args()
    columns = "| what | logs | frames each | jobs | peak MB | s | s per log |"
    print(f"{columns}\n|---|---|---|---|---|---|---|")
    worst = 0.0
    for what in ("score", "compare"):
        for frames in asked.frames:
            for logs in asked.logs:
                with _place() as place:
                    if what == "score":
                        pairs = make_logs(place, logs, frames)
                        peak, took = timed(lambda p=pairs: peak_of_scoring(p, asked.jobs))  # type: ignore[misc]
                    else:
                        sides = make_sides(place, logs, frames)
                        peak, took = timed(lambda s=sides: peak_of_comparing(*s, asked.jobs))  # type: ignore[misc]
                worst = max(worst, peak)
                row = what, logs, frames, asked.jobs, f"{peak:.0f}", f"{took:.1f}"
                print(f"| {' | '.join(map(str, row))} | {took / logs:.3f} |", flush=True)
    return int(worst > GOAL_MB)


if __name__ == "__main__":
    sys.exit(main())
