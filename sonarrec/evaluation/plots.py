"""Pictures of an evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sonarrec.evaluation.scoring import PROTOCOLS, Scored

# Okabe and Ito's colours, told apart with any colour vision; line styles tell them apart in grey.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
STYLES = ("-", "--", "-.", ":")
PUBLISHED = (("SMI", 0.0381, 0.8226, "s"), ("framework", 0.0276, 0.8648, "D"))
"""Tables 4 and 5, Total: the paper's only two points."""


def draw_roc(path: Path, scored: Sequence[Scored]) -> None:
    """Draw the micro-averaged ROC of every method, one panel per protocol, as a PNG.

    The FPR axis ends a little beyond the worst operating point (at 0.1 or more): what lies to
    the right of it is no place to work at. roc.csv holds the rest.
    """
    protocols = [p for p in PROTOCOLS if any(s.protocol == p for s in scored)]
    worst = max((s.count().fpr for s in scored), default=0.0)
    right = min(1.0, max(0.1, np.ceil(13 * np.nan_to_num(worst)) / 10))
    figure = Figure(figsize=(5.2 * len(protocols), 5.6), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(protocols), sharey=True, squeeze=False)[0]
    for axes, protocol in zip(panels, protocols, strict=True):
        looks = zip(cycle(COLOURS), cycle(STYLES), strict=False)
        for s, (colour, style) in zip(
            (s for s in scored if s.protocol == protocol), looks, strict=False
        ):
            curve, point = s.curve(), s.count()
            at = curve.turns()
            axes.plot(curve.fpr[at], curve.tpr[at], style, color=colour, lw=1.8, zorder=3)
            axes.plot(
                point.fpr,
                point.tpr,
                "o" + style,
                color=colour,
                ms=9,
                mec="black",
                zorder=4,
                clip_on=False,
                label=f"{s.method}, at its operating point: {point.tpr:.3f}, {point.fpr:.4f}",
            )
        if protocol == "paper":
            for name, fpr, tpr, marker in PUBLISHED:
                axes.plot(
                    fpr,
                    tpr,
                    marker,
                    color="none",
                    mec="black",
                    ms=13,
                    zorder=5,
                    label=f"published {name}, in the paper's own basin: {tpr:.3f}, {fpr:.4f}",
                )
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
            title="TPR, FPR",
            title_fontsize=8,
        )
    panels[0].set_ylabel("true positive rate (micro average)")
    figure.savefig(path)
