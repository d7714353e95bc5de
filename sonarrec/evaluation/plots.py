"""The ROC as a chart: its content, also for the report, and as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sonarrec.arrays import FloatArray
from sonarrec.evaluation.count import Scored
from sonarrec.evaluation.curves import PUBLISHED
from sonarrec.evaluation.match import PROTOCOLS
from sonarrec.tables.outputs import plain, write_figure

# Okabe and Ito's colours, for any colour vision; line styles distinguish methods in grey print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
STYLES = ("-", "--", "-.", ":")
MARKERS = ("s", "D")
DPI = 120


@dataclass(frozen=True, slots=True)
class Point:
    """One (FPR, TPR) of a method, or a published one; NaN if a rate is 0/0."""

    name: str
    fpr: float
    tpr: float
    label: str


@dataclass(frozen=True, slots=True)
class Line:
    """The ROC of one method, (n,) corners, and its operating point."""

    method: str
    fpr: FloatArray
    tpr: FloatArray
    at: Point


@dataclass(frozen=True, slots=True)
class Roc:
    """One chart. published: the paper's points, if they are comparable. fpr_end: of the axis."""

    lines: tuple[Line, ...]
    published: tuple[Point, ...]
    fpr_end: float


def roc(scored: Sequence[Scored], corners: int = 2000) -> Roc:
    """The ROC of each method under one protocol, over all IDs.

    corners: at most so many per line. The paper's points are for protocol paper. The axis ends a
    little beyond the worst operating point, at least at 0.1.
    """

    def point(name: str, label: str, fpr: float, tpr: float) -> Point:
        return Point(name, fpr, tpr, f"{label}: TPR {tpr:.4f}, FPR {fpr:.4f}")

    lines = []
    for s in scored:
        curve, count = s.curve(), s.count()
        at = curve.turns(corners)
        operating = point(s.method, f"{s.method} at its operating point", count.fpr, count.tpr)
        lines.append(Line(s.method, curve.fpr[at], curve.tpr[at], operating))
    comparable = all(s.protocol == "paper" for s in scored)
    published = [point(name, f"published {name}", fpr, tpr) for name, fpr, tpr in PUBLISHED]
    worst = max(np.nan_to_num([line.at.fpr for line in lines]), default=0.0)
    end = float(min(1.0, max(0.1, np.ceil(13 * worst) / 10)))
    return Roc(tuple(lines), tuple(published * comparable), end)


def draw_roc(path: Path, scored: Sequence[Scored]) -> None:
    """Draw the micro-averaged ROC of every method, one panel per protocol, as a PNG.

    roc.csv has the whole curve.
    """
    methods = [*dict.fromkeys(s.method for s in scored)]
    charts = {p: roc([s for s in scored if s.protocol == p]) for p in PROTOCOLS}
    charts = {protocol: one for protocol, one in charts.items() if one.lines}
    right = max(one.fpr_end for one in charts.values())
    figure = Figure(figsize=(5.2 * len(charts), 5.6), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, len(charts), sharey=True, squeeze=False)[0]
    for axes, (protocol, one) in zip(panels, charts.items(), strict=True):
        for line in one.lines:
            n = methods.index(line.method)
            colour, style = COLOURS[n % len(COLOURS)], STYLES[n % len(STYLES)]
            axes.plot(line.fpr, line.tpr, style, color=colour, lw=1.8, zorder=3)
            dot = {"ms": 9, "mec": "black", "zorder": 4, "clip_on": False}
            _dot(axes, line.at, "o" + style, color=colour, **dot)
        for point, marker in zip(one.published, MARKERS, strict=False):
            _dot(axes, point, marker, color="none", mec="black", ms=13, zorder=5)
        axes.set(
            title=f"protocol {protocol}",
            xlabel=f"false positive rate (axis ends at {right:g})",
            xlim=(0, right),
            ylim=(0, 1.02),
        )
        axes.grid(color="0.9")
        axes.set_axisbelow(True)
        axes.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.12),
            fontsize=8,
            frameon=False,
            markerscale=0.7,
            handlelength=3,
            title="published: in the paper's own basin" if one.published else "",
            title_fontsize=8,
        )
    panels[0].set_ylabel("true positive rate (micro average)")
    write_figure(path, figure)


def _dot(axes: Any, point: Point, marker: str, **look: Any) -> None:
    axes.plot(point.fpr, point.tpr, marker, label=plain(point.label), **look)
