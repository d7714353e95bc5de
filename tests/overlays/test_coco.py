"""`sonarrec export --to coco`: a box per declared claim, with its score."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.support.command import SAMPLE, sample_log, sonarrec
from tests.support.rows import read_rows

RECORD = SAMPLE.parent / "regression"


Box = tuple[str, str, float, str | None]


def boxes(path: Path) -> tuple[list[Box], list[str]]:
    """((frame's image, label, score, track) of each box; the names of images)."""
    document = json.loads(path.read_text())
    images = {one["id"]: one["file_name"] for one in document["images"]}
    labels = {one["id"]: one["name"] for one in document["categories"]}
    found = []
    for one in document["annotations"]:
        image, label = images[one["image_id"]], labels[one["category_id"]]
        found.append((image, label, one["score"], one["attributes"].get("track")))
    return found, [*images.values()]


def declared(results: Path, method: str = "framework") -> list[dict[str, str]]:
    rows = read_rows(results / "estimates.csv")
    return [row for row in rows if row["method"] == method and row["declared"] == "1"]


@pytest.mark.parametrize("log", ["pan", "polar"])
@pytest.mark.parametrize("method", ["framework", "smi"])
def test_each_declared_claim_is_a_box(tmp_path: Path, log: str, method: str) -> None:
    out = tmp_path / "coco.json"
    sonarrec("export", RECORD / log, "--to", "coco", "--method", method, "-o", out)
    found, images = boxes(out)
    assert len(images) == len(read_rows(RECORD / log / "frames.csv"))
    expected = []
    for row in declared(RECORD / log, method):
        track = row["object"] if method == "framework" else None
        box = (images[int(row["frame"])], f"ID.{row['landmark']}", float(row["score"]), track)
        expected.append(box)
    assert found == expected
    assert len(found) > 20


def test_the_claims_of_a_run_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read as truth they are unchecked proposals; without the log, images are numbered."""
    monkeypatch.chdir(tmp_path)
    log = sample_log(Path("dive"), 24)
    for file in log.glob("*.png"):
        file.rename(log / f"ping_{2 * int(file.stem) + 5}.png")
    sonarrec("run", log, "-q")
    sonarrec("export")
    found, images = boxes(Path("coco.json"))
    assert images == [f"ping_{2 * n + 5}.png" for n in range(24)]
    told = sonarrec("truth", "convert", "coco.json", "--log", log)
    assert f"{len(found)} row" in told.stdout
    claims = declared(Path("sonarrec_out/dive"))
    estimates = {(row["frame"], row["landmark"]): row for row in claims}
    rows = read_rows(Path("gt.csv"))
    assert len(rows) == len(estimates) == len(found) > 0
    for row in rows:
        claim = estimates[row["frame"], row["landmark"]]
        for name in ("x_px", "y_px", "orientation_deg"):
            assert float(row[name]) == pytest.approx(float(claim[name]), abs=0.006)
        assert (row["track"], row["source"]) == (claim["object"], "tracked")
    sonarrec("export", code=1)  # the file is there
    shutil.rmtree(log)
    told = sonarrec("export", "-o", "numbered.json")
    assert "note: " in told.stderr
    again, images = boxes(Path("numbered.json"))
    assert images == [f"dive_{n:06d}.png" for n in range(24)]
    assert [one[1:] for one in again] == [one[1:] for one in found]
    sonarrec("truth", "convert", "numbered.json", "-o", "again.csv")
    assert Path("again.csv").read_bytes() == Path("gt.csv").read_bytes()


def test_several_logs_have_a_file_each_and_a_fault_costs_its_own(tmp_path: Path) -> None:
    results = tmp_path / "results"
    for log in ("pan", "polar", "faint"):
        shutil.copytree(RECORD / log, results / log)
    (results / "faint" / "run.toml").unlink()  # no geometry
    table = results / "polar" / "estimates.csv"
    table.write_text("\n".join(table.read_text().splitlines()[:-1]) + "\n")
    told = sonarrec("export", results, results / "pan", "-o", tmp_path / "all", code=3)
    assert sorted(path.name for path in (tmp_path / "all").iterdir()) == ["pan.json", "polar.json"]
    assert "geometry" in told.stderr
    assert "estimates.csv holds" in told.stderr
    assert "geometry" in sonarrec("export", results / "faint", code=1).stderr
    sonarrec("export", results / "pan", "--method", "none", code=2)
