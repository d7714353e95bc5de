"""The sample logs, and whether results are nearly those on record."""

from __future__ import annotations

from pathlib import Path

from tests.support.rows import read_rows

SAMPLES = Path(__file__).parents[2] / "sample_data"


def check_nearly_as_on_record(results: Path, sample: str) -> None:
    """Nearly all that the framework declares of a sample log is declared here, and little more."""
    clean, found = _declared(SAMPLES / "regression" / sample), _declared(results)
    assert len(clean & found) > 0.95 * len(clean)
    assert len(found - clean) < 0.02 * len(clean)


def _declared(results: Path) -> set[tuple[int, int]]:
    """(frame, landmark) of what the framework declares in estimates.csv."""
    rows = read_rows(results / "estimates.csv")
    named = (r for r in rows if r["method"] == "framework" and r["declared"] == "1")
    return {(int(r["frame"]), int(r["landmark"])) for r in named}
