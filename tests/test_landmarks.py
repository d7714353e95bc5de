"""Landmark sets: what is drawn is what is written, and what cannot be meant is refused."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sonarrec.errors import SonarrecError
from sonarrec.landmarks import DrawnSet, landmarks_from_table, load_landmarks

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
                expected = sectors[degrees // 120] if 0.1 <= radius <= 0.6 else 0
                expected = 1 if 0.8 <= radius <= 1.0 else expected
                assert two.pattern(k, np.array([x]), np.array([y]))[0] == expected


def test_an_angle_just_below_zero_stays_in_the_last_sector() -> None:
    """np.mod of -1e-20 by 2 pi is 2 pi itself."""
    found = landmarks_from_table(TABLE, "here")
    np.testing.assert_array_equal(found.codes(np.array([-1e-20]))[:, 0], [1, 1])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"radius": 3}, r"radius \(.*radius_m"),
        ({"radius_m": "wide"}, "radius_m .*above 0.* 'wide'"),
        ({"ring": [0.9, 0.8]}, "ring must"),
        ({"ring": [0.9, 1.1]}, "ring must"),
        ({"ring": 3}, "ring must .* 2, .* 0 to 1"),
        ({"symbol": [-0.1, 0.5]}, "symbol must"),
        ({"symbol": [0.0, 0.9]}, "symbol .*ring"),
        ({"landmark": []}, "needs an id"),
        ({"landmark": 3}, r"\[\[landmark\]\]"),
        ({"landmark": [3]}, "1 must be a table"),
        ({"landmark": [{"id": 1}]}, "1 lacks sectors"),
        ({"landmark": [{"id": 1, "sectors": []}]}, "sectors must be"),
        ({"landmark": [{"id": 1, "sectors": [0, 2]}]}, "sectors must be"),
        ({"landmark": [{"id": [1], "sectors": [0, 1]}]}, "a whole number"),
        ({"landmark": [{"id": 1, "sectors": [1, 0], "colour": 3}]}, "colour"),
        ({"landmark": [{"id": 1, "sectors": [1, 0]}, {"id": 1, "sectors": [1, 1]}]}, "of its own"),
        ({"landmark": [{"id": 1, "sectors": [1]}, {"id": 2, "sectors": [1, 1]}]}, "equally many"),
        ({"landmark": [{"id": 1, "sectors": [1, 0]}, {"id": 2, "sectors": [0, 1]}]}, "1 and 2 are"),
    ],
)
def test_a_set_that_cannot_be_meant(change: dict[str, Any], says: str) -> None:
    with pytest.raises(SonarrecError, match=says) as caught:
        landmarks_from_table(TABLE | change, "here")
    assert str(caught.value).startswith("here: ")
    assert "\n" not in str(caught.value)


def test_files(tmp_path: Path) -> None:
    with pytest.raises(SonarrecError, match=r"built in \(.*basin"):
        load_landmarks("besin")
    path = tmp_path / "set.toml"
    path.write_text(
        'name = "x"\nradius_m = 1\nring = [0.5, 1]\nsymbol = [0, 0.5]\n'
        "[[landmark]]\nid = 1\nsectors = [1, 0]\n"
    )
    assert load_landmarks(path).sectors == ((1, 0),)


LETTERS: dict[str, Any] = {
    "name": "letters",
    "kind": "drawn",
    "size_m": 0.3,
    "mirrored": "no",
    "pose": "free",
    "landmark": [
        {"id": 7, "cells": ["100", "100", "111"]},
        {"id": 3, "cells": ["110", "101", "110"]},
    ],
}


def drawn(**changed: Any) -> DrawnSet:
    found = landmarks_from_table({**LETTERS, **changed}, "here")
    assert isinstance(found, DrawnSet)
    return found


def test_drawn_set_comes_back_from_its_table() -> None:
    letters = drawn()
    assert letters.as_table() == LETTERS
    assert (letters.radius_m, letters.ids) == (0.15, (7, 3))
    lists = [{"id": 7, "cells": [[1, 0, 0], [1, 0, 0], [1, 1, 1]]}, LETTERS["landmark"][1]]
    assert drawn(landmark=lists) == letters
    assert letters.periods_deg().tolist() == [360, 360]


def test_pattern_of_a_plate_is_its_drawing_as_one_reads_it() -> None:
    middles = np.array([-2 / 3, 0, 2 / 3])
    x, y = np.meshgrid(middles, -middles)
    for k, row in enumerate(LETTERS["landmark"]):
        read = np.array([[*map(int, cells)] for cells in row["cells"]])
        assert np.array_equal(drawn().pattern(k, x, y), read)
    assert drawn().pattern(0, np.array([-1.1]), np.array([0.5])) == 0


def test_images_and_small_pictures_become_cells(tmp_path: Path) -> None:
    picture = np.zeros((120, 120), np.uint8)
    picture[20:100, 30:50] = 200
    assert cv2.imwrite(str(tmp_path / "bar.png"), picture)
    assert cv2.imwrite(str(tmp_path / "tag.png"), np.array([[255, 0], [0, 0]], np.uint8))
    file = tmp_path / "set.toml"
    file.write_text(
        'name = "p"\nkind = "drawn"\nsize_m = 0.2\n[[landmark]]\nid = 1\nimage = "bar.png"\n'
        '[[landmark]]\nid = 2\nimage = "tag.png"\n'
    )
    found = load_landmarks(file)
    assert isinstance(found, DrawnSet)
    os.mkfifo(tmp_path / "pipe")
    cv2.imwrite(str(tmp_path / "wide.png"), picture[:60])
    for name, words in (("pipe", "no such file"), ("wide.png", "120 x 60 pixels")):
        (tmp_path / "other.toml").write_text(file.read_text().replace("bar.png", name))
        with pytest.raises(SonarrecError, match=words):
            load_landmarks(tmp_path / "other.toml")
    bar, tag = found.drawings()
    assert tag.tolist() == [[True, False], [False, False]]
    assert bar.shape == (28, 28)
    assert bar.mean() == pytest.approx(80 * 20 / 120**2, abs=0.03)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"landmark": [{"id": 1, "cells": ["101", "010"]}]}, "2 rows of 3 cells"),
        ({"landmark": [], "cells": ["????"] * 4, "codes": "00f1 " * 501}, "501 IDs"),
        ({"family": "set.toml", "landmark": []}, "a built-in drawn set"),
        ({"family": "actag24h10", "landmark": [], "ids": []}, "needs an id"),
        ({"landmark": []}, "needs an id"),
        ({"landmark": [{"id": 1, "cells": ["11", "11"]}]}, "all of one kind"),
        ({"landmark": [{"id": 1, "cells": ["12", "11"]}]}, "rows of 0 and 1"),
        ({"landmark": [{"id": 1, "cells": ["1", "11"]}]}, "equally long"),
        ({"landmark": [{"id": 1}]}, "cells, or an image"),
        ({"landmark": [{"id": 1, "image": "no.png"}]}, "no such file"),
        ({"kind": "painted"}, "kind must be"),
        ({"family": "actag24h10"}, "in place of"),
        ({"family": "actag24h10", "landmark": [], "ids": [9]}, "has no ID 9"),
        ({"family": "basin", "landmark": []}, "a built-in drawn set"),
        ({"ids": [7]}, "none is named"),
        ({"size_m": 0}, "size_m"),
        ({"landmark": [], "cells": ["1?", "??"], "codes": "5 g"}, "hex words of 1 digits"),
        ({"landmark": [], "cells": ["1?", "??"], "codes": "9"}, "for 3 cells"),
    ],
)
def test_what_no_plate_can_be_is_refused(changed: dict[str, Any], words: str) -> None:
    with pytest.raises(SonarrecError, match=words):
        drawn(**changed)


def test_drawings_that_no_image_tells_apart_are_refused() -> None:
    left = {"id": 1, "cells": ["110", "010", "010"]}
    right = {"id": 2, "cells": ["011", "010", "010"]}
    turned = {"id": 3, "cells": ["001", "111", "000"]}
    assert drawn(landmark=[left, right]).ids == (1, 2)
    for other, hand in ((turned, "no"), (right, "either")):
        with pytest.raises(SonarrecError, match="same drawing"):
            drawn(landmark=[left, other], mirrored=hand)


def test_codes_stand_in_the_cells_that_are_left_open() -> None:
    words = drawn(landmark=[], cells=["1?", "??"], codes="5 4")
    assert words.ids == (0, 1)
    assert words.cells == (((1, 1), (0, 1)), ((1, 1), (0, 0)))


def test_a_family_lends_its_drawings() -> None:
    few = drawn(family="actag24h10", landmark=[], ids=[5, 0], mirrored="yes")
    family = load_landmarks("actag24h10")
    assert isinstance(family, DrawnSet)
    assert few.ids == (5, 0)
    assert few.cells == (family.cells[5], family.cells[0])
