"""The motion read off the images of simulated vehicles, against the simulator's own."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.config import Continuity
from sonarrec.recogniser.motion.image_motion import _Evidence
from sonarrec.recogniser.motion.motion_grid import CellGrid, MotionGrid
from sonarrec.recogniser.motion.odometry import Odometry
from sonarrec.recogniser.motion.registration import Registration
from sonarrec.recogniser.plane import working_plane
from sonarrec.simulation.motion import Pose, poses
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import MotionSection, Scene, SonarSection, scene_fan
from sonarrec.sonar.frame import Motion
from sonarrec.sonar.geometry import PoseTable
from tests.studies.learning.random_scenes import random_scene
from tests.support.slow import but_first
from tests.support.vehicle import RATE_HZ, VehicleRun, vehicle_run

FRAMES = 60


def truth(poses: list[Pose]) -> FloatArray:
    """(n - 1, 3) carried to the right and ahead (m), turned (deg), from the poses of n frames."""
    found = []
    for before, now in pairwise(poses):
        x, y = now.x_m - before.x_m, now.y_m - before.y_m
        cos, sin = (way(math.radians(before.pan_deg)) for way in (math.cos, math.sin))
        found.append((x * cos - y * sin, x * sin + y * cos, now.pan_deg - before.pan_deg))
    return np.array(found)


def measured(
    images: Sequence[ByteImage], scene: Scene, given: PoseTable | None = None
) -> list[Motion | None]:
    plane = working_plane("floor", scene_fan(scene), scene.landmark_set.radius_m, 12.0)
    odometry = Odometry(plane, Continuity(), given)
    step_ns = round(1e9 / scene.rate_hz)
    return [odometry.step(plane.warp(image), n * step_ns) for n, image in enumerate(images)]


def images_of(scene: Scene, *along: object) -> list[ByteImage]:
    return [frame.image for frame in render(scene, *along)]


def noise(image: ByteImage, rng: np.random.Generator) -> ByteImage:
    """Levels at random where the image is of the floor."""
    return np.where(image > 0, rng.integers(1, 255, image.shape), 0).astype(np.uint8)


def as_rows(motions: list[Motion | None]) -> tuple[FloatArray, FloatArray]:
    """(n, 3) as `truth`, and the standard errors."""
    known = [m for m in motions if m is not None]
    return (
        np.array([(m.right_m, m.ahead_m, m.pan_deg) for m in known]),
        np.array([(m.right_sigma_m, m.ahead_sigma_m, m.pan_sigma_deg) for m in known]),
    )


@cache
def run_of(seed: int) -> tuple[VehicleRun, tuple[ByteImage, ...]]:
    run = vehicle_run(seed)
    images = images_of(replace(run.scene, frames=FRAMES), run.poses()[:FRAMES], run.ground)
    return run, tuple(images)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [8700, 8702, 8703, 8704])
def test_a_vehicle_s_motion_is_measured_with_its_error(seed: int) -> None:
    """At .35 m/s and up to 20 deg/s. A pixel of the image is 1 cm, a beam .3 deg wide: a few
    thousand grains of speckle fix a step to a fraction of that."""
    run, images = run_of(seed)
    motions = measured(images, run.scene)
    assert motions[0] is None
    known = np.array([m.known for m in motions[1:] if m is not None])
    assert np.mean(known) > 0.95
    found, sigma = as_rows(motions)
    error = (found - truth(run.poses()[:FRAMES]))[known]
    rms = np.sqrt((error**2).mean(axis=0))
    assert (rms < (0.003, 0.004, 0.1)).all()
    squared = ((error / sigma[known]) ** 2).mean(axis=0)
    # Near 1 each. The number of frames alone makes it .8 to 1.2 (59 frames, two deviations); the
    # allowance for heave, wider than these runs need, makes surge smaller.
    assert (squared < 1.7).all()
    assert (squared[[0, 2]] > 0.5).all()
    # Over the way made so far nothing gathers but what single steps leave.
    assert (np.abs(error.sum(axis=0)) < (0.06, 0.06, 1.5)).all()


def test_evidence_of_many_frames_is_that_of_their_faded_mean() -> None:
    """By draws: its chi-square has a mean of 2 where nothing moves, and its sigma is the mean's."""
    rng = np.random.default_rng(0)
    sigma = np.array([0.004, 0.02])
    found, mean = [], []
    for _ in range(300):
        evidence = _Evidence()
        for _ in range(40):
            motion = np.append(rng.normal(0, sigma), 0.0)
            found_now = evidence.add(Registration(motion, np.diag([*sigma**2, 1e-6]), 0.9))
        found.append(found_now)
        mean.append(np.linalg.solve(evidence.matrix, evidence.vector))
    assert np.mean(found) == pytest.approx(2, abs=0.3)
    assert evidence.sigma is not None
    np.testing.assert_allclose(evidence.sigma, np.std(mean, axis=0), rtol=0.12)


