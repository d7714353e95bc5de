"""estimates.parquet in place of estimates.csv: the same columns, rows and numbers for everyone."""

from __future__ import annotations

import csv
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from sonarrec.errors import SonarrecError
from sonarrec.landmarks import load_landmarks
from sonarrec.nouns import FrameResult
from sonarrec.results.folders import estimates_of, part_of
from sonarrec.results.read import estimate_tables, read_log, read_results
from sonarrec.results.write import ResultsWriter
from sonarrec.tables import parquet
from tests.support.command import SAMPLE, sonarrec

TRUTH = SAMPLE / "gt.csv"


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The sample log, run into each form."""
    place = tmp_path_factory.mktemp("forms")
    for form in ("csv", "parquet"):
        sonarrec("run", SAMPLE, "--tables", form, "-o", place / form, "-q")
    return {form: place / form / "pan" for form in ("csv", "parquet")}


def test_the_same_columns_and_rows(both: dict[str, Path]) -> None:
    """Against the text of the CSV file, cell by cell."""
    assert not (both["parquet"] / "estimates.csv").exists()
    assert not (both["csv"] / "estimates.parquet").exists()
    table = pq.read_table(both["parquet"] / "estimates.parquet")
    with (both["csv"] / "estimates.csv").open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    assert table.column_names == header
    for name, cells in zip(header, zip(*rows, strict=True), strict=True):
        found = table.column(name).to_pylist()
        if name == "method":
            assert found == list(cells)
        elif name in ("frame", "timestamp_ns", "object", "landmark", "declared"):
            assert found == list(map(int, cells))
        else:
            told = np.array([np.nan if x is None else x for x in found])
            expected = np.array(list(map(float, cells)))
            assert np.allclose(told, expected, rtol=1e-15, atol=0, equal_nan=True)


@pytest.mark.slow
def test_whoever_reads_results_reads_both(both: dict[str, Path], tmp_path: Path) -> None:
    """What each command makes of them: the same bytes, but for where it names the file."""
    made = {}
    for form, results in both.items():
        place = tmp_path / "work"
        shutil.copytree(results, place / "pan")
        shutil.copy(results.parent / "logs.csv", place)
        out = place / "out"
        out.mkdir()
        for words in (
            ("evaluate", place / "pan", "--ground-truth", TRUTH, "-o", out / "evaluation"),
            ("report", place / "pan", "--ground-truth", TRUTH, "-o", out / "report.html"),
            ("overlay", SAMPLE, place / "pan", "--mcap", out / "marks.mcap"),
            ("truth", "propose", place / "pan", "-o", out / "proposed.csv"),
            ("map", place / "pan", "--odometry", poses(tmp_path), "-o", out / "map"),
            ("evaluate", "--ground-truth", TRUTH, "--compare", place / "pan", both["csv"]),
        ):
            sonarrec(*words, *(("-o", out / "compare") if "--compare" in words else ()))
        made[form] = {
            path.relative_to(out).as_posix(): path.read_bytes()
            for path in sorted(out.rglob("*"))
            if path.is_file()
        }
        shutil.rmtree(place)
    told = made["parquet"].pop("report.html").decode()
    key = '<tr><th scope="row" class="text">tables</th><td class="text">parquet</td></tr>'
    assert told.count(key) == 1
    assert told.replace(key, "") == made["csv"].pop("report.html").decode()
    compared = [json.loads(made[form].pop("compare/compare.json")) for form in ("csv", "parquet")]
    assert compared[0]["rates"] == compared[1]["rates"]
    assert [one["key"] for one in compared[1]["settings"]] == ["program.tables"]
    assert made["parquet"] == made["csv"]


def poses(place: Path) -> Path:
    path = place / "poses.csv"
    rows = (f"{n * 250_000_000},{n / 100},0,0" for n in range(200))
    path.write_text("timestamp_ns,x,y,yaw\n" + "\n".join(rows) + "\n", encoding="utf-8")
    return path


def test_in_python(both: dict[str, Path]) -> None:
    tables = {form: read_results(folder) for form, folder in both.items()}
    pd.testing.assert_frame_equal(
        tables["csv"].estimates, tables["parquet"].estimates, check_dtype=False
    )
    logs = {form: read_log(folder) for form, folder in both.items()}
    assert np.array_equal(logs["csv"].score, logs["parquet"].score)  # to the last bit
    assert np.array_equal(logs["csv"].probability, logs["parquet"].probability)
    assert logs["csv"].methods == logs["parquet"].methods


def test_some_rows_at_a_time(
    both: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Row groups bound the memory of writing and of reading."""
    monkeypatch.setattr(parquet, "ROWS", 100)
    shutil.copytree(both["csv"], tmp_path / "pan")
    table = tmp_path / "pan" / "estimates.csv"
    rows = table.read_text(encoding="utf-8").count("\n") - 1
    parquet.convert(table, table.with_suffix(".parquet"))
    file = pq.ParquetFile(table.with_suffix(".parquet"))
    assert file.num_row_groups == -(-rows // 100)
    assert not table.exists()
    landmarks = load_landmarks("basin")
    parts = list(estimate_tables(table.with_suffix(".parquet"), landmarks, 70))
    assert [first for first, _ in parts] == list(range(0, rows, 70))
    scores = np.concatenate([part["score"] for _, part in parts])
    assert np.array_equal(scores, read_log(both["csv"]).score)


def test_a_run_that_is_stopped_leaves_csv(tmp_path: Path) -> None:
    folder, run = tmp_path / "log", {"input": {}}
    with ResultsWriter(folder, load_landmarks("basin"), run, parquet=True) as writer:
        writer.write(FrameResult(index=0, timestamp_ns=0, candidates=0, tracks=0, estimates=()))
    part = part_of(folder)
    assert estimates_of(part).name == "estimates.csv"
    assert not list(part.glob("*.parquet"))
    assert len(read_results(part).frames) == 1


@pytest.mark.parametrize(
    "changed",
    [
        lambda table: table.set_index("frame"),
        lambda table: table.assign(
            object=table["object"].astype("Int64").where(table["object"] > 0)
        ),
        lambda table: table.assign(declared=table["declared"].astype("boolean")),
        lambda table: table.assign(method=table["method"].astype("category")),
        lambda table: table.assign(range_sigma_m=table["range_sigma_m"].astype(str)),
    ],
    ids=["index", "blanks", "flags", "categories", "nan as text"],
)
def test_parquet_of_other_programs(both: dict[str, Path], tmp_path: Path, changed: Any) -> None:
    """As pandas writes it: its columns are those of the CSV, whatever pandas notes beside them.

    polars makes text of a column of estimates.csv whose first 100 cells are nan.
    """
    table = changed(pd.read_csv(both["csv"] / "estimates.csv"))
    shutil.copytree(both["csv"], tmp_path / "pan")
    (tmp_path / "pan" / "estimates.csv").unlink()
    table.to_parquet(tmp_path / "pan" / "estimates.parquet")
    expected, found = read_log(both["csv"]), read_log(tmp_path / "pan")
    assert found.methods == expected.methods
    for name in ("method", "frame_index", "landmark_index", "score", "declared", "position"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_damaged_parquet_is_one_line(both: dict[str, Path], tmp_path: Path) -> None:
    shutil.copytree(both["parquet"], tmp_path / "pan")
    table = tmp_path / "pan" / "estimates.parquet"
    for data in (table.read_bytes()[:-200], b"", b"PAR1" * 10):
        table.write_bytes(data)
        told = sonarrec("evaluate", tmp_path / "pan", "--ground-truth", TRUTH, code=1)
        assert told.stderr.startswith(f"sonarrec: {table}: not a readable Parquet table (")
        assert told.stderr.count("\n") == 1


def test_without_pyarrow(
    both: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(SonarrecError, match=r"pip install 'sonarrec\[parquet\]'"):
        read_log(both["parquet"])
    told = sonarrec("run", SAMPLE, "--tables", "parquet", "-o", tmp_path, code=1)
    assert "pip install 'sonarrec[parquet]'" in told.stderr
    assert not list(tmp_path.iterdir())
    assert len(read_log(both["csv"]).score)
