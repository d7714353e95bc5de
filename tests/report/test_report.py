"""The report: its numbers against the evaluation's, its drawing against brute force."""

from __future__ import annotations

import base64
import csv
import hashlib
import json
import os
import re
import shutil
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest
import zstandard
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.cli import main
from sonarrec.drawing.pen import landmark_colours
from sonarrec.evaluation import cells
from sonarrec.evaluation.counting.reliability import Reliability
from sonarrec.evaluation.counting.scoring import PROTOCOLS, score
from sonarrec.evaluation.evaluate import evaluate
from sonarrec.evaluation.matching.options import ScoringOptions
from sonarrec.evaluation.summary import summarise
from sonarrec.landmarks import load_landmarks
from sonarrec.report import charts, frames, svg
from sonarrec.report.logs import (
    LogToShow,
    ReportedLog,
    Track,
    alongside,
    judged_sightings,
    read_logs,
    tracks,
)
from sonarrec.report.mistakes import episodes, in_words
from sonarrec.report.settings import settings_tables
from sonarrec.sonar import Sonar
from sonarrec.truth.table import read_truth
from tests.support.browser import contrast
from tests.support.command import SAMPLE, sonarrec

IDS = (1, 2, 3, 4)


class Page(HTMLParser):
    """Every element of a page with its attributes, and every table as rows of cells."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.tables: dict[str, list[list[str]]] = {}
        self.text = ""
        self._rows: list[list[str]] = []
        self._caption: str | None = None
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag == "table":
            self._rows = []
        elif tag == "caption":
            self._caption = ""
        elif tag == "tr":
            self._rows.append([])
        elif tag in ("td", "th"):
            self._rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        if tag == "caption" and self._caption is not None:
            self.tables[self._caption] = self._rows
            self._caption = None
        elif tag == "table":
            self._rows = []

    def handle_data(self, data: str) -> None:
        self.text += data
        if self._caption is not None:
            self._caption += data
        elif self._rows and self._rows[-1]:
            self._rows[-1][-1] += data.strip()


# The page


def test_a_log_that_failed_is_named_also_on_the_page_of_a_few(tmp_path: Path) -> None:
    """It was on no page of up to eight logs. And a single frame is not `1 frames`."""
    log = tmp_path / "out" / "one"
    log.mkdir(parents=True)
    (log / "frames.csv").write_text("frame,timestamp_ns\n0,0\n", encoding="utf-8")
    estimate = "frame,method,object,landmark,score,declared\n0,ours,1,3,0.9,1\n"
    (log / "estimates.csv").write_text(estimate, encoding="utf-8")
    (tmp_path / "out" / "logs.csv").write_text(
        "log,path,status,frames,unusable,seconds,declared,message\n"
        "one,one,done,1,0,1.0,1,\ngone,gone.mcap,failed,0,0,1.0,0,gone.mcap: <b>no MCAP</b>\n",
        encoding="utf-8",
    )
    page = tmp_path / "page.html"
    sonarrec("report", tmp_path / "out", "-o", page)
    text = page.read_text(encoding="utf-8")
    standing = text[text.index('<section id="standing"') :].partition("</section>")[0]
    assert ">gone</th>" in standing
    assert "failed: gone.mcap: &lt;b&gt;no MCAP" in standing
    assert "have panels" not in standing
    assert "ours declares ID.3 in 1 of 1 frame" in text
    assert "1 frames" not in text


def test_tables_are_the_evaluations(pages: dict[str, Path], results: Path) -> None:
    sonarrec("evaluate", results, "--ground-truth", SAMPLE / "gt.csv", "-q")
    with (results / "evaluation" / "confusion.csv").open(newline="") as file:
        confusion = list(csv.DictReader(file))
    page = Page(pages["full"])
    for method in ("smi", "framework"):
        for protocol in PROTOCOLS:
            rows = {r[0]: r[1:] for r in page.tables[f"{method}, protocol {protocol}"]}
            expected = [r for r in confusion if (r["method"], r["protocol"]) == (method, protocol)]
            for label, column in cells.COUNT_ROWS:
                assert rows[label] == [r[column] for r in expected]
            for label in ("TPR", "FPR"):
                for cell, r in zip(rows[label], expected, strict=True):
                    if r[label.lower()]:
                        assert float(cell) == pytest.approx(float(r[label.lower()]), abs=5.1e-5)
                    else:
                        assert cell == "0.0000*"


def test_figures_are_the_summarys(pages: dict[str, Path], results: Path) -> None:
    found = summarise(evaluate(results, SAMPLE / "gt.csv"))
    page = Page(pages["full"])
    text = re.sub(r"\s+", "", page.text)
    for method in ("smi", "framework"):
        for name, digits in (("auc", 3), ("brier", 3), ("ece", 3), ("position_error_95_m", 4)):
            figure = found.figure("strict", method, name)
            assert figure is not None
            told = f"{figure.value:.{digits}f}"
            if not np.isnan(figure.low):
                told += f"{figure.low:.{digits}f}to{figure.high:.{digits}f}"
            assert told in text
    for note in found.notes:
        assert note in page.text


def test_nothing_is_fetched_and_one_script_runs(pages: dict[str, Path]) -> None:
    """That one is the page's own, by the hash that its policy asks for; without frames none."""
    for name, path in pages.items():
        page = Page(path)
        names = {name for name, _ in page.elements}
        assert not names & {"link", "iframe", "object", "embed", "base"}
        text = path.read_text(encoding="utf-8")
        running = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
        assert len(running) == (name == "full")
        assert sum(name == "script" for name, _ in page.elements) == 2 * len(running)
        policy = next(str(a["content"]) for _, a in page.elements if "http-equiv" in a)
        digests = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in running]
        assert re.findall(r"'sha256-(.*?)'", policy) == digests
        for _, attributes in page.elements:
            for key, value in attributes.items():
                assert not key.startswith("on")
                if key in ("src", "href", "srcset", "data", "poster"):
                    assert value is not None
                    assert value.startswith(("#", "data:image/"))
        text = text.replace('"http://www.w3.org/2000/svg"', "")  # a name, not an address
        assert "http://" not in text
        assert "https://" not in text
        assert "url(" not in text
        assert "@import" not in text


