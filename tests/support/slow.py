"""Cases of a test that `make test` leaves out."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def but_first(cases: Iterable[Any], quick: int = 1) -> list[Any]:
    """Cases for `parametrize`, all but the first few marked slow: a tuple is several arguments."""
    some = [*cases]
    tuples = [case if isinstance(case, tuple) else (case,) for case in some[quick:]]
    return some[:quick] + [pytest.param(*case, marks=pytest.mark.slow) for case in tuples]
