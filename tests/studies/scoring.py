"""`make scoring`: what `sonarrec evaluate` costs over many made-up logs, memory above all.

A line per number of logs and of frames each. The logs are links to a few different ones.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.support.made_up import make_logs

GOAL_MB = 300

# Scores and prints its own peak in KiB (bytes on macOS).
_SCORE = """
import resource, sys
from sonarrec.cli import main
try:
    main(["evaluate", "--quiet", *sys.argv[1:]])
except SystemExit as end:
    assert not end.code, end.code
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
# As in memory.py: a new process is charged with the peak of the one it was forked from.
_LAUNCH = "import subprocess, sys; sys.exit(subprocess.run(sys.argv[1:]).returncode)"


def peak_of_scoring(pairs: Path, jobs: int = 1) -> float:
    """Peak resident memory, MB, of a process that scores a table of pairs."""
    command = [sys.executable, "-c", _LAUNCH, sys.executable, "-c", _SCORE]
    command += ["--pairs", str(pairs), "--jobs", str(jobs)]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return int(told) / (1024**2 if sys.platform == "darwin" else 1024)


def main() -> int:
    """Measure; the exit code is 1 where a case takes more than GOAL_MB."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--frames", type=int, nargs="+", default=[1000, 10_000])
    parser.add_argument("--jobs", type=int, default=1)
    asked = parser.parse_args()
    print("| logs | frames each | jobs | peak MB | s | s per log |\n|---|---|---|---|---|---|")
    worst = 0.0
    for frames in asked.frames:
        for logs in asked.logs:
            place = Path(tempfile.mkdtemp())
            try:
                pairs = make_logs(place / "made", logs, frames)
                begun = time.monotonic()
                peak = peak_of_scoring(pairs, asked.jobs)
                took = time.monotonic() - begun
            finally:
                shutil.rmtree(place)
            worst = max(worst, peak)
            row = logs, frames, asked.jobs, f"{peak:.0f}", f"{took:.1f}", f"{took / logs:.3f}"
            print(f"| {' | '.join(map(str, row))} |", flush=True)
    return int(worst > GOAL_MB)


if __name__ == "__main__":
    sys.exit(main())