def test_links_within_the_page_arrive(pages: dict[str, Path]) -> None:
    for path in pages.values():
        elements = Page(path).elements
        there = [a["id"] for _, a in elements if "id" in a]
        assert len(there) == len(set(there))
        links = {str(a["href"])[1:] for _, a in elements if "href" in a}
        assert links <= set(there)
        assert len(links) >= 4


def test_pictures_have_words_and_sizes(pages: dict[str, Path]) -> None:
    pictures = [a for name, a in Page(pages["full"]).elements if name == "img"]
    assert len(pictures) > 6
    for picture in pictures:
        assert re.match(r"Sonar image, frame \d+: ", str(picture["alt"]))
        assert int(str(picture["width"])) > 100
    drawings = [a for name, a in Page(pages["full"]).elements if name == "svg"]
    assert all(a.get("aria-label") or a.get("aria-hidden") for a in drawings)


def test_without_truth_and_log_the_page_says_so(pages: dict[str, Path]) -> None:
    page = Page(pages["bare"])
    assert "no ground truth was given" in page.text
    assert "the log itself was not given (--log)" in page.text
    assert "TPR" not in page.text
    assert not [name for name, _ in page.elements if name == "img"]
    seen = page.tables["Declared by framework, a row per pass, in order of first sight"]
    assert {row[0] for row in seen[1:]} == {"ID.1", "ID.3"}


def test_size_and_sameness(pages: dict[str, Path], results: Path, tmp_path: Path) -> None:
    assert pages["full"].stat().st_size < 1.5e6
    again = tmp_path / "again.html"
    sonarrec(
        "report", results, "--ground-truth", SAMPLE / "gt.csv", "--log", SAMPLE, "-o", again, "-q"
    )
    assert again.read_bytes() == pages["full"].read_bytes()


def test_names_are_text_not_html(tmp_path: Path) -> None:
    folder = tmp_path / "<img src=x onerror=alert(1)>"
    folder.mkdir()
    (folder / "frames.csv").write_text("frame\n0\n1\n")
    (folder / "estimates.csv").write_text(
        "frame,method,object,landmark,score,declared\n0,<script>bad()</script>,1,1,0.9,1\n"
    )
    sonarrec("report", folder, "-o", tmp_path / "out.html")
    page = Page(tmp_path / "out.html")
    assert not [n for n, a in page.elements if n in ("script", "img") or "onerror" in a]
    assert "<script>bad()</script>" in page.text


def test_results_of_another_program(tmp_path: Path) -> None:
    """Frames without times, no objects, no probabilities, no run.toml, truth without places."""
    (tmp_path / "frames.csv").write_text("frame\n" + "".join(f"{n}\n" for n in range(10)))
    (tmp_path / "estimates.csv").write_text(
        "frame,method,landmark,score,declared\n2,mine,1,0.9,1\n3,mine,1,0.8,1\n7,mine,3,0.7,1\n"
    )
    (tmp_path / "gt.csv").write_text("frame,landmark\n3,1\n4,1\n")
    truth = ("--ground-truth", tmp_path / "gt.csv", "--min-visible", "0.995")
    sonarrec("report", tmp_path, *truth)
    page = Page(tmp_path / "report.html")
    assert "in view (at least 99.5% of it)" in page.text
    assert "2 rows with at least 99.5% of the landmark in view are scored" in page.text
    assert "ID.1 declared (0.90) while it is not in view" in page.text
    assert "ID.1 in view and not declared" in page.text
    assert "no tracks with probabilities" in page.text
    assert "there is no run.toml" in page.text


ODD_RESULTS = {
    "no estimate": ("0,5\n1,9\n", ""),
    "one frame": ("7,5\n", "7,framework,1,2.0,0.0,.9,.05,.05,0,0,1,.9,1\n"),
    "single-frame method only": ("0,5\n1,9\n", "1,smi,0,2.0,0.0,.9,.05,.05,0,0,1,.9,1\n"),
    "times that fall": ("0,9\n1,5\n", "1,framework,1,2.0,0.0,.9,.05,.05,0,0,1,.9,1\n"),
    "one estimate in a gap": (
        "".join(f"{n},{n}\n" for n in (0, 1, 50)),
        "".join(f"{n},framework,1,2.0,0.0,.9,.05,.05,0,0,1,.9,1\n" for n in (0, 50)),
    ),
}


@pytest.mark.parametrize("name", ODD_RESULTS)
@pytest.mark.parametrize("truth", [None, "", "7,1,2.0,0.0\n0,2,2.0,0.0\n"])
def test_odd_results(tmp_path: Path, name: str, truth: str | None) -> None:
    frames, estimates = ODD_RESULTS[name]
    (tmp_path / "frames.csv").write_text(f"frame,timestamp_ns\n{frames}")
    header = (
        "frame,method,object,range_m,bearing_deg,p_1,p_2,p_3,p_4,p_none,landmark,score,declared"
    )
    (tmp_path / "estimates.csv").write_text(f"{header}\n{estimates}")
    options: tuple[str | Path, ...] = ()
    if truth is not None:
        (tmp_path / "gt.csv").write_text(f"frame,landmark,range_m,bearing_deg\n{truth}")
        options = ("--ground-truth", tmp_path / "gt.csv")
    result = CliRunner().invoke(main, ["report", str(tmp_path), *map(str, options)])
    if result.exit_code == 1:  # told in one line, as by evaluate
        assert isinstance(result.exception, SystemExit)
        assert result.stderr.startswith("sonarrec: ")
        assert truth == "" or (truth is not None and name == "no estimate") or name == "one frame"
        return
    assert isinstance(result.exception, SystemExit | None), result.exception
    page = Page(tmp_path / "report.html")
    for _, attributes in page.elements:
        assert "nan" not in str(attributes.get("d")) + str(attributes.get("style"))


