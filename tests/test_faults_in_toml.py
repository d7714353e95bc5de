"""A fault in a TOML that a user writes has one exit code, whatever the file and the command: 2
where it is the call's or the only log's; among several logs it costs that log (3)."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.support.command import SAMPLE, sample_log, sonarrec

LOG = "dives/pan"
FAULTS = {"no TOML": "a = \n", "an unknown key": "nonesuch = 1\n", "a wrong type": "config = 'x'\n"}

# Files beside the log, or that the command names: (the file, the command, what follows).
FILES = [
    *((f"{LOG}/sonar.toml", "run", LOG), ("x.toml", "simulate", "--scene", "x.toml", "-o", "made")),
    *(("dives/sonar.toml", "run", LOG), ("dives/pan.sonar.toml", "info", LOG)),
    *((f"{LOG}/sonar.toml", "info", LOG), (f"{LOG}/sonar.toml", "info", "--json", LOG)),
    (f"{LOG}/sonar.toml", "truth", "check", f"{LOG}/gt.csv", LOG),
    (f"{LOG}/sonar.toml", "calibrate", LOG, "-o", "m.toml"),
    (f"{LOG}/sonar.toml", "overlay", LOG, "done/pan", "-o", "o.mp4"),
    (f"{LOG}/sonar.toml", "check"),
    *((f"{LOG}/landmarks.toml", "run", LOG), ("dives/landmarks.toml", "run", LOG)),
    (f"{LOG}/landmarks.toml", "calibrate", LOG, "-o", "m.toml"),
    (f"{LOG}/landmarks.toml", "truth", "check", f"{LOG}/gt.csv", LOG),
    ("x.toml", "run", LOG, "--sonar", "x.toml"),
    ("x.toml", "info", LOG, "--sonar", "x.toml"),
    ("x.toml", "evaluate", "done/pan", "--sonar", "x.toml"),
    ("x.toml", "map", "done/pan", "--sonar", "x.toml"),
    ("x.toml", "report", "done/pan", "--sonar", "x.toml"),
    *(("x.toml", command, "done/pan", "--landmarks", "x.toml") for command in ("evaluate", "map")),
    ("x.toml", "report", "done/pan", "--landmarks", "x.toml"),
    ("x.toml", "run", LOG, "--landmarks", "x.toml"),
    ("x.toml", "landmarks", "x.toml"),
    ("x.toml", "run", LOG, "--config", "x.toml"),
    ("x.toml", "config", "--config", "x.toml"),
    ("x.toml", "calibrate", LOG, "-o", "m.toml", "--config", "x.toml"),
    ("x.toml", "run", LOG, "--model", "x.toml"),
    ("x.toml", "check", "x.toml"),
]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two logs of three frames with their truth, and the results of one."""
    folder = tmp_path_factory.mktemp("site")
    for name in ("pan", "other"):
        log = sample_log(folder / "dives" / name, 3)
        shutil.copy(SAMPLE / "gt.csv", log)
    sonarrec("run", folder / LOG, "-o", folder / "done", "-q")
    (folder / "sonarrec.check.toml").write_text(f'[[log]]\npath = "{LOG}"\n')
    shutil.copytree(folder / "done/pan", folder / "sonarrec.check/pan")  # on record
    return folder


@pytest.fixture
def place(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(site, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


CASES = [
    pytest.param(file, words, fault, marks=[pytest.mark.slow] * ((n + k) % 3 > 0))
    for n, (file, *words) in enumerate(FILES)
    for k, fault in enumerate(FAULTS)
]
"""One fault in each of the FILES is quick; of a kind of file the commands differ in theirs."""


@pytest.mark.parametrize(("file", "words", "fault"), CASES)
def test_a_fault_is_bad_usage(file: str, words: list[str], fault: str, place: Path) -> None:
    if file in ("dives/sonar.toml", "dives/pan.sonar.toml"):  # else that in the log is read
        (place / LOG / "sonar.toml").unlink()
    Path(file).write_text(FAULTS[fault])
    before = sorted(place.rglob("*"))
    told = sonarrec(*words, code=2).stderr
    assert told.startswith("sonarrec: ")
    assert Path(file).name in told
    assert told.count("\n") == 1
    assert sorted(place.rglob("*")) == before


@pytest.mark.parametrize(
    "text",
    ["tilt_degg = 20", "tilt_deg = '20'", "tilt_deg = nan", "tilt_deg = 95", "tilt_deg = 2,5"],
)
@pytest.mark.parametrize("command", ["run", "info"])
def test_so_is_one_in_a_key_of_the_geometry(command: str, text: str, place: Path) -> None:
    with (place / LOG / "sonar.toml").open("r+") as file:
        lines = [line for line in file if not line.startswith("tilt_deg")]
        file.seek(0)
        file.writelines([*lines, text, "\n"])
    told = sonarrec(command, LOG, code=2).stderr
    assert told.startswith(f"sonarrec: {LOG}/sonar.toml: ")
    assert told.count("\n") == 1


@pytest.mark.parametrize("file", ["sonar.toml", "landmarks.toml"])
def test_among_several_logs_it_costs_that_log(file: str, place: Path) -> None:
    (place / LOG / file).write_text(FAULTS["an unknown key"])
    sonarrec("run", LOG, "--dry-run", code=2)
    told = sonarrec("run", LOG, "dives/other", "-j", "1", "-q", code=3).stderr
    assert f"{LOG}/{file}" in told
    assert (place / "sonarrec_out/other/estimates.csv").is_file()
    assert not (place / "sonarrec_out/pan").exists()
    sonarrec("run", LOG, "dives/other", "--dry-run", code=3)
    check = "".join(f'[[log]]\npath = "{log}"\n' for log in (LOG, "dives/other"))
    (place / "sonarrec.check.toml").write_text(check)
    shutil.copytree("done/pan", "sonarrec.check/other")
    sonarrec("check", code=3)
    if file == "sonar.toml":
        logs = json.loads(sonarrec("info", "--json", LOG, "dives/other", code=3).stdout)["logs"]
        assert ["error" in log for log in logs] == [True, False]


def test_one_that_all_logs_share_is_bad_usage(place: Path) -> None:
    for log in (LOG, "dives/other"):
        (place / log / "sonar.toml").unlink()
    (place / "dives/sonar.toml").write_text(FAULTS["no TOML"])
    sonarrec("run", "dives", "-j", "1", code=2)
    sonarrec("info", "dives", code=2)


@pytest.mark.parametrize("part", ["sonar", "landmarks", "model"])
def test_so_is_one_in_the_run_toml_of_an_earlier_run(part: str, place: Path) -> None:
    text = (place / "done/pan/run.toml").read_text()
    text = text.replace(f"[{part}]\n", f"[{part}]\nname = 3\nrange_min_m = 'x'\n", 1)
    Path("x.toml").write_text(text if f"[{part}]" in text else f"{text}[{part}]\nname = 3\n")
    told = sonarrec("run", LOG, "--config", "x.toml", code=2).stderr
    assert told.startswith("sonarrec: x.toml: ")
