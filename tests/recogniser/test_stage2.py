"""The table of tracks; stage 2: particle groups on score maps with known peaks."""

import dataclasses
import math

import numpy as np
import pytest

from sonarrec import config
from sonarrec.landmarks import load_landmarks
from sonarrec.recogniser import stage2
from sonarrec.recogniser.plane import FanPlane
from sonarrec.recogniser.stage1 import CandidateSelector
from sonarrec.recogniser.stage2 import ContinuityFilter, Particles
from sonarrec.recogniser.tracks import Tracks
from sonarrec.sonar.frame import Motion, Selection
from sonarrec.truth.match import share_in_image
from tests.support.drawn import SECTORS, disc_pattern, make_fan, speckled_disc
from tests.support.slow import but_first

BASIN = load_landmarks("basin")
FAN = make_fan(512)
PLANE = FanPlane(FAN, BASIN.radius_m)
DIAMETER = 2 * PLANE.axes[0]
# The paper's rules with nothing added: only the strikes delete.
PAPER = dataclasses.replace(
    config.preset("paper").continuity, particles=1500, hit_power=4.0, motion="random_walk"
)
START = (190.0, 250.0)


def peaks(*places, width: float = 6.0, height: float = 1.0, base: float = 0.0) -> np.ndarray:
    """A score map with bumps at (column, row)."""
    row, column = np.mgrid[0 : PLANE.shape[0], 0 : PLANE.shape[1]]
    score = np.full(PLANE.shape, base)
    for x, y in places:
        bump = height * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * width**2))
        score = np.maximum(score, bump)
    return score.astype(np.float32)


def selection(score: np.ndarray, *candidates) -> Selection:
    places = np.array(candidates, float).reshape(-1, 2)
    return Selection(score, places, np.full(len(places), 0.9), np.zeros_like(score), 1.0)


EVEN = np.ones(PLANE.shape, np.float32)


def seen(*places) -> Selection:
    """A peak and a candidate at each place."""
    return selection(peaks(*places), *places)


def new_filter(settings=PAPER, seed: int = 0, **changes) -> ContinuityFilter:
    settings = dataclasses.replace(settings, **changes)
    return ContinuityFilter(settings, PLANE, Tracks(), np.random.default_rng(seed))


def away(follow: ContinuityFilter) -> list[int]:
    """Numbers of the tracks that are remembered."""
    return follow._tracks["number"][follow._tracks["remembered"]].tolist()


def resampled(weight_map: np.ndarray, places: np.ndarray, settings, seed: int) -> np.ndarray:
    """How often each particle at a whole-number place survives one step without any walk."""
    follow = new_filter(settings, seed)
    follow.step(selection(weight_map, tuple(places[0])))
    # No other way in: the particles are put where their weights are known.
    follow._tracks["particles"] = places[None].astype(np.float32)
    follow.step(selection(weight_map))
    kept, counts = np.unique(follow._tracks["particles"][0], axis=0, return_counts=True)
    table = {tuple(p): int(c) for p, c in zip(kept, counts, strict=True)}
    return np.array([table.get(tuple(p), 0) for p in places.astype(np.float32)])


