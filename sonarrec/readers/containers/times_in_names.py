"""Finds the times that stand in the names of images, in the forms that recorders and people use.

A reading must explain all names. Digits behind the seconds are decimals or a counter, as their
steps show; where that stays open, or day and month could be exchanged, names have no times.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache

import numpy as np

from sonarrec.arrays import IntArray
from sonarrec.stretches import LEAST_STEP_NS

_DAY_NS = 86_400 * 10**9
_MOST_COUNTED = 10  # the longest step of a counter: every tenth frame was exported
_YEARS = range(2010, 2040)  # of two digits
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_ANY = r"[^0-9A-Za-z]"  # a sign
_YEAR, _NAMED = r"(?P<year>20\d\d)", rf"(?P<month>(?i:{'|'.join(_MONTHS)}))[A-Za-z]*"
_Y, _M, _D = r"(?P<year>\d\d)", r"(?P<month>\d\d)", r"(?P<day>\d\d)"
_M1, _D1 = r"(?P<month>\d\d?)", r"(?P<day>\d\d?)"  # perhaps of one digit
_DATES = (
    rf"{_YEAR}(?P<sign>{_ANY}){_M1}(?P=sign){_D1}",
    _YEAR + _M + _D,
    rf"{_YEAR}{_ANY}?{_NAMED}{_ANY}?{_D}",
    rf"{_D1}{_ANY}?{_NAMED}{_ANY}{{0,2}}{_YEAR}",
    rf"{_NAMED}{_ANY}?{_D1}{_ANY}{{1,2}}{_YEAR}",
    rf"{_YEAR}-?(?P<of_year>\d\d\d)(?!\d)",
    rf"{_D1}(?P<sign>{_ANY}){_M1}(?P=sign){_YEAR}",
    rf"{_M1}(?P<sign>(?!\.){_ANY}){_D1}(?P=sign){_YEAR}",  # with points, the day is first
    _D + _M + _YEAR,
    _M + _D + _YEAR,
    rf"{_Y}(?P<sign>{_ANY}?){_M}(?P=sign){_D}",
    rf"{_D}(?P<sign>{_ANY}?){_M}(?P=sign){_Y}",
    rf"{_M}(?P<sign>(?!\.){_ANY}|){_D}(?P=sign){_Y}",
)
_BETWEEN = rf"{_ANY}{{0,3}}(?:T|t|at)?{_ANY}{{0,3}}"
_LETTERED = rf"(?P<hour>\d\d?)h{_ANY}?(?P<minute>\d\d?)m(?:in)?{_ANY}?(?P<second>\d\d?)(?=s|\b|_)"
_TIMES = (
    # File systems do not like colons, so that other signs stand for them, or none.
    rf"(?P<hour>\d\d?)(?P<colon>{_ANY}|%3A)(?P<minute>\d\d?)(?P=colon)(?P<second>\d\d?)",
    r"(?P<hour>\d\d)(?P<minute>\d\d)(?P<second>\d\d)",
    _LETTERED,
)
_LEAST_DIGITS = 8  # of a date with a time, or of the seconds since 1970
_SINCE_1970 = re.compile(r"(?<!\d)0*(?P<since>1[1-9]\d{8})")  # s, from 2004 to 2033
_TIME_OF_DAY = [
    re.compile(rf"(?<!\d)(?P<hour>\d\d)(?P<colon>{_ANY})(?P<minute>\d\d)(?P=colon)(?P<second>\d\d)"
               r"(?=[.,_ -]\d)"),
    re.compile(rf"(?<!\d){_LETTERED}"),
]  # fmt: skip
_SEEN = re.compile(
    r"(?<!\d)(?:20\d\d[-_. ]?(?:0[1-9]|1[0-2])[-_. ]?(?:0[1-9]|[12]\d|3[01])"
    r"|[0-3]\d[-_. ][0-3]\d[-_. ]20\d\d)"
    rf"|{_NAMED}{_ANY}\d\d?(?!\d)(?=.*(?<!\d)20\d\d(?!\d))"
)

# What stands behind the seconds, in this order.
_HALF = re.compile(r"[\s_-]?(?P<half>[AaPp])\.?[Mm](?![A-Za-z])\.?")
_UTC = r"[\s_]?(?:UTC|GMT|Z)?[\s_]?"
_ZONE = re.compile(
    rf"s?{_UTC}(?P<zone>[+-](?:0\d|1[0-4])(?:[-:_.]?(?:00|15|30|45)|(?<=\+\d\d)))(?!\d)"
)
_ZONE_BY_NAME = re.compile(
    r"s?[\s_-]?(?:A?CES?T|EES?T|WES?T|[ECMP][SD]T|A[CEW][SD]T|BST|IST|JST|MSK)(?![A-Za-z])"
)
_DIGITS = re.compile(
    rf"(?:s(?:ec)?)?(?P<point>{_ANY}{{0,2}})(?:[mun]s)?(?P<digits>\d+)(?P<unit>[mun]s)?(?!x\d)(?!\d)"
)


@cache
def _dated() -> list[re.Pattern[str]]:
    """The forms of date and time; compiling them takes as long as recognising several frames."""
    return [re.compile(rf"(?<!\d){date}{_BETWEEN}{time}") for date in _DATES for time in _TIMES]


@dataclass(frozen=True, slots=True)
class NamedTimes:
    """The times of n names."""

    ns: IntArray
    """(n,) since 1970 in UTC, or since midnight."""
    order: IntArray
    """(n,) the names' indices in the order of recording: by a counter in the names, else by the
    times."""
    spread: bool = False
    """Whether names have whole seconds, of which the frames are spread evenly."""


def times_in_names(stems: Sequence[str]) -> NamedTimes | None:
    """The times in names without their suffix; None if they have none, or not surely.

    Each name has date and time of day in the same form, or the time since 1970 in s, ms, us or ns,
    or, if no name has a date, a time of day with decimals, which may go over midnight.
    """
    digits = sum(map(str.isdigit, "".join(stems[:1])))
    forms = [*_dated(), _SINCE_1970] if digits >= _LEAST_DIGITS else []
    named = [times for form in forms if (times := _read(form, stems)) is not None]
    if not named and not any(map(date_in, stems[:1])):
        named = [t for form in _TIME_OF_DAY if (t := _read(form, stems, dated=False)) is not None]
    # Day and month may be exchanged: then the right reading is the one that takes days, not months.
    named.sort(key=lambda times: int(np.ptp(times.ns)))
    similar = [times for times in named if np.ptp(times.ns) <= 2 * np.ptp(named[0].ns) + _DAY_NS]
    return named[0] if similar and all((t.ns == named[0].ns).all() for t in similar) else None


def date_in(stem: str) -> str | None:
    """What looks like a date in a name without its suffix, whether or not it is read."""
    seen = _SEEN.search(stem)
    return None if seen is None else seen[0]


def _read(form: re.Pattern[str], stems: Sequence[str], dated: bool = True) -> NamedTimes | None:
    """The times as this form has them."""
    if not stems or form.search(stems[0]) is None:
        return None
    matches = [[*form.finditer(stem)] for stem in stems]
    if len({len(of_name) for of_name in matches}) > 1:
        return None
    # Of several, the start of the recording stays the same from name to name.
    positions = range(len(matches[0]))
    changing = [k for k in positions if len({of_name[k][0] for of_name in matches}) > 1]
    if len(changing or positions) > 1:
        return None
    chosen = [of_name[(changing or positions)[0]] for of_name in matches]
    before = [stem[: match.start()] for stem, match in zip(stems, chosen, strict=True)]
    rest = [stem[match.end() :] for stem, match in zip(stems, chosen, strict=True)]
    try:
        seconds = np.array([_seconds(match.groupdict()) for match in chosen], np.int64)
    except ValueError:  # a 13th month
        return None
    halves, rest = _stripped(_HALF, rest)
    zones, rest = _stripped(_ZONE, rest)
    fraction, counter = np.zeros(len(stems), np.int64), None
    behind = [_DIGITS.match(text) for text in rest]
    if zones is None and any(behind):
        rest = [
            text[match.end() if match else 0 :] for text, match in zip(rest, behind, strict=True)
        ]
        read = _behind_seconds(seconds, behind, form is _SINCE_1970)
        if read is None:
            return None
        fraction, counter = read
        if halves is None:
            halves, rest = _stripped(_HALF, rest)
        zones, rest = _stripped(_ZONE, rest)
    if any(map(_ZONE_BY_NAME.match, rest)):
        return None
    if halves is not None:
        hours = np.array([int(match["hour"]) for match in chosen])
        if hours.min() < 1 or hours.max() > 12:
            return None
        seconds += 3_600 * (12 * np.array([half in "Pp" for half in halves]) - 12 * (hours == 12))
    if zones is not None:
        seconds -= np.array([_offset_s(zone) for zone in zones])
    if counter is None or np.ptp(counter) >= 2 * len(stems):
        counter = _counter([f"{a}/{b}" for a, b in zip(before, rest, strict=True)])
    return _in_order(seconds * 10**9 + fraction, counter, dated, not fraction.any())


def _stripped(form: re.Pattern[str], texts: list[str]) -> tuple[list[str] | None, list[str]]:
    """(what the form has at the start of all texts, the rest of them); None if one lacks it."""
    matches = [match for text in texts if (match := form.match(text)) is not None]
    values = [match[1] for match in matches]
    if len(values) < len(texts) or len(set(values)) > 2:  # an offset changes with summer time alone
        return None, texts
    return values, [text[match.end() :] for text, match in zip(texts, matches, strict=True)]


def _seconds(part: dict[str, str | None]) -> int:
    """A name's whole seconds. Raises ValueError if there is no such date or time of day."""
    if (since := part.get("since")) is not None:
        return int(since)
    year, month, of_year = part.get("year") or "1970", part.get("month") or "1", part.get("of_year")
    if len(year) == 2:
        year = f"20{year}"
        if int(year) not in _YEARS:
            raise ValueError
    number = int(month) if month.isdigit() else _MONTHS.index(month[:3].lower()) + 1
    clock = [int(part[name] or 0) for name in ("hour", "minute", "second")]
    moment = datetime(int(year), number, int(part.get("day") or 1), *clock, tzinfo=UTC)  # type: ignore[arg-type, misc]
    if of_year is not None:
        moment += timedelta(days=int(of_year) - 1)
        if of_year == "000" or moment.year != int(year):
            raise ValueError
    return int(moment.timestamp())


