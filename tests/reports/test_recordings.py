"""Frames of the recordings on the page, and which recording is which log's."""

from __future__ import annotations

import base64
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from sonarrec.reports import frames
from sonarrec.truth.table import read_truth
from tests.support.command import SAMPLE, sonarrec
from tests.support.pages import held_frames, reported
from tests.support.rows import read_rows


def test_frames_held_are_the_logs(pages: dict[str, Path], pan: Path) -> None:
    """All of a short log; each with its time, its truth and what every method says where."""
    (log,) = held_frames(pages["full"])
    assert (log["name"], log["unit"], log["methods"]) == ("pan", "s", ["framework", "smi"])
    assert [f["frame"] for f in log["frames"]] == list(range(128))
    declared: dict[tuple[int, str], list[tuple[str, float, float]]] = {}
    for row in read_rows(pan / "estimates.csv"):
        if row["declared"] == "1":
            label = f"ID.{row['landmark']}  {float(row['score']):.2f}"
            # Pixel centres are whole numbers in the table, halves on the page.
            place = label, float(row["x_px"]) + 0.5, float(row["y_px"]) + 0.5
            declared.setdefault((int(row["frame"]), row["method"]), []).append(place)
    truth = read_truth(SAMPLE / "gt.csv")
    for f in log["frames"]:
        assert f["at"] == f["frame"] / 4
        for method, said in zip(log["methods"], f["said"], strict=True):
            shown = sorted((o["label"], *o["ellipse"][:2]) for o in said if o["declared"])
            expected = sorted(declared.get((f["frame"], method), []))
            assert [label for label, *_ in shown] == [label for label, *_ in expected]
            for (_, *place), (_, *other) in zip(shown, expected, strict=True):
                assert np.hypot(*np.subtract(place, other)) < 1
        assert len(f["truth"]) == np.count_nonzero(truth.keys == f["frame"])
        if f["frame"] % 8:  # decoding takes longest
            continue
        data = base64.b64decode(f["image"].removeprefix("data:image/jpeg;base64,"))
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        source = cv2.imread(str(SAMPLE / f"{f['frame']:06d}.png"), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert source is not None
        assert list(image.shape[::-1]) == f["size"] == [191, 256]
        assert np.corrcoef(image.ravel(), source.ravel())[0, 1] > 0.97


def test_of_each_log_a_frame_is_held(pan: Path) -> None:
    """Also where others want all there is room for: a click on the log has to show something."""
    log = reported(pan, SAMPLE / "gt.csv")
    logs = [replace(log, results=replace(log.results, name=name)) for name in ("a", "b", "c")]
    wanted = [("a", f) for f in range(60)] + [("b", 70)]
    found = frames.choose(logs, wanted, 20)
    assert found == {"a": list(range(18)), "b": [70], "c": [0]}


def test_frames_held_take_no_more_than_stated() -> None:
    """Of noise, which no coder makes small."""
    noise = np.random.default_rng(0).integers(0, 256, (900, 700), dtype=np.uint8)
    for most in (1000, 3000, 15_000):  # the least that JPEG needs is some 600
        source = frames._within(noise, most)
        assert len(source) <= most
        assert source.startswith("data:image/jpeg;base64,")


def test_another_log_is_refused(pan: Path, tmp_path: Path) -> None:
    folder = tmp_path / "pan"
    shutil.copytree(SAMPLE, folder)
    (folder / "000127.png").unlink()
    fault = sonarrec("report", pan, "--log", folder, "-o", tmp_path / "x.html", code=1).stderr
    assert fault.startswith("sonarrec: ")
    assert "another log" in fault
    assert not (tmp_path / "x.html").exists()
    # Nor is a topic that the run had one that was given.
    named = tmp_path / "named"
    shutil.copytree(pan, named)
    run = (named / "run.toml").read_text()
    run = run.replace('time = "log"\n', 'time = "header"\ntopic = "/sonar"\n')
    (named / "run.toml").write_text(run)
    given = ("--log", folder, "-o", tmp_path / "x.html")
    assert "another log" in sonarrec("report", named, *given, code=1).stderr
    fault = sonarrec("report", named, *given, "--topic", "/sonar", code=2).stderr
    assert "--topic chooses a channel" in fault
