"""The page of `sonarrec site`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sonarrec import __version__
from sonarrec.arrays import FloatArray
from sonarrec.errors import number_of
from sonarrec.evaluation import cells
from sonarrec.evaluation.by_range import Rate
from sonarrec.evaluation.cells import Cell
from sonarrec.evaluation.counting.uncertainty import LEVEL, MIN_UNITS
from sonarrec.evaluation.plots import COLOURS
from sonarrec.report.pictures import LARGEST, QUALITY, as_webp, shrunk
from sonarrec.report.svg import STYLES, UNIT, Axis, Chart, Dot, Shape, polyline
from sonarrec.report.templates import filled
from sonarrec.simulation.site.results import ENOUGH, ContrastResults, ExampleFrame, Site, span_text


@dataclass(frozen=True, slots=True)
class Picture:
    """A frame of one contrast."""

    caption: str
    alt: str
    source: str
    width: int
    height: int


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
        rate_cell=_cell,
        over_contrast=_over_contrast(site.contrasts),
        over_range=_over_range(site.contrasts),
        false_claims=_false_claims(site.contrasts),
        pictures=[_picture(one) for one in site.shown],
        landmarks=sum(layout.landmark_count for layout in site.layouts),
        fakes=sum(len(layout.discs) - layout.landmark_count for layout in site.layouts),
    )


def _cell(rate: Rate, digits: int) -> Cell:
    return cells.cell(rate.value, rate.low, rate.high, digits)


def _contrast_axis(results: Sequence[ContrastResults]) -> Axis:
    low, high = results[0].contrast_db, results[-1].contrast_db
    margin = max(0.05 * (high - low), 0.5)
    return Axis(low - margin, high + margin)


def _over_contrast(results: Sequence[ContrastResults]) -> Chart:
    """TPR over contrast, with its interval as thin lines."""
    rates = [one.rates.tpr for one in results]
    x = _contrast_axis(results).share(np.array([one.contrast_db for one in results]))
    goal = polyline(np.array([0.0, 1.0]), np.array([ENOUGH, ENOUGH]))
    edges = (np.array([getattr(rate, name) for rate in rates]) for name in ("low", "high"))
    return _contrast_chart(
        results,
        np.array([rate.value for rate in rates]),
        [f"TPR {rate.value:.3f}" for rate in rates],
        UNIT,
        "TPR",
        Shape(goal, None, "line thin", f"{ENOUGH:.0%}"),
        *(Shape(polyline(x, edge), 0, "faint", "interval") for edge in edges),
    )


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
    *shapes: Shape,
) -> Chart:
    """A line over contrast. texts: of the dots. up: the vertical axis. shapes: drawn below it."""
    axis = _contrast_axis(results)
    x, y = axis.share(np.array([one.contrast_db for one in results])), up.share(value)
    texts = [f"{one.contrast_db:g} dB: {text}" for one, text in zip(results, texts, strict=True)]
    dots = [
        Dot(100 * float(a), 100 * float(b), text, 0)
        for a, b, text in zip(x, y, texts, strict=True)
        if np.isfinite(b)
    ]
    drawn = [*shapes, Shape(polyline(x, y), 0, "line", name)]
    labels = "contrast over the floor, dB", name
    return Chart("; ".join(texts), drawn, axis.ticks(), up.ticks(5), dots, *labels)


def _over_range(results: Sequence[ContrastResults]) -> Chart:
    """TPR at the middle of each step of slant range, a line for each contrast."""
    steps = results[0].rates.by_range
    axis = Axis(steps[0].near_m, steps[-1].far_m)
    x = axis.share(np.array([(r.near_m + r.far_m) / 2 for r in steps]))
    shapes, dots, texts = [], [], []
    goal = polyline(np.array([0.0, 1.0]), np.array([ENOUGH, ENOUGH]))
    shapes.append(Shape(goal, None, "line thin", f"{ENOUGH:.0%}"))
    for n, one in enumerate(results):
        value = np.array([r.tpr.value for r in one.rates.by_range])
        label = f"{one.contrast_db:g} dB"
        shapes.append(Shape(polyline(x, value), n, f"line style-{n % STYLES}", label))
        for at, rate in zip(x, one.rates.by_range, strict=True):
            if rate.tpr.cases:
                text = f"{label}, {span_text(rate.near_m, rate.far_m)}: {rate.tpr.value:.2f}"
                texts.append(text)
                dots.append(Dot(100 * float(at), 100 * rate.tpr.value, text, n))
    return Chart(
        "; ".join(texts), shapes, axis.ticks(), UNIT.ticks(5), dots, "slant range, m", "TPR"
    )


def _picture(example: ExampleFrame) -> Picture:
    image = shrunk(example.image, LARGEST)
    declared = (
        f"{example.declared} of {example.truth} declared"
        if example.truth
        else "no landmark in view"
    )
    return Picture(
        f"{example.contrast_db:g} dB, frame {example.frame}: {declared}.",
        f"Sonar image at {example.contrast_db:g} dB, frame {example.frame}, "
        f"with {number_of(example.truth, 'landmark')}",
        as_webp(image, QUALITY),
        image.shape[1],
        image.shape[0],
    )
