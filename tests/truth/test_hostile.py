"""Annotations, tables and pairs that no person would write: one line each, and soon."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sonarrec.errors import SonarrecError, printable
from sonarrec.evaluation.evaluate import evaluate_logs
from sonarrec.evaluation.pairs import Pair, read_pairs
from sonarrec.landmarks import load_landmarks
from sonarrec.tables.read import read_table
from sonarrec.truth.annotations import cvat, read_annotations
from sonarrec.truth.convert import convert
from sonarrec.truth.table import read_truth

NINES = "9" * 400
BOX = '<box frame="{}" outside="0" xtl="1" ytl="1" xbr="3" ybr="3"/>'
FAR_APART = f"<track label='1'>{BOX.format(0)}{BOX.format(99_999)}</track>"
LABELME = (
    '{"imagePath": "1.png", "shapes": [{"label": "1", "shape_type": "polygon", "points": %s}]}'
)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.json", LABELME % "[[1e308, 1], [1e308, 5], [2, 1e308]]", "no coordinate"),
        ("a.json", LABELME % f"[[{NINES}, 1], [1, 5], [2, 3]]", "no coordinate"),
        ("a.json", LABELME % f"[[{'9' * 5000}, 1], [1, 5], [2, 3]]", "not valid JSON"),
        ("a.json", LABELME % ("[" * 100_000), "not valid JSON"),
        ("a.xml", f"<annotations><track label='1'>{BOX.format(NINES)}</track></annotations>",
         "no number of a frame"),
        ("a.xml", f"<annotations>{3 * FAR_APART}</annotations>", "shapes to fill in"),
        ("a.xml", "<?xml version='1.0' encoding='klingon'?><annotations/>", "unknown encoding"),
        ("a.txt", "1,1,1,1,1,1,1,1e308\n", "no coordinate"),
    ],
)  # fmt: skip
def test_annotations(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(SonarrecError, match=said) as fault:
        read_annotations(tmp_path / name)
    assert len(str(fault.value)) < 500


def test_as_many_shapes_as_hours_of_recording_have_are_filled_in(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text(f"<annotations>{FAR_APART}</annotations>")
    assert read_annotations(tmp_path / "a.xml")[1].interpolated == 99_998 < cvat.MOST_FILLED_IN


@pytest.mark.parametrize(
    ("image", "label", "said"),
    [
        ("9" * 5000, "1", "image name of 5004 characters"),
        (str(2**63), "1", "below 2\\^63"),
        ("1", "9" * 5000, "has no ID"),
    ],
)
def test_digits_in_names_and_labels(tmp_path: Path, image: str, label: str, said: str) -> None:
    shape = f'{{"label": "{label}", "shape_type": "point", "points": [[1, 1]]}}'
    text = f'{{"imagePath": "{image}.png", "shapes": [{shape}]}}'
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(SonarrecError, match=said):
        convert(tmp_path / "a.json", tmp_path / "gt.csv", load_landmarks("basin"))
    assert not (tmp_path / "gt.csv").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frame,landmark\n" + NINES + ",1\n", "a whole number below 2"),
        ("timestamp_ns,landmark\n9223372036854775808,1\n", "a whole number below 2"),
        (",".join(f"c{i}" for i in range(200_000)) + "\n", "columns"),
        ("frame,landmark\n" + "1," * 200_000 + "\n", "columns"),
        ("frame,landmark\n" + "9" * 5000 + ",1\n", "a whole number"),
        ("9" * 5000 + ",frame\n", "no landmark; found 999"),
        ('"a\nb",frame\n1,1\n', r"found a\\nb,frame; expected"),
    ],
)
def test_tables(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "gt.csv").write_text(text)
    with pytest.raises(SonarrecError, match=said) as fault:
        read_truth(tmp_path / "gt.csv")
    assert len(str(fault.value)) < 500


@pytest.mark.parametrize("path", ["/dev/zero", "/dev/null"])
def test_a_device_is_no_table(path: str) -> None:
    with pytest.raises(SonarrecError, match="not a file that can be read as a table"):
        read_table(Path(path), {"frame": "whole"}, ("frame",), "frame")


@pytest.mark.parametrize("name", ["a\0b", "a" * 5000])
def test_paths_of_pairs(tmp_path: Path, name: str) -> None:
    (tmp_path / "pairs.csv").write_text(f'results,ground_truth\n"{name}",gt.csv\n')
    with pytest.raises(SonarrecError, match=r"pairs\.csv line 2") as fault:
        read_pairs(tmp_path / "pairs.csv")
    assert str(fault.value).isprintable()


@pytest.mark.parametrize("again", ["same", "link", "copy"])
def test_one_result_is_not_several_logs(tmp_path: Path, again: str) -> None:
    first, second = tmp_path / "out", tmp_path / "again"
    first.mkdir()
    (first / "frames.csv").write_text("frame\n0\n")
    (first / "estimates.csv").write_text(
        "frame,method,range_m,bearing_deg,landmark,score,declared\n0,m,2,0,1,0.9,1\n"
    )
    (tmp_path / "gt.csv").write_text("frame,landmark,range_m,bearing_deg\n0,1,2,0\n")
    if again == "link":
        second.symlink_to(first)
    elif again == "copy":
        shutil.copytree(first, second)
    else:
        second = first / ".." / "out"
    pairs = [Pair(folder, tmp_path / "gt.csv", str(n)) for n, folder in enumerate((first, second))]
    found = evaluate_logs(pairs)
    assert found.counts.logs == ("0",)
    assert found.unused == ()
    assert any(f"{second}: the same log as {first} (by its tables)" in n for n in found.notes)


def test_what_a_terminal_obeys_is_escaped() -> None:
    assert printable("a\x1b[2Jb\nc") == r"a\x1b[2Jb\nc"
    assert printable("Flußbett 河") == "Flußbett 河"
    assert str(SonarrecError("no \x1b[31m here")) == r"no \x1b[31m here"


def test_method_names_cannot_move_the_cursor(tmp_path: Path) -> None:
    from sonarrec.evaluation.tabulate import screen, summary_screen
    from tests.support.claims import evaluate

    (tmp_path / "frames.csv").write_text("frame\n0\n1\n")
    (tmp_path / "estimates.csv").write_text(
        "frame,method,range_m,bearing_deg,landmark,score,declared\n0,m\x1b[2J,2,0,1,0.9,1\n"
    )
    (tmp_path / "gt.csv").write_text("frame,landmark,range_m,bearing_deg\n0,1,2,0\n")
    found = evaluate(tmp_path, tmp_path / "gt.csv")
    shown = screen(found.counts) + summary_screen(found, details=True)
    assert r"m\x1b[2J" in shown
    assert "\x1b" not in shown + "".join(found.notes)
