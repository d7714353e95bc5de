"""Results on disk: frames.csv, estimates.csv and run.toml (the contract is in the README)."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Self

import tomli_w

from sonarrec import __version__, config
from sonarrec.landmarks import LandmarkSet
from sonarrec.records import NO_STAMPS, Fan, FrameResult, SonarrecError, Stamps
from sonarrec.sonar import Sonar

FRAME_COLUMNS = (
    "frame",
    "timestamp_ns",
    "candidates",
    "tracks",
    "log_time_ns",
    "publish_time_ns",
    "header_stamp_ns",
)


def estimate_columns(ids: Sequence[int]) -> list[str]:
    """The header of estimates.csv for a landmark set's IDs."""
    place = ["x_px", "y_px", "range_m", "bearing_deg", "orientation_deg", "existence"]
    beliefs = [f"p_{i}" for i in ids] + ["p_none"]
    return [
        "frame",
        "timestamp_ns",
        "method",
        "object",
        *place,
        *beliefs,
        "landmark",
        "score",
        "declared",
        "range_sigma_m",
        "bearing_sigma_deg",
        "orientation_sigma_deg",
    ]


class ResultsWriter:
    """Appends one log's results as they come; run.toml says `finished = true` only at the end."""

    def __init__(self, folder: Path, landmarks: LandmarkSet, run: dict[str, Any]) -> None:
        """run: the tables of run.toml. Raises SonarrecError where the folder cannot be written."""
        self.frames = 0
        self._folder = folder
        self._run = run
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._write_run(finished=False)
            # Line endings and encoding are fixed, so that equal results are equal bytes anywhere.
            self._frames_file = (folder / "frames.csv").open("w", newline="", encoding="utf-8")
            self._estimates_file = (folder / "estimates.csv").open(
                "w", newline="", encoding="utf-8"
            )
        except OSError as error:
            raise SonarrecError(
                f"{folder}: cannot write results here ({error.strerror}); choose another --out"
            ) from None
        self._frames = csv.writer(self._frames_file, lineterminator="\n")
        self._estimates = csv.writer(self._estimates_file, lineterminator="\n")
        self._frames.writerow(FRAME_COLUMNS)
        self._estimates.writerow(estimate_columns(landmarks.ids))

    def write(self, result: FrameResult, stamps: Stamps = NO_STAMPS) -> None:
        """Append one frame and the times that its log keeps of it.

        Raises SonarrecError where the disk takes no more.
        """
        self.frames += 1
        try:
            self._frames.writerow(
                (
                    result.index,
                    result.timestamp_ns,
                    result.candidates,
                    result.tracks,
                    stamps.log,
                    stamps.publish,
                    stamps.header,
                )
            )
            self._estimates.writerows(
                (
                    result.index,
                    result.timestamp_ns,
                    e.method,
                    e.object,
                    f"{e.x_px:.2f}",
                    f"{e.y_px:.2f}",
                    f"{e.range_m:.4f}",
                    f"{e.bearing_deg:.3f}",
                    f"{e.orientation_deg:.1f}",
                    f"{e.existence:.4f}",
                    *(f"{p:.6f}" for p in e.probabilities.tolist()),
                    e.landmark,
                    f"{e.score:.6f}",
                    int(e.declared),
                    f"{e.range_sigma_m:.4f}",
                    f"{e.bearing_sigma_deg:.3f}",
                    f"{e.orientation_sigma_deg:.1f}",
                )
                for e in result.estimates
            )
        except OSError as error:
            raise self._fault(error) from None

    def finish(self, problems: Sequence[str]) -> None:
        """Mark the results as whole: every frame of the log was processed or told of.

        Raises SonarrecError where the disk takes no more.
        """
        self._run["input"]["frames_processed"] = self.frames
        self._run["input"]["problems"] = list(problems)
        try:
            # The last rows leave the buffers before run.toml calls them whole.
            self._frames_file.close()
            self._estimates_file.close()
            self._write_run(finished=True)
        except OSError as error:
            raise self._fault(error) from None

    def _fault(self, error: OSError) -> SonarrecError:
        return SonarrecError(
            f"{self._folder}: cannot write results ({error.strerror}); what is there is good"
        )

    def _write_run(self, finished: bool) -> None:
        """Replace run.toml in one step: readers see the old one or the new one."""
        text = tomli_w.dumps({"finished": finished, **self._run}, multiline_strings=True)
        partial = self._folder / "run.toml.part"
        partial.write_text(text, encoding="utf-8")
        os.replace(partial, self._folder / "run.toml")  # noqa: PTH105

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._frames_file.close()
        self._estimates_file.close()


