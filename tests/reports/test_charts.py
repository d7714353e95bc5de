"""What the report gathers of a log and draws of it, against brute force."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline

from sonarrec.evaluation import plots
from sonarrec.landmarks import load_landmarks
from sonarrec.reports import charts
from sonarrec.reports.glyphs import glyph
from sonarrec.reports.logs import ReportedLog, alongside, tracks
from tests.support.claims import all_scored, counts
from tests.support.pages import random_results, reported


@given(st.lists(st.floats(0, 1) | st.just(np.nan), min_size=1, max_size=3000), st.integers(2, 400))
@settings(max_examples=30)
def test_thinning_keeps_peaks_and_dips(values: list[float], most: int) -> None:
    y = np.array(values)
    kept = charts.thinned(y, most)
    assert len(kept) <= max(most, 1)
    assert (np.diff(kept) > 0).all()
    if np.isfinite(y).any():
        assert np.nanmax(y[kept]) == np.nanmax(y)
        assert np.nanmin(y[kept]) == np.nanmin(y)


def drawn_points(path: str) -> list[list[tuple[int, int]]]:
    """The subpaths of a polyline."""
    return [
        [tuple(map(int, p.split())) for p in part.split("L")]  # type: ignore[misc]
        for part in path.split("M")[1:]
    ]


def test_lines_break_where_nothing_was_seen() -> None:
    x = np.array([0, 0.25, 0.5, 0.75, 1.0])
    y = np.array([0, 1, np.nan, 0.5, np.nan])
    assert drawn_points(charts.polyline(x, y)) == [
        [(0, 1000), (500, 0)],
        [(1500, 500), (1500, 500)],
    ]
    assert charts.polyline(x, np.full(5, np.nan)) == ""


def painted(path: str) -> np.ndarray:
    """(WIDTH,) height of the bars at every column of the sheet, by filling each rectangle."""
    height = np.zeros(charts.WIDTH)
    for left, up, wide in re.findall(r"M(\d+) 1000v-(\d+)h(\d+)v\d+z", path):
        columns = slice(int(left), int(left) + int(wide))
        height[columns] = np.maximum(height[columns], int(up))
    return height


@pytest.mark.parametrize("count", [1, 397, 5000])
def test_bars_cover_their_frames(count: int) -> None:
    rng = np.random.default_rng(count)
    start = np.cumsum(rng.choice([1.0, 30.0], count, p=[0.95, 0.05])) - 1
    height = np.where(rng.random(count) < 0.6, rng.random(count).round(1), 0)
    axis = charts.Axis(0.0, float(start[-1]) + 1)
    path = charts.bars(axis, start, 1.0, height)
    columns = painted(path)
    centre = np.floor(axis.share(start + 0.5) * charts.WIDTH).astype(int)
    at = columns[np.minimum(centre, charts.WIDTH - 1)]
    if count < charts.MOST_POINTS:
        assert at == pytest.approx(1000 * height)
        between = np.diff(start) > 2  # nothing is drawn over time without frames
        gaps = np.floor(axis.share(start[:-1][between] + 15) * charts.WIDTH).astype(int)
        assert not columns[gaps].any()
    else:
        assert path.count("M") <= charts.MOST_POINTS
        assert columns.max() == 1000 * height.max()


def test_the_landmark_drawn_is_the_landmark() -> None:
    """Each glyph's path, filled by the even-odd rule, against the set's own pattern."""
    landmarks = load_landmarks("basin")
    x, y = (v.ravel() for v in np.meshgrid(*[np.linspace(-0.97, 0.97, 60)] * 2))
    points = np.column_stack([50 + 49 * x, 50 - 49 * y])
    for k in range(len(landmarks.ids)):
        inside = np.zeros(len(x), dtype=bool)
        for part in glyph(landmarks, k).split("M")[1:]:
            inside ^= Outline(traced(part)).contains_points(points)
        expected = landmarks.pattern(k, x, y) > 0.5
        # Grid points on an edge may fall either way.
        assert np.mean(inside != expected) < 0.02


def traced(part: str) -> np.ndarray:
    """(n, 2) points along a circle "cx cy a..." or a wedge "A, outer arc, L, inner arc"."""
    numbers = [float(v) for v in re.findall(r"-?\d+\.?\d*", part)]
    turn = np.linspace(0, 2 * np.pi, 200)
    if "a" in part:
        radius = numbers[2]
        return np.column_stack([50 + radius * np.cos(turn), 50 + radius * np.sin(turn)])
    (ax, ay, outer, _, _, _, _, bx, by, dx, dy, *_), (cx, cy) = numbers, numbers[-2:]

    def arc(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
        radius = np.hypot(x0 - 50, y0 - 50)
        begin, end = np.arctan2(50 - y0, x0 - 50), np.arctan2(50 - y1, x1 - 50)
        way = np.linspace(0, (end - begin + np.pi) % (2 * np.pi) - np.pi, 30) + begin
        return np.column_stack([50 + radius * np.cos(way), 50 - radius * np.sin(way)])

    assert outer == pytest.approx(np.hypot(ax - 50, ay - 50), abs=0.1)
    return np.vstack([arc(ax, ay, bx, by), arc(dx, dy, cx, cy)])


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> ReportedLog:
    return reported(random_results(tmp_path_factory.mktemp("random") / "log"))


def test_the_roc_runs_along_the_right_axes(log: ReportedLog) -> None:
    """Every corner of the line and every dot is one of the evaluation's."""
    assert log.matched is not None
    scored = all_scored(counts(log.matched))[0]
    chart = charts.roc(scored.counts, scored.protocol)
    end = plots.roc(scored.counts, scored.protocol).fpr_end
    assert end < 1
    curve, count = scored.curve(), scored.count()
    (points,) = drawn_points(chart.shapes[0].path)
    x, y = np.array(points).T
    fpr, tpr = x / charts.WIDTH * end, 1 - y / charts.HEIGHT
    away = np.hypot(fpr[:, None] - curve["fpr"], tpr[:, None] - curve["tpr"])
    assert away.min(axis=1).max() < 0.002
    assert chart.dots[0][:2] == pytest.approx((100 * count.fpr / end, 100 * count.tpr))


