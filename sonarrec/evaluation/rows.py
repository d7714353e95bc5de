"""Rows: the claims and the truth of one log as two tables, and what each claim adds to the counts.

Everything is counted from one list per method: its claims by falling score, each with what it adds
to TP, TN, FP and FN after those before it. Without thresholds the sum over the declared claims is
the operating point; the cumulative sum over all claims is the ROC.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray, Table, begins
from sonarrec.errors import UsageError
from sonarrec.passes import pass_begins
from sonarrec.results.columns import in_order
from sonarrec.results.read import LogResults
from sonarrec.sonar.stated import Sonar, sonar_from
from sonarrec.truth.match import Truth

PROTOCOLS = ("paper", "strict")
COUNTS = ["tp", "tn", "fp", "fn"]
DIGITS = 6
"""Of a score: claims are counted by score, so that memory does not grow with their number."""
ROUNDING_M = 1e-9
"""A claim exactly on the gate counts as inside, despite rounding."""
PAPER_MIN_VISIBLE = 0.5
"""The share of a disc in view from which protocol paper counts it. TP + FN of Tables 4 and 5 are
those of frames with its centre, or half the disc, in view."""

SHORT = 5
"""Frames; a log of fewer may be shorter than the tolerance."""


@dataclass(frozen=True, slots=True)
class ScoringOptions:
    """How results are read and compared with truth."""

    min_visible: float = 0.9
    """Under protocol strict a landmark counts if at least this share of its disc is in view."""
    tolerance_s: float | None = None
    """For truth matched by time; None: half the time between frames."""
    landmarks: str | None = None
    """Landmark set, in place of that of run.toml."""
    sonar: Sonar | None = None
    """Geometry that takes precedence over run.toml."""
    within_m: float | None = None
    """Under protocol strict a claim must lie this near; None: within half a disc or plate."""
    methods: tuple[str, ...] = ()
    """Those that are scored or shown, the leading one first; all if none is named."""
    labelled_only: bool = False
    """Whether only frames count that have a row of truth, of a landmark or `none`."""

    def check(self) -> None:
        """Raises UsageError if an option is invalid."""
        if not 0 <= self.min_visible <= 1:
            raise UsageError(
                f"--min-visible is a share of the disc, 0 to 1, not {self.min_visible:g}"
            )
        if not 0 <= (self.tolerance_s or 0) < math.inf:
            raise UsageError(f"--tolerance is a time in s, 0 or more, not {self.tolerance_s:g}")
        if self.within_m is not None and not 0 < self.within_m < math.inf:
            raise UsageError(f"--within is a distance in m above 0, not {self.within_m:g}")

    def check_against(self, log: LogResults) -> None:
        """Raises UsageError if an option is larger than the log, so that anything would match."""
        within_m, tolerance_s, times = self.within_m or 0, self.tolerance_s or 0, log.timestamp_ns
        size_m = math.inf if log.fan is None else log.fan.window_m
        if within_m > size_m:
            raise UsageError(
                f"--within is a distance in m; {within_m:g} m is more than the {size_m:g} m of "
                f"range that {log.name} shows; {within_m:g} cm are {within_m / 100:g}"
            )
        length_s = math.inf if times is None or len(times) < SHORT else np.ptp(times) / 1e9
        if tolerance_s > length_s:
            raise UsageError(
                f"--tolerance is a time in s; {tolerance_s:g} s is more than the {length_s:.4g} s "
                f"of {log.name}; {tolerance_s:g} ms are {tolerance_s / 1000:g}"
            )


DEFAULT = ScoringOptions()


def scoring_options(
    method: str | Sequence[str] = (),
    min_visible: float = 0.9,
    tolerance_s: float | None = None,
    landmarks: str | None = None,
    sonar: Sonar | Mapping[str, Any] | None = None,
    within_m: float | None = None,
    labelled_only: bool = False,
) -> ScoringOptions:
    """The options that a program passes, by the names of the command's."""
    methods = (method,) if isinstance(method, str) else tuple(method)
    geometry = sonar_from(sonar)
    return ScoringOptions(
        min_visible, tolerance_s, landmarks, geometry, within_m, methods, labelled_only
    )