def _offset_s(zone: str) -> int:
    digits = re.sub(r"\D", "", zone)
    return (-1 if zone[0] == "-" else 1) * (3_600 * int(digits[:2]) + 60 * int(digits[2:] or 0))


def _behind_seconds(
    seconds: IntArray, parts: Sequence[re.Match[str] | None], since_1970: bool
) -> tuple[IntArray, IntArray | None] | None:
    """(the decimals in ns; the counter in their place, if it is one) of the digits behind the
    seconds; None if it is not clear what they are."""
    points = {part["point"] for part in parts if part is not None}
    texts = [part["digits"] if part is not None else "" for part in parts]
    units = {part["unit"] for part in parts if part is not None}
    widths, point = sorted(set(map(len, texts))), min(points)
    if len(points) > 1 or len(units) > 1 or (None in parts and point not in (".", ",")):
        return None
    values = np.array([int(text or 0) for text in texts])
    if widths[-1] > 9:
        return None
    if unit := min(units):
        digits = {"m": 3, "u": 6, "n": 9}[unit[0]]
        return (values * 10 ** (9 - digits), None) if widths[-1] <= digits else None
    if point not in (".", ",") and _counts(seconds, values):
        return np.zeros(len(values), np.int64), values
    padded = np.array([int(f"{text:0<9}") for text in texts])
    # Numbers that were not padded with zeros: 37000000 of 37,000,000 ns.
    unpadded = values * 10 ** (9 - next(width for width in (3, 6, 9) if width >= widths[-1]))
    if len(widths) == 1:
        usual = widths[0] in (3, 6, 9)
        if not usual and (since_1970 or point not in (".", ",")) and not point:
            return None if since_1970 else (padded, None)
        is_tag = point not in (".", ",") and not usual and len(set(texts)) == 1 < len(texts)
        return None if is_tag else (padded, None)
    if not point:
        return None
    if point not in (".", ","):
        return unpadded, None
    is_cut = not any(text.endswith("0") and len(text) < widths[-1] and int(text) for text in texts)
    evenness = [np.var(np.diff(np.sort(seconds * 1e9 + ns))) for ns in (padded, unpadded)]
    return (padded if is_cut and evenness[0] <= 4 * evenness[1] else unpadded), None


