"""Counts over all IDs, to be summed over recordings whose IDs may differ."""

from __future__ import annotations

import math
from typing import NamedTuple

from sonarrec.evaluation.counts import COUNTS, Counts


class Count(NamedTuple):
    """Of one method under one protocol. double: further claims of an ID in view in one frame."""

    tp: int
    tn: int
    fp: int
    fn: int
    double: int = 0

    @property
    def total(self) -> int:
        return self.tp + self.tn + self.fp + self.fn

    @property
    def tpr(self) -> float:
        return self.tp / (self.tp + self.fn) if self.tp + self.fn else math.nan

    @property
    def fpr(self) -> float:
        return self.fp / (self.fp + self.tn) if self.fp + self.tn else math.nan


def counted(found: Counts) -> dict[tuple[str, str], Count]:
    """By protocol and method."""
    of = {}
    for method in found.methods:
        for protocol in found.protocols:
            row = found.count(method, protocol)
            double = row.tp + row.fn - row.positives
            of[protocol, method] = Count(*(int(getattr(row, n)) for n in COUNTS), int(double))
    return of
