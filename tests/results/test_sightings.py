"""Passes: gathered frame by frame, written, read back, and worked out from the tables."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.api.run import run
from sonarrec.cli.run import found_in
from sonarrec.errors import SonarrecError
from sonarrec.landmarks import load_landmarks
from sonarrec.results.folders import part_of
from sonarrec.results.sightings import Sighting, Sightings, read_sightings, sightings_in
from sonarrec.results.write import ResultsWriter
from sonarrec.runs.one import MOST_SIGHTINGS, _outcome
from sonarrec.sonar.frame import Estimate, FrameResult
from sonarrec.sonar.geometry import pose_table
from tests.results.test_write import tables
from tests.support.drawn import make_fan

BASIN = load_landmarks("basin")
SAMPLE = Path(__file__).parents[2] / "sample_data"
CONTRACT = (
    "method,landmark,track,first_frame,last_frame,start_ns,end_ns,frames_declared,mean_score,"
    "best_score,range_m,bearing_deg,orientation_deg,range_sigma_m,bearing_sigma_deg,"
    "orientation_sigma_deg,x_m,y_m"
)


def claim(method: str = "framework", **changed: object) -> Estimate:
    values: dict[str, object] = {
        "method": method,
        "object": 3,
        "x_px": 1.0,
        "y_px": 1.0,
        "range_m": 2.0,
        "bearing_deg": 0.0,
        "orientation_deg": 0.0,
        "existence": 1.0,
        "probabilities": np.array([0.7, 0.1, 0.05, 0.05, 0.1]),
        "landmark": 1,
        "score": 0.7,
        "declared": True,
    }
    return Estimate(**(values | changed))  # type: ignore[arg-type]


def gathered(frames: dict[int, list[Estimate]], sightings: Sightings | None = None) -> list:
    sightings = sightings or Sightings(BASIN)
    found = []
    for frame, estimates in sorted(frames.items()):
        found += sightings.add(frame, frame * 10**8, estimates)
    return found + sightings.close_all()


@pytest.mark.parametrize("landmark", [1, 2])
def test_turns_that_look_the_same_are_one_direction(landmark: int) -> None:
    """ID.2 looks the same after half a turn, and is read as one or the other."""
    turns = [178.0, 4.0, 181.0, 3.0] if landmark == 2 else [178.0, 184.0, 181.0, 183.0]
    frames = {f: [claim(landmark=landmark, orientation_deg=t)] for f, t in enumerate(turns)}
    [found] = gathered(frames)
    assert found.orientation_deg == pytest.approx(181.5, abs=0.1)  # of those the first one's
    [unknown] = gathered({0: [claim(landmark=landmark, orientation_deg=np.nan)]})
    assert np.isnan(unknown.orientation_deg)


claims = st.tuples(
    st.integers(0, 60),
    st.sampled_from(["framework", "smi"]),
    st.integers(0, 2),
    st.sampled_from([1, 4]),
    st.floats(0, 1),
    st.floats(1, 4),
    st.floats(0, 359),
    st.floats(0.001, 1),
    st.booleans(),
)


@given(st.lists(claims, max_size=60))
@settings(max_examples=30)
def test_every_figure_is_what_numpy_says_of_the_pass(rows: list[tuple]) -> None:
    """Against runs cut out of all the declarations at once."""
    frames: dict[int, list[Estimate]] = defaultdict(list)
    by_key = defaultdict(list)
    for frame, method, number, landmark, score, range_m, turn, sigma, declared in rows:
        read = {"object": number, "landmark": landmark, "score": score, "declared": declared}
        read |= {"range_m": range_m, "orientation_deg": turn}
        e = claim(method, **read, range_sigma_m=math.nan if method == "smi" else sigma)
        frames[frame].append(e)
        if declared:
            by_key[method, landmark, None if method == "smi" else number].append((frame, e))
    expected = []
    for key, found in by_key.items():
        found.sort(key=lambda one: one[0])
        at = np.array([f for f, _ in found])
        for part in np.split(np.arange(len(at)), np.flatnonzero(np.diff(at) > 10) + 1):
            inside = [found[n][1] for n in part]
            turns = np.exp(1j * np.radians([e.orientation_deg for e in inside]))
            scores, ranges = [e.score for e in inside], [e.range_m for e in inside]
            sigma = np.sqrt(np.mean([e.range_sigma_m**2 for e in inside]))
            span = *key, at[part[0]], at[part[-1]], len(set(at[part]))
            told = np.mean(scores), max(scores), np.mean(ranges), turns.mean(), sigma
            expected.append((span, *told))
    found_all = gathered(frames)
    assert [s.last_frame for s in found_all] == sorted(s.last_frame for s in found_all)

    def ident(s: Sighting) -> tuple:
        return s.method, s.landmark, s.track, s.first_frame, s.last_frame, s.frames_declared

    by_span = {ident(s): s for s in found_all}
    assert len(by_span) == len(found_all) == len(expected)
    for key, mean, best, range_m, turn, sigma in expected:
        s = by_span[key]
        assert (s.start_ns, s.end_ns) == (s.first_frame * 10**8, s.last_frame * 10**8)
        assert (s.mean_score, s.best_score) == (pytest.approx(mean), best)
        assert s.range_m == pytest.approx(range_m)
        assert s.range_sigma_m == pytest.approx(sigma, nan_ok=True)
        if abs(turn) > 1e-6:  # else they cancel out
            unit = np.exp(1j * np.radians(s.orientation_deg))
            assert unit == pytest.approx(turn / abs(turn), abs=1e-6)
        assert math.isnan(s.x_m)


def test_the_place_on_the_floor_is_the_same_from_wherever_it_is_seen() -> None:
    """A mark at (1, 4): seen from three places with three headings, ranges by Pythagoras."""
    fan, mark = make_fan(), (1.0, 4.0)
    assert fan.height_m is not None
    poses = [(0.0, 0.0, 0.0), (20.0, -0.5, 1.0), (350.0, 2.0, 0.5)]
    at = np.arange(3) * 10**8
    yaw, x, y = np.array(poses).T
    table = pose_table("poses", {}, at, yaw, x, y)
    frames = {}
    for n, (heading, px, py) in enumerate(poses):
        bearing = math.degrees(math.atan2(mark[0] - px, mark[1] - py)) - heading
        away = math.hypot(mark[0] - px, mark[1] - py, fan.height_m)
        frames[n] = [claim(range_m=away, bearing_deg=(bearing + 180) % 360 - 180)]
    [s] = gathered(frames, Sightings(BASIN, fan, table))
    assert (s.x_m, s.y_m) == pytest.approx(mark)
    as_ros = replace(table, axes="ahead, left")
    [s] = gathered(frames, Sightings(BASIN, fan, as_ros))
    assert (s.x_m, s.y_m) == pytest.approx((mark[1], -mark[0]))
    [unknown] = gathered({9: [claim()]}, Sightings(BASIN, fan, table))
    assert math.isnan(unknown.x_m)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    return run(SAMPLE / "pan.mcap", out, preset=["default", "offline"]).folder


@pytest.mark.parametrize("why", ["no sightings.csv", "cut short"])
def test_the_tables_give_the_same_sightings(results: Path, tmp_path: Path, why: str) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    for name in ("frames.csv", "estimates.csv", "run.toml"):
        (copy / name).write_bytes((results / name).read_bytes())
    if why == "cut short":
        (copy / "sightings.csv").write_text(CONTRACT + "\n")
        text = (copy / "run.toml").read_text()
        (copy / "run.toml").write_text(text.replace("finished = true", "finished = false"))
    found = list(read_sightings(copy))
    written = list(read_sightings(results))
    assert len(found) == len(written) > 8
    for one, other in zip(found, written, strict=True):
        for name in CONTRACT.split(","):
            a, b = getattr(one, name), getattr(other, name)
            near = 0.06 if "orientation" in name else 2e-3
            assert a == (pytest.approx(b, abs=near, nan_ok=True) if isinstance(b, float) else b)


def broken_off(folder: Path) -> None:
    with ResultsWriter(folder, BASIN, tables()) as writer:
        for i in range(20):
            writer.write(FrameResult(i, i, 1, 1, (claim(declared=i < 3 or i > 17),)))
        raise KeyboardInterrupt


def test_a_run_that_breaks_off_leaves_the_passes_of_its_frames(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        broken_off(tmp_path / "dive")
    part = part_of(tmp_path / "dive")
    written = list(sightings_in(part / "sightings.csv"))
    assert [(s.first_frame, s.last_frame) for s in written] == [(0, 2), (18, 19)]
    worked_out = list(read_sightings(part))  # run.toml says that it did not finish
    assert [(s.first_frame, s.last_frame) for s in worked_out] == [(0, 2), (18, 19)]


@pytest.mark.parametrize("cell", ["x", "", "1.5"])
def test_a_wrong_cell_is_told_with_its_line(results: Path, tmp_path: Path, cell: str) -> None:
    text = (results / "sightings.csv").read_text().splitlines()
    text[2] = ",".join(cell if i == 3 else c for i, c in enumerate(text[2].split(",")))
    file = tmp_path / "sightings.csv"
    file.write_text("\n".join(text))
    with pytest.raises(SonarrecError, match=r"sightings\.csv line 3: no sighting"):
        list(sightings_in(file))


def test_the_table_is_bounded_and_says_how_many_more(tmp_path: Path) -> None:
    """Of thirty passes the longest, in order, with the calendar's time."""
    start = 1_700_000_000 * 10**9
    with ResultsWriter(tmp_path / "dive", BASIN, tables()) as writer:
        for i in range(30 * 40):
            seen = i % 40 < 1 + i // 40
            writer.write(FrameResult(i, start + i * 10**8, 1, 1, (claim(declared=seen),)))
        writer.finish([])
    outcome = _outcome(tmp_path / "dive", ["framework"], [], frames=1200, candidates=1200)
    kept = outcome.sightings
    assert outcome.passes == {"framework": 30}
    assert [s.frames_declared for s in kept] == list(range(31 - MOST_SIGHTINGS, 31))
    assert outcome.landmarks == {kept[0].landmark: sum(range(1, 31))}
    lines = found_in(outcome, outcome.folder)
    assert len(lines) == MOST_SIGHTINGS + 3
    assert "UTC" in lines[1]
    assert "10 more in" in lines[-1]
    none = replace(outcome, passes={"framework": 0}, sightings=[])
    assert found_in(none, none.folder)[1:] == ["  no landmark declared"]
