"""An opened log: yields its Frames, and collects what could not be used."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Container, Iterator
from dataclasses import replace
from itertools import chain, islice
from typing import Any, NamedTuple

from sonarrec.errors import SonarrecError, number_of
from sonarrec.readers.decode.layout import Stated
from sonarrec.readers.decode.reading import apply, settle
from sonarrec.readers.open import Source
from sonarrec.readers.raw import RawLog, StoredFrame, UnusableError
from sonarrec.sonar.frame import Clock, Fan, Frame, Stamps
from sonarrec.sonar.stated import Sonar
from sonarrec.stretches import CLEARLY_BACK_NS, Breaks

MOST_HZ = 200.0  # no imaging sonar is faster
FIRST_FRAMES = 5  # so many are kept, to compare the stated geometry with
SETTLING_FRAMES = 3  # the commonest size or window of these is that of the log
# The three are looked for among so many frames and bytes: the frames of a whole chunk may be lost,
# and a sonar may send blank ones until it has its settings.
SETTLING_WITHIN, SETTLING_BYTES = 1000, 2**26
Size = tuple[int, ...] | None


class Log:
    """A recorded log, whose Frames are streamed; each pass gives the same. A context manager.

    name: of its results folder. frame_count: None if unknown. stated: the geometry that file and
    flags state. header: the same of a sonar's own file. diagnostics: faults and notes on the
    log, complete after the pass. beam_width_deg: as stated, else as the first frame's message or
    header has it; None if neither does. untimed: whether 1 Hz was assumed so far, because neither
    frames nor geometry state times.
    """

    def __init__(
        self,
        source: Source,
        stated: Sonar,
        raw: RawLog,
        time: Clock,
        observe: Callable[[StoredFrame], None] | None = None,
    ) -> None:
        """raw: the source, opened. time: which of its times names a frame. observe: called with
        each frame as the log holds it."""
        self.path, self.name, self.stated = source.path, source.name, stated
        self.header, self.frame_count = raw.header_info.sonar, raw.frame_count
        self.diagnostics = raw.diagnostics
        self._source, self._raw, self._time, self._observe = source, raw, time, observe
        origin = "headers" if raw.header_info.values else "messages"
        about = Stated(stated, str(source.path), origin, raw.diagnostics.note)
        self._reading = settle(about, ())
        self.beam_width_deg = stated.beam_width_deg
        self.untimed = False
        self._last_timed = 0, 0  # number and time of the last frame that carried one
        self._header_unset = False  # whether header times were asked for and nobody set them
        hz, playback_hz = stated.frame_rate_hz, raw.playback_hz
        if hz and playback_hz and abs(hz / playback_hz - 1) > 0.05:
            self.diagnostics.note(
                f"frame_rate_hz = {hz:g} is not used, since the video has times, of "
                f"{playback_hz:g} frames per second; if it was recorded at another rate, export "
                "images"
            )

    @property
    def sonar(self) -> Sonar:
        """The geometry in use; for polar messages that of the first ping, once it was read."""
        return self._reading.sonar

    @property
    def order_from(self) -> str | None:
        """ "found" or "assumed" for a beam order that nobody stated; else None."""
        return None if self._reading.layout is None else self._reading.layout.order_from

    @property
    def fan(self) -> Fan | None:
        """The geometry of the fan images; None before the first frame."""
        return self._reading.fan

    def reading(self) -> dict[str, Any]:
        """How the log was read, for run.toml: the choices, and what the first frame decided."""
        table: dict[str, Any] = {"time": self._time}
        if self._raw.topic is not None:
            table["topic"] = self._raw.topic
        if self._raw.polar and self.sonar.beam_order is not None:
            table["beam_order"] = self.sonar.beam_order
        return table | self._reading.as_table()

    @property
    def dynamic_range_db(self) -> float | None:
        """Decibels from black to white; None if unknown, or before the first frame."""
        # With other scales than linear, the reader itself made the grey levels with this many dB.
        reading, step = self.reading(), self._raw.header_info.sample_db
        stated: float | None = reading.get("dynamic_range_db", self.sonar.dynamic_range_db)
        if stated is None and step is not None and "full_scale" in reading:
            stated = step * reading["full_scale"]
        return stated

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *_: object) -> None:
        self._raw.close()

    def __iter__(self) -> Iterator[Frame]:
        """All usable frames: see `within`."""
        return self.within((0, None))

    def within(
        self, span: tuple[int, int | None], passed_over: Container[int] = ()
    ) -> Iterator[Frame]:
        """The usable frames of a span, in order. Each keeps its number in the log.

        span: (first number, one past the last; None: to the end). A frame without a time gets it
        from the last frame that has one and from frame_rate_hz (1 Hz if not stated). The log's
        first usable frame is always read, because it decides geometry and grey scale; other frames
        before the span are skipped, even if they are damaged. passed_over: numbers of others that
        are skipped; it may change during the pass.
        Raises SonarrecError if no frame can be used, or if the bearings in the sonar geometry do
        not match the images.
        """
        self.diagnostics.begin_pass()
        self._raw.passed_over = range(0)  # an earlier pass may have set it
        numbered = enumerate(self._stored())
        used, before, repeats, breaks, start_ns = 0, None, Counter[str](), self._breaks(), 0
        stretch = 0
        for index, stored in islice(numbered, span[1]):
            if stored.is_lost or (used and (index < span[0] or index in passed_over)):
                continue
            if stored.complete:  # only `info` asks for such, and of the others what their times say
                used += 1
                stretch += breaks.add(index, self._time_of(index, stored), stored.stamps)
                continue
            # Grey pixels in the fan, and the time.
            try:
                frame = self._frame(index, stored)
            except UnusableError as error:
                self.diagnostics.skip(stored.name, error)
                continue
            # What the first usable one alone says.
            if not used and stored.ping is not None and self.stated.beam_width_deg is None:
                self.beam_width_deg = stored.ping.beam_width_deg
            used += 1
            if used == 1:
                self._raw.passed_over = passed_over or range(span[0])
            if index < span[0]:
                continue
            # Is it another picture, and another time, than the frame before?
            if before is not None:
                repeats["at once"] += int(frame.timestamp_ns == before.timestamp_ns)
                same = frame.pixels.data == before.pixels.data  # stops early
                repeats["pictures"] += int(same and frame.pixels.any())
            start_ns = start_ns if before else frame.timestamp_ns
            before = frame
            stretch += breaks.add(index, frame.timestamp_ns, frame.stamps)
            yield replace(frame, stretch=stretch)
        if next(numbered, None) is None:  # the end of the log
            self.diagnostics.end_pass()
            if not used:
                raise SonarrecError(f"{self.path}: not one frame could be used{self._why()}")
        self._note_repeats(repeats)
        other = None if before is None else self._other_clock(before.stamps)
        self.diagnostics.note(*breaks.pauses(), *breaks.set_clock(other))
        if before is not None and before.stamps.log is not None:
            self._note_rate(used - 1, before.timestamp_ns - start_ns)

    def _breaks(self) -> Breaks:
        # Recorders of messages may swap some; a sonar's own file has them in order.
        ordered = self._time == "log" and not self._source.reader.has_topics
        return Breaks(self._time, 0 if ordered else CLEARLY_BACK_NS)

    def _other_clock(self, stamps: Stamps) -> Clock | None:
        """A clock that could name the frames in place of this one; None: there is none."""
        others: tuple[Clock, ...] = ("header", "log")
        return next((c for c in others if c != self._time and getattr(stamps, c) is not None), None)

    def _stored(self) -> Iterator[StoredFrame]:
        """The frames as the log holds them, once the first few have decided how all are read."""
        frames = self._observed()
        first = _first_of(frames)
        if self._reading.layout is None:  # else an earlier pass has settled it
            self._reading = settle(self._reading.stated, first)
        self._last_timed = 0, 0
        stamped = [frame.stamps.header for frame in first if frame.pixels is not None]
        self._header_unset = self._time == "header" and bool(stamped) and set(stamped) == {0}
        if self._header_unset:
            self.diagnostics.note(
                "the header stamps of its first frames are 0; --time log is used instead"
            )
        return chain(first, frames)

    def _frame(self, index: int, stored: StoredFrame) -> Frame:
        """The frame for the stages. Raises UnusableError if it cannot be used."""
        reading, pixels = apply(self._reading, stored)
        self._reading = reading
        assert reading.layout is not None
        fan, polar = reading.layout.fan, reading.layout.polar
        return Frame(index, self._time_of(index, stored), pixels, fan, stored.stamps, polar)

    def _note_rate(self, steps: int, span_ns: int) -> None:
        """Tell of a rate that no sonar has, and in which unit the times would be plausible."""
        rate = steps / span_ns * 1e9 if span_ns > 0 else 0.0
        for unit, factor in {"us": 1e3, "ms": 1e6, "s": 1e9}.items():
            if rate / factor <= MOST_HZ < rate:
                fits = f"if its times are in {unit} it has {rate / factor:.3g}"
                self.diagnostics.note(f"{rate:.4g} frames a second, which no sonar sends; {fits}")
                return

    def _note_repeats(self, repeats: Counter[str]) -> None:
        if count := repeats["pictures"]:
            self.diagnostics.note(
                f"{number_of(count, 'image')} equal to the one before: each counts as another "
                "view, so scores are too high; remove them"
            )
        if count := repeats["at once"]:
            self.diagnostics.note(
                f"{number_of(count, 'frame')} of the same {self._time} time as the one before; "
                "truth and poses by time fit both of them equally"
            )

    def why_none(self) -> str:
        """The end of a message that no frame lies in a span: why, if frames could not be used."""
        return f", or none that can be used{self._why()}" if self.diagnostics.problems else ""

    def _why(self) -> str:
        problems = self.diagnostics.problems
        return f" ({problems[0]})" if problems else ""

    def _observed(self) -> Iterator[StoredFrame]:
        for stored in self._raw:
            if self._observe is not None:
                self._observe(stored)
            yield stored

    def _time_of(self, index: int, frame: StoredFrame) -> int:
        """The time that names a frame, ns. Raises UnusableError if the frame has no such time."""
        clock = "log" if self._header_unset else self._time
        stamp: int | None = frame.time_ns if clock == "log" else getattr(frame.stamps, clock)
        if stamp is None and self._time != "log":
            raise UnusableError(f"without a {self._time} time; --time log needs none")
        number, before = self._last_timed
        if stamp is None:
            self.untimed = self.sonar.frame_rate_hz is None
            return before + round((index - number) * 1e9 / (self.sonar.frame_rate_hz or 1.0))
        if clock == "header" and stamp == 0 and before > 0:
            raise UnusableError("its header stamp is 0, as if not set; --time log needs none")
        if not -(2**63) <= stamp < 2**63:
            raise UnusableError(f"its {self._time} time of {stamp} ns is beyond every clock")
        self._last_timed = index, stamp
        return stamp

    def digest_source(self) -> Digest:
        """Of the log's files: see `digest_of`."""
        return digest_of(self._source)


