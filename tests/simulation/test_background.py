"""Landmarks laid into recordings, against what the recordings' own truth and plain sums tell."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sonarrec.config import preset
from sonarrec.geometry import polar_from_pixel
from sonarrec.landmarks import BUILT_IN, load_landmarks
from sonarrec.readers import open_log
from sonarrec.simulation.background import Background, survey
from sonarrec.simulation.background_files import DiscLook, compose, write_backgrounds
from sonarrec.simulation.composite import Composer, CompositeDisc
from sonarrec.simulation.layout import Layout, draw_layout, truth_of
from sonarrec.simulation.motion import Pose, poses
from sonarrec.simulation.scene import Scene
from sonarrec.simulation.simulate import write_recording
from tests.studies.learning.random_scenes import random_scene
from tests.support.command import sonarrec
from tests.support.drawn import make_fan
from tests.support.rows import read_rows

BASIN = load_landmarks("basin")
LOOK = DiscLook(plate_db=-6.0, beam_width_deg=0.4)
ARIS = Path(__file__).parents[1] / "readers" / "aris_sample" / "sample.aris"
FRAMES = 24
# A made-up sonar whose images are as even as speckle lets them be.
FAN = make_fan(500, 1.2, 4.2, 32.0, height_m=0.7)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A pan over a floor without landmarks, whose motion is known."""
    drawn = random_scene(5, "no_landmark")
    return replace(drawn, frames=FRAMES, objects=())


