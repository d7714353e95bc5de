"""A few of the damaged files of `make fuzz`; tests/readers/test_damaged.py has those of sonars."""

import pytest

from tests.studies.fuzz import run_all


@pytest.mark.slow
def test_damaged_files_end_with_an_exit_code() -> None:
    failures, summary = run_all(100)
    assert not failures, summary
