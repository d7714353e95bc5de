"""Shape matrices of drawn discs against the ideal rows, and Otsu against OpenCV."""

import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.landmarks import load_landmarks
from sonarrec.recogniser.stage3.shape_matrix import (
    ANGLES,
    STEP,
    Identification,
    ShapeSampler,
    identify,
    otsu_levels,
    rotated_codes,
)
from tests.support.drawn import SECTORS, disc_pattern, draw_ellipse_disc, surroundings

BASIN = load_landmarks("basin")
ROTATED = rotated_codes(BASIN)
CENTRE = (101.3, 98.6)
RADIUS = 80.0
SAMPLER = ShapeSampler(BASIN, (RADIUS, RADIUS))


def agreement(landmark: int) -> list[float]:
    """Share of sectors that agree with each ID: PAPER's ideal rows before normalising."""
    truth = SECTORS[landmark]
    return [sum(a == b for a, b in zip(truth, SECTORS[k], strict=True)) / 4 for k in SECTORS]


def picture(pattern) -> np.ndarray:
    disc = draw_ellipse_disc((200, 204), CENTRE, (RADIUS, RADIUS), pattern)
    return (40 + 180 * disc).astype(np.uint8)


def sampled(image, inside=None, start_rad=0.0, centres=(CENTRE,)):
    """Brightness of the cells, and whether they are seen."""
    inside = np.ones_like(image) if inside is None else inside
    places, start = np.array(centres).reshape(-1, 2), np.full(len(centres), start_rad)
    return SAMPLER(image, inside, places, start, *surroundings(image))


def identified(image, start_rad=0.0) -> Identification:
    return identify(*sampled(image, start_rad=start_rad), SAMPLER.bands, ROTATED)


@pytest.mark.parametrize("landmark", sorted(SECTORS))
@pytest.mark.parametrize("start_deg", [0, 35, 200])
def test_on_the_grid_of_angles_the_row_is_exact(landmark, start_deg):
    start = np.radians(start_deg)
    image = picture(disc_pattern(SECTORS[landmark], start + 7 * STEP))
    found = identified(image, start_rad=start)
    np.testing.assert_allclose(found.similarity[0], agreement(landmark), atol=1e-9)
    np.testing.assert_allclose(
        found.measurement()[0], np.array(agreement(landmark)) / sum(agreement(landmark))
    )
    assert found.rotation[0] in ((7, 25) if landmark == 2 else (7,))


def test_the_trap_a_blank_disc_is_more_id_1_than_id_1():
    q = identified(picture(disc_pattern((0, 0, 0, 0)))).measurement()[0]
    np.testing.assert_allclose(q, (0.375, 0.25, 0.25, 0.125))
    assert q[0] > 1 / 3  # what an ideal ID.1 gives


@pytest.mark.parametrize("share", [0.25, 0.75])
def test_without_a_circle_the_symbol_tells_nothing(share):
    """The outer lines of a ring that covers a known share of the turn, beside that share."""
    whole = disc_pattern(SECTORS[3])

    def pattern(x, y):
        turn = np.arctan2(y, x) % (2 * np.pi)
        return whole(x, y) * ((np.hypot(x, y) < 0.7) | (turn < share * 2 * np.pi))

    found = identified(picture(pattern))
    assert found.ring[0] == pytest.approx(share, abs=0.03)  # a cell at each end of the arc
    plain = found.measurement()[0]
    assert plain.argmax() == 2
    np.testing.assert_array_equal(found.measurement(share - 0.05)[0], plain)
    np.testing.assert_array_equal(found.measurement(share + 0.05)[0], 0.25)


@settings(max_examples=8)
@given(column=st.integers(40, 140))
def test_cells_outside_the_fan_are_not_seen(column):
    image = picture(disc_pattern(SECTORS[1]))
    inside = np.ones_like(image)
    inside[:, :column] = 0
    _, seen = sampled(image, inside)
    x = CENTRE[0] + RADIUS * SAMPLER.radii[:, None] * np.cos((np.arange(ANGLES) + 0.5) * STEP)
    sure = np.abs(x - column + 0.5) > 0.1  # a cell belongs to the pixel nearest to it
    sure[SAMPLER.bands.outer] = False  # which partly lie beyond the image
    np.testing.assert_array_equal(seen[0][sure], (x > column - 0.5)[sure])


