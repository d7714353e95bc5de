"""What the report gathers of a log, against loops: mistakes, truth, sightings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sonarrec.evaluation.match import PROTOCOLS
from sonarrec.reports.logs import alongside, episodes, in_words, tracks
from tests.support.claims import evaluate
from tests.support.pages import PLACED, reported, tables


@pytest.fixture(scope="module")
def random_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random results of two methods and random truth, with positions."""
    folder, rng, frames = tmp_path_factory.mktemp("random") / "log", np.random.default_rng(5), 120
    places = rng.uniform((1.5, -10), (3.5, 10), (5, 2))
    rows, truth = [], []
    for n in range(frames):
        for range_m, bearing in places[rng.random(5) < 0.5]:
            near = (range_m + rng.normal(0, 0.05), bearing + rng.normal(0, 1))
            truth.append(f"{n},{rng.integers(1, 5)},{range_m},{bearing},{rng.choice([0.5, 1])}")
            for method in ("smi", "framework"):
                s = round(rng.random(), 2)
                rows.append(
                    f"{n},{method},{rng.integers(100, 104)},{near[0]},{near[1]},.1,.2,.3,.2,.2,"
                    f"{rng.integers(1, 5)},{s},{int(s > 0.4)}"
                )
    tables(folder, ((n, n * 250_000_000) for n in range(frames)), PLACED, rows)
    lines = ["frame,landmark,range_m,bearing_deg,visible", *dict.fromkeys(truth), ""]
    (folder / "gt.csv").write_text("\n".join(lines))
    return folder


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_mistakes_add_up_to_the_table(random_log: Path, tmp_path: Path, protocol: str) -> None:
    truth = random_log / "gt.csv"
    if protocol == "paper":  # without positions in the truth only this one is scored
        rows = [line.split(",") for line in truth.read_text().splitlines()]
        truth = tmp_path / "gt.csv"
        truth.write_text("".join(f"{r[0]},{r[1]},{r[4]}\n" for r in rows))
    found = evaluate(random_log, truth)
    matched = reported(random_log, truth).matched
    assert matched is not None
    for one in (s for s in found.scored if s.protocol == protocol):
        count, wrong = one.count(), episodes([matched], one.method, protocol)
        assert sum(e.times for e in wrong if e.kind == "claim") == count.fp > 50
        assert sum(e.times for e in wrong if e.kind == "miss") == count.fn > 50
        for e in wrong:
            assert e.first <= e.worst <= e.last
            assert 0 <= e.wrongness <= 1


def test_episodes_and_their_order(tmp_path: Path) -> None:
    """By hand: a long mistake before a short one; a gap of five frames makes two of one."""
    log = tmp_path / "log"
    # ID.2 claimed at 20 deg, where nothing lies: frames 0 to 3, 8 and 14 (gaps of 4 and 5).
    claims = [f"{n},mine,2,2.0,20,{0.5 + n / 100},1" for n in (0, 1, 2, 3, 8, 14)]
    # ID.1 lies at 0 deg in frames 20 and 21; called ID.3 there, then scored too low.
    claims += ["20,mine,3,2.0,0,0.8,1", "21,mine,1,2.0,0,0.3,0"]
    tables(log, range(40), "frame,method,landmark,range_m,bearing_deg,score,declared", claims)
    (log / "gt.csv").write_text(
        "frame,landmark,range_m,bearing_deg\n20,1,2.0,0\n21,1,2.0,0\n30,4,2.0,0\n"
    )
    matched = reported(log, log / "gt.csv").matched
    assert matched is not None
    found = episodes([matched], "mine", "strict")
    shown = [(e.kind, e.landmark, e.first, e.last, e.worst, e.times) for e in found]
    assert shown == [
        ("claim", 2, 0, 8, 8, 5),
        ("miss", 1, 20, 21, 20, 2),
        ("miss", 4, 30, 30, 30, 1),
        ("claim", 3, 20, 20, 20, 1),
        ("claim", 2, 14, 14, 14, 1),
    ]
    assert [in_words(e) for e in found] == [
        "ID.2 declared (0.58) where no landmark lies",
        "ID.1 in view and not declared: called ID.3 (0.80)",
        "ID.4 in view and not declared: nothing found there",
        "ID.3 declared (0.80) on what is ID.1",
        "ID.2 declared (0.64) where no landmark lies",
    ]


def test_truth_beneath_and_estimates_alongside(random_log: Path) -> None:
    """Against loops over every pair."""
    log = reported(random_log)
    found, truth = log.results, log.matched
    assert truth is not None
    assert log.truth_near is not None
    assert found.position is not None
    for n in range(0, len(found.frame_index), 7):
        best, beneath = found.landmarks.radius_m, -1
        for t in np.flatnonzero(truth.truth_frame_index == found.frame_index[n]):
            away = np.linalg.norm(found.position[n] - truth.truth_position[t])
            if away <= best:
                best, beneath = away, truth.truth_landmark_index[t]
        assert log.truth_near[n] == beneath
    shown = tracks(log)
    assert {track.number for track in shown} == {100, 101, 102, 103}
    smi = np.flatnonzero(log.of_method("smi"))
    for track in shown:
        assert (np.diff(track.frame_index) > 0).all()
        assert (found.object[track.estimates] == track.number).all()
        for at, row, matched in zip(
            track.estimates, track.frame_index, alongside(log, track, "smi"), strict=True
        ):
            here = smi[found.frame_index[smi] == row]
            away = np.linalg.norm(found.position[here] - found.position[at], axis=1)
            if len(here) and away.min() <= found.landmarks.radius_m:
                assert matched == here[away.argmin()]
            else:
                assert matched == -1
