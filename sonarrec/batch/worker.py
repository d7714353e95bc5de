"""The process that runs logs: Tasks on stdin; on stdout how far each is, and its Outcome.

All are pickled, for both ends are the same program. See processes.py for the other end.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
from threading import Thread
from time import monotonic, sleep
from typing import IO

from sonarrec.batch.task import GRACE_S, Outcome, Task, do
from sonarrec.records import FrameResult, SonarrecError

TELL_EVERY_S = 0.2


def main() -> None:
    """Run tasks as they come. SIGTERM keeps the frames so far; so does the death of who asked."""
    told = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints must not get between
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C; who asked sends SIGTERM
    signal.signal(signal.SIGTERM, _stop)
    Thread(target=_watch_parent, args=(os.getppid(),), daemon=True).start()
    try:
        while (task := _next()) is not None:
            pickle.dump(_done(task, told), told)
            told.flush()
    except KeyboardInterrupt:
        os._exit(128 + signal.SIGTERM)
    except BrokenPipeError:
        os._exit(1)


def _next() -> Task | None:
    try:
        task: Task = pickle.load(sys.stdin.buffer)
    except EOFError:
        return None
    return task


def _done(task: Task, told: IO[bytes]) -> Outcome:
    """Run a task, and tell from time to time how far it is."""
    frames, last = 0, 0.0

    def observe(_: FrameResult, total: int | None) -> None:
        nonlocal frames, last
        frames += 1
        if monotonic() > last + TELL_EVERY_S:
            last = monotonic()
            pickle.dump((frames, total), told)
            told.flush()

    try:
        return do(task, observe)
    except MemoryError:
        return Outcome("failed", error=SonarrecError(f"{task.path}: not enough memory"))


def _watch_parent(parent: int) -> None:
    """End where who asked was killed: another may be asked for the same log."""
    while os.getppid() == parent:
        sleep(TELL_EVERY_S)
    os.kill(os.getpid(), signal.SIGTERM)
    sleep(GRACE_S)
    os.kill(os.getpid(), signal.SIGKILL)


def _stop(*_: object) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough: let the part be written
    raise KeyboardInterrupt
