"""What may be wrong with a log and its geometry: at the end of `run`, and in `info`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sonarrec.advice.landmarks import of_ring
from sonarrec.arrays import FloatArray
from sonarrec.drawing.geometry import disc_width_px
from sonarrec.errors import Advice, command_line
from sonarrec.landmarks import DrawnSet, load_landmarks
from sonarrec.readers.log import MOST_HZ, Log
from sonarrec.recogniser.restore.saturation import BRIGHT
from sonarrec.results.run_file import rerun
from sonarrec.runs.prepare import PreparedRun
from sonarrec.sonar.frame import Fan, Frame
from sonarrec.sonar.geometry import fan_mask, floor_depth, pixel_from_polar
from sonarrec.sonar.stated import Sonar
from sonarrec.tables.outputs import free_name

_BACKGROUND = 6.0  # grey levels about the commonest one that hold no echo
# Share of pixels outside of the stated fan that hold echoes, measured on the sample logs and on
# recordings of others: .13 or more if the fan is wrong, at most .03 if it is right.
_OUTSIDE = 0.1
_FILLED = 0.6  # the same share, if the picture is no fan at all
_OTHER_SHAPE = 0.08  # of the logarithm of width over height; pictures end within a few pixels
_LEAST_MARGIN_PX = 4  # a darker edge of the fan may be black too
_CUT = 0.2  # share of the stated fan that lies outside of the picture
LEAST_WIDTH_PX = 12
"""Of the first 64 frames of sample_data/pan at 32, 16, 12, 10 and 8 px, landmarks are declared 80,
76, 48, 18 times and once."""
LEAST_GRAZING_DEG = 2.0  # below, a ripple of a centimetre has a shadow as long as a disc
HALF_BEAM_DEG = 15.0  # in elevation; sonars of this kind have 6 to 10
STEEP_TILT_DEG = 60.0  # of tilts that are assumed
SOUND_M_S = 1600.0  # in the warmest and saltiest water


def of_log(log: Log, first: Sequence[Frame]) -> Iterator[Advice]:
    """On the geometry of a log that was read. first: its first frames."""
    lines = [contradiction(first, log.sonar)]
    if log.fan is not None:
        lines += [*_unlikely(log.sonar, log.fan), *_in_radians(log.sonar, log.fan)]
    yield from (Advice(line) for line in lines if line)


def of_run(run: PreparedRun, *, has_sightings: bool) -> Iterator[Advice]:
    """On a log that was run; the lines do not name it. Notes only, for its results are done.

    has_sightings: whether any landmark was declared.
    """
    log, fan, landmarks = run.log, run.fan, run.landmarks
    # What explains the rest: then less is asked.
    small, width_px = [*_in_radians(log.sonar, fan)], disc_width_px(fan, landmarks)
    narrow = width_px < LEAST_WIDTH_PX and not isinstance(landmarks, DrawnSet)
    inverted = not has_sightings and _is_bright(run)
    lines = [*small, *of_ring(landmarks)]
    if not small and (doubt := contradiction(run.first, log.sonar)):
        lines.append(f"{doubt}; {_preview(run)} shows it")
    elif not (small or narrow or inverted) and (other := run.recogniser.sizes.other()):
        lines.append(
            f"rings of about {other:.2g} m radius fit clearly better than those of "
            f"{landmarks.name}, {landmarks.radius_m:g} m; check radius_m, the range window, "
            f"and whether a margin lies round the picture: {_preview(run)}"
        )
    if run.poses is not None and isinstance(landmarks, DrawnSet) and landmarks.pose == "free":
        lines.append(
            "the run does not use the poses, since plates may lie at any angle; if they lie on the "
            f'floor, state pose = "floor" in the landmarks {landmarks.name}'
        )
    where = f"a landmark of {landmarks.name} in mid-window is"
    middle_m = (fan.range_min_m + fan.range_max_m) / 2
    low_deg = math.degrees(math.asin(min(floor_depth(fan) / middle_m, 1.0)))
    if narrow:
        wide = f"{width_px:.0f} px wide, and needs {LEAST_WIDTH_PX}"
        lines.append(f"{where} {wide}; check range and scale: are all in metres?")
    elif low_deg < LEAST_GRAZING_DEG:
        lines.append(f"{where} seen {low_deg:.2g} deg above the floor; check range and height")
    lines += _unlikely(log.sonar, fan)
    static, saturated, cause = run.recogniser.restored
    if static:
        lines.append(
            f"{static:.1%} of the picture never changes, as text or a panel, and is filled from "
            "its neighbours"
        )
    if saturated and not inverted:
        lines.append(f"{saturated:.0%} of the frames {cause}")
    if log.untimed and len(run.first) > 1:
        lines.append("frames carry no time, so 1 Hz is assumed; give frame_rate_hz")
    if run.recogniser.tracking and not (has_sightings or narrow or small):
        lines += _nothing_declared(run, width_px, inverted)
    yield from map(Advice, lines)


def _nothing_declared(run: PreparedRun, width_px: float, inverted: bool) -> Iterator[str]:
    """What may be wrong if nothing is recognised, the likeliest first.

    width_px: of a landmark in mid-window. inverted: whether the pictures seem to be.
    """
    log, landmarks, reading = run.log, run.landmarks, run.log.reading()
    if len(run.first) == 1:
        features = run.job.run_options.configs[0].features
        why = "IDs of drawn plates are declared from the second frame on"
        if not isinstance(landmarks, DrawnSet):
            why = (
                f"in a single frame an ID needs a score of {features.declare_alone:g} "
                f"(features.declare_alone), in a log of more frames {features.declare:g} from its "
                "second frame on; `sonarrec overlay` shows what is likely"
            )
        yield f"no landmark declared: {why}"
        return
    suspects = list[str]()
    if inverted:
        how = "dark echoes on white; `mogrify -negate *.png` in a copy of them mends it"
        suspects.append(f"whether the pictures, which are bright, are inverted ({how})")
    if _narrows(run.first):
        again = _again(run, "--layout", "fan")
        suspects.append(f"layout (the corners are empty, as those of a fan are: {again})")
    if "topic" in reading:
        suspects.append(f"topic ({command_line('info', log.path)} has all)")
    if run.poses is not None:
        suspects.append(f"the poses {run.poses.name} (run once without them)")
    if not _only_this_way_up(run.first):
        again = _again(run, "--range-order", log.sonar.other_range_order)
        suspects.append(f"range order ({again})")
    suspects.append(f"geometry ({_preview(run)})")
    yield f"no landmark declared; check {', '.join(suspects)}"
    scale = "linear" if reading.get("pixel_scale") == "log" else "log"
    level = f"level ({_again(run, '--pixel-scale', scale)})"
    yield (
        f"then landmark set and size ({_landmarks(run)}; a landmark of {landmarks.name} is "
        f"{width_px:.0f} px wide here) and {level}"
    )


# What the pictures tell


def contradiction(first: Sequence[Frame], sonar: Sonar) -> str:
    """Whether there are echoes outside of the stated fan, or it exceeds the picture, with the keys
    to look at: clear cases only; else empty, as it is without fan images. sonar: the geometry as
    stated."""
    if not first or first[0].polar is not None:
        return ""
    fan, picture = first[0].fan, _mean(first)
    if not (sonar.apex_px or sonar.metres_per_pixel) and (margin := _margin(picture, fan)):
        return (
            f"a margin of {margin} lies round the pictures, which a fan is taken to fill; cut it "
            "off, or state apex_px and metres_per_pixel"
        )
    outside, share, upside_down = _echoes_outside(picture, fan)
    if share > _OUTSIDE and outside > _OUTSIDE / 10:
        text = f"{share:.0%} of the picture outside of the stated fan holds echoes"
        if upside_down < _OUTSIDE / 3:
            option = f"--range-order {sonar.other_range_order}"
            return f"{text}, but none once it is upside down: try {option}"
        exchanged = replace(fan, apex_column=fan.apex_row, apex_row=fan.apex_column)
        if sonar.apex_px is not None and _echoes_outside(picture, exchanged)[1] < _OUTSIDE / 3:
            return f"{text}, but none if apex_px is exchanged: it is column, then row"
        if shape := _other_shape(fan, sonar):
            return f"{text}; {shape}"
        if share > _FILLED:
            return f"{text} (is it polar, --layout polar?)"
        keys = "range_min_m, range_max_m, field_of_view_deg, apex_px and metres_per_pixel"
        return f"{text} (unless it is text or a panel, look at {keys})"
    cut = _share_cut(fan)
    if cut > _CUT:
        keys = "field_of_view_deg, metres_per_pixel and apex_px"
        shape = _other_shape(fan, sonar) or f"is it polar, --layout polar? else look at {keys}"
        return f"{cut:.0%} of the stated fan lies outside of the picture; {shape}"
    return ""


def _other_shape(fan: Fan, sonar: Sonar) -> str:
    """Whether the picture's shape is another than that of the stated fan, a clause; empty if it is
    not, or if the fan need not fill the picture, since apex_px or metres_per_pixel is stated."""
    stated, shape = _shape(fan), fan.columns / fan.rows
    if sonar.apex_px or sonar.metres_per_pixel or abs(math.log(shape / stated)) < _OTHER_SHAPE:
        return ""
    if abs(math.log(shape * stated)) < _OTHER_SHAPE:
        return f"its {fan.columns} x {fan.rows} pixels have the fan's shape if rows are columns"
    return (
        f"the fan is {stated:.2f} times as wide as high, the picture ({fan.columns} x {fan.rows}) "
        f"{shape:.2f} times: is it polar (--layout polar), cut or stretched, or are range_max_m, "
        "range_min_m or field_of_view_deg wrong?"
    )


def _mean(first: Sequence[Frame]) -> FloatArray:
    """(rows, columns) of the first frames."""
    return np.asarray(np.mean([frame.pixels for frame in first], axis=0))


def _margin(picture: FloatArray, fan: Fan) -> str:
    """How wide and bright an even margin of a fan image is; empty if there is none. A black one
    counts if what lies within has the shape of the stated fan."""
    edge = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
    lit = np.abs(picture - edge[0]) > 1
    if np.ptp(edge) > 0 or not lit.any():
        return ""
    rows, columns = (np.flatnonzero(lit.any(axis=axis)) for axis in (1, 0))
    high, wide = (int(lines[-1] - lines[0] + 1) for lines in (rows, columns))
    width_px = min(rows[0], fan.rows - 1 - rows[-1], columns[0], fan.columns - 1 - columns[-1])
    fits = abs(math.log(wide / high / _shape(fan))) < _OTHER_SHAPE
    if edge[0] <= _BACKGROUND and not (fits and width_px >= _LEAST_MARGIN_PX):
        return ""
    return f"{width_px} px or more of grey level {edge[0]:.0f}"


def _shape(fan: Fan) -> float:
    """How many times as wide as high a picture is that the fan just fills."""
    half = min(math.radians((fan.bearing_max_deg - fan.bearing_min_deg) / 2), math.pi / 2)
    high_m = fan.range_max_m - fan.range_min_m * math.cos(half)
    return 2 * fan.range_max_m * math.sin(half) / high_m


def _only_this_way_up(first: Sequence[Frame]) -> bool:
    """Whether the echoes fill the stated fan, and would not if they were upside down."""
    if first[0].polar is not None:
        return False
    _, share, upside_down = _echoes_outside(_mean(first), first[0].fan)
    return share < _OUTSIDE / 3 and upside_down > _OUTSIDE


def _echoes_outside(picture: FloatArray, fan: Fan) -> tuple[float, float, float]:
    """(share of a fan image outside of a fan; share of that which holds echoes; the same if the
    picture is upside down)."""
    outside = fan_mask(fan) == 0
    return float(np.mean(outside)), _echoes(picture[outside]), _echoes(picture[::-1][outside])


def _narrows(first: Sequence[Frame]) -> bool:
    """Whether pictures that are read as polar narrow towards one end, as those of a fan do: its
    corners are empty."""
    if first[0].polar is None:
        return False
    picture = _mean(first)
    high, wide = (side // 8 for side in picture.shape)
    for end in (picture[:high], picture[-high:]):
        corners = max(_echoes(end[:, :wide]), _echoes(end[:, -wide:]))
        if corners < _OUTSIDE / 3 and _echoes(end[:, 3 * wide : -3 * wide]) > _FILLED:
            return True
    return False


def _is_bright(run: PreparedRun) -> bool:
    """Whether the first pictures are brighter in their fan than those of a sonar."""
    levels = [
        frame.pixels[fan_mask(run.fan) > 0] if frame.polar is None else frame.pixels
        for frame in run.first
    ]
    return any(grey.size for grey in levels) and float(np.concatenate(levels).mean()) > BRIGHT


def _echoes(grey: FloatArray) -> float:
    """Share of pixels that differ from the commonest grey level: 0 for an even background."""
    if not grey.size:
        return 0.0
    background = np.bincount(np.rint(grey).astype(int).ravel(), minlength=256).argmax()
    return float(np.mean(np.abs(grey - background) > _BACKGROUND))


def _share_cut(fan: Fan) -> float:
    """Share of a fan that lies outside of its picture, by range and bearing."""
    range_m = np.linspace(fan.range_min_m, fan.range_max_m, 98)[1:-1, None]
    bearings = np.linspace(fan.bearing_min_deg, fan.bearing_max_deg, 66)[1:-1]
    column, row = pixel_from_polar(fan, range_m, bearings)
    return float(np.mean((column < -1) | (column > fan.columns) | (row < -1) | (row > fan.rows)))


# What the stated geometry tells


def _unlikely(sonar: Sonar, fan: Fan) -> Iterator[str]:
    """What of the stated height, tilt and frame rate can hardly be so."""
    height, tilt, hz = sonar.height_m, sonar.tilt_deg, sonar.frame_rate_hz
    if height and tilt is None and fan.tilt_deg > STEEP_TILT_DEG:
        yield (
            f"height {height:g} m puts the sonar almost straight above the floor "
            f"(tilt {fan.tilt_deg:.0f} deg); is it in metres?"
        )
    if height and tilt is not None:
        lowest_deg = min(max(tilt + HALF_BEAM_DEG, 1.0), 90.0)
        if height / math.sin(math.radians(lowest_deg)) > fan.range_max_m:
            yield (
                f"height {height:g} m at a tilt of {tilt:g} deg puts the floor beyond "
                f"range_max_m = {fan.range_max_m:g}; is the height in metres?"
            )
        axis_m = height / math.sin(math.radians(tilt)) if tilt else math.inf
        if axis_m < fan.range_min_m:
            yield (
                f"with tilt_deg = {tilt:g} and height_m = {height:g} the sonar's axis meets the "
                f"floor at {axis_m:.3g} m, nearer than range_min_m = {fan.range_min_m:g}; check "
                "the three"
            )
    most_hz = min(MOST_HZ, SOUND_M_S / 2 / fan.range_max_m)
    if hz is not None and hz > most_hz:
        yield (
            f"frame_rate_hz = {hz:g} is too fast for echoes from {fan.range_max_m:.3g} m (at most "
            f"{most_hz:.3g}); if it is the milliseconds of a frame, write {1e3 / hz:.3g}"
        )


def _in_radians(sonar: Sonar, fan: Fan) -> Iterator[str]:
    """Which stated angles are so small that they may be in radians."""
    name, across_deg = "field_of_view_deg", fan.bearing_max_deg - fan.bearing_min_deg
    if sonar.bearings_deg is not None:
        name, across_deg = "the span of bearings_deg", float(np.ptp(sonar.bearings_deg))
    stated = [(name, across_deg, math.pi)]
    if sonar.tilt_deg is not None and sonar.tilt_deg % 1:  # 1 deg is one, and 0 is level
        stated.append(("tilt_deg", sonar.tilt_deg, math.pi / 2))
    for name, angle, most in stated:
        if 0 < angle <= most:
            yield (
                f"{name} is {angle:.3g}, which is very small; if it is in radians, write "
                f"{math.degrees(angle):.3g}"
            )


# Commands to try


def _again(run: PreparedRun, *options: str) -> str:
    """The command that repeats a run with other options, and leaves its results as they are."""
    job = run.job
    if job.urls:  # run.toml is on a server
        return f"`run` with {' '.join(options)}"
    poses = run.log_options.odometry
    return rerun(Path(job.log), job.folder / "run.toml", *options, poses=poses)


def _landmarks(run: PreparedRun) -> str:
    """The command that shows the landmark set of a run."""
    job, is_built_in = run.job, run.landmarks == load_landmarks("basin")
    own = [] if job.urls or is_built_in else [job.folder / "run.toml"]
    return command_line("landmarks", *own)


def _preview(run: PreparedRun) -> str:
    """The command that draws the geometry of a run onto its first frame."""
    job = run.job
    if job.urls:
        return "`sonarrec info --preview` of a copy"
    file, topic = job.folder / "run.toml", run.log.reading().get("topic")
    words: list[object] = ["info", Path(job.log), "--sonar", file]
    words += [] if topic is None else ["--topic", topic]
    words += [] if run.landmarks == load_landmarks("basin") else ["--landmarks", file]
    return command_line(*words, "--preview", free_name(Path(job.out, f"{job.name}_preview.png")))
