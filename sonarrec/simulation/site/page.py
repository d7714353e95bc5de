"""The page of `sonarrec site`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sonarrec.errors import number_of
from sonarrec.evaluation import cells
from sonarrec.evaluation.intervals import LEVEL, MIN_UNITS
from sonarrec.evaluation.plots import COLOURS
from sonarrec.nouns import VERSION
from sonarrec.reports.page import filled
from sonarrec.reports.pictures import LARGEST, QUALITY, as_webp, shrunk
from sonarrec.reports.svg import STYLES, UNIT, Axis, Chart, Dot, Shape, polyline
from sonarrec.simulation.site.results import (
    ENOUGH,
    ContrastResults,
    ExampleFrame,
    Rate,
    Site,
    span_text,
)

GOAL = Shape(polyline(np.array([0.0, 1.0]), np.full(2, ENOUGH)), None, "line thin", f"{ENOUGH:.0%}")
"""A line across a chart at ENOUGH."""


def render(site: Site) -> str:
    """The whole page as HTML."""
    results, rates = site.contrasts, [one.rates for one in site.contrasts]
    false = [r.false_per_100 for r in rates]
    up = Axis(0.0, max(1.0, 1.1 * float(np.nanmax([rate.value for rate in false]))))
    return filled(
        "site.html",
        __package__,
        version=VERSION,
        site=site,
        level=f"{LEVEL:.0%}",
        least=MIN_UNITS,
        enough=f"{ENOUGH:.0%}",
        colours=[COLOURS[n % len(COLOURS)] for n in range(len(site.contrasts))],
        styles=STYLES,
        steps=[span_text(r.near_m, r.far_m) for r in site.contrasts[0].rates.by_range],
        rate_cell=lambda rate, digits: cells.cell(rate.value, rate.low, rate.high, digits),
        over_contrast=_contrast_chart(results, [r.tpr for r in rates], UNIT, "TPR", "TPR {:.3f}"),
        over_range=_over_range(results),
        false_claims=_contrast_chart(
            results, false, up, "false claims per 100 frames", "{:.2f} in 100 frames"
        ),
        pictures=[_picture(one) for one in site.shown],
        landmarks=sum(layout.landmark_count for layout in site.layouts),
        fakes=sum(len(layout.discs) - layout.landmark_count for layout in site.layouts),
    )


def _contrast_chart(
    results: Sequence[ContrastResults], rates: Sequence[Rate], up: Axis, name: str, form: str
) -> Chart:
    """A line over contrast; shares have thin lines at ENOUGH and at the interval's ends."""
    value, low, high = (np.array([getattr(r, n) for r in rates]) for n in ("value", "low", "high"))
    edges = (low, high) if up is UNIT else ()
    contrast = np.array([one.contrast_db for one in results])
    margin = max(0.05 * (contrast[-1] - contrast[0]), 0.5)
    axis = Axis(contrast[0] - margin, contrast[-1] + margin)
    x, y = axis.share(contrast), up.share(value)
    texts = [f"{db:g} dB: {form.format(v)}" for db, v in zip(contrast, value, strict=True)]
    dots = [
        Dot(100 * float(a), 100 * float(b), text, 0)
        for a, b, text in zip(x, y, texts, strict=True)
        if np.isfinite(b)
    ]
    drawn = [GOAL] if edges else []
    drawn += [Shape(polyline(x, edge), 0, "faint", "interval") for edge in edges]
    drawn.append(Shape(polyline(x, y), 0, "line", name))
    labels = "contrast over the floor, dB", name
    return Chart("; ".join(texts), drawn, axis.ticks(), up.ticks(5), dots, *labels)


def _over_range(results: Sequence[ContrastResults]) -> Chart:
    """TPR at the middle of each step of slant range, a line for each contrast."""
    steps = results[0].rates.by_range
    axis = Axis(steps[0].near_m, steps[-1].far_m)
    x = axis.share(np.array([(r.near_m + r.far_m) / 2 for r in steps]))
    shapes, dots, texts = [GOAL], [], []
    for n, one in enumerate(results):
        value = np.array([r.tpr.value for r in one.rates.by_range])
        label = f"{one.contrast_db:g} dB"
        shapes.append(Shape(polyline(x, value), n, f"line style-{n % STYLES}", label))
        for share, rate in zip(x, one.rates.by_range, strict=True):
            if rate.tpr.cases:
                text = f"{label}, {span_text(rate.near_m, rate.far_m)}: {rate.tpr.value:.2f}"
                texts.append(text)
                dots.append(Dot(100 * float(share), 100 * rate.tpr.value, text, n))
    return Chart(
        "; ".join(texts), shapes, axis.ticks(), UNIT.ticks(5), dots, "slant range, m", "TPR"
    )


def _picture(example: ExampleFrame) -> dict[str, Any]:
    """A frame of one contrast, for the template."""
    image = shrunk(example.image, LARGEST)
    where = f"{example.contrast_db:g} dB, frame {example.frame}"
    found = f"{example.declared} of {example.truth} declared"
    return {
        "caption": f"{where}: {found if example.truth else 'no landmark in view'}.",
        "alt": f"Sonar image at {where}, with {number_of(example.truth, 'landmark')}",
        "source": as_webp(image, QUALITY),
        "width": image.shape[1],
        "height": image.shape[0],
    }
