"""estimates.csv read frame by frame, of any program."""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.results.read import choose_method, read_estimates
from tests.support.estimates import BASIN, FAN, at, csv_file, estimate, write_results


def test_estimates_come_back_as_written(tmp_path: Path) -> None:
    rows = [(), (estimate(10.25, 20.5, 3), estimate(30, 40, 4, number=9)), (), (estimate(1, 2),)]
    path = write_results(tmp_path / "r", rows) / "estimates.csv"
    found = dict(read_estimates(path, "framework", BASIN, FAN))
    assert sorted(found) == [1, 3]
    exact = attrgetter("object", "landmark", "declared", "x_px", "y_px")
    for read, written in zip([*found[1], *found[3]], [*rows[1], *rows[3]], strict=True):
        assert exact(read) == exact(written)
        np.testing.assert_allclose(read.probabilities, written.probabilities, atol=1e-6)


def test_estimates_of_another_program(tmp_path: Path) -> None:
    path = csv_file(
        tmp_path / "e.csv",
        "frame,method,range_m,bearing_deg,landmark,score,declared,read",
        "4,yolo,2.0,5.0,3,0.8,True,by Ann",
    )
    assert choose_method(path, None) == "yolo"
    [(frame, [found])] = read_estimates(path, "yolo", BASIN, FAN)
    assert frame == 4
    assert (found.x_px, found.y_px) == pytest.approx(at(FAN, 2.0, 5.0))
    np.testing.assert_allclose(found.probabilities, [0, 0, 0.8, 0, 0.2])
    assert found.object < 0  # and so it has no trail
    assert found.read == ""  # theirs is something else


HEAD = "frame,method,x_px,y_px,landmark,score,declared"


def test_choice_of_method(tmp_path: Path) -> None:
    def chosen(*methods: str, wanted: str | None = None) -> str:
        rows = [f"{n},{m},1,1,1,0.5,0" for n, m in enumerate(methods)]
        return choose_method(csv_file(tmp_path / "e.csv", HEAD, *rows), wanted)

    assert chosen("smi", "framework", "yolo") == "framework"
    assert chosen("smi", "framework:paper") == "framework:paper"
    assert chosen("smi", "framework", wanted="smi") == "smi"
    assert chosen("yolo") == "yolo"
    assert chosen() == "framework"
    assert chosen(wanted="smi") == "smi"
    assert chosen("smi", "framework:b", "framework:a") == "framework:a"
    assert chosen("smi", "yolo") == "yolo"
    with pytest.raises(UsageError, match=r"'x'.* smi"):
        chosen("smi", wanted="x")


@pytest.mark.parametrize(
    ("row", "fault"),
    [
        ("0,m,1,1,9,0.5,0", "landmark 9 .*basin"),
        ("0,m,1,1,x,0.5,0", "landmark .*'x'"),
        ("1.5,m,1,1,1,0.5,0", "frame "),
        ("0,m,nan,1,1,0.5,0", "no position"),
        ("0,m,,1,1,0.5,0", "no position"),
        ("0,m,1e300,1,1,0.5,0", "x_px .*-1e9 to 1e9"),
        ("0,m,1,1,1,high,0", "score "),
        ("0,m,1,1,1,0.5,yes", "declared .*0 or 1"),
        ("0,m", "landmark .*empty"),
        ("-1,m,1,1,1,0.5,0", "frame -1 .*frame 0"),
    ],
)
def test_bad_rows_are_told_by_line(row: str, fault: str, tmp_path: Path) -> None:
    path = csv_file(tmp_path / "e.csv", HEAD, "0,m,1,1,1,0.5,0", row)
    with pytest.raises(SonarrecError, match=f"line 3: {fault}"):
        list(read_estimates(path, "m", BASIN, FAN))


@pytest.mark.parametrize(
    ("text", "fault"),
    [("", "it is empty"), ("frame,method\n", "wrong columns"), ("\0\0", "wrong columns")],
)
def test_tables_of_another_kind(text: str, fault: str, tmp_path: Path) -> None:
    (tmp_path / "e.csv").write_text(text)
    with pytest.raises(SonarrecError, match=fault):
        choose_method(tmp_path / "e.csv", None)
