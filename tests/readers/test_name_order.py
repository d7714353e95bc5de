"""The order of images by their names: right, or told as a guess."""

from __future__ import annotations

import random
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from sonarrec.readers import open_log
from sonarrec.readers.guess.name_order import in_order
from sonarrec.readers.guess.times import times_in_names
from tests.support.logs import frames, image_folder

NOON = datetime(2024, 5, 1, 12, 30)
MIDNIGHT = datetime(2024, 1, 31, 23, 59, 45)
JITTER = random.Random(57)

CERTAIN: dict[str, Callable[[int], str]] = {
    "counter": lambda k: f"frame{k}",
    "padded counter": lambda k: f"img-{k + 9950:04d}",
    "seconds without padding": lambda k: f"{k / 4:g}",
    "seconds by Python": lambda k: f"t{round(k / 10, 1)}",
    "padded seconds": lambda k: f"{k / 4:.2f}",
    "seconds.microseconds": lambda k: f"{k // 4}.{k % 4 * 250_000 + JITTER.randrange(999)}",
    "seconds.nanoseconds": lambda k: f"{1_700_000_000 + k // 10}.{k % 10 * 10**8 + k % 3}",
    "since 1970": lambda k: f"{1_700_000_000 + k / 8}",
    "since 1970, ns": lambda k: f"{1_700_000_000 + k // 10}_{k % 10 * 10**8:09d}",
    "chapter.frame": lambda k: f"{k // 12}.{k % 12 + 1}",
    "counter and time": lambda k: f"{k}_{1_700_000_000 + k * 0.25}",
    "two counters": lambda k: f"{k:04d}_{3 * k + 100}",
    "size": lambda k: f"{k}_512x381",
}
WITH_TIMES = {  # and whether they are certain
    "%Y-%m-%d_%H-%M-%S.%f": True,
    "%Y%m%d%H%M%S%f": True,
    "%d-%m-%Y_%H-%M-%S.%f": False,
    "%d.%m.%Y %H.%M.%S.%f": False,
    "%d%b%Y_%H%M%S": False,
    "%H-%M-%S.%f": False,
    "%H%M%S_%f": False,
}
GUESSES: dict[str, Callable[[int], str]] = {
    "copies": lambda k: f"Capture 7 ({k + 1})" if k else "Capture 7",
    "since 1970, ns without zeros": lambda k: f"{1_700_000_000 + k // 10}_{k % 10 * 10**8}",
    "date, then counter": lambda k: f"20240{k // 30 + 1}01_{k % 30:03d}",
    "negative": lambda k: str(k - 40),
    "negative alone": lambda k: f"f_{k - 99}",
    "case": lambda k: f"{('f', 'F')[k % 2]}rame{k}",
    "hexadecimal": lambda k: f"{k:04x}",
    "8 bits": lambda k: f"{(k + 200) % 256}",
    "camera": lambda k: f"IMG_{(k + 9950) % 9999 + 1:04d}",
    "folders": lambda k: f"scan{k // 9}_{k % 9}",
    "clock of 12 hours": lambda k: (NOON + timedelta(seconds=60 * k)).strftime("%I-%M-%S %p"),
    "unsaid half of day": lambda k: (NOON + timedelta(seconds=60 * k)).strftime("%I%M%S"),
    "seconds of a minute": lambda k: f"{(50 + k / 4) % 60:.2f}",
    "hours and minutes": lambda k: f"{(1400 + k) // 60 % 24:02d}{(1400 + k) % 60:02d}",
    "thousands": lambda k: f"{k + 990:,}",
    "letters": lambda k: f"{k // 2}{'ab'[k % 2]}",
}


def ordered(stems: list[str]) -> tuple[bool, str | None]:
    """Whether names in disorder come back, and why that is a guess; None where they hold times."""
    paths = [f"/9/log.7/{stem}.png" for stem in stems]
    found, doubt = in_order(random.Random(1).sample(paths, len(paths)))
    times = times_in_names(Path(path).stem for path in found)
    return found == paths, doubt if times is None else None


@pytest.mark.parametrize("form", CERTAIN)
def test_certain_forms(form: str) -> None:
    assert ordered([CERTAIN[form](k) for k in range(90)]) == (True, None)


@pytest.mark.parametrize("form", WITH_TIMES)
def test_times(form: str) -> None:
    """Over midnight and the end of a month."""
    step = timedelta(seconds=1 if "f" not in form else 0.3)
    is_right, doubt = ordered([(MIDNIGHT + k * step).strftime(form) for k in range(90)])
    assert (is_right and doubt is None) is WITH_TIMES[form]
    assert is_right or doubt


@pytest.mark.parametrize("form", GUESSES)
def test_guesses_are_told(form: str) -> None:
    _, doubt = ordered([GUESSES[form](k) for k in range(90)])
    assert doubt


def test_one_note_says_what_to_do(tmp_path: Path) -> None:
    log = image_folder(tmp_path / "log", frames(3, 20, 20))
    for k, name in enumerate(("left", "right1", "right2")):
        (log / f"frame{k}.png").rename(log / f"{name}.png")
    with open_log(log) as opened:
        (note,) = opened.diagnostics.notes
    assert "the order of its 3 images, from left.png to right2.png, is a guess" in note
    assert note.endswith("if it is wrong, name them by one counter (000000, 000001, ...)")
