"""The process that runs logs: it reads Tasks from stdin and writes progress and Outcomes to stdout.

All are pickled, since both ends are the same program. many.py is the other end.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
from threading import Thread
from time import monotonic, sleep
from typing import IO

from sonarrec.errors import SonarrecError
from sonarrec.nouns import FrameResult
from sonarrec.runs.task import GRACE_S, Outcome, Task, run_task

REPORT_EVERY_S = 0.2


def main() -> None:
    """Run tasks as they come. After SIGTERM, or if the parent dies, the frames so far are kept."""
    pipe = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not mix with the pickles
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C on the terminal; the parent sends SIGTERM
    signal.signal(signal.SIGTERM, _stop)
    Thread(target=_watch_parent, args=(os.getppid(),), daemon=True).start()
    try:
        while (task := _next_task()) is not None:
            pickle.dump(_run(task, pipe), pipe)
            pipe.flush()
    except KeyboardInterrupt:
        os._exit(128 + signal.SIGTERM)
    except BrokenPipeError:
        os._exit(1)


def _next_task() -> Task | None:
    try:
        task: Task = pickle.load(sys.stdin.buffer)
    except EOFError:
        return None
    return task


def _run(task: Task, pipe: IO[bytes]) -> Outcome:
    """Run a task and report its progress now and then."""
    frames, last = 0, 0.0

    def observe(_: FrameResult, total: int | None) -> None:
        nonlocal frames, last
        frames += 1
        if monotonic() > last + REPORT_EVERY_S:
            last = monotonic()
            pickle.dump((frames, total), pipe)
            pipe.flush()

    try:
        return run_task(task, observe)
    except MemoryError:
        return Outcome("failed", error=SonarrecError(f"{task.path}: not enough memory"))


def _watch_parent(parent: int) -> None:
    """End when the parent is gone: another process may be asked to run the same log."""
    while os.getppid() == parent:
        sleep(REPORT_EVERY_S)
    os.kill(os.getpid(), signal.SIGTERM)
    sleep(GRACE_S)
    os.kill(os.getpid(), signal.SIGKILL)


def _stop(*_: object) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough: let the results be written
    raise KeyboardInterrupt
