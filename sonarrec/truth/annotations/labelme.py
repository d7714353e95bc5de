"""LabelMe JSON: one file an image, most often a folder of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sonarrec.errors import SonarrecError, number_of
from sonarrec.truth.annotations.shapes import (
    HALF_A_PIXEL,
    Annotations,
    Shape,
    centre_of_area,
    coordinates,
    listed,
    read_json,
    stated,
    stated_visible,
    whole,
)

_FEWEST_POINTS = {
    **{"circle": 1, "point": 1, "polygon": 3, "rectangle": 2, "mask": 2},
    "oriented_rectangle": 4,
}


def matches(path: Path, text: str) -> bool:
    """Whether a folder holds JSON files, or a file, which begins with `text`, is LabelMe's."""
    if path.is_dir():
        return bool(_files(path))
    return text.lstrip().startswith("{") and "shapes" in read_json(path)


def read(path: Path) -> Annotations:
    """Read a folder of LabelMe files, or one. Raises SonarrecError on anything not understood."""
    found, seen = Annotations(), set[str]()
    for file in _files(path) if path.is_dir() else [path]:
        document = read_json(file)
        where = ""
        try:
            # With its folder: images of two logs may share a name. Two files may be of one image.
            shapes, name = listed(document, "shapes"), str(stated(document, "imagePath"))
            if name not in seen:
                found.images.append(name)
                seen.add(name)
            if document.get("imageWidth") and document.get("imageHeight"):
                size = whole(document["imageWidth"]), whole(document["imageHeight"])
                found.sizes[name] = size
            for number, shape in enumerate(shapes):
                where = f"shapes[{number}]: "
                label, points = str(stated(shape, "label")), listed(shape, "points")
                kind = str(shape.get("shape_type") or "polygon")
                centre = _centre(kind, [coordinates(point, 2, "a point") for point in points])
                if centre is None:
                    found.unused[kind] += 1
                    continue
                x, y = (value - HALF_A_PIXEL for value in centre)
                # `visible` as a flag would be no share, only a yes.
                flags = shape["flags"] if isinstance(shape.get("flags"), dict) else {}
                hidden = next((v for flag, v in flags.items() if flag.lower() == "occluded"), None)
                visible = stated_visible({"occluded": hidden})
                found.shapes.append(Shape(name, label, x, y, visible))
        except ValueError as error:
            raise SonarrecError(
                f"{file}: not as LabelMe writes it ({where}{error})"
                + ("; move other files out of the folder" if path.is_dir() else "")
            ) from None
    return found


def _files(folder: Path) -> list[Path]:
    """The JSON files of a folder, but hidden ones."""
    return sorted(file for file in folder.glob("*.json") if not file.name.startswith("."))


def _centre(kind: str, points: Sequence[Sequence[float]]) -> tuple[float, float] | None:
    """Centre of a shape, None for kinds that have none: lines, strips and many points.

    points: of (x, y). Raises ValueError where there are too few.
    """
    if kind not in _FEWEST_POINTS:
        return None
    if len(points) < _FEWEST_POINTS[kind]:
        raise ValueError(f"{number_of(len(points), 'point')}, which is no {kind}")
    x, y = zip(*points, strict=True)
    middle = (min(x) + max(x)) / 2, (min(y) + max(y)) / 2
    if kind == "rectangle":  # two corners, or all four
        return middle
    if kind == "mask":  # its first and its last pixel, not the edges about them
        return middle[0] + HALF_A_PIXEL, middle[1] + HALF_A_PIXEL
    if kind in ("polygon", "oriented_rectangle"):
        return centre_of_area(list(zip(x, y, strict=True)))
    return x[0], y[0]  # of a circle the centre, before a point on the rim
