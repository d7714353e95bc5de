"""Logs through the recogniser and onto disk: one, or many at once. All parallelism is here."""

from __future__ import annotations

import os


def cores() -> int:
    """How many this process may use; a batch system or a container may limit them."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
