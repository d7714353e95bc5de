"""The ROC as a chart: its content, also for the report, and as a picture."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonarrec.arrays import Table
from sonarrec.evaluation.counts import Counts, corners
from sonarrec.tables.outputs import escape_mathtext, write_figure

PUBLISHED = (("SMI", 0.0381, 0.8226), ("framework", 0.0276, 0.8648))
"""(method, FPR, TPR) of Tables 4 and 5, Total: the paper's only two points."""
# Okabe and Ito's colours, for any colour vision; line styles distinguish methods in grey print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
STYLES = ("-", "--", "-.", ":")
MARKERS = ("s", "D")
DPI = 120


class Point(NamedTuple):
    """A marked point of the chart."""

    name: str
    fpr: float
    tpr: float
    label: str


@dataclass(frozen=True, slots=True)
class Roc:
    """One chart."""

    lines: dict[str, Table]
    """By method the corners of its ROC."""
    points: tuple[Point, ...]
    """The operating point of each."""
    published: tuple[Point, ...]
    """The paper's, if they are comparable."""
    fpr_end: float
    """Of the axis."""


def roc(counts: Counts, protocol: str, most: int = 2000) -> Roc:
    """The ROC of each method under one protocol, over all IDs.

    most: corners per line. The paper's points are for protocol paper. The axis ends a little beyond
    the worst operating point, at least at 0.1.
    """
    lines = {m: corners(counts.corners(m, protocol), most) for m in counts.methods}
    operating = [(m, counts.count(m, protocol)) for m in counts.methods]
    points = _points([(m, c.fpr, c.tpr) for m, c in operating], "{} at its operating point")
    published = _points(PUBLISHED if protocol == "paper" else [], "published {}")
    worst = max((point.fpr for point in points if not math.isnan(point.fpr)), default=0.0)
    return Roc(lines, points, published, min(1.0, max(0.1, float(np.ceil(13 * worst) / 10))))


def _points(rows: Iterable[tuple[str, float, float]], label: str) -> tuple[Point, ...]:
    return tuple(
        Point(name, fpr, tpr, f"{label.format(name)}: TPR {tpr:.4f}, FPR {fpr:.4f}")
        for name, fpr, tpr in rows
    )


def draw_roc(path: Path, counts: Counts) -> None:
    """Draw the micro-averaged ROC of every method, one panel per protocol, as a PNG.

    roc.csv has the whole curve.
    """
    from matplotlib.figure import Figure  # takes long to import; the report draws its own

    charts = {protocol: roc(counts, protocol) for protocol in counts.protocols}
    right = max(chart.fpr_end for chart in charts.values())
    figure = Figure(figsize=(5.2 * len(charts), 5.6), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, len(charts), sharey=True, squeeze=False)[0]
    for axes, (protocol, chart) in zip(panels, charts.items(), strict=True):
        for n, (line, point) in enumerate(zip(chart.lines.values(), chart.points, strict=True)):
            colour, style = COLOURS[n % len(COLOURS)], STYLES[n % len(STYLES)]
            axes.plot(line["fpr"], line["tpr"], style, color=colour, lw=1.8, zorder=3)
            dot = {"ms": 9, "mec": "black", "zorder": 4, "clip_on": False}
            label = escape_mathtext(point.label)
            axes.plot(point.fpr, point.tpr, "o" + style, label=label, color=colour, **dot)
        for point, marker in zip(chart.published, MARKERS, strict=False):
            ring = {"color": "none", "mec": "black", "ms": 13, "zorder": 5}
            axes.plot(point.fpr, point.tpr, marker, label=escape_mathtext(point.label), **ring)
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
            title="published: in the paper's own basin" if chart.published else "",
            title_fontsize=8,
        )
    panels[0].set_ylabel("true positive rate (micro average)")
    write_figure(path, figure)
