"""`sonarrec truth review`: a page on which a person checks and corrects ground truth, pass by pass.

What is decided here: the passes, their order, and which frames are in the page. The page's script
keeps what a person decides, and writes gt.csv.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import dist
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.drawing.pen import landmark_colours
from sonarrec.drawing.results import outline_of
from sonarrec.errors import Diagnostics, MissingError, SonarrecError, UsageError, number_of
from sonarrec.geometry import floor_depth, ground_range, plane_from_polar, polar_from_pixel
from sonarrec.landmarks import DrawnSet
from sonarrec.mapping.path import MOVED, measured_path, read_frames
from sonarrec.overlays.overlay import results_folder
from sonarrec.readers import open_log
from sonarrec.readers.log import Log
from sonarrec.readers.open import Source, find_log
from sonarrec.records import VERSION
from sonarrec.reports.template import fill
from sonarrec.results.columns import leading
from sonarrec.results.folders import possible_names
from sonarrec.results.read import LogResults, check_same_log, not_whole, read_estimates, read_log
from sonarrec.results.run_file import LogOptions
from sonarrec.results.sightings import PASS_GAP
from sonarrec.tables.outputs import check_output, write_page
from sonarrec.tables.read import read_table
from sonarrec.truth.check import misfit
from sonarrec.truth.match import match_truth
from sonarrec.truth.propose import HEADER, LEAST_DECLARED, Taken, proposals
from sonarrec.truth.table import FILLED_IN, TRACKED, TRUTH_FILE, read_cells, read_truth

MOST_BYTES = 24_000_000  # of the frames of a page, as text; the page has at most 25 MB
QUALITIES = (85, 70, 55, 40)  # of JPEG, which is coded a hundred times as fast as WebP
_NOT_SAVED = {"timestamp_ns": "frame", "range_m": "x_px", "bearing_deg": "y_px"}
"""Columns of a truth in place of which others are saved: two statements could contradict."""


@dataclass(frozen=True, slots=True)
class Review:
    """A page that was written. shown: its frames, of so many `frames`. passes, open: their
    number."""

    path: Path
    shown: int
    frames: int
    passes: int
    open: int
    diagnostics: Diagnostics


@dataclass(frozen=True, slots=True)
class _Row:
    """A row of gt.csv: the frame, the pixel, the share in view, and its cells under the page's
    header, as they came."""

    frame: int
    x: float
    y: float
    visible: float
    cells: list[str]


@dataclass(slots=True)
class _Pass:
    """A landmark on its way through the view. id: the same on every page of these tracks or this
    truth. state: open or accepted. left_out: whether open rows are not saved. why: what speaks
    against it. belief: see `_Beliefs`. wrong: frames in which results and truth disagree."""

    id: str
    landmark: int
    origin: str
    rows: list[_Row]
    state: str = "open"
    left_out: bool = False
    why: str = ""
    belief: float = 0.0
    wrong: int = 0
    corners: dict[int, list[list[float]]] = field(default_factory=dict)


def review(
    log: str | Path,
    out: Path,
    *,
    truth: Path | None = None,
    results: Path = Path("sonarrec_out"),
    every: int = 1,
    spans: Sequence[tuple[int, int | None]] = (),
    mistakes: bool = False,
    up_to: Path | None = None,
) -> Review:
    """Write the page of one log.

    truth: default: that beside the log, if there is one. results: the folder of this log's
    results, or one that holds it. every, spans: frames in the page; all rows are in it anyway.
    mistakes: begin with the passes on which results and truth disagree. up_to: as of find_log.
    Raises SonarrecError if something cannot be used, UsageError for an invalid option.
    """
    source, told = find_log(log, up_to), Diagnostics()
    folder = results_folder(source.path, source, results)
    found = read_log(folder)
    truth = truth or source.beside(TRUTH_FILE)
    check_output(out, "review", [truth, source.path])
    told.problem(*not_whole(found, "shown"))
    options = found.run.complete(LogOptions(), same_log=source.reader.has_topics).arguments()
    with open_log(source, **(options | {"up_to": up_to})) as recording:
        check_same_log(recording, folder, found.run)
        album = _Album(found, spans, every)
        album.fill(recording)
        told.problem(*recording.diagnostics.problems)
    header, passes, kept = list(HEADER), list[_Pass](), list[tuple[int | None, list[str]]]()
    taken: Taken = defaultdict(list)
    log_cell = ""
    if truth is not None:
        header, log_cell, passes, kept = _of_truth(truth, source, found, taken, told)
    passes += _of_tracks(folder, found, taken, header, log_cell, truth is not None)
    _Beliefs(folder, found).fill(passes)
    if mistakes:
        _mark_mistakes(passes, found, folder, results, truth)
    passes.sort(key=lambda p: (-p.wrong, p.state != "open", p.belief, p.rows[0].frame))
    page = _page(found, folder, truth, album, header, log_cell, passes, kept)
    write_page(out, page)
    opened = sum(p.state == "open" for p in passes)
    return Review(out, len(album.images), len(album.numbers), len(passes), opened, told)


# The passes


def _of_truth(
    path: Path, source: Source, found: LogResults, taken: Taken, told: Diagnostics
) -> tuple[list[str], str, list[_Pass], list[tuple[int | None, list[str]]]]:
    """(header of what is saved, the log's cell, the passes of a truth, rows that stay as they are:
    frame, None on another log, and cells)."""
    table = read_truth(path)
    name = table.name_of(possible_names(found.name, source.place.resolve()))
    named = replace(found, name=name)
    matched = match_truth(table, named)
    pixels = None if found.fan is None else matched.pixels(found.fan)
    if pixels is None:
        raise SonarrecError(f"{path}: no positions (x_px,y_px or range_m,bearing_deg) to show")
    if (wrong := misfit(table, named, matched)) is not None:
        raise SonarrecError(wrong)
    columns, cells = read_cells(path)
    dropped = [c for c in _NOT_SAVED if c in columns]
    header = [c for c in columns if c not in dropped or _NOT_SAVED[c] not in columns]
    header = [_NOT_SAVED.get(c, c) for c in header]
    header += [c for c in ("visible", "source") if c not in header]
    if dropped:
        told.note(f"{path}: the page saves frame, x_px and y_px in place of {', '.join(dropped)}")

    def saved(row: int, frame: int | None, where: Sequence[float] = ()) -> list[str]:
        of = dict(zip(columns, cells[row], strict=False))
        if frame is not None and table.key != "frame":
            of["frame"] = str(frame)
        if len(where) and "range_m" in columns:
            of["x_px"], of["y_px"] = (f"{v:.3f}" for v in where)
        return [of.get(c, "") for c in header]

    rows = defaultdict[int, list[_Row]](list)
    for n in np.argsort(matched.frame_index, kind="stable").tolist():
        frame, landmark = int(found.frame[matched.frame_index[n]]), matched.landmark_index[n]
        x, y = pixels[n].tolist()
        one = _Row(
            frame, x, y, float(matched.visible[n]), saved(int(matched.row[n]), frame, (x, y))
        )
        rows[found.landmarks.ids[landmark]].append(one)
        taken[frame, found.landmarks.ids[landmark]].append(_floor(found, one))
    passes = []
    for landmark, of_landmark in rows.items():
        for part in _split(of_landmark):
            source_of = {row.cells[header.index("source")] for row in part}
            state = "open" if source_of & {TRACKED, FILLED_IN} else "accepted"
            made = f"g{landmark}.{part[0].frame}.{part[0].x:.0f}"
            passes.append(_Pass(made, landmark, "truth", part, state))
    mine = set(np.flatnonzero(_is_mine(table, name)).tolist())
    rest = [n for n in range(len(table.at)) if n not in {*matched.row.tolist()}]
    kept, lost = [], 0
    for n in rest:
        has_frame = table.key == "frame"
        if dropped and (not has_frame or "x_px" not in columns):
            lost += 1
            continue
        kept.append((int(table.at[n]) if n in mine else None, saved(n, None)))
    if lost:
        told.note(
            f"{path}: {number_of(lost, 'row')} on other logs or on no frame of this one cannot be "
            "saved by frame and pixel; the page leaves them out"
        )
    return header, "" if table.log is None else name, passes, kept


def _is_mine(table: Any, name: str) -> Any:
    return np.ones(len(table.at), bool) if table.log is None else np.asarray(table.log == name)


def _of_tracks(
    folder: Path,
    found: LogResults,
    taken: Taken,
    header: Sequence[str],
    log_cell: str,
    has_truth: bool,
) -> Iterator[_Pass]:
    """The passes of all tracks that declared an ID; with a truth those that it does not have."""
    for track, rows in proposals(folder, found, taken=taken):
        made = []
        for row in rows:
            of = dict(zip(HEADER, map(str, row), strict=True)) | {"log": log_cell}
            x, y, visible = (float(of[c]) for c in ("x_px", "y_px", "visible"))
            made.append(_Row(int(of["frame"]), x, y, visible, [of.get(c, "") for c in header]))
        for part in _split(made):
            if has_truth and len(part) < LEAST_DECLARED:
                continue  # the truth begins or ends a little later or sooner
            why = [track.left_out] * bool(track.left_out) + ["not in the truth"] * has_truth
            first = f"t{track.track}.{part[0].frame}"
            yield _Pass(
                *(first, track.landmark, f"track {track.track}", part),
                left_out=bool(why),
                why="; ".join(why),
            )


def _split(rows: Iterable[_Row]) -> list[list[_Row]]:
    """Rows of one landmark, rising in frame, as passes: each row goes on with the nearest pass that
    ended at most PASS_GAP frames ago."""
    passes: list[list[_Row]] = []
    for row in rows:
        going = [p for p in passes if 0 < row.frame - p[-1].frame <= PASS_GAP + 1]
        if going:
            min(going, key=lambda p: dist((p[-1].x, p[-1].y), (row.x, row.y))).append(row)
        else:
            passes.append([row])
    return passes


def _floor(found: LogResults, row: _Row) -> list[float]:
    """A row's position on the floor, m."""
    assert found.fan is not None
    range_m, bearing_deg = polar_from_pixel(found.fan, np.array([row.x]), np.array([row.y]))
    floor: list[float] = plane_from_polar(ground_range(found.fan, range_m), bearing_deg)[0].tolist()
    return floor


