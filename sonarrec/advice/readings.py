"""What claims tell of a truth: signs that its rows mean something else than they state.

The rows of a truth, also those that matching drops, are compared with the claims of the leading
method. These checks follow one another, and the first that finds something ends the search:

1. Would all rows fit clearly better in another reading: with other IDs, with positions or frames
   stated in another way, with another scale or offset? It is named as the reason only if nearly all
   rows and claims meet under it. If others fit clearly better but none explains the difference, or
   if hardly any rows and claims meet, the note says what was seen and gives no reason.
2. Would a part of the rows fit better in another reading, or a half of them at other frames?
3. Do frames with claims lack rows?
4. Do many claims lie where no row is? Are right claims all as far off in range, or in orientation,
   or exactly on rows? These are no more than notes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from sonarrec.advice.truth import FEWEST
from sonarrec.arrays import FloatArray, IntArray, Table
from sonarrec.errors import Advice, number_of
from sonarrec.evaluation.counts import errors_of
from sonarrec.evaluation.rows import Matched, ScoringOptions, equal_pairs, judge
from sonarrec.results.read import LogResults
from sonarrec.sonar.geometry import (
    pixel_from_polar,
    plane_from_polar,
    plane_position,
    polar_from_pixel,
    polar_from_plane,
)
from sonarrec.truth.table import TruthTable

MOST_ROWS = 500  # are asked which reading fits; more add nothing
MOST_SHIFT = 500  # frames by which the truth may be early or late
MOST_PART_SHIFT = 50  # frames by which a half of it may be
BETTER = 0.05  # by which another reading must fit better; with right truths none ever did
NEARLY_ALL = 0.8  # of rows and of claims agree under the reading that is named as the reason
PART = 0.1  # of the rows, that were stated in another way than the others
UNSEEN = 0.1  # of an ID's frames are claimed, between two frames with its row, and have none
OTHER_IDS = 0.25  # of the rows lie on claims of other IDs; a method confuses fewer
SAME_SCALE = 0.04  # difference from 1 that counts as none
LEAST_SCALE = 0.1  # with less, claims hardly depend on rows
LEAST_SPREAD = 0.05  # m or deg, of values that show a scale
MOST_EVERY = 30  # frames from one that was labelled to the next
FEW = 0.1  # of rows and of claims meet by chance in a truth of another log
FEWEST_CLAIMS = 20  # of which a few right ones may be chance
SAME_M = 5e-4  # of labels and claims made by different means, which differ by millimetres at least
MOST_ROTATION_DEG = 20.0  # by which right claims differ, in the median
LEAST_ROTATION_DEG, CLEARLY = 6.0, 10  # if labels run clockwise; how much more sums then agree
LEAST_STRETCH = 0.25  # of the log, without a row, at its beginning or end


def of_claims(
    table: TruthTable, log: LogResults, matched: Matched, options: ScoringOptions
) -> Iterator[Advice]:
    """Whether claims tell that rows mean something else, or that frames lack rows.

    matched: of all frames of the log; its leading method is asked.
    """
    both = _sightings(table, log, matched, options)
    rows = int(both.rows["sure"].sum())
    if min(rows, len(both.claims)) < FEWEST:
        if rows >= FEWEST_CLAIMS and len(both.claims) and not len(both.met(both.rows)):
            yield Advice(
                f"{table.path}: none of {number_of(len(both.claims), 'claim')} in {log.name} meets "
                f"one of its {rows} rows; check the landmark set, the geometry and this truth"
            )
        return
    for check in (_other_reading, _other_part, _other_half, _without_rows):
        if lines := [*check(both)]:
            yield from (Advice(f"{table.path}: {line}", grave=True) for line in lines)
            return
    for check in (_on_no_row, _off_throughout):
        yield from (Advice(f"{table.path}: {line}") for line in check(both))


class _Meeting(NamedTuple):
    """How many rows there are that are sure, and how many of these lie on frames of the log; how
    many claims on frames with a row; and of both how many meet one of the other."""

    stated: int
    rows: int
    rows_met: int
    claims: int
    claims_met: int

    @property
    def shares(self) -> tuple[float, float]:
        return self.rows_met / max(self.rows, 1), self.claims_met / max(self.claims, 1)

    @property
    def explains(self) -> bool:
        """Whether nearly all rows and claims meet, of enough of them."""
        enough = min(self.rows, self.claims) >= FEWEST and 2 * self.rows >= self.stated
        return enough and min(self.shares) >= NEARLY_ALL

    @property
    def by_chance(self) -> bool:
        """Whether no claim meets a row, or so few that chance explains it."""
        few = self.claims >= FEWEST_CLAIMS and max(self.shares) < FEW
        return few or not self.claims_met


@dataclass(frozen=True, slots=True)
class _Sightings:
    """The rows of the truth on one log, whether or not matching kept them, and the claims that the
    leading method declared.

    Both tables have these columns. frame: by number; by rank in time if the truth names frames by
    time. stretch: that of the frame. landmark: its ID. position: (n, 2) m in the fan plane, 0 if
    protocol strict lacks positions. Rows also have `sure`: whether enough of the landmark is in
    view that a claim is missing without one. Claims also have those of Matched.
    """

    rows: Table
    claims: Table
    frames: IntArray
    """(F,) of the log, as in the tables, rising."""
    log: LogResults
    matched: Matched
    options: ScoringOptions
    in_pixels: bool
    """Whether the positions of the rows are stated so."""

    def pairs(self, rows: Table, most: int = 0) -> Table:
        """The pairs of a row and a claim at most so many frames from it: row, claim (their
        indices), same (whether their IDs are), offset (in gates; NaN if not known)."""
        row, claim = equal_pairs(rows["frame"], self.claims["frame"], most)
        offset_m = np.linalg.norm(rows["position"][row] - self.claims["position"][claim], axis=1)
        same = rows["landmark"][row] == self.claims["landmark"][claim]
        return Table(row=row, claim=claim, same=same, offset=offset_m / self.matched.gate_m)

    def met(self, rows: Table) -> Table:
        """The pairs that meet: of one frame and ID, and within the gate."""
        pairs = self.pairs(rows)
        return pairs[np.flatnonzero(pairs["same"] & (pairs["offset"] <= 1))]

    def meeting(self, rows: Table) -> _Meeting:
        """How these rows and the claims meet."""
        met = self.met(rows)
        return _Meeting(
            stated=int(rows["sure"].sum()),
            rows=int((rows["sure"] & np.isin(rows["frame"], self.frames)).sum()),
            rows_met=int(rows["sure"][np.unique(met["row"])].sum()),
            claims=int(np.isin(self.claims["frame"], rows["frame"]).sum()),
            claims_met=len(np.unique(met["claim"])),
        )

    def come_nearer(self, rows: Table, moved: Table) -> bool:
        """Whether rows come clearly nearer to claims of their ID at other frames. A landmark that
        stays in one position does not: it fits at any time."""
        given, other = (
            np.median(pairs["offset"][pairs["same"]]) if pairs["same"].any() else np.inf
            for pairs in (self.pairs(rows), self.pairs(moved))
        )
        return bool(given > 2 * other)

    def fits(self, rows: Table, most: int) -> FloatArray:
        """(2 most + 1,) how near claims come to these rows, 0 to 1 on average, if the rows are
        `most` frames earlier ... as they are ... `most` frames later."""
        total = np.zeros(2 * most + 1)
        for landmark in np.unique(rows["landmark"]):  # of all at once the pairs are too many
            own, claims = (t[t["landmark"] == landmark] for t in (rows, self.claims))
            pairs = replace(self, claims=claims).pairs(own, most)
            # A shift is one within a stretch: pauses are of another length in frames.
            pairs = pairs[own["stretch"][pairs["row"]] == claims["stretch"][pairs["claim"]]]
            shift = claims["frame"][pairs["claim"]] - own["frame"][pairs["row"]] + most
            near = np.zeros((len(own), 2 * most + 1), np.float32)
            # fmax: it is 0 where a position is not known.
            np.fmax.at(near, (pairs["row"], shift), 1 - np.minimum(pairs["offset"], 1))
            total += near.sum(axis=0)
        return np.asarray(total / len(rows))


def _sightings(
    table: TruthTable, log: LogResults, matched: Matched, options: ScoringOptions
) -> _Sightings:
    """The rows on a log that are at all in view, and the claims of the leading method."""
    claims = matched.claims
    claims = claims[claims["declared"] & (claims["method"] == 0)]
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
    before = np.searchsorted(frames, when, "right") - 1  # rows may lie beyond the log
    return _Sightings(
        rows=Table(
            frame=when,
            stretch=stretch[before.clip(0)],
            landmark=table.landmark[rows],
            position=np.zeros((len(rows), 2)) if position is None else position,
            sure=table.visible[rows] >= options.min_visible,
        ),
        claims=claims.with_columns(
            frame=of_index[claims["at"]], stretch=log.stretch[claims["at"]], position=claimed
        ),
        frames=frames,
        log=log,
        matched=matched,
        options=options,
        in_pixels=table.position is not None and table.position[0] == "pixel",
    )


# All rows in another reading


def _other_reading(both: _Sightings) -> Iterator[str]:
    """Whether the rows fit clearly better in another reading, or hardly fit at all."""
    seen, reason, doubtful = both.meeting(both.rows), "", False
    if both.matched.placed:
        reason = _other_ids(both)
        if not reason:
            reason, doubtful = _other_statement(both, seen.explains)
        if not reason and (doubtful or not seen.explains):
            reason = _other_scale(both) or _other_numbers(both)
    name = both.log.name
    if reason:
        yield f"its rows would fit the claims in {name} clearly better {reason}; check it"
    elif text := _bearings_alone(both):
        yield (
            f"{text} in {name}; is this its truth, with bearings from the sonar's axis, not from "
            "north?"
        )
    elif seen.by_chance or (doubtful and seen.shares[1] < NEARLY_ALL):  # else rows are missed
        claimed = seen.claims or len(both.claims)  # all, if none is on a frame with a row
        yield (
            f"{seen.rows_met} of {number_of(seen.rows, 'row')} on {name} and {seen.claims_met} of "
            f"{number_of(claimed, 'claim')} of {both.matched.methods[0]} meet; check that this is "
            "its truth, and its positions, times and units"
        )


def _other_ids(both: _Sightings) -> str:
    """Which IDs nearly all rows would need to meet claims; empty if none, or if of several IDs only
    one is another: the method may confuse it."""
    pairs = both.pairs(both.rows)
    near = pairs[both.rows["sure"][pairs["row"]] & (pairs["offset"] <= 1)]
    stated, claimed = both.rows["landmark"][near["row"]], both.claims["landmark"][near["claim"]]
    meant = dict[int, int]()  # the ID that is claimed most often on the rows of each
    for landmark in np.unique(stated).tolist():
        ids, count = np.unique(claimed[stated == landmark], return_counts=True)
        meant[landmark] = int(ids[count.argmax()])
    other = {landmark: another for landmark, another in meant.items() if landmark != another}
    if not other or (len(other) == 1 and len(meant) > 1):
        return ""
    landmarks = [meant.get(landmark, landmark) for landmark in both.rows["landmark"].tolist()]
    if not both.meeting(both.rows.with_columns(landmark=landmarks)).explains:
        return ""
    return "if `landmark` " + ", ".join(f"{k} were ID.{another}" for k, another in other.items())


Way = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""From (n,) slant ranges in m and bearings in deg as stated to those that were meant."""


