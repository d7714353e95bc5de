"""Mistakes over neighbouring frames: what each method got wrong, when, and with what score."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.evaluation.match import Judged, Matched

FALSE, MISSED = "false", "missed"
KINDS = (FALSE, MISSED)
GAP = 4
"""Frames without the mistake that do not end it: neighbouring frames look much the same. A pause
does."""
ROWS = np.dtype(
    [
        *((name, "i8") for name in ("kind", "landmark", "other", "first", "last", "frames")),
        *(("score", "f8"), ("times", "i8"), ("worst", "i8")),
    ]
)
"""A row as of Mistake; kind, landmark and other are indices, other -1 for none."""
Key = TypeVar("Key")


class Mistake(NamedTuple):
    """A row of mistakes.csv; the fields are its columns."""

    log: str
    method: str
    kind: str
    """`false` (a false claim) or `missed` (in view, but not claimed)."""
    landmark: int
    """The ID that was claimed, or missed."""
    other: int | None
    """The ID that lies where the false claim is; or that of the surest estimate where the missed
    landmark lies, claimed or not. In most of the frames; None for none."""
    first_frame: int
    last_frame: int
    frames: int
    """In how many it is made; up to GAP between two are without it."""
    score: float
    """The highest of the false claim, or of that estimate; NaN for none."""
    times: int
    """False claims or misses: more than frames where two were made in one. They add up to FP and
    FN."""
    worst_frame: int
    """That of the score; of equal ones that nearest to the middle."""
    protocol: str
    """By which it is one: strict, or paper if strict is not scored."""
    at_start: int
    """1 if a method with tracks, which looks at one in two frames before it declares it, missed
    only the log's first frame."""

    @property
    def span(self) -> str:
        """The frames it is made in."""
        if self.first_frame == self.last_frame:
            return f"frame {self.first_frame}"
        return f"{self.frames} of frames {self.first_frame} to {self.last_frame}"

    @property
    def in_words(self) -> str:
        """A sentence."""
        if self.kind == MISSED:
            sentence = f"ID.{self.landmark} in view and not declared"
            if self.protocol == "paper":
                return sentence
            if self.other is None:
                return f"{sentence}: nothing found there"
            return f"{sentence}: best guess ID.{self.other} ({self.score:.2f})"
        sentence = f"ID.{self.landmark} declared ({self.score:.2f})"
        if self.protocol == "paper":
            return f"{sentence} while it is not in view"
        if self.other is None:
            return f"{sentence} where no landmark lies"
        if self.other == self.landmark:
            return f"{sentence} a second time on the same landmark"
        return f"{sentence} on what is ID.{self.other}"


class Wrong(NamedTuple):
    """What one method got wrong under one protocol: false claims, then missed truths."""

    kind: IntArray
    """(n,) 0 false, 1 missed."""
    landmark: IntArray
    other: IntArray
    """(n,) indices of IDs, as of Mistake; other -1 for none."""
    at: IntArray
    """(n,) index of the frame."""
    score: FloatArray
    """(n,) as of Mistake; -1 for none."""


def find_wrong(log: Matched, judged: Judged, claimed: BoolArray, beneath: IntArray | None) -> Wrong:
    """claimed: (P,) whether each positive is. beneath: as of `truth_beneath`; None for protocol
    paper, in which positions play no part: its score of a missed ID is that of any estimate of it
    in the frame."""
    false = judged.claim[judged.declared_claim[judged.declared_effect[:, 2] > 0]]
    missed = judged.positive[~claimed]
    guess = _surest(log, judged, missed, beneath)
    claim, other = np.append(false, guess), np.full(len(false) + len(guess), -1)
    if beneath is not None:
        other = np.append(log.claim_landmark_index, -1)[claim]
        other[: len(false)] = np.append(log.truth_landmark_index, -1)[beneath[false]]
    return Wrong(
        kind=np.repeat([0, 1], [len(false), len(guess)]),
        landmark=np.append(log.claim_landmark_index[false], log.truth_landmark_index[missed]),
        other=other,
        at=np.append(log.claim_frame_index[false], log.truth_frame_index[missed]),
        score=np.append(log.score, -1.0)[claim],
    )


def _surest(log: Matched, judged: Judged, missed: IntArray, beneath: IntArray | None) -> IntArray:
    """(n,) the method's estimate of the highest score for each missed truth, -1 if there is none:
    of those on it or, in protocol paper, of those of its ID in its frame."""
    claims = judged.claim[::-1]  # by rising score
    place, wanted, places = beneath, missed, len(log.truth_frame_index)
    if place is None:
        ids = len(log.ids)
        place = log.claim_frame_index * ids + log.claim_landmark_index
        wanted = log.truth_frame_index[missed] * ids + log.truth_landmark_index[missed]
        places = len(log.frame) * ids
    surest = np.full(places + 1, -1)  # the last one for claims on nothing, at -1
    surest[place[claims]] = claims  # of several the last stays, which has the highest score
    return surest[wanted]


def over_frames(log: Matched, found: Mapping[Key, Wrong]) -> dict[Key, npt.NDArray[Any]]:
    """(m,) ROWS by the same keys: what is wrong over neighbouring frames. All at once, which takes
    half the time."""
    if not found:
        return {}
    of = np.repeat(np.arange(len(found)), [len(wrong.at) for wrong in found.values()])
    kind, landmark, other, at, score = map(np.concatenate, zip(*found.values(), strict=True))
    # Of false claims those on another landmark are mistakes of their own; what is guessed where a
    # landmark is missed changes from frame to frame.
    ids = len(log.ids)
    group = ((of * ids + landmark) * 2 + kind) * (ids + 1) + np.where(kind, 0, other + 1)
    order = np.argsort(group * len(log.frame) + at, kind="stable")
    group, at, other, score = (column[order] for column in (group, at, other, score))
    new_frame, new = np.ones((2, len(order)), dtype=bool)
    new_group = np.diff(group) != 0
    new[1:] = new_group | (np.diff(at) > GAP + 1) | (np.diff(log.stretch[at]) != 0)
    new_frame[1:] = new_group | (np.diff(at) != 0)
    start, episode = np.flatnonzero(new), np.cumsum(new) - 1
    end = np.append(start[1:], len(at))[: len(start)] - 1
    rows = np.zeros(len(start), dtype=ROWS)
    rows["kind"], rows["landmark"] = kind[order][start], landmark[order][start]
    rows["other"] = _most_frequent(other + 1, episode) - 1
    rows["times"], rows["frames"] = end + 1 - start, np.bincount(episode[new_frame])
    off_middle = np.abs(2 * at - (at[start] + at[end])[episode])
    rank = -score + 2 * (other != rows["other"][episode])
    worst = np.lexsort((off_middle, rank, episode))[start]
    rows["score"] = np.where(score[worst] < 0, np.nan, score[worst])
    for name, index in (("first", start), ("last", end), ("worst", worst)):
        rows[name] = log.frame[at[index]]
    ends = np.searchsorted(of[order][start], np.arange(1, len(found)))
    return dict(zip(found, np.split(rows, ends), strict=True))


def _most_frequent(value: IntArray, group: IntArray) -> IntArray:
    """(groups,) the value that each group has most often. value: (n,) >= 0; group: (n,) rising."""
    size = int(value.max(initial=0)) + 1
    pair, count = np.unique(group * size + value, return_counts=True)
    pair = pair[np.argsort(pair // size * (len(value) + 1) - count, kind="stable")]
    first = np.unique(pair // size, return_index=True)[1]
    return np.asarray(pair[first] % size)
