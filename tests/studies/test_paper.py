"""`make paper`: what it rests on."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from sonarrec.config import SECTIONS, preset, with_table
from sonarrec.evaluation.plots import PUBLISHED
from sonarrec.recogniser.stage3.published import TABLE_3, update
from sonarrec.simulation.motion import poses
from sonarrec.sonar.frame import Estimate
from tests.studies import baseline, bench, scenes
from tests.studies.learning.built_in import MODEL_SEEDS
from tests.studies.paper import parts, prediction, search, world
from tests.studies.paper.published import FRAMES, IDS, IN_VIEW, TABLE_4, TABLE_5
from tests.studies.paper.world import kept_worlds
from tests.support.counted import counted
from tests.support.rows import read_rows
from tests.support.simulated import score

SEEDS = {
    "the built-in model": MODEL_SEEDS,
    "settings": scenes.TUNING,
    "make scenes": scenes.REPORTED,
    "scenes with --ours": scenes.FRESH,
    "the rival's tuning": [seed for seed, _ in baseline.TUNING_SCENES],
    "make bench": bench.REPORTED,
    "stage 1 and SMI": range(8000, 8007),
    "the worlds": range(20_000, 21_120),
    "the choices": range(6000, 6100),
    "the report": prediction.SEEDS,
}


def test_no_seed_is_used_twice() -> None:
    for (a, seeds), (b, others) in combinations(SEEDS.items(), 2):
        assert not set(seeds) & set(others), f"{a} and {b} share seeds"


def test_no_two_worlds_are_akin() -> None:
    worlds = kept_worlds()
    assert len(worlds) >= 8
    assert len({w.number for w in worlds}) == len(worlds)
    # The places of things and all that is drawn once differ in each of them.
    for a, b in combinations([[*w.values.values()] for w in worlds], 2):
        assert np.mean(np.isclose(a, b)) < 0.2


# Tables 4 and 5 as printed: TP, TN, FP, FN of ID.1 to ID.4 and in total.
COUNTS_4 = [(353, 588, 52, 9), (0, 989, 3, 0), (266, 626, 20, 81), (239, 625, 37, 95)]
COUNTS_5 = [(350, 611, 29, 2), (0, 992, 0, 0), (300, 625, 21, 46), (239, 631, 31, 91)]


@pytest.mark.parametrize(("table", "counts"), [(TABLE_4, COUNTS_4), (TABLE_5, COUNTS_5)])
def test_the_published_rates_and_frames_in_view_follow_from_the_counts(table, counts) -> None:
    for k, (tp, tn, fp, fn) in enumerate([*counts, tuple(np.sum(counts, axis=0))]):
        assert table["fpr"][k] == pytest.approx(fp / (fp + tn), abs=6e-5)
        assert table["tpr"][k] == pytest.approx(tp / (tp + fn) if tp + fn else 0, abs=6e-5)
    assert (table["fpr"][4], table["tpr"][4]) in [(fpr, tpr) for _, fpr, tpr in PUBLISHED]
    assert [IN_VIEW.get(i, 0) for i in IDS] == [tp + fn for tp, _, _, fn in COUNTS_5]


def test_the_kept_worlds_are_within_the_ranges_and_seen_as_often_as_published() -> None:
    """Counted from the simulator's truth, not by the rule by which the worlds were found."""
    for kept in kept_worlds():
        assert all(u.low <= kept.values[u.name] <= u.high for u in world.UNKNOWNS)
        check_seen_as_often_as_published(kept)


def check_seen_as_often_as_published(kept: world.World) -> None:
    scene = kept.scene(5)
    assert scene.frames == FRAMES
    pan = np.array([p.pan_deg for p in poses(scene)])
    for item in scene.landmarks:
        seen = int((np.abs(item.azimuth_deg - pan) < scene.sonar.field_of_view_deg / 2).sum())
        assert abs(seen - IN_VIEW[item.id]) <= 16


@pytest.mark.slow
def test_a_recording_is_scored_by_every_method(tmp_path: Path) -> None:
    scene = kept_worlds()[0].scene(1, frames=48)
    folders = tmp_path / "0", tmp_path / "1"
    prediction.record(prediction.Job(scene, folders, tmp_path / "readings"))
    counts = counted(score(folders[:1]))
    assert {method for _, method in counts} == set(prediction.METHODS.values())
    for name in ("framework", "SMI, one claim", "continuity, one claim"):
        count = counts["paper", prediction.METHODS[name]]
        assert count.double == 0
        assert count.total == len(IDS) * 48
    again = tmp_path / "2", tmp_path / "3"
    prediction.record(prediction.Job(scene, again, tmp_path / "readings"))
    tables = [(f / "estimates.csv").read_bytes() for f in (*folders, *again)]
    assert tables[:2] == tables[2:]
    assert tables[0] != tables[1]  # other particles
    # Readings are compared with SMI and the preset as they are in the first folder.
    read = counted(score([tmp_path / "readings"]))
    assert {method for _, method in read} == {*prediction.PLAIN.values(), *parts.READINGS}
    for method in prediction.PLAIN.values():
        assert read["paper", method] == counts["paper", method]
        assert read["strict", method] == counts["strict", method]


