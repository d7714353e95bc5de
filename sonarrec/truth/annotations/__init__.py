"""Ground truth as people already have it. A further format is one module and one row in FORMATS.

Read by hand: the libraries for these formats bring drawing tools or machine learning with them,
and check less of what a person's file holds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sonarrec.errors import MissingError, SonarrecError
from sonarrec.truth.annotations import coco, cvat, labelme, mot
from sonarrec.truth.annotations.shapes import Annotations


@dataclass(frozen=True, slots=True)
class Format:
    """One kind of annotation file: how it is told from others (by its path and how it begins)."""

    name: str
    matches: Callable[[Path, str], bool]
    read: Callable[[Path], Annotations]


FORMATS = (
    Format("cvat", cvat.matches, cvat.read),
    Format("coco", coco.matches, coco.read),
    Format("mot", mot.matches, mot.read),
    Format("labelme", labelme.matches, labelme.read),
)


def read_annotations(path: Path, name: str | None = None) -> tuple[str, Annotations]:
    """Read annotations of the format called `name`, by default of the one the content shows.

    Returns the format's name as well. Raises SonarrecError where the file cannot be understood.
    """
    if not path.exists():
        raise MissingError(f"{path}: no such file or folder")
    if name is not None:
        chosen = next(f for f in FORMATS if f.name == name)
    else:
        text = "" if path.is_dir() else _beginning(path)
        matching = [f for f in FORMATS if f.matches(path, text)]
        if not matching and path.is_dir():
            raise SonarrecError(f"{path}: a folder without LabelMe JSON files")
        if not matching:
            raise SonarrecError(
                f"{path}: not an annotation file this program reads (CVAT XML 1.1, COCO JSON, "
                "MOTChallenge gt.txt, LabelMe JSON or a folder of it); unpack an archive first"
            )
        chosen = matching[0]
    return chosen.name, chosen.read(path)


def _beginning(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(4096).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
