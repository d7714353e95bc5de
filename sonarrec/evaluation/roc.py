"""The content of a ROC chart, for the pictures and the report: lines, points, labels, axis."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.evaluation.count import Scored
from sonarrec.evaluation.curves import PUBLISHED


@dataclass(frozen=True, slots=True)
class Point:
    """One (FPR, TPR); NaN if a rate is 0/0."""

    name: str
    """Of the method, or of the published one."""
    fpr: float
    tpr: float
    label: str


@dataclass(frozen=True, slots=True)
class Line:
    """The ROC of one method and its operating point."""

    method: str
    fpr: FloatArray
    tpr: FloatArray
    """(n,) corners of the curve."""
    at: Point


@dataclass(frozen=True, slots=True)
class Roc:
    """One chart."""

    lines: tuple[Line, ...]
    published: tuple[Point, ...]
    """The paper's points, if they are comparable."""
    fpr_end: float
    """End of the FPR axis."""


def roc(scored: Sequence[Scored], corners: int = 2000) -> Roc:
    """The ROC of each method under one protocol, over all IDs.

    corners: at most so many per line. The paper's points are for protocol paper.
    """
    lines = []
    for s in scored:
        curve, count = s.curve(), s.count()
        at = curve.turns(corners)
        named = f"{s.method} at its operating point"
        point = _point(s.method, named, count.fpr, count.tpr)
        lines.append(Line(s.method, curve.fpr[at], curve.tpr[at], point))
    comparable = all(s.protocol == "paper" for s in scored)
    published = tuple(
        _point(name, f"published {name}", fpr, tpr) for name, fpr, tpr in PUBLISHED if comparable
    )
    return Roc(tuple(lines), published, fpr_end(line.at.fpr for line in lines))


def _point(name: str, label: str, fpr: float, tpr: float) -> Point:
    return Point(name, fpr, tpr, f"{label}: TPR {tpr:.4f}, FPR {fpr:.4f}")


def fpr_end(fprs: Iterable[float]) -> float:
    """End of the axis: a little beyond the worst of these FPRs, at least 0.1."""
    worst = max(np.nan_to_num(list(fprs)), default=0.0)
    return float(min(1.0, max(0.1, np.ceil(13 * worst) / 10)))
