"""The order of images by their names: certain where their numbers only rise, else a guess."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from functools import partial

from sonarrec.readers.guess.times import counts_behind_point
from sonarrec.tables.order import POINTED, natural_order

_POINTED = re.compile(POINTED)
_NUMBER = re.compile(rf"{POINTED}|[0-9]+")
_SIGNED = re.compile(r"(?:^|[^0-9A-Za-z)#])-#")
_DECIMALS = 9  # of numbers with a point
_GAP = 20  # times the least step, from which on a counter may have reached its limit there


def in_order(paths: Iterable[str]) -> tuple[list[str], str | None]:
    """Paths of images in the order of their frames, and why it is a guess; None if it is certain.

    It is the natural order. It is certain where all names are alike but for numbers that rise from
    each to the next. (Names with times tell the order by these; see `times_in_names`.)
    """
    texts = list(paths)
    if len(texts) < 2:
        return texts, None
    points: list[list[tuple[str, str]]] = []  # mostly none: empty lists would take much room
    is_count: bool | None = True
    if any(map(_POINTED.search, _stems(texts))):
        points = [_POINTED.findall(stem) for stem in _stems(texts)]
        is_count = counts_behind_point([found[-1][1] if found else "" for found in points])
    ordered = sorted(texts, key=partial(_key, decimals=not is_count))
    counted = partial(_key, decimals=False)
    if is_count is None and (not all(points) or ordered != sorted(texts, key=counted)):
        return ordered, "what stands behind a point in them may be decimals or a counter"
    return ordered, _doubt(_stems(ordered), bool(points), bool(is_count))


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
    number = _NUMBER if pointed else re.compile("[0-9]+")
    form = number.sub("#", stems[0])
    before: list[int] = []
    steps: list[tuple[int, int]] = []  # the least and the largest of each number
    spans: list[int] = []
    for stem in stems:
        if number.sub("#", stem) != form:
            return f"{os.path.basename(stem)} is not named as {os.path.basename(stems[0])}"  # noqa: PTH119
        values = [_value(match[0], pointed, is_count) for match in number.finditer(stem)]
        if before:
            step = [b - a for a, b in zip(before, values, strict=True)]
            pairs = zip(steps, step, strict=True)
            steps = [(min(low, d), max(high, d)) for (low, high), d in pairs]
            spans = [span + d for span, d in zip(spans, step, strict=True)]
        else:
            steps, spans = [(2**63, -(2**63))] * len(values), [0] * len(values)
        before = values
    varying = [n for n, (low, high) in enumerate(steps) if low or high]
    if not varying:
        return "several have the same name"
    if _SIGNED.search(form):
        return "a dash before a number may be a minus sign"
    if len(varying) > 1 and any(steps[n][0] <= 0 for n in varying):
        return "several numbers in them change"
    if any(2 * high > spans[n] and high > _GAP * low for n, (low, high) in enumerate(steps)):
        return "a number leaves out more than half of its span, and may begin anew behind that"
    return None


def _value(digits: str, pointed: bool, is_count: bool) -> int:
    whole, _, part = digits.replace(",", ".").partition(".")
    if not pointed:
        return int(whole)
    part = part.zfill(_DECIMALS) if is_count else part.ljust(_DECIMALS, "0")
    return int(whole + part[:_DECIMALS])
