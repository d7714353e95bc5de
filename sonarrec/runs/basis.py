"""What a run goes by, in one line: geometry, landmark set, beam width, and where each is from."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from sonarrec.config import Config
from sonarrec.geometry import floor_depth
from sonarrec.landmarks import LandmarkSet
from sonarrec.nouns import Fan
from sonarrec.readers.log import Log
from sonarrec.readers.open import LANDMARKS_FILE, SONAR_FILE, Source
from sonarrec.results.run_file import LogOptions, RunFile
from sonarrec.sonar import Sonar

OPTION = "option"


def chosen_landmarks(
    source: Source | None, choice: str | Path | None, earlier: RunFile
) -> tuple[LandmarkSet, str]:
    """The set that the user chose, else the earlier run's, else that beside the log, else basin;
    and where it is from. Raises SonarrecError if it is invalid."""
    if choice is not None:
        return earlier.landmark_set(choice), f"{OPTION}, {choice}"
    if "landmarks" in earlier.table:
        return earlier.landmark_set(), str(earlier.path)
    beside = None if source is None else source.beside(LANDMARKS_FILE)
    return earlier.landmark_set(beside), "built in" if beside is None else str(beside)


def basis(
    log: Log,
    fan: Fan,
    source: Source,
    given: LogOptions,
    earlier: RunFile,
    landmarks: tuple[LandmarkSet, str],
    beams: str,
) -> str:
    """The line. given: the options of the command alone. earlier: the run.toml that completed
    them. landmarks: from `chosen_landmarks`. beams: from `beams_in_words`."""
    file = given.sonar_file or source.beside(SONAR_FILE)
    again = Sonar() if given.sonar_file else earlier.sonar()

    def origin(key: str) -> str:
        if getattr(given.sonar, key) is not None:
            return OPTION
        if getattr(again, key) is not None:
            return str(earlier.path)
        stated = getattr(log.stated, key)
        if stated is not None and stated != getattr(log.header, key):
            return str(file)
        return "log" if getattr(log.sonar, key) is not None else "assumed"

    height = origin("height_m")
    if height == "assumed" and fan.height_m is not None:
        height = "as the first frames show"
    view = "field_of_view_deg" if log.sonar.bearings_deg is None else "bearings_deg"
    window = [f"{fan.range_min_m:.4g}", f"to {fan.range_max_m:.4g} m"]
    ends = [origin("range_min_m"), origin("range_max_m")]
    one = [(" ".join(window), ends[0])] if ends[0] == ends[1] else [*zip(window, ends, strict=True)]
    parts = [
        *one,
        (f"{fan.bearing_max_deg - fan.bearing_min_deg:.4g} deg wide", origin(view)),
        (f"tilt {fan.tilt_deg:.4g} deg", origin("tilt_deg")),
        (f"height {floor_depth(fan):.3g} m", height),
    ]
    told = {"layout", "range_min_m", "range_max_m", view, "tilt_deg", "height_m", "frame_rate_hz"}
    others = [key for key in log.sonar.as_table() if key not in told]
    parts += [(key, where) for key in others if (where := origin(key)) not in ("log", "assumed")]
    chosen, from_where = landmarks
    # An origin once for those that follow each other.
    groups = groupby(parts, key=lambda part: part[1])
    by_origin = [f"{', '.join(text for text, _ in same)} ({where})" for where, same in groups]
    line = f"geometry {', '.join(by_origin)}; landmarks {chosen.name} ({from_where}); {beams}"
    unused = source.others(SONAR_FILE, file)
    unused += source.others(LANDMARKS_FILE, source.beside(LANDMARKS_FILE))
    if from_where.startswith(OPTION) or "landmarks" in earlier.table:
        unused += filter(None, [source.beside(LANDMARKS_FILE)])
    seen = [str(place) for place in unused if str(place) not in from_where]
    return line + (f"; not used: {', '.join(seen)}" if seen else "")


def beams_in_words(
    stated: Sequence[Config], used: Sequence[Config], log: Log, about: Sequence[str]
) -> str:
    """The beams' width, and where it is from. stated, used: the settings before and after
    `with_beams`. about: its notes."""
    widths = {c.features.beam_width_deg for c in used if c.features.beam_width_deg}
    if not widths:
        return "no beam width needed"
    how = "by its beams" if about else "usual for this view"
    if log.beam_width_deg is not None:
        how = "stated"
    if any(c.features.beam_width_deg for c in stated):
        how = "setting"
    return f"beams {' and '.join(f'{width:g}' for width in sorted(widths))} deg wide ({how})"
