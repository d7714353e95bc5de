"""The logs on a Dask cluster: each task the same process of its own, on a worker."""

from __future__ import annotations

import logging
from time import monotonic, sleep
from typing import Any

from sonarrec.batch.processes import Watch, Worker
from sonarrec.batch.task import GRACE_S, Outcome, Task
from sonarrec.records import SonarrecError, UsageError
from sonarrec.results.folders import LockedError

RETRIES = 2
"""How often a task is begun anew whose worker was lost."""
PATIENCE = "10s"
"""How long a scheduler is waited for."""
_TLS = "DASK_DISTRIBUTED__COMM__TLS__"
"""Begins the variables that name certificates; dask's configuration files may as well."""


def run_on_cluster(
    tasks: list[Task], address: str, watch: Watch, timeout_s: float | None = None
) -> None:
    """Run tasks on the workers of the Dask scheduler at `address`; results go where all see them.

    A scheduler that dies loses nothing that is finished: the same call goes on from there. Raises
    UsageError without the extra `cluster`, for what is no address, without the certificates that it
    needs, or where no scheduler answers.
    """
    try:
        import distributed
    except ImportError:
        raise UsageError("--scheduler needs pip install 'sonarrec[cluster]'") from None
    dask: Any = distributed  # it is typed in part only
    try:
        # First, for a client that was begun in vain prints a traceback when it is let go.
        dask.comm.get_address_host_port(address)
    except ValueError:
        raise UsageError(
            f"--scheduler {address}: expected an address such as tcp://host:8786"
        ) from None
    try:
        secure = dask.Security().get_connection_args("client")
    except OSError as error:
        raise UsageError(
            f"--scheduler {address}: the certificates that {_TLS}... names cannot be read "
            f"({error.strerror or error})"
        ) from None
    if address.startswith("tls://") and secure["ssl_context"] is None:
        raise UsageError(
            f"--scheduler {address}: needs certificates; {_TLS}CA_FILE, {_TLS}CLIENT__CERT and "
            f"{_TLS}CLIENT__KEY name their files"
        )
    if secure["require_encryption"] and not address.startswith(("tls://", "wss://")):
        raise UsageError(
            f"--scheduler {address}: dask's configuration requires encryption; tls://host:8786"
        )
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # a lost scheduler is told below
    try:
        client = dask.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(f"--scheduler {address}: no scheduler answers there ({error})") from None
    with client:
        if not client.scheduler_info()["workers"]:
            watch.note(f"{address}: no worker is there; the logs wait for one")
        for i in range(len(tasks)):
            watch.begun(i)  # when each really begins only its worker knows
        left = {
            client.submit(_there, task.absolute(), timeout_s, pure=False, retries=RETRIES): i
            for i, task in enumerate(tasks)
        }
        for future in dask.as_completed(list(left), loop=client.loop):
            i = left.pop(future)
            if future.status == "finished":
                watch.ended(i, future.result())
            else:
                watch.ended(i, Outcome("failed", error=_lost(tasks[i], future)))
            future.release()


def _there(task: Task, timeout_s: float | None) -> Outcome:
    """What a worker of the cluster does: a task in a process of its own."""
    worker = Worker(timeout_s)
    give_up = monotonic() + 2 * GRACE_S
    try:
        while True:
            outcome = worker.run(task)
            # The process of a worker that was lost may still be writing down its part.
            if not isinstance(outcome.error, LockedError) or monotonic() > give_up:
                return outcome
            sleep(1)
    finally:
        worker.close()


def _lost(task: Task, future: Any) -> SonarrecError:
    if future.status == "error":
        return SonarrecError(f"{task.path}: {future.exception()}")
    return SonarrecError(f"{task.path}: the scheduler gave it up ({future.status})")
