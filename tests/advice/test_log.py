"""What a picture tells against its geometry: clear faults are told, right geometry never."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from sonarrec.advice.log import contradiction
from sonarrec.readers import open_log
from sonarrec.readers.log import FIRST_FRAMES
from sonarrec.sonar.frame import Fan, Frame
from sonarrec.sonar.stated import Sonar
from tests.support.command import sample_log, sonarrec
from tests.support.drawn import draw_on_floor, make_fan, speckled

SAMPLE = Path(__file__).parents[2] / "sample_data"
RNG = np.random.default_rng(3)


def doubt(log: Path, **stated: float | str) -> str:
    """What is told of a log, with keys of its geometry replaced."""
    with open_log(log, sonar=Sonar(**stated)) as opened:  # type: ignore[arg-type]
        return contradiction([*islice(opened, FIRST_FRAMES)], opened.sonar)


def of_picture(image: np.ndarray, fan: Fan) -> str:
    return contradiction([Frame(0, 0, image, fan)], Sonar())


def floor(fan: Fan) -> np.ndarray:
    """A fan image of bare floor, black outside of the fan."""
    empty, seen = draw_on_floor(fan, 2.5, 0, 0.01, lambda x, y: 0 * (x + y))
    return speckled(empty, seen, RNG)


def upside_down(folder: Path, out: Path) -> Path:
    """The first frames of a folder, their rows in reverse, with its sonar.toml."""
    out.mkdir()
    shutil.copy(folder / "sonar.toml", out)
    for path in sorted(folder.glob("*.png"))[:8]:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert cv2.imwrite(str(out / path.name), image[::-1])
    return out


@pytest.mark.parametrize("log", ["pan", "polar", "pan.mcap"])
def test_right_geometry_is_not_doubted(log: str) -> None:
    assert not doubt(SAMPLE / log)


@pytest.mark.parametrize(
    ("log", "stated", "told"),
    [
        ("pan", {"range_max_m": 30.0}, r"holds echoes.*range_max_m"),
        ("pan", {"field_of_view_deg": 18.0}, r"holds echoes.*field_of_view_deg"),
        ("polar", {"layout": "fan"}, r"outside of the picture.*96 x 256.*--layout polar"),
        ("pan", {"field_of_view_deg": 130.0}, r"outside of the picture.*field_of_view_deg"),
        ("pan", {"apex_px": (383.5, 95.0)}, r"if apex_px is exchanged"),
    ],
)
def test_wrong_geometry_is_told(log: str, stated: dict[str, float | str], told: str) -> None:
    line = doubt(SAMPLE / log, **stated)
    assert re.search(told, line), line


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda image: image, ""),
        (lambda image: image[30:], "cut or stretched"),
        (lambda image: cv2.resize(image, (256, 256)), "cut or stretched"),
        (np.transpose, "if rows are columns"),
        (lambda image: np.pad(image, 8, constant_values=255), "8 px or more of grey level 255"),
        (lambda image: np.pad(image, 20), "20 px or more of grey level 0"),
    ],
)
def test_pictures_of_another_shape_are_told(
    tmp_path: Path, change: Callable[[np.ndarray], np.ndarray], told: str
) -> None:
    log = sample_log(tmp_path / "log", 5)
    for path in log.glob("*.png"):
        cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))  # type: ignore[arg-type]
    line = doubt(log)
    assert told in line if told else not line


def test_an_upside_down_fan_is_told(tmp_path: Path) -> None:
    line = doubt(upside_down(SAMPLE / "pan", tmp_path / "down"))
    assert "upside down" in line


def test_the_share_outside_is_the_share_of_pixels() -> None:
    """Half of the pixels outside of the fan lit, by count."""
    fan = make_fan(rows=200)
    image = floor(fan)
    column, row = np.meshgrid(np.arange(fan.columns), np.arange(fan.rows))
    across, ahead = column - fan.apex_column, fan.apex_row - row
    range_m = np.hypot(across, ahead) * fan.metres_per_pixel
    outside = (np.abs(np.degrees(np.arctan2(across, ahead))) > 14.4) | (range_m > 3.75)
    outside |= range_m < 1.25
    assert not of_picture(image, fan)
    lit = outside & (RNG.random(outside.shape) < 0.3)
    line = of_picture(np.where(lit, 120, image).astype(np.uint8), fan)
    assert line.startswith(f"{np.mean(lit[outside]):.0%} of the picture outside")


@pytest.mark.parametrize("background", [0, 60, 255])
def test_a_background_of_one_colour_and_a_few_marks_are_no_echoes(background: int) -> None:
    fan = make_fan(rows=200)
    image = floor(fan)
    image[image == 0] = background
    image[5:15, 3:30] = 255 - background  # a burnt-in number
    assert not of_picture(image, fan)


def test_a_fan_upside_down_is_turned(tmp_path: Path) -> None:
    turned = upside_down(SAMPLE / "pan", tmp_path / "turned")
    with (turned / "sonar.toml").open("a") as file:
        file.write('range_order = "near_first"\n')
    # Stated by a flag, the default overrules the sonar.toml.
    for stated, step in ((None, 1), ({"range_order": "far_first"}, -1)):
        with open_log(SAMPLE / "pan", sonar=stated) as right, open_log(turned, sonar=stated) as log:
            for one, other in zip(log, right, strict=False):
                np.testing.assert_array_equal(one.image, other.image[::step])


def test_a_picture_without_a_fan_is_asked_for_polar() -> None:
    fan = make_fan(rows=200)
    speckle = speckled(np.zeros((fan.rows, fan.columns)), np.ones((fan.rows, fan.columns)), RNG)
    line = of_picture(speckle, fan)
    assert "polar, --layout polar" in line


def test_run_tells_it_in_one_note_and_is_done(tmp_path: Path) -> None:
    log = sample_log(tmp_path / "log", 8)
    assert "note: " not in sonarrec("run", log, "-o", tmp_path / "out").stderr
    wrong = sonarrec("run", log, "-o", tmp_path / "wrong", "--field-of-view-deg", "18")
    (line,) = [line for line in wrong.stderr.splitlines() if "note: " in line]
    assert line.startswith(f"sonarrec: note: {log}: ")
    assert "picture outside" in line
    assert f"`sonarrec info {log} --sonar {tmp_path}/wrong/log/run.toml --preview " in line


def test_what_to_check_where_nothing_is_recognised_is_told_last(tmp_path: Path) -> None:
    log = sample_log(tmp_path / "log", 0)
    fan = make_fan(rows=256)
    for n in range(3):
        cv2.imwrite(str(log / f"{n}.png"), np.zeros((fan.rows, fan.columns), np.uint8))
    result = sonarrec("run", log, "-o", tmp_path / "out")
    line = " ".join(result.stderr.splitlines()[-2:])
    words = ("range order", "near_first", "geometry", "--preview", "landmark set", "level")
    assert [*words] == sorted(words, key=line.index)
    # At 2.5 m of slant range and 0.68 m of height: 0.3 m across is 0.3 x 2.5 / 2.406 m of arc.
    pixels = 0.3 * 2.5 / np.sqrt(2.5**2 - 0.68**2) / (2.5 / 256)
    assert f"{pixels:.0f} px wide" in line
    millimetres = ("--range-min-m", "1250", "--range-max-m", "3750", "--overwrite")
    told = sonarrec("run", log, "-o", tmp_path / "out", *millimetres).stderr
    # Too narrow a landmark explains the rest: nothing else is asked.
    assert "0 px wide" in told
    assert ": no landmark declared; check" not in told
    assert "fit clearly better" not in told


def nothing_seen(folder: Path, *words: str | Path) -> str:
    """The first suspects of a run in which no landmark is declared."""
    told = sonarrec("run", folder, "-o", folder.parent / "out", "-q", *words).stderr
    (line,) = [line for line in told.splitlines() if "no landmark declared" in line]
    return line


def test_the_likeliest_suspect_leads(tmp_path: Path) -> None:
    log = sample_log(tmp_path / "log", 8)
    # The echoes fill the fan only this way up: its range order is no suspect.
    (tmp_path / "poses.csv").write_text(
        "timestamp,yaw,x,y\n" + "".join(f"{n},0,{9 * n},0\n" for n in range(9))
    )
    nothing = ("--set", "features.declare=1")
    poses = nothing_seen(log, *nothing, "--odometry", tmp_path / "poses.csv")
    assert "check the poses poses.csv" in poses
    assert "range order" not in poses
    fan = nothing_seen(log, *nothing, "--layout", "polar")
    assert "check layout" in fan
    polar = tmp_path / "polar"
    polar.mkdir()
    for name in ("sonar.toml", *(f"{n:06d}.png" for n in range(8))):
        shutil.copy(SAMPLE / "polar" / name, polar)
    assert "layout" not in nothing_seen(polar, *nothing)
    for file in log.glob("*.png"):
        cv2.imwrite(str(file), 255 - cv2.imread(str(file), cv2.IMREAD_UNCHANGED))
    assert "inverted" in nothing_seen(log).partition("geometry")[0]


def test_a_height_that_cannot_be_in_metres_is_doubted(tmp_path: Path) -> None:
    log = sample_log(tmp_path / "log", 3)
    for tilt, told in (("", True), ("tilt_deg = 20.0\n", False)):
        (log / "sonar.toml").write_text(
            "[sonar]\nrange_min_m = 1.25\nrange_max_m = 3.75\nfield_of_view_deg = 28.8\n"
            f"frame_rate_hz = 4.0\n{tilt}"
        )
        ran = sonarrec("run", log, "-o", tmp_path / f"out{tilt[:4]}", "--height-m", "2.4")
        shown = sonarrec("info", log, "--quick", "--height-m", "2.4").stdout
        # 2.4 m below half of 1.25 + 3.75 m.
        doubt = f"tilt {np.degrees(np.arcsin(2.4 / 2.5)):.0f} deg); is it in metres?"
        assert (doubt in ran.stderr, doubt in shown) == (told, told)
    refused = sonarrec("run", log, "-o", tmp_path / "none", "--height-m", "66", code=2).stderr
    assert "in metres?" in refused
