"""Pictures of an evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from sonarrec.evaluation.count import Scored
from sonarrec.evaluation.judge import PROTOCOLS
from sonarrec.evaluation.roc import Point, roc
from sonarrec.tables.outputs import plain, write_figure

# Okabe and Ito's colours, for any colour vision; line styles distinguish methods in grey print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
STYLES = ("-", "--", "-.", ":")
MARKERS = ("s", "D")
DPI = 120


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
