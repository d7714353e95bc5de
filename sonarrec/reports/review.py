"""`sonarrec truth review`: a page on which a person checks and corrects ground truth, pass by pass.

What is decided here: the passes, their order, and which frames are in the page. The page's script
keeps what a person decides, and writes gt.csv.
"""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from math import dist
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from sonarrec import __version__
from sonarrec.arrays import ByteImage, FloatArray
from sonarrec.drawing.pen import disc_outline, landmark_colours
from sonarrec.drawing.results import outline_of
from sonarrec.errors import (
    Diagnostics,
    MissingError,
    SonarrecError,
    UsageError,
    number_of,
    printable,
)
from sonarrec.mapping.path import MOVED, measured_path, read_frames
from sonarrec.overlays.overlay import find_both
from sonarrec.passes import ended
from sonarrec.readers import open_log
from sonarrec.readers.log import Log
from sonarrec.readers.open import Source, own_file
from sonarrec.reports.frames import as_jpeg
from sonarrec.reports.glyphs import glyph
from sonarrec.reports.template import fill
from sonarrec.results.columns import leading
from sonarrec.results.folders import possible_names
from sonarrec.results.read import (
    LogResults,
    check_same_log,
    of_methods,
    read_estimates,
    read_log,
    why_incomplete,
)
from sonarrec.results.run_file import LogOptions
from sonarrec.runs.recorded import outdated
from sonarrec.sonar.frame import Frame
from sonarrec.sonar.geometry import floor_depth, ground_range, plane_from_polar, polar_from_pixel
from sonarrec.tables.outputs import check_output, write_page
from sonarrec.tables.read import read_table
from sonarrec.truth.check import misfit
from sonarrec.truth.match import match_truth
from sonarrec.truth.propose import HEADER, LEAST_DECLARED, Occupied, proposals
from sonarrec.truth.table import FILLED_IN, TRACKED, TRUTH_FILE, read_cells, read_truth

MOST_BYTES = 24_900_000  # of a page
ROW_BYTES, POSE_BYTES = 250, 80  # at most, of a row, and of a frame without its image
QUALITIES = (85, 70, 55, 40)  # of JPEG
PICTURE_PX = 64  # of a pass
SHOWN = 1.3  # radii from the middle of such a picture to its edge
MOST_ADDED = 12  # frames in one
IMAGES = '"images":{"":""'  # where they go in the page, so that they are held once
_REPLACED = {"timestamp_ns": "frame", "range_m": "x_px", "bearing_deg": "y_px"}
"""Columns of a truth in place of which others are saved, since two could contradict each other."""


class _Row(NamedTuple):
    """A row of gt.csv: frame, pixel, share in view, and its cells under the page's header."""

    frame: int
    x: float
    y: float
    visible: float
    cells: list[str]


class Summary(NamedTuple):
    """What the start page of several logs says of a page; key: under which the browser keeps the
    decisions. gt_name: what the page saves."""

    name: str
    page: str
    key: str
    gt_name: str
    frames: int
    passes: int
    open: int
    lowest: float | None


@dataclass(slots=True)
class _Pass:
    """A landmark on its way through the view; the page's script has these fields, too.

    id: the same on every page of these tracks or this truth. landmark: None for an object that is
    none. state: open, accepted or rejected. left_out: whether it is saved only once accepted. why:
    what speaks against it. belief, orientations, corners, read: see `_find_beliefs`. wrong: frames
    in which results and truth disagree; first_wrong: the first of the longest such run. picture:
    mean of frames, each rotated so that the first sector begins at the right.
    """

    id: str
    landmark: int | None
    origin: str
    rows: list[_Row]
    state: str = "open"
    left_out: bool = False
    why: str = ""
    belief: float = 0.0
    wrong: int = 0
    first_wrong: int = -1
    picture: str = ""
    read: list[float] = field(default_factory=list)
    orientations: dict[int, float] = field(default_factory=dict)
    corners: dict[int, list[list[float]]] = field(default_factory=dict)


@dataclass(slots=True)
class _Table:
    """What of gt.csv is not in passes. log: the log's name in it. kept: rows that stay as they are:
    their frame, None on another log, and their cells."""

    header: list[str]
    log: str = ""
    kept: list[tuple[int | None, list[str]]] = field(default_factory=list)


