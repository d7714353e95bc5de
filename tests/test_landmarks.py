"""Landmark sets: what is drawn is what is written, and what cannot be meant is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from sonarrec.errors import SonarrecError
from sonarrec.landmarks import LandmarkSet, landmarks_from_table, load_landmarks

TABLE: dict[str, Any] = {
    "name": "two",
    "radius_m": 0.2,
    "ring": [0.8, 1.0],
    "symbol": [0.1, 0.6],
    "landmark": [{"id": 7, "sectors": [1, 0, 1]}, {"id": 3, "sectors": [1, 1, 1]}],
}


def test_basin_is_the_papers_set() -> None:
    basin = load_landmarks("basin")
    assert basin.ids == (1, 2, 3, 4)
    assert basin.sectors == ((1, 0, 0, 0), (1, 0, 1, 0), (1, 1, 0, 0), (1, 1, 1, 0))
    assert (basin.radius_m, basin.ring, basin.symbol) == (0.15, (0.8, 1.0), (0.0, 0.62))


def test_comes_back_from_its_table() -> None:
    basin = load_landmarks("basin")
    assert landmarks_from_table(basin.as_table(), "again") == basin
    assert landmarks_from_table(TABLE, "here").as_table() == TABLE


def test_pattern_point_by_point() -> None:
    """Against the definition, point after point, well off the borders."""
    two = landmarks_from_table(TABLE, "here")
    for radius in (0.05, 0.3, 0.55, 0.7, 0.85, 0.99, 1.1):
        for degrees in range(5, 360, 10):
            x = radius * math.cos(math.radians(degrees))
            y = radius * math.sin(math.radians(degrees))
            for k, sectors in enumerate(two.sectors):
                if 0.8 <= radius <= 1.0:
                    expected = 1
                elif 0.1 <= radius <= 0.6:
                    expected = sectors[degrees // 120]
                else:
                    expected = 0
                assert two.pattern(k, np.array([x]), np.array([y]))[0] == expected


def test_pattern_keeps_the_shape_and_has_the_right_area() -> None:
    """The bright area of a finely drawn disc is that of its ring and its sectors."""
    basin = load_landmarks("basin")
    y, x = np.mgrid[-1.05:1.05:701j, -1.05:1.05:701j]
    cell = (2.1 / 700) ** 2
    for k, sectors in enumerate(basin.sectors):
        drawn = basin.pattern(k, x, y)
        assert drawn.shape == x.shape
        area = math.pi * (1 - 0.8**2 + 0.62**2 * sum(sectors) / 4)
        assert drawn.sum() * cell == pytest.approx(area, rel=0.01)


@st.composite
def landmark_tables(draw: st.DrawFn) -> dict[str, Any]:
    count = draw(st.integers(1, 9))
    rows = draw(st.lists(st.tuples(*[st.integers(0, 1)] * count), min_size=1, max_size=6))
    canonical = [min(r[n:] + r[:n] for n in range(count)) for r in rows]
    assume(len(set(canonical)) == len(rows))
    return TABLE | {
        "landmark": [{"id": k * 3 + 1, "sectors": list(row)} for k, row in enumerate(rows)]
    }


@pytest.mark.slow
@given(landmark_tables(), st.floats(-50, 50))
def test_codes_of_any_number_of_ids_and_sectors(table: dict[str, Any], angle: float) -> None:
    found = landmarks_from_table(table, "here")
    codes = found.codes(np.array([angle, angle + 2 * math.pi]))
    assert codes.shape == (len(found.ids), 2)
    count = len(found.sectors[0])
    place = (angle % (2 * math.pi)) / (2 * math.pi) * count
    if 1e-6 < place % 1 < 1 - 1e-6:
        expected = [row[int(place)] for row in found.sectors]
        np.testing.assert_array_equal(codes, np.transpose([expected, expected]))


def test_an_angle_just_below_zero_stays_in_the_last_sector() -> None:
    """np.mod of -1e-20 by 2 pi is 2 pi itself."""
    found: LandmarkSet = landmarks_from_table(TABLE, "here")
    np.testing.assert_array_equal(found.codes(np.array([-1e-20]))[:, 0], [1, 1])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"radius": 3},
            r"unknown key radius \(did you mean radius_m\?\); known keys: name, radius_m",
        ),
        ({"radius_m": "wide"}, "radius_m must be a number above 0, not 'wide'"),
        ({"ring": [0.9, 0.8]}, "ring must be"),
        ({"ring": [0.9, 1.1]}, "ring must be"),
        ({"ring": 3}, "ring must be a list of 2, each a number from 0 to 1, not 3"),
        ({"symbol": [-0.1, 0.5]}, "symbol must be"),
        ({"symbol": [0.0, 0.9]}, "must end where the ring begins"),
        ({"landmark": []}, "needs an id"),
        ({"landmark": 3}, r"its own \[\[landmark\]\]"),
        ({"landmark": [3]}, "1 must be a table of keys, not 3"),
        ({"landmark": [{"id": 1}]}, "1 lacks sectors"),
        ({"landmark": [{"id": 1, "sectors": []}]}, "sectors must be"),
        ({"landmark": [{"id": 1, "sectors": [0, 2]}]}, "sectors must be"),
        ({"landmark": [{"id": [1], "sectors": [0, 1]}]}, "a whole number"),
        ({"landmark": [{"id": 1, "sectors": [1, 0], "colour": 3}]}, "colour"),
        (
            {"landmark": [{"id": 1, "sectors": [1, 0]}, {"id": 1, "sectors": [1, 1]}]},
            "of its own",
        ),
        (
            {"landmark": [{"id": 1, "sectors": [1, 0]}, {"id": 2, "sectors": [1, 1, 0]}]},
            "equally many",
        ),
        (
            {"landmark": [{"id": 1, "sectors": [1, 0, 0]}, {"id": 2, "sectors": [0, 0, 1]}]},
            "IDs 1 and 2 are the same pattern turned",
        ),
    ],
)
def test_a_set_that_cannot_be_meant(change: dict[str, Any], says: str) -> None:
    with pytest.raises(SonarrecError, match=says) as caught:
        landmarks_from_table(TABLE | change, "here")
    assert str(caught.value).startswith("here: ")
    assert "\n" not in str(caught.value)


def test_files(tmp_path: Path) -> None:
    with pytest.raises(SonarrecError, match=r"neither a file nor built in \(basin"):
        load_landmarks("besin")
    path = tmp_path / "set.toml"
    path.write_text(
        'name = "x"\nradius_m = 1\nring = [0.5, 1]\nsymbol = [0, 0.5]\n'
        "[[landmark]]\nid = 1\nsectors = [1, 0]\n"
    )
    assert load_landmarks(path).sectors == ((1, 0),)
