"""RESULTS.md and the README's table are what the studies' files say."""

from __future__ import annotations

import re
import tomllib

import pytest

from tests.studies.learning.random_scenes import ALL_KINDS
from tests.studies.results.__main__ import FOLDER, NOW, ORDER, PAGE, page
from tests.studies.results.readme import BEGIN, END, KINDS, README, filled
from tests.studies.results.record import read

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
    study = read(name)
    tables = [table["csv"].strip().splitlines()[1:] for table in study["table"]]
    return sum(len(rows[: study.get("rows_on_page")]) for rows in tables[: study.get("on_page")])


@pytest.mark.parametrize("of", ["default", "protocol_strict"])
def test_rows_whose_digest_no_longer_holds_are_marked(of: str) -> None:
    depending = [name for name in ORDER if of in read(name)["digest"]]
    # As if one of them had just been made: after a change of results none is up to date.
    held = now() | read(max(depending, key=page_rows))["digest"]
    before, after = page(held), page(held | {of: "another"})
    up_to_date = [name for name in depending if read(name)["digest"].items() <= held.items()]
    rows = sum(map(page_rows, up_to_date))
    assert rows
    assert after.count("| † ") == before.count("| † ") + rows


def test_the_readme_is_filled_from_the_records() -> None:
    text = README.read_text(encoding="utf-8")
    assert text == filled(text, now()), "make results"
    assert set(KINDS) == set(ALL_KINDS)
    headings = re.findall("^## (.*)", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    anchors = {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}
    linked = re.findall(r"RESULTS\.md#([\w-]+)\)", text)
    assert linked
    assert set(linked) <= anchors


def test_the_kinds_in_the_readme_have_the_lowest_tpr_and_the_highest_fpr() -> None:
    text = README.read_text(encoding="utf-8")
    shown = [kind for kind in KINDS if re.search(rf"\| († )?{KINDS[kind]} \|", text)]
    rates = {}
    for line in read("scenes_fresh")["table"][0]["csv"].splitlines():
        if kind := re.match("`(.*)`", line):
            of_default = re.findall(r"([\d.]+) \(", line.split(",")[2])
            rates[kind[1]] = [float(rate) for rate in of_default]
    pairs = [pair for pair in rates.values() if len(pair) == 2]
    lowest, highest = min(tpr for tpr, _ in pairs), max(pair[-1] for pair in rates.values())
    assert 1 <= len(shown) <= 2
    assert lowest in [rates[kind][0] for kind in shown]
    assert highest in [rates[kind][-1] for kind in shown]


def test_other_figures_in_the_readme_are_on_record() -> None:
    """A paragraph has the figures of the command that it names."""
    text = README.read_text(encoding="utf-8")
    text = (text.partition(BEGIN)[0] + text.partition(END)[2]).partition("## How well")[2]
    recorded: dict[str, list[float]] = {}
    for study in map(read, ORDER):
        numbers = NUMBER.findall("".join(table["csv"] for table in study["table"]))
        recorded.setdefault(study["command"], []).extend(map(float, numbers))
    made = [part for part in text.split("\n\n") if re.search("`(make|python) ", part)]
    assert made
    for part in made:
        (command,) = re.findall("`((?:make|python) .*?)`", part)
        for number in re.findall(r"\d*\.\d+", part):
            digits = len(number.partition(".")[2])
            found = {round(value, digits) for value in recorded[command]}
            assert float(number) in found, (command, number)
