"""HOTA and IDF1 against their published definitions, written out with scipy's assignment."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from sonarrec.evaluation.match import Matched
from sonarrec.evaluation.screen import screen
from sonarrec.evaluation.tracking import assignment
from tests.support.claims import GATE_M, evaluated, matched

IDS = 3


def random_case(rng: np.random.Generator, frames: int) -> Matched:
    """Landmarks that move and touch, tracks that break, change over, are double or lie nowhere."""
    truth, claims = [], []
    base = rng.random((IDS, 2)) * 0.4
    for f in range(frames):
        for k in range(IDS):
            if rng.random() < 0.2:
                continue
            x, y = base[k] + 0.02 * np.sin(f / 5 + k)
            truth.append((f, k + 1, x, y, rng.random() > 0.1))
            for track in {k + 10 * int(f // 7 % 3), int(rng.integers(0, 30))}:
                off = rng.normal(0, 0.06, 2)
                claim = (0, f, int(rng.integers(1, 5)), x + off[0], y + off[1], rng.random())
                claims.append((*claim, rng.random() > 0.2, track))
    return matched(frames, truth, claims)


def sequence(log: Matched) -> list[tuple[list[int], list[int], np.ndarray]]:
    """Per frame the landmarks, the tracks and their similarity, as TrackEval takes them."""
    found = []
    for f in range(len(log.frame)):
        there = np.flatnonzero(log.truth_frame_index == f)
        claims: dict[int, int] = {}
        of_frame = np.flatnonzero(log.declared & (log.claim_frame_index == f))
        for c in sorted(of_frame, key=lambda c: -log.score[c]):
            off = [math.dist(log.claim_position[c], log.truth_position[t]) for t in there]
            nearest = there[int(np.argmin(off))] if off and min(off) <= GATE_M else -1
            if nearest < 0 or log.truth_positive[nearest]:
                claims.setdefault(int(log.claim_object[c]), int(c))
        truths = [t for t in there if log.truth_positive[t]]
        similarity = np.array(
            [
                [
                    max(0, 1 - math.dist(log.claim_position[c], log.truth_position[t]) / 2 / GATE_M)
                    for c in claims.values()
                ]
                for t in truths
            ]
        ).reshape(len(truths), len(claims))
        found.append((log.truth_landmark_index[truths].tolist(), list(claims), similarity))
    return found


def published(logs: list[list[tuple[list[int], list[int], np.ndarray]]]) -> tuple[float, float]:
    """(HOTA, IDF1) over sequences: Luiten et al. 2021, Eq. 10 to 21; Ristani et al. 2016, 3.2."""
    alphas = np.arange(0.05, 0.99, 0.05)
    tp, fn, fp, going = np.zeros((4, len(alphas)))
    id_tp = id_all = 0.0
    for log in logs:
        truths = sorted({g for ids, *_ in log for g in ids})
        tracks = sorted({t for _, ids, _ in log for t in ids})
        n_g = {g: sum(ids.count(g) for ids, *_ in log) for g in truths}
        n_t = {t: sum(ids.count(t) for _, ids, _ in log) for t in tracks}
        jaccard = {(g, t): 0.0 for g in truths for t in tracks}
        overlap = np.zeros((len(truths), len(tracks)))
        for gs, ts, s in log:
            for i, g in enumerate(gs):
                for j, t in enumerate(ts):
                    whole = s[i].sum() + s[:, j].sum() - s[i, j]
                    jaccard[g, t] += s[i, j] / whole if whole > 0 else 0
                    overlap[truths.index(g), tracks.index(t)] += s[i, j] >= 0.5
        score = {(g, t): c / (n_g[g] + n_t[t] - c) for (g, t), c in jaccard.items()}
        for a, alpha in enumerate(alphas):
            pairs: dict[tuple[int, int], int] = {}
            for gs, ts, s in log:
                weight = np.array([[score[g, t] for t in ts] for g in gs]).reshape(s.shape) * s
                hits = [
                    (gs[i], ts[j])
                    for i, j in zip(*linear_sum_assignment(-weight), strict=True)
                    if s[i, j] >= alpha - np.finfo(float).eps
                ]
                for hit in hits:
                    pairs[hit] = pairs.get(hit, 0) + 1
                tp[a] += len(hits)
                fn[a] += len(gs) - len(hits)
                fp[a] += len(ts) - len(hits)
            going[a] += sum(c * c / (n_g[g] + n_t[t] - c) for (g, t), c in pairs.items())
        id_tp += overlap[linear_sum_assignment(-overlap)].sum()
        id_all += sum(n_g.values()) + sum(n_t.values())
    hota = np.sqrt(tp / (tp + fn + fp) * going / np.maximum(1, tp)).mean()
    return float(hota), 2 * id_tp / id_all


@pytest.mark.parametrize("seed", range(4))
def test_as_published(seed: int) -> None:
    rng = np.random.default_rng(seed)
    logs = [random_case(rng, frames) for frames in (40, 3, 25)]
    summary = evaluated(*logs).summary
    for some, found in ((logs, summary), (logs[:1], evaluated(logs[0]).summary)):
        hota, idf1 = published([sequence(log) for log in some])
        assert 0.05 < hota < 0.6
        for name, value in (("hota", hota), ("idf1", idf1)):
            figure = found.figure("strict", "a", name)
            assert figure is not None
            assert figure.value == pytest.approx(value, abs=1e-9), name


def test_nine_tracks_for_three_landmarks_show() -> None:
    """Every frame is right, so the rates are 1 and 0 in any case."""
    truth = [(f, k, k, 0.0, True) for f in range(90) for k in (1, 2, 3)]
    right = [(0, f, k, k, 0.0, 0.9, True) for f, k, *_ in truth]
    whole = evaluated(matched(90, truth, [(*c, c[2]) for c in right], methods=("a",)))
    broken = evaluated(
        matched(90, truth, [(*c, 10 * c[2] + c[1] // 30) for c in right], methods=("a",))
    )
    for found, hota, idf1, tracks in ((whole, 1, 1, 1), (broken, math.sqrt(1 / 3), 1 / 3, 3)):
        values = {f.name: f.value for f in found.summary.figures if f.landmark == "total"}
        assert (values["tpr"], values["fpr"]) == (1, 0)
        assert values["hota"] == pytest.approx(hota)
        assert values["idf1"] == pytest.approx(idf1)
        assert values["tracks_per_landmark"] == tracks
    assert "HOTA                          0.577" in screen(broken)


def test_without_tracks_or_claims_there_is_nothing_to_measure() -> None:
    truth = [(f, 1, 0.0, 0.0, True) for f in range(5)]
    unnumbered = [(0, 1, 1, 0.0, 0.0, 0.9, True)]
    undeclared = [(1, 1, 1, 0.0, 0.0, 0.9, False, 4)]
    summary = evaluated(matched(9, truth, unnumbered + undeclared)).summary
    assert summary.figure("strict", "a", "hota") is None
    assert summary.figure("strict", "b", "hota").value == 0
    assert summary.figure("strict", "b", "idf1").value == 0
    single = evaluated(matched(9, truth, [(0, *undeclared[0][1:])], methods=("smi",))).summary
    assert single.figure("strict", "smi", "hota") is None
    # Two discs of one ID in a frame are two identities.
    two = [(f, 1, x, 0.0, True) for f in range(5) for x in (0.0, 1.0)]
    claims = [(0, f, 1, x, 0.0, 0.9, True, int(x)) for f, _, x, *_ in two]
    assert evaluated(matched(5, two, claims)).summary.figure("strict", "a", "hota").value == 1


def test_assignment_is_scipy_s() -> None:
    rng = np.random.default_rng(1)
    for _ in range(300):
        score = rng.random(rng.integers(0, 7, 2)) * (rng.random() < 0.9)
        score[rng.random(score.shape) < 0.3] = 0
        rows, columns = assignment(score)
        assert len({*rows.tolist()}) == len(rows) == len({*columns.tolist()})
        best = score[linear_sum_assignment(-score)].sum()
        assert score[rows, columns].sum() == pytest.approx(best, abs=1e-12)
