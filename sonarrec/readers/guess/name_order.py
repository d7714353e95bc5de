"""The order of images by their names: that of the few certain forms, or one that is a guess."""

from __future__ import annotations

import os
import re
from array import array
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.readers.guess.times import DATE, counts_behind_point, may_be_half_days
from sonarrec.tables.order import POINTED, natural_order

_DAY = re.compile(
    r"(?<![0-9])(20[0-9]{2})([-_.]?)(0[1-9]|1[0-2])\2(0[1-9]|[12][0-9]|3[01])(?![0-9])"
)
_HALF_OF_DAY = re.compile(r"[0-9][\s_]?[ap]\.?m(?![a-z])", re.IGNORECASE)
_POINTED = re.compile(POINTED)
_SIGNED = re.compile(r"(?:^|[^0-9A-Za-z)])-$")
_DATE_MARK = "\0"  # around the digits of a date with the year first
_DECIMALS = 9  # of numbers with a point
# At which counters begin anew, besides powers of ten: of bits, and of hours, seconds, HHMM, seconds
# of an hour, of a day and of a week.
_LIMITS = (2**8, 2**16, 2**32, 24, 60, 2360, 3600, 86_400, 604_800)
_HALVES = "of a clock of 12 hours the halves of the day are not told apart"


def in_order(paths: Iterable[str]) -> tuple[list[str], str | None]:
    """Paths of images in the order of their frames, and why it is a guess; None if it is certain.

    Certain are names that are alike but for one counter or a time: with the year first, since 1970,
    or of a day of 24 hours. Else it is the natural order.
    """
    texts = list(paths)
    if len(texts) < 2:
        return texts, None
    points: list[list[tuple[str, str]]] = []  # mostly none: empty lists would take much room
    is_count: bool | None = True
    if any(map(_POINTED.search, _stems(texts))):
        points = [_POINTED.findall(stem) for stem in _stems(texts)]
        is_count = counts_behind_point([(found or [("0", "")])[-1] for found in points])
    ordered = sorted(texts, key=partial(_key, decimals=not is_count))
    counted = partial(_key, decimals=False)
    if is_count is None and (not all(points) or ordered != sorted(texts, key=counted)):
        return ordered, "what stands behind a point in them may be decimals or a counter"
    stems = _stems(ordered)
    if all(re.fullmatch(r" ?\([0-9]+\)", stem.removeprefix(stems[0])) for stem in stems[1:]):
        return ordered, None  # copies, as systems name them
    return ordered, _doubt(stems, bool(points), bool(is_count))


def _key(path: str, decimals: bool) -> str:
    """By the name without its suffix, so that Capture comes before Capture (2)."""
    return f"{natural_order(os.path.splitext(path)[0], decimals=decimals)}\0{path}"  # noqa: PTH122


def _stems(paths: Sequence[str]) -> list[str]:
    """Names without suffix, and without the folder if it is one. A Path of each would take long."""
    folders = {path.rpartition(os.sep)[0] for path in paths}
    start = len(folders.pop()) + 1 if len(folders) == 1 else 0
    return [os.path.splitext(path[start:] if start > 1 else path)[0] for path in paths]  # noqa: PTH122


def _doubt(stems: Sequence[str], pointed: bool, is_count: bool) -> str | None:
    """Why the order of these names is a guess; None if it is certain. pointed: whether they hold
    numbers with a point; is_count: as `counts_behind_point`."""
    number = re.compile(rf"{POINTED}|[0-9]+" if pointed else "[0-9]+")
    pattern, values, columns = "", array("q"), 0
    marks: list[tuple[re.Pattern[str], Any]] = [
        (DATE, _marked_date),
        (_DAY, rf"{_DATE_MARK}\1\3\4{_DATE_MARK}"),
    ]
    marks = [(form, mark) for form, mark in marks if form.search(stems[0])][:1]
    for stem in stems:
        text = stem
        for form, mark in marks:
            text = form.sub(mark, stem)
        found = [match[0] for match in number.finditer(text)]
        other = number.sub("#", text)
        if other != (pattern := pattern or other):
            return f"{os.path.basename(stem)} is not named as {os.path.basename(stems[0])}"  # noqa: PTH119
        columns = len(found)
        for digits in found:
            whole = digits
            if pointed:
                whole, _, part = digits.replace(",", ".").partition(".")
                part = part.zfill(_DECIMALS) if is_count else part.ljust(_DECIMALS, "0")
                whole += part[:_DECIMALS]
            value = int(whole)
            if value >= 2**63:
                return f"{digits} is longer than a number that counts"
            values.append(value)
    table = np.frombuffer(values, np.int64).reshape(len(stems), columns)
    return _doubt_of(table, pattern, stems[0], scale=10**_DECIMALS if pointed else 1)


