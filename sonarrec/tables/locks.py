"""Locks between processes, on open files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # no such locks on this system
    fcntl = None  # type: ignore[assignment]


def locked(file: IO[bytes] | int, *, alone: bool, wait: bool = False) -> bool:
    """Lock an open file or folder; False if another process has locked it, unless it waits.

    alone: exclusively. If holders of the lock may delete the file, check `is_there` next.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, (fcntl.LOCK_EX if alone else fcntl.LOCK_SH) | fcntl.LOCK_NB * (not wait))
    except OSError:  # locked, or the file system has no locks
        return False
    return True


def is_there(file: IO[bytes], path: Path) -> bool:
    """Whether an open file is still the one at `path`, not a deleted one."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False
