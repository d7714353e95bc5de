"""The averaged shape matrix by properties, and what is read off it by drawn discs."""

import math
from itertools import islice
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec import Recogniser, open_log
from sonarrec.config import Features
from sonarrec.landmarks import load_landmarks
from sonarrec.recogniser.plane import FloorPlane
from sonarrec.recogniser.stage3.appearance import AppearanceMeasurement, _Picture
from sonarrec.recogniser.stage3.model_file import built_in_weights
from sonarrec.recogniser.stage3.opinions import Opinion
from sonarrec.recogniser.stage3.reader import Reader
from sonarrec.recogniser.stage3.shape_matrix import (
    ANGLES,
    STEP,
    STEP_DEG,
    ShapeSampler,
    rotated_codes,
)
from tests.support.drawn import (
    SECTORS,
    disc_pattern,
    make_fan,
    speckled_disc,
    surroundings,
    whole_disc,
)
from tests.support.slow import but_first
from tests.support.tracks import follow, made_up_tracks

SAMPLES = Path(__file__).parents[2] / "sample_data"
BASIN = load_landmarks("basin")
FAN = make_fan(512)
PLANE = FloorPlane(FAN, BASIN.radius_m, 15.0)
SAMPLER = ShapeSampler(BASIN, PLANE.axes)
LINES = len(SAMPLER.radii)
READ = Reader(built_in_weights(), rotated_codes(BASIN))


def new_measurement(memory: float = 20.0, lines: int = LINES, width_deg: float = 0.01):
    """And the tracks it measures."""
    tracks = made_up_tracks()
    memory = Features(memory_frames=memory)
    return AppearanceMeasurement(memory, PLANE, tracks, lines, BASIN, READ, width_deg), tracks


SEEN = np.ones((1, 1, ANGLES), bool)
NOTHING = np.empty((0, 1, ANGLES))
ANGLE = np.arange(ANGLES) * 2 * np.pi / ANGLES


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), memory=st.sampled_from([1.0, 5.0, 20.0]))
def test_the_average_is_the_fading_sum_over_what_was_seen(seed, memory):
    rng = np.random.default_rng(seed)
    measurement, tracks = new_measurement(memory, 2)
    follow(tracks, 4)
    frames = 6
    grey = rng.normal(size=(frames, 1, 2, ANGLES))
    seen = rng.random(grey.shape) < 0.7
    for g, s in zip(grey, seen, strict=True):
        found = measurement.gather(g, s)
    average, count = found["brightness"], found["count"]
    assert found["frames"].tolist() == [frames]
    keep = 1 - 1 / memory
    for line in range(2):
        for a in range(0, ANGLES, 7):
            weights = [keep ** (frames - 1 - t) * seen[t, 0, line, a] for t in range(frames)]
            assert count[0, line, a] == pytest.approx(sum(weights))
            if sum(weights) > 1e-6:
                mean = sum(w * grey[t, 0, line, a] for t, w in enumerate(weights)) / sum(weights)
                assert average[0, line, a] == pytest.approx(mean)


def test_tracks_keep_their_own_average_and_lost_ones_are_forgotten():
    measurement, tracks = new_measurement(10.0, 1)

    def gathered(*levels):
        level = np.array(levels, float)[:, None, None] * SEEN
        return measurement.gather(level, np.repeat(SEEN, len(levels), 0))

    follow(tracks, 1, 2, 5)
    gathered(10, 20, 50)
    follow(tracks, 2, 5, 6)
    np.testing.assert_allclose(gathered(20, 50, 60)["brightness"][:, 0, 0], [20, 50, 60])
    follow(tracks, 5)
    follow(tracks, 5, 6)
    found = gathered(50, -10)
    # Nothing of the first 6 is left.
    np.testing.assert_allclose(found["brightness"][:, 0, 0], [50, -10])
    np.testing.assert_allclose(found["count"][:, 0, 0], [1 + 0.9 + 0.81, 1])
    assert found["frames"].tolist() == [3, 1]


@pytest.mark.parametrize("same", [True, False])
def test_a_track_that_comes_back_earns_what_it_was_by_looking_the_same(same):
    """Half of the old frames count at once where it does, and never where it does not."""
    measurement, tracks = new_measurement(10.0, 1)
    picture, other = np.sin(ANGLE)[None, None], np.cos(2 * ANGLE)[None, None]
    follow(tracks, 3)
    for _ in range(4):
        before = measurement.gather(picture, SEEN)
    follow(tracks, away=[3])
    for _ in range(50):
        measurement.gather(NOTHING, NOTHING)
    follow(tracks, 3)
    now, count = (picture if same else other), (0.5 * before["count"] if same else 0.0)
    for i in range(4):
        found = measurement.gather(now, SEEN)
        count = 1 + (count if i == 0 else 0.9 * count)
        np.testing.assert_allclose(found["brightness"], now)
        np.testing.assert_allclose(found["count"], count)
        assert found["frames"].tolist() == [i + (3 if same else 1)]
        # Another picture is another episode of the track's life.
        assert (found["episode"] == before["episode"]).all() == same


def test_what_looks_somewhat_the_same_goes_on_in_its_old_episode_after_three_frames():
    measurement, tracks = new_measurement(10.0, 1)
    picture = np.sin(ANGLE)[None, None]
    alike = (0.6 * np.sin(ANGLE) + 0.8 * np.cos(3 * ANGLE))[None, None]  # correlation .6
    follow(tracks, 3)
    first = measurement.gather(picture, SEEN)["episode"].tolist()
    follow(tracks, away=[3])
    measurement.gather(NOTHING, NOTHING)
    follow(tracks, 3)
    again = [measurement.gather(alike, SEEN)["episode"].tolist() for _ in range(4)]
    assert again[0] == again[1] > first
    assert again[2] == again[3] == first


