"""LabelMe JSON: one file an image, most often a folder of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sonarrec.records import SonarrecError
from sonarrec.truth.annotations.shapes import (
    HALF_A_PIXEL,
    NOT_AS_DESCRIBED,
    Annotations,
    Shape,
    centre_of_area,
    coordinate,
    read_json,
    stated_visible,
    whole,
)


def matches(path: Path, text: str) -> bool:
    """Whether a folder holds JSON files, or a file, which begins with `text`, is LabelMe's."""
    if path.is_dir():
        return any(path.glob("*.json"))
    return text.lstrip().startswith("{") and "shapes" in read_json(path)


def read(path: Path) -> Annotations:
    """Read a folder of LabelMe files, or one. Raises SonarrecError on anything not understood."""
    found, seen = Annotations(), set[str]()
    for file in sorted(path.glob("*.json")) if path.is_dir() else [path]:
        document = read_json(file)
        try:
            # With its folder: images of two logs may share a name. Two files may be of one image.
            name = str(document["imagePath"])
            if name not in seen:
                found.images.append(name)
                seen.add(name)
            if document.get("imageWidth") and document.get("imageHeight"):
                size = whole(document["imageWidth"]), whole(document["imageHeight"])
                found.sizes[name] = size
            for shape in document["shapes"]:
                kind = shape.get("shape_type") or "polygon"
                centre = _centre(kind, [(coordinate(x), coordinate(y)) for x, y in shape["points"]])
                if centre is None:
                    found.unused[f"{kind} shapes, which have no one centre"] += 1
                    continue
                x, y = (value - HALF_A_PIXEL for value in centre)
                visible = stated_visible(_flags(shape))
                found.shapes.append(Shape(name, str(shape["label"]), x, y, visible))
        except NOT_AS_DESCRIBED as error:
            raise SonarrecError(f"{file}: not as LabelMe writes it ({error!r})") from None
    return found


def _flags(shape: dict[str, Any]) -> dict[str, Any]:
    """The flags a person set on a shape; `visible` as a flag would be no share, only a yes."""
    flags = shape.get("flags") or {}
    return {"occluded": next((flags[f] for f in flags if f.lower() == "occluded"), None)}


def _centre(kind: str, points: list[tuple[float, float]]) -> tuple[float, float] | None:
    """Centre of a shape, None for kinds that have none: lines, strips and many points."""
    if kind == "circle":
        return points[0]  # centre, then a point on the rim
    if kind in ("rectangle", "mask"):  # two corners, or all four
        x, y = zip(*points, strict=True)
        return (min(x) + max(x)) / 2, (min(y) + max(y)) / 2
    if kind == "polygon":
        return centre_of_area(points)
    return points[0] if kind == "point" else None
