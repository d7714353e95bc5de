"""`run`, `info`, `evaluate` and `report` with logs and results on a server that speaks S3."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from sonarrec.cli import main
from sonarrec.remote import store
from sonarrec.remote.find import find
from tests.support.logs import cdr_image, frames, image_folder, mcap_file
from tests.support.servers import web_server

Sonarrec = Callable[..., Result]
TABLES = ("estimates.csv", "frames.csv", "run.toml", "sightings.csv")


@pytest.fixture
def sonarrec(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sonarrec:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")

    def invoke(*words: str) -> Result:
        result = CliRunner().invoke(main, [*words, "--cache", str(tmp_path / "cache")])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        assert "Traceback" not in result.stderr
        said = [line for line in result.output.splitlines() if "; the results are in " not in line]
        assert str(tmp_path / "cache") not in "".join(said)
        return result

    return invoke


def small_mcap(path: Path, count: int = 6, seed: int = 0) -> Path:
    images = frames(count, seed=seed)
    return mcap_file(path, [("/s", k * 10**8, cdr_image(i)) for k, i in enumerate(images)])


def upload(s3: Any, path: Path, key: str) -> None:
    s3.upload_file(str(path), "dives", key)


def keys(s3: Any) -> list[str]:
    return [one["Key"] for one in s3.list_objects_v2(Bucket="dives").get("Contents", [])]


@pytest.fixture
def day(tmp_path: Path, s3: Any) -> Path:
    """A local folder and the same at s3://dives/day: two MCAP files and their sonar.toml."""
    for n, name in enumerate(("a.mcap", "b.mcap")):
        upload(s3, small_mcap(tmp_path / "day" / name, seed=n), f"day/{name}")
    upload(s3, tmp_path / "day" / "sonar.toml", "day/sonar.toml")
    return tmp_path / "day"


@pytest.mark.usefixtures("s3")
def test_results_are_those_of_the_local_log(sonarrec: Sonarrec, day: Path) -> None:
    assert sonarrec("run", str(day / "a.mcap"), "-o", "local").exit_code == 0
    assert sonarrec("run", "s3://dives/day/*.mcap", "-o", "far").exit_code == 0
    for table in ("estimates.csv", "frames.csv"):
        assert Path("far/a", table).read_bytes() == Path("local/a", table).read_bytes()
    far, local = (tomllib.loads(Path(o, "a/run.toml").read_text()) for o in ("far", "local"))
    for key in ("path", "place"):
        assert far["input"].pop(key) == "s3://dives/day/a.mcap"
        local["input"].pop(key)
    assert far == local
    again = sonarrec("run", "s3://dives/day/", "-o", "far")
    assert again.stdout.splitlines()[-1] == "2 up to date"


ODD = ("a [1]", "a*", "a?b", "a%20b", "a#b", "ä;b&c=d")


@pytest.mark.slow
def test_names_with_wildcards_are_names(sonarrec: Sonarrec, s3: Any, day: Path) -> None:
    for name in ODD:
        upload(s3, day / "a.mcap", f"day/{name}.mcap")
    names = {f"s3://dives/day/{name}.mcap" for name in ("a", "b", *ODD)}
    assert {log.url.redacted for log in find("s3://dives/day/")} == names
    assert {log.url.redacted for log in find("s3://dives/day/*.mcap")} == names
    for name in ODD:
        assert [log.name for log in find(f"s3://dives/day/{name}.mcap")] == [name]
    far = sonarrec("run", "s3://dives/day/", "--frames", ":2", "-q")
    assert far.exit_code == 0, far.stderr
    assert {p.name for p in Path("sonarrec_out").iterdir()} == {"a", "b", *ODD, "logs.csv"}
    upload(s3, day / "a.mcap", "day [2]/c.mcap")
    assert [log.name for log in find("s3://dives/day [2]/")] == ["c"]


