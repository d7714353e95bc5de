"""Reads the folder of a ROS 2 bag as one recording. Messages are numbered through all its parts.

metadata.yaml lists the parts and the numbers of their messages. Without it, the parts are the files
with names as `ros2 bag record` gives them.
"""

from __future__ import annotations

import heapq
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

from sonarrec.errors import Diagnostics, SonarrecError, number_of, printable
from sonarrec.readers.containers.packed import PACKINGS
from sonarrec.readers.containers.recording import Channel, Message, Recording
from sonarrec.tables.order import natural_order

METADATA = "metadata.yaml"
_ENDINGS = tuple(suffix + end for suffix in (".mcap", ".db3") for end in ("", *PACKINGS))
Open = Callable[[Path, Diagnostics], Recording]


def is_bag_folder(folder: Path) -> bool:
    """Whether a folder is a bag: it has the metadata.yaml of a bag, or parts with usual names.
    Usual names are FOLDER_0, FOLDER_1, ... or rosbag2_..._0, ... Raises OSError."""
    if (folder / METADATA).is_file():
        with (folder / METADATA).open("rb") as file:
            if b"rosbag2_bagfile_information" in file.read(2**12):
                return True
    return bool(_parts_by_name(folder))


def are_parts(names: Iterable[str], folder: str) -> bool:
    """Whether all logs among the file names in a folder have the usual names of parts."""
    stems = {match[1] if (match := _numbered(n)) else None for n in names if _is_stored(n)}
    if len(stems) != 1:
        return False
    stem = stems.pop()
    return stem is not None and (stem == folder or stem.startswith("rosbag2_"))


def bag_files(folder: Path) -> list[Path]:
    """The files of a bag, in order: metadata.yaml, and the parts that exist."""
    parts, _ = _listed(folder, Diagnostics(folder))
    return [path for path in (folder / METADATA, *parts) if path.is_file()]


def _stored_parts(folder: Path) -> list[Path]:
    with os.scandir(folder) as entries:  # one by one: a folder of images may hold very many
        parts = [folder / entry.name for entry in entries if _is_stored(entry.name)]
    return sorted(parts, key=natural_order)


def _is_stored(name: str) -> bool:
    return name.lower().endswith(_ENDINGS) and name[0] != "."


def _parts_by_name(folder: Path) -> list[Path]:
    """The parts according to their names; none if a log in the folder has another name."""
    parts = _stored_parts(folder)
    return parts if are_parts((p.name for p in parts), folder.resolve().name) else []


def _numbered(part: str) -> re.Match[str] | None:
    """The stem and the number of a part's usual name."""
    return re.match(r"(.*)_([0-9]{1,9})\.[^_]*$", part)


def _listed(folder: Path, diagnostics: Diagnostics) -> tuple[list[Path], dict[str, Any]]:
    """(parts in order, the table of metadata.yaml)."""
    metadata, problem = _metadata(folder / METADATA)
    names = metadata.get("relative_file_paths")
    if isinstance(names, list) and names:
        # Old bags put the folder in front of the names. Nothing outside of the folder is read. One
        # of aliases within aliases would be a text of gigabytes.
        texts = (PurePosixPath(name).name for name in names if isinstance(name, str))
        there = {entry.name for entry in folder.iterdir()}
        parts = list(dict.fromkeys(folder / _as_stored(name or "unnamed", there) for name in texts))
        listed = set(parts)
        stems = {match[1] for p in parts if (match := _numbered(p.name))}
        for part in _stored_parts(folder):
            match = _numbered(part.name)
            if part not in listed and match is not None and match[1] in stems:
                diagnostics.fault(f"{METADATA} does not list it, so it is not read", part.name)
        return parts, metadata
    parts = _parts_by_name(folder) or _stored_parts(folder)
    if problem is not None:
        diagnostics.fault(f"{problem}; the parts are read by their names", METADATA)
    numbers = [int(match[2]) for p in parts if (match := _numbered(p.name))]
    for before, after in pairwise([-1, *numbers] if len(numbers) == len(parts) else []):
        if after > before + 1:
            which = f"{before + 1}" + f" to {after - 1}" * (after > before + 2)
            diagnostics.fault(
                f"part {which} is missing; the numbers of the frames after it are too low",
                folder.name,
            )
    return parts, {}


def _as_stored(name: str, there: set[str]) -> str:
    """The name of a part as it exists, compressed or not, whatever metadata.yaml says. there: all
    names in the folder."""
    plain = next((name.removesuffix(end) for end in PACKINGS if name.endswith(end)), name)
    return next((n for n in (name, *(name + end for end in PACKINGS), plain) if n in there), name)


def _metadata(file: Path) -> tuple[dict[str, Any], str | None]:
    """(table of the bag in metadata.yaml, what is wrong with the file). The table is empty if there
    is no such file or it cannot be used."""
    if not file.is_file():
        return {}, None
    try:
        return _parsed(file.read_bytes())
    except OSError as error:
        return {}, f"cannot be read ({error.strerror})"


