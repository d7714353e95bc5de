"""The page on which a person checks ground truth: what is in it, and what it does in a browser."""

from __future__ import annotations

import base64
import json
import re
import shutil
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sonarrec.results.read import read_log
from sonarrec.sonar.geometry import (
    floor_depth,
    ground_range,
    pixel_from_polar,
    plane_from_polar,
    polar_from_pixel,
    slant_range,
)
from sonarrec.truth.match import share_in_image
from tests.support.browser import COLOURS, contrast
from tests.support.command import SAMPLE, sonarrec
from tests.support.drawn import SECTORS, make_fan
from tests.support.pages import as_written
from tests.support.review_page import Page
from tests.support.rows import read_rows, write_rows

ENTER, RIGHT = "\ue007", "\ue014"
GT = SAMPLE.with_name("pan.gt.csv")
PLACED = "frame,method,object,range_m,bearing_deg,landmark,score,declared"
HEADER = "frame,timestamp_ns,method,object,x_px,y_px,landmark,score,declared,p_1,p_2,p_3,p_4,p_none"


def data_of(page: Path) -> dict[str, Any]:
    """What the page's script reads."""
    text = re.search(r'<script type="application/json" id="data">(.*)</script>', page.read_text())
    assert text is not None
    found: dict[str, Any] = json.loads(text[1])
    return found


def places(rows: Iterable[dict[str, str]]) -> dict[int, dict[int, tuple[float, float]]]:
    """The pixels of a truth's rows, by ID and frame."""
    found: dict[int, dict[int, tuple[float, float]]] = {}
    for row in rows:
        place = float(row["x_px"]), float(row["y_px"])
        found.setdefault(int(row["landmark"]), {})[int(row["frame"])] = place
    return found


TRUTH = places(read_rows(GT))
ONE, THREE = TRUTH[1], TRUTH[3]


