"""Scenes as files, and the recordings that are written of them."""

from __future__ import annotations

import csv
import math
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from sonarrec.cli import main
from sonarrec.errors import SonarrecError
from sonarrec.landmarks import load_landmarks
from sonarrec.simulation.objects import object_radius
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import (
    BUILT_IN,
    PlacedObject,
    load_scene,
    scene_bearings,
    scene_from_table,
    scene_sonar,
    scene_table,
)
from sonarrec.simulation.simulate import write_recording
from sonarrec.sonar import load_sonar
from tests.studies.learning.random_scenes import random_scene
from tests.support.bare import BARE, POLAR, power


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nmae = 'x'", r"unknown key nmae \(did you mean name\?\); known keys: name, seed"),
        (
            "[sonar]\nrange_mim_m = 1",
            r"unknown key sonar.range_mim_m .*; known in \[sonar\]: layout",
        ),
        ("[motion]\npan_deg_s = 'fast'", "motion.pan_deg_s must be a number, 0 or more"),
        ("[noise]\nhot_beams = 1.5", "must be a whole number"),
        ("[noise]\nsnr_db = nan", "must be a number from -200 to 200, not nan"),
        ("[multipath]\ndrift_s = 1e-300", "must be a number from 0.001 to 1e\\+12"),
        ("frames = 0", "frames must be a whole number, 1 or more"),
        ("sonar = 3", r"\[sonar\] must be a table of keys, not 3"),
        ("landmark = 3", "its own \\[\\[landmark\\]\\]"),
        ("[[landmark]]\nid = 9\nground_m = 2\nazimuth_deg = 0", "id 9 is not in the set"),
        ("[[landmark]]\nid = 1", r"\[\[landmark\]\] 1 lacks ground_m, azimuth_deg"),
        ("[[object]]\nkind = 'ufo'\nground_m = 2\nazimuth_deg = 0", "unknown kind of object"),
        ("[sonar]\nrange_min_m = 4.0", r"its errors, contradicts itself: range_min_m = 4 .* 3.75$"),
        (
            "[sonar]\ntilt_error_deg = 80",
            "contradicts itself: tilt_deg = 100 must be 0 to below 90",
        ),
        ("[sonar]\nlayout = 'square'", "layout must be"),
        ("[motion]\npan_start_deg = 60", "pan_start_deg must lie"),
        ("[motion]\npan_max_deg = 261", "the pan sweep must be 300 deg or less"),
        (
            "[sonar]\nfield_of_view_deg = 130\n[motion]\npan_max_deg = 200",
            "the sweep of 240 deg and the view of 130 deg go round and see the same floor twice",
        ),
        ("[noise]\nsmear = 1.5", "noise.smear must be a number from 0 to 1, not 1.5"),
        ("[motion]\nheave_m = 0.7", "heave_m leaves no floor"),
        ("landmark_set = 'nowhere'", "no landmark set"),
        ("= 3", "not a readable TOML"),
    ],
)
def test_faults_in_a_scene_file_are_one_clear_line(tmp_path, text: str, message: str) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(text)
    with pytest.raises(SonarrecError, match=message) as caught:
        load_scene(path)
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "text",
    [
        "[floor]\ntexture_m = 1e-5",  # finer than cells
        "[fading]\nburst_probability = 1\nburst_frames = 1e9",
        "[fading]\nghost_blur_m = 1e9",
        "[multipath]\ncopy_db = -10\nblur_m = 1e9\nblur_beams = 1e9",  # wider than images
        "[multipath]\nband_db = -10\nband_step_m = 1e-9",
        "[sonar]\nrange_min_m = 0\n[floor]\nrelief_m = 0.01",  # water alone, which has no slope
    ],
)
def test_values_beyond_what_images_hold_are_drawn(tmp_path, text: str) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(f"frames = 2\n{text}")
    for frame in render(load_scene(path)):
        assert 1 < frame.image.std() < 127
        assert 10 < np.median(frame.image[frame.image > 0]) < 200


@pytest.mark.parametrize("path", sorted(BUILT_IN.glob("*.toml")), ids=lambda path: path.stem)
def test_built_in_scenes_load_and_survive_a_round_trip(path) -> None:
    scene = load_scene(path.stem)
    assert scene == load_scene(path)
    assert scene_from_table(scene_table(scene), "again") == scene
    # Sections the file does not mention keep their defaults.
    assert set(tomllib.loads(path.read_text())) <= set(scene_table(scene))


@pytest.mark.parametrize("seed", range(20))
def test_random_layouts_do_not_overlap(seed: int) -> None:
    scene = random_scene(seed, "near_miss")
    radius = scene.landmark_set.radius_m
    circles = [(p.ground_m, p.azimuth_deg, radius) for p in scene.landmarks]
    circles += [
        (p.ground_m, p.azimuth_deg, object_radius(scene, p))
        for p in scene.objects
        if p.kind != "wall"
    ]
    for i, (ground, azimuth, size) in enumerate(circles):
        for other_ground, other_azimuth, other_size in circles[:i]:
            # Law of cosines between the two places.
            turn = math.cos(math.radians(azimuth - other_azimuth))
            square = ground**2 + other_ground**2 - 2 * ground * other_ground * turn
            assert math.sqrt(square) > size + other_size


def test_paper_scene_is_the_papers_experiment() -> None:
    scene = load_scene("paper")
    assert (scene.frames, scene.rate_hz, scene.motion.pan_deg_s) == (992, 4.0, 2.0)
    assert {item.id for item in scene.landmarks} == {1, 3, 4}
    for item in scene.landmarks:
        assert 1.7 <= math.hypot(item.ground_m, scene.sonar.height_m) <= 2.3
    kinds = {item.kind for item in scene.objects}
    assert kinds >= {"mesh", "beam"}
    assert kinds & {"blank", "half_ring", "spokes", "filled"}, "no circular fake"