@dataclass(frozen=True, slots=True)
class Matched:
    """The claims and the truth of one log as tables: F frames, K IDs.

    In both tables `at` is the index of the frame in `frame`, `landmark` the ID, `cell` both, as
    at * K + the index of the ID; x and y are m in the fan plane, orientation is deg; NaN where
    unknown.
    """

    name: str
    ids: tuple[int, ...]
    methods: tuple[str, ...]
    frame: IntArray
    """(F,) the numbers of the frames."""
    stretch: IntArray
    """(F,) the number of the frame's stretch, which rises."""
    truths: Table
    """A row per landmark that is at least partly in view in a frame: at, landmark, cell, x, y,
    orientation; paper, strict: whether enough of it is in view for that protocol; passage: the
    index of the pass that it is part of, -1 if none; unit."""
    claims: Table
    """A row per estimate: method (index into methods), at, landmark, cell, x, y, orientation, score
    (0 to 1, six digits), declared."""
    probability: FloatArray
    """(claims, K + 1) one per ID, then none of these; NaN if not stated."""
    passes: Table
    """A row per pass, by time: passage (its index), landmark, first, last (indices of frames),
    first_frame, last_frame (their numbers), unit."""
    unit: IntArray
    """(F,) the unit of a frame's negatives and false claims."""
    gate_m: float
    """The distance within which a claim is right."""
    period_deg: dict[int, float]
    """Of each ID the smallest rotation after which it looks the same."""
    placed: bool
    """Whether positions are known wherever protocol strict needs them."""

    @property
    def units(self) -> int:
        """How many units; a log without any landmark is one."""
        return int(self.unit.max(initial=0)) + 1


def match(
    log: LogResults, truth: Truth, options: ScoringOptions = DEFAULT, ids: tuple[int, ...] = ()
) -> Matched:
    """Match one log with its truth.

    ids: the log's IDs in the wanted order; others are not used. If only labelled frames count, gaps
    in passes are of these, else each of every 20th frame would be a pass. A truth with `visible` 0
    is none: nothing of the landmark is in view.
    """
    of_set = np.asarray(log.landmarks.ids)
    ids = ids if set(ids) == set(log.landmarks.ids) else log.landmarks.ids
    methods = in_order(log.methods)
    seen, count = truth.visible > 0, len(log.frame_index)
    truths = Table(
        at=truth.frame_index[seen],
        landmark=of_set[truth.landmark_index[seen]],
        **_position_columns(truth.position, len(seen), seen),
        orientation=np.nan if truth.orientation is None else truth.orientation[seen],
        paper=truth.visible[seen] >= PAPER_MIN_VISIBLE,
        strict=truth.visible[seen] >= options.min_visible,
    )
    claims = Table(
        method=np.array([methods.index(name) for name in log.methods], dtype=np.int16)[log.method],
        at=log.frame_index,
        landmark=of_set[log.landmark_index],
        **_position_columns(log.position, count, slice(None)),
        orientation=log.orientation,
        score=np.round(log.score, DIGITS),
        declared=log.declared,
    )
    columns = [*log.landmarks.indices(np.array(ids)).tolist(), len(ids)]
    probability = np.full((count, len(columns)), np.nan, dtype=np.float32)
    if log.probability is not None:
        probability = log.probability[:, columns]
    return matched(
        log.name,
        ids,
        methods,
        log.frame,
        log.stretch,
        truths,
        claims,
        count=np.arange(len(log.frame)) if options.labelled_only else log.frame,
        probability=probability,
        gate_m=options.within_m or log.landmarks.radius_m,
        period_deg=dict(zip(log.landmarks.ids, log.landmarks.periods_deg().tolist(), strict=True)),
        placed=not len(seen)
        or (truth.position is not None and (log.position is not None or not count)),
    )


