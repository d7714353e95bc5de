"""Times as text, the same in tables, pages and pictures."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from sonarrec.sonar.frame import date_text, is_date, time_text

MAY = int(datetime(2024, 5, 1, 12, 30, tzinfo=UTC).timestamp()) * 10**9


@pytest.mark.parametrize(
    ("rest_ns", "decimals", "end"), [(0, 0, ""), (999_999_999, 0, ""), (70_000_000, 2, ".07")]
)
def test_times_are_cut_never_rounded_up(rest_ns: int, decimals: int, end: str) -> None:
    assert date_text(MAY + rest_ns, decimals) == f"2024-05-01 12:30:00{end}"
    assert time_text(MAY + rest_ns, decimals) == f"12:30:00{end}"


def test_the_clock_of_a_sonar_that_was_never_set_gives_no_dates() -> None:
    since_1980 = int(datetime(1980, 1, 6, 3, tzinfo=UTC).timestamp()) * 10**9
    assert is_date(MAY)
    assert not is_date(since_1980)
    assert not is_date(3_600 * 10**9)
