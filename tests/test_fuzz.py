"""A few of the damaged files of `make fuzz`."""

from __future__ import annotations

from tests.fuzz import run_all


def test_damaged_files_end_with_an_exit_code() -> None:
    failures, summary = run_all(75)
    assert not failures, summary


def test_a_file_that_once_asked_for_4_gb() -> None:
    """OpenCV believed the length of a PNG's chunk."""
    assert not run_all(1, first=1628)[0]