def every_point(folders: list[Path], method: str) -> list[tuple[float, float]]:
    """(FPR, TPR) in protocol paper with each score as the least one, counted frame by frame."""
    found = []
    logs = [(read_rows(f / "estimates.csv"), read_rows(f / "gt.csv")) for f in folders]
    mine = [[r for r in estimates if r["method"] == method] for estimates, _ in logs]
    for least in [*sorted({round(float(r["score"]), 6) for rows in mine for r in rows}), 2.0]:
        tp = tn = fp = fn = 0
        for rows, (_, truth) in zip(mine, logs, strict=True):
            there = {(r["frame"], r["landmark"]) for r in truth if float(r["visible"]) >= 0.5}
            enough = (r for r in rows if round(float(r["score"]), 6) >= least)
            said = [(r["frame"], r["landmark"]) for r in enough]
            tp += sum(s in there for s in said)
            fn += len(there - set(said))
            fp += len(set(said) - there)
            tn += 48 * len(IDS) - len(there | set(said))
        found.append((fp / (fp + tn), tp / (tp + fn)))
    return found


@pytest.mark.slow
def test_the_tpr_at_an_fpr_is_that_of_counting_at_every_score(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prediction, "in_processes", lambda work, items: list(map(work, items)))
    worlds = kept_worlds()[2:18:15]  # of which these frames show landmarks
    jobs = [prediction.jobs_of(w, 0, 1, 48, tmp_path / str(w.number)) for w in worlds]
    for (job,) in jobs:
        prediction.record(job)
    group = prediction.grouped(worlds, jobs)
    for method in prediction.METHODS:
        points = [every_point(list(j.folders), prediction.METHODS[method]) for (j,) in jobs]
        for fpr in (0.0, 0.01, 0.0312, 0.2):
            expected = [max(t for f, t in of if f <= fpr) for of in points]
            assert group.tpr_at(method, "paper", fpr) == pytest.approx(expected, abs=1e-12)
    # One claim of an ID and frame: no method has more hits than landmarks in view.
    assert (group.tpr_at("SMI", "paper", 1) >= group.tpr_at("SMI, one claim", "paper", 1)).all()
    lines = prediction.reading_lines(prediction.grouped(worlds, jobs, readings=True))
    assert [line["reading"] for line in lines[2:]] == [*parts.READINGS]


def test_readings_are_the_formulas_as_printed_and_one_choice_each() -> None:
    paper = preset("paper")
    printed, *others = (with_table(paper, t, "") for t in parts.READINGS.values())
    assert printed.continuity.hit_power == printed.features.distance_power == 1
    assert printed.features.least_ring == printed.continuity.least_in_view == 0
    for other in others:
        sections = [(getattr(other, s), getattr(paper, s)) for s in SECTIONS]
        changed = [n for a, b in sections for n in a.__slots__ if getattr(a, n) != getattr(b, n)]
        assert len(changed) == 1, changed


def test_a_faultless_disc_is_declared_in_the_frame_that_the_manual_tells() -> None:
    """`sonarrec help method`: ID.1 and ID.4 in the third, ID.2 and ID.3 in the fourth."""
    ideal = np.array([[4, 3, 3, 2], [3, 4, 2, 3], [3, 2, 4, 3], [2, 3, 3, 4]]) / 12
    model, belief = TABLE_3 / TABLE_3.sum(axis=1, keepdims=True), np.full((4, 4), 0.25)
    declared = []
    for _ in range(4):
        belief = update(belief, ideal, model)
        declared.append((np.diag(belief) >= preset("paper").features.declare).tolist())
    assert declared == [[False] * 4] * 2 + [[True, False, False, True], [True] * 4]


def test_one_claim_is_the_surest_of_its_id() -> None:
    place, belief = (0.0,) * 5, (1.0, np.zeros(5))
    claims = [
        Estimate("m", 0, *place, *belief, landmark, score, score >= 0.5)
        for landmark, score in ((1, 0.6), (1, 0.9), (3, 0.4), (3, 0.2))
    ]
    kept = parts.once(claims)
    assert [(e.score, e.declared) for e in kept] == [(0, 0), (0.9, 1), (0.4, 0), (0, 0)]


def test_an_interval_of_worlds_covers_the_mean() -> None:
    drawn = np.random.default_rng(3).normal(size=(200, 22))
    covered = [low <= 0 <= high for low, high in map(prediction.interval_of, drawn)]
    assert 0.88 <= np.mean(covered) <= 0.98


@pytest.mark.slow
def test_a_world_of_the_search_is_possible() -> None:
    first = search.drawn(np.random.default_rng(1))
    other = search.drawn(np.random.default_rng(2), like=first)
    for drawn in (first, other):
        check_seen_as_often_as_published(drawn)
    same = [n for n in world.NAMES if first.values[n] == other.values[n]]
    assert "ring_db" in same
    assert "azimuth_deg_1" not in same


def test_the_sign_flip_test_is_exact() -> None:
    assert prediction.flipped(np.full(8, 0.02)) == pytest.approx(2 / 256)
    assert prediction.flipped(np.array([1.0, -1.0, 1.0, -1.0])) == 1
    assert prediction.flipped(np.array([3.0, 1.0, -2.0])) == pytest.approx(6 / 8)