def best_split(values):
    """Otsu's between-class variance at its best, over every value as the threshold."""
    best = (-1.0, values[0])
    for level in sorted(set(values))[:-1]:
        low = [v for v in values if v <= level]
        high = [v for v in values if v > level]
        between = len(low) * len(high) * (np.mean(low) - np.mean(high)) ** 2
        if between > best[0] * (1 + 1e-12):
            best = (between, level)
    return best


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1))
def test_identify_is_the_counting_of_cells_written_out(seed):
    rng = np.random.default_rng(seed)
    bands = ShapeSampler(BASIN, (9.0, 9.0)).bands
    grey = rng.normal(size=(2, bands.outer.stop, ANGLES))
    seen = rng.random(grey.shape) < rng.uniform(0.3, 1)
    found = identify(grey, seen, bands, ROTATED)
    for n in range(2):
        rows = [*range(bands.symbol.start, bands.symbol.stop)]
        ring = [*range(bands.ring.start, bands.ring.stop)]
        disc = [grey[n, r, a] for r in rows + ring for a in range(ANGLES) if seen[n, r, a]]
        _, level = best_split(disc)
        fit = np.zeros((ANGLES, 4))
        cells = [(r, a) for r in rows for a in range(ANGLES) if seen[n, r, a]]
        for turn, k in itertools.product(range(ANGLES), range(4)):
            code = [SECTORS[k + 1][(a - turn) % ANGLES // 9] for a in range(ANGLES)]
            fit[turn, k] = np.mean([(grey[n, r, a] > level) == code[a] for r, a in cells])
        assert fit[found.rotation[n]].max() == pytest.approx(fit.max())
        np.testing.assert_allclose(found.similarity[n], fit[found.rotation[n]])
        bright = [grey[n, r, a] > level for r in ring for a in range(ANGLES) if seen[n, r, a]]
        assert found.ring[n] == pytest.approx(np.mean(bright))


@settings(max_examples=30)
@given(data=st.data())
def test_otsu_parts_8_bit_values_as_opencv_does(data):
    size = data.draw(st.integers(2, 60))
    values = np.array(data.draw(st.lists(st.integers(0, 255), min_size=size, max_size=size)))
    padded = np.concatenate([values, [17, 250, 3]]).astype(float)  # and cells that are not seen
    seen = np.arange(size + 3) < size
    ours = padded[:size] > otsu_levels(padded[None], seen[None])[0]
    theirs_level, _ = cv2.threshold(values.astype(np.uint8)[None], 0, 255, cv2.THRESH_OTSU)
    theirs = values > theirs_level

    def between(high):
        if high.all() or not high.any():
            return 0.0
        return high.sum() * (~high).sum() * (values[high].mean() - values[~high].mean()) ** 2

    # Two levels can be equally good; then either will do.
    assert (ours == theirs).all() or between(ours) == pytest.approx(between(theirs), rel=1e-6)


def test_brightness_is_free_of_gain_and_offset():
    image = picture(disc_pattern(SECTORS[1]))
    grey, seen = sampled(image)
    dim, _ = sampled((image // 2 + 30).astype(np.uint8))
    np.testing.assert_allclose(dim[seen], grey[seen], atol=0.03)
    assert grey.max() == pytest.approx((image.max() - image.mean()) / image.std(), abs=0.01)


def test_no_objects_and_objects_outside_the_image_are_no_trouble():
    image = picture(disc_pattern(SECTORS[1]))
    for centres in ((), ((-500.0, 900.0),)):
        grey, seen = sampled(image, centres=centres)
        found = identify(grey, seen, SAMPLER.bands, ROTATED)
        assert not seen.any()
        assert found.measurement().shape == (len(centres), 4)
        np.testing.assert_allclose(found.measurement().sum(axis=1), 1)