class _Beliefs:
    """The least belief of the leading method in a pass: the lowest probability of its ID where an
    ID is declared on it; 0 where none is. And the corners of plates."""

    def __init__(self, folder: Path, found: LogResults) -> None:
        fan = found.fan
        assert fan is not None
        every = read_estimates(
            folder / "estimates.csv", leading(found.methods), found.landmarks, fan
        )
        self._found, self._by_frame = found, dict(every)

    def fill(self, passes: Iterable[_Pass]) -> None:
        fan, landmarks = self._found.fan, self._found.landmarks
        assert fan is not None
        for one in passes:
            k, beliefs = landmarks.ids.index(one.landmark), []
            for row in one.rows:
                near = [
                    e
                    for e in self._by_frame.get(row.frame, ())
                    if dist((e.x_px, e.y_px), (row.x, row.y)) * fan.metres_per_pixel
                    < landmarks.radius_m
                ]
                beliefs += [float(e.probabilities[k]) for e in near if e.declared]
                outlines = [outline_of(e, fan, landmarks) for e in near if e.corners is not None]
                if outlines and isinstance(landmarks, DrawnSet):
                    one.corners[row.frame] = outlines[0].round(1).tolist()
            one.belief = round(min(beliefs, default=0.0), 3)


def _mark_mistakes(
    passes: Sequence[_Pass], found: LogResults, folder: Path, results: Path, truth: Path | None
) -> None:
    """State in how many frames of each pass the leading method and the truth disagree, as
    mistakes.csv of `sonarrec evaluate` has it. Raises MissingError if there is none."""
    places = [place / "evaluation" / "mistakes.csv" for place in (folder, results, folder.parent)]
    tables = sorted(filter(Path.is_file, places), key=lambda path: path.stat().st_mtime)
    if not tables:
        given = f"--ground-truth {truth} " if truth else ""
        raise MissingError(
            f"{places[0]}: no such file; `sonarrec evaluate {given}{folder}` writes it"
        )
    kinds: Any = dict.fromkeys(("log", "method", "kind"), "text") | {
        **dict.fromkeys(("landmark", "first_frame", "last_frame", "frames"), "whole"),
        "other": "blank or number",
    }
    table = read_table(tables[-1], kinds, tuple(kinds), ",".join(kinds))
    for n in range(len(table["log"])):
        name, method, kind = (str(table[c][n]) for c in ("log", "method", "kind"))
        if (name, method) != (found.name, leading(found.methods)):
            continue
        first, last = int(table["first_frame"][n]), int(table["last_frame"][n])
        ids = {int(table["landmark"][n])} | {int(v) for v in [table["other"][n]] if v == v}
        for one in passes:
            if one.landmark in ids and any(first <= row.frame <= last for row in one.rows):
                one.wrong += int(table["frames"][n])
                one.state = "open"
                text = f"{kind} ID.{table['landmark'][n]} in frames {first}-{last}"
                one.why = "; ".join(filter(None, (one.why, text)))


