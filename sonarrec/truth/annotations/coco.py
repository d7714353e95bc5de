"""COCO JSON: objects and keypoints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sonarrec.errors import SonarrecError
from sonarrec.truth.annotations.shapes import (
    HALF_A_PIXEL,
    PARTLY_HIDDEN,
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


def matches(path: Path, text: str) -> bool:
    """Whether a file, which begins with `text`, is a COCO document."""
    if not path.is_file() or not text.lstrip().startswith("{"):
        return False
    document = read_json(path)
    return {"images", "annotations", "categories"} <= set(document)


def read(path: Path) -> Annotations:
    """Read a COCO document. Raises SonarrecError if its lists are not understood; annotations that
    are not, or name no image, are counted, and the first is told.

    The centre of an object is that of its only labelled keypoint, else of its polygon, else of its
    box. Crowds, which stand for many objects, are passed over.
    """
    document = read_json(path)
    found, wrong = Annotations(), ""
    try:
        names = _names(document, "images", "file_name")
        labels = _names(document, "categories", "name")
        for number, image in enumerate(document["images"]):
            with _row(f"images[{number}]"):
                if image.get("width") and image.get("height"):
                    found.sizes[names[image["id"]]] = whole(image["width"]), whole(image["height"])
        found.images.extend(names.values())
        for number, annotation in enumerate(listed(document, "annotations")):
            try:
                name = _named(names, annotation, "image_id", "images")
                label = _named(labels, annotation, "category_id", "categories")
                centre = None if annotation.get("iscrowd") else _centre(annotation)
            except ValueError as error:
                wrong = wrong or f"not as COCO describes it (annotations[{number}]: {error})"
                found.unused[wrong] += 1
                continue
            if annotation.get("iscrowd"):
                found.unused["crowd"] += 1
            elif centre is None:
                found.unused["annotation left empty"] += 1
            else:
                found.shapes.append(Shape(name, label, *centre))
    except ValueError as error:
        raise SonarrecError(f"{path}: not as COCO describes it ({error})") from None
    return found


@contextmanager
def _row(where: str) -> Iterator[None]:
    """A ValueError raised inside begins with the row of the document."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _names(document: Any, key: str, name: str) -> dict[float | str, str]:
    """The names in a list of the document, by id. Raises ValueError if they are not stated."""
    names: dict[float | str, str] = {}
    for number, row in enumerate(listed(document, key)):
        with _row(f"{key}[{number}]"):
            n, text = stated(row, "id"), str(stated(row, name))
            if not isinstance(n, int | float | str):
                raise ValueError(f"id {n!r}")
            if names.setdefault(n, text) != text:
                raise ValueError(f"id {n!r} is that of {names[n]!r} and of {text!r}")
    return names


def _named(names: Mapping[float | str, str], annotation: Any, key: str, where: str) -> str:
    """The name that an id of an annotation stands for. Raises ValueError where it has none."""
    n = stated(annotation, key)
    if not isinstance(n, int | float | str) or n not in names:
        raise ValueError(f"{key} {n!r} is not among the {where}")
    return names[n]


def _centre(annotation: dict[str, Any]) -> tuple[float, float, float | None] | None:
    """(x, y, visible) of one annotation; None if it has no position."""
    attributes = annotation.get("attributes")
    visible = stated_visible(attributes if isinstance(attributes, dict) else {})
    flat = listed(annotation, "keypoints") if annotation.get("keypoints") else []
    keypoints = [coordinates(flat[n : n + 3], 3, "a keypoint") for n in range(0, len(flat), 3)]
    labelled = [(x, y, flag) for x, y, flag in keypoints if flag]
    if len(labelled) == 1:
        x, y, flag = labelled[0]
        if visible is None and flag == 1:  # labelled, but not visible
            visible = PARTLY_HIDDEN
        # A keypoint names a pixel; boxes and polygons run along the edges between pixels.
        return x, y, visible
    outlines = annotation.get("segmentation")
    outline = outlines[0] if isinstance(outlines, list) and len(outlines) == 1 else None
    if isinstance(outline, list) and len(outline) >= 6:
        flat = coordinates(outline, len(outline) // 2 * 2, "a polygon")
        x, y = centre_of_area(list(zip(flat[0::2], flat[1::2], strict=True)))
    else:
        if annotation.get("bbox") == []:
            return None
        left, top, width, height = coordinates(stated(annotation, "bbox"), 4, "bbox")
        if not (left or top or width or height):  # as is written where there is none
            return None
        x, y = left + width / 2, top + height / 2
    return x - HALF_A_PIXEL, y - HALF_A_PIXEL, visible
