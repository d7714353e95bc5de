"""`sonarrec info`: what it says of logs whose contents are known."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from sonarrec.simulation.mcap import McapWriter
from sonarrec.sonar.stated import Sonar
from tests.support.command import SAMPLE, sonarrec
from tests.support.hard_logs import HardLog
from tests.support.logs import (
    PERIOD_NS,
    cdr_image,
    frames,
    image_folder,
    mcap_file,
    read,
    video_file,
)

IMAGES = frames(20, 30, 24)
START_NS = 1_700_000_000 * 10**9
MESSAGES = [("/a", START_NS + k * PERIOD_NS, cdr_image(image)) for k, image in enumerate(IMAGES)]


def table(path: Path, *arguments: str, code: int = 0) -> dict[str, Any]:
    tables = json.loads(sonarrec("info", path, "--json", *arguments, code=code).stdout)["logs"]
    return dict(tables[0])


def sequence(path: Path, *arguments: str, code: int = 0) -> dict[str, Any]:
    """What is told of the images of a log that has one sequence of them."""
    (images,) = table(path, *arguments, code=code)["images"]
    return dict(images)


def text(path: Path, *arguments: str, code: int = 0) -> str:
    return sonarrec("info", path, *arguments, code=code).output


def test_several_logs_are_a_row_each(tmp_path: Path) -> None:
    logs = [mcap_file(tmp_path / name / f"{name}.mcap", MESSAGES) for name in ("good", "cut")]
    logs.append(without_geometry(mcap_file(tmp_path / "bare" / "bare.mcap", MESSAGES)))
    data = logs[1].read_bytes()
    logs[1].write_bytes(data[: len(data) * 2 // 3])
    (noise := tmp_path / "noise.mcap").write_bytes(np.random.default_rng(0).bytes(3000))
    head, *rows = sonarrec("info", *logs, noise, code=3).stdout.splitlines()
    assert head.split() == ["log", "frames", "span", "geometry", "state"]
    told = {Path(row.split()[0]).stem: row for row in rows}
    assert set(told) == {"good", "cut", "bare", "noise"}
    assert "20" in told["good"].split()
    assert "lacks range_min_m" in told["bare"]
    assert "cut" in told["cut"].replace(str(logs[1]), "")
    assert "cannot be read" in told["noise"]
    told = json.loads(sonarrec("info", logs[0], noise, "--json", code=3).stdout)
    assert [("error" in each) for each in told["logs"]] == [False, True]
    assert told["program"] == {"name": "sonarrec", "version": told["version"]}
    sonarrec("info", logs[0], logs[0])
    assert "not an MCAP" in sonarrec("info", noise, tmp_path / "missing", code=1).stderr
    sonarrec("info", logs[0], "--nonsense", code=2)


def without_geometry(path: Path) -> Path:
    (path.parent / "sonar.toml").unlink()
    return path


def test_a_whole_mcap_against_the_package_s_own_account(tmp_path: Path) -> None:
    path = mcap_file(tmp_path / "log.mcap", MESSAGES)
    found = table(path)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    container = found["container"]
    assert container["footer"]
    assert container["chunks"] == {"zstd": summary.statistics.chunk_count}
    assert container["start_ns"] == summary.statistics.message_start_time
    assert container["end_ns"] == summary.statistics.message_end_time
    (channel,) = container["channels"]
    assert channel.items() >= {
        *(("topic", "/a"), ("schema", "sensor_msgs/msg/Image"), ("schema_encoding", "ros2msg")),
        *(("message_encoding", "cdr"), ("messages", 20), ("images", True)),
    }
    (images,) = found["images"]
    assert (images["frames"], images["usable"]) == (20, 20)
    assert (images["rows"], images["columns"], images["pixels"]) == (30, 24, "uint8")
    assert images["rate_hz"] == pytest.approx(4)
    assert (images["layout"], images["lacks"]) == ("fan", [])
    assert images["geometry"]["tilt_deg"] == 20
    assert images["geometry_from"] == str(tmp_path / "sonar.toml")
    assert not found["faults"] + images["problems"]
    (note,) = images["notes"]  # ramps from edge to edge are no fan
    assert "outside" in note
    assert found["size_bytes"] == path.stat().st_size


@pytest.mark.parametrize("indexed", [True, False])
def test_quick_reads_one_frame(indexed: bool, tmp_path: Path) -> None:
    path = mcap_file(tmp_path / "log.mcap", MESSAGES, indexed=indexed)
    found = table(path, "--quick")
    (images,) = found["images"]
    assert not found["checked"]
    assert (images["frames"], images["usable"], images["rate_hz"]) == (20, None, None)
    assert (images["rows"], images["columns"]) == (30, 24)
    assert "20, not checked" in text(path, "--quick")


def test_quick_does_not_see_what_only_reading_shows(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with HardLog(path) as log:
        for first in range(0, 20, 5):
            log.chunk([(t, m) for _, t, m in MESSAGES[first : first + 5]], "zstd")
    data = bytearray(path.read_bytes())
    data[log.positions[2] + 200] ^= 1
    path.write_bytes(data)
    assert not table(path, "--quick")["faults"]
    found = table(path, code=3)
    assert (found["images"][0]["usable"], found["images"][0]["frames"]) == (15, 20)
    (fault,) = found["faults"]
    assert f"byte {log.positions[2]}" in fault
    assert "5 frames" in fault
    assert re.search("whole +no: damaged", text(path, code=3))


def test_what_info_counts_is_what_run_uses(tmp_path: Path) -> None:
    messages = list(MESSAGES)
    messages[3] = ("/a", messages[3][1], cdr_image(IMAGES[3][:-2]))
    messages[5] = ("/a", messages[5][1], b"\0\1\0\0")
    path = mcap_file(tmp_path / "log.mcap", messages)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    used, problems, _ = read(path)
    found = table(path, code=3)
    assert found["images"][0]["usable"] == len(used)
    assert sorted(found["faults"] + found["images"][0]["problems"]) == sorted(problems)
    assert found["faults"] == [p for p in problems if p.startswith("log.mcap")]
    assert not found["container"]["footer"]
    assert "cut short" in text(path, code=3)


def test_a_geometry_that_is_missing_is_told_and_costs_no_frame(tmp_path: Path) -> None:
    path = without_geometry(mcap_file(tmp_path / "log.mcap", MESSAGES))
    images = sequence(path, "--range-max-m", "9")
    assert (images["usable"], images["geometry_from"]) == (20, None)
    assert images["lacks"] == ["range_min_m", "tilt_deg", "field_of_view_deg"]
    assert images["geometry"] == {"range_max_m": 9}
    images = sequence(path, "--range-max-m", "9", "--height-m", "0.5")
    assert images["lacks"] == ["range_min_m", "field_of_view_deg"]
    told = text(path, "--range-max-m", "9")
    assert "20 of 20" in told
    # The height replaces the tilt, and no other key.
    assert "--range-min-m, --tilt-deg (or --height-m), --field-of-view-deg, or" in told
    assert f"--write-sonar {tmp_path / 'log.sonar.toml'}`" in told


def test_polar_messages_tell_their_own_geometry(tmp_path: Path) -> None:
    bearings = tuple(np.linspace(-30, 30, 24).tolist())
    sonar = Sonar(range_min_m=1, range_max_m=4, tilt_deg=20, bearings_deg=bearings).complete("test")
    path = tmp_path / "log.mcap"
    with McapWriter(path, sonar) as writer:
        for k, image in enumerate(IMAGES):
            writer.write(k * PERIOD_NS, image)
    images = sequence(path)
    assert images["polar_messages"]
    assert (images["layout"], images["lacks"], images["usable"]) == ("polar", ["tilt_deg"], 20)
    assert images["geometry"]["range_max_m"] == pytest.approx(4)
    np.testing.assert_allclose(images["geometry"]["bearings_deg"], bearings, atol=1e-4)
    assert images["origins"]["beam_order"] == "found"
    told = text(path)
    for fact in (
        "1 to 4 m, 24 beams from -30 to 30 deg\n",
        "layout, range_min_m, range_max_m, bearings_deg",
        "beam_order = range-major",
        "lacks tilt_deg",
        "0.000 s, 4.8 s long",
    ):
        assert fact in told
    assert "stated differs" in text(path, "--layout", "fan")


def test_several_image_channels_and_one_that_is_none(tmp_path: Path) -> None:
    messages = [(f"/{'ab'[k % 2]}", time, data) for k, (_, time, data) in enumerate(MESSAGES)]
    path = mcap_file(tmp_path / "log.mcap", messages)
    found = table(path)
    assert [(i["topic"], i["usable"]) for i in found["images"]] == [("/a", 10), ("/b", 10)]
    assert sequence(path, "--topic", "/b")["topic"] == "/b"
    assert "/a, /b" in text(path, "--topic", "/c", code=2)


def test_an_mcap_without_images_is_shown_all_the_same(tmp_path: Path) -> None:
    path = mcap_file(tmp_path / "log.mcap", [("/imu", 0, b"x")], schema="sensor_msgs/msg/Imu")
    found = table(path, code=1)
    assert found["images"] == []
    assert found["container"]["channels"][0]["schema"] == "sensor_msgs/msg/Imu"
    told = text(path, code=1)
    assert "holds messages" in told
    assert "footer; checksums" in told


def test_folder_glob_and_video(tmp_path: Path) -> None:
    folder = image_folder(tmp_path / "log", IMAGES)
    for path in (folder, folder / "*.png"):
        found = table(path)
        assert (found["kind"], found["files"], found["container"]) == ("images", 20, None)
        assert found["images"][0]["usable"] == 20
        assert found["images"][0]["rate_hz"] is None
    assert "24 x 30, uint8, fan, 4 Hz as stated" in text(folder)
    (folder / "frame7.png").write_bytes(b"broken")
    images = sequence(folder, code=3)
    assert images["usable"] == 19
    assert [line.partition(":")[0] for line in images["problems"]] == ["frame7.png"]
    found = table(video_file(folder / "log.avi", IMAGES, "MJPG", 10.0))
    assert (found["kind"], found["images"][0]["usable"]) == ("video", 20)
    assert found["images"][0]["rate_hz"] == pytest.approx(10, rel=0.01)
    assert found["images"][0]["pixels"] == "3 x uint8"


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp"])
def test_of_a_long_folder_a_sample_is_decoded(suffix: str, tmp_path: Path) -> None:
    """Whatever `--all` names, but for what is wrong in the middle of a file alone."""
    names = [f"frame{n}{suffix}" for n in range(240)]
    in_colour = [cv2.merge([image // 2] * 3) for image in frames(240, 12, 12)]
    folder = image_folder(tmp_path / "log", in_colour, suffix)

    def change(number: int, how: Callable[[bytes], bytes]) -> None:
        (folder / names[number]).write_bytes(how((folder / names[number]).read_bytes()))

    whole = sequence(folder)
    assert (whole["usable"], whole["frames"], whole["problems"]) == (240, 240, [])
    assert whole["decoded"] == (240 if suffix == ".bmp" else 200)
    assert sequence(folder, "--all") == whole | {"decoded": 240}
    change(7, lambda data: data[: len(data) // 2])
    change(8, lambda data: data + bytes(40))  # as some recorders pad their files: no fault
    change(9, lambda data: data[: -len(data) // 4] + bytes(len(data) // 4))
    change(10, lambda data: bytes(16) + data[16:])
    change(11, lambda _: b"")
    assert cv2.imwrite(str(folder / names[12]), np.full((13, 12), 9, np.uint8))
    (folder / names[13]).unlink()
    (folder / names[13]).symlink_to("nowhere")
    found, every = (sequence(folder, *how, code=3) for how in ([], ["--all"]))
    assert found["problems"] == every["problems"]
    assert (found["usable"], found["frames"]) == (every["usable"], every["frames"])
    named = {line.partition(":")[0] for line in found["problems"]}
    assert {names[n] for n in (7, 10, 11, 12, 13)} <= named
    assert names[8] not in named


def test_frames_unlike_the_first_are_all_named(tmp_path: Path) -> None:
    folder = image_folder(tmp_path / "log", frames(300, 30, 24))
    for n in range(5, 300):
        assert cv2.imwrite(str(folder / f"frame{n}.png"), np.full((31, 25), n % 250, np.uint8))
    found = sequence(folder, code=3)
    assert (found["usable"], found["frames"], found["decoded"]) == (5, 300, 300)


def test_pauses_are_found_between_images_that_are_not_decoded(tmp_path: Path) -> None:
    times = [n / 4 + 100 * (n > 107) for n in range(300)]
    names = [f"20261120T10{int(time // 60):02d}{time % 60:06.3f}.png" for time in times]
    folder = image_folder(tmp_path / "log", frames(300, 30, 24), names=names)
    found, every = (sequence(folder, *how) for how in ([], ["--all"]))
    for key in ("usable", "start_ns", "end_ns", "rate_hz"):
        assert found[key] == every[key], key
    pauses = [[note for note in i["notes"] if "1 pause" in note] for i in (found, every)]
    assert pauses[0] == pauses[1] != []


def test_a_geometry_is_written_with_what_is_missing_marked(tmp_path: Path) -> None:
    log, file = tmp_path / "log", tmp_path / "sonar.toml"
    log.mkdir()
    for n in range(4):
        shutil.copy(SAMPLE / f"{n:06d}.png", log)
    told = sonarrec("info", log, "--range-max-m", "3.75", "--write-sonar", file).stderr
    assert "range_min_m" in told
    written = file.read_text()
    stated = tomllib.loads(written)["sonar"]
    true = tomllib.loads((SAMPLE / "sonar.toml").read_text())["sonar"]
    assert stated["range_max_m"] == 3.75
    assert not {"range_min_m", "tilt_deg", "height_m", "field_of_view_deg"} & set(stated)
    # As marked it is completed, and then serves.
    for key in ("range_min_m", "tilt_deg", "field_of_view_deg"):
        line = re.search(rf"^# {key} =  # missing.*$", written, re.MULTILINE)
        assert line is not None
        written = written.replace(line[0], f"{key} = {true[key]}")
    file.write_text(written)
    assert "lacks" not in sonarrec("info", log, "--quick").stdout  # it lies beside the folder
    own = sonarrec("info", SAMPLE, "--quick", "--write-sonar", SAMPLE / "sonar.toml", code=2)
    assert "is not overwritten" in own.stderr
    of_log = tmp_path / "whole.toml"
    assert "nothing is missing" in sonarrec("info", SAMPLE, "--write-sonar", of_log).stderr
    assert tomllib.loads(of_log.read_text())["sonar"] == true


def test_what_the_log_states_ping_by_ping_is_written_as_a_comment(tmp_path: Path) -> None:
    """Stated in a file it would overrule pings of other windows."""
    log, file = tmp_path / "log.mcap", tmp_path / "new.toml"
    sonarrec("simulate", "--scene", "sample_polar", "--frames", "2", "-o", log)
    sonarrec("info", log, "--write-sonar", file)
    stated = tomllib.loads(file.read_text())["sonar"]
    assert set(stated) == {"tilt_deg", "height_m", "frame_rate_hz", "beam_width_deg", "beam_order"}
    assert "# range_max_m: " in file.read_text()


def test_a_damaged_log_is_marked_in_the_table(tmp_path: Path) -> None:
    logs = [mcap_file(tmp_path / name / f"{name}.mcap", MESSAGES) for name in ("good", "torn")]
    data = bytearray(logs[1].read_bytes())
    data[len(data) // 3 : len(data) // 3 + 9] = b"\0" * 9  # in a chunk: its end is whole
    logs[1].write_bytes(data)
    told = sonarrec("info", *logs, code=3)
    good, torn = told.stdout.splitlines()[1:]
    assert "whole" in good
    assert "or damaged" in torn
    assert "info" in told.stderr
    assert "info" not in sonarrec("info", *logs, "--json", code=3).stderr
