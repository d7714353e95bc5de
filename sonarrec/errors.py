"""What is said when something goes wrong: faults, notes, and names as text."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import NamedTuple, TypeVar

AnyPath = TypeVar("AnyPath")
MOST_NAMES = 10_000  # of a folder, among which a similar one is looked for
LEAST_SIMILARITY = 0.7  # of difflib's ratio

QUOTES = "\u201c\u201d\u201e\u2018\u2019\u201a\xab\xbb"  # of word processors


def printable(text: object) -> str:
    """The text as every terminal and UTF-8 file can hold it, where text leaves the program.

    Control characters, and bytes of names that are no UTF-8, become escapes such as \\xe9; secrets
    of URLs are left out.
    """
    safe = redact_urls(name_as_text(text))
    if safe.isprintable():
        return safe
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in safe)


class SonarrecError(Exception):
    """A fault in the input or the settings, in one line: what, where, what to do."""

    def __str__(self) -> str:
        # The message may quote the contents of files.
        return printable(super().__str__())


class UsageError(SonarrecError):
    """An invalid setting or option (exit code 2, as click's own usage errors)."""


class MissingError(UsageError):
    """An input that is not there."""


def similar_name(path: Path) -> str:
    """What may have been meant by a path that is not there, as the end of a message; or empty."""
    from difflib import get_close_matches  # only where something is wrong

    if meant := foreign_path(str(path)):
        return meant
    while not path.parent.exists() and path.parent != path:
        path = path.parent
    try:
        names = [entry.name for entry in islice(os.scandir(path.parent), MOST_NAMES)]
    except OSError:
        return ""
    if spaced := [name for name in names if path.name in name.split()]:
        return f"; a name with spaces needs quotes: {shlex.quote(str(path.parent / spaced[0]))}"
    known = {Path(name).stem.casefold(): name for name in names}
    known |= {name.casefold(): name for name in names}
    near = get_close_matches(path.name.casefold(), known, 1, LEAST_SIMILARITY)
    return f"; did you mean {path.parent / known[near[0]]}?" if near else ""


# TOML reads \n of logs\new as the end of a line.
_AS_SLASHES = str.maketrans({"\\": "/", "\n": "/n", "\t": "/t", "\r": "/r", "\b": "/b", "\f": "/f"})


def foreign_path(text: str) -> str:
    """What is meant by a path of Windows, or by ~ in quotes, as the end of a message; or empty."""
    home, plain = os.path.expanduser(text), text.translate(_AS_SLASHES)  # noqa: PTH111
    mounted = re.sub("^([A-Za-z]):", lambda drive: f"/mnt/{drive[1].lower()}", plain)
    meant = [name for name in (home, plain, mounted) if name != text and os.path.lexists(name)]
    if os.sep != "/" or not (meant or home != text or "\\" in text):
        return ""
    why = "in quotes ~ is not your home" if home != text else "folders are parted by /, not by \\"
    return f"; {why}{f': did you mean {meant[0]}?' if meant else ''}"


def plain_number(text: object) -> str:
    """How a text is written as a number, as the end of a message; empty: it is none."""
    number = re.fullmatch(r"\s*([-+]?(?:[0-9]+(?:[.,][0-9]*)?|[.,][0-9]+))\s*(\S*)\s*", str(text))
    if not number:
        return ""
    if number[2]:
        return "; write the number alone, in the unit that is asked for"
    return f"; write {number[1].replace(',', '.')}"


@contextmanager
def as_usage() -> Iterator[None]:
    """Raise faults as UsageErrors: around the reading of any TOML that a user writes, and of
    options, so that a typo has the same exit code wherever it is."""
    try:
        yield
    except UsageError:
        raise
    except SonarrecError as error:
        raise UsageError(*error.args) from None


def number_of(count: int, noun: str, ending: str = "s") -> str:
    """A count and its noun, such as "1 log" and "2 logs"; ending: of the plural."""
    return f"{count} {noun}{'' if count == 1 else ending}"


def listed(names: Sequence[object], most: int) -> str:
    """The first so many names, and whether there are more."""
    return ", ".join(map(str, names[:most])) + (", ..." if len(names) > most else "")


def command_line(*words: object) -> str:
    """A command as messages name it, such as "`sonarrec run 'my dive.mcap'`": it can be pasted.

    words: after `sonarrec`; files as Path, so that no name is taken for an option.
    """
    texts = (
        f"./{word}" if isinstance(word, Path) and str(word)[0] == "-" else word for word in words
    )
    return f"`sonarrec {shlex.join(map(str, texts))}`"


def name_as_text(name: object) -> str:
    """A file's name as valid Unicode, as tables hold it; messages need no call, see `printable`.

    Bytes that are no UTF-8 become escapes such as \\xe9.
    """
    return str(name).encode(errors="surrogateescape").decode(errors="backslashreplace")


def name_from_text(text: str) -> str:
    """The file's name from which `name_as_text` made this text."""
    name = re.sub(rb"\\x([89a-f][0-9a-f])", lambda byte: bytes([int(byte[1], 16)]), text.encode())
    return name.decode(sys.getfilesystemencoding(), errors="surrogateescape")


# A scheme has a limit, and a tail is never tried twice: else a long word takes its length squared.
_SCHEME = r"[A-Za-z][A-Za-z0-9+.-]{1,30}:/{1,2}"  # a Path keeps one slash only
_URL = re.compile(rf"{_SCHEME}(?=[^/])")
# A password may hold any sign, if what is behind the colon is no port.
_USER = (
    r"(?:[^\s/:@]*:(?!\d*(?:[/?#;]|$))(?:(?!:/)[^\n])*@"
    r"|[^\s/:@]*:(?:(?!:/)[^?#;\n])*@|[^\s/?#]*@)?"
)
_URL_PARTS = re.compile(rf"({_SCHEME}){_USER}([^?;#]*).*", re.DOTALL)
_IN_TEXT = re.compile(
    rf"({_SCHEME}){_USER}([^\s?;#'\"]*)(?:[?;#](?:[:'\",;)\]]*+[^\s:'\",;)\]])*+)?"
)


def is_url(text: object) -> bool:
    """Whether a text is a URL, also one that has been a Path."""
    return _URL.match(str(text)) is not None


def redact_url(url: object) -> str:
    """Scheme, host and path of a URL, without user, password, parameters, query and fragment."""
    return _URL_PARTS.sub(r"\1\2", str(url))


def redact_urls(text: object, known: Iterable[str] = ()) -> str:
    """A text with each URL in it as `redact_url` has it, for every output.

    known: URLs that may be in it, since where one ends in a text is a guess.
    """
    for url in known:
        text = str(text).replace(url, redact_url(url))
    return _IN_TEXT.sub(r"\1\2", str(text))


def refuse_url(path: AnyPath) -> AnyPath:
    """The path as it is. Raises UsageError if it is a URL: only `run` can use one."""
    if is_url(path):
        raise UsageError(
            f"{redact_url(path)}: URLs are for the logs and results of `run`; copy it here, or "
            "mount the server: sonarrec help run"
        )
    return path


MAX_PROBLEM_LINES = 20
"""The most lines on frames that could not be used; then a count."""


MOST_FRAMES = 5
"""The most frames skipped for one reason with a line of their own; else one line for all."""
MOST_OF_A_KIND = 3
"""The most faults, equal but for numbers, with a line of their own; then a count."""


class Advice(NamedTuple):
    """A line on what may be wrong: what is so, why, and what to do."""

    text: str
    grave: bool = False
    """Whether it is a problem, so that the exit code is 3; else it is a note."""


class Diagnostics:
    """Notes and faults of one log. Every part of the program adds to them; the commands print them.

    notes: a line on each value that was guessed, assumed or contradicts another. unusable: how many
    frames of this pass could not be used. A line that is there already is not added again, so a
    further pass over the log gives the same lines.
    """

    def __init__(self, log: object = None) -> None:
        """log: its path, with which notes begin; None: each note names what it is about."""
        self.notes: list[str] = []
        self._faults: dict[str, dict[str, None]] = {}  # the lines of each kind
        self.unusable = 0
        self._log = log
        # Of this pass, by the reason: the first frames, and how many.
        self._skipped: dict[str, list[str]] = {}
        self._skipped_for = Counter[str]()
        self._is_at_end = False  # whether this pass reached the end, so that faults are complete
        self._others: list[str] = []

    def note(self, *lines: str, about: object = None) -> None:
        """Add what the user should know though everything was used. about: if not the log."""
        about = self._log if about is None else about
        _add(self.notes, [line if about is None else f"{about}: {line}" for line in lines])

    def fault(self, text: str, file: object) -> None:
        """Add what is wrong with a file of the log as a whole. file: its name."""
        line = printable(f"{file}: {text}")
        self._faults.setdefault(re.sub("[0-9]+", "", line), {})[line] = None

    def problem(self, *lines: str) -> None:
        """Add what else could not be used."""
        _add(self._others, lines)

    def advise(self, lines: Iterable[Advice]) -> None:
        """Add lines of advice, each by how grave it is."""
        for line in lines:
            (self.problem if line.grave else self.note)(line.text)

    def skip(self, frame: str, why: object) -> None:
        """Add a frame that could not be used, and why."""
        self.unusable += 1
        reason = printable(why)
        if reason not in self._skipped and len(self._skipped) == MAX_PROBLEM_LINES:
            return
        self._skipped_for[reason] += 1
        if self._skipped_for[reason] <= MOST_FRAMES:
            self._skipped.setdefault(reason, []).append(printable(frame))

    def begin_pass(self) -> None:
        """Drop the frames of an earlier pass."""
        self.unusable, self._is_at_end = 0, False
        self._skipped.clear()
        self._skipped_for.clear()

    def end_pass(self) -> None:
        """All frames were read, to the end of the log."""
        self._is_at_end = True

    @property
    def faults(self) -> list[str]:
        """What is wrong with the log as a whole: of one kind MOST_OF_A_KIND lines, then a count."""
        lines = list[str]()
        for of_kind in self._faults.values():
            first, *others = [*of_kind]
            lines += [first, *others[: MOST_OF_A_KIND - 1]]
            if (more := len(of_kind) - MOST_OF_A_KIND) > 0:
                lines.append(f"{first.partition(': ')[0]}: {more} more of this kind")
        return lines

    @property
    def skipped(self) -> list[str]:
        """A line for each frame that could not be used, one for all of a reason if many have it;
        of many reasons the first ones, then a count."""
        lines, frames = list[str](), 0
        for why, (first, *others) in self._skipped.items():
            count, names = self._skipped_for[why], [first, *others]
            if count > MOST_FRAMES:
                names, each = [f"{first} and {count - 1} more frames"], count
            else:
                each = 1
            names = names[: MAX_PROBLEM_LINES - len(lines)]
            lines += [f"{name}: {why}, skipped" for name in names]
            frames += each * len(names)
        more = self.unusable - frames
        return [*lines, *([f"{number_of(more, 'more frame')} skipped"] if more > 0 else [])]

    @property
    def problems(self) -> list[str]:
        """All that could not be used (exit code 3); complete after a pass over the log."""
        return [*self.skipped, *(self.faults if self._is_at_end else []), *self._others]


def _add(known: list[str], lines: Iterable[str]) -> None:
    known += [line for line in dict.fromkeys(map(printable, lines)) if line not in known]