def review(
    log: str | Path,
    out: Path,
    *,
    truth: Path | None = None,
    results: Path | None = None,
    every: int = 1,
    spans: Sequence[tuple[int, int | None]] = (),
    mistakes: bool = False,
    method: str | None = None,
    start: str = "",
    following: str = "",
) -> tuple[str, Summary, Diagnostics]:
    """Write the page of one log; (a line on what is in it, a summary, faults and notes).

    log, results: as `find_both` takes them. truth: default: the log's own gt.csv, if there is one.
    every, spans: frames in the page; all rows are in it anyway.
    mistakes: begin with the passes on which results and truth disagree. method: that of the tracks;
    None: the leading one. start, following: of several logs the start page, and the next page.
    Raises SonarrecError if something cannot be used, UsageError for an invalid option.
    """
    (source, folder), diagnostics = find_both(Path(log), results), Diagnostics()
    output = read_log(folder)
    if output.fan is None:
        raise SonarrecError(
            f"{folder}: its run.toml does not state the sonar's geometry; run again"
        )
    method = method or leading(output.methods)
    output = of_methods(output, [method])
    truth = truth or source.companion(TRUTH_FILE)
    check_output(out, "review", [truth, source.path])
    diagnostics.problem(*why_incomplete(output, "shown"))
    diagnostics.note(*outdated([folder]))
    stretch = dict(zip(output.frame.tolist(), output.stretch.tolist(), strict=True))
    table, passes, occupied = _Table([*HEADER]), list[_Pass](), Occupied(list)
    if truth is not None:
        table, passes = _of_truth(truth, source, output, stretch, occupied, diagnostics)
    passes += _of_tracks(folder, output, method, stretch, occupied, table, truth is not None)
    _find_beliefs(passes, folder, output, method)
    if mistakes:
        _mark_mistakes(passes, output, method, [folder, folder.parent], truth)
    passes.sort(key=lambda p: (-p.wrong, p.state != "open", p.belief, p.rows[0].frame))
    options = output.run.complete(LogOptions(), same_log=source.reader.has_topics).arguments()
    with open_log(source, **options) as recording:
        check_same_log(recording, folder, output.run)
        frames = _Frames(recording, output, spans, every, passes)
        diagnostics.problem(*recording.diagnostics.problems)
    gt_name = own_file(source.location, TRUTH_FILE).name
    unsure = [seen for seen in passes if seen.state == "open"]
    lowest = min((seen.belief for seen in unsure), default=None)
    counts = len(frames.numbers), len(passes), len(unsure), lowest
    summary = Summary(output.name, out.name, _key(output, folder, truth), gt_name, *counts)
    page = _page(output, summary, (start, following), truth, frames, table, passes, folder)
    head, tail = page.split(IMAGES)
    parts = [head, '"images":{']
    for k, (n, image) in enumerate(frames.images.items()):
        parts += ["," if k else "", f'"{n}":"', image, '"']
    write_page(out, *parts, tail)
    size, held = out.stat().st_size / 1e6, f"{len(frames.images)} of {len(frames.numbers)} frames"
    opened = f"{number_of(len(passes), 'pass', 'es')}, {len(unsure)} open"
    return f"{out}: {size:.1f} MB, {held}, {opened}; open it in a browser", summary, diagnostics


# The passes


