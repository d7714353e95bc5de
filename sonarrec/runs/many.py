"""Runs logs in separate processes, so that a crash or a lack of memory costs one log only."""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from queue import SimpleQueue
from tempfile import TemporaryFile
from threading import Lock, Thread, Timer
from time import monotonic
from typing import IO

from sonarrec.errors import SonarrecError
from sonarrec.nouns import FrameResult
from sonarrec.remote.fetch import fetch_ahead
from sonarrec.runs.task import GRACE_S, Outcome, Task, run_task

# The child gets sys.path, so that it runs this same program. It uses one thread: the logs share the
# cores, and OpenCV's threads would only compete.
_START = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
_START += "from sonarrec.runs.worker import main; main()"
_ONE_THREAD = {"OPENCV_FOR_THREADS_NUM": "1"}

Frames = Callable[[int, int | None], None]
"""Called now and then with the number of frames done and the total, None if not known."""


class Worker:
    """Runs logs in a process apart, one after the other; a new process after one that ended.

    One thread calls `run`; others may call `stop`.
    """

    def __init__(self, timeout_s: float | None = None) -> None:
        """timeout_s: how long one log may take; None: no limit."""
        self._timeout_s = timeout_s
        self._child: subprocess.Popen[bytes] | None = None
        self._printed: IO[bytes] | None = None  # what the process prints, such as a traceback
        self._starting = Lock()
        self._stopped = False

    def run(self, task: Task, frames: Frames | None = None) -> Outcome:
        """Run a task; its outcome says if the process died."""
        start_s = monotonic()
        with self._starting:
            if self._stopped:
                return Outcome("waiting")
            try:
                child = self._child = self._child or self._start()
            except OSError as error:  # no memory, file descriptors or disk space
                why = f"no process could be started for it ({error.strerror})"
                return Outcome("failed", error=SonarrecError(f"{task.path}: {why}"))
        late = False

        def overdue() -> None:
            nonlocal late
            late = True
            _end(child)

        timer = Timer(self._timeout_s or 0, overdue)
        if self._timeout_s is not None:
            timer.start()
        outcome = _listen(child, task, frames)
        timer.cancel()
        if outcome is not None and not late:
            return outcome
        fault = self._wait_for_end()
        if self._stopped:
            return Outcome("waiting")
        why = f"took more than {self._timeout_s:g} s (--timeout)" if late else _why(child)
        fault = fault if child.returncode > 0 and not late else ""
        failed = SonarrecError(f"{task.path}: {why}")
        return Outcome("failed", monotonic() - start_s, error=failed, fault=fault)

    def stop(self) -> None:
        """End the running process and start none; the log keeps its frames so far.

        Returns at once. A process that does not end is killed after GRACE_S.
        """
        with self._starting:
            self._stopped = True
            if self._child is not None:
                Thread(target=_end, args=(self._child,), daemon=True).start()

    def close(self) -> None:
        """Wait for the process to end; one that does not is killed after GRACE_S."""
        with self._starting:
            self._stopped = True
        if self._child is not None:
            self._wait_for_end()

    def _start(self) -> subprocess.Popen[bytes]:
        """A process that waits for tasks."""
        self._printed = TemporaryFile()  # noqa: SIM115 - as long as the process
        return subprocess.Popen(
            [sys.executable, "-c", _START, json.dumps(sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._printed,
            env=os.environ | _ONE_THREAD,
            start_new_session=True,
        )

    def _wait_for_end(self) -> str:
        """Wait for the process to end; what it has printed."""
        child, printed = self._child, self._printed
        assert child is not None
        assert printed is not None
        with child, printed:
            assert child.stdin is not None
            with suppress(OSError):
                child.stdin.close()  # no more tasks
            _wait_or_kill(child)
            self._child = None
            printed.seek(0)
            return printed.read().decode(errors="replace")


def _listen(child: subprocess.Popen[bytes], task: Task, frames: Frames | None) -> Outcome | None:
    """Send the task and report its frames until it ends; None if the process dies before."""
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        pickle.dump(task, child.stdin)
        child.stdin.flush()
        while True:
            message = pickle.load(child.stdout)
            if isinstance(message, Outcome):
                return message
            if frames is not None:
                frames(*message)
    except (EOFError, OSError, pickle.UnpicklingError):
        return None


def _end(child: subprocess.Popen[bytes]) -> None:
    child.terminate()
    _wait_or_kill(child)


def _wait_or_kill(child: subprocess.Popen[bytes]) -> None:
    """Wait for a process to end; one that does not within GRACE_S is killed."""
    try:
        child.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        child.kill()


def _why(child: subprocess.Popen[bytes]) -> str:
    code = child.returncode
    if code >= 0:
        return "a bug in sonarrec ended its process; the traceback is above"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    return f"its process was ended by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")


class Watch:
    """Gets events while logs are run, always in the caller's thread. i: index of the task."""

    def note(self, line: str) -> None:
        """A line about the call as a whole."""

    def started(self, i: int) -> None:
        """Task i has begun."""

    def frames(self, i: int, done: int, total: int | None) -> None:
        """`done` frames of task i are processed; called now and then."""

    def fetching(self, i: int, arrived: int, total: int | None) -> None:
        """`arrived` bytes of the log of task i are fetched; only for logs run in this process."""

    def ended(self, i: int, outcome: Outcome) -> None:
        """Task i has ended."""


def run_here(tasks: list[Task], watch: Watch) -> None:
    """Run tasks one after the other in this process; the next remote log is fetched meanwhile."""
    for i, task in enumerate(tasks):
        done = 0

        def observe(_: FrameResult, total: int | None, i: int = i) -> None:
            nonlocal done
            done += 1
            watch.frames(i, done, total)
            if done == 1:
                _fetch_next(tasks[i + 1 :])

        watch.started(i)
        watch.ended(i, run_task(task, observe, partial(watch.fetching, i)))


def _fetch_next(tasks: list[Task]) -> None:
    for remote in (task.remote for task in tasks):
        if remote is not None and remote.log is not None:
            fetch_ahead(remote.log, remote.cache)
            return


def run_apart(tasks: list[Task], jobs: int, watch: Watch, timeout_s: float | None = None) -> None:
    """Run tasks in separate processes, `jobs` at a time, started in their order.

    An exception in the caller's thread, such as Ctrl-C, ends the processes; their logs keep the
    frames so far.
    """
    tasks_left = iter(enumerate(tasks))
    turn = Lock()
    events: SimpleQueue[Callable[[], None] | None] = SimpleQueue()  # None: a worker has ended

    def report_frames(i: int, done: int, total: int | None) -> None:
        events.put(partial(watch.frames, i, done, total))

    def work(worker: Worker) -> None:
        try:
            while True:
                with turn:
                    i, task = next(tasks_left, (-1, None))
                if task is None:
                    return
                events.put(partial(watch.started, i))
                outcome = worker.run(task, partial(report_frames, i))
                if outcome.status == "waiting":
                    return
                events.put(partial(watch.ended, i, outcome))
        except BaseException as error:  # a bug: the call must not end as if all were done
            events.put(partial(_raise, error))
        finally:
            events.put(None)

    workers = [Worker(timeout_s) for _ in range(min(jobs, len(tasks)))]
    threads = [Thread(target=work, args=(worker,), daemon=True) for worker in workers]
    for thread in threads:
        thread.start()
    working = len(threads)
    try:
        while working:
            if (tell := events.get()) is None:
                working -= 1
            else:
                tell()
    except BaseException:
        for worker in workers:
            worker.stop()
        raise
    finally:
        for thread, worker in zip(threads, workers, strict=True):
            thread.join()
            worker.close()


def _raise(error: BaseException) -> None:
    raise error
