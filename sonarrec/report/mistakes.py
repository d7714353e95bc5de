"""The mistakes of an evaluation, grouped into episodes, the worst first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from sonarrec.arrays import IntArray
from sonarrec.evaluation.counting.scoring import Scored
from sonarrec.evaluation.evaluate import Evaluation
from sonarrec.evaluation.matching.joined import Joined, nearest_truth

GAP = 4
"""An episode may have gaps of so many frames, since neighbouring frames are alike."""


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
    """Of Joined's: that claim, or the truth that was missed."""


def episodes(evaluation: Evaluation, method: str, protocol: str) -> list[Episode]:
    """A method's mistakes at its operating point, as a protocol that was scored counts them.

    The worst first: wrongness summed over the episode. The counts of all episodes add up to the
    FP and FN of the method's table.
    """
    joined = evaluation.joined
    scored = next(s for s in evaluation.scored if (s.method, s.protocol) == (method, protocol))
    wrong = pd.concat([_false_claims(scored), _misses(joined, scored)], ignore_index=True)
    wrong["log"] = joined.log_index[wrong["at"]]
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
            landmark=joined.ids[row.landmark],
            log=joined.logs[row.log],
            first=int(joined.frame[row.first]),
            last=int(joined.frame[row.last]),
            worst=int(joined.frame[row.at]),
            count=int(row.times),
            wrongness=float(row.wrongness),
            which=int(row.which),
        )
        for row in grouped.sort_values("sum", ascending=False, kind="stable").itertuples()
    ]


def _false_claims(scored: Scored) -> pd.DataFrame:
    """A row per false claim; `which` is the claim, `at` its frame (indices into Joined)."""
    false = scored.declared_claim[scored.declared_effect[:, 2] > 0]
    return pd.DataFrame(
        {
            "kind": "claim",
            "at": scored.frame_index[false],
            "landmark": scored.landmark_index[false],
            "wrongness": scored.score[false],
            "which": scored.claim[false],
        }
    )


def _misses(joined: Joined, scored: Scored) -> pd.DataFrame:
    """A row per landmark in view that was not claimed; `which` is the truth."""
    claimed = scored.truth[scored.declared_claim[scored.declared_effect[:, 3] < 0]]
    missed = np.setdiff1d(scored.positive, claimed)
    ids = len(joined.ids)
    best = np.zeros(len(joined.frame) * ids)
    of_method = joined.method_index == joined.methods.index(scored.method)
    cell = joined.claim_frame_index[of_method] * ids + joined.claim_landmark_index[of_method]
    np.maximum.at(best, cell, joined.score[of_method])
    at, landmark = joined.truth_frame_index[missed], joined.truth_landmark_index[missed]
    return pd.DataFrame(
        {
            "kind": "miss",
            "at": at,
            "landmark": landmark,
            "wrongness": 1 - best[at * ids + landmark],
            "which": missed,
        }
    )


def in_words(episode: Episode, joined: Joined) -> str:
    """A sentence on the worst frame of an episode."""
    if episode.kind == "claim":
        sentence = f"ID.{episode.landmark} declared ({episode.wrongness:.2f})"
        if episode.protocol == "paper":
            return f"{sentence} while it is not in view"
        claim = np.array([episode.which])
        (truth,) = _beneath(joined, claim)
        if truth < 0:
            return f"{sentence} where no landmark lies"
        beneath = joined.ids[joined.truth_landmark_index[truth]]
        if beneath == episode.landmark:
            return f"{sentence} a second time on the same landmark"
        return f"{sentence} on what is ID.{beneath}"
    sentence = f"ID.{episode.landmark} in view and not declared"
    if episode.protocol == "paper":
        return sentence
    of_method = joined.method_index == joined.methods.index(episode.method)
    frame_index = joined.truth_frame_index[episode.which]
    claims_here = np.flatnonzero(of_method & (joined.claim_frame_index == frame_index))
    claims_here = claims_here[_beneath(joined, claims_here) == episode.which]
    if not len(claims_here):
        return f"{sentence}: nothing found there"
    best = claims_here[np.argmax(joined.score[claims_here])]
    name, score = joined.ids[joined.claim_landmark_index[best]], joined.score[best]
    if joined.declared[best]:
        return f"{sentence}: called ID.{name} ({score:.2f})"
    return f"{sentence}: best guess ID.{name} ({score:.2f})"


def _beneath(joined: Joined, claims: IntArray) -> IntArray:
    """(n,) the truth beneath each of the claims, -1 where there is none."""
    return nearest_truth(joined, claims, joined.claim_frame_index[claims], joined.truth_frame_index)
