"""What a command prints, and how it ends.

In this order: what is wrong (stderr), results (stdout), notes (stderr). And the exit codes.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import NoReturn

import click

from sonarrec.errors import SonarrecError, UsageError, number_of, printable

FAILED = 1  # nothing could be used
MISUSED = 2  # an option is invalid, or an input does not exist
PARTLY = 3  # finished, but part of the input could not be used
WORSE = 4  # finished, but the results are worse than before, or than a limit allows
INTERRUPTED = 130  # stopped by Ctrl-C
TERMINATED = 143  # stopped by SIGTERM
MOST_NOTES = 5


def code_of(error: SonarrecError) -> int:
    """The exit code of a log, or a call, that failed."""
    return MISUSED if isinstance(error, UsageError) else FAILED


def code_of_all(codes: Sequence[int]) -> int:
    """The exit code of a call by those of its logs."""
    if all(codes) and PARTLY not in codes:
        return FAILED if FAILED in codes else MISUSED
    return PARTLY if any(codes) else 0


def say(*lines: str) -> None:
    """Print lines on stdout. Control characters, as in names of files or topics, become escapes."""
    click.echo("\n".join(map(printable, lines)))


def inform(line: str) -> None:
    """Print a line on stderr that is neither note nor problem. If stderr fails, ignore it."""
    with suppress(OSError):
        click.echo(f"sonarrec: {printable(line)}", err=True)


def print_notes(problems: Iterable[str], notes: Iterable[str] = ()) -> None:
    """Print problems, then at most MOST_NOTES notes, on stderr, none twice. If stderr fails, ignore
    it."""
    different = [*dict.fromkeys(notes)]
    with suppress(OSError):
        for problem in dict.fromkeys(problems):
            click.echo(f"{styled('sonarrec:', fg='red')} {printable(problem)}", err=True)
        for note in different[:MOST_NOTES]:
            click.echo(f"{styled('sonarrec: note:', fg='yellow')} {printable(note)}", err=True)
    if more := len(different[MOST_NOTES:]):
        inform(number_of(more, "more note"))


def finish(
    quiet: bool, results: Iterable[str], problems: Collection[str] = (), notes: Iterable[str] = ()
) -> None:
    """Print what is wrong, the results unless quiet, and notes; leave with PARTLY if problems."""
    print_notes(problems)
    if not quiet:
        say(*results)
    print_notes((), notes)
    if problems:
        leave(PARTLY)


class Terminated(KeyboardInterrupt):
    """Raised at SIGTERM, which batch systems and containers send; it ends as Ctrl-C does."""


@contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM raises Terminated, so that unfinished outputs are removed."""

    def stop(*_: object) -> None:
        raise Terminated

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def leave(code: int) -> NoReturn:
    """End the command with this exit code."""
    click.get_current_context().exit(code)


def styled(text: str, **style: object) -> str:
    """The text in a colour or in bold, which only a terminal shows (see no-color.org)."""
    return text if os.environ.get("NO_COLOR") else click.style(text, **style)  # type: ignore[arg-type]


@contextmanager
def progress(
    quiet: bool, total: int | None = None, title: str | None = None, unit: str = "frame"
) -> Iterator[Callable[..., None]]:
    """tqdm's bar on stderr, moved by step(total=None, by=1); none if stderr is no terminal."""
    if quiet or not sys.stderr.isatty():
        yield lambda *_, **__: None
        return
    from tqdm import tqdm  # slow to load

    # With a file descriptor of its own: readers redirect that of stderr while they decode.
    terminal = os.fdopen(os.dup(sys.stderr.fileno()), "w", encoding=sys.stderr.encoding)
    style = {"desc": title, "unit": unit, "leave": False, "delay": 1e-3}  # none without a step
    with terminal, tqdm(total=total, file=terminal, **style) as bar:

        def step(total: int | None = None, by: int = 1) -> None:
            bar.total = bar.total if total is None else total
            bar.update(by)

        yield step


@contextmanager
def above_the_bar() -> Iterator[None]:
    """Print above a bar, not into it."""
    if "tqdm" not in sys.modules:  # no bar is shown
        yield
        return
    from tqdm import tqdm

    with tqdm.external_write_mode():
        yield