def _ways(both: _Sightings) -> dict[str, Way]:
    """The ways in which positions may have been stated, in words."""
    ways: dict[str, Way] = {
        "with the sign of their bearings reversed (or the other --flip)": lambda r, b: (r, -b),
        "with bearings in radians": lambda r, b: (r, np.degrees(b)),
    }
    if (fan := both.log.fan) is not None:
        ends_m = fan.range_min_m + fan.range_max_m
        ways["with the other --range-order of run"] = lambda r, b: (ends_m - r, b)
        if both.in_pixels:
            ways["with x_px and y_px exchanged"] = lambda r, b: polar_from_pixel(
                fan, *pixel_from_polar(fan, r, b)[::-1]
            )

            def from_below(r: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
                column, row = pixel_from_polar(fan, r, b)
                return polar_from_pixel(fan, column, fan.rows - 1 - row)

            ways["with y_px counted from the top row"] = from_below
    return ways


def _read(rows: Table, *ways: Way) -> Table:
    """The rows with their positions read in these ways."""
    polar = polar_from_plane(rows["position"])
    for way in ways:
        polar = way(*polar)
    return rows.with_columns(position=plane_from_polar(*polar))


def _other_statement(both: _Sightings, explained: bool) -> tuple[str, bool]:
    """(how rows fit clearly better than as given, if that explains nearly all of them, else empty;
    whether others fit clearly better at all).

    Positions may have been stated in other ways, and frames be early or late. One change is tried
    first; then several at once, unless nearly all is explained as given.
    """
    ways, sure = _ways(both), both.rows[both.rows["sure"]]
    sample = sure[:: -(-len(sure) // MOST_ROWS)]
    most = min(MOST_SHIFT, int(np.ptp(both.frames)))
    fits: dict[tuple[str, ...], FloatArray] = {(): both.fits(sample, most)}
    given, doubtful = float(fits[()][most]), False
    for count in (1,) if explained else (1, 2, 3):
        for words in combinations(ways, count):
            fits[words] = both.fits(_read(sample, *(ways[word] for word in words)), most)
        # With the frames as they are; and moved by those that fit best, if these are not the last.
        readings = [(float(fit[most]), words, 0) for words, fit in fits.items()]
        for words, fit in fits.items():
            if len(words) < count and 0 < (best := int(fit.argmax())) < 2 * most:
                readings.append((float(fit[best]), words, best - most))
        best_fit, words, shift = max(readings, key=lambda reading: reading[0])
        if best_fit <= given + BETTER:
            continue
        doubtful = True
        moved = _read(both.rows, *(ways[word] for word in words))
        if both.meeting(moved.with_columns(frame=moved["frame"] + shift)).explains:
            return " and ".join([*words, *([_shift(shift, both.log)] if shift else [])]), True
    return "", doubtful


def _shift(frames: int, log: LogResults) -> str:
    text = f"{number_of(abs(frames), 'frame')} {'later' if frames > 0 else 'earlier'}"
    if log.timestamp_ns is not None:
        step_s = float(np.median(np.diff(np.sort(log.timestamp_ns)))) / 1e9
        text += f" ({abs(frames) * step_s:.3g} s)"
    return text


def _other_scale(both: _Sightings) -> str:
    """By which scales and offsets of positions nearly all rows meet claims; empty if by none."""
    sure = both.rows[both.rows["sure"]]
    pairs = both.pairs(sure)
    pairs = pairs[pairs["same"]]
    if len(pairs) < FEWEST:
        return ""
    claimed = both.claims["position"][pairs["claim"]]
    for statement in _statements(both):
        lines = [
            *map(_line, statement.stated(sure["position"][pairs["row"]]), statement.stated(claimed))
        ]
        if any(abs(scale) <= LEAST_SCALE for scale, _ in lines):
            continue
        words = []
        for (name, unit, least), (scale, offset) in zip(statement.columns, lines, strict=True):
            if scale != 1 or abs(offset) > least:
                times = f" times {scale:.3g}" if scale != 1 else ""
                moved = f" {offset:+.2g} {unit}" if abs(offset) > least else ""
                words.append(f"{name} were that stated{times}{moved}")
        meant = map(np.polyval, lines, statement.stated(both.rows["position"]))
        moved_rows = both.rows.with_columns(position=statement.to_plane(*meant))
        if words and both.meeting(moved_rows).explains:
            other = statement.columns[0][1] == "px" and any(scale != 1 for scale, _ in lines)
            pictures = " (were they measured in other pictures than the fan images?)"
            return f"if {' and '.join(words)}{pictures if other else ''}"
    return ""


def _other_numbers(both: _Sightings) -> str:
    """By which factor nearly all rows meet claims, where every n-th frame was numbered anew."""
    for every in range(2, MOST_EVERY + 1):
        numbered = both.rows.with_columns(frame=every * both.rows["frame"])
        if both.meeting(numbered).explains and both.come_nearer(both.rows, numbered):
            return f"with frame numbers times {every}, as if every {every}th frame had one"
    return ""


class _Statement(NamedTuple):
    """How positions are stated: (name, unit, least offset that counts) of its two columns, and how
    these follow from (n, 2) positions in the fan plane, and back."""

    columns: tuple[tuple[str, str, float], tuple[str, str, float]]
    stated: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
    to_plane: Callable[[FloatArray, FloatArray], FloatArray]


def _statements(both: _Sightings) -> Iterator[_Statement]:
    """The ways to state positions in which a truth may have another scale, its own first."""
    fan = both.log.fan
    if both.in_pixels and fan is not None:
        yield _Statement(
            (("x_px", "px", 3.0), ("y_px", "px", 3.0)),
            lambda position: pixel_from_polar(fan, *polar_from_plane(position)),
            lambda column, row: plane_from_polar(*polar_from_pixel(fan, column, row)),
        )
    polar = ("range", "m", 0.1), ("bearing", "deg", 1.0)
    yield _Statement(polar, polar_from_plane, plane_from_polar)


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


# A part of the rows, or of the frames


def _other_part(both: _Sightings) -> Iterator[str]:
    """Whether a part of the rows would meet claims in another reading than the others."""
    if not both.matched.placed:
        return
    rows, name = int(both.rows["sure"].sum()), both.log.name
    met = both.met(both.rows)
    rest = both.rows[np.setdiff1d(np.arange(len(both.rows)), met["row"])]
    others = both.claims[np.setdiff1d(np.arange(len(both.claims)), met["claim"])]
    unmet = replace(both, rows=rest, claims=others)
    pairs = unmet.pairs(rest)
    on_others = int(rest["sure"][np.unique(pairs["row"][pairs["offset"] <= 1])].sum())
    if rows >= FEWEST_CLAIMS and on_others > OTHER_IDS * rows:
        yield f"{on_others} of {rows} rows lie on claims of other IDs in {name}; check them"
        return
    rivals = rest[np.unique(pairs["row"][pairs["same"]])]  # without misses
    for words, way in _ways(both).items():
        count = unmet.meeting(_read(rivals, way))
        if count.explains and count.rows_met > PART * rows:
            text = f"{count.rows_met} of {rows} rows would meet claims only {words}"
            yield f"{text} in {name}; check them"
            return


def _other_half(both: _Sightings) -> Iterator[str]:
    """Whether the earlier or the later rows would fit clearly better some frames off, as where
    frames are missing in the log."""
    sure, most = both.rows[both.rows["sure"]], min(MOST_PART_SHIFT, int(np.ptp(both.frames)))
    middle = int(np.median(sure["frame"]))
    for where, half in (
        (f"from frame {middle} on", sure[sure["frame"] >= middle]),
        (f"before frame {middle}", sure[sure["frame"] < middle]),
    ):
        if not both.matched.placed or len(half) < FEWEST_CLAIMS:
            continue
        fit = both.fits(half[:: -(-len(half) // MOST_ROWS)], most)
        shift = int(fit.argmax()) - most
        moved = half.with_columns(frame=half["frame"] + shift)
        better = fit.max() > fit[most] + BETTER and both.come_nearer(half, moved)
        if better and abs(shift) < most and both.meeting(moved).explains:
            fits = f"would fit the claims in {both.log.name} clearly better"
            yield f"its rows {where} {fits} {_shift(shift, both.log)}; check it"
            return


def _bearings_alone(both: _Sightings) -> str:
    """How many rows have the range of a claim of their ID but another bearing; empty if few."""
    if not both.matched.placed:
        return ""
    sure = both.rows[both.rows["sure"]]
    pairs = both.pairs(sure)
    pairs = pairs[pairs["same"]]
    range_m, _ = polar_from_plane(sure["position"][pairs["row"]])
    claimed_m, _ = polar_from_plane(both.claims["position"][pairs["claim"]])
    near = np.abs(range_m - claimed_m) <= both.matched.gate_m / 2
    with_claim, of_range, met = (
        len(np.unique(pairs["row"][which]))
        for which in (pairs["row"] >= 0, near, pairs["offset"] <= 1)
    )
    if with_claim < FEWEST_CLAIMS or of_range < NEARLY_ALL * with_claim or 2 * met > with_claim:
        return ""
    return (
        f"{of_range} of {with_claim} rows have the range of a claim of their ID, {met} its bearing"
    )


def _without_rows(both: _Sightings) -> Iterator[str]:
    """Whether rows are on some frames only, or a long beginning or end has none, and most of the
    other frames have claims."""
    matched, its_rows = both.matched, f"its rows for {both.log.name}"
    if both.options.labelled_only or not len(matched.truths):
        return
    rows, claimed = np.unique(matched.truths["at"]), np.unique(both.claims["at"])
    frames = len(matched.frame)
    if unseen := _between_rows(both):
        yield (
            f"{its_rows} are on {len(rows)} of {frames} frames, and claims in {unseen} frames "
            "between two with a row of the same ID count as false; label these, or add "
            "--labelled-only if they have no row at all"
        )
        return
    first, last = rows[[0, -1]]
    for length, seen, word in (
        (first, claimed < first, f"begin at frame {matched.frame[first]}"),
        (frames - 1 - last, claimed > last, f"end at frame {matched.frame[last]}"),
    ):
        if length > LEAST_STRETCH * frames and seen.sum() > length / 2:
            yield (
                f"{its_rows} {word}, and {seen.sum()} of the {length} frames without one have "
                "claims, which count as false; label each frame, or add --labelled-only"
            )


def _between_rows(both: _Sightings) -> int:
    """How many frames seem to lack a row: of an ID with rows before and behind, and most frames
    between claimed. 0 if these are few."""
    ids = len(both.matched.ids)
    rows, claimed = (np.unique(table["cell"]) for table in (both.matched.truths, both.claims))
    # Where a row lacks a claim, a claim of another ID lies on its landmark.
    confused = np.unique(np.setdiff1d(rows, claimed) // ids)
    claimed = np.setdiff1d(claimed[~np.isin(claimed // ids, confused)], rows)
    unseen = list[int]()
    for k in np.unique(rows % ids):
        own, frame = (cells[cells % ids == k] // ids for cells in (rows, claimed))
        behind = np.searchsorted(own, frame)  # which row is next
        inner = (behind > 0) & (behind < len(own))
        between = np.bincount(behind[inner], minlength=len(own))
        lacks = np.append(False, 2 * between[1:] > np.diff(own) - 1)
        unseen += frame[inner][lacks[behind[inner]]].tolist()
    return len({*unseen}) if len(unseen) > UNSEEN * (len(rows) + len(unseen)) else 0


# Notes


def _on_no_row(both: _Sightings) -> Iterator[str]:
    """Whether many claims lie where the truth has nothing."""
    if not both.matched.placed:
        return
    pairs = both.pairs(both.rows)
    on_a_row = pairs["claim"][pairs["offset"] <= 1]
    alone = np.setdiff1d(np.arange(len(both.claims)), on_a_row)
    if both.options.labelled_only:
        alone = alone[np.isin(both.claims["frame"][alone], both.rows["frame"])]
    if len(alone) < max(FEWEST_CLAIMS, PART * len(both.claims)):
        return
    lonely, where = both.claims[alone], []
    for landmark in np.unique(lonely["landmark"]).tolist():
        frames = np.unique(both.matched.frame[lonely["at"][lonely["landmark"] == landmark]])
        where.append(f"ID.{landmark} in {number_of(len(frames), 'frame')} from {frames[0]} on")
    yield (
        f"{len(alone)} of {len(both.claims)} claims in {both.log.name} lie where it has no row and "
        f"count as false ({', '.join(where)}); if landmarks are there, also at the image's edge, "
        "they lack rows"
    )


def _off_throughout(both: _Sightings) -> Iterator[str]:
    """Whether the claims that are right all lie as far off in range or orientation."""
    matched, its_rows = both.matched, f"its rows for {both.log.name}"
    if not matched.placed:
        return
    right = judge(matched, "strict")
    right = right[right["declared"] & (right["method"] == 0) & (right["truth"] >= 0)]
    if len(right) < FEWEST:
        return
    claims, truths = matched.claims[right["claim"]], matched.truths[right["truth"]]
    distance_m = float(np.median(errors_of(matched, right)["position"]["value"]))
    if distance_m < SAME_M:
        yield (
            f"{its_rows} lie on the claims to {distance_m:.1g} m; if they were made from results "
            "and not checked, rates say nothing"
        )
    off_each = np.hypot(claims["x"], claims["y"]) - np.hypot(truths["x"], truths["y"])
    off_m = float(np.median(off_each))
    spread_m = float(np.median(np.abs(off_each - off_m)))
    if abs(off_m) > both.log.landmarks.radius_m / 2 and spread_m < abs(off_m) / 4:
        nearer = "nearer" if off_m > 0 else "farther"
        yield (
            f"{its_rows} lie {abs(off_m):.2f} m {nearer} in range than the claims on them, "
            "throughout; range_m is the slant range to a landmark's middle, not that along the "
            "floor"
        )
    rotation = errors_of(matched, right)["orientation"]["value"]
    if len(rotation) < FEWEST:
        return
    median, period = float(np.median(rotation)), [matched.period_deg[i] for i in right["landmark"]]
    # Of labels that run clockwise, the sum with what is claimed is the same everywhere.
    spread, spread_of_sum = (
        1 - abs(np.nanmean(np.exp(2j * np.pi * angle / period)))
        for angle in (
            claims["orientation"] - truths["orientation"],
            claims["orientation"] + truths["orientation"],
        )
    )
    is_mirrored = median > LEAST_ROTATION_DEG and spread > CLEARLY * spread_of_sum
    if median > MOST_ROTATION_DEG or is_mirrored:
        yield (
            f"{its_rows} have orientations that differ by {median:.0f} deg, in the median, from "
            "those of the claims on them; orientation_deg is in degrees, counter-clockwise from "
            "the right"
        )
