"""Finds out whether a truth can be that of a log, and what is doubtful about it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from sonarrec.arrays import BoolArray, IntArray
from sonarrec.errors import Diagnostics, number_of
from sonarrec.geometry import polar_from_plane
from sonarrec.nouns import is_date
from sonarrec.truth.match import SLACK_PX, ReadLog, Truth, match_times, pixels_apart, share_in_image
from sonarrec.truth.table import TruthTable


def misfit(table: TruthTable, log: ReadLog, truth: Truth) -> str | None:
    """Why a truth with rows on the log cannot be that of the log; None if it can.

    truth: as matched to the log.
    """
    at = table.at[table.rows_of(log.name)]
    if table.key == "timestamp_ns" and log.timestamp_ns is not None:
        unit = unit_of_times(log.timestamp_ns, at)
        if unit is not None:
            return f"{table.path}: {in_other_unit(unit, log.name)}"
    if truth.rows and not len(truth.frame_index):
        near, of_frames, question = "on", log.frame, "is this the truth of another log?"
        if truth.tolerance_ns is not None:
            assert log.timestamp_ns is not None
            near, of_frames = f"within {truth.tolerance_ns / 1e9:.4g} s of", log.timestamp_ns
            if hours := _hours_between(log.timestamp_ns, at):
                question = (
                    f"shifted by {hours * 3600} s all would: are they times of another time zone?"
                )
        return (
            f"{table.path}: none of its {truth.rows} rows ({table.key} {at.min()} to {at.max()}) "
            f"lies {near} a processed frame of {log.name} ({number_of(len(log.frame), 'frame')}, "
            f"{of_frames.min()} to {of_frames.max()}); {question}"
        )
    outside = outside_image(log, truth)
    if len(outside) and outside.all():
        assert log.fan is not None
        assert truth.position is not None
        range_m, bearing_deg = (values[0] for values in polar_from_plane(truth.position))
        return (
            f"{table.path}: none of its {len(outside)} positions lies in the image of {log.name} "
            f"({log.fan.range_min_m:g} to {log.fan.range_max_m:g} m, {log.fan.bearing_min_deg:g} "
            f"to {log.fan.bearing_max_deg:g} deg); the first is {range_m:.4g} m, "
            f"{bearing_deg:.4g} deg; are the units and the log right?"
        )
    return None


def _hours_between(timestamp_ns: IntArray, at: IntArray) -> int | None:
    """The shift in whole hours after which all times (R,) are those of frames; None if none fits.

    There must be three times, frames within 10 us, and dates: counted from 0, two logs may agree.
    """
    if not is_date(int(timestamp_ns.min())) or len(np.unique(at)) < 3:
        return None
    shifts = (
        (h, match_times(timestamp_ns, at + h * 3600 * 10**9, 1e-5))
        for h in sorted(range(-14, 15), key=abs)
    )
    return next((hours for hours, (_, met, _) in shifts if met.all()), None)


FEWEST = 5  # frames or rows from which on a pattern in them is told
_UNITS_NS = {"microseconds": 10**3, "milliseconds": 10**6, "seconds": 10**9}


def unit_of_times(timestamp_ns: IntArray, at: IntArray) -> str | None:
    """The unit of times that cannot be nanoseconds; None if they can be.

    timestamp_ns: (F,) of frames. at: (R,). It is another unit if with it at least nine of ten rows
    have a frame, and these are three or more frames and three times as many as with nanoseconds. In
    ns, times of a clock that starts at 0 would nearly all fall on the first frame.
    """

    def frames_met(unit_ns: int) -> tuple[int, float]:
        """(number of frames with a row, share of the rows with a frame)."""
        if not len(at) or np.abs(at).max() >= 2**63 // unit_ns:
            return 0, 0.0
        nearest, matched, _ = match_times(timestamp_ns, at * unit_ns)
        return len(np.unique(nearest[matched])), float(matched.mean())

    in_ns, _ = frames_met(1)
    for unit, unit_ns in _UNITS_NS.items():
        frames, share = frames_met(unit_ns)
        if share >= 0.9 and frames >= 3 * max(in_ns, 1):
            return unit
    return None


def in_other_unit(unit: str, log: str) -> str:
    """The message on times of another unit. log: its name."""
    return (
        f"timestamp_ns must be nanoseconds; its times fit the frames of {log} only if they are "
        f"{unit}"
    )


def without_rows(path: Path, rows: int, logs: Iterable[str], consequence: str) -> str:
    """Why a truth has no row on any of some logs.

    rows: how many it has. consequence: of having none, a clause.
    """
    if rows:
        return f"{path}: its log column names none of {', '.join(logs)}"
    return (
        f"{path}: it has no row, so {consequence}; a truth has a row per landmark in view "
        "(sonarrec help truth)"
    )


def tell_rows(told: Diagnostics, name: str, truth_rows: int, between: int) -> None:
    """Tell if the truth has no row on a log, or rows between its frames.

    name: of the log. truth_rows, between: as in Truth.
    """
    if not truth_rows:
        told.note(f"{name}: no row in the ground truth, so it is taken to hold no landmark")
    if between:
        told.note(
            f"{name}: {number_of(between, 'ground-truth row')} between frames ignored, "
            "because others are nearer in time"
        )


def tell_other_logs(
    told: Diagnostics, table: TruthTable, logs: Sequence[str], consequence: str
) -> None:
    """Tell of rows of the truth about other logs than `logs`. consequence: of that, a clause."""
    if table.log is None:
        return
    other_names = np.asarray(table.log)[~np.isin(table.log, logs)]
    if len(other_names):
        names = sorted(set(map(str, other_names)))
        listed = ", ".join(names[:5]) + f" and {len(names) - 5} more" * (len(names) > 5)
        told.problem(
            f"{table.path}: {len(other_names)} of {len(table.at)} rows name logs that were not "
            f"given ({listed}); {consequence}"
        )


def tell_fit(
    told: Diagnostics, table: TruthTable, log: ReadLog, truth: Truth, use: str, of_proposals: str
) -> None:
    """Tell what a reader should know of the rows on one log, and signs that they are not its own.

    truth: as matched to the log. use: what is done with range and bearing, a verb. of_proposals:
    the consequence of rows as `truth propose` wrote them, a clause.
    """
    rows, path, name = table.rows_of(log.name), table.path, log.name
    if table.not_read:
        told.note(table.not_read_text())
    if proposed := np.count_nonzero(table.proposed[rows]):
        told.note(
            f"{path}: by `source`, {proposed} of {len(rows)} rows for {name} are unchecked "
            f"proposals of `truth propose`; {of_proposals}. Clear `source` in the rows that a "
            "person has checked"
        )
    if outside := int(np.count_nonzero(outside_image(log, truth))):
        told.note(
            f"{path}: {outside} of {len(truth.frame_index)} positions lie outside the image of "
            f"{name}; `sonarrec truth check` names them"
        )
    if log.fan is not None and (apart := np.sum(pixels_apart(table, rows, log.fan) > SLACK_PX)):
        told.note(
            f"{path}: {number_of(int(apart), 'row')} for {name} with x_px,y_px elsewhere than "
            f"range_m,bearing_deg, which {use}; `sonarrec truth check` tells which"
        )
    frames = np.unique(truth.frame_index)
    if len(frames) >= FEWEST and np.diff(frames).min() > 1:
        step = int(np.median(np.diff(frames)))
        told.note(
            f"{path}: of {name} about one frame in {step} has a row; the frames between are taken "
            "to hold no landmark, so that claims in them are false. Give every frame its rows"
        )
    if table.timestamp_ns is not None and log.timestamp_ns is not None and len(rows):
        nearest, met, _ = match_times(log.timestamp_ns, table.timestamp_ns[rows])
        if other := int(np.count_nonzero(met & (log.frame[nearest] != table.at[rows]))):
            told.note(
                f"{path}: {other} of {len(rows)} rows for {name} have the timestamp_ns of another "
                "frame than the one they name; frame counts. Drop the wrong column"
            )
    if log.fan is not None and table.position is not None and table.position[0] == "polar":
        bearings = np.abs(table.position[2][rows])
        widest = max(-log.fan.bearing_min_deg, log.fan.bearing_max_deg)
        if len(rows) >= FEWEST and 0 < bearings.max() <= np.radians(widest):
            told.note(
                f"{path}: no bearing for {name} is beyond {bearings.max():.2g} deg, of "
                f"{widest:.3g} in view; are they in radians?"
            )


def outside_image(log: ReadLog, truth: Truth) -> BoolArray:
    """(T,) which discs lie wholly outside the fan; (0,) if positions or the fan are not known."""
    fan = log.fan
    if fan is None or truth.position is None:
        return np.zeros(0, dtype=bool)
    radius = log.landmarks.radius_m
    range_m, bearing_deg = polar_from_plane(truth.position)
    aside = bearing_deg - np.clip(bearing_deg, fan.bearing_min_deg, fan.bearing_max_deg)
    outside = np.asarray(
        (range_m < fan.range_min_m - radius)
        | (range_m > fan.range_max_m + radius)
        | (np.radians(np.abs(aside)) * range_m > radius)
    )
    # Only these are computed exactly, on the floor, since that takes long.
    share = share_in_image(fan, range_m[outside], bearing_deg[outside], radius)
    outside[outside] = share == 0
    return outside
