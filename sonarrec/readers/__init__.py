"""Opens recorded logs: any kind of file in, a stream of frames out, fan images or polar."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from sonarrec.errors import SonarrecError, UsageError, command_line
from sonarrec.readers.log import Log
from sonarrec.readers.open import SONAR_FILE, Source, find_log, misnamed, own_file
from sonarrec.sonar.frame import Clock
from sonarrec.sonar.stated import Sonar, sonar_from


def open_log(
    path: str | Path | Source,
    *,
    sonar: Sonar | Mapping[str, Any] | None = None,
    sonar_file: str | Path | None = None,
    topic: str | None = None,
    time: Clock = "log",
    up_to: Path | None = None,
) -> Log:
    """Open a log for reading its frames: images, a video, an MCAP, a ROS bag or a sonar's own file.

    Parameters
    ----------
    path : str, Path or Source
        A file, a folder or a glob of images; or a log that `find_log` found.
    sonar : Sonar or mapping, optional
        Geometry that takes precedence over files, such as {"tilt_deg": 20.0}, with the keys and
        units of sonar.toml.
    sonar_file : str or Path, optional
        In place of the log's own sonar.toml: `sonar.toml` in a folder of images; of one file
        `NAME.sonar.toml`, else `sonar.toml`, in its folder.
    topic : str, optional
        The image channel of an MCAP file or a bag.
    time : {"log", "publish", "header"}, default "log"
        Which time of a message becomes the time of its frame. Frames are always in the order of
        log time.
    up_to : Path, optional
        The highest folder that is searched for a sonar.toml if the log has none of its own.

    Returns
    -------
    Log
        Iterate over it for Frames; it is a context manager that closes the file.

    Raises
    ------
    SonarrecError
        The log or its geometry cannot be used.
    UsageError
        The topic or time is invalid.

    Examples
    --------
    >>> with sonarrec.open_log("sample_data/polar") as log:
    ...     frame = next(iter(log))
    >>> frame.pixels.shape, frame.pixels.dtype  # range bins x beams
    ((256, 96), dtype('uint8'))
    >>> frame.fan.range_min_m, frame.fan.range_max_m
    (1.4, 2.65)
    """
    if isinstance(path, Source):
        source, path = path, path.path
    else:
        source = find_log(path, up_to)
    source.check_topic(topic, path)
    if time not in get_args(Clock):
        raise UsageError(f"{path}: time is {time!r}, not one of {', '.join(get_args(Clock))}")
    if time != "log" and not source.reader.has_topics:
        raise UsageError(
            f"{path}: --time chooses a clock of an MCAP or a ROS bag; this log is neither"
        )
    file = None if sonar_file is None else Path(sonar_file)
    flags = sonar_from(sonar)
    resolved, where = source.stated_sonar(flags, file)
    raw = source.open(topic)
    resolved = raw.geometry(resolved)
    try:
        if not raw.polar and (missing := resolved.missing()):
            option = f"--{missing[0].replace('_', '-')}"
            own = own_file(source.path, SONAR_FILE)
            chosen = [] if topic is None else ["--topic", topic]
            begin = command_line(
                "info", Path(path), *chosen, *flags.as_options(), "--write-sonar", own
            )
            has_file = file is not None or source.companion(SONAR_FILE) is not None
            how = "fill it in" if has_file else f"{begin} begins a sonar.toml"
            raise SonarrecError(
                f"{where}: sonar geometry lacks {', '.join(missing)}; {how}, or give options such "
                f"as {option}{'' if has_file else misnamed(source.location, SONAR_FILE)}"
            )
        if not raw.polar:
            resolved.complete(where)
        elif not resolved.states_floor:
            raise SonarrecError(
                f"{where}: the log states the sonar's geometry except for its tilt; give "
                "--tilt-deg (downward, to within some 10 deg) or --height-m, or write one of the "
                f"two into a sonar.toml next to it{misnamed(source.location, SONAR_FILE)}"
            )
    except SonarrecError:
        raw.close()
        raise
    return Log(source, resolved, raw, time)
