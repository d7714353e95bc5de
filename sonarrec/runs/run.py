"""Runs logs, one or many, and gives what became of each: `sonarrec.run`, and the command's."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from sonarrec.config import Config
from sonarrec.config import preset as config_of
from sonarrec.errors import Advice, UsageError, is_url, number_of, redact_url
from sonarrec.landmarks import LandmarkSet, load_landmarks
from sonarrec.readers.log import Log
from sonarrec.readers.named_logs import NamedLog
from sonarrec.recogniser.presets.side_by_side import SideBySide
from sonarrec.recogniser.restore.beam_width import with_beams
from sonarrec.recogniser.stage3.model_file import read_model
from sonarrec.results.folders import MADE, PAGES
from sonarrec.results.run_file import LogOptions
from sonarrec.runs import cores
from sonarrec.runs.job import Event, Job, Outcome, RunOptions
from sonarrec.runs.logs_table import COLUMNS, NAME, LogsTable, Row
from sonarrec.runs.many import Watch, run_here, run_in_processes
from sonarrec.runs.one import result_names
from sonarrec.sonar.frame import Fan, Frame, FrameResult

if TYPE_CHECKING:
    import pandas as pd


Presets = str | Config | Sequence[str | Config]
"""One preset by name or as a Config, or several to run side by side."""


class Recogniser:
    """Recognises the landmarks in frames of a log, and gives their results; writes no files.

    Parameters
    ----------
    source : Log or Fan
        An opened log, or the geometry that frames of your own share.
    preset : str, Config or sequence of these, default "default"
        As in `run`.
    landmarks : str, Path or LandmarkSet, default "basin"
        A landmark set, or its name or TOML file.
    model : str or Path, optional
        A model that `sonarrec calibrate` learned.

    Raises
    ------
    SonarrecError
        One of these cannot be used.
    """

    def __init__(
        self,
        source: Log | Fan,
        preset: Presets = "default",
        *,
        landmarks: str | Path | LandmarkSet = "basin",
        model: str | Path | None = None,
    ) -> None:
        self._log = source if isinstance(source, Log) else None
        self._fan = source if isinstance(source, Fan) else None
        self._configs = configs_of(preset)
        self.landmarks = (
            landmarks if isinstance(landmarks, LandmarkSet) else load_landmarks(landmarks)
        )
        self._model = None if model is None else read_model(Path(model)).weights

    def recognise(self, frames: Iterable[Frame] | None = None) -> Iterator[FrameResult]:
        """Recognise the landmarks in frames, in their order.

        Nothing is remembered from one call to the next.

        Parameters
        ----------
        frames : iterable of Frame, optional
            Frames of one fan, by rising index. `pixels` are the fan image, (rows, columns) uint8,
            or (range bins, beams) uint8 where a frame has `polar`. Default: those of the log.

        Yields
        ------
        FrameResult
            One for each frame, some frames later; positions in px, m and deg.

        Raises
        ------
        UsageError
            An image has a shape or type that does not fit the fan, or a frame does not come after
            the one before.
        """
        frames = self._log if frames is None else frames
        if frames is None:
            raise UsageError("a Recogniser made from a fan needs frames to recognise")
        rest = _of_one_fan(frames, self._fan)
        first = next(rest, None)
        if first is None:
            return
        stated_deg = None if self._log is None else self._log.beam_width_deg
        configs, _ = with_beams(self._configs, stated_deg, first)
        recogniser = SideBySide(configs, self._fan or first.fan, self.landmarks, self._model)
        yield from recogniser.recognise(chain([first], rest))


def _of_one_fan(frames: Iterable[Frame], fan: Fan | None) -> Iterator[Frame]:
    """The frames; fan: theirs, if None that of the first. Raises UsageError as `recognise` does."""
    before = -1
    for frame in frames:
        fan = fan or frame.fan
        pixels, shape, fan_shape = frame.pixels, frame.pixels.shape, (fan.rows, fan.columns)
        if frame.polar is not None and shape == frame.polar.shape:
            shape = frame.fan.rows, frame.fan.columns  # of the fan image that they make
        elif frame.polar is not None:
            fan_shape = frame.polar.shape
        if shape != fan_shape or pixels.dtype != np.uint8:
            raise UsageError(
                f"frame {frame.index}: an image of {shape} {pixels.dtype}, where the fan "
                f"needs {fan_shape} uint8"
            )
        if frame.index <= before:
            raise UsageError(f"frame {frame.index} comes after frame {before}; sort by index")
        before = frame.index
        yield frame


def configs_of(presets: Presets) -> list[Config]:
    """The presets as Configs.

    Raises UsageError if there is none, or if two have one name: results are named by it.
    """
    several = [presets] if isinstance(presets, str | Config) else presets
    configs = [config_of(preset) if isinstance(preset, str) else preset for preset in several]
    names = [config.preset for config in configs]
    if not names:
        raise UsageError("preset: none is given; leave it out for default")
    if len(set(names)) < len(names):
        raise UsageError(
            f"preset {', '.join(names)}: each once, for results go by its name; to compare "
            "settings of one preset, run it once for each, each with an out of its own"
        )
    return configs


@dataclass(frozen=True, slots=True, repr=False)
class Runs:
    """How the runs of several logs went."""

    folder: Path
    """That which holds the results of each."""
    rows: tuple[Row, ...]
    """As in logs.csv."""
    outcomes: tuple[Outcome, ...]
    """What became of each log, in their order."""
    fault: str | None
    """Why logs.csv could not be written."""
    notes: tuple[str, ...]
    """On the folder as a whole."""

    @property
    def table(self) -> pd.DataFrame:
        """A row for each log, as in logs.csv; `message` says why one failed."""
        import pandas as pd  # slow to load

        return pd.DataFrame(map(astuple, self.rows), columns=list(COLUMNS))

    def __iter__(self) -> Iterator[Outcome]:
        """Those of the logs that have results now."""
        return (outcome for outcome in self.outcomes if outcome.error is None)

    def __repr__(self) -> str:
        frames = [outcome.frames for outcome in self]
        failed = len(self.rows) - len(frames)
        done = f"{number_of(len(frames), 'log')}, {number_of(sum(frames), 'frame')}"
        return f"<{self.folder}: {done}; {failed} failed>" if failed else f"<{self.folder}: {done}>"


def jobs_of(
    logs: Sequence[NamedLog],
    out: str,
    log_options: LogOptions,
    run_options: RunOptions,
    overwrite: bool = False,
    advise: Callable[..., Iterable[Advice]] | None = None,
) -> list[Job]:
    """A job for each log. out: the folder of the results, or its URL.

    Raises UsageError if two logs would have the same name.
    """
    names = result_names([redact_url(log.path) if is_url(log.path) else log.path for log in logs])
    return [
        Job(
            log=log.path,
            name=name,
            out=out,
            log_options=replace(log_options, up_to=log.up_to),
            run_options=run_options,
            overwrite=overwrite,
            advise=advise,
        )
        for log, name in zip(logs, names, strict=True)
    ]


def run_jobs(
    jobs: Sequence[Job],
    out: str | Path,
    watch: Watch | None = None,
    *,
    at_once: int | None = None,
    scheduler: str | None = None,
    alone: bool = False,
) -> Runs:
    """Run the jobs and keep OUT/logs.csv, also if the call is stopped.

    out: a folder, or the URL of one. watch: gets what happens meanwhile. at_once: how many run at
    the same time; default: the number of cores. scheduler: address of a Dask cluster that runs
    them. alone: the call names a single log; if that gives no results, logs.csv is not written.
    """
    outcomes: dict[int, Outcome] = {}
    with _folder_of(out) as folder:
        table = LogsTable(folder, jobs, alone=alone)

        def keep(i: int | None, event: Event) -> None:
            if i is not None:
                table.add(i, event)
            if i is not None and isinstance(event, Outcome):
                outcomes[i] = event
            if watch is not None:
                watch(i, event)

        at_once = min(at_once or cores(), len(jobs))
        table.write()
        try:
            if scheduler is not None:
                from sonarrec.runs.cluster import run_on_cluster  # with dask, only where needed

                run_on_cluster(jobs, scheduler, keep)
            elif at_once > 1:
                run_in_processes(jobs, at_once, keep)
            else:
                run_here(jobs, keep)
        except BaseException:  # Ctrl-C as well
            table.stopped()
            raise
        finally:
            table.write()
        ended = tuple(outcome for _, outcome in sorted(outcomes.items()))
        return Runs(folder, table.rows, ended, table.fault, _outdated(folder, ended))


@contextmanager
def _folder_of(out: str | Path) -> Iterator[Path]:
    """The folder of the results; of a URL one for logs.csv, which is put there at the end.

    A run that is stopped does not wait for a server.
    """
    if not is_url(out):
        yield Path(out)
        return
    from sonarrec.runs.remote import check_out, download, upload  # with fsspec, only where needed

    check_out(str(out))
    url = f"{str(out).rstrip('/')}/{NAME}"
    with TemporaryDirectory(prefix="sonarrec-") as folder:
        download(url, Path(folder, NAME))  # with the rows of other calls
        yield Path(folder)
        upload(Path(folder, NAME), url)


def _outdated(out: Path, outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    """A note on pages and folders in OUT that were made from results replaced now."""
    if all(outcome.error is not None or outcome.up_to_date for outcome in outcomes):
        return ()
    older = [name for name in PAGES if (out / name).exists()]
    older += [name for name, made in MADE.items() if (out / name / made[-1]).is_file()]
    text = f"{out}: older than the results: {', '.join(older)}; make them again"
    return (text,) if older else ()