def _of_truth(
    path: Path,
    source: Source,
    results: LogResults,
    stretch: Mapping[int, int],
    occupied: Occupied,
    diagnostics: Diagnostics,
) -> tuple[_Table, list[_Pass]]:
    """The passes of a truth, and what else is in it. Raises SonarrecError if it has no positions,
    or cannot be the truth of this log."""
    truth = read_truth(path)
    name = truth.name_of(possible_names(results.name, source.location.resolve()))
    named = replace(results, name=name)
    matched = match_truth(truth, named)
    assert results.fan is not None  # else nothing could be proposed
    pixels = matched.pixels(results.fan)
    if pixels is None:
        raise SonarrecError(f"{path}: no positions (x_px,y_px or range_m,bearing_deg) to show")
    if (wrong := misfit(truth, named, matched)) is not None:
        raise SonarrecError(wrong)
    strangers = match_truth(truth, named, strangers=True)
    others = strangers.pixels(results.fan)
    assert others is not None
    columns, cells = read_cells(path)
    replaced = [c for c in _REPLACED if c in columns]
    header = list(dict.fromkeys(_REPLACED.get(c, c) for c in columns))
    table = _Table(header + [c for c in ("visible", "track", "source") if c not in header])
    table.log = "" if truth.log is None else name
    if replaced:
        names = ", ".join(replaced)
        diagnostics.note(f"{path}: the page saves frame, x_px and y_px in place of {names}")

    def cells_of(row: int, **values: str) -> list[str]:
        return [
            (dict(zip(columns, cells[row], strict=False)) | values).get(c, "") for c in table.header
        ]

    kept = {*range(len(truth.keys))}
    orientations: FloatArray = np.full(len(pixels), np.nan)
    if matched.orientation is not None:
        orientations = matched.orientation
    rows = defaultdict[tuple[int | None, str], list[_Row]](list)
    oriented = dict[tuple[int | None, int], float]()
    sides = ((matched, pixels, results.landmarks.ids), (strangers, others, ()))
    for match, positions, ids in sides:
        slant_m, bearing_deg = polar_from_pixel(results.fan, *positions.T)
        floor = plane_from_polar(ground_range(results.fan, slant_m), bearing_deg)
        for n in np.argsort(match.frame_index, kind="stable").tolist():
            x, y = positions[n].tolist()
            if not np.isfinite(x + y):
                continue  # it says that the frame was looked at
            frame = int(results.frame[match.frame_index[n]])
            landmark = ids[match.landmark_index[n]] if ids else None
            pixel = {"x_px": f"{x:.3f}", "y_px": f"{y:.3f}"} if "range_m" in columns else {}
            came = cells_of(int(match.row[n]), frame=str(frame), **pixel)
            track = came[table.header.index("track")]
            rows[landmark, track].append(_Row(frame, x, y, float(match.visible[n]), came))
            if ids and np.isfinite(orientations[n]):
                oriented[landmark, frame] = float(orientations[n])
            # What is no landmark is none of any ID.
            for k in (landmark,) if landmark is not None else results.landmarks.ids:
                occupied[frame, k].append(floor[n].tolist())
            kept.discard(int(match.row[n]))
    passes, column = [], table.header.index("source")
    for (landmark, track), of_landmark in rows.items():
        for part in _split(of_landmark, stretch, is_one=bool(track)):
            proposed = {row.cells[column] for row in part} & {TRACKED, FILLED_IN}
            made = f"g{landmark}.{part[0].frame}.{part[0].x:.0f}"
            state = "open" if proposed else "accepted" if landmark is not None else "rejected"
            seen = _Pass(made, landmark, "truth", part, state)
            seen.orientations = {
                f: oriented[landmark, f] for f, *_ in part if (landmark, f) in oriented
            }
            passes.append(seen)
    saves_all = truth.key == "frame" and ("x_px" in columns or "range_m" not in columns)
    rest = sorted(kept)
    for n in rest if saves_all else ():
        is_mine = truth.log is None or truth.log[n] == name
        table.kept.append((int(truth.keys[n]) if is_mine else None, cells_of(n)))
    if rest and not saves_all:
        diagnostics.note(
            f"{path}: {number_of(len(rest), 'row')} on other logs, or on no frame, have no frame "
            "or pixel; the page does not save them"
        )
    return table, passes


def _of_tracks(
    folder: Path,
    results: LogResults,
    method: str,
    stretch: Mapping[int, int],
    occupied: Occupied,
    table: _Table,
    has_truth: bool,
) -> Iterator[_Pass]:
    """The passes of all tracks that declared an ID; with a truth those that it does not have."""
    for track, rows in proposals(folder, results, method, occupied=occupied):
        made = []
        for row in rows:
            named = dict(zip(HEADER, map(str, row), strict=True)) | {"log": table.log}
            x, y, visible = (float(named[c]) for c in ("x_px", "y_px", "visible"))
            cells = [named.get(c, "") for c in table.header]
            made.append(_Row(int(named["frame"]), x, y, visible, cells))
        why = [track.left_out, "not in the truth" if has_truth else ""]
        for part in _split(made, stretch):
            # Where the truth begins or ends a little later or sooner there is nothing to decide.
            if not has_truth or len(part) >= LEAST_DECLARED:
                first, origin = f"t{track.track}.{part[0].frame}", f"track {track.track}"
                seen = _Pass(first, track.landmark, origin, part, left_out=any(why))
                seen.why = "; ".join(filter(None, why))
                yield seen


