"""A few of the damaged files of `make fuzz`."""

from __future__ import annotations

import pytest

from tests.studies.fuzz import SONARS, run_all

pytestmark = pytest.mark.slow


def test_damaged_files_end_with_an_exit_code() -> None:
    failures, summary = run_all(100)
    assert not failures, summary


@pytest.mark.parametrize("form", SONARS)
def test_damaged_files_of_sonars_end_with_an_exit_code(form: str) -> None:
    failures, summary = run_all(20, form=form)
    assert not failures, summary
