"""What all containers of messages (MCAP files and ROS bags) have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from sonarrec.errors import Diagnostics

CLEARLY_BACK_NS = 10**9
"""Threads of a recorder may swap messages, but not those so far apart."""


@dataclass(frozen=True, slots=True)
class Message:
    """One message. Times in ns; publish_time is None if the container does not store it.

    data is None if it cannot be read; then `problem` says why. If `problem` is None too, it was
    lost together with others, which the recording's faults report in one line.
    """

    channel: int
    log_time: int
    publish_time: int | None
    data: memoryview | None
    problem: str | None = None


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel, and the type of its messages.

    schema: name of the type; empty if there is none. schema_encoding, definition: as stored in the
    container ("ros2msg", ...).
    """

    topic: str
    schema: str
    schema_encoding: str
    definition: bytes
    message_encoding: str


class Recording(ABC):
    """An open container of messages.

    channels: by the container's own numbers. counts: number of messages of each. profile, library:
    what wrote it; empty if not stated. span: first and last log time in ns; None without messages.
    chunks: number of chunks by compression. whole: whether its writer closed it and it is not cut.
    diagnostics: is told what is wrong or uncertain, all of it by the end of a pass.
    """

    def __init__(self, path: Path, diagnostics: Diagnostics) -> None:
        self.path = path
        self.diagnostics = diagnostics
        self.channels = dict[int, Channel]()
        self.counts, self.chunks = Counter[int](), Counter[str]()
        self.profile = self.library = ""
        self.span: tuple[int, int] | None = None
        self.whole = True

    @abstractmethod
    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """One pass over the messages of some channels, in the order of log time. Raises
        SonarrecError if nothing more can be read."""

    @abstractmethod
    def close(self) -> None:
        """Close the files that are open."""

    def fault(self, text: str) -> None:
        """Tell what is wrong."""
        self.diagnostics.fault(text, self.path.name)

    def note_set_back(self, spans: Iterable[tuple[int, int]], within_ns: int = 0) -> None:
        """Tell if the clock was clearly set back during the recording. spans: first and last log
        time, ns, of its parts, in the order of recording. within_ns: by how much times go back
        within a part."""
        latest, back_ns = 0, within_ns
        for first, last in spans:
            back_ns = max(back_ns, latest - first)
            latest = max(latest, last)
        if back_ns > CLEARLY_BACK_NS:
            self.diagnostics.note(
                f"log times go back by {back_ns / 1e9:.1f} s (was the clock set?); frames come in "
                "the order of log time, so those recorded before and after that may be mixed",
                about=self.path,
            )