def _split(
    rows: Iterable[_Row], stretch: Mapping[int, int], *, is_one: bool = False
) -> list[list[_Row]]:
    """Rows of one landmark, rising in frame, as passes: each row goes on with the nearest pass that
    has not ended, in its stretch. stretch: the number of each frame's. is_one: the rows have one
    number of a track, so that only their stretch ends a pass."""
    passes: list[list[_Row]] = []
    going: list[list[_Row]] = []
    for row in rows:
        going = [
            p
            for p in going
            if stretch[p[-1].frame] == stretch[row.frame]
            and (is_one or not ended(p[-1].frame, row.frame))
        ]
        free = [p for p in going if p[-1].frame < row.frame]
        if free:
            min(free, key=lambda p: dist((p[-1].x, p[-1].y), (row.x, row.y))).append(row)
        else:
            passes.append([row])
            going.append(passes[-1])
    return passes


def _find_beliefs(passes: Iterable[_Pass], folder: Path, results: LogResults, method: str) -> None:
    """Find each pass's least belief, the lowest probability of its ID where the method declares an
    ID on it (0 if it never does), its corners, its orientation by frame, in deg, and the symbol
    that was read: the mean probability, 0 to 9, that each of 36 directions is lit, from the first
    sector's begin on."""
    fan, landmarks = results.fan, results.landmarks
    assert fan is not None
    on_frame = defaultdict[int, list[tuple[_Pass, _Row]]](list)
    read = dict[str, FloatArray]()
    reach_px = landmarks.radius_m / fan.metres_per_pixel
    for seen in passes:
        seen.belief = 1.0
        for row in seen.rows:
            on_frame[row.frame].append((seen, row))
    declared = set[str]()
    for frame, estimates in read_estimates(folder / "estimates.csv", method, landmarks, fan):
        for seen, row in on_frame.get(frame, ()):
            for e in estimates:
                if dist((e.x_px, e.y_px), (row.x, row.y)) >= reach_px:
                    continue
                if e.declared and seen.landmark is not None:
                    k = landmarks.ids.index(seen.landmark)
                    seen.belief = min(seen.belief, round(float(e.probabilities[k]), 3))
                    declared.add(seen.id)
                if e.corners is not None:
                    seen.corners[frame] = outline_of(e, fan, landmarks).round(1).tolist()
                if np.isfinite(e.orientation_deg):
                    orientation = seen.orientations.setdefault(frame, round(e.orientation_deg, 1))
                    if e.read:
                        lit = np.frombuffer(e.read.encode(), np.uint8) - ord("0")
                        begin = round((90 - e.bearing_deg - orientation) / 360 * len(lit))
                        sums = read.setdefault(seen.id, np.zeros(1 + len(lit)))
                        sums += [1, *np.roll(lit, begin)]
    for seen in passes:
        seen.belief *= seen.id in declared
        if seen.id in read:
            seen.read = (read[seen.id][1:] / read[seen.id][0]).round(1).tolist()


