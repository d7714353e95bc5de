"""Times of frames as text: as dates if they count from 1970."""

from __future__ import annotations

from datetime import UTC, datetime

YEAR_2000_NS = 946_684_800 * 10**9


def is_date(timestamp_ns: int) -> bool:
    """Whether a time counts from 1970: then it is after the year 2000.

    A sonar's clock that was never set counts from when the sonar was switched on.
    """
    return timestamp_ns >= YEAR_2000_NS


def date_text(timestamp_ns: int, decimals: int = 0) -> str:
    """Date and time of day in UTC, cut to so many decimals: "2024-05-01 12:30:00.25"."""
    return _text(timestamp_ns, "%Y-%m-%d %H:%M:%S", decimals)


def time_text(timestamp_ns: int, decimals: int = 0) -> str:
    """Time of day in UTC, cut to so many decimals: "12:30:00.25"."""
    return _text(timestamp_ns, "%H:%M:%S", decimals)


def _text(timestamp_ns: int, form: str, decimals: int) -> str:
    seconds, rest = divmod(timestamp_ns, 10**9)
    fraction = f".{rest:09d}"[: decimals + 1] if decimals else ""
    return f"{datetime.fromtimestamp(seconds, UTC):{form}}{fraction}"
