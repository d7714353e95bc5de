"""Converts annotations to gt.csv: labels to IDs, images to frames, centres to fan pixels."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from sonarrec.arrays import FloatArray
from sonarrec.errors import Diagnostics, SonarrecError, UsageError, number_of
from sonarrec.geometry import beam_bearings, bin_ranges, pixel_from_polar, polar_from_pixel
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Fan
from sonarrec.readers.containers.images import is_image, names_an_image
from sonarrec.readers.guess.times import times_in_names
from sonarrec.readers.log import Log
from sonarrec.readers.open import find_log
from sonarrec.sonar import Sonar
from sonarrec.tables.order import natural_order
from sonarrec.truth.annotations import read_annotations
from sonarrec.truth.annotations.shapes import Annotations, Shape
from sonarrec.truth.match import share_in_image
from sonarrec.truth.table import HEADER, write_truth

_PLAIN_LABEL = re.compile(r"(?:(?:id|landmark)[\s._-]*)?(\d{1,18})", re.IGNORECASE)
_LAST_NUMBER = re.compile(r"(?<![0-9])(?<![0-9]\.)[0-9]{1,18}$")
"""In an image's name; not the fraction of a time in seconds."""
_OF_ROBOFLOW = re.compile(r"(.+?)(?:_(?:png|jpe?g|bmp|tiff?))?\.rf\.[0-9A-Za-z]{7,}")
_OF_LABEL_STUDIO = re.compile(r"(?=[0-9]*[a-f])[0-9a-f]{8}-(.+)")
"""Stems as these tools export them, with a hash in which may be digits."""
_HASH = re.compile(r"(?<![0-9A-Za-z])(?=[0-9]*[a-f])[0-9a-f]{7,}$")
_BY_NUMBER = "frames by the number that ends every image name"
_BY_ORDER = "frames by the natural order of the images listed; give --log where it has more"
_FEW = 5  # most names in a message

FrameNumbers = dict[int | str, int]
"""The frame, or the time in ns, that each Shape.frame stands for."""

Sizes = Set[tuple[int, int]]  # (columns, rows) that images have


@dataclass(frozen=True, slots=True)
class LogImages:
    """What a log says about the images that were annotated.

    sonar, fan: its geometry, and that of its fan images. names: its image files in frame order;
    empty for a log in one file, whose frames have no names. frame_count: None if unknown.
    """

    sonar: Sonar
    fan: Fan
    names: tuple[str, ...]
    frame_count: int | None


@dataclass(frozen=True, slots=True)
class ConversionReport:
    """What became of the annotations.

    format: which it was. counts: rows written per ID. diagnostics: what was done on the way, and
    what could not be used, or does not fit the log.
    """

    format: str
    counts: dict[int, int]
    diagnostics: Diagnostics


def look_at(log: Log) -> LogImages:
    """Read the first frame of a log, for its geometry, and the names of its files.

    Raises SonarrecError where no frame can be used.
    """
    fan = next(iter(log)).fan
    files = find_log(log.path).files
    names = tuple(file.name for file in files if is_image(file))
    return LogImages(log.sonar, fan, names, log.frame_count)


