"""An opened log: one pass over its Frames, and what of it could not be used."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

from sonarrec.readers.colour_maps import LUMINANCE
from sonarrec.readers.frame_maker import FrameMaker
from sonarrec.readers.images import MAX_FILE_BYTES, is_image
from sonarrec.readers.raw import RawFrame, RawLog, UnusableError
from sonarrec.records import Clock, Fan, Frame, SonarrecError, name_as_text, number_of
from sonarrec.sonar import Sonar

MAX_PROBLEM_LINES = 20
SETTLING_FRAMES = 3  # the log's size or window is the commonest of these


class Log:
    """A recorded log: one pass of Frames, streamed. Use it as a context manager.

    name: of the folder or file, for the results folder. frame_count: None where unknown. stated:
    the geometry as file and flags state it. unusable: frames so far that could not be used.
    problems: one line for each thing that could not be used (at most MAX_PROBLEM_LINES, then a
    count), complete after the pass. beam_width_deg: as the first frame's message or header states
    it; None where it does not. untimed: whether frames so far were taken as one a second,
    since neither they nor the geometry give their times.
    """

    def __init__(
        self, path: Path, name: str, files: Sequence[Path], stated: Sonar, raw: RawLog, time: Clock
    ) -> None:
        """files: what the log consists of, in order. time: which of its times names a frame."""
        self.path = path
        self.name = name
        self.stated = stated
        self.frame_count = raw.frame_count
        self.unusable = 0
        self.problems: list[str] = []
        self._files = files
        self._raw = raw
        self._time = time
        origin = "headers" if raw.header_info.values else "messages"
        self._make = FrameMaker(stated, name_as_text(path), origin)
        self.beam_width_deg: float | None = None
        self.untimed = False
        self._timed = 0, 0  # number and time of the last frame that carried one
        self._unset = False  # whether header times were asked for and nobody set them

    @property
    def sonar(self) -> Sonar:
        """The geometry in use: for polar messages that of the first ping, once it was read."""
        return self._make.sonar

    @property
    def order_from(self) -> str | None:
        """ "found" or "assumed" for a beam order that nobody stated; else None."""
        return self._make.order_from

    @property
    def fan(self) -> Fan | None:
        """The fan images' geometry, None before the first frame."""
        return self._make.fan

    def reading(self) -> dict[str, Any]:
        """How the log was read, for run.toml: what was chosen, and what the first frame settled."""
        settled: dict[str, Any] = {"time": self._time}
        if self._raw.topic is not None:
            settled["topic"] = self._raw.topic
        if self._raw.polar and self.sonar.beam_order is not None:
            settled["beam_order"] = self.sonar.beam_order
        if self._make.colour_map != LUMINANCE:
            settled["colour_map"] = self._make.colour_map
        scale = self._make.scale
        return settled if scale is None else settled | scale.as_table()

    @property
    def dynamic_range_db(self) -> float | None:
        """Decibels from black to white; None where nothing tells, or before the first frame."""
        # On other scales than linear the reader itself made the grey, by as many dB.
        reading, step = self.reading(), self._raw.header_info.sample_db
        stated: float | None = reading.get("dynamic_range_db", self.sonar.dynamic_range_db)
        if stated is None and step is not None and "full_scale" in reading:
            stated = step * reading["full_scale"]
        return stated

    @property
    def notes(self) -> list[str]:
        """Where the stated geometry contradicts the log, and what was taken or is not certain;
        complete after the pass."""
        notes = list(self._raw.header_info.notes)
        if self._unset:
            notes.append("the header stamps of its first frames are 0; --time log is used instead")
        return [f"{name_as_text(self.path)}: {note}" for note in notes] + self._make.notes

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *_: object) -> None:
        self._raw.close()

    def __iter__(self) -> Iterator[Frame]:
        """All usable frames: see `within`."""
        return self.within((0, None))

    def within(self, span: tuple[int, int | None]) -> Iterator[Frame]:
        """The usable frames in order, from the first number up to, not including, the second, if
        there is one; each keeps its number in the log.

        Where frames carry no time, it is number / frame_rate_hz, or at one a second without; those
        behind one that carries a time are counted on from it. Of the frames before the span the
        log's first usable one is looked at, which settles its geometry and grey scale; the others
        are passed over, whatever is wrong with them.
        Raises SonarrecError where no frame can be used, or where the bearings in the sonar
        geometry do not match the images.
        """
        used = self.unusable = 0
        self._timed = 0, 0
        self.problems.clear()  # of an earlier pass
        frames = _of_one_size(self._raw)
        first = list(islice(frames, SETTLING_FRAMES))
        self._make.settle(first)
        stamped = [raw.stamps.header for raw in first if raw.pixels is not None]
        self._unset = self._time == "header" and bool(stamped) and set(stamped) == {0}
        frames = chain(first, frames)
        del first  # or it would keep its images to the end
        for index, raw in enumerate(frames):
            if span[1] is not None and index >= span[1]:
                return
            if (raw.pixels is None and raw.problem is None) or (used and index < span[0]):
                continue  # not asked for, or reported in the faults with others
            try:
                pixels, fan, polar = self._make(raw)
                stamp = self._time_of(index, raw)
            except UnusableError as error:
                self.unusable += 1
                if self.unusable <= MAX_PROBLEM_LINES:
                    self.problems.append(f"{raw.name}: {error}, skipped")
                continue
            if not used and raw.sonar is not None:
                self.beam_width_deg = raw.sonar.beam_width_deg
            used += 1
            if index < span[0]:
                self._raw.passed_over = range(span[0])
            else:
                yield Frame(index, stamp, pixels, fan, raw.stamps, polar)
        if self.unusable > MAX_PROBLEM_LINES:
            self.problems.append(
                f"{number_of(self.unusable - MAX_PROBLEM_LINES, 'more frame')} skipped"
            )
        self.problems.extend(dict.fromkeys(self._raw.faults))  # some are told in each pass
        if not used:
            reason = f" ({self.problems[0]})" if self.problems else ""
            raise SonarrecError(f"{name_as_text(self.path)}: not one frame could be used{reason}")

    def _time_of(self, index: int, raw: RawFrame) -> int:
        """The time that names a frame, ns. Raises UnusableError where the log has no such time."""
        stamps = raw.stamps
        by_clock = {"log": raw.timestamp_ns, "publish": stamps.publish, "header": stamps.header}
        stamp = by_clock["log" if self._unset else self._time]
        if stamp is None and self._time != "log":
            raise UnusableError(f"without a {self._time} time; --time log needs none")
        if stamp is not None and not -(2**63) <= stamp < 2**63:
            raise UnusableError(f"its {self._time} time of {stamp} ns is beyond every clock")
        if stamp is not None:
            self._timed = index, stamp
            return stamp
        self.untimed = self.sonar.frame_rate_hz is None
        number, time_ns = self._timed
        return time_ns + round((index - number) * 1e9 / (self.sonar.frame_rate_hz or 1.0))

    def digest_source(self) -> tuple[int, str]:
        """(size in bytes, SHA-256 in hex) of the log's file: see `digest_of`."""
        return digest_of(self.path, self._files)


