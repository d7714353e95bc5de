"""This process seems to have one core: what it does takes no process more."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from unittest.mock import patch

_CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def one_core() -> AbstractContextManager[object]:
    """Meanwhile; what this process starts has the cores that there are."""
    return patch.object(os, "sched_getaffinity", lambda _: {0}, create=True)


@contextmanager
def one_core_for_others() -> Iterator[None]:
    """What this process starts meanwhile has one core: to start a second process, or to copy the
    first, takes longer than many a run. On systems other than Linux it has all cores."""
    if not _CORES:
        yield
        return
    os.sched_setaffinity(0, {_CORES[os.getpid() % len(_CORES)]})
    try:
        yield
    finally:
        os.sched_setaffinity(0, _CORES)
