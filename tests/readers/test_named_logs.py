"""Which logs a command's arguments name, and what lies beside them."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.readers.named_logs import log_arguments, logs_named
from sonarrec.readers.open import companion, find_log
from sonarrec.runs.one import result_names
from tests.support.bags import bag, messages, split_bag
from tests.support.command import SAMPLE, sonarrec
from tests.support.locked import locked
from tests.support.logs import SONAR_TOML, frames, image_folder, image_mcap
from tests.support.rows import read_rows

IMAGES = frames(3)


def recording(path: Path) -> Path:
    image_mcap(path, IMAGES)
    (path.parent / "sonar.toml").unlink()
    return path


@pytest.fixture
def campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    top = Path("campaign")
    for name in ("dive10.mcap", "dive2.mcap", "day1/a.mcap", "day2/a.mcap"):
        recording(top / name)
    bag(top / "day1" / "rosbag2_x", messages(IMAGES))
    split_bag(top / "day2" / "long", [messages(IMAGES)[:1], messages(IMAGES)[1:]])
    image_folder(top / "day2" / "pings", IMAGES)
    (top / "day1" / "notes.txt").write_text("no log")
    for results in (top / "sonarrec_out" / "old", top / "day1" / ".hidden"):
        image_folder(results, IMAGES)
    (top / "sonarrec_out" / "old" / "frames.csv").touch()
    return top


def named(*words: str, recursive: bool = False) -> list[str]:
    return [
        str(Path(log.path).relative_to("campaign"))
        for word in words
        for log in logs_named(word, recursive=recursive)
    ]


@pytest.mark.usefixtures("campaign")
def test_folders_globs_and_lists() -> None:
    assert named("campaign") == ["dive2.mcap", "dive10.mcap"]
    assert named("campaign/day1") == ["day1/a.mcap", "day1/rosbag2_x"]
    everything = [
        "day1/a.mcap", "day1/rosbag2_x", "day2/a.mcap", "day2/long", "day2/pings", "dive2.mcap",
        "dive10.mcap",
    ]  # fmt: skip
    assert named("campaign", recursive=True) == everything
    # The parts of a bag stand for the bag.
    assert named("campaign/**/*.mcap") == [e for e in everything if e.count("rosbag") == 0
                                           and "pings" not in e]  # fmt: skip
    assert named("campaign/day2/*") == ["day2/a.mcap", "day2/long", "day2/pings"]
    assert named("campaign/day2/long") == ["day2/long"]
    assert named("campaign/day2/long/long_1.mcap") == ["day2/long/long_1.mcap"]
    assert named("campaign/day2/pings") == ["day2/pings"]
    Path("campaign/day2").rename("campaign/day [2]")
    assert named("campaign/day [2]/*") == [f"day [2]/{log}" for log in ("a.mcap", "long", "pings")]
    assert len(find_log("campaign/day [2]/pings/*.png").files) == len(IMAGES)
    lines = ["# dives\n", "\n", "  'campaign/day1'\n", '"campaign/dive2.mcap"']
    assert log_arguments(["campaign/dive10.mcap"], lines) == [
        "campaign/dive10.mcap", "campaign/day1", "campaign/dive2.mcap",
    ]  # fmt: skip
    with pytest.raises(UsageError, match="--from-file"):
        log_arguments([], ["# nothing"])
    with pytest.raises(UsageError, match="2 images"):
        log_arguments([str(SAMPLE / f"00000{n}.png") for n in (0, 1)], [])
    assert "--from-file LIST" in sonarrec("run", code=2).stderr


@pytest.mark.parametrize("name", ["frames.csv", "evaluation.json", "map.csv"])
def test_pictures_of_results_are_no_log(name: str, campaign: Path) -> None:
    everything = named("campaign", recursive=True)
    image_folder(campaign / "day1" / "results", IMAGES)
    assert "day1/results" in named("campaign", recursive=True)
    (campaign / "day1" / "results" / name).touch()
    assert named("campaign", recursive=True) == everything
    assert "day1/results" not in named("campaign/day1/*")


def test_linked_folders(campaign: Path) -> None:
    """They are followed after the folders beside them, and circles end."""
    everything = named("campaign", recursive=True)
    recording(campaign.parent / "disk" / "deep" / "b.mcap")
    (campaign.parent / "disk" / "again").symlink_to("deep")
    (campaign.parent / "disk" / "back").symlink_to(Path("..", "campaign"))
    for link in (
        *("day1/far ../../disk", "all ../disk", "day0 day2", "up ..", "self ."),
        "day1/hidden .hidden",
    ):
        name, to = link.split()
        (campaign / name).symlink_to(to)
    found = named("campaign", recursive=True)
    assert sorted(found) == sorted([*everything, "day1/far/deep/b.mcap", "day1/hidden"])


def test_images_and_logs_in_one_folder(campaign: Path) -> None:
    shutil.copy(SAMPLE / "000000.png", campaign / "map.png")
    told = sonarrec("run", campaign, code=2).stderr
    assert "logs (2, dive2.mcap" in told
    assert "'campaign/*.png' or 'campaign/*.mcap'" in told
    assert named("campaign/*.mcap") == ["dive2.mcap", "dive10.mcap"]
    (campaign / "map.png").unlink()
    with pytest.raises(SonarrecError, match="folder of 2 logs"):
        find_log(campaign)


@pytest.mark.parametrize("words", ["campaign --recursive", "campaign/*"])
def test_a_folder_that_cannot_be_read_costs_its_own_logs(words: str, campaign: Path) -> None:
    for name in ("day1", "day2", "sonarrec_out"):
        shutil.rmtree(campaign / name)
    (campaign / "sonar.toml").write_text(SONAR_TOML)
    recording(campaign / "locked" / "a.mcap")
    with locked(campaign / "locked"):
        told = sonarrec("run", *words.split(), "-j", "1", code=3)
    assert all(name in told.stdout for name in ("dive2", "dive10"))
    line = r"^sonarrec: campaign/locked(/a\.mcap)?: .*Permission denied"
    assert len(re.findall(line, told.stderr, re.MULTILINE)) == 2  # as it ends, and below the table


def test_a_list_from_standard_input(campaign: Path) -> None:
    (campaign / "sonar.toml").write_text(SONAR_TOML)
    told = sonarrec("run", "--from-file", "-", "-o", "out", input="# all\ncampaign\n\n")
    assert "2 done" in told.stdout


@pytest.mark.slow
def test_poses_beside_a_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("pan.mcap", "pan.sonar.toml"):
        shutil.copy(SAMPLE.parent / name, ".")
    Path("table.csv").write_text("timestamp,yaw\n0,-16\n16,16\n32,-16\n")
    log = ("pan.mcap", "--frames", ":30")
    sonarrec("run", *log, "--odometry", "table.csv", "-o", "given")
    sonarrec("run", *log, "-o", "none")
    shutil.copy("table.csv", "pan.poses.csv")
    told = sonarrec("run", *log, "-o", "found")
    assert "pan.poses.csv" in told.stderr
    again = sonarrec("run", *log, "--config", "none/pan/run.toml", "-o", "again")
    assert "poses" not in again.stderr, "a run that had none has none when it is repeated"
    outs = ("given", "found", "none", "again")
    given, found, none, repeated = (Path(o, "pan", "estimates.csv").read_bytes() for o in outs)
    assert given == found != none == repeated


def test_companions(tmp_path: Path) -> None:
    log = recording(tmp_path / "a" / "b" / "dive.mcap")
    assert companion(log, "gt.csv", tmp_path) is None
    (tmp_path / "gt.csv").touch()
    assert companion(log, "gt.csv") is None
    assert companion(log, "gt.csv", tmp_path / "a") is None
    assert companion(log, "gt.csv", tmp_path) == tmp_path / "gt.csv"
    assert companion(log, "gt.csv", tmp_path / "elsewhere") is None
    for nearer in ("a/gt.csv", "a/dive.gt.csv", "a/b/gt.csv", "a/b/dive.gt.csv"):
        (tmp_path / nearer).touch()
        assert companion(log, "gt.csv", tmp_path) == tmp_path / nearer
    folder = image_folder(tmp_path / "pings", IMAGES)
    (tmp_path / "pings.gt.csv").touch()
    assert companion(folder, "gt.csv") == tmp_path / "pings.gt.csv"
    (folder / "gt.csv").touch()
    assert companion(folder, "gt.csv") == folder / "gt.csv"
    # Beside a log's folder lies only what serves several logs.
    (folder / "sonar.toml").unlink()
    for name in ("sonar.toml", "landmarks.toml", "poses.csv"):
        (tmp_path / name).touch()
        shared = None if name == "poses.csv" else tmp_path / name
        assert companion(folder, name) == shared
    long = image_folder(tmp_path / ("n" * 250), IMAGES)  # with .gt.csv it is no file's name
    assert companion(long, "gt.csv") is None
    (long / "gt.csv").touch()
    assert companion(long, "gt.csv") == long / "gt.csv"


def test_names_of_results(campaign: Path) -> None:
    for place in ("one/bag", "two/bag"):
        bag(campaign / place, messages(IMAGES))
    (campaign / "x.y").mkdir()
    recording(campaign / "x.y" / "dive.1.mcap")
    bag(campaign / "z.1", messages(IMAGES))
    logs = ["one/bag", "two/bag/", "x.y/dive.1.mcap", "z.1", "day2/long"]
    assert result_names([campaign / log for log in logs]) == [
        "one-bag", "two-bag", "dive.1", "z.1", "long",
    ]  # fmt: skip


@pytest.mark.parametrize("given", ["dives", "dives/*.mcap", "dives/**/*.mcap"])
def test_links_to_nothing_fail(given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Passed over unsaid, its log would be missing and nobody would know."""
    monkeypatch.chdir(tmp_path)
    for name in ("a", "c"):
        recording(Path("dives", f"{name}.mcap"))
    Path("dives", "sonar.toml").write_text(SONAR_TOML, encoding="utf-8")
    Path("dives", "b.mcap").symlink_to("gone.mcap")
    Path("dives", "notes.txt").symlink_to("gone.txt")  # not of a log's ending
    assert [log.path for log in logs_named(given)] == [f"dives/{x}.mcap" for x in "abc"]
    told = sonarrec("run", given, "-j", "1", code=3)
    rows = read_rows(Path("sonarrec_out", "logs.csv"))
    assert [(row["log"], row["status"]) for row in rows] == [
        *(("a", "done"), ("b", "failed"), ("c", "done"))
    ]
    line = rows[1]["message"]
    assert line.startswith("dives/b.mcap: a link")
    assert told.stderr.count(line) == 2  # as it ends, and below the table
