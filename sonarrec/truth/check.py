"""Whether a gt.csv can be the truth of a log, and what of it is used."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray
from sonarrec.errors import Diagnostics, number_of
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import in_image, polar_from_pixel, polar_from_plane
from sonarrec.tables import composed
from sonarrec.truth.match import ReadLog, Truth, share_in_image, wrong_times
from sonarrec.truth.table import TruthTable

SLACK = 0.1
"""Tolerance for labels made by eye: a tenth of the radius in position, of the area in `visible`."""
NEARLY_ALL = 0.8
"""Of positions, that lie in the image if columns are exchanged."""


def misfit(table: TruthTable, log: ReadLog, truth: Truth) -> str | None:
    """Why a truth with rows on the log cannot be that of the log; None if it can.

    truth: as matched to the log.
    """
    rows = table.rows_of(log.name)
    keys, fan, times = table.keys[rows], log.fan, log.timestamp_ns
    wrong = ""
    if table.key == "timestamp_ns" and times is not None:
        wrong = wrong_times(times, keys, table.landmark[rows])
    if wrong:
        return f"{table.path}: its {table.key} ({keys.min()} to {keys.max()}) {wrong}"
    if truth.rows and not len(truth.frame_index):
        near, of_frames = "on", log.frame
        if truth.tolerance_ns is not None and times is not None:
            near, of_frames = f"within {truth.tolerance_ns / 1e9:.4g} s of", times
        return (
            f"{table.path}: none of its {truth.rows} rows ({table.key} {keys.min()} to "
            f"{keys.max()}) lies {near} a processed frame of {log.name} "
            f"({number_of(len(log.frame), 'frame')}, {of_frames.min()} to "
            f"{of_frames.max()}); is this the truth of another log?"
        )
    outside = outside_of_log(log, truth)
    if fan is not None and table.position is not None and np.sum(outside) > len(outside) / 2:
        kind, *pair = table.position
        stated, exchanged = pair, pair[::-1]
        if kind == "pixel":
            stated, exchanged = ([*polar_from_pixel(fan, *p)] for p in (stated, exchanged))
        range_m, bearing_deg = (v[truth.row][outside][0] for v in stated)
        inside, how = in_image(fan, *exchanged)[truth.row], "are the units and the log right?"
        if inside.mean() > NEARLY_ALL:
            names = "x_px and y_px" if kind == "pixel" else "range_m and bearing_deg"
            how = f"{np.sum(inside)} lie in it if {names} are exchanged; rename the columns"
        return (
            f"{table.path}: {np.sum(outside)} of its {len(outside)} positions lie outside the "
            f"image of {log.name} ({fan.range_min_m:g} to {fan.range_max_m:g} m, "
            f"{fan.bearing_min_deg:g} to {fan.bearing_max_deg:g} deg); "
            f"such as {range_m:.4g} m, {bearing_deg:.4g} deg; {how}"
        )
    return None


def without_rows(path: Path, rows: int, logs: Iterable[str], consequence: str) -> str:
    """Why a truth has no row on any of some logs.

    rows: how many it has. consequence: of having none, a clause.
    """
    if rows:
        return f"{path}: its log column names none of {', '.join(logs)}"
    return (
        f"{path}: it has no row, so {consequence}; a truth has a row per landmark in view, or "
        "with landmark `none` where nothing is (sonarrec help truth)"
    )


def report_rows(diagnostics: Diagnostics, name: str, truth_rows: int, between: int) -> None:
    """Tell if the truth has no row on a log, or rows between its frames.

    name: of the log. truth_rows, between: as in Truth.
    """
    if not truth_rows:
        diagnostics.note(f"{name}: no row in the ground truth, so it is taken to hold no landmark")
    if between:
        diagnostics.note(
            f"{name}: {number_of(between, 'ground-truth row')} between frames ignored, "
            "because others are nearer in time"
        )


def report_other_logs(
    diagnostics: Diagnostics, table: TruthTable, logs: Sequence[str], consequence: str
) -> None:
    """Tell of rows of the truth about other logs than `logs`. consequence: of that, a clause."""
    known = {composed(name) for name in logs}
    named = () if table.log is None else table.log
    others = [str(name) for name in named if composed(name) not in known]
    if others:
        names = sorted(set(others))
        more = f" and {len(names) - 5} more" if len(names) > 5 else ""
        diagnostics.problem(
            f"{table.path}: {len(others)} of {len(table.keys)} rows name logs that were not "
            f"given ({', '.join(names[:5])}{more}); {consequence}"
        )


def outside_of_log(log: ReadLog, truth: Truth) -> BoolArray:
    """(T,) which discs lie wholly outside the fan; (0,) if positions or the fan are not known."""
    if log.fan is None or truth.position is None:
        return np.zeros(0, dtype=bool)
    return outside_image(log.fan, *polar_from_plane(truth.position), log.landmarks.radius_m)


def outside_image(
    fan: Fan, range_m: FloatArray, bearing_deg: FloatArray, radius_m: float
) -> BoolArray:
    """(T,) which floor discs, by their centres, lie wholly outside the fan image, and by more than
    SLACK."""
    outside = ~in_image(fan, range_m, bearing_deg)  # the centre
    near = share_in_image(fan, range_m[outside], bearing_deg[outside], radius_m * (1 + SLACK))
    outside[outside] = near == 0
    return outside