def _mark_mistakes(
    passes: Sequence[_Pass],
    output: LogResults,
    method: str,
    results: Iterable[Path],
    truth: Path | None,
) -> None:
    """State in how many frames of each pass the method and the truth disagree, as mistakes.csv of
    `sonarrec evaluate` has it. results: where it may have been written; the latest counts. Raises
    MissingError if there is none."""
    candidates = [folder / "evaluation" / "mistakes.csv" for folder in results]
    tables = sorted(filter(Path.is_file, candidates), key=lambda path: path.stat().st_mtime)
    if not tables:
        given = f"--ground-truth {truth} " if truth else ""
        write = f"`sonarrec evaluate {given}{candidates[0].parents[1]}` writes it"
        raise MissingError(f"{candidates[0]}: no such file; {write}")
    kinds: Any = dict.fromkeys(("log", "method", "kind"), "text") | {
        **dict.fromkeys(("first_frame", "last_frame", "frames", "landmark"), "whole"),
        "other": "blank or number",
    }
    header = tuple(kinds)
    table = read_table(tables[-1], kinds | {"at_start": "flag"}, header, ",".join(header))
    at_start = table.get("at_start", np.zeros(len(table["log"]), bool))
    for n in range(len(table["log"])):
        series = str(table["log"][n]), str(table["method"][n])
        if series != (output.name, method) or at_start[n]:  # no track declares where it begins
            continue
        first, last, frames, landmark = (int(table[c][n]) for c in kinds if kinds[c] == "whole")
        ids = {landmark, int(np.nan_to_num(table["other"][n], nan=landmark))}
        why = f"{table['kind'][n]} ID.{landmark} in frames {first}-{last}"
        for current in passes:
            if current.landmark in ids and any(first <= row.frame <= last for row in current.rows):
                current.first_wrong = first if current.wrong == 0 else current.first_wrong
                current.wrong += frames
                current.state = "open"
                current.why = "; ".join(filter(None, (current.why, why)))


# The frames


