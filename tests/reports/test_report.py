"""The report's page: its numbers against the evaluation's, its words, what it holds."""

from __future__ import annotations

import base64
import hashlib
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from sonarrec.cli import main
from sonarrec.evaluation.rows import PROTOCOLS
from sonarrec.reports import screen
from tests.support.claims import evaluate
from tests.support.command import SAMPLE, sonarrec
from tests.support.pages import DECLARED, PLACED, Page, as_written, tables, without_log
from tests.support.rows import read_rows, write_rows

PASSES = "Declared by framework, a row per pass, in order of first sight"


def test_tables_are_the_evaluations(pages: dict[str, Path], pan: Path) -> None:
    sonarrec("evaluate", pan, "--ground-truth", SAMPLE / "gt.csv", "-q")
    confusion = read_rows(pan / "evaluation" / "confusion.csv")
    page = Page(pages["full"])
    for method in ("smi", "framework"):
        for protocol in PROTOCOLS:
            rows = {r[0]: r[1:] for r in page.tables[f"{method}, protocol {protocol}"]}
            expected = [r for r in confusion if (r["method"], r["protocol"]) == (method, protocol)]
            for label, column in screen.COUNT_ROWS.items():
                assert rows[label] == [r[column] for r in expected]
            for label in ("TPR", "FPR"):
                for cell, r in zip(rows[label], expected, strict=True):
                    if r[label.lower()]:
                        assert float(cell) == pytest.approx(float(r[label.lower()]), abs=5.1e-5)
                    else:
                        assert cell == "0.0000*"


def test_figures_are_the_summarys(pages: dict[str, Path], pan: Path) -> None:
    found, page = evaluate(pan, SAMPLE / "gt.csv").summary, Page(pages["full"])
    assert all(note in page.text for note in found.notes)
    for method in ("smi", "framework"):
        for name, digits in (("auc", 3), ("ece", 3), ("position_error_95_m", 4)):
            figure = found.figure("strict", method, name)
            assert figure is not None
            told = f"{figure.value:.{digits}f}"
            if not np.isnan(figure.low):
                told += f"{figure.low:.{digits}f}to{figure.high:.{digits}f}"
            assert told in re.sub(r"\s+", "", page.text)


def test_false_claims_are_told_per_100_frames(pages: dict[str, Path], pan: Path) -> None:
    """Of each method, protocol strict first; so many are the frames of its results."""
    frames = len(read_rows(pan / "frames.csv"))
    counts = evaluate(pan, SAMPLE / "gt.csv").counts
    rows = next(
        rows for caption, rows in Page(pages["full"]).tables.items() if "per 100" in caption
    )
    cells = {row[0]: row[1:] for row in rows}
    for method in ("smi", "framework"):
        false = [counts.count(method, protocol).fp for protocol in ("strict", "paper")]
        assert [cells[method][n] for n in (4, 9)] == [f"{100 * fp / frames:.2f}" for fp in false]


def test_nothing_is_fetched_and_one_script_runs(pages: dict[str, Path]) -> None:
    """That one is the page's own, by the hash that its policy asks for; without frames none."""
    for name, path in pages.items():
        page, text = Page(path), path.read_text(encoding="utf-8")
        kinds = [kind for kind, _ in page.elements]
        assert not {*kinds} & {"link", "iframe", "object", "embed", "base"}
        running = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
        assert len(running) == (name == "full")
        assert kinds.count("script") == 2 * len(running)
        policy = next(str(a["content"]) for _, a in page.elements if "http-equiv" in a)
        digests = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in running]
        assert re.findall(r"'sha256-(.*?)'", policy) == digests
        for key, value in (pair for _, a in page.elements for pair in a.items()):
            assert not key.startswith("on")
            if key in ("src", "href", "srcset", "data", "poster"):
                assert str(value).startswith(("#", "data:image/"))
        text = text.replace('"http://www.w3.org/2000/svg"', "")  # a name, not an address
        assert not re.search(r"https?://|url\(|@import", text)
        there = [a["id"] for _, a in page.elements if "id" in a]
        assert len(there) == len(set(there))
        links = {str(a["href"])[1:] for _, a in page.elements if "href" in a}
        assert len(links) >= 4
        assert links <= set(there)
        for kind, a in page.elements:
            if kind == "img":
                assert re.match(r"Sonar image, frame \d+: ", str(a["alt"]))
                assert int(str(a["width"])) > 100
            assert kind != "svg" or a.get("aria-label") or a.get("aria-hidden")
        assert (kinds.count("img") > 6) == (name == "full")