@pytest.mark.parametrize("kind", but_first(["plain", "fading", "low_contrast", "fast_pan"]))
def test_a_tripod_is_told_to_stand(kind: str) -> None:
    scene = random_scene(8710, kind, frames=40)
    motions = measured(images_of(scene), scene)
    for motion in motions[1:]:
        assert motion is not None
        assert (motion.right_m, motion.ahead_m) == (0, 0)
    sure = [m for m in motions[1:] if m is not None and m.known]
    assert len(sure) > 0.85 * len(motions)
    assert all(0 < max(m.right_sigma_m, m.ahead_sigma_m) < 0.01 for m in sure)


def test_pictures_that_come_again_to_the_bit_show_no_motion() -> None:
    """As of a recording that is looped: they leave no error, by which nothing can be divided."""
    scene = random_scene(8710, "plain", frames=2)
    motions = measured(images_of(scene) * 6, scene)
    assert all(m is not None and (m.right_m, m.ahead_m) == (0, 0) for m in motions[1:])


def test_where_poses_end_the_images_go_on_from_the_last() -> None:
    scene = random_scene(8710, "plain", frames=12)
    frames = list(render(scene))
    times = np.array([frame.timestamp_ns for frame in frames[:6]])
    pose = np.array([(f.pan_deg, 0.0, 0.0) for f in frames[:6]])
    given = PoseTable("poses", {}, times, pose, 1e9)
    motions = measured([frame.image for frame in frames], scene, given)
    found, _ = as_rows(motions)
    true = [b.pan_deg - a.pan_deg for a, b in pairwise(frames)]
    np.testing.assert_allclose(found[:, 2], true, atol=0.1)
    assert all(m is not None and m.known for m in motions[1:])


@pytest.mark.parametrize(("view_deg", "beams"), but_first([(28.8, 96), (130.0, 256)]))
@pytest.mark.parametrize("pan_deg", [0.1, 0.25])
def test_slow_pans_do_not_add_up_short(view_deg: float, beams: int, pan_deg: float) -> None:
    """From frame to frame each comes short by a fifth and more, for beams leak into their
    neighbours. To and fro, with a blank frame where it turns back."""
    frames, back = 33, 20
    pan = MotionSection(-30.0, (back - 0.5) * pan_deg, 0.0, pan_deg * RATE_HZ)
    sonar = SonarSection(range_bins=256, beams=beams, field_of_view_deg=view_deg)
    scene = Scene(frames=frames, rate_hz=RATE_HZ, sonar=sonar, motion=pan)
    shown = list(render(scene))
    images = [f.image for f in shown]
    images[back] = np.zeros_like(images[back])
    motions = measured(images, scene)
    assert [i for i, m in enumerate(motions) if m and not m.known] == [back, back + 1]
    for first, end in ((0, back - 1), (back + 1, frames - 1)):
        steps, sigmas = as_rows(motions[first + 1 : end + 1])
        true = shown[end].pan_deg - shown[first].pan_deg
        assert abs(true) > 9 * pan_deg
        off = steps[:, 2].sum() - true
        assert abs(off) < 0.1
        assert abs(off) < 3 * np.hypot.reduce(sigmas[:, 2])