@pytest.fixture(scope="module")
def ran(pan: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log called dive, without truth, and its results."""
    folder = tmp_path_factory.mktemp("ran")
    shutil.copytree(SAMPLE, folder / "dive", ignore=shutil.ignore_patterns("gt.csv"))
    ours = shutil.ignore_patterns("evaluation", "*.html")  # what other tests make of them
    shutil.copytree(pan, folder / "out" / "dive", ignore=ours)
    return folder


Track = tuple[int, dict[int, tuple[float, float]], float]
"""The ID it declares, the pixel in each frame, and its belief."""


def with_tracks(ran: Path, folder: Path, tracks: Sequence[Track]) -> Path:
    """The log with results that hold these tracks alone, in a new folder."""
    shutil.copytree(ran, folder)
    lines = [HEADER]
    for number, (landmark, places, belief) in enumerate(tracks, 1):
        beliefs = [belief if k == landmark else 0 for k in range(1, 5)] + [1 - belief]
        lines += [
            ",".join(map(str, (frame, 0, "framework", number, x, y, landmark, belief, 1, *beliefs)))
            for frame, (x, y) in places.items()
        ]
    results = folder / "out" / "dive"
    lines[1:] = sorted(lines[1:], key=lambda line: int(line.partition(",")[0]))
    (results / "estimates.csv").write_text("\n".join(lines) + "\n")
    as_written(results)
    return folder


def swapped() -> list[Track]:
    """Tracks of one that took another disc for its own at frame 40, lay 10 px off in frame 100, and
    called a stone ID.2; ID.1 is missing in frames 40 to 52."""
    first = {n: ONE[n] for n in range(40)} | {n: THREE[n] for n in range(40, 112)}
    second = {n: ONE[n] for n in range(77, 128)}
    second[100] = (second[100][0] - 10, second[100][1])
    stone = dict.fromkeys(range(60, 80), (95.0, 60.0))
    return [
        (1, first, 0.97),
        (3, {n: THREE[n] for n in range(17, 40)}, 0.98),
        (1, second, 0.99),
        (2, stone, 0.91),
    ]


@pytest.fixture
def folder(ran: Path, tmp_path: Path) -> Path:
    """The log with those tracks."""
    return with_tracks(ran, tmp_path / "w", swapped())


def review(folder: Path, *more: str | Path, code: int = 0, log: str = "dive") -> Path:
    """The page of a log."""
    page = folder / "review.html"
    results = ("--results", folder / "out", "-o", page)
    sonarrec("truth", "review", folder / log, *results, *more, code=code)
    return page


# What is in the page


def test_passes_the_uncertain_ones_first(folder: Path) -> None:
    page = review(folder)
    found = data_of(page)
    assert page.stat().st_size < 25e6
    assert [
        (p["landmark"], p["rows"][0]["frame"], p["rows"][-1]["frame"], p["belief"], p["state"])
        for p in found["passes"]
    ] == [
        (2, 60, 79, 0.91, "open"),
        (1, 0, 111, 0.97, "open"),
        (3, 17, 39, 0.98, "open"),
        (1, 77, 127, 0.99, "open"),
    ]
    assert sorted(map(int, found["images"])) == list(range(128))


def test_what_propose_leaves_out_comes_with_its_reason(ran: Path, tmp_path: Path) -> None:
    spans = ((range(40), 0.99), (range(80, 83), 0.95), (range(90, 120), 0.8))
    tracks = [(1, {n: ONE[n] for n in frames}, belief) for frames, belief in spans]
    found = data_of(review(with_tracks(ran, tmp_path / "w", tracks)))["passes"]
    by_frame = {p["rows"][0]["frame"]: p for p in found}
    assert [by_frame[n]["left_out"] for n in (0, 80, 90)] == [False, True, True]
    none, frames, score = (by_frame[n]["why"] for n in (0, 80, 90))
    assert none == ""
    assert "3 frames" in frames
    assert "0.9" in score


def test_a_truth_and_what_it_lacks(folder: Path) -> None:
    """A track on the truth is the truth's pass; the rest is what the truth does not have."""
    shutil.copy(GT, folder / "dive" / "gt.csv")  # found, as evaluate finds it
    found = data_of(review(folder))
    header = "frame,landmark,x_px,y_px,visible,orientation_deg,track,source"
    assert found["header"] == header.split(",")
    listed = [(p["landmark"], p["rows"][0]["frame"], p["state"], p["why"]) for p in found["passes"]]
    assert listed[:2] == [(2, 60, "open", "not in the truth"), (1, 40, "open", "not in the truth")]
    assert {(k, n, state) for k, n, state, _ in listed[2:]} == {
        *((1, 0, "accepted"), (1, 77, "accepted"), (3, 17, "accepted"))
    }
    proposal = folder / "proposed.csv"
    sonarrec("truth", "propose", folder / "out" / "dive", "-o", proposal)
    again = data_of(review(folder, "--truth", proposal))["passes"]
    assert {(p["origin"], p["state"]) for p in again} == {("truth", "open")}


def test_mistakes_come_first(folder: Path) -> None:
    shutil.copy(GT, folder / "dive" / "gt.csv")
    results = folder / "out" / "dive"
    where = ("--results", folder / "out", "-o", folder / "review.html", "--mistakes")
    lacking = sonarrec("truth", "review", folder / "dive", *where, code=2)
    command = re.search(r"`(sonarrec evaluate .*)`", lacking.stderr)
    assert command is not None
    assert str(results) in command[1]
    (results / "evaluation").mkdir(exist_ok=True)
    (results / "evaluation" / "mistakes.csv").write_text(
        "log,method,kind,landmark,other,first_frame,last_frame,frames,score,at_start\n"
        "dive,framework,missed,3,1,90,111,22,0.1,0\n"
        "dive,smi,false,1,,0,10,11,0.9,0\n"
        "dive,framework,missed,1,,0,3,4,nan,1\n"
        "dive,framework,false,2,,60,79,20,0.91,0\n"
    )
    found = data_of(review(folder, "--mistakes"))["passes"]
    first = [(p["landmark"], p["rows"][0]["frame"], p["wrong"]) for p in found[:4]]
    assert first == [(3, 17, 22), (1, 40, 22), (1, 77, 22), (2, 60, 20)]
    assert {p["state"] for p in found if p["wrong"]} == {"open"}
    assert any("missed ID.3 in frames 90-111" in p["why"] for p in found if p["landmark"] == 3)


def test_frames_that_are_chosen_and_those_that_fit_in(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = {"--every=5": [*range(0, 128, 5)], "--frames=10:13,40": [10, 11, 12, 40]}
    for option, frames in shown.items():
        page = review(folder, option)
        assert sorted(map(int, data_of(page)["images"])) == frames
        assert "log's 128 frames" in page.read_text()
        rows = sum(len(one["rows"]) for one in data_of(page)["passes"])
        assert rows == sum(len(places) for _, places, _ in swapped())
    monkeypatch.setattr("sonarrec.reports.review.MOST_BYTES", 300_000)
    few = data_of(review(folder))["images"]
    assert 20 < len(few) < 128
    assert sum(map(len, few.values())) <= 300_000
    steps = np.diff(sorted(map(int, few)))
    assert len(set(steps)) == 1
    review(folder, "--frames", "200:210", code=2)
    review(folder, "--frames", "x", code=2)


def test_the_picture_of_a_pass_has_its_first_sector_at_the_right(ran: Path, tmp_path: Path) -> None:
    """Counter-clockwise from there, as a landmark file has them; of the sample's ID.1 and ID.3."""
    folder = Path(shutil.copytree(ran, tmp_path / "w"))
    shown = [p for p in data_of(review(folder))["passes"] if p["picture"]]
    assert {p["landmark"] for p in shown} == {1, 3}
    for seen in shown:
        data = np.frombuffer(base64.b64decode(seen["picture"].partition(",")[2]), np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        y, x = np.mgrid[1:-1:64j, -1:1:64j] * 1.3  # radii of the disc
        symbol = np.hypot(x, y) < 0.55
        quarter = (np.arctan2(y, x) // (np.pi / 2)).astype(int) % 4
        mean = [picture[symbol & (quarter == n)].mean() for n in range(4)]
        bright = [n for n in range(4) if SECTORS[seen["landmark"]][n]]
        assert set(np.argsort(mean)[-len(bright) :]) == set(bright)


def test_results_of_another_log_and_none(folder: Path, tmp_path: Path) -> None:
    (folder / "dive" / "000127.png").unlink()
    assert not review(folder, code=1).exists()
    told = sonarrec("truth", "review", folder / "dive", "--results", tmp_path / "no", code=2).stderr
    assert f"sonarrec run {folder / 'dive'}" in told


def test_a_folder_of_logs_has_a_page_each(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    for name in ("a", "b", "c"):
        shutil.copy(SAMPLE.with_name("pan.mcap"), logs / f"{name}.mcap")
    shutil.copy(SAMPLE.with_name("pan.sonar.toml"), logs / "sonar.toml")
    few = ("--frames", "30:42", "--out", tmp_path / "out", "-q")
    sonarrec("run", logs / "a.mcap", logs / "b.mcap", *few)
    where = ("--results", tmp_path / "out", "-o", tmp_path / "pages")
    done = sonarrec("truth", "review", logs, *where, code=3)  # c has no results
    assert len(done.stdout.splitlines()) == 3  # and the start page
    assert str(logs / "c.mcap") in done.stderr
    for name in ("a", "b"):
        page = tmp_path / "pages" / f"{name}.html"
        assert f"<h1>{name}</h1>" in page.read_text()
        found = data_of(page)
        assert (found["first"], found["frames"], len(found["images"])) == (30, 12, 12)


def test_nothing_but_an_older_page_is_replaced(folder: Path) -> None:
    page = review(folder)
    review(folder)
    page.write_text("mine")
    review(folder, code=2)
    assert page.read_text() == "mine"


# In a browser


@pytest.mark.slow
def test_a_person_corrects_a_proposal(
    browser: Any, ran: Path, folder: Path, tmp_path: Path
) -> None:
    """Each kind of decision once; the file holds them, and scores as truth made by hand."""
    page = Page(browser, review(folder), tmp_path)
    assert page.faults["console"] == []
    page.press(" ", "r")  # the stone, which is first; that ends the play
    assert not browser.execute_script("return timer")
    assert page.text("pass").startswith("ID.1, frames 0 to 111, open")
    page.go(40)
    page.press("f", "3")  # from here on it is ID.3
    page.choose(1, 0)
    page.press("a")
    page.choose(3, 17)
    page.press("a")
    page.press("a")  # of what is open then, the last
    page.choose(1, 77)
    page.go(100)
    scale = page.pointer(ONE[100][0] - 10, ONE[100][1], drag=(10, 0))
    page.choose(1, 0)
    page.press("n", "1")
    page.go(40)
    page.pointer(*ONE[40])
    page.go(52)
    page.pointer(*ONE[52])
    page.press(*[ENTER, "r", "u"])  # reject what was drawn, and not
    expected = [[2, 60, 79, "rejected"], [1, 0, 39, "accepted"], [3, 40, 111, "accepted"]]
    expected += [[3, 17, 39, "accepted"], [1, 77, 127, "accepted"], [1, 40, 52, "accepted"]]
    assert page.passes == expected
    browser.refresh()
    assert page.passes == expected
    everything = read_rows(page.save())
    rows = [row for row in everything if row["landmark"] != "none"]
    stone = [row for row in everything if row["landmark"] == "none"]
    assert [int(row["frame"]) for row in stone] == [*range(60, 80)]
    assert {(row["x_px"], row["source"]) for row in stone} == {("95.00", "")}
    assert "No pass is open" in page.text("say")
    assert "same spot" not in page.text("left")
    made = places(rows)
    assert sum(map(len, made.values())) == len(rows)
    assert {k: {*of} for k, of in made.items()} == {k: {*of} for k, of in TRUTH.items()}
    assert {row["source"] for row in rows} == {""}
    for landmark, of_landmark in made.items():
        for frame, place in of_landmark.items():
            off = np.abs(np.subtract(place, TRUTH[landmark][frame])).max()
            drawn = landmark == 1 and 40 <= frame <= 52
            near = 2 / scale if drawn or frame == 100 else 0.006
            assert off < near + 1.5 * drawn, (frame, landmark, off)
    fan = read_log(folder / "out" / "dive").fan
    assert fan is not None
    pixels = np.array([(float(row["x_px"]), float(row["y_px"])) for row in rows])
    by_program = share_in_image(fan, *polar_from_pixel(fan, *pixels.T), 0.15)
    visible = np.array([float(row["visible"]) for row in rows])
    assert np.abs(visible - by_program).max() < 0.03
    saved = page.downloads / "dive.gt.csv"
    sonarrec("truth", "check", saved, folder / "dive")
    score = ("evaluate", ran / "out" / "dive", "--ground-truth")
    by_hand, right = (sonarrec(*score, truth).stdout for truth in (saved, GT))
    assert by_hand.replace(str(saved), str(GT)) == right
    # Another ID on a landmark that is accepted: the page says so until that is taken back.
    page.press("n", "4")
    page.go(20)
    page.pointer(*ONE[20])
    page.press(ENTER)
    page.save()
    for part in ("left", "say"):
        assert "spot as ID.1 in frame 20" in page.text(part)
    page.press("u")
    assert "same spot" not in page.text("left")


GEOMETRY = """
const [fan, points, radius] = arguments;
return points.map(([x, y]) => {
  const floor = floorFromPixel(fan, x, y);
  return [...floor, ...pixelFromFloor(fan, ...floor), visibleShare(fan, x, y, radius)]
    .map((v) => Number.isNaN(v) ? null : v);
});"""


@pytest.mark.slow
@pytest.mark.parametrize("shape", [{}, {"height_m": None}, {"field_of_view_deg": 130.0}])
def test_the_geometry_of_the_script_is_the_program_s(
    browser: Any, folder: Path, tmp_path: Path, shape: dict[str, Any]
) -> None:
    fan = make_fan(rows=120, **shape)
    page = Page(browser, review(folder), tmp_path)
    x, y = (
        v.ravel()
        for v in np.meshgrid(np.linspace(-9, fan.columns + 9, 14), np.linspace(-9, 310, 23))
    )
    of = asdict(fan) | {"depth_m": floor_depth(fan)}
    found = page.browser.execute_script(GEOMETRY, of, np.column_stack([x, y]).tolist(), 0.15)
    right, ahead, column, row, visible = np.array(found, dtype=float).T
    range_m, bearing_deg = polar_from_pixel(fan, x, y)
    ground = ground_range(fan, range_m)
    expected = plane_from_polar(ground, bearing_deg)
    assert 5 < np.isnan(ground).sum() < len(x) / 2
    np.testing.assert_allclose(np.column_stack([right, ahead]), expected, atol=1e-9)
    slant = slant_range(fan, np.hypot(right, ahead))
    back = pixel_from_polar(fan, slant, np.degrees(np.arctan2(right, ahead)))
    np.testing.assert_allclose([column, row], back, atol=1e-9)
    shares = share_in_image(fan, range_m, bearing_deg, 0.15)
    assert {0.0, 1.0} < {*shares}
    np.testing.assert_allclose(visible, shares, atol=0.004)  # a point or two on the very edge


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1024, 1280, 1366])
def test_the_page_fits_and_is_legible(
    browser: Any, folder: Path, tmp_path: Path, width: int
) -> None:
    opened = Page(browser, review(folder), tmp_path, width)
    faults = opened.faults
    opened.press("a")
    top, bottom, height, frame = browser.execute_script(
        "const [say, frame] = ['say', 'marks'].map(id => document.getElementById(id));"
        "const box = say.getBoundingClientRect(), of = frame.getBoundingClientRect();"
        "return [box.top, box.bottom, innerHeight, of.width * of.height / innerWidth / innerHeight]"
    )
    assert 0 < top < bottom <= height  # a message is in view, and the frame has most of the window
    assert frame > 0.4
    assert faults["console"] == []
    assert (faults["broken"], faults["wide"], faults["outside"]) == (0, 0, [])
    page, text, _ = browser.execute_script(COLOURS)
    assert min(contrast(colour, page) for colour in text) >= 4.5
    acts, keys = browser.execute_script("return [Object.keys(acts), Object.keys(keys)]")
    by_key = browser.execute_script("return Object.values(keys)")
    assert {*acts} <= {*by_key, "reopen", "take", "leave", "log", "again"}
    listed = browser.execute_script(
        "return [...document.querySelectorAll('dl kbd')].map(k => k.textContent)"
    )
    names = {"ArrowUp": "↑", "ArrowDown": "↓", "ArrowLeft": "←", "ArrowRight": "→", " ": "Space"}
    named = {names.get(key, key) for key in keys} - {"Delete"}
    assert {key.lower() for key in named} <= {key.lower() for key in listed}


@pytest.mark.slow
def test_frames_that_are_not_in_the_page_follow(browser: Any, ran: Path, tmp_path: Path) -> None:
    folder = with_tracks(ran, tmp_path / "w", [(1, {n: ONE[n] for n in range(40)}, 0.99)])
    page = Page(browser, review(folder, "--every", "5"), tmp_path)
    before = {int(r["frame"]): float(r["y_px"]) for r in read_rows(page.save())}
    page.press(RIGHT, RIGHT)
    assert page.text("title") == "Frame 10"
    scale = page.pointer(*ONE[10], drag=(0, 12))
    rows = {int(r["frame"]): r for r in read_rows(page.save())}
    moved = {n: float(row["y_px"]) - before[n] for n, row in rows.items()}
    for n, by in moved.items():
        assert by == pytest.approx(12 * max(0, 1 - abs(n - 10) / 5), abs=1 / scale), n
    assert {n for n, row in rows.items() if not row["source"]} == set(range(6, 15))
    page.press("x")
    assert set(before) - {int(r["frame"]) for r in read_rows(page.save())} == {8, 9, 10, 11, 12}
    page.press("u", "u")
    assert {int(r["frame"]): float(r["y_px"]) for r in read_rows(page.save())} == before
    page.press("y", "y")
    assert len(read_rows(page.save())) == len(before) - 5


@pytest.mark.slow
def test_no_passes_and_damaged_frames(browser: Any, ran: Path, tmp_path: Path) -> None:
    """The page opens; a landmark is placed; a frame that cannot be read is grey and gets no row."""
    folder = tmp_path / "w"
    log = shutil.copytree(ran / "dive", folder / "dive")
    (log / "000005.png").write_bytes((log / "000005.png").read_bytes()[:200])
    sonarrec("run", log, "--out", folder / "out", "-q", code=3)
    estimates = folder / "out" / "dive" / "estimates.csv"
    estimates.write_text(HEADER + "\n")
    as_written(estimates.parent)
    page = Page(browser, review(folder, code=3), tmp_path)
    assert page.faults["console"] == []
    assert page.passes == []
    assert "open; 126 frames" in page.text("left")
    page.press("a", "r", "x", " ", " ", "u", "y")  # nothing to decide, nothing happens
    page.go(5)
    assert "cannot be read" in browser.find_element("id", "grey").text
    page.go(0)
    page.press("n", "4")
    page.pointer(*ONE[0])
    page.go(12)
    page.pointer(*ONE[12])
    page.press("2", ENTER)
    rows = read_rows(page.save())
    assert [int(row["frame"]) for row in rows] == [n for n in range(13) if n != 5]
    assert {(row["landmark"], row["source"]) for row in rows} == {("2", "")}
    for frame, place in places(rows)[2].items():  # a disc of some 30 px that turned by 7 degrees
        assert np.hypot(*np.subtract(place, ONE[frame])) < 2.5


@pytest.mark.slow
def test_two_ids_on_one_spot(browser: Any, ran: Path, tmp_path: Path) -> None:
    """Told; a line for each; the rejected one shows nothing, and is not proposed again."""
    spot, other = ({n: of[n] for n in range(17, 40)} for of in (ONE, THREE))
    folder = with_tracks(ran, tmp_path / "w", [(1, spot, 0.99), (2, spot, 0.95), (1, other, 0.97)])
    page = Page(browser, review(folder), tmp_path)
    assert sorted(p[0] for p in page.passes) == [1, 1, 2]
    lanes = browser.execute_script("return passes.map(p => lanesOf()[0].get(p.id))")
    assert len(set(lanes)) == 3
    assert "same spot" in page.text("left")
    page.choose(2, 17)
    page.press("r", "a", "a")
    assert "same spot" not in page.text("left")
    saved = page.save()
    rows = [(row["landmark"], float(row["visible"]) > 0) for row in read_rows(saved)]
    assert set(rows) == {("1", True), ("none", False)}
    again = data_of(review(folder, "--truth", saved))["passes"]
    assert sorted((p["landmark"] or 0, p["state"]) for p in again) == [
        *((0, "rejected"), (1, "accepted"), (1, "accepted"))
    ]


@pytest.mark.slow
def test_work_is_kept_and_offered(browser: Any, ran: Path, tmp_path: Path) -> None:
    folder = with_tracks(ran, tmp_path / "w", swapped()[:3])
    page = Page(browser, review(folder), tmp_path)
    page.press("a", "r")
    states = ["accepted", "rejected", "open"]
    assert [state for *_, state in page.passes] == states
    kept = browser.execute_script("return localStorage.getItem(key)")
    assert len(kept) < 1000  # decisions, no rows
    others = with_tracks(ran, tmp_path / "again", [(1, {}, 0.0), *swapped()[1:]])
    again = Page(browser, review(others), tmp_path, again=True)
    assert "2 decisions" in browser.find_element("id", "offer").text
    assert "1 decision" in again.text("say")
    assert "rejected" in {state for *_, state in again.passes}
    browser.find_element("css selector", "[data-act=leave]").click()
    assert not browser.find_element("id", "offer").is_displayed()
    assert {state for *_, state in again.passes} == {"open"}


@pytest.mark.slow
def test_where_the_browser_keeps_nothing(browser: Any, folder: Path, tmp_path: Path) -> None:
    refuse = "Storage.prototype.setItem = () => { throw new DOMException('', 'SecurityError'); }"
    added = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": refuse})
    try:
        page = Page(browser, review(folder), tmp_path)
        assert "keeps nothing" in browser.find_element("id", "refused").text
        leaving = (
            "const e = new Event('beforeunload', {cancelable: true});"
            "dispatchEvent(e); return e.defaultPrevented"
        )
        assert not browser.execute_script(leaving)
        page.press("a")
        assert browser.execute_script(leaving)
        page.save()
        assert not browser.execute_script(leaving)
    finally:
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)


@pytest.mark.slow
def test_names_are_no_html(browser: Any, folder: Path, tmp_path: Path) -> None:
    evil = "</script><img src=x onerror=hit=1>&lt;'\"\\"
    log = tmp_path / evil.replace("/", "")
    (folder / "dive").rename(folder / log.name)
    (folder / "out" / "dive").rename(folder / "out" / log.name)
    truth = tmp_path / f"{evil.replace('/', '')}.csv"
    told = evil.replace('"', "")
    rows = [f"{n},1,{x},{y},{told},{told}" for n, (x, y) in ONE.items()]
    truth.write_text("\n".join(["frame,landmark,x_px,y_px,source,note", *rows, ""]))
    page = Page(browser, review(folder, "--truth", truth, log=log.name), tmp_path)
    assert page.faults["console"] == []
    assert browser.execute_script("return typeof hit") == "undefined"
    assert browser.find_element("css selector", "h1").text == log.name
    assert {row["note"] for row in read_rows(page.save()) if row["note"]} == {told}


@pytest.mark.slow
def test_plates_show_their_corners_and_are_not_dragged(
    browser: Any, ran: Path, tmp_path: Path
) -> None:
    log, out = ran / "dive", tmp_path / "w" / "out"
    sonarrec("run", log, "--landmarks", "actag24h10", "--frames", "0:20", "--out", out, "-q")
    shutil.copytree(log, tmp_path / "w" / "dive")
    folder = out / "dive"
    ids = list(read_log(folder).landmarks.ids)
    header = f"{PLACED},r1,b1,r2,b2,r3,b3,r4,b4"
    corners = "2.6,-3,2.6,3,2.4,3,2.4,-3"
    rows = [f"{n},framework,1,2.5,0,{ids[1]},0.95,1,{corners}" for n in range(20)]
    (folder / "estimates.csv").write_text("\n".join([header, *rows, ""]))
    as_written(folder)
    page = Page(browser, review(tmp_path / "w"), tmp_path)
    fan = read_log(folder).fan
    assert fan is not None
    drawn = browser.find_element("css selector", "#marks polygon").get_attribute("points")
    points = np.array(drawn.replace(",", " ").split(), dtype=float).reshape(-1, 2)
    range_m, bearing_deg = np.array(corners.split(","), dtype=float).reshape(4, 2).T
    expected = np.column_stack(pixel_from_polar(fan, range_m, bearing_deg))
    np.testing.assert_allclose(points, expected, atol=0.06)
    page.pointer(*expected.mean(axis=0), drag=(10, 0))
    assert "not dragged" in page.text("say")
    page.press(*str(ids[2]))
    time.sleep(1)
    before = read_rows(page.save())
    assert {(row["landmark"], row["source"]) for row in before} == {(str(ids[2]), "")}
    assert {row["x_px"] for row in before} == {f"{fan.apex_column:.2f}"}


@pytest.mark.slow
def test_a_truth_goes_out_as_it_came(browser: Any, ran: Path, tmp_path: Path) -> None:
    """By time and in metres, with other logs, columns and objects; frames and pixels are saved."""
    folder = with_tracks(ran, tmp_path / "w", swapped()[:1])
    rows = ["log,frame,landmark,x_px,y_px,visible,orientation_deg,by"]
    columns = ("frame", "landmark", "x_px", "y_px", "visible", "orientation_deg")
    rows += [",".join(["dive", *(row[c] for c in columns), '"A, B"']) for row in read_rows(GT)]
    rows += ["other,3,1,10,20,1,,C", "dive,7,none,50,60,,,D"]
    truth = tmp_path / "truth.csv"
    truth.write_text("\n".join(rows) + "\n")
    page = Page(browser, review(folder, "--truth", truth), tmp_path)
    came, saved = read_rows(truth), read_rows(page.save())
    assert all(row.pop("source") == "" for row in saved)
    for row in saved:
        row.pop("track", None)
    assert sorted(map(repr, saved)) == sorted(map(repr, came))
    listed = read_rows(folder / "out" / "dive" / "frames.csv")
    times = {row["frame"]: row["timestamp_ns"] for row in listed}
    columns = ("landmark", "range_m", "bearing_deg")
    by_time = [
        {"timestamp_ns": times[row["frame"]]} | {c: row[c] for c in columns}
        for row in read_rows(GT)
    ]
    write_rows(truth, by_time)
    page = Page(browser, review(folder, "--truth", truth), tmp_path)
    saved = read_rows(page.save())
    assert list(saved[0]) == ["frame", "landmark", "x_px", "y_px", "visible", "track", "source"]
    for landmark, of_landmark in places(saved).items():
        for frame, place in of_landmark.items():
            assert np.abs(np.subtract(place, TRUTH[landmark][frame])).max() < 0.02
    assert len(saved) == len(by_time)


@pytest.mark.slow
def test_by_touch(browser: Any, ran: Path, tmp_path: Path) -> None:
    """One finger drags an outline, two zoom."""
    folder = with_tracks(ran, tmp_path / "w", [(1, {n: ONE[n] for n in range(40)}, 0.99)])
    page = Page(browser, review(folder), tmp_path, 420)
    left, top = browser.execute_script(
        "const b = document.getElementById('marks').getBoundingClientRect();return [b.left, b.top]"
    )
    across, down, _, _, scale = page.screen()
    x, y = left + across + ONE[0][0] * scale, top + down + ONE[0][1] * scale

    def touch(kind: str, *points: tuple[float, float]) -> None:
        at = [{"x": a, "y": b, "id": n} for n, (a, b) in enumerate(points)]
        browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

    touch("touchStart", (x, y))
    touch("touchMove", (x - 20, y))
    touch("touchMove", (x - 40, y))
    touch("touchEnd")
    first = read_rows(page.save())[0]
    place = float(first["x_px"]) + 40 / scale, float(first["y_px"])
    assert place == pytest.approx(ONE[0], abs=0.1)
    touch("touchStart", (left + 50, top + 20))
    touch("touchStart", (left + 50, top + 20), (left + 90, top + 20))
    touch("touchMove", (left + 50, top + 20), (left + 130, top + 20))
    touch("touchEnd")
    assert browser.execute_script("return view.zoom") == pytest.approx(2, abs=0.05)
