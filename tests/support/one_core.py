"""This process seems to have one core: what it does takes no process more."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from unittest.mock import patch


def one_core() -> AbstractContextManager[object]:
    """Meanwhile; what this process starts has the cores that there are."""
    return patch.object(os, "sched_getaffinity", lambda _: {0}, create=True)
