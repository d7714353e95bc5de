"""The study of tolerances states what it says that it states."""

import pytest

from tests.studies import tolerances


@pytest.mark.slow
def test_a_radius_that_is_far_too_large_loses_what_the_right_one_finds() -> None:
    right, wrong = (
        tolerances.rates("polar", "radius", factor, frames=(0, 16)) for factor in (1.0, 1.3)
    )
    assert float(right.split(" / ")[0]) > 0.8
    assert float(wrong.split(" / ")[0]) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "factor"), [("radius", 0.95), ("radius", 1.05), ("height", 0.8), ("height", 1.2)]
)
def test_a_radius_5_percent_off_and_a_height_20_percent_off_cost_nothing(
    what: str, factor: float
) -> None:
    tpr, fpr = map(float, tolerances.rates("pan", what, factor, frames=(0, 60)).split(" / "))
    assert tpr > 0.95
    assert fpr < 0.01