# The frames


class _Album:
    """The frames of a page: at full resolution, in at most MOST_BYTES.

    numbers: of all frames of the run's span. images: those held, as JPEG in a data URI, by number.
    damaged: numbers of frames that cannot be read.
    """

    def __init__(
        self, found: LogResults, spans: Sequence[tuple[int, int | None]], every: int
    ) -> None:
        self._span = found.run.span() or (0, None)
        self._wanted = [
            n
            for n in found.frame.tolist()
            if n % every == 0
            and (not spans or any(a <= n and (b is None or n < b) for a, b in spans))
        ]
        if not self._wanted:
            raise UsageError(f"{found.name}: none of its {len(found.frame)} frames is chosen")
        self.numbers = range(0)
        self.images: dict[int, str] = {}
        self.damaged: list[int] = []

    def fill(self, log: Log) -> None:
        """Read the log, in one pass."""
        wanted, order, step, quality, held = {*self._wanted}, 0, 1, 0, 0
        seen: list[int] = []
        for frame in log.within(self._span):
            seen.append(frame.index)
            if frame.index not in wanted:
                continue
            if order % step == 0:
                image = _as_jpeg(frame.image, QUALITIES[quality])
                while not self.images and quality + 1 < len(QUALITIES):
                    if len(image) * len(wanted) <= MOST_BYTES:
                        break
                    quality += 1
                    image = _as_jpeg(frame.image, QUALITIES[quality])
                self.images[frame.index] = image
                held += len(image)
            order += 1
            while held > MOST_BYTES and len(self.images) > 1:  # then only every second is held
                step *= 2
                self.images = dict([*self.images.items()][::2])
                held = sum(map(len, self.images.values()))
        last = log.frame_count or seen[-1] + 1
        self.numbers = range(self._span[0], min(last, self._span[1] or last))
        self.damaged = sorted({*self.numbers} - {*seen})


