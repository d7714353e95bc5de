"""Simulated plates: what is drawn shows where the truth says, and blanks show nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonarrec.errors import SonarrecError, UsageError
from sonarrec.simulation.render import SimulatedFrame, render
from sonarrec.simulation.scene import HeldPlate, PlateScene, load_scene
from sonarrec.simulation.simulate import simulate
from tests.support.rows import read_rows

PLATE = HeldPlate(2, range_m=1.0, bearing_deg=4.0, turned_deg=70.0, tilt_deg=40.0)
EVEN = {"streaks": 0, "clutter": 0, "light_db": 0.0}
SCENE = PlateScene(plate=(PLATE,), frames=2, swing=0.3, **EVEN)


def at(scene: PlateScene, frame: SimulatedFrame, range_m: float, bearing_deg: float) -> float:
    """Mean grey level of 3 x 3 samples."""
    bins = (range_m - scene.range_min_m) / (scene.range_max_m - scene.range_min_m) * scene.bins
    beams = (bearing_deg / scene.field_of_view_deg + 0.5) * scene.beams
    row, column = round(bins - 0.5), round(beams - 0.5)
    return float(frame.image[row - 1 : row + 2, column - 1 : column + 2].mean())


@pytest.mark.parametrize("mirrored", [False, True])
def test_cells_show_between_the_corners(mirrored: bool) -> None:
    """Corners alone say, by interpolation, where each cell lies."""
    scene = replace(SCENE, plate=(replace(PLATE, mirrored=mirrored),))
    frame = next(render(scene))
    (plate,) = frame.truth
    corners = plate.corners[:, 0] * np.exp(1j * np.radians(90 - plate.corners[:, 1]))
    drawing = scene.landmark_set.drawings()[2]
    grey = np.empty((7, 7))
    for row, column in np.ndindex(7, 7):
        right, down = (column + 0.5) / 7, (row + 0.5) / 7
        top = corners[0] + right * (corners[1] - corners[0])
        bottom = corners[3] + right * (corners[2] - corners[3])
        place = top + down * (bottom - top)
        bearing = 90 - np.degrees(np.angle(place))
        grey[row, column] = at(scene, frame, abs(place), bearing)
    assert np.corrcoef(grey.ravel(), drawing.ravel())[0, 1] > 0.8
    middle = corners.mean()
    assert abs(middle) == pytest.approx(plate.range_m, abs=0.01)
    right_of = np.degrees(np.angle(corners[1] + corners[2] - corners[0] - corners[3]))
    assert (plate.orientation_deg - right_of + 180) % 360 - 180 == pytest.approx(0, abs=4)
    # Turned clockwise as drawn, the corners go round the other way where it is mirrored.
    area = np.imag(np.conj(corners[1] - corners[0]) * (corners[3] - corners[0]))
    assert (area > 0) == mirrored


def test_without_tilt_below_the_sonar_it_is_a_square_on_the_floor() -> None:
    scene = replace(SCENE, plate=(replace(PLATE, tilt_deg=0.0),), swing=0.0, height_m=0.6)
    (true,) = next(render(scene)).truth
    assert true.range_m == pytest.approx(1.0)
    ground_m = np.sqrt(true.corners[:, 0] ** 2 - 0.6**2)
    corners = ground_m * np.exp(1j * np.radians(true.corners[:, 1]))
    assert np.abs(corners - np.roll(corners, 1)) == pytest.approx(0.3048)


def test_the_same_scene_gives_the_same_frames_and_blanks_show_nothing() -> None:
    scene = replace(SCENE, frames=4, blank_every=2)
    once, again = list(render(scene)), list(render(scene))
    assert all(np.array_equal(a.image, b.image) for a, b in zip(once, again, strict=True))
    assert [len(frame.truth) for frame in once] == [1, 0, 1, 0]
    assert once[1].image.mean() < once[0].image.mean() - 20


def test_a_recording_is_written_with_its_truth(tmp_path: Path) -> None:
    scene = load_scene("plates")
    out = simulate(replace(scene, frames=2), tmp_path / "log")
    rows = [(row["frame"], row["landmark"]) for row in read_rows(out / "gt.csv")]
    assert rows == [("0", "0"), ("0", "3"), ("1", "0"), ("1", "3")]
    names = {"000000.png", "000001.png", "gt.csv", "corners.csv", "landmarks.toml", "sonar.toml"}
    assert {path.name for path in out.iterdir()} == names
    with pytest.raises(UsageError, match="PNGs"):
        simulate("plates", tmp_path / "other.mcap")


def test_the_background_is_as_far_over_the_noise_as_stated() -> None:
    """Speckle of power 1 / 1.6 ** 2, whose uneven strength, of 2.5 dB, adds .7 dB to its mean."""
    blank = replace(SCENE, frames=6, blank_every=2, swing=0.0, floor_db=15.0)
    grey = np.array([frame.image for frame in render(blank)])[:, 60:340]
    grey = grey[:, :, np.r_[:70, 186:256]]  # beside the plate
    power = (10 ** ((grey / 255 * 60 - 8) / 10)).mean(axis=(1, 2))
    over_db = 10 * np.log10(power[::2].mean() / power[1::2].mean() - 1)
    assert over_db == pytest.approx(15 - 20 * np.log10(1.6) + 0.7, abs=2)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('landmark_set = "basin"', "no kind"),
        ("[[plate]]\nlandmark = 0\nrange_m = 2.0", "outside of the window"),
        ("[[plate]]\nlandmark = 9", "no ID 9 in landmark_set"),
        ("[[plate]]\nlandmark = 0\nknown = false", "no ID 0 in others"),
        ("range_min_m = 3.0", "range_min_m"),
        ("plates = 1", "unknown key"),
    ],
)
def test_scenes_that_cannot_be_are_refused(text: str, words: str, tmp_path: Path) -> None:
    file = tmp_path / "scene.toml"
    file.write_text(f'kind = "plates"\n{text}\n')
    with pytest.raises(SonarrecError, match=words):
        load_scene(file)