def _marked_date(match: re.Match[str]) -> str:
    """The seconds of a date, if years had 12 months of 31 days: short enough for nine decimals."""
    year, month, day, hour, minute, second = (
        int(match[key]) for key in ("year", "month", "day", "hour", "minute", "second")
    )
    days = ((year - 2000) * 12 + month) * 31 + day
    seconds = ((days * 24 + hour) * 60 + minute) * 60 + second
    return f"{_DATE_MARK}{seconds}{_DATE_MARK}{match.string[match.end('second') : match.end()]}"


def _doubt_of(table: IntArray, pattern: str, stem: str, scale: int) -> str | None:
    """As `_doubt`. table: (names, numbers of each). pattern: of all names, # for each number. stem:
    one of them. scale: what the values of the table were multiplied by."""
    varying = np.flatnonzero(np.ptp(table, axis=0)).tolist()
    steps = np.diff(table, axis=0)
    if not varying:
        return "several have the same name"
    if _HALF_OF_DAY.search(stem):
        return _HALVES
    between = pattern.split("#")
    for column in varying:
        if _SIGNED.search("0" * bool(column) + between[column]):
            return "a dash before a number may be a minus sign"
    rising = [column for column in varying if (steps[:, column] > 0).all()]
    time = next((c for c in varying if _is_time(table[:, c], between[c], scale)), None)
    if time is not None:
        is_date = between[time].endswith(_DATE_MARK) and 10**8 < table[0, time] // scale < 10**10
        if is_date and may_be_half_days(table[:, time] // scale // 3600 % 24):
            return _HALVES
        others = [column for column in varying if column not in rising and column != time]
        if (steps[:, time] >= 0).all() and others in ([], [time + 1]):
            return None
    elif (clock := _clock(table // scale, between, varying)) is not None:
        return clock or None
    elif len(varying) == 1:
        counter = table[:, varying[0]]
        if rising and _begins_anew(counter, scale):
            return f"the counter may begin anew after {counter[-1] / scale:.9g}"
        if _is_day_first(counter // scale):
            return "they may be dates without the year first"
        return None
    if rising == varying:
        return None
    return "several numbers in them change"


def _is_time(values: IntArray, before: str, scale: int) -> bool:
    """Whether a column holds dates, or seconds, milli-, micro- or nanoseconds since 1970."""
    low, high = int(values.min()) // scale, int(values.max()) // scale
    since_1970 = any(11 * 10**k <= low and high < 20 * 10**k for k in (8, 11, 14, 17))
    return since_1970 or before.endswith(_DATE_MARK)


def _clock(table: IntArray, between: Sequence[str], varying: Sequence[int]) -> str | None:
    """Of names that hold a time of day and no other number but its fraction that changes: why their
    order is doubtful, "" if it is not. None for other names."""
    digits = table[:, varying[0]]
    hour, last = digits // 10_000, varying[0]
    is_compact = (digits % 100 < 60).all() and (digits // 100 % 100 < 60).all()
    if not (is_compact and 0 < hour.max() < 24):
        starts = range(max(last - 2, 0), min(last + 1, table.shape[1] - 2))
        start = next((n for n in starts if (table[:, n : n + 3] < (24, 60, 60)).all()), None)
        if start is None or len(between[start + 1]) != 1:
            return None
        hour, last = table[:, start], start + 2
    if not set(varying) <= set(range(last - 2, last + 2)):
        return None
    hours = set(hour.tolist())
    if {0, 23} <= hours:
        return "times of day without a date may go over midnight"
    return _HALVES if may_be_half_days(hour) else ""


def _is_day_first(digits: IntArray) -> bool:
    """Whether numbers may be days, months and years in this order, or months and days."""
    for years, is_year in (
        (10**4, (digits % 10**4 // 100 == 20).all()),
        (10**2, len(set((digits % 100).tolist())) <= 2 < len(digits)),
    ):
        both = np.stack([digits // years // 100, digits // years % 100])
        if is_year and both.min() > 0 and both.max() <= 31 and both.min(axis=0).max() <= 12:
            return True
    return False


def _begins_anew(counter: IntArray, scale: int) -> bool:
    """Whether numbers that rise are two stretches of a counter that reached its limit."""
    steps = np.diff(counter)
    usual = 2 * int(np.median(steps))
    last = int(counter[-1])
    limits = (10 ** len(str(last // scale)), *_LIMITS)
    ends = any(last < limit * scale <= last + usual for limit in limits)
    return bool(ends and counter[0] <= usual and steps.max() > np.ptp(counter) / 2 > usual)
