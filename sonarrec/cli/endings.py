"""What a command prints, and how it ends: messages on stdout and stderr, and exit codes."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

import click

from sonarrec.errors import Diagnostics, name_as_text, printable

FAILED = 1  # nothing could be used
MISUSED = 2  # an option is invalid, or an input does not exist
PARTLY = 3  # finished, but part of the input could not be used
WORSE = 4  # finished, but the results are worse than before, or than a limit allows
INTERRUPTED = 130  # stopped by Ctrl-C
TERMINATED = 143  # stopped by SIGTERM


def say(*lines: str) -> None:
    """Print lines on stdout. Control characters, as in names of files or topics, become escapes."""
    click.echo("\n".join(map(printable, lines)))


def _coloured(text: str, colour: str) -> str:
    """The text in a colour, which only a terminal shows (see no-color.org)."""
    return text if os.environ.get("NO_COLOR") else click.style(text, fg=colour)


def headed(text: str) -> str:
    """A heading as a terminal shows it."""
    return text if os.environ.get("NO_COLOR") else click.style(text, bold=True)


def inform(line: str) -> None:
    """Print a line on stderr that is neither note nor problem. If stderr fails, ignore it."""
    with suppress(OSError):
        click.echo(f"sonarrec: {printable(line)}", err=True)


def tell(problems: Iterable[str], notes: Iterable[str] = ()) -> None:
    """Print notes, then problems, on stderr, each on its own line. If stderr fails, ignore it."""
    with suppress(OSError):
        for note in notes:
            click.echo(f"{_coloured('sonarrec: note:', 'yellow')} {printable(note)}", err=True)
        for problem in problems:
            # A problem may end with an example of several lines.
            lines = "\n".join(map(printable, problem.split("\n")))
            click.echo(f"{_coloured('sonarrec:', 'red')} {lines}", err=True)


def end(problems: Collection[object]) -> None:
    """Leave with exit code PARTLY if there are problems; otherwise return.

    problems: the parts of the input that could not be used.
    """
    if problems:
        leave(PARTLY)


def finish(told: Diagnostics, quiet: bool, lines: Iterable[str]) -> None:
    """Print what is told and, unless quiet, the lines; leave with PARTLY if there are problems."""
    tell(told.problems, told.notes)
    if not quiet:
        say(*lines)
    end(told.problems)


@contextmanager
def naming_leftovers(*places: Path) -> Iterator[None]:
    """If Ctrl-C stops the block, say which of these outputs exist.

    The user must remove them before the next call, which refuses to overwrite them.
    """
    try:
        yield
    except KeyboardInterrupt as error:
        if leftovers := ", ".join(name_as_text(place) for place in places if place.exists()):
            error.add_note(f"the output so far is in {leftovers}; remove it to start again")
        raise


def leave(code: int) -> NoReturn:
    """End the command with this exit code."""
    click.get_current_context().exit(code)