def test_a_landmark_set_of_nine_ids(tmp_path: Path) -> None:
    sets = "".join(
        f"[[landmark]]\nid = {n + 10}\nsectors = [{','.join('1' * (n + 1) + '0' * (9 - n))}]\n"
        for n in range(9)
    )
    landmarks = tmp_path / "nine.toml"
    landmarks.write_text(
        f'name = "nine"\nradius_m = 0.2\nring = [0.8, 1.0]\nsymbol = [0.1, 0.6]\n{sets}'
    )
    (tmp_path / "frames.csv").write_text("frame\n0\n1\n")
    (tmp_path / "estimates.csv").write_text(
        "frame,method,object,landmark,score,declared\n"
        + "".join(f"0,framework,{n},{n + 10},0.9,1\n" for n in range(9))
    )
    sonarrec("report", tmp_path, "--landmarks", landmarks)
    page = Page(tmp_path / "report.html")
    assert len(page.tables["Declared by framework, a row per pass, in order of first sight"]) == 10
    assert "Never" not in page.text


def test_several_logs(results: Path, tmp_path: Path) -> None:
    root = tmp_path / "out"
    for name in ("first", "pan"):
        shutil.copytree(results, root / name)
    run = root / "first" / "run.toml"  # as if of another recording: one counts once
    run.write_text(re.sub('sha256 = "[0-9a-f]*"', f'sha256 = "{"0" * 64}"', run.read_text()))
    rows = (SAMPLE / "gt.csv").read_text().splitlines()
    with (tmp_path / "gt.csv").open("w") as file:
        file.write(f"log,{rows[0]}\n")
        file.writelines(f"{name},{row}\n" for name in ("first", "pan") for row in rows[1:])
    sonarrec("report", root, "--ground-truth", tmp_path / "gt.csv", "--log", SAMPLE)
    page = Page(root / "report.html")
    assert "2 recorded sonar logs" in page.text
    first, second = page.tables["Per log, protocol strict"][2:]
    assert (first[0], second[0]) == ("first", "pan")
    assert first[1:] == second[1:]
    found = evaluate(results, SAMPLE / "gt.csv").scored
    counts = [s.count() for s in found if s.protocol == "strict"]
    missed_and_false = [str(n) for c in counts for n in (c.fn, c.fp)]
    assert [cell for n in range(len(counts)) for cell in first[4 * n + 3 : 4 * n + 5]] == (
        missed_and_false
    )
    assert len([n for n, _ in page.elements if n == "img"]) > 6
    other = sonarrec("report", root, "--log", tmp_path, code=2)
    assert "neither one of these logs nor holds any: first, pan" in other.stderr