def digest_of(log: Path, files: Sequence[Path]) -> tuple[int, str]:
    """(size in bytes, SHA-256 in hex) of a log's file.

    Of several images, and of the files of a bag, the sum of their sizes and the hash over each
    one's name, a zero byte and its contents, in frame order; of one that cannot be read or is
    too large to be an image the name alone. Raises SonarrecError where the one file of a log
    cannot be read.
    """
    size, digest = 0, hashlib.sha256()
    several = files != [log]
    for path in files:
        if several:
            digest.update(path.name.encode(errors="surrogateescape") + b"\0")
        try:
            if several and is_image(path) and path.stat().st_size > MAX_FILE_BYTES:
                continue
            with path.open("rb") as file:
                while block := file.read(2**20):
                    size += len(block)
                    digest.update(block)
        except OSError as error:
            if several:  # it was told when its frame's turn came
                continue
            raise SonarrecError(
                f"{name_as_text(path)}: cannot be read ({error.strerror})"
            ) from None
    return size, digest.hexdigest()


def _of_one_size(frames: Iterable[RawFrame]) -> Iterator[RawFrame]:
    """The frames, those among the first few that are of an odd size marked as unusable.

    The first frame that is used settles the size of the log: one that a driver sent before it had
    its settings must not cost all the others.
    """
    frames = iter(frames)
    first = list(islice(frames, SETTLING_FRAMES))
    sizes = Counter(size for f in first if (size := _stored_size(f)) is not None)
    for frame in first:
        size = _stored_size(frame)
        if size is None or size == (usual := sizes.most_common(1)[0][0]):
            yield frame
        else:
            problem = f"{size[1]} x {size[0]} pixels in a log of {usual[1]} x {usual[0]}"
            yield replace(frame, pixels=None, problem=problem)
    yield from frames


def _stored_size(frame: RawFrame) -> tuple[int, ...] | None:
    """(rows, columns) of an image that does not tell its geometry."""
    if frame.pixels is None or frame.sonar is not None:
        return None
    return frame.pixels.shape[:2]
