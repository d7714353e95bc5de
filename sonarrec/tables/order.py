"""The order of files whose names hold numbers."""

from __future__ import annotations

import os
import re
from pathlib import Path


def natural_order(path: str | Path, *, decimals: bool | None = None) -> str:
    """Sort key by which frame2.png comes before frame10.png, and 1700000000.25 before 1700000000.5.

    decimals: whether all numbers with a point are decimals, or none is; None: seconds since 1970
    are. The key is one text: for very many files it takes a fraction of the memory of a list of
    parts. A zero byte, which no path holds, and the count of its digits are put before each number.
    The path itself comes last, for 1 and 01 are the same number.
    """
    text = os.fspath(path)
    number = _SECONDS if decimals is None else _DECIMAL if decimals else _WHOLE
    return f"{number.sub(_led_by_its_length, text)}\0\0{text}"


# Seconds since 1970 with their fraction, at whose end programs leave out zeros, or all of it; else
# whole numbers.
_SECONDS = re.compile(r"(1[0-9]{9})(?:\.([0-9]+)|(?![0-9]))|[0-9]+")
# Not of a date such as 31.12.2024, nor of a time of day.
POINTED = r"(?<![0-9])(?<![0-9][.,])([0-9]+)[.,]([0-9]+)(?![0-9])(?![.,][0-9])"
"""A number with a point."""
_DECIMAL = re.compile(
    r"(?<![0-9])(?<![0-9][.,])([0-9]+)(?:[.,]([0-9]+)(?![0-9])(?![.,][0-9])|(?![.,]?[0-9]))|[0-9]+"
)
_WHOLE = re.compile(r"()()[0-9]+")


def _led_by_its_length(number: re.Match[str]) -> str:
    seconds, fraction = number.groups(default="")
    digits = (seconds or number[0]).lstrip("0")
    return f"\0{len(digits):04d}{digits}" + f".{fraction}\0" * bool(seconds)
