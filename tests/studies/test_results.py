"""RESULTS.md and the README's table are what the studies' files say."""

from __future__ import annotations

import re
import tomllib

import pytest

from tests.studies.results.__main__ import FOLDER, NOW, ORDER, PAGE, page, read

README = FOLDER.parents[2] / "README.md"
NUMBER = re.compile(r"\d*\.\d+|\b\d+\b")


def now() -> dict[str, str]:
    return tomllib.loads(NOW.read_text(encoding="utf-8"))


def test_the_page_is_put_together_from_all_files() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert text == page(now()), "make results"
    assert len(text.splitlines()) <= 300
    assert {path.stem for path in FOLDER.glob("*.toml")} == {*ORDER, "now"}


@pytest.mark.parametrize("of", ["default", "protocol_strict"])
def test_rows_whose_digest_no_longer_holds_are_marked(of: str) -> None:
    before, after = page(now()), page(now() | {of: "another"})
    depending = [name for name in ORDER if of in read(name)["digest"]]
    rows = sum(
        len(table["csv"].strip().splitlines()) - 1
        for name in depending
        if read(name)["digest"] == {k: now()[k] for k in read(name)["digest"]}
        for table in read(name)["table"][: read(name).get("on_page")]
    )
    assert rows > 20
    assert after.count("| † ") == before.count("| † ") + rows


def test_figures_in_the_readme_are_on_record() -> None:
    """A row of its table of results has the figures of the file whose command it names."""
    text = README.read_text(encoding="utf-8").partition("## How well")[2].partition("\n## ")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    made = [row for row in rows if row and ("`make " in row[-1] or row[-1] == "the same")]
    assert len(made) >= 4
    command = ""
    for *cells, by in made:
        command = by.strip("`") if by != "the same" else command
        recorded = [
            float(number)
            for name in ORDER
            if (study := read(name))["command"] == command
            for table in study["table"]
            for number in NUMBER.findall(table["csv"])
        ]
        told = [number for cell in cells[1:] for number in NUMBER.findall(cell)]
        assert told, cells
        for number in told:
            digits = len(number.partition(".")[2])
            assert any(round(value, digits) == float(number) for value in recorded), (by, number)
