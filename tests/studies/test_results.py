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
    assert len(text.splitlines()) <= 200
    assert {path.stem for path in FOLDER.glob("*.toml")} == {*ORDER, "now"}


def page_rows(name: str) -> int:
    """How many rows a study has on the page."""
    tables = read(name)["table"][: read(name).get("on_page")]
    return sum(len(table["csv"].strip().splitlines()) - 1 for table in tables)


@pytest.mark.parametrize("of", ["default", "protocol_strict"])
def test_rows_whose_digest_no_longer_holds_are_marked(of: str) -> None:
    depending = [name for name in ORDER if of in read(name)["digest"]]
    # As if one of them had just been made: after a change of results none is up to date.
    held = now() | read(max(depending, key=page_rows))["digest"]
    before, after = page(held), page(held | {of: "another"})
    rows = sum(
        page_rows(name) for name in depending if read(name)["digest"].items() <= held.items()
    )
    assert rows
    assert after.count("| † ") == before.count("| † ") + rows


def test_figures_in_the_readme_are_on_record() -> None:
    """A row or a paragraph of its results has the figures of the command that it names."""
    text = README.read_text(encoding="utf-8").partition("## How well")[2].partition("\n## ")[0]
    recorded: dict[str, list[float]] = {}
    for study in map(read, ORDER):
        numbers = NUMBER.findall("".join(table["csv"] for table in study["table"]))
        recorded.setdefault(study["command"], []).extend(map(float, numbers))
    made = [part for part in re.split(r"\n\n|\n(?=\|)", text) if re.search("`(make|python) ", part)]
    assert len(made) >= 6
    for part in made:
        (command,) = re.findall("`((?:make|python) .*?)`", part)
        told = re.findall(r"\d*\.\d+", part.partition("|")[2].partition("|")[2] or part)
        assert told, part
        for number in told:
            digits = len(number.partition(".")[2])
            found = {round(value, digits) for value in recorded[command]}
            assert float(number) in found, (command, number)
