"""A few of the damaged files of `make fuzz`."""

from __future__ import annotations

from tests.studies.fuzz import run_all


def test_damaged_files_end_with_an_exit_code() -> None:
    failures, summary = run_all(75)
    assert not failures, summary
