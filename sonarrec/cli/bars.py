"""Progress bars on stderr; silent if stderr is not a terminal."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from itertools import count
from typing import Any

Move = Callable[..., None]
"""Called now and then as move(done, total=None, note=""); the first call shows the bar."""


@contextmanager
def _bar(quiet: bool, *, own: bool = False, **look: Any) -> Iterator[Move]:
    """A bar of tqdm. look: options of it. own: with a file descriptor of its own."""
    if quiet or not sys.stderr.isatty():
        yield lambda *_, **__: None
        return
    from tqdm import tqdm  # only here, since it is slow to load

    bar: Any = None
    with ExitStack() as stack:

        def move(done: float, total: float | None = None, note: str = "") -> None:
            nonlocal bar
            if bar is None:
                bar = stack.enter_context(tqdm(leave=False, **look))
            bar.total = bar.total if total is None else total
            if note:
                bar.set_postfix_str(note, refresh=False)
            bar.update(max(done - bar.n, 0))

        if own:
            descriptor = os.dup(sys.stderr.fileno())
            terminal = os.fdopen(descriptor, "w", encoding=sys.stderr.encoding)
            look["file"] = stack.enter_context(terminal)
        yield move


def progress_of_frames(
    quiet: bool, total: int | None = None, title: str | None = None
) -> AbstractContextManager[Move]:
    """A progress bar over frames. title: text before it."""
    # It has its own file descriptor, because readers redirect that of stderr while they decode.
    return _bar(quiet, own=True, total=total, desc=title, unit="frame")


@contextmanager
def progress(
    quiet: bool, total: int | None = None, title: str | None = None
) -> Iterator[Callable[..., None]]:
    """The same, by a function to call after each frame: step(total=None, note="")."""
    with progress_of_frames(quiet, total, title) as move:
        frames = count(1)
        yield lambda total=None, note="": move(next(frames), total, note)


def progress_of_logs(quiet: bool, logs: int) -> AbstractContextManager[Move]:
    """A progress bar over logs that run in parallel; done: includes fractions of running ones."""
    layout = "{percentage:3.0f}%|{bar}| {postfix} [{elapsed}<{remaining}]"
    return _bar(quiet, total=logs, bar_format=layout)
