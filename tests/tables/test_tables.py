"""Tables as they are read: what counts as a number, and where a fault is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sonarrec.errors import SonarrecError
from sonarrec.tables.read import line_number, read_table, read_tables


def column(folder: Path, text: str | bytes, name: str, kind: str = "whole") -> list[Any]:
    """A column of the table t.csv, which has this text."""
    path = folder / "t.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    found: list[Any] = read_table(path, {name: kind}, (name,), "a,b")[name].tolist()
    return found


def test_whole_numbers_are_all_those_of_64_bits(tmp_path: Path) -> None:
    most = [-(2**63), 0, 2**63 - 512, 2**63 - 1]
    assert column(tmp_path, "\n".join(["t", *map(str, most)]), "t") == most
    with pytest.raises(SonarrecError, match="line 3: t "):
        column(tmp_path, f"t\n0\n{2**63}\n", "t")


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_lines_are_those_of_the_file(tmp_path: Path, end: str) -> None:
    """Rows end at 3, with a cell of two lines; 5, behind a blank one; 6 and 8."""
    lines = ["a,b", '1, "x', ' y"', "\t", '2,"say ""no"""', "3,", "", ",4"]
    assert len(column(tmp_path, end.join(lines), "a", "blank or number")) == 4
    assert [line_number(tmp_path / "t.csv", row) for row in range(4)] == [3, 5, 6, 8]


@pytest.mark.parametrize("header", ["a,b,a", "a,b, a", '"a",b,a'])
def test_one_of_two_columns_of_a_name_is_not_chosen(tmp_path: Path, header: str) -> None:
    text = f"{header}\n1,2,3\n"
    with pytest.raises(SonarrecError, match=r"two columns .* a;"):
        column(tmp_path, text, "a")
    assert column(tmp_path, text, "b") == [2]


@pytest.mark.parametrize("rows", [None, 1])
@pytest.mark.parametrize("names", [("007", "008"), ("20261124", "1"), ("1.0", "1e3"), ("True", "")])
def test_names_are_text(tmp_path: Path, names: tuple[str, str], rows: int | None) -> None:
    path = tmp_path / "t.csv"
    path.write_text("log,a\n" + "".join(f"{name},1\n" for name in names))
    parts = read_tables(path, {"log": "blank or text"}, ("log",), "log", rows)
    found = [name for _, part in parts for name in part["log"]]
    assert [name for name in found if name == name] == [name for name in names if name]


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_a_table_in_another_encoding_is_told(tmp_path: Path, encoding: str) -> None:
    with pytest.raises(SonarrecError, match="UTF-8"):
        column(tmp_path, "a,b\n1,größe\n".encode(encoding), "a")


@pytest.mark.parametrize(
    "text",
    [
        10**6 * "x",  # seconds, unless a pattern of messages takes the square of its length
        10**5 * "http://",
        "a,b\n1,2\n1,2,3",
        "a,b\n1,2,3",
        "a;b\n1;2",
        "",
        '"a\n' + 20_000 * "b\n",
        "a," * 1_000,
    ],
)
def test_what_is_no_table_is_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "t.csv"
    with pytest.raises(SonarrecError) as caught:
        column(tmp_path, text, "b")
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value)) < len(str(path)) + 600
