"""Mistakes over neighbouring frames: what each method got wrong, when, and with what score."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sonarrec.arrays import IntArray
from sonarrec.evaluation.match import Judged, Matched

FALSE, MISSED = "false", "missed"
KINDS = (FALSE, MISSED)
GAP = 4
"""Frames without the mistake that do not end it: neighbouring frames look much the same."""
ROWS = np.dtype(
    [
        *((name, "i8") for name in ("kind", "landmark", "other", "first", "last", "frames")),
        *(("score", "f8"), ("times", "i8"), ("worst", "i8")),
    ]
)
"""A row as of Mistake; kind, landmark and other are indices, other -1 for none."""


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


def find_mistakes(log: Matched, judged: Judged, beneath: IntArray | None) -> npt.NDArray[Any]:
    """(n,) ROWS of a method. beneath: as of `truth_beneath`; None for protocol paper, in which
    positions play no part: its score of a missed ID is that of any estimate of it in the frame."""
    false = judged.claim[judged.declared_claim[judged.declared_effect[:, 2] > 0]]
    missed = judged.positive[~judged.positive_is_claimed]
    guess = _surest(log, judged, missed, beneath)
    claim = np.append(false, guess)
    kind = (np.arange(len(claim)) >= len(false)).astype(np.int64)
    landmark = np.append(log.claim_landmark_index[false], log.truth_landmark_index[missed])
    at = np.append(log.claim_frame_index[false], log.truth_frame_index[missed])
    other = np.full(len(claim), -1)
    if beneath is not None:
        under = np.append(log.truth_landmark_index, -1)[beneath[false]]
        other = np.append(under, np.append(log.claim_landmark_index, -1)[guess])
    score = np.append(log.score, -1.0)[claim]

    # Of false claims those on another landmark are mistakes of their own; what is guessed where a
    # landmark is missed changes from frame to frame.
    group = (landmark * 2 + kind) * (len(log.ids) + 1) + np.where(kind, 0, other + 1)
    order = np.argsort(group * len(log.frame) + at, kind="stable")
    kind, landmark, at, other, score = (c[order] for c in (kind, landmark, at, other, score))
    new_frame, new = np.ones((2, len(order)), dtype=bool)
    new_group = np.diff(group[order]) != 0
    new[1:] = new_group | (np.diff(at) > GAP + 1)
    new_frame[1:] = new_group | (np.diff(at) != 0)
    start, episode = np.flatnonzero(new), np.cumsum(new) - 1
    end = np.append(start[1:], len(at))[: len(start)] - 1
    found = np.zeros(len(start), dtype=ROWS)
    found["kind"], found["landmark"] = kind[start], landmark[start]
    found["other"] = _most_frequent(other + 1, episode) - 1
    found["times"], found["frames"] = end + 1 - start, np.bincount(episode[new_frame])
    off_middle = np.abs(2 * at - (at[start] + at[end])[episode])
    rank = -score + 2 * (other != found["other"][episode])
    worst = np.lexsort((off_middle, rank, episode))[start]
    found["score"] = np.where(score[worst] < 0, np.nan, score[worst])
    for name, rows in (("first", start), ("last", end), ("worst", worst)):
        found[name] = log.frame[at[rows]]
    return found


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


def _most_frequent(value: IntArray, group: IntArray) -> IntArray:
    """(groups,) the value that each group has most often. value: (n,) >= 0; group: (n,) rising."""
    size = int(value.max(initial=0)) + 1
    pair, count = np.unique(group * size + value, return_counts=True)
    pair = pair[np.argsort(pair // size * (len(value) + 1) - count, kind="stable")]
    first = np.unique(pair // size, return_index=True)[1]
    return np.asarray(pair[first] % size)
