"""Pictures of an evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, NullFormatter

from sonarrec.arrays import FloatArray
from sonarrec.evaluation.behaviour import BINS
from sonarrec.evaluation.count import Scored
from sonarrec.evaluation.curves import macro_curve
from sonarrec.evaluation.judge import PROTOCOLS
from sonarrec.evaluation.roc import Point, fpr_end, roc
from sonarrec.evaluation.summary import FEW, Reliability
from sonarrec.tables.outputs import plain, write_figure

# Okabe and Ito's colours, for any colour vision; line styles distinguish methods in grey print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
STYLES = ("-", "--", "-.", ":")
MARKERS = ("s", "D")
DPI = 120


def _laid_out(width: float, height: float, *, left: float, bottom: float, hspace: float) -> Figure:
    """A figure with fixed margins in inches: computing them takes longer than drawing."""
    figure = Figure(figsize=(width, height), dpi=DPI)
    figure.subplots_adjust(
        left=left / width,
        right=1 - 0.15 / width,
        bottom=bottom / height,
        top=1 - 0.3 / height,
        wspace=0.12,
        hspace=hspace,
    )
    return figure


def _looks(scored: Sequence[Scored]) -> dict[str, tuple[str, str]]:
    """Colour and line style per method, the same in every panel."""
    methods = dict.fromkeys(s.method for s in scored)
    return dict(zip(methods, zip(cycle(COLOURS), cycle(STYLES), strict=False), strict=False))


def _by_protocol(scored: Sequence[Scored]) -> dict[str, list[Scored]]:
    groups = {p: [s for s in scored if s.protocol == p] for p in PROTOCOLS}
    return {protocol: some for protocol, some in groups.items() if some}


def _legend_below(axes: Any, title: str) -> None:
    axes.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, -0.12),
        fontsize=8,
        frameon=False,
        markerscale=0.7,
        handlelength=3,
        title=title,
        title_fontsize=8,
    )


def draw_roc(path: Path, scored: Sequence[Scored]) -> None:
    """Draw the micro-averaged ROC of every method, one panel per protocol, as a PNG.

    The FPR axis ends a little beyond the worst operating point; roc.csv has the whole curve.
    """
    looks = _looks(scored)
    charts = {protocol: roc(some) for protocol, some in _by_protocol(scored).items()}
    right = max(one.fpr_end for one in charts.values())
    figure = Figure(figsize=(5.2 * len(charts), 5.6), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, len(charts), sharey=True, squeeze=False)[0]
    for axes, (protocol, one) in zip(panels, charts.items(), strict=True):
        for line in one.lines:
            colour, style = looks[line.method]
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
        _legend_below(axes, "published: in the paper's own basin" if one.published else "")
    panels[0].set_ylabel("true positive rate (micro average)")
    write_figure(path, figure)


def _dot(axes: Any, point: Point, marker: str, **look: Any) -> None:
    axes.plot(point.fpr, point.tpr, marker, label=plain(point.label), **look)


def draw_roc_by_id(path: Path, scored: Sequence[Scored]) -> None:
    """Draw the ROC of every ID that is ever in view, and their macro average, as a PNG."""
    by_protocol, looks = _by_protocol(scored), _looks(scored)
    ids_in_view = [k for k in range(len(scored[0].ids)) if not np.isnan(scored[0].count(k).tpr)]
    charts = {(p, k): roc(some, k) for p, some in by_protocol.items() for k in ids_in_view}
    right = max((one.fpr_end for one in charts.values()), default=fpr_end(()))
    rows, columns = len(by_protocol), len(ids_in_view) + 1
    width, height = max(2.6 * columns, 5.2), 2.7 * rows + 0.5
    figure = _laid_out(width, height, left=0.75, bottom=0.65, hspace=0.22)
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for row, (protocol, some) in zip(panels, by_protocol.items(), strict=True):
        for axes, k in zip(row, ids_in_view, strict=False):
            for line in charts[protocol, k].lines:
                colour, style = looks[line.method]
                axes.plot(line.fpr, line.tpr, style, color=colour, lw=1.6)
                dot = {"color": colour, "mec": "black", "clip_on": False}
                axes.plot(line.at.fpr, line.at.tpr, "o", **dot)
        for s in some:
            colour, style = looks[s.method]
            fpr, tpr = macro_curve(s.curve(k) for k in ids_in_view)
            row[-1].plot(fpr, tpr, style, color=colour, lw=1.6, label=plain(s.method))
        for axes, name in zip(
            row, [*(f"ID.{scored[0].ids[k]}" for k in ids_in_view), "macro"], strict=True
        ):
            axes.set(title=f"{name}, {protocol}", xlim=(0, right), ylim=(0, 1.03))
            axes.grid(color="0.9")
            axes.set_axisbelow(True)
    figure.supxlabel(f"false positive rate (axes end at {right:g})", fontsize=10)
    figure.supylabel("true positive rate", fontsize=10)
    panels[-1, -1].legend(fontsize=8, loc="lower right")
    write_figure(path, figure)


def draw_det(path: Path, scored: Sequence[Scored]) -> None:
    """Draw the detection error trade-off: misses against false positives, on a probit scale."""
    by_protocol, looks = _by_protocol(scored), _looks(scored)
    ticks = (0.001, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95)
    figure = Figure(figsize=(5.2 * len(by_protocol), 5.6), dpi=DPI, layout="constrained")
    panels = figure.subplots(1, len(by_protocol), squeeze=False)[0]
    for axes, (protocol, some) in zip(panels, by_protocol.items(), strict=True):
        chart = roc(some, corners=400)
        for line in chart.lines:
            colour, style = looks[line.method]
            x, y = _deviates(line.fpr), _deviates(1 - line.tpr)
            axes.plot(x, y, style, color=colour, lw=1.8, label=plain(line.method))
            axes.plot(*_det(line.at), "o", color=colour, mec="black", ms=8)
        for point, marker in zip(chart.published, MARKERS, strict=False):
            label = f"published {point.name}"
            axes.plot(*_det(point), marker, color="none", mec="black", ms=12, label=label)
        at, names = _deviates(np.array(ticks)), [f"{100 * t:g} %" for t in ticks]
        axes.set_xticks(at, names)
        axes.set_yticks(at, names)
        axes.set(
            title=f"protocol {protocol}",
            xlabel="false positive rate",
            ylabel="miss rate (1 - TPR)",
            xlim=(at[0] - 0.2, at[-1]),
            ylim=(at[0] - 0.2, at[-1]),
        )
        axes.grid(color="0.9")
        axes.set_axisbelow(True)
        _legend_below(axes, "dots: operating points; rates under 0.1 % lie at the edge")
    write_figure(path, figure)


def _det(point: Point) -> tuple[FloatArray, FloatArray]:
    return _deviates(np.array([point.fpr])), _deviates(np.array([1 - point.tpr]))


def _deviates(rates: FloatArray) -> FloatArray:
    """Probits; rates nearer to 0 or 1 than 0.0007 are drawn at 0.0007 from them."""
    probit = NormalDist().inv_cdf
    return np.array([probit(r) for r in np.clip(rates, 7e-4, 1 - 7e-4).tolist()])


def draw_reliability(path: Path, curves: Sequence[Reliability]) -> None:
    """Draw, per method, how often the most probable class is right, and how many estimates are."""
    tops = [c for c in curves if c.landmark_text == "top"]
    width, height = max(3.6 * len(tops), 4.2), 4.6
    figure = _laid_out(width, height, left=0.65, bottom=0.5, hspace=0.12)
    panels = figure.subplots(
        2, len(tops), sharex=True, sharey="row", squeeze=False, height_ratios=(3, 1)
    )
    middles = (np.arange(BINS) + 0.5) / BINS
    for axes, bars, top in zip(*panels, tops, strict=True):
        axes.plot([0, 1], [0, 1], ":", color="0.5", label="perfectly calibrated")
        few = top.count < FEW
        label = f"most probable; hollow: fewer than {FEW}"
        held = np.where(few, np.nan, top.right)
        # Points at 0 and 1 are not clipped, and lie above the legend.
        above = {"clip_on": False, "zorder": 6}
        axes.plot(top.mean, held, "o-", color=COLOURS[0], lw=1, label=label, **above)
        axes.plot(top.mean[few], top.right[few], "o", color="white", mec=COLOURS[0], **above)
        axes.set(title=plain(top.method), xlim=(0, 1), ylim=(0, 1))
        axes.grid(color="0.9")
        bars.bar(middles, np.maximum(top.count, 0.5), width=0.09, color=COLOURS[0])
        bars.set(xlabel="probability stated", yscale="log", ylim=(0.5, None))
        # As plain text, 10, 100, 1k: formulas, as powers of ten are, take as long as all the rest.
        bars.yaxis.set_major_formatter(EngFormatter(sep=""))
        bars.yaxis.set_minor_formatter(NullFormatter())
    panels[0, 0].set_ylabel("share that is right")
    panels[1, 0].set_ylabel("estimates")
    panels[0, 0].legend(fontsize=7, loc="upper left")
    write_figure(path, figure)