def run_table(
    settings: Sequence[config.Config],
    sonar: Sonar,
    fan: Fan,
    landmarks: LandmarkSet,
    source: tuple[str, int, str],
    reading: Mapping[str, Any] = MappingProxyType({}),
) -> dict[str, Any]:
    """The tables of run.toml: all that is needed to get the same results again.

    sonar: as stated, which serves a run again. source: the input's name, size in bytes and SHA-256.
    reading: how it was read (`Log.reading`). The fan is written out also where the geometry leaves
    it to defaults or to the log's messages, so that fan pixels can be read later.
    """
    resolved = Sonar(metres_per_pixel=fan.metres_per_pixel, apex_px=(fan.apex_column, fan.apex_row))
    table = sonar.as_table() | {
        key: value
        for key, value in resolved.as_table().items()
        # A polar image has no pixels of its own: these describe the fan it became.
        if sonar.layout == "fan"
    }
    name, size, digest = source
    tables = [config.as_table(c) for c in settings]
    return {
        "program": {"name": "sonarrec", "version": __version__},
        "input": {"name": name, "bytes": size, "sha256": digest, **reading},
        "config": tables if len(tables) > 1 else tables[0],
        "sonar": table,
        "fan": {
            "rows": fan.rows,
            "columns": fan.columns,
            "metres_per_pixel": fan.metres_per_pixel,
            "apex_px": [fan.apex_column, fan.apex_row],
            "range_min_m": fan.range_min_m,
            "range_max_m": fan.range_max_m,
            "field_of_view_deg": fan.bearing_max_deg - fan.bearing_min_deg,
            "tilt_deg": fan.tilt_deg,
            **({} if fan.height_m is None else {"height_m": fan.height_m}),
        },
        "landmarks": landmarks.as_table(),
    }


@dataclass(slots=True)
class Sighting:
    """One landmark as one track declared it: what `sonarrec run` prints."""

    landmark: int
    track: int
    first: FrameResult
    last: FrameResult
    frames: int
    best_score: float


class Sightings:
    """Gathers which landmarks one method declared, when and how surely."""

    def __init__(self, method: str) -> None:
        self.method = method
        self._found: dict[tuple[int, int], Sighting] = {}

    def add(self, result: FrameResult) -> None:
        """Take in one frame's declared estimates."""
        for estimate in result.estimates:
            if estimate.method != self.method or not estimate.declared:
                continue
            key = (estimate.landmark, estimate.object)
            known = self._found.setdefault(key, Sighting(*key, result, result, 0, 0.0))
            known.last = result
            known.frames += 1
            known.best_score = max(known.best_score, estimate.score)

    def table(self) -> list[str]:
        """Lines to print, one per landmark and track, in order of first sight."""
        if not self._found:
            return ["no landmark declared"]
        lines = ["landmark  track  frames         from s      to s  declared  best score"]
        for s in sorted(self._found.values(), key=lambda s: (s.first.index, s.track)):
            span = f"{s.first.index}-{s.last.index}"
            times = (s.first.timestamp_ns / 1e9, s.last.timestamp_ns / 1e9)
            lines.append(
                f"{s.landmark:>8}  {s.track:>5}  {span:<11} {times[0]:>9.2f} {times[1]:>9.2f}"
                f"  {s.frames:>8}  {s.best_score:>10.3f}"
            )
        return lines