def _counts(seconds: IntArray, values: IntArray) -> bool:
    """Whether the numbers behind the seconds count the frames, of the log or of each second."""
    order = np.lexsort((values, seconds))
    steps, within = np.diff(values[order]), np.diff(seconds[order]) == 0
    if not len(steps):
        return False
    of_log = steps.min() > 0 and np.median(steps) <= _MOST_COUNTED
    first = values[order][np.concatenate([[True], ~within])]
    return bool(of_log or (first.max() <= 1 and (steps[within] == 1).all()))


def _counter(texts: Sequence[str]) -> IntArray | None:
    """(n,) the one number in these texts that counts the frames; None if there is none."""
    if len({re.sub(r"\d+", "#", text) for text in texts}) > 1:
        return None
    for column in zip(*(re.findall(r"\d+", text) for text in texts), strict=True):
        numbers = sorted({int(text) for text in column if len(text) < 10})
        if len(numbers) == len(texts) and numbers[-1] - numbers[0] < 2 * len(texts):
            return np.array([int(text) for text in column])
    return None


def _in_order(
    ns: IntArray, counter: IntArray | None, dated: bool, integer: bool
) -> NamedTimes | None:
    """The times in the order of recording; None if no sonar sends so."""
    order = np.argsort(ns, kind="stable")
    if counter is not None:
        counted = np.argsort(counter)
        if np.mean(np.diff(ns[counted]) >= 0) >= 0.9 or len(ns) == 1:  # but where a clock was set
            order = counted
    if not dated:  # over midnight
        if (np.diff(ns[order]) >= 0).all() and np.diff(ns[order]).max(initial=0) > _DAY_NS // 2:
            order = np.roll(order, -1 - int(np.diff(ns[order]).argmax()))
        days = np.cumsum(np.diff(ns[order], prepend=ns[order[0]]) < -_DAY_NS // 2)
        ns[order] += days * _DAY_NS
    spread = integer and bool((np.diff(ns[order]) == 0).any()) and bool(np.ptp(ns))
    if spread:
        ns[order] = _spread(ns[order])
    steps = np.diff(ns[order])
    if len(steps) and (not steps.all() or np.quantile(np.abs(steps), 0.1) < LEAST_STEP_NS):
        return None
    return NamedTimes(ns, order, spread)


def _spread(seconds: IntArray) -> IntArray:
    """(n,) times of frames whose names have whole seconds, in ns: evenly in each second."""
    starts = np.flatnonzero(np.diff(seconds, prepend=-1))
    counts = np.diff(starts, append=len(seconds))
    position = np.arange(len(seconds)) - np.repeat(starts, counts)
    most = np.repeat(np.maximum(counts, int(np.median(counts))), counts)
    spread: IntArray = seconds + position * 10**9 // most
    return spread