@pytest.fixture(scope="module")
def recording(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("background") / "floor"
    write_recording(scene, folder)
    return folder


@pytest.fixture(scope="module")
def background(recording: Path) -> Background:
    return survey(lambda: open_log(recording), BASIN, preset("default"))


def speckle(rng: np.random.Generator) -> np.ndarray:
    """Grey of fully developed speckle at 50 dB over 255, cells of about 2 pixels, level 25 dB."""
    field = rng.standard_normal((2, FAN.rows, FAN.columns))
    field = np.stack([cv2.GaussianBlur(part, (0, 0), 1.0) for part in field])
    power = (field**2).sum(axis=0)
    decibels = 25 + 10 * np.log10(power / power.mean())
    return np.rint(np.clip(decibels / 50 * 255, 1, 255)).astype(np.uint8)


def power_of(image: np.ndarray) -> np.ndarray:
    return np.asarray(10 ** (image.astype(float) / 255 * 5.0))


@pytest.mark.parametrize("contrast", [-3.0, 0.0, 6.0, 10.0])
def test_the_contrast_is_the_one_asked_for(contrast: float) -> None:
    """Mean power of a filled disc over that of the floor about it, and of a plate likewise.

    Inside 0.8 of the radius the smear, 2 sigma of 0.4 deg and 2 cm, does not reach. A disc holds
    some 1,000 speckle cells (50 x 40 pixels, cells of 2), a frame 1 / sqrt(1000) = 3 % or 0.14 dB
    of error; over 12 frames 0.04 dB. 0.15 dB is four times that, and leaves the rounding to whole
    grey levels, 0.2 dB apart but without bias.
    """
    composer = Composer(FAN, BASIN, 50.0, 0.4)
    here = Pose(0.0, 0.7, 0.0, 0.0)
    discs = [CompositeDisc("filled", 0, -0.2, 2.5, 0.0), CompositeDisc("blank", 0, 0.3, 2.5, 0.0)]
    rng = np.random.default_rng(1)
    row, column = np.mgrid[0 : FAN.rows, 0 : FAN.columns].astype(float)
    range_m, bearing = polar_from_pixel(FAN, column, row)
    ground = np.sqrt(np.maximum(range_m**2 - 0.7**2, 0))
    x, y = ground * np.sin(np.radians(bearing)), ground * np.cos(np.radians(bearing))
    filled = np.hypot(x + 0.2, y - 2.5) < 0.8 * 0.15
    plate = np.hypot(x - 0.3, y - 2.5) < 0.5 * 0.15
    measured = []
    for _ in range(12):
        image = speckle(rng)
        laid = composer.compose(image, discs, here, [contrast], -6.0)[contrast]
        floor = power_of(image)
        measured.append([power_of(laid)[m].mean() / floor[m].mean() for m in (filled, plate)])
    ring_db, plate_db = 10 * np.log10(np.mean(measured, axis=0))
    assert ring_db == pytest.approx(contrast, abs=0.15)
    # Four times as few cells under the plate, and the smear of the ring beyond 0.5 is nil.
    assert plate_db == pytest.approx(-6.0, abs=0.3)


def test_the_light_of_the_floor_stays_on_the_disc() -> None:
    """Half of the floor 10 dB brighter: a disc across the step has both lights."""
    composer = Composer(FAN, BASIN, 50.0, 0.4)
    image = speckle(np.random.default_rng(2))
    half = image[:, FAN.columns // 2 :]
    half[:] = np.minimum(half.astype(int) + 51, 255).astype(np.uint8)
    filled, here = CompositeDisc("filled", 0, 0.0, 2.5, 0.0), Pose(0.0, 0.7, 0.0, 0.0)
    disc = composer.footprint(filled, here)
    assert disc is not None
    laid = power_of(composer.compose(image, [filled], here, [6.0], -6.0)[6.0])[disc.box]
    inside = disc.share > 0.99
    column = np.arange(disc.box[1].start, disc.box[1].stop)
    left, right = inside & (column < FAN.apex_column - 10), inside & (column > FAN.apex_column + 12)
    assert 10 * math.log10(laid[right].mean() / laid[left].mean()) > 4


@pytest.mark.slow
def test_nothing_but_the_discs_is_touched(background: Background) -> None:
    layout = draw_layout(background, BASIN, 1)
    fan = background.fan
    row, column = np.mgrid[0 : fan.rows, 0 : fan.columns].astype(float)
    range_m, bearing = polar_from_pixel(fan, column, row)
    height = fan.height_m
    assert height is not None
    ground = np.sqrt(np.maximum(range_m**2 - height**2, 0))
    frames = background.frames()
    for index, images in compose(background, layout, LOOK, [6.0]):
        pose = background.path[index]
        azimuth = np.radians(bearing + pose.pan_deg)
        x, y = pose.x_m + ground * np.sin(azimuth), pose.y_m + ground * np.cos(azimuth)
        # The smear ends 2 sigma out: 1.7 cm of slant range, 0.34 deg; a pixel more for drawing.
        near = np.zeros(x.shape, dtype=bool)
        for disc in layout.discs:
            spill = 0.017 * 1.5 + np.radians(0.34) * 4 + 2 * fan.metres_per_pixel
            near |= np.hypot(x - disc.x_m, y - disc.y_m) < BASIN.radius_m + spill
        before = next(frames).image
        assert np.array_equal(images[6.0][~near], before[~near])
        assert not np.array_equal(images[6.0], before)


def test_the_path_and_the_truth_follow_the_known_pan(background: Background, scene: Scene) -> None:
    """The simulator knows its pan; the odometry measured it; bearings in gt.csv turn by it."""
    known = np.array([pose.pan_deg for pose in poses(scene)])
    path = np.array([pose.pan_deg for pose in background.path])
    assert abs(known[-1] - known[0]) > 2
    assert np.abs(path - (known - known[0])).max() < 0.15 * np.ptp(known)
    layout = Layout(BASIN, (CompositeDisc("landmark", 1, 0.0, 2.2, 30.0),), 0)
    seen = [truth_of(background, layout, frame) for frame in range(FRAMES)]
    (first,) = seen[0]
    assert first.bearing_deg == pytest.approx(0, abs=1e-3)
    for rows, pan in zip(seen, path, strict=True):
        for row in rows:
            assert row.bearing_deg == pytest.approx(-pan, abs=1e-3)
            assert row.range_m == pytest.approx(first.range_m, abs=1e-4)
            assert row.orientation_deg == pytest.approx((30 + pan) % 360, abs=2e-3)


def test_discs_lie_on_the_floor_also_where_paper_runs_there(
    recording: Path, background: Background
) -> None:
    """That preset measures no motion: `site` laid discs that went along with the sonar."""
    paper = survey(lambda: open_log(recording), BASIN, preset("paper"))
    assert paper.path == background.path
    assert paper.unknown == 0


@pytest.mark.slow
def test_told_poses_carry_the_discs(recording: Path, tmp_path: Path) -> None:
    """A sonar told to go 2 cm ahead a frame: a disc comes 2 cm nearer over the ground."""
    rate = open_log(recording).sonar.frame_rate_hz or 1.0
    told = tmp_path / "poses.csv"
    rows = [f"{round(n * 1e9 / rate)},0,0,{0.02 * n:.4f}" for n in range(FRAMES)]
    told.write_text("timestamp_ns,yaw,x,y\n" + "\n".join(rows) + "\n")
    out = tmp_path / "out"
    sonarrec(
        *("simulate", "--background", recording, "--odometry", told, "--count", "1"),
        *("--frames", "0:12", "-o", out),
    )
    sonar = open_log(out).sonar
    truth = [row for row in read_rows(out / "gt.csv") if float(row["visible"]) > 0]
    ahead = [
        math.sqrt(float(r["range_m"]) ** 2 - (sonar.height_m or 0) ** 2)
        * math.cos(math.radians(float(r["bearing_deg"])))
        for r in truth
    ]
    assert len(ahead) > 3
    assert np.diff(ahead) == pytest.approx(-0.02, abs=1e-4)
    assert float(read_rows(out / "poses.csv")[-1]["y"]) == pytest.approx(0.22)


@pytest.mark.slow
def test_what_is_written_is_a_log_of_the_same_geometry(
    background: Background, tmp_path: Path
) -> None:
    layout = draw_layout(background, BASIN, 2)
    kinds = [disc.kind for disc in layout.discs]
    assert {"landmark", "blank", "filled"} <= set(kinds)
    write_backgrounds(background, layout, LOOK, {3.0: tmp_path / "a"})
    with open_log(tmp_path / "a") as log:
        frames = list(log)
    assert len(frames) == FRAMES
    assert frames[0].fan == background.fan
    times = [frame.timestamp_ns for frame in background.frames()]
    assert [frame.timestamp_ns for frame in frames] == pytest.approx(times, abs=2)
    again = draw_layout(background, BASIN, 2)
    assert again == layout
    assert draw_layout(background, BASIN, 3) != layout
    assert not (tmp_path / "a" / "landmarks.toml").exists()


@pytest.mark.slow
def test_a_series_is_recognised_and_scored_as_it_is(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "series"
    told = sonarrec(
        "simulate", "--background", recording, "--contrast", "10,3", "--seed", "4", "-o", out
    ).stdout
    assert "contrast_3: 24 frames" in told
    assert "at 10 dB" in told
    truth = [(out / f"contrast_{db}" / "gt.csv").read_bytes() for db in (3, 10)]
    assert truth[0] == truth[1]
    results = tmp_path / "results"
    sonarrec("run", out / "contrast_3", out / "contrast_10", "-o", results, "-q", "-j", "1")
    scored = sonarrec("evaluate", results / "contrast_10").stdout
    assert "framework" in scored


@pytest.mark.parametrize(
    ("words", "told", "code"),
    [
        (["--contrast", "loud"], "--contrast loud: expected numbers", 2),
        (["--contrast", "3,3"], "a value is given twice", 2),
        (["--contrast", "10.12345,10.12346"], "a value is given twice", 2),
        (["--contrast", "200"], "from -60 to 60", 2),
        (["--scene", "paper"], "--scene is for scenes", 2),
        (["--frames", "90:99"], "no frame lies in --frames", 2),
        (["--frames", "12"], "expected A:B", 2),
        (["--height-m", "3.6", "--range-max-m", "3.7"], "nothing of the floor is in view", 1),
        (["--landmarks", "BIG"], "is nowhere whole in view", 1),
        (["--odometry", "POSES", "--odometry-topic", "/p"], "choose one of the two", 2),
    ],
)
def test_bad_input_is_one_line(
    words: list[str], told: str, code: int, recording: Path, tmp_path: Path
) -> None:
    text = (BUILT_IN / "basin.toml").read_text()
    big = tmp_path / "big.toml"
    big.write_text(text.replace("radius_m = 0.15", "radius_m = 1.4"))
    given = [{"BIG": str(big), "POSES": str(big)}.get(word, word) for word in words]
    out = tmp_path / "out"
    done = sonarrec("simulate", "--background", recording, "-o", out, *given, code=code)
    assert told in done.stderr
    assert done.stderr.count("\n") == 1
    assert not out.exists()


def test_a_log_without_geometry_and_a_folder_in_use_are_refused(
    recording: Path, tmp_path: Path
) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    for picture in sorted(recording.glob("*.png"))[:3]:
        (bare / picture.name).write_bytes(picture.read_bytes())
    told = sonarrec("simulate", "--background", bare, "-o", tmp_path / "out", code=1).stderr
    assert "sonar geometry lacks" in told
    told = sonarrec("simulate", "--background", recording, "-o", bare, code=1).stderr
    assert "already exists and is not empty" in told
    told = sonarrec("simulate", "--plate", "3", "-o", tmp_path / "out", code=2).stderr
    assert "--plate is for --background" in told


def test_amplitudes_have_the_range_that_the_reader_gave_them(
    recording: Path, tmp_path: Path
) -> None:
    """Grey that the reader makes of amplitudes is 50 dB by its own doing: nothing is assumed."""
    folder = tmp_path / "amplitudes"
    folder.mkdir()
    (folder / "sonar.toml").write_bytes((recording / "sonar.toml").read_bytes())
    for path in sorted(recording.glob("*.png"))[:2]:
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        amplitude = np.where(grey > 0, 10 ** (grey / 255 * 2.5), 0) * 60
        cv2.imwrite(str(folder / path.name), np.rint(amplitude).astype(np.uint16))
    for scale, noted in (("log", False), ("linear", True)):
        out = tmp_path / scale
        words = ("--pixel-scale", scale, "--count", "1", "-o", out)
        told = sonarrec("simulate", "--background", folder, *words).stderr
        assert ("grey is taken as 50 dB" in told) == noted
