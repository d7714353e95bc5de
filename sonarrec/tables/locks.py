"""Locks between processes, on open files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # no such locks on this system
    fcntl = None  # type: ignore[assignment]


def locked(file: IO[bytes], *, alone: bool) -> bool:
    """Lock an open file without waiting; False if another process has locked it.

    alone: exclusively. If holders of the lock may delete the file, check `is_there` next.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, (fcntl.LOCK_EX if alone else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def is_there(file: IO[bytes], path: Path) -> bool:
    """Whether an open file is still the one at `path`, not a deleted one."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False