@pytest.mark.usefixtures("day")
def test_one_that_fails_costs_itself_only(sonarrec: Sonarrec) -> None:
    names = [f"s3://dives/day/{n}.mcap" for n in ("a", "none", "b")]
    result = sonarrec("run", *names, "-q")
    assert result.exit_code == 3
    assert [line for line in result.stderr.splitlines() if "note: " not in line] == [
        "sonarrec: s3://dives/day/none.mcap: does not exist",
        "2 done, 1 failed: s3://dives/day/none.mcap",
    ]
    assert sonarrec("run", "s3://dives/day/none.mcap").exit_code == 2  # as of a local one


def test_faults_name_the_server(sonarrec: Sonarrec, s3: Any, day: Path) -> None:
    (day / "cut.mcap").write_bytes((day / "a.mcap").read_bytes()[:9000])
    (day / "bad.sonar.toml").write_text("[sonar]\nlayout = 7\n")
    upload(s3, day / "cut.mcap", "day/cut.mcap")
    upload(s3, day / "a.mcap", "day/bad.mcap")
    upload(s3, day / "bad.sonar.toml", "day/bad.sonar.toml")
    result = sonarrec("run", "s3://dives/day/cut.mcap", "s3://dives/day/bad.mcap")
    assert result.exit_code == 3
    assert "s3://dives/day/bad.sonar.toml: " in result.stderr
    assert "cache" not in Path("sonarrec_out/cut/run.toml").read_text()


@pytest.mark.slow
def test_results_go_to_a_server_and_are_up_to_date_there(
    sonarrec: Sonarrec, s3: Any, day: Path, tmp_path: Path
) -> None:
    out = ["-o", "s3://dives/out"]
    result = sonarrec("run", str(day / "a.mcap"), "s3://dives/day/b.mcap", *out)
    assert result.exit_code == 0
    assert "s3://dives/out/a: 6 frames" in result.stdout
    assert keys(s3)[3:] == [*(f"out/{log}/{t}" for log in "ab" for t in TABLES), "out/logs.csv"]
    status = sonarrec("status", "s3://dives/out")
    assert status.stdout.startswith("2 logs: 2 done\n12 frames, ")
    assert not list((tmp_path / "cache" / "out").rglob("estimates.csv"))
    assert sonarrec("run", str(day / "a.mcap"), *out).stdout == (
        "s3://dives/out/a: up to date, 6 frames\n"
    )
    replaced = sonarrec("run", str(day / "a.mcap"), "--seed", "1", *out)
    assert (
        "s3://dives/out/a: earlier results are replaced (other settings: seed)" in replaced.stderr
    )
    table = s3.get_object(Bucket="dives", Key="out/a/run.toml")["Body"].read().decode()
    assert tomllib.loads(table)["config"]["seed"] == 1
    small_mcap(tmp_path / "other" / "a.mcap", seed=7)
    other = sonarrec("run", str(tmp_path / "other" / "a.mcap"), *out)
    assert other.exit_code == 1
    assert "s3://dives/out/a: holds the results of another log" in other.stderr


@pytest.mark.slow
def test_what_was_made_from_replaced_results_goes_and_the_users_files_stay(
    sonarrec: Sonarrec, s3: Any, day: Path
) -> None:
    run = ["run", str(day / "a.mcap"), "--frames", ":1", "-o", "s3://dives/out", "-q"]
    assert sonarrec(*run).exit_code == 0
    ours = {"evaluation/roc.csv": "", "map/map.csv": "", "report.html": ""}
    ours["report.html"] = "<!doctype html><title>a: sonarrec report</title>"
    mine = {"map/notes.txt": "", "compare.html": "<!doctype html>mine"}
    for name, text in (ours | mine).items():
        s3.put_object(Bucket="dives", Key=f"out/a/{name}", Body=text.encode())
    assert sonarrec(*run, "--seed", "1").exit_code == 0
    there = {key.removeprefix("out/a/") for key in keys(s3) if key.startswith("out/a/")}
    assert there == {*TABLES, *mine}


