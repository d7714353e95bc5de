"""What claims tell of a truth: signs that its rows mean something else than they state.

The rows of a truth, also those that matching drops, are compared with the claims of the leading
method: as they are, and as if positions or frames had been stated in another way. Such a reading is
named as the reason only if nearly all rows and claims agree under it. If others fit clearly better
but none explains the difference, the note says what was seen and gives no reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from sonarrec.advice.truth import FEWEST
from sonarrec.arrays import BoolArray, FloatArray, IntArray, Table
from sonarrec.errors import Advice, number_of
from sonarrec.evaluation.counts import errors_of
from sonarrec.evaluation.rows import Matched, ScoringOptions, equal_pairs, judge
from sonarrec.results.read import LogResults
from sonarrec.sonar.geometry import (
    pixel_from_plane,
    plane_from_polar,
    plane_position,
    polar_from_pixel,
    polar_from_plane,
)
from sonarrec.truth.table import TruthTable

MOST_ROWS = 500  # are asked which reading fits; more add nothing
MOST_SHIFT = 500  # frames by which the truth may be early or late
BETTER = 0.05  # by which another reading must fit better; with right truths none ever did
NEARLY_ALL = 0.8  # of rows and of claims agree under the reading that is named as the reason
PART = 0.1  # of the rows, that were stated in another way than the others
UNSEEN = 0.1  # of an ID's frames are claimed, between two frames with its row, and have none
OTHER_IDS = 0.25  # of the rows lie on claims of other IDs; a method confuses fewer
SAME_SCALE = 0.04  # difference from 1 that counts as none
LEAST_SCALE = 0.1  # with less, claims hardly depend on rows
LEAST_SPREAD = 0.05  # m or deg, of values that show a scale
FEW = 0.1  # of rows and of claims meet by chance in a truth of another log
FEWEST_CLAIMS = 20  # of which a few right ones may be chance
MOST_ROTATION_DEG = 20.0  # by which right claims differ, in the median
LEAST_STRETCH = 0.25  # of the log, without a row, at its beginning or end


def of_claims(
    table: TruthTable, log: LogResults, matched: Matched, options: ScoringOptions
) -> Iterator[Advice]:
    """Whether claims tell that rows mean something else, or that frames lack rows.

    matched: of all frames of the log; its leading method is asked.
    """
    claims = matched.claims
    claims = claims[claims["declared"] & (claims["method"] == 0)]  # of the leading method
    both = _sightings(table, log, matched, claims, options.min_visible)
    if min(both.rows.sure.sum(), len(both.claims.frame)) < FEWEST:
        return
    reason = _any_reason(both, log, matched.ids) if matched.placed else None
    seen, lines = both.meeting(both.rows), list[str]()
    if reason:
        lines = [f"its rows would fit the claims in {log.name} clearly better {reason}; check it"]
    elif reason is not None or seen.by_chance:
        claimed = seen.claims or len(both.claims.frame)  # all, if none is on a frame with a row
        lines = [
            f"{seen.rows_met} of {number_of(seen.rows, 'row')} on {log.name} and "
            f"{seen.claims_met} of {number_of(claimed, 'claim')} of {matched.methods[0]} meet; "
            "check that this is its truth, and its positions, times and units"
        ]
    elif len(matched.truths):
        if part := _part(both, log) if matched.placed else "":
            lines = [f"{part} in {log.name}; check them"]
        elif not options.labelled_only:
            lines = [f"its rows for {log.name} {how}" for how in _without_rows(matched, claims)]
    yield from (Advice(f"{table.path}: {line}", grave=True) for line in lines)
    if matched.placed and not lines:
        for how in _off(matched, log):
            yield Advice(f"{table.path}: its rows for {log.name} {how}")


class _Points(NamedTuple):
    """frame: (n,) by number; by rank in time if the truth names frames by time. landmark: (n,) into
    ids. position: (n, 2) m in the fan plane. sure: (n,) whether enough of the landmark is in view
    that a claim is missing without one."""

    frame: IntArray
    landmark: IntArray
    position: FloatArray
    sure: BoolArray

    def of(self, some: BoolArray | slice) -> _Points:
        """Some of the points."""
        return _Points(self.frame[some], self.landmark[some], self.position[some], self.sure[some])


class _Meeting(NamedTuple):
    """How many rows lie on frames of the log, how many claims on frames with a row; and of both how
    many meet one of the other."""

    rows: int
    rows_met: int
    claims: int
    claims_met: int

    @property
    def shares(self) -> tuple[float, float]:
        return self.rows_met / max(self.rows, 1), self.claims_met / max(self.claims, 1)

    @property
    def by_chance(self) -> bool:
        """Whether no claim meets a row, or so few that chance explains it."""
        few = self.claims >= FEWEST_CLAIMS and max(self.shares) < FEW
        return few or not self.claims_met


@dataclass(frozen=True, slots=True)
class _Sightings:
    """The rows of the truth and the claims on one log.

    frames, stretch: (F,) of the log, rising. A row meets a claim of its ID and frame nearer than
    gate_m.
    """

    rows: _Points
    claims: _Points
    frames: IntArray
    stretch: IntArray
    gate_m: float
    in_pixels: bool
    """Whether the positions of the rows are stated so."""

    def meeting(self, rows: _Points) -> _Meeting:
        """How these rows and the claims meet."""
        rows = rows.of(np.isin(rows.frame, self.frames))
        rows_met, claims_met = self.met(rows)
        return _Meeting(
            rows=int(rows.sure.sum()),
            rows_met=int((rows.sure & rows_met).sum()),
            claims=int(np.isin(self.claims.frame, rows.frame).sum()),
            claims_met=int(claims_met.sum()),
        )

    def near(self, rows: _Points) -> tuple[IntArray, IntArray]:
        """The (row, claim) of one frame that are nearer than the gate, of whatever IDs."""
        row, claim = equal_pairs(rows.frame, self.claims.frame)
        offset = np.linalg.norm(rows.position[row] - self.claims.position[claim], axis=1)
        return row[offset <= self.gate_m], claim[offset <= self.gate_m]

    def met(self, rows: _Points) -> tuple[BoolArray, BoolArray]:
        """((n,) of these rows, (m,) of the claims, whether each meets one of the other)."""
        row, claim = self.near(rows)
        same = rows.landmark[row] == self.claims.landmark[claim]
        of_rows, of_claims = np.zeros(len(rows.frame), bool), np.zeros(len(self.claims.frame), bool)
        of_rows[row[same]] = of_claims[claim[same]] = True
        return of_rows, of_claims

    def rest(self) -> _Sightings:
        """The rows and claims of which none meets the other."""
        rows_met, claims_met = self.met(self.rows)
        return replace(self, rows=self.rows.of(~rows_met), claims=self.claims.of(~claims_met))

    def fits(self, rows: _Points, most: int) -> FloatArray:
        """(2 most + 1,) how near claims come to these rows, 0 to 1 on average, if the rows are
        `most` frames earlier ... as they are ... `most` frames later."""
        near = np.zeros((len(rows.frame), 2 * most + 1), np.float32)
        for landmark in np.unique(rows.landmark):
            same = np.flatnonzero(rows.landmark == landmark)
            claims = np.flatnonzero(self.claims.landmark == landmark)
            claims = claims[np.argsort(self.claims.frame[claims], kind="stable")]
            frame = self.claims.frame[claims]
            low = np.searchsorted(frame, rows.frame[same] - most)
            count = np.searchsorted(frame, rows.frame[same] + most, "right") - low
            row = np.repeat(same, count)
            within = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
            claim = claims[np.repeat(low, count) + within]
            # A shift is one within a stretch: pauses are of another length in frames.
            own = self._stretch_of(rows.frame[row]) == self._stretch_of(self.claims.frame[claim])
            row, claim = row[own], claim[own]
            offset = self.claims.position[claim] - rows.position[row]
            nearness = 1 - np.minimum(np.linalg.norm(offset, axis=1) / self.gate_m, 1)
            shift = self.claims.frame[claim] - rows.frame[row] + most
            np.fmax.at(near, (row, shift), nearness)  # NaN: a position that is not known
        return np.asarray(near.mean(axis=0))

    def _stretch_of(self, frame: IntArray) -> IntArray:
        """(n,) the stretches of frames, also of those beyond the log."""
        index = np.searchsorted(self.frames, frame, "right") - 1
        return np.asarray(self.stretch[index.clip(0)])


def _sightings(
    table: TruthTable, log: LogResults, matched: Matched, claims: Table, min_visible: float
) -> _Sightings:
    """The rows on a log, whether or not matching kept them, and the claims."""
    rows = table.rows_of(log.name)
    rows = rows[table.visible[rows] > 0]
    when, frames, stretch = table.keys[rows], log.frame, log.stretch
    of_index = frames
    if table.key != "frame" and log.timestamp_ns is not None:
        order = np.argsort(log.timestamp_ns, kind="stable")
        times, stretch = log.timestamp_ns[order], stretch[order]
        frames, of_index = np.arange(len(times)), np.argsort(order)
        step = max(float(np.median(np.diff(times))), 1.0) if len(times) > 1 else 1.0
        beyond = np.clip(when, times[0], times[-1])
        rank = np.interp(beyond, times, np.arange(len(times))) + (when - beyond) / step
        when = np.rint(rank).astype(np.int64)
    position: FloatArray | None = None
    claimed: FloatArray = np.zeros((len(claims), 2))
    if matched.placed and table.position is not None:
        kind, first, second = table.position
        position = plane_position((kind, first[rows], second[rows]), log.fan)
        claimed = np.column_stack([claims["x"], claims["y"]])
    if position is None:
        position = np.zeros((len(rows), 2))
    number = {landmark: k for k, landmark in enumerate(matched.ids)}
    landmark = np.array([number[i] for i in table.landmark[rows].tolist()], dtype=np.int64)
    sure = table.visible[rows] >= min_visible
    return _Sightings(
        rows=_Points(when, landmark, position, sure),
        claims=_Points(
            of_index[claims["at"]],
            claims["cell"] % len(matched.ids),
            claimed,
            np.ones(len(claims), bool),
        ),
        frames=frames,
        stretch=stretch,
        gate_m=matched.gate_m,
        in_pixels=table.position is not None and table.position[0] == "pixel",
    )


Way = Callable[[FloatArray], FloatArray]
"""From (n, 2) positions as stated to those that were meant."""


def _reason(both: _Sightings, log: LogResults) -> str | None:
    """How rows and claims fit clearly better than as given, if that explains nearly all of them.

    Empty if others fit clearly better, but none explains it; None if they fit best as given. One
    other reading is tried first, then several at once.
    """
    rows = both.rows
    sure = rows.of(rows.sure)
    sample = sure.of(slice(None, None, -(-len(sure.frame) // MOST_ROWS)))
    most = min(MOST_SHIFT, int(np.ptp(both.frames)))
    ways = _other_positions(log, both.in_pixels)
    fits: dict[tuple[str, ...], FloatArray] = {(): both.fits(sample, most)}
    given = float(fits[()][most])
    explained, doubtful = min(both.meeting(rows).shares) >= NEARLY_ALL, False
    for count in (1,) if explained else (1, 2, 3):
        for words in combinations(ways, count):
            fits[words] = both.fits(_placed(sample, words, ways), most)
        # With the frames as they are; and moved by those that fit best, if these are not the last.
        readings = [(float(fit[most]), words, 0) for words, fit in fits.items()]
        for words, fit in fits.items():
            if len(words) < count and 0 < (best := int(fit.argmax())) < 2 * most:
                readings.append((float(fit[best]), words, best - most))
        best_fit, words, shift = max(readings, key=lambda reading: reading[0])
        moved = _placed(rows, words, ways)
        moved = moved._replace(frame=moved.frame + shift)
        better = best_fit > given + BETTER
        if better and _explains(both.meeting(moved), int(rows.sure.sum())):
            return " and ".join([*words, *([_shift(shift, log)] if shift else [])])
        doubtful = doubtful or better
    return "" if doubtful else None


def _any_reason(both: _Sightings, log: LogResults, ids: Sequence[int]) -> str | None:
    """As `_reason`, also if IDs, or a scale or an offset of positions, explain it."""
    if other := _other_ids(both, ids):
        return other
    if reason := _reason(both, log):
        return reason
    explained = min(both.meeting(both.rows).shares) >= NEARLY_ALL
    return ("" if explained and reason is None else _other_scale(both)) or reason


def _other_ids(both: _Sightings, ids: Sequence[int]) -> str:
    """Which IDs nearly all rows would need to meet claims; empty if none, or if of several IDs only
    one is another: the method may confuse it."""
    row, claim = both.near(both.rows)
    counts = np.zeros((len(ids),) * 2, np.int64)  # of a row's ID and the claimed one
    np.add.at(
        counts, (both.rows.landmark[row], both.claims.landmark[claim]), 1 * both.rows.sure[row]
    )
    seen = counts.any(axis=1)
    claimed = np.where(seen, counts.argmax(axis=1), np.arange(len(ids)))
    named = np.flatnonzero(seen).tolist()
    moved = [k for k in named if claimed[k] != k]
    meant = both.meeting(both.rows._replace(landmark=claimed[both.rows.landmark]))
    few = not moved or (len(moved) == 1 and named != moved)
    if few or not _explains(meant, int(both.rows.sure.sum())):
        return ""
    return "if `landmark` " + ", ".join(f"{ids[k]} were ID.{ids[claimed[k]]}" for k in moved)


def _other_scale(both: _Sightings) -> str:
    """By which scales and offsets of positions nearly all rows meet claims; empty if by none."""
    sure = both.rows.of(both.rows.sure)
    row, claim = equal_pairs(sure.frame, both.claims.frame)
    same = sure.landmark[row] == both.claims.landmark[claim]
    if same.sum() < FEWEST:
        return ""
    stated, claimed, moved = (
        np.column_stack(polar_from_plane(position))
        for position in (
            sure.position[row[same]],
            both.claims.position[claim[same]],
            both.rows.position,
        )
    )
    words, scales = [], []
    for k, (name, unit, least) in enumerate((("range", "m", 0.1), ("bearing", "deg", 1.0))):
        scale, offset = _line(stated[:, k], claimed[:, k])
        scales.append(abs(scale))
        moved[:, k] = scale * moved[:, k] + offset
        if scale != 1 or abs(offset) > least:
            times = f" times {scale:.3g}" if scale != 1 else ""
            moved_by = f" {offset:+.2g} {unit}" if abs(offset) > least else ""
            words.append(f"{name} were that stated{times}{moved_by}")
    meant = both.meeting(both.rows._replace(position=plane_from_polar(*moved.T)))
    fits = words and min(scales) > LEAST_SCALE and _explains(meant, int(both.rows.sure.sum()))
    return f"if {' and '.join(words)}" if fits else ""


def _line(stated: FloatArray, claimed: FloatArray) -> tuple[float, float]:
    """(scale, offset) from (n,) stated to (n,) claimed values, by medians, since some claims do not
    fit. The scale is 1 if the values hardly differ."""
    order = np.argsort(stated)
    low, high = order[: len(order) // 2], order[-(len(order) // 2) :]
    run = stated[high] - stated[low]
    scale = 1.0
    if np.median(run) > LEAST_SPREAD:
        scale = float(np.median((claimed[high] - claimed[low])[run > 0] / run[run > 0]))
        scale = 1.0 if abs(scale - 1) <= SAME_SCALE else scale
    return scale, float(np.median(claimed - scale * stated))


def _part(both: _Sightings, log: LogResults) -> str:
    """How many rows, a part, would meet claims in another reading than the others, and in which."""
    rest, rows = both.rest(), int(both.rows.sure.sum())
    on_others = int(rest.rows.sure[np.unique(rest.near(rest.rows)[0])].sum())
    if rows >= FEWEST_CLAIMS and on_others > OTHER_IDS * rows:
        return f"{on_others} of {rows} rows lie on claims of other IDs"
    row, claim = equal_pairs(rest.rows.frame, rest.claims.frame)
    same = rest.rows.landmark[row] == rest.claims.landmark[claim]
    rivals = replace(rest, rows=rest.rows.of(np.unique(row[same])))  # without misses
    for words, way in _other_positions(log, both.in_pixels).items():
        meeting = rivals.meeting(rivals.rows._replace(position=way(rivals.rows.position)))
        if _explains(meeting, len(rivals.rows.frame)) and meeting.rows_met > PART * rows:
            return f"{meeting.rows_met} of {rows} rows would meet claims only {words}"
    return ""


def _explains(meeting: _Meeting, rows: int) -> bool:
    """Whether nearly all rows and claims meet. rows: how many there are, also beyond the log."""
    enough = min(meeting.rows, meeting.claims) >= FEWEST and 2 * meeting.rows >= rows
    return enough and min(meeting.shares) >= NEARLY_ALL


def _other_positions(log: LogResults, in_pixels: bool) -> dict[str, Way]:
    """The ways in which positions may have been stated, in words."""
    ways: dict[str, Way] = {
        "with the sign of their bearings reversed": lambda position: position * (-1, 1),
        "with bearings in radians": lambda position: _radians(*polar_from_plane(position)),
    }
    if log.fan is not None:
        ends_m = log.fan.range_min_m + log.fan.range_max_m

        def from_other_end(position: FloatArray) -> FloatArray:
            range_m, bearing_deg = polar_from_plane(position)
            return plane_from_polar(ends_m - range_m, bearing_deg)

        ways["with the other --range-order"] = from_other_end
    if in_pixels and (fan := log.fan) is not None:

        def exchanged(position: FloatArray) -> FloatArray:
            x_px, y_px = pixel_from_plane(fan, position).T
            return plane_from_polar(*polar_from_pixel(fan, y_px, x_px))

        ways["with x_px and y_px exchanged"] = exchanged
    return ways


def _radians(range_m: FloatArray, bearing: FloatArray) -> FloatArray:
    return plane_from_polar(range_m, np.degrees(bearing))


def _placed(rows: _Points, words: tuple[str, ...], ways: Mapping[str, Way]) -> _Points:
    """The rows with their positions read in these ways."""
    for word in words:
        rows = rows._replace(position=ways[word](rows.position))
    return rows


def _shift(frames: int, log: LogResults) -> str:
    text = f"{number_of(abs(frames), 'frame')} {'later' if frames > 0 else 'earlier'}"
    if log.timestamp_ns is not None:
        step_s = float(np.median(np.diff(np.sort(log.timestamp_ns)))) / 1e9
        text += f" ({abs(frames) * step_s:.3g} s)"
    return text


def _off(matched: Matched, log: LogResults) -> Iterator[str]:
    """What is said if the claims that are right all lie as far off in range or orientation."""
    right = judge(matched, "strict")
    right = right[right["declared"] & (right["method"] == 0) & (right["truth"] >= 0)]
    claims, truths = matched.claims[right["claim"]], matched.truths[right["truth"]]
    range_m, stated_m = (np.hypot(points["x"], points["y"]) for points in (claims, truths))
    if len(right) < FEWEST:
        return
    off_m = float(np.median(range_m - stated_m))
    spread_m = float(np.median(np.abs(range_m - stated_m - off_m)))
    if abs(off_m) > log.landmarks.radius_m / 2 and spread_m < abs(off_m) / 4:
        nearer = "nearer" if off_m > 0 else "farther"
        yield (
            f"lie {abs(off_m):.2f} m {nearer} in range than the claims on them, throughout; "
            "range_m is the slant range to a landmark's middle, not that along the floor"
        )
    rotation = errors_of(matched, right)["orientation"]["value"]
    if len(rotation) >= FEWEST and (median := float(np.median(rotation))) > MOST_ROTATION_DEG:
        yield (
            f"have orientations that differ by {median:.0f} deg, in the median, from those of the "
            "claims on them; orientation_deg is in degrees, counter-clockwise from the right"
        )


def _without_rows(matched: Matched, claims: Table) -> Iterator[str]:
    """What is said if rows are on some frames only, or a long beginning or end has none, and most
    of the other frames have claims."""
    if len(unseen := _between_rows(matched, claims)):
        labelled = len(np.unique(matched.truths["at"]))
        yield (
            f"are on {labelled} of {len(matched.frame)} frames, and claims in {len(unseen)} "
            "frames between two with a row of the same ID count as false; label these, or add "
            "--labelled-only if they have no row at all"
        )
        return
    first, last = matched.truths["at"].min(), matched.truths["at"].max()
    claimed = np.unique(claims["at"])
    frames = len(matched.frame)
    for length, seen, word in (
        (first, claimed < first, f"begin at frame {matched.frame[first]}"),
        (frames - 1 - last, claimed > last, f"end at frame {matched.frame[last]}"),
    ):
        if length > LEAST_STRETCH * frames and seen.sum() > length / 2:
            yield (
                f"{word}, and {seen.sum()} of the {length} frames without one have claims, "
                "which count as false; label each frame, or add --labelled-only"
            )


def _between_rows(matched: Matched, claims: Table) -> IntArray:
    """The frames, by index, that seem to lack a row: of an ID with rows before and behind, and most
    frames between claimed. Empty if these are few."""
    ids = len(matched.ids)
    rows, claimed = (np.unique(table["cell"]) for table in (matched.truths, claims))
    # Where a row lacks a claim, a claim of another ID lies on its landmark.
    confused = np.unique(np.setdiff1d(rows, claimed) // ids)
    claimed = claimed[~np.isin(claimed // ids, confused)]
    # One ID after the other, by frame.
    rows, claimed = (
        np.sort(cell % ids * len(matched.frame) + cell // ids) for cell in (rows, claimed)
    )
    claimed = np.setdiff1d(claimed, rows)
    behind = np.searchsorted(rows, claimed)
    inner = (behind > 0) & (behind < len(rows))
    behind, claimed = behind[inner], claimed[inner]
    same = rows[behind] // len(matched.frame) == rows[behind - 1] // len(matched.frame)
    between = np.bincount(behind[same], minlength=len(rows))
    lacks = 2 * between[1:] > np.diff(rows) - 1
    unseen = claimed[same & np.append(False, lacks)[behind]]
    enough = len(unseen) > UNSEEN * (len(rows) + len(unseen))
    return np.unique(unseen % len(matched.frame)) if enough else unseen[:0]