def test_logs_of_different_landmark_sets_are_refused(results: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        shutil.copytree(results, tmp_path / name)
    run = tmp_path / "b" / "run.toml"
    run.write_text(run.read_text().replace("id = 2\n", "id = 7\n"))
    estimates = tmp_path / "b" / "estimates.csv"
    estimates.write_text(estimates.read_text().splitlines()[0] + "\n")
    fault = sonarrec("report", tmp_path, code=1).stderr
    assert fault.startswith("sonarrec: ")
    assert "logs a and b were run with different landmark IDs" in fault


def test_another_log_is_refused(results: Path, tmp_path: Path) -> None:
    folder = tmp_path / "pan"
    shutil.copytree(SAMPLE, folder)
    (folder / "000127.png").unlink()
    fault = sonarrec("report", results, "--log", folder, "-o", tmp_path / "x.html", code=1).stderr
    assert fault.startswith("sonarrec: ")
    assert "results of another log" in fault
    assert not (tmp_path / "x.html").exists()
    # Nor is a topic that the run had one that was given.
    named = tmp_path / "named"
    shutil.copytree(results, named)
    run = (named / "run.toml").read_text()
    run = run.replace('time = "log"\n', 'time = "header"\ntopic = "/sonar"\n')
    (named / "run.toml").write_text(run)
    given = ("--log", folder, "-o", tmp_path / "x.html")
    assert "results of another log" in sonarrec("report", named, *given, code=1).stderr
    fault = sonarrec("report", named, *given, "--topic", "/sonar", code=2).stderr
    assert "--topic chooses a channel" in fault


def test_several_presets(tmp_path: Path) -> None:
    half = ("--frames", "20:70")
    sonarrec("run", SAMPLE, *half, "--preset", "paper,default", "--out", tmp_path, "-q")
    head, *rows = (SAMPLE / "gt.csv").read_text().splitlines()
    rows = [row for row in rows if 20 <= int(row.partition(",")[0]) < 70]
    (tmp_path / "gt.csv").write_text("\n".join([head, *rows, ""]))
    scored = ("--ground-truth", tmp_path / "gt.csv")
    sonarrec("report", tmp_path / "pan", *scored, "--method", "framework:default")
    text = Page(tmp_path / "pan" / "report.html").text
    assert "Declared by framework:default" in text
    assert re.search("framework:(default|paper) minus framework:(default|paper)", text)
    assert "framework:paper: " in text
    fault = sonarrec("report", tmp_path / "pan", "--method", "best", code=2).stderr
    there = "smi:paper, framework:paper, smi:default, framework:default"
    assert f"no method 'best'; there is {there}" in fault


def test_every_setting_is_shown(pages: dict[str, Path], results: Path) -> None:
    def leaves(value: Any) -> Iterator[tuple[str, Any]]:
        for key, inner in value.items():
            if isinstance(inner, dict):
                yield from leaves(inner)
            elif not isinstance(inner, list):
                yield key, inner

    text = Page(pages["bare"]).text
    run = tomllib.loads((results / "run.toml").read_text())
    found = list(leaves(run))
    assert len(found) > 40
    for key, value in found:
        assert f"{key}{str(value).lower() if isinstance(value, bool) else value}" in text


def test_settings_of_several_presets_and_odd_values() -> None:
    run = {
        "finished": True,
        "config": [
            {"preset": "paper", "smi": {"declare": 0.6}},
            {"preset": "default", "smi": {"declare": 0.5}},
        ],
        "landmarks": {"ring": [0.8, 1.0], "landmark": [{"id": 1, "sectors": [1, 0]}, {"id": 2}]},
    }
    assert list(settings_tables(run)) == [
        ("run", [("finished", "true")]),
        ("config[0]", [("preset", "paper")]),
        ("config[0].smi", [("declare", "0.6")]),
        ("config[1]", [("preset", "default")]),
        ("config[1].smi", [("declare", "0.5")]),
        ("landmarks", [("ring", "0.8, 1.0"), ("landmark", "id 1, sectors 1, 0; id 2")]),
    ]


def test_what_could_not_be_used_is_told(results: Path, tmp_path: Path) -> None:
    shutil.copytree(results, tmp_path / "pan")
    run = (results / "run.toml").read_text()
    run = run.replace("finished = true", "finished = false")
    run = run.replace("problems = []", 'problems = ["000007.png: unreadable, skipped"]')
    (tmp_path / "pan" / "run.toml").write_text(run)
    told_twice = sonarrec("report", tmp_path / "pan", code=3)
    assert "the run was cut short" in told_twice.stderr
    text = Page(tmp_path / "pan" / "report.html").text
    assert "the run was cut short" in text
    assert "000007.png: unreadable, skipped" in text


def test_a_log_without_sightings(results: Path, tmp_path: Path) -> None:
    """Nothing declared: the page says so and shows what came nearest to it."""
    shutil.copytree(results, tmp_path / "pan")
    with (results / "estimates.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    with (tmp_path / "pan" / "estimates.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(row | {"declared": 0} for row in rows)
    sonarrec("report", tmp_path / "pan", "--log", SAMPLE)
    page = Page(tmp_path / "pan" / "report.html")
    assert "No landmark was declared." in page.text
    assert "Nothing declared; nearest to it ID." in page.text
    assert len([name for name, _ in page.elements if name == "img"]) == 1


def test_no_results_is_one_line(tmp_path: Path) -> None:
    fault = sonarrec("report", tmp_path, code=1).stderr
    assert fault.startswith("sonarrec: ")
    assert "no results here" in fault


def held_frames(path: Path) -> list[dict[str, Any]]:
    """What the page holds to be shown on a click, per log."""
    (text,) = re.findall(
        r'<script type="application/json" id="frames">(.*?)</script>', path.read_text()
    )
    found: list[dict[str, Any]] = json.loads(text)
    return found


def test_frames_held_are_the_logs(pages: dict[str, Path], results: Path) -> None:
    """All of a short log; each with its time, its truth and what every method says in it."""
    (log,) = held_frames(pages["full"])
    assert (log["name"], log["unit"], log["methods"]) == ("pan", "s", ["smi", "framework"])
    assert [f["frame"] for f in log["frames"]] == list(range(128))
    declared: dict[tuple[int, str], list[str]] = {}
    with (results / "estimates.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            if row["declared"] == "1":
                label = f"ID.{row['landmark']}  {float(row['score']):.2f}"
                declared.setdefault((int(row["frame"]), row["method"]), []).append(label)
    truth = read_truth(SAMPLE / "gt.csv")
    for f in log["frames"]:
        assert f["at"] == f["frame"] / 4
        for method, said in zip(log["methods"], f["said"], strict=True):
            labels = sorted(o["label"] for o in said if o["declared"])
            assert labels == sorted(declared.get((f["frame"], method), []))
        assert len(f["truth"]) == np.count_nonzero(truth.at == f["frame"])
        data = base64.b64decode(f["image"].removeprefix("data:image/webp;base64,"))
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        source = cv2.imread(str(SAMPLE / f"{f['frame']:06d}.png"), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert source is not None
        assert list(image.shape[::-1]) == f["size"] == [191, 256]
        assert np.corrcoef(image.ravel(), source.ravel())[0, 1] > 0.97


def test_outlines_lie_where_the_table_has_them(pages: dict[str, Path], results: Path) -> None:
    (log,) = held_frames(pages["full"])
    with (results / "estimates.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            if row["declared"] == "1":
                of_method = log["frames"][int(row["frame"])]["said"][
                    log["methods"].index(row["method"])
                ]
                # Pixel centres are whole numbers in the table, halves on the page.
                place = np.array([float(row["x_px"]), float(row["y_px"])]) + 0.5
                away = [np.linalg.norm(np.array(o["ellipse"][:2]) - place) for o in of_method]
                assert min(away) < 1


@pytest.mark.parametrize("most", [3, 40, 250])
def test_which_frames_are_held(results: Path, most: int) -> None:
    """The wanted first, in their order; of the rest as many as there is room for, spread out."""
    logs = [reported(results, SAMPLE / "gt.csv")]
    wanted = [("pan", 99), ("pan", 5), ("other", 1), ("pan", 99), ("pan", 6), ("pan", 7)]
    found = frames.choose(logs, wanted, most)["pan"]
    assert len(found) == min(most, 128)
    assert found == sorted(set(found))
    assert {99, 5, 6} <= set(found)
    if most == 40:
        assert max(np.diff(found)) <= 6


def test_of_each_log_a_frame_is_held(results: Path) -> None:
    """Also where others want all there is room for: a click on the log has to show something."""
    log = reported(results, SAMPLE / "gt.csv")
    logs = [replace(log, results=replace(log.results, name=name)) for name in ("a", "b", "c")]
    wanted = [("a", f) for f in range(60)] + [("b", 70)]
    found = frames.choose(logs, wanted, 20)
    assert found == {"a": list(range(18)), "b": [70], "c": [0]}


def test_frames_held_take_no_more_than_stated() -> None:
    """Of noise, which no coder makes small."""
    noise = np.random.default_rng(0).integers(0, 256, (900, 700), dtype=np.uint8)
    for most in (400, 3000, 15_000):
        source = frames._within(noise, most)
        assert len(source) <= most
        assert source.startswith("data:image/webp;base64,")


def test_a_false_claim_is_called_one(results: Path, tmp_path: Path) -> None:
    """Under an ID that lies nowhere: the picture says so. Of alike scores the true one is shown."""
    shutil.copytree(results, tmp_path / "pan")
    (tmp_path / "pan" / "sightings.csv").unlink()
    with (results / "estimates.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:  # the first of all sightings is false, and as sure as any
        if row["method"] == "framework" and row["declared"] == "0" and row["frame"] == "4":
            row |= {"declared": "1", "landmark": "1", "score": "1.0"}
        if row["method"] == "framework" and row["declared"] == "0" and row["frame"] == "9":
            row |= {"declared": "1", "landmark": "2", "score": "0.8"}
    with (tmp_path / "pan" / "estimates.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
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
    assert "declared in 1 frame. False claim: no landmark lies there." in text


@pytest.mark.slow
def test_a_table_of_pairs(results: Path, tmp_path: Path) -> None:
    """Each log against its own truth, its recording found by name in a folder of them."""
    shutil.copytree(results, tmp_path / "a" / "pan")
    for day in ("day1", "day2"):
        shutil.copytree(SAMPLE, tmp_path / "logs" / day / "pan")
    other = tmp_path / "logs" / "day2" / "pan"
    for n in range(40, 128):
        (other / f"{n:06d}.png").unlink()
    sonarrec("run", other, "-o", tmp_path / "b")
    gt = SAMPLE / "gt.csv"
    (tmp_path / "pairs.csv").write_text(
        f"results,ground_truth,log\na/pan,{gt},one\nb/pan,{gt},two\n"
    )
    sonarrec("report", "--pairs", tmp_path / "pairs.csv", "--log", tmp_path / "logs", code=3)
    page = Page(tmp_path / "report.html")
    assert [row[0] for row in page.tables["Per log, protocol strict"][2:]] == ["one", "two"]
    assert [log["name"] for log in held_frames(tmp_path / "report.html")] == ["one", "two"]
    both = sonarrec("report", results, "--pairs", tmp_path / "pairs.csv", code=2)
    assert "leave out RESULTS" in both.stderr


def test_a_folder_of_logs(results: Path, tmp_path: Path) -> None:
    """By name, and of equal names by SHA-256; what is missing is told."""
    shutil.copytree(results, tmp_path / "out" / "pan")
    shutil.copytree(results, tmp_path / "out" / "gone")
    run = tmp_path / "out" / "gone" / "run.toml"
    run.write_text(re.sub(r'(name|path) = ".*pan"', r'\1 = "gone"', run.read_text()))
    other = tmp_path / "logs" / "day1" / "pan"
    shutil.copytree(SAMPLE, other)
    (other / "000127.png").unlink()
    shutil.copytree(SAMPLE, tmp_path / "logs" / "day2" / "pan")
    told = sonarrec("report", tmp_path / "out", "--log", tmp_path / "logs", code=3)
    assert "no log of the name gone in it; the page has no frames of it" in told.stderr
    assert "no log of the name gone" in Page(tmp_path / "out" / "report.html").text
    (log,) = held_frames(tmp_path / "out" / "report.html")
    assert (log["name"], log["in_all"]) == ("pan", 128)


def test_logs_in_several_folders_are_each_found_in_one(tmp_path: Path) -> None:
    """What is not in the first folder, but in the second, is not told as missing."""
    for name in ("a", "b"):
        shutil.copytree(SAMPLE, tmp_path / f"at_{name}" / name)
        sonarrec(
            "run", "-q", tmp_path / f"at_{name}" / name, "--frames", ":3", "-o", tmp_path / "o"
        )
    both = ["--log", tmp_path / "at_a", "--log", tmp_path / "at_b"]
    assert "no log of the name" not in sonarrec("report", tmp_path / "o", *both).stderr
    told = sonarrec("report", tmp_path / "o", *both[:2], code=3).stderr
    assert told.count("no log of the name b in it; the page has no frames of it") == 1


def test_a_packed_log_of_any_name_is_found_in_a_folder_of_logs(tmp_path: Path) -> None:
    packed = tmp_path / "logs" / os.fsdecode(b"d\xe9ve.mcap.zst")
    packed.parent.mkdir()
    packed.write_bytes(zstandard.compress(SAMPLE.with_suffix(".mcap").read_bytes()))
    shutil.copy(SAMPLE / "sonar.toml", packed.parent)
    sonarrec("run", "-q", packed, "--frames", "0:3", "-o", tmp_path / "out")
    sonarrec("report", tmp_path / "out", "--log", tmp_path / "logs")
    [log] = held_frames(tmp_path / "out" / "report.html")
    assert log["name"] == r"d\xe9ve"


@pytest.mark.slow
def test_a_long_log_stays_a_small_page(tmp_path: Path) -> None:
    """20,000 frames, 300 tracks: what is drawn is bounded, and what is left out is told."""
    frames, objects = 20_000, 300
    stamps = "".join(f"{n},{n * 10**8}\n" for n in range(frames))
    (tmp_path / "frames.csv").write_text(f"frame,timestamp_ns\n{stamps}")
    noise = np.random.default_rng(0).random((frames, 2)).round(3)
    rows = "".join(
        f"{n},{m},{n * objects // frames},2,0,{a},0,{1 - a},0,0,"
        f"{3 - 2 * (a > 0.5)},{b},{+(b > 0.5)}\n"
        for n, (a, b) in enumerate(noise.tolist())
        for m in ("smi", "framework")
    )
    header = (
        "frame,method,object,range_m,bearing_deg,p_1,p_2,p_3,p_4,p_none,landmark,score,declared"
    )
    (tmp_path / "estimates.csv").write_text(f"{header}\n{rows}")
    (tmp_path / "gt.csv").write_text(
        "frame,landmark,range_m,bearing_deg\n" + "".join(f"{n},1,2,0\n" for n in range(frames))
    )
    sonarrec("report", tmp_path, "--ground-truth", tmp_path / "gt.csv")
    assert (tmp_path / "report.html").stat().st_size < 1e6
    text = Page(tmp_path / "report.html").text
    assert "12 of 300 declared tracks are shown" in text
    assert "more sightings left out" in text
    assert "lesser groups of mistakes left out" in text


@pytest.fixture(scope="module")
def of_a_long_log(tmp_path_factory: pytest.TempPathFactory) -> str:
    """20,000 frames: a landmark declared for two frames in every 200, and at the end for 3,000."""
    frames, folder = 20_000, tmp_path_factory.mktemp("long")
    (folder / "frames.csv").write_text(
        "frame,timestamp_ns\n" + "".join(f"{n},{n * 10**8}\n" for n in range(frames))
    )
    header = "frame,method,object,range_m,bearing_deg,landmark,score,declared"
    (folder / "estimates.csv").write_text(
        f"{header}\n"
        + "".join(f"{n},framework,{n // 200},2,0,1,1,{+(n % 200 < 2)}\n" for n in range(17_000))
        + "".join(f"{n},framework,999,2,0,1,1,1\n" for n in range(17_000, frames))
    )
    sonarrec("report", folder)
    return (folder / "report.html").read_text()


def test_of_many_sightings_the_page_has_those_of_most_frames(of_a_long_log: str) -> None:
    assert "46 more sightings left out" in of_a_long_log
    assert "<td>999</td><td>17000</td>" in of_a_long_log


def test_a_bar_of_many_frames_tells_how_many_of_them_are_declared(of_a_long_log: str) -> None:
    """400 bars of 50 frames: 2 of 200 declared is .04 of every fourth, the end is full."""
    [(best, mean)] = re.findall(
        r'class="bar faint"[^>]* d="([^"]*)".*?class="bar"[^>]* d="([^"]*)"', of_a_long_log, re.S
    )
    heights = [int(h) for h in re.findall(r"v-(\d+)", mean)]
    assert heights == [40] * 85 + [1000]
    assert [int(h) for h in re.findall(r"v-(\d+)", best)] == [1000] * 86
    assert "at most 50" in of_a_long_log


# The mistakes


def write_log(folder: Path, rng: np.random.Generator, frames: int = 120) -> None:
    """Random results of two methods and random truth, with positions."""
    folder.mkdir()
    header = (
        "frame,method,object,range_m,bearing_deg,p_1,p_2,p_3,p_4,p_none,landmark,score,declared"
    )
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
    stamps = "".join(f"{n},{n * 250_000_000}\n" for n in range(frames))
    (folder / "frames.csv").write_text(f"frame,timestamp_ns\n{stamps}")
    (folder / "estimates.csv").write_text("\n".join([header, *rows]) + "\n")
    (folder / "gt.csv").write_text(
        "\n".join(["frame,landmark,range_m,bearing_deg,visible", *dict.fromkeys(truth)]) + "\n"
    )


@pytest.fixture(scope="module")
def random_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("random") / "log"
    write_log(folder, np.random.default_rng(5))
    return folder


def reported(folder: Path, truth: Path | None = None) -> ReportedLog:
    [log], _ = read_logs(
        [LogToShow(folder, read_truth(truth or folder / "gt.csv"))],
        ScoringOptions(sonar=Sonar()),
        method=None,
    )
    return log


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_mistakes_add_up_to_the_table(random_log: Path, tmp_path: Path, protocol: str) -> None:
    truth = random_log / "gt.csv"
    if protocol == "paper":  # without positions in the truth only this one is scored
        rows = [line.split(",") for line in truth.read_text().splitlines()]
        truth = tmp_path / "gt.csv"
        truth.write_text("".join(f"{r[0]},{r[1]},{r[4]}\n" for r in rows))
    found = evaluate(random_log, truth)
    for method in found.joined.methods:
        count = score(found.joined, found.joined.methods.index(method), protocol).count()
        wrong = episodes(found, method, protocol)
        assert sum(e.count for e in wrong if e.kind == "claim") == count.fp > 50
        assert sum(e.count for e in wrong if e.kind == "miss") == count.fn > 50
        for e in wrong:
            assert e.first <= e.worst <= e.last
            assert 0 <= e.wrongness <= 1


def test_episodes_and_their_order(tmp_path: Path) -> None:
    """By hand: a long mistake before a short one; a gap of five frames makes two of one."""
    log = tmp_path / "log"
    log.mkdir()
    (log / "frames.csv").write_text("frame\n" + "".join(f"{n}\n" for n in range(40)))
    # ID.2 claimed at 20 deg, where nothing lies: frames 0 to 3, 8 and 14 (gaps of 4 and 5).
    claims = [f"{n},mine,2,2.0,20,{0.5 + n / 100},1" for n in (0, 1, 2, 3, 8, 14)]
    # ID.1 lies at 0 deg in frames 20 and 21; called ID.3 there, then scored too low.
    claims += ["20,mine,3,2.0,0,0.8,1", "21,mine,1,2.0,0,0.3,0"]
    header = "frame,method,landmark,range_m,bearing_deg,score,declared"
    (log / "estimates.csv").write_text("\n".join([header, *claims]) + "\n")
    (log / "gt.csv").write_text(
        "frame,landmark,range_m,bearing_deg\n20,1,2.0,0\n21,1,2.0,0\n30,4,2.0,0\n"
    )
    scored = evaluate(log, log / "gt.csv")
    found = episodes(scored, "mine", "strict")
    shown = [(e.kind, e.landmark, e.first, e.last, e.worst, e.count) for e in found]
    assert shown == [
        ("claim", 2, 0, 8, 8, 5),
        ("miss", 1, 20, 21, 20, 2),
        ("miss", 4, 30, 30, 30, 1),
        ("claim", 3, 20, 20, 20, 1),
        ("claim", 2, 14, 14, 14, 1),
    ]
    assert [in_words(e, scored.joined) for e in found] == [
        "ID.2 declared (0.58) where no landmark lies",
        "ID.1 in view and not declared: called ID.3 (0.80)",
        "ID.4 in view and not declared: nothing found there",
        "ID.3 declared (0.80) on what is ID.1",
        "ID.2 declared (0.64) where no landmark lies",
    ]


# What is gathered of a log


def test_truth_beneath_and_estimates_alongside(random_log: Path) -> None:
    """Against loops over every pair."""
    log = reported(random_log)
    found, truth = log.results, log.truth
    assert truth is not None
    assert log.truth_near is not None
    assert found.position is not None
    assert truth.position is not None
    for n in range(0, len(found.frame_index), 7):
        best, beneath = found.landmarks.radius_m, -1
        for t in np.flatnonzero(truth.frame_index == found.frame_index[n]):
            away = np.linalg.norm(found.position[n] - truth.position[t])
            if away <= best:
                best, beneath = away, truth.landmark_index[t]
        assert log.truth_near[n] == beneath
    chosen = tracks(log, most=3, most_silent=0)
    shown = chosen.declared
    assert (len(shown), chosen.declared_in_all, chosen.silent_in_all) == (3, 4, 0)
    assert {track.number for track in shown} < {100, 101, 102, 103}
    smi = np.flatnonzero(log.of_method("smi"))
    for track in shown:
        assert (np.diff(track.frame_index) > 0).all()
        assert (found.object[track.at] == track.number).all()
        for at, row, matched in zip(
            track.at, track.frame_index, alongside(log, track, "smi"), strict=True
        ):
            here = smi[found.frame_index[smi] == row]
            away = np.linalg.norm(found.position[here] - found.position[at], axis=1)
            if len(here) and away.min() <= found.landmarks.radius_m:
                assert matched == here[away.argmin()]
            else:
                assert matched == -1


def test_sightings_of_the_sample(results: Path) -> None:
    """Against a loop over estimates.csv."""
    claims: dict[tuple[int, int], list[tuple[int, float]]] = {}
    with (results / "estimates.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            if row["method"] == "framework" and row["declared"] == "1":
                key = (int(row["landmark"]), int(row["object"]))
                claims.setdefault(key, []).append((int(row["frame"]), float(row["score"])))
    reported_log = reported(results, SAMPLE / "gt.csv")
    found = judged_sightings(reported_log)
    assert {(one.sighting.landmark, one.sighting.track) for one in found} == set(claims)
    assert {one.sighting.landmark for one in found} == {1, 3}
    assert len(found) == 3  # landmark 1 goes and comes back
    for one in found:
        s = one.sighting
        assert s.track is not None
        here = [c for c in claims[s.landmark, s.track] if s.first_frame <= c[0] <= s.last_frame]
        frames, scores = zip(*here, strict=True)
        assert (s.first_frame, s.last_frame, s.frames_declared) == (
            min(frames),
            max(frames),
            len(frames),
        )
        assert s.best_score == max(scores)
        assert s.mean_score == pytest.approx(np.mean(scores), abs=1e-6)
        surest = reported_log.frame_of(one.surest)
        assert round(scores[frames.index(surest)], 2) == round(s.best_score, 2)
        assert one.right is not None
        assert 0 <= one.right <= len(one.at) == len(here)


# The drawing


@given(st.lists(st.floats(0, 1) | st.just(np.nan), min_size=1, max_size=3000), st.integers(2, 400))
@settings(max_examples=60)
def test_thinning_keeps_peaks_and_dips(values: list[float], most: int) -> None:
    y = np.array(values)
    kept = svg.thinned(y, most)
    assert len(kept) <= max(most, 1)
    assert (np.diff(kept) > 0).all()
    if np.isfinite(y).any():
        assert np.nanmax(y[kept]) == np.nanmax(y)
        assert np.nanmin(y[kept]) == np.nanmin(y)


def drawn_points(path: str) -> list[list[tuple[int, int]]]:
    """The subpaths of a polyline."""
    return [
        [tuple(map(int, p.split())) for p in part.split("L")]  # type: ignore[misc]
        for part in path.split("M")[1:]
    ]


def test_lines_break_where_nothing_was_seen() -> None:
    x = np.array([0, 0.25, 0.5, 0.75, 1.0])
    y = np.array([0, 1, np.nan, 0.5, np.nan])
    assert drawn_points(svg.polyline(x, y)) == [
        [(0, 1000), (500, 0)],
        [(1500, 500), (1500, 500)],
    ]
    assert svg.polyline(x, np.full(5, np.nan)) == ""


def test_no_line_through_a_step_of_few_estimates() -> None:
    """Nor through an empty one; its dot is hollow, and what it tells says so."""
    count = np.array([0, 9, 10, 400, 3, 12, 15, 0, 11, 1])
    mean = np.where(count, np.arange(10) / 10 + 0.05, np.nan)
    right = np.where(count, 0.5, np.nan)
    chart = charts.reliability(Reliability("mine", "top", count, mean, right), 0)
    (line,) = [s.path for s in chart.shapes if s.label == "mine"]
    columns = [[x for x, _ in part] for part in drawn_points(line)]
    assert columns == [[500, 700], [1100, 1300], [1700, 1700]]
    hollow = [dot.x for dot in chart.dots if dot.kind == "few"]
    assert hollow == pytest.approx([15, 45, 95])
    assert all(("too few" in d.label) == (d.kind == "few") for d in chart.dots)
    assert len(chart.dots) == 8


def test_a_track_never_declared_is_seen_though_its_score_is_nothing() -> None:
    """Grey where it was followed; above it, where the score is worth a bar, in the ID's colour."""
    log = SimpleNamespace(
        time=np.arange(10.0),
        truth_near=None,
        results=SimpleNamespace(
            landmark_index=np.array([0, 0, 1, 1]),
            score=np.array([0.0, 0.0, 0.4, 0.0]),
            landmarks=SimpleNamespace(ids=(1, 2)),
        ),
    )
    track = Track(7, np.arange(4), np.array([2, 3, 4, 5]))
    (lane,) = charts.silent_lanes(cast(ReportedLog, log), [track])
    followed, first, second = (painted(shape.path) for shape in lane.chart.shapes)
    assert (followed[400:1200] == 150).all()
    assert not followed[:400].any()
    assert not followed[1200:].any()
    assert not first.any()
    assert (second[800:1000] == 400).all()
    assert np.count_nonzero(second) == 200


def painted(path: str) -> np.ndarray:
    """(WIDTH,) height of the bars at every column of the sheet, by filling each rectangle."""
    height = np.zeros(svg.WIDTH)
    for left, up, wide in re.findall(r"M(\d+) 1000v-(\d+)h(\d+)v\d+z", path):
        columns = slice(int(left), int(left) + int(wide))
        height[columns] = np.maximum(height[columns], int(up))
    return height


@pytest.mark.parametrize("count", [1, 40, 397, 5000])
def test_bars_cover_their_frames(count: int) -> None:
    rng = np.random.default_rng(count)
    start = np.cumsum(rng.choice([1.0, 30.0], count, p=[0.95, 0.05])) - 1
    height = np.where(rng.random(count) < 0.6, rng.random(count).round(1), 0)
    axis = svg.Axis(0.0, float(start[-1]) + 1)
    path = svg.bars(axis, start, 1.0, height)
    columns = painted(path)
    centre = np.floor(axis.share(start + 0.5) * svg.WIDTH).astype(int)
    at = columns[np.minimum(centre, svg.WIDTH - 1)]
    if count < svg.MOST_POINTS:
        assert at == pytest.approx(1000 * height)
        between = np.diff(start) > 2  # nothing is drawn over time without frames
        gaps = np.floor(axis.share(start[:-1][between] + 15) * svg.WIDTH).astype(int)
        assert not columns[gaps].any()
    else:
        assert path.count("M") <= svg.MOST_POINTS
        assert columns.max() == 1000 * height.max()


def test_bars_are_seen_beside_a_pause_of_a_day() -> None:
    start = np.array([0.0, 0.25, 0.5, 86_400.0, 86_400.25])
    path = svg.bars(svg.Axis(0.0, 86_400.5), start, 0.25, np.array([0, 1, 0, 0, 0.5]))
    columns = painted(path)
    assert np.flatnonzero(columns).tolist() == [0, svg.WIDTH - 1]
    assert columns[[0, -1]].tolist() == [1000, 500]


def test_ticks_are_round_and_in_place() -> None:
    for high in (0.3, 1.0, 61.75, 25_000.0):
        ticks = svg.Axis(0.0, high).ticks()
        assert 3 <= len(ticks) <= 7
        for tick in ticks:
            assert tick.at == pytest.approx(100 * float(tick.text) / high, abs=0.01)
    assert svg.Axis(0.0, 0.3).ticks()[-1].text == "0.3"
    # A second of a track, ten hours into the log; frames of a very long one.
    late = [tick.text for tick in svg.Axis(36_000.125, 36_001.375).ticks()]
    assert late == ["36000.25", "36000.5", "36000.75", "36001", "36001.25"]
    assert svg.Axis(0.0, 3_000_000.0).ticks()[-1].text == "3000000"


def test_the_landmark_drawn_is_the_landmark() -> None:
    """Each glyph's path, filled by the even-odd rule, against the set's own pattern."""
    landmarks = load_landmarks("basin")
    x, y = (
        v.ravel() for v in np.meshgrid(np.linspace(-0.97, 0.97, 60), np.linspace(-0.97, 0.97, 60))
    )
    from matplotlib.path import Path as Outline

    for k in range(len(landmarks.ids)):
        inside = np.zeros(len(x), dtype=bool)
        for part in svg.glyph(landmarks, k).split("M")[1:]:
            inside ^= Outline(traced(part)).contains_points(
                np.column_stack([50 + 49 * x, 50 - 49 * y])
            )
        expected = landmarks.pattern(k, x, y) > 0.5
        # Grid points on an edge may fall either way.
        assert np.mean(inside != expected) < 0.02


def traced(part: str) -> np.ndarray:
    """(n, 2) points along a circle "cx cy a..." or a wedge "A, outer arc, L, inner arc"."""
    numbers = [float(v) for v in re.findall(r"-?\d+\.?\d*", part)]
    turn = np.linspace(0, 2 * np.pi, 200)
    if "a" in part:
        radius = numbers[2]
        return np.column_stack([50 + radius * np.cos(turn), 50 + radius * np.sin(turn)])
    (ax, ay, outer, _, _, _, _, bx, by, dx, dy, *_), (cx, cy) = numbers, numbers[-2:]

    def arc(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
        radius = np.hypot(x0 - 50, y0 - 50)
        begin, end = np.arctan2(50 - y0, x0 - 50), np.arctan2(50 - y1, x1 - 50)
        way = np.linspace(0, (end - begin + np.pi) % (2 * np.pi) - np.pi, 30) + begin
        return np.column_stack([50 + radius * np.cos(way), 50 - radius * np.sin(way)])

    assert outer == pytest.approx(np.hypot(ax - 50, ay - 50), abs=0.1)
    return np.vstack([arc(ax, ay, bx, by), arc(dx, dy, cx, cy)])


def test_colours_stand_out_on_white() -> None:
    """Those of a set of 20 IDs as well: 3 to 1, as WCAG 2 asks of what is drawn."""
    white = [255, 255, 255]
    for colour in (*landmark_colours(range(20)).values(), (0, 0, 0), (255, 255, 255)):
        dark = svg.darkened(colour)
        assert contrast([int(dark[n : n + 2], 16) for n in (1, 3, 5)], white) >= 3
        if contrast(list(colour), white) > 3.2:
            assert dark == "#{:02x}{:02x}{:02x}".format(*colour)