def test_the_page_says_what_was_assumed_and_what_the_methods_are(pan: Path, tmp_path: Path) -> None:
    shutil.copytree(pan, tmp_path / "pan")
    run = tmp_path / "pan" / "run.toml"
    for height, tilt, expected in (
        (True, True, ("20 deg", "0.68 m")),
        (True, False, ("15.78 deg assumed", "0.68 m")),
        (False, True, ("20 deg", "0.855 m assumed")),
    ):
        text = (pan / "run.toml").read_text()
        text = re.sub("^(path|place) = .*\n", "", text, flags=re.MULTILINE)  # so without pictures
        for key, stated in (("height_m", height), ("tilt_deg", tilt)):
            text = text if stated else re.sub(rf"^{key} = .*\n", "", text, flags=re.MULTILINE)
        run.write_text(text)
        sonarrec("report", tmp_path / "pan", "-o", tmp_path / "out.html")
        page = (tmp_path / "out.html").read_text()
        assert f"<dt>tilt</dt><dd>{expected[0]}</dd>" in page
        assert f"<dt>height</dt><dd>{expected[1]}</dd>" in page
    assert "the recogniser" in page
    # 128 frames at 4 Hz; the same as info has.
    assert "<dt>length</dt><dd>31.8 s at" in page


def test_without_truth_and_log_the_page_says_so(pages: dict[str, Path]) -> None:
    page = Page(pages["bare"])
    assert "--log" in page.text
    assert "TPR" not in page.text
    assert not [name for name, _ in page.elements if name == "img"]
    seen = page.tables[PASSES]
    assert {row[0] for row in seen[1:]} == {"ID.1", "ID.3"}


def test_names_are_text_not_html(tmp_path: Path) -> None:
    folder = tmp_path / "<img src=x onerror=alert(1)>"
    tables(folder, range(2), DECLARED, ["0,<script>bad()</script>,1,1,0.9,1"])
    sonarrec("report", folder, "-o", tmp_path / "out.html")
    page = Page(tmp_path / "out.html")
    assert not [n for n, a in page.elements if n in ("script", "img") or "onerror" in a]
    assert "<script>bad()</script>" in page.text


def test_results_of_another_program(tmp_path: Path) -> None:
    """Frames without times, no objects, no probabilities, no run.toml, truth without places."""
    rows = ("2,mine,1,0.9,1", "3,mine,1,0.8,1", "7,mine,3,0.7,1")
    tables(tmp_path, range(10), "frame,method,landmark,score,declared", rows)
    (tmp_path / "gt.csv").write_text("frame,landmark\n3,1\n4,1\n")
    truth = ("--ground-truth", tmp_path / "gt.csv", "--min-visible", "0.995")
    sonarrec("report", tmp_path, *truth)
    page = Page(tmp_path / "report.html")
    for fact in ("least 99.5%", "ID.1 declared (0.90)", "ID.1 in view", "run.toml"):
        assert fact in page.text


ROW = "{},{},1,2.0,0.0,.9,.05,.05,0,0,1,.9,1"
ODD_RESULTS: dict[str, tuple[list[tuple[int, int]], list[str]]] = {
    "no estimate": ([(0, 5), (1, 9)], []),
    "one frame": ([(7, 5)], [ROW.format(7, "framework")]),
    "single-frame method only": ([(0, 5), (1, 9)], [ROW.format(1, "smi")]),
    "times that fall": ([(0, 9), (1, 5)], [ROW.format(1, "framework")]),
    "a gap": ([(n, n) for n in (0, 1, 50)], [ROW.format(n, "framework") for n in (0, 50)]),
}


