"""Runs frames through the recogniser without writing files: `sonarrec.Recogniser`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from sonarrec.config import Config
from sonarrec.config import preset as config_of
from sonarrec.errors import UsageError
from sonarrec.landmarks import LandmarkSet, load_landmarks
from sonarrec.nouns import Fan, Frame, FrameResult
from sonarrec.readers.log import Log
from sonarrec.recogniser.presets.side_by_side import SideBySide
from sonarrec.recogniser.restore.beam_width import with_beams
from sonarrec.recogniser.stage3.model import read_model

Presets = str | Config | Sequence[str | Config]
"""One preset by name or as a Config, or several to run side by side."""


class Recogniser:
    """Recognises the landmarks in frames of a log, and gives their results; writes no files."""

    def __init__(
        self,
        source: Log | Fan,
        preset: Presets = "default",
        *,
        landmarks: str | Path | LandmarkSet = "basin",
        model: str | Path | None = None,
    ) -> None:
        """source: an opened log, or the fan geometry that frames of your own share.

        The rest is as in `run`. Raises SonarrecError where one of them cannot be used.
        """
        self._log = source if isinstance(source, Log) else None
        self._fan = source if isinstance(source, Fan) else None
        self._configs = configs_of(preset)
        self.landmarks = (
            landmarks if isinstance(landmarks, LandmarkSet) else load_landmarks(landmarks)
        )
        self._model = None if model is None else read_model(Path(model)).model

    def recognise(self, frames: Iterable[Frame] | None = None) -> Iterator[FrameResult]:
        """Yield a FrameResult for each Frame, in the frames' order, some frames later.

        frames: of one fan, by rising index; `pixels` are the fan image, (rows, columns) uint8, or
        polar where a frame has `polar`. Default: the log's own. Nothing is remembered from one call
        to the next. Raises UsageError at an image whose shape or type does not fit the fan,
        and at a frame that does not come after the last.
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
    configs = [config_of(one) if isinstance(one, str) else one for one in several]
    names = [one.preset for one in configs]
    if not names:
        raise UsageError("preset: none is given; leave it out for default")
    if len(set(names)) < len(names):
        raise UsageError(
            f"preset {', '.join(names)}: each once, for results go by its name; run settings of "
            "one preset apart, each with an out of its own"
        )
    return configs
