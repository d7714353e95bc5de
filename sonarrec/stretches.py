"""Where a recording was paused or its clock was set: there a stretch ends, and with it all tracks.

What was seen before a pause says nothing of what follows, however the frames are numbered. The rule
looks only back. The reader applies it to every clock that a frame has, and numbers the stretches:
`Frame.stretch`, and a column of frames.csv. Only tables of other programs, which lack the column,
are numbered by their times.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.sonar.frame import NO_STAMPS, Clock, Stamps

# A pause is longer than LEAST_PAUSE_NS and than PAUSE_STEPS times the longest of the last
# KNOWN_STEPS steps: a sonar that sends in bursts, or a slow one, has no pauses. What is longer than
# CERTAIN_PAUSE_NS and than CERTAIN_STEPS usual steps is one even between bursts.
LEAST_PAUSE_NS, PAUSE_STEPS, KNOWN_STEPS = 2 * 10**9, 10, 10
CERTAIN_PAUSE_NS, CERTAIN_STEPS = 60 * 10**9, 20
CLEARLY_BACK_NS = 10**9
"""Threads of a recorder may swap frames, but not over a longer time."""
LEAST_STEP_NS = 5_000_000
"""No imaging sonar sends pings faster: shorter steps are those of a counter or of another unit."""
YEAR_NS = 31_556_952 * 10**9
HOUR_NS = 3_600 * 10**9
NEAR_NS = 2 * 10**9  # of an hour, in which a log ends whose clock was set back by one
MOST_LISTED = 3  # pauses, one by one


class Stretches:
    """Decides of each frame whether it begins a stretch, by one clock.

    step_ns: the time from the frame before. is_certain: whether it begins one whatever other clocks
    say: by a clock that was set, or by a certain pause.
    """

    def __init__(self) -> None:
        self._steps = deque[int](maxlen=KNOWN_STEPS)
        self._known = deque[int](maxlen=KNOWN_STEPS)  # with the longest so far in place of pauses
        self._before: tuple[int, int] | None = None
        self.step_ns, self.is_certain = 0, False

    def begins(self, frame: int, timestamp_ns: int) -> bool:
        """Whether the next frame begins a stretch. Not the first one, with which nothing ends."""
        before, self._before = self._before, (frame, timestamp_ns)
        if before is None:
            return False
        self.step_ns = step = timestamp_ns - before[1]
        is_pause, self.is_certain = False, step < -CLEARLY_BACK_NS or step > YEAR_NS
        # A log without times is numbered: each time is the frame's number times the period.
        if (
            step > LEAST_PAUSE_NS
            and self._steps
            and abs(timestamp_ns * before[0] - before[1] * frame) > frame + before[0]
        ):
            self.is_certain |= step > max(CERTAIN_PAUSE_NS, CERTAIN_STEPS * self.usual_ns)
            # After two such steps in a row the sonar is slower.
            longest = max(self.longest_ns, self._steps[-1])
            is_pause = len(self._known) == KNOWN_STEPS and step > PAUSE_STEPS * longest
        begins = is_pause or self.is_certain
        if step > 0:
            self._steps.append(step)
        # In the place of a pause there may have been the longest step, one between bursts.
        if (known := self.longest_ns if begins else step) > 0:
            self._known.append(known)
        return begins

    @property
    def longest_ns(self) -> int:
        """The longest of the last steps."""
        return max(self._known, default=0)

    @property
    def runs(self) -> bool:
        """Whether the clock is known to run, in the unit that it should have."""
        return len(self._steps) == KNOWN_STEPS and self.usual_ns >= LEAST_STEP_NS

    @property
    def usual_ns(self) -> int:
        """The median of the last steps, pauses among them."""
        return sorted(self._steps)[len(self._steps) // 2]


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
    """Decides of each frame of a log whether it begins a stretch; the notes on its times.

    Any clock may tell, that of the sonar first: while it runs evenly, a short pause of another one
    is the recorder's.
    """

    def __init__(self, clock: Clock = "log", least_back_ns: int = CLEARLY_BACK_NS) -> None:
        """clock: which names the frames. least_back_ns: by how much it must go back for a note."""
        self._clock, self._least_back_ns = clock, least_back_ns
        nearest_first: tuple[Clock, ...] = ("header", "publish", "log")
        self._clocks = {name: Stretches() for name in nearest_first}
        self._set_back = dict[Clock, int]()  # the frame where a clock was set back the last time
        self._first_ns, self._before = 0, (-1, 0)
        self._count = Counter[bool]()  # of pauses, and of other breaks
        self._pauses = list[str]()
        self._paused_at = -1  # the frame after the last pause
        self._jump = ""  # the first

    def add(self, frame: int, timestamp_ns: int, stamps: Stamps = NO_STAMPS) -> bool:
        """Add the next frame; whether it begins a stretch. stamps: what other clocks say of it."""
        steps = self._steps(frame, timestamp_ns, stamps)
        (before, before_ns), self._before = self._before, (frame, timestamp_ns)
        if before < 0:
            self._first_ns = timestamp_ns
            return False
        step = timestamp_ns - before_ns
        if not self._jump and (step < -self._least_back_ns or step > YEAR_NS):
            self._jump = f"times jump ahead by {step / YEAR_NS:.1f} years at frame {frame} ("
            if step < 0:
                back = f"{-step / 1e9:.1f} s" if -step < 100 * 10**9 else duration(-step)
                self._jump = f"times go back by {back} at frame {frame} (were two recordings "
                self._jump += "joined, or "
        if not steps:
            return False
        reported = self._clock if self._clock in steps else next(iter(steps))
        is_pause = reported != self._clock or 0 < step <= YEAR_NS  # else it is reported as a jump
        self._count[is_pause] += 1
        if is_pause:
            self._paused_at = frame
            length = duration(abs(steps[reported]))
            if reported != self._clock:
                back = "goes back by " if steps[reported] < 0 else ""
                length = f"{reported} time {back}{length}"
            self._pauses = [*self._pauses, f"{length} after frame {before}"][:MOST_LISTED]
        return True

    def _steps(self, frame: int, timestamp_ns: int, stamps: Stamps) -> dict[Clock, int]:
        """By clock the steps in ns to this frame with which a stretch begins; mostly none."""
        steps, even = dict[Clock, int](), False
        for name, clock in [*self._clocks.items()]:
            time_ns = timestamp_ns if name == self._clock else getattr(stamps, name)
            if time_ns is None or (time_ns == 0 and name != self._clock):  # it was not set
                continue
            if clock.begins(frame, time_ns) and (clock.is_certain or not even):
                steps[name] = clock.step_ns
            even |= clock.runs and name not in steps
            if name in steps and clock.step_ns < 0 and name != self._clock:
                if frame - self._set_back.get(name, -KNOWN_STEPS - 1) <= KNOWN_STEPS:
                    del self._clocks[name], steps[name]  # no clock is set so often
                self._set_back[name] = frame
        return steps

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
        span_ns = self._before[1] - self._first_ns + self._clocks[self._clock].longest_ns
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