@lru_cache(maxsize=1)  # each bag needs it several times
def _parsed(data: bytes) -> tuple[dict[str, Any], str | None]:
    """As `_metadata`, from the file's bytes."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        metadata = YAML(typ="safe", pure=True).load(data.decode("utf-8"))
    except (YAMLError, ValueError, TypeError, RecursionError):
        return {}, "cannot be read as YAML"
    table = metadata.get("rosbag2_bagfile_information") if isinstance(metadata, dict) else None
    return (table, None) if isinstance(table, dict) else ({}, "describes no bag")


@dataclass(slots=True)
class _Part:
    """One file of a bag.

    numbers: from the file's channel numbers to those of the bag. start: first log time, ns. sound:
    whole and without faults. read: first and last log time of what a pass has read, ns; None if
    nothing.
    """

    path: Path
    numbers: dict[int, int] = field(default_factory=dict)
    start: int = 0
    sound: bool = False
    read: tuple[int, int] | None = None


class BagFolder(Recording):
    """A `Recording` of all parts of a bag.

    One part is open at a time; several only if they overlap in time. If a part is cut, damaged or
    missing, only its own messages are lost.
    """

    def __init__(self, path: Path, open_part: Open, diagnostics: Diagnostics) -> None:
        """open_part: opens one file. Raises SonarrecError if no part can be read."""
        super().__init__(path, diagnostics)
        self._open = open_part
        self.profile = "ros2"
        files, metadata = _listed(path, self.diagnostics)
        self._parts = [_Part(file) for file in files]
        for part in self._parts:
            if part.path.is_file():
                self._look_into(part)
            else:
                self.diagnostics.fault("this part of the bag is missing", part.path.name)
        if not any(part.numbers for part in self._parts):
            faults = self.diagnostics.faults
            reason = f" ({faults[0]})" if faults else ""
            raise SonarrecError(f"{path}: no part of this bag can be read{reason}")
        self.whole = all(part.sound for part in self._parts)
        self._tell_lost(metadata)

    def _look_into(self, part: _Part) -> None:
        """Open a part and register its channels, counts, times and faults."""
        known = len(self.diagnostics.faults)
        try:
            log = self._open(part.path, self.diagnostics)
        except (SonarrecError, OSError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            text = str(reason).removeprefix(f"{printable(part.path)}: ").partition("\n")[0]
            self.diagnostics.fault(text, part.path.name)
            return
        log.close()
        for number, channel in log.channels.items():
            part.numbers[number] = self._number_of(channel)
            self.counts[part.numbers[number]] += log.counts.get(number, 0)
        self.chunks.update(log.chunks)
        self.library = self.library or log.library
        part.sound = log.whole and len(self.diagnostics.faults) == known
        if log.span is not None:
            part.start, end = log.span
            first, last = self.span or log.span
            self.span = min(first, part.start), max(last, end)

    def _number_of(self, channel: Channel) -> int:
        """The bag's number for a channel of a part; a new number for a new channel. A part may lack
        the definition of a channel that other parts have."""
        for number, other in self.channels.items():
            alike = [(c.topic, c.schema, c.message_encoding) for c in (channel, other)]
            if alike[0] == alike[1] and (
                not other.definition or not channel.definition or channel == other
            ):
                self.channels[number] = channel if channel.definition else other
                return number
        self.channels[len(self.channels)] = channel
        return len(self.channels) - 1

    def _tell_lost(self, metadata: dict[str, Any]) -> None:
        """Tell of which channels the parts hold fewer messages than metadata.yaml counts."""
        stated: Counter[object] = Counter()
        rows = metadata.get("topics_with_message_count")
        for row in rows if isinstance(rows, list) else []:
            if isinstance(row, dict) and isinstance(row.get("topic_metadata"), dict):
                name, count = row["topic_metadata"].get("name"), row.get("message_count")
                stated[str(name)] += count if isinstance(count, int) else 0
        held: Counter[object] = Counter()
        for number, channel in self.channels.items():
            held[channel.topic] += self.counts[number]
        for topic, count in held.items():
            if stated[topic] > count:
                told = number_of(stated[topic], "message")
                self.fault(
                    f"{METADATA} counts {told} of {topic}, the parts hold {count}; the numbers of "
                    "frames after lost ones are too low"
                )

    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """The messages of some channels in log-time order; those of equal time by their parts."""
        order = sorted(range(len(self._parts)), key=lambda i: (self._parts[i].start, i))
        runs: list[tuple[int, int, Message, Iterator[Message]]] = []

        def advanced(index: int, run: Iterator[Message]) -> None:
            if (message := next(run, None)) is not None:
                heapq.heappush(runs, (message.log_time, index, message, run))

        for index, time_ns in zip(
            [*order, None], [*(self._parts[i].start for i in order), math.inf], strict=True
        ):
            while runs and runs[0][0] < time_ns:
                _, first, message, run = heapq.heappop(runs)
                yield message
                advanced(first, run)
            if index is not None:
                advanced(index, self._messages_of(self._parts[index], channels))
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