class Digest(NamedTuple):
    """What identifies the files of a log, as run.toml has it."""

    bytes: int
    """Their size, all together."""
    sha256: str


def digest_of(log: Source) -> Digest:
    """Of a log's file; of several images, or the files of a bag, in frame order: before the bytes
    of each come its name, a zero byte, its size and a line end. Of one that cannot be read, only
    the name and the zero byte count. Raises SonarrecError if a log of one file cannot be read."""
    digest, total, block = hashlib.sha256(), 0, memoryview(bytearray(2**20))
    alone = log.files == [log.path]
    for path in log.files:
        if not alone:
            digest.update(path.name.encode(errors="surrogateescape") + b"\0")
        try:
            with path.open("rb", buffering=0) as file:
                if not alone:
                    digest.update(b"%d\n" % os.fstat(file.fileno()).st_size)
                while count := file.readinto(block):
                    total += count
                    digest.update(block[:count])
        except OSError as error:
            if alone:
                raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
            # Else it is reported with its frame.
    return Digest(total, digest.hexdigest())


def _first_of(frames: Iterator[StoredFrame]) -> list[StoredFrame]:
    """The first frames, up to the SETTLING_FRAMES-th of one size that shows something. Those of
    another size than most are marked as unusable: if a driver sent one before it had its settings,
    and it decided the size of the log, all others would be lost."""
    first, held, shown, sizes = list[StoredFrame](), 0, Counter[Size](), Counter[Size]()
    for frame in islice(frames, SETTLING_WITHIN):
        first.append(frame)
        if frame.pixels is not None:
            # None of pings, which state their geometry.
            size = frame.pixels.shape[:2] if frame.ping is None else None
            held += frame.pixels.nbytes
            sizes[size] += 1
            shown[size] += frame.has_content
        enough = max(shown.values(), default=0) >= SETTLING_FRAMES
        if enough or (held > SETTLING_BYTES and len(first) >= SETTLING_FRAMES):
            break
    ((usual, _),) = (+shown or +sizes).most_common(1) or [(None, 0)]
    return [frame if usual is None else _unless_of_other_size(usual, frame) for frame in first]


def _unless_of_other_size(usual: tuple[int, ...], frame: StoredFrame) -> StoredFrame:
    """The frame; without pixels if they are of another size."""
    if frame.pixels is None or frame.ping is not None or frame.pixels.shape[:2] == usual:
        return frame
    rows, columns = frame.pixels.shape[:2]
    problem = f"{columns} x {rows} pixels in a log of {usual[1]} x {usual[0]}"
    return replace(frame, pixels=None, problem=problem)
