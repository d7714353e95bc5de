"""Areas and points read off ROC curves, against scikit-learn and plain searches."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.evaluation.counts import corners
from sonarrec.evaluation.figures import area, tpr_at
from tests.support.claims import IDS, all_scored, counts, matched

FRAMES = 250


def one_vs_rest(seed: int, claimed: float = 0.8):
    """A case with one claim at most per frame and ID, (F, K) truth, and the scores as
    scikit-learn takes them: what was not claimed comes last."""
    rng = np.random.default_rng(seed)
    positive = rng.random((FRAMES, len(IDS))) < (0.4, 0.1, 0.7, 0.3)
    # Two digits, so that many are equal.
    points = np.round(rng.random(positive.shape) * 0.6 + positive * 0.3, 2)
    made = rng.random(positive.shape) < claimed
    case = matched(
        FRAMES,
        [(f, k + 1, k, 0, True) for f, k in np.argwhere(positive)],
        [(0, f, k + 1, k, 0, points[f, k], False) for f, k in np.argwhere(made)],
        methods=("a",),
    )
    return case, positive, np.where(made, points, -1.0)


@pytest.mark.parametrize("protocol", ["paper", "strict"])
@pytest.mark.parametrize("claimed", [1.0, 0.8])
def test_areas_equal_scikit_learns(claimed: float, protocol: str) -> None:
    metrics = pytest.importorskip("sklearn.metrics")
    case, positive, points = one_vs_rest(1, claimed)
    (scored,) = [s for s in all_scored(counts(case)) if s.protocol == protocol]
    cells = [(k, positive[:, k], points[:, k]) for k in range(len(IDS))]
    for k, truth, value in [*cells, (None, positive.ravel(), points.ravel())]:
        curve = scored.curve(k)
        auc = metrics.roc_auc_score(truth, value)
        assert area(curve["fpr"], curve["tpr"]) == pytest.approx(auc, abs=1e-12)
        assert curve["threshold"][0] == math.inf
        # What roc.csv keeps draws the same curve, and few points nearly so.
        at, few = corners(curve), corners(curve, most=20)
        assert len(at) < len(curve["fpr"])
        assert len(few) <= 22
        assert area(at["fpr"], at["tpr"]) == pytest.approx(auc, abs=1e-12)
        assert area(few["fpr"], few["tpr"]) == pytest.approx(auc, abs=0.05)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), most=st.floats(0, 1))
def test_tpr_at_an_fpr_is_the_best_that_a_threshold_gives(seed: int, most: float) -> None:
    case, positive, points = one_vs_rest(seed)
    curve = all_scored(counts(case))[1].curve(2)
    truth, value = positive[:, 2], points[:, 2]
    reached = [
        np.mean(value[truth] >= t)
        for t in [*np.unique(value[value >= 0]), math.inf]
        if np.mean(value[~truth] >= t) <= most
    ]
    assert tpr_at(curve["fpr"], curve["tpr"], most) == pytest.approx(max(reached), abs=1e-12)


def test_areas_by_hand() -> None:
    perfect = np.array([0, 0, 1]), np.array([0, 1, 1])
    assert area(*perfect) == tpr_at(*perfect, 0) == 1
    silent = np.zeros(1), np.zeros(1)  # nothing is ever claimed: a guess
    assert (area(*silent), tpr_at(*silent, 0.05)) == (0.5, 0)
    # Half of the positives for nothing, then no more: a straight line from (0, .5) to (1, 1).
    half = np.zeros(2), np.array([0, 0.5])
    assert (area(*half), tpr_at(*half, 0.05)) == (0.75, 0.5)
