"""COCO JSON: objects and keypoints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sonarrec.records import SonarrecError
from sonarrec.truth.annotations.shapes import (
    HALF_A_PIXEL,
    NOT_AS_DESCRIBED,
    PARTLY_HIDDEN,
    Annotations,
    Shape,
    centre_of_area,
    coordinate,
    read_json,
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
    """Read a COCO document. Raises SonarrecError on anything not understood.

    The centre of an object is that of its only labelled keypoint, else of its polygon, else of its
    box. Crowds, which stand for many objects, are passed over.
    """
    document = read_json(path)
    found = Annotations()
    where = "images and categories"
    try:
        labels = {category["id"]: str(category["name"]) for category in document["categories"]}
        names = {}
        for image in document["images"]:
            names[image["id"]] = str(image["file_name"])
            if "width" in image and "height" in image:
                size = whole(image["width"]), whole(image["height"])
                found.sizes[names[image["id"]]] = size
        found.images.extend(names.values())
        for number, annotation in enumerate(document["annotations"]):
            where = f"annotation {number} of the list"
            if annotation.get("iscrowd"):
                found.unused["crowds"] += 1
                continue
            x, y, visible = _centre(annotation)
            name, label = names[annotation["image_id"]], labels[annotation["category_id"]]
            found.shapes.append(Shape(name, label, x, y, visible))
    except NOT_AS_DESCRIBED as error:
        raise SonarrecError(f"{path}: {where}: not as COCO describes it ({error!r})") from None
    return found


def _centre(annotation: dict[str, Any]) -> tuple[float, float, float | None]:
    """(x, y, visible) of one annotation."""
    visible = stated_visible(annotation.get("attributes") or {})
    flat = annotation.get("keypoints") or []
    keypoints = [tuple(flat[n : n + 3]) for n in range(0, len(flat), 3)]
    labelled = [(x, y, flag) for x, y, flag in keypoints if flag]
    if len(labelled) == 1:
        x, y, flag = labelled[0]
        if visible is None and flag == 1:  # labelled, but not visible
            visible = PARTLY_HIDDEN
        # A keypoint names a pixel; boxes and polygons run along the edges between pixels.
        return coordinate(x), coordinate(y), visible
    polygons = annotation.get("segmentation")
    if isinstance(polygons, list) and len(polygons) == 1 and len(polygons[0]) >= 6:
        flat = [coordinate(value) for value in polygons[0]]
        x, y = centre_of_area(list(zip(flat[0::2], flat[1::2], strict=True)))
    else:
        left, top, width, height = (coordinate(value) for value in annotation["bbox"])
        x, y = left + width / 2, top + height / 2
    return x - HALF_A_PIXEL, y - HALF_A_PIXEL, visible
