"""Ground truth matched to the frames that were processed, and the share of a disc in view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.errors import SonarrecError
from sonarrec.landmarks import LandmarkSet
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import (
    floor_depth,
    ground_range,
    in_image,
    pixel_from_plane,
    plane_position,
    points_on_disc,
)
from sonarrec.tables.read import NONE, line_number
from sonarrec.truth.table import TruthTable


@dataclass(frozen=True, slots=True)
class Truth:
    """The T landmarks in view of one log's processed frames."""

    frame_index: IntArray
    """(T,) into ReadLog.frame."""
    landmark_index: IntArray
    """(T,) into the set's ids; the number of IDs for a stranger."""
    visible: FloatArray
    """(T,) share of the disc, 0 to 1."""
    position: FloatArray | None
    """(T, 2) m in the fan plane, to the right and ahead; None if not known."""
    orientation: FloatArray | None
    """(T,) deg, as in estimates.csv; None without the column."""
    row: IntArray
    """(T,) into the table."""
    rows: int
    """Number of rows of gt.csv on this log; of these `unprocessed` are on frames that were not
    processed, `between` left out because a row with a nearer time has the frame."""
    unprocessed: int
    between: int
    tolerance_ns: float | None
    """Longest time from a row to its frame; None if rows name frames by number."""

    def pixels(self, fan: Fan) -> FloatArray | None:
        """(T, 2) column and row in the fan image; None if positions are not known."""
        return None if self.position is None else pixel_from_plane(fan, self.position)


class ReadLog(Protocol):
    """The frames of one log to which truth is matched; a LogResults is one.

    frame: (F,) numbers, rising. timestamp_ns: (F,) or None. fan: for positions in pixels.
    """

    @property
    def name(self) -> str: ...
    @property
    def landmarks(self) -> LandmarkSet: ...
    @property
    def fan(self) -> Fan | None: ...
    @property
    def frame(self) -> IntArray: ...
    @property
    def timestamp_ns(self) -> IntArray | None: ...


def match_truth(
    table: TruthTable, log: ReadLog, tolerance_s: float | None = None, *, strangers: bool = False
) -> Truth:
    """The truth of one log, cut to the frames in its frames.csv.

    By time, a row belongs to the frame nearest to it, if that is within the tolerance (default:
    half the median time between frames). A frame takes only the rows of the time nearest to it:
    truth denser than the frames must not show one landmark many times. strangers: match the rows on
    objects that are no landmark instead; their landmark_index is the number of IDs.
    Raises SonarrecError on an ID outside the landmark set, or if times cannot be compared.
    """
    rows = table.rows_of(log.name, strangers=strangers)
    ids = np.asarray(log.landmarks.ids)
    known = np.isin(table.landmark[rows], [*ids, NONE])
    if not known.all():
        bad = int(rows[np.argmin(known)])
        raise SonarrecError(
            f"{table.path} line {line_number(table.path, bad)}: landmark {table.landmark[bad]} "
            f"is not in the set {log.landmarks.name!r} ({', '.join(map(str, ids))}) used for "
            f"{log.name}; write its IDs, not track numbers, or name another set with --landmarks"
        )
    keys, tolerance_ns, position = table.keys[rows], None, None
    if table.key == "frame":
        index = np.minimum(np.searchsorted(log.frame, keys), len(log.frame) - 1)
        matched = kept = log.frame[index] == keys
    elif log.timestamp_ns is None:
        raise SonarrecError(
            f"{table.path} names frames by timestamp_ns, but the frames.csv of {log.name} has "
            "no such column; add it, or give the truth by frame"
        )
    else:
        tolerance_ns = _tolerance_ns(log.timestamp_ns, tolerance_s)
        index, matched, kept = match_times(log.timestamp_ns, keys, tolerance_s)
    if table.position is not None:
        position = plane_position(table.position, log.fan)
    row = rows[kept]
    landmark_index = (
        np.full(len(row), len(ids)) if strangers else log.landmarks.indices(table.landmark[row])
    )
    return Truth(
        frame_index=index[kept],
        landmark_index=landmark_index,
        visible=table.visible[row],
        position=None if position is None else position[row],
        orientation=None if table.orientation is None else table.orientation[row],
        row=row,
        rows=len(keys),
        unprocessed=int(np.count_nonzero(~matched)),
        between=int(np.count_nonzero(matched & ~kept)),
        tolerance_ns=tolerance_ns,
    )


def _tolerance_ns(timestamp_ns: IntArray, tolerance_s: float | None) -> float:
    """The tolerance as stated; else half the median time between frames (F,), in any order."""
    if tolerance_s is not None:
        return tolerance_s * 1e9
    steps = np.diff(np.sort(timestamp_ns))
    return float(np.median(steps)) / 2 if len(steps) else 0.0


