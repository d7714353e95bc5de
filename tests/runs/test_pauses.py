"""Recordings that were paused, and clocks that were set back: what ends there, and what is told."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sonarrec import evaluate
from sonarrec.advice.rows import check_truth
from sonarrec.config import preset
from sonarrec.landmarks import load_landmarks
from sonarrec.overlays import overlay as overlays
from sonarrec.readers import open_log
from sonarrec.recogniser.presets.side_by_side import SideBySide
from sonarrec.results.read import read_log
from sonarrec.results.sightings import read_sightings
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import scene_fan
from sonarrec.simulation.simulate import simulate
from sonarrec.sonar.frame import Frame, FrameResult
from sonarrec.truth.table import write_truth
from tests.support.command import sonarrec
from tests.support.logs import SONAR_TOML, cdr_image, frames, image_folder, mcap_file
from tests.support.paused import IDS, PERIOD_NS, START_NS, parts, paused, record
from tests.support.rows import read_rows, write_rows

BASIN = load_landmarks("basin")
PRESETS = ("default", "offline", "paper")
FRAMES = 24


@cache
def recognised(pause_ns: int) -> tuple[FrameResult, ...]:
    """Two parts of FRAMES frames by all presets, with a pause between."""
    scenes = parts(FRAMES, 2)

    def frames() -> Iterator[Frame]:
        for part, scene in enumerate(scenes):
            start_ns = START_NS + part * ((FRAMES - 1) * PERIOD_NS + pause_ns)
            for one in render(scene):
                index, time_ns = part * FRAMES + one.index, start_ns + one.index * PERIOD_NS
                stretch = part * (pause_ns > PERIOD_NS)
                yield Frame(index, time_ns, one.image, scene_fan(scene), stretch=stretch)

    stages = SideBySide([preset(p) for p in PRESETS], scene_fan(scenes[0]), scenes[0].landmark_set)
    return tuple(stages.recognise(frames()))


def tracks(results: tuple[FrameResult, ...], name: str) -> tuple[set[int], set[int]]:
    """The tracks before and after the pause."""
    before, after = (
        {e.object for r in part for e in r.estimates if e.method == f"framework:{name}"}
        for part in (results[:FRAMES], results[FRAMES:])
    )
    return before, after


@pytest.mark.parametrize("name", PRESETS)
def test_no_track_goes_over_a_pause(name: str) -> None:
    before, after = tracks(recognised(5 * 10**9), name)
    assert before
    assert after
    assert max(before) < min(after)
    going_on = tracks(recognised(PERIOD_NS), name)
    assert going_on[0] & going_on[1]  # the same frames without a pause


@pytest.mark.parametrize("name", PRESETS[:2])
def test_no_belief_goes_over_a_pause(name: str) -> None:
    """The discs afterwards are others, in the same places."""

    def claimed(pause_ns: int) -> set[int]:
        after = recognised(pause_ns)[FRAMES:]
        found = (e for r in after for e in r.estimates if e.method == f"framework:{name}")
        return {e.landmark for e in found if e.declared}

    assert claimed(5 * 10**9) == set(IDS.values())
    assert claimed(PERIOD_NS) & set(IDS)


def test_the_paper_begins_with_even_beliefs() -> None:
    """Eq. 5 spreads the beliefs of all objects of the frame before."""
    results = recognised(5 * 10**9)
    first, again = (
        max(float(e.probabilities.max()) for e in r.estimates if e.method == "framework:paper")
        for r in (results[0], results[FRAMES])
    )
    assert again <= first + 0.1


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An MCAP with two pauses, run: the log, and its results in out/dive."""
    folder = tmp_path_factory.mktemp("paused")
    log = paused(folder / "dive.mcap", 5.3, 3600, frames=FRAMES)
    (folder / "told.txt").write_text(sonarrec("run", log, "-o", folder / "out").stderr)
    return log


def results(log: Path) -> Path:
    return log.parent / "out" / log.stem


def test_pauses_are_told(dive: Path) -> None:
    line = "2 pauses: 5.3 s after frame 23, 1 h after frame 47"
    told = sonarrec("info", dive).output
    assert line in told
    assert "4 Hz" in told
    assert line in (dive.parent / "told.txt").read_text()
    (found,) = json.loads(sonarrec("info", dive, "--json").stdout)["logs"]
    assert found["images"][0]["rate_hz"] == pytest.approx(4)


