"""The sample log's results and pages, made once."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.command import SAMPLE, sonarrec


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample log, run."""
    out = tmp_path_factory.mktemp("results")
    sonarrec("run", SAMPLE, "--out", out, "-q")
    return out / "pan"


@pytest.fixture(scope="session")
def pages(results: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The sample log's report with everything, and with nothing but the results."""
    folder = tmp_path_factory.mktemp("pages")
    scored = ("--ground-truth", SAMPLE / "gt.csv", "--log", SAMPLE)
    sonarrec("report", results, *scored, "-o", folder / "full.html")
    sonarrec("report", results, "-o", folder / "bare.html")
    return {name: folder / f"{name}.html" for name in ("full", "bare")}
