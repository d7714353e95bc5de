"""What is said when something goes wrong: faults, notes, and names as text."""

from __future__ import annotations

import re
import sys


def printable(text: str) -> str:
    """The text with control characters, and others that a terminal cannot show, as escapes."""
    escaped = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return text if text.isprintable() else "".join(escaped)


class SonarrecError(Exception):
    """A fault in the input or the settings, in one line: what, where, what to do."""

    def __str__(self) -> str:
        # The message may quote the contents of files.
        return "\n".join(map(printable, super().__str__().split("\n")))

    @property
    def line(self) -> str:
        """The first line, without the example of a sonar.toml that may follow."""
        return str(self).partition("\n")[0].removesuffix("; like this:")


class UsageError(SonarrecError):
    """An invalid setting or option (exit code 2, as click's own usage errors)."""


class MissingError(UsageError):
    """An input that is not there."""


def number_of(count: int, noun: str, ending: str = "s") -> str:
    """A count and its noun, such as "1 log" and "2 logs"; ending: of the plural."""
    return f"{count} {noun}{'' if count == 1 else ending}"


def name_as_text(name: object) -> str:
    """A file's name as valid Unicode, for messages and tables.

    Bytes that are no UTF-8 become escapes such as \\xe9.
    """
    return str(name).encode(errors="surrogateescape").decode(errors="backslashreplace")


def name_from_text(text: str) -> str:
    """The file's name from which `name_as_text` made this text."""
    name = re.sub(rb"\\x([89a-f][0-9a-f])", lambda byte: bytes([int(byte[1], 16)]), text.encode())
    return name.decode(sys.getfilesystemencoding(), errors="surrogateescape")


class Diagnostics:
    """What is to be told about one log. Every part tells it; the commands print it.

    notes: what was guessed, assumed or contradicts, a line each. problems: what could not be used
    of the input, a line each (exit code 3). A line that was told before is not told again.
    """

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.problems: list[str] = []

    def note(self, *lines: str) -> None:
        """Tell what the user should know though everything was used."""
        _tell(self.notes, lines)

    def problem(self, *lines: str) -> None:
        """Tell what could not be used."""
        _tell(self.problems, lines)


def _tell(told: list[str], lines: tuple[str, ...]) -> None:
    told.extend(line for line in dict.fromkeys(lines) if line not in told)
