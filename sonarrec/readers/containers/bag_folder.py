"""Reads the folder of a ROS 2 bag: its parts one after the other, by the readers of one file.

metadata.yaml lists the parts. Without it they are the files with names as `ros2 bag record` gives
them: FOLDER_0, FOLDER_1, ... or rosbag2_..._0, ...
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

from sonarrec.errors import Diagnostics, SonarrecError, listed, number_of, printable
from sonarrec.readers.raw import Channel, Message, Recording
from sonarrec.tables import natural_order

METADATA = "metadata.yaml"
MOST_NAMED = 3  # parts named in a message
Open = Callable[[Path, Diagnostics], Recording]


def is_bag_folder(folder: Path) -> bool:
    """Whether a folder is a bag: it has the metadata.yaml of a bag, or only parts with usual names.
    Raises OSError."""
    if (folder / METADATA).is_file():
        with (folder / METADATA).open("rb") as file:
            head = file.read(2**12)
        is_lost = re.search(rb"^\w", head, re.MULTILINE) is None  # empty, or {}
        if b"rosbag2_bagfile_information" in head or (is_lost and _stored(folder)):
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


class BagFolder(Recording):
    """A `Recording` of all parts of a bag, of which one is open at a time. If a part is cut,
    damaged or missing, only its own messages are lost."""

    def __init__(self, path: Path, open_part: Open, diagnostics: Diagnostics) -> None:
        """open_part: opens one file. Raises SonarrecError if no part can be read."""
        super().__init__(path, diagnostics, "ros2")
        self._open = open_part
        stored, listed = _stored(path), _listed(path, diagnostics)
        if listed is None:
            numbers = {int(match[2]) for p in stored if (match := _numbered(p))}
            missing = [f"part {n}" for n in range(max(numbers, default=-1)) if n not in numbers]
            unlisted = []
        else:
            missing = [p.name for p in listed if p not in stored]
            unlisted = [p.name for p in stored if p not in listed]
        self._report_parts(missing, "missing; frames after it have lower numbers than they had")
        self._report_parts(unlisted, f"not listed in {METADATA}, and not read")
        # Each part, and from its channel numbers to those of the bag.
        self._parts: dict[Path, dict[int, int]] = {}
        for part in listed or stored:
            if part in stored:
                self._register(part)
        if not any(self._parts.values()):
            faults = diagnostics.faults
            reason = f" ({faults[0]})" if faults else ""
            raise SonarrecError(f"{path}: no part of this bag can be read{reason}")

    def _report_parts(self, names: list[str], what: str) -> None:
        """Tell what is wrong with some parts."""
        if names:
            self.complete = False
            parts = number_of(len(names), "part")
            self.fault(f"{parts} of the bag {what}: {listed(names, MOST_NAMED)}")

    def _register(self, part: Path) -> None:
        """Open a part and register its channels, counts, times and faults."""
        known = self.diagnostics.faults
        try:
            log = self._open(part, self.diagnostics)
        except SonarrecError as error:
            text = str(error).removeprefix(f"{printable(part)}: ").partition("\n")[0]
            self.diagnostics.fault(text, part.name)
            self.complete = False
            return
        log.close()
        self._parts[part] = numbers = {n: self._number_of(c) for n, c in log.channels.items()}
        for own, number in numbers.items():
            self.counts[number] += log.counts.get(own, 0)
        self.chunks.update(log.chunks)
        self.library = self.library or log.library
        self.complete &= log.complete and self.diagnostics.faults == known
        if log.span is not None:
            first, last = self.span or log.span
            self.span = min(first, log.span[0]), max(last, log.span[1])

    def _number_of(self, channel: Channel) -> int:
        """The bag's number for a channel of a part; a new number for a new channel. A part may lack
        the definition of a channel that other parts have."""
        for number, other in self.channels.items():
            new, old = ((c.topic, c.schema, c.message_encoding) for c in (channel, other))
            if new == old and (not other.definition or not channel.definition or channel == other):
                self.channels[number] = channel if channel.definition else other
                return number
        self.channels[len(self.channels)] = channel
        return len(self.channels) - 1

    def messages(self, channels: Collection[int]) -> Iterator[Message]:
        """The messages of some channels, part by part, each in log-time order."""
        spans = []
        for part, numbers in self._parts.items():
            chosen = {own: number for own, number in numbers.items() if number in channels}
            if not chosen:
                continue
            first = last = None
            try:
                log = self._open(part, self.diagnostics)
                try:
                    for message in log.messages(chosen):
                        first = message.log_time if first is None else first
                        last = max(last or 0, message.log_time)
                        yield replace(message, channel=chosen[message.channel])
                finally:
                    log.close()
            except SonarrecError as error:
                self.diagnostics.fault(str(error).removeprefix(f"{printable(part)}: "), part.name)
            if first is not None and last is not None:
                spans.append((first, last))
        self.note_set_back(spans)
