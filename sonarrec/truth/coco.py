"""COCO: truth or claims as boxes on the images of a log, and pixels of these images as positions.

CVAT, Label Studio and FiftyOne import such a file; `truth/convert.py` reads it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sonarrec import __version__
from sonarrec.arrays import FloatArray
from sonarrec.errors import SonarrecError, name_as_text, number_of
from sonarrec.landmarks import LandmarkSet
from sonarrec.readers.containers.images import is_image
from sonarrec.readers.log import Log
from sonarrec.readers.open import find_log
from sonarrec.sonar.frame import Fan
from sonarrec.sonar.geometry import beam_bearings, bin_ranges, pixel_from_polar, polar_from_pixel
from sonarrec.sonar.stated import Sonar
from sonarrec.tables.outputs import write_text, writing
from sonarrec.tables.read import NONE
from sonarrec.truth.check import SLACK
from sonarrec.truth.match import share_in_image
from sonarrec.truth.table import check_new

HALF_A_PIXEL = 0.5  # tools put (0, 0) at the image's corner, we at the centre of its first pixel
ATTRIBUTES = ("visible", "orientation_deg", "track", "source")
"""Columns of gt.csv that are attributes of an annotation."""


@dataclass(frozen=True, slots=True)
class Pictures:
    """The images of a log that a person annotates: its image files, else its fan images.

    name: of the log. sonar: its geometry as stated. size: (columns, rows) of the images. files: by
    frame; empty for a log of another kind, or if they are not known.
    """

    name: str
    fan: Fan
    sonar: Sonar
    size: tuple[int, int]
    files: Sequence[Path] = ()

    def file_name(self, frame: int) -> str:
        """The name of a frame's image; if it is of no file, the frame's number ends it."""
        own = f"{self.name}_{frame:06d}.png"
        return name_as_text(self.files[frame].name if frame < len(self.files) else own)

    def pixel(self, range_m: FloatArray, bearing_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(column, row) in the images, (N,) each, of slant ranges and bearings."""
        if self.size == (self.fan.columns, self.fan.rows):
            return self._stored(*pixel_from_polar(self.fan, range_m, bearing_deg))
        bearings, ranges = self._samples(self.size)
        column = _on_line(bearing_deg, bearings, np.arange(len(bearings)))
        row = _on_line(range_m, ranges, np.arange(len(ranges)))
        return (row, column) if self.sonar.beam_order == "beam-major" else (column, row)

    def polar(
        self, size: tuple[Any, Any], column: FloatArray, row: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """(slant range in m, bearing in deg), (N,) each, of pixels of fan or polar images.

        size: (columns, rows) of the images. Raises SonarrecError if it is not that of the log's.
        """
        if size == (self.fan.columns, self.fan.rows):
            return polar_from_pixel(self.fan, *self._stored(column, row))
        if self.sonar.beam_order == "beam-major":
            column, row = row, column
        bearings, ranges = self._samples(size)
        range_m = _on_line(row, np.arange(len(ranges)), ranges)
        return range_m, _on_line(column, np.arange(len(bearings)), bearings)

    def _stored(self, column: FloatArray, row: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels of the fan as pixels of the images as they are stored, and the reverse."""
        if self.sonar.layout != "polar" and self.sonar.flip:
            column = self.fan.columns - 1 - column
        if self.sonar.layout != "polar" and self.sonar.range_order == "near_first":
            row = self.fan.rows - 1 - row
        return column, row

    def _samples(self, size: tuple[Any, Any]) -> tuple[FloatArray, FloatArray]:
        """(bearing of each beam, slant range of each bin) of polar images as they are stored."""
        beams, bins = size[::-1] if self.sonar.beam_order == "beam-major" else size
        known = len(self.sonar.bearings_deg or ()) or beams
        expected = known, round(self.fan.window_m / self.fan.metres_per_pixel)
        if self.sonar.layout != "polar" or None in size or (beams, bins) != expected:
            theirs = "of several sizes, or of none" if None in size else f"{size[0]} x {size[1]} px"
            raise SonarrecError(
                f"{self.name}: the annotated images are {theirs}, those of the log "
                f"{self.size[0]} x {self.size[1]} px; annotate these, or scale size and shapes"
            )
        geometry = self.sonar.complete(self.name)
        bearings, ranges = beam_bearings(geometry, beams), bin_ranges(geometry, bins)
        ranges = ranges[::-1] if self.sonar.range_order == "far_first" else ranges
        return (-bearings if self.sonar.flip else bearings), ranges


def pictures_of(log: Log) -> Pictures:
    """The images of an opened log, by its first frame."""
    first = next(iter(log))
    files = [file for file in find_log(log.path).files if is_image(file)]
    size = first.fan.columns, first.fan.rows
    if files and first.polar is not None:
        bins, beams = first.polar.shape
        size = (bins, beams) if log.sonar.beam_order == "beam-major" else (beams, bins)
    return Pictures(log.name, first.fan, log.sonar, size, files)


def _on_line(at_x: FloatArray, x: Any, y: Any) -> FloatArray:
    """(N,) the line through points (x, y), of monotonic x, at (N,) x. Its ends go on straight, for
    a disc that the image's edge cuts may have its centre there."""
    order = np.argsort(x)
    x, y = x[order], y[order]
    slope = np.diff(y) / np.diff(x)
    beyond = np.minimum(at_x - x[0], 0) * slope[0] + np.maximum(at_x - x[-1], 0) * slope[-1]
    return np.asarray(np.interp(at_x, x, y) + beyond)


class ImageObject(NamedTuple):
    """A disc or plate in one frame. landmark: its ID; NONE for an object that is no landmark.

    x_px, y_px: its centre, in fan pixels. outline: (n, 2) fan pixels. attributes: by name, such as
    those of ATTRIBUTES; without `visible` it is the share that the fan image shows.
    """

    frame: int
    landmark: int
    x_px: float
    y_px: float
    outline: FloatArray
    attributes: dict[str, Any]
    score: float = 1.0  # Label Studio imports no annotation without one


def write_coco(
    out: Path,
    landmarks: LandmarkSet,
    pictures: Pictures,
    frames: Iterable[int],
    objects: Sequence[ImageObject],
) -> str:
    """Write a new COCO file of the objects on these frames; a line on what is in it.

    A box is centred at the disc, and as large as the whole disc, also beyond the image's edges.
    Raises SonarrecError if `out` exists or cannot be written.
    """
    check_new(out)
    names = {i: f"ID.{i}" for i in landmarks.ids}
    if any(item.landmark == NONE for item in objects):
        names[NONE] = "none"
    numbers = {i: n for n, i in enumerate(names, 1)}
    tracks, annotations = dict[tuple[str, int], int](), list[dict[str, object]]()
    centres = np.array([item[2:4] for item in objects], float).reshape(-1, 2)
    of_discs = polar_from_pixel(pictures.fan, *centres.T)
    shares = share_in_image(pictures.fan, *of_discs, landmarks.radius_m).tolist()
    for item, share in zip(objects, shares, strict=True):
        points = polar_from_pixel(pictures.fan, *np.vstack([item[2:4], item.outline]).T)
        x, y = pictures.pixel(*points)
        half = np.abs([x - x[0], y - y[0]]).max(axis=1)
        corner = np.array([x[0], y[0]]) + HALF_A_PIXEL - half
        attributes = {"visible": round(share, 3)} | item.attributes
        attributes["occluded"] = attributes["visible"] < share - SLACK
        if track := item.attributes.get("track"):
            # CVAT gives a track one label, and makes it of keyframes.
            number = tracks.setdefault((track, item.landmark), len(tracks) + 1)
            attributes |= {"track_id": number, "keyframe": True}
        annotations.append(
            {
                "id": len(annotations) + 1,
                "image_id": item.frame + 1,
                "category_id": numbers[item.landmark],
                "bbox": np.concatenate([corner, 2 * half]).round(4).tolist(),
                "area": round(4 * half.prod(), 2),
                "segmentation": [],
                "iscrowd": 0,
                "score": item.score,
                "attributes": attributes,
            }
        )
    size = dict(zip(("width", "height"), pictures.size, strict=True))
    images = [{"id": n + 1, "file_name": pictures.file_name(n), **size} for n in frames]
    document = {
        "info": {"description": f"{pictures.name}, by sonarrec {__version__}"},
        "categories": [{"id": n, "name": names[i]} for i, n in numbers.items()],
        "images": images,
        "annotations": annotations,
    }
    with writing(out):
        write_text(out, json.dumps(document))
    return f"{out}: {number_of(len(objects), 'box', 'es')} on {number_of(len(images), 'image')}"
