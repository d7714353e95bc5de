"""Stage 1 against drawn discs and a correlation written out."""

import dataclasses
import math
import warnings
from itertools import islice

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec import config
from sonarrec.landmarks import load_landmarks
from sonarrec.recogniser import stage1
from sonarrec.recogniser.plane import FanPlane, Plane, working_plane
from sonarrec.recogniser.stage1 import CandidateSelector, Correlation
from sonarrec.simulation.render import render
from sonarrec.simulation.scene import scene_fan
from sonarrec.sonar.frame import Fan, Selection
from tests.studies.learning.random_scenes import random_scene
from tests.support.drawn import SECTORS, disc_pattern, draw_on_floor, make_fan, speckled, whole_disc

BASIN = load_landmarks("basin")
BEAM_DEG = 0.3
FAN = make_fan(512)
# The thresholds of this file, so that tuning the defaults does not touch it.
RING = dataclasses.replace(
    config.preset("default").candidates, threshold=0.4, ring_full_contrast=1.6, min_visible=0.35
)
EDGE = dataclasses.replace(config.preset("paper").candidates, threshold=0.35, min_visible=0.35)
DETECTORS = {"ring": RING, "edge": EDGE}


def selector(kind: str, fan: Fan = FAN) -> tuple[Plane, CandidateSelector]:
    settings = DETECTORS[kind]
    plane = working_plane(settings.plane, fan, BASIN.radius_m, settings.disc_radius_px)
    return plane, CandidateSelector(settings, plane, BASIN, BEAM_DEG)


SELECTORS = {kind: selector(kind) for kind in DETECTORS}


def picture(rng, places, sectors=SECTORS[1], fan=FAN) -> np.ndarray:
    """Speckled fan image of discs at (range_m, bearing_deg) with a dark plate under each."""
    bright, dark = np.zeros((2, fan.rows, fan.columns))
    for range_m, bearing_deg in places:
        pattern = disc_pattern(sectors, rng.uniform(0, 2 * np.pi))
        disc, seen = draw_on_floor(fan, range_m, bearing_deg, BASIN.radius_m, pattern)
        plate, _ = draw_on_floor(fan, range_m, bearing_deg, BASIN.radius_m, whole_disc)
        bright, dark = bright + disc, dark + plate
    return speckled(bright, seen, rng, dark=dark)


def miss(plane: Plane, selection: Selection, range_m: float, bearing_deg: float) -> float:
    """Distance from a true centre to the nearest candidate, in working pixels."""
    truth = np.ravel(plane.from_polar(np.array([range_m]), np.array([bearing_deg])))
    return float(np.hypot(*(selection.positions - truth).T).min(initial=math.inf))


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**32 - 1), range_m=st.floats(1.7, 3.2), bearing_deg=st.floats(-9.5, 9.5)
)
def test_the_ring_filter_finds_a_centre_to_a_part_of_a_pixel(seed, range_m, bearing_deg):
    plane, select = SELECTORS["ring"]
    rng = np.random.default_rng(seed)
    sectors = SECTORS[int(rng.integers(1, 5))]
    found = select(plane.warp(picture(rng, [(range_m, bearing_deg)], sectors)))
    assert miss(plane, found, range_m, bearing_deg) < 0.4
    assert found.scores[0] == found.scores.max() > 0.9


def test_the_outline_finds_centres_to_within_its_tolerance():
    """The paper's detector is as coarse as the band in which an edge counts as on the outline."""
    plane, select = SELECTORS["edge"]
    rng = np.random.default_rng(0)
    misses = []
    for _ in range(8):
        place = (rng.uniform(1.7, 3.2), rng.uniform(-9, 9))
        misses.append(miss(plane, select(picture(rng, [place])), *place))
    assert np.median(misses) < 1
    assert max(misses) < 0.2 * plane.axes[0]