@pytest.mark.slow
def test_a_vehicle_that_sets_out_and_stops_is_noticed() -> None:
    """Twelve frames at rest, thirty on the way, thirty at rest where it came to."""
    run, _ = run_of(8702)
    pose = run.poses()[:31]
    poses = [pose[0]] * 12 + pose + [pose[30]] * 30
    images = images_of(replace(run.scene, frames=len(poses)), poses, run.ground)
    found, _ = as_rows(measured(images, run.scene))
    assert (found[:11, :2] == 0).all()
    way = found[12:41]
    np.testing.assert_allclose(way[:, 1], truth(poses)[12:41, 1], atol=0.02)
    assert (found[-5:, :2] == 0).all()
    assert np.abs(found - truth(poses)).sum(axis=0)[0] < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(("speed_m_s", "rate_hz"), [(0.01, 4.0), (0.02, 15.0)])
def test_small_steps_add_up(speed_m_s: float, rate_hz: float) -> None:
    """A small part of a cell (2 cm) a frame, then at rest. From frame to frame such steps are taken
    for none."""
    frames, rest = 80, 20
    drawn = random_scene(8711, "vehicle")
    ahead = MotionSection(surge_m_s=speed_m_s, pan_start_deg=0.0, pan_deg_s=0.0)
    scene = replace(drawn, motion=ahead, rate_hz=rate_hz, frames=frames)
    path = poses(scene)
    path += [path[-1]] * rest
    images = images_of(replace(scene, frames=len(path)), path)
    found, sigma = as_rows(measured(images, scene))
    true = truth(path)
    off = (found - true)[: frames - 1].sum(axis=0)
    stated = np.hypot.reduce(sigma[: frames - 1])
    assert abs(off[1]) < 3 * stated[1]
    # It takes a few frames until it is sure.
    assert -0.02 - 0.05 * true[:, 1].sum() < off[1] < 0.01 + 0.02 * true[:, 1].sum()
    assert abs(off[0]) < 0.03
    assert (found[-4:, :2] == 0).all()


@pytest.mark.slow
def test_where_the_floor_shows_nothing_in_common_it_says_so() -> None:
    """Noise, and black frames: any motion that a slow vehicle can make lies within sigma."""
    run, images = run_of(8700)
    rng = np.random.default_rng(1)
    for frames in ([noise(images[0], rng) for _ in range(12)], [np.zeros_like(images[0])] * 4):
        for motion in measured(frames, run.scene)[1:]:
            assert motion is not None
            assert not motion.known
            assert motion.right_sigma_m >= 0.1
            assert motion.ahead_sigma_m >= 0.1
            assert motion.pan_sigma_deg >= 4


@pytest.mark.slow
def test_a_vehicle_that_loses_the_floor_goes_on_as_it_went_and_finds_it_again() -> None:
    run, images = run_of(8702)
    rng, frames = np.random.default_rng(2), list(images[:40])
    for n in (20, 21, 22):
        frames[n] = noise(frames[n], rng)
    motions = measured(frames, run.scene)
    true = truth(run.poses()[:40])
    found, sigma = as_rows(motions)
    lost = [n for n, m in enumerate(motions) if m is not None and m.ahead_sigma_m > 0.03 and n > 2]
    assert lost == [20, 21, 22, 23]
    for n in lost:
        assert (np.abs(found[n - 1] - true[n - 1]) < 3 * sigma[n - 1]).all()
    assert all(m is not None and m.known for m in motions[20:25])  # tracks go on meanwhile
    assert motions[24] is not None
    assert motions[24].ahead_sigma_m < 0.02


@pytest.mark.slow
def test_a_motion_that_was_not_found_at_first_is_searched_for_again() -> None:
    """The first frame is noise: how little it is like the second says nothing of the third."""
    run, images = run_of(8702)
    frames = [noise(images[0], np.random.default_rng(4)), *images[12:20]]
    found, _ = as_rows(measured(frames, run.scene))
    true = truth(run.poses()[12:20])
    np.testing.assert_allclose(found[4:, 1], true[3:, 1], atol=0.02)


def test_cells_of_a_field_of_view_in_radians_make_no_endless_grid() -> None:
    """191 columns over half a degree: steps of two cells would be 1,100 to either side."""
    step = math.radians(0.5) / 191
    floats = np.float32(1.25), 0.01, np.float32(-step * 95), step, np.float32(0.7)
    tracemalloc.start()
    MotionGrid(CellGrid((256, 191), *floats))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6  # 0.1 deg a step: 40,000 motions of 48 blocks; 1.7 GB by two cells a step
