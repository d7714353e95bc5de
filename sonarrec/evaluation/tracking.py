"""How well tracks follow landmarks: what HOTA and IDF1 are sums of.

HOTA: Luiten et al. 2021; IDF1: Ristani et al. 2016; both as TrackEval 1.3 computes them. A track is
an object number of declared estimates, an identity is a landmark of the truth, whatever ID was
declared. Similarity falls from 1 at the true centre to 0 at two gates, so that it is .5, the least
that IDF1 counts, where a claim is just right under protocol strict.
"""

from __future__ import annotations

import numpy as np

from sonarrec.arrays import BoolArray, FloatArray, IntArray
from sonarrec.evaluation.match import ROUNDING_M, Matched, distance, equal_pairs
from sonarrec.nouns import follows

ALPHAS = np.arange(0.05, 0.99, 0.05)
"""Similarities from which on a pair counts as a match; HOTA is the mean over them."""
A = len(ALPHAS)


def tracking(log: Matched, beneath: IntArray, method: int) -> FloatArray | None:
    """(4 A + 5,) sums of one log for one method; None if it has no tracks.

    Per alpha TP, FN, FP and the sum over TP of how well its pair goes together; then IDTP, IDFN,
    IDFP, tracks and identities.
    Claims on a landmark partly in view, or whose object is not known, are left out. beneath: from
    `match.truth_beneath`.
    """
    claim = np.flatnonzero((log.method_index == method) & (log.claim_object >= 0))
    if not follows(log.methods[method]) or not len(claim):
        return None
    claim = claim[log.declared[claim]]
    if len(log.truth_positive):
        claim = claim[(beneath[claim] < 0) | log.truth_positive[beneath[claim]]]
    claim = claim[np.lexsort((-log.score[claim], log.claim_object[claim]))]
    key = log.claim_frame_index[claim], log.claim_object[claim]
    claim = claim[np.unique(np.stack(key), axis=1, return_index=True)[1]]  # one per frame and track
    truth = np.flatnonzero(log.truth_positive)
    track = np.unique(log.claim_object[claim], return_inverse=True)[1]
    identity = np.unique(_identities(log, truth), axis=0, return_inverse=True)[1].ravel()
    tracks, identities = (int(of.max(initial=-1)) + 1 for of in (track, identity))
    size = np.bincount(identity, minlength=identities)[:, None] + np.bincount(
        track, minlength=tracks
    )
    # Of all pairs in one frame those nearer than two gates.
    t, c = equal_pairs(log.truth_frame_index[truth], log.claim_frame_index[claim])
    off_m = distance(log, claim[c], truth[t])
    near = off_m < 2 * log.gate_m
    t, c, off_m = t[near], c[near], off_m[near]
    similarity = 1 - off_m / (2 * log.gate_m)
    cell = identity[t] * tracks + track[c]
    of_truth = np.bincount(t, similarity, minlength=len(truth))
    of_claim = np.bincount(c, similarity, minlength=len(claim))

    def summed(weight: FloatArray | BoolArray) -> FloatArray:
        """(identities, tracks) sums over pairs."""
        sums = np.bincount(cell, weight, identities * tracks)
        return np.asarray(sums, dtype=float).reshape(identities, tracks)

    together = summed(similarity / (of_truth[t] + of_claim[c] - similarity))
    potential = summed(off_m <= log.gate_m + ROUNDING_M)
    with np.errstate(invalid="ignore"):
        alignment = (together / (size - together)).ravel()
    matched = _matched(t, c, alignment[cell] * similarity, log.truth_frame_index[truth])
    enough = ALPHAS[:, None] - np.finfo(float).eps
    tp, going_together = np.zeros((2, A))
    for a, of_alpha in enumerate(similarity >= enough):
        matches = summed(matched & of_alpha)
        tp[a] = matches.sum()
        going_together[a] = (matches**2 / np.maximum(1, size - matches)).sum()
    id_tp = potential[assignment(potential)].sum()
    last = id_tp, len(truth) - id_tp, len(claim) - id_tp, tracks, identities
    return np.concatenate([tp, len(truth) - tp, len(claim) - tp, going_together, last])


def _identities(log: Matched, truth: IntArray) -> IntArray:
    """(n, 2) landmark of each truth, and which of those of one ID in its frame it is, by row."""
    cell = log.truth_frame_index[truth] * len(log.ids) + log.truth_landmark_index[truth]
    order = np.argsort(cell, kind="stable")
    start = np.searchsorted(cell[order], cell[order])
    number = np.empty(len(truth), dtype=np.int64)
    number[order] = np.arange(len(truth)) - start
    return np.stack([log.truth_landmark_index[truth], number], axis=1)


def _matched(t: IntArray, c: IntArray, score: FloatArray, frame: IntArray) -> BoolArray:
    """(n,) which pairs of truth and claim match, each in one at most: the best of each frame.

    frame: of each truth.
    """
    alone = (np.bincount(t)[t] == 1) & (np.bincount(c)[c] == 1) if len(t) else np.ones(0, bool)
    contested = np.flatnonzero(~alone)
    contested = contested[np.argsort(frame[t[contested]], kind="stable")]
    starts = np.flatnonzero(np.diff(frame[t[contested]], prepend=-1))
    for pairs in np.split(contested, starts[1:]) if len(contested) else ():
        truths, row = np.unique(t[pairs], return_inverse=True)
        claims, column = np.unique(c[pairs], return_inverse=True)
        table = np.zeros((len(truths), len(claims)))
        table[row, column] = score[pairs]
        best = set(zip(*(of.tolist() for of in assignment(table)), strict=True))
        alone[pairs] = [of in best for of in zip(row.tolist(), column.tolist(), strict=True)]
    return np.asarray(alone)


def assignment(score: FloatArray) -> tuple[IntArray, IntArray]:
    """(rows, columns) of the pairs, each row and column in one at most, of the largest sum.

    score: (R, C), 0 or more. Shortest augmenting paths (Jonker and Volgenant 1987).
    """
    if score.shape[0] > score.shape[1]:
        columns, rows = assignment(score.T)
        return rows, columns
    row, column = np.nonzero(score)
    if len({*row.tolist()}) == len(row) == len({*column.tolist()}):  # as in most frames
        return row, column
    n, m = score.shape
    cost = np.hstack([np.zeros((n, 1)), score.max() - score])  # column 0 holds the row to add
    of_column, row_price, price = np.full(m + 1, -1), np.zeros(n), np.zeros(m + 1)
    for i in range(n):
        of_column[0], at = i, 0
        least, before = np.full(m + 1, np.inf), np.zeros(m + 1, dtype=np.int64)
        reached = np.zeros(m + 1, dtype=bool)
        while of_column[at] >= 0:
            reached[at] = True
            reduced = cost[of_column[at]] - row_price[of_column[at]] - price
            shorter = ~reached & (reduced < least)
            least[shorter], before[shorter] = reduced[shorter], at
            following = int(np.where(reached, np.inf, least).argmin())
            step = least[following]
            row_price[of_column[reached]] += step
            price[reached] -= step
            least[~reached] -= step
            at = following
        while at:
            of_column[at], at = of_column[before[at]], int(before[at])
    columns = np.flatnonzero(of_column[1:] >= 0)
    return of_column[1:][columns], columns
