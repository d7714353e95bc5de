"""Runs logs on a Dask cluster: each job in a process of its own on a worker."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.results.folders import LockedError
from sonarrec.runs.job import GRACE_S, Job, Outcome
from sonarrec.runs.many import Processes, Watch

RETRIES = 2
"""How often a job is started again after its worker was lost."""
PATIENCE = "10s"
"""How long to wait for the scheduler."""


def run_on_cluster(jobs: Sequence[Job], address: str, watch: Watch) -> None:
    """Run jobs on the workers of the Dask scheduler at `address`.

    If the scheduler dies, finished results stay and the same call continues from there.
    Raises UsageError if the extra `cluster` is not installed, the address is invalid, certificates
    are missing or no scheduler answers.
    """
    try:
        import distributed
    except ImportError:
        raise UsageError("--scheduler needs pip install 'sonarrec[cluster]'") from None
    dask: Any = distributed  # only part of it has types
    try:  # a client that cannot connect would wait for ever
        dask.comm.get_address_host_port(address)
        certificates = dask.Security().get_connection_args("client")["ssl_context"]
    except (ValueError, OSError) as error:
        raise UsageError(
            f"--scheduler {address}: expected an address such as tcp://host:8786 ({error})"
        ) from None
    if address.startswith("tls://") and certificates is None:
        raise UsageError(f"--scheduler {address}: needs certificates in dask's configuration")
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # a lost scheduler is reported below
    try:
        client = dask.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(f"--scheduler {address}: no scheduler answers there ({error})") from None
    with client:
        if not client.scheduler_info()["workers"]:
            watch(None, f"{address}: there is no worker yet; the logs wait for one")
        for i in range(len(jobs)):
            watch(i, (0, None))  # only the worker knows when a job really starts
        running = {
            client.submit(_run_on_worker, job, Path.cwd(), pure=False, retries=RETRIES): i
            for i, job in enumerate(jobs)
        }
        for future in dask.as_completed(list(running), loop=client.loop):
            i = running.pop(future)
            if future.status == "finished":
                watch(i, future.result())
            else:
                gone = f"the scheduler gave up on it ({future.status})"
                why = future.exception() if future.status == "error" else gone
                lost = SonarrecError(f"{jobs[i].path}: {why}")
                watch(i, Outcome("failed", error=lost))
            future.release()


def _run_on_worker(job: Job, folder: Path) -> Outcome:
    """Run a job in a process of its own; called on a worker. folder: to which its paths relate."""
    give_up = monotonic() + 2 * GRACE_S
    with closing(Processes(folder if folder.is_dir() else None)) as processes:
        while True:
            outcome = processes.run(job)
            # The process of a lost worker may still be writing its results.
            if not isinstance(outcome.error, LockedError) or monotonic() > give_up:
                return outcome
            sleep(1)
