"""Logs that misbehave by their names, in processes of their own; calls over many logs."""

from __future__ import annotations

import fcntl
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from tests.support.command import SAMPLE as SAMPLE
from tests.support.command import sample_log
from tests.support.rows import read_rows

FRAMES = 6
GRACE_S = 3.0
"""So long a process that is to end has in the tests, in place of `one.GRACE_S`."""
BEHAVIOUR = '''
"""Read by every process at its start: logs of these names misbehave while they are read.

A slow one waits before its last frame until there is a file slow.go beside it; it makes slow.waits.
"""
import fcntl, os, signal, sys, time
if "sonarrec" in "".join(sys.orig_argv):
    from sonarrec.runs import one
    from sonarrec.readers import log

    one.GRACE_S = {grace}
    within = log.Log.within

    def misbehave(self, span):
        if self.name == "hangs":
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if self.name in ("hangs", "slow"):
            held = self.path.with_suffix(".held").open("w")
            fcntl.flock(held, fcntl.LOCK_EX)  # as long as the process lives
        for frame in within(self, span):
            yield frame
            last = self.name == "slow" and frame.index + 2 >= len([*self.path.glob("*.png")])
            if last:
                self.path.with_suffix(".waits").touch()
            while (self.name == "hangs" or last) and not self.path.with_suffix(".go").exists():
                time.sleep(0.05)
            if self.name == "dies":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.name == "raises":
                raise ZeroDivisionError("a fault of ours")

    log.Log.within = misbehave
'''


def made(folder: Path, *names: str, frames: int = FRAMES) -> list[Path]:
    """Logs of a few frames of the sample."""
    return [sample_log(folder / name, frames) for name in names]


def environment(folder: Path) -> dict[str, str]:
    """In which logs misbehave by their names."""
    home = folder / "behaviour"
    home.mkdir(exist_ok=True)
    (home / "sitecustomize.py").write_text(BEHAVIOUR.replace("{grace}", str(GRACE_S)))
    path = [str(home), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(path)}


def until(true: Callable[[], bool], running: subprocess.Popen[bytes] | None = None) -> None:
    """Wait for what must come true, while a process runs if one is given; else that is killed."""
    limit = time.monotonic() + 300
    while not true():
        ended, late = running is not None and running.poll() is not None, time.monotonic() > limit
        if running is not None and late:
            running.kill()
        assert not late, "never came true"
        assert not ended, "ended before it came true"
        time.sleep(0.02)


def answers(port: int) -> bool:
    """Whether a server listens on this machine."""
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
        return True
    return False


def ended(log: Path) -> bool:
    """Whether the process has that read a log which hangs or is slow."""
    with log.with_suffix(".held").open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
    return True


def command(*words: str | Path) -> list[str]:
    return [sys.executable, "-m", "sonarrec", *map(str, words)]


def rows(out: Path) -> dict[str, dict[str, str]]:
    return {row["log"]: row for row in read_rows(out / "logs.csv")}


def tables(folder: Path) -> list[bytes]:
    names = ("frames.csv", "estimates.csv", "sightings.csv")
    return [(folder / name).read_bytes() for name in names]


# On Linux a new process is charged with the peak of the one it was forked from, until it runs
# its own program: so it is forked from a small one.
_LAUNCHER = """
import resource, subprocess, sys
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(code not in (0, 3))
"""


def peak_mb(words: list[str]) -> float:
    """Peak resident memory of a command, MB. Raises CalledProcessError where it fails."""
    run = [sys.executable, "-c", _LAUNCHER, *words]
    told = subprocess.run(run, check=True, capture_output=True, text=True).stdout
    return int(told) / (1024**2 if sys.platform == "darwin" else 1024)
