"""Tables as they are read: what counts as a number, and where a fault is."""

from __future__ import annotations

from pathlib import Path

import pytest

from sonarrec.files.tables import read_table
from sonarrec.records import SonarrecError


def times(path: Path, *cells: str) -> list[int]:
    path.write_text("\n".join(["timestamp_ns", *cells]) + "\n")
    table = read_table(path, {"timestamp_ns": "whole"}, ("timestamp_ns",), "timestamp_ns")
    found: list[int] = table["timestamp_ns"].tolist()
    return found


def test_whole_numbers_are_all_those_of_64_bits(tmp_path: Path) -> None:
    most = [-(2**63), 0, 2**63 - 512, 2**63 - 1]
    assert times(tmp_path / "t.csv", *map(str, most)) == most
    with pytest.raises(SonarrecError, match=r"line 3: timestamp_ns must be a whole number below"):
        times(tmp_path / "t.csv", "0", str(2**63))
