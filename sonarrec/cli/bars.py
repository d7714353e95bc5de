"""Progress bars on stderr; silent if stderr is not a terminal."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any


def _silent(quiet: bool) -> bool:
    return quiet or not sys.stderr.isatty()  # checked here, since tqdm is slow to load


def _nothing(*_: object, **__: object) -> None:
    """Does nothing: the step of a silent bar."""


@contextmanager
def progress(
    quiet: bool, total: int | None = None, title: str | None = None
) -> Iterator[Callable[..., None]]:
    """A progress bar over frames. title: text before it.

    Yields a function to call after each frame: step(total=None, note="").
    """
    if _silent(quiet):
        yield _nothing
        return
    from tqdm import tqdm

    # It has its own file descriptor, because readers redirect that of stderr while they decode.
    with (
        os.fdopen(os.dup(sys.stderr.fileno()), "w", encoding=sys.stderr.encoding) as terminal,
        tqdm(total=total, desc=title, unit="frame", leave=False, file=terminal) as bar,
    ):

        def step(total: int | None = None, note: str = "") -> None:
            if total is not None:
                bar.total = total
            if note:
                bar.set_postfix_str(note, refresh=False)
            bar.update()

        yield step


@contextmanager
def progress_of_logs(quiet: bool, logs: int) -> Iterator[Callable[[float, str], None]]:
    """A progress bar over logs that run in parallel.

    Yields a function to call now and then: at(logs done including fractions of running ones, note).
    """
    if _silent(quiet):
        yield _nothing
        return
    from tqdm import tqdm

    layout = "{percentage:3.0f}%|{bar}| {postfix} [{elapsed}<{remaining}]"
    with tqdm(total=logs, bar_format=layout, leave=False) as bar:

        def at(done: float, note: str) -> None:
            bar.set_postfix_str(note, refresh=False)
            bar.update(max(done - bar.n, 0))

        yield at


@contextmanager
def fetching(quiet: bool, name: str) -> Iterator[Callable[[int, int | None], None]]:
    """A progress bar over the bytes of a log that is being fetched.

    Yields a function to call as they arrive: step(arrived, total or None). The first call shows it.
    """
    if _silent(quiet):
        yield _nothing
        return
    from tqdm import tqdm

    with ExitStack() as stack:
        bar: Any = None

        def step(arrived: int, of: int | None) -> None:
            nonlocal bar
            if bar is None:
                look = {"desc": f"fetch {name}", "unit": "B", "unit_scale": True}
                bar = stack.enter_context(tqdm(**look, leave=False))
            bar.total = of
            bar.update(arrived - bar.n)

        yield step
