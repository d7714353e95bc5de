"""Times of frames that stand in the names of their images."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import UTC, datetime

import numpy as np

from sonarrec.records import IntArray

# No imaging sonar sends pings faster: what rises by less from name to name counts, and is no time.
LEAST_STEP_NS = 5_000_000

_NANOSECONDS = re.compile(r"\A([0-9]{19})\Z")
# A dot or comma leads a fraction of any length. Behind other signs, or none, stand milliseconds,
# microseconds or nanoseconds in full; other lengths would be counters or zones.
_FRACTION = r"(?:[.,]([0-9]{1,9})|[-_]?([0-9]{3}(?:[0-9]{3}){0,2}))?"
# Seconds since 1970, from 2001 to 2096.
_SINCE_1970 = re.compile(rf"(?<![0-9])([1-3][0-9]{{9}}){_FRACTION}(?![0-9])")
_DATE = re.compile(
    r"(?<![0-9])(20[0-9]{2})[-_.]?([0-9]{2})[-_.]?([0-9]{2})"
    rf"[-_.T ]{{0,2}}([0-9]{{2}})[-_.:h]?([0-9]{{2}})[-_.:m]?([0-9]{{2}}){_FRACTION}(?![0-9])"
)


def times_in_names(stems: Iterable[str]) -> IntArray | None:
    """(n,) times in ns that stand in n names without their suffix; None if they hold none.

    All names are alike: numbers of 19 digits, or they hold the seconds since 1970 or date and time
    of day (taken as UTC), with or without a fraction. Such times must rise from name to name, by
    LEAST_STEP_NS and more in most: else they are counters, or seconds in which several images fall.
    """
    form, digits, times = None, None, []
    for stem in stems:
        if form is None:
            form = next((f for f in (_NANOSECONDS, _DATE, _SINCE_1970) if f.search(stem)), None)
        found = form.findall(stem) if form is not None else ()
        if len(found) != 1:
            return None
        if form is _NANOSECONDS:
            times.append(int(found[0]))
            continue
        *whole, fraction, in_full = found[0]
        # One writer gives all names as many; counters and nanoseconds without zeros differ.
        if len(in_full) != (digits := len(in_full) if digits is None else digits):
            return None
        numbers = [int(part) for part in whole]
        try:
            seconds = numbers[0] if form is _SINCE_1970 else _since_1970(*numbers)
        except ValueError:  # a 13th month
            return None
        times.append(seconds * 10**9 + int(f"{fraction or in_full:0<9}"))
    if form is _NANOSECONDS:
        return np.array(times, np.int64) if max(times) < 2**63 else None
    rising = np.array(times, np.int64)
    return rising if _like_pings(rising) else None


def _since_1970(year: int, month: int, day: int, hour: int, minute: int, second: int) -> int:
    return int(datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp())


def _like_pings(times: IntArray) -> bool:
    steps = np.diff(times)
    return not len(steps) or bool(steps.min() > 0 and np.median(steps) >= LEAST_STEP_NS)
