"""Runs jobs in separate processes, so that a crash or a lack of memory costs one log only.

Jobs and events are pickled: both ends are the same program.
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

from sonarrec.errors import SonarrecError
from sonarrec.runs.job import GRACE_S, Event, Job, Observe, Outcome, Report
from sonarrec.runs.one import run_job
from sonarrec.sonar.frame import FrameResult

# The child gets sys.path, so that it runs this same program. It uses one thread: the logs share the
# cores, and OpenCV's threads would only compete.
_START = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
_START += "from sonarrec.runs.many import main; main()"
_ONE_THREAD = {"OPENCV_FOR_THREADS_NUM": "1"}
_REPORT_EVERY_S = 0.2

Watch = Callable[[int | None, Event], object]
"""Called with the index of a job and an event, one at a time; None: a line on the whole call."""


def run_here(jobs: Sequence[Job], watch: Watch) -> None:
    """Run jobs one after the other in this process."""
    for i, job in enumerate(jobs):
        report = partial(watch, i)
        report((0, None))
        report(run_job(job, _progress(report), report))


def run_in_processes(jobs: Sequence[Job], at_once: int, watch: Watch) -> None:
    """Run jobs in processes of their own, `at_once` at a time, started in their order.

    An exception in the caller's thread, such as Ctrl-C, ends the processes; their logs keep the
    frames so far.
    """
    processes, one_at_a_time = Processes(), Lock()

    def report(i: int, event: Event) -> None:
        with one_at_a_time:
            watch(i, event)

    def work(i: int, job: Job) -> None:
        report(i, (0, None))
        outcome = processes.run(job, partial(report, i))
        if outcome.status != "waiting":
            report(i, outcome)

    with closing(processes), ThreadPoolExecutor(at_once) as threads:
        try:
            futures = [threads.submit(work, i, job) for i, job in enumerate(jobs)]
            for ended in as_completed(futures):
                ended.result()
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            processes.stop()
            raise


def _progress(report: Report, every_s: float = 0.0) -> Observe:
    """Reports how many frames are done, and of how many, at most every so many seconds."""
    frames, reported_s = 0, 0.0

    def observe(_: FrameResult, total: int | None) -> None:
        nonlocal frames, reported_s
        frames += 1
        if monotonic() >= reported_s + every_s:
            reported_s = monotonic()
            report((frames, total))

    return observe


class _Child:
    """A process that runs one job after another; see `main`."""

    def __init__(self, folder: Path | None) -> None:
        self._printed = TemporaryFile()  # noqa: SIM115 - as long as the process
        self.process = subprocess.Popen(
            [sys.executable, "-c", _START, json.dumps(sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._printed,
            cwd=folder,
            env=os.environ | _ONE_THREAD,
            start_new_session=True,
        )

    def run(self, job: Job, report: Report) -> Outcome | None:
        """Run a job and pass on its events until it ends; None if the process dies before."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        try:
            pickle.dump(job, self.process.stdin)
            self.process.stdin.flush()
            while not isinstance(event := pickle.load(self.process.stdout), Outcome):
                report(event)
        except (EOFError, OSError, pickle.UnpicklingError):
            return None
        return event

    def end(self) -> str:
        """Wait for the end of the process, for which there is no other job; what it printed."""
        with self.process, self._printed:
            assert self.process.stdin is not None
            with suppress(OSError):
                self.process.stdin.close()
            self.process.wait()
            self._printed.seek(0)
            return self._printed.read().decode(errors="replace")


class Processes:
    """Runs jobs in processes: in one that an earlier job has left, else in a new one."""

    def __init__(self, folder: Path | None = None) -> None:
        """folder: to which the jobs' paths relate; default: the current one."""
        self._folder = folder
        self._idle = list[_Child]()
        self._running = set[_Child]()
        self._starting = Lock()
        self._stopped = False

    def run(self, job: Job, report: Report = str) -> Outcome:
        """Run a job; its outcome says if the process died. report: gets the events before."""
        start_s = monotonic()

        def failed(why: str, traceback: str = "") -> Outcome:
            error = SonarrecError(f"{job.path}: {why}")
            return Outcome(
                "failed", error=error, traceback=traceback, seconds=monotonic() - start_s
            )

        with self._starting:
            if self._stopped:
                return Outcome("waiting")
            try:
                child = self._idle.pop() if self._idle else self._start()
            except OSError as error:  # no memory, file descriptors or disk space
                return failed(f"no process could be started for it ({error.strerror})")
            self._running.add(child)
        outcome = child.run(job, report)
        self._running.discard(child)
        if outcome is not None:
            self._idle.append(child)
            return outcome
        printed, code = child.end(), child.process.returncode
        if self._stopped:
            return Outcome("waiting")
        if code >= 0:
            return failed("a bug in sonarrec ended its process; the traceback is above", printed)
        memory = " (out of memory?)" if code == -signal.SIGKILL else ""
        return failed(f"its process was ended by {signal.Signals(-code).name}{memory}")

    def _start(self) -> _Child:
        return _Child(self._folder)

    def stop(self) -> None:
        """End the processes and start none; logs keep their frames so far. Returns at once."""
        with self._starting:
            self._stopped = True
            for child in [*self._running]:  # their threads take them out meanwhile
                child.process.terminate()
                killer = Timer(GRACE_S, child.process.kill)
                killer.daemon = True
                killer.start()

    def close(self) -> None:
        """End the processes that wait for another job."""
        for child in self._idle:
            child.end()


def main() -> None:
    """The process that runs jobs: they come on stdin, progress and outcomes go to stdout.

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
        while True:
            try:
                job: Job = pickle.load(sys.stdin.buffer)
            except EOFError:
                return  # no other follows
            try:
                outcome = run_job(job, _progress(send, _REPORT_EVERY_S), send)
            except MemoryError:
                outcome = Outcome("failed", error=SonarrecError(f"{job.path}: not enough memory"))
            send(outcome)
    except KeyboardInterrupt:
        os._exit(128 + signal.SIGTERM)
    except BrokenPipeError:
        os._exit(1)


def _stop(*_: object) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough: let the results be written
    raise KeyboardInterrupt
