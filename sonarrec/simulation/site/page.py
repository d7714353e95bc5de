"""The page of `sonarrec site`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sonarrec import __version__
from sonarrec.arrays import FloatArray
from sonarrec.errors import number_of
from sonarrec.evaluation import cells
from sonarrec.evaluation.intervals import LEVEL, MIN_UNITS
from sonarrec.evaluation.plots import COLOURS
from sonarrec.report.pictures import LARGEST, QUALITY, as_webp, shrunk
from sonarrec.report.svg import STYLES, UNIT, Axis, Chart, Dot, Shape, polyline
from sonarrec.report.templates import filled
from sonarrec.simulation.site.results import ENOUGH, ContrastResults, ExampleFrame, Site, span_text


def render(site: Site) -> str:
    """The whole page as HTML."""
    return filled(
        "site.html",
        __package__,
        version=__version__,
        site=site,
        level=f"{LEVEL:.0%}",
        least=MIN_UNITS,
        enough=f"{ENOUGH:.0%}",
        colours=[COLOURS[n % len(COLOURS)] for n in range(len(site.contrasts))],
        styles=STYLES,
        steps=[span_text(r.near_m, r.far_m) for r in site.contrasts[0].rates.by_range],
        rate_cell=lambda rate, digits: cells.cell(rate.value, rate.low, rate.high, digits),
        over_contrast=_over_contrast(site.contrasts),
        over_range=_over_range(site.contrasts),
        false_claims=_false_claims(site.contrasts),
        pictures=[_picture(one) for one in site.shown],
        landmarks=sum(layout.landmark_count for layout in site.layouts),
        fakes=sum(len(layout.discs) - layout.landmark_count for layout in site.layouts),
    )


def _over_contrast(results: Sequence[ContrastResults]) -> Chart:
    """TPR over contrast, with its interval as thin lines."""
    rates = [one.rates.tpr for one in results]
    edges = [np.array([getattr(rate, name) for rate in rates]) for name in ("low", "high")]
    texts = [f"TPR {rate.value:.3f}" for rate in rates]
    value = np.array([rate.value for rate in rates])
    return _contrast_chart(results, value, texts, UNIT, "TPR", edges)


def _false_claims(results: Sequence[ContrastResults]) -> Chart:
    """False claims over contrast."""
    value = np.array([one.rates.false_per_100.value for one in results])
    up = Axis(0.0, max(1.0, 1.1 * float(np.nanmax(value))))
    texts = [f"{v:.2f} in 100 frames" for v in value]
    return _contrast_chart(results, value, texts, up, "false claims per 100 frames")


def _contrast_chart(
    results: Sequence[ContrastResults],
    value: FloatArray,
    texts: Sequence[str],
    up: Axis,
    name: str,
    edges: Sequence[FloatArray] = (),
) -> Chart:
    """A line over contrast. texts: of the dots. up: the vertical axis. edges: of the interval."""
    contrast = np.array([one.contrast_db for one in results])
    margin = max(0.05 * (contrast[-1] - contrast[0]), 0.5)
    axis = Axis(contrast[0] - margin, contrast[-1] + margin)
    x, y = axis.share(contrast), up.share(value)
    texts = [f"{db:g} dB: {text}" for db, text in zip(contrast, texts, strict=True)]
    dots = [
        Dot(100 * float(a), 100 * float(b), text, 0)
        for a, b, text in zip(x, y, texts, strict=True)
        if np.isfinite(b)
    ]
    drawn = [_goal()] if edges else []
    drawn += [Shape(polyline(x, edge), 0, "faint", "interval") for edge in edges]
    drawn.append(Shape(polyline(x, y), 0, "line", name))
    labels = "contrast over the floor, dB", name
    return Chart("; ".join(texts), drawn, axis.ticks(), up.ticks(5), dots, *labels)


def _goal() -> Shape:
    """A line across a chart at ENOUGH."""
    path = polyline(np.array([0.0, 1.0]), np.array([ENOUGH, ENOUGH]))
    return Shape(path, None, "line thin", f"{ENOUGH:.0%}")


def _over_range(results: Sequence[ContrastResults]) -> Chart:
    """TPR at the middle of each step of slant range, a line for each contrast."""
    steps = results[0].rates.by_range
    axis = Axis(steps[0].near_m, steps[-1].far_m)
    x = axis.share(np.array([(r.near_m + r.far_m) / 2 for r in steps]))
    shapes, dots, texts = [_goal()], [], []
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
