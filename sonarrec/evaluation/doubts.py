"""Doubts about a truth: with what figures mean something else than they seem to."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sonarrec.arrays import FloatArray, IntArray
from sonarrec.errors import number_of
from sonarrec.evaluation.match import PROTOCOLS, Matched, equal_pairs, judge
from sonarrec.geometry import plane_from_polar, polar_from_plane
from sonarrec.results.read import LogResults
from sonarrec.truth.check import FEWEST, unchecked
from sonarrec.truth.match import Truth
from sonarrec.truth.table import TruthTable

MOST_ROWS = 4000  # are asked which reading fits
MOST_SHIFT = 20  # frames by which the truth may be early or late
BETTER = 0.05  # by which another reading must fit better; with right truths none ever did
LEAST_STRETCH = 0.25  # of the log, without a row, at its beginning or end


def doubts(table: TruthTable, log: LogResults, truth: Truth, matched: Matched) -> Iterator[str]:
    """A line on each. truth, matched: of the log; its leading method is asked."""
    path, name = table.path, log.name
    if proposed := unchecked(table, name):
        yield f"{proposed}; they say nothing about the results that they came from"
    if len(truth.visible) and not truth.visible.any():
        yield f"{path}: `visible` is 0 in all rows on {name}, so no landmark is ever in view"
    claims = np.flatnonzero(matched.declared & (matched.method_index == 0))
    rows = np.flatnonzero(matched.truth_positive)
    if min(len(claims), len(rows)) < FEWEST:
        return
    ends_m = log.fan.range_min_m + log.fan.range_max_m if log.fan else np.nan
    other = _other_reading(matched, claims, rows, ends_m) if matched.placed else ""
    if other and log.timestamp_ns is not None and other[0].isdigit():
        step_s = np.median(np.diff(np.sort(log.timestamp_ns))) / 1e9
        other += f" ({int(other.split()[0]) * step_s:.3g} s)"
    if other:
        yield f"{path}: its rows fit the claims in {name} clearly better {other}; which is right?"
    elif not len(judge(matched, matched.methods[0], PROTOCOLS[matched.placed]).right):
        yield (
            f"{path}: none of the {len(claims)} claims of {matched.methods[0]} in {name} is right; "
            "is this the truth of this recording, and are its positions and their units right?"
        )
    yield from _without_rows(f"{path}: its rows for {name}", matched, claims)


def _other_reading(log: Matched, claims: IntArray, rows: IntArray, ends_m: float) -> str:
    """How the rows fit the claims clearly better than as given; empty if they do not. ends_m: the
    sum of the log's least and largest range."""
    rows = rows[:: max(len(rows) // MOST_ROWS, 1)]
    frame, position = log.truth_frame_index[rows], log.truth_position[rows]
    range_m, bearing_deg = polar_from_plane(position)
    readings = {
        "with the sign of their bearings turned": (frame, position * (-1, 1)),
        "with the other --range-order": (frame, plane_from_polar(ends_m - range_m, bearing_deg)),
        "with bearings in radians": (frame, plane_from_polar(range_m, np.degrees(bearing_deg))),
    }
    for shift in range(1, MOST_SHIFT + 1):
        frames = number_of(shift, "frame")
        readings[f"{frames} later"] = _shifted(log, frame, shift), position
        readings[f"{frames} earlier"] = _shifted(log, frame, -shift), position
    fits = {text: _fit(log, claims, rows, *reading) for text, reading in readings.items()}
    given = _fit(log, claims, rows, frame, position)
    best = max(fits, key=lambda text: fits[text])
    return best if fits[best] > given + BETTER else ""


def _shifted(log: Matched, frame: IntArray, shift: int) -> IntArray:
    """(n,) indices of frames so much later; -1 where that is in another stretch, or none."""
    moved = frame + shift
    near = moved.clip(0, len(log.frame) - 1)
    return np.where((near == moved) & (log.stretch[near] == log.stretch[frame]), moved, -1)


def _fit(
    log: Matched, claims: IntArray, rows: IntArray, frame: IntArray, position: FloatArray
) -> float:
    """How near claims of their IDs come to rows at frame (n,), position (n, 2): mean, 0 to 1."""
    cell = frame * len(log.ids) + log.truth_landmark_index[rows]
    claimed = log.claim_frame_index[claims] * len(log.ids) + log.claim_landmark_index[claims]
    row, claim = equal_pairs(cell, claimed)
    offset_m = np.linalg.norm(log.claim_position[claims[claim]] - position[row], axis=1)
    nearness = np.zeros(len(rows))
    np.fmax.at(nearness, row, 1 - np.minimum(offset_m / log.gate_m, 1))  # NaN: unknown
    return float(nearness.mean())


def _without_rows(of: str, log: Matched, claims: IntArray) -> Iterator[str]:
    """A line if a long beginning or end has no row, but a claim in most frames."""
    first, last = log.truth_frame_index.min(), log.truth_frame_index.max()
    claimed = np.unique(log.claim_frame_index[claims])
    frames = len(log.frame)
    for length, found, word in (
        (first, claimed < first, f"begin at frame {log.frame[first]}"),
        (frames - 1 - last, claimed > last, f"end at frame {log.frame[last]}"),
    ):
        if length > LEAST_STRETCH * frames and found.sum() > length / 2:
            yield (
                f"{of} {word}, and {found.sum()} of the {length} frames without one have claims, "
                f"which count as false; `sonarrec run --frames {log.frame[first]}:"
                f"{log.frame[last] + 1}` gives results of the labelled part alone"
            )
