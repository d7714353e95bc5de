"""What a picture of ROC curves shows, whoever draws it: lines, points, names and the axis."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from sonarrec.evaluation.counting.curves import PUBLISHED
from sonarrec.evaluation.counting.pooled import PooledScored
from sonarrec.records import FloatArray


@dataclass(frozen=True, slots=True)
class Point:
    """One (FPR, TPR); NaN where a rate is 0/0."""

    name: str
    """Of the method, or of the one published."""
    fpr: float
    tpr: float
    label: str


@dataclass(frozen=True, slots=True)
class Line:
    """The ROC of one method and its operating point."""

    method: str
    fpr: FloatArray
    tpr: FloatArray
    """(n,) the corners of the curve."""
    at: Point


@dataclass(frozen=True, slots=True)
class Roc:
    """One pair of axes."""

    lines: tuple[Line, ...]
    published: tuple[Point, ...]
    """The paper's own, where they are of the same kind."""
    fpr_end: float
    """Of the FPR axis."""


def roc(scored: Sequence[PooledScored], k: int | None = None, corners: int = 2000) -> Roc:
    """The ROC of each method under one protocol: of the k-th ID, or over all IDs.

    corners: of a line, at most. The paper's points belong to its own protocol, over all IDs.
    """
    lines = []
    for s in scored:
        curve, count = s.curve(k), s.count(k)
        at = curve.turns(corners)
        named = f"{s.method} at its operating point"
        point = _point(s.method, named, count.fpr, count.tpr)
        lines.append(Line(s.method, curve.fpr[at], curve.tpr[at], point))
    comparable = k is None and all(s.protocol == "paper" for s in scored)
    published = tuple(
        _point(name, f"published {name}", fpr, tpr) for name, fpr, tpr in PUBLISHED if comparable
    )
    return Roc(tuple(lines), published, fpr_end(line.at.fpr for line in lines))


def _point(name: str, label: str, fpr: float, tpr: float) -> Point:
    return Point(name, fpr, tpr, f"{label}: TPR {tpr:.4f}, FPR {fpr:.4f}")


def fpr_end(fprs: Iterable[float]) -> float:
    """A little beyond the worst of these, 0.1 or more: right of it is no place to work."""
    worst = max(np.nan_to_num(list(fprs)), default=0.0)
    return float(min(1.0, max(0.1, np.ceil(13 * worst) / 10)))
