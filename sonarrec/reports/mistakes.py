"""The mistakes of an evaluation, grouped into episodes, the worst first."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from sonarrec.arrays import BoolArray
from sonarrec.evaluation.match import Judged, Matched, judge, truth_beneath

GAP = 4  # an episode may have gaps of so many frames, since neighbouring frames are alike


@dataclass(frozen=True, slots=True)
class Episode:
    """One mistake over neighbouring frames, as one method made it."""

    protocol: str
    method: str
    kind: str
    """"claim" (a false claim) or "miss" (in view and not declared)."""
    landmark: int
    """The ID claimed or missed."""
    log: str
    first: int
    last: int
    worst: int
    """Frame numbers."""
    count: int
    """Mistakes in it."""
    wrongness: float
    """Of the worst frame, 0 to 1; of a claim its score, of a miss 1 - the best score that the
    method gave that ID in that frame."""
    which: int
    """Of Matched's: that claim, or the truth that was missed."""


def episodes(logs: Mapping[str, Matched], method: str, protocol: str) -> list[Episode]:
    """A method's mistakes at its operating point, as a protocol that was scored counts them.

    The worst first: wrongness summed over the episode. The counts of all episodes add up to the
    FP and FN of the method's table. logs: by name.
    """
    names, matched, found = [*logs], [*logs.values()], []
    for n, log in enumerate(matched):
        judged = judge(log, method, protocol)
        found += [_false_claims(judged).assign(log=n), _misses(log, judged, method).assign(log=n)]
    wrong = pd.concat(found, ignore_index=True)
    wrong = wrong.sort_values(["kind", "landmark", "log", "at"], kind="stable")
    gap = wrong.groupby(["kind", "landmark", "log"], sort=False)["at"].diff()
    wrong["episode"] = (~(gap <= GAP + 1)).cumsum()  # the first one of a group has no gap
    grouped = wrong.groupby("episode").agg(
        first=("at", "min"), last=("at", "max"), times=("at", "size"), sum=("wrongness", "sum")
    )
    worst = wrong.sort_values("wrongness", ascending=False, kind="stable")
    worst = worst.drop_duplicates("episode").set_index("episode")
    grouped = grouped.join(worst[["kind", "landmark", "log", "at", "wrongness", "which"]])
    return [
        Episode(
            protocol=protocol,
            method=method,
            kind=row.kind,
            landmark=matched[row.log].ids[row.landmark],
            log=names[row.log],
            first=int(matched[row.log].frame[row.first]),
            last=int(matched[row.log].frame[row.last]),
            worst=int(matched[row.log].frame[row.at]),
            count=int(row.times),
            wrongness=float(row.wrongness),
            which=int(row.which),
        )
        for row in grouped.sort_values("sum", ascending=False, kind="stable").itertuples()
    ]


def _false_claims(scored: Judged) -> pd.DataFrame:
    """A row per false claim; `which` is the claim, `at` its frame (indices into Matched)."""
    false = scored.declared_claim[scored.declared_effect[:, 2] > 0]
    rows = {"kind": "claim", "at": scored.frame_index[false], "which": scored.claim[false]}
    seen = {"landmark": scored.landmark_index[false], "wrongness": scored.score[false]}
    return pd.DataFrame(rows | seen)


def _misses(log: Matched, scored: Judged, method: str) -> pd.DataFrame:
    """A row per landmark in view that was not claimed; `which` is the truth."""
    missed = scored.positive[~scored.positive_is_claimed]
    ids = len(log.ids)
    best = np.zeros(len(log.frame) * ids)
    of_method = _of_method(log, method)
    cell = log.claim_frame_index[of_method] * ids + log.claim_landmark_index[of_method]
    np.maximum.at(best, cell, log.score[of_method])
    at, landmark = log.truth_frame_index[missed], log.truth_landmark_index[missed]
    rows = {"kind": "miss", "at": at, "which": missed}
    return pd.DataFrame(rows | {"landmark": landmark, "wrongness": 1 - best[at * ids + landmark]})


def in_words(episode: Episode, log: Matched) -> str:
    """A sentence on the worst frame of an episode."""
    if episode.kind == "claim":
        sentence = f"ID.{episode.landmark} declared ({episode.wrongness:.2f})"
        if episode.protocol == "paper":
            return f"{sentence} while it is not in view"
        truth = truth_beneath(log)[episode.which]
        if truth < 0:
            return f"{sentence} where no landmark lies"
        beneath = log.ids[log.truth_landmark_index[truth]]
        if beneath == episode.landmark:
            return f"{sentence} a second time on the same landmark"
        return f"{sentence} on what is ID.{beneath}"
    sentence = f"ID.{episode.landmark} in view and not declared"
    if episode.protocol == "paper":
        return sentence
    of_method = _of_method(log, episode.method)
    frame_index = log.truth_frame_index[episode.which]
    claims_here = np.flatnonzero(of_method & (log.claim_frame_index == frame_index))
    claims_here = claims_here[truth_beneath(log)[claims_here] == episode.which]
    if not len(claims_here):
        return f"{sentence}: nothing found there"
    best = claims_here[np.argmax(log.score[claims_here])]
    name, score = log.ids[log.claim_landmark_index[best]], log.score[best]
    if log.declared[best]:
        return f"{sentence}: called ID.{name} ({score:.2f})"
    return f"{sentence}: best guess ID.{name} ({score:.2f})"


def _of_method(log: Matched, method: str) -> BoolArray:
    """(N,) which claims are the method's."""
    index = log.methods.index(method) if method in log.methods else -1
    return np.asarray(log.method_index == index)