class _Frames:
    """The frames of a page, at full resolution, as many as MOST_BYTES allow.

    numbers: of all frames of the run's span. images: those held, as JPEG in a data URI, by number.
    damaged: numbers of frames that cannot be read.
    """

    def __init__(
        self,
        log: Log,
        results: LogResults,
        spans: Sequence[tuple[int, int | None]],
        every: int,
        passes: Sequence[_Pass],
    ) -> None:
        """Read the log, in one pass. Raises UsageError if no frame is chosen."""
        wanted = {
            n for n in results.frame.tolist() if n % every == 0 and (not spans or _in(n, spans))
        }
        if not wanted:
            raise UsageError(f"{log.path}: none of its frames is chosen; see --frames and --every")
        self.images: dict[int, str] = {}
        held = 0
        rows = sum(len(current.rows) for current in passes)
        room = max(0, MOST_BYTES - ROW_BYTES * rows - POSE_BYTES * len(results.frame))
        seen, step, span = set[int](), 1, results.run.span() or (0, None)
        rank = {n: k for k, n in enumerate(sorted(wanted))}
        passed_over = {-1}  # not empty, since it is filled once the first frame is there
        to_add = defaultdict[int, list[tuple[_Pass, _Row]]](list)
        sums = {current.id: np.zeros((PICTURE_PX, PICTURE_PX), np.float32) for current in passes}
        for current in passes:
            shown = [row for row in current.rows if row.frame in current.orientations]
            best = max(current.rows, key=lambda row: row.visible)
            for row in shown[:: -(-len(shown) // MOST_ADDED)] if shown else [best]:
                to_add[row.frame].append((current, row))
        for frame in log.within(span, passed_over):
            seen.add(frame.index)
            for current, row in to_add.get(frame.index, ()):
                orientation = current.orientations.get(row.frame, 0)
                sums[current.id] += _upright(frame, row, orientation, results.landmarks.radius_m)
            if frame.index not in wanted:
                continue
            if not self.images:
                # The first frame decides the quality, the best with which all fit in, and the step.
                sizes = {q: len(wanted) * len(as_jpeg(frame.image, q)) for q in QUALITIES}
                quality = next((q for q in QUALITIES if sizes[q] <= room), QUALITIES[-1])
                while sizes[quality] / step > 1.1 * max(room, 1) and step < len(wanted):
                    step *= 2
                kept = {n for n in wanted if rank[n] % step == 0}
                passed_over |= {*results.frame.tolist()} - kept - {*to_add}
            if rank[frame.index] % step == 0:
                self.images[frame.index] = as_jpeg(frame.image, quality)
                held += len(self.images[frame.index])
            while held > room and len(self.images) > 1:
                step *= 2
                self.images = {n: uri for n, uri in self.images.items() if rank[n] % step == 0}
                held = sum(map(len, self.images.values()))
        for current in passes:
            low, high = np.percentile(sums[current.id], (1, 99))
            levels = np.clip(255 * (sums[current.id] - low) / max(high - low, 1), 0, 255)
            current.picture = as_jpeg(levels.astype(np.uint8), QUALITIES[0])
        seen |= {*results.frame.tolist()}  # the run could read those that were passed over
        last = log.frame_count or max(seen) + 1
        self.numbers = range(span[0], min(last, span[1] or last))
        self.damaged = sorted({*self.numbers} - {*seen})


def _in(number: int, spans: Sequence[tuple[int, int | None]]) -> bool:
    return any(first <= number and (end is None or number < end) for first, end in spans)


def _upright(frame: Frame, row: _Row, orientation_deg: float, radius_m: float) -> ByteImage:
    """The floor about a row, seen from above, its orientation taken back to 0."""
    middle = (PICTURE_PX - 1) / 2
    axes = disc_outline(
        frame.fan,
        SHOWN * radius_m,
        row.x,
        row.y,
        np.radians([orientation_deg, orientation_deg + 90]),
    )
    source = np.array([(row.x, row.y), *axes], np.float32)
    edge = (middle, middle), (PICTURE_PX - 0.5, middle), (middle, -0.5)
    affine = cv2.getAffineTransform(np.array(edge, np.float32), source)
    size, flags = (PICTURE_PX, PICTURE_PX), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(frame.image, affine, size, flags=flags), np.uint8)


# The page


def _key(results: LogResults, folder: Path, truth: Path | None) -> str:
    """What the browser keeps the decisions on a log and a truth under."""
    of_log = results.run.input.sha256 or str(folder.resolve())
    of_truth = "" if truth is None else hashlib.sha256(truth.read_bytes()).hexdigest()
    return hashlib.sha256(f"{of_log} {of_truth}".encode()).hexdigest()


def _poses(folder: Path) -> dict[int, list[float]]:
    """By frame: cosine and sine of the yaw, x and y in m, and the number of the stretch, which ends
    where the motion is not known. Empty without motion."""
    table = read_frames(folder)
    if any(name not in table for name in MOVED):
        return {}
    frame, moved = table["frame"], np.column_stack([table[name] for name in MOVED])
    unknown = ~np.isfinite(moved).all(axis=1)
    moved[unknown] = 0
    yaw, x, y = measured_path(frame, frame, table["stretch"], moved, np.zeros_like(moved)).pose.T
    columns = [np.cos(np.radians(yaw)), np.sin(np.radians(yaw)), x, y, np.cumsum(unknown)]
    return dict(zip(frame.tolist(), np.column_stack(columns).round(6).tolist(), strict=True))


def _page(
    results: LogResults,
    summary: Summary,
    links: tuple[str, str],
    truth: Path | None,
    frames: _Frames,
    table: _Table,
    passes: Sequence[_Pass],
    folder: Path,
) -> str:
    """The whole page as HTML, with IMAGES where these go. links: to the start page and to the next
    log, or empty."""
    fan, landmarks = results.fan, results.landmarks
    assert fan is not None
    names = [each.name for each in fields(_Pass)]
    made = [
        {name: getattr(p, name) for name in names} | {"rows": [row._asdict() for row in p.rows]}
        for p in passes
    ]
    data = {
        "key": summary.key,
        "page": hashlib.sha256(json.dumps([table.header, made]).encode()).hexdigest(),
        "gt_name": summary.gt_name,
        "next": links[1],
        "fan": asdict(fan) | {"depth_m": floor_depth(fan)},
        "ids": landmarks.ids,
        "glyphs": [glyph(landmarks, k) for k in range(len(landmarks.ids))],
        "radius_m": landmarks.radius_m,
        "first": frames.numbers.start,
        "frames": len(frames.numbers),
        "damaged": frames.damaged,
        "images": {"": ""},
        "poses": _poses(folder),
        "passes": made,
        **asdict(table),
    }
    usable = len(frames.numbers) - len(frames.damaged)
    return fill(
        "review.html",
        ("viewer.js", "review.js"),
        data,
        version=__version__,
        name=results.name,
        gt_name=printable(summary.gt_name),
        links=links,
        truth=None if truth is None else printable(truth.name),
        ids=landmarks.ids,
        glyphs=data["glyphs"],
        colours=[
            "#{:02x}{:02x}{:02x}".format(*c) for c in landmark_colours(landmarks.ids).values()
        ],
        held=len(frames.images),
        usable=usable,
        damaged=len(frames.damaged),
    )
