"""How a command ends: what it tells on stderr, and its exit code."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn

import click

from sonarrec.records import shown

FAILED = 1  # nothing could be used
MISUSED = 2  # an option cannot be meant, or an input is not there
PARTLY = 3  # finished, but part of the input could not be used
INTERRUPTED = 130  # stopped by Ctrl-C
TERMINATED = 143  # stopped by SIGTERM


def tell(problems: Iterable[str], notes: Iterable[str] = ()) -> None:
    """Notes and problems, a line each, on stderr; where nobody can read it, nothing is lost."""
    with suppress(OSError):
        for note in notes:
            click.echo(f"sonarrec: note: {note}", err=True)
        for problem in problems:
            click.echo(f"sonarrec: {problem}", err=True)


def end(problems: Collection[object]) -> None:
    """End a command that is done: with PARTLY where part of the input could not be used."""
    if problems:
        leave(PARTLY)


@contextmanager
def begun(*places: Path) -> Iterator[None]:
    """Where Ctrl-C stops what is made inside, say what is left of it: the same call refuses it."""
    try:
        yield
    except KeyboardInterrupt as error:
        if left := ", ".join(shown(place) for place in places if place.exists()):
            error.add_note(f"what was made so far is in {left}; remove that to begin anew")
        raise


def leave(code: int) -> NoReturn:
    """End the command with an exit code."""
    click.get_current_context().exit(code)
