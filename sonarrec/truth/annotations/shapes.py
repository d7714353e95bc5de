"""What every annotation format comes down to: labelled shapes on numbered or named frames."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sonarrec.errors import SonarrecError
from sonarrec.tables.read import LARGEST

PARTLY_HIDDEN = 0.5  # `visible` of a shape flagged as occluded; the flag does not say by how much

HALF_A_PIXEL = 0.5
"""Drawing tools put (0, 0) at the image's corner, this program at the centre of its first pixel."""


@dataclass(frozen=True, slots=True)
class Shape:
    """One labelled shape on one frame."""

    frame: int | str
    """Its number as the file counts, or the name of its image."""
    label: str
    x: float
    y: float
    """Of its centre, pixels, (0, 0) at the centre of the first pixel."""
    visible: float | None
    """0 to 1; None if the file does not state it."""


@dataclass(slots=True)
class Annotations:
    """One file, or folder of files, as read."""

    shapes: list[Shape] = field(default_factory=list)
    first_frame: int = 0
    """What the file calls the first frame of the log."""
    images: list[str] = field(default_factory=list)
    """Every image listed, also those with no shape on them."""
    sizes: dict[str | None, tuple[int, int]] = field(default_factory=dict)
    """(columns, rows) of images by name, as far as they are stated; None: of all."""
    interpolated: int = 0
    """Shapes filled in between keyframes."""
    unused: Counter[str] = field(default_factory=Counter)
    """The kinds of shapes that were passed over, as they have no one centre, counted."""


def centre_of_area(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Centroid of a polygon's area; of a degenerate one the mean of its points.

    A person sets the points of an outline unevenly, which the mean of the points would follow.
    """
    x, y = np.asarray(points, dtype=float).T
    middle_x, middle_y = x.mean(), y.mean()
    x, y = x - middle_x, y - middle_y
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    area = cross.sum() / 2
    if abs(area) < 1e-9:
        return float(middle_x), float(middle_y)
    return (
        float(middle_x + ((x + np.roll(x, -1)) * cross).sum() / (6 * area)),
        float(middle_y + ((y + np.roll(y, -1)) * cross).sum() / (6 * area)),
    )


def stated_visible(attributes: Mapping[str, Any]) -> float | None:
    """`visible` by free attributes: `visible` or `visibility` as a share or true or false, else a
    flag `occluded`; None without these.

    Raises ValueError on a share that is no number from 0 to 1.
    """
    given = {str(name).strip().lower(): value for name, value in attributes.items()}
    for name in ("visible", "visibility"):
        text = "" if given.get(name) is None else str(given[name]).strip().lower()
        if text:  # else left blank
            try:
                share = float({"true": "1", "false": "0"}.get(text, text))
            except ValueError:
                share = math.nan
            if not 0 <= share <= 1:
                raise ValueError(f"{name} must be a share, 0 to 1, not {shortened(given[name])}")
            return share
    if str(given.get("occluded", "")).strip().lower() in ("1", "true"):
        return PARTLY_HIDDEN
    return None


def coordinate(value: Any) -> float:
    """A coordinate in pixels as a number. Raises ValueError where it is none."""
    try:
        number = float(value)
    except (OverflowError, TypeError, ValueError):
        number = math.nan
    if not abs(number) <= LARGEST:  # or nan
        raise ValueError(f"{shortened(value)} is no coordinate in pixels")
    return number


def coordinates(values: Any, count: int, what: str) -> list[float]:
    """So many coordinates from a JSON document. Raises ValueError where they are not."""
    if not isinstance(values, list) or len(values) != count:
        raise ValueError(f"{what} must be {count} numbers, not {shortened(values)}")
    return [coordinate(value) for value in values]


def whole(value: Any) -> int:
    """A frame number, a size or a class. Raises ValueError where it is none."""
    try:
        number = int(value)
    except (OverflowError, TypeError, ValueError):
        number = LARGEST + 1
    if abs(number) > LARGEST or (isinstance(value, float) and value != number):
        raise ValueError(f"{shortened(value)} is no number of a frame, of a class or of pixels")
    return number


def stated(table: Any, key: str) -> Any:
    """A value of a JSON document. Raises ValueError where there is none, or null."""
    if not isinstance(table, dict):
        raise ValueError(f"{shortened(table)} where keys are expected, such as {key!r}")
    if table.get(key) is None:
        raise ValueError(f"no {key!r}")
    return table[key]


def listed(table: Any, key: str) -> list[Any]:
    """A list of a JSON document. Raises ValueError where there is none."""
    values = stated(table, key)
    if not isinstance(values, list):
        raise ValueError(f"{key!r} must be a list, not {shortened(values)}")
    return values


def shortened(value: Any) -> str:
    """A value for a message."""
    text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) < 40 else f"{text[:40]}..."


def read_text(path: Path) -> str:
    """The text of an annotation file. Raises SonarrecError where there is none."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise SonarrecError(f"{path}: not a text file; unpack an archive first") from None
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None


def read_json(path: Path) -> Any:
    """The document in a JSON file. Raises SonarrecError where there is none."""
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:  # also a number of thousands of digits
        raise SonarrecError(f"{path}: not valid JSON ({error})") from None