@pytest.mark.slow
def test_a_partial_upload_is_no_result_and_is_finished_by_the_next_run(
    sonarrec: Sonarrec, s3: Any, day: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = ["run", str(day / "a.mcap"), "-o", "s3://dives/out"]
    assert sonarrec(*run).exit_code == 0
    put = store.Store.put

    def breaks(self: store.Store, file: Path, url: Any) -> None:
        if url.name == "frames.csv":
            raise store.SonarrecError(f"{url.redacted}: failed, also in 3 retries")
        put(self, file, url)

    with monkeypatch.context() as patched:
        patched.setattr(store.Store, "put", breaks)
        result = sonarrec(*run, "--seed", "1")
    assert result.exit_code == 1
    (waits,) = (tmp_path / "cache" / "out").glob("*/a")
    assert f"the results are in {waits}; the same command uploads them" in result.stderr
    assert "out/a/run.toml" not in keys(s3)  # the old results are not taken for the new ones
    (day / "gt.csv").write_text("frame,landmark,range_m,bearing_deg\n0,1,2.0,0.0\n")
    truth = ["--ground-truth", str(day / "gt.csv")]
    told = sonarrec("evaluate", "s3://dives/out/a", *truth)
    assert told.exit_code == 1
    assert "s3://dives/out/a: left out because its upload is not finished" in told.stderr
    again = sonarrec(*run, "--seed", "1")
    assert again.stdout == "s3://dives/out/a: up to date, 6 frames\n"
    assert [k for k in keys(s3) if k.startswith("out/a/")] == [f"out/a/{t}" for t in TABLES]
    assert not waits.exists()


@pytest.mark.slow
@pytest.mark.usefixtures("day")
def test_evaluate_and_report_read_results_there_and_put_theirs_beside(
    sonarrec: Sonarrec, s3: Any, tmp_path: Path
) -> None:
    for log, tables in (("a", "csv"), ("b", "parquet")):
        words = [f"s3://dives/day/{log}.mcap", "-o", "s3://dives/out", "--tables", tables]
        assert sonarrec("run", *words).exit_code == 0
    truth = tmp_path / "gt.csv"
    rows = [f"{log},{k},1,2.0,0.0" for log in "ab" for k in range(6)]
    truth.write_text("\n".join(["log,frame,landmark,range_m,bearing_deg", *rows]) + "\n")
    upload(s3, truth, "gt.csv")
    scored = sonarrec("evaluate", "s3://dives/out", "--ground-truth", "s3://dives/gt.csv")
    assert scored.exit_code == 0, scored.stderr
    assert "s3://dives/out/evaluation: confusion.csv" in scored.stdout
    assert "out/evaluation/evaluation.json" in keys(s3)
    page = sonarrec(
        "report",
        "s3://dives/out",
        *("--ground-truth", "s3://dives/gt.csv", "--log", "s3://dives/day/a.mcap"),
    )
    assert page.exit_code == 0, page.stderr
    assert page.stdout.startswith("s3://dives/out/report.html: ")
    for key in ("report.html", "evaluation/evaluation.json"):
        text = s3.get_object(Bucket="dives", Key=f"out/{key}")["Body"].read().decode()
        assert str(tmp_path) not in text
    s3.delete_object(Bucket="dives", Key="out/b/run.toml")
    partly = sonarrec("report", "s3://dives/out", "-o", "page.html")
    assert partly.exit_code == 3
    assert "s3://dives/out/b: left out" in partly.stderr
    assert Path("page.html").exists()


def write_truth(path: Path, frames: int = 6) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [f"{k},1,2.0,0.0" for k in range(frames)]
    path.write_text("\n".join(["frame,landmark,range_m,bearing_deg", *rows]) + "\n")
    return path


def positives(evaluation: Path) -> int:
    return int(json.loads((evaluation / "evaluation.json").read_text())["positives"])


@pytest.mark.slow
@pytest.mark.parametrize("out", ["here", "s3://dives/out"])
@pytest.mark.usefixtures("day")
def test_evaluate_finds_the_truth_beside_a_log_on_a_server(
    sonarrec: Sonarrec, s3: Any, tmp_path: Path, out: str
) -> None:
    upload(s3, write_truth(tmp_path / "own.csv", 4), "day/a.gt.csv")
    upload(s3, write_truth(tmp_path / "all.csv", 2), "day/gt.csv")
    assert sonarrec("run", "s3://dives/day/*.mcap", "-o", out, "-q").exit_code == 0
    found = sonarrec("evaluate", out, "-o", "found")
    assert found.exit_code == 0, found.stderr
    for name, truth in (("a", "a.gt.csv"), ("b", "gt.csv")):
        told = f"note: {out}/{name}: ground truth s3://dives/day/{truth}, beside its log"
        assert told in found.stdout.splitlines()
    assert "s3://dives/day/a.gt.csv" in Path("found/evaluation.json").read_text()
    assert str(tmp_path) not in Path("found/evaluation.json").read_text()
    assert positives(Path("found")) == 4 + 2
    given = sonarrec("evaluate", f"{out}/a", "--ground-truth", str(tmp_path / "own.csv"), "-o", "g")
    assert given.exit_code == 0
    each = sonarrec("evaluate", f"{out}/a", "-o", "each")
    assert each.exit_code == 0
    for name in ("confusion.csv", "per_log.csv", "passes.csv", "figures.csv"):
        assert Path("each", name).read_bytes() == Path("g", name).read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("day")
def test_of_a_log_on_a_server_without_truth_or_that_changed_a_line_says_so(
    sonarrec: Sonarrec, s3: Any, tmp_path: Path
) -> None:
    upload(s3, write_truth(tmp_path / "own.csv"), "day/a.gt.csv")
    assert sonarrec("run", "s3://dives/day/*.mcap", "-q").exit_code == 0
    without = (
        "sonarrec_out/b: no ground truth: no b.gt.csv, nor gt.csv beside s3://dives/day/b.mcap"
    )
    partly = sonarrec("evaluate")
    assert partly.exit_code == 3
    assert partly.stderr == f"sonarrec: {without}; not scored\n"
    alone = sonarrec("evaluate", "sonarrec_out/b")
    assert alone.exit_code == 2
    assert alone.stderr == f"sonarrec: {without}; give --ground-truth, or --pairs\n"
    upload(s3, small_mcap(tmp_path / "longer.mcap", 9), "day/a.mcap")
    changed = sonarrec("evaluate", "sonarrec_out/a")
    assert changed.exit_code == 2
    assert "s3://dives/day/a.mcap has changed since the run (it had " in changed.stderr
    s3.delete_object(Bucket="dives", Key="day/a.mcap")
    assert "s3://dives/day/a.mcap: does not exist" in sonarrec("evaluate", "sonarrec_out/a").stderr


def test_truth_of_a_web_server_is_asked_for_by_its_name(sonarrec: Sonarrec, tmp_path: Path) -> None:
    """Of a file without any index page; of a folder of images it is the one inside."""
    site = tmp_path / "site"
    small_mcap(site / "a.mcap")
    image_folder(site / "pings", frames(3))
    write_truth(site / "a.gt.csv", 5)
    write_truth(site / "pings" / "gt.csv", 3)
    with web_server(site) as web:
        assert sonarrec("run", f"{web.url}/a.mcap", f"{web.url}/pings/", "-q").exit_code == 0
        web.asked.clear()
        done = sonarrec("evaluate")
        assert done.exit_code == 0, done.stderr
        assert f"sonarrec_out/a: ground truth {web.url}/a.gt.csv, beside its log" in done.stdout
        assert f"{web.url}/pings/gt.csv, beside its log" in done.stdout
        got = {path for method, path, _ in web.asked if method == "GET"}
        assert {"/a.gt.csv", "/pings/gt.csv"} <= got
        assert not [path for path in got if path == "/" or path.endswith((".mcap", ".png"))]
    assert positives(Path("sonarrec_out/evaluation")) == 5 + 3


def test_json_has_the_sightings_that_were_uploaded(
    sonarrec: Sonarrec, day: Path, tmp_path: Path
) -> None:
    there = sonarrec("run", str(day / "a.mcap"), "-o", "s3://dives/out", "--json")
    here = sonarrec("run", str(day / "a.mcap"), "-o", str(tmp_path / "out"), "--json")
    (far,), (near,) = (json.loads(told.stdout)["logs"] for told in (there, here))
    assert far.pop("folder") == "s3://dives/out/a"
    near.pop("folder")
    assert far == near


@pytest.mark.slow
def test_a_dry_run_uploads_nothing(sonarrec: Sonarrec, s3: Any, day: Path) -> None:
    run = ["run", str(day / "a.mcap"), "s3://dives/day/b.mcap", "-o", "s3://dives/out"]
    before = keys(s3)
    told = sonarrec(*run, "--dry-run")
    assert told.stdout.splitlines() == [f"{day}/a.mcap: new", "s3://dives/day/b.mcap: new"]
    assert keys(s3) == before
    assert sonarrec(*run, "-q").exit_code == 0
    assert {
        line.rpartition(": ")[2] for line in sonarrec(*run, "--dry-run").stdout.splitlines()
    } == {"up to date"}
    failed = sonarrec(*run, "--retry-failed")
    assert failed.stderr == "nothing to do\n"


@pytest.mark.usefixtures("day")
def test_info_tells_of_a_log_there(sonarrec: Sonarrec) -> None:
    told = sonarrec("info", "s3://dives/day/a.mcap", "s3://dives/day/none.mcap")
    assert told.exit_code == 3
    assert told.stdout.startswith("s3://dives/day/a.mcap: MCAP")
    assert "s3://dives/day/sonar.toml" in told.stdout
    assert told.stderr == "sonarrec: s3://dives/day/none.mcap: does not exist\n"


@pytest.mark.usefixtures("day")
def test_without_credentials_a_line_says_so(
    sonarrec: Sonarrec, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    monkeypatch.setenv("HOME", "/nonexistent")
    monkeypatch.setattr(store.fsspec.AbstractFileSystem, "cachable", False)
    result = sonarrec("run", "s3://dives/day/a.mcap")
    assert result.exit_code == 1
    assert "no access (Unable to locate credentials)" in result.stderr
    assert "sonarrec help remote" in result.stderr


def test_a_web_server_takes_no_results(sonarrec: Sonarrec, tmp_path: Path) -> None:
    image_folder(tmp_path / "pings", frames(3))
    result = sonarrec("run", str(tmp_path / "pings"), "-o", "https://host/out")
    assert result.exit_code == 2
    assert "https://host/out: results cannot be written to a web server" in result.stderr


def test_without_the_extra_a_line_says_what_to_install(
    sonarrec: Sonarrec, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "fsspec", None)
    result = sonarrec("run", "s3://dives/a.mcap")
    assert result.exit_code == 1
    assert result.stderr == (
        "sonarrec: s3://dives/a.mcap: fsspec is not installed; pip install 'sonarrec[remote]'\n"
    )


@pytest.mark.slow
def test_no_network_library_is_loaded_for_local_logs(tmp_path: Path) -> None:
    log = small_mcap(tmp_path / "a.mcap", 3)
    program = (
        "import sys; from sonarrec.cli import main; "
        f"main(['run', {str(log)!r}, '-o', {str(tmp_path / 'out')!r}], standalone_mode=False); "
        "print(sorted({'fsspec', 'aiohttp', 's3fs', 'botocore', 'asyncssh'}"
        " & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"
