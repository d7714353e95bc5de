"""Which method leads, and which a command takes."""

from __future__ import annotations

import pytest

from sonarrec.errors import UsageError
from sonarrec.results.methods import chosen, in_order, leading


def test_the_framework_leads_and_the_baseline_is_last() -> None:
    there = ("smi", "yolo", "smi:paper", "framework:offline", "framework", "framework:default")
    assert in_order(there) == (
        *("framework", "framework:default", "framework:offline", "yolo", "smi", "smi:paper"),
    )
    assert leading(["smi", "yolo"]) == "yolo"
    assert leading(["smi"]) == "smi"
    assert leading([]) == "framework"


def test_methods_are_taken_as_they_are_named() -> None:
    assert chosen(["smi", "framework"], (), "out") == ("framework", "smi")
    assert chosen(["smi", "framework", "yolo"], ["yolo", "smi", "yolo"], "out") == ("yolo", "smi")
    with pytest.raises(UsageError, match=r"^out: no method 'x'; there is framework, smi$"):
        chosen(["smi", "framework"], ["x"], "out")