def test_errors_of_geometry_are_in_the_sidecar_only() -> None:
    scene = replace(BARE, sonar=replace(BARE.sonar, tilt_error_deg=2.0, height_error_m=0.05))
    stated = scene_sonar(scene)
    assert stated.tilt_deg == pytest.approx(22.0)
    assert stated.height_m == pytest.approx(0.73)
    assert next(render(scene)).image.tobytes() == next(render(BARE)).image.tobytes()


def test_polar_recording_states_uneven_bearings() -> None:
    scene = replace(POLAR, sonar=replace(POLAR.sonar, bearings="didson"))
    bearings = scene_bearings(scene)
    steps = np.diff(bearings)
    assert steps.min() > 0.21
    assert steps.max() < 0.39
    assert bearings[-1] + steps[-1] / 2 == pytest.approx(14.4, abs=0.02)
    assert scene_sonar(scene).bearings_deg == pytest.approx(tuple(bearings), abs=1e-4)
    (frame,) = render(scene)
    assert frame.image.shape == (512, 96)
    scene = replace(scene, objects=(PlacedObject("filled", 1.9, 9.0, size_m=0.05, bright_db=25),))
    seen = power(next(render(scene)).image, scene)
    centre = np.average(bearings, weights=np.maximum(seen - 20, 0).sum(axis=0))
    assert centre == pytest.approx(9.0, abs=0.2)


def test_written_recordings_read_back(tmp_path) -> None:
    scene = replace(load_scene("basin"), frames=3, rate_hz=3.0)
    done: list[int] = []
    write_recording(scene, tmp_path / "log", progress=done.append)
    write_recording(scene, tmp_path / "log.mcap", "mcap")
    assert done == [1, 2, 3]
    frames = list(render(scene))
    for frame in frames:
        image = cv2.imread(str(tmp_path / "log" / f"{frame.index:06d}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(image, frame.image)
    with (tmp_path / "log" / "gt.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    expected = [(f.index, row) for f in frames for row in f.truth]
    assert len(rows) == len(expected) > 0
    for read, (index, row) in zip(rows, expected, strict=True):
        assert int(read["frame"]) == index
        assert int(read["landmark"]) == row.landmark
        for key in ("x_px", "y_px", "range_m", "bearing_deg", "visible", "orientation_deg"):
            assert float(read[key]) == getattr(row, key)
    assert load_sonar(tmp_path / "log" / "sonar.toml") == scene_sonar(scene)
    assert load_scene(tmp_path / "log" / "scene.toml") == scene
    for name in ("sonar.toml", "gt.csv", "scene.toml"):
        assert (tmp_path / f"log.{name}").read_bytes() == (tmp_path / "log" / name).read_bytes()
    with (tmp_path / "log.mcap").open("rb") as file:
        times = [message.log_time for _, _, message in make_reader(file).iter_messages()]
    assert times == [frame.timestamp_ns for frame in frames] == [0, 333333333, 666666667]
    with pytest.raises(SonarrecError, match="already exists"):
        write_recording(scene, tmp_path / "log")


@pytest.mark.parametrize("radius", [0.15, 0.10])
def test_a_set_that_only_has_the_name_of_the_built_in_one_is_written(tmp_path, radius) -> None:
    discs = replace(load_landmarks("basin"), radius_m=radius)
    write_recording(replace(BARE, landmark_set=discs), tmp_path / "log")
    write_recording(replace(BARE, landmark_set=discs), tmp_path / "log.mcap", "mcap")
    for path in (tmp_path / "log" / "landmarks.toml", tmp_path / "log.landmarks.toml"):
        assert path.exists() == (radius != 0.15)
        assert radius == 0.15 or load_landmarks(path) == discs


def test_simulate_command(tmp_path) -> None:
    runner = CliRunner()
    out = tmp_path / "log"
    done = runner.invoke(
        main, ["simulate", "--scene", "basin", "--frames", "2", "--seed", "9", "--out", str(out)]
    )
    assert done.exit_code == 0, done.output
    assert len(list(out.glob("*.png"))) == 2
    assert load_scene(out / "scene.toml").seed == 9
    again = runner.invoke(main, ["simulate", "--scene", "basin", "--out", str(out)])
    assert again.exit_code == 1
    assert "already exists" in again.output
    (tmp_path / "file").touch()
    inside = str(tmp_path / "file" / "log")
    fault = runner.invoke(main, ["simulate", "--scene", "basin", "--out", inside])
    assert fault.exit_code == 1
    assert fault.stderr == f"sonarrec: {inside}: cannot be written (Not a directory)\n"
    wrong = runner.invoke(main, ["simulate", "--scene", "x", "--out", str(tmp_path / "new")])
    assert wrong.exit_code == 2
    assert not (tmp_path / "new").exists()


SAMPLES = Path(__file__).parents[2] / "sample_data"


@pytest.mark.parametrize("name", ["pan", "polar"])
def test_sample_logs_are_what_their_scenes_render(name: str) -> None:
    scene = load_scene(SAMPLES / name / "scene.toml")
    assert scene == load_scene(f"sample_{name}")
    for frame in render(replace(scene, frames=2)):
        stored = cv2.imread(str(SAMPLES / name / f"{frame.index:06d}.png"), cv2.IMREAD_UNCHANGED)
        # Other processors round differently in the last bit.
        assert np.mean(np.abs(stored.astype(int) - frame.image) > 1) < 0.001
