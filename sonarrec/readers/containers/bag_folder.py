"""Reads the folder of a ROS 2 bag: its parts one after the other, by the readers of one file.

metadata.yaml lists the parts. Without it they are the files with names as `ros2 bag record` gives
them: FOLDER_0, FOLDER_1, ... or rosbag2_..._0, ...
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from sonarrec.errors import Diagnostics, SonarrecError, number_of, printable
from sonarrec.readers.containers.recording import Channel, Message, Recording
from sonarrec.tables.order import natural_order

METADATA = "metadata.yaml"
MOST_NAMED = 3  # parts named in a message
Open = Callable[[Path, Diagnostics], Recording]


def is_bag_folder(folder: Path) -> bool:
    """Whether a folder is a bag: it has the metadata.yaml of a bag, or only parts with usual names.
    Raises OSError."""
    if (folder / METADATA).is_file():
        with (folder / METADATA).open("rb") as file:
            if b"rosbag2_bagfile_information" in file.read(2**12):
                return True
    stems = {match[1] if (match := _numbered(p)) else "" for p in _stored(folder)}
    stem = stems.pop() if len(stems) == 1 else ""
    return bool(stem) and (stem == folder.resolve().name or stem.startswith("rosbag2_"))


def bag_files(folder: Path) -> list[Path]:
    """The files of a bag, in order: metadata.yaml, and the parts that exist."""
    parts = (_listed(folder, Diagnostics(folder)) or []) + _stored(folder)
    return [path for path in dict.fromkeys((folder / METADATA, *parts)) if path.is_file()]


def _stored(folder: Path) -> list[Path]:
    with os.scandir(folder) as entries:  # one by one: a folder of images may hold very many
        names = [e.name for e in entries if e.name.endswith((".mcap", ".db3")) and e.name[0] != "."]
    return sorted((folder / name for name in names), key=natural_order)


def _numbered(part: Path) -> re.Match[str] | None:
    """The stem and the number of a part's usual name."""
    return re.fullmatch(r"(.*)_([0-9]{1,9})", part.stem)


def _listed(folder: Path, diagnostics: Diagnostics) -> list[Path] | None:
    """The parts that metadata.yaml lists; None if it lists none."""
    from ruamel.yaml import YAML

    file = folder / METADATA
    if not file.is_file():
        return None
    try:
        table = YAML(typ="safe", pure=True).load(file.read_bytes().decode("utf-8"))
        names = table["rosbag2_bagfile_information"]["relative_file_paths"]
        # Old bags put the folder in front of the names. Nothing outside of the folder is read.
        return [folder / (PurePosixPath(str(name)).name or "unnamed") for name in names] or None
    except Exception:  # the library raises errors of many classes
        diagnostics.fault("lists no parts; they are read by their names", METADATA)
        return None


@dataclass(slots=True)
class _Part:
    """One file of a bag.

    numbers: from the file's channel numbers to those of the bag. read: first and last log time of
    what a pass has read, ns; None if nothing.
    """

    path: Path
    numbers: dict[int, int] = field(default_factory=dict)
    read: tuple[int, int] | None = None


class BagFolder(Recording):
    """A `Recording` of all parts of a bag, of which one is open at a time.

    If a part is cut, damaged or missing, only its own messages are lost.
    """

    def __init__(self, path: Path, open_part: Open, diagnostics: Diagnostics) -> None:
        """open_part: opens one file. Raises SonarrecError if no part can be read."""
        super().__init__(path, diagnostics)
        self._open, self.profile, self.whole = open_part, "ros2", True
        stored = _stored(path)
        listed = _listed(path, diagnostics)
        missing = [p.name for p in listed or () if p not in stored]
        if listed is None:
            numbers = {int(match[2]) for p in stored if (match := _numbered(p))}
            missing = [f"part {n}" for n in range(max(numbers, default=-1)) if n not in numbers]
        self._tell(missing, "missing; frames after it have lower numbers than they had")
        unlisted = [p.name for p in stored if listed is not None and p not in listed]
        self._tell(unlisted, f"not listed in {METADATA}, and not read")
        self._parts = [_Part(file) for file in listed or stored if file in stored]
        for part in self._parts:
            self._look_into(part)
        if not any(part.numbers for part in self._parts):
            faults = self.diagnostics.faults
            reason = f" ({faults[0]})" if faults else ""
            raise SonarrecError(f"{path}: no part of this bag can be read{reason}")

    def _tell(self, names: list[str], what: str) -> None:
        """Tell what is wrong with some parts."""
        if names:
            self.whole = False
            few = ", ".join(names[:MOST_NAMED]) + ", ..." * (len(names) > MOST_NAMED)
            self.fault(f"{number_of(len(names), 'part')} of the bag {what}: {few}")

    def _look_into(self, part: _Part) -> None:
        """Open a part and register its channels, counts, times and faults."""
        known = len(self.diagnostics.faults)
        try:
            log = self._open(part.path, self.diagnostics)
        except (SonarrecError, OSError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            text = str(reason).removeprefix(f"{printable(part.path)}: ").partition("\n")[0]
            self.diagnostics.fault(text, part.path.name)
            self.whole = False
            return
        log.close()
        for number, channel in log.channels.items():
            part.numbers[number] = self._number_of(channel)
            self.counts[part.numbers[number]] += log.counts.get(number, 0)
        self.chunks.update(log.chunks)
        self.library = self.library or log.library
        self.whole &= log.whole and len(self.diagnostics.faults) == known
        if log.span is not None:
            first, last = self.span or log.span
            self.span = min(first, log.span[0]), max(last, log.span[1])

    def _number_of(self, channel: Channel) -> int:
        """The bag's number for a channel of a part; a new number for a new channel. A part may lack
        the definition of a channel that other parts have."""
        for number, other in self.channels.items():
            one, two = ((c.topic, c.schema, c.message_encoding) for c in (channel, other))
            if one == two and (not other.definition or not channel.definition or channel == other):
                self.channels[number] = channel if channel.definition else other
                return number
        self.channels[len(self.channels)] = channel
        return len(self.channels) - 1

    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """The messages of some channels, part by part, each in log-time order."""
        for part in self._parts:
            yield from self._messages_of(part, channels)
        self.note_set_back(part.read for part in self._parts if part.read is not None)

    def _messages_of(self, part: _Part, channels: Collection[int]) -> Iterator[Message]:
        numbers = {own: number for own, number in part.numbers.items() if number in channels}
        if not numbers:
            return
        try:
            log = self._open(part.path, self.diagnostics)
        except (SonarrecError, OSError):  # it was there before
            self.diagnostics.fault("cannot be read any more", part.path.name)
            return
        try:
            for message in log.messages(numbers):
                first, last = part.read or (message.log_time, message.log_time)
                part.read = first, max(last, message.log_time)
                yield replace(message, channel=numbers[message.channel])
        except SonarrecError as error:
            self.diagnostics.fault(str(error).removeprefix(f"{printable(part.path)}: "), part.path)
        finally:
            log.close()

    def close(self) -> None:
        """Does nothing, because parts are closed when they have been read."""
