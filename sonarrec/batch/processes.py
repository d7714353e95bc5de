"""Logs in processes apart: a crash, an out-of-memory kill or a hung decoder costs that log only."""

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
from typing import IO, Any

from sonarrec.batch.task import GRACE_S, Outcome, Task, do
from sonarrec.records import FrameResult, SonarrecError
from sonarrec.remote.fetch import fetch_ahead

# The paths are handed on, so that the child runs this very program. One thread a process: the logs
# share the cores, and OpenCV's threads would only get into each other's way.
_START = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
_START += "from sonarrec.batch.worker import main; main()"
_ONE_THREAD = {"OPENCV_FOR_THREADS_NUM": "1"}

Frames = Callable[[int, int | None], None]
"""Told from time to time how many frames of a log are done, and of how many, where known."""


class Worker:
    """Runs logs in a process apart, one after the other; a new process after one that ended.

    One thread calls `run`; others may call `stop`.
    """

    def __init__(self, timeout_s: float | None = None) -> None:
        """timeout_s: how long one log may take; default, as long as it likes."""
        self._timeout_s = timeout_s
        self._child: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes] | None = None  # what the process prints: a traceback, above all
        self._starting = Lock()
        self._stopped = False

    def run(self, task: Task, frames: Frames | None = None) -> Outcome:
        """The outcome of a task, or of the end of its process, however that was."""
        begun = monotonic()
        with self._starting:
            if self._stopped:
                return Outcome("waiting")
            try:
                child = self._child = self._child or self._started()
            except OSError as error:  # no memory, no file descriptors, no room for what it prints
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
        outcome = _told(child, task, frames)
        timer.cancel()
        if outcome is not None and not late:
            return outcome
        fault = self._ended()
        if self._stopped:
            return Outcome("waiting")
        why = f"took more than {self._timeout_s:g} s (--timeout)" if late else _why(child)
        fault = fault if child.returncode > 0 and not late else ""
        told = SonarrecError(f"{task.path}: {why}")
        return Outcome("failed", monotonic() - begun, error=told, fault=fault)

    def stop(self) -> None:
        """End what runs; the log keeps its frames so far in its part. Nothing new is begun.

        Returns at once; a process that does not end by itself is killed GRACE_S later.
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
            self._ended()

    def _started(self) -> subprocess.Popen[bytes]:
        """A process that waits for tasks."""
        self._said = TemporaryFile()  # noqa: SIM115 - as long as the process
        return subprocess.Popen(
            [sys.executable, "-c", _START, json.dumps(sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
            env=os.environ | _ONE_THREAD,
            start_new_session=True,
        )

    def _ended(self) -> str:
        """What the process has printed, once it has ended."""
        child, said = self._child, self._said
        assert child is not None
        assert said is not None
        with child, said:
            assert child.stdin is not None
            with suppress(OSError):
                child.stdin.close()  # no more tasks
            try:
                child.wait(GRACE_S)
            except subprocess.TimeoutExpired:
                child.kill()
            self._child = None
            said.seek(0)
            return said.read().decode(errors="replace")


def _told(child: subprocess.Popen[bytes], task: Task, frames: Frames | None) -> Outcome | None:
    """What the process tells of the task to its end; None where it ends without an Outcome."""
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        pickle.dump(task, child.stdin)
        child.stdin.flush()
        while True:
            news = pickle.load(child.stdout)
            if isinstance(news, Outcome):
                return news
            if frames is not None:
                frames(*news)
    except (EOFError, OSError, pickle.UnpicklingError):
        return None


def _end(child: subprocess.Popen[bytes]) -> None:
    child.terminate()
    try:
        child.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        child.kill()


def _why(child: subprocess.Popen[bytes]) -> str:
    code = child.returncode
    if code >= 0:
        return "a fault of sonarrec ended its process; the traceback is above"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    return f"its process was ended by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")


class Watch:
    """What is told while logs are run, always in the caller's thread. i: which task."""

    def note(self, line: str) -> None:
        """What is to be known of the call, in a line."""

    def begun(self, i: int) -> None:
        """Task i has begun."""

    def frames(self, i: int, done: int, total: int | None) -> None:
        """So many frames of task i are done; told from time to time."""

    def fetching(self, i: int, came: int, total: int | None) -> None:
        """So many bytes of the log of task i came; told of a log of this process only."""

    def ended(self, i: int, outcome: Outcome) -> None:
        """Task i has ended."""


def run_here(tasks: list[Task], watch: Watch) -> None:
    """Run tasks one after the other in this process; the next log on a server comes meanwhile."""
    for i, task in enumerate(tasks):
        done = 0

        def observe(_: FrameResult, total: int | None, i: int = i) -> None:
            nonlocal done
            done += 1
            watch.frames(i, done, total)
            if done == 1:
                _fetch_next(tasks[i + 1 :])

        watch.begun(i)
        watch.ended(i, do(task, observe, partial(watch.fetching, i)))


def _fetch_next(tasks: list[Task]) -> None:
    for far in (task.elsewhere for task in tasks):
        if far is not None and far.log is not None:
            fetch_ahead(far.log, far.cache)
            return


def run_apart(tasks: list[Task], jobs: int, watch: Watch, timeout_s: float | None = None) -> None:
    """Run tasks in processes apart, `jobs` at a time; begun in their order.

    An exception in the caller's thread, Ctrl-C above all, ends the processes, each with its frames
    so far in its part.
    """
    left = iter(enumerate(tasks))
    turn = Lock()
    news: SimpleQueue[tuple[Callable[..., None], tuple[Any, ...]] | None] = SimpleQueue()

    def work(worker: Worker) -> None:
        try:
            while True:
                with turn:
                    i, task = next(left, (-1, None))
                if task is None:
                    return
                news.put((watch.begun, (i,)))
                outcome = worker.run(task, partial(_put, news, watch.frames, i))
                if outcome.status == "waiting":
                    return
                news.put((watch.ended, (i, outcome)))
        except BaseException as error:  # a fault of ours: the call must not end as if all were done
            news.put((_raised, (error,)))
        finally:
            news.put(None)

    workers = [Worker(timeout_s) for _ in range(min(jobs, len(tasks)))]
    threads = [Thread(target=work, args=(worker,), daemon=True) for worker in workers]
    for thread in threads:
        thread.start()
    working = len(threads)
    try:
        while working:
            if (said := news.get()) is None:
                working -= 1
            else:
                call, arguments = said
                call(*arguments)
    except BaseException:
        for worker in workers:
            worker.stop()
        raise
    finally:
        for thread, worker in zip(threads, workers, strict=True):
            thread.join()
            worker.close()


def _raised(error: BaseException) -> None:
    raise error


def _put(news: SimpleQueue[Any], call: Callable[..., None], *arguments: Any) -> None:
    news.put((call, arguments))