def _as_jpeg(image: ByteImage, quality: int) -> str:
    coded, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert coded
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


# The page


def _poses(folder: Path) -> dict[int, list[float]]:
    """By frame: yaw in deg, x and y in m of the measured path, and the number of the stretch, which
    begins where the motion is not known. Empty without motion."""
    table = read_frames(folder)
    if any(name not in table for name in MOVED):
        return {}
    frame, moved = table["frame"], np.column_stack([table[name] for name in MOVED])
    unknown = ~np.isfinite(moved).all(axis=1)
    moved[unknown] = 0
    pose: FloatArray = measured_path(frame, frame, moved, np.zeros_like(moved)).pose
    rows = np.column_stack([pose.round(5), np.cumsum(unknown)])
    return dict(zip(frame.tolist(), rows.tolist(), strict=True))


def _page(
    found: LogResults,
    folder: Path,
    truth: Path | None,
    album: _Album,
    header: Sequence[str],
    log_cell: str,
    passes: Sequence[_Pass],
    kept: Sequence[tuple[int | None, list[str]]],
) -> str:
    """The whole page as HTML."""
    fan, landmarks = found.fan, found.landmarks
    assert fan is not None
    of_log = found.run.input.sha256 or str(folder.resolve())
    of_truth = "" if truth is None else hashlib.sha256(truth.read_bytes()).hexdigest()
    listed = [asdict(one) for one in passes]
    data: Mapping[str, Any] = {
        "name": found.name,
        "key": hashlib.sha256(f"{of_log} {of_truth}".encode()).hexdigest(),
        "page": hashlib.sha256(json.dumps([header, listed]).encode()).hexdigest(),
        "fan": asdict(fan) | {"depth_m": floor_depth(fan)},
        "ids": landmarks.ids,
        "radius_m": landmarks.radius_m,
        "first": album.numbers.start,
        "frames": len(album.numbers),
        "damaged": album.damaged,
        "images": album.images,
        "poses": _poses(folder),
        "header": header,
        "log": log_cell,
        "passes": listed,
        "kept": kept,
    }
    usable = len(album.numbers) - len(album.damaged)
    return fill(
        "review.html",
        ("viewer.js", "review.js"),
        data,
        version=VERSION,
        log=found.name,
        truth=None if truth is None else truth.name,
        ids=landmarks.ids,
        colours=[
            "#{:02x}{:02x}{:02x}".format(*c) for c in landmark_colours(landmarks.ids).values()
        ],
        missing=usable - len(album.images),
        usable=usable,
        damaged=album.damaged,
    )
