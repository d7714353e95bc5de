"""Every TOML that is read: whatever it holds, a fault is one line that names file and key."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarrec.config import Config, configs, with_assignments
from sonarrec.errors import SonarrecError, UsageError
from sonarrec.landmarks import load_landmarks
from sonarrec.recogniser.stage3.model_file import as_toml, built_in_weights, read_model
from sonarrec.results.run_file import read_run
from sonarrec.simulation.scene import load_scene
from sonarrec.sonar.stated import load_sonar
from sonarrec.tables import toml

MODEL = as_toml(built_in_weights())
SET = 'name = "x"\nradius_m = 1\nring = [0.5, 1]\nsymbol = [0, 0.5]\n'

TABLES = ("input", "sonar", "fan", "landmarks", "odometry", "model")

# reader, what of its file is sound, a number in it
READERS: dict[str, tuple[Callable[[Path], object], str, str]] = {
    "settings": (lambda path: configs(path=path), "[candidates]\n", "candidates.threshold"),
    "run.toml": (lambda path: configs(path=path), "[config.candidates]\n", "candidates.threshold"),
    "seed": (lambda path: configs(path=path), "", "seed"),
    "sonar": (load_sonar, "[sonar]\n", "sonar.tilt_deg"),
    "sonar's list": (load_sonar, "[sonar]\n", "sonar.bearings_deg"),
    "model": (read_model, MODEL[: MODEL.index("other")], "other"),
    "landmarks": (load_landmarks, SET.replace("radius_m = 1\n", ""), "radius_m"),
    "landmark": (load_landmarks, SET + "[[landmark]]\nsectors = [1, 0]\n", "id"),
    "scene": (load_scene, "", "frames"),
    "scene's section": (load_scene, "[noise]\n", "noise.snr_db"),
    "scene's landmark": (load_scene, "[[landmark]]\nid = 1\nground_m = 2\n", "azimuth_deg"),
}
HOSTILE = {
    "400 digits": "9" * 400,
    "5,000 digits": "9" * 5000,
    "5,000 digits of hex": "0x" + "f" * 5000,
    "nan": "nan",
    "-inf": "-inf",
    "bool": "true",
    "text": '"fast"',
    "long text": '"' + "x" * 10**5 + '"',
    "date": "2020-01-01",
    "nested lists": "[" * 5000 + "]" * 5000,
    "nested tables": "{a=" * 5000 + "1" + "}" * 5000,
    "NUL": "1\0",
    "NUL told": r'"\u0000"',
}


def one_line(read: Callable[[], object], path: Path) -> str:
    with pytest.raises(SonarrecError) as caught:
        read()
    text = str(caught.value)
    assert text.startswith(str(path))
    assert len(text) < len(str(path)) + 340
    assert text.isprintable()
    return text


@pytest.mark.parametrize("reader", READERS)
def test_what_cannot_be_meant(reader: str, tmp_path: Path) -> None:
    read, sound, key = READERS[reader]
    path = tmp_path / "x.toml"
    if read not in (load_landmarks, load_scene):  # to which it would be a built-in name
        assert "cannot be read" in one_line(lambda: read(path), path)
    for value in HOSTILE.values():
        path.write_text(f"{sound}{key.split('.')[-1]} = {value}\n")
        text = one_line(lambda: read(path), path)
        assert key in text or "readable TOML file" in text, value[:60]
    for name in ('"a\\nb"', '"\\u001b[31m"', '""', "k" * 5000, ".".join("a" * 1000)):
        path.write_text(f"{sound}{name} = 1\n")
        text = one_line(lambda: read(path), path)
        assert any(says in text for says in ("unknown key", "or unknown: ", "nested too deep"))
    for data, says in (
        (b"# 20 \xb0", "UTF-8"),
        (b"a = 1,5\n", "decimals have a point"),
        (b"a = 1\nb =\n", "line 2"),
    ):
        path.write_bytes(data)
        assert says in one_line(lambda: read(path), path)
    os.truncate(path, 2**24 + 1)
    assert "16 MiB" in one_line(lambda: read(path), path)


@pytest.mark.parametrize(
    ("stated", "says"),
    [
        *((f"{name} = 3", f"{name} .* table of keys, not 3") for name in TABLES),
        ("config = 3", "config .* list of tables, not 3"),
        ("config = [3]", r"config .* list of tables, not \[3\]"),
        ("finished = 1", "finished .* true or false, not 1"),
        ("[program]\nmethods = 'smi'", r"program\.methods .* list, .*'smi'"),
        ("[input]\nbytes = true", r"input\.bytes .* whole number, 0 or more, not True"),
        ("[input]\ntime = 'noon'", r'input\.time .* "log", "publish" or "header", not \'noon\''),
        (f"x = {'9' * 400}", "64 bits"),
        (f"x.{'y.' * 1000}z = 1", "nested too deep"),
        ("x = 1\0", "line 1, column 6"),
    ],
)
def test_a_run_toml_that_cannot_be_meant(stated: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "run.toml"
    path.write_text(stated)
    assert re.search(says, one_line(lambda: read_run(path), path))


def test_names_no_file_can_have() -> None:
    for load in (load_landmarks, load_scene):
        for name in ("x" * 5000, "a\0b", "a\nb"):
            with pytest.raises(SonarrecError, match="built in") as caught:
                load(name)
            assert str(caught.value).isprintable()


def test_assignments_that_cannot_be_meant() -> None:
    for value in HOSTILE.values():
        with pytest.raises(UsageError, match=r"candidates\.threshold") as caught:
            with_assignments(Config(), [f"candidates.threshold={value}"])
        assert str(caught.value).isprintable()
        assert len(str(caught.value)) < 300


@dataclass(frozen=True)
class Part:
    share: toml.Share = 0.5
    word: Literal["red", "green"] = "red"
    pair: tuple[toml.Positive, toml.Positive] | None = None


@dataclass(frozen=True)
class Row:
    id: toml.Integer


@dataclass(frozen=True)
class Whole:
    count: toml.Count = 3
    part: Part = Part()
    rows: tuple[Row, ...] = ()


def test_a_table_becomes_its_dataclass() -> None:
    table: dict[str, Any] = {"count": 1e3, "part": {"pair": [1, 2.5]}, "rows": [{"id": -4}]}
    found = toml.from_table(Whole, table, "here")
    assert found == Whole(1000, Part(pair=(1.0, 2.5)), (Row(-4),))
    assert (type(found.count), type(found.part.pair[0])) == (int, float)  # type: ignore[index]
    over = toml.from_table(Whole, {"part": {"share": 1}}, "here", over=found)
    assert over == Whole(1000, Part(1.0, pair=(1.0, 2.5)), (Row(-4),))


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"cuont": 1}, "unknown key cuont .*count"),
        ({"part": {"c d": 1}}, r"unknown key part\.'c d'; .*\[part\]: share, word, pair"),
        ({"part": 3}, r"\[part\] .*, not 3"),
        ({"count": -1}, "count .*whole number, 0 or more, not -1"),
        ({"count": 1.5}, "count .*whole number, 0 or more, not 1.5"),
        ({"part": {"share": 2}}, r"part\.share .*from 0 to 1, not 2"),
        ({"part": {"word": "blue"}}, r'part\.word .*"red" or "green", not \'blue\''),
        ({"part": {"pair": [1]}}, r"part\.pair .*list of 2, each a number above 0, "),
        ({"rows": {"id": 1}}, r".*\[\[rows\]\]"),
        ({"rows": [{"id": 1}, {}]}, r"\[\[rows\]\] 2 lacks id"),
        ({"rows": [{"id": "x"}]}, r"\[\[rows\]\] 1: id .*whole number, not 'x'"),
    ],
)
def test_faults_name_the_key_the_bound_and_the_value(table: dict[str, Any], says: str) -> None:
    with pytest.raises(SonarrecError, match=f"^here: {says}"):
        toml.from_table(Whole, table, "here")


@given(value=st.floats() | st.integers())
def test_bounds_hold_for_every_number(value: float) -> None:
    most = sys.float_info.max
    for wanted, good in (
        (toml.Finite, -most <= value <= most),
        (toml.Positive, 0 < value <= most),
        (toml.NotNegative, 0 <= value <= most),
        (toml.Share, 0 <= value <= 1),
        (toml.Count, 0 <= value < 2**63 and int(value) == value),
        (toml.Integer, -(2**63) <= value < 2**63 and int(value) == value),
    ):
        try:
            found = toml.checked(value, wanted, "x")
        except SonarrecError:
            assert not good
        else:
            assert good
            assert found == type(found)(value)