def test_what_is_passed_is_averaged_as_it_lies():
    """Each frame's matrix counts from a line of sight that has turned by a step and more."""
    measurement, tracks = new_measurement(20.0, 1)
    picture = np.random.default_rng(3).normal(size=(1, 1, ANGLES))
    seen = SEEN.copy()
    seen[..., 5] = False  # on the object, not in the matrix
    for turned in (0, 1, 2, 4, 40, -3):
        # As the line of sight turns one way, the object turns the other beneath it.
        now, shown = (np.roll(of_object, -turned, axis=2) for of_object in (picture, seen))
        follow(tracks, 7, sight_deg=[turned * STEP_DEG + 0.3 * STEP_DEG])
        found = measurement.gather(now, shown)
        np.testing.assert_allclose(found["brightness"][shown], now[shown])
        assert (found["count"][~shown] == 0).all()


def averaged(pattern, seed: int, frames: int = 16, range_m: float = 2.1, bearing_deg: float = 3.0):
    """Probabilities and turn after some frames of one speckled disc on its dark plate."""
    rng = np.random.default_rng(seed)
    measurement, tracks = new_measurement()
    centre = np.stack(PLANE.from_polar(np.array([range_m]), np.array([bearing_deg])), axis=-1)
    sight = PLANE.line_of_sight(centre)
    track = follow(tracks, 1, positions=centre)
    for _ in range(frames):
        picture = speckled_disc(rng, FAN, range_m, bearing_deg, BASIN.radius_m, pattern)
        image = PLANE.warp(picture)
        grey, visible = SAMPLER(image, PLANE.inside, centre, sight, *surroundings(image))
        evidence = measurement.gather(grey, visible)
    known = measurement.beliefs([track.with_columns(**evidence)])
    return known.probabilities[0], float(sight[0] + known.rotation[0] * STEP)


@pytest.mark.parametrize("landmark", sorted(SECTORS))
@pytest.mark.parametrize("turn_deg", but_first([137, 20, 291]))
def test_a_landmark_is_known_by_its_id_and_orientation(landmark, turn_deg):
    p, orientation = averaged(disc_pattern(SECTORS[landmark], math.radians(turn_deg)), turn_deg)
    assert p[landmark - 1] > 0.5
    symmetry = 180 if landmark == 2 else 360
    off = (math.degrees(orientation) - turn_deg + symmetry / 2) % symmetry - symmetry / 2
    assert abs(off) < 6


@pytest.mark.parametrize("seed", but_first(range(3)))
def test_a_blank_and_a_filled_disc_are_none_of_these(seed):
    """PAPER's trap: to the single frame they are more ID.1 and more ID.4 than those themselves."""
    for pattern in (disc_pattern((0, 0, 0, 0)), whole_disc, lambda x, _: 0 * x):
        assert averaged(pattern, seed)[0][4] > 0.5


@pytest.mark.parametrize(("width_deg", "needed"), [(0.4, 2), (4.0, 8)])
def test_an_id_is_earned_by_frames_and_by_more_of_a_disc_few_beams_wide(width_deg, needed):
    """At 2 m a disc of 0.3 m is 21 beams of 0.4 deg wide, and two of 4 deg."""
    measurement, tracks = new_measurement(width_deg=width_deg)
    centre = np.stack(PLANE.from_polar(np.array([2.0]), np.array([0.0])), axis=-1)
    grey = np.zeros((1, LINES, ANGLES))

    def enough_evidence() -> bool:
        track = follow(tracks, 1, positions=centre)
        track = track.with_columns(**measurement.gather(grey, grey == 0))
        return bool(measurement.beliefs([track]).enough_evidence[0])

    assert [enough_evidence() for _ in range(10)] == [frame >= needed for frame in range(1, 11)]
    tracks["shown"] = False
    assert not enough_evidence()


def test_what_is_written_of_a_symbol_is_what_lies_there():
    """In the sample log, where the truth says each disc's orientation: of the directions a step and
    more from a sector's edge, nine of ten are read as they are, of declared landmarks."""
    truth = pd.read_csv(SAMPLES / "pan" / "gt.csv").set_index(["frame", "landmark"])
    right = []
    with open_log(SAMPLES / "pan") as log:
        for result in islice(Recogniser(log).recognise(), 60):
            for e in result.estimates:
                if e.method != "framework" or not e.declared:
                    continue
                assert len(e.read) == ANGLES
                orientation = truth["orientation_deg"].get((result.index, e.landmark), math.nan)
                angle = np.degrees((np.arange(ANGLES) + 0.5) * STEP) + 90 - e.bearing_deg
                angle = np.radians(angle - orientation) % (2 * np.pi)
                code = BASIN.codes(angle)[BASIN.ids.index(e.landmark)] > 0.5
                inner = (code == np.roll(code, 1)) & (code == np.roll(code, -1))
                read = np.array([int(digit) for digit in e.read]) > 4
                right.append((read == code)[inner].mean())
    assert len(right) > 50
    assert np.mean(right) > 0.9


def test_pictures_are_compared_over_the_cells_that_both_have_seen() -> None:
    rng = np.random.default_rng(2)
    (total, other), seen = rng.uniform(0, 9, (2, 6, 12)), np.ones((6, 12))
    mine, theirs = seen.copy(), 2 * seen
    mine[:2], theirs[3:, :5] = 0, 0
    both = (mine > 0) & (theirs > 0)
    wanted = np.corrcoef(total[both], other[both] / 2)[0, 1]
    picture = _Picture(total, mine, 0, Opinion())
    assert picture.correlation(other, theirs) == pytest.approx(wanted)
    assert picture.correlation(other, np.where(mine > 0, 0, theirs)) == 0
