"""Times of frames that stand in the names of their images."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime

import numpy as np

from sonarrec.arrays import IntArray

# No imaging sonar sends pings faster: what rises by less from name to name counts, and is no time.
LEAST_STEP_NS = 5_000_000
MOST_COUNTED_NS = 50_000_000  # thousandths that rise by more do not count frames

_NANOSECONDS = re.compile(r"\A[0-9]{19}\Z")
# A dot or comma leads a fraction of any length. Behind other signs, or none, stand milliseconds,
# microseconds or nanoseconds in full; other lengths would be counters.
_FRACTION = (
    r"(?:[.,](?P<fraction>[0-9]{1,9})"
    r"|(?P<sign>[-_]?)(?P<in_full>[0-9]{3}(?:[0-9]{3}){0,2}))?"
)
# From 2004 to 2033. Counters of ten digits begin at 1000000000.
_SINCE_1970 = re.compile(rf"(?<![0-9])(?P<since_1970>1[1-9][0-9]{{8}}){_FRACTION}(?![0-9])")
_DATE = re.compile(
    r"(?<![0-9])(?P<year>20[0-9]{2})(?P<dash>[-_.]?)(?P<month>[0-9]{2})(?P=dash)(?P<day>[0-9]{2})"
    r"(?:[-_.T ]{0,2}| at )"
    r"(?P<hour>[0-9]{2}|(?<=[-_T ])[0-9](?=[-_.:]))(?P<colon>[-_.:]|h(?=[0-9]{2}m)|)"
    rf"(?P<minute>[0-9]{{2}})(?:(?P=colon)|m)(?P<second>[0-9]{{2}}){_FRACTION}(?![0-9])"
    r"(?![\s_]?[AP]M(?![A-Z]))",  # of which half of the day is not told apart
    re.IGNORECASE,
)


def times_in_names(stems: Iterable[str]) -> IntArray | None:
    """(n,) times in ns that stand in n names without their suffix; None if they hold none.

    All names are alike: numbers of 19 digits, or they hold the seconds since 1970 or date and time
    of 24 hours, with or without a fraction; it is taken as UTC. Such times must rise from name to
    name, by LEAST_STEP_NS and more in most: else they are counters, or seconds in which several
    images fall.
    """
    stems = list(stems)
    if not stems:
        return None
    if all(map(_NANOSECONDS.match, stems)):
        return np.array(stems, np.int64) if max(stems) < str(2**63) else None
    # Names may hold both: when the recording began, and when the image was taken.
    found = (_rising_times(form, stems) for form in (_DATE, _SINCE_1970))
    return next((times for times in found if times is not None), None)


def _rising_times(form: re.Pattern[str], stems: Sequence[str]) -> IntArray | None:
    """(n,) the one time in ns that each name holds in this form; None if some do not, or if they
    do not rise as those of pings do."""
    alike: tuple[str, int] | None = None
    seconds, fractions = list[int](), list[str]()
    for stem in stems:
        found = [match.groupdict(default="") for match in form.finditer(stem)]
        if len(found) != 1:
            return None
        of_name = found[0]
        # One writer gives all names as many; counters and nanoseconds without zeros differ.
        kind = of_name["sign"], len(of_name["in_full"])
        if kind != (alike := alike or kind):
            return None
        if form is _SINCE_1970:
            seconds.append(int(of_name["since_1970"]))
        else:
            keys = ("year", "month", "day", "hour", "minute", "second")
            try:
                moment = datetime(*(int(of_name[key]) for key in keys), tzinfo=UTC)  # type: ignore[misc, arg-type]
            except ValueError:  # a 13th month
                return None
            seconds.append(int(moment.timestamp()))
        fractions.append(of_name["fraction"] or of_name["in_full"])
    longest = max(map(len, fractions))
    if counts_behind_point(fractions):
        fractions = [text.zfill(-(-longest // 3) * 3) for text in fractions]
    whole = np.array(seconds, np.int64)
    parts = np.array([int(f"{text:0<9}") for text in fractions], np.int64)
    if alike is not None and _fraction_counts(whole, parts, *alike):
        parts = np.zeros_like(parts)
    steps = np.diff(times := whole * 10**9 + parts)
    if len(steps) and (steps.min() <= 0 or np.median(steps) < LEAST_STEP_NS):
        return None
    # What seems a time of day is a counter of six digits that has not reached 60, or is between two
    # hundreds.
    within_a_minute = np.ptp(whole // 60) == 0 and whole[0] % 86400 < 3600
    counts = len(whole) > 1 and within_a_minute and np.ptp(whole) == len(whole) - 1
    return None if form is _DATE and not parts.any() and counts else times


def counts_behind_point(parts: Sequence[str]) -> bool | None:
    """Whether digits behind a point count thousandths, millionths or billionths without leading
    zeros (1.5: one second and 5 us), instead of being decimals; None if that does not show.

    parts: digits behind the point, of each name. Decimals are cut at their last digit above 0, or
    all have one length; a count never begins with 0.
    """
    lengths = set(map(len, parts))
    if lengths == {0, 3}:  # 1,000
        return None
    if 0 in lengths or len(lengths) == 1:
        return False
    is_decimal, is_count = (any(len(p) > 1 and p[end] == "0" for p in parts) for end in (0, -1))
    return is_count if is_decimal != is_count else None


def _fraction_counts(seconds: IntArray, fractions: IntArray, sign: str, digits: int) -> bool:
    """Whether what stands behind the seconds and a sign is a counter, or the size of the image.
    digits: how many it has in every name. Three digits that are all that differs, and by little,
    may be every tenth frame."""
    if not sign or len(seconds) < 2:
        return False
    by_one = np.diff(fractions) == 10 ** (9 - digits)
    if by_one.all() or by_one[np.diff(seconds) == 0].any():
        return True
    in_one_second = np.ptp(seconds) == 0
    by_little = bool(in_one_second and np.median(np.diff(fractions)) < MOST_COUNTED_NS)
    return digits == 3 and (by_little or bool(np.ptp(fractions) == 0))