def matched(
    name: str,
    ids: tuple[int, ...],
    methods: tuple[str, ...],
    frame: IntArray,
    stretch: IntArray,
    truths: Table,
    claims: Table,
    *,
    count: IntArray | None = None,
    **others: Any,
) -> Matched:
    """The log with its passes and units. truths, claims: of Matched, without these and cells.
    count: (F,) numbers by which a gap ends a pass, if not those of the frames."""
    passes, passage = find_passes(truths, frame if count is None else count, stretch)
    unit = unit_of_frames(passes, stretch)
    of_truth = np.where(passage >= 0, np.append(passes["unit"], 0)[passage], unit[truths["at"]])
    index = np.full(max(ids, default=0) + 1, 0)
    index[list(ids)] = np.arange(len(ids))
    truths, claims = (
        t.with_columns(cell=t["at"] * len(ids) + index[t["landmark"]]) for t in (truths, claims)
    )
    return Matched(
        name,
        ids,
        methods,
        frame,
        stretch,
        truths.with_columns(passage=passage, unit=of_truth),
        claims,
        passes=passes.with_columns(
            first_frame=frame[passes["first"]], last_frame=frame[passes["last"]]
        ),
        unit=unit,
        **others,
    )


def _position_columns(position: FloatArray | None, count: int, rows: Any) -> dict[str, FloatArray]:
    """The columns x and y of positions (count, 2); NaN if they are not known."""
    known = np.full((count, 2), np.nan) if position is None else position
    return {"x": known[rows, 0], "y": known[rows, 1]}


# Passes: neighbouring frames show the same disc on the same floor through the same noise. If each
# counted as independent, every difference would look significant.


def find_passes(truths: Table, frame: IntArray, stretch: IntArray) -> tuple[Table, IntArray]:
    """(passes of Matched, without frame numbers; of each truth its pass, -1 if too little of it is
    in view).

    The frames of a pass are those with the whole landmark in view; landmarks of one ID that are in
    view together are one pass. Passes that overlap by more than half of the shorter one are one
    unit, since landmarks seen together are seen equally well.

    frame, stretch: (F,) as in LogResults.
    """
    counted = np.flatnonzero(truths["strict"])
    counted = counted[np.lexsort((truths["at"][counted], truths["landmark"][counted]))]
    index, landmark = truths["at"][counted], truths["landmark"][counted]
    new = pass_begins(frame[index], stretch[index], landmark)
    begin = np.flatnonzero(new)
    end = np.append(begin[1:], len(index))[: len(begin)] - 1
    first, last = index[begin], index[end]
    order = np.lexsort((last, first))
    passage = np.full(len(truths), -1)
    passage[counted] = np.argsort(order)[np.cumsum(new) - 1]
    first, last = first[order], last[order]
    return Table(
        passage=np.arange(len(order)),
        landmark=landmark[begin][order],
        first=first,
        last=last,
        unit=_units(first, last),
    ), passage


def _units(first: IntArray, last: IntArray) -> IntArray:
    """(P,) the unit of each pass, by the indices of their first and last frames."""
    unit, begin, end = list[int](), 0, -1  # of the present unit: its first and last frame
    for a, b in zip(first.tolist(), last.tolist(), strict=True):
        if unit and 2 * (min(b, end) - a + 1) > min(b - a, end - begin) + 1:
            end = max(b, end)
            unit.append(unit[-1])
        else:
            begin, end = a, b
            unit.append(unit[-1] + 1 if unit else 0)
    return np.array(unit, dtype=int)


def unit_of_frames(passes: Table, stretch: IntArray) -> IntArray:
    """(F,) the unit of what is not part of a pass: IDs not in view and false claims.

    It is the unit nearest in time, with the border half-way between neighbours, since a distractor
    also lasts over many frames, or where a stretch begins between them.
    """
    if not len(passes):
        return np.zeros(len(stretch), dtype=int)
    begin = np.flatnonzero(begins(passes["unit"]))
    first, last = passes["first"][begin], np.maximum.reduceat(passes["last"], begin)
    borders = (last[:-1] + first[1:]) / 2
    # Where stretches begin between two units, the border is at that nearest to half-way.
    starts = np.flatnonzero(np.diff(stretch)) + 0.5
    for n, border in enumerate(borders):
        between = starts[(starts > last[n]) & (starts < first[n + 1])]
        if len(between):
            borders[n] = between[np.abs(between - border).argmin()]
    return np.searchsorted(np.maximum.accumulate(borders), np.arange(len(stretch)))


# Right and false claims