def test_a_landmark_that_is_never_declared_has_a_row_where_it_is_in_view(log: ReportedLog) -> None:
    assert log.in_view is not None
    shown = np.flatnonzero(log.in_view.any(axis=0)).tolist()
    silent = replace(log.results, declared=np.zeros_like(log.results.declared))
    assert [k for k, _ in charts.timeline(replace(log, results=silent))] == shown
    blind = replace(log, results=silent, matched=None)
    assert charts.timeline(blind) == []


def test_truth_beneath_and_estimates_alongside(log: ReportedLog) -> None:
    """Against loops over every pair."""
    found, truth = log.results, log.matched
    assert truth is not None
    assert log.truth_near is not None
    assert found.position is not None
    for n in range(0, len(found.frame_index), 7):
        best, beneath = found.landmarks.radius_m, -1
        for t in np.flatnonzero(truth.truths["at"] == found.frame_index[n]):
            place = truth.truths["x"][t], truth.truths["y"][t]
            away = np.linalg.norm(found.position[n] - place)
            if away <= best:
                best, beneath = away, truth.truths["cell"][t] % len(truth.ids)
        assert log.truth_near[n] == beneath
    shown = tracks(log)
    assert {track.number for track in shown} == {100, 101, 102, 103}
    smi = np.flatnonzero(log.of_method("smi"))
    for track in shown:
        assert (np.diff(track.frame_index) > 0).all()
        assert (found.object[track.estimates] == track.number).all()
        for at, row, matched in zip(
            track.estimates, track.frame_index, alongside(log, track, "smi"), strict=True
        ):
            here = smi[found.frame_index[smi] == row]
            away = np.linalg.norm(found.position[here] - found.position[at], axis=1)
            if len(here) and away.min() <= found.landmarks.radius_m:
                assert matched == here[away.argmin()]
            else:
                assert matched == -1


@given(st.floats(-100, 100), st.floats(0.1, 1e4), st.integers(2, 8))
def test_ticks_are_round_and_few(low: float, length: float, most: int) -> None:
    found = charts.Axis(low, low + length).ticks(most)
    values = np.array([float(text) for _, text in found])
    assert 1 <= len(values) - 1 <= most
    step = np.diff(values).mean()
    assert values == pytest.approx(step * np.round(values / step), abs=1e-6 * step)
    assert f"{step:.9e}"[:4] in ("1.00", "2.00", "2.50", "5.00")
    assert values.min() >= low - 1e-6 * step
    assert values.max() <= low + length + 1e-6 * step
    assert [at for at, _ in found] == pytest.approx(100 * (values - low) / length, abs=0.01)


@given(st.tuples(*[st.integers(0, 255)] * 3))
def test_colours_stand_out_on_white_and_keep_their_hue(colour: tuple[int, int, int]) -> None:
    found = [int(charts.darkened(colour)[n : n + 2], 16) for n in (1, 3, 5)]

    def luminance(levels: Sequence[int]) -> float:  # WCAG 2, relative luminance
        v = np.array(levels) / 255
        linear = np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
        return float(linear @ (0.2126, 0.7152, 0.0722))

    assert 1.05 / (luminance(found) + 0.05) >= 3.0
    if 1.05 / (luminance(colour) + 0.05) > 3.15:
        assert found == [*colour]
    assert np.argsort(colour, kind="stable").tolist() == np.argsort(found, kind="stable").tolist()