@pytest.mark.slow
def test_resampling_is_systematic_and_unbiased():
    still = dataclasses.replace(
        PAPER, sigma_px=0.0, sigma_known_px=0.0, particles=300, z_hit=0.8, z_rand=0.2, hit_power=2.0
    )
    rng = np.random.default_rng(1)
    score = rng.random(PLANE.shape).astype(np.float32)
    flat = rng.permutation(200 * 200)[:300]
    places = np.column_stack([flat % 200 + 90, flat // 200 + 150])
    hit = score[places[:, 1], places[:, 0]].astype(float)
    weight = 0.8 * hit**2 + 0.2 / 300  # Eq. 4
    expected = 300 * weight / weight.sum()
    total = np.zeros(300)
    runs = 200
    for seed in range(runs):
        counts = resampled(score, places, still, seed)
        assert counts.sum() == 300
        # Only systematic (not multinomial) resampling keeps every count this near.
        assert (np.abs(counts - expected) < 1 + 1e-6).all()
        total += counts
    np.testing.assert_allclose(total / runs, expected, atol=5 * 0.5 / math.sqrt(runs))


def test_a_particle_walks_randn_sigma_in_each_frame():
    """Eq. 3. On an even map resampling keeps every particle, so each step can be seen."""
    follow = new_filter()
    follow.step(selection(EVEN, START))
    before = follow._tracks["particles"].copy()
    follow.step(selection(EVEN))
    walked = follow._tracks["particles"] - before
    np.testing.assert_allclose(walked.std(axis=1), PAPER.sigma_px, rtol=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_noise_dies_by_the_rule_of_25_percent_five_times(seed):
    follow = new_filter(seed=seed)
    rng = np.random.default_rng(seed)
    follow.step(selection(rng.random(PLANE.shape, np.float32) * 0.4, START))
    wide = []
    for _ in range(15):
        groups = follow.step(selection(rng.random(PLANE.shape, np.float32) * 0.4))
        if not len(groups["number"]):
            break
        wide.append((groups["spread"] > 0.25).any())
    assert 4 <= len(wide) < 15  # five strikes take five frames
    assert wide[-4:] == [True] * 4
    assert wide[-5:] != [True] * 5


@pytest.mark.parametrize(("count", "lives"), [("in_a_row", 4), ("in_all", 1)])
def test_a_narrow_frame_in_between_starts_the_count_again(count, lives):
    """Unless strikes count in all: then the fifth deletes, at the second loss."""
    follow = new_filter(count_strikes=count)
    noise = np.full(PLANE.shape, 0.3, np.float32)
    follow.step(seen(START))
    for life in range(4):
        for _ in range(4):  # lost for less than five frames
            groups = follow.step(selection(noise))
        groups = follow.step(selection(peaks(START)))
        assert list(groups["number"]) == [1] * (life < lives)
        assert (groups["spread"] <= 0.25).all()


def test_p_hit_is_the_map_s_power_or_its_share_of_the_group():
    """Eq. 4 written out for four particles, of which one is on a peak."""
    still = dataclasses.replace(PAPER, z_hit=0.8, z_rand=0.2, hit_power=2.0, particles=4)
    places = np.array([[(10, 10), (20, 10), (20, 20), (9999, 0)]], np.float32)
    score = np.full(PLANE.shape, 0.1, np.float32)
    score[10, 10] = 0.9
    hits = np.array([0.81, 0.01, 0.01, 0.0])
    for p_hit, of_all in (("map", 1.0), ("normalised", hits.sum())):
        weight = 0.8 * hits / of_all + 0.2 / 4
        particles = Particles(dataclasses.replace(still, p_hit=p_hit), np.random.default_rng(0))
        found = particles.weigh(places, score)
        np.testing.assert_allclose(found[0], weight / weight.sum(), rtol=1e-5)


@pytest.mark.parametrize("seed", but_first([0, 1]))
def test_a_group_on_a_landmark_lives_with_a_spread_of_some_pixels(seed):
    """The trap: 4 to 8 px per axis after weighting, with the paper's edge map."""
    select = CandidateSelector(config.preset("paper").candidates, PLANE, BASIN, 0.3)
    follow, rng = new_filter(seed=seed), np.random.default_rng(seed)
    pattern = disc_pattern(SECTORS[1 + seed], 0.7)
    spreads = []
    for _ in range(15):
        image = speckled_disc(rng, FAN, 2.2, 2.0, BASIN.radius_m, pattern)
        groups = follow.step(select(image))
        assert 1 in groups["number"]
        spreads.append(groups["spread"][0] * 2 * np.array(PLANE.axes))
    typical = np.median(spreads[1:], axis=0)
    assert (typical > 2).all()
    assert (typical < 10).all()
    truth = np.ravel(PLANE.from_polar(np.array([2.2]), np.array([2.0])))
    np.testing.assert_allclose(groups["position"][0], truth, atol=4)


@pytest.mark.parametrize("pan_deg", [-3.0, 0.8, 4.0])
def test_a_known_pan_moves_the_groups(pan_deg):
    follow = new_filter(motion="image", sigma_px=0.05, sigma_known_px=0.05, spread_limit=9.0)
    range_m, bearing_deg = np.array([2.2, 2.9]), np.array([2.0, -5.0])
    follow.step(selection(EVEN, *np.transpose(PLANE.from_polar(range_m, bearing_deg))))
    groups = follow.step(selection(EVEN), Motion(pan_deg))
    turned = np.transpose(PLANE.from_polar(range_m, bearing_deg - pan_deg))
    np.testing.assert_allclose(groups["position"], turned, atol=0.05)


def test_a_group_pulled_off_what_the_pan_says_is_deleted(monkeypatch):
    monkeypatch.setattr(stage2, "OWN_CANDIDATE", 2.0)  # to go to another's candidate
    follow = new_filter(motion="image", sigma_known_px=10.0)
    follow.step(seen(START))
    assert list(follow.step(selection(peaks(START)), Motion(0.0))["number"]) == [1]
    elsewhere = (START[0] + 0.45 * DIAMETER, START[1])
    groups = follow.step(seen(elsewhere), Motion(0.0))
    assert list(groups["number"]) == [2]  # what pulled it is a new object


def test_of_two_groups_on_one_object_the_older_stays():
    follow = new_filter()
    a, b = START, (START[0] + 0.8 * DIAMETER, START[1])
    groups = follow.step(seen(a))
    groups = follow.step(seen(a, b))
    assert list(groups["number"]) == [1, 2]
    for t in range(12):  # the second object runs into the first
        b = (START[0] + max(0.8 - 0.08 * t, 0) * DIAMETER, START[1])
        groups = follow.step(seen(a, b))
    assert list(groups["number"]) == [1]
    np.testing.assert_allclose(groups["position"][0], a, atol=2)


def test_existence_is_bayes_rule_on_hits_and_misses():
    follow, existence, score = new_filter(), 0.5, peaks(START)
    follow.step(selection(score, START))
    for hit in [True, True, False, True, True, True, False, False]:
        groups = follow.step(selection(score, *([START] if hit else [])))
        odds = existence / (1 - existence) * (0.9 / 0.4 if hit else 0.1 / 0.6)
        existence = min(max(odds / (1 + odds), 0.01), 0.99)
        assert groups["existence"][0] == pytest.approx(existence)


def test_an_object_that_is_no_longer_a_candidate_is_given_up():
    follow = new_filter(min_existence=0.05, strikes=99)
    follow.step(seen(START))
    # Odds of 1 fall by 6 with each miss: 1/6 and 1/36 are left, which is below .05 at the second.
    assert [len(follow.step(selection(peaks(START)))["number"]) for _ in range(2)] == [1, 0]


# --- Groups that leave the view and return --------------------------------------------------------

DEFAULT = config.preset("default").continuity
REMEMBER = dataclasses.replace(DEFAULT, particles=500, sigma_px=3.0, sigma_known_px=1.0)


def seen_at(pan_deg: float, range_m: float = 2.6, azimuth_deg: float = 10.0) -> tuple[float, float]:
    """Where a still object shows once the sonar looks `pan_deg` to the right."""
    column, row = PLANE.from_polar(np.array([range_m]), np.array([azimuth_deg - pan_deg]))
    return float(column[0]), float(row[0])


def swept(follow: ContinuityFilter, pans, hidden=(), else_at=(), width=6.0) -> list[list[int]]:
    """Numbers in view at each pan, of one still object that is a candidate where half of it shows.

    else_at: where there is a peak of the same width that is none, while it does not show.
    """
    numbers = []
    for i, pan in enumerate(pans):
        shown = [seen_at(pan)] if abs(10.0 - pan) < 14 and i not in hidden else []
        motion = Motion(pan - pans[i - 1]) if i else None
        score = peaks(*(shown or else_at), width=width)
        numbers.append(follow.step(selection(score, *shown), motion)["number"].tolist())
    return numbers


AWAY_AND_BACK = [*np.arange(4, -14, -1.5), *np.arange(-14, 12, 1.5)]


@pytest.mark.parametrize(("frames", "number"), [(REMEMBER.remember_frames, 1), (5, 2)])
def test_an_object_that_returns_keeps_its_number_but_not_after_too_long(frames, number):
    numbers = swept(new_filter(REMEMBER, remember_frames=frames), AWAY_AND_BACK)
    assert numbers[0] == [1]
    assert [] in numbers  # it was out of view
    assert numbers[-1] == [number]
    assert {n for frame in numbers for n in frame} == {1, number}


def test_without_a_known_pan_nobody_is_remembered():
    follow = new_filter(REMEMBER)
    assert swept(follow, AWAY_AND_BACK[:12])[-1] == []
    follow.step(selection(peaks()), None)
    groups = follow.step(selection(peaks(seen_at(4.0)), seen_at(4.0)), Motion(0.0))
    assert list(groups["number"]) == [2]


def test_what_does_not_show_where_it_should_is_forgotten():
    # All of it is in view again a little inside the fan's edge, which is at 14.4 deg.
    whole = [i for i, pan in enumerate(AWAY_AND_BACK) if i > 12 and abs(10 - pan) < 11]
    few = range(12, whole[REMEMBER.strikes - 2])
    many = range(12, whole[REMEMBER.strikes + 2])
    assert swept(new_filter(REMEMBER), AWAY_AND_BACK, hidden=few)[-1] == [1]
    assert swept(new_filter(REMEMBER), AWAY_AND_BACK, hidden=many)[-1] == [2]


@pytest.mark.parametrize("width", [12.0, 18.0])
def test_a_group_held_back_at_the_edge_is_remembered_where_its_object_went(width):
    """What scores at the fan's edge, though no candidate, draws particles back there."""
    pans = [*np.arange(0, -14, -0.4), *np.arange(-14, 6, 0.4)]
    at_12_deg = seen_at(-2.0)  # where the object was
    numbers = swept(new_filter(REMEMBER), pans, else_at=[at_12_deg], width=width)
    assert numbers[0] == numbers[-1] == [1]
    assert [] in numbers
    assert {n for frame in numbers for n in frame} == {1}


def test_a_newcomer_elsewhere_is_not_taken_for_the_lost_one():
    follow = new_filter(REMEMBER)
    swept(follow, AWAY_AND_BACK[:12])
    far = seen_at(0.0, range_m=1.9, azimuth_deg=-3.0)
    groups = follow.step(seen(far), Motion(0.0))
    assert list(groups["number"]) == [2]
    assert away(follow) == [1]


def test_what_is_out_of_view_is_not_missed():
    """A turn that takes an object from the view and back leaves its existence as it was."""
    follow = new_filter(motion="image", least_in_view=0.35)
    score = peaks(START)
    follow.step(selection(score, START))
    existence = follow.step(selection(score, START), Motion(0.0))["existence"][0]
    assert len(follow.step(selection(0 * score), Motion(30.0))["number"]) == 0
    back = follow.step(selection(score, START), Motion(-30.0))
    assert list(back["number"]) == [1]
    assert back["existence"][0] == pytest.approx(existence)


@pytest.mark.parametrize(("away", "number"), [(1, 2), (100, 1)])
def test_the_longer_a_lost_object_is_away_the_farther_off_it_may_be(away, number):
    """A third of a diameter: too far for one that just left, not after a hundred frames."""
    follow = new_filter(REMEMBER)
    follow.step(seen(START))
    follow.step(seen(START), Motion(0.0))
    nothing = selection(peaks())
    follow.step(nothing, Motion(30.0))
    for _ in range(away):
        follow.step(nothing, Motion(0.0))
    follow.step(nothing, Motion(-15.0))
    place = (START[0] + 0.33 * DIAMETER, START[1])
    groups = follow.step(seen(place), Motion(-15.0))
    assert list(groups["number"]) == [number]


@pytest.mark.parametrize(("own_candidate", "stays"), [(0.2, True), (2.0, False)])
def test_a_group_stays_with_its_own_candidate_beside_a_broader_hill(
    monkeypatch, own_candidate, stays
):
    """Circles of a blotchy floor overlap the landmark's: without a claim to its own candidate a
    group leaves the narrower hill, though it is no lower."""
    true, other = START, (START[0] + 0.37 * DIAMETER, START[1])
    score = np.maximum(peaks(true, width=0.12 * DIAMETER), peaks(other, width=0.2 * DIAMETER))
    monkeypatch.setattr(stage2, "OWN_CANDIDATE", own_candidate)
    follow = new_filter(DEFAULT, particles=500)
    for _ in range(40):
        groups = follow.step(selection(score, true, other), Motion(0.0))
    (first,) = groups["position"][groups["number"] == 1]
    assert (np.hypot(*(first - true)) < 0.05 * DIAMETER) == stays


@pytest.mark.parametrize(("sigma_known_px", "stays"), [(4.0, True), (10.0, False)])
def test_a_new_group_does_not_stray_to_a_hill_beside_its_own(sigma_known_px, stays):
    """A third of a radius off lies a higher hill, of no disc: real floors have such. The group
    begins at its candidate, no wider than it walks, and does not leave it in the next frames."""
    true, other = START, (START[0] + 0.17 * DIAMETER, START[1])
    hills = [peaks(true, width=0.05 * DIAMETER, height=0.9), peaks(other, width=0.05 * DIAMETER)]
    alone, both = (selection(score, true) for score in (hills[0], np.maximum(*hills)))
    follow = new_filter(DEFAULT, sigma_known_px=sigma_known_px)
    follow.step(alone)
    groups = follow.step(both, Motion(0.0))
    assert list(groups["number"]) == [1]
    assert (np.hypot(*(groups["position"][0] - true)) < 0.05 * DIAMETER) == stays


@pytest.mark.parametrize("way", ["in", "out"])
def test_with_too_little_in_view_what_comes_in_stays_and_what_goes_out_goes(way):
    """At the side of the fan, 14.4 deg: a disc that shows as a candidate from .2 of it on."""
    bearings = np.arange(15.8, 13.4, -0.4)
    bearings = bearings if way == "in" else bearings[::-1]
    shares = share_in_image(FAN, np.full(len(bearings), 2.6), bearings, BASIN.radius_m)
    assert 0.2 < shares.min() < 0.25
    follow = new_filter(DEFAULT)
    for i, (bearing, share) in enumerate(zip(bearings, shares, strict=True)):
        place = seen_at(10.0 - bearing)
        motion = Motion(float(bearings[i - 1] - bearing)) if i else None
        groups = follow.step(seen(place), motion)
        if way == "in" or share > DEFAULT.least_in_view:
            assert list(groups["number"]) == [1]
            assert groups["shown"][0] == (share > DEFAULT.least_in_view)
            assert not away(follow)
    if way == "out":
        assert list(groups["number"]) == []
        assert away(follow) == [1]


def test_rows_begin_and_end_in_all_columns_at_once():
    tracks = Tracks()
    tracks.declare(position=np.array([1.0, 2.0]), pool=list, picture=None)
    tracks.begin(3)
    tracks["position"][1] = 5.0
    for number, pool in zip(tracks["number"], tracks["pool"], strict=True):
        pool.append(number)  # each has its own
    before = tracks[tracks.in_view]
    tracks.keep(tracks["number"] != 1)
    new = tracks.begin(1)
    assert tracks["number"].tolist() == [2, 3, 4]
    assert tracks["position"][new].tolist() == [[1.0, 2.0]]
    assert tracks["position"][0].tolist() == [5.0, 5.0]
    assert tracks["pool"].tolist() == [[2], [3], []]
    assert tracks["picture"].tolist() == [None] * 3
    assert before["number"].tolist() == [1, 2, 3]


def test_numbers_are_not_used_again_after_all_tracks_have_ended():
    tracks = Tracks()
    tracks.begin(2)
    tracks.keep(np.zeros(2, bool))
    assert len(tracks) == 0
    tracks.begin(1)
    assert tracks["number"].tolist() == [3]


def test_remembered_tracks_are_not_in_view():
    tracks = Tracks()
    tracks.begin(3)
    tracks["remembered"][1] = True
    assert tracks["number"][tracks.in_view].tolist() == [1, 3]
