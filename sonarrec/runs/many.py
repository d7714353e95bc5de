"""Runs logs in separate processes, so that a crash or a lack of memory costs one log only.

Tasks and events are pickled: both ends are the same program.
"""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile
from threading import Lock, Timer
from time import monotonic
from typing import IO

from sonarrec.errors import SonarrecError
from sonarrec.nouns import FrameResult
from sonarrec.runs.one import GRACE_S, Event, Observe, Outcome, Task, run_task

# The child gets sys.path, so that it runs this same program. It uses one thread: the logs share the
# cores, and OpenCV's threads would only compete.
_START = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
_START += "from sonarrec.runs.many import main; main()"
_ONE_THREAD = {"OPENCV_FOR_THREADS_NUM": "1"}
_REPORT_EVERY_S = 0.2

Child = subprocess.Popen[bytes]
Watch = Callable[[int | None, Event], object]
"""Called with the index of a task and an event, one at a time; None: a line on the whole call."""


def run_here(tasks: Sequence[Task], watch: Watch) -> None:
    """Run tasks one after the other in this process."""
    for i, task in enumerate(tasks):
        tell = partial(watch, i)
        tell((0, None))
        tell(run_task(task, _progress(tell), tell))


def run_apart(tasks: Sequence[Task], jobs: int, watch: Watch) -> None:
    """Run tasks in processes of their own, `jobs` at a time, started in their order.

    An exception in the caller's thread, such as Ctrl-C, ends the processes; their logs keep the
    frames so far.
    """
    processes, turn = Processes(), Lock()

    def tell(i: int, event: Event) -> None:
        with turn:
            watch(i, event)

    def work(i: int, task: Task) -> None:
        tell(i, (0, None))
        outcome = processes.run(task, partial(tell, i))
        if outcome.status != "waiting":
            tell(i, outcome)

    with closing(processes), ThreadPoolExecutor(jobs) as threads:
        try:
            futures = [threads.submit(work, i, task) for i, task in enumerate(tasks)]
            for ended in as_completed(futures):
                ended.result()
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            processes.stop()
            raise


def _progress(tell: Callable[[Event], object], every_s: float = 0.0) -> Observe:
    """Tells how many frames of a log are done, and of how many, at most every so many seconds."""
    frames, told_s = 0, 0.0

    def observe(_: FrameResult, total: int | None) -> None:
        nonlocal frames, told_s
        frames += 1
        if monotonic() >= told_s + every_s:
            told_s = monotonic()
            tell((frames, total))

    return observe


class Processes:
    """Runs logs in processes: in one that an earlier log has left, else in a new one."""

    def __init__(self, folder: Path | None = None) -> None:
        """folder: to which the tasks' paths relate; default: the current one."""
        self._folder = folder
        self._idle = list[tuple[Child, IO[bytes]]]()  # with the file of what each prints
        self._running = set[Child]()
        self._starting = Lock()
        self._stopped = False

    def stop(self) -> None:
        """End the processes and start none; logs keep their frames so far. Returns at once."""
        with self._starting:
            self._stopped = True
            for child in [*self._running]:  # their threads take them out meanwhile
                child.terminate()
                killer = Timer(GRACE_S, child.kill)
                killer.daemon = True
                killer.start()

    def run(self, task: Task, tell: Callable[[Event], object] = str) -> Outcome:
        """Run a task; its outcome says if the process died. tell: gets the events before."""
        start_s = monotonic()

        def failed(why: str, fault: str = "") -> Outcome:
            error = SonarrecError(f"{task.path}: {why}")
            return Outcome("failed", monotonic() - start_s, error=error, fault=fault)

        with self._starting:
            if self._stopped:
                return Outcome("waiting")
            try:
                child, printed = self._idle.pop() if self._idle else self._start()
            except OSError as error:  # no memory, file descriptors or disk space
                return failed(f"no process could be started for it ({error.strerror})")
            self._running.add(child)
        outcome = _listen(child, task, tell)
        self._running.discard(child)
        if outcome is not None:
            self._idle.append((child, printed))
            return outcome
        said = _said_until_its_end(child, printed)
        if self._stopped:
            return Outcome("waiting")
        if child.returncode >= 0:
            return failed("a bug in sonarrec ended its process; the traceback is above", said)
        memory = " (out of memory?)" if child.returncode == -signal.SIGKILL else ""
        return failed(f"its process was ended by {signal.Signals(-child.returncode).name}{memory}")

    def close(self) -> None:
        """End the processes that wait for another log."""
        for child, printed in self._idle:
            _said_until_its_end(child, printed)

    def _start(self) -> tuple[Child, IO[bytes]]:
        """A process that waits for tasks, and the file of what it prints, such as a traceback."""
        printed = TemporaryFile()  # noqa: SIM115 - as long as the process
        child = subprocess.Popen(
            [sys.executable, "-c", _START, json.dumps(sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=printed,
            cwd=self._folder,
            env=os.environ | _ONE_THREAD,
            start_new_session=True,
        )
        return child, printed


def _listen(child: Child, task: Task, tell: Callable[[Event], object]) -> Outcome | None:
    """Send the task and pass on its events until it ends; None if the process dies before."""
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        pickle.dump(task, child.stdin)
        child.stdin.flush()
        while not isinstance(event := pickle.load(child.stdout), Outcome):
            tell(event)
    except (EOFError, OSError, pickle.UnpicklingError):
        return None
    return event


def _said_until_its_end(child: Child, printed: IO[bytes]) -> str:
    """Wait for a process to end, for which there is no other task; what it has printed."""
    with child, printed:
        assert child.stdin is not None
        with suppress(OSError):
            child.stdin.close()
        child.wait()
        printed.seek(0)
        return printed.read().decode(errors="replace")


def main() -> None:
    """The process that runs logs: tasks come on stdin, progress and outcomes go to stdout.

    After SIGTERM, or if the parent is gone and so the pipe is broken, the frames so far are kept.
    """
    pipe = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints must not mix with the pickles
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C on the terminal; the parent sends SIGTERM
    signal.signal(signal.SIGTERM, _stop)

    def send(event: Event) -> None:
        pickle.dump(event, pipe)
        pipe.flush()

    try:
        while (task := _next_task()) is not None:
            try:
                outcome = run_task(task, _progress(send, _REPORT_EVERY_S), send)
            except MemoryError:
                outcome = Outcome("failed", error=SonarrecError(f"{task.path}: not enough memory"))
            send(outcome)
    except KeyboardInterrupt:
        os._exit(128 + signal.SIGTERM)
    except BrokenPipeError:
        os._exit(1)


def _next_task() -> Task | None:
    with suppress(EOFError):
        task: Task = pickle.load(sys.stdin.buffer)
        return task
    return None


def _stop(*_: object) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough: let the results be written
    raise KeyboardInterrupt
