"""Scenes as files, and the recordings that are written of them."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from sonarrec.errors import SonarrecError
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
from sonarrec.sonar.stated import load_sonar
from tests.support.bare import BARE, POLAR, changed, power
from tests.support.command import sonarrec
from tests.support.rows import read_rows


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nmae = 'x'", r"nmae \(did you mean name\?\)"),
        ("[[landmark]]\nid = 9\nground_m = 2\nazimuth_deg = 0", "id 9"),
        ("[[object]]\nkind = 'ufo'\nground_m = 2\nazimuth_deg = 0", "kind of object"),
        ("[sonar]\nrange_min_m = 4.0", r"range_min_m = 4 .* 3.75$"),
        ("[sonar]\ntilt_error_deg = 80", "tilt_deg = 100 must"),
        ("[motion]\npan_start_deg = 60", "pan_start_deg must"),
        ("[sonar]\nfield_of_view_deg = 130\n[motion]\npan_max_deg = 200", "240 deg .* 130 deg"),
        ("[motion]\nheave_m = 0.7", "heave_m"),
        ("landmark_set = 'nowhere'", "no landmark set"),
    ],
)
def test_faults_in_a_scene_file_are_one_clear_line(tmp_path, text: str, message: str) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(text)
    with pytest.raises(SonarrecError, match=message) as caught:
        load_scene(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "path",  # plates have scenes of their own
    sorted({*BUILT_IN.glob("*.toml")} - {BUILT_IN / "plates.toml"}),
    ids=lambda path: path.stem,
)
def test_built_in_scenes_load_and_survive_a_round_trip(path) -> None:
    scene = load_scene(path.stem)
    assert scene == load_scene(path)
    assert scene_from_table(scene_table(scene), "again") == scene
    # Sections the file does not mention keep their defaults.
    assert set(tomllib.loads(path.read_text())) <= set(scene_table(scene))


def test_errors_of_geometry_are_in_the_sidecar_only() -> None:
    scene = changed(BARE, sonar={"tilt_error_deg": 2.0, "height_error_m": 0.05})
    stated = scene_sonar(scene)
    assert stated.tilt_deg == pytest.approx(22.0)
    assert stated.height_m == pytest.approx(0.73)
    assert next(render(scene)).image.tobytes() == next(render(BARE)).image.tobytes()


def test_polar_recording_states_uneven_bearings() -> None:
    scene = changed(POLAR, sonar={"bearings": "didson"})
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
    scene = changed(load_scene("basin"), frames=3, rate_hz=3.0, sonar={"range_bins": 128})
    done: list[int] = []
    write_recording(scene, tmp_path / "log", progress=done.append)
    write_recording(scene, tmp_path / "log.mcap")
    assert done == [1, 2, 3]
    frames = list(render(scene))
    for frame in frames:
        image = cv2.imread(str(tmp_path / "log" / f"{frame.index:06d}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(image, frame.image)
    rows = read_rows(tmp_path / "log" / "gt.csv")
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
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        read_by_others = list(reader.iter_decoded_messages())
    times = [one.message.log_time for one in read_by_others]
    assert times == [frame.timestamp_ns for frame in frames] == [0, 333333333, 666666667]
    for one, frame in zip(read_by_others, frames, strict=True):
        assert bytes(one.decoded_message.data) == frame.image.tobytes()


def test_simulate_command(tmp_path) -> None:
    basin, out = ("simulate", "--scene", "basin"), tmp_path / "log"
    sonarrec(*basin, "--frames", "2", "--seed", "9", "--out", out)
    assert len(list(out.glob("*.png"))) == 2
    assert load_scene(out / "scene.toml").seed == 9
    assert "already exists" in sonarrec(*basin, "--out", out, code=1).stderr
    (tmp_path / "file").touch()
    inside = tmp_path / "file" / "log"
    assert f"{inside}: " in sonarrec(*basin, "--out", inside, code=1).stderr
    sonarrec("simulate", "--scene", "x", "--out", tmp_path / "new", code=2)
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
