"""How a command ends: its messages on stderr, and its exit code."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

import click

from sonarrec.records import name_as_text, printable

FAILED = 1  # nothing could be used
MISUSED = 2  # an option is invalid, or an input does not exist
PARTLY = 3  # finished, but part of the input could not be used
INTERRUPTED = 130  # stopped by Ctrl-C
TERMINATED = 143  # stopped by SIGTERM


def say(*lines: str) -> None:
    """Lines on stdout; what a terminal would obey, in the names of files and topics, as escapes."""
    click.echo("\n".join(map(printable, lines)))


def tell(problems: Iterable[str], notes: Iterable[str] = ()) -> None:
    """Print notes and problems on stderr, a line each; errors of stderr are ignored."""
    with suppress(OSError):
        for note in notes:
            click.echo(f"sonarrec: note: {printable(note)}", err=True)
        for problem in problems:
            # A fault may have an example behind it, of several lines.
            lines = "\n".join(map(printable, problem.split("\n")))
            click.echo(f"sonarrec: {lines}", err=True)


def end(problems: Collection[object]) -> None:
    """End a command, with PARTLY if part of the input could not be used."""
    if problems:
        leave(PARTLY)


@contextmanager
def naming_leftovers(*places: Path) -> Iterator[None]:
    """If Ctrl-C stops the inside, name the places that it left, which a new call would refuse."""
    try:
        yield
    except KeyboardInterrupt as error:
        if leftovers := ", ".join(name_as_text(place) for place in places if place.exists()):
            error.add_note(f"the output so far is in {leftovers}; remove it to start again")
        raise


def leave(code: int) -> NoReturn:
    """End the command with an exit code."""
    click.get_current_context().exit(code)