def convert(
    source: Path,
    out: Path,
    landmarks: LandmarkSet,
    *,
    format_name: str | None = None,
    labels: Mapping[str, int | None] | None = None,
    first_frame: int | None = None,
    log: LogImages | None = None,
) -> ConversionReport:
    """Write the annotations in `source` as `out`, a new gt.csv.

    labels: the ID for labels that do not show it themselves; None leaves a label out. first_frame:
    what the annotations call the first frame of the log (default 0; MOTChallenge 1). log: finds
    frames by image name, turns polar pixels into fan pixels, and limits `visible` to the share of
    the disc inside the fan. Raises SonarrecError if nothing can be used or `out` exists,
    UsageError if `labels` or `first_frame` are invalid.
    """
    name, found = read_annotations(source, format_name)
    told = Diagnostics()
    for what, count in found.unused.items():
        told.problem(f"{what}: {number_of(count, 'shape')} passed over")
    by_label = Counter(s.label for s in found.shapes)
    ids = _landmark_ids(by_label, labels or {}, landmarks, told)
    key, frames, rule = _frame_numbers(source, found, first_frame, log.names if log else ())
    missing = Counter(str(s.frame) for s in found.shapes if s.frame not in frames)
    if missing:
        told.problem(
            f"{number_of(missing.total(), 'shape')} on images that are not in the log: "
            f"{_some(missing)}"
        )
    used = [s for s in found.shapes if s.label in ids and s.frame in frames]
    if told.problems and not used:
        raise SonarrecError(f"{source}: nothing can be used: {'; '.join(told.problems)}")
    if log is not None and key == "frame":
        told.problem(*_not_as_in_log(log, [frames[s.frame] for s in used], len(found.images), rule))
    sizes = {size for name, size in found.sizes.items() if name is None or name in frames}
    x, y, visible = _in_fan_pixels(source, sizes, used, log, landmarks.radius_m)
    # Tracks drawn in overlapping parts of one job hold a shape twice, hidden perhaps in one only.
    share: dict[tuple[int, int, str, str], str] = {}
    for n, s in enumerate(used):
        shape = frames[s.frame], ids[s.label], f"{x[n]:.2f}", f"{y[n]:.2f}"
        share[shape] = min(f"{visible[n]:.3f}", share.get(shape, "1.000"))
    rows = sorted(((*shape, least) for shape, least in share.items()), key=lambda row: row[:2])
    write_truth(out, HEADER.replace("frame", key).split(","), rows)
    told.note(rule)
    if found.interpolated:
        told.note(f"{number_of(found.interpolated, 'shape')} filled in between keyframes")
    if len(rows) < len(used):
        told.note(f"{number_of(len(used) - len(rows), 'repeated shape')} left out")
    counts = Counter(row[1] for row in rows)
    return ConversionReport(name, {i: counts[i] for i in landmarks.ids if counts[i]}, told)


def _landmark_ids(
    labels: Counter[str], given: Mapping[str, int | None], landmarks: LandmarkSet, told: Diagnostics
) -> dict[str, int]:
    """The ID per label that has one; labels that should have one are told."""
    known = ", ".join(map(str, landmarks.ids))
    for label, landmark in given.items():
        if label not in labels:
            raise UsageError(f"--map {label}: no shape has this label; labels: {_some(labels)}")
        if landmark is not None and landmark not in landmarks.ids:
            raise UsageError(f"--map {label}: ID {landmark} is not in {landmarks.name!r} ({known})")
    ids = {label: landmark for label, landmark in given.items() if landmark is not None}
    for label, count in labels.items():
        if label in given:
            continue
        plain = _PLAIN_LABEL.fullmatch(label.strip())
        named = f"label {label!r} ({number_of(count, 'time')})"
        if not label:
            told.problem(f"{number_of(count, 'shape')} without a label")
        elif plain is None:
            told.problem(
                f"{named} has no ID: give one by --map '{label}=ID', or leave it out by "
                f"--map '{label}=none'"
            )
        elif int(plain[1]) not in landmarks.ids:
            told.problem(
                f"{named} is not in the set {landmarks.name!r} ({known}): name the right set by "
                "--landmarks"
            )
        else:
            ids[label] = int(plain[1])
    return ids


def _frame_numbers(
    source: Path, found: Annotations, first_frame: int | None, log_names: Sequence[str]
) -> tuple[str, FrameNumbers, str]:
    """("frame" or "timestamp_ns", that number for each Shape.frame, how it was found)."""
    first = found.first_frame if first_frame is None else first_frame
    key, numbered = "frame", not found.images
    frames: FrameNumbers
    if numbered:
        frames = {s.frame: int(s.frame) for s in found.shapes}
        rule = f"frames as numbered in the annotations, from {first}"
    else:
        key, frames, rule = _frames_of_images(found.images, log_names)
        numbered = rule == _BY_NUMBER
    if numbered:
        frames = {name: number - first for name, number in frames.items()}
    elif first_frame is not None:
        raise UsageError(f"--first-frame has no meaning here: {rule}")
    for image, times in Counter(found.images).items():
        if times > 1 and image in frames:
            raise SonarrecError(
                f"{source}: {times} images are called {image!r} and would all be frame "
                f"{frames[image]}; give annotations of one log only"
            )
    seen: dict[int, int | str] = {}
    for name, frame in frames.items():
        if frame < 0:
            raise SonarrecError(
                f"{source}: {name!r} lies before the log's first frame, which is called {first} "
                "here; lower --first-frame"
            )
        if seen.setdefault(frame, name) != name:
            raise SonarrecError(
                f"{source}: images {seen[frame]!r} and {name!r} would both be frame {frame}; "
                "give --log, or annotations of one log only"
            )
    return key, frames, rule


