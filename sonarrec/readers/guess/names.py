"""What the names of images tell: their order, and times if they hold them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.tables.order import natural_order

# No imaging sonar sends pings faster: what rises by less from name to name counts, and is no time.
LEAST_STEP_NS = 5_000_000
_GAP = 20  # times the least step, from which on a counter may have reached its limit there

# Since 1970, from 2004 to 2033: seconds with or without decimals, or milli-, micro- or nanoseconds.
_SINCE_1970 = re.compile(
    r"(?<![0-9])(1[1-9][0-9]{8})(?:\.([0-9]{1,9})|([0-9]{3}(?:[0-9]{3}){0,2}))?(?![0-9])"
)
# As ISO 8601 has them. File systems do not like colons, so that other signs stand for them.
_ISO = re.compile(
    r"(?<![0-9])(20[0-9]{2})(-?)([0-9]{2})\2([0-9]{2})[-_T ]"
    r"([0-9]{2})([-_.:]?)([0-9]{2})\6([0-9]{2})(?:[.,]([0-9]{1,9}))?(?![0-9]|[\s_]?[AaPp][Mm])"
)


def times_in_names(stems: Iterable[str]) -> IntArray | None:
    """(n,) times in ns that stand in n names without their suffix; None if they hold none.

    Each name holds one time, all in the same form: as ISO 8601 has date and time (in UTC), or since
    1970 in s, ms, us or ns. They must rise from name to name, mostly by LEAST_STEP_NS or more.
    """
    stems = list(stems)
    found = (_rising(form, stems) for form in (_ISO, _SINCE_1970) if stems)
    return next((times for times in found if times is not None), None)


def _rising(form: re.Pattern[str], stems: Sequence[str]) -> IntArray | None:
    times = []
    for stem in stems:
        if len(found := form.findall(stem)) != 1:
            return None
        if form is _ISO:
            year, _, month, day, hour, _, minute, second, decimals = found[0]
            try:
                fields = map(int, (year, month, day, hour, minute, second))
                seconds = int(datetime(*fields, tzinfo=UTC).timestamp())  # type: ignore[misc, arg-type]
            except ValueError:  # a 13th month
                return None
        else:
            seconds, decimals = int(found[0][0]), found[0][1] or found[0][2]
        times.append(seconds * 10**9 + int(f"{decimals:0<9}"))
    steps = np.diff(times)
    if len(steps) and (steps.min() <= 0 or np.median(steps) < LEAST_STEP_NS):
        return None
    return np.array(times, np.int64)


def in_order(paths: Iterable[str]) -> tuple[list[str], str | None]:
    """Paths of images in the natural order of their names, and why it is a guess; None if it is
    certain: where all names are alike but for counters that rise from each to the next."""
    ordered = sorted(paths, key=_key)
    return ordered, _doubt(ordered) if len(ordered) > 1 else None


def _key(path: str) -> str:
    """By the name without its suffix, so that Capture comes before Capture (2)."""
    return f"{natural_order(os.path.splitext(path)[0])}\0{path}"  # noqa: PTH122


def _doubt(ordered: Sequence[str]) -> str | None:
    """Why the order of these paths is a guess; None if it is certain."""
    shared = os.path.commonpath([os.path.dirname(path) for path in ordered])  # noqa: PTH120
    form, before = None, list[int]()
    lows, highs, spans = list[int](), list[int](), list[int]()
    for path in ordered:
        stem = os.path.splitext(path[len(shared) :])[0]  # noqa: PTH122
        if (form := form or re.sub("[0-9]+", "#", stem)) != re.sub("[0-9]+", "#", stem):
            return f"{os.path.basename(path)} is not named as {os.path.basename(ordered[0])}"  # noqa: PTH119
        values = [int(digits) for digits in re.findall("[0-9]+", stem)]
        steps = [b - a for a, b in zip(before, values, strict=True)] if before else []
        lows = [*map(min, lows, steps)] if lows else steps
        highs = [*map(max, highs, steps)] if highs else steps
        spans = [*map(sum, zip(spans, steps, strict=True))] if spans else steps
        before = values
    varying = [n for n, (low, high) in enumerate(zip(lows, highs, strict=True)) if low or high]
    if not varying:
        return "several have the same name"
    if re.search(r"(?:^|[^0-9A-Za-z)#])-#", form or ""):
        return "a dash before a number may be a minus sign"
    if len(varying) > 1 and any(lows[n] <= 0 for n in varying):
        return "several numbers in them change"
    if any(2 * highs[n] > spans[n] and highs[n] > _GAP * lows[n] for n in varying):
        return "a number leaves out more than half of its span, and may begin anew behind that"
    return None