@pytest.mark.parametrize("name", ODD_RESULTS)
@pytest.mark.parametrize("truth", [None, "7,1,2.0,0.0\n0,2,2.0,0.0\n"])
def test_odd_results(tmp_path: Path, name: str, truth: str | None) -> None:
    frames, estimates = ODD_RESULTS[name]
    tables(tmp_path, frames, PLACED, estimates)
    options: tuple[str | Path, ...] = ()
    if truth is not None:
        (tmp_path / "gt.csv").write_text(f"frame,landmark,range_m,bearing_deg\n{truth}")
        options = ("--ground-truth", tmp_path / "gt.csv")
    result = CliRunner().invoke(main, ["report", str(tmp_path), *map(str, options)])
    if result.exit_code == 1:  # told in one line, as by evaluate
        assert isinstance(result.exception, SystemExit)
        assert result.stderr.startswith("sonarrec: ")
        assert (truth is not None and name == "no estimate") or name == "one frame"
        return
    assert isinstance(result.exception, SystemExit | None), result.exception
    for _, attributes in Page(tmp_path / "report.html").elements:
        assert "nan" not in str(attributes.get("d")) + str(attributes.get("style"))


def test_of_logs_of_different_landmark_sets_one_is_shown(pan: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        without_log(pan, tmp_path / name)
    run = tmp_path / "b" / "run.toml"
    run.write_text(run.read_text().replace("id = 2\n", "id = 7\n"))
    estimates = tmp_path / "b" / "estimates.csv"
    estimates.write_text(estimates.read_text().splitlines()[0] + "\n")
    told = sonarrec("report", tmp_path, code=3).stderr
    assert told.startswith(f"sonarrec: {tmp_path / 'b'}: another landmark")
    rows = Page(tmp_path / "report.html").named["All logs"]
    assert [row[:3] for row in rows[1:3]] == [["a", "done", "128"], ["b", "done", "128"]]
    assert rows[3] == ["another landmark set"]


@pytest.mark.slow
def test_a_false_claim_is_called_one(pan: Path, tmp_path: Path) -> None:
    """Under an ID that lies nowhere: the picture says so. Of alike scores the true one is shown."""
    shutil.copytree(pan, tmp_path / "pan")
    (tmp_path / "pan" / "sightings.csv").unlink()
    rows = read_rows(pan / "estimates.csv")
    for row in rows:  # the first of all sightings is false, and as sure as any
        if row["method"] == "framework" and row["declared"] == "0" and row["frame"] == "4":
            row |= {"declared": "1", "landmark": "1", "score": "1.0"}
        if row["method"] == "framework" and row["declared"] == "0" and row["frame"] == "9":
            row |= {"declared": "1", "landmark": "2", "score": "0.8"}
    write_rows(tmp_path / "pan" / "estimates.csv", rows)
    as_written(tmp_path / "pan")
    truth = ("--ground-truth", SAMPLE / "gt.csv")
    sonarrec("report", tmp_path / "pan", *truth, "--log", SAMPLE, "-o", tmp_path / "x.html")
    text = re.sub(r"\s+", " ", Page(tmp_path / "x.html").text)
    surest = text[text.index("The surest frame of each landmark") : text.index("The rarest")]
    told = re.findall(r"Frame (\d+): ID.(\d) \((.*?)\).*?(False claim: .*?\.|(?=Frame)|$)", surest)
    assert [(i, score, false) for _, i, score, false in told] == [
        ("1", "1.00", ""),
        ("2", "0.80", "False claim: no landmark lies there."),
        ("3", "1.00", ""),
    ]
    assert "declared in 1 frame. False claim" in text


def test_a_long_log_has_the_longest_sightings_and_bars_of_many_frames(tmp_path: Path) -> None:
    """400 bars of 50 frames: a landmark declared for two frames in every 200, .04 of every fourth
    bar, and at the end for 3,000."""
    rows = [f"{n},framework,{n // 200},1,1,{+(n % 200 < 2)}" for n in range(17_000)]
    rows += [f"{n},framework,999,1,1,1" for n in range(17_000, 20_000)]
    tables(tmp_path, ((n, n * 10**8) for n in range(20_000)), DECLARED, rows)
    sonarrec("report", tmp_path)
    text = (tmp_path / "report.html").read_text()
    assert "46 more sightings" in text
    assert "<td>999</td><td>17000</td>" in text
    assert "at most 50" in text
    [drawn] = re.findall(r'"bar faint"[^>]* d="([^"]*)".*?"bar"[^>]* d="([^"]*)"', text, re.S)
    best, mean = ([int(h) for h in re.findall(r"v-(\d+)", path)] for path in drawn)
    assert (best, mean) == ([1000] * 86, [40] * 85 + [1000])