def _not_as_in_log(log: LogImages, frames: Sequence[int], listed: int, rule: str) -> Iterator[str]:
    """A line for each sign that the log numbers its frames differently. frames: of the shapes.

    Nothing is left out for it, since the count that a video states may be wrong.
    """
    count = log.frame_count
    if not count:
        return
    beyond = Counter(str(frame) for frame in frames if frame >= count)
    if beyond:
        yield (
            f"{number_of(beyond.total(), 'shape')} beyond the log's last frame, {count - 1}: frame "
            f"{_some(beyond)}; {rule}. Is --first-frame right, and is this the log?"
        )
    if rule == _BY_ORDER and listed < count:
        yield (
            f"{number_of(listed, 'image')} listed, but the log has {number_of(count, 'frame')}: in "
            "their order they were taken for its first ones; name them by the numbers of their "
            "frames"
        )


def _frames_of_images(
    images: Sequence[str], log_names: Sequence[str]
) -> tuple[str, FrameNumbers, str]:
    """As `_frame_numbers`, for images that are named.

    An image is found by its name in the log, in any folder, or by its name without suffix if that
    is unique. If the log has no names, times in the names count; else the number at the end of
    every name; else their natural order. Raises SonarrecError if the log has none of the names.
    """
    paths = {name: _path(name, log_names) for name in images}
    files, stems = _once(log_names), _once([Path(name).stem for name in log_names])
    found = {name: files.get(path.name, stems.get(path.stem)) for name, path in paths.items()}
    if log_names and not any(n is not None for n in found.values()):
        paths = _without_hashes(paths)
        found = {name: stems.get(path.stem) for name, path in paths.items()}
    in_log: FrameNumbers = {name: n for name, n in found.items() if n is not None}
    if in_log:
        return "frame", in_log, "frames by image name in the log"
    if log_names and images:
        raise SonarrecError(
            f"no image of the log is called as one that was annotated: {images[0]!r} and so on "
            f"here, {log_names[0]!r} there; give the log that was annotated"
        )
    paths = _without_hashes(paths)
    order = sorted(paths, key=lambda name: natural_order(paths[name]))
    in_order = [paths[name].stem for name in order]
    times = times_in_names(in_order)
    if times is not None:
        stamps: FrameNumbers = dict(zip(order, times.tolist(), strict=True))
        return "timestamp_ns", stamps, "frames by the times in the images' names"
    latest = max((int(stem) for stem in in_order if re.fullmatch(r"[0-9]{19}", stem)), default=0)
    if latest >= 2**63:
        raise SonarrecError(f"image name {latest} is no time in ns: it must lie below 2^63")
    ends = {name: _LAST_NUMBER.search(path.stem) for name, path in paths.items()}
    numbers: FrameNumbers = {name: int(end[0]) for name, end in ends.items() if end}
    if len(numbers) == len(ends) and not any(_HASH.search(path.stem) for path in paths.values()):
        return "frame", numbers, _BY_NUMBER
    return "frame", {name: n for n, name in enumerate(order)}, _BY_ORDER


def _without_hashes(paths: dict[str, Path]) -> dict[str, Path]:
    """The images' paths as they were before Roboflow or Label Studio put a hash into every name."""
    for form in (_OF_ROBOFLOW, _OF_LABEL_STUDIO):
        found = {name: form.fullmatch(path.stem) for name, path in paths.items()}
        plain = {name: paths[name].with_stem(match[1]) for name, match in found.items() if match}
        if plain and len(plain) == len(paths):
            return plain
    return paths


