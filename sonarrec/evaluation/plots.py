"""The ROC as a chart: its content, also for the report, and as a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from sonarrec.evaluation.counts import Counts, corners
from sonarrec.tables.outputs import escape_mathtext, write_figure

PUBLISHED = (("SMI", 0.0381, 0.8226), ("framework", 0.0276, 0.8648))
"""(method, FPR, TPR) of Tables 4 and 5, Total: the paper's only two points."""
# Okabe and Ito's colours, for any colour vision; line styles distinguish methods in grey print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
STYLES = ("-", "--", "-.", ":")
MARKERS = ("s", "D")
DPI = 120


@dataclass(frozen=True, slots=True)
class Roc:
    """One chart."""

    lines: dict[str, pd.DataFrame]
    """By method the corners of its ROC."""
    points: pd.DataFrame
    published: pd.DataFrame
    """points, published: operating points and, if they are comparable, the paper's: name, fpr, tpr,
    label."""
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
    worst = float(points.fpr.fillna(0).max())
    return Roc(lines, points, published, min(1.0, max(0.1, float(np.ceil(13 * worst) / 10))))


def _points(rows: Any, label: str) -> pd.DataFrame:
    found = pd.DataFrame(rows, columns=["name", "fpr", "tpr"])
    found["label"] = [
        f"{label.format(p.name)}: TPR {p.tpr:.4f}, FPR {p.fpr:.4f}"
        for p in found.itertuples(index=False, name="Point")
    ]
    return found


def draw_roc(path: Path, counts: Counts) -> None:
    """Draw the micro-averaged ROC of every method, one panel per protocol, as a PNG.

    roc.csv has the whole curve.
    """
    charts = {protocol: roc(counts, protocol) for protocol in counts.protocols}
    right = max(chart.fpr_end for chart in charts.values())
    figure = Figure(figsize=(5.2 * len(charts), 5.6), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, len(charts), sharey=True, squeeze=False)[0]
    for axes, (protocol, chart) in zip(panels, charts.items(), strict=True):
        points = chart.points.itertuples(index=False)
        for n, (line, point) in enumerate(zip(chart.lines.values(), points, strict=True)):
            colour, style = COLOURS[n % len(COLOURS)], STYLES[n % len(STYLES)]
            axes.plot(line.fpr, line.tpr, style, color=colour, lw=1.8, zorder=3)
            dot = {"ms": 9, "mec": "black", "zorder": 4, "clip_on": False}
            label = escape_mathtext(point.label)
            axes.plot(point.fpr, point.tpr, "o" + style, label=label, color=colour, **dot)
        for point, marker in zip(chart.published.itertuples(), MARKERS, strict=False):
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
            title="published: in the paper's own basin" if len(chart.published) else "",
            title_fontsize=8,
        )
    panels[0].set_ylabel("true positive rate (micro average)")
    write_figure(path, figure)