def match_times(
    timestamp_ns: IntArray, wanted_ns: IntArray, tolerance_s: float | None = None
) -> tuple[IntArray, BoolArray, BoolArray]:
    """Per time in `wanted_ns`: (index of the nearest frame; whether it is within the tolerance;
    whether it is also the time nearest to that frame).

    timestamp_ns: (F,) of the frames. wanted_ns: (R,). tolerance_s: default half the median time
    between frames.
    """
    order = np.argsort(timestamp_ns, kind="stable")
    times = timestamp_ns[order]
    after = np.minimum(np.searchsorted(times, wanted_ns), len(times) - 1)
    before = np.maximum(after - 1, 0)
    near = np.where(times[after] - wanted_ns < wanted_ns - times[before], after, before)
    offset = np.abs(times[near] - wanted_ns)
    matched = offset <= _tolerance_ns(timestamp_ns, tolerance_s)
    # Per frame the nearest time, the earlier of two equally near; all rows of that time stay.
    best = np.lexsort((wanted_ns, offset, near))
    frames, first = np.unique(near[best], return_index=True)
    stamp = np.zeros(len(times), dtype=np.int64)
    stamp[frames] = wanted_ns[best[first]]
    return order[near], matched, matched & (wanted_ns == stamp[near])


UNITS = {"us": 10**3, "ms": 10**6, "s": 10**9}
"""Of times that should be in ns."""
FEWEST_FRAMES = 5
CLEARLY_MORE = 4  # times as many frames have a row if times are read in another unit


QUARTER_NS = 15 * 60 * UNITS["s"]  # clocks of all zones differ by multiples of it
MOST_HOURS = 14  # between a zone's clock and UTC


def wrong_times(timestamp_ns: IntArray, times: IntArray, landmark: IntArray) -> str:
    """What is wrong with times of truth, (R,), of landmarks, (R,), as a clause; else empty.

    timestamp_ns: (F,) of the frames.
    """
    if len(timestamp_ns) < 2 or not len(times):
        return ""
    of_log = f"the log ({timestamp_ns.min()} to {timestamp_ns.max()} ns)"
    if unit := _wrong_unit(timestamp_ns, times):
        return f"fit {of_log} only in {unit}; give them in ns"
    of_seconds = [not (ns % UNITS["s"]).any() for ns in (timestamp_ns, times)]
    if of_seconds == [False, True] and len({*zip(times, landmark, strict=True)}) < len(times):
        return (
            "are whole seconds, so that one ID has several rows at the same; give them as in "
            "frames.csv, or the column frame"
        )
    # In which quarters of an hour would all rows be in the log?
    least = int(timestamp_ns.min()) - int(times.min()) - UNITS["s"]
    most = int(timestamp_ns.max()) - int(times.max()) + UNITS["s"]
    first, last = -(-least // QUARTER_NS), most // QUARTER_NS
    if (
        first == last != 0
        and abs(first) <= 4 * MOST_HOURS
        and not match_times(timestamp_ns, times)[1].any()
    ):
        return f"fit {of_log} only with {first / 4:+g} h; give them by the log's clock"
    return ""


def _wrong_unit(timestamp_ns: IntArray, times: IntArray) -> str:
    """The unit in which times of truth, (R,), clearly are if they are not in ns; else empty.

    In the right unit the rows spread over many frames; in ns all would lie on few, or on none.
    """

    def frames(factor: int) -> int:
        """How many frames have a row."""
        sized = times[np.abs(times) < 2**62 // factor] * factor
        if not len(sized):
            return 0
        nearest, matched, _ = match_times(timestamp_ns, sized)
        return len(np.unique(nearest[matched]))

    counts = {unit: frames(factor) for unit, factor in UNITS.items()}
    best = max(counts, key=lambda unit: counts[unit])
    enough = counts[best] >= max(FEWEST_FRAMES, CLEARLY_MORE * frames(1))
    return best if enough else ""


_POINTS = 500  # of a disc: shares are good to a hundredth
_BATCH = 2_000  # discs at a time, which bounds the memory


def share_in_image(
    fan: Fan, range_m: FloatArray, bearing_deg: FloatArray, radius_m: float
) -> FloatArray:
    """(N,) share, 0 to 1, of floor discs that the fan image shows.

    range_m: (N,) slant range of the centres; nearer than the floor counts as straight below the
    sonar, 0 or less as not shown. bearing_deg: (N,) positive to the right. radius_m: of every disc.
    """
    right, ahead = points_on_disc(radius_m, _POINTS)
    share = np.empty(len(range_m))
    for start in range(0, len(range_m), _BATCH):
        batch = slice(start, start + _BATCH)
        ground = np.nan_to_num(ground_range(fan, range_m[batch]))[:, None]
        bearing = np.radians(bearing_deg[batch])[:, None]
        across = ground * np.sin(bearing) + right
        along = ground * np.cos(bearing) + ahead
        slant = np.sqrt(across**2 + along**2 + floor_depth(fan) ** 2)
        share[batch] = in_image(fan, slant, np.degrees(np.arctan2(across, along))).mean(axis=1)
    share[range_m <= 0] = 0  # ranges are squared above, so negative ones would count
    return share