def _path(name: str, log_names: Sequence[str]) -> Path:
    """An image's path. Web tools write %20 for a space and a query behind: digits of no name."""
    path = Path(name.replace("\\", "/"))
    if not ("%" in name or "?" in name) or path.name in log_names:
        return path
    address = Path(str(path).partition("?")[0])
    return Path(unquote(str(address if names_an_image(address.name) else path)))


def _once(names: Sequence[str]) -> dict[str, int]:
    """The index of each name that occurs once."""
    times = Counter(names)
    return {name: n for n, name in enumerate(names) if times[name] == 1}


def _in_fan_pixels(
    source: Path, sizes: Sizes, shapes: Sequence[Shape], log: LogImages | None, radius_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(column, row, visible), each (N,), of the shapes in the log's fan images. sizes: known ones
    of the annotated images."""
    x = np.array([s.x for s in shapes], dtype=float)
    y = np.array([s.y for s in shapes], dtype=float)
    visible = np.array([1.0 if s.visible is None else s.visible for s in shapes], dtype=float)
    if log is None:
        return x, y, visible
    fan = log.fan
    drawn_on_fan = sizes <= {(fan.columns, fan.rows)}
    if log.sonar.layout == "polar" and not (sizes and drawn_on_fan):
        range_m, bearing_deg = _polar_pixels(source, sizes, log, x, y)
        x, y = pixel_from_polar(fan, range_m, bearing_deg)
    elif drawn_on_fan:
        if log.sonar.layout != "polar" and log.sonar.flip:
            x = fan.columns - 1 - x
        range_m, bearing_deg = polar_from_pixel(fan, x, y)
    else:
        raise _wrong_size(source, sizes, f"{fan.columns} x {fan.rows}")
    return x, y, np.minimum(visible, share_in_image(fan, range_m, bearing_deg, radius_m))


def _polar_pixels(
    source: Path, sizes: Sizes, log: LogImages, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(range in m, bearing in deg) of pixels of the log's own polar images."""
    sonar, drawn = log.sonar, sizes
    if not sizes:
        raise SonarrecError(
            f"{source}: the log is polar, and these annotations do not tell the size of the "
            "images they were drawn on; export them in another format"
        )
    if sonar.beam_order == "beam-major":
        x, y, sizes = y, x, {size[::-1] for size in sizes}
    bins = round(log.fan.window_m / log.fan.metres_per_pixel)
    beams = min(sizes)[0] if sonar.bearings_deg is None else len(sonar.bearings_deg)
    if sonar.range_order == "far_first":
        y = bins - 1 - y
    if sizes != {(beams, bins)}:
        raise _wrong_size(source, drawn, f"{beams} beams x {bins} ranges")
    geometry = sonar.complete(str(source))
    bearing_deg = _between_samples(x, beam_bearings(geometry, beams))
    range_m = _between_samples(y, bin_ranges(geometry, bins))
    return range_m, -bearing_deg if sonar.flip else bearing_deg


def _between_samples(index: FloatArray, values: FloatArray) -> FloatArray:
    """(N,) values at (N,) indices between samples, and beyond them, where a disc that the image's
    edge cuts may have its centre."""
    last = len(values) - 1
    steps = np.diff(values) if last else np.zeros(1)
    beyond = np.minimum(index, 0) * steps[0] + np.maximum(index - last, 0) * steps[-1]
    return np.asarray(np.interp(index, np.arange(last + 1), values) + beyond)


def _wrong_size(source: Path, sizes: Sizes, size: str) -> SonarrecError:
    drawn = ", ".join(f"{columns} x {rows}" for columns, rows in sorted(sizes)[:_FEW])
    return SonarrecError(
        f"{source}: drawn on images of {drawn} pixels, but those of the log have {size}; "
        "annotate the log's own images"
    )


def _some(names: Mapping[str, int]) -> str:
    """The first few of the names."""
    more = ", ..." if len(names) > _FEW else ""
    return ", ".join(list(names)[:_FEW]) + more
