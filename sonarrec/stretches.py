"""Where a recording was paused or its clock was set: there a stretch ends, and with it all tracks.

What was seen before a pause says nothing of what follows, however the frames are numbered. The rule
looks only back. The reader applies it and numbers the stretches: `Frame.stretch`, and a column of
frames.csv. Only tables of other programs, which lack the column, are numbered by their times.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.records import Clock

# A pause is longer than LEAST_PAUSE_NS and than PAUSE_STEPS times the longest of the last
# KNOWN_STEPS steps: a sonar that sends in bursts, or a slow one, has no pauses.
LEAST_PAUSE_NS, PAUSE_STEPS, KNOWN_STEPS = 2 * 10**9, 10, 10
CLEARLY_BACK_NS = 10**9
"""Threads of a recorder may swap frames, but not over a longer time."""
YEAR_NS = 31_556_952 * 10**9
HOUR_NS = 3_600 * 10**9
NEAR_NS = 2 * 10**9  # of an hour, in which a log ends whose clock was set back by one
MOST_LISTED = 3  # pauses, one by one


class Stretches:
    """Decides of each frame whether it begins a stretch."""

    def __init__(self) -> None:
        self._steps = deque[int](maxlen=KNOWN_STEPS)
        self._before: tuple[int, int] | None = None

    def begins(self, frame: int, timestamp_ns: int) -> bool:
        """Whether the next frame begins a stretch. Not the first one, with which nothing ends."""
        before, self._before = self._before, (frame, timestamp_ns)
        if before is None:
            return False
        step = timestamp_ns - before[1]
        begins = step < -CLEARLY_BACK_NS or step > YEAR_NS
        if step > LEAST_PAUSE_NS and len(self._steps) == KNOWN_STEPS:
            # A log without times is numbered: each time is the frame's number times the period.
            numbered = abs(timestamp_ns * before[0] - before[1] * frame) <= frame + before[0]
            begins |= step > PAUSE_STEPS * self.longest_ns and not numbered
        if begins:
            # It counts as the longest so far: in its place there may have been one between bursts.
            step = self.longest_ns
        if step > 0:
            self._steps.append(step)
        return begins

    @property
    def longest_ns(self) -> int:
        """The longest of the last steps."""
        return max(self._steps, default=0)


def stretch_numbers(frame: IntArray, timestamp_ns: IntArray | None) -> IntArray:
    """(F,) the number of each frame's stretch, from 0. frame, timestamp_ns: (F,), in order; without
    times all is one stretch."""
    if timestamp_ns is None:
        return np.zeros(len(frame), np.int64)
    begins = Stretches().begins
    rows = zip(frame.tolist(), timestamp_ns.tolist(), strict=True)
    return np.cumsum([begins(*row) for row in rows], dtype=np.int64)


def stretches_of(frames: Mapping[str, Any]) -> IntArray:
    """(F,) the stretch of each frame of a frames.csv. frames: its columns, by rising frame; by
    their times if it has no column `stretch`."""
    if "stretch" in frames:
        return np.asarray(frames["stretch"])
    return stretch_numbers(frames["frame"], frames.get("timestamp_ns"))


class Breaks:
    """The notes on the times of a log's frames."""

    def __init__(self, least_back_ns: int = CLEARLY_BACK_NS) -> None:
        """least_back_ns: by how much times must go back for a note."""
        self._least_back_ns = least_back_ns
        self._stretches = Stretches()
        self._first_ns, self._before = 0, (-1, 0)
        self._count = Counter[bool]()  # of pauses, and of other breaks
        self._pauses = list[str]()
        self._paused_at = -1  # the frame after the last pause
        self._jump = ""  # the first

    def add(self, frame: int, timestamp_ns: int) -> bool:
        """Add the next frame; whether it begins a stretch."""
        begins = self._stretches.begins(frame, timestamp_ns)
        (before, before_ns), self._before = self._before, (frame, timestamp_ns)
        if before < 0:
            self._first_ns = timestamp_ns
            return False
        step = timestamp_ns - before_ns
        is_pause = begins and 0 < step <= YEAR_NS
        self._count[is_pause] += begins
        if is_pause:
            self._paused_at = frame
            if len(self._pauses) < MOST_LISTED:
                self._pauses.append(f"{duration(step)} after frame {before}")
        elif not self._jump and (step < -self._least_back_ns or step > YEAR_NS):
            self._jump = f"times jump ahead by {step / YEAR_NS:.1f} years at frame {frame} ("
            if step < 0:
                back = f"{-step / 1e9:.1f} s" if -step < 100 * 10**9 else duration(-step)
                self._jump = f"times go back by {back} at frame {frame} (were two recordings "
                self._jump += "joined, or "
        return begins

    def pauses(self) -> Iterator[str]:
        """A line on the pauses, if there are any."""
        if count := self._count[True]:
            more = f" and {count - MOST_LISTED} more" if count > MOST_LISTED else ""
            word = "pause" if count == 1 else "pauses"
            yield f"{count} {word}: {', '.join(self._pauses)}{more}; tracks end there"

    def set_clock(self, other: Clock | None) -> Iterator[str]:
        """A line if the clock was set. other: what else could name the frames."""
        if self._jump:
            do = "give truth by frame" if other is None else f"try `run --time {other}`"
            yield f"{self._jump}was the clock set?); truth and poses by time fit one part: {do}"
        span_ns = self._before[1] - self._first_ns + self._stretches.longest_ns
        alone = self._count[True] == 1 and not self._count[False]
        if alone and abs(span_ns - HOUR_NS) <= NEAR_NS:
            yield (
                f"times fill 1 h except for a pause. If the clock was set back by 1 h, frames from "
                f"{self._paused_at} on were recorded first: name the images by a counter"
            )


def duration(length_ns: int) -> str:
    """A length of time in the unit that suits it: "5.25 s", "30 min", "1 h", "3 days"."""
    seconds = length_ns / 1e9
    if seconds < 100:
        return f"{seconds:.3g} s"
    if seconds < 3_600:
        return f"{seconds / 60:.3g} min"
    hours = seconds / 3_600
    return f"{hours:.3g} h" if hours < 100 else f"{hours / 24:.3g} days"


class Rate:
    """The rate of a log's frames by the median step, which pauses do not change."""

    def __init__(self) -> None:
        self._steps = Counter[float]()  # ns, to four digits, so that memory does not grow
        self._before_ns: int | None = None
        self._same = 0  # frames since, of that time: clocks may show whole seconds only

    def add(self, timestamp_ns: int) -> None:
        """Add the next frame."""
        self._same += 1
        if self._before_ns is not None and timestamp_ns == self._before_ns:
            return
        if self._before_ns is not None and timestamp_ns > self._before_ns:
            step = (timestamp_ns - self._before_ns) / self._same
            self._steps[float(f"{step:.4g}")] += self._same
        self._before_ns, self._same = timestamp_ns, 0

    @property
    def hz(self) -> float | None:
        """Frames per second; None before two times that rise."""
        rest = self._steps.total() / 2
        for step, count in sorted(self._steps.items()):
            rest -= count
            if rest <= 0:
                return 1e9 / step
        return None
