"""The mistakes behind an evaluation's counts, gathered into episodes, the worst first."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from sonarrec.evaluation.scoring import Evaluation, Joined, score
from sonarrec.report.logs import ReportedLog

GAP = 4
"""Frames without the mistake that do not yet end an episode: neighbouring frames are alike."""


@dataclass(frozen=True, slots=True)
class Episode:
    """One mistake over neighbouring frames, as one method made it.

    kind: "claim" (declared where it is not) or "miss" (in view and not declared). landmark: the
    ID claimed or missed. log: name. first, last, worst: frame numbers. count: mistakes in it.
    wrongness: of the worst frame, 0 to 1; of a claim its score, of a miss 1 - the best score that
    the method gave that ID in that frame.
    """

    method: str
    kind: str
    landmark: int
    log: str
    first: int
    last: int
    worst: int
    count: int
    wrongness: float


def protocol_of_mistakes(evaluation: Evaluation) -> str:
    """The protocol whose mistakes are told: the strict one where it was scored."""
    return "strict" if evaluation.joined.placed else "paper"


def episodes(evaluation: Evaluation, method: str) -> list[Episode]:
    """A method's mistakes at its operating point.

    The worst first: wrongness summed over the episode. The counts of all episodes add up to the
    FP and FN of the method's table.
    """
    joined = evaluation.joined
    wrong = _mistakes(joined, joined.methods.index(method), protocol_of_mistakes(evaluation))
    wrong["log"] = joined.log[wrong["at"]]
    wrong = wrong.sort_values(["kind", "landmark", "log", "at"], kind="stable")
    gap = wrong.groupby(["kind", "landmark", "log"], sort=False)["at"].diff()
    wrong["episode"] = (~(gap <= GAP + 1)).cumsum()  # the first of a group has no gap before it
    wrong["sum"] = wrong["wrongness"] * wrong["times"]
    told = wrong.groupby("episode").agg(
        first=("at", "min"), last=("at", "max"), times=("times", "sum"), sum=("sum", "sum")
    )
    worst = wrong.sort_values("wrongness", ascending=False, kind="stable")
    worst = worst.drop_duplicates("episode").set_index("episode")
    told = told.join(worst[["kind", "landmark", "log", "at", "wrongness"]])
    return [
        Episode(
            method=method,
            kind=row.kind,
            landmark=joined.ids[row.landmark],
            log=joined.logs[row.log],
            first=int(joined.frame[row.first]),
            last=int(joined.frame[row.last]),
            worst=int(joined.frame[row.at]),
            count=int(row.times),
            wrongness=float(row.wrongness),
        )
        for row in told.sort_values("sum", ascending=False, kind="stable").itertuples()
    ]


def _mistakes(joined: Joined, method: int, protocol: str) -> pd.DataFrame:
    """False claims and misses, a row per frame and ID: kind, at (frame's index), landmark, times
    and wrongness, as Episode has them."""
    ids = len(joined.ids)
    cells = len(joined.frame) * ids
    mine = joined.method == method
    best = np.zeros(cells)
    np.maximum.at(
        best, joined.claim_frame[mine] * ids + joined.claim_landmark[mine], joined.score[mine]
    )
    claims = _declared_only(joined)
    scored = score(claims, method, protocol)
    cell = scored.frame * ids + scored.landmark
    false = scored.effect[:, 2] > 0

    truth = joined.truth_frame * ids + joined.truth_landmark
    missed = np.bincount(truth[joined.truth_positive], minlength=cells)
    if protocol == "paper":  # which asks only whether the ID was in view
        missed = np.minimum(missed, 1)
    missed -= np.bincount(cell[scored.effect[:, 3] < 0], minlength=cells)
    lost = np.flatnonzero(missed)
    return pd.DataFrame(
        {
            "kind": ["claim"] * np.count_nonzero(false) + ["miss"] * len(lost),
            "at": np.concatenate([scored.frame[false], lost // ids]),
            "landmark": np.concatenate([scored.landmark[false], lost % ids]),
            "times": np.concatenate([np.ones(np.count_nonzero(false), dtype=int), missed[lost]]),
            "wrongness": np.concatenate([scored.score[false], 1 - best[lost]]),
        }
    )


def _declared_only(joined: Joined) -> Joined:
    """The same with only the claims of every method's operating point."""
    kept = joined.declared
    return replace(
        joined,
        method=joined.method[kept],
        claim_frame=joined.claim_frame[kept],
        claim_landmark=joined.claim_landmark[kept],
        claim_position=joined.claim_position[kept],
        score=joined.score[kept],
        declared=joined.declared[kept],
    )


def told(episode: Episode, log: ReportedLog) -> str:
    """One sentence on the worst frame of an episode: what was wrong, and what lay beneath."""
    found = log.results
    k = found.landmarks.ids.index(episode.landmark)
    row = int(np.searchsorted(found.frame, episode.worst))
    near = log.truth_near
    here = np.flatnonzero(log.of_method(episode.method) & (found.row == row))
    if episode.kind == "claim":
        sentence = f"ID.{episode.landmark} declared ({episode.wrongness:.2f})"
        if near is None:
            return f"{sentence} while it is not in view"
        claim = here[found.declared[here] & (found.landmark[here] == k)]
        claim = claim[np.isclose(found.score[claim], episode.wrongness)]
        beneath = near[claim[0]]
        if beneath < 0:
            return f"{sentence} where no landmark lies"
        if beneath == k:
            return f"{sentence} a second time on the same landmark"
        return f"{sentence} on what is ID.{found.landmarks.ids[beneath]}"
    sentence = f"ID.{episode.landmark} in view and not declared"
    if near is None:
        return sentence
    on = here[near[here] == k]
    if not len(on):
        return f"{sentence}: nothing found there"
    best = on[np.argmax(found.score[on])]
    name, score = found.landmarks.ids[found.landmark[best]], found.score[best]
    if found.declared[best]:
        return f"{sentence}: called ID.{name} ({score:.2f})"
    return f"{sentence}: best guess ID.{name} ({score:.2f})"