def equal_pairs(a: IntArray, b: IntArray, within: int = 0) -> tuple[IntArray, IntArray]:
    """Indices of all pairs of an a and a b that differ by at most `within`, by a, then by b."""
    order = np.argsort(b, kind="stable")
    low = np.searchsorted(b[order], a - within)
    count = np.searchsorted(b[order], a + within, "right") - low
    first = np.repeat(np.arange(len(a)), count)
    nth = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
    return first, order[low[first] + nth]


def nearest_truth(claims: Table, log: Matched, same: str) -> IntArray:
    """(claims,) the row of the nearest truth of the same `at` or `cell`, -1 if none is within the
    gate."""
    claim, truth = equal_pairs(claims[same], log.truths[same])
    off_m = np.hypot(*(claims[axis][claim] - log.truths[axis][truth] for axis in "xy"))
    near = np.flatnonzero(off_m <= log.gate_m + ROUNDING_M)
    near = near[np.argsort(off_m[near], kind="stable")][::-1]  # the nearest is set last
    nearest = np.full(len(claims), -1)
    nearest[claim[near]] = truth[near]
    return nearest


def truth_beneath(log: Matched) -> IntArray:
    """For each claim the nearest truth of any ID in its frame, -1 if none is within the gate."""
    return nearest_truth(log.claims, log, "at")


def positives(log: Matched, protocol: str) -> IntArray:
    """The rows of the truths that are FN without any claim; under protocol paper one per frame and
    ID."""
    rows = np.flatnonzero(log.truths[protocol])
    if protocol == "paper":  # if possible one that is part of a pass
        rows = rows[np.argsort(~log.truths["strict"][rows], kind="stable")]
        rows = np.sort(rows[np.unique(log.truths["cell"][rows], return_index=True)[1]])
    return rows


def present(log: Matched, protocol: str) -> BoolArray:
    """(F * K,) whether an ID is in view in a frame, so that it is no TN."""
    seen = np.zeros(len(log.frame) * len(log.ids), dtype=bool)
    truths = log.truths[positives(log, protocol)] if protocol == "paper" else log.truths
    seen[truths["cell"]] = True
    return seen


def judge(log: Matched, protocol: str) -> Table:
    """The claims that count: claim (its row), method, landmark, score, declared,
    truth (the row of which it is a right claim, else -1), absent (its ID is not in view), spot and
    unit.

    spot: what it claims (a cell, or one truth). unit: that of its truth if it is right, else that
    of its frame, so that a claim changes the unit that has its positive or negative.
    """
    claims, rows = log.claims, positives(log, protocol)
    cell, counts = claims["cell"], np.ones(len(claims), dtype=bool)
    if protocol == "paper":  # positions play no part
        of_cell = np.full(len(log.frame) * len(log.ids), -1)
        of_cell[log.truths["cell"][rows]] = rows
        truth, spot = of_cell[cell], cell
    else:  # claims on a truth that is only partly in view do not count
        truth = nearest_truth(claims, log, "cell")
        counts = np.append(log.truths[protocol], True)[truth]
        spot = np.where(truth >= 0, -1 - truth, cell)
    judged = Table(
        claim=np.arange(len(claims)),
        **{name: claims[name] for name in ("method", "landmark", "score", "declared")},
        truth=truth,
        absent=~present(log, protocol)[cell],
        spot=spot,
        unit=np.where(truth >= 0, np.append(log.truths["unit"], 0)[truth], log.unit[claims["at"]]),
    )
    return judged[counts]


def effects(judged: Table, protocol: str) -> Table:
    """The judged claims with what each adds to TP, TN, FP and FN of its method after those of a
    higher score. Further claims of a spot count differently from the first."""
    spot = judged["spot"] * (int(judged["method"].max(initial=0)) + 1) + judged["method"]
    order = np.lexsort((-judged["score"], spot))
    first = np.zeros(len(judged), dtype=bool)
    first[order] = begins(spot[order])
    right, absent = judged["truth"] >= 0, judged["absent"]
    tp, fp = (right, ~right & first) if protocol == "paper" else (right & first, ~(right & first))
    tn, fn = -1 * (absent & first), -1 * (right & first)
    return judged.with_columns(tp=1 * tp, tn=tn, fp=1 * fp, fn=fn)