def test_frames_csv_states_no_step_over_a_pause(dive: Path) -> None:
    rows = read_rows(results(dive) / "frames.csv")
    assert [r["frame"] for r in rows if not r["dyaw_deg"]] == ["0", "24", "48"]


def test_poses_state_the_step_over_a_pause_but_no_track_goes_over(dive: Path) -> None:
    poses, out = dive.parent / "poses.csv", dive.parent / "posed"
    start_s = START_NS / 1e9
    times = [start_s + n / 4 for n in range(20_000)]
    poses.write_text("\n".join(["timestamp,yaw,x,y", *(f"{t:.2f},3,0,0" for t in times), ""]))
    sonarrec("run", dive, "-o", out, "--odometry", poses)
    rows = read_rows(out / "dive" / "frames.csv")
    assert [r["frame"] for r in rows if not r["dyaw_deg"]] == ["0"]
    assert (rows[24]["dyaw_deg"], rows[24]["dyaw_sigma_deg"]) == ("0.0000", "")
    of_parts = [set[str](), set[str](), set[str]()]
    for row in read_rows(out / "dive" / "estimates.csv"):
        if row["method"] == "framework":
            of_parts[int(row["frame"]) // FRAMES].add(row["object"])
    assert not of_parts[0] & of_parts[1]
    assert not of_parts[1] & of_parts[2]
    told = sonarrec("map", out / "dive", "--odometry", poses)
    assert "path" not in told.stdout.split("number")[1]
    assert {r["path"] for r in read_rows(out / "dive" / "map" / "map.csv")} == {"1"}


@pytest.mark.usefixtures("pictures")
def test_without_poses_a_map_has_a_path_for_each_stretch(dive: Path) -> None:
    told = sonarrec("map", results(dive), "-o", dive.parent / "map", "--origin", "54,10,0")
    assert "frame 24, 48" in told.stderr
    assert "1 log" in told.stdout
    rows = read_rows(dive.parent / "map" / "map.csv")
    assert [(r["path"], r["landmark"]) for r in rows] == [
        *(("1", "1"), ("1", "3"), ("2", "2"), ("2", "4"), ("3", "1"), ("3", "3"))
    ]
    assert all(r["other_frames"] == "0" for r in rows)
    # The sonar stood and the scenes are the same: each path begins where the first one did.
    for row, first in zip(rows[2:], rows[:2] * 2, strict=True):
        assert float(row["x_m"]) == pytest.approx(float(first["x_m"]), abs=0.03)
        assert float(row["y_m"]) == pytest.approx(float(first["y_m"]), abs=0.03)
    for row in read_rows(dive.parent / "map" / "passes.csv"):
        assert int(row["path"]) == 1 + int(row["first_frame"]) // FRAMES
    features = json.loads((dive.parent / "map" / "map.geojson").read_text())["features"]
    points = [f["properties"] for f in features if f["geometry"]["type"] == "Point"]
    assert [p["path"] for p in points] == [1, 1, 2, 2, 3, 3]
    assert (dive.parent / "map" / "map.png").stat().st_size > 10_000


@pytest.fixture
def joined(dive: Path, tmp_path: Path) -> Path:
    """Another program's results of that log: one track of ID.1 without an end, but in frames 20 to
    27, where it is not seen."""
    folder = tmp_path / "dive"
    folder.mkdir()
    for name in ("run.toml", "frames.csv"):
        (folder / name).write_bytes((results(dive) / name).read_bytes())
    text = (folder / "run.toml").read_text()
    (folder / "run.toml").write_text(text.replace("finished = true", "finished = false"))
    rows = read_rows(results(dive) / "estimates.csv")
    [first, *_] = (
        r for r in rows if (r["method"], r["declared"], r["landmark"]) == ("framework", "1", "1")
    )
    every = [n for n in range(3 * FRAMES) if not 20 <= n < 28]
    stamps = {r["frame"]: r["timestamp_ns"] for r in read_rows(folder / "frames.csv")}
    found = [first | {"frame": n, "timestamp_ns": stamps[str(n)], "object": 1} for n in every]
    write_rows(folder / "estimates.csv", found)
    return folder


def test_stretches_are_numbered_and_other_programs_need_not(dive: Path, joined: Path) -> None:
    wanted = [n // FRAMES for n in range(3 * FRAMES)]
    with open_log(dive) as log:
        assert [frame.stretch for frame in log] == wanted
    rows = read_rows(joined / "frames.csv")
    assert [int(row["stretch"]) for row in rows] == wanted
    write_rows(joined / "frames.csv", [{k: r[k] for k in ("frame", "timestamp_ns")} for r in rows])
    assert read_log(joined).stretch.tolist() == wanted


def test_sightings_and_passes_of_other_programs_end_there(joined: Path, tmp_path: Path) -> None:
    spans = [(s.first_frame, s.last_frame) for s in read_sightings(joined)]
    assert spans == [(0, 19), (28, 47), (48, 71)]
    seen = {"landmark": 1, "range_m": 2.0, "bearing_deg": 0.0}
    write_rows(tmp_path / "gt.csv", [{"frame": n} | seen for n in range(3 * FRAMES)])
    scores = evaluate(joined, tmp_path / "gt.csv")
    passes = scores.passes.query("protocol == 'strict' and method == 'framework'")
    spans = [*zip(passes.first_frame, passes.last_frame, strict=True)]
    assert spans == [(0, 23), (24, 47), (48, 71)]
    assert scores.counts.units.number == 3


def test_propose_fills_no_gap_over_a_pause(joined: Path, tmp_path: Path) -> None:
    sonarrec("truth", "propose", joined, "-o", tmp_path / "new.csv", "--max-gap", "20", code=3)
    frames = [int(r["frame"]) for r in read_rows(tmp_path / "new.csv")]
    assert frames == [n for n in range(3 * FRAMES) if not 20 <= n < 28]


def test_trails_begin_anew(dive: Path, joined: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lengths = list[int]()

    def noted(history: object) -> dict[int, np.ndarray]:
        found = trails(history)
        lengths.append(max(map(len, found.values()), default=0))
        return found

    trails = overlays.trails
    monkeypatch.setattr(overlays, "trails", noted)
    overlays.overlay(dive, dive.parent / "pictures", results=joined, frames=(40, 60))
    assert lengths[:8] == [13, 14, 15, 16, 17, 18, 19, 20]
    assert lengths[8:] == list(range(1, 13))


def black(folder: Path, pause_s: float) -> Path:
    """Twice FRAMES black frames, with a pause between."""
    images, pause_ns = [np.zeros((300, 560), np.uint8)] * 2 * FRAMES, round(pause_s * 1e9)
    image_folder(folder, images)
    for n in range(2 * FRAMES):
        time_ns = START_NS + n * PERIOD_NS + (pause_ns - PERIOD_NS if n >= FRAMES else 0)
        (folder / f"frame{n}.png").rename(folder / f"{time_ns}.png")
    return folder


@pytest.mark.parametrize(("pause_s", "faults"), [(5.0, set()), (0.25, {"jump", "changed"})])
def test_a_truth_may_change_over_a_pause(pause_s: float, faults: set[str], tmp_path: Path) -> None:
    """Neither a jump nor another ID in one place is a fault there."""
    rows = [(n, 1 if n < FRAMES else 2, 2.0, 0.0) for n in range(2 * FRAMES)]
    rows += [(n, 3, *((2.4, -9.0) if n < FRAMES else (1.9, 9.0))) for n in range(2 * FRAMES)]
    write_truth(tmp_path / "gt.csv", ("frame", "landmark", "range_m", "bearing_deg"), rows)
    with open_log(black(tmp_path / "dive", pause_s)) as log:
        found = check_truth(tmp_path / "gt.csv", log, BASIN, max_pan_deg=5.0)[1]
    assert {fault.kind for fault in found} == faults


@pytest.mark.parametrize(("pause_s", "told"), [(5.0, 0), (0.25, 1)])
def test_a_truth_is_not_shifted_over_a_pause(pause_s: float, told: int, tmp_path: Path) -> None:
    """Rows in the six last frames of a stretch, claims in the six first of the next."""
    folder, last = tmp_path / "dive", range(FRAMES - 6, FRAMES)
    folder.mkdir()
    (folder / "run.toml").write_text("")
    gap_ns = round(pause_s * 1e9) - PERIOD_NS
    times = [START_NS + n * PERIOD_NS + gap_ns * (n >= FRAMES) for n in range(2 * FRAMES)]
    write_rows(
        folder / "frames.csv", [{"frame": n, "timestamp_ns": t} for n, t in enumerate(times)]
    )
    seen = [{"frame": n, "landmark": 1, "range_m": 2 + n / 50, "bearing_deg": 0.0} for n in last]
    more = {"method": "framework", "object": 1, "score": 0.9, "declared": 1}
    write_rows(folder / "estimates.csv", [r | more | {"frame": r["frame"] + 6} for r in seen])
    write_rows(tmp_path / "gt.csv", seen)
    scores = evaluate(folder, tmp_path / "gt.csv", sonar={"range_min_m": 1.0, "range_max_m": 4.0})
    assert sum("6 frames later" in line for line in scores.unused) == told


def test_names_in_local_time_as_summer_time_ends(tmp_path: Path) -> None:
    """At 03:00 the clock shows 02:00 again, so what was recorded last comes first."""
    three = int(datetime(2024, 10, 27, 3, tzinfo=UTC).timestamp()) * 10**9
    first, then = parts(FRAMES, 2)
    starts = three - 3600 * 10**9, three - FRAMES * PERIOD_NS
    log = record(tmp_path / "dive", [then, first], starts)
    for told in (
        sonarrec("run", log, "-o", tmp_path / "out").stderr,
        sonarrec("info", log).output,
        sonarrec("evaluate", tmp_path / "out" / "dive").output,
    ):
        assert f"frames from {FRAMES} on" in told
    for row in read_rows(tmp_path / "out" / "dive" / "sightings.csv"):
        assert int(row["end_ns"]) - int(row["start_ns"]) < 10 * 10**9


def test_a_clock_that_was_set_back_ends_tracks_whichever_names_the_frames(tmp_path: Path) -> None:
    """The recorder's clock is steady; the sonar's was set back."""
    stamps = [(1000 + n if n < 12 else 100 + n) for n in range(24)]
    sent = [
        (n * PERIOD_NS, cdr_image(image, stamp=(stamp, 0)))
        for n, (image, stamp) in enumerate(zip(frames(24), stamps, strict=True))
    ]
    log = mcap_file(tmp_path / "dive.mcap", [("/sonar", *message) for message in sent])
    (tmp_path / "dive.sonar.toml").write_text(SONAR_TOML)
    with open_log(log) as opened:
        assert len(list(opened)) == 24
        [note] = opened.diagnostics.notes
    assert "back by 15 min after" in note
    with open_log(log, time="header") as opened:
        assert len(list(opened)) == 24
        [note] = opened.diagnostics.notes
    assert "go back" in note
    assert "at frame 12" in note
    assert "--time log" in note
    out = tmp_path / "out"
    for clock in ("log", "header"):
        sonarrec("run", log, "--time", clock, "-o", out, "--overwrite")
        rows = read_rows(out / "dive" / "frames.csv")
        assert [r["frame"] for r in rows if not r["dyaw_deg"]] == ["0", "12"]


@pytest.mark.parametrize(("named", "pauses"), [(True, 1), (False, 0)])
def test_lost_frames_are_a_pause_only_where_frames_have_times(
    named: bool, pauses: int, tmp_path: Path
) -> None:
    log = image_folder(tmp_path / "dive", frames(2 * FRAMES))
    for n in range(2 * FRAMES):
        image = log / f"frame{n}.png"
        if 15 <= n < 35:
            image.write_bytes(b"")
        if named:
            image.rename(log / f"{START_NS + n * PERIOD_NS}.png")
    with open_log(log) as opened:
        assert len(list(opened)) == 2 * FRAMES - 20
        assert sum("pause" in note for note in opened.diagnostics.notes) == pauses


@pytest.mark.slow
def test_plates_are_followed_over_no_pause(tmp_path: Path) -> None:
    simulate("plates", tmp_path / "plates", frames=6)
    landmarks = load_landmarks(str(tmp_path / "plates" / "landmarks.toml"))
    with open_log(tmp_path / "plates") as log:
        shown = list(log)

    def both(pause_ns: int) -> tuple[set[int], set[int]]:
        steps = [0, *[PERIOD_NS] * 11]  # twelve frames before the pause, six after it
        steps += [pause_ns, *[PERIOD_NS] * 5]
        times = START_NS + np.cumsum(steps)
        frames = [
            replace(
                shown[n % 6], index=n, timestamp_ns=time, stretch=int(n > 11 and pause_ns > 10**9)
            )
            for n, time in enumerate(times.tolist())
        ]
        stages = SideBySide([preset("default")], shown[0].fan, landmarks)
        found = [{e.object for e in r.estimates} for r in stages.recognise(frames)]
        return set().union(*found[:12]), set().union(*found[12:])

    before, after = both(5 * 10**9)
    assert after
    assert max(before) < min(after)
    before, after = both(PERIOD_NS)
    assert before & after
