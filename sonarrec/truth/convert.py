"""Converts COCO annotations to gt.csv: labels to IDs, images to frames, centres to fan pixels. And
gt.csv to COCO."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import unquote

import cv2
import msgspec
import numpy as np

from sonarrec.drawing.pen import disc_outline
from sonarrec.errors import Diagnostics, SonarrecError, UsageError, number_of
from sonarrec.landmarks import LandmarkSet
from sonarrec.readers.log import Log
from sonarrec.readers.open import find_log
from sonarrec.results.folders import possible_names
from sonarrec.sonar.geometry import pixel_from_polar
from sonarrec.tables import composed, natural_order, not_text
from sonarrec.tables.read import ID_IN_LABELS, LARGEST, NONE
from sonarrec.truth.check import misfit, report_other_logs
from sonarrec.truth.coco import ATTRIBUTES, HALF_A_PIXEL, ImageObject, pictures_of, write_coco
from sonarrec.truth.match import match_truth, share_in_image
from sonarrec.truth.table import HEADER, read_cells, read_truth, write_truth

MOST_ROUNDING_PX = 0.1
PARTLY_HIDDEN = 0.5  # `visible` of a shape flagged as occluded; the flag does not say by how much
_PLAIN_LABEL = re.compile(rf"(?:{ID_IN_LABELS})?(\d{{1,18}})", re.IGNORECASE)
_LAST_NUMBER = re.compile(r"[0-9]{1,18}$")
# Label Studio puts a hash before the names of images, Roboflow one behind.
_HASH = re.compile(
    r"^(?=[0-9]*[a-f])[0-9a-f]{8}-|(?:_(?:png|jpe?g|bmp|tiff?))?\.rf\.[0-9A-Za-z]{7,}$"
)


class _Image(msgspec.Struct):
    id: int | str
    file_name: str
    width: int | None = None
    height: int | None = None


class _Category(msgspec.Struct):
    id: int | str
    name: str


class _Annotation(msgspec.Struct):
    image_id: int | str
    category_id: int | str
    bbox: list[float] = []
    segmentation: Any = None
    keypoints: list[float] | None = None
    attributes: dict[str, Any] | None = None
    iscrowd: int | bool = 0


class _Coco(msgspec.Struct):
    images: list[_Image]
    categories: list[_Category]
    annotations: list[_Annotation]


def convert(
    source: Path,
    out: Path,
    landmarks: LandmarkSet,
    *,
    labels: Mapping[str, int | None] | None = None,
    first_frame: int = 0,
    log: Log | None = None,
) -> tuple[dict[str, int], Diagnostics]:
    """Write the annotations in a COCO document as `out`, a new gt.csv; (rows per ID or none, faults
    and notes).

    The centre of an object is that of its only labelled keypoint, else of its polygon, else of its
    box; ATTRIBUTES become columns. labels: the ID for labels that do not show it themselves; None
    leaves a label out. first_frame: the number that the names of the images give
    the log's first frame. log: finds frames by image name, turns polar pixels into fan pixels, and
    limits a `visible` that is not stated to the share of the disc inside the fan. Raises
    SonarrecError if nothing can be used or `out` exists,
    UsageError if `labels` are invalid.
    """
    try:
        text = source.read_bytes()
        coco = msgspec.json.decode(text, type=_Coco)
    except OSError as error:
        raise SonarrecError(f"{source}: cannot be read ({error.strerror})") from None
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        what = not_text(text[:32], "COCO JSON") or f"not COCO JSON ({error})"
        raise SonarrecError(
            f"{source}: {what}. This command reads COCO JSON; a CSV with the columns of gt.csv "
            "needs no conversion (sonarrec help truth)"
        ) from None
    diagnostics = Diagnostics()
    images = {image.id: image for image in coco.images}
    names = {category.id: category.name for category in coco.categories}
    # (image, label, x, y, visible, texts of ATTRIBUTES); the annotations that have no centre
    shapes, without = [], []
    for n, mark in enumerate(coco.annotations):
        if mark.image_id not in images or mark.category_id not in names:
            raise SonarrecError(f"{source}: annotations[{n}] names an image or category not listed")
        is_mask = isinstance(mark.segmentation, dict)  # of runs, which tools flag as a crowd too
        centre = None if mark.iscrowd and not is_mask else _centre(mark)
        if centre is None:
            without.append(n)
        else:
            shapes.append(
                (images[mark.image_id], names[mark.category_id], *centre, _attribute_cells(mark))
            )
    if without:
        more = f"such as annotations[{without[0]}]"
        diagnostics.problem(
            f"{number_of(len(without), 'annotation')} without one centre, {more}, left out"
        )
    within_one = [max(abs(shape[2]), abs(shape[3])) <= 1 for shape in shapes]
    if 2 * sum(within_one) > len(shapes):
        raise SonarrecError(
            f"{source}: {sum(within_one)} of {len(shapes)} shapes lie within the first pixel, as "
            "if given in shares of the image; export them in pixels"
        )
    ids = _landmark_ids(
        Counter(label for _, label, *_ in shapes), labels or {}, landmarks, diagnostics
    )
    twice = [name for name, n in Counter(image.file_name for image in coco.images).items() if n > 1]
    if twice:
        raise SonarrecError(
            f"{source}: {number_of(len(twice), 'name')} of several images each, such as "
            f"{twice[0]}, as where videos share names; export the annotations of one log only"
        )
    if log is not None and (other := _other_folder(coco.images, find_log(log.path).location)):
        diagnostics.problem(other)
    pictures = None if log is None else pictures_of(log)
    in_log = pictures.files if pictures else ()
    frames, rule = _frames_of([image.file_name for image in coco.images], first_frame, in_log)
    if min(frames.values(), default=0) < 0 or len(set(frames.values())) < len(frames):
        raise SonarrecError(
            f"{source}: images before the log's first frame, or two of one frame ({rule}); give "
            "--log, another --first-frame, or annotations of one log only"
        )
    if missing := {image.file_name for image, *_ in shapes} - set(frames):
        diagnostics.problem(
            f"{number_of(len(missing), 'image')} not in the log, such as {min(missing)}"
        )
    used = [shape for shape in shapes if shape[1] in ids and shape[0].file_name in frames]
    x, y, visible = np.array([shape[2:5] for shape in used], float).reshape(-1, 3).T
    sizes = [(shape[0].width or math.inf, shape[0].height or math.inf) for shape in used]
    columns, rows_px = np.array(sizes, float).reshape(-1, 2).T
    lost = (x < -1) | (y < -1) | (x > columns) | (y > rows_px)
    if pictures and used:
        size, *others = {(image.width, image.height) for image, *_ in used}
        of_discs = pictures.polar((None, None) if others else size, x, y)
        x, y = pixel_from_polar(pictures.fan, *of_discs)
        visible = np.minimum(visible, share_in_image(pictures.fan, *of_discs, landmarks.radius_m))
        lost = visible == 0
    # A shape whose `visible` is stated is where a person says.
    lost &= np.array([not shape[-1]["visible"] for shape in used], bool)
    if lost.any():
        image, _, at_x, at_y, *_ = used[np.argmax(lost)]
        diagnostics.problem(
            f"{np.sum(lost)} of {number_of(len(used), 'shape')} lie outside the "
            f"{'fan' if log else 'image'}, such as at {at_x:.0f}, {at_y:.0f} in "
            f"{image.file_name}, left out; a box is [x, y, width, height], not two corners"
        )
    if diagnostics.problems and lost.all():
        raise SonarrecError(f"{source}: nothing can be used: {'; '.join(diagnostics.problems)}")
    extra = [c for c in ATTRIBUTES[1:] if any(shape[-1][c] for shape in used)]
    rows = {
        (
            *(frames[image.file_name], ids[label], f"{x[n]:.2f}", f"{y[n]:.2f}"),
            f"{float(texts['visible'] or visible[n]):.3f}",
            *(texts[c] for c in extra),
        )
        for n, (image, label, *_, texts) in enumerate(used)
        if not lost[n]
    }
    names_of_ids = {i: f"ID.{i}" for i in landmarks.ids} | {NONE: "none"}
    written = [(n, "none" if i == NONE else i, *cells) for n, i, *cells in sorted(rows)]
    write_truth(out, [*HEADER.split(","), *extra], written)
    diagnostics.note(rule)
    counts = Counter(row[1] for row in rows)
    return {name: counts[i] for i, name in names_of_ids.items() if counts[i]}, diagnostics


def _attribute_cells(annotation: _Annotation) -> dict[str, str]:
    """The text of each of ATTRIBUTES; empty if not stated, or invalid. CVAT renumbers tracks."""
    given = (annotation.attributes or {}).items()
    stated = {str(k).lower(): str(v).strip() for k, v in given if v is not None}
    stated.setdefault("track", stated.get("track_id", ""))
    for column, least, most in (("visible", 0, 1), ("orientation_deg", -LARGEST, LARGEST)):
        try:
            is_valid = least <= float(stated.get(column, "")) <= most
        except ValueError:
            is_valid = False
        stated[column] = stated[column] if is_valid else ""
    return {column: stated.get(column, "") for column in ATTRIBUTES}


def _centre(annotation: _Annotation) -> tuple[float, float, float] | None:
    """(x, y, visible) of one annotation; None if it has no one position."""
    stated = {str(k).lower(): v for k, v in (annotation.attributes or {}).items()}
    visible = PARTLY_HIDDEN if stated.get("occluded") in (True, 1, "true") else 1.0
    k = annotation.keypoints or []
    labelled = [point for point in zip(k[::3], k[1::3], k[2::3], strict=False) if point[2] > 0]
    if len(labelled) == 1:
        # A keypoint names a pixel; boxes and polygons run along the edges between pixels.
        x, y, flag = labelled[0]
        return x, y, min(visible, PARTLY_HIDDEN if flag == 1 else 1.0)
    outlines = annotation.segmentation
    if isinstance(outlines, list) and len(outlines) == 1 and len(outlines[0]) >= 6:
        # The centre of the area, since a person sets the points of an outline unevenly.
        outline = np.array(outlines[0][: len(outlines[0]) // 2 * 2], np.float64).reshape(-1, 2)
        corner = outline.min(axis=0)
        area = cv2.moments((outline - corner).astype(np.float32))
        if area["m00"]:
            middle = corner + np.array([area["m10"], area["m01"]]) / area["m00"] - HALF_A_PIXEL
            return float(middle[0]), float(middle[1]), visible
    if len(annotation.bbox) != 4 or not any(annotation.bbox):  # as is written where there is none
        return None
    left, top, width, height = annotation.bbox
    return left + width / 2 - HALF_A_PIXEL, top + height / 2 - HALF_A_PIXEL, visible


def _landmark_ids(
    labels: Counter[str],
    given: Mapping[str, int | None],
    landmarks: LandmarkSet,
    diagnostics: Diagnostics,
) -> dict[str, int]:
    """The ID per label that has one; labels that should have one are reported."""
    known = ", ".join(map(str, landmarks.ids))
    for label, landmark in given.items():
        if label not in labels:
            raise UsageError(f"--map {label}: no shape has this label; labels: {', '.join(labels)}")
        if landmark is not None and landmark not in landmarks.ids:
            raise UsageError(f"--map {label}: ID {landmark} is not in {landmarks.name!r} ({known})")
    ids = {label: landmark for label, landmark in given.items() if landmark is not None}
    for label in set(labels) - set(given):
        plain = _PLAIN_LABEL.fullmatch(label.strip())
        if plain is not None and int(plain[1]) in landmarks.ids:
            ids[label] = int(plain[1])
        elif label.strip() == "none":
            ids[label] = NONE
        else:
            diagnostics.problem(
                f"label {label!r} ({number_of(labels[label], 'shape')}) is no ID of "
                f"{landmarks.name!r} ({known}): give --map '{label}=ID', or '{label}=none'"
            )
    return ids


def _other_folder(images: Sequence[_Image], log: Path) -> str:
    """Whether most images are named as in another log's folder, next to this log's; empty: no."""
    folders = Counter(Path(image.file_name.replace("\\", "/")).parent.name for image in images)
    ((name, count),) = folders.most_common(1) or [("", 0)]
    if name in ("", log.name) or not (log.parent / name).is_dir():
        return ""
    return (
        f"{count} of {len(images)} images are named as in the folder {name}, not in {log.name}; "
        f"are they of the log {log.parent / name}?"
    )


def _frames_of(
    images: Sequence[str], first_frame: int, in_log: Sequence[Path]
) -> tuple[dict[str, int], str]:
    """(the frame of each image that has one, the rule). in_log: the log's own images.

    An image is found by its name in the log, in any folder and with any suffix. If the log has no
    names, the number at the end of every name counts; else the natural order of the names.
    """
    stems = {
        name: composed(Path(unquote(name.replace("\\", "/").partition("?")[0])).stem)
        for name in images
    }
    of_log = {composed(file.stem): n for n, file in enumerate(in_log)}
    if not of_log.keys() & stems.values():
        stems = {name: _HASH.sub("", stem) for name, stem in stems.items()}
    if in_log:
        frames = {name: of_log[stem] for name, stem in stems.items() if stem in of_log}
        if images and not frames:
            raise SonarrecError(f"no image of the log is called {images[0]!r}; give its own log")
        return frames, "frames by image name in the log"
    ends = {name: _LAST_NUMBER.search(stem) for name, stem in stems.items()}
    numbers = {name: int(end[0]) - first_frame for name, end in ends.items() if end}
    if len(numbers) == len(stems):
        return numbers, f"frames by the number that ends every image name, from {first_frame}"
    order = sorted(stems, key=lambda name: natural_order(stems[name]))
    by_order = "frames by the natural order of the images listed; give --log where it has more"
    return {name: n for n, name in enumerate(order)}, by_order


def truth_to_coco(
    source: Path, out: Path, landmarks: LandmarkSet, log: Log
) -> tuple[str, Diagnostics]:
    """Write the rows of a gt.csv on a log as `out`, a new COCO file with all frames of the log;
    (a line on it, faults and notes).

    Raises SonarrecError if the truth has no positions or cannot be the log's, or `out` exists.
    """
    table, diagnostics = read_truth(source), Diagnostics()
    if table.position is None:
        raise SonarrecError(f"{source}: no positions (x_px,y_px or range_m,bearing_deg) to draw")
    pictures = pictures_of(log)
    index, times = np.array([(frame.index, frame.timestamp_ns) for frame in log], np.int64).T
    name = table.name_of(possible_names(log.name, find_log(log.path).location.resolve()))
    of_log = {"name": name, "landmarks": landmarks, "fan": pictures.fan, "frame": index}
    frames: Any = SimpleNamespace(**of_log, timestamp_ns=times)  # a ReadLog
    header, cells = read_cells(source)
    objects = list[ImageObject]()
    for strangers in (False, True):
        truth = match_truth(table, frames, strangers=strangers)
        if not strangers and (why := misfit(table, frames, truth)):
            raise SonarrecError(why)
        if lost := truth.unprocessed + truth.between:
            diagnostics.problem(f"{source}: {number_of(lost, 'row')} on no frame of the log")
        centres = truth.pixels(pictures.fan)
        assert centres is not None
        if table.pixel is not None:  # stated besides metres, and perhaps rounded otherwise
            own = table.pixel[truth.row]
            centres = np.where(np.abs(own - centres) < MOST_ROUNDING_PX, own, centres)
        ids = [(*landmarks.ids, NONE)[k] for k in truth.landmark_index]
        of_rows = zip(
            index[truth.frame_index].tolist(), ids, centres.tolist(), truth.row, strict=True
        )
        for frame, landmark, (x, y), row in of_rows:
            stated = dict(zip(header, map(str.strip, cells[row]), strict=False))
            attributes: dict[str, Any] = {c: stated[c] for c in ATTRIBUTES[2:] if stated.get(c)}
            if table.orientation is not None and np.isfinite(table.orientation[row]):
                attributes["orientation_deg"] = float(table.orientation[row])
            attributes["visible"] = float(table.visible[row])
            outline = disc_outline(pictures.fan, landmarks.radius_m, x, y)
            objects.append(ImageObject(frame, landmark, x, y, outline, attributes))
    report_other_logs(diagnostics, table, [name], "they are left out")
    diagnostics.problem(*log.diagnostics.problems)
    objects.sort(key=lambda item: item[:4])
    return write_coco(out, landmarks, pictures, index.tolist(), objects), diagnostics
