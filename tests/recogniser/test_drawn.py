"""Drawn plates: the clip of a real one, where it is at hand, and what the stages are made of."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sonarrec.config import Continuity, preset
from sonarrec.errors import Diagnostics
from sonarrec.landmarks import PlatePose
from sonarrec.readers import open_log
from sonarrec.recogniser.drawn.drawings import (
    FINE,
    Drawings,
    as_drawn,
    best,
    comparisons,
    levelled,
    shown,
    uneven_light,
)
from sonarrec.recogniser.drawn.model import built_in_model
from sonarrec.recogniser.drawn.pose import BOUNDS, Fit
from sonarrec.recogniser.drawn.stage2 import Plates
from sonarrec.recogniser.drawn.three_stages import PlateStages, pose_fitter
from sonarrec.recogniser.stage2 import ContinuityFilter
from sonarrec.recogniser.tracks import Tracks
from sonarrec.runs.run import Recogniser
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import HeldPlate, PlateScene, scene_sonar
from sonarrec.sonar.frame import Frame, Selection
from sonarrec.sonar.geometry import PolarToFan, PoseTable, plane_from_polar
from tests.support.clip import ACTAG, clip_claims, family
from tests.support.drawn import make_fan
from tests.support.rows import read_rows


def test_every_way_of_showing_a_drawing_is_undone() -> None:
    drawing = np.arange(9, dtype=np.float32).reshape(3, 3)
    views = [shown(drawing, way) for way in range(8)]
    assert len({view.tobytes() for view in views}) == 8
    for way, view in enumerate(views):
        assert np.array_equal(as_drawn(view, way), drawing)


def test_smeared_drawings_match_those_of_a_fine_convolution() -> None:
    """Against a blur of the drawing at forty samples a cell."""
    drawings = Drawings(family())
    smear = (0.12, 0.06)
    cells = family().drawings()[3].astype(np.float32)
    fine = np.pad(np.kron(cells, np.ones((40, 40), np.float32)), 280)
    sigma = [s * 140 for s in smear]
    blurred = cv2.GaussianBlur(fine, (0, 0), sigmaX=sigma[0], sigmaY=sigma[1])[280:560, 280:560]
    wanted = blurred.reshape(FINE, 10, FINE, 10).mean(axis=(1, 3))
    assert drawings.seen(FINE, smear)[3] == pytest.approx(wanted, abs=0.02)


@pytest.mark.parametrize("way", range(8))
def test_a_drawing_is_told_in_every_way_through_uneven_light(way: int) -> None:
    drawings = Drawings(family())
    u, v = np.meshgrid(*(np.linspace(-1, 1, FINE),) * 2)
    for k in range(drawings.count):
        seen = shown(drawings.seen(FINE, (0.06, 0.06))[k], way)
        picture = (40 * seen + 90 + 30 * u - 50 * v + 25 * v**2).astype(np.float32)
        column, match = best(drawings.matches(picture, np.array([0.0, 1.0]), (0.06, 0.06)))
        assert match.argmax() == k
        assert drawings.ways[column[k]] == way
        assert match[k] == pytest.approx(1, abs=1e-3)


def test_what_a_wrong_drawing_leaves_is_patches() -> None:
    """Of two equal matches, that of a noisy picture of the drawing is likelier."""
    rng = np.random.default_rng(0)
    rows = Drawings(family()).seen(FINE, (0.05, 0.05)).reshape(-1, FINE**2)
    down = np.array([[0.0, 1.0]] * 2)
    light = uneven_light(FINE, down)
    right, wrong = levelled(rows[:2], light)
    noise = levelled(rng.standard_normal((2, FINE**2)).astype(np.float32), light)[0]
    patches = levelled(np.stack([wrong - (wrong @ right) * right] * 2), light)[0]
    pictures = levelled(np.stack([right + noise, right + patches]), light)
    found = comparisons(pictures, np.stack([right, right]), light, down)
    assert found[0, 0] == pytest.approx(found[1, 0], abs=0.05)
    noisy, mixed = built_in_model().of_pictures(found)
    assert noisy > mixed + 5


@pytest.mark.parametrize("pose", ["free", "floor"])
def test_a_simulated_tag_is_claimed_where_it_is(pose: PlatePose) -> None:
    """Held and swinging, or lying on the floor before a sonar whose poses are known."""
    tag = HeldPlate(0, range_m=1.0, turned_deg=10.0, tilt_deg=30.0 * (pose == "free"))
    scene = PlateScene(landmark_set=replace(family(), mirrored="no", pose=pose), plate=(tag,))
    scene = replace(scene, frames=12, beams=192, bins=280, clutter=0)
    if pose == "floor":
        scene = replace(scene, swing=0.0, height_m=0.5)
    polar = PolarToFan(scene_sonar(scene).complete("scene"), scene.bins, scene.beams)
    shots = list(render(scene))
    times = np.array([shot.timestamp_ns for shot in shots[:8]])
    poses = PoseTable("poses", {}, times, np.zeros((8, 3)), 1e9)
    stages = PlateStages(preset("default"), polar.fan, scene.landmark_set, poses=poses)
    claims = []
    for shot in shots:
        frame = Frame(shot.index, shot.timestamp_ns, shot.image, polar.fan, polar=polar)
        claims += [(e, *shot.truth) for e in stages.step(frame).estimates if e.declared]
    assert len(claims) >= 10
    for claim, true in claims:
        assert claim.landmark == 0
        assert claim.range_m == pytest.approx(true.range_m, abs=0.02)
        assert claim.bearing_deg == pytest.approx(true.bearing_deg, abs=0.5)
        assert abs(math.remainder(claim.orientation_deg - true.orientation_deg, 360)) < 5
    diagnostics = Diagnostics()
    stages.odometry.report(diagnostics)
    # A plate that is held moves by itself, so poses are not asked for.
    assert bool(diagnostics.problems) == (pose == "floor")
    assert all("pose for 4 of 12" in line for line in diagnostics.problems)


def test_a_plate_that_was_found_is_the_only_peak_about_it() -> None:
    """Else stage 1's peaks on its cells begin groups of their own."""
    fitter = pose_fitter(preset("default"), make_fan(height_m=None), family())
    tracks = Tracks()
    groups = ContinuityFilter(Continuity(), fitter.plane, tracks, np.random.default_rng(0))
    plates, half = Plates(fitter, tracks, groups), fitter.plane.axes[0]
    rows, columns = fitter.plane.inside.shape
    middle = np.array([columns / 2, rows / 2])
    pose = np.array([*middle, half, 0, 0, half])
    fit = Fit(pose, np.full(7, 0.8, np.float32), 0, 0, np.zeros((FINE, FINE), np.float32), 3.0)
    score = np.full((rows, columns), 0.5, np.float32)
    near, far = middle + np.array([[half, 0], [2 * half, 0]])
    kept = np.array([near, far])
    led = plates.lead(Selection(score, kept, np.array([0.5, 0.5]), score, score), [fit])
    assert led.positions.tolist() == [middle.tolist(), far.tolist()]
    assert led.scores.tolist() == pytest.approx([0.8, 0.5])
    y, x = np.mgrid[:rows, :columns]
    off = np.maximum(abs(x - middle[0]), abs(y - middle[1])) / half
    assert led.score_map[off < 0.04] == pytest.approx(0.8, abs=0.02)
    assert led.score_map[(off > 1) & (off < 1.45)].max() < 0.01
    assert (led.score_map[off > 1.55] == 0.5).all()


