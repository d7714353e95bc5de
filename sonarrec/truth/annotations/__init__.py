"""Ground truth as people already have it. A further format is one module and one row in FORMATS.

Read by hand: the libraries for these formats bring drawing tools or machine learning with them,
and check less of what a person's file holds.
"""

from __future__ import annotations

from pathlib import Path

from sonarrec.errors import MissingError, SonarrecError
from sonarrec.truth.annotations import coco, cvat, labelme, mot
from sonarrec.truth.annotations.shapes import Annotations

FORMATS = {"cvat": cvat, "coco": coco, "mot": mot, "labelme": labelme}
"""Each module has `matches`, by the path and how the file begins, and `read`."""


def read_annotations(path: Path, name: str | None = None) -> tuple[str, Annotations]:
    """Read annotations of the format called `name`, by default of the one the content shows.

    Returns the format's name as well. Raises SonarrecError where the file cannot be understood.
    """
    if not path.exists():
        raise MissingError(f"{path}: no such file or folder")
    if name is None:
        text = ""
        if not path.is_dir():
            try:
                with path.open("rb") as file:
                    text = file.read(4096).decode("utf-8-sig", errors="replace")
            except OSError as error:
                raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
        name = next((one for one, form in FORMATS.items() if form.matches(path, text)), None)
    if name is None:
        raise SonarrecError(
            f"{path}: a folder without LabelMe JSON files"
            if path.is_dir()
            else f"{path}: not an annotation file this program reads (CVAT XML 1.1, COCO JSON, "
            "MOTChallenge gt.txt, LabelMe JSON); unpack an archive first"
        )
    return name, FORMATS[name].read(path)