@pytest.mark.parametrize("kind", DETECTORS)
def test_of_several_discs_all_are_found_best_first_and_apart(kind):
    plane, select = SELECTORS[kind]
    places = [(1.8, -6.0), (2.1, 7.0), (2.7, -2.0), (3.2, 6.0)]
    found = select(plane.warp(picture(np.random.default_rng(3), places)))
    for place in places:
        assert miss(plane, found, *place) < 0.2 * plane.axes[0]
    assert (np.diff(found.scores) <= 0).all()
    assert found.scores.max() <= 1
    offset = (found.positions[:, None] - found.positions[None]) / (2 * np.array(plane.axes))
    distance = np.hypot(offset[..., 0], offset[..., 1]) + 9 * np.eye(len(offset))
    assert distance.min() >= DETECTORS[kind].separation - 1e-6


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 60), most=st.integers(1, 40))
def test_kept_peaks_are_those_of_a_comparison_of_all(seed, count, most):
    _, select = SELECTORS["ring"]
    across, along = select._diameter
    side = select._config.separation * across
    positions = np.random.default_rng(seed).uniform(-side, 6 * side, (count, 2))
    kept: list[int] = []
    for i, (x, y) in enumerate(positions):
        offsets = np.hypot(*((positions[kept] - (x, y)) / (across, along)).T)
        if len(kept) < most and offsets.min(initial=math.inf) >= select._config.separation:
            kept.append(i)
    assert select._suppress_neighbours(positions, most) == kept


def test_peaks_at_the_edge_of_an_image_that_is_not_whole_blocks_are_scored():
    """As in a part of a mean: whatever is in the last rows and columns lies in the image."""
    plane, _ = selector("ring", WIDE)
    plane.inside, plane.shape = np.ones((321, 323), np.uint8), (321, 323)
    select = CandidateSelector(dataclasses.replace(RING, threshold=0.1), plane, BASIN, BEAM_DEG)
    found = select(np.random.default_rng(7).integers(1, 255, plane.shape).astype(np.uint8))
    assert (found.positions <= np.array([322, 320]) + 1).all()
    assert found.positions.max() > 300


WIDE = make_fan(512, 0.5, 10.0, 130.0, tilt_deg=15.0, height_m=1.5)


@pytest.mark.slow
def test_of_many_discs_on_a_large_floor_all_are_found():
    """A fan of 130 deg to 10 m shows a floor forty times as large as the one above."""
    plane, select = selector("ring", WIDE)
    places = [(r, b) for r in (3.0, 4.5, 6.0) for b in range(-55, 56, 11)]
    found = select(plane.warp(picture(np.random.default_rng(5), places, fan=WIDE)))
    for place in places:
        assert miss(plane, found, *place) < 0.2 * plane.axes[0]


@pytest.mark.slow
def test_noise_on_the_largest_floors_gives_no_more_than_eight_times_as_many_candidates():
    wide = make_fan(1024, 0.5, 40.0, 130.0, tilt_deg=15.0, height_m=1.5)
    settings = dataclasses.replace(RING, threshold=0.1)
    plane = working_plane("floor", wide, BASIN.radius_m, RING.disc_radius_px)
    noise = np.random.default_rng(6).integers(1, 255, (wide.rows, wide.columns)).astype(np.uint8)
    found = CandidateSelector(settings, plane, BASIN, BEAM_DEG)(plane.warp(noise))
    assert len(found.positions) == 8 * RING.max_candidates


@pytest.mark.parametrize("kind", DETECTORS)
@pytest.mark.parametrize("bearing_deg", [-14.0, 13.0, 15.0, 17.0])
def test_a_part_of_a_ring_at_the_fan_s_edge_is_found_where_it_is_as_much_as_asked(
    kind, bearing_deg
):
    # At 2.4 m a disc spans 7.5 degrees: from 45 to 62 % of its ring lies within 14.4 degrees, and
    # of the last a quarter.
    plane, select = SELECTORS[kind]
    found = select(plane.warp(picture(np.random.default_rng(1), [(2.4, bearing_deg)])))
    off = miss(plane, found, 2.4, bearing_deg) / plane.axes[0]
    assert off > 0.4 if bearing_deg == 17 else off < (0.05 if kind == "ring" else 0.2)


@pytest.mark.parametrize("kind", DETECTORS)
@pytest.mark.parametrize("level", [0, 1, 128, 255])
def test_black_and_even_frames_give_none_and_no_warning(kind, level):
    plane, select = SELECTORS[kind]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        image = np.full((FAN.rows, FAN.columns), level, np.uint8)
        found = select(plane.warp(image))
    assert found.positions.shape == (0, 2)
    assert found.scores.shape == (0,)
    assert np.isfinite(found.score_map).all()


@pytest.mark.parametrize("gain", [0.5, 0.8])
@pytest.mark.parametrize("kind", DETECTORS)
def test_gain_does_not_change_the_score(kind, gain):
    plane, select = SELECTORS[kind]
    image = picture(np.random.default_rng(4), [(2.2, 1.0)])
    dim = np.where(image > 0, 30 + gain * image, 0).astype(np.uint8)
    loud, quiet = select(plane.warp(image)), select(plane.warp(dim))
    assert quiet.scores[0] == pytest.approx(loud.scores[0], abs=0.05)
    assert miss(plane, quiet, 2.2, 1.0) < 0.2 * plane.axes[0]


