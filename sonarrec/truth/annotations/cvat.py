"""CVAT XML 1.1, "for video" (tracks) and "for images".

Read as a stream of elements. CVAT writes no document type declaration and none is accepted:
without one there are no entities to expand and nothing is fetched from elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from xml.parsers import expat

from sonarrec.errors import SonarrecError, number_of
from sonarrec.truth.annotations.shapes import (
    HALF_A_PIXEL,
    Annotations,
    Shape,
    centre_of_area,
    coordinate,
    shortened,
    stated_visible,
    whole,
)

MOST_FILLED_IN = 200_000
"""Shapes between keyframes, of all tracks: hours of recording. Beyond it a number is mistyped."""


def matches(path: Path, text: str) -> bool:
    """Whether a file, which begins with `text`, is CVAT's."""
    return path.is_file() and "<annotations" in text


def read(path: Path) -> Annotations:
    """Read an annotations.xml. Raises SonarrecError, with the line, on anything not understood.

    Frames between two keyframes of a track are filled in linearly, as CVAT itself does on export,
    unless the first of the two is marked outside.
    """
    parser = expat.ParserCreate()
    reader = _Reader()
    parser.StartElementHandler = reader.start
    parser.EndElementHandler = reader.end
    parser.CharacterDataHandler = reader.text
    parser.StartDoctypeDeclHandler = _refuse
    parser.buffer_text = True
    try:
        with path.open("rb") as file:
            parser.ParseFile(file)
    except OSError as error:
        raise SonarrecError(f"{path}: cannot be read ({error.strerror})") from None
    except expat.ExpatError as error:
        raise SonarrecError(f"{path}: not well-formed XML ({error})") from None
    except KeyError as error:
        where = f"{path} line {parser.CurrentLineNumber}"
        raise SonarrecError(f"{where}: lacks the attribute {error.args[0]!r}") from None
    except (LookupError, ValueError) as error:  # LookupError: of an encoding nobody knows
        raise SonarrecError(f"{path} line {parser.CurrentLineNumber}: {error}") from None
    return reader.found


def _refuse(*_: object) -> None:
    raise ValueError("a document type declaration, which CVAT does not write, is not accepted")


def _box(a: Mapping[str, str]) -> tuple[float, float]:
    # Also of a rotated box, which turns about its centre.
    left, right, top, bottom = (coordinate(a[name]) for name in ("xtl", "xbr", "ytl", "ybr"))
    return (left + right) / 2, (top + bottom) / 2


def _mask(a: Mapping[str, str]) -> tuple[float, float]:
    left, width, top, height = (coordinate(a[name]) for name in ("left", "width", "top", "height"))
    return left + width / 2, top + height / 2


def _points(a: Mapping[str, str]) -> list[tuple[float, float]]:
    pairs = [point.split(",") for point in a["points"].split(";")]
    if any(len(pair) != 2 for pair in pairs):
        raise ValueError(f"points must be x,y;x,y and so on, not {shortened(a['points'])}")
    return [(coordinate(x), coordinate(y)) for x, y in pairs]


def _polygon(a: Mapping[str, str]) -> tuple[float, float]:
    points = _points(a)
    if len(points) < 3:
        raise ValueError(f"{number_of(len(points), 'point')}, which is no polygon")
    return centre_of_area(points)


def _point(a: Mapping[str, str]) -> tuple[float, float] | None:
    points = _points(a)  # several are one shape, and each may be of another thing
    return points[0] if len(points) == 1 else None


_CENTRES: dict[str, Callable[[Mapping[str, str]], tuple[float, float] | None]] = {
    "box": _box,
    "ellipse": lambda a: (coordinate(a["cx"]), coordinate(a["cy"])),
    "mask": _mask,
    "polygon": _polygon,
    "points": _point,
}
"""The centre of each shape; None if it has no one centre."""
_OTHER_SHAPES = {"polyline", "cuboid", "skeleton", "tag"}


class _Reader:
    """Handles the elements as they come."""

    def __init__(self) -> None:
        self.found = Annotations()
        # Of the track that is open: frames, shapes and whether they are marked as outside.
        self._track: list[tuple[int, Shape, bool]] | None = None
        self._image: str | None = None  # that is open
        self._label = ""
        self._open: list[tuple[str, dict[str, str]]] = []
        self._attributes: dict[str, str] = {}  # free attributes of the shape that is open
        self._tasks: set[str] = set()
        self._text = ""
        self._width = 0

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self._text = ""
        self._open.append((tag, attributes))
        if tag in ("track", "image"):
            self._tasks.add(attributes.get("task_id", ""))
            if len(self._tasks) > 1:
                raise ValueError("several tasks in one file; export them one by one")
        if tag == "track":
            self._track, self._label = [], attributes["label"]
        elif tag == "image":
            self._image = attributes["name"]
            self.found.images.append(self._image)
            size = whole(attributes["width"]), whole(attributes["height"])
            self.found.sizes[self._image] = size
        elif tag in _CENTRES:
            self._attributes = {}
        elif tag in _OTHER_SHAPES and len(self._open) == 3:
            self._pass_over(tag, attributes)

    def text(self, text: str) -> None:
        self._text += text

    def end(self, tag: str) -> None:
        _, attributes = self._open.pop()
        if tag == "attribute" and "name" in attributes:
            self._attributes[attributes["name"]] = self._text
        elif tag == "width":
            self._width = whole(self._text)
        elif tag == "height":
            self.found.sizes[None] = self._width, whole(self._text)
        elif tag == "track" and self._track is not None:
            self._close_track(sorted(self._track, key=itemgetter(0)))
            self._track = None
        elif tag == "image":
            self._image = None
        # The parts of a skeleton lie one level deeper and are no shapes of their own.
        elif tag in _CENTRES and len(self._open) == 2:
            self._close_shape(tag, attributes)

    def _close_shape(self, tag: str, attributes: dict[str, str]) -> None:
        centre = _CENTRES[tag](attributes)
        if centre is None:
            self._pass_over(f"several {tag}", attributes)
            return
        x, y = (value - HALF_A_PIXEL for value in centre)
        visible = stated_visible({"occluded": attributes.get("occluded"), **self._attributes})
        if self._track is not None:
            frame, outside = whole(attributes["frame"]), attributes.get("outside") == "1"
            self._track.append((frame, Shape(frame, self._label, x, y, visible), outside))
        elif self._image is not None:
            self.found.shapes.append(Shape(self._image, attributes["label"], x, y, visible))

    def _pass_over(self, what: str, attributes: Mapping[str, str]) -> None:
        if attributes.get("outside") != "1":  # else it only says where a track ends
            self.found.unused[what] += 1

    def _close_track(self, track: list[tuple[int, Shape, bool]]) -> None:
        self.found.shapes += [shape for _, shape, outside in track if not outside]
        for (frame, a, outside), (following, b, _) in pairwise(track):
            gap = following - frame
            if outside or gap < 2:
                continue
            self.found.interpolated += gap - 1
            if self.found.interpolated > MOST_FILLED_IN:
                raise ValueError(
                    f"{self.found.interpolated} shapes to fill in between keyframes, the last of "
                    f"them {gap} frames apart; more than {MOST_FILLED_IN} are not filled in"
                )
            for step in range(1, gap):
                part = step / gap
                x, y = a.x + part * (b.x - a.x), a.y + part * (b.y - a.y)
                self.found.shapes.append(replace(a, frame=frame + step, x=x, y=y))
