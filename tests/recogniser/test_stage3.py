"""Stage 3 against PAPER's equations written out and figures worked out from them."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarrec.config import Features
from sonarrec.landmarks import LandmarkSet, load_landmarks
from sonarrec.recogniser.estimates import wins
from sonarrec.recogniser.stage3.published import (
    PublishedMeasurement,
    measurement_model,
    motion_model,
    update,
)
from tests.support.tracks import follow, made_up_tracks

IDEAL = {  # shares of agreeing sectors between the four IDs, by hand
    1: (1, 0.75, 0.75, 0.5),
    2: (0.75, 1, 0.5, 0.75),
    3: (0.75, 0.5, 1, 0.75),
    4: (0.5, 0.75, 0.75, 1),
}
BASIN = load_landmarks("basin")


def ideal_q(landmark: int) -> np.ndarray:
    return np.array(IDEAL[landmark]) / sum(IDEAL[landmark])


def rows_of(shape, low=0.01):
    """Strategy: arrays of positive rows that sum to 1."""
    count = int(np.prod(shape))
    return st.lists(st.floats(low, 1), min_size=count, max_size=count).map(
        lambda v: np.reshape(v, shape) / np.reshape(v, shape).sum(axis=-1, keepdims=True)
    )


class Estimator:
    """Beliefs by what is measured, over a window of 2.5 m."""

    def __init__(self, **settings: object) -> None:
        self._tracks = made_up_tracks()
        self._measurement = PublishedMeasurement(
            Features(**settings), self._tracks, pytest.fail, BASIN, 2.5
        )

    def step(self, measured: np.ndarray, *numbers: int, **where: object) -> np.ndarray:
        """measured: of tracks of these numbers; where: as in `follow`."""
        track = follow(self._tracks, *numbers, **where)
        belief = self._tracks["belief"][self._tracks.in_view]
        return self._measurement.update(track.with_columns(belief=belief), measured)


@settings(max_examples=30)
@given(data=st.data(), n=st.integers(1, 4), k=st.integers(2, 6))
def test_update_is_equations_6_to_8_written_out(data, n, k):
    predicted, q = data.draw(rows_of((n, k))), data.draw(rows_of((n, k)))
    model = data.draw(rows_of((k, k)))
    expected = np.zeros((n, k))
    for m, j in itertools.product(range(n), range(k)):
        normaliser = sum(model[other, j] * predicted[m, other] for other in range(k))  # Eq. 7
        for i in range(k):
            expected[m, i] += model[i, j] * predicted[m, i] / normaliser * q[m, j]  # Eq. 6, 8
    belief = update(predicted, q, model)
    np.testing.assert_allclose(belief, expected, rtol=1e-9)
    np.testing.assert_allclose(belief.sum(axis=1), 1, rtol=1e-12)


def test_what_was_ruled_out_by_such_a_model_can_be_measured_again():
    """IDs without a sector in common are never confused: belief follows the measurement."""
    opposite = LandmarkSet(
        "two", 0.15, (0.8, 1.0), (0.0, 0.62), (1, 2), ((1, 0, 0, 0), (0, 1, 1, 1))
    )
    model = measurement_model(opposite, 2.5)
    np.testing.assert_array_equal(model, np.eye(2))
    belief = update(np.array([[0.5, 0.5]]), np.array([[1.0, 0.0]]), model)
    np.testing.assert_allclose(belief, [[1, 0]])
    np.testing.assert_allclose(update(belief, np.array([[0.3, 0.7]]), model), [[0.3, 0.7]])
    np.testing.assert_allclose(update(belief, np.array([[0.0, 1.0]]), model), [[0, 1]])


@pytest.mark.parametrize("kind", ["association", "inverse_distance"])
def test_one_that_returns_to_an_empty_view_brings_its_own_belief(kind):
    estimator = Estimator(motion_model=kind)
    before = estimator.step(ideal_q(3)[None], 4, positions=[[50, 50]])
    estimator.step(np.empty((0, 4)), away=[4])
    back = estimator.step(np.full((1, 4), 0.25), 4, positions=[[80, 50]])
    expected = update(before, np.full((1, 4), 0.25), measurement_model(BASIN, 2.5))
    np.testing.assert_allclose(back, expected)


@pytest.mark.parametrize(
    ("window_m", "table"), [(1.25, 2), (1.5, 2), (2.0, 3), (2.5, 3), (5.0, 3), (10.0, 3), (0.6, 2)]
)
def test_the_table_measured_nearest_to_the_window_is_chosen(window_m, table):
    model = measurement_model(BASIN, window_m)
    # The first entries are PAPER's; rows are renormalised, which moves them by less than 1e-3.
    assert model[0, 0] == pytest.approx({2: 0.3195, 3: 0.3341}[table], abs=1e-4)
    assert model[2, 1] == pytest.approx({2: 0.1742, 3: 0.1769}[table], abs=1e-4)
    np.testing.assert_allclose(model.sum(axis=1), 1, rtol=1e-12)
    assert (model.argmax(axis=1) == np.arange(4)).all()


def test_other_landmark_sets_get_the_ideal_similarities():
    sectors = ((1, 0, 0, 0, 0, 0), (1, 1, 0, 1, 0, 0), (1, 1, 1, 0, 1, 0))
    other = LandmarkSet("six", 0.2, (0.8, 1.0), (0.0, 0.6), (7, 9, 12), sectors)
    model = measurement_model(other, 2.5)
    for a, b in itertools.product(range(3), repeat=2):
        agree = [sum(x == y for x, y in zip(sectors[a], sectors[c], strict=True)) for c in range(3)]
        assert model[a, b] == pytest.approx(agree[b] / sum(agree))


positions = st.lists(
    st.tuples(st.integers(0, 600), st.integers(0, 600)), min_size=1, max_size=5, unique=True
)


def test_a_high_power_of_a_long_way_is_no_0_over_0():
    """100 pixels to the power of -400 are 0 in 64 bits; the nearest has all of the row."""
    same = motion_model(np.array([[0.0, 0.0]]), np.array([[0.0, 100.0], [0.0, 200.0]]), 400)
    assert same.tolist() == [[1.0, pytest.approx(0, abs=1e-100)]]


@settings(max_examples=30)
@given(now=positions, before=positions, power=st.sampled_from([1.0, 2.0, 4.0]))
def test_motion_model_rows_sum_to_one_and_follow_inverse_distance(now, before, power):
    same = motion_model(np.array(now, float), np.array(before, float), power)
    assert same.shape == (len(now), len(before))
    np.testing.assert_allclose(same.sum(axis=1), 1, rtol=1e-9)
    for m, a in enumerate(now):
        distance = [max(np.hypot(a[0] - b[0], a[1] - b[1]), 1) for b in before]
        for i, j in itertools.combinations(range(len(before)), 2):
            ratio = (distance[j] / distance[i]) ** power
            assert same[m, i] / same[m, j] == pytest.approx(ratio, rel=1e-6)


def three_in_a_row(kind: str, power: float, shift: float, frames: int) -> np.ndarray:
    """Beliefs in ID.1, ID.3 and ID.4, 60 and 120 px apart, measured without noise, while the
    picture moves by `shift` pixels a frame."""
    estimator = Estimator(motion_model=kind, distance_power=power)
    place = np.array([(100, 200), (160, 200), (280, 200)], float)
    q = np.stack([ideal_q(1), ideal_q(3), ideal_q(4)])
    for _ in range(frames):
        place = place + np.array([shift, 0])
        belief = estimator.step(q, 1, 2, 3, positions=place)
        np.testing.assert_allclose(belief.sum(axis=1), 1, rtol=1e-9)
    return belief


# Panning 2 deg/s at 4 frames/s moves the picture by 3 to 5 px where the landmarks lie.
@pytest.mark.parametrize(
    ("kind", "power", "shift"),
    [*(("association", 1.0, shift) for shift in (0, 5, 20)), ("inverse_distance", 4.0, 5)],
)
def test_association_and_a_sharp_power_keep_neighbours_apart(kind, power, shift):
    belief = three_in_a_row(kind, power, shift, 100)
    assert list(belief.argmax(axis=1)) == [0, 2, 3]
    assert belief[[0, 1, 2], [0, 2, 3]].min() > 0.8


@pytest.mark.parametrize(("shift", "frames", "wrong"), [(5, 300, 1), (20, 60, 0)])
def test_the_trap_literal_inverse_distance_ends_with_a_wrong_id(shift, frames, wrong):
    belief = three_in_a_row("inverse_distance", 1.0, shift, frames)
    assert belief[wrong].argmax() != (0, 2, 3)[wrong]


@pytest.mark.parametrize("kind", ["association", "inverse_distance"])
def test_a_new_track_knows_nothing_and_an_old_one_remembers(kind):
    model = measurement_model(BASIN, 2.5)
    estimator = Estimator(motion_model=kind, distance_power=1.0)
    for _ in range(30):
        old = estimator.step(ideal_q(1)[None], 4, positions=[(50, 50)])
    both = estimator.step(np.stack([ideal_q(1)] * 2), 4, 9, positions=[(50, 50), (52, 50)])
    np.testing.assert_allclose(both[0], update(old, ideal_q(1)[None], model)[0])
    np.testing.assert_allclose(both[1], update(np.full((1, 4), 0.25), ideal_q(1)[None], model)[0])


def test_a_new_track_may_take_its_neighbours_belief_by_eq_5():
    model = measurement_model(BASIN, 2.5)
    estimator = Estimator(motion_model="inverse_distance", new_belief="neighbours")
    measured = np.stack([ideal_q(1), ideal_q(4)])
    old = estimator.step(measured, 4, 5, positions=[(50, 50), (80, 50)])
    new = estimator.step(ideal_q(3)[None], 9, positions=[(60, 50)])
    mixed = (2 * old[:1] + old[1:]) / 3  # 10 and 20 pixels away
    np.testing.assert_allclose(new, update(mixed, ideal_q(3)[None], model))


@settings(max_examples=30)
@given(beliefs=st.integers(0, 6).flatmap(lambda n: rows_of((n, 3)) if n else st.just(None)))
def test_an_id_goes_to_the_one_object_for_which_it_is_most_probable(beliefs):
    """The rule in words, object by object."""
    rows = np.empty((0, 3)) if beliefs is None else beliefs.round(6)
    won = wins(np.column_stack([rows, np.zeros(len(rows))]))
    for m, row in enumerate(rows):
        k = int(np.argmax(row))
        rivals = [other[k] for n, other in enumerate(rows) if n != m]
        if all(row[k] > r for r in rivals):
            assert won[m]
        if any(row[k] < r for r in rivals):
            assert not won[m]
    claimed = rows[won].argmax(axis=1)
    assert len(set(claimed.tolist())) == len(claimed)
