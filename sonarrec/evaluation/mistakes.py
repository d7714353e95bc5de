"""Mistakes over neighbouring frames: what each method got wrong, when, and with what score."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonarrec.arrays import IntArray, Table, begins, stacked
from sonarrec.evaluation.rows import Matched, effects, positives

FALSE, MISSED = "false", "missed"
KINDS = (FALSE, MISSED)
GAP = 4
"""Frames without the mistake that do not end it: neighbouring frames look much the same. A pause
does."""


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
    only the first frame of a log of several."""

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


def find_wrong(log: Matched, judged: Table, protocol: str, beneath: IntArray | None) -> Table:
    """What each method got wrong in each frame, false claims, then missed truths: method, kind,
    landmark, other, at (index of the frame), score.

    kind, landmark and other are indices, other -1 for none; score is as of Mistake, -1 for none.
    judged: of the protocol. beneath: as of `truth_beneath`; None for protocol paper, in which
    positions play no part: its score of a missed ID is that of any estimate of it in the frame.
    Method -1, which claims nothing, stands for those that only other logs have.
    """
    declared, rows = effects(judged[judged["declared"]], protocol), positives(log, protocol)
    ids, truths = len(log.ids), log.truths
    parts = []
    for method in range(-1, len(log.methods)):
        own = declared[declared["method"] == method]
        false = own["claim"][own["fp"] > 0]
        missed = rows[~np.isin(rows, own["truth"])]
        guess = _surest(log, judged[judged["method"] == method], missed, beneath)
        claim, other = np.append(false, guess), np.full(len(false) + len(guess), -1)
        if beneath is not None:
            other = np.append(log.claims["cell"] % ids, -1)[claim]
            other[: len(false)] = np.append(truths["cell"] % ids, -1)[beneath[false]]
        cell = np.append(log.claims["cell"][false], truths["cell"][missed])
        parts.append(
            Table(
                method=method,
                kind=np.repeat([0, 1], [len(false), len(guess)]),
                landmark=cell % ids,
                other=other,
                at=cell // ids,
                score=np.append(log.claims["score"], -1.0)[claim],
            )
        )
    return stacked(parts)


def _surest(log: Matched, judged: Table, missed: IntArray, beneath: IntArray | None) -> IntArray:
    """(n,) the estimate of the highest score for each missed truth, -1 if there is none: of those
    on it or, in protocol paper, of those of its ID in its frame. judged: of one method."""
    claims = judged["claim"][np.argsort(-judged["score"], kind="stable")][::-1]
    index, wanted, count = beneath, missed, len(log.truths)
    if index is None:
        index, wanted = log.claims["cell"], log.truths["cell"][missed]
        count = len(log.frame) * len(log.ids)
    surest = np.full(count + 1, -1)  # the last one for claims on nothing, at -1
    surest[index[claims]] = claims  # of several the last stays, which has the highest score
    return surest[wanted]


def over_frames(log: Matched, wrong: Table) -> Table:
    """What is wrong over neighbouring frames, with the columns of Mistake but log.

    wrong: as of `find_wrong`, with the index of the protocol.
    """
    series = wrong["protocol"].astype(int) * (len(log.methods) + 1) + wrong["method"] + 1
    # Of false claims those on another landmark are mistakes of their own; what is guessed where a
    # landmark is missed changes from frame to frame.
    other, ids = np.where(wrong["kind"], 0, wrong["other"] + 1), len(log.ids)
    group = ((series * ids + wrong["landmark"]) * 2 + wrong["kind"]) * (ids + 1) + other
    order = np.argsort(group * len(log.frame) + wrong["at"], kind="stable")
    group, wrong = group[order], wrong[order]
    frame, score, other = wrong["at"], wrong["score"], wrong["other"]
    new = begins(group, log.stretch[frame])
    new[1:] |= np.diff(frame) > GAP + 1
    start, episode = np.flatnonzero(new), np.cumsum(new) - 1
    end = np.append(start[1:], len(frame))[: len(start)] - 1
    usual = _most_frequent(other + 1, episode) - 1
    off_middle = np.abs(2 * frame - (frame[start] + frame[end])[episode])
    rank = -score + 2 * (other != usual[episode])
    worst = np.lexsort((off_middle, rank, episode))[start]
    kind = wrong["kind"][start]
    return Table(
        **{name: wrong[name][start] for name in ("protocol", "method", "landmark")},
        kind=kind,
        other=usual,
        first_frame=log.frame[frame[start]],
        last_frame=log.frame[frame[end]],
        frames=np.bincount(episode[begins(group, frame)], minlength=len(start)),
        score=np.where(score[worst] < 0, np.nan, score[worst]),
        times=end + 1 - start,
        worst_frame=log.frame[frame[worst]],
        at_start=kind * (frame[end] == 0) * (len(log.frame) > 1),
    )


def _most_frequent(value: IntArray, group: IntArray) -> IntArray:
    """(groups,) the value that each group has most often. value: (n,) >= 0; group: (n,) rising."""
    size = int(value.max(initial=0)) + 1
    pair, count = np.unique(group * size + value, return_counts=True)
    pair = pair[np.argsort(pair // size * (len(value) + 1) - count, kind="stable")]
    first = np.unique(pair // size, return_index=True)[1]
    return np.asarray(pair[first] % size)