needs_clip = pytest.mark.skipif(not ACTAG.is_dir(), reason=f"{ACTAG}: the clip is not at hand")


@needs_clip
@pytest.mark.slow
@pytest.mark.parametrize(("preset", "least"), [("default", 0.99), ("offline", 1.0)])
def test_a_real_tag_is_read_on_a_real_sonar(preset: str, least: float) -> None:
    right, claims, frames = clip_claims(ACTAG, family(), preset)
    assert len(right) >= least * frames
    assert {landmark for _, landmark in claims} == {0}


@needs_clip
@pytest.mark.slow
def test_a_real_tag_that_is_not_in_the_set_is_none_of_it() -> None:
    tags = family()
    others = replace(tags, ids=tags.ids[1:], cells=tags.cells[1:])
    assert not clip_claims(ACTAG, others, "default")[1]


@needs_clip
@pytest.mark.slow
def test_corners_of_a_real_still_are_where_they_were_published(tmp_path: Path) -> None:
    for name in ("0.png", "1.png"):  # an ID is declared from two frames on
        (tmp_path / name).write_bytes((ACTAG / "still.png").read_bytes())
    rows = read_rows(ACTAG / "still.csv")
    published = np.array([(float(row["range_m"]), float(row["bearing_deg"])) for row in rows])
    sonar = {"range_min_m": 0.1, "range_max_m": 1.5, "field_of_view_deg": 60, "tilt_deg": 45}
    sonar |= {"layout": "polar", "range_order": "far_first"}
    with open_log(tmp_path / "*.png", sonar=sonar) as log:
        *_, last = Recogniser(log, "default", landmarks=family()).recognise()
    (tag,) = [e for e in last.estimates if e.declared]
    assert tag.landmark == 0
    assert tag.corners is not None
    corners, wanted = plane_from_polar(*tag.corners.T), plane_from_polar(*published.T)
    # Published is the white square, of three cells of seven.
    square = corners.mean(axis=0) + (corners - corners.mean(axis=0)) * 3 / 7
    offset = np.hypot(*(square[:, None] - wanted[None]).transpose(2, 0, 1)).min(axis=0)
    assert np.median(offset) < 0.03


@pytest.mark.parametrize("pose", ["free", "floor"])
def test_poses_have_the_singular_values_of_a_plate(pose: PlatePose) -> None:
    fitter = pose_fitter(preset("default"), make_fan(), replace(family(), pose=pose))
    rng = np.random.default_rng(3)
    poses = np.column_stack([rng.uniform(0, 99, (400, 2)), rng.normal(0, 15, (400, 4))])
    left, values, right = np.linalg.svd(poses[:, 2:].reshape(-1, 2, 2))
    low, high, least = fitter.plane.axes[0] * np.array(BOUNDS[pose])
    values[:, 0] = values[:, 0].clip(low, high)
    values[:, 1] = np.minimum(values[:, 1].clip(least), values[:, 0])
    found = fitter._within(poses)
    assert found[:, 2:] == pytest.approx(((left * values[:, None]) @ right).reshape(-1, 4))
    assert (found[:, :2] == poses[:, :2]).all()
    assert fitter._within(found) == pytest.approx(found)
