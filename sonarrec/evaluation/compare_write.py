"""The files of `evaluation/` that a comparison writes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from textwrap import indent

from sonarrec.evaluation.changes import CHANGES, change_cells
from sonarrec.evaluation.comparison import Comparison
from sonarrec.evaluation.write import as_record, finite_or_none, json_text, write_table
from sonarrec.tables.outputs import (
    check_no_recording,
    check_output,
    check_tables,
    replaced,
    writing,
)

COMPARE = ("protocol", "method", "landmark", "rate", "old", "new", "worse_by", "of")


def write_comparison(folder: Path, comparison: Comparison) -> tuple[str, ...]:
    """Write compare.csv, changes.csv and compare.json; returns their names.

    Raises as `write_evaluation`.
    """
    rates = (
        (r.protocol, r.method, r.landmark_text, r.rate, r.old, r.new, r.worse, r.of)
        for r in comparison.rates
    )
    changes = map(change_cells, comparison.frames)
    check_tables(folder, {"compare.csv": COMPARE, "changes.csv": CHANGES})
    check_output(folder / "compare.json", "JSON", header='{\n  "old": ')
    check_no_recording(folder, ["evaluation.json", "compare.csv"])
    with writing(folder):
        write_table(folder / "compare.csv", COMPARE, rates)
        write_table(folder / "changes.csv", CHANGES, changes)
        with (
            replaced(folder / "compare.json") as new,
            new.open("w", encoding="utf-8", newline="") as file,
        ):
            file.writelines(comparison_json(comparison))
    return ("compare.csv", "changes.csv", "compare.json")


def comparison_json(*found: Comparison) -> Iterator[str]:
    """compare.json piece by piece; a list of them if there are several."""
    for n, one in enumerate(found):
        if found[1:]:
            yield "," if n else "["
        yield from _comparison_json(one)
    if found[1:]:
        yield "]\n"


def _comparison_json(comparison: Comparison) -> Iterator[str]:
    """compare.json piece by piece: what was compared and how it was made, rates, tests, passes;
    0/0 is null."""
    document = {
        "old": comparison.old,
        "new": comparison.new,
        "verdict": comparison.verdict,
        "logs": list(comparison.logs),
        "frames": comparison.frames_compared,
        "landmarks": list(comparison.landmarks),
        "units": comparison.units,
        "settings": [asdict(change) for change in comparison.settings],
        "rates": [
            as_record(asdict(rate)) | {"worse_by": finite_or_none(rate.worse)}
            for rate in comparison.rates
        ],
        "differences": [as_record(asdict(difference)) for difference in comparison.differences],
        "passes": [],
        "frames_and_ids": comparison.frames.verdicts(),
        "lost": list(comparison.lost),
        "gained": list(comparison.gained),
        "notes": list(comparison.notes),
        "unused": list(comparison.unused),
    }
    # Of many logs the passes are many. No text in the document holds the key as it stands here:
    # in one its quotes are escaped.
    before, after = json_text(document).split('"passes": []')
    yield f'{before}"passes": ['
    end = ""
    for change in comparison.passes:
        yield ("," if end else "") + "\n" + indent(json.dumps(asdict(change), indent=2), " " * 4)
        end = "\n  "
    yield f"{end}]{after}"
