"""`sonarrec landmarks`: how far IDs are apart, and what makes a set hard to recognise."""

from __future__ import annotations

from itertools import pairwise, product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import tomli_w

from sonarrec.drawing.landmarks import distances
from sonarrec.landmarks import DrawnSet, landmarks_from_table, load_landmarks
from tests.support.command import sonarrec

BASIN = load_landmarks("basin").as_table()


def ids(*sectors: tuple[int, ...]) -> dict[str, Any]:
    rows = [{"id": n + 1, "sectors": list(row)} for n, row in enumerate(sectors)]
    return BASIN | {"landmark": rows}


def test_as_drawn_it_is_the_share_of_the_sectors() -> None:
    rows = [(1, 0, 0, 0, 0, 0), (1, 1, 0, 1, 0, 0), (1, 1, 1, 1, 1, 0), (1, 0, 1, 0, 1, 0)]
    found = distances(landmarks_from_table(ids(*rows), "here"), 0.0)
    assert len(found) == 6
    for distance in found:
        one, other = (rows[number - 1] for number in distance.ids)
        least = min(
            sum(a != b for a, b in zip(one, other[n:] + other[:n], strict=True)) for n in range(6)
        )
        assert distance.drawn == pytest.approx(least / 6)
        assert distance.seen == pytest.approx(distance.drawn, abs=0.04)


def test_wide_beams_bring_ids_together() -> None:
    basin = load_landmarks("basin")
    by_beam = [{d.ids: d.seen for d in distances(basin, m)} for m in (0.0, 0.02, 0.08, 0.3)]
    for before, after in pairwise(by_beam):
        assert all(after[pair] < before[pair] for pair in before)
    assert max(by_beam[-1].values()) < 0.2


def test_a_set_that_is_hard_to_recognise_is_told(tmp_path: Path) -> None:
    file = tmp_path / "set.toml"
    file.write_text(tomli_w.dumps(ids((1,) * 3 + (0,) * 9, (1,) * 4 + (0,) * 8)))
    told = sonarrec("landmarks", file, "--distance", "2.5", "--beam-width", "0.5").stderr
    assert "IDs 1 and 2" in told
    assert told.count("note: ") == 1


def test_the_built_in_set_is_drawn(tmp_path: Path) -> None:
    picture = tmp_path / "basin.png"
    told = sonarrec("landmarks", "-o", picture)
    assert told.stderr == ""
    assert "  1 and 3          0.25" in told.stdout
    drawn = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    # The discs as drawn lie in the upper half: half their symbol is bright where the set says so.
    for k, quarter in product(range(4), range(4)):
        down, right = (-1, -1, 1, 1)[quarter], (1, -1, -1, 1)[quarter]
        x, y = 190 * k + 15 + 80 + 30 * right, 30 + 80 + 30 * down
        assert (drawn[y, x] > 128) == load_landmarks("basin").sectors[k][quarter]


def test_plates_are_as_far_apart_as_their_cells_say() -> None:
    """In whatever quarter turn or hand they are most alike."""
    tags = load_landmarks("actag24h10")
    assert isinstance(tags, DrawnSet)
    for near in distances(tags, 0.0)[:4]:
        a, b = (tags.drawings()[tags.ids.index(i)] for i in near.ids)
        turned = [np.rot90(hand, n) for hand in (b, b[:, ::-1]) for n in range(4)]
        assert near.drawn * 49 == pytest.approx(min((a != one).sum() for one in turned))
    through_beams = distances(tags, 0.08)
    assert max(d.seen for d in through_beams) < min(d.seen for d in distances(tags, 0.0))


def test_a_sheet_of_plates_is_to_scale(tmp_path: Path) -> None:
    sheet = tmp_path / "plates.svg"
    sonarrec("landmarks", "actag24h10", "-o", sheet)
    sonarrec("landmarks", "actag24h10", "-o", sheet)  # over its own
    root = ElementTree.parse(sheet).getroot()
    wide, _, unit = root.attrib["width"].partition("mm")
    assert unit == ""
    assert float(wide) == float(root.attrib["viewBox"].split()[2])  # a unit is a millimetre
    space = "{http://www.w3.org/2000/svg}"
    assert {rect.attrib["width"] for rect in root.iter(f"{space}rect")} == {"304.8"}
    tags = load_landmarks("actag24h10")
    assert isinstance(tags, DrawnSet)
    cells = [path.attrib["d"].count("M") for path in root.iter(f"{space}path")]
    assert cells == [int(d.sum()) for d in tags.drawings()]
    other = tmp_path / "mine.svg"
    other.write_text("<svg/>")
    assert "not overwritten" in sonarrec("landmarks", "actag24h10", "-o", other, code=2).stderr


def test_plates_too_small_for_the_beams_are_told() -> None:
    told = [sonarrec("landmarks", "actag24h10", "--distance", d).stderr for d in ("5.1", "10")]
    # Beams of .6 deg have a sigma of .075 of 305 mm at 5.14 m.
    assert not told[0]
    assert "read beyond 0.51" in told[1]
