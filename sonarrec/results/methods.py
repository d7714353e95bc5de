"""Methods of results: their order, and which of them a command takes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from sonarrec.errors import UsageError, printable
from sonarrec.nouns import follows

OF_ONE_PRESET = ("framework", "smi")
"""The methods of a run of one preset, even if one of them has no estimate."""


def in_order(methods: Iterable[str]) -> tuple[str, ...]:
    """Each method once: the framework's, then other programs', then those without tracks."""

    def rank(method: str) -> tuple[bool, bool, str]:
        return not follows(method), method.partition(":")[0] != OF_ONE_PRESET[0], method

    return tuple(sorted(set(methods), key=rank))


def chosen(methods: Iterable[str], wanted: Sequence[str], where: str | Path) -> tuple[str, ...]:
    """The wanted methods as they were named; all in order if none is wanted.

    where: what holds them, for the message. Raises UsageError if one is missing.
    """
    there = in_order(methods)
    for method in wanted:
        if method not in there:
            raise UsageError(
                printable(f"{where}: no method {method!r}; there is {', '.join(there)}")
            )
    return tuple(dict.fromkeys(wanted)) or there


def leading(methods: Iterable[str]) -> str:
    """The method that is shown where one is: the first in order; the framework if there is none."""
    return next(iter(in_order(methods)), OF_ONE_PRESET[0])
