"""What every container of messages gives, whatever its format: MCAP, the bags of ROS."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from sonarrec.records import name_as_text


@dataclass(frozen=True, slots=True)
class Message:
    """One message. Times in ns; publish_time is None where the container keeps none.

    data is None where it cannot be read; then `problem` says why. Without a problem it is one of
    many that were lost together, for which the recording's `faults` have one line.
    """

    channel: int
    log_time: int
    publish_time: int | None
    data: memoryview | None
    problem: str | None = None


@dataclass(frozen=True, slots=True)
class Channel:
    """What the messages of one channel are. schema: the message's name, empty without one.
    schema_encoding, definition: as the container holds it ("ros2msg", ...)."""

    topic: str
    schema: str
    schema_encoding: str
    definition: bytes
    message_encoding: str


class Recording(ABC):
    """A container of messages, opened.

    channels: by a number of the container's own. counts: messages of each. profile, library: what
    wrote it, empty where it does not say. span: first and last log time in ns, None without a
    message. chunks: how many, by compression. whole: it was closed by its writer and is not cut.
    faults: a line for each thing that is wrong, complete after a pass over its messages.
    """

    channels: Mapping[int, Channel]
    counts: Mapping[int, int]
    profile: str
    library: str
    span: tuple[int, int] | None
    chunks: Mapping[str, int]

    def __init__(self, path: Path) -> None:
        self.path = path
        self.faults: list[str] = []
        self.whole = True

    @abstractmethod
    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """One pass over the messages of some channels, in the order of log time.

        Raises SonarrecError where nothing more can be read.
        """

    @abstractmethod
    def close(self) -> None:
        """Close what is open."""

    def fault(self, text: str) -> None:
        """Add a line about what is wrong."""
        self.faults.append(f"{name_as_text(self.path.name)}: {text}")

    def up_to_damage(
        self, messages: Iterator[Message], count: int, line: Callable[[Exception], str]
    ) -> Iterator[Message]:
        """Yield the messages that a library reads, up to the damage: whatever it raises.

        Libraries do not list what they raise. count: how many messages there should be. line: makes
        a line of an error.
        """
        messages_read = 0
        try:
            for message in messages:
                messages_read += 1
                yield message
        except Exception as error:
            self.whole = False
            self.fault(
                f"damaged ({line(error)}): {count - messages_read} of {count} frames are lost"
            )
