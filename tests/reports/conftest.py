"""A browser, and the sample log's results and pages, made once."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from sonarrec.arrays import ByteImage
from sonarrec.reports import frames
from tests.support.browser import chromium
from tests.support.command import sonarrec
from tests.support.pages import without_log


@pytest.fixture(scope="session", autouse=True)
def _encoded_once() -> Iterator[None]:
    """A process encodes each picture once: it takes longest, and most pages show the sample."""
    as_jpeg = frames.as_jpeg

    @cache
    def encoded(data: bytes, shape: tuple[int, ...], quality: int) -> str:
        return as_jpeg(np.frombuffer(data, np.uint8).reshape(shape), quality)

    def once(image: ByteImage, quality: int) -> str:
        return encoded(image.tobytes(), image.shape, quality)

    with patch.object(frames, "as_jpeg", once):
        yield


@pytest.fixture(scope="session")
def pages(pan: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The sample log's report with everything, and with nothing but the results, whose log is
    gone."""
    folder = tmp_path_factory.mktemp("pages")
    sonarrec("report", pan, "-o", folder / "full.html")
    without_log(pan, folder / "pan")
    sonarrec("report", folder / "pan", "-o", folder / "bare.html", code=3)
    return {name: folder / f"{name}.html" for name in ("full", "bare")}


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with chromium(tmp_path_factory.mktemp("profile")) as driver:
        yield driver