@pytest.mark.parametrize(("gain", "power"), [("root", 0.5), ("none", 0.0)])
def test_the_outline_s_score_is_the_count_of_edge_pixels_written_out(monkeypatch, gain, power):
    monkeypatch.setattr(stage1, "BLUR_PX", 3)
    monkeypatch.setattr(stage1, "EDGE_TOLERANCE_PX", 1)
    fan = make_fan(64)
    settings = dataclasses.replace(EDGE, min_visible=0.361, edge_gain=gain)
    plane = FanPlane(fan, BASIN.radius_m)
    select = CandidateSelector(settings, plane, BASIN, BEAM_DEG)
    rng = np.random.default_rng(6)
    image = picture(rng, [(2.4, 2.0)], fan=fan)
    score = select(image).score_map

    # Canny's edges as OpenCV finds them, without those that the fan's own border makes.
    sigma = image[plane.inside == 1].std()
    limits = settings.canny_low * sigma, settings.canny_high * sigma
    edges = cv2.Canny(cv2.GaussianBlur(image, (3, 3), 0), *limits)
    rows, columns = image.shape
    inside = np.pad(plane.inside, 2, constant_values=1)
    edge_rows, edge_columns = np.nonzero(edges)
    on_edge = np.zeros((rows, columns), bool)
    for r, c in zip(edge_rows, edge_columns, strict=True):
        if inside[r : r + 5, c : c + 5].all():
            on_edge[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2] = True
    # Eq. 1 and 2: the outline's pixels round a candidate.
    across = BASIN.radius_m / fan.metres_per_pixel
    along = across * math.cos(math.radians(fan.tilt_deg))
    reach = math.ceil(across) + 1
    outline = [
        (y, x)
        for y in range(-reach, reach + 1)
        for x in range(-reach, reach + 1)
        if abs(math.hypot(x / across, y / along) - 1) < 0.5 / along
    ]
    assert on_edge.any()
    expected = np.zeros((rows, columns))
    for r in range(rows):
        for c in range(columns):
            near = ((r + y, c + x) for y, x in outline)
            there = [(y, x) for y, x in near if 0 <= y < rows and 0 <= x < columns]
            share = sum(plane.inside[p] for p in there) / len(outline)
            if share >= settings.min_visible:
                hits = sum(on_edge[p] for p in there)
                expected[r, c] = min(hits / len(outline) / share**power, 1)
    np.testing.assert_allclose(score, expected, atol=1e-5)


@pytest.mark.slow
def test_discs_whose_gap_the_beams_fill_are_candidates():
    """Against where the simulator put them; by a gap that counts .75, one in eight is missed."""
    scene = random_scene(8730, "tiny_discs", frames=60)
    settings = config.preset("default").candidates
    plane = working_plane("floor", scene_fan(scene), 0.06, settings.disc_radius_px)
    select = CandidateSelector(settings, plane, scene.landmark_set, 0.4)
    off = []
    for frame in islice(render(scene), 0, None, 5):
        whole = [t for t in frame.truth if t.visible > 0.99]
        found = select(plane.warp(frame.image)) if whole else None
        off += [miss(plane, found, t.range_m, t.bearing_deg) for t in whole if found]
    assert len(off) > 8
    assert np.mean(np.array(off) < 0.3 * plane.axes[0]) > 0.97


@pytest.mark.parametrize("shape", [(40, 31), (9, 50), (7, 5), (1, 12)])
def test_a_correlation_is_the_sum_written_out_for_image_after_image(shape):
    """Also of images that the kernel is larger than; of a kernel that half a turn leaves alike."""
    rng = np.random.default_rng(8)
    kernel = rng.normal(size=(11, 11)).astype(np.float32)
    with pytest.raises(ValueError, match="symmetric"):
        Correlation(kernel, shape)
    kernel += kernel[::-1, ::-1].copy()
    correlation = Correlation(kernel, shape)
    for _ in range(3):
        image = rng.normal(size=shape).astype(np.float32)
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(image, 5), kernel.shape)
        expected = np.einsum("ijkl,kl->ij", windows.astype(float), kernel.astype(float))
        single_precision = 1e-6 * abs(expected).max()
        np.testing.assert_allclose(correlation(image), expected, rtol=0, atol=single_precision)
