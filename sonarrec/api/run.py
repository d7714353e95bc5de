"""Runs logs, one or many, and gives what became of each: `sonarrec.run`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, overload

from sonarrec.advice.log import of_run
from sonarrec.errors import UsageError, refuse_url
from sonarrec.readers.named_logs import NamedLog
from sonarrec.results.run_file import LogOptions, frame_span, span_text
from sonarrec.runs.job import Observe, Outcome, RunOptions
from sonarrec.runs.one import at_hand, run_log
from sonarrec.runs.run import Presets, Runs, configs_of, jobs_of, run_jobs
from sonarrec.sonar.frame import Clock
from sonarrec.sonar.stated import Sonar, sonar_from


@overload
def run(log: str | Path, out: str | Path = ..., **options: Any) -> Outcome: ...
@overload
def run(log: Sequence[str | Path], out: str | Path = ..., **options: Any) -> Runs: ...


def run(  # type: ignore[misc]  # the overloads leave out what both have
    log: str | Path | Sequence[str | Path],
    out: str | Path = "sonarrec_out",
    *,
    preset: Presets = "default",
    landmarks: str | Path | None = None,
    model: str | Path | None = None,
    sonar: Sonar | Mapping[str, Any] | None = None,
    sonar_file: str | Path | None = None,
    topic: str | None = None,
    time: Clock | None = None,
    odometry: str | Path | None = None,
    frames: tuple[int, int | None] | None = None,
    overwrite: bool = False,
    jobs: int | None = None,
    observe: Observe | None = None,
) -> Outcome | Runs:
    """Recognise the landmarks in a log, or in each of several; results go to `out`/<log name>/.

    Of several logs one that cannot be used does not stop the others.

    Parameters
    ----------
    log : str, Path or sequence of these
        An MCAP file, a ROS bag, a folder or glob of images, a video or a sonar's own file.
    out : str or Path, default "sonarrec_out"
        The folder of the results.
    preset : str, Config or sequence of these, default "default"
        "default", "offline", "paper" or settings; several run side by side, each of another name.
    landmarks : str or Path, optional
        A landmark set, by name or TOML file. Default: landmarks.toml of the log, else `basin`.
    model : str or Path, optional
        A model that `sonarrec calibrate` learned.
    sonar : Sonar or mapping, optional
        Geometry that takes precedence over files, such as {"tilt_deg": 20.0}, with the keys and
        units of sonar.toml: m, deg.
    sonar_file : str or Path, optional
        A sonar.toml, in place of the log's own.
    topic : str, optional
        The image channel of an MCAP or bag.
    time : {"log", "publish", "header"}, optional
        Which time of a message becomes the time of its frame. Default: log.
    odometry : str or Path, optional
        A table of the sonar's poses, CSV or in TUM form.
    frames : tuple of int, optional
        (first, end): only these frames, without `end`, which may be None: to the last. They keep
        their numbers.
    overwrite : bool, default False
        Do again what is up to date, and replace the results of another log of that name.
    jobs : int, optional
        How many logs run at once. Default: the number of cores.
    observe : callable, optional
        Of a single log: called after each frame with its FrameResult and the number of frames,
        None if that is not known.

    Returns
    -------
    Outcome or Runs
        Of one log its Outcome: folder, counts, sightings, notes and problems. Of several Runs:
        `table` has a row per log.

    Raises
    ------
    SonarrecError
        Input or settings cannot be used; what was written stays.
    UsageError
        An option is invalid.

    Examples
    --------
    >>> done = sonarrec.run("sample_data/polar", "results", frames=(0, 60))
    >>> done
    <results/polar: 60 frames, 2 sightings>
    >>> [(one.method, one.landmark) for one in done.sightings]
    [('framework', 2), ('framework', 4)]
    """
    log_options = LogOptions(
        sonar=sonar_from(sonar),
        sonar_file=None if sonar_file is None else Path(sonar_file),
        topic=topic,
        time=time,
        odometry=None if odometry is None else Path(odometry),
        # By the text that run.toml will hold: what it could not give back is refused.
        frames=None if frames is None else frame_span(span_text(frames)),
    )
    learned = None if model is None else Path(model)
    run_options = RunOptions(configs_of(preset), landmarks, learned)
    several = [log] if isinstance(log, str | Path) else log
    logs = [NamedLog(str(path)) for path in several]
    to_run = jobs_of(logs, str(refuse_url(out)), log_options, run_options, overwrite, of_run)
    if isinstance(log, str | Path):
        with at_hand(to_run[0]) as job:
            return run_log(job, observe)
    if observe is not None:
        raise UsageError("observe is for a single log")
    done = run_jobs(to_run, out, at_once=jobs)
    errors = [outcome.error for outcome in done.outcomes if outcome.error is not None]
    if errors and len(errors) == len(done.outcomes):
        raise errors[0]
    return done
